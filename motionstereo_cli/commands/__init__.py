"""The command line: one file a command."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from typing import Any

import click

from motionstereo_cli import __version__

#: In the order of the help: the name of each command, and of its function in the file of that name.
_FUNCTIONS = {
    "run": "run",
    "batch": "batch",
    "report": "report",
    "info": "info",
    "check": "check",
    "rig": "rig",
    "figure": "figure",
    "simulate": "simulate",
    "drive": "drive",
    "evaluate": "evaluate",
    "compare": "compare",
    "help": "show_help",
}


class _Commands(Mapping[str, click.Command]):
    """The commands by name; each loads when it is asked for, which takes a while for all."""

    def __getitem__(self, name: str) -> click.Command:
        function = _FUNCTIONS[name]
        command: click.Command = getattr(importlib.import_module(f"{__name__}.{name}"), function)
        return command

    def __iter__(self) -> Iterator[str]:
        return iter(_FUNCTIONS)

    def __len__(self) -> int:
        return len(_FUNCTIONS)


_commands: Any = _Commands()  # click only reads it


class _InOrder(click.Group):
    """A group whose help has its commands in the order in which they were added."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)


@click.group(
    cls=_InOrder,
    commands=_commands,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="motionstereo help lists the topics of the documentation.",
)
@click.version_option(__version__, message="motionstereo %(version)s")
def cli() -> None:
    """Depth and steering from what moves in two stereo videos."""
