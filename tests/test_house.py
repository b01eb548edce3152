"""The rules of the house: who may know whom."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import motionstereo_cli

PACKAGE = Path(motionstereo_cli.__file__).parent
MODULES = sorted(PACKAGE.rglob("*.py"))


def imports(path, *, top_level_only=False):
    """Names of all modules that a file imports, as dotted paths."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    nodes = tree.body if top_level_only else ast.walk(tree)
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def room(path):
    relative = path.relative_to(PACKAGE)
    return relative.parts[0] if len(relative.parts) > 1 else ""


@pytest.mark.parametrize("path", [p for p in MODULES if room(p) == "stages"], ids=lambda p: p.name)
def test_stages_know_arrays_and_numbers_alone(path):
    allowed = {"__future__", "collections", "dataclasses", "math", "typing"}
    allowed |= {"numpy", "cv2", "scipy"}
    known = {name for name in imports(path) if not name.startswith("motionstereo_cli.kernel")}
    assert {name.split(".")[0] for name in known} <= allowed


def test_only_the_pipeline_and_the_mapping_join_stages():
    joining = [
        path.name
        for path in MODULES
        if any(name.startswith("motionstereo_cli.stages.") for name in imports(path))
    ]
    assert joining == ["mapping.py", "pipeline.py"]


def test_only_commands_and_the_entry_point_know_click():
    knowing = {
        path.relative_to(PACKAGE).as_posix() for path in MODULES if "click" in set(imports(path))
    }
    strangers = {path for path in knowing if not path.startswith("commands/")}
    assert strangers == {"__main__.py"}


@pytest.mark.parametrize(("one", "other"), [("sources", "sinks"), ("sinks", "sources")])
def test_sources_and_sinks_never_import_each_other(one, other):
    for path in MODULES:
        if room(path) == one:
            assert not any(n.startswith(f"motionstereo_cli.{other}") for n in imports(path)), path


def test_nothing_heavy_loads_before_it_is_used():
    heavy = ("numpy", "cv2", "scipy", "av", "imageio", "tqdm")
    loaded = subprocess.run(
        [
            sys.executable,
            "-c",
            "import sys, motionstereo_cli.__main__, motionstereo_cli.types\n"
            f"print([name for name in {heavy} if name in sys.modules])",
        ],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert loaded.strip() == "[]"


def test_only_known_files_stand_at_the_top():
    allowed = {"pyproject.toml", "motionstereo_cli", "tests", "sample_data", "Makefile"}
    allowed |= {"README.md", "LICENSE", "CHANGELOG.md", "out", "build"}
    found = {path.name for path in PACKAGE.parent.iterdir() if not path.name.startswith(".")}
    assert {name for name in found if not name.endswith(".egg-info")} <= allowed
