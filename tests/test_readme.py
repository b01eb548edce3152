"""The README says what the program does: its option tables are the live commands' own."""

import re
from pathlib import Path

import click
import pytest

from motionstereo_cli.commands import cli

README = Path(__file__).parent.parent / "README.md"


def table(command):
    rows = ["| option | what it does |", "| --- | --- |"]
    for option in command.params:
        if isinstance(option, click.Option):
            names = ", ".join(option.opts + option.secondary_opts)
            text = " ".join(option.get_help_record(click.Context(command))[1].split())
            rows.append(f"| `{names}` | {text.replace('|', 'or')} |")
    return "\n".join(rows)


@pytest.mark.parametrize("name", cli.commands)
def test_the_readme_has_every_option_as_it_is(name, renew):
    wanted = table(cli.commands[name])
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
