"""Results of a run, complete or not, read from its folder."""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.atomic import part_of
from motionstereo_cli.files.reading import MAX_RESULT_BYTES, read_bytes, real
from motionstereo_cli.sinks.outputs import OUTPUTS, RECORD
from motionstereo_cli.sinks.read_back import read_record, read_table
from motionstereo_cli.sinks.records import RunRecord
from motionstereo_cli.sinks.sink import DEFAULT_TIME_BASE, EPOCH_S

if TYPE_CHECKING:
    from numpy.typing import NDArray

#: Columns of the steering table that the page shows over time.
SERIES = ("steer", "steer_rad", "depth_m", "nearest_m", "charged", "matched")

#: Time from frame to frame in the videos where the source has no time, in s.
FRAME_S = float(DEFAULT_TIME_BASE)

#: Pixel formats of H.264 that browsers play.
_PLAYED = ("yuv420p", "yuvj420p")

Rows = Collection[dict[str, str]]


@dataclass(frozen=True, slots=True)
class SteeringTable:
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

    @property
    def timed(self) -> bool:
        """Whether the source has times."""
        return not np.isnan(self.time_s).any()

    @property
    def places(self) -> NDArray[np.float64]:
        """The x of each frame in the plots and videos in s: its time, if the source has times.

        Times since an epoch count from :attr:`begin_s`, as those of the videos do.
        """
        if not self.timed:
            return np.asarray(self.frames * FRAME_S, np.float64)
        return self.time_s - (self.begin_s or 0.0)

    @property
    def begin_s(self) -> float | None:
        """The first of times since an epoch, in s; None where times are no such."""
        first = float(self.time_s[0])
        return first if self.timed and first > EPOCH_S else None

    @property
    def best(self) -> int:
        """The row of the frame in which most of the image was matched."""
        return int(np.nan_to_num(self.series["matched"]).argmax())


@dataclass(frozen=True, slots=True)
class Results:
    """Results of a run.

    Attributes:
        path: its folder.
        record: the content of ``run.json`` or, before the run is complete, its future content.
        complete: whether the run is complete.
        trusted: whether the record is that of a run of this process. Otherwise nothing outside the
            folder is opened, whatever the record names: the page may be passed on.
    """

    path: Path
    record: RunRecord
    complete: bool
    trusted: bool = False

    @property
    def within(self) -> Path:
        """A folder that every file lies in that may be opened."""
        return Path(real(self.path).anchor) if self.trusted else self.path

    def has(self, output: str) -> bool:
        """Return whether the run was asked for an output."""
        return output in (self.record.outputs or ())

    @property
    def height(self) -> int | None:
        """Height of the images in px: below them a video may have a strip. None if unknown."""
        if self.record.camera:
            return self.record.camera.height
        given, inputs = self.record.values("input_settings"), self.record.inputs or {}
        source = inputs.get("right") or inputs.get("left")
        whole = not given.get("crop") and given.get("scale", 1.0) == 1.0
        return source.height or None if source and whole else None

    @property
    def reference(self) -> str:
        """The camera whose view the outputs show, ``right`` or ``left``."""
        return str(self.record.values("settings").get("reference", "right"))

    def video(self, output: str) -> Path:
        """Return the path of an output's video, None if it is missing."""
        return self.path / OUTPUTS[output].path

    def view(self) -> tuple[Path | None, bool]:
        """Return a video of the reference view, and whether browsers play it.

        That is the run's own video or, if it shows the same, the recording.
        """
        if self.has("view-video"):
            return self.video("view-video"), True
        given = self.record.values("input_settings")
        said = (self.record.inputs or {}).get(self.reference)
        whole = not given.get("crop") and given.get("scale", 1.0) == 1.0
        if said is None or said.kind != "video" or said.rotation_deg or not whole:
            return None, False
        path = Path(said.path)
        known = said.codec == "h264" and said.pixel_format in _PLAYED
        return path, known and path.suffix.lower() in (".mp4", ".m4v", ".mov")

    def steering(self) -> SteeringTable | None:
        """Return the steering table, None where there is none or it is empty.

        Raises:
            InputError: it cannot be read, or is not a steering table.
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
        return read_table(path, part=part).rows.values() if os.path.lexists(path) else None

    def _lines(self, output: str) -> Rows | None:
        path = self._file(output)
        if not os.path.lexists(path):
            return None
        try:
            content = read_bytes(path, "the table", MAX_RESULT_BYTES, within=self.path)
            lines = content.decode().split("\n")[:-1]
            rows = [json.loads(line) for line in lines]
            return [{k: "" if v is None else str(v) for k, v in row.items()} for row in rows]
        except (OSError, ValueError, AttributeError, RecursionError) as error:
            raise InputError(f"cannot read the table {path}: {error}") from error

    def _file(self, output: str) -> Path:
        """Return an output's file or, if it is not complete, its partial file."""
        path = self.path / OUTPUTS[output].path
        return path if os.path.lexists(path) else part_of(path)


def read_results(path: Path) -> Results:
    """Return the results of a run.

    Raises:
        InputError: the folder is not the output of a run.
    """
    for place in (path / RECORD, part_of(path / RECORD)):
        if os.path.lexists(place):
            record = read_record(place)
            if record.program == "motionstereo":
                return Results(path, record, complete=bool(record.counts))
    raise InputError(f"{path} has no {RECORD} of a run: give the output folder of run (its --out)")


def numbers(texts: Iterable[str]) -> NDArray[np.float64]:
    """Return the numbers of a column; empty = NaN.

    Raises:
        ValueError: a cell is not a number.
    """
    return np.array([float(text) if text else np.nan for text in texts])


def _steering(path: Path, rows: Rows) -> SteeringTable:
    cells: dict[str, list[str]] = {name: [] for name in ("frame", "time_s", "status", *SERIES)}
    try:
        for row in rows:  # each is made when it is asked for
            for name, column in cells.items():
                column.append(row[name])
        return SteeringTable(
            frames=np.array([int(text) for text in cells["frame"]]),
            time_s=numbers(cells["time_s"]),
            status=tuple(cells["status"]),
            series={name: numbers(cells[name]) for name in SERIES},
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"the steering table in {path} is damaged: {error}") from error
