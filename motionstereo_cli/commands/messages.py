"""Messages on standard error."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
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


def say(kind: str, text: str) -> None:
    """Print a message in one line, after its kind: ``note``, ``warning`` or ``error``."""
    line = printable(" ".join(text.split()))
    hear = listener.get()
    if hear is None or hear(kind, line):
        click.echo(f"{kind}: {line}", err=True)


def printable(text: str) -> str:
    """Return a text with control characters and others that cannot be printed as escapes.

    File names may contain terminal codes, which could clear the screen.
    """
    return "".join(
        each if each.isprintable() else each.encode("unicode_escape").decode() for each in text
    )
