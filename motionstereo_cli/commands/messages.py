"""Talk on standard error."""

from __future__ import annotations

from collections.abc import Callable

import click


def say(kind: str, text: str) -> None:
    """Say something in one line, after what it is: ``note``, ``warning`` or ``error``."""
    click.echo(f"{kind}: {printable(' '.join(text.split()))}", err=True)


def announce_compiling(tell: Callable[[str, str], object] = say) -> None:
    """Say so when the first run on a machine takes longer."""
    from motionstereo_cli.compiled import when_compiling

    when_compiling(lambda: tell("note", "compiling for this machine, once: a few seconds"))


def printable(text: str) -> str:
    """Return a text in which what a terminal would obey, or cannot show, stands as an escape.

    Names of files come from strangers, and codes in one could clear the screen.
    """
    return "".join(
        each if each.isprintable() else each.encode("unicode_escape").decode() for each in text
    )
