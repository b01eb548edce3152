"""Views keep their colour for what people look at, and only where somebody asks for it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from bags import Bag
from numpy.typing import NDArray
from recordings import encode, folder
from spatial import svo2

from motionstereo_cli.__main__ import main
from motionstereo_cli.sources import open_stereo
from motionstereo_cli.sources.settings import InputSettings

COUNT = 6


def world(shift: int) -> list[NDArray[np.uint8]]:
    """RGB images of 64 x 48 px: coloured blocks that move."""
    blocks = np.random.default_rng(4).integers(0, 256, (6, 40, 3), np.uint8)
    wide = blocks.repeat(8, axis=0).repeat(8, axis=1)
    return [np.ascontiguousarray(wide[:, 2 * n + shift :][:, :64]) for n in range(COUNT)]


LEFTS, RIGHTS = world(0), world(4)


def as_video(path: Path) -> list[Any]:
    lossless = {"crf": "0", "preset": "ultrafast"}
    return [
        encode(path / name, images, "libx264", "yuv444p", options=lossless, rgb=True)
        for name, images in (("l.mp4", LEFTS), ("r.mp4", RIGHTS))
    ]


def as_folders(path: Path) -> list[Any]:
    return [
        folder(path / name, [image[:, :, ::-1] for image in images], ".png")
        for name, images in (("l", LEFTS), ("r", RIGHTS))
    ]


def as_deep_folders(path: Path) -> list[Any]:
    return [
        folder(path / name, [image[:, :, ::-1] * np.uint16(257) for image in images], ".png")
        for name, images in (("l", LEFTS), ("r", RIGHTS))
    ]


def as_bag(path: Path) -> list[Any]:
    with Bag(path / "a.bag", ".bag") as bag:
        for n, pair in enumerate(zip(LEFTS, RIGHTS, strict=True)):
            for side, image in zip(("left", "right"), pair, strict=True):
                bag.image(f"/{side}/image_raw", image[:, :, ::-1], n * 10**8 + 10**9, "bgr8")
    return [path / "a.bag"]


@pytest.mark.parametrize(
    ("make", "error"), [(as_video, 12), (as_folders, 0), (as_deep_folders, 0), (as_bag, 0)]
)
@pytest.mark.parametrize("camera", ["left", "right"])
def test_contract_of_colours(tmp_path: Path, make: Any, error: int, camera: str) -> None:
    given = make(tmp_path)
    with open_stereo(*given) as source:
        plain = list(source)
    with open_stereo(*given) as source:
        source.keep_colours(camera)
        frames = list(source)
    assert [frame.colours for frame in plain] == [None] * COUNT
    for frame, without, truth in zip(
        frames, plain, {"left": LEFTS, "right": RIGHTS}[camera], strict=True
    ):
        np.testing.assert_array_equal((frame.left, frame.right), (without.left, without.right))
        assert frame.colours is not None
        assert np.abs(frame.colours.astype(int) - truth).max() <= error


def test_colours_follow_layout_rectification_crop_and_scale(tmp_path: Path) -> None:
    both = [np.hstack(pair)[:, :, ::-1] for pair in zip(LEFTS, RIGHTS, strict=True)]
    path = folder(tmp_path / "both", both, ".png")
    settings = InputSettings(
        layout="side-by-side", rotate_left=180, rotate_right=180, crop="8,8,32,24", scale=0.5
    )
    with open_stereo(path, settings=settings) as source:
        source.rectify(lambda view: view[:, ::-1].copy(), lambda view: view[:, ::-1].copy())
        source.keep_colours("right")
        frame = next(iter(source))
    expected = cv2.resize(RIGHTS[0][::-1][8:32, 8:40], (16, 12), interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(frame.colours, expected)


@pytest.mark.parametrize("kind", ["grey video", "neutral video", "svo2", "grey folder"])
def test_what_is_grey_stays_grey(tmp_path: Path, kind: str) -> None:
    greys = [np.hstack([image[:, :, 0]] * 2) for image in LEFTS]
    if kind == "svo2":
        path = svo2(tmp_path / "a.svo2", greys, "jpeg")
    elif kind == "grey folder":
        path = folder(tmp_path / "a", greys, ".png")
    else:
        codec = ("ffv1", "gray") if kind == "grey video" else ("libx264", "yuv420p")
        path = encode(tmp_path / "a.mkv", greys, *codec)
    with open_stereo(path, settings=InputSettings(layout="side-by-side")) as source:
        source.keep_colours("right")
        assert next(iter(source)).colours is None


@pytest.mark.parametrize("pieces", [[], ["--jobs", "2"]])
def test_what_people_look_at_is_in_colour(tmp_path: Path, pieces: list[str]) -> None:
    left, right = map(str, as_folders(tmp_path))
    (tmp_path / "rig.yaml").write_text(
        "width: 64\nheight: 48\nfocal_px: 50\nbaseline_m: 0.1\ncx: 31.5\ncy: 23.5\n"
    )
    out = tmp_path / "out"
    given = ["run", left, right, "--rig", str(tmp_path / "rig.yaml"), "-o", str(out), *pieces]
    assert main([*given, "--save", "points,view-video,preview", "--no-check"]) == 0
    with av.open(str(out / "view.mp4")) as film:
        shown = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    for image, truth in zip(shown, RIGHTS, strict=True):
        inside = np.s_[4::8, 4:56:8]
        assert np.median(np.abs(image[inside].astype(int) - truth[inside])) < 12
    content = (out / f"points/{COUNT - 1:06d}.ply").read_bytes()
    head, _, rows = content.partition(b"end_header\n")
    kind = np.dtype([("place", "<f4", 3), ("look", np.uint8, 3)])
    points = np.frombuffer(rows, kind)
    assert len(points) > 100
    assert b"uchar red" in head
    x, y, z = points["place"].T
    column, row = np.rint(50 * x / z + 31.5).astype(int), np.rint(50 * y / z + 23.5).astype(int)
    np.testing.assert_array_equal(points["look"], RIGHTS[-1][row, column])
