"""One page that shows a run to people."""

from __future__ import annotations

from pathlib import Path

from motionstereo_cli.errors import OutputError
from motionstereo_cli.files.atomic import reported
from motionstereo_cli.files.targets import is_stream, write_output

#: Its name in a folder.
PAGE = "report.html"

#: What every page has near its begin.
GENERATOR = '<meta name="generator" content="motionstereo'


def write_report(path: Path, html: str) -> None:
    """Write a page, in the place of an older one if there is one.

    Raises:
        OutputError: the file is there and is no such page, or cannot be written.
    """
    if path.exists() and not is_stream(path) and not is_report(path):
        raise OutputError(f"{path} is no report of motionstereo: give another name with -o")
    write_output(path, html.encode())


def is_report(path: Path) -> bool:
    """Return whether there is a page that this program made."""
    if not path.is_file() or path.is_symlink():
        return False
    with reported(path), path.open("rb") as file:
        return GENERATOR.encode() in file.read(1000)
