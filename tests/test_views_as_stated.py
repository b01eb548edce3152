"""Views that a recording itself says it holds, and views turned by those who mounted the camera."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image as Pillow
from recordings import Images, encode, folder, number_in, scene

from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.sources import open_stereo
from motionstereo_cli.sources.settings import InputSettings
from motionstereo_cli.sources.video import VideoRecording

LEFTS, RIGHTS = scene(), [255 - image for image in scene()]
BESIDE = [np.hstack(each) for each in zip(LEFTS, RIGHTS, strict=True)]
ABOVE = [np.vstack(each) for each in zip(LEFTS, RIGHTS, strict=True)]


def matroska(path: Path, images: Images, mode: str) -> Path:
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("ffv1", rate=30)
        stream.height, stream.width = images[0].shape
        stream.pix_fmt = "gray"
        stream.metadata["stereo_mode"] = mode
        for index, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, "gray")
            frame.pts, frame.time_base = index, Fraction(1, 30)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


@pytest.mark.parametrize(
    ("mode", "images", "layout", "swapped"),
    [
        ("left_right", BESIDE, "side-by-side", False),
        ("right_left", BESIDE, "side-by-side", True),
        ("top_bottom", ABOVE, "top-bottom", False),
        ("bottom_top", ABOVE, "top-bottom", True),
    ],
)
def test_matroska_states_the_layout(
    tmp_path: Path, mode: str, images: Images, layout: str, swapped: bool
) -> None:
    path = matroska(tmp_path / "v.mkv", images, mode)
    for swap in (False, True):
        with open_stereo(path, settings=InputSettings(swap=swap)) as source:
            assert (source.settings.layout, source.settings.swap) == (layout, swapped != swap)
            frame = next(iter(source))
        views = (RIGHTS[0], LEFTS[0]) if swapped != swap else (LEFTS[0], RIGHTS[0])
        np.testing.assert_array_equal((frame.left, frame.right), views)


def test_wide_pixels_are_squeezed_views(tmp_path: Path) -> None:
    options = {"x264-params": "frame-packing=3:sar=2/1"}
    path = encode(tmp_path / "v.mp4", BESIDE, "libx264", "yuv420p", options=options)
    with open_stereo(path) as source:
        assert source.settings.layout == "side-by-side-half"
        assert (source.width, source.height) == (128, 48)


def test_h264_states_the_layout_in_any_container(tmp_path: Path) -> None:
    for packing, images, layout in (("3", BESIDE, "side-by-side"), ("4", ABOVE, "top-bottom")):
        options = {"x264-params": f"frame-packing={packing}", "crf": "1"}
        path = encode(tmp_path / "v.mp4", images, "libx264", "yuv420p", options=options)
        with open_stereo(path) as source:
            assert source.settings.layout == layout
            assert number_in(list(source)[3].left) == 3


def test_what_is_stated_and_what_is_given_may_differ(tmp_path: Path) -> None:
    path = matroska(tmp_path / "v.mkv", BESIDE, "left_right")
    plain = encode(tmp_path / "w.mkv", BESIDE, "ffv1", "gray")
    with open_stereo(path, settings=InputSettings(layout="top-bottom")) as source:
        assert source.warnings == [
            f"{path} says that its views lie side-by-side: leave --layout out"
        ]
    with open_stereo(path, plain) as source:
        assert (
            "v.mkv says that it holds both views, side-by-side: leave RIGHT out"
            in (source.warnings[0])
        )
    with pytest.raises(SettingsError, match=r"w\.mkv is one recording: give RIGHT as well"):
        open_stereo(plain)


def test_ways_of_stating_that_are_not_read(tmp_path: Path) -> None:
    path = matroska(tmp_path / "v.mkv", BESIDE, "row_interleaved_lr")
    with contextlib.closing(VideoRecording(path)) as recording:
        assert recording.stated is None
        assert "says that it holds two views in a way that is not read" in recording.warnings[0]


# --- Stills -----------------------------------------------------------------------------------


def mpo(path: Path) -> None:
    left, right = (Pillow.fromarray(images[5]) for images in (LEFTS, RIGHTS))
    left.save(path, "MPO", save_all=True, append_images=[right], quality=95)


def jps(path: Path, descriptor: bytes = b"") -> None:
    images = BESIDE if descriptor[2:3] != b"\3" else ABOVE
    done, content = cv2.imencode(".jpg", images[5], [cv2.IMWRITE_JPEG_QUALITY, 95])
    assert done
    mark = b"_JPSJPS_" + len(descriptor).to_bytes(2) + descriptor
    segment = b"\xff\xe3" + (2 + len(mark)).to_bytes(2) + mark if descriptor else b""
    path.write_bytes(content.tobytes()[:2] + segment + content.tobytes()[2:])


@pytest.mark.parametrize(
    ("name", "write", "crossed"),
    [
        ("a.mpo", mpo, False),
        ("a.jps", jps, True),
        ("a.jps", lambda path: jps(path, b"\0\4\2\1"), False),
        ("a.jps", lambda path: jps(path, b"\0\0\2\1"), True),
        ("a.jps", lambda path: jps(path, b"\0\4\3\1"), False),
    ],
)
def test_stills_with_both_views(
    tmp_path: Path, name: str, write: Callable[[Path], None], crossed: bool
) -> None:
    (tmp_path / "both").mkdir()
    path = tmp_path / "both" / name
    write(path)
    for given in (path, path.parent):
        with open_stereo(given) as source:
            (frame,) = source
        left, right = (frame.right, frame.left) if crossed else (frame.left, frame.right)
        assert np.abs(left.astype(int) - LEFTS[5]).max() <= 8
        assert np.abs(right.astype(int) - RIGHTS[5]).max() <= 8


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("a.svo2", "a ZED recording: export it with ZED_SVO_Export"),
        ("a.npz", "NumPy's arrays: write each as an image"),
        ("a.HEIC", "a HEIF image: convert it"),
        ("calibration.yaml", "a calibration goes to --rig"),
        ("a.zip", "an archive: unpack it"),
    ],
)
def test_files_of_others_are_named(tmp_path: Path, name: str, said: str) -> None:
    (tmp_path / name).write_bytes(b"PK\3\4" + bytes(99))
    images = folder(tmp_path / "images", LEFTS, ".png")
    with pytest.raises(InputError, match=said):
        open_stereo(tmp_path / name, images)


# --- Turns ------------------------------------------------------------------------------------

Turn = Callable[[NDArray[np.uint8]], NDArray[np.uint8]]

TURNS: list[tuple[dict[str, Any], Turn]] = [
    ({"rotate_right": 180}, lambda image: np.rot90(image, 2)),
    ({"rotate_right": 90}, lambda image: np.rot90(image, 1)),
    ({"rotate_right": 270}, lambda image: np.rot90(image, -1)),
    ({"mirror_right": True}, lambda image: image[:, ::-1]),
    ({"mirror_right": True, "rotate_right": 180}, lambda image: image[::-1]),
]


@pytest.mark.parametrize(("settings", "turn"), TURNS)
def test_views_are_turned_back(tmp_path: Path, settings: dict[str, Any], turn: Turn) -> None:
    images = [np.ascontiguousarray(turn(image)) for image in RIGHTS]
    left = folder(tmp_path / "left", LEFTS, ".png")
    right = folder(tmp_path / "right", images, ".png")
    with open_stereo(left, right, InputSettings(**settings)) as source:
        frame = list(source)[5]
        assert (source.view_width, source.view_height) == (64, 48)
    np.testing.assert_array_equal(frame.left, LEFTS[5])
    np.testing.assert_array_equal(frame.right, RIGHTS[5])
    assert frame.right.flags.c_contiguous


@pytest.mark.parametrize("swap", [False, True])
def test_halves_are_turned_before_they_are_rectified(tmp_path: Path, swap: bool) -> None:
    images = [
        np.hstack([left, right[::-1, ::-1]]) for left, right in zip(LEFTS, RIGHTS, strict=True)
    ]
    path = folder(tmp_path / "both", images, ".png")
    turn = {"rotate_left" if swap else "rotate_right": 180}
    with open_stereo(
        path, settings=InputSettings(layout="side-by-side", swap=swap, **turn)
    ) as source:
        source.rectify(lambda view: view, lambda view: view // 2)
        frame = next(iter(source))
    left, right = (RIGHTS, LEFTS) if swap else (LEFTS, RIGHTS)
    np.testing.assert_array_equal(frame.left, left[0])
    np.testing.assert_array_equal(frame.right, right[0] // 2)


def test_a_view_on_its_side_is_named(tmp_path: Path) -> None:
    left = folder(tmp_path / "left", LEFTS, ".png")
    right = folder(tmp_path / "right", [np.rot90(image) for image in RIGHTS], ".png")  # type: ignore[misc]
    with pytest.raises(InputError, match=r"64x48 but .* 48x64: .*turn one with --rotate-right 90"):
        open_stereo(left, right)
    with pytest.raises(SettingsError, match=r"--rotate-left cannot be 45"):
        InputSettings(rotate_left=45)
