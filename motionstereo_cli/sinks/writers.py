"""Writing so that nothing incomplete ever has a final name."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterable
from io import BufferedRandom, BufferedWriter
from pathlib import Path

from motionstereo_cli.errors import OutputError
from motionstereo_cli.files.atomic import part_of, reported, sync, write_whole


def cell(value: float | None, decimals: int) -> str:
    """Return a number as a cell of a table, empty = unknown; it never needs quotes."""
    if value is None or not math.isfinite(value):
        return ""
    return f"{value:z.{decimals}f}"  # z: no -0.0000


class TableFile:
    """A table as a file that has its name only when it is complete: RFC 4180, but for LF.

    Args:
        path: final name.
        header: names of the columns; none if empty.
        since: go on from this checkpoint of an earlier table: its size in bytes.

    Raises:
        OutputError: the file cannot be written, or is not what the checkpoint says.
    """

    def __init__(self, path: Path, header: str, since: int | None = None) -> None:
        self._path = path
        self._file: BufferedWriter | BufferedRandom
        with reported(path):
            self._file = part_of(path).open("wb") if since is None else _reopened(path, since)
        if header and since is None:
            self.add([header])

    def add(self, lines: Iterable[str]) -> None:
        """Append lines, without their ends, and pass them on at once."""
        with reported(self._path):
            self._file.writelines(line.encode("ascii") + b"\n" for line in lines)
            self._file.flush()

    def checkpoint(self) -> int:
        """Have the disk hold what was written so far, and return its size in bytes."""
        with reported(self._path):
            os.fsync(self._file.fileno())
            return self._file.tell()

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


def _reopened(path: Path, size: int) -> BufferedRandom:
    if path.exists():  # completed, but not all that belongs to it
        os.replace(path, part_of(path))
    file = part_of(path).open("r+b")
    if file.seek(0, os.SEEK_END) < size:
        file.close()
        raise OutputError(f"{part_of(path)} was cut: --resume cannot go on, give --overwrite")
    file.truncate(size)
    file.seek(size)
    return file


class NumberedFiles:
    """Files of one kind, one a frame, each written whole.

    Args:
        path: where they go; ``{:06d}`` in its name is the number of the frame.

    Raises:
        OutputError: the folder cannot be made or a file not written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._unsynced: list[Path] = []
        with reported(path.parent):
            path.parent.mkdir(exist_ok=True)

    def add(self, number: int, content: bytes) -> None:
        """Write the file of a frame."""
        path = self._path.with_name(self._path.name.format(number))
        write_whole(path, content)
        self._unsynced.append(path)

    def checkpoint(self) -> None:
        """Have the disk hold what was written so far."""
        for path in self._unsynced:
            sync(path)
        self._unsynced.clear()

    def close(self) -> None:
        """Do nothing: every file is complete."""

    def abandon(self, *, keep: bool) -> None:
        """Do nothing: every file is complete."""
