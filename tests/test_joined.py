"""Recordings in several files: one recording, whose numbers and times go on."""

from __future__ import annotations

import datetime
import itertools
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from recordings import COUNT, Images, cut, encode, folder, number_in, scene

from motionstereo_cli.__main__ import main
from motionstereo_cli.errors import InputError
from motionstereo_cli.sinks.records import InputRecord
from motionstereo_cli.sources import open_stereo
from motionstereo_cli.sources.joined import parts_of
from motionstereo_cli.sources.settings import InputSettings

GOPRO = ("GX010042.MP4", "GX020042.MP4", "GX030042.MP4")


def split(path: Path, images: Images, names: tuple[str, ...], sizes: tuple[int, ...]) -> Path:
    """Write images as several videos, of some number each."""
    path.mkdir()
    rest = iter(images)
    for name, size in zip(names, sizes, strict=True):
        part = list(itertools.islice(rest, size))
        if name.endswith(".mkv"):
            encode(path / name, part, "ffv1", "gray")
        elif name.endswith(".avi"):
            encode(path / name, part, "mjpeg", "yuvj420p", 2)
        elif name.endswith(".h264"):
            encode(path / name, part, "libx264", "yuv420p", options={"crf": "1"})
        else:
            encode(path / name, part, "libx264", "yuv420p", options={"crf": "1", "bf": "2"})
    return path


def negative(images: Images) -> Images:
    return [255 - image for image in images]


@pytest.mark.parametrize(
    "names",
    [
        GOPRO,
        ("GOPR0042.MP4", "GP010042.MP4", "GP020042.MP4"),
        ("DJI_0009.mp4", "DJI_0010.mp4", "DJI_0011.mp4"),
        ("20260101_100000_9.mkv", "20260101_100100_10.mkv", "20260101_100200_11.mkv"),
        ("part1.avi", "part2.avi", "part3.avi"),
        ("v8.h264", "v9.h264", "v10.h264"),
    ],
)
@pytest.mark.parametrize("pattern", [False, True])
def test_contract_of_parts(tmp_path: Path, names: tuple[str, ...], pattern: bool) -> None:
    settings = InputSettings(frame_rate=30) if names[0].endswith("h264") else InputSettings()
    # The cameras begin new files at different images.
    left = split(tmp_path / "left", scene(), names, (5, 4, 3))
    right = split(tmp_path / "right", negative(scene()), names, (4, 4, 4))
    given = [f"{side}/*{Path(names[0]).suffix}" if pattern else side for side in (left, right)]
    with open_stereo(*given, settings) as source:
        assert source.expected_frames in (COUNT, None)
        frames = list(source)
        assert source.damage == []
        assert [line for line in source.warnings if "--frame-rate" not in line] == []
        assert source.counts["left"]["paired"] == COUNT
        assert set(source.paths) == {side / name for side in (left, right) for name in names}
        told = source.describe()["left"]
        assert InputRecord(**told).files == 3
        assert told["files"] == 3
        assert told["bytes"] == sum((left / name).stat().st_size for name in names)
    assert [frame.number for frame in frames] == list(range(COUNT))
    times = [frame.time_s - frames[0].time_s for frame in frames]  # type: ignore[operator]
    assert times == pytest.approx(np.arange(COUNT) / 30, abs=2e-3)
    for number, frame in enumerate(frames):
        assert number_in(frame.left) == number
        assert number_in(255 - frame.right) == number


@pytest.mark.parametrize("begin", [1, 4, 7, 11])
def test_what_begins_in_the_middle_is_what_it_is_in_the_whole(tmp_path: Path, begin: int) -> None:
    left = split(tmp_path / "left", scene(), GOPRO, (5, 4, 3))
    right = split(tmp_path / "right", negative(scene()), GOPRO, (4, 4, 4))
    with open_stereo(left, right) as source:
        whole = list(source)
    with open_stereo(left, right) as source:
        assert source.begin_at(begin)
        rest = list(source)
    assert [frame.pts for frame in rest] == [frame.pts for frame in whole[begin:]]
    for frame, truth in zip(rest, whole[begin:], strict=True):
        np.testing.assert_array_equal((frame.left, frame.right), (truth.left, truth.right))


def test_a_run_of_parts_is_that_of_one_file(tmp_path: Path) -> None:
    images = [np.roll(scene(96, 64)[0], 3 * n, axis=1) for n in range(COUNT)]
    for side in ("left", "right"):
        encode(tmp_path / f"{side}.mkv", images, "ffv1", "gray")
        names = tuple(f"{n}.mkv" for n in range(3))
        split(tmp_path / side, images, names, (5, 4, 3))
    for name, ends in (("one", ".mkv"), ("parts", "")):
        given = [str(tmp_path / f"{side}{ends}") for side in ("left", "right")]
        out = ["-o", str(tmp_path / name), "--save", "disparity", "--no-check"]
        assert main(["run", *given, *out]) == 0
    for n in range(COUNT):
        name = f"disparity/{n:06d}.png"
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes()


def test_times_that_go_on_by_themselves_are_kept_and_gaps_said(tmp_path: Path) -> None:
    for name, numbers in (("a1.mkv", range(4)), ("a2.mkv", range(4, 8)), ("a3.mkv", range(68, 72))):
        images = [scene()[n % COUNT] for n in numbers]
        (tmp_path / "v").mkdir(exist_ok=True)
        _at(tmp_path / "v" / name, images, [n / 30 for n in numbers])
    with open_stereo(f"{tmp_path}/v/*.mkv", tmp_path / "v", InputSettings()) as source:
        frames = list(source)
        (warning,) = set(source.warnings)
    assert "about 2.0 s are missing between" in warning
    assert "a2.mkv" in warning
    assert "a3.mkv" in warning
    assert [frame.time_s for frame in frames] == pytest.approx(
        [n / 30 for n in (*range(8), *range(68, 72))], abs=2e-3
    )


def _at(path: Path, images: Images, times_s: list[float]) -> None:
    with av.open(str(path), "w", options={"avoid_negative_ts": "disabled"}) as container:
        stream: Any = container.add_stream("ffv1", rate=30)
        stream.height, stream.width = images[0].shape
        stream.pix_fmt = "gray"
        for image, time_s in zip(images, times_s, strict=True):
            frame = av.VideoFrame.from_ndarray(image, "gray")
            frame.pts, frame.time_base = round(time_s * 1000), Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def test_creation_times_tell_what_is_missing_between_files(tmp_path: Path) -> None:
    begin = datetime.datetime(2026, 1, 1, 10, tzinfo=datetime.UTC)
    (tmp_path / "v").mkdir()
    for n, at_s in enumerate((0, 1, 61)):
        path = encode(tmp_path / f"{n}.mp4", scene(), "libx264", "yuv420p")
        moment = begin + datetime.timedelta(seconds=at_s)
        with av.open(str(path)) as old, av.open(str(tmp_path / "v" / path.name), "w") as new:
            new.metadata["creation_time"] = moment.isoformat().replace("+00:00", ".000000Z")
            stream = new.add_stream_from_template(old.streams.video[0])
            for packet in old.demux(video=0):
                if packet.size:
                    packet.stream = stream
                    new.mux(packet)
    images = folder(tmp_path / "images", scene(count=36), ".png")
    with open_stereo(tmp_path / "v", images) as source:
        (warning,) = source.warnings
        assert InputRecord(**source.describe()["left"]).created == "2026-01-01T10:00:00+00:00"
    assert "about 59.6 s are missing between" in warning
    assert "by their creation times: times go on without them" in warning


def test_files_that_are_missing_or_damaged_are_said(tmp_path: Path) -> None:
    left = split(tmp_path / "left", scene(), GOPRO, (5, 4, 3))
    (left / GOPRO[1]).unlink()
    images = folder(tmp_path / "right", scene(), ".png")
    with open_stereo(left, images) as source:
        assert "numbers are missing between" in source.warnings[0]
        assert len(list(source)) == 8
    with pytest.raises(InputError, match="as --strict says"):
        open_stereo(left, images, InputSettings(strict=True))
    cut(left / GOPRO[2], left / GOPRO[1], 0.5)
    with open_stereo(left, images) as source:
        assert len(list(source)) == 8
        assert f"{GOPRO[1]} is left out" in source.damage[0]


def test_what_is_not_one_recording_is_refused(tmp_path: Path) -> None:
    path = split(tmp_path / "v", scene(), GOPRO[:2], (5, 4))
    (path / "GX020043.MP4").write_bytes(b"")
    with pytest.raises(
        InputError, match=r"several recordings, of the numbers 0042, 0043.*G\?\?\?0042"
    ):
        parts_of("v", list(path.iterdir()))
    for name in ("front_1.mp4", "rear_1.mp4"):
        (tmp_path / name).write_bytes(b"")
    with pytest.raises(InputError, match=r"not of one form \(front_1.mp4, rear_1.mp4\)"):
        parts_of("v", list(tmp_path.glob("*.mp4")))
    (path / "GX020043.MP4").unlink()
    encode(path / "GX030042.MP4", scene(96, 64), "libx264", "yuv420p")
    with pytest.raises(InputError, match=r"is 96x64 but .*GX010042.MP4 is 64x48"):
        open_stereo(path, path / GOPRO[0])


def test_one_chapter_alone_names_the_next(tmp_path: Path) -> None:
    path = split(tmp_path / "v", scene(), GOPRO[:2], (6, 6))
    images = folder(tmp_path / "images", scene(count=6), ".png")
    with open_stereo(path / GOPRO[0], images) as source:
        assert "GX010042.MP4 goes on in" in source.warnings[0]
        assert "G???0042.MP4" in source.warnings[0]
    with open_stereo(path / GOPRO[1], images) as source:
        assert source.warnings == []


@pytest.mark.parametrize("names", [GOPRO, ("GOPR0042.MP4", "GP010042.MP4", "GP020042.MP4")])
def test_chapters_that_are_not_there_are_named(tmp_path: Path, names: tuple[str, ...]) -> None:
    images = folder(tmp_path / "images", scene(count=8), ".png")
    whole = split(tmp_path / "v", scene(count=12), names, (4, 4, 4))
    with open_stereo(whole, images) as source:
        assert not any("chapters" in line for line in source.warnings)
    (whole / names[0]).unlink()
    with open_stereo(whole, images) as source:
        said = f"{whole}: begins with {names[1]}: the chapters before it are not there"
        assert said in source.warnings
    (whole / names[1]).unlink()
    with open_stereo(whole, images) as source:
        assert said.replace(names[1], names[2]) in source.warnings


@pytest.mark.parametrize("kind", ["videos", "folders", "names"])
def test_a_folder_with_a_left_and_a_right_recording_is_both(tmp_path: Path, kind: str) -> None:
    whole = tmp_path / "whole"
    whole.mkdir()
    left, right = ("cam_left", "cam_right") if kind == "names" else ("left", "right")
    for side, images in ((left, scene()), (right, negative(scene()))):
        if kind == "folders":
            folder(whole / side, images, ".png")
        else:
            encode(whole / f"{side}.mkv", images, "ffv1", "gray")
    (whole / "rig.yaml").write_text("focal_px: 1\n")
    with open_stereo(whole) as source:
        frames = list(source)
    assert len(frames) == COUNT
    np.testing.assert_array_equal(frames[3].left, 255 - frames[3].right)


def test_an_empty_folder_is_said_to_be_empty(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is empty: give a folder that holds recordings"):
        open_stereo(tmp_path)
