"""Damaged and hostile text files: every reader gives a result or says what is wrong, in one line.

The suite tries each reader a hundred times; `make fuzz` goes on for 10 minutes each. Seeds count
from 0 and are printed, so that a failure comes again.
"""

import contextlib
import io
import itertools
import math
import re
import time

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st
from test_calibration import (
    KITTI,
    MIDDLEBURY,
    SIZE,
    euroc_files,
    fisheye_file,
    opencv_file,
    ros_files,
)
from test_calibration_formats import (
    depthai,
    kalibr,
    nested_json,
    nested_parts,
    npz,
    orb_slam_2,
    orb_slam_3,
    zed,
)
from test_compare import RECORD, STEERING, written
from test_rig import VALUES, rig_file

from motionstereo_cli.__main__ import main
from motionstereo_cli.errors import MotionStereoError
from motionstereo_cli.evaluation.compare import compare
from motionstereo_cli.evaluation.evaluate import Comparison
from motionstereo_cli.rig import format_rig, read_rig
from motionstereo_cli.rig.calibration import read_calibration
from motionstereo_cli.rig.poses import read_poses
from motionstereo_cli.runs.folder import prepare
from motionstereo_cli.sinks.read_back import Maps, Table
from motionstereo_cli.sources.folder import FolderRecording
from motionstereo_cli.types import Rig

#: A warning of NumPy's would be talk that no user can follow.
pytestmark = pytest.mark.filterwarnings("error")

#: What is put in place of a word: numbers that are none or out of range, and marks of the formats.
NASTY = [
    *(b"nan", b"-inf", b"0", b"-1", b"-0.0", b"1e308", b"1e-320", b"1e999", b"0.5", b"2", b"1_0"),
    *(b"3" * 20, b"9" * 5000, b"1" + b"0" * 400, b"0x1p3", "\u0663".encode(), b"true", b"null"),
    *(b"", b"\0", b"\r", b"\n", b"\xff\xfe", b"\xed\xa0\x80", b"\x1b[31m", b"\xef\xbb\xbf"),
    *(b"[", b"]", b"{", b"}", b"<", b">", b"<!--", b":", b"=", b",", b"-", b'"', b"'", b"#", b"|"),
    *(b"[" * 3000, b'{"a":' * 3000, b"&a [*a]", b"!!python/object/apply:os.system", b"<<: *a"),
]


@st.composite
def damaged(draw, samples):
    """Any bytes, or a sample with some of its words replaced, lost, repeated or exchanged."""
    if draw(st.integers(0, 9)) == 0:
        return draw(st.binary(max_size=200))
    words = re.findall(rb"[\w.+-]+|\s+|[^\w\s]", draw(st.sampled_from(samples)))
    places = st.integers(0, len(words) - 1)
    for _ in range(draw(st.integers(1, 4))):
        place = draw(places)
        match draw(st.integers(0, 5)):
            case 0:
                words[place] = draw(st.binary(max_size=6))
            case 1:
                words[place] *= draw(st.integers(2, 5))
            case 2:
                words[place] = words[draw(places)]
            case 3:
                end = draw(places)
                words[place:end] = [b""] * (end - place)  # the number of words stays
            case _:
                words[place] = draw(st.sampled_from(NASTY))
    return b"".join(words)


@pytest.fixture
def fuzz(request):
    """Return what tries a check on former finds, and then a hundred examples.

    If the command line says so, on a hundred more, until its time is over.
    """

    def run(strategy, check, finds=()):
        for content in finds:
            check(content)
        ends = time.monotonic() + request.config.getoption("--fuzz-seconds")
        for number in itertools.count():
            print(f"seed {number}")
            tried = given(strategy)(check)
            limits = settings(
                max_examples=100,
                deadline=None,
                database=None,
                suppress_health_check=list(HealthCheck),
            )
            seed(number)(limits(tried))()
            if time.monotonic() >= ends:
                break

    return run


def result_of(read, *args, **options):
    """Return what a reader gives, or None where it says in one line what is wrong."""
    try:
        return read(*args, **options)
    except MotionStereoError as error:
        message = str(error)
    assert 10 < len(message) < 1000
    return None


def test_rig_files(fuzz, tmp_path):
    path = rig_file(tmp_path, doffs="-3.5")
    samples = [path.read_bytes(), b"\xef\xbb\xbf%YAML:1.0\r\n---\r\n" + path.read_bytes()]

    def check(content):
        path.write_bytes(content)
        rig = result_of(read_rig, path)
        if rig is not None:
            assert all(math.isfinite(getattr(rig, name)) for name in VALUES)
            path.write_text(format_rig(rig))
            assert read_rig(path) == rig

    fuzz(damaged(samples), check)


def test_calibration_files(fuzz, tmp_path):
    files = [opencv_file(tmp_path / f"rig.{suffix}") for suffix in ("yml", "xml", "json")]
    files += [fisheye_file(tmp_path / "fisheye.yml"), rig_file(tmp_path)]
    files.append(opencv_file(tmp_path / "sized.yml", image_width=320.0, image_height=240.0))
    samples = [path.read_bytes() for path in files] + [KITTI.encode(), MIDDLEBURY.encode()]
    path = tmp_path / "calibration"

    def check(content):
        path.write_bytes(content)
        for size in (SIZE, None):
            check_calibration(result_of(read_calibration, [path], size))

    sized = files[-1].read_bytes()
    assert b"320." in sized
    finds = [sized.replace(b"320.", size) for size in (b"1e999", b"2e9", b"1e6")]
    finds += [samples[0].replace(b"rows: 3", b"rows: 1e999"), sized.replace(b"258.", b"1e-320")]
    fuzz(damaged(samples), check, finds)


def test_calibration_files_of_other_programs(fuzz, tmp_path):
    writers = [kalibr, orb_slam_2, orb_slam_3, depthai, zed, nested_json, nested_parts, npz]
    samples = [write(tmp_path).read_bytes() for write in writers]
    path = tmp_path / "calibration"

    def check(content):
        path.write_bytes(content)
        check_calibration(result_of(read_calibration, [path], SIZE))

    fuzz(damaged(samples), check)


def test_pairs_of_calibration_files(fuzz, tmp_path):
    pairs = [euroc_files(tmp_path), ros_files(tmp_path)]
    samples = [(left.read_bytes(), right.read_bytes()) for left, right in pairs]
    paths = [tmp_path / "one", tmp_path / "other"]

    def check(contents):
        for path, content in zip(paths, contents, strict=True):
            path.write_bytes(content)
        check_calibration(result_of(read_calibration, paths))

    spoilt = st.one_of(
        *(st.tuples(damaged([left]), st.just(right)) for left, right in samples),
        *(st.tuples(st.just(left), damaged([right])) for left, right in samples),
    )
    left, right = samples[0]
    assert b"0.0, 0.0, 0.0, 1.0]" in right
    fuzz(spoilt, check, [(left, right.replace(b"0.0, 0.0, 0.0, 1.0]", b"0, 0, 0, 0]"))])


def check_calibration(calibration):
    if calibration is not None:
        rig = calibration.rig
        assert math.isfinite(rig.cx + rig.cy + rig.doffs)
        assert 0 < rig.focal_px < math.inf
        assert 0 < rig.baseline_m < math.inf
        assert calibration.describe()


def test_poses(fuzz, tmp_path):
    path, rig = tmp_path / "poses.txt", Rig(64, 48, 50.0, 0.1, 32.0, 24.0)
    turns = [(math.sin(t), math.cos(t)) for t in range(5)]
    tum = [f"{t / 10} {t} -0.5 1.2 0 0 {sin} {cos}" for t, (sin, cos) in enumerate(turns)]
    euroc = [f"{t}00000000,{t},0,1.2,{cos},0,0,{sin},0" for t, (sin, cos) in enumerate(turns)]
    kitti = [f"{cos} {-sin} 0 {t} {sin} {cos} 0 0 0 0 1 0" for t, (sin, cos) in enumerate(turns)]
    heads = "# poses", "#timestamp, x [m], y [m], z [m], q_w, q_x, q_y, q_z, v", ""
    samples = zip(heads, (tum, euroc, kitti), strict=True)

    def check(content):
        path.write_bytes(content)
        trajectory = result_of(read_poses, path, None, rig, np.eye(4))
        if trajectory is not None:
            result_of(trajectory.check_covers, 0.0, 0.3)
            for time_s in (*trajectory.time_s, 0.05, 0.3):
                pose = result_of(trajectory.at, time_s)
                assert pose is None or math.isfinite(pose.yaw_rad)

    fuzz(damaged(["\n".join([head, *lines]).encode() for head, lines in samples]), check)


CONFIG = b"""max-disparity = 96
blur_px = 0.5
preset = "paper"
save = ["steering", "depth"]
check = false
overwrite = true
crop = "0,0,64,48"
start = "0:12.5"
matcher = "trails" # or regions
rig = ["a.yaml", "b.yaml"]
"""
COMPARE_CONFIG = b"""tolerance = ["steer=0.02", "depth_m=1"]
max-differing = 0.1
junit = "out.xml"
"""


@pytest.mark.parametrize(
    ("command", "sample"), [("run", CONFIG), ("compare", COMPARE_CONFIG)], ids=["run", "compare"]
)
def test_configuration_files(fuzz, tmp_path, monkeypatch, command, sample):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "config.toml"

    def check(content):
        path.write_bytes(content)
        with contextlib.redirect_stderr(io.StringIO()) as talk:
            exit_code = main([command, "nowhere.mp4", "nor_here.mp4", "--config", str(path)])
        assert exit_code in (1, 2)
        assert talk.getvalue().startswith("error: ")
        assert "internal: " not in talk.getvalue()
        assert talk.getvalue().count("\n") == 1

    finds = [b"max-disparity = 1" + b"0" * 400, b"tolerance = " + b"[" * 3000]
    fuzz(damaged([sample]), check, finds)


def test_tables(fuzz, tmp_path):
    path = tmp_path / "steering.csv"
    objects = b'frame,id,x,note\n0,1,5,"a ""b"",c"\n0,2,7,\n3,1,-4,\n'

    def check(content):
        path.write_bytes(content)
        table = result_of(Table, path)
        if table is not None:
            frames = result_of(lambda: list(table.by_frame())) or []
            assert all(tuple(row) == table.columns for _, rows in frames for row in rows.values())

    fuzz(damaged([STEERING.encode(), objects]), check)


def test_time_stamps_of_images(fuzz, tmp_path):
    (tmp_path / "data").mkdir()
    stamps = [1403636579763555584 + 50_000_000 * number for number in range(3)]
    for stamp in stamps:
        assert cv2.imwrite(str(tmp_path / f"data/{stamp}.png"), np.zeros((4, 4), np.uint8))
    sample = "#timestamp [ns],filename\r\n" + "".join(f"{s},{s}.png\r\n" for s in stamps)

    def check(content):
        (tmp_path / "data.csv").write_bytes(content)
        stream = result_of(FolderRecording, tmp_path / "data")
        if stream is not None:
            result_of(lambda: [(image.pts, stream.time_base) for image in stream])

    finds = [b"1" + b"0" * 400 + b",a.png", b"9" * 5000 + b",a.png"]
    fuzz(damaged([sample.encode()]), check, [sample.encode() + find for find in finds])


def test_records_of_runs(fuzz, tmp_path):
    actual, golden = written(tmp_path / "actual"), written(tmp_path / "golden")
    sample = (golden / "run.json").read_bytes()
    assert RECORD["program"].encode() in sample
    out = tmp_path / "out"
    out.mkdir()

    def check(content):
        (actual / "run.json").write_bytes(content)
        assert result_of(compare, actual, golden) is not None  # unreadable is a difference
        result_of(lambda: Comparison(Maps(actual), Maps(golden)).pair(0))
        (out / "run.json").write_bytes(content)
        result_of(prepare, out, ["steering"], overwrite=True)

    fuzz(damaged([sample]), check, [b"[" * 3000, b"{" + b'"a": {' * 3000])
