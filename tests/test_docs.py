"""Every command that is printed works: those of the documentation, and those of reports."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from bags import Bag
from recordings import encode, folder

from motionstereo_cli.__main__ import main
from motionstereo_cli.commands import cli
from motionstereo_cli.report.words import command
from motionstereo_cli.sinks.read_back import read_record
from motionstereo_cli.types import Rig

ROOT = Path(__file__).parent.parent
SAMPLE = ROOT / "sample_data"
PAGES = [ROOT / "README.md", *sorted((ROOT / "motionstereo_cli/docs").glob("*.md"))]

#: What is not tried: installing, and what needs other machines or programs.
ELSEWHERE = re.compile(
    r"^(pip|pipx|uv|uvx|docker|dask|make|ffmpeg|eval|_MOTION\w*)\b|HOST:|SLURM_|onnx:|s3:|complete"
)

#: The size of all recordings here, in px: a quarter of the sample's.
WIDTH, HEIGHT = 80, 60
SMALL = ["--width", f"{WIDTH}", "--height", f"{HEIGHT}"]
PAIR = ["left.mp4", "right.mp4"]
#: What commands are given here besides, so that they are done soon.
SHORTER = {
    "simulate": SMALL,
    "drive": [*SMALL, "--max-frames", "20"],
    "batch": ["--workers", "1"],
}


def commands(path):
    """Return the commands of a page's code blocks, which read like those of a shell."""
    text = path.read_text(encoding="utf-8").replace("\\\n", " ")
    blocks = re.findall(r"^```(\w*)\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    codes = [code for language, code in blocks if language in ("", "sh", "bash")]
    lines = [line for code in codes for line in code.splitlines() if "motionstereo " in line]
    return [line for line in lines if not ELSEWHERE.search(line)]


def images_of(path):
    with av.open(str(path)) as video:
        images = [frame.to_ndarray(format="gray") for frame in video.decode(video=0)]
    return [cv2.resize(each, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA) for each in images]


@pytest.fixture(scope="module")
def yours(tmp_path_factory):
    """The sample, smaller, and the files that the pages say are yours."""
    home = tmp_path_factory.mktemp("yours")
    views = [images_of(SAMPLE / f"{side}.mp4") for side in ("left", "right")]
    for side, images in zip(("left", "right"), views, strict=True):
        encode(home / f"{side}.mp4", images, "libx264", "yuv420p")
        folder(home / side, images[:12], ".png", "{:06d}")
    both = [np.hstack(pair) for pair in zip(*views, strict=True)]
    encode(home / "both.mp4", both, "libx264", "yuv420p")
    focal_px, baseline_m = 278.4 * WIDTH / 320, 0.12
    (home / "rig.yaml").write_text(
        f"width: {WIDTH}\nheight: {HEIGHT}\nfocal_px: {focal_px}\nbaseline_m: {baseline_m}\n"
        f"cx: {WIDTH / 2 - 0.5}\ncy: {HEIGHT / 2 - 0.5}\n"
    )
    opencv(home / "stereo.yml", focal_px, (WIDTH, HEIGHT))
    opencv(home / "calibration.yaml", 1000, (1280, 1024))
    sequence = home / "kitti/sequences/00"
    sequence.mkdir(parents=True)
    for number, images in enumerate(views):
        folder(sequence / f"image_{number}", images[:12], ".png", "{:06d}")
    matrix = f"{focal_px} 0 {WIDTH / 2} 0 0 {focal_px} {HEIGHT / 2} 0 0 0 1 0"
    right = matrix.split()
    right[3] = f"{-focal_px * baseline_m}"
    (sequence / "calib.txt").write_text(f"P0: {matrix}\nP1: {' '.join(right)}\n")
    (sequence / "times.txt").write_text("".join(f"{0.1 * n:e}\n" for n in range(12)))
    (home / "poses.txt").write_text(
        "".join(f"{n / 30:.6f} {n / 60} 0 0.3 0 0 0 1\n" for n in range(len(both)))
    )
    with Bag(home / "drive_bag", ".mcap") as bag:
        rig = Rig(WIDTH, HEIGHT, focal_px, baseline_m, WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5)
        for side, images in zip(("left", "right"), views, strict=True):
            for n, image in enumerate(images[:12]):
                bag.image(f"/cam/{side}/image_raw", image, 10**9 + n * 10**8)
            bag.camera_info(f"/cam/{side}/camera_info", rig, 10**9, right=side == "right")
    for name in ("one", "two"):
        for side in ("left", "right"):
            (home / "archive" / name).mkdir(parents=True, exist_ok=True)
            shutil.copy(home / f"{side}.mp4", home / "archive" / name)
    (home / "recordings.csv").write_text("left,right,out,rig\nleft.mp4,right.mp4,a,rig.yaml\n")
    shutil.copy(ROOT / "motionstereo_cli/simulate/worlds/office.toml", home / "my-office.toml")
    pair = [str(home / "left.mp4"), str(home / "right.mp4"), "--rig", str(home / "rig.yaml")]
    save = ["--save", "steering,depth,disparity", "-o", str(home / "golden")]
    assert main(["run", *pair, *save]) == 0
    shutil.copytree(home / "golden/disparity", home / "maps")
    return home


def opencv(path, focal_px, size):
    """Write a calibration of OpenCV without distortion, 0.12 m between the cameras."""
    camera = np.array([[focal_px, 0, size[0] / 2], [0, focal_px, size[1] / 2], [0, 0, 1]])
    values = {"K1": camera, "D1": np.zeros(5), "K2": camera, "D2": np.zeros(5)}
    values |= {"R": np.eye(3), "T": np.array([-0.12, 0, 0])}
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", size[0])
    storage.write("image_height", size[1])
    for name, value in values.items():
        storage.write(name, np.asarray(value, np.float64))
    storage.release()


@pytest.mark.parametrize("path", [*filter(commands, PAGES)], ids=lambda path: path.name)
def test_the_commands_of_a_page_work_in_order(yours, tmp_path, path, monkeypatch, capfd):
    monkeypatch.chdir(shutil.copytree(yours, tmp_path / "sample_data"))
    assert_they_work(commands(path), capfd)


def test_a_bag_is_made_of_two_videos_and_read(yours, tmp_path, monkeypatch, capsys):
    (made,) = re.findall(
        r"^```python\n(.*?)^```",
        (ROOT / "motionstereo_cli/docs/input.md").read_text(),
        re.MULTILINE | re.DOTALL,
    )
    monkeypatch.chdir(
        shutil.copytree(yours, tmp_path / "sample_data", ignore=shutil.ignore_patterns("drive_bag"))
    )
    exec(made, {})
    assert main(["run", "drive_bag", "--rig", "rig.yaml", "--end", "20", "-o", "out"]) == 0
    assert "20 frames in" in capsys.readouterr().err


@pytest.mark.parametrize("name", [name for name in cli.commands if name != "help"])
def test_the_examples_of_a_commands_help_work(yours, tmp_path, name, monkeypatch, capfd):
    examples = cli.commands[name].examples
    assert any(line.startswith(f"motionstereo {name} ") for line in examples)
    assert max(map(len, examples)) <= 78, "a terminal of 80 columns would break it"
    monkeypatch.chdir(shutil.copytree(yours, tmp_path / "sample_data"))
    assert_they_work(examples, capfd)


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        ([*PAIR], "nowhere: give --rig for results in m"),
        ([*PAIR, "--rig", "stereo.yml"], "stereo.yml (OpenCV)"),
        (
            ["kitti/sequences/00"],
            "kitti/sequences/00/calib.txt (KITTI, found beside the recording)",
        ),
    ],
    ids=["none", "given", "found"],
)
def test_info_says_where_the_rig_comes_from(yours, monkeypatch, capsys, given, wanted):
    monkeypatch.chdir(yours)
    assert main(["info", *given]) == 0
    assert re.search(r"^rig from +(.+)$", capsys.readouterr().out, re.MULTILINE)[1].endswith(wanted)


def assert_they_work(lines, capfd):
    failed = []
    for line in lines:
        words = shlex.split(line, comments=True)
        if "|" in words:
            shell = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
            done = subprocess.run(
                ["bash", "-c", f"set -o pipefail; {line}"], env=shell, check=False
            )
            code = done.returncode
        else:
            assert words[0] == "motionstereo"
            if words[1] == "simulate" and not re.search(r"--frames \d+:", line):
                words += ["--frames", "20"]
            code = main([*words[1:], *SHORTER.get(words[1], [])])
        if code:
            failed.append("\n".join([line, *capfd.readouterr()]))
    assert not failed, "\n".join(failed)


@pytest.mark.parametrize(
    "given",
    [
        [*PAIR, "--rig", "rig.yaml", "--reference", "left", "--save", "steering,depth-video"],
        ["right.mp4", "left.mp4", "--swap", "--no-check", "--save", "steering,preview"],
        ["both.mp4", "--layout", "side-by-side", "--near-px", "9"],
        ["left", "right", "--scale", "0.5", "--colours", "turbo"],
        ["left/*.png", "right/*.png", "--preset", "paper", "--no-legend"],
        ["kitti/sequences/00", "--matcher", "sgbm"],
        [*PAIR, "--rig", "stereo.yml", "--crop", "8,4,64,48", "--start", "3", "--end", "9"],
        [*PAIR, "--rig", "rig.yaml", "--poses", "poses.txt", "--save", "steering,map"],
        [*PAIR, "--rig", "rig.yaml", "--poses", "auto", "--save", "poses,objects"],
        [*PAIR, "--rig", "rig.yaml", "--disparity", "maps", "--max-disparity", "auto"],
        [*PAIR, "--rig", "rig.yaml", "--config", "run.toml"],
        [*PAIR, "--rig", "stereo.yml", "--fov", "60", "--every", "2"],
    ],
    ids=" ".join,
)
def test_run_it_again_gives_the_same(yours, tmp_path, monkeypatch, given):
    home = shutil.copytree(yours, tmp_path / "some where")
    monkeypatch.chdir(home)
    Path("run.toml").write_text('bands = 6\nswap = false\nlegend = false\nstart = "2"\n')
    ends = [] if "--end" in given else ["--end", "12"]
    assert main(["run", *given, *ends, "-o", "once"]) == 0
    record = read_record(home / "once/run.json")
    words = shlex.split(command(record))
    assert words[0] == "motionstereo"
    assert main([*words[1:], "-o", "again"]) == 0
    again = read_record(home / "again/run.json")
    assert again.sums == record.sums
    assert (again.settings, again.input_settings) == (record.settings, record.input_settings)
    assert again.output_settings == record.output_settings


def test_the_page_of_security_names_tests_that_are_there() -> None:
    page = (ROOT / "motionstereo_cli/docs/security.md").read_text()
    rows = re.findall(r"^\| .* \| ([a-z_, ]+) \|$", page, re.MULTILINE)
    assert len(rows) > 10
    for name in {name for row in rows[1:] for name in row.split(", ")}:
        assert (ROOT / f"tests/test_{name}.py").is_file(), name
