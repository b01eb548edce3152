"""Writing so that nothing incomplete ever has a final name, and no link is followed.

What is written first bears a name that ends in ``.part``. Whatever bears that name before, such
as a link that leads elsewhere, is removed and not written through.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterable, Iterator
from itertools import groupby
from pathlib import Path

from motionstereo_cli.errors import OutputError

#: Flags that some systems do not have.
_NO_LINK = getattr(os, "O_NOFOLLOW", 0)
_BINARY = getattr(os, "O_BINARY", 0)
_FOLDER = getattr(os, "O_DIRECTORY", 0)


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
        BrokenPipeError: as it stands, because a reader that has gone is no failure.
    """
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror or error}") from error


def open_new(path: Path) -> int:
    """Return the descriptor of a new, empty file; what bore its name is removed, a link as such.

    Raises:
        OSError: the file cannot be made.
    """
    path.unlink(missing_ok=True)
    return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | _NO_LINK | _BINARY, 0o666)


def open_again(path: Path) -> int:
    """Return the descriptor of an existing file, for reading and writing; a link is refused.

    Raises:
        OSError: there is no such file, or it cannot be opened.
    """
    return os.open(path, os.O_RDWR | _NO_LINK | _BINARY)


def write_whole(path: Path, content: bytes, *, durable: bool = False, writer: str = "") -> None:
    """Write a small file at once: beside its final name, then renamed.

    With ``durable``, the disk holds it before it gets its name. Where several processes may write
    it at the same time, each gives a ``writer`` of its own, and the last one wins.

    Raises:
        OutputError: the file cannot be written.
    """
    part = part_of(path.with_name(f"{path.name}.{writer}") if writer else path)
    with reported(path):
        try:
            with os.fdopen(open_new(part), "wb") as file:
                file.write(content)
                if durable:
                    file.flush()
                    os.fsync(file.fileno())
            os.replace(part, path)
        except BaseException:
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)
            raise


def sync(path: Path) -> None:
    """Make sure that a file is on the disk, even if the machine goes down.

    Raises:
        OutputError: it cannot.
    """
    with reported(path):
        file = open_again(path)  # for writing: Windows syncs nothing else
        try:
            os.fsync(file)
        finally:
            os.close(file)


def make_folder(path: Path) -> None:
    """Make a folder for results where it is missing.

    Raises:
        OutputError: it cannot be made, or a link stands in its place.
    """
    with reported(path):
        if path.is_symlink():
            raise OutputError(f"{path} is a link to elsewhere: remove it, or give another folder")
        path.mkdir(exist_ok=True)


def remove(root: Path, paths: Iterable[Path]) -> None:
    """Remove files in a folder or one level below, in order; those that are gone are passed over.

    No link is followed but ``root`` itself: where one takes the place of a folder below, what it
    leads to stays.

    Args:
        root: the folder.
        paths: files in it.

    Raises:
        OSError: one cannot be removed, or lies behind a link.
    """
    if os.unlink not in os.supports_dir_fd:
        for path in paths:
            if path.parent != root and path.parent.is_symlink():
                raise OSError(f"{path.parent} is a link")
            path.unlink(missing_ok=True)
        return
    top = os.open(root, os.O_RDONLY | _FOLDER)
    try:
        for folder, files in groupby(paths, key=lambda path: path.parent):
            if folder == root:
                _remove_in(top, files)
                continue
            with contextlib.suppress(FileNotFoundError):
                below = os.open(folder.name, os.O_RDONLY | _FOLDER | _NO_LINK, dir_fd=top)
                try:
                    _remove_in(below, files)
                finally:
                    os.close(below)
    finally:
        os.close(top)


def _remove_in(folder: int, files: Iterable[Path]) -> None:
    for path in files:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(path.name, dir_fd=folder)
