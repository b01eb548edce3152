"""Compare a run with an earlier one, for regression tests.

GOLDEN is the output of a run, or a part of it. Only images that GOLDEN has are compared; tables are
compared whole. A file of GOLDEN that ACTUAL lacks, or that cannot be read, is a difference.
"""

from __future__ import annotations

import contextlib
import heapq
import itertools
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.evaluation.settings import COLUMN_TOLERANCE, CompareSettings
from motionstereo_cli.files.reading import MAX_RECORD_BYTES, check_regular, read_text, real
from motionstereo_cli.files.records import read_json, typed
from motionstereo_cli.rig.structure import read_structure
from motionstereo_cli.sinks.outputs import MAP_PICTURE, MAP_PLACE, OUTPUTS, RECORD
from motionstereo_cli.sinks.read_back import (
    Maps,
    Table,
    read_pixels,
    read_record,
    shortened,
    size_of,
)
from motionstereo_cli.sinks.records import GROUPS, RunRecord, option_of
from motionstereo_cli.sinks.scale import ENDS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.sinks.outputs import Output
    from motionstereo_cli.types import Real

    #: Rows of a frame by their id, each by column.
    _Rows = dict[str, dict[str, str]]

#: Parts of run.json that may differ between machines, without a word or with a note.
_IGNORED = frozenset(
    {"program", "outputs", "sums", "table", "options", "shares", "warnings", "damage", "timing"}
    | {"measured"}
)
_NOTED = frozenset({"versions", "inputs"})
_ENDS = frozenset(f"output_settings.{name}" for name in ENDS)

#: Rounding allowance at exactly the tolerance: in a table's decimals, in float32 m.
_ROUNDING = 1e-9
_ROUNDING_M = 1e-5


@dataclass(frozen=True, slots=True)
class Difference:
    """A difference in an output.

    Attributes:
        what: a column, a setting, ``pixels``, ``size``, ``rows``, ``frames``, ``files``.
        found: the worst difference, in words.
        count: number of rows, frames or files that differ.
        first_frame, worst_frame: the first frame that differs, and the worst; None if in no frame.
        worst: the difference there, in the column's unit or as share of the pixels; infinite
            if it is not a number.
    """

    what: str
    found: str
    count: int
    first_frame: int | None
    worst_frame: int | None
    worst: float


@dataclass(slots=True)
class Compared:
    """An output of GOLDEN beside that of ACTUAL.

    Attributes:
        name: its path in the folders.
        unit: what ``compared`` counts, such as rows.
        compared: number of these that were compared.
        differences: the differences by :attr:`Difference.what`.
    """

    name: str
    unit: str
    compared: int = 0
    differences: dict[str, Difference] = field(default_factory=dict)

    def differ(
        self, what: str, found: str, frame: int | None = None, worst: float = math.inf
    ) -> None:
        """Add a difference in a frame; the worst of a kind is kept, the others are counted."""
        former = self.differences.get(what, Difference(what, found, 0, frame, frame, worst))
        if worst > former.worst:
            former = replace(former, found=found, worst_frame=frame, worst=worst)
        self.differences[what] = replace(former, count=former.count + 1)


class WorstImage(NamedTuple):
    """The two images that differ most.

    Attributes:
        name: output and frame.
        actual, golden: (height, width) float32 disparity in px or depth in m, NaN = unknown.
        tolerance: in the same unit.
        share: share of pixels that differ, 0..1.
    """

    name: str
    actual: Real
    golden: Real
    tolerance: float
    share: float


@dataclass(frozen=True, slots=True)
class CompareReport:
    """The result of a comparison.

    Attributes:
        outputs: all outputs of GOLDEN.
        notes: differences that do not count, and what was not compared, one line each.
        worst_image: the image that differs most; None if none exceeds the tolerance.
    """

    outputs: tuple[Compared, ...]
    notes: tuple[str, ...]
    worst_image: WorstImage | None

    @property
    def differs(self) -> bool:
        """Whether there is any difference."""
        return any(output.differences for output in self.outputs)


def compare(
    actual: Path,
    golden: Path,
    settings: CompareSettings | None = None,
    *,
    tolerances: Mapping[str, float] | None = None,
    progress: Callable[[], object] = lambda: None,
) -> CompareReport:
    """Compare the results of a run with golden ones, one image of each in memory at a time.

    Args:
        actual: folder that ``run`` wrote.
        golden: that of an earlier run, or a part of it.
        settings: tolerances of images; the defaults if None.
        tolerances: tolerances of table columns, in addition to
            :data:`~motionstereo_cli.evaluation.settings.COLUMN_TOLERANCE`.
        progress: called after each image.

    Raises:
        InputError: ``actual`` is not the output of a run, ``golden`` has nothing to compare, or
            they are the same folder.
        SettingsError: no table of ``golden`` has the column of a tolerance.
    """
    check_regular(actual / RECORD, actual)
    if not (actual / RECORD).is_file():
        raise InputError(
            f"{actual} has no {RECORD}, so no run was completed there: check the path, or run again"
        )
    if real(golden) == real(actual):
        raise InputError(f"{actual} and {golden} are the same folder: give two")
    comparison = _Comparison(
        actual,
        golden,
        settings or CompareSettings(),
        {**COLUMN_TOLERANCE, **(tolerances or {})},
        progress,
    )
    report = comparison.report()
    if not any(output.compared or output.differences for output in report.outputs):
        raise InputError(f"{golden} has nothing that run writes: check the path")
    for column in tolerances or {}:
        if column not in comparison.columns:
            known = ", ".join(sorted(comparison.columns & COLUMN_TOLERANCE.keys()))
            raise SettingsError(
                f"--tolerance: no table of {golden} has a column {column!r}: "
                f"choose from {known or 'none, because there is no table'}"
            )
    return report


class _Comparison:
    def __init__(
        self,
        actual: Path,
        golden: Path,
        settings: CompareSettings,
        tolerances: Mapping[str, float],
        progress: Callable[[], object],
    ) -> None:
        self._actual, self._golden = actual, golden
        self._settings, self._tolerances = settings, tolerances
        self._progress = progress
        self._notes: list[str] = []
        self._worst: WorstImage | None = None
        self.columns: set[str] = set()

    def report(self) -> CompareReport:
        outputs = {}
        self._check_regular(RECORD)
        self._frames = _frames_of(self._golden)
        for save in OUTPUTS.values():
            path = self._golden / save.path
            if save.kind in ("disparity", "depth"):
                if path.parent.is_dir() and save.shown not in outputs:
                    outputs[save.shown] = self._maps(save.shown)
            elif save.kind == "table":
                if os.path.lexists(path):
                    outputs[save.path] = self._table(save.path)
            else:
                outputs |= self._others(save)
        if os.path.lexists(self._golden / RECORD):
            outputs[RECORD] = self._record()
        return CompareReport(tuple(outputs.values()), tuple(self._notes), self._worst)

    def _others(self, save: Output) -> Iterator[tuple[str, Compared]]:
        """Yield each kind of file of an output that is neither images nor a table."""
        special = {MAP_PICTURE: self._cells, MAP_PLACE: self._values}
        for path in save.paths:
            if path in special:
                if os.path.lexists(self._golden / path):
                    yield path, special[path](path)
            elif files := sorted(self._golden.glob(path.replace("{:06d}", "*"))):
                shown = path.partition("{")[0]
                yield shown, self._presence(shown, files)

    def _check_regular(self, name: str) -> None:
        """Make sure that an output is no FIFO, folder or link to elsewhere, which ends it all."""
        for folder in (self._golden, self._actual):
            check_regular(folder / name, folder)

    def _table(self, name: str) -> Compared:
        output = Compared(name, "rows")
        self._check_regular(name)
        try:
            golden = Table(self._golden / name)
            self.columns.update(golden.columns)
            actual = Table(self._actual / name)
            self._rows(output, actual, golden)
        except InputError as error:
            output.differ("files", str(error))
        return output

    def _rows(self, output: Compared, actual: Table, golden: Table) -> None:
        for column in golden.columns:
            if column not in actual.columns:
                output.differ(column, "the column is missing")
        for column in actual.columns:
            if column not in golden.columns:
                output.differ(column, "the column is not in golden")
        shared = [column for column in golden.columns if column in actual.columns]
        if shared != [column for column in actual.columns if column in golden.columns]:
            output.differ("columns", "they are in another order")
        for frame, mine, theirs in _side_by_side(actual, golden):
            for name in sorted(mine.keys() | theirs.keys()):
                if name in mine and name in theirs:
                    for column in shared:
                        self._cell(output, frame, column, mine[name], theirs[name])
                    output.compared += 1
                else:
                    output.differ("rows", "missing" if name in theirs else "not in golden", frame)

    def _cell(
        self,
        output: Compared,
        frame: int,
        column: str,
        actual: Mapping[str, str],
        golden: Mapping[str, str],
    ) -> None:
        mine, theirs = actual[column], golden[column]
        if mine == theirs:
            return
        tolerance = self._tolerances.get(column)
        error = math.inf if tolerance is None else _distance(mine, theirs)
        if tolerance is None or error - tolerance > _ROUNDING:
            found = f"{_shown(mine)}, golden {_shown(theirs)}"
            if math.isfinite(error):
                found += f" (tolerance {tolerance:g})"
            output.differ(column, found, frame, error)

    def _maps(self, name: str) -> Compared:
        output = Compared(name, "images")
        try:
            golden = Maps(self._golden / name, within=self._golden)
            actual = Maps(self._actual / name, within=self._actual)
        except InputError as error:
            output.differ("files", str(error))
            return output
        if golden.kind == "disparity":
            tolerance, shown = self._settings.tolerance_px, f"{self._settings.tolerance_px:g} px"
        else:
            tolerance = self._settings.tolerance_mm / 1000
            shown = f"{self._settings.tolerance_mm:g} mm"
        for frame in golden.files:
            self._progress()
            if frame not in actual.files:
                output.differ("frames", "missing", frame)
                continue
            try:
                mine, theirs = actual.read(frame), golden.read(frame)
            except InputError as error:
                output.differ("files", str(error), frame)
                continue
            if mine.shape != theirs.shape:
                found = f"{size_of(mine)}, golden {size_of(theirs)}"
                output.differ("size", found, frame)
                continue
            output.compared += 1
            share = float(np.mean(differing(mine, theirs, tolerance) | _in_only_one(mine, theirs)))
            if share > (self._worst.share if self._worst else 0):
                self._worst = WorstImage(f"{name} frame {frame}", mine, theirs, tolerance, share)
            if share > self._settings.max_differing:
                found = (
                    f"{share:.2%} are over {shown} off or known in only one "
                    f"(tolerance {self._settings.max_differing:.2%})"
                )
                output.differ("pixels", found, frame, share)
        # golden may be incomplete, but frames that its run did not have are extra.
        for frame in actual.files:
            if not self._in_golden(frame, golden):
                output.differ("frames", "not in golden", frame)
        return output

    def _in_golden(self, frame: int, golden: Maps) -> bool:
        """Return whether the golden run had a frame, even if its image is missing."""
        if frame in golden.files:
            return True
        whole = list(golden.files) == list(range(len(golden.files)))
        return not whole if self._frames is None else frame < self._frames

    def _record(self) -> Compared:
        output = Compared(RECORD, "values")
        try:
            both = [_said(folder / RECORD) for folder in (self._actual, self._golden)]
        except InputError as error:
            output.differ("files", str(error))
            return output
        self._files(*(said.pop("files", ()) for said in both))
        actual, golden = (dict(_leaves(said)) for said in both)
        measured = set.intersection(*(set(said.get("measured", ())) for said in both))
        for name, theirs in golden.items():
            section, _, field_name = name.partition(".")
            if section in _IGNORED or (section in _NOTED and name.endswith(".path")):
                continue
            output.compared += section not in _NOTED
            if name in actual and _same(actual[name], theirs):
                continue
            if name in _ENDS and 0 in (actual.get(name), theirs):  # one run shows no colours
                continue
            if name in actual:
                mine = _given(actual[name])
            else:
                mine = "given" if any(key.startswith(f"{name}.") for key in actual) else "missing"
            found = f"{mine}, golden {_given(theirs)}"
            if section in GROUPS and field_name in measured:
                self._notes.append(f"{option_of(name)} was measured: {found}")
            elif section in _NOTED:
                self._notes.append(f"{name} is {found}")
            else:
                output.differ(option_of(name), found)
        for name in actual.keys() - golden.keys():
            section = name.partition(".")[0]
            # The golden record, too, may be incomplete, but each section that it has is whole.
            there = any(key.startswith(f"{section}.") for key in golden)
            if there and section not in _IGNORED | _NOTED:
                output.differ(option_of(name), f"{_given(actual[name])}, not in golden")
        return output

    def _files(self, actual: Sequence[dict[str, str]], golden: Sequence[dict[str, str]]) -> None:
        """Note which files the runs read besides the recordings, if these differ."""
        mine, theirs = (
            {each["sha256"]: each["path"] for each in side} for side in (actual, golden)
        )
        for these, others, whose in ((mine, theirs, "actual"), (theirs, mine, "golden")):
            self._notes += [
                f"{whose} read {_shown(path)}, the other did not, or with other content"
                for content, path in these.items()
                if content not in others
            ]

    def _cells(self, name: str) -> Compared:
        """Compare two pictures of a map, whose cells have one value of three."""
        output = Compared(name, "cells")
        self._check_regular(name)
        try:
            mine, theirs = (read_pixels(folder / name) for folder in (self._actual, self._golden))
        except InputError as error:
            output.differ("files", str(error))
            return output
        if mine.shape != theirs.shape:
            output.differ("size", f"{size_of(mine)}, golden {size_of(theirs)}")
            return output
        output.compared = theirs.size
        share = float(np.mean(mine != theirs))
        if share > self._settings.max_differing:
            limit = self._settings.max_differing
            output.differ("cells", f"{share:.2%} differ (tolerance {limit:.2%})", worst=share)
        return output

    def _values(self, name: str) -> Compared:
        """Compare two files of values by name, in YAML."""
        output = Compared(name, "values")
        self._check_regular(name)
        try:
            actual, golden = (
                dict(
                    _leaves(
                        dict(read_structure(path, read_text(path, "the values", MAX_RECORD_BYTES)))
                    )
                )
                for path in (self._actual / name, self._golden / name)
            )
        except InputError as error:
            output.differ("files", str(error))
            return output
        output.compared = len(golden)
        for key in dict.fromkeys((*golden, *actual)):
            if not (key in actual and key in golden and _same(actual[key], golden[key])):
                mine, theirs = (
                    _given(side[key]) if key in side else "missing" for side in (actual, golden)
                )
                output.differ(key, f"{mine}, golden {theirs}")
        return output

    def _presence(self, name: str, files: list[Path]) -> Compared:
        output = Compared(name, "files", len(files))
        for file in files:
            path = file.relative_to(self._golden)
            if not (self._actual / path).is_file():
                output.differ("files", f"{path} is missing")
        self._notes.append(f"{name} must exist; its content is not compared")
        return output


def _frames_of(golden: Path) -> int | None:
    """Return the number of frames of a golden run, None if unknown."""
    with contextlib.suppress(InputError):
        if counts := read_record(golden / RECORD).counts:
            return counts.written
    return None


def _side_by_side(actual: Table, golden: Table) -> Iterator[tuple[int, _Rows, _Rows]]:
    """Yield the number of each frame and its rows by id, of both tables; none where it lacks."""

    def of(table: Table, side: int) -> Iterator[tuple[int, int, _Rows]]:
        for frame, rows in table.by_frame():
            yield frame, side, rows

    both = heapq.merge(of(actual, 0), of(golden, 1), key=lambda each: each[:2])
    for frame, group in itertools.groupby(both, lambda each: each[0]):
        found = {side: rows for _, side, rows in group}
        yield frame, found.get(0, {}), found.get(1, {})


def _said(path: Path) -> dict[str, Any]:
    """Return all that a record says, fields of later versions too.

    Raises:
        InputError: the file cannot be read, or is no record of a run.
    """
    said: dict[str, Any] = read_json(path, within=path.parent)
    typed(said, RunRecord, path)
    return said


def differing(actual: Real, golden: Real, tolerance: float) -> NDArray[np.bool_]:
    """Return where two images differ by more than a tolerance, (height, width) bool.

    Args:
        actual, golden: (height, width) float32 px or m, NaN = unknown; unknown in both is equal.
        tolerance: in the same unit.
    """
    return np.asarray(np.abs(actual - golden) > tolerance + _ROUNDING_M)  # NaN is not


def _in_only_one(actual: Real, golden: Real) -> NDArray[np.bool_]:
    return np.asarray(np.isnan(actual) != np.isnan(golden))


def _distance(one: str, other: str) -> float:
    """Return the difference of two cells, infinite unless both are finite numbers."""
    try:
        distance = abs(float(one) - float(other))
    except ValueError:
        return math.inf
    return distance if math.isfinite(distance) else math.inf


def _leaves(record: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield the values of nested dicts and lists with their dotted names, in order."""
    waiting: list[tuple[str, Any]] = [*reversed(record.items())]
    while waiting:
        name, value = waiting.pop()
        if isinstance(value, list):
            value = dict(enumerate(value))
        if isinstance(value, dict):
            waiting += [(f"{name}.{key}", inner) for key, inner in reversed(value.items())]
        else:
            yield name, value


def _same(one: object, other: object) -> bool:
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=1e-6, abs_tol=_ROUNDING)  # a rig is computed
    return one == other


def _shown(cell: str) -> str:
    """Return a cell of a table in words, numbers as they are."""
    if cell == "":
        return "unknown"
    return cell if math.isfinite(_distance(cell, "0")) else shortened(cell)


def _given(value: object) -> str:
    """Return a value of a record in words."""
    if isinstance(value, str):
        return "not given" if value == "" else _shown(value)
    return shortened(value)
