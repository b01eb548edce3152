"""Progress of a command: a bar for people, or lines of JSON for programs."""

from __future__ import annotations

import contextlib
import functools
import io
import json
import logging
import sys
import time
from collections.abc import Callable
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TextIO

import click

from motionstereo_cli.commands.grouped import GroupedOption
from motionstereo_cli.commands.messages import level, listener, loudness, say
from motionstereo_cli.errors import DAMAGED_EXIT_CODE, INTERRUPTED_EXIT_CODE, OutputError
from motionstereo_cli.files.targets import is_stream, open_replacing, open_stream

if TYPE_CHECKING:
    from tqdm import tqdm

#: Minimum time between two progress lines, in s.
_PAUSE_S = 0.2
#: The beginning of each line; identifies a file of an earlier command.
_BEGINNING = b'{"kind": "'

_STATUS = {
    0: "done",
    1: "failed",
    2: "usage",
    DAMAGED_EXIT_CODE: "damaged",
    INTERRUPTED_EXIT_CODE: "interrupted",
}
_LINES: ContextVar[JsonLines | None] = ContextVar("lines", default=None)


_WARM_UP_FRAMES = 4
_WORTH_SAYING_S = 5
#: Minimum time between two lines of what is drawn, in s.
_LINE_S = 5


class JsonLines:
    """Report progress to a program, one JSON object a line.

    Args:
        stream: receives the lines.
        aside: whether messages also go to standard error, because ``stream`` is not that.
    """

    def __init__(self, stream: TextIO, *, aside: bool) -> None:
        self._stream, self.aside = stream, aside
        self._begun_s = self._first_s = time.monotonic()
        self._next_s = 0.0
        self._frame = 0
        self._frames: int | None = None

    def tell(self, kind: str, **more: Any) -> None:
        """Write a line; does nothing if the reader has gone."""
        now_s = time.monotonic()
        eta = None
        if self._frame and self._frames:
            frame_s = (now_s - self._first_s) / self._frame
            eta = round(max(self._frames - self._frame, 0) * frame_s, 3)
        facts = {
            "kind": kind,
            "frame": self._frame,
            "frames": self._frames,
            "seconds": round(now_s - self._begun_s, 3),
            "eta": eta,
        }
        with contextlib.suppress(OSError, ValueError):
            self._stream.write(json.dumps(facts | more) + "\n")
            self._stream.flush()

    def hear(self, kind: str, text: str) -> bool:
        """Write a message; return whether it is to be shown to people too."""
        self.tell(kind, text=text)
        return self.aside

    def begin(self, frames: int | None) -> None:
        """Start counting ``frames`` frames; None if unknown."""
        self._frames, self._first_s = frames, time.monotonic()
        self.tell("begin")

    def advance(self, frames: int = 1) -> None:
        """Count frames, and write a line now and then."""
        self._frame += frames
        if time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + _PAUSE_S
            self.tell("progress")

    def end(self, exit_code: int) -> None:
        """Write the line of the end."""
        status = _STATUS.get(exit_code, "failed")
        self.tell("end", status=status, exit_code=exit_code)
        if self.aside:
            with contextlib.suppress(OSError, ValueError):
                self._stream.close()


class Bar:
    """Show progress on a terminal or as JSON lines.

    Args:
        frames: how many there will be; None if unknown.
        quiet: no bar, even on a terminal.
    """

    def __init__(self, frames: int | None = None, *, quiet: bool = False) -> None:
        self._lines = _LINES.get()
        self._bar: tqdm[Any] | None = None
        hidden = (
            quiet
            or level.get() > logging.INFO
            or (self._lines is not None and not self._lines.aside)
        )
        self._on_terminal = not hidden and sys.stderr is not None and sys.stderr.isatty()
        self._next_line_s = 0.0
        if frames is not None:
            self.begin(frames)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def begin(self, frames: int | None) -> None:
        """Start the bar for ``frames`` frames; None if unknown."""
        if self._on_terminal:
            from tqdm import tqdm  # it takes a twentieth of the start to load

            self._bar = tqdm(total=frames, unit="frame")
        if self._lines is not None:
            self._lines.begin(frames)

    def update(self) -> None:
        """Count a frame."""
        if self._bar is not None:
            self._bar.update()
        if self._lines is not None:
            self._lines.advance()

    def tell(self, words: Callable[[], str]) -> None:
        """Say now and then, on a terminal, how things stand."""
        if self._on_terminal and time.monotonic() >= self._next_line_s:
            self._next_line_s = time.monotonic() + _LINE_S
            self.say("note", words())

    def say(self, kind: str, text: str) -> None:
        """Say something beside the bar."""
        if self._bar is not None:
            self._bar.clear()
        say(kind, text)
        if self._bar is not None:
            self._bar.refresh()


def lines() -> JsonLines | None:
    """Return the lines of ``--progress jsonl``; None without."""
    return _LINES.get()


def end_lines(exit_code: int) -> None:
    """End the lines of ``--progress jsonl``, if there are any."""
    if (told := _LINES.get()) is not None:
        _LINES.set(None)
        listener.set(None)
        told.end(exit_code)


_QUIET = "Print only warnings, errors and what is asked for; no bar."

_option = functools.partial(click.option, cls=GroupedOption, group="Output")
_OPTIONS = (
    _option(
        "--verbose",
        is_flag=True,
        help="Also print what is found before the first frame, and checkpoints.",
    ),
    _option("--quiet", is_flag=True, help=_QUIET),
    _option(
        "--progress-file",
        type=click.Path(dir_okay=False, path_type=Path),
        help="File or FIFO for --progress jsonl.  [default: standard error]",
    ),
    _option(
        "--progress",
        type=click.Choice(["bar", "jsonl"]),
        default="bar",
        show_default=True,
        help="How to report progress. bar: a bar, on a terminal; jsonl: one JSON object a line, "
        "messages included.",
    ),
)


def progress_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command ``--quiet``, ``--verbose``, ``--progress`` and ``--progress-file``.

    It receives none of them.
    """

    def watched(
        *,
        progress: str,
        progress_file: Path | None,
        quiet: bool,
        verbose: bool,
        **values: Any,
    ) -> Any:
        if quiet and verbose:
            raise click.UsageError("--quiet and --verbose contradict each other: give one")
        if progress_file is not None and progress != "jsonl":
            raise click.UsageError("--progress-file is for --progress jsonl: give both")
        if progress == "jsonl":
            told = _opened(progress_file)
            _LINES.set(told)
            listener.set(told.hear)
        with loudness(quiet=quiet, verbose=verbose):
            return command(**values)

    wrapped: Callable[..., Any] = functools.update_wrapper(watched, command)
    for option in _OPTIONS:
        wrapped = option(wrapped)
    return wrapped


def quiet_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command ``--quiet``, which it does not receive."""

    def quieted(*, quiet: bool, **values: Any) -> Any:
        with loudness(quiet=quiet, verbose=False):
            return command(**values)

    wrapped: Callable[..., Any] = functools.update_wrapper(quieted, command)
    return click.option("--quiet", is_flag=True, help=_QUIET)(wrapped)


def no_bar() -> bool | None:
    """Return whether a bar of tqdm is off: True with ``--quiet``, None: without a terminal."""
    return level.get() > logging.INFO or None


def _opened(path: Path | None) -> JsonLines:
    """Open the file of the lines; replaces only a file of an earlier command."""
    if path is None:
        return JsonLines(sys.stderr, aside=False)
    try:
        if is_stream(path):
            return JsonLines(io.TextIOWrapper(open_stream(path), "utf-8"), aside=True)
        file = open_replacing(path, _BEGINNING)
        if file is None:
            raise OutputError(f"{path} was not written by --progress jsonl: give another name")
        return JsonLines(io.TextIOWrapper(file, "utf-8"), aside=True)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror or error}") from error


def foretelling(frames: int, bar: Bar) -> Callable[[], None]:
    """Return a function to call after each frame; it estimates the total time once.

    It prints nothing if that is less than some seconds.

    Args:
        frames: expected number of frames.
        bar: advances with each frame.
    """
    times_s = []

    def advance() -> None:
        bar.update()
        times_s.append(time.perf_counter())
        # The first frames take longer: modules load.
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
