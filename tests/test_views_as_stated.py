"""Views that a recording itself says it holds, and views turned by those who mounted the camera."""

from __future__ import annotations

import hashlib
import math
import struct
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from av.sidedata.sidedata import Type
from numpy.typing import NDArray
from PIL import Image as Pillow
from recordings import COUNT, Images, cut, encode, folder, number_in, scene
from spatial import SERIAL, stamp_ns, svo2, vr180, with_boxes

from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.rig.calibration import rectify_source
from motionstereo_cli.runs.opening import check_size
from motionstereo_cli.sinks.records import InputRecord
from motionstereo_cli.sources import open_stereo
from motionstereo_cli.sources.multiview import eyes_in
from motionstereo_cli.sources.settings import InputSettings
from motionstereo_cli.sources.stereo3d import ViewMetadata
from motionstereo_cli.types import Rig

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


@pytest.mark.parametrize(
    ("mode", "said"),
    [
        ("row_interleaved_lr", "in alternate rows, which is not read: .*stereo3d=irl:sbsl"),
        ("row_interleaved_rl", "in alternate rows, .*stereo3d=irr:sbsl"),
        ("col_interleaved_lr", "in alternate columns, .*stereo3d=icl:sbsl"),
        ("checkerboard_rl", "as a checkerboard, .*convert them to views side by side"),
        ("block_lr", "one after the other, frame by frame, .*stereo3d=al:sbsl"),
        ("anaglyph_cyan_red", r"in the colours of one image \(anaglyph\), .*each view whole"),
        ("anaglyph_green_magenta", r"in the colours of one image \(anaglyph\)"),
    ],
)
def test_ways_of_stating_that_are_not_read(tmp_path: Path, mode: str, said: str) -> None:
    path = matroska(tmp_path / "v.mkv", BESIDE, mode)
    for layout in ("two", "side-by-side"):
        with pytest.raises(InputError, match=rf"v\.mkv says that both views lie {said}"):
            open_stereo(path, settings=InputSettings(layout=layout))


# --- Spherical video --------------------------------------------------------------------------


def test_what_is_spherical_is_refused_or_projected(tmp_path: Path) -> None:
    def world(azimuth: Any, height: Any) -> Any:
        return 128 + 60 * np.sin(3 * azimuth) + 60 * np.sin(4 * height)

    # Rows and columns of a view are angles: latitude and longitude of rays (x, y, 1).
    down, across = ((np.arange(96) + 0.5) / 96 - 0.5) * np.pi, (np.arange(96) + 0.5) / 96 * np.pi
    longitude, latitude = np.meshgrid(across - np.pi / 2, down)
    view = world(longitude, np.clip(np.tan(latitude) / np.cos(longitude), -1, 1)).astype(np.uint8)
    both = [np.hstack([view, 255 - view])] * 3
    path = encode(tmp_path / "v.mp4", both, "libx264", "yuv420p", options={"crf": "1"})
    with_boxes(path, vr180())
    for layout in ("two", "side-by-side"):
        with pytest.raises(InputError, match=r"spherical \(equirectangular, 180x180 degrees\)"):
            open_stereo(path, settings=InputSettings(layout=layout))
    with open_stereo(path, settings=InputSettings(project=True)) as source:
        frame = next(iter(source))
        assert (source.width, source.height) == (62, 62)
        assert source.projected_focal_px == pytest.approx(31)
        assert InputRecord(**source.describe()["both"]).projection == (
            "equirectangular, 180x180 degrees"
        )
        other = Rig(width=96, height=96, focal_px=50, baseline_m=0.06, cx=48, cy=48)
        with pytest.raises(InputError, match=r"focal_px 31, cx 30\.5, cy 30\.5, and the base"):
            check_size(other, source)
    middle = (np.arange(62) - 30.5) / 31
    x, y = np.meshgrid(middle, middle)
    truth = world(np.arctan(x), np.clip(y, -1, 1))
    for image, expected in ((frame.left, truth), (frame.right, 255 - truth)):
        assert np.abs(image - expected)[2:-2].max() < 8


def test_what_cannot_be_projected(tmp_path: Path) -> None:
    path = encode(tmp_path / "v.mp4", BESIDE, "libx264", "yuv420p")
    with pytest.raises(SettingsError, match="--project is for spherical video"):
        open_stereo(path, settings=InputSettings(layout="side-by-side", project=True))
    with_boxes(path, vr180(degrees=80))
    with pytest.raises(InputError, match=r"80x180 degrees\), which is not read"):
        open_stereo(path, settings=InputSettings(project=True))


# --- Spatial video ----------------------------------------------------------------------------


@pytest.fixture
def spatial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A video whose images say that they are views 0 and 1 in turn; the first is the right one."""

    def view(frame: av.VideoFrame) -> int:
        return (frame.pts or 0) // 512 % 2

    def said(frame: av.VideoFrame, _: object) -> ViewMetadata:
        return ViewMetadata(eye=("right", "left")[view(frame)], baseline_m=0.02, width_deg=60)

    for module in ("video", "multiview"):
        monkeypatch.setattr(f"motionstereo_cli.sources.{module}.view_id", view)
        monkeypatch.setattr(f"motionstereo_cli.sources.{module}.view_metadata", said)
    return encode(tmp_path / "v.mp4", LEFTS, "libx264", "yuv420p", options={"crf": "1"})


def test_spatial_video_is_two_recordings(spatial: Path) -> None:
    assert eyes_in(spatial, InputSettings(), 0) == {"left": 1, "right": 0}
    with open_stereo(spatial) as source:
        assert list(source.describe(fingerprint=False)) == ["left", "right"]
        assert InputRecord(**source.describe()["left"]).view == "right"  # by its first image
        calibration = rectify_source(source, ())
        assert len(list(source)) == COUNT
    assert calibration is not None
    assert calibration.rig.baseline_m == pytest.approx(0.02)
    assert calibration.rig.focal_px == pytest.approx(32 / math.tan(math.radians(30)))
    assert "20 mm apart and see 60 degrees: depth follows from these" in calibration.warnings[0]


def test_spatial_video_that_lost_a_view_is_named(
    spatial: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("motionstereo_cli.sources.multiview.view_id", lambda _: 0)
    with pytest.raises(InputError, match=r"only one view can be decoded \(right\)"):
        open_stereo(spatial)


def test_side_data_without_a_name_is_passed_over() -> None:
    assert (Type(29).value, Type(9999).name) == (29, "KIND_9999")
    assert Type(2) is Type.STEREO3D


# --- SVO2 -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("codec", "compression"), [("h264", "none"), ("h265", "lz4"), ("jpeg", "zstd")]
)
def test_svo2_is_read_as_a_video_is(tmp_path: Path, codec: str, compression: str) -> None:
    path = svo2(tmp_path / "drive.svo2", BESIDE, codec, compression)
    with open_stereo(path) as source:
        frames = list(source)
        assert source.counts["left"] | source.counts["right"] == {
            **{"read": 12, "paired": 12, "unpaired": 0, "damaged": 0},
            **{"flawed": 0, "repeated": 0, "unread": 0},
        }
        assert (source.damage, source.warnings) == ([], [])
        told = source.describe()["both"]
        assert (told["serial_number"], told["images"]) == (str(SERIAL), 12)
        assert told["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
        assert f"SN{SERIAL}.conf" in source.calibration_notes[0]
    assert [frame.pts for frame in frames] == [stamp_ns(n) for n in range(COUNT)]
    luma = [np.clip((each.astype(int) - 16) * 255 / 219, 0, 255) for each in BESIDE]
    for frame, truth in zip(frames, luma, strict=True):
        assert np.abs(np.hstack([frame.left, frame.right]) - truth).max() < 6


@pytest.mark.parametrize("codec", ["h264", "jpeg"])
def test_svo2_that_was_cut_off_gives_what_is_before_the_cut(tmp_path: Path, codec: str) -> None:
    whole = svo2(tmp_path / "whole.svo2", BESIDE, codec)
    with open_stereo(whole) as source:
        expected = list(source)
    path = cut(whole, tmp_path / "cut.svo2", 0.6)
    with open_stereo(path) as source:
        frames = list(source)
        assert source.damage == [f"{path}: reading stopped early: it is cut off"]
        assert source.frame_rate == 30
    assert 3 < len(frames) < COUNT
    for frame, truth in zip(frames, expected, strict=False):
        np.testing.assert_array_equal(frame.left, truth.left)


def test_damaged_messages_of_svo2_are_counted(tmp_path: Path) -> None:
    path = svo2(tmp_path / "drive.svo2", BESIDE, "jpeg")
    content = bytearray(path.read_bytes())
    at = content.find(b"\xff\xd8", len(content) // 2)
    content[at + 2 : at + 40] = bytes(38)
    path.write_bytes(content)
    with open_stereo(path) as source:
        assert len(list(source)) == COUNT - 1
        assert source.counts["left"]["damaged"] == 1
        assert source.damage == [f"{path}: 1 image could not be decoded"]


@pytest.mark.parametrize("content", [b"", b"none of it", b"\x89MCAP0\r\n" * 3])
def test_what_is_no_svo2_is_named(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.svo2"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"x\.svo2: none of its images can be decoded"):
        open_stereo(path)


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
        ("a.svo", "an older ZED recording: export it with ZED_SVO_Export"),
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


def test_a_time_that_no_clock_has_is_damage(tmp_path: Path) -> None:
    path = svo2(tmp_path / "a.svo2", BESIDE, "h264")
    footer = bytes(24) + struct.pack("<Q", stamp_ns(5)) + bytes(24)
    before, after = path.read_bytes().split(footer)
    path.write_bytes(before + footer.replace(footer[24:32], b"\xff" * 8) + after)
    with open_stereo(path) as source:
        assert len(list(source)) == COUNT - 1
        assert source.counts["left"]["damaged"] == 1
