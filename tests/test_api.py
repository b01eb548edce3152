"""The package from Python: the public names, and the README's five lines."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

import motionstereo_cli
from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.files.video import VideoWriter
from motionstereo_cli.method import matching
from motionstereo_cli.rig import write_rig
from motionstereo_cli.types import Rig

README = Path(motionstereo_cli.__file__).parent.parent / "README.md"
PAGE = Path(motionstereo_cli.__file__).parent / "docs" / "python.md"


def examples(page: Path) -> list[str]:
    """The blocks of Python code in a page."""
    return re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S)


def python(code: str, cwd: Path) -> str:
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code],
        capture_output=True,
        text=True,
        check=False,
        cwd=cwd,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture
def recording(tmp_path):
    """A folder with stripes that move, 8 px apart in the two views: 80 * 0.1 / 8 = 1 m."""
    stripes = np.repeat(np.random.default_rng(1).integers(0, 256, 20, np.uint8), 9)
    for side, shift in (("left", 0), ("right", 8)):
        video = VideoWriter(tmp_path / f"{side}.mp4", Fraction(1, 30))
        for index in range(6):
            start = shift + 2 * index
            view = np.tile(stripes[start : start + 96], (64, 1))
            # A nearer side, or one flat surface would fill the view: no heading.
            begin = 0 if side == "right" else 16
            view[:, begin : begin + 32] = stripes[2 * index : 2 * index + 32]
            video.write(view, index)
        video.close()
    write_rig(tmp_path / "rig.yaml", Rig(96, 64, 80, 0.1, 47.5, 31.5))
    return tmp_path


def test_five_lines_stream_arrays(recording):
    [code] = examples(README)
    assert code == examples(PAGE)[0]
    median = code.replace("result.depth_m.shape", "np.nanmedian(result.depth_m)")
    lines = python(f"import numpy as np\n{median}", recording).splitlines()
    assert [line.split()[0] for line in lines] == ["0", "1", "2", "3", "4", "5"]
    assert lines[0].split()[1:] == ["nan", "None"]
    assert float(lines[-1].split()[1]) == pytest.approx(1, abs=0.02)
    assert abs(float(lines[-1].split()[2])) < 0.6


def test_a_plan_is_run(recording):
    assert python(examples(PAGE)[1], recording).startswith("6 ")


def test_a_matcher_of_ones_own_is_chosen_by_its_name(recording):
    code = examples(PAGE)[2] + (
        "from motionstereo_cli import Settings, open_stereo, process\n"
        "with open_stereo('left.mp4', 'right.mp4') as source:\n"
        "    *_, last = process(source, Settings(matcher='constant'))\n"
        "known = ~np.isnan(last.disparity_px)\n"
        "print((known == last.motion).all(), known.any(), np.nanmax(last.disparity_px))\n"
    )
    assert python(code, recording) == "True True 8.0\n"


def test_the_example_compares_two_matchers_with_the_truth(tmp_path):
    lines = python(examples(PAGE)[3], tmp_path).splitlines()
    scores = [re.fullmatch(r"([a-z-]+): (.*) known, (.*) of it wrong .*", line) for line in lines]
    assert [score[1] for score in scores] == ["semi-global", "dense"]
    for score in scores:
        assert float(score[2]) > 0.05  # cards move before a wall that rests
        assert float(score[3]) < 0.4


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (
            lambda right, left, settings: right.charge[1:],
            r"gives shape \(23, 32\): give \(24, 32\)",
        ),
        (lambda right, left, settings: "far", "failed: ValueError"),
        (lambda right, left: right.charge, "failed: TypeError"),
    ],
)
def test_a_matcher_that_fails_is_named(function, message, monkeypatch):
    monkeypatch.setattr(matching, "MATCH", dict(matching.MATCH))
    monkeypatch.setitem(matching.MATCHERS, "own", None)
    motionstereo_cli.register_matcher("own", function)
    frame = motionstereo_cli.StereoFrame(0, 0, None, *np.zeros((2, 24, 32), np.uint8))
    with pytest.raises(InputError, match=f"the matcher own {message}"):
        list(motionstereo_cli.process([frame], motionstereo_cli.Settings(matcher="own")))


@pytest.mark.parametrize(("name", "function"), [("dense", print), ("", print), ("mine", 5)])
def test_only_new_names_and_functions_are_registered(name, function):
    with pytest.raises(SettingsError, match="give another name, and a function"):
        motionstereo_cli.register_matcher(name, function)


def test_installed_packages_offer_matchers(recording, monkeypatch, tmp_path):
    """To the command line too; one that cannot be loaded is named when it is wanted."""
    packages = tmp_path / "packages"
    offer = packages / "offer-1.dist-info"
    offer.mkdir(parents=True)
    (offer / "METADATA").write_text("Metadata-Version: 2.1\nName: offer\nVersion: 1\n")
    (offer / "entry_points.txt").write_text(
        "[motionstereo.matchers]\nconstant = offer:constant\ngone = offer.gone:match\n"
        "dense = offer:constant\n"
    )
    (packages / "offer.py").write_text(examples(PAGE)[2].partition("register_matcher(")[0])
    monkeypatch.setenv("PYTHONPATH", str(packages))

    def ran(matcher):
        args = ["run", "left.mp4", "right.mp4", "--matcher", matcher, "-o", matcher]
        command = [sys.executable, "-m", "motionstereo_cli", *args, "--save", "steering"]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=recording)
        return done.returncode, done.stderr

    assert ran("constant")[0] == 0
    assert json.loads((recording / "constant/run.json").read_text())["settings"]["matcher"]
    code, said = ran("gone")
    assert code == 1
    assert "error: the matcher gone cannot be loaded: ModuleNotFoundError" in said
    assert ran("dense")[0] == 0
    code, said = ran("none")
    assert code == 2
    assert "constant" in said


@pytest.mark.parametrize("name", motionstereo_cli.__all__)
def test_every_public_name_is_there_and_documented(name):
    thing = getattr(motionstereo_cli, name)
    assert thing.__name__ == name
    assert thing.__doc__
    assert name in dir(motionstereo_cli)


def test_type_checkers_see_the_same_names_from_the_same_modules():
    path = Path(motionstereo_cli.__file__)
    assert (path.parent / "py.typed").exists()
    seen = {
        alias.name: node.module
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ImportFrom) and node.module.startswith("motionstereo_cli")
        for alias in node.names
    }
    assert seen == {
        name: getattr(motionstereo_cli, name).__module__ for name in motionstereo_cli.__all__
    }


def test_the_import_loads_nothing_heavy_and_knows_no_other_names(tmp_path):
    code = (
        "import sys, motionstereo_cli as m\n"
        "m.Settings, m.Rig, m.InputSettings\n"
        "print({'numpy', 'cv2', 'av', 'click'} & sys.modules.keys(), hasattr(m, 'procces'))"
    )
    assert python(code, tmp_path) == "set() False\n"


def test_submodules_are_not_hidden_by_public_names():
    modules = {path.stem for path in Path(motionstereo_cli.__file__).parent.iterdir()}
    assert not modules & set(motionstereo_cli.__all__)
