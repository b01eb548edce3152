"""The report: one web page of a run or a batch."""

from __future__ import annotations

from pathlib import Path

from motionstereo_cli.errors import OutputError
from motionstereo_cli.files.reading import open_regular
from motionstereo_cli.files.targets import is_stream, write_output

#: File name of the page.
PAGE = "report.html"

#: The mark near the beginning of every page, which identifies it.
GENERATOR = '<meta name="generator" content="motionstereo'


def write_report(path: Path, html: str) -> None:
    """Write a page; replaces an older one.

    Raises:
        OutputError: another file has that name, or the page cannot be written.
    """
    if path.exists() and not is_stream(path) and not is_report(path):
        raise OutputError(f"{path} is not a report of motionstereo: give another name with -o")
    write_output(path, html.encode())


def is_report(path: Path) -> bool:
    """Return whether a file is a page that this program wrote."""
    if path.is_symlink():
        return False
    try:
        with open_regular(path) as file:
            return GENERATOR.encode() in file.read(1000)
    except OSError:
        return False
