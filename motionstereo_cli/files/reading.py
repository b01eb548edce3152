"""Reading input files."""

from __future__ import annotations

import errno
import hashlib
import os
import stat
from collections.abc import Iterable, Iterator
from io import BufferedReader
from pathlib import Path

from motionstereo_cli.errors import InputError

#: Larger images, in px, come from damaged or hostile files unless the user says
#: otherwise. Beyond the second number Pillow reads none.
MAX_PIXELS = 64_000_000
PILLOW_MAX_PIXELS = 178_000_000

#: Larger than any calibration.
MAX_CALIBRATION_BYTES = 16_000_000

#: The longest line of a table that is read line by line.
MAX_LINE_BYTES = 65_536

#: Tables of objects and of poses that are kept whole; those of runs are read row by row. Records
#: are far smaller.
MAX_RESULT_BYTES, MAX_RECORD_BYTES = 48_000_000, 16_000_000


def real(path: str | Path) -> Path:
    """Return a path, absolute and with links resolved; a circle of links is left as it is."""
    return Path(os.path.realpath(path))


def open_regular(path: str | Path, within: Path | None = None) -> BufferedReader:
    """Open a regular file for reading bytes; links are followed.

    A FIFO, a socket or a device would make the program wait, or do something when it is opened.

    Args:
        path: the file.
        within: a folder that no link may lead out of; None: links may lead anywhere.

    Raises:
        OSError: it cannot be opened, is no regular file, or lies elsewhere.
    """
    try:
        if within is not None and not real(path).is_relative_to(real(within)):
            raise OSError(errno.EPERM, f"it is a link that leads out of {within}", str(path))
        _check_regular(os.stat(path), path)
    except (ValueError, RuntimeError) as error:  # a NUL; a circle of links
        raise OSError(errno.EINVAL, str(error), str(path)) from None
    # Without waiting: it may have been exchanged for a FIFO since.
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    file = os.fdopen(os.open(path, flags), "rb")
    try:
        _check_regular(os.fstat(file.fileno()), path)
    except OSError:
        file.close()
        raise
    return file


def _check_regular(status: os.stat_result, path: str | Path) -> None:
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "it is a FIFO, a socket or a device, not a file", str(path))


def read_bytes(path: str | Path, what: str, max_bytes: int, within: Path | None = None) -> bytes:
    """Return the content of a file.

    Args:
        path: the file.
        what: its name in messages.
        max_bytes: the maximum size.
        within: see :func:`open_regular`.

    Raises:
        InputError: the file cannot be read or is larger.
    """
    try:
        with open_regular(path, within) as file:
            content = content_up_to(file, max_bytes)
    except OSError as error:
        raise InputError(f"cannot read {what} {path}: {error.strerror}") from error
    if content is None:
        raise InputError(f"{path} is larger than {max_bytes} bytes: check that it is {what}")
    return content


def content_up_to(file: BufferedReader, max_bytes: int) -> bytes | None:
    """Return the content of an open file, None where it is larger; that is seen before reading.

    Raises:
        OSError: it cannot be read.
    """
    if os.fstat(file.fileno()).st_size > max_bytes:
        return None
    content = file.read(max_bytes + 1)  # the size of files in /proc is 0
    return content if len(content) <= max_bytes else None


def read_head(path: str | Path, size: int) -> bytes:
    """Return the first bytes of a file, none where it cannot be read."""
    try:
        with open_regular(path) as file:
            return file.read(size)
    except OSError:
        return b""


def read_text(path: str | Path, what: str, max_bytes: int, within: Path | None = None) -> str:
    """Return the text of a file, as :func:`read_bytes` reads it."""
    return as_text(read_bytes(path, what, max_bytes, within))


def read_lines(
    path: str | Path, what: str, within: Path | None = None, *, part: bool = False
) -> Iterator[str]:
    """Yield the lines of a table, with their ends: the table may be larger than the memory.

    Args:
        path, what, within: as of :func:`read_bytes`.
        part: an incomplete last line is dropped.

    Raises:
        InputError: the file cannot be read, or has a line that is too long.
    """
    try:
        with open_regular(path, within) as file:
            while line := file.readline(MAX_LINE_BYTES + 1):
                if len(line) > MAX_LINE_BYTES:
                    raise InputError(
                        f"cannot read {what} {path}: it has a line of more than "
                        f"{MAX_LINE_BYTES} bytes: write it again"
                    )
                if not part or line.endswith(b"\n"):
                    yield line.decode("utf-8", errors="replace").removeprefix("\ufeff")
    except OSError as error:
        raise InputError(f"cannot read {what} {path}: {error.strerror}") from error


def open_fifo(path: Path) -> int:
    """Open a FIFO or device for reading without waiting for a writer, and return its descriptor.

    Raises:
        OSError: it cannot be opened.
    """
    return os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))


def check_regular(path: Path, within: Path) -> None:
    """Check that a path is a regular file or does not exist.

    Raises:
        InputError: it is something else, or a link that leads out of ``within``.
    """
    if os.path.lexists(path):
        try:
            open_regular(path, within).close()
        except OSError as error:
            raise InputError(f"cannot read {path}: {error.strerror}") from None


def as_text(content: bytes) -> str:
    """Decode UTF-8; invalid bytes become replacement characters."""
    text = content.decode("utf-8-sig", errors="replace")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file's content, in hexadecimal digits.

    Raises:
        OSError: it cannot be read.
    """
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sha256_of_all(sums: Iterable[tuple[str, str]]) -> str:
    """Return the SHA-256 of several files, that of the text which ``sha256sum`` prints of them.

    Args:
        sums: the SHA-256 of each, in hexadecimal digits, and its name without folders.
    """
    whole = hashlib.sha256()
    for digest, name in sums:
        whole.update(digest.encode() + b"  " + os.fsencode(name) + b"\n")
    return whole.hexdigest()


class HeldFile:
    """A file that stays open, so that its hash belongs to the content that was read.

    Another file may get its name meanwhile.

    Attributes:
        size_bytes: size when it was opened.
        head: the first bytes.

    Raises:
        OSError: it cannot be opened, or is no regular file.
    """

    def __init__(self, path: str | Path) -> None:
        self._file = open_regular(path)
        self._status = os.fstat(self._file.fileno())
        self.size_bytes = self._status.st_size
        self.head = self._file.read(256)

    @property
    def changed(self) -> bool:
        """Whether the file was written to since it was opened."""
        now = os.fstat(self._file.fileno())
        return (now.st_size, now.st_mtime_ns) != (self.size_bytes, self._status.st_mtime_ns)

    def check_same(self, file: BufferedReader) -> None:
        """Check that another open file is the same file.

        Raises:
            OSError: it is not.
        """
        if not os.path.samestat(self._status, os.fstat(file.fileno())):
            raise OSError(errno.EAGAIN, "it was replaced while it was opened")

    def sha256(self) -> str:
        """Return the SHA-256 of the content, in hexadecimal digits."""
        self._file.seek(0)
        return hashlib.file_digest(self._file, "sha256").hexdigest()

    def close(self) -> None:
        """Close it."""
        self._file.close()
