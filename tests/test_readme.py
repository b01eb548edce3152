"""The README says what the program does: its option tables are the live commands' own.

Options that several commands share have one table; those of a command are the rest.
"""

import re
from pathlib import Path

import click
import pytest

from motionstereo_cli.commands import cli
from motionstereo_cli.settings import Settings, params
from motionstereo_cli.sources.settings import InputSettings

README = Path(__file__).parent.parent / "README.md"


SHARED = {
    "input": {item.name for item in params(InputSettings)},
    "processing": {"preset", *(item.name for item in params(Settings))},
}


def options(name):
    """The options of a command without the shared ones, or shared ones as ``run`` has them."""
    command = cli.commands[name if name in cli.commands else "run"]
    shared = SHARED.get(name)
    groups = [] if shared else [g for g in SHARED.values() if g <= {o.name for o in command.params}]
    for option in command.params:
        if isinstance(option, click.Option) and (
            option.name in shared if shared else not any(option.name in group for group in groups)
        ):
            yield command, option


def table(name):
    rows = ["| option | what it does |", "| --- | --- |"]
    for command, option in options(name):
        names = ", ".join(option.opts + option.secondary_opts)
        text = " ".join(option.get_help_record(click.Context(command))[1].split())
        rows.append(f"| `{names}` | {text.replace('|', 'or')} |")
    return "\n".join(rows)


@pytest.mark.parametrize("name", [*SHARED, *cli.commands])
def test_the_readme_has_every_option_as_it_is(name, renew):
    wanted = table(name)
    text = README.read_text(encoding="utf-8")
    block = re.compile(rf"(<!-- options: {name} -->\n).*?(<!-- end -->)", re.DOTALL)
    if renew:
        text = block.sub(lambda m: f"{m[1]}{wanted}\n{m[2]}", text)
        README.write_text(text, encoding="utf-8")
    found = block.search(text)
    assert found, f"README.md lacks the options of {name}"
    assert wanted in found[0], "renew with: make renew"


@pytest.mark.parametrize("name", cli.commands)
def test_every_command_and_option_has_help(name):
    command = cli.commands[name]
    assert command.help
    for option in command.params:
        if isinstance(option, click.Option):
            assert option.help, option.name
