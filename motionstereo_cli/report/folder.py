"""What a run left in its folder, complete or not, as tables."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.atomic import part_of
from motionstereo_cli.sinks import OUTPUTS, RECORD
from motionstereo_cli.sinks.reading import read_record, read_table

if TYPE_CHECKING:
    from numpy.typing import NDArray

#: Columns of the steering table that the page shows over time.
SERIES = ("steer", "steer_rad", "depth_m", "nearest_m", "charged", "matched")

Rows = list[dict[str, str]]


@dataclass(frozen=True, slots=True)
class Steering:
    """The steering table.

    Attributes:
        frames: (n,) numbers of the frames.
        time_s: (n,) their times; NaN where the source has none.
        status: the status of each frame, n names.
        series: :data:`SERIES` by name, (n,) each; NaN = unknown.
    """

    frames: NDArray[np.int64]
    time_s: NDArray[np.float64]
    status: tuple[str, ...]
    series: Mapping[str, NDArray[np.float64]]

    def __len__(self) -> int:
        return len(self.status)


@dataclass(frozen=True, slots=True)
class Results:
    """What a run left.

    Attributes:
        path: its folder.
        record: what ``run.json`` says or, of a run that is not complete, is going to.
        complete: the run came to its end.
    """

    path: Path
    record: Mapping[str, Any]
    complete: bool

    def has(self, output: str) -> bool:
        """Return whether the run was to write an output."""
        return output in self.record.get("outputs", {})

    def steering(self) -> Steering | None:
        """Return the steering table, None where there is none or it is empty.

        Raises:
            InputError: it cannot be read, or is not such a table.
        """
        rows = self._rows("steering") or self._lines("steering-jsonl")
        return _steering(self.path, rows) if rows else None

    def objects(self) -> Rows | None:
        """Return the rows of the table of moving objects, None where there is none.

        Raises:
            InputError: it cannot be read.
        """
        return self._rows("objects")

    def _rows(self, output: str) -> Rows | None:
        path = self._file(output)
        part = path.suffix == ".part"
        return list(read_table(path, part=part).rows.values()) if path.is_file() else None

    def _lines(self, output: str) -> Rows | None:
        path = self._file(output)
        if not path.is_file():
            return None
        try:
            lines = path.read_text(encoding="utf-8").split("\n")[:-1]
            rows = [json.loads(line) for line in lines]
            return [{k: "" if v is None else str(v) for k, v in row.items()} for row in rows]
        except (OSError, ValueError, AttributeError, RecursionError) as error:
            raise InputError(f"cannot read the table {path}: {error}") from error

    def _file(self, output: str) -> Path:
        """Return an output's file or, where it is not complete, the part that there may be."""
        path = self.path / OUTPUTS[output].path
        return path if path.exists() else part_of(path)


def read_results(path: Path) -> Results:
    """Return what a run left in a folder.

    Raises:
        InputError: no run wrote the folder.
    """
    for place in (path / RECORD, part_of(path / RECORD)):
        if place.is_file():
            record = read_record(place)
            if record.get("program") == "motionstereo":
                return Results(path, record, complete="counts" in record)
    raise InputError(f"{path} has no {RECORD} of a run: give the folder that run wrote (its --out)")


def numbers(texts: Iterable[str]) -> NDArray[np.float64]:
    """Return the numbers of a column; empty = NaN.

    Raises:
        ValueError: a cell is no number.
    """
    return np.array([float(text) if text else np.nan for text in texts])


def _steering(path: Path, rows: Rows) -> Steering:
    try:
        return Steering(
            frames=np.array([int(row["frame"]) for row in rows]),
            time_s=numbers(row["time_s"] for row in rows),
            status=tuple(row["status"] for row in rows),
            series={name: numbers(row[name] for row in rows) for name in SERIES},
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"the steering table in {path} is damaged: {error}") from error
