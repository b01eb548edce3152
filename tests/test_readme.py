"""The documentation says what the program does: its tables are the live commands' own."""

import ast
import os
import re
import shlex
import subprocess
from pathlib import Path

import click
import pytest
import yaml

import motionstereo_cli
from motionstereo_cli.__main__ import main
from motionstereo_cli.check.findings import RULES
from motionstereo_cli.commands import cli
from motionstereo_cli.commands.grouped import grouped
from motionstereo_cli.commands.help import pages, readable, subject
from motionstereo_cli.sinks.outputs import DEFAULT_OUTPUTS, OUTPUTS
from motionstereo_cli.sinks.steering_table import HEADER

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"
DOCS = Path(motionstereo_cli.__file__).parent / "docs"
CONTRIBUTING = ROOT / ".github/CONTRIBUTING.md"
PAGES = [README, *sorted(DOCS.glob("*.md")), CONTRIBUTING]


def table(head, rows):
    lines = ["| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *rows)]
    return "\n".join(lines)


def record(command, option):
    """An option's names, and its help as one line of a table."""
    names = ", ".join(option.opts + option.secondary_opts)
    shown, text = option.get_help_record(click.Context(command))
    choices = re.search(r"\[(.*)\]$", shown)
    text = f"{' '.join(text.split())}{f' [{choices[1]}]' if choices else ''}"
    return f"`{names}`", text.replace(" | ", ", ").replace("|", ", ")


def all_options():
    """The whole page of options."""
    run = cli.commands["run"]
    of_run = {record(run, each) for found in grouped(run.params).values() for each in found}
    parts = ["# Options: every option of every command"]
    for name, command in cli.commands.items():
        context = click.Context(command, info_name=f"motionstereo {name}")
        usage = " ".join(command.collect_usage_pieces(context)).replace("[OPTIONS] ", "")
        parts.append(f"## motionstereo {name} {usage}".rstrip())
        parts.append("\n".join(line.strip() for line in command.help.strip().splitlines()))
        shared = []
        for heading, options in grouped(command.params).items():
            rows = [record(command, each) for each in options]
            if command is run:
                parts.append(f"### {heading}")
            else:
                shared += [flags for flags, text in rows if (flags, text) in of_run]
                rows = [row for row in rows if row not in of_run]
            parts.extend([table(["option", "what it does"], rows)] if rows else [])
        if shared:
            parts.append(f"As [run](#motionstereo-run-left-right) has them: {', '.join(shared)}.")
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


def start():
    """The first commands, as the page start has them."""
    return block("first commands", (DOCS / "start.md").read_text(encoding="utf-8"))[2]


def figures():
    """What the pages of measurements say in one sentence each."""
    lines = []
    for name in ("accuracy", "speed", "reliability"):
        path = DOCS / f"{name}.md"
        said = " ".join(block("summary", path.read_text(encoding="utf-8"))[2].split())
        lines.append(f"- **[{name.title()}]({path.relative_to(ROOT).as_posix()}).** {said}")
    return "\n".join(lines)


def commands():
    rows = [[f"`{name}`", each.help.partition("\n")[0]] for name, each in cli.commands.items()]
    return table(["command", "what it does"], rows)


def findings():
    rules = {rule.name: rule for rule in RULES}
    rows = [[rule.name, rule.measured, rule.limit] for rule in rules.values()]
    return table(["finding", "measured", "ruins the result (exit code 1)"], rows)


def topics():
    return "\n".join(
        f"- [{name}](motionstereo_cli/docs/{name}.md): {subject(page)}"
        for name, page in pages().items()
    )


def targets():
    """The targets of the Makefile, as ``make help`` prints them."""
    found = re.findall(r"^([a-z-]+):.*## (.*)", (ROOT / "Makefile").read_text(), re.MULTILINE)
    return table(["command", "what it does"], [[f"`make {name}`", what] for name, what in found])


def rooms():
    """The folders and modules of the package, as their docstrings say."""
    package = DOCS.parent
    files = [*sorted(package.glob("*.py")), *sorted(package.glob("*/__init__.py"))]
    rows = []
    for path in files:
        if path != package / "__init__.py":
            name = f"{path.parent.name}/" if path.name == "__init__.py" else path.name
            rows.append(
                [f"`{name}`", ast.get_docstring(ast.parse(path.read_text())).split("\n")[0]]
            )
    return table(["where", "what"], rows)


def workflow():
    text = (ROOT / ".github/workflows/regress.yml").read_text(encoding="utf-8")
    return f"```yaml\n{text}```"


GENERATED = {
    (CONTRIBUTING, "targets"): targets,
    (CONTRIBUTING, "rooms"): rooms,
    (DOCS / "reliability.md", "workflow"): workflow,
    (README, "commands"): commands,
    (README, "default outputs"): lambda: outputs(DEFAULT_OUTPUTS, with_name=False),
    (README, "start"): start,
    (README, "steering"): steering,
    (README, "topics"): topics,
    (README, "figures"): figures,
    (DOCS / "input.md", "findings"): findings,
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


def written_commands():
    """Each line that runs motionstereo in a code block of a page, with its page."""
    for path in PAGES:
        text = path.read_text(encoding="utf-8").replace("\\\n", " ")
        for code in re.findall(r"^```\w*\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
            yield from ((path.name, line) for line in code.splitlines() if "motionstereo " in line)
    steps = yaml.safe_load((ROOT / ".github/workflows/regress.yml").read_text(encoding="utf-8"))
    for step in steps["jobs"]["regress"]["steps"]:
        if step.get("run", "").startswith("motionstereo "):
            yield "regress.yml", step["run"]


def test_every_command_in_the_documentation_is_understood():
    ran = set()
    for page, line in written_commands():
        for words in re.findall(r"(?:^|\| |\. |run: )motionstereo ([^|#>]*)", line):
            name, *args = shlex.split(words)
            if name.startswith("-") or "MOTIONSTEREO" in line:
                continue
            assert name in cli.commands, f"{page}: {line}"
            command = cli.commands[name]
            context = click.Context(command, info_name=name, **command.context_settings)
            try:
                cli.commands[name].make_parser(context).parse_args(args)
            except click.UsageError as error:
                pytest.fail(f"{page}: {line}: {error.format_message()}")
            ran.add(page)
    assert {"README.md", "regress.yml", "outputs.md"} <= ran


def test_make_help_prints_the_targets():
    done = subprocess.run(["make", "-C", ROOT, "help"], capture_output=True, text=True, check=True)
    for name in re.findall(r"`make ([a-z-]+)`", targets()):
        assert re.search(rf"^{name} ", done.stdout, re.MULTILINE), name


def test_help_prints_every_page_and_every_commands_help(capsys):
    assert main(["help"]) == 0
    listed = capsys.readouterr().out
    assert listed.splitlines()[1].startswith("  start ")
    assert not pages().keys() & cli.commands.keys()
    for topic, page in pages().items():
        assert f"  {topic} " in listed
        assert main(["help", topic]) == 0
        assert capsys.readouterr().out == page + "\n"
    for name in cli.commands:
        assert main(["help", name]) == 0
        assert f"Usage: motionstereo {name}" in capsys.readouterr().out


def test_on_a_terminal_tables_fit_it(monkeypatch):
    shown = []
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setattr("shutil.get_terminal_size", lambda: os.terminal_size((70, 24)))
    monkeypatch.setattr("click.echo_via_pager", shown.append)
    assert main(["help", "outputs"]) == 0
    (page,) = shown
    assert "| --- |" not in page
    assert "code  meaning\n0     done" in page
    table = page[page.index("**steering**") : page.index("**Formats.**")]
    assert max(map(len, table.splitlines())) <= 70
    words, kept = (set(re.findall(r"\w+", text)) for text in (pages()["outputs"], page))
    assert words - kept <= {"column", "topic"}, "only lists have no name for their first column"


def test_every_page_can_be_shown_on_a_terminal():
    for topic, page in pages().items():
        for width in (40, 200):
            assert "| --- |" not in readable(page, width), topic


def test_a_mistyped_topic_is_named_with_what_it_may_be(capsys):
    assert main(["help", "ouputs"]) == 2
    assert "did you mean outputs?" in capsys.readouterr().err


def test_the_short_help_of_run_fits_a_screen_and_the_full_one_has_all(capsys):
    run = cli.commands["run"]
    assert main(["run", "--help"]) == 0
    short = capsys.readouterr().out
    assert len(short.splitlines()) <= 52
    assert main(["run", "--help-all"]) == 0
    full = capsys.readouterr().out
    for option in run.params:
        if isinstance(option, click.Option) and not option.hidden:
            assert option.opts[-1] in full, option.name
    assert [line for line in full.splitlines() if line.endswith(" options:")] == [
        f"{heading} options:" for heading in grouped(run.params)
    ]
    assert main(["help", "run"]) == 0
    assert capsys.readouterr().out == full


#: The commands with a help of their own.
HELPED = [name for name in cli.commands if name != "help"]


@pytest.mark.parametrize("name", HELPED)
def test_every_command_has_the_full_help(name, capsys):
    assert main([name, "--help-all"]) == 0
    assert f"Usage: motionstereo {name}" in capsys.readouterr().out


@pytest.mark.parametrize("name", cli.commands)
def test_a_command_without_its_arguments_shows_how_it_is_used(name, capsys):
    if any(each.required for each in cli.commands[name].params):
        assert main([name]) == 2
        error, note = capsys.readouterr().err.splitlines()
        assert error.startswith("error: Missing ")
        assert f"usage: motionstereo {name} [OPTIONS]" in note
        assert f"motionstereo {name} --help" in note


@pytest.mark.parametrize(
    ("line", "last", "wanted"),
    [
        ("motionstereo", "simu", {"simulate"}),
        ("motionstereo run", "--max-d", {"--max-disparity"}),
        ("motionstereo run --reference", "l", {"left"}),
        ("motionstereo batch table.csv", "--max-d", {"--max-disparity"}),
        ("motionstereo run --save", "depth,stee", {"depth,steering", "depth,steering-jsonl"}),
        ("motionstereo help", "out", {"outputs"}),
        ("motionstereo run", "sample", {"sample"}),
    ],
)
def test_the_shell_completes(line, last, wanted, monkeypatch, capsys):
    words = [*line.split(), last]
    monkeypatch.setenv("_MOTIONSTEREO_COMPLETE", "bash_complete")
    monkeypatch.setenv("COMP_WORDS", " ".join(words))
    monkeypatch.setenv("COMP_CWORD", str(len(words) - 1))
    assert main([]) == 0
    found = {each.partition(",")[2] for each in capsys.readouterr().out.splitlines()}
    assert found == wanted


def test_completion_that_no_shell_asked_for(monkeypatch, capsys):
    monkeypatch.setenv("_MOTIONSTEREO_COMPLETE", "bash_complete")
    monkeypatch.delenv("COMP_WORDS", raising=False)
    assert main([]) == 2
    assert "but not COMP_WORDS and COMP_CWORD: unset it" in capsys.readouterr().err


def test_the_help_of_all_says_of_each_command_what_its_own_help_begins_with(capsys):
    assert main(["--help"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    for name, command in cli.commands.items():
        first, _, _ = command.help.partition("\n")
        assert f" {name} {first}" in shown, name


@pytest.mark.parametrize("name", HELPED)
def test_the_help_of_a_command_is_what_it_was(name, renew, monkeypatch, capsys):
    """Nothing changes in it unseen: ``make renew`` accepts what does.

    The text of ``--help-all`` is held by the page of options.
    """
    monkeypatch.setenv("COLUMNS", "80")
    path = Path(__file__).parent / "help" / f"{name}.txt"
    assert main([name, "--help"]) == 0
    shown = capsys.readouterr().out
    if renew:
        path.parent.mkdir(exist_ok=True)
        path.write_text(shown, encoding="utf-8")
    assert path.read_text(encoding="utf-8") == shown, "renew with: make renew"


def test_ranges_are_stated_in_one_way():
    for name, command in cli.commands.items():
        context = click.Context(command)
        for option in command.params:
            if isinstance(option, click.Option):
                assert "<=" not in str(option.get_help_record(context)), f"{name} {option.name}"


def test_each_command_has_its_help_held():
    held = {path.stem for path in (Path(__file__).parent / "help").glob("*.txt")}
    assert held == set(HELPED)
