"""``motionstereo report``: a page that shows a run to people."""

from __future__ import annotations

from pathlib import Path

import click

from motionstereo_cli.commands.grouped import GroupedCommand
from motionstereo_cli.commands.messages import say


@click.command(cls=GroupedCommand)
@click.argument("out", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--out",
    "page",
    type=click.Path(dir_okay=False, allow_dash=True, path_type=Path),
    help="HTML to write; an older report is replaced; - is standard output.  "
    "[default: report.html in OUT]",
)
def report(*, out: Path, page: Path | None) -> int:
    """Show a run, or a batch of runs, as one page to be opened in a browser.

    OUT is a folder that run wrote, complete or not, or the folder of a batch. The page needs no
    network. For a run it plays the videos of OUT as long as they stay where they are, and otherwise
    shows one frame of each. For a batch it has a row for each recording, failures first.
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
