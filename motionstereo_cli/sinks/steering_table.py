"""The steering table."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from motionstereo_cli.files.atomic import part_of, reported
from motionstereo_cli.files.targets import check_place, copy_new
from motionstereo_cli.sinks.writers import TableFile, TableMark, cell
from motionstereo_cli.types import Step

if TYPE_CHECKING:
    from motionstereo_cli.sinks.sink import RunContext

HEADER = "frame,pts,time_s,status,steer,steer_rad,depth_m,nearest_m,charged,matched,risk_s"


def steering_line(step: Step, table_format: str) -> str:
    """Return one row of the table, without its line end.

    time_s has 6 decimals (microseconds), depth_m, nearest_m (mm) and risk_s (ms) have 3, all other
    real numbers 4. An empty cell, or null, is unknown. No cell can need quotes.

    Args:
        step: that of the frame.
        table_format: ``csv``, or ``jsonl`` for a JSON object with the numbers as CSV has them.
    """
    time, steering = step.time, step.steering
    cells = (
        str(time.index),
        str(time.pts),
        cell(time.time_s, 6),
        steering.status,
        cell(steering.steer, 4),
        cell(steering.steer_rad, 4),
        cell(steering.depth_m, 3),
        cell(steering.nearest_m, 3),
        cell(step.charged, 4),
        cell(step.matched, 4),
        cell(steering.risk_s, 3),
    )
    if table_format == "csv":
        return ",".join(cells)
    values = {name: each or "null" for name, each in zip(HEADER.split(","), cells, strict=True)}
    values["status"] = f'"{values["status"]}"'
    return "{" + ", ".join(f'"{name}": {value}' for name, value in values.items()) + "}"


def _header(table_format: str) -> str:
    return HEADER if table_format == "csv" else ""


class SteeringStream:
    """The steering table on a binary stream, such as standard output.

    Each row is flushed at once, for readers that steer by it.

    Args:
        stream: where to write; it stays open.
        name: its name in messages.
        table_format: ``csv`` (RFC 4180, except that lines end in LF) or ``jsonl`` (JSON lines).

    Raises:
        OutputError: the stream cannot be written.
        BrokenPipeError: the reader of the stream closed it.
    """

    def __init__(self, stream: BinaryIO, name: Path | str, table_format: str = "csv") -> None:
        self._stream = stream
        self._name = name
        self._format = table_format
        if header := _header(table_format):
            self._write_line(header)

    def write(self, step: Step) -> None:
        """Append the row of a frame."""
        self._write_line(steering_line(step, self._format))

    def checkpoint(self) -> None:
        """Do nothing: what has been passed on cannot be taken back."""

    def close(self) -> None:
        """Do nothing: every row has been written, and the caller owns the stream."""

    def abandon(self, *, keep: bool) -> None:
        """Do nothing: what has been passed on cannot be taken back."""

    def _write_line(self, line: str) -> None:
        with reported(self._name):
            self._stream.write(line.encode("ascii") + b"\n")
            self._stream.flush()


class SteeringFile(TableFile):
    """The steering table as a file: a row for each frame.

    Args:
        path: final name; its suffix is the format, see :class:`SteeringStream`.
        since: continue from this checkpoint.
        table_format: the format, where the name has no suffix.

    Raises:
        OutputError: the file cannot be written, or is not what the checkpoint says.
    """

    def __init__(
        self,
        path: Path,
        _: RunContext | None = None,
        since: TableMark | None = None,
        table_format: str = "",
    ) -> None:
        self._format = table_format or path.suffix.removeprefix(".")
        super().__init__(path, _header(self._format), since)

    def write(self, step: Step) -> None:
        """Append the row of a frame."""
        self.add([steering_line(step, self._format)])


class SteeringCopy(SteeringFile):
    """The steering table for a place outside the output folder, copied there when it is complete.

    Until then the table is in the output folder, where a resumed run continues it.

    Args:
        path: its name in the folder of the run, without ``.part``.
        target: its final place.
        table_format, since: see :class:`SteeringFile`.

    Raises:
        OutputError: the file cannot be written, or is not what the checkpoint says.
    """

    def __init__(
        self, path: Path, target: Path, table_format: str, since: TableMark | None = None
    ) -> None:
        check_place(target)
        super().__init__(path, None, since, table_format)
        self._target = target

    def close(self) -> None:
        """Copy the table to its place."""
        self.end()
        copy_new(part_of(self._path), self._target)
