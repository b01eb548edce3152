"""Writing so that nothing incomplete ever bears a final name."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from motionstereo_cli.errors import OutputError


def part_of(path: Path) -> Path:
    """Return the name that ``path`` has while it is being written."""
    return path.with_name(path.name + ".part")


@contextlib.contextmanager
def reported(path: Path | str) -> Iterator[None]:
    """Turn the system's errors while writing ``path`` into one that names it.

    Raises:
        OutputError: the block raised an OSError (full disk, no permission, ...).
        BrokenPipeError: as it stands, for a reader that has gone is no failure.
    """
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror or error}") from error


def write_whole(path: Path, content: bytes) -> None:
    """Write a small file at once: beside its final name, then renamed.

    Raises:
        OutputError: the file cannot be written.
    """
    part = part_of(path)
    with reported(path):
        try:
            part.write_bytes(content)
            os.replace(part, path)
        except BaseException:
            part.unlink(missing_ok=True)
            raise


def cell(value: float | None, decimals: int) -> str:
    """Return a number as a cell of a table, empty = unknown; it never needs quotes."""
    if value is None or not math.isfinite(value):
        return ""
    return f"{value:z.{decimals}f}"  # z: no -0.0000


class TableFile:
    """A table as a file that bears its name only when it is complete: RFC 4180, but for LF.

    Args:
        path: final name.
        header: names of the columns.

    Raises:
        OutputError: the file cannot be written.
    """

    def __init__(self, path: Path, header: str) -> None:
        self._path = path
        with reported(path):
            self._file = part_of(path).open("wb")
        self.add([header])

    def add(self, lines: Iterable[str]) -> None:
        """Append lines, without their ends, and pass them on at once."""
        with reported(self._path):
            self._file.writelines(line.encode("ascii") + b"\n" for line in lines)
            self._file.flush()

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
