"""Results on disk: exact text, images and videos read back, and whose files are whose."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import av
import cv2
import imageio.v3 as iio
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from taken import prepared, step_of, taken

from motionstereo_cli.errors import InputError, OutputError, SettingsError
from motionstereo_cli.files.atomic import part_of, reported, segment_of, write_whole
from motionstereo_cli.files.encode import encode_pfm, encode_png
from motionstereo_cli.files.video import Indexed, SegmentedVideo, VideoWriter, join, table_of
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.params import params
from motionstereo_cli.runs.folder import RunFolder
from motionstereo_cli.runs.folder_files import head
from motionstereo_cli.runs.threaded_sink import Threaded
from motionstereo_cli.sinks.drawing import coloured
from motionstereo_cli.sinks.images import depth_png, disparity_png
from motionstereo_cli.sinks.outputs import DEFAULT_OUTPUTS, OUTPUTS, available
from motionstereo_cli.sinks.records import Counts
from motionstereo_cli.sinks.scale import DepthScale, palette
from motionstereo_cli.sinks.settings import OutputSettings
from motionstereo_cli.sinks.sink import RunContext
from motionstereo_cli.sinks.steering_table import SteeringFile, SteeringStream
from motionstereo_cli.types import FrameResult, Rig, Steering, Step, StereoFrame

BLIND = Steering("blind", None, None, None, None)
NAN = float("nan")
STREAM = RunContext(Fraction(1, 25), Settings(), None)
RIG = Rig(width=6, height=4, focal_px=100, baseline_m=0.1, cx=2.5, cy=1.5)


def frame_result(
    index: int = 0,
    *,
    pts: int | None = None,
    time_s: float | None = None,
    steering: Steering = BLIND,
    bands: np.ndarray | None = None,
    motion: np.ndarray | None = None,
    charge: np.ndarray | None = None,
    disparity_px: np.ndarray | None = None,
    age_frames: np.ndarray | None = None,
    confidence: np.ndarray | None = None,
    depth_m: np.ndarray | None = None,
    charged: float = 0.0,
    matched: float = 0.0,
) -> FrameResult:
    grey = np.zeros((4, 6) if disparity_px is None else disparity_px.shape, np.uint8)
    return FrameResult(
        frame=StereoFrame(index, index if pts is None else pts, time_s, grey, grey),
        bands=grey if bands is None else bands,
        motion=grey > 0 if motion is None else motion,
        charge=grey if charge is None else charge,
        age_frames=grey + 255 if age_frames is None else age_frames,
        confidence=np.full((4, 6), NAN, np.float32) if confidence is None else confidence,
        disparity_px=np.full((4, 6), NAN, np.float32) if disparity_px is None else disparity_px,
        depth_m=depth_m,
        steering=steering,
        charged=charged,
        matched=matched,
    )


def saved(
    out: Path, name: str, *results: FrameResult, stream: RunContext = STREAM, index: int = 0
) -> Path:
    """Write results as an output of a run; return the file, of numbered ones that of a frame."""
    sink = OUTPUTS[name].open(out, stream)
    for result in results:
        sink.write(taken(name, result))
    sink.close()
    return out / OUTPUTS[name].path.format(index)


def decoded(path: Path) -> list[tuple[float, np.ndarray]]:
    """Times in s and RGB images of a video."""
    with av.open(str(path)) as container:
        return [(f.time, f.to_ndarray(format="rgb24")) for f in container.decode(video=0)]


# Age and confidence.


def test_age_and_confidence_are_read_back(tmp_path):
    age = np.array([[0, 15, 255]], np.uint8)
    chance = np.array([[1.0, 0.5, NAN, 0.0]], np.float32)
    result = frame_result(7, age_frames=age, confidence=chance)
    found = cv2.imread(str(saved(tmp_path, "age", result, index=7)), cv2.IMREAD_UNCHANGED)
    assert found.dtype == np.uint8
    assert found.tolist() == age.tolist()
    found = cv2.imread(str(saved(tmp_path, "confidence", result, index=7)), cv2.IMREAD_UNCHANGED)
    assert found.tolist() == [[255, 128, 0, 1]]


# Steering table.


def test_the_steering_table_to_the_letter(tmp_path):
    sink = SteeringFile(tmp_path / "steering.csv")
    sink.write(step_of(frame_result(0)))
    held = Steering("held", -0.00001, 0.12345, 2.71849, 0.0006, 1.23456)
    sink.write(
        step_of(frame_result(1, pts=512, time_s=1 / 30, steering=held, charged=1 / 3, matched=1))
    )
    odd = Steering("ok", 1.0, None, float("inf"), NAN)
    sink.write(step_of(frame_result(2, pts=-7, time_s=-0.25, steering=odd)))
    sink.close()
    assert (tmp_path / "steering.csv").read_bytes() == (
        b"frame,pts,time_s,status,steer,steer_rad,depth_m,nearest_m,charged,matched,risk_s\n"
        b"0,0,,blind,,,,,0.0000,0.0000,\n"
        b"1,512,0.033333,held,0.0000,0.1235,2.718,0.001,0.3333,1.0000,1.235\n"
        b"2,-7,-0.250000,ok,1.0000,,,,0.0000,0.0000,\n"
    )


def test_json_lines_hold_the_same_numbers_and_null_where_unknown(tmp_path):
    held = Steering("held", -0.00001, 0.12345, 2.71849, 0.0006)
    results = frame_result(0), frame_result(1, pts=512, time_s=1 / 30, steering=held, charged=1 / 3)
    lines = saved(tmp_path, "steering-jsonl", *results).read_text().splitlines()
    with saved(tmp_path, "steering", *results).open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(lines) == 2
    for line, row in zip(map(json.loads, lines), rows, strict=True):
        assert line.keys() == row.keys()
        for name, cell in row.items():
            known = cell if name == "status" else float(cell or "nan")
            assert line[name] == known or (cell == "" and line[name] is None)
    assert lines[1] == (
        '{"frame": 1, "pts": 512, "time_s": 0.033333, "status": "held", "steer": 0.0000, '
        '"steer_rad": 0.1235, "depth_m": 2.718, "nearest_m": 0.001, "charged": 0.3333, '
        '"matched": 0.0000, "risk_s": null}'
    )


def test_rows_are_passed_on_at_once_but_the_name_comes_last(tmp_path):
    path = tmp_path / "steering.csv"
    sink = SteeringFile(path)
    sink.write(step_of(frame_result(0)))
    assert part_of(path).read_text().count("\n") == 2
    assert not path.exists()
    sink.close()
    assert [each.name for each in tmp_path.iterdir()] == ["steering.csv"]


@pytest.mark.parametrize("keep", [True, False])
def test_an_abandoned_table_never_gets_its_name(tmp_path, keep):
    path = tmp_path / "steering.csv"
    sink = SteeringFile(path)
    sink.write(step_of(frame_result(0)))
    sink.abandon(keep=keep)
    assert list(tmp_path.iterdir()) == ([part_of(path)] if keep else [])


def test_a_full_disk_is_named_and_a_gone_reader_is_no_failure():
    no_space = pytest.raises(OutputError, match="cannot write out: No space left")
    with Path("/dev/full").open("wb", buffering=0) as full, no_space:
        SteeringStream(full, "out")
    with pytest.raises(BrokenPipeError), reported("out"):
        raise BrokenPipeError


# Images.


def test_depth_in_mm_by_hand():
    nearness_px = np.float32([[NAN, 1 / 2.71, np.inf, 2500], [1 / 65.53, 1 / 65.54, 0.0, -1.0]])
    expected = [[0, 2710, 1, 1], [65530, 0, 0, 0]]
    rig = Rig(4, 2, focal_px=10, baseline_m=0.1, cx=1.5, cy=0.5, doffs=2)
    np.testing.assert_array_equal(depth_png(nearness_px - 2, rig), np.uint16(expected))


def test_disparity_as_kitti_has_it_by_hand():
    disparity_px = np.float32([[NAN, 1.0, 0.0, 0.001], [65535 / 256, 256.0, 12.5, 0.25]])
    expected = [[0, 256, 1, 1], [65535, 0, 3200, 64]]
    np.testing.assert_array_equal(disparity_png(disparity_px), np.uint16(expected))


@given(arrays(np.float32, (3, 4), elements=st.floats(0, 300, width=32) | st.just(NAN)))
def test_disparity_survives_to_half_a_step(disparity_px):
    stored = disparity_png(disparity_px)
    known = disparity_px <= np.float32(65535 / 256)
    np.testing.assert_array_equal(stored > 0, known)
    error_px = np.abs(stored[known] / 256 - disparity_px[known])
    assert (error_px <= np.where(stored[known] == 1, 1 / 256, 1 / 512) + 1e-6).all()


def test_numbered_images_read_back(tmp_path):
    out = tmp_path / "with {braces}"
    out.mkdir()
    values = np.linspace(0.5, 60, 24, dtype=np.float32).reshape(4, 6)
    result = frame_result(7, disparity_px=values)
    stream = RunContext(Fraction(1, 25), Settings(), RIG)
    depth_png = saved(out, "depth", result, index=7, stream=stream)
    depth_mm = cv2.imread(str(depth_png), cv2.IMREAD_UNCHANGED)
    disparity = cv2.imread(str(saved(out, "disparity", result, index=7)), cv2.IMREAD_UNCHANGED)
    assert depth_mm.dtype == disparity.dtype == np.uint16
    np.testing.assert_array_equal(depth_mm, np.rint(RIG.depth_m(values) * 1000))
    np.testing.assert_array_equal(disparity, np.rint(values * 256))
    assert len(list(out.rglob("*"))) == 4


def test_another_depth_scale_holds_for_image_and_video(tmp_path):
    depth_m = np.float32([[NAN, 2.7112, 13.1068, 13.108]])
    stream = RunContext(Fraction(1, 25), Settings(), RIG, OutputSettings(depth_scale=5000))
    result = frame_result(disparity_px=RIG.disparity_px(depth_m))
    image = cv2.imread(str(saved(tmp_path, "depth", result, stream=stream)), cv2.IMREAD_UNCHANGED)
    assert image.tolist() == [[0, 13556, 65534, 0]]
    video = saved(tmp_path, "depth-mkv", result, stream=stream)
    with av.open(str(video)) as container:
        [frame] = container.decode(video=0)
    assert frame.to_ndarray().tolist() == image.tolist()


def test_the_lossless_depth_video_gives_every_level_back(tmp_path):
    levels = np.arange(65536, dtype=np.uint16).reshape(255 + 1, 256)[:, :255]  # odd width
    with np.errstate(divide="ignore"):
        disparity_px = RIG.disparity_px(np.float32(levels) / 1000)
    results = [
        frame_result(index, pts=40 * index, disparity_px=np.roll(disparity_px, index))
        for index in range(3)
    ]
    stream = RunContext(Fraction(1, 1000), Settings(), RIG)
    with av.open(str(saved(tmp_path, "depth-mkv", *results, stream=stream))) as container:
        assert container.streams.video[0].codec_context.name == "ffv1"
        frames = list(container.decode(video=0))
    assert [frame.time for frame in frames] == [0, 0.04, 0.08]
    for index, frame in enumerate(frames):
        assert frame.format.name == "gray16le"
        expected = np.where(np.roll(levels, index) == 0, 1, np.roll(levels, index))
        np.testing.assert_array_equal(frame.to_ndarray(), expected)  # a known 0 is 1


@pytest.mark.parametrize(
    ("name", "unknown"), [("depth-pfm", np.inf), ("depth-tiff", NAN), ("disparity-pfm", np.inf)]
)
def test_float_images_are_exact(tmp_path, name, unknown):
    values = np.linspace(0.1, 70, 24, dtype=np.float32).reshape(4, 6)
    values[1, 2] = NAN
    result = frame_result(7, depth_m=values, disparity_px=values)
    path = saved(tmp_path, name, result, index=7)
    expected = np.where(np.isnan(values), np.float32(unknown), values)
    for found in (
        cv2.imread(str(path), cv2.IMREAD_UNCHANGED),
        iio.imread(path, plugin="pillow"),
    ):
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, expected)


def test_a_pfm_file_to_the_byte():
    """Width and height, a negative scale for little-endian, and the lowest row first."""
    content = encode_pfm(np.float32([[1, 2, 3], [4, 5, NAN]]))
    header, values = content[:-24], np.frombuffer(content[-24:], "<f4")
    assert header.split() == [b"Pf", b"3", b"2", b"-1"]
    assert values.tolist() == [4, 5, np.inf, 1, 2, 3]


def test_bands_motion_and_charge_as_images_and_as_video(tmp_path):
    bands = np.tile(np.repeat(np.arange(1, 9, dtype=np.uint8), 8), (48, 1))
    motion = bands > 4
    charge = (bands * 30).astype(np.uint8)
    result = frame_result(bands=bands, motion=motion, charge=charge)
    shown = {
        "bands": (bands, (bands - 1.0) / 7 * 255),
        "motion": (np.where(motion, 255, 0), np.where(motion, 255, 0)),
        "charge": (charge, charge),
    }
    for name, (image, grey) in shown.items():
        numbered, video = (name, f"{name}-video") if name != "charge" else ("charge-png", "charge")
        found = cv2.imread(str(saved(tmp_path, numbered, result)), cv2.IMREAD_UNCHANGED)
        assert found.dtype == np.uint8
        np.testing.assert_array_equal(found, image)
        [(_, rgb)] = decoded(saved(tmp_path, video, result))
        middles = np.s_[:, 4::8]  # the codec blurs the seams
        assert np.abs(rgb.mean(axis=2)[middles] - grey[middles]).max() <= 6, name


def test_256_bands_fit(tmp_path):
    bands = np.uint16([[1, 128, 256]])
    path = saved(tmp_path, "bands", frame_result(bands=bands))
    assert cv2.imread(str(path), cv2.IMREAD_UNCHANGED).tolist() == bands.tolist()


def test_a_file_that_cannot_be_written_leaves_nothing(tmp_path):
    (tmp_path / "taken.png").mkdir()
    with pytest.raises(OutputError, match=r"taken\.png: Is a directory"):
        write_whole(tmp_path / "taken.png", b"x")
    assert [each.name for each in tmp_path.iterdir()] == ["taken.png"]


# Videos.


def test_the_charge_video_gives_the_charge_back_at_the_same_times(tmp_path):
    charges = [np.full((48, 64), level, np.uint8) for level in (0, 15, 127, 239, 255)]
    for charge in charges:
        charge[:24] = 255 - charge[:24]
    sink = OUTPUTS["charge"].open(tmp_path, RunContext(Fraction(1, 1000), Settings(), None))
    stamps = [40, 80, 95, 95, 400]  # uneven, and one that does not come after the one before
    for index, (pts, charge) in enumerate(zip(stamps, charges, strict=True)):
        sink.write(taken("charge", frame_result(index, pts=pts, charge=charge)))
    sink.close()
    read = decoded(tmp_path / "charge.mp4")
    assert [round(time_s, 6) for time_s, _ in read] == [0.04, 0.08, 0.095, 0.096, 0.4]
    for charge, (_, rgb) in zip(charges, read, strict=True):
        # Rows by the seam between the halves are the codec's to blur.
        off_seam = np.r_[:20, 28:48]
        assert np.abs(rgb[off_seam].mean(axis=2) - charge[off_seam]).max() <= 4


@pytest.mark.parametrize("name", ["video.mp4", "video.mkv", "segments.mp4"])
def test_a_video_has_the_rate_of_its_frames(tmp_path, name):
    """Up to the last, which no other one ends, and which may be a segment of its own."""
    kind = SegmentedVideo if name.startswith("segments") else VideoWriter
    video = kind(tmp_path / name, Fraction(1, 1000))
    for index in range(11):
        video.write(np.full((48, 64), 20 * index, np.uint8), 100 * index)
        if isinstance(video, SegmentedVideo) and index % 5 == 4:
            video.checkpoint()
    video.close()
    with av.open(str(tmp_path / name)) as read:
        assert read.streams.video[0].average_rate == 10


def test_depth_colours_are_red_near_blue_far_grey_unknown():
    disparity_px = np.float32([[NAN, 0.0, 1.0, 8.0, 64.0, 70.0]])
    found = coloured(disparity_px, DepthScale(64, colours="turbo"))[0].astype(int)
    unknown, zero, far, middle, near, nearer = found
    assert len(set(unknown.tolist())) == 1
    assert zero.tolist() == far.tolist()
    assert near.tolist() == nearer.tolist()
    assert far[2] == far.max() > 100  # blue
    assert middle[1] == middle.max() > 200  # the middle of the log scale is green
    assert near[0] == near.max() > 100  # red


def test_colours_and_their_range_are_options(tmp_path):
    """With f b = 10 px m, 5 m and 0.5 m are 2 px and 20 px of d + doffs."""
    disparity_px = np.repeat(np.float32([[1.5, 0.5, 18.5]]), 16, axis=1).repeat(16, axis=0)
    rig = dataclasses.replace(RIG, doffs=1.5)
    output = OutputSettings(colours="viridis", near_m=0.5, far_m=5)
    stream = RunContext(Fraction(1, 25), Settings(), rig, output)
    result = frame_result(disparity_px=disparity_px)
    [(_, rgb)] = decoded(saved(tmp_path, "depth-video", result, stream=stream))
    viridis = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_VIRIDIS)
    viridis = viridis[:, 0, ::-1].astype(int)
    third = 32 + int(223 * math.log10(3 / 2))
    for column, level in ((8, third), (24, 32), (40, 255)):
        assert np.abs(rgb[8, column] - viridis[level]).max() <= 12


def test_every_colour_map_is_known_to_opencv():
    [choices] = (item.choices for item in params(OutputSettings) if item.name == "colours")
    for name in choices:
        assert coloured(np.float32([[8.0]]), DepthScale(64, colours=name)).max() > 0


def test_nonsense_of_the_output_is_refused():
    with pytest.raises(SettingsError, match="--near-m 5 is not below --far-m 5"):
        OutputSettings(near_m=5, far_m=5)
    with pytest.raises(SettingsError, match="--depth-scale cannot be 0"):
        OutputSettings(depth_scale=0)


def test_the_depth_video_keeps_colours_and_pads_odd_sizes(tmp_path):
    disparity_px = np.full((31, 45), NAN, np.float32)
    disparity_px[:, 16:32] = 2
    disparity_px[:, 32:] = 60
    stream = dataclasses.replace(STREAM, output=OutputSettings(legend=False))
    result = frame_result(disparity_px=disparity_px)
    view = np.zeros((31, 45), np.uint8)
    frame = dataclasses.replace(result.frame, left=view, right=view)
    result = dataclasses.replace(result, frame=frame)
    [(_, rgb)] = decoded(saved(tmp_path, "depth-video", result, stream=stream))
    assert rgb.shape == (32, 46, 3)
    scale = DepthScale.of(stream.settings, stream.output, stream.rig)
    for column in (8, 24, 40):
        expected = coloured(disparity_px, scale, view)[16, column].astype(int)
        assert np.abs(rgb[16, column] - expected).max() <= 16


def test_an_interrupted_video_can_be_played_under_its_part_name(tmp_path):
    path = tmp_path / "charge.mp4"
    sink = OUTPUTS["charge"].open(tmp_path, STREAM)
    for index in range(3):
        sink.write(taken("charge", frame_result(index)))
    sink.abandon(keep=True)
    assert len(decoded(segment_of(path, 0))) == 3
    assert not path.exists()


def test_a_video_given_up_leaves_nothing(tmp_path):
    sink = OUTPUTS["charge"].open(tmp_path, STREAM)
    sink.write(taken("charge", frame_result(0)))
    sink.abandon(keep=False)
    assert not list(tmp_path.iterdir())


def test_a_video_that_outgrows_the_disk_names_the_path_and_goes(tmp_path):
    script = """
import resource, sys
from fractions import Fraction
from pathlib import Path
import numpy as np
from motionstereo_cli.errors import OutputError
from motionstereo_cli.files.encode import encode_png
from motionstereo_cli.files.video import VideoWriter
video = VideoWriter(Path(sys.argv[1]), Fraction(1, 25))
noise = np.random.default_rng(0)
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, -1))
try:
    for index in range(60):
        video.write(noise.integers(0, 256, (48, 64), np.uint8), index)
    video.close()
except OutputError as error:
    video.abandon(keep=False)
    resource.setrlimit(resource.RLIMIT_FSIZE, (-1, -1))  # coverage writes at the end
    sys.exit(str(error))
"""
    path = tmp_path / "charge.mp4"
    done = subprocess.run(
        [sys.executable, "-c", script, path], capture_output=True, text=True, check=False
    )
    assert done.stderr == f"cannot write {path}: File too large\n"
    assert not list(tmp_path.iterdir())


# Threads.


class Listing:
    """A sink that notes what happens to it, and fails at one frame."""

    def __init__(self, fails_at: int | None = None) -> None:
        self.events: list[object] = []
        self._fails_at = fails_at

    def write(self, step: Step) -> None:
        if step.time.index == self._fails_at:
            raise OutputError("no room")
        self.events.append(step.time.index)

    def close(self) -> None:
        self.events.append("closed")

    def abandon(self, *, keep: bool) -> None:
        self.events.append(("abandoned", keep))


def test_a_threaded_sink_writes_all_in_order_and_closes_once():
    inner = Listing()
    sink = Threaded(inner)
    for index in range(50):
        sink.write(step_of(frame_result(index)))
    sink.close()
    sink.abandon(keep=False)
    assert inner.events == [*range(50), "closed"]


def test_an_error_in_the_thread_stops_the_stream():
    inner = Listing(fails_at=3)
    sink = Threaded(inner)

    def write_all() -> None:
        for index in range(1000):
            sink.write(step_of(frame_result(index)))

    with pytest.raises(OutputError, match="no room"):
        write_all()
    sink.abandon(keep=False)
    assert inner.events == [0, 1, 2, ("abandoned", False)]


def test_an_error_at_the_last_frame_is_raised_by_close():
    inner = Listing(fails_at=1)
    sink = Threaded(inner)
    sink.write(step_of(frame_result(0)))
    sink.write(step_of(frame_result(1)))
    with pytest.raises(OutputError, match="no room"):
        sink.close()
    sink.abandon(keep=True)
    assert inner.events == [0, ("abandoned", True)]


# The output folder.


def a_run(out: Path, save: tuple[str, ...], frames: int, *, done: bool = True) -> None:
    """Leave what a run leaves, complete or cut off."""
    folder = prepared(out, save, overwrite=True)
    for name in save:
        path = out / OUTPUTS[name].path
        path.parent.mkdir(exist_ok=True)
        if "{" in path.name:
            for index in range(frames):
                path.with_name(path.name.format(index)).write_bytes(b"image")
        else:
            (path if done else part_of(path)).write_bytes(b"stream")
    if done:
        folder.complete(counts=Counts(written=frames))


def names(out: Path) -> set[str]:
    return {str(path.relative_to(out)) for path in out.rglob("*") if not path.is_dir()}


def test_every_default_is_an_output_and_depth_needs_a_rig():
    assert set(DEFAULT_OUTPUTS) <= OUTPUTS.keys()
    assert available(DEFAULT_OUTPUTS, rig=True) == DEFAULT_OUTPUTS
    assert available(["depth", "charge", "disparity"], rig=False) == ("disparity", "charge")
    assert available(["depth-pfm"], rig=False) == ("disparity-pfm",)
    with pytest.raises(SettingsError, match="--save depth-mkv needs --rig"):
        available(["steering", "depth-mkv"], rig=False)
    jsonl = available(["steering", "charge"], rig=True, steering_format="jsonl")
    assert jsonl == ("steering-jsonl", "charge")


def test_a_folder_with_anything_in_it_is_refused(tmp_path):
    (tmp_path / "notes.txt").touch()
    with pytest.raises(OutputError, match="not empty"):
        prepared(tmp_path, ["steering"])
    assert names(tmp_path) == {"notes.txt"}


@pytest.mark.parametrize("done", [True, False])
def test_overwrite_removes_what_a_run_wrote_and_nothing_else(tmp_path, done):
    a_run(tmp_path, ("steering", "depth", "depth-tiff", "charge"), 3, done=done)
    strangers = {"notes.txt", "depth/000004.png", "depth/mine.png", "depth.mp4", "disparity/a.png"}
    strangers |= {"depth-tiff/000001.png", "depth/000000.tiff"}
    for stranger in strangers:
        path = tmp_path / stranger
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"mine")
    prepared(tmp_path, ["steering", "charge"], overwrite=True)
    assert names(tmp_path) == {*strangers, "run.json.part"}


def test_overwrite_leaves_no_empty_folder_of_a_former_run(tmp_path):
    a_run(tmp_path, ("depth",), 3)
    prepared(tmp_path, ["steering"], overwrite=True)
    assert not (tmp_path / "depth").exists()


@pytest.mark.parametrize(
    "stranger",
    ["steering.csv", "steering.csv.part", "depth/000000.png", "depth", "run.json", "run.json.part"],
)
def test_nobody_elses_file_is_written_over(tmp_path, stranger):
    path = tmp_path / stranger
    path.parent.mkdir(exist_ok=True)
    path.write_text('{"program": "another"}')
    with pytest.raises(OutputError, match="not from an earlier run"):
        prepared(tmp_path, ["steering", "depth"], overwrite=True)
    assert names(tmp_path) == {stranger}


@pytest.mark.parametrize("record", ["[]", "{", '{"program": "motionstereo", "outputs": 3}'])
def test_a_record_that_makes_no_sense_gives_no_right_to_remove(tmp_path, record):
    (tmp_path / "run.json").write_text(record)
    (tmp_path / "steering.csv").touch()
    with pytest.raises(OutputError, match="not from an earlier run"):
        prepared(tmp_path, ["steering"], overwrite=True)
    assert names(tmp_path) == {"run.json", "steering.csv"}


def test_a_record_cannot_point_outside_the_folder(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (tmp_path / "steering.csv").touch()
    outputs = {"../steering": {"path": "../steering.csv"}, "steering": {"path": "../steering.csv"}}
    (out / "run.json").write_text(
        json.dumps({"program": "motionstereo", "outputs": outputs, "counts": {"written": 1}})
    )
    prepared(out, ["steering"], overwrite=True)
    assert (tmp_path / "steering.csv").exists()


@pytest.mark.parametrize("taken", ["charge.mp4", "depth", "."])
def test_an_input_is_not_harmed(tmp_path, taken):
    a_run(tmp_path, ("steering", "depth", "charge"), 2)
    before = names(tmp_path)
    with pytest.raises(OutputError, match="is an input of this run"):
        prepared(tmp_path, ["depth"], overwrite=True, inputs=[tmp_path / taken])
    assert names(tmp_path) == before


def test_an_input_elsewhere_in_the_folder_stays(tmp_path):
    (tmp_path / "left.mp4").touch()
    prepared(tmp_path, ["steering"], overwrite=True, inputs=[tmp_path / "left.mp4"])
    assert names(tmp_path) == {"left.mp4", "run.json.part"}


def test_an_output_folder_that_cannot_be(tmp_path):
    (tmp_path / "file").touch()
    for out in (tmp_path / "file", tmp_path / "file/out"):
        with pytest.raises(OutputError, match=f"cannot write {out}"):
            prepared(out, ["steering"], overwrite=True)


@pytest.mark.parametrize("left", [{"depth/000000.png"}, set()])
def test_a_failed_run_leaves_its_record_only_beside_images(tmp_path, left):
    def fail() -> None:
        with RunFolder(tmp_path, ["depth"], identity=head(["depth"])):
            for name in left:
                (tmp_path / name).parent.mkdir()
                (tmp_path / name).touch()
            raise InputError("the second frame cannot be read")

    with pytest.raises(InputError, match="the second"):
        fail()
    assert names(tmp_path) == (left and {"run.json.part", *left})


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(1, 1), (3, 7), (20, 31)])
def test_a_png_holds_its_pixels(dtype, shape):
    image = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, shape).astype(dtype)
    content = np.frombuffer(encode_png(image), np.uint8)
    assert np.array_equal(cv2.imdecode(content, cv2.IMREAD_UNCHANGED), image)


def test_a_video_of_indexed_colours_is_that_of_its_rgb(tmp_path):
    levels = np.random.default_rng(0).integers(0, 256, (8, 6)).repeat(4, 0).repeat(4, 1)
    levels = levels.astype(np.uint8)
    shown = []
    for image in (Indexed(levels, table_of(palette("turbo"))), palette("turbo")[levels][:, :, 0]):
        video = VideoWriter(tmp_path / "colours.mp4", Fraction(1, 25))
        video.write([image, image], 0)
        video.close()
        with av.open(str(tmp_path / "colours.mp4")) as file:
            shown.append(next(file.decode(video=0)).to_ndarray(format="rgb24"))
    assert shown[0].shape == (64, 24, 3)
    assert np.array_equal(shown[0], shown[1])


@pytest.mark.parametrize("joints", [[(0, 20), (20, 30)], [(0, 10), (10, 30)]])
def test_videos_joined_of_joined_videos_have_the_bytes_of_one(tmp_path, joints):
    """Also what a head says of the rate, which differs from segment to segment."""
    rng = np.random.default_rng(0)
    images = [(rng.integers(0, 256, (64, 96)) * (n % 7) / 7).astype(np.uint8) for n in range(30)]

    def made(path, first, stop):
        last = first - 1 if first else None
        path.parent.mkdir()
        video = SegmentedVideo(path, Fraction(1, 25), ((), last))
        for number in range(first, stop):
            if number in (10, 20):
                video.checkpoint()
            video.write(images[number], number)
        video.close()
        return path

    whole = made(tmp_path / "whole/a.mp4", 0, 30)
    parts = [made(tmp_path / f"{first}/a.mp4", first, stop) for first, stop in joints]
    join(parts, tmp_path / "joined.mp4")
    assert (tmp_path / "joined.mp4").read_bytes() == whole.read_bytes()
