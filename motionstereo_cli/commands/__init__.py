"""The command line: one file a command."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from typing import Any

import click

from motionstereo_cli import __version__

#: In the order of the help: the function of each command, in the file of its name, and the first
#: line of its help. Said here too, the help of all need not load each.
_COMMANDS = {
    "run": ("run", "Find depth and steering in the two videos of a stereo camera."),
    "batch": ("batch", "Process many recordings, side by side on this machine or on a cluster."),
    "report": ("report", "Show a run, or a batch of runs, as one page to be opened in a browser."),
    "info": ("info", "Print how an input is understood."),
    "check": ("check", "Look for mistakes in a recording that would ruin a run."),
    "rig": ("rig", "Convert a calibration to rig.yaml, and say how it is understood."),
    "figure": ("figure", "Show some frames stage by stage on one sheet."),
    "simulate": ("simulate", "Render a stereo recording with exact truth into the folder OUT."),
    "drive": ("drive", "Let a simulated robot drive by its own depth."),
    "evaluate": ("evaluate", "Compare the disparity or depth that a run found with the truth."),
    "compare": ("compare", "Compare a run with an earlier one. Exit code 4 if they differ."),
    "help": ("show_help", "Print a page of the documentation, or the help of a command."),
}


class _Commands(Mapping[str, click.Command]):
    """The commands by name; each loads when it is asked for, which takes a while for all."""

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
