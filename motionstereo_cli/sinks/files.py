"""Writing so that nothing incomplete ever bears a final name."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
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
