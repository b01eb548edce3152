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


def ends_in(out):
    said = json.loads((out / "run.json").read_text())["output_settings"]
    return [said[name] for name in ("near_m", "far_m", "near_px", "far_px")]


def test_the_ends_of_the_depth_colours_are_measured_and_kept(recording, tmp_path, capsys):
    given = ["run", *recording, "--save", "depth-video", "--jobs", "1", "-o"]
    assert main([*given, str(tmp_path / "a")]) == 0
    near_m, far_m, near_px, far_px = ends_in(tmp_path / "a")
    assert [near_m, far_m] == [0, 0]
    assert far_px < DISPARITY < near_px <= 4 * far_px
    again = ["--near-px", f"{near_px}", "--far-px", f"{far_px}"]
    assert main([*given, str(tmp_path / "b"), *again]) == 0
    videos = {(tmp_path / name / "depth.mp4").read_bytes() for name in "ab"}
    assert len(videos) == 1
    assert main([*given, str(tmp_path / "a"), "--resume"]) == 0
    assert "is complete already" in capsys.readouterr().err
    assert main([*given, str(tmp_path / "a"), "--resume", "--colours", "turbo"]) == 1


@pytest.mark.parametrize(
    ("given", "ends"),
    [
        (["--near-m", "1"], [1, 2]),
        (["--far-m", "0.05"], [0.025, 0.05]),
        (["--near-m", "2", "--far-m", "5"], [2, 5]),
    ],
)
def test_given_ends_of_the_depth_colours_stay(recording, tmp_path, given, ends):
    rig = tmp_path / "rig.yaml"
    rig.write_text("width: 160\nheight: 96\nfocal_px: 36\nbaseline_m: 0.2\ncx: 80\ncy: 48\n")
    args = ["run", *recording, "--rig", str(rig), "--save", "depth-video", "-o"]
    assert main([*args, str(tmp_path / "o"), *given]) == 0
    assert ends_in(tmp_path / "o") == [*ends, 0, 0]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("--near-px 3", "not --near-px\n"),
        ("--far-px 3", "not --far-px\n"),
        ("--near-px 9 --far-px 3", "not --near-px and --far-px\n"),
    ],
)
def test_ends_in_px_are_not_those_of_a_rig(recording, tmp_path, capsys, given, said):
    rig = tmp_path / "rig.yaml"
    rig.write_text("width: 160\nheight: 96\nfocal_px: 36\nbaseline_m: 0.2\ncx: 80\ncy: 48\n")
    args = ["run", *recording, "--rig", str(rig), "-o", str(tmp_path / "o"), *given.split()]
    assert main(args) == 2
    assert said in capsys.readouterr().err


def test_the_colours_of_a_pipe_are_those_of_its_first_frames(recording, tmp_path):
    fifo = tmp_path / "left"
    os.mkfifo(fifo)
    threading.Thread(target=lambda: fifo.write_bytes(Path(recording[0]).read_bytes())).start()
    report = run(RunPlan(str(fifo), recording[1], tmp_path / "o", save=("depth-video",)))
    assert report.frames == 40
    *_, near_px, far_px = ends_in(tmp_path / "o")
    assert far_px < DISPARITY < near_px


def test_what_nobody_sees_in_colour_is_not_measured(recording, tmp_path):
    assert main(["run", *recording, "--save", "steering", "-o", str(tmp_path / "o")]) == 0
    assert ends_in(tmp_path / "o") == [0] * 4
