"""Errors with a known cause, under one root.

Each message is one line: what is wrong, where, and what to do. The command line prints it and
exits with ``exit_code``.
"""

from __future__ import annotations

import contextlib
import errno
import re
from collections.abc import Iterator
from pathlib import Path

#: Exit codes beside 0 (done) and those of the errors below.
DAMAGED_EXIT_CODE = 3
DIFFERENT_EXIT_CODE = 4
INTERRUPTED_EXIT_CODE = 130

#: Message of an :class:`InputError` if left and right have no pair of images.
NO_FRAMES = "the recordings have no frame in common: check that they are whole"


class MotionStereoError(Exception):
    """Root of all errors that a user can cause and correct."""

    exit_code = 1


class SettingsError(MotionStereoError):
    """A parameter or argument has an invalid value."""

    exit_code = 2


class InputError(MotionStereoError):
    """A recording, rig or other input file cannot be used."""


class OutputError(MotionStereoError):
    """A result cannot be written."""


class TakenError(OutputError):
    """A file of others has the name of a result.

    Attributes:
        path: that file.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(f"{path} is not from this run: move it, and give the command again")
        self.path = path


class BusyError(OutputError):
    """Another run is writing to the folder."""


def is_damage(error: BaseException) -> bool:
    """Return whether an error of another library's reader means damaged input.

    Such readers raise errors of every kind; lack of memory is not damage, nor are this program's
    own errors.
    """
    return isinstance(error, Exception) and not (
        isinstance(error, MotionStereoError) or shortage(error)
    )


#: The longest message of a library that is quoted: some quote the file.
_MAX_QUOTED = 200


def words_of(error: BaseException) -> str:
    """Return the message of another library's error, in one line that is not long."""
    said = " ".join(str(getattr(error, "strerror", None) or error).split())
    return said[:_MAX_QUOTED].rstrip(".") or type(error).__name__


#: Messages of libraries when the system has no more memory.
_NO_MEMORY = re.compile("failed to map segment|cannot allocate memory|insufficient memory", re.I)


def shortage(error: BaseException) -> str | None:
    """Return what the machine lacks and what to do, None for other errors."""
    if "start new thread" in str(error):
        return (
            "the system starts no more threads, as its memory or the number of processes is "
            "limited: close other programs, or give --jobs 1"
        )
    if (
        isinstance(error, MemoryError)
        or getattr(error, "errno", None) == errno.ENOMEM
        or _NO_MEMORY.search(str(error))
    ):
        return "out of memory: close other programs, or give --jobs 1, --scale or --crop"
    if getattr(error, "errno", None) in (errno.EMFILE, errno.ENFILE):
        return "too many files are open: raise the limit (ulimit -n), or close other programs"
    return None


@contextlib.contextmanager
def opening(name: object) -> Iterator[None]:
    """Name a file whose opening takes more memory than there is: a damaged one may say any size.

    Raises:
        InputError: in the place of an error that means lack of memory.
    """
    try:
        yield
    except MotionStereoError:
        raise
    except Exception as error:
        if (said := shortage(error)) is None:
            raise
        raise InputError(f"{name} cannot be opened: {said}; or it is damaged") from error
