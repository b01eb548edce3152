"""Atomic writes: no incomplete file has its final name, and no foreign file is touched.

A file that is written at once has a random name until it is complete. The name is created
exclusively, so no existing file, link or folder can collide with it. A file that takes longer
(tables, segments of videos) has a name that ends in ``.part``, in a folder of results, where all
names are this program's.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Self

from motionstereo_cli.errors import OutputError, TakenError

#: Flags that not all systems have.
_NO_LINK = getattr(os, "O_NOFOLLOW", 0)
_BINARY = getattr(os, "O_BINARY", 0)
_NO_WAIT = getattr(os, "O_NONBLOCK", 0)

#: Prefix and suffix of random names; they identify files left over after a kill.
_MARK, _PART = ".motionstereo-", ".part"
_MARKED = re.compile(rf"{re.escape(_MARK)}[0-9a-f]{{16}}{re.escape(_PART)}")


def part_of(path: Path) -> Path:
    """Return the name of ``path`` while it is written, frame by frame."""
    return path.parent / (path.name + _PART)  # "." has no name


def segment_of(path: Path, number: int) -> Path:
    """Return the name of a segment, counted from 0, of the video ``path`` that is being written."""
    return part_of(path.with_name(f"{path.stem}.{number:04d}{path.suffix}"))


def is_segment(name: str, path: Path) -> bool:
    """Return whether a file's name is that of a segment of the video ``path``."""
    stem, suffix = re.escape(path.stem), re.escape(path.suffix)
    return re.fullmatch(rf"{stem}\.\d{{4,}}{suffix}\.part", name) is not None


def is_left_over(path: Path) -> bool:
    """Return whether a file was left over because this program was killed while writing it."""
    return _MARKED.fullmatch(path.name) is not None and path.is_file() and not path.is_symlink()


@contextlib.contextmanager
def reported(path: Path | str) -> Iterator[None]:
    """Turn the system's errors while writing ``path`` into one that names it.

    Raises:
        OutputError: the block raised an OSError (full disk, no permission, ...), or a ValueError
            because the name is empty or has a NUL.
        BrokenPipeError: unchanged, because a reader that closes its end is not a failure.
    """
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror or error}") from error
    except ValueError as error:
        if "empty name" in str(error):
            raise OutputError(f"cannot write {path}: that is no file; give it a name") from error
        if "null" not in str(error):
            raise
        raise OutputError(f"cannot write {path}: its name has a NUL") from error


class Temporary:
    """A new file in the folder of its final name, renamed when it is complete.

    As a context it is discarded at the end, unless it got its name.

    Args:
        final: that name.

    Attributes:
        path: its random name until then.
        content: the file, open for writing.

    Raises:
        OSError: it cannot be made.
    """

    def __init__(self, final: Path) -> None:
        self._final = final
        self.path = final.with_name(f"{_MARK}{os.urandom(8).hex()}{_PART}")
        self.content: BinaryIO = os.fdopen(make_new(self.path), "wb")
        self._status = os.fstat(self.content.fileno())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.discard()

    def place(self, *, durable: bool = False) -> None:
        """Give the file its final name, replacing a file or link that has it.

        With ``durable``, it is synced to disk before that.

        Raises:
            OSError: it cannot be written.
        """
        self._end(durable=durable)
        os.replace(self.path, self._final)

    def place_new(self) -> None:
        """Give the file its final name, which must be free; it is synced to disk first.

        Raises:
            FileExistsError: something has the name.
            OSError: it cannot be written.
        """
        self._end(durable=True)
        try:
            os.link(self.path, self._final)
        except FileExistsError:
            raise
        except OSError:  # a disk without hard links
            os.close(make_new(self._final))
            os.replace(self.path, self._final)

    def discard(self) -> None:
        """Remove the file if it did not get its final name; a file that took its place stays."""
        with contextlib.suppress(OSError):
            self.content.close()
        with contextlib.suppress(OSError):
            if os.path.samestat(os.lstat(self.path), self._status):
                self.path.unlink()

    def _end(self, *, durable: bool) -> None:
        self.content.flush()
        if durable:
            os.fsync(self.content.fileno())
        self.content.close()


def make_new(path: Path) -> int:
    """Return the descriptor of a new, empty file.

    Raises:
        FileExistsError: something has the name.
        OSError: the file cannot be made.
    """
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | _NO_LINK | _BINARY, 0o666)


def open_new(path: Path) -> int:
    """Return the descriptor of a new, empty file in a folder of results.

    An existing file or link of that name is removed first.

    Raises:
        OSError: the file cannot be made.
    """
    path.unlink(missing_ok=True)
    return make_new(path)


def open_log(path: Path) -> int:
    """Return the descriptor of a file to append to; it is created if missing.

    Raises:
        OSError: it cannot be opened, is no regular file, or has a further name elsewhere.
    """
    how = os.O_WRONLY | os.O_APPEND | os.O_CREAT | _NO_LINK | _NO_WAIT | _BINARY
    descriptor = os.open(path, how, 0o666)
    status = os.fstat(descriptor)
    if not stat.S_ISREG(status.st_mode) or status.st_nlink > 1:
        os.close(descriptor)
        raise OSError(errno.EINVAL, "it was not written by this program", str(path))
    return descriptor


def open_again(path: Path) -> int:
    """Open an existing file for reading and writing, and return its descriptor; a link is refused.

    Raises:
        OSError: there is no such file, or it cannot be opened.
    """
    return os.open(path, os.O_RDWR | _NO_LINK | _NO_WAIT | _BINARY)


def check_free(path: Path) -> None:
    """Make sure that nothing has a name that a run is about to give to a file of its own.

    Raises:
        TakenError: something has it.
    """
    if os.path.lexists(path):
        raise TakenError(path)


def name_part(path: Path) -> None:
    """Rename the ``.part`` file of ``path`` to ``path``.

    Raises:
        OSError: it cannot be renamed.
    """
    os.replace(part_of(path), path)


def unname(path: Path) -> None:
    """Rename a file back to its ``.part`` name.

    Raises:
        OSError: it cannot be renamed.
    """
    os.replace(path, part_of(path))


def remove_own(path: Path) -> None:
    """Remove a file from a folder of results, if it exists.

    Raises:
        OutputError: it cannot be removed.
    """
    with reported(path):
        path.unlink(missing_ok=True)


def write_whole(path: Path, content: bytes, *, durable: bool = False) -> None:
    """Write a small file atomically: under a random name, then renamed; the last writer wins.

    With ``durable``, it is synced to disk before that.

    Raises:
        OutputError: the file cannot be written.
    """
    with reported(path), Temporary(path) as file:
        file.content.write(content)
        file.place(durable=durable)


def sync(path: Path) -> None:
    """Sync a file to disk.

    Raises:
        OutputError: it cannot be synced.
    """
    with reported(path):
        file = open_again(path)  # opened for writing, because Windows syncs no other files
        try:
            os.fsync(file)
        finally:
            os.close(file)
