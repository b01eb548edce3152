"""The entry point: run a command; on an error print one line and return an exit code."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import traceback
from collections.abc import Sequence
from types import FrameType
from typing import TextIO, cast

import click
from click.shell_completion import shell_complete

from motionstereo_cli.commands import cli
from motionstereo_cli.commands.messages import Tolerant, say
from motionstereo_cli.commands.progress import end_lines
from motionstereo_cli.errors import (
    INTERRUPTED_EXIT_CODE,
    MotionStereoError,
    SettingsError,
    shortage,
    words_of,
)
from motionstereo_cli.runs.cores import prepare

#: How much alike an unknown option and the one that is suggested are at least, 0..1.
_LIKE = 0.8


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    0 done, 1 failed, 2 usage, 3 done but the input was damaged, 4 ``compare`` found a
    difference, 130 interrupted. If the reader of standard output has gone and nothing else was to
    be written: 0, without a message. A message that cannot be written is dropped.

    No traceback is shown unless the environment has ``MOTIONSTEREO_DEBUG=1``.

    Args:
        args: arguments after the program's name; the process's own if None.
    """
    signal.signal(signal.SIGTERM, _interrupt)
    prepare()
    _fill_standard_descriptors()
    with contextlib.ExitStack() as redirected:
        if sys.stderr is not None:
            tolerant = cast("TextIO", Tolerant(sys.stderr))
            redirected.enter_context(contextlib.redirect_stderr(tolerant))
        exit_code = _called(args)
        end_lines(exit_code)
        return exit_code


def _fill_standard_descriptors() -> None:
    """Open closed standard streams on the null device, so that no other file takes their number.

    FFmpeg writes its log to descriptor 2, whatever it is.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number
    if sys.stdout is None:
        sys.stdout = os.fdopen(1, "w", closefd=False)


def _called(args: Sequence[str] | None) -> int:
    given = list(sys.argv[1:] if args is None else args)
    try:
        if instruction := os.environ.get("_MOTIONSTEREO_COMPLETE"):
            return _completed(instruction)
        # Not cli(), which has exit codes of its own for Ctrl-C and closed pipes.
        with cli.make_context("motionstereo", given or ["--help"]) as context:
            return cli.invoke(context) or 0
    except click.exceptions.Exit as done:  # --help, --version
        return done.exit_code
    except BrokenPipeError:
        # At exit, the interpreter flushes standard output once more.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (KeyboardInterrupt, Exception) as error:
        if isinstance(error, click.NoSuchOption):
            for name in given:
                if name.startswith("-") and os.path.exists(name):
                    error.add_note(f"there is a file of the name {name}: write ./{name}")
        return _fail(error)


def _completed(instruction: str) -> int:
    """Answer a shell that completes a command line.

    Raises:
        SettingsError: no shell asked in this way.
    """
    try:
        return shell_complete(cli, {}, "motionstereo", "_MOTIONSTEREO_COMPLETE", instruction)
    except (LookupError, ValueError) as error:
        raise SettingsError(
            "_MOTIONSTEREO_COMPLETE is set, but not COMP_WORDS and COMP_CWORD: unset it"
        ) from error


def _fail(error: BaseException) -> int:
    """Print an error in one line and return its exit code."""
    match error:
        case KeyboardInterrupt() | click.Abort():
            message, exit_code = "interrupted", INTERRUPTED_EXIT_CODE
        case click.MissingParameter(ctx=click.Context() as context):
            message, exit_code = error.format_message(), error.exit_code
            usage = " ".join(context.get_usage().split()).removeprefix("Usage: ")
            error.add_note(f"usage: {usage}; {context.command_path} --help shows the options")
        case click.NoSuchOption(option_name=name, possibilities=known):
            import difflib  # which takes time

            like = difflib.get_close_matches(name, known or (), 1, _LIKE)
            message = click.NoSuchOption(name, possibilities=like).format_message()
            exit_code = error.exit_code
        case click.ClickException():
            message, exit_code = error.format_message(), error.exit_code
        case MotionStereoError():
            message, exit_code = str(error), error.exit_code
        case _ if short_of := shortage(error):
            message, exit_code = short_of, 1
        case FileNotFoundError(filename=None):  # of the current folder
            message, exit_code = "the current folder has been removed: change to another", 1
        case OSError():
            message, exit_code = str(error) if error.filename else words_of(error), 1
        case _:
            message, exit_code = f"internal: {type(error).__name__}: {error}", 1
    if os.environ.get("MOTIONSTEREO_DEBUG") == "1":
        traceback.print_exception(error)
    say("error", message)
    for note in getattr(error, "__notes__", []):
        say("note", note)
    return exit_code


def _interrupt(signal_number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main())
