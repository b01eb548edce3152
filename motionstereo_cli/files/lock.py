"""A lock on a folder: one process at a time writes to it."""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Iterator
from pathlib import Path

from motionstereo_cli.errors import BusyError
from motionstereo_cli.files.atomic import reported

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

#: The file that is locked where folders cannot be.
LOCK = "run.lock"


@contextlib.contextmanager
def locked(folder: Path, *, shared: bool = False) -> Iterator[None]:
    """Create a folder, and keep other processes out of it until the block ends.

    With ``shared``, only those are kept out that do not share.

    The lock ends with its process, even if that is killed. Disks without locks get none.

    Raises:
        BusyError: another process is writing there.
        OutputError: the folder cannot be made.
    """
    with reported(folder):
        folder.mkdir(parents=True, exist_ok=True)
    if fcntl:
        with _folder_lock(folder, shared=shared):
            yield
    elif shared:
        yield
    else:
        with _file_lock(folder):
            yield


def _busy(folder: Path) -> BusyError:
    return BusyError(
        f"{folder} is being written by another run: wait for it, or give another folder"
    )


@contextlib.contextmanager
def _folder_lock(folder: Path, *, shared: bool) -> Iterator[None]:
    with reported(folder):
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(handle, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        except BlockingIOError:
            raise _busy(folder) from None
        except OSError:
            pass  # a network disk without locks
        yield
    finally:
        os.close(handle)


@contextlib.contextmanager
def _file_lock(folder: Path) -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns that fcntl is missing
        import filelock  # here, because importing takes a tenth of a second

    lock = filelock.FileLock(folder / LOCK)
    with reported(folder):
        try:
            lock.acquire(blocking=False)
        except filelock.Timeout:
            raise _busy(folder) from None
    try:
        yield
    finally:
        lock.release()  # which removes its file
