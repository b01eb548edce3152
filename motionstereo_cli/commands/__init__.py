"""The command line: one file a command."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from typing import Any

import click

from motionstereo_cli import __version__

#: In the order of the help: the function of each command, in the file of its name, and the first
#: line of its help, which is repeated here so that the list of commands loads none of them.
_COMMANDS = {
    "run": ("run", "Find depth and steering in the two videos of a stereo camera."),
    "batch": ("batch", "Process many recordings in parallel, on this machine or on a cluster."),
    "report": ("report", "Make a web page of a run or of a batch."),
    "info": ("info", "Show what was detected in an input."),
    "check": ("check", "Look for faults in a recording that would spoil a run."),
    "rig": ("rig", "Convert a calibration to rig.yaml and show how it was read."),
    "figure": ("figure", "Draw some frames stage by stage on one sheet."),
    "simulate": ("simulate", "Render a stereo recording with exact truth into the folder OUT."),
    "drive": ("drive", "Drive a simulated robot by its own depth."),
    "evaluate": ("evaluate", "Compare the disparity or depth of a run with ground truth."),
    "compare": ("compare", "Compare a run with an earlier one; exit code 4 if they differ."),
    "help": ("show_help", "Print a page of the documentation, or the help of a command."),
}


class _Commands(Mapping[str, click.Command]):
    """The commands by name; each loads on first use."""

    def __getitem__(self, name: str) -> click.Command:
        function, _ = _COMMANDS[name]
        command: click.Command = getattr(importlib.import_module(f"{__name__}.{name}"), function)
        return command

    def __iter__(self) -> Iterator[str]:
        return iter(_COMMANDS)

    def __len__(self) -> int:
        return len(_COMMANDS)


_commands: Any = _Commands()  # click only reads it


class _Group(click.Group):
    """A group whose help lists its commands in order, without loading them."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(_COMMANDS)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, line) for name, (_, line) in _COMMANDS.items()])


@click.group(
    cls=_Group,
    commands=_commands,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="motionstereo help lists the topics of the documentation.",
)
@click.version_option(__version__, message="motionstereo %(version)s")
def cli() -> None:
    """Depth and steering from what moves in two stereo videos."""
