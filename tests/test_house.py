"""The rules of the house: who may know whom."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import motionstereo_cli
from bench import house

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


#: Files of ``robot`` that know arrays and numbers only; the others join them and keep state.
PURE_ROBOT = {
    *("free_space.py", "course.py", "grid.py", "local_map.py", "fused_map.py", "objects.py"),
    "points.py",
    *("alignment.py", "approach.py", "movers.py", "separation.py"),
}
#: Files of ``method`` that join its stages.
JOINTS = {"matching.py", "memory.py", "settings.py"}
PURE = [
    path
    for path in MODULES
    if (room(path) == "method" and path.name not in JOINTS)
    or (room(path) == "robot" and path.name in PURE_ROBOT)
]
#: What each room may import of the package besides itself; "" is the modules at the root.
GROUND = {"errors", "types", "compiled", "params", "method"}
MAY_IMPORT = {
    "files": {"compiled", "errors", "types"},
    "sources": {"compiled", "errors", "types", "params", "files"},
    "rig": {"errors", "types", "params", "files", "sources"},
    "sinks": GROUND | {"files", "rig", "robot", "sources"},
}


@pytest.mark.parametrize("path", PURE, ids=lambda p: p.name)
def test_stages_and_the_pure_files_of_robot_know_arrays_and_numbers_only(path):
    allowed = {"__future__", "collections", "dataclasses", "math", "typing"}
    allowed |= {"numpy", "cv2"}
    pure = tuple(f"motionstereo_cli.{n}" for n in ("compiled", "robot.assignment", "robot.grid"))
    known = {name for name in imports(path) if not name.startswith(pure)}
    assert {name.split(".")[0] for name in known} <= allowed


def joins(rooms):
    """Files that import something of ``rooms`` from outside of it."""
    names = tuple(f"motionstereo_cli.{name}" for name in rooms)
    return {
        path.relative_to(PACKAGE).as_posix()
        for path in MODULES
        if any(name.startswith(names) for name in imports(path))
    }


def test_only_the_pipeline_its_memories_and_matchers_join_stages():
    stages = [f"method.{path.stem}" for path in PURE if room(path) == "method"]
    joints = {"method/matching.py", "method/memory.py", "pipeline.py"}
    assert joins(stages) == joints | {"runs/onnx_model.py"}  # which makes a stage of a file


def test_only_the_files_of_robot_that_keep_state_join_its_pure_ones():
    pure = [f"robot.{name.removesuffix('.py')}" for name in sorted(PURE_ROBOT - {"grid.py"})]
    assert joins(pure) <= {
        "pipeline.py",
        "robot/__init__.py",  # which loads them when they are used
        *("robot/bodies.py", "robot/speeds.py"),  # of objects
        "robot/guide.py",
        "robot/mapper.py",
        "robot/mover_finder.py",
        "robot/odometer.py",
        "robot/odometry.py",
        "robot/route.py",  # the course to a goal
        "robot/tracker.py",
    } | {
        "runs/checkpoint.py",  # it names what is kept from frame to frame
        "batch/pieces.py",  # it hands on what pieces found
        "sinks/map.py",
        "sinks/points.py",
        "simulate/drive_plan.py",
    }


@pytest.mark.parametrize("name", sorted(MAY_IMPORT))
def test_rooms_import_nothing_above_them(name):
    for path in MODULES:
        if room(path) == name:
            known = {n.split(".")[1] for n in imports(path) if n.startswith("motionstereo_cli.")}
            assert known <= MAY_IMPORT[name] | {name, "__version__"}, path


def test_no_import_goes_round_or_up_and_no_two_classes_have_one_name():
    measured = house.measured()
    for what in ("circles", "arrows up", "class names twice"):
        assert measured[what] == 0, what
    assert measured["imports in functions that a circle forces"] == 0


def test_only_commands_and_the_entry_point_know_click():
    knowing = {
        path.relative_to(PACKAGE).as_posix() for path in MODULES if "click" in set(imports(path))
    }
    strangers = {path for path in knowing if not path.startswith("commands/")}
    assert strangers == {"__main__.py"}


#: What opens, makes, names or removes files: methods by their name, functions with their module.
METHODS = {
    *("open", "read_bytes", "read_text", "write_bytes", "write_text", "unlink", "touch", "mkdir"),
    *("rmdir", "rename", "hardlink_to", "symlink_to", "rmtree", "copyfile", "copytree"),
    "resolve",  # which raises on a circle of links
    *("imread", "imwrite", "VideoCapture", "FileStorage", "memmap", "fromfile", "tofile"),
    *("NamedTemporaryFile", "TemporaryDirectory", "mkdtemp", "mkstemp"),
}
FUNCTIONS = {
    *("os.replace", "os.remove", "os.makedirs", "os.link", "os.symlink", "os.truncate"),
    *("np.load", "np.save", "np.savez", "np.loadtxt", "np.savetxt", "zipfile.ZipFile"),
    *("shutil.copy", "shutil.move"),
}
#: The gate; and what is no file, or is read before anything else can be.
GATE = {"files", "compiled", "building"}
NO_FILES = {
    ("sources/container.py", "av.open"),  # the gate of media
    ("sources/bag_topics.py", "reader.open"),
    ("runs/run.py", "OUTPUTS[name].open"),
    ("commands/grouped.py", "formatter.write_text"),
    ("sinks/bag.py", "layout.read_bytes"),  # of the package
    ("rig/structure.py", "np.load"),  # both of bytes in memory
    ("rig/structure.py", "zipfile.ZipFile"),
    ("__main__.py", "os.open"),  # os.devnull
    ("commands/messages.py", "os.open"),
}


def test_files_are_opened_made_and_removed_by_one_room():
    found = set()
    for path in MODULES:
        if room(path) in GATE:
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            name = ast.unparse(node) if isinstance(node, ast.Attribute | ast.Name) else ""
            bare = isinstance(node, ast.Name) and name == "open"
            if bare or name in FUNCTIONS or (name.rpartition(".")[2] in METHODS and "." in name):
                found.add((path.relative_to(PACKAGE).as_posix(), name))
    assert found == NO_FILES


def test_nothing_heavy_loads_before_it_is_used():
    heavy = ("numpy", "cv2", "av", "imageio", "tqdm")
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
    allowed |= {"PKG-INFO", "setup.cfg"}  # of an unpacked source distribution
    found = {path.name for path in PACKAGE.parent.iterdir() if not path.name.startswith(".")}
    assert {name for name in found if not name.endswith(".egg-info")} <= allowed


def test_no_file_is_too_long_to_read_in_one_go():
    lengths = {path: path.read_text(encoding="utf-8").count("\n") for path in MODULES}
    assert {path.name: lines for path, lines in lengths.items() if lines > 600} == {}


def test_a_command_says_what_happens_and_leaves_the_work_to_others():
    for path in MODULES:
        if room(path) == "commands":
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.FunctionDef):
                    code = node.body[1:] if ast.get_docstring(node) else node.body
                    assert not code or node.end_lineno - code[0].lineno < 40, node.name
