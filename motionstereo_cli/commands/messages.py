"""Messages on standard error."""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Any, TextIO

import click


class Tolerant:
    """Standard error that drops text if the disk is full or the reader has gone.

    Args:
        stream: standard error.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write a text, or drop it."""
        try:
            self._stream.write(text)
            self._stream.flush()
        except (OSError, ValueError):
            self._drop()
        return len(text)

    def flush(self) -> None:
        """Do nothing: what was written has been passed on."""

    def _drop(self) -> None:
        # At exit, the interpreter writes once more what is left.
        with contextlib.suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)


#: Receives each message and returns whether to print it too; None: all are printed.
listener: ContextVar[Callable[[str, str], bool] | None] = ContextVar("listener", default=None)


#: The least level that is printed, as ``logging`` has them: 10 with ``--verbose``, 30 with
#: ``--quiet``.
level: ContextVar[int] = ContextVar("level", default=logging.INFO)

_LEVELS = {
    "detail": logging.DEBUG,
    "note": logging.INFO,
    "warning": logging.WARNING,
    "error": logging.ERROR,
}


def say(kind: str, text: str) -> None:
    """Print a message in one line, after its kind.

    Kinds are ``error``, ``warning``, ``note`` and, with ``--verbose``, ``detail``.
    """
    line = printable(" ".join(text.split()))
    hear = listener.get()
    if (hear is None or hear(kind, line)) and _LEVELS[kind] >= level.get():
        click.echo(f"{kind}: {line}", err=True)


class _Details(logging.Handler):
    """Prints what the package logs for ``--verbose``; all else is said anyway."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print a record."""
        if record.levelno == logging.DEBUG:
            say("detail", record.getMessage())


@contextlib.contextmanager
def loudness(*, quiet: bool, verbose: bool) -> Iterator[None]:
    """Print no notes, or details too, while it lasts."""
    logger, details = logging.getLogger("motionstereo"), _Details()
    before = logger.level
    token = level.set(logging.WARNING if quiet else logging.DEBUG if verbose else logging.INFO)
    if verbose:
        logger.setLevel(logging.DEBUG)
        logger.addHandler(details)
    try:
        yield
    finally:
        level.reset(token)
        logger.removeHandler(details)
        logger.setLevel(before)


def printable(text: str) -> str:
    """Return a text with control characters and others that cannot be printed as escapes.

    File names may contain terminal codes, which could clear the screen.
    """
    return "".join(
        each if each.isprintable() else each.encode("unicode_escape").decode() for each in text
    )
