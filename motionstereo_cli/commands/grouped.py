"""Help in groups: common options on one screen, all options on request."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import click

#: The headings, in the order in which the help has them.
GROUPS = ("Common", "Scene", "Input", "Calibration", "Output", "Method", "Guidance", "Robustness")

#: Key in a context's ``meta`` that asks for the full help.
FULL = f"{__name__}.full"


class GroupedOption(click.Option):
    """An option with its heading in the help.

    Args:
        group: its heading in the full help.
        common: whether the short help shows it, under the first heading.
    """

    def __init__(self, *args: Any, group: str, common: bool = False, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.heading = GROUPS[0] if common else group


def grouped(options: Iterable[click.Parameter]) -> dict[str, list[click.Option]]:
    """Return options by their heading, in the order of the headings.

    Plain click options count as common.
    """
    groups: dict[str, list[click.Option]] = {name: [] for name in GROUPS}
    for option in options:
        if isinstance(option, click.Option) and not option.hidden:
            groups[getattr(option, "heading", GROUPS[0])].append(option)
    return {name: found for name, found in groups.items() if found}


class GroupedCommand(click.Command):
    """A command whose ``--help`` has its common options and ``--help-all`` all of them.

    Args:
        examples: command lines that the help ends with; they work in ``sample_data``.
    """

    def __init__(self, *args: Any, examples: Sequence[str] = (), **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.examples = examples

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the examples, each on a line that can be copied."""
        if self.examples:
            with formatter.section("Examples"):
                for line in self.examples:
                    formatter.write(f"  {line}\n")

    def get_help_option_names(self, ctx: click.Context) -> list[str]:
        """Return the names of the help option, whatever the context; click keeps the first."""
        return ["-h", "--help"]

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """Return the parameters, ``--help`` and, if there is more to show, ``--help-all``."""
        option = click.Option(
            ["--help-all"],
            is_flag=True,
            is_eager=True,
            expose_value=False,
            callback=_show_all,
            hidden=len(grouped(self.params)) == 1,
            help="Show all options and exit.",
        )
        return [*super().get_params(ctx), option]

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options: all of them, or the first sentence of the common ones."""
        groups = grouped(self.get_params(ctx))
        full = ctx.meta.get(FULL, False) or len(groups) == 1
        for name in groups if full else GROUPS[:1]:
            with formatter.section(f"{name} options" if len(groups) > 1 else "Options"):
                records = [record for o in groups[name] if (record := o.get_help_record(ctx))]
                formatter.write_dl(
                    records if full else [(names, _short(text)) for names, text in records]
                )
        if not full:
            rest = {name: len(found) for name, found in groups.items() if name != GROUPS[0]}
            more = ", ".join(f"{name} ({count})" for name, count in rest.items())
            formatter.write_paragraph()
            formatter.write_text(f"More options with --help-all: {more}.")


def _short(text: str) -> str:
    """Return the first sentence of an option's help, and the facts in brackets behind it."""
    sentences, gap, facts = text.partition("  [")
    return sentences.partition(". ")[0].removesuffix(".") + "." + gap + facts


def _show_all(ctx: click.Context, _: click.Parameter, wanted: bool) -> None:
    if wanted:
        ctx.meta[FULL] = True
        click.echo(ctx.get_help(), color=ctx.color)
        ctx.exit()
