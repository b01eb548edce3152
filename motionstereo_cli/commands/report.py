"""``motionstereo report``: a page that shows a run to people."""

from __future__ import annotations

from pathlib import Path

import click

from motionstereo_cli.commands.grouped import GroupedCommand
from motionstereo_cli.commands.messages import say
from motionstereo_cli.commands.progress import quiet_option


@click.command(
    cls=GroupedCommand,
    examples=(
        "motionstereo run left.mp4 right.mp4 --rig rig.yaml -o out/shown",
        "motionstereo report out/shown",
    ),
)
@click.argument("out", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--out",
    "page",
    type=click.Path(dir_okay=False, allow_dash=True, path_type=Path),
    help="HTML file to write; replaces an older report. - is standard output.  "
    "[default: report.html in OUT]",
)
@quiet_option
def report(*, out: Path, page: Path | None) -> int:
    """Make a web page of a run or of a batch.

    OUT is the output folder of a run, complete or not, or of a batch. The page works without a
    network. For a run it plays the videos in OUT while they stay there, and otherwise shows one
    frame of each. For a batch it has one row for each recording, failures first.
    """
    from motionstereo_cli.report import PAGE, write_report
    from motionstereo_cli.report.batch_page import TABLE, batch_page
    from motionstereo_cli.report.run_page import run_page

    place = out / PAGE if page is None else Path(PAGE) if str(page) == "-" else page
    show = batch_page if (out / TABLE).is_file() else run_page
    html = show(out, place)
    if str(page) == "-":
        click.echo(html, nl=False)
        return 0
    write_report(place, html)
    say("note", f"{place}: open it in a browser")
    return 0
