"""Writing so that nothing incomplete ever bears a final name."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator
from pathlib import Path

from motionstereo_cli.errors import OutputError


def part_of(path: Path) -> Path:
    """Return the name that ``path`` has while it is being written."""
    return path.with_name(path.name + ".part")


def segment_of(path: Path, number: int) -> Path:
    """Return the name of a segment, counted from 0, of the video ``path`` that is being written."""
    return part_of(path.with_name(f"{path.stem}.{number:04d}{path.suffix}"))


def is_segment(name: str, path: Path) -> bool:
    """Return whether a file's name is that of a segment of the video ``path``."""
    return re.fullmatch(rf"{path.stem}\.\d{{4,}}{path.suffix}\.part", name) is not None


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


def write_whole(path: Path, content: bytes, *, durable: bool = False) -> None:
    """Write a small file at once: beside its final name, then renamed.

    With ``durable``, the disk holds it before it gets its name.

    Raises:
        OutputError: the file cannot be written.
    """
    part = part_of(path)
    with reported(path):
        try:
            part.write_bytes(content)
            if durable:
                sync(part)
            os.replace(part, path)
        except BaseException:
            part.unlink(missing_ok=True)
            raise


def sync(path: Path) -> None:
    """Have the disk hold a file, should the machine go down.

    Raises:
        OutputError: it cannot.
    """
    with reported(path):
        file = os.open(path, os.O_RDONLY)
        try:
            os.fsync(file)
        finally:
            os.close(file)
