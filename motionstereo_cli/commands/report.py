"""``motionstereo report``: a page that shows a run to people."""

from __future__ import annotations

from pathlib import Path

import click

from motionstereo_cli.commands.messages import say


@click.command()
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
    """Show a run as one page, to be opened in a browser.

    OUT is a folder that run wrote, complete or not. The page needs no network; it plays the
    videos of OUT as long as they lie where they are, and shows one frame of each where not.
    """
    from motionstereo_cli.report import write_report
    from motionstereo_cli.report.run_page import run_page

    if page and str(page) == "-":
        click.echo(run_page(out, Path("report.html")), nl=False)
        return 0
    page = page or out / "report.html"
    write_report(page, run_page(out, page))
    say("note", f"{page}: open it in a browser")
    return 0
