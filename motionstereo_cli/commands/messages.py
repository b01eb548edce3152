"""Messages on standard error."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, TextIO

import click

if TYPE_CHECKING:
    from motionstereo_cli.commands.progress import Bar

_WARM_UP_FRAMES = 4
_WORTH_SAYING_S = 5


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


def foretelling(frames: int, bar: Bar) -> Callable[[], None]:
    """Return a function to call after each frame; soon after the first it says how long all take.

    It says nothing if that is less than some seconds.

    Args:
        frames: how many frames there will be, about.
        bar: advances with each frame.
    """
    times_s = []

    def advance() -> None:
        bar.update()
        times_s.append(time.perf_counter())
        # The first frames take longer: they load.
        if len(times_s) == 2 * _WARM_UP_FRAMES:
            frame_s = (times_s[-1] - times_s[_WARM_UP_FRAMES - 1]) / _WARM_UP_FRAMES
            rest_s = frame_s * (frames - len(times_s))
            if rest_s >= _WORTH_SAYING_S:
                bar.say("note", f"about {frames} frames, which take {_duration(rest_s)}")

    return advance


def _duration(seconds: float) -> str:
    """Return a time in words, as exact as an estimate can be."""
    if seconds < 90:
        return f"about {max(round(seconds, -1), 10):.0f} s"
    if seconds < 5400:
        return f"about {seconds / 60:.0f} minutes"
    return f"about {seconds / 3600:.1f} hours"


def printable(text: str) -> str:
    """Return a text with its control characters, and others that cannot be printed, as escapes.

    Names of files may come from anywhere, and codes in one could clear the screen.
    """
    return "".join(
        each if each.isprintable() else each.encode("unicode_escape").decode() for each in text
    )
