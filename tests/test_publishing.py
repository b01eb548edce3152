"""What is published: the README on the package index, the extras, and the workflows."""

import re
import sys
import tomllib
from pathlib import Path

import pytest
import yaml
from readme_renderer import markdown

import motionstereo_cli

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
ADDRESS = PROJECT["urls"]["Source"]
WORKFLOWS = {path.stem: path for path in (ROOT / ".github/workflows").glob("*.yml")}

sys.path.insert(0, str(ROOT / "motionstereo_cli/building"))
from backend import with_full_links  # noqa: E402  # as pip imports it


@pytest.fixture(scope="module")
def page():
    """The README as the package index shows it, HTML."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    return markdown.render(with_full_links(text, ADDRESS, motionstereo_cli.__version__))


def test_the_readme_is_rendered_whole(page):
    assert re.search(r"<h1[^>]*>motionstereo<", page)
    assert "<table>" in page
    assert "&lt;!--" not in page


def test_every_link_and_picture_of_the_rendered_readme_is_a_file_of_the_project(page):
    links = re.findall(r'<(a|img)\b[^>]*?(?:href|src)="([^#"]+)"', page)
    assert {kind for kind, _ in links} == {"a", "img"}
    for kind, link in links:
        way = "raw" if kind == "img" else "blob"
        start = f"{ADDRESS}/{way}/v{motionstereo_cli.__version__}/"
        assert link.startswith(start), link
        assert (ROOT / link.removeprefix(start).partition("#")[0]).is_file(), link


def test_links_that_are_full_already_stay():
    text = "[a](https://a.org) [b](#part) [c](c.md#part) ![d](d.png)"
    assert with_full_links(text, "https://x.org/p", "2.0") == (
        "[a](https://a.org) [b](#part) [c](https://x.org/p/blob/v2.0/c.md#part) "
        "![d](https://x.org/p/raw/v2.0/d.png)"
    )


def test_the_address_stands_in_one_place():
    for path in (*ROOT.glob("*.md"), *ROOT.glob("motionstereo_cli/**/*.md")):
        assert ADDRESS not in path.read_text(encoding="utf-8"), path


def test_all_has_every_extra_but_that_of_developers_and_install_names_them():
    extras = PROJECT["optional-dependencies"]
    page = (ROOT / "motionstereo_cli/docs/install.md").read_text(encoding="utf-8")
    assert extras["all"] == [f"motionstereo[{','.join(sorted(extras.keys() - {'all', 'dev'}))}]"]
    for name in extras.keys() - {"dev"}:
        assert f"`pip install '.[{name}]'`" in page
    assert "[all]" in (ROOT / ".github/Dockerfile").read_text()


def test_workflows_run_on_every_python_that_the_package_names():
    named = {c.rpartition(" ")[2] for c in PROJECT["classifiers"] if "Python :: 3." in c}
    steps = {
        name: yaml.safe_load(path.read_text(encoding="utf-8"))["jobs"]
        for name, path in WORKFLOWS.items()
    }
    assert set(steps["test"]["test"]["strategy"]["matrix"]["python"]) == named
    built = str(steps["wheels"]["wheels"]["steps"])
    assert {f"cp{name.replace('.', '')}-*" for name in named} <= set(re.findall(r"cp3\S+\*", built))
    assert f">={min(named, key=lambda name: int(name[2:]))}" == PROJECT["requires-python"]


def test_workflows_use_targets_that_there_are():
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for path in WORKFLOWS.values():
        for line in re.findall(r"\bmake (?:-C \S+ )?([a-z -]+)$", path.read_text(), re.MULTILINE):
            assert set(line.split()) <= set(targets), line


def test_newcomers_are_told_one_time_for_the_build():
    """Of the pages that say how long it takes to compile the loops."""
    said = {}
    for path in (ROOT / "README.md", ROOT / "Makefile", *ROOT.glob("motionstereo_cli/docs/*.md")):
        text = " ".join(path.read_text(encoding="utf-8").split())
        pattern = r"(?:[Cc]ompiles the inner loops|loops are built)[^.]*? in (.*? minutes?)"
        said |= {f"{path.name}": found for found in re.findall(pattern, text)}
    assert said.keys() == {"README.md", "Makefile", "install.md", "speed.md"}
    assert set(said.values()) == {"about a minute"}
