"""``motionstereo help``: the pages of the documentation, and the help of each command."""

from __future__ import annotations

import difflib
import re
import shutil
import sys
from collections.abc import Mapping
from importlib import resources

import click

from motionstereo_cli.commands.grouped import FULL
from motionstereo_cli.files.reading import read_text

# Comments mark the generated parts of a page.
_COMMENT = re.compile(r"<!--.*?-->\n")
_MAX_PAGE_BYTES = 1_000_000
_TABLE = re.compile(r"(?:^\|.*\n)+", re.MULTILINE)


def pages() -> dict[str, str]:
    """Return the Markdown text of each page of the documentation, by its topic; start is first."""
    folder = resources.files("motionstereo_cli") / "docs"
    found = sorted(folder.iterdir(), key=lambda page: (page.name != "start.md", page.name))
    return {
        page.name.removesuffix(".md"): _COMMENT.sub(
            "", read_text(str(page), "a page", _MAX_PAGE_BYTES)
        )
        for page in found
        if page.name.endswith(".md")
    }


def subject(page: str) -> str:
    """Return what a page is about: its heading after the colon."""
    return page.partition("\n")[0].partition(": ")[2]


def _complete_topics(context: click.Context, _: click.Parameter, begun: str) -> list[str]:
    return [name for name in [*pages(), *_commands(context)] if name.startswith(begun)]


def _commands(context: click.Context) -> Mapping[str, click.Command]:
    group = context.find_root().command
    return group.commands if isinstance(group, click.Group) else {}


@click.command("help")
@click.argument("topic", required=False, shell_complete=_complete_topics)
@click.pass_context
def show_help(context: click.Context, topic: str | None) -> None:
    """Print a page of the documentation, or the help of a command.

    Without TOPIC it lists the topics.
    """
    topics, commands = pages(), _commands(context)
    if topic is None:
        width = max(map(len, topics))
        lines = [f"  {name:<{width}}  {subject(page)}" for name, page in topics.items()]
        click.echo("\n".join(["Topics (motionstereo help TOPIC):", *lines]))
        click.echo(f"Commands (motionstereo help COMMAND): {', '.join(commands)}")
    elif topic in commands:
        context = click.Context(commands[topic], context.parent, topic)
        context.meta[FULL] = True
        _show(commands[topic].get_help(context))
    elif topic in topics:
        _show(topics[topic])
    else:
        near = difflib.get_close_matches(topic, [*topics, *commands], n=1)
        advice = f"did you mean {near[0]}?" if near else f"choose from {', '.join(topics)}"
        raise click.UsageError(f"there is no topic {topic!r}: {advice}", context)


def _show(text: str) -> None:
    """Print a text; on a terminal page by page, with tables that fit it."""
    if sys.stdout.isatty():
        click.echo_via_pager(readable(text, shutil.get_terminal_size().columns))
    else:
        click.echo(text)


def readable(page: str, width: int) -> str:
    """Return a page with its tables in columns, or as lists where the width is too small."""
    return _TABLE.sub(lambda table: _fitted(table[0], width), page)


def _fitted(table: str, width: int) -> str:
    head, _, *rows = (
        [cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()
    )
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    if sum(widths) + 2 * len(widths) - 2 <= width:
        lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in (head, *rows)]
        return "\n".join(lines) + "\n"
    formatter = click.HelpFormatter(width=width)
    if len(head) > 2:
        rows = [
            [row[0], "; ".join(f"{name}: {cell}" for name, cell in pairs if cell)]
            for row in rows
            for pairs in [list(zip(head, row, strict=True))[1:]]
        ]
    formatter.write_dl([(first, rest) for first, rest in rows], col_max=24)
    return formatter.getvalue()
