"""The installed command on sample_data: what a user would run first."""

import csv
import subprocess
import sys
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from motionstereo_cli.evaluation.compare import compare
from motionstereo_cli.evaluation.compare_report import format_table
from motionstereo_cli.evaluation.figure import titles_of

SAMPLE = Path(__file__).parent.parent / "sample_data"
COMMAND = Path(sys.executable).with_name("motionstereo")


def motionstereo(*arguments):
    return subprocess.run(
        [COMMAND, *map(str, arguments)], capture_output=True, text=True, timeout=120, check=False
    )


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    out = tmp_path_factory.mktemp("sample") / "out"
    done = motionstereo(
        *("run", SAMPLE / "left.mp4", SAMPLE / "right.mp4", "--rig", SAMPLE / "rig.yaml"),
        *("--save", "steering,depth,disparity,charge,depth-video", "-o", out),
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""
    assert "100 frames" in done.stderr
    assert str(out) in done.stderr
    return out


def rows(path):
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_the_results_are_the_expected_ones(out):
    assert '"timing"' not in (SAMPLE / "golden/run.json").read_text(), "it differs each time"
    report = compare(out, SAMPLE / "golden")
    compared = {output.name: output.compared for output in report.outputs}
    assert format_table(report).startswith("no difference")
    assert (compared["steering.csv"], compared["depth/"], compared["disparity/"]) == (100, 3, 2)


def test_steers_left_into_the_turn_and_straight_after_it(out):
    steer = [float(row["steer"]) for row in rows(out / "steering.csv")[1:]]
    assert max(np.abs(steer[14:30])) < 0.1
    assert min(steer[49:60]) > 0.25
    assert max(steer[49:60]) > 0.7
    assert max(np.abs(steer[79:])) < 0.1


def test_depth_images_and_videos_are_whole(out):
    images = sorted((out / "depth").iterdir())
    assert [path.name for path in images] == [f"{n:06d}.png" for n in range(100)]
    depth_mm = cv2.imread(str(images[60]), cv2.IMREAD_UNCHANGED)
    assert depth_mm.dtype == np.uint16
    assert depth_mm.shape == (240, 320)
    assert 1500 < np.median(depth_mm[depth_mm > 0]) < 15000
    for name in ("charge.mp4", "depth.mp4"):
        with av.open(str(out / name)) as video:
            stream = video.streams.video[0]
            assert (stream.codec_context.name, stream.pix_fmt) == ("h264", "yuv420p")
            assert sum(1 for _ in video.decode(stream)) == 100
    assert not list(out.rglob("*.part"))


def test_figure_makes_a_row_a_frame(tmp_path):
    sheet = tmp_path / "sheet.png"
    videos = (SAMPLE / "left.mp4", SAMPLE / "right.mp4")
    done = motionstereo("figure", *videos, "--frames", "3,20", "-o", sheet)
    assert done.returncode == 0, done.stderr
    picture = cv2.imread(str(sheet), cv2.IMREAD_GRAYSCALE)
    assert picture.shape == (24 + 2 * 244, 56 + 4 * 324)
    right, bands, memory, depth = (
        picture[26 + 244 : 266 + 244, 58 + i * 324 :][:, :320] for i in range(4)
    )
    assert len(np.unique(right)) > 100
    assert set(np.unique(bands)) <= {band * 255 // 7 for band in range(8)}
    assert set(np.unique(memory)) <= {0, *range(15, 256, 16)}
    assert 0.2 < (depth > 0).mean() < 0.6
    assert (depth > 0)[memory == 0].mean() == 0


@pytest.mark.parametrize(("in_metres", "name"), [(True, "depth"), (False, "disparity")])
def test_without_a_rig_the_figure_has_disparity(in_metres, name):
    titles = titles_of("left", in_metres=in_metres)
    assert titles[::3] == ["(a) left image", f"(d) {name}, near = bright"]


@pytest.mark.parametrize(
    ("frames", "exit_code", "words"),
    [("3,x", 2, "--frames"), ("-3", 2, "--frames"), ("3,100", 1, "no frame 100")],
)
def test_figure_says_what_is_wrong_with_the_frames(tmp_path, frames, exit_code, words):
    videos = (SAMPLE / "left.mp4", SAMPLE / "right.mp4")
    done = motionstereo("figure", *videos, f"--frames={frames}", "-o", tmp_path / "sheet.png")
    assert done.returncode == exit_code
    assert words in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not list(tmp_path.iterdir())
