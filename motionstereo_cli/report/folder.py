"""What a run left in its folder, complete or not, as tables."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.atomic import part_of
from motionstereo_cli.sinks import RECORD

if TYPE_CHECKING:
    from numpy.typing import NDArray

#: Columns of the steering table that the page shows over time.
SERIES = ("steer", "steer_rad", "depth_m", "nearest_m", "charged", "matched")


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
class RunFolder:
    """What a run left.

    Attributes:
        path: the folder.
        record: what ``run.json`` says; of a run that is not complete, no more than its outputs.
        complete: the run came to its end.
    """

    path: Path
    record: Mapping[str, Any]
    complete: bool

    def file(self, name: str) -> Path | None:
        """Return an output's file, of a run that is not complete the part there is, or None."""
        path = self.path / name
        return next((each for each in (path, part_of(path)) if each.is_file()), None)

    def steering(self) -> Steering | None:
        """Return the steering table, None where there is none.

        Raises:
            InputError: it cannot be read, or is not such a table.
        """
        rows = self._rows("steering.csv") or self._lines("steering.jsonl")
        return _steering(self.path, rows) if rows else None

    def objects(self) -> list[dict[str, str]] | None:
        """Return the rows of the table of moving objects, None where there is none.

        Raises:
            InputError: it cannot be read.
        """
        return self._rows("objects.csv")

    def _rows(self, name: str) -> list[dict[str, str]] | None:
        text = self._text(name)
        if text is None:
            return None
        try:
            return list(csv.DictReader(io.StringIO(text, newline=""), restval=""))
        except csv.Error as error:
            raise InputError(f"cannot read {self.path / name}: {error}") from error

    def _lines(self, name: str) -> list[dict[str, str]] | None:
        try:
            rows = [json.loads(line) for line in (self._text(name) or "").splitlines()]
            return [{k: "" if v is None else str(v) for k, v in row.items()} for row in rows]
        except (ValueError, AttributeError, RecursionError) as error:
            raise InputError(f"cannot read {self.path / name}: {error}") from error

    def _text(self, name: str) -> str | None:
        """Return the whole lines of a file: the last one may have been cut off."""
        if not (path := self.file(name)):
            return None
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, ValueError) as error:
            raise InputError(f"cannot read {path}: {error}") from error
        return text[: text.rfind("\n") + 1]


def read_run(path: Path) -> RunFolder:
    """Return what a run left in a folder.

    Raises:
        InputError: no run wrote the folder.
    """
    for place in (path / RECORD, part_of(path / RECORD)):
        try:
            record = json.loads(place.read_bytes())
            if record["program"] == "motionstereo":
                return RunFolder(path, record, complete="counts" in record)
        except (OSError, ValueError, LookupError, TypeError, RecursionError):
            continue
    raise InputError(f"{path} has no {RECORD} of a run: give the folder that run wrote (its --out)")


def numbers(texts: Iterable[str]) -> NDArray[np.float64]:
    """Return the numbers of a column; empty = NaN.

    Raises:
        ValueError: a cell is no number.
    """
    return np.array([float(text) if text else np.nan for text in texts])


def _steering(path: Path, rows: list[dict[str, str]]) -> Steering:
    try:
        return Steering(
            frames=np.array([int(row["frame"]) for row in rows]),
            time_s=numbers(row["time_s"] for row in rows),
            status=tuple(row["status"] for row in rows),
            series={name: numbers(row[name] for row in rows) for name in SERIES},
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"the steering table in {path} is damaged: {error}") from error
