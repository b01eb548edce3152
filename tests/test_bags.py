"""ROS bags: found, read and paired as the images that were put into them."""

import dataclasses
import html
import json
import re
import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest
from bags import Bag

from motionstereo_cli.__main__ import main
from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.report.run_page import run_page
from motionstereo_cli.rig.calibration import rectify_source
from motionstereo_cli.sources import open_stereo
from motionstereo_cli.sources.bag import BagRecording
from motionstereo_cli.sources.bag_topics import bags_in, stereo_topics
from motionstereo_cli.sources.settings import InputSettings
from motionstereo_cli.types import Rig

KINDS = (".bag", ".db3", ".mcap")
RIG = Rig(width=64, height=48, focal_px=50.0, baseline_m=0.1, cx=31.5, cy=23.5)
PERIOD_NS = 10**8


def greys(count=6):
    """Left and right images: a texture that moves 2 px a frame, 4 px apart."""
    texture = np.random.default_rng(0).integers(0, 256, (48, 120), np.uint8)
    return [
        (texture[:, 2 * n : 2 * n + 64], texture[:, 2 * n + 4 : 2 * n + 68]) for n in range(count)
    ]


def written(folder: Path, kind: str, *, left="/cam/left/image_raw", right="/cam/right/image_raw"):
    path = folder / ("drive.bag" if kind == ".bag" else "drive")
    with Bag(path, kind) as bag:
        for n, pair in enumerate(greys()):
            stamp_ns = 5 * 10**9 + n * PERIOD_NS
            for side, topic, grey in zip(("left", "right"), (left, right), pair, strict=True):
                bag.image(topic, grey, stamp_ns + (n % 3) * 10**5, padding=5)
                info = f"{topic.rpartition('/')[0]}/camera_info"
                bag.camera_info(info, RIG, stamp_ns, right=side == "right")
    return path


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_gives_the_images_and_times_put_into_it(tmp_path, kind):
    path = written(tmp_path, kind)
    with open_stereo(path) as source:
        assert source.expected_frames == 6
        frames = list(source)
        assert not source.damage
    for frame, (left, right) in zip(frames, greys(), strict=True):
        np.testing.assert_array_equal(frame.left, left)
        np.testing.assert_array_equal(frame.right, right)
    assert frames[1].pts == 5 * 10**9 + PERIOD_NS + 10**5
    assert frames[1].time_s == pytest.approx(5.1001)


@pytest.mark.parametrize("kind", [".db3", ".mcap"])
def test_the_file_in_the_folder_is_a_bag_too(tmp_path, kind):
    (file,) = written(tmp_path, kind).glob(f"*{kind}")
    assert bags_in(file) == (file,)
    with open_stereo(file) as source:
        assert len(list(source)) == 6


@pytest.mark.parametrize("kind", KINDS)
def test_the_calibration_in_a_bag_is_that_of_the_run(tmp_path, kind):
    with open_stereo(written(tmp_path, kind)) as source:
        calibration = rectify_source(source, ())
        assert calibration is not None
        rig = calibration.rig
    assert (rig.focal_px, rig.baseline_m, rig.cx, rig.cy) == pytest.approx((50, 0.1, 31.5, 23.5))


@pytest.mark.parametrize(
    ("names", "found"),
    [
        (["/left/image_raw", "/right/image_raw"], ("/left/image_raw", "/right/image_raw")),
        (["/infra1/image_rect_raw", "/infra2/image_rect_raw"], None),
        (["/cam0/image", "/cam1/image"], None),
        (["/left/image_raw", "/right/image_raw", "/left/image_rect", "/right/image_rect"], "rect"),
    ],
)
def test_left_and_right_are_found_by_name(tmp_path, names, found):
    path = tmp_path / "a.bag"
    with Bag(path, ".bag") as bag:
        for name in names:
            bag.image(name, greys()[0][0], 10**9)
    left, right = stereo_topics([path])
    if found == "rect":
        assert (left, right) == ("/left/image_rect", "/right/image_rect")
    else:
        assert [left, right] == names


def test_where_names_do_not_tell_the_topics_are_listed_and_can_be_given(tmp_path):
    path = tmp_path / "a.bag"
    with Bag(path, ".bag") as bag:
        for n in range(2):
            for name in ("/front/image", "/back/image"):
                bag.image(name, greys()[0][0], 10**9 + n * PERIOD_NS)
    with pytest.raises(InputError, match=r"--topics LEFT,RIGHT.*/back/image \(64x48 px, mono8, 2 "):
        stereo_topics([path])
    with open_stereo(path, settings=InputSettings(topics="/front/image,/back/image")) as source:
        assert source.describe()["left"]["topic"] == "/front/image"
        assert len(list(source)) == 2
    with pytest.raises(SettingsError, match="give two topics"):
        stereo_topics([path], "/front/image,/side/image")
    folders = [tmp_path / "left", tmp_path / "right"]
    for folder in folders:
        folder.mkdir()
    with pytest.raises(SettingsError, match="is none"):
        open_stereo(*folders, InputSettings(topics="/a,/b"))


COLOUR = np.random.default_rng(1).integers(0, 256, (48, 64, 3), np.uint8)
RGB_LUMA = cv2.cvtColor(COLOUR, cv2.COLOR_RGB2GRAY)
GREY = COLOUR[:, :, 0]
OPAQUE = np.full((48, 64, 1), 255, np.uint8)


@pytest.mark.parametrize(
    ("encoding", "pixels", "grey"),
    [
        ("mono8", GREY, GREY),
        ("mono16", GREY.astype(np.uint16) * 257, GREY),
        ("rgb8", COLOUR, RGB_LUMA),
        ("bgr8", COLOUR[:, :, ::-1], RGB_LUMA),
        ("rgba8", np.dstack([COLOUR, OPAQUE]), RGB_LUMA),
        ("bgra8", np.dstack([COLOUR[:, :, ::-1], OPAQUE]), RGB_LUMA),
        ("yuv422", np.dstack([np.full_like(GREY, 128), GREY]), GREY),
        ("yuv422_yuy2", np.dstack([GREY, np.full_like(GREY, 128)]), GREY),
        ("rgb16", COLOUR.astype(np.uint16) * 257, RGB_LUMA),
        ("bgr16", COLOUR[:, :, ::-1].astype(np.uint16) * 257, RGB_LUMA),
        ("bgra16", np.dstack([COLOUR[:, :, ::-1], OPAQUE]).astype(np.uint16) * 257, RGB_LUMA),
        ("16UC3", COLOUR[:, :, ::-1].astype(np.uint16) * 257, RGB_LUMA),
    ],
)
def test_every_encoding_becomes_grey(tmp_path, encoding, pixels, grey):
    path = tmp_path / "a.bag"
    with Bag(path, ".bag") as bag:
        bag.image("/left", pixels, 10**9, encoding)
    (image,) = BagRecording(path, "/left")
    assert np.abs(image.grey.astype(int) - grey).max() <= pixels.itemsize - 1


@pytest.mark.parametrize("encoding", ["nv12", "nv21"])
def test_luma_in_a_plane_of_its_own_is_grey(tmp_path, encoding):
    path = tmp_path / "a.bag"
    with Bag(path, ".bag") as bag:
        bag.image("/left", GREY, 10**9, encoding, behind=np.zeros(GREY.size // 2, np.uint8))
    (image,) = BagRecording(path, "/left")
    np.testing.assert_array_equal(image.grey, GREY)


@pytest.mark.parametrize("deep", [False, True])
@pytest.mark.parametrize(
    ("encoding", "places"),
    [
        ("bayer_rggb8", {(0, 0): 2, (0, 1): 1, (1, 0): 1, (1, 1): 0}),
        ("bayer_bggr8", {(0, 0): 0, (0, 1): 1, (1, 0): 1, (1, 1): 2}),
        ("bayer_gbrg8", {(0, 0): 1, (0, 1): 0, (1, 0): 2, (1, 1): 1}),
        ("bayer_grbg8", {(0, 0): 1, (0, 1): 2, (1, 0): 0, (1, 1): 1}),
    ],
)
def test_bayer_patterns_are_told_apart(tmp_path, encoding, places, deep):
    """Of a picture of one colour, each pattern gives the luma of that colour."""
    blue, green, red = 30, 90, 220
    pixels = np.zeros((48, 64), np.uint8)
    for (row, column), channel in places.items():
        pixels[row::2, column::2] = (blue, green, red)[channel]
    path = tmp_path / "a.bag"
    with Bag(path, ".bag") as bag:
        if deep:
            pixels = pixels.astype(np.uint16) * 257
        bag.image("/left", pixels, 10**9, encoding.replace("8", "16" if deep else "8"))
    (image,) = BagRecording(path, "/left")
    luma = 0.299 * red + 0.587 * green + 0.114 * blue
    assert np.abs(image.grey[4:-4, 4:-4] - luma).max() < 2


def test_compressed_images_and_ones_that_are_not(tmp_path):
    path = tmp_path / "a.bag"
    content = cv2.imencode(".png", GREY)[1].tobytes()
    with Bag(path, ".bag") as bag:
        for n, data in enumerate((content, b"none", content)):
            bag.compressed("/left/image_raw/compressed", data, 10**9 + n, "png")
    recording = BagRecording(path, "/left/image_raw/compressed")
    assert [image.number for image in recording] == [0, 2]
    assert recording.lost == 1
    assert "1 image could not be read" in recording.damage[0]


def test_an_unknown_encoding_is_named(tmp_path):
    path = tmp_path / "a.bag"
    with Bag(path, ".bag") as bag:
        bag.image("/left", GREY, 10**9, "nv77")
    with pytest.raises(InputError, match="encoding 'nv77'"):
        BagRecording(path, "/left")


def test_without_stamps_the_time_of_recording_counts_and_stamps_that_go_back_are_said(tmp_path):
    path = tmp_path / "a.bag"
    with Bag(path, ".bag") as bag:
        for n in range(3):
            bag.image("/left", GREY, 0, recorded_ns=10**9 + n * PERIOD_NS)
        for stamp in (3, 1, 2):
            bag.image("/right", GREY, stamp * 10**9, recorded_ns=10**9)
    assert [image.pts for image in BagRecording(path, "/left")] == [
        10**9 + n * PERIOD_NS for n in range(3)
    ]
    recording = BagRecording(path, "/right")
    list(recording)
    assert "go back" in recording.damage[0]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("given", ["folder", "pattern", "both"])
def test_the_parts_of_a_split_bag_are_one_recording(tmp_path, kind, given):
    parts = tmp_path / "parts"
    parts.mkdir()
    for part in (0, 1, 2):
        path = tmp_path / f"{part}" if kind != ".bag" else parts / f"a_{part}.bag"
        with Bag(path, kind) as bag:
            for n, pair in list(enumerate(greys()))[2 * part : 2 * part + 2]:
                for side, grey in zip(("left", "right"), pair, strict=True):
                    bag.image(f"/{side}/image_raw", grey, (n + 50) * PERIOD_NS)
        if kind != ".bag":
            (file,) = path.glob(f"*{kind}")
            file.rename(parts / f"a_{part}{kind}")
    names = {
        "folder": [parts],
        "pattern": [f"{parts}/a_*{kind}"],
        "both": [parts / f"a_0{kind}", parts / f"a_1{kind}"],
    }[given]
    count = 4 if given == "both" else 6
    with open_stereo(*names) as source:
        frames = list(source)
        assert source.counts["left"]["paired"] == source.expected_frames == count
        assert len(source.paths) == count // 2
        assert (source.damage, source.warnings) == ([], [])
        assert source.describe()["left"]["bytes"] == sum(p.stat().st_size for p in source.paths)
    assert [frame.pts for frame in frames] == [(n + 50) * PERIOD_NS for n in range(count)]
    for frame, (left, right) in zip(frames, greys(), strict=False):
        np.testing.assert_array_equal((frame.left, frame.right), (left, right))


def test_two_bags_of_one_camera_each_are_left_and_right(tmp_path):
    for side in (0, 1):
        with Bag(tmp_path / f"{side}.bag", ".bag") as bag:
            for n, pair in enumerate(greys()):
                bag.image("/camera/image_raw", pair[side], n * PERIOD_NS + 10**9)
    with open_stereo(tmp_path / "0.bag", tmp_path / "1.bag") as source:
        frames = list(source)
    for frame, (left, right) in zip(frames, greys(), strict=True):
        np.testing.assert_array_equal((frame.left, frame.right), (left, right))


@pytest.mark.parametrize(
    ("frames", "found"),
    [
        (("left_optical", "right_optical"), ("left_optical", "right_optical")),
        (("/cam/optical", "/cam/optical"), ("cam/optical", "")),  # both in the left camera's
    ],
)
def test_the_frames_of_the_images_are_known(tmp_path, frames, found):
    with Bag(tmp_path / "drive.bag", ".bag") as bag:
        for n, pair in enumerate(greys()):
            for side, grey, bag.frame_id in zip(("left", "right"), pair, frames, strict=True):
                bag.image(f"/{side}/image_rect", grey, n * PERIOD_NS + 10**9)
    with open_stereo(tmp_path / "drive.bag") as source:
        assert (source.frame_id("left"), source.frame_id("right")) == found


@pytest.mark.parametrize("begin_s", [0, 12, 1_700_000_000])
def test_clocks_of_topics_that_differ_are_brought_together(tmp_path, begin_s):
    path = tmp_path / "a.bag"
    received_ns = 1_650_000_000 * 10**9
    with Bag(path, ".bag") as bag:
        for n, (left, right) in enumerate(greys()):
            at_ns = received_ns + n * PERIOD_NS
            bag.image("/left/image_raw", left, at_ns, recorded_ns=at_ns)
            if n:  # the right camera begins an image later
                stamp_ns = begin_s * 10**9 + n * PERIOD_NS
                bag.image("/right/image_raw", right, stamp_ns, recorded_ns=at_ns + 10**6 * n)
    with open_stereo(path) as source:
        frames = list(source)
        (warning,) = source.warnings
        ahead_s = float(re.search(r"--sync-shift (\S+);", warning)[1])
        assert ahead_s == pytest.approx(begin_s - 1_650_000_000, abs=0.01)
    assert len(frames) == 5
    np.testing.assert_array_equal(frames[0].left, greys()[1][0])
    np.testing.assert_array_equal(frames[4].right, greys()[5][1])


@pytest.mark.parametrize(
    ("region", "binning"),
    [((0, 0, 0, 0), (2, 2)), ((16, 8, 64, 48), (0, 0)), ((16, 8, 128, 96), (2, 2))],
)
def test_the_calibration_follows_region_and_binning(tmp_path, region, binning):
    whole = Rig(width=128, height=96, focal_px=100, baseline_m=0.1, cx=63.5, cy=47.5)
    whole = whole if not region[0] else dataclasses.replace(whole, width=256, height=192)
    path = tmp_path / "a.bag"
    with Bag(path, ".bag") as bag:
        for side, grey in zip(("left", "right"), greys()[0], strict=True):
            bag.image(f"/{side}/image_rect", grey, 10**9)
            bag.camera_info(
                *(f"/{side}/camera_info", whole, 10**9),
                right=side == "right",
                region=region,
                binning=binning,
            )
    with open_stereo(path) as source:
        calibration = rectify_source(source, ())
    assert calibration is not None
    rig, step = calibration.rig, binning[0] or 1
    assert (rig.width, rig.height) == (64, 48)
    assert rig.focal_px == pytest.approx(100 / step)
    assert rig.baseline_m == pytest.approx(0.1)
    assert rig.cx == pytest.approx((63.5 - region[0] + 0.5) / step - 0.5)
    assert rig.cy == pytest.approx((47.5 - region[1] + 0.5) / step - 0.5)


@pytest.mark.parametrize("kind", KINDS)
def test_a_cut_bag_is_one_line_or_damage(tmp_path, kind, capsys):
    path = written(tmp_path, kind)
    file = path if path.is_file() else next(path.glob(f"*{kind}"))
    content = file.read_bytes()
    file.write_bytes(content[: int(len(content) * 0.6)])
    assert main(["run", str(path), "-o", str(tmp_path / "out"), "--no-check"]) in (1, 3)
    said = capsys.readouterr().err
    assert "internal" not in said
    assert str(path) in said


def test_a_bag_without_images_is_said(tmp_path):
    path = tmp_path / "a.bag"
    with Bag(path, ".bag") as bag:
        bag.camera_info("/camera_info", RIG, 10**9, right=False)
    with pytest.raises(InputError, match=r"no pair of a left and a right camera.*none"):
        open_stereo(path)


def test_a_bag_of_another_writer(tmp_path):
    """mcap_ros2 shares no code with what reads it."""
    from mcap_ros2.writer import Writer

    schema = """std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec"""
    path = tmp_path / "theirs.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        kind = writer.register_msgdef("sensor_msgs/msg/Image", schema)
        for n, pair in enumerate(greys()):
            for side, grey in zip(("left", "right"), pair, strict=True):
                stamp = {"sec": 1, "nanosec": n * PERIOD_NS}
                message = {
                    "header": {"stamp": stamp, "frame_id": ""},
                    "height": 48,
                    "width": 64,
                    "encoding": "mono8",
                    "is_bigendian": 0,
                    "step": 64,
                    "data": np.ascontiguousarray(grey).tobytes(),
                }
                writer.write_message(f"/{side}/image_raw", kind, message, 10**9 + n * PERIOD_NS)
        writer.finish()
    with open_stereo(path) as source:
        frames = list(source)
    np.testing.assert_array_equal(frames[5].left, greys()[5][0])


def test_info_and_run_take_a_bag(tmp_path, capsys):
    path = written(tmp_path, ".mcap")
    assert main(["info", str(path), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["left"]["topic"] == "/cam/left/image_raw"
    assert facts["rig"]["focal_px"] == pytest.approx(50)
    assert facts["rig_from"].startswith("recorded with the images (")
    assert [each["name"] for each in facts["topics"]] == [
        f"/cam/{side}/image_raw" for side in ("left", "right")
    ]
    assert main(["info", str(path)]) == 0
    table = capsys.readouterr().out
    assert "topic /cam/left/image_raw with camera_info" in table
    assert re.search(r"^topics +/cam/left/image_raw \(.+, 6 images, .+ per second\), ", table, re.M)
    assert re.search(r"^rig from +recorded with the images ", table, re.M)
    out = tmp_path / "out"
    assert main(["run", str(path), "-o", str(out), "--save", "steering,depth"]) == 0
    assert (out / "depth/000005.png").exists()
    # The command on its page gives the same again.
    shown = re.search(r'<code id="command">(.*?)</code>', run_page(out, out / "report.html"))[1]
    words = shlex.split(html.unescape(shown))
    assert words.count(str(path)) == 1
    assert main([*words[1:], "-o", str(tmp_path / "again")]) == 0
    assert (tmp_path / "again/steering.csv").read_bytes() == (out / "steering.csv").read_bytes()


def test_what_needs_a_calibration_takes_that_of_a_bag(tmp_path, capsys):
    path, poses = written(tmp_path, ".mcap"), tmp_path / "poses.txt"
    rows = [f"{5 + n * PERIOD_NS / 1e9:.6f} {n / 100} 0 0 0 0 0 1" for n in range(-1, 8)]
    poses.write_text("\n".join(rows))
    given = ["run", str(path), "--poses", str(poses), "--near-m", "1", "-o", str(tmp_path / "out")]
    assert main([*given, "--save", "steering,depth"]) == 0
    assert "--rig" not in capsys.readouterr().err
    assert (tmp_path / "out/depth/000005.png").exists()


@pytest.mark.parametrize(("white", "level", "warned"), [(0, 16, 1), (4095, 250, 0)])
def test_deep_images_of_a_bag_are_scaled_as_those_of_folders(tmp_path, white, level, warned):
    with Bag(tmp_path / "deep.bag", ".bag") as bag:
        for side in ("left", "right"):
            deep = np.full((8, 8), 4015, np.uint16)
            bag.image(f"/{side}/image_raw", deep, 10**9, "mono16")
    with open_stereo(tmp_path / "deep.bag", settings=InputSettings(white=white)) as source:
        assert next(iter(source)).left.max() == level
        assert len([line for line in source.warnings if "--white 4095" in line]) == 2 * warned


@pytest.mark.parametrize("kind", [".bag", ".db3", ".mcap"])
@pytest.mark.parametrize("harm", ["cut", "middle", "first", "renamed"])
def test_parts_that_are_damaged_or_missing_are_named(tmp_path, kind, harm):
    parts = tmp_path / "parts"
    parts.mkdir()
    for part in range(4):
        path = tmp_path / f"{part}" if kind != ".bag" else parts / f"a_{part}.bag"
        with Bag(path, kind) as bag:
            for n, pair in list(enumerate(greys() * 2))[3 * part : 3 * part + 3]:
                for side, grey in zip(("left", "right"), pair, strict=True):
                    bag.image(f"/{side}/image_raw", grey, n * 10**9)
        if kind != ".bag":
            (file,) = path.glob(f"*{kind}")
            file.rename(parts / f"a_{part}{kind}")
    files = [parts / f"a_{part}{kind}" for part in range(4)]
    if harm == "cut":
        content = files[2].read_bytes()
        files[2].write_bytes(content[: len(content) // 2])
    else:
        files[0 if harm == "first" else 1].unlink()
        files[2].unlink() if harm == "renamed" else None
        files[3].rename(parts / f"b{kind}") if harm == "renamed" else None
    with open_stereo(parts) as source:
        frames = list(source)
        if harm == "cut":
            assert 9 <= len(frames) < 12
            assert frames[-1].time_s == 11
            assert any("a_2" in line or "could not be read" in line for line in source.damage)
            return
        said = {
            "middle": f"1 parts before a_2{kind} are not there",
            "first": f"the parts before a_1{kind} are not there",
            "renamed": f"7.0 s are missing before b{kind}",
        }[harm]
        assert source.warnings == [f"{parts}: {said}"]
        assert source.damage == []
        assert len(frames) == (6 if harm == "renamed" else 9)


@pytest.mark.parametrize("kind", [".db3", ".mcap"])
@pytest.mark.parametrize("harm", ["none", "cut", "missing", "metadata"])
def test_a_split_bag_with_metadata_is_read_but_for_what_is_damaged(tmp_path, kind, harm, capsys):
    parts = tmp_path / "parts"
    parts.mkdir()
    for part in range(3):
        with Bag(tmp_path / f"{part}", kind) as bag:
            for n, pair in list(enumerate(greys()))[2 * part : 2 * part + 2]:
                for side, grey in zip(("left", "right"), pair, strict=True):
                    bag.image(f"/{side}/image_raw", grey, n * PERIOD_NS)
        (file,) = (tmp_path / f"{part}").glob(f"*{kind}")
        file.rename(parts / f"a_{part}{kind}")
    about = (tmp_path / "0/metadata.yaml").read_text()
    names = "".join(f"  - a_{part}{kind}\n" for part in range(3))
    listed = re.sub(r"(relative_file_paths:\n)( *- .*\n)+", rf"\1{names}", about)
    (parts / "metadata.yaml").write_text("x: [" if harm == "metadata" else listed)
    middle = parts / f"a_1{kind}"
    if harm == "cut":
        middle.write_bytes(middle.read_bytes()[: middle.stat().st_size // 2])
    elif harm == "missing":
        middle.unlink()
    out = ["-o", str(tmp_path / "out"), "--save", "steering", "--no-check"]
    if harm == "metadata":
        assert main(["run", str(parts), *out]) == 1
        assert "move metadata.yaml elsewhere" in capsys.readouterr().err
        (parts / "metadata.yaml").unlink()
    damaged = harm in ("cut", "missing")
    assert main(["run", str(parts), *out]) == (3 if damaged else 0)
    assert (f"{middle} is left out" in capsys.readouterr().err) == damaged
    counts = json.loads((tmp_path / "out/run.json").read_text())["counts"]
    assert counts["written"] == (4 if damaged else 6)


@pytest.mark.parametrize(("encoding", "red"), [("nv12", 1), ("nv21", 0)])
@pytest.mark.parametrize("padding", [0, 16])
def test_chroma_below_the_luma_gives_colours(tmp_path, encoding, red, padding):
    chroma = np.full((24, 64 + padding), 128, np.uint8)
    chroma[:, red::2] = 240  # of V, which is red
    luma = np.full((48, 64), 90, np.uint8)
    path = tmp_path / "a.bag"
    with Bag(path, ".bag") as bag:
        bag.image("/left", luma, 10**9, encoding, padding=padding, behind=chroma.reshape(-1))
    (image,) = BagRecording(path, "/left")
    colours = image.colour()
    assert colours.shape == (48, 64, 3)
    assert (colours[..., 0] > 200).all()
    assert (colours[..., 1:] < 120).all()


@pytest.mark.parametrize(
    ("kind", "tool"), [(".bag", "rosbag reindex"), (".db3", "sqlite3"), (".mcap", "mcap recover")]
)
def test_what_saves_a_bag_that_is_cut_off_is_said(tmp_path, kind, tool):
    path = tmp_path / "a.bag" if kind == ".bag" else tmp_path / "a"
    with Bag(path, kind) as bag:
        for n, pair in enumerate(greys()):
            for side, grey in zip(("left", "right"), pair, strict=True):
                bag.image(f"/{side}/image_raw", grey, n * 10**9)
    file = path if kind == ".bag" else next(path.glob(f"*{kind}"))
    content = file.read_bytes()
    file.write_bytes(content[: 2 * len(content) // 3])
    with pytest.raises(InputError, match=tool):
        open_stereo(path)
