"""Where a command may write: one rule for all commands.

Never to an input, to a file whose ``.part`` name is an input, or into a folder that is an input.
Devices and FIFOs are written to; they are not replaced by a file.
"""

from __future__ import annotations

import errno
import os
import shutil
import stat
import time
from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO, NamedTuple

from motionstereo_cli.errors import OutputError
from motionstereo_cli.files.atomic import (
    Temporary,
    make_new,
    open_again,
    part_of,
    reported,
    write_whole,
)
from motionstereo_cli.files.reading import open_regular, sha256_of

#: How long to wait for a reader of a FIFO, in s, and how often to look.
_PATIENCE_S = 10.0
_GLANCE_S = 0.05


class _Place(NamedTuple):
    """Where a path leads.

    Attributes:
        name: absolute, with links resolved.
        file: device and number of what is there; None if nothing is.
        is_folder: whether that is a folder.
    """

    name: str
    file: tuple[int, int] | None
    is_folder: bool


def _place_of(path: Path) -> _Place:
    name = os.path.realpath(path)
    try:
        status = os.stat(name)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise
        return _Place(name, None, is_folder=False)
    return _Place(name, (status.st_dev, status.st_ino), stat.S_ISDIR(status.st_mode))


def check_target(path: Path, inputs: Iterable[Path]) -> None:
    """Check that writing to a file or folder does not touch an input.

    Args:
        path: what is to be written.
        inputs: files and folders that are read.

    Raises:
        OutputError: it is one of them, under any name, or inside one, or a circle of links.
    """
    check_targets((path,), inputs)


def check_targets(paths: Iterable[Path | None], inputs: Iterable[Path]) -> None:
    """Check several files as :func:`check_target` does; None is skipped."""
    targets = []
    for path in paths:
        if path is not None:
            with reported(path):
                targets.append((path, _place_of(path), _place_of(part_of(path))))
    for taken in dict.fromkeys(inputs):  # there may be thousands: each is looked at once
        with reported(taken):
            found = _place_of(taken)
        inside = os.path.join(found.name, "")
        for path, place, part in targets:
            if found.name in (place.name, part.name) or (
                found.file is not None and found.file in (place.file, part.file)
            ):
                raise OutputError(f"{path} is an input of this run: give another name")
            if found.is_folder and place.name.startswith(inside):
                raise OutputError(
                    f"{path} lies in {taken}, an input of this run: give another place"
                )


def write_output(path: Path, content: bytes, inputs: Iterable[Path] = ()) -> None:
    """Write a file that the user named, replacing an existing one.

    Args:
        path: the file; a device or FIFO is written into.
        content: all of it.
        inputs: files and folders that are read.

    Raises:
        OutputError: it is an input, or cannot be written.
    """
    check_target(path, inputs)
    if not is_stream(path):
        write_whole(path, content)
        return
    try:
        with reported(path), open_stream(path) as stream:
            stream.write(content)
    except BrokenPipeError:
        raise OutputError(f"cannot write {path}: its reader has gone") from None


def is_stream(path: Path) -> bool:
    """Return whether a name is a device, a FIFO, or standard output rather than a file."""
    try:
        status = path.stat()
    except OSError:
        return False
    return not (stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)) or (
        path.is_symlink() and _is_stdout(status)
    )


def open_replacing(path: Path, beginning: bytes) -> BinaryIO | None:
    """Open a file for writing: a new one, or an older one of this program, which is truncated.

    Args:
        path: the file.
        beginning: first bytes of this program's files; an empty file counts as one.

    Returns:
        the file; None if the name belongs to another file or a link.

    Raises:
        OSError: it cannot be opened.
    """
    try:
        return os.fdopen(make_new(path), "wb")
    except FileExistsError:
        pass
    if path.is_symlink():
        return None
    file = os.fdopen(open_again(path), "r+b")
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode) or file.read(len(beginning)) not in (
        b"",
        beginning,
    ):
        file.close()
        return None
    file.seek(0)
    file.truncate()
    return file


def open_stream(path: Path) -> BinaryIO:
    """Open a device or FIFO for writing.

    Raises:
        OSError: it cannot be opened, or no program reads the FIFO within 10 s.
    """
    if path.is_symlink() and _is_stdout(path.stat()):
        return os.fdopen(os.dup(1), "wb")
    latest_s = time.monotonic() + _PATIENCE_S
    while True:
        try:
            # Without waiting: a FIFO without a reader would block for ever.
            descriptor = os.open(path, os.O_WRONLY | getattr(os, "O_NONBLOCK", 0))
            break
        except OSError as error:
            if error.errno != errno.ENXIO or not path.is_fifo():
                raise
            if time.monotonic() > latest_s:
                raise OSError(errno.ENXIO, "no program reads this FIFO") from None
            time.sleep(_GLANCE_S)
    os.set_blocking(descriptor, True)
    return os.fdopen(descriptor, "wb")


def _is_stdout(status: os.stat_result) -> bool:
    try:
        return os.path.samestat(status, os.fstat(1))
    except OSError:
        return False


def check_place(path: Path) -> None:
    """Check that a file can be created in its folder.

    Raises:
        OutputError: the folder does not exist, or is not writable.
    """
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise OutputError(f"cannot write {path}: {path.parent} is no folder to write to")


def copy_new(source: Path, target: Path) -> None:
    """Copy a file to a free name; a file with the same content there is kept.

    Raises:
        OutputError: something else has the name, or it cannot be written.
    """
    with reported(target), open_regular(source) as content, Temporary(target) as copy:
        shutil.copyfileobj(content, copy.content)
        try:
            copy.place_new()
        except FileExistsError:
            if sum_of(target) != sum_of(source):
                raise OutputError(
                    f"{target} is not from an earlier run: move it, or give another name"
                ) from None


def link_new(source: Path, target: Path) -> None:
    """Hard-link a file to a free name, or copy it where there are no hard links.

    Raises:
        OutputError: something else has the name, or it cannot be written.
    """
    try:
        os.link(source, target)
    except OSError:
        copy_new(source, target)


def sum_of(path: Path) -> str | None:
    """Return the SHA-256 of a file; None if it does not exist or is behind a link."""
    try:
        return None if path.is_symlink() else sha256_of(path)
    except OSError:
        return None
