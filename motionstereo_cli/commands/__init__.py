"""The command line: one file a command."""

from __future__ import annotations

import click

from motionstereo_cli import __version__
from motionstereo_cli.commands.batch import batch
from motionstereo_cli.commands.check import check
from motionstereo_cli.commands.compare import compare
from motionstereo_cli.commands.drive import drive
from motionstereo_cli.commands.evaluate import evaluate
from motionstereo_cli.commands.figure import figure
from motionstereo_cli.commands.help import show_help
from motionstereo_cli.commands.info import info
from motionstereo_cli.commands.report import report
from motionstereo_cli.commands.rig import rig
from motionstereo_cli.commands.run import run
from motionstereo_cli.commands.simulate import simulate


class _InOrder(click.Group):
    """A group whose help has its commands in the order in which they were added."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)


@click.group(
    cls=_InOrder,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="motionstereo help lists the topics of the documentation.",
)
@click.version_option(__version__, message="motionstereo %(version)s")
def cli() -> None:
    """Depth and steering from what moves in two stereo videos."""


cli.add_command(run)
cli.add_command(batch)
cli.add_command(report)
cli.add_command(info)
cli.add_command(check)
cli.add_command(rig)
cli.add_command(figure)
cli.add_command(simulate)
cli.add_command(drive)
cli.add_command(evaluate)
cli.add_command(compare)
cli.add_command(show_help)
