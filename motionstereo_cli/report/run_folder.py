"""Results of a run, complete or not, read from its folder."""

from __future__ import annotations

import json
import os
from array import array
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.atomic import part_of
from motionstereo_cli.files.reading import real
from motionstereo_cli.files.stills import DamagedImageError, grey_of, read_still
from motionstereo_cli.sinks.outputs import OUTPUTS, RECORD
from motionstereo_cli.sinks.read_back import Table, lines_of_table, read_record
from motionstereo_cli.sinks.records import RunRecord
from motionstereo_cli.sinks.sink import DEFAULT_TIME_BASE, EPOCH_S

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.types import Grey

#: Columns of the steering table that the page shows over time.
SERIES = ("steer", "steer_rad", "depth_m", "nearest_m", "charged", "matched")

#: Time from frame to frame in the videos where the source has no time, in s.
FRAME_S = float(DEFAULT_TIME_BASE)

#: Pixel formats of H.264 that browsers play.
_PLAYED = ("yuv420p", "yuvj420p")

#: Rows of a steering table that a page has at most: 28 hours at 30 images per second.
MAX_FRAMES = 3_000_000

#: Statuses that a table has at most, of three that there are.
_MAX_STATUSES = 16


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
    def reference(self) -> str:
        """The camera whose view the outputs show, ``right`` or ``left``."""
        return str(self.record.values("settings").get("reference", "right"))

    def video(self, output: str) -> Path:
        """Return the path of an output's video, which may be missing."""
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
        for output, rows_of in (("steering", _rows), ("steering-jsonl", _objects_of_lines)):
            path = self._file(output)
            if os.path.lexists(path) and (found := _steering(path, rows_of(path))):
                return found
        return None

    def objects(self) -> Iterator[dict[str, str]] | None:
        """Return the rows of the table of moving objects, None where there is none.

        Raises:
            InputError: it cannot be read.
        """
        path = self._file("objects")
        return _rows(path) if os.path.lexists(path) else None

    def map(self) -> Grey | None:
        """Return the map from above, (height, width) uint8; None without one that can be read."""
        path = (self.path / OUTPUTS["map"].path).with_suffix(".png")
        if not (self.has("map") and path.is_file()):
            return None
        try:
            return grey_of(read_still(path, within=self.path).pixels, path)
        except (DamagedImageError, InputError):
            return None

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


def _rows(path: Path) -> Iterator[dict[str, str]]:
    for _, rows in Table(path, part=path.suffix == ".part").by_frame():
        yield from rows.values()


def _objects_of_lines(path: Path) -> Iterator[dict[str, str]]:
    """Yield the rows of a table of JSON lines; an incomplete last line is dropped."""
    for number, line in enumerate(lines_of_table(path, part=True), 1):
        try:
            row = json.loads(line)
            yield {name: "" if value is None else str(value) for name, value in row.items()}
        except (ValueError, AttributeError, RecursionError) as error:
            raise InputError(f"cannot read the table {path}: line {number}: {error}") from error


def _steering(path: Path, rows: Iterable[Mapping[str, str]]) -> SteeringTable | None:
    """Return a steering table, None if it has no rows; it takes 72 bytes a row."""
    frames, status, statuses = array("q"), list[str](), dict[str, str]()
    numbers = {name: array("d") for name in ("time_s", *SERIES)}
    try:
        for row in rows:
            if len(status) == MAX_FRAMES:
                raise InputError(
                    f"{path} has more than {MAX_FRAMES} frames, the limit of a page: make pages of "
                    "parts of the recording, run with --start and --end"
                )
            frames.append(int(row["frame"]))
            status.append(statuses.setdefault(row["status"], row["status"]))
            if len(statuses) > _MAX_STATUSES:
                raise ValueError(f"it has more than {_MAX_STATUSES} statuses")
            for name, column in numbers.items():
                column.append(float(row[name] or "nan"))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"the steering table {path} is damaged: {error}") from error
    if not status:
        return None
    return SteeringTable(
        frames=np.array(frames),
        time_s=np.array(numbers.pop("time_s")),
        status=tuple(status),
        series={name: np.array(column) for name, column in numbers.items()},
    )
