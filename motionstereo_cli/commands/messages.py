"""Messages on standard error."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from contextvars import ContextVar
from typing import Any, TextIO

import click


class Tolerant:
    """Standard error that may be full, or its reader gone: what cannot be read is dropped.

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
        # The interpreter writes what is left once more on its way out.
        with contextlib.suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)


#: Takes each message too, and tells whether people are to read it; None: nothing does.
listener: ContextVar[Callable[[str, str], bool] | None] = ContextVar("listener", default=None)


def say(kind: str, text: str) -> None:
    """Say something in one line, after what it is: ``note``, ``warning`` or ``error``."""
    line = printable(" ".join(text.split()))
    hear = listener.get()
    if hear is None or hear(kind, line):
        click.echo(f"{kind}: {line}", err=True)


def printable(text: str) -> str:
    """Return a text with its control characters, and others that cannot be printed, as escapes.

    Names of files may come from anywhere, and codes in one could clear the screen.
    """
    return "".join(
        each if each.isprintable() else each.encode("unicode_escape").decode() for each in text
    )
