"""``--max-disparity auto``: measured before the first frame, and the same ever after."""

import json
import os
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
from recordings import encode

from motionstereo_cli import Settings, process
from motionstereo_cli.__main__ import main
from motionstereo_cli.errors import SettingsError
from motionstereo_cli.runs.disparity_range import with_range
from motionstereo_cli.runs.plan import RunPlan
from motionstereo_cli.runs.run import Watcher, run

DISPARITY, ADVISED = 36, 64


def textured(seed, width, height=96):
    noise = np.random.default_rng(seed).integers(0, 256, (height, width)).astype(np.uint8)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2), None, 0, 255, cv2.NORM_MINMAX)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A wall that passes by, 36 px nearer than infinity, in 40 frames."""
    folder, wall = tmp_path_factory.mktemp("wall"), textured(1, 400)
    for side, begin in (("left", 0), ("right", DISPARITY)):
        images = [wall[:, begin + 2 * t : begin + 2 * t + 160] for t in range(40)]
        encode(folder / f"{side}.mkv", images, "ffv1", "gray", 2)
    return [str(folder / f"{side}.mkv") for side in ("left", "right")]


def number_in(out):
    return json.loads((out / "run.json").read_text())["settings"]["max_disparity"]


def test_the_range_is_measured_said_and_recorded(recording, tmp_path, capsys):
    given = ["run", *recording, "--save", "steering", "-o"]
    config = tmp_path / "run.toml"
    config.write_text('max-disparity = "auto"\n')
    assert main([*given, str(tmp_path / "a"), "--max-disparity", "auto"]) == 0
    [line] = [line for line in capsys.readouterr().err.splitlines() if "max-disparity" in line]
    assert line.startswith(f"note: --max-disparity {ADVISED}: disparities of {DISPARITY}.0 to")
    assert main([*given, str(tmp_path / "b"), "--config", str(config)]) == 0
    assert main([*given, str(tmp_path / "c"), "--max-disparity", str(ADVISED)]) == 0
    tables = {(tmp_path / name / "steering.csv").read_bytes() for name in "abc"}
    assert [number_in(tmp_path / name) for name in "abc"] == [ADVISED] * 3
    assert len(tables) == 1


def test_a_run_goes_on_with_the_number_it_was_begun_with(recording, tmp_path, capsys):
    given = ["run", *recording, "--save", "steering", "-o", str(tmp_path / "o"), "--resume"]
    assert main([*given, "--max-disparity", "32"]) == 0
    assert main([*given, "--max-disparity", "auto"]) == 0
    assert "is complete already" in capsys.readouterr().err
    assert main([*given, "--max-disparity", "40"]) == 1


def test_what_cannot_be_measured_is_said(tmp_path, capsys):
    blank = [np.full((48, 64), 90, np.uint8)] * 3
    left = encode(tmp_path / "l.mkv", blank, "ffv1", "gray", 2)
    right = encode(tmp_path / "r.mkv", blank, "ffv1", "gray", 2)
    given = ["run", str(left), str(right), "--max-disparity", "auto", "--save", "steering"]
    assert main([*given, "-o", str(tmp_path / "o")]) == 0
    assert "too few to measure: 64 is taken" in capsys.readouterr().err
    assert number_in(tmp_path / "o") == Settings().max_disparity


def test_a_pipe_is_measured_in_its_first_frames_and_none_is_lost(recording, tmp_path):
    fifo = tmp_path / "left"
    os.mkfifo(fifo)
    threading.Thread(target=lambda: fifo.write_bytes(Path(recording[0]).read_bytes())).start()
    plan = RunPlan(str(fifo), recording[1], tmp_path / "o", settings=Settings(max_disparity="auto"))
    said = []
    report = run(plan, Watcher(lambda _, text: said.append(text)))
    assert report.frames == 40
    assert number_in(tmp_path / "o") == ADVISED
    assert "in 16 frames" in " ".join(said)
    with pytest.raises(SettingsError, match="cannot read a pipe again"):
        RunPlan(str(fifo), recording[1], resume=True)


def test_a_plan_gets_its_number_and_process_wants_one(recording):
    plan = RunPlan(*recording, settings=Settings(max_disparity=0))
    assert with_range(plan, print).settings.max_disparity == ADVISED
    assert RunPlan.of_json(plan.as_json()) == plan
    with pytest.raises(SettingsError, match="give a number"):
        list(process([], plan.settings))
