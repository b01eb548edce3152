"""Write a report in the requested forms: files, and one on standard output."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TypeVar

import click

STDOUT = Path("-")

_Report = TypeVar("_Report")
#: The file of a form, None if it was not requested, and the function that makes it.
Form = tuple[Path | None, Callable[[_Report], str]]


def write_files(report: _Report, forms: Sequence[Form[_Report]], inputs: Iterable[Path]) -> None:
    """Write the forms that have a file.

    Raises:
        OutputError: a file is one of ``inputs``, or cannot be written.
    """
    from motionstereo_cli.files.targets import write_output

    taken = tuple(inputs)
    for path, form in forms:
        if path is not None and path != STDOUT:
            write_output(path, form(report).encode(), taken)


def print_form(
    report: _Report, forms: Sequence[Form[_Report]], table: Callable[[_Report], str]
) -> None:
    """Print the form for standard output or, without one, the table."""
    form = next((form for path, form in forms if path == STDOUT), table)
    click.echo(form(report), nl=False)
