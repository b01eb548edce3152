from __future__ import annotations

import hashlib
import itertools
import json
import re
import threading
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import imageio.v3 as iio
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from recordings import COUNT, FULL, LIMITED, Images, cut, encode, folder, number_in, remux, scene

from motionstereo_cli.errors import InputError
from motionstereo_cli.sources import open_stereo
from motionstereo_cli.sources.folder import FolderRecording
from motionstereo_cli.sources.names import natural_key
from motionstereo_cli.sources.prefetch import prefetch
from motionstereo_cli.sources.recording import Image, Recording
from motionstereo_cli.sources.video import VideoRecording


def open_recording(path: Path) -> Recording:
    return FolderRecording(path) if path.is_dir() else VideoRecording(path)


def read_all(path: Path) -> tuple[Recording, list[Image]]:
    stream = open_recording(path)
    try:
        return stream, list(stream)
    finally:
        stream.close()


# --- The contract of every kind of source -----------------------------------------------------

EVEN = (64, 48)
ODD = (65, 49)
MP4 = Fraction(1, 15360)
MKV = Fraction(1, 1000)
AVI = Fraction(1, 30)
NO_TIME = None
SHARP = {"crf": "1", "bf": "2"}


def video(*codec: Any, **options: Any) -> Callable[[Path, Images], Path]:
    return lambda path, images: encode(path, images, *codec, **options)


def stills(
    suffix: str, change: Callable[[Any], Any] = lambda image: image
) -> Callable[[Path, Images], Path]:
    return lambda path, images: folder(path, [change(image) for image in images], suffix)


def deep(image: NDArray[np.uint8]) -> NDArray[np.uint16]:
    return image * np.uint16(257)


#: name: (size, largest error in grey levels, seconds per unit of pts, how to make it)
KINDS: dict[str, tuple[tuple[int, int], int, Fraction | None, Callable[[Path, Images], Path]]] = {
    "h264.mp4": (EVEN, 4, MP4, video("libx264", "yuv420p", options=SHARP)),
    "h264 full.mp4": (EVEN, 4, MP4, video("libx264", "yuv420p", FULL, options=SHARP)),
    "h264 odd.mp4": (ODD, 4, MP4, video("libx264", "yuv444p", options=SHARP)),
    "mjpeg.avi": (EVEN, 8, AVI, video("mjpeg", "yuvj420p", FULL)),
    "ffv1 grey odd.mkv": (ODD, 0, MKV, video("ffv1", "gray")),
    "ffv1 10 bit.mkv": (EVEN, 1, MKV, video("ffv1", "yuv420p10le", LIMITED)),
    "ffv1 10 bit full.mkv": (EVEN, 1, MKV, video("ffv1", "yuv422p10le", FULL)),
    "ffv1 16 bit grey.mkv": (EVEN, 1, MKV, video("ffv1", "gray16le", FULL)),
    "packed.avi": (EVEN, 1, AVI, video("rawvideo", "yuyv422")),
    "ffv1 12 bit grey.mkv": (ODD, 1, MKV, video("ffv1", "gray12le", FULL)),
    "ffv1 14 bit limited.mkv": (EVEN, 1, MKV, video("ffv1", "yuv444p14le", LIMITED)),
    "ffv1 16 bit colour.mkv": (EVEN, 1, MKV, video("ffv1", "rgb48le", FULL)),
    "ffv1 alpha.mkv": (EVEN, 1, MKV, video("ffv1", "yuva420p", LIMITED)),
    "vp9.webm": (ODD, 4, MKV, video("libvpx-vp9", "yuv444p", options={"crf": "2", "b": "0"})),
    "mpeg4.mov": (EVEN, 8, MP4, video("mpeg4", "yuv420p", options={"qscale": "1", "b": "9M"})),
    "rgb.mkv": (ODD, 1, MKV, video("ffv1", "bgr0", FULL)),
    "png odd": (ODD, 0, NO_TIME, stills(".png")),
    "colour png": (EVEN, 0, NO_TIME, stills(".png", lambda image: np.dstack([image] * 3))),
    "png with alpha": (EVEN, 0, NO_TIME, stills(".png", lambda image: np.dstack([image] * 4))),
    "16-bit png": (EVEN, 0, NO_TIME, stills(".png", deep)),
    "16-bit pgm": (EVEN, 0, NO_TIME, stills(".pgm", deep)),
    "jpg": (EVEN, 8, NO_TIME, stills(".jpg")),
    "tiff": (EVEN, 0, NO_TIME, stills(".tiff")),
    "16-bit tiff": (ODD, 0, NO_TIME, stills(".tif", deep)),
    "16-bit colour png": (
        EVEN,
        1,
        NO_TIME,
        stills(".png", lambda image: deep(np.dstack([image] * 3))),
    ),
    "pgm odd": (ODD, 0, NO_TIME, stills(".pgm")),
    "webp": (ODD, 0, NO_TIME, stills(".webp")),
    "bmp": (ODD, 0, NO_TIME, stills(".BMP")),
}


@pytest.mark.parametrize("kind", KINDS)
def test_contract(tmp_path: Path, kind: str) -> None:
    (width, height), error, time_base, make = KINDS[kind]
    truth = scene(width, height)
    stream, images = read_all(make(tmp_path / kind, truth))

    assert (stream.width, stream.height) == (width, height)
    assert stream.expected_images == len(images) == COUNT
    assert [image.number for image in images] == list(range(COUNT))
    assert [number_in(image.grey) for image in images] == list(range(COUNT))
    for image, expected in zip(images, truth, strict=True):
        assert image.grey.dtype == np.uint8
        assert image.grey.flags.c_contiguous
        assert np.abs(image.grey.astype(int) - expected).max() <= error
    assert stream.time_base == time_base
    if time_base is None:
        assert [image.pts for image in images] == list(range(COUNT))
    else:
        for index, image in enumerate(images):
            assert image.pts * time_base == pytest.approx(index / 30, abs=0.0006)
    assert (stream.lost, stream.flawed, stream.damage) == (0, 0, [])


@pytest.mark.parametrize("kind", ["h264.mp4", "ffv1 grey odd.mkv", "png odd"])
def test_a_stereo_source_is_its_two_streams(tmp_path: Path, kind: str) -> None:
    (width, height), _, time_base, make = KINDS[kind]
    left = make(tmp_path / f"left {kind}", scene(width, height))
    right = make(tmp_path / f"right {kind}", [255 - image for image in scene(width, height)])
    lefts, rights = read_all(left)[1], read_all(right)[1]
    with open_stereo(left, right) as source:
        frames = list(source)
        assert (source.width, source.height, source.time_base) == (width, height, time_base)
        assert source.expected_frames == COUNT
        assert source.damage == []
        undamaged = {"read": COUNT, "paired": COUNT, "unpaired": 0}
        undamaged |= {"damaged": 0, "flawed": 0, "repeated": 0, "unread": 0}
        assert source.counts == {"skipped": 0, "left": undamaged, "right": undamaged}
    assert [frame.index for frame in frames] == list(range(COUNT))
    for frame, one, other in zip(frames, lefts, rights, strict=True):
        np.testing.assert_array_equal(frame.left, one.grey)
        np.testing.assert_array_equal(frame.right, other.grey)
        assert frame.pts == other.pts
        assert frame.time_s == (None if time_base is None else float(other.pts * time_base))


# --- Grey -------------------------------------------------------------------------------------


def test_limited_luma_is_expanded_and_saturates(tmp_path: Path) -> None:
    luma = np.array([[0, 16, 17, 125, 126, 234, 235, 255]], np.uint8).repeat(8, axis=0)
    (image,) = read_all(encode(tmp_path / "v.mkv", [luma], "ffv1", "gray", LIMITED))[1]
    assert image.grey[0].tolist() == [0, 0, 1, 127, 128, 254, 255, 255]


def test_untagged_yuv_is_limited_and_untagged_grey_is_full(tmp_path: Path) -> None:
    luma = np.full((16, 16), 126, np.uint8)
    for pixel_format, expected in (("gray", 126), ("yuv420p", 126)):
        path = encode(tmp_path / f"{pixel_format}.mkv", [luma], "ffv1", pixel_format)
        stream, (image,) = read_all(path)
        assert np.unique(image.grey).tolist() == [expected]
        assert stream.describe()["range"] == ("full" if pixel_format == "gray" else "limited")


PRIMARIES = np.array([[[255, 0, 0], [0, 255, 0], [0, 0, 255]]], np.uint8)
BT601 = [76, 150, 29]  # 0.299 * 255, 0.587 * 255, 0.114 * 255


def test_colour_becomes_bt601_luma(tmp_path: Path) -> None:
    colours = PRIMARIES.repeat(16, axis=0).repeat(16, axis=1)
    film = encode(tmp_path / "v.mkv", [colours], "ffv1", "bgr0", FULL, rgb=True)
    images = folder(tmp_path / "images", [colours[:, :, ::-1].copy()], ".png")  # cv2: BGR
    for path in (film, images):
        (image,) = read_all(path)[1]
        assert image.grey[0, ::16].tolist() == BT601


def test_sixteen_bits_are_rounded(tmp_path: Path) -> None:
    levels = np.array([[0, 128, 129, 257, 32896, 65406, 65407, 65535]], np.uint16)
    (image,) = read_all(folder(tmp_path / "images", [levels], ".png"))[1]
    assert image.grey[0].tolist() == [0, 0, 1, 1, 128, 254, 255, 255]


@pytest.mark.parametrize(("degrees", "quarters"), [(90, 1), (180, 2), (-90, 3)])
def test_rotation_metadata_is_obeyed(tmp_path: Path, degrees: int, quarters: int) -> None:
    truth = scene()[:2]
    path = encode(tmp_path / "v.mp4", truth, "libx264", "yuv420p", options=SHARP, degrees=degrees)
    stream, images = read_all(path)
    expected = np.rot90(truth[0], quarters)  # counter-clockwise
    assert (stream.height, stream.width) == expected.shape
    assert np.abs(images[0].grey.astype(int) - expected).max() <= 4


# --- Time -------------------------------------------------------------------------------------


def test_time_stamps_are_those_of_the_file(tmp_path: Path) -> None:
    pts = [5, 6, 9, 10, 20]
    path = encode(tmp_path / "v.mp4", scene(count=5), "libx264", "yuv420p", pts=pts)
    stream, images = read_all(path)
    assert stream.time_base is not None
    times_s = [float(image.pts * stream.time_base) for image in images]
    assert times_s == pytest.approx([each / 30 for each in pts], abs=1e-3)
    assert [image.number for image in images] == [0, 1, 2, 3, 4]
    assert stream.damage == []


# --- Damage -----------------------------------------------------------------------------------


@pytest.fixture
def mjpeg(tmp_path: Path) -> Path:
    return encode(tmp_path / "whole.mkv", scene(), "mjpeg", "yuvj420p", FULL)


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
@pytest.mark.parametrize(
    ("lost_left", "lost_right"),
    [({4}, set()), (set(), {4, 5}), ({3, 8}, {3, 6}), ({0}, {1}), (set(range(2, 8)), set())],
)
def test_streams_stay_in_step_when_images_cannot_be_decoded(
    tmp_path: Path, mjpeg: Path, suffix: str, lost_left: set[int], lost_right: set[int]
) -> None:
    left = remux(mjpeg, tmp_path / f"left{suffix}", spoil(lost_left, b"no image"))
    right = remux(mjpeg, tmp_path / f"right{suffix}", spoil(lost_right, b"no image"))
    check_in_step(left, right, lost_left, lost_right)


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
@pytest.mark.parametrize(
    ("lost_left", "lost_right"),
    [({4}, set()), (set(), {4, 5}), ({3, 8}, {3, 6}), (set(range(2, 8)), set())],
)
def test_streams_stay_in_step_when_images_are_gone_from_the_file(
    tmp_path: Path, mjpeg: Path, suffix: str, lost_left: set[int], lost_right: set[int]
) -> None:
    left = remux(mjpeg, tmp_path / f"left{suffix}", spoil(lost_left, None))
    right = remux(mjpeg, tmp_path / f"right{suffix}", spoil(lost_right, None))
    check_in_step(left, right, lost_left, lost_right)


def spoil(lost: set[int], content: bytes | None) -> Callable[[int, bytes], bytes | None]:
    return lambda index, packet: content if index in lost else packet


def check_in_step(left: Path, right: Path, lost_left: set[int], lost_right: set[int]) -> None:
    with open_stereo(left, right) as source:
        pairs = [(number_in(frame.left), number_in(frame.right)) for frame in source]
        counts, damage = source.counts, source.damage
    whole = sorted(set(range(COUNT)) - lost_left - lost_right)
    assert pairs == [(number, number) for number in whole]
    for side, lost, other in (("left", lost_left, lost_right), ("right", lost_right, lost_left)):
        assert counts[side] == {
            "read": COUNT,
            "paired": len(whole),
            "unpaired": len(other - lost),
            "damaged": len(lost),
            "flawed": 0,
            "repeated": 0,
            "unread": 0,
        }
    assert any(str(left) in line for line in damage) == bool(lost_left | lost_right)


def test_an_irregular_rate_is_no_damage(tmp_path: Path) -> None:
    pts = [0, 10, 11, 25, 26, 27]
    stream, images = read_all(encode(tmp_path / "v.mkv", scene(count=6), "ffv1", "gray", pts=pts))
    assert [image.number for image in images] == [0, 1, 2, 3, 4, 5]
    assert stream.damage == []


def test_empty_places_in_an_avi_are_no_damage(tmp_path: Path, mjpeg: Path) -> None:
    # Milliseconds as time base: FFmpeg fills the AVI with 32 empty places between two images.
    stream, images = read_all(remux(mjpeg, tmp_path / "v.avi", lambda _, packet: packet))
    assert [image.number for image in images] == list(range(COUNT))
    assert stream.damage == []


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".avi"])
@pytest.mark.parametrize("share", [0.5, 0.65, 0.8])
def test_truncated_video_keeps_what_is_there_and_counts_the_rest(
    tmp_path: Path, suffix: str, share: float
) -> None:
    first = encode(tmp_path / f"first{suffix}", scene(), "mjpeg", "yuvj420p", FULL)
    whole = remux(first, tmp_path / f"copy{suffix}", lambda _, packet: packet)
    assert read_all(whole)[0].damage == []
    path = cut(whole, tmp_path / f"cut{suffix}", share)
    stream, images = read_all(path)
    assert 2 <= len(images) < COUNT
    assert [number_in(image.grey) for image in images] == list(range(len(images)))
    assert len(images) + stream.lost == COUNT
    assert any("missing at its end" in line for line in stream.damage)

    with open_stereo(path, whole) as source:
        assert sum(1 for _ in source) == len(images)
        right = source.counts["right"]
        assert (right["unpaired"], right["unread"]) == (1, COUNT - len(images) - 1)
        assert re.search(r"copy.*about \d+ images? longer", source.damage[-1])


def test_damaged_video_decodes_the_same_each_time_and_says_so(tmp_path: Path) -> None:
    noise = np.random.default_rng(0)
    images = [noise.integers(0, 256, (128, 128)).astype(np.uint8) for _ in range(16)]
    whole = encode(tmp_path / "whole.mp4", images, "libx264", "yuv420p", options={"slices": "4"})

    def flip(index: int, packet: bytes) -> bytes:
        middle = len(packet) // 2
        return packet[:middle] + bytes(200) + packet[middle + 200 :] if index == 5 else packet

    path = remux(whole, tmp_path / "damaged.mp4", flip)
    runs = []
    for _ in range(3):
        stream, read = read_all(path)
        assert stream.flawed > 0
        assert stream.lost == 0
        assert any(str(path) in line for line in stream.damage)
        runs.append(b"".join(image.grey.tobytes() for image in read))
    assert runs[0] == runs[1] == runs[2]


def test_an_unreadable_image_costs_its_pair_alone(tmp_path: Path) -> None:
    left = folder(tmp_path / "left", scene(), ".png")
    right = folder(tmp_path / "right", scene(), ".jpg")
    cut(left / "frame3.png", left / "frame3.png", 0.5)
    (left / "frame0.png").write_bytes(b"")
    (right / "frame7.jpg").write_text("no image")
    with open_stereo(left, right) as source:
        pairs = [(number_in(frame.left), number_in(frame.right)) for frame in source]
        assert pairs == [(n, n) for n in range(COUNT) if n not in (0, 3, 7)]
        assert source.counts["left"] == {
            "read": 12,
            "paired": 9,
            "unpaired": 1,
            "damaged": 2,
            "flawed": 0,
            "repeated": 0,
            "unread": 0,
        }
        assert source.damage[0] == (f"{left}: 2 images could not be read, the first is frame0.png")


def test_the_common_part_of_different_lengths(tmp_path: Path) -> None:
    left = folder(tmp_path / "left", scene(count=5), ".png")
    right = folder(tmp_path / "right", scene(count=8), ".png")
    with open_stereo(left, right) as source:
        assert source.expected_frames == 5
        assert len(list(source)) == 5
        counts = source.counts["right"]
        assert (counts["unpaired"], counts["unread"]) == (1, 2)
        assert source.damage == [
            f"{right}: about 3 images longer than the other side: "
            "only the common part was processed"
        ]


# --- What cannot be opened --------------------------------------------------------------------


def text_named_mp4(path: Path) -> Path:
    (path / "bad.mp4").write_text("Dear diary,\n" * 99)
    return path / "bad.mp4"


def empty_file(path: Path) -> Path:
    (path / "bad.mp4").touch()
    return path / "bad.mp4"


def mp4_without_index(path: Path) -> Path:
    whole = encode(path / "whole.mp4", scene(), "libx264", "yuv420p")
    return cut(whole, path / "bad.mp4", 0.5)


def sound_alone(path: Path) -> Path:
    with av.open(str(path / "bad.mkv"), "w") as container:
        stream: Any = container.add_stream("pcm_s16le", rate=8000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), "s16", "mono")
        frame.sample_rate = 8000
        container.mux(stream.encode(frame))
    return path / "bad.mkv"


def nothing_decodable(path: Path) -> Path:
    whole = encode(path / "whole.mkv", scene(), "mjpeg", "yuvj420p", FULL)
    return remux(whole, path / "bad.mkv", lambda *_: b"no image")


def empty_folder(path: Path) -> Path:
    (path / "bad").mkdir()
    (path / "bad" / "notes.txt").touch()
    return path / "bad"


def folder_of_unreadable_images(path: Path) -> Path:
    (path / "bad").mkdir()
    (path / "bad" / "frame0.png").touch()
    return path / "bad"


def float_images(path: Path) -> Path:
    return folder(path / "bad", [image.astype(np.float32) for image in scene()], ".tiff")


def other_size(path: Path) -> Path:
    return folder(path / "bad", scene(width=80), ".png")


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (lambda path: path / "bad.mp4", "there is no file or folder"),
        (text_named_mp4, "is not a video that can be decoded"),
        (empty_file, "is not a video that can be decoded"),
        (mp4_without_index, "is not a video that can be decoded"),
        (sound_alone, "has no video stream"),
        (nothing_decodable, "none of its images can be decoded"),
        (empty_folder, "has no images"),
        (folder_of_unreadable_images, "none of its images can be decoded"),
        (float_images, "float32 pixels"),
        (other_size, "64x48.*80x48|80x48.*64x48"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_unusable_input(
    tmp_path: Path, make: Callable[[Path], Path], complaint: str, capfd: Any
) -> None:
    good, bad = folder(tmp_path / "good", scene(), ".png"), make(tmp_path)
    capfd.readouterr()
    for left, right in ((good, bad), (bad, good)):
        with pytest.raises(InputError, match=complaint) as caught:
            open_stereo(left, right)
        assert "\n" not in str(caught.value)
        assert str(bad) in str(caught.value)
    assert capfd.readouterr() == ("", "")  # FFmpeg keeps silent


def test_the_same_recording_twice(tmp_path: Path) -> None:
    images = folder(tmp_path / "images", scene(), ".png")
    link = tmp_path / "link"
    link.symlink_to(images)
    for other in (images, link, tmp_path / "images" / ".." / "images"):
        with pytest.raises(InputError, match="are the same recording"):
            open_stereo(images, other)


def test_folder_with_images_of_different_size(tmp_path: Path) -> None:
    left = folder(tmp_path / "left", scene(), ".png")
    right = folder(tmp_path / "right", scene(), ".png")
    assert cv2.imwrite(str(right / "frame7.png"), scene(width=80)[7])
    with (
        open_stereo(left, right) as source,
        pytest.raises(InputError, match=r"frame7\.png is 80x48 but .* 64x48"),
    ):
        list(source)


# --- Folders ----------------------------------------------------------------------------------


def test_files_other_than_images_are_passed_over(tmp_path: Path) -> None:
    path = folder(tmp_path / "images", scene(count=11), ".png")
    (path / "frame1.txt").touch()
    (path / "rig.yaml").touch()
    (path / ".png").touch()  # a hidden file without suffix
    assert [number_in(image.grey) for image in read_all(path)[1]] == list(range(11))


def test_orientation_noted_by_the_camera_is_obeyed(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    image = scene()[0]
    # Exif tag 0x0112, Orientation, 6: turn clockwise.
    exif = bytes.fromhex("457869660000 49492A0008000000 0100 1201 0300 01000000 06000000 00000000")
    iio.imwrite(tmp_path / "images" / "a.jpg", image, exif=exif, quality=95)
    stream, (read,) = read_all(tmp_path / "images")
    assert (stream.width, stream.height) == (48, 64)
    assert np.abs(read.grey.astype(int) - np.rot90(image, -1)).max() <= 6


@given(st.lists(st.integers(0, 10**6), unique=True))
def test_names_sort_by_their_numbers(values: list[int]) -> None:
    names = [f"frame{value}.png" for value in values]
    assert sorted(names, key=natural_key) == [f"frame{value}.png" for value in sorted(values)]


def test_natural_order_of_mixed_names() -> None:
    names = ["b1", "a10b2", "a2", "a", "10", "9", "a10b10", "a02"]
    assert sorted(names, key=natural_key) == ["9", "10", "a", "a2", "a02", "a10b2", "a10b10", "b1"]


# --- Description ------------------------------------------------------------------------------


def test_description_of_a_video_and_of_a_folder(tmp_path: Path) -> None:
    film = encode(tmp_path / "v.mp4", scene(), "libx264", "yuv420p", LIMITED)
    images = folder(tmp_path / "images", scene(count=2), ".png")
    with open_stereo(film, images) as source:
        described = json.loads(json.dumps(source.describe()))
    assert described["left"] == {
        "path": str(film),
        "kind": "video",
        "codec": "h264",
        "pixel_format": "yuv420p",
        "range": "limited",
        "rotation_deg": 0,
        "width": 64,
        "height": 48,
        "frame_rate": "30",
        "images": 12,
        "bytes": film.stat().st_size,
        "sha256": hashlib.sha256(film.read_bytes()).hexdigest(),
    }
    files = [images / "frame0.png", images / "frame1.png"]
    sums = "".join(
        f"{hashlib.sha256(file.read_bytes()).hexdigest()}  {file.name}\n" for file in files
    )
    assert described["right"] == {
        "path": str(images),
        "kind": "images",
        "codec": "png",
        "pixel_format": "grey 8 bit",
        "range": "full",
        "rotation_deg": 0,
        "width": 64,
        "height": 48,
        "frame_rate": None,
        "images": 2,
        "bytes": sum(file.stat().st_size for file in files),
        "sha256": hashlib.sha256(sums.encode()).hexdigest(),
    }


# --- Working ahead ----------------------------------------------------------------------------


def threads() -> list[threading.Thread]:
    return [each for each in threading.enumerate() if each.name == "prefetch"]


@given(st.lists(st.integers()), st.integers(1, 5))
def test_prefetch_keeps_items_and_order(items: list[int], depth: int) -> None:
    assert list(prefetch(items, depth)) == items
    assert threads() == []


def test_prefetch_works_ahead_by_its_depth_and_no_further() -> None:
    made = threading.Semaphore(0)
    count = itertools.count()

    def items() -> Iterator[int]:
        while True:
            yield next(count)
            made.release()

    ahead = prefetch(items(), 3)
    assert next(ahead) == 0
    for _ in range(3):
        assert made.acquire(timeout=10)
    assert not made.acquire(timeout=0.2)
    ahead.close()
    assert threads() == []


def test_prefetch_raises_an_error_after_the_items_before_it() -> None:
    def items() -> Iterator[int]:
        yield 1
        raise InputError("no more")

    ahead = prefetch(items(), 4)
    assert next(ahead) == 1
    with pytest.raises(InputError, match="no more"):
        next(ahead)
    assert threads() == []


def test_leaving_in_mid_stream_leaves_no_thread(tmp_path: Path) -> None:
    left = encode(tmp_path / "left.mkv", scene(count=200), "ffv1", "gray")
    right = encode(tmp_path / "right.mkv", scene(count=200), "ffv1", "gray")
    with open_stereo(left, right) as source:
        frames = iter(source)
        next(frames)
        assert len(threads()) == 2
    assert threads() == []
    assert next(frames, None) is None


# --- Seeking ----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_contract_of_seeking(tmp_path: Path, kind: str) -> None:
    (width, height), _, _, make = KINDS[kind]
    path = make(tmp_path / kind, scene(width, height))
    through = [(image.number, image.pts, image.grey.tobytes()) for image in read_all(path)[1]]
    for number in (0, 1, 5, COUNT - 1, COUNT):
        recording = open_recording(path)
        recording.skip_to(number)
        found = [(image.number, image.pts, image.grey.tobytes()) for image in recording]
        assert found == through[number:]
        assert recording.damage == []
        recording.close()


GROUPS = {"g": "4", "sc_threshold": "0"}


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
@pytest.mark.parametrize("frames_between", ["0", "2"])
@pytest.mark.parametrize("lost", [set(), {3, 8}])
def test_seeking_is_decoding_through(
    tmp_path: Path, suffix: str, frames_between: str, lost: set[int]
) -> None:
    kept = [n for n in range(24) if n not in lost]
    images = [scene(count=24)[n] for n in kept]
    options = GROUPS | {"bf": frames_between}
    path = encode(tmp_path / f"v{suffix}", images, "libx264", "yuv420p", options=options, pts=kept)
    through = [(image.number, image.pts, image.grey.tobytes()) for image in read_all(path)[1]]
    assert [number for number, *_ in through] == kept
    for number in range(24):
        recording = VideoRecording(path)
        sought = recording.skip_to(number)
        found = [(image.number, image.pts, image.grey.tobytes()) for image in recording]
        assert found == [each for each in through if each[0] >= number]
        assert recording.lost == len(lost)
        assert sought == (number > 4 + len([n for n in lost if n < 5]) - 1)
        recording.close()


def test_images_that_cannot_be_decoded_keep_their_numbers(tmp_path: Path, mjpeg: Path) -> None:
    path = remux(mjpeg, tmp_path / "v.mkv", spoil({2, 5, 6}, b"no image"))
    through = [(image.number, image.pts) for image in read_all(path)[1]]
    for number in range(1, COUNT):
        recording = VideoRecording(path)
        recording.skip_to(number)
        found = [(image.number, image.pts) for image in recording]
        assert found == [each for each in through if each[0] >= number]
        recording.close()


@pytest.mark.parametrize(
    ("codec", "options", "silent"),
    [
        ("mpeg4", {"g": "100"}, True),
        ("libvpx-vp9", {"g": "100", "deadline": "realtime"}, True),
        ("libx264", {"g": "100", "bf": "0"}, False),
        ("mjpeg", {}, False),
    ],
)
def test_behind_a_hole_it_is_said_where_nothing_tells_what_is_wrong(
    tmp_path: Path, codec: str, options: dict[str, str], silent: bool
) -> None:
    pixels = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    whole = encode(tmp_path / "whole.mkv", scene(), codec, pixels, options=options)
    torn = remux(whole, tmp_path / "torn.mkv", lambda index, packet: packet if index != 5 else None)
    stream, shown = read_all(torn)
    assert len(shown) == COUNT - 1
    assert stream.lost == 1
    assert ("next key frame may be wrong" in " ".join(stream.damage)) == silent
    assert (stream.flawed > 0) == (codec == "libx264")
