"""The package from Python: the public names, and the README's five lines."""

from __future__ import annotations

import ast
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

import motionstereo_cli
from motionstereo_cli.files.video import VideoWriter
from motionstereo_cli.rig import write_rig
from motionstereo_cli.types import Rig

FIVE_LINES = """
from motionstereo_cli import Settings, open_stereo, process, read_rig

with open_stereo("left.mp4", "right.mp4") as source:
    for result in process(source, Settings(max_disparity=32), read_rig("rig.yaml")):
        print(result.frame.index, np.nanmedian(result.depth_m), result.steering.steer_rad)
"""


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


def test_five_lines_stream_arrays(tmp_path):
    """Stripes that move, 8 px apart in the two views: 80 * 0.1 / 8 = 1 m."""
    stripes = np.repeat(np.random.default_rng(1).integers(0, 256, 20, np.uint8), 9)
    for side, shift in (("left", 0), ("right", 8)):
        video = VideoWriter(tmp_path / f"{side}.mp4", Fraction(1, 30))
        for index in range(6):
            start = shift + 2 * index
            video.write(np.tile(stripes[start : start + 96], (64, 1)), index)
        video.close()
    write_rig(tmp_path / "rig.yaml", Rig(96, 64, 80, 0.1, 47.5, 31.5))
    lines = python("import numpy as np" + FIVE_LINES, tmp_path).splitlines()
    assert [line.split()[0] for line in lines] == ["0", "1", "2", "3", "4", "5"]
    assert lines[0].split()[1:] == ["nan", "None"]
    assert float(lines[-1].split()[1]) == pytest.approx(1, abs=0.02)
    assert abs(float(lines[-1].split()[2])) < 0.6


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
