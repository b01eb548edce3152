"""The documentation says what the program does: its tables are the live commands' own.

Options that several commands share have one table; those of a command are the rest.
"""

import re
from pathlib import Path

import click
import pytest

import motionstereo_cli
from motionstereo_cli.__main__ import main
from motionstereo_cli.commands import cli
from motionstereo_cli.commands.help import pages, subject
from motionstereo_cli.params import params
from motionstereo_cli.settings import Settings
from motionstereo_cli.sinks import DEFAULT_OUTPUTS, OUTPUTS
from motionstereo_cli.sinks.steering import HEADER
from motionstereo_cli.sources.settings import InputSettings

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"
DOCS = Path(motionstereo_cli.__file__).parent / "docs"
PAGES = [README, *sorted(DOCS.glob("*.md")), ROOT / ".github/CONTRIBUTING.md"]

SHARED = {
    "input": {item.name for item in params(InputSettings)},
    "processing": {"preset", *(item.name for item in params(Settings))},
}


def table(head, rows):
    lines = ["| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *rows)]
    return "\n".join(lines)


def options(command, names):
    rows = []
    for option in command.params:
        if isinstance(option, click.Option) and option.name in names:
            flags = ", ".join(option.opts + option.secondary_opts)
            text = " ".join(option.get_help_record(click.Context(command))[1].split())
            rows.append([f"`{flags}`", text.replace("|", "or")])
    return table(["option", "what it does"], rows)


def all_options():
    """The whole page of options."""
    parts = ["# Options: every option of every command"]
    for name, command in cli.commands.items():
        context = click.Context(command, info_name=f"motionstereo {name}")
        usage = " ".join(command.collect_usage_pieces(context)).replace("[OPTIONS] ", "")
        known = {o.name for o in command.params if isinstance(o, click.Option)}
        shared = {group: names for group, names in SHARED.items() if names <= known}
        own = known.difference(*shared.values())
        parts.append(f"## motionstereo {name} {usage}".rstrip())
        parts.append("\n".join(line.strip() for line in command.help.splitlines()))
        parts.extend([options(command, own)] if own else [])
        if shared:
            links = " and ".join(f"[{group}](#options-of-the-{group})" for group in shared)
            parts.append(f"and the options of the {links}.")
    for group, names in SHARED.items():
        parts.append(f"## Options of the {group}")
        parts.append(options(cli.commands["run"], names))
    return "\n\n".join(parts) + "\n"


def outputs(names, *, with_name):
    rows = []
    for name in names:
        bold = f"**{name}**" if name in DEFAULT_OUTPUTS else name
        save = OUTPUTS[name]
        files = ", ".join(f"`{path}`" for path in (save.path.format(0), *save.beside))
        rows.append([*([bold] if with_name else []), files, save.what])
    record = "settings, versions, inputs with size and SHA-256, rig, time base, counts of frames, "
    record += "damage, and the unit of every output"
    rows.append([*(["(always)"] if with_name else []), "`run.json`", record])
    return table([*(["name for `--save`"] if with_name else []), "file", "what it holds"], rows)


def steering():
    """The columns of the steering table, as the page of outputs describes them."""
    return block("steering", (DOCS / "outputs.md").read_text(encoding="utf-8"))[2]


def commands():
    rows = [[f"`{name}`", each.help.partition("\n")[0]] for name, each in cli.commands.items()]
    return table(["command", "what it does"], rows)


def topics():
    return "\n".join(
        f"- [{name}](motionstereo_cli/docs/{name}.md): {subject(page)}"
        for name, page in pages().items()
    )


GENERATED = {
    (README, "commands"): commands,
    (README, "default outputs"): lambda: outputs(DEFAULT_OUTPUTS, with_name=False),
    (README, "steering"): steering,
    (README, "topics"): topics,
    (DOCS / "outputs.md", "outputs"): lambda: outputs(OUTPUTS, with_name=True),
}


def block(name, text):
    found = re.search(rf"(<!-- {name} -->\n)(.*?)\n?(<!-- end -->)", text, re.DOTALL)
    assert found, f"there is no block {name}"
    return found


@pytest.mark.parametrize(("path", "name"), GENERATED, ids=lambda part: getattr(part, "name", part))
def test_tables_are_those_of_the_program(path, name, renew):
    wanted, text = GENERATED[path, name](), path.read_text(encoding="utf-8")
    if renew:
        found = block(f"generated: {name}", text)
        text = text[: found.start(2)] + wanted + "\n" + text[found.start(3) :]
        path.write_text(text, encoding="utf-8")
    assert block(f"generated: {name}", text)[2] == wanted, "renew with: make renew"


def test_the_page_of_options_is_that_of_the_program(renew):
    path, wanted = DOCS / "options.md", all_options()
    if renew:
        path.write_text(wanted, encoding="utf-8")
    assert path.read_text(encoding="utf-8") == wanted, "renew with: make renew"


def test_every_column_of_the_steering_table_is_described():
    named = re.findall(r"^\| (.*?) \|", steering(), re.MULTILINE)[2:]
    assert [name for cell in named for name in re.findall(r"`(\w+)`", cell)] == HEADER.split(",")


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_links_lead_somewhere(path):
    for link in re.findall(r"\]\(([^)\s]+)\)", path.read_text(encoding="utf-8")):
        if link.startswith(("http:", "https:")):
            continue
        target, _, anchor = link.partition("#")
        file = path.parent / target if target else path
        assert file.exists(), link
        if anchor:
            headings = re.findall(r"^#+ (.*)", file.read_text(encoding="utf-8"), re.MULTILINE)
            slugs = [re.sub(r"[^\w\- ]", "", each.lower()).replace(" ", "-") for each in headings]
            assert anchor in slugs, link


@pytest.mark.parametrize("name", cli.commands)
def test_every_command_and_option_has_help(name):
    command = cli.commands[name]
    assert command.help
    for option in command.params:
        if isinstance(option, click.Option):
            assert option.help, option.name


def test_help_prints_every_page_and_every_commands_help(capsys):
    assert main(["help"]) == 0
    listed = capsys.readouterr().out
    assert not pages().keys() & cli.commands.keys()
    for topic, page in pages().items():
        assert f"  {topic} " in listed
        assert main(["help", topic]) == 0
        assert capsys.readouterr().out == page + "\n"
    for name in cli.commands:
        assert main(["help", name]) == 0
        assert f"Usage: motionstereo {name}" in capsys.readouterr().out


def test_a_mistyped_topic_is_named_with_what_it_may_be(capsys):
    assert main(["help", "ouputs"]) == 2
    assert "did you mean outputs?" in capsys.readouterr().err
