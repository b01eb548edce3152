"""The steering table."""

from __future__ import annotations

import contextlib
import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from motionstereo_cli.sinks.files import part_of, reported
from motionstereo_cli.types import FrameResult

if TYPE_CHECKING:
    from motionstereo_cli.sinks import Stream

HEADER = "frame,pts,time_s,status,steer,steer_rad,depth_m,nearest_m,charged,matched"


def steering_cells(result: FrameResult) -> dict[str, str]:
    """Return one row of the table as text, by column.

    time_s has 6 decimals (microseconds), depth_m and nearest_m have 3 (mm), all other real
    numbers 4. An empty cell is unknown. No cell can need quotes.
    """
    frame, steering = result.frame, result.steering
    cells = (
        str(frame.index),
        str(frame.pts),
        _cell(frame.time_s, 6),
        steering.status,
        _cell(steering.steer, 4),
        _cell(steering.steer_rad, 4),
        _cell(steering.depth_m, 3),
        _cell(steering.nearest_m, 3),
        _cell(result.charged, 4),
        _cell(result.matched, 4),
    )
    return dict(zip(HEADER.split(","), cells, strict=True))


def _json_line(cells: dict[str, str]) -> str:
    """Return a row as a JSON object, its numbers as they stand in the CSV; null = unknown."""
    values = {name: cell or "null" for name, cell in cells.items()}
    values["status"] = f'"{values["status"]}"'
    return "{" + ", ".join(f'"{name}": {value}' for name, value in values.items()) + "}"


class SteeringStream:
    """The steering table on a binary stream, such as standard output.

    Each row is passed on at once, for a reader that steers by it.

    Args:
        stream: where to write; it stays open.
        name: what messages call it.
        table_format: ``csv`` (RFC 4180, but for LF) or ``jsonl`` (JSON lines).

    Raises:
        OutputError: the stream cannot be written.
        BrokenPipeError: whoever read the stream has gone.
    """

    def __init__(self, stream: BinaryIO, name: Path | str, table_format: str = "csv") -> None:
        self._stream = stream
        self._name = name
        self._as_json = table_format == "jsonl"
        if not self._as_json:
            self._write_line(HEADER)

    def write(self, result: FrameResult) -> None:
        """Append the row of a frame."""
        cells = steering_cells(result)
        self._write_line(_json_line(cells) if self._as_json else ",".join(cells.values()))

    def close(self) -> None:
        """Do nothing: every row has been passed on, and the stream is another's."""

    def abandon(self, *, keep: bool) -> None:
        """Do nothing: what has been passed on cannot be taken back."""

    def _write_line(self, line: str) -> None:
        with reported(self._name):
            self._stream.write(line.encode("ascii") + b"\n")
            self._stream.flush()


class SteeringFile(SteeringStream):
    """The steering table as a file that bears its name only when it is complete.

    Args:
        path: final name.
        table_format: see :class:`SteeringStream`.

    Raises:
        OutputError: the file cannot be written.
    """

    def __init__(self, path: Path, table_format: str = "csv") -> None:
        self._path = path
        with reported(path):
            self._file = part_of(path).open("wb")
        super().__init__(self._file, path, table_format)

    def close(self) -> None:
        """Complete the table and give it its name."""
        with reported(self._path):
            self._file.close()
            os.replace(part_of(self._path), self._path)

    def abandon(self, *, keep: bool) -> None:
        """Leave the table under its ``.part`` name or, without ``keep``, remove it."""
        with contextlib.suppress(OSError):  # a row that could not be written is tried again
            self._file.close()
        if not keep:
            part_of(self._path).unlink(missing_ok=True)


def steering_file(path: Path, _: Stream) -> SteeringFile:
    """Return a sink for the steering table, its format told by the name's suffix."""
    return SteeringFile(path, path.suffix.removeprefix("."))


def _cell(value: float | None, decimals: int) -> str:
    if value is None or not math.isfinite(value):
        return ""
    return f"{value:z.{decimals}f}"  # z: no -0.0000
