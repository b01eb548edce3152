"""Layouts, pairing, selection, standard input and damage of stereo sources."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from recordings import COUNT, FULL, Images, cut, encode, folder, number_in, remux, scene

from motionstereo_cli.__main__ import main
from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.sources import StereoSource, open_stereo
from motionstereo_cli.sources.names import file_numbers
from motionstereo_cli.sources.pairing import pair
from motionstereo_cli.sources.recording import Image, Recording
from motionstereo_cli.sources.settings import InputSettings, adapted_rig
from motionstereo_cli.types import Rig

RIG = Rig(width=64, height=48, focal_px=50, baseline_m=0.1, cx=31.5, cy=23.5, doffs=2)


def negative(images: Images) -> Images:
    return [255 - image for image in images]


def smooth(images: Images) -> Images:
    """The images without edges, which squeezing would blur."""
    return [cv2.GaussianBlur(image, (0, 0), 3) for image in images]


def squeezed(images: Images, across: int, down: int) -> Images:
    height, width = images[0].shape
    size = (width // across, height // down)
    return [np.asarray(cv2.resize(i, size, interpolation=cv2.INTER_AREA)) for i in images]


def beside(lefts: Images, rights: Images) -> Images:
    return [np.hstack(each) for each in zip(lefts, rights, strict=True)]


def above(lefts: Images, rights: Images) -> Images:
    return [np.vstack(each) for each in zip(lefts, rights, strict=True)]


#: name: (how both views become one image, largest error in grey levels)
LAYOUTS: dict[str, tuple[Callable[[Images, Images], Images], int]] = {
    "side-by-side": (beside, 0),
    "side-by-side-half": (lambda le, ri: beside(squeezed(le, 2, 1), squeezed(ri, 2, 1)), 3),
    "top-bottom": (above, 0),
    "top-bottom-half": (lambda le, ri: above(squeezed(le, 1, 2), squeezed(ri, 1, 2)), 4),
}

Opener = Callable[[Path, Images, InputSettings, pytest.MonkeyPatch], StereoSource]


def as_video(path: Path, images: Images, settings: InputSettings, _: Any) -> StereoSource:
    return open_stereo(encode(path / "both.mkv", images, "ffv1", "gray"), None, settings)


def as_images(path: Path, images: Images, settings: InputSettings, _: Any) -> StereoSource:
    return open_stereo(folder(path / "both", images, ".png"), None, settings)


def as_pipe(
    path: Path, images: Images, settings: InputSettings, patch: pytest.MonkeyPatch
) -> StereoSource:
    film = encode(path / "both.mkv", images, "ffv1", "gray")
    patch.setattr(sys, "stdin", film.open("rb"))
    return open_stereo("-", None, settings)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("opener", [as_video, as_images, as_pipe])
@pytest.mark.parametrize("swap", [False, True])
def test_contract_of_layouts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, layout: str, opener: Opener, swap: bool
) -> None:
    lefts = smooth(scene())
    rights = negative(lefts)
    join, error = LAYOUTS[layout]
    settings = InputSettings(layout=layout, swap=swap)
    with opener(tmp_path, join(lefts, rights), settings, monkeypatch) as source:
        frames = list(source)
        assert (source.width, source.height) == (source.view_width, source.view_height) == (64, 48)
        whole = {
            "read": 12,
            "paired": 12,
            "unpaired": 0,
            "damaged": 0,
            "flawed": 0,
            "repeated": 0,
            "unread": 0,
        }
        assert source.counts == {"skipped": 0, "left": whole, "right": whole}
        assert (source.damage, source.warnings) == ([], [])
        assert list(source.describe()) == ["both"]
    assert [frame.index for frame in frames] == list(range(COUNT))
    for frame, left, right in zip(frames, lefts, rights, strict=True):
        views = (frame.right, frame.left) if swap else (frame.left, frame.right)
        for view, truth in zip(views, (left, right), strict=True):
            assert view.dtype == np.uint8
            assert view.flags.c_contiguous
            assert np.abs(view.astype(int) - truth).max() <= error


def test_squeezed_views_get_their_whole_disparity_back(tmp_path: Path) -> None:
    x = np.arange(128)
    left, right = (
        np.tile(128 + 100 * np.sin((x + shift) / 9), (48, 1)).astype(np.uint8) for shift in (0, 8)
    )
    images = LAYOUTS["side-by-side-half"][0]([left], [right])
    path = encode(tmp_path / "v.mkv", images, "ffv1", "gray")
    with open_stereo(path, settings=InputSettings(layout="side-by-side-half")) as source:
        (frame,) = source
    # What is at x in the right view is at x + 8 in the left one: in full, not in squeezed px.
    assert np.abs(frame.left[:, 12:-4].astype(int) - frame.right[:, 4:-12]).max() <= 2


def test_swap_of_two_recordings(tmp_path: Path) -> None:
    one = folder(tmp_path / "one", scene(), ".png")
    other = folder(tmp_path / "other", negative(scene()), ".png")
    with open_stereo(one, other, InputSettings(swap=True)) as source:
        frame = next(iter(source))
        assert source.describe(fingerprint=False)["left"]["path"] == str(other)
    np.testing.assert_array_equal(frame.right, scene()[0])


def test_a_half_that_cannot_be_halved(tmp_path: Path) -> None:
    path = folder(tmp_path / "both", scene(65, 49), ".png")
    for layout, size in (("side-by-side", "65 px wide"), ("top-bottom-half", "49 px high")):
        with pytest.raises(InputError, match=f"is {size}: --layout {layout} needs an even"):
            open_stereo(path, settings=InputSettings(layout=layout))


def test_one_recording_and_what_is_missing(tmp_path: Path) -> None:
    path = folder(tmp_path / "both", scene(), ".png")
    with pytest.raises(SettingsError, match=r"image_0 and image_1.* or --layout side-by-side"):
        open_stereo(path)
    other = folder(tmp_path / "other", scene(), ".png")
    with pytest.raises(SettingsError, match=r"takes one recording: leave .*other out"):
        open_stereo(path, other, InputSettings(layout="top-bottom"))


# --- Crop, scale, rectification, rig ------------------------------------------------------------


def test_crop_and_scale_of_the_views(tmp_path: Path) -> None:
    left = folder(tmp_path / "left", scene(), ".png")
    right = folder(tmp_path / "right", negative(scene()), ".png")
    settings = InputSettings(crop="8,4,40,20", scale=0.5)
    with open_stereo(left, right, settings) as source:
        assert (source.width, source.height) == (20, 10)
        assert (source.view_width, source.view_height) == (64, 48)
        frame = next(iter(source))
    part = scene()[0][4:24, 8:48].astype(float)
    means = part.reshape(10, 2, 20, 2).mean(axis=(1, 3))
    assert frame.left.flags.c_contiguous
    assert np.abs(frame.left - means).max() <= 0.5
    assert np.abs(frame.right - (255 - means)).max() <= 0.5


def test_whole_views_are_rectified_before_they_are_cut(tmp_path: Path) -> None:
    both = folder(tmp_path / "both", beside(scene(), negative(scene())), ".png")
    other = folder(tmp_path / "other", negative(scene()), ".png")
    one = folder(tmp_path / "one", scene(), ".png")

    def mirrored(view: NDArray[np.uint8]) -> NDArray[np.uint8]:
        assert view.shape == (48, 64)
        return view[:, ::-1]

    for swap in (False, True):
        for inputs, layout in (((one, other), "two"), ((both, None), "side-by-side")):
            settings = InputSettings(layout=layout, swap=swap, crop="0,0,32,48")
            with open_stereo(*inputs, settings) as source:
                source.rectify(mirrored, lambda view: view)
                frame = next(iter(source))
            left, right = (negative(scene()), scene()) if swap else (scene(), negative(scene()))
            np.testing.assert_array_equal(frame.left, left[0][:, ::-1][:, :32])
            np.testing.assert_array_equal(frame.right, right[0][:, :32])


def test_the_rig_follows_crop_and_scale_by_hand() -> None:
    rig = adapted_rig(RIG, InputSettings(crop="8,4,40,20", scale=0.5))
    # cx: 31.5 - 8 = 23.5 in the crop; (23.5 + 0.5) / 2 - 0.5 = 11.5. cy: (19.5 + 0.5) / 2 - 0.5.
    assert rig == Rig(20, 10, focal_px=25, baseline_m=0.1, cx=11.5, cy=9.5, doffs=1)
    assert adapted_rig(RIG, InputSettings()) == RIG


def test_the_rig_follows_what_the_pixels_do(tmp_path: Path) -> None:
    # A stripe whose centre is the principal point stays there.
    image = np.zeros((48, 64), np.uint8)
    image[:, 30:34] = 255  # centre 31.5
    one = folder(tmp_path / "one", [image], ".png")
    other = folder(tmp_path / "other", [255 - image], ".png")
    for settings in (
        InputSettings(scale=0.5),
        InputSettings(scale=2),
        InputSettings(crop="10,0,50,48"),
        InputSettings(crop="11,0,53,48", scale=0.6),
    ):
        with open_stereo(one, other, settings) as source:
            (frame,) = source
        centre = np.average(np.arange(source.width), weights=frame.left[0])
        assert centre == pytest.approx(adapted_rig(RIG, settings).cx, abs=0.1)


@given(
    x=st.integers(0, 20),
    width=st.integers(10, 40),
    scale=st.floats(0.1, 3),
    disparity=st.floats(0.1, 60),
)
def test_depth_does_not_change_with_the_size(
    x: int, width: int, scale: float, disparity: float
) -> None:
    rig = adapted_rig(RIG, InputSettings(crop=f"{x},0,{width},48", scale=scale))
    scaled = disparity * rig.width / width
    depth_m = RIG.focal_px * RIG.baseline_m / (disparity + RIG.doffs)
    assert rig.focal_px * rig.baseline_m / (scaled + rig.doffs) == pytest.approx(depth_m)


@pytest.mark.parametrize(
    ("given_settings", "complaint"),
    [
        ({"layout": "sidebyside"}, "--layout cannot be 'sidebyside': choose two"),
        ({"crop": "1,2,3"}, "--crop cannot be '1,2,3': give X,Y,WIDTH,HEIGHT"),
        ({"crop": "-1,0,9,9"}, "--crop cannot be"),
        ({"crop": "0,0,0,9"}, "give a width and height above 0"),
        ({"scale": 0}, "--scale cannot be 0"),
        ({"every": 0}, "--every cannot be 0"),
        ({"start": "12.5"}, "--start cannot be '12.5': give a frame number"),
        ({"start": "-3"}, "--start cannot be"),
        ({"end": "1:2:3:4"}, "--end cannot be"),
        ({"start": "5", "end": "5"}, "--end 5 does not come after --start 5"),
        ({"end": "0s"}, "--end 0s does not come after --start 0"),
        ({"sync_offset": 1, "sync_tolerance": 0.01}, "give one of them"),
        ({"sync_tolerance": float("nan")}, "--sync-tolerance cannot be nan"),
    ],
)
def test_nonsense_settings(given_settings: dict[str, Any], complaint: str) -> None:
    with pytest.raises(SettingsError) as caught:
        InputSettings(**given_settings)
    assert complaint in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("100", 100),
        ("12.5s", Fraction("12.5")),
        ("7s", Fraction(7)),
        ("0:12.5", Fraction("12.5")),
        ("1:02:03.25", Fraction("3723.25")),
    ],
)
def test_places_are_frames_or_times(text: str, place: int | Fraction) -> None:
    assert InputSettings(start=text).first == place
    assert type(InputSettings(start=text).first) is type(place)


# --- Pairing ----------------------------------------------------------------------------------


def lead(one: int, other: int) -> Fraction:
    return Fraction(other - one)


times = st.lists(st.integers(0, 60), unique=True).map(sorted)


@given(left=times, right=times, tolerance=st.integers(0, 9))
def test_pairs_are_near_in_order_and_used_once(
    left: list[int], right: list[int], tolerance: int
) -> None:
    pairs = list(pair(iter(left), iter(right), lead, Fraction(tolerance)))
    assert all(abs(one - other) <= tolerance for one, other in pairs)
    for side in zip(*pairs, strict=True):
        assert list(side) == sorted(set(side))
    # What could have been a pair was none because one of the two has somebody nearer.
    spare = [sorted(set(each) - {p[i] for p in pairs}) for i, each in enumerate((left, right))]
    for one in spare[0]:
        for other in spare[1]:
            apart = abs(one - other)
            rivals = [abs(one - each) for each in right] + [abs(each - other) for each in left]
            assert apart > tolerance or min(rivals) < apart


def test_the_nearest_is_the_partner() -> None:
    left, right = [0, 33, 66, 100], [31, 64, 95, 130]
    pairs = list(pair(iter(left), iter(right), lead, Fraction(40)))
    assert pairs == [(33, 31), (66, 64), (100, 95)]
    assert list(pair(iter(left), iter(right), lead, Fraction(2))) == [(33, 31), (66, 64)]


class Numbers(Recording):
    """A stream that has some numbers only, and says so."""

    numbered = True

    def __init__(self, numbers: list[int], flawed: frozenset[int] = frozenset()) -> None:
        self.time_base, self.frame_rate = Fraction(1, 10), Fraction(10)
        self.expected_images = numbers[-1] + 1
        self._numbers, self._flawed = numbers, flawed
        self._lost = self._flaws = 0
        self._start(self._read(), "numbers")

    def _read(self) -> Iterator[Image]:
        last = -1
        for number in self._numbers:
            self._lost += number - last - 1
            self._flaws += number in self._flawed
            last = number
            yield Image(number, number, np.zeros((1, 1), np.uint8))

    @property
    def lost(self) -> int:
        return self._lost

    @property
    def flawed(self) -> int:
        return self._flaws

    damage = files = ()
    describe = fingerprint = dict

    def close(self) -> None:
        pass


numbers = st.sets(st.integers(0, 30), min_size=1).map(sorted)


def delivered(source: StereoSource) -> list[int]:
    try:
        return [frame.pts for frame in source]
    except InputError:  # there is no pair, or none behind --start
        return []


@given(left=numbers, right=numbers, offset=st.integers(-4, 4))
def test_pairs_are_the_numbers_that_both_sides_have(
    left: list[int], right: list[int], offset: int
) -> None:
    streams = [Numbers(left), Numbers(right)]
    with StereoSource(streams, InputSettings(sync_offset=offset)) as source:
        assert delivered(source) == sorted({n + offset for n in left} & set(right))


@given(
    left=numbers,
    right=numbers,
    flawed=st.frozensets(st.integers(0, 30)),
    settings=st.one_of(
        st.builds(InputSettings, sync_offset=st.integers(-4, 4), every=st.integers(1, 4)),
        st.builds(InputSettings, sync_tolerance=st.sampled_from([0.05, 0.1, 0.25])),
        st.builds(InputSettings, start=st.sampled_from(["2", "1.5s"]), end=st.just("9")),
        st.builds(InputSettings, end=st.sampled_from(["3", "0.7s", "0:2"])),
    ),
)
def test_every_image_is_accounted_for(
    left: list[int], right: list[int], flawed: frozenset[int], settings: InputSettings
) -> None:
    streams = [Numbers(left, flawed), Numbers(right)]
    with StereoSource(streams, settings) as source:
        frames = delivered(source)
        counts = source.counts
    for side, stream in zip(("left", "right"), streams, strict=True):
        c = counts[side]
        assert c["read"] == c["paired"] + c["unpaired"] + c["damaged"]
        assert c["paired"] == counts["skipped"] + len(frames)
        assert c["flawed"] <= c["paired"] + c["unpaired"]
        assert c["read"] + c["unread"] == stream.expected_images
    if settings.end == "" and frames:
        ended = [counts[side]["unread"] == 0 for side in ("left", "right")]
        assert any(ended)


def test_an_offset_leaves_ends_over_and_that_is_no_damage() -> None:
    whole = list(range(10))
    for offset in (2, -2):
        settings = InputSettings(sync_offset=offset)
        with StereoSource([Numbers(whole), Numbers(whole)], settings) as source:
            assert source.expected_frames == len(delivered(source)) == 8
            assert source.damage == []
            assert source.counts["left"]["read"] + source.counts["left"]["unread"] == 10
    longer = list(range(13))
    with StereoSource([Numbers(longer), Numbers(whole)], InputSettings(sync_offset=2)) as source:
        delivered(source)
        assert source.damage == [
            "numbers: about 3 images longer than the other side: only the common part was processed"
        ]


def test_by_time_streams_may_begin_apart_but_a_hole_is_damage() -> None:
    whole, holed = list(range(10)), [3, 4, 6, 7, 8, 9]
    settings = InputSettings(sync_tolerance=0.04)
    with StereoSource([Numbers(whole), Numbers(holed)], settings) as source:
        assert delivered(source) == holed
        assert source.damage == ["numbers: 1 image dropped: no partner on the other side"]
        assert source.counts["left"]["unpaired"] == 4


def test_time_needs_time_stamps(tmp_path: Path) -> None:
    left = folder(tmp_path / "left", scene(), ".png")
    right = folder(tmp_path / "right", scene(), ".png")
    for settings in ({"sync_tolerance": 0.01}, {"start": "0.1s"}, {"end": "0:01"}):
        with pytest.raises(SettingsError, match=r"has no time stamps: give --frame-rate"):
            open_stereo(left, right, InputSettings(**settings))
        with open_stereo(left, right, InputSettings(frame_rate=29.97, **settings)) as source:
            assert source.time_base == Fraction(100, 2997)
    one = encode(tmp_path / "one.mkv", scene(), "ffv1", "gray")
    other = encode(tmp_path / "other.mkv", scene(), "ffv1", "gray")
    with pytest.raises(SettingsError, match=r"--frame-rate is for what has no times"):
        open_stereo(one, other, InputSettings(frame_rate=20))


# --- Selection --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("selection", "expected"),
    [
        ({}, list(range(12))),
        ({"start": "3"}, list(range(3, 12))),
        ({"end": "3"}, [0, 1, 2]),
        ({"start": "2", "end": "9", "every": 3}, [2, 5, 8]),
        ({"start": "0.1s", "end": "0.2s"}, [3, 4, 5]),
        ({"start": "0:0.3"}, [9, 10, 11]),
    ],
)
def test_selection(tmp_path: Path, selection: dict[str, Any], expected: list[int]) -> None:
    stamps = [5 + n for n in range(COUNT)]  # times count from the first image, not from 0
    left = encode(tmp_path / "left.mkv", scene(), "ffv1", "gray", pts=stamps)
    right = encode(tmp_path / "right.mkv", scene(), "ffv1", "gray", pts=stamps)
    with open_stereo(left, right, InputSettings(**selection)) as source:
        frames = list(source)
        assert source.expected_frames == len(frames)
        assert source.damage == []
        assert source.counts["skipped"] == source.counts["left"]["paired"] - len(frames)
    assert [number_in(frame.left) for frame in frames] == expected
    assert [number_in(frame.right) for frame in frames] == expected
    assert [frame.index for frame in frames] == list(range(len(expected)))
    assert [frame.pts for frame in frames] == [round((5 + n) * 1000 / 30) for n in expected]


def test_a_selection_behind_the_end(tmp_path: Path) -> None:
    path = folder(tmp_path / "both", scene(), ".png")
    settings = InputSettings(layout="side-by-side", start="12")
    with (
        open_stereo(path, settings=settings) as source,
        pytest.raises(InputError, match=r"--start 12 lies behind the last of 12 frames"),
    ):
        list(source)


# --- Folders ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stems", "expected"),
    [
        (["000007", "000008", "000010"], [7, 8, 10]),
        (["cam0_9", "cam0_10"], [9, 10]),
        (["f000000_10", "f000001_10"], [0, 1]),
        (["a0", "a10", "a30"], [0, 10, 30]),
        (
            ["1403636579763555584", "1403636579813555584"],
            [1403636579763555584, 1403636579813555584],
        ),
        (["000000_10", "000001_11"], None),  # two numbers
        (["left", "right"], None),
        (["a1", "b2"], None),
        (["1", "01"], None),  # twice the same
        (["0", "4", "9"], None),  # no steps: time stamps
        (["only5"], None),
    ],
)
def test_numbers_in_file_names(stems: list[str], expected: list[int] | None) -> None:
    assert file_numbers(stems) == expected


def test_a_gap_on_one_side_drops_the_partner_and_is_named(tmp_path: Path) -> None:
    left = folder(tmp_path / "left", scene(), ".png")
    right = folder(tmp_path / "right", scene(), ".png")
    for number in (5, 8, 9):
        (right / f"frame{number}.png").unlink()
    with open_stereo(left, right) as source:
        assert source.warnings == [
            f"{right}: numbers are missing between 4 and 6 and in 1 other places: "
            "check that no images are lost"
        ]
        frames = [(each.number, number_in(each.left), number_in(each.right)) for each in source]
        assert source.damage == [f"{left}: 3 images dropped: no partner on the other side"]
    # Poses that go by number are of these places, too.
    assert frames == [(n, n, n) for n in range(COUNT) if n not in (5, 8, 9)]


def test_numbers_count_only_where_both_sides_have_them(tmp_path: Path) -> None:
    left = folder(tmp_path / "left", scene(), ".png")
    for number in reversed(range(COUNT)):
        (left / f"frame{number}.png").rename(left / f"frame{number + 1}.png")
    right = encode(tmp_path / "right.mkv", scene(), "ffv1", "gray")
    with open_stereo(left, right) as source:
        frames = list(source)
    assert [number_in(frame.left) for frame in frames] == list(range(COUNT))


def test_patterns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for side, images in (("cam0", scene()), ("cam1", negative(scene()))):
        for number, image in enumerate(images):
            assert cv2.imwrite(f"{side}_{number}.png", image)
    with open_stereo("cam0_*.png", "cam1_*.png") as source:
        frames = list(source)
        assert source.describe()["left"]["path"] == "cam0_*.png"
    assert [number_in(frame.left) for frame in frames] == list(range(COUNT))
    np.testing.assert_array_equal(frames[3].right, 255 - frames[3].left)
    with pytest.raises(InputError, match="there is no file or folder cam2_"):
        open_stereo("cam0_*.png", "cam2_*.png")
    with pytest.raises(InputError, match="are the same recording"):
        open_stereo("cam0_*.png", "cam0_*.png")


@pytest.mark.parametrize("pair", [("image_0", "image_1"), ("image_02/data", "image_03/data")])
def test_kitti_folders(tmp_path: Path, pair: tuple[str, str]) -> None:
    for side, images in zip(pair, (scene(), negative(scene())), strict=True):
        (tmp_path / side).parent.mkdir(exist_ok=True)
        folder(tmp_path / side, images, ".png")
    with open_stereo(tmp_path) as source:
        frames = list(source)
        assert source.paths == (tmp_path / pair[0], tmp_path / pair[1])
    assert [number_in(frame.left) for frame in frames] == list(range(COUNT))
    assert number_in(255 - frames[7].right) == 7


def kitti(path: Path, times: list[str]) -> Path:
    for side, images in (("image_0", scene()), ("image_1", negative(scene()))):
        folder(path / side, images, ".png", "{:06d}")
    (path / "times.txt").write_text("\n".join(times) + "\n")
    return path


def test_kitti_has_the_times_beside_the_images(tmp_path: Path) -> None:
    path = kitti(tmp_path, [f"{n * 0.1037:e}" for n in range(COUNT)])
    (path / "image_1" / "000004.png").unlink()
    with open_stereo(path) as source:
        frames = list(source)
        assert source.frame_rate == pytest.approx(1 / 0.1037, rel=1e-6)
    left = [n for n in range(COUNT) if n != 4]
    assert [number_in(frame.left) for frame in frames] == left
    assert [frame.time_s for frame in frames] == pytest.approx([n * 0.1037 for n in left])


def test_kitti_times_of_more_images_than_there_are_are_said(tmp_path: Path) -> None:
    with open_stereo(kitti(tmp_path, [f"{n * 0.1:e}" for n in range(3 * COUNT)])) as source:
        (said,) = source.warnings
    assert f"has {3 * COUNT} times, but the last image is {COUNT - 1:06d}.png" in said


@pytest.mark.parametrize(
    ("times", "said"),
    [
        (["0.1"] * COUNT, "the times do not rise"),
        (["0.1"], "does not fit the images"),
        (["x"] * COUNT, "does not fit the images"),
        (["inf"] * COUNT, "does not fit the images"),
    ],
)
def test_kitti_times_that_do_not_fit(tmp_path: Path, times: list[str], said: str) -> None:
    with pytest.raises(InputError, match=said):
        open_stereo(kitti(tmp_path, times))


BEGIN_NS = 1403636579763555584
PERIOD_NS = 50_000_000


def euroc(path: Path, lost: set[int] = frozenset(), jitter_ns: int = 0) -> Path:  # type: ignore[assignment]
    for camera, images in ((0, scene()), (1, negative(scene()))):
        data = path / f"mav0/cam{camera}/data"
        data.mkdir(parents=True)
        rows = ["#timestamp [ns],filename"]
        for number, image in enumerate(images):
            if camera == 1 and number in lost:
                continue
            stamp = BEGIN_NS + PERIOD_NS * number + jitter_ns * camera
            assert cv2.imwrite(str(data / f"{stamp}.png"), image)
            rows.append(f"{stamp},{stamp}.png")
        (data.parent / "data.csv").write_text("\r\n".join(rows) + "\r\n")
    return path


@pytest.mark.parametrize("jitter_ns", [0, 3_000_000, -3_000_000])
def test_euroc_folders_pair_by_their_time_stamps(tmp_path: Path, jitter_ns: int) -> None:
    with open_stereo(euroc(tmp_path, {0, 5}, jitter_ns)) as source:
        frames = list(source)
        assert source.frame_rate == 20
        assert source.time_base == Fraction(1, 10**9)
        assert source.damage == [
            f"{tmp_path / 'mav0/cam0/data'}: 1 image dropped: no partner on the other side"
        ]
    kept = [n for n in range(COUNT) if n not in (0, 5)]
    assert [number_in(frame.left) for frame in frames] == kept
    assert [number_in(255 - frame.right) for frame in frames] == kept
    assert [frame.pts for frame in frames] == [BEGIN_NS + PERIOD_NS * n + jitter_ns for n in kept]


def test_what_can_be_wrong_with_a_euroc_folder(tmp_path: Path) -> None:
    path = euroc(tmp_path)
    table = path / "mav0/cam1/data.csv"
    (path / f"mav0/cam1/data/{BEGIN_NS + 2 * PERIOD_NS}.png").unlink()
    with open_stereo(path) as source:
        assert len(list(source)) == COUNT - 1
        assert source.counts["right"]["damaged"] == 1
    text = table.read_text()
    table.write_text(text + "soon,x.png\n")
    with pytest.raises(InputError, match=r"data\.csv, line 14: give 'time stamp in ns,file"):
        open_stereo(path)
    table.write_text(text + text.splitlines()[-1] + "\n")
    with pytest.raises(InputError, match=r"data\.csv has the time stamp \d+ twice"):
        open_stereo(path)
    table.write_text("#timestamp [ns],filename\n")
    with pytest.raises(InputError, match="has no images"):
        open_stereo(path)


# --- Standard input ---------------------------------------------------------------------------

BESIDE = InputSettings(layout="side-by-side")


@pytest.fixture
def y4m(tmp_path: Path) -> Path:
    images = beside(scene(), negative(scene()))
    return encode(tmp_path / "both.y4m", images, "rawvideo", "yuv420p")


class Given:
    """A standard input that gives some bytes and then ends, or waits."""

    closed = False

    def __init__(self, content: bytes, *, waits: bool = False) -> None:
        self._reader, writer = os.pipe()

        def feed() -> None:
            with os.fdopen(writer, "wb") as pipe:
                pipe.write(content)
                pipe.flush()
                if waits:
                    self.done.wait(20)

        self.done = threading.Event()
        self._thread = threading.Thread(target=feed)
        self._thread.start()

    def fileno(self) -> int:
        return self._reader

    def end(self) -> None:
        self.done.set()
        self._thread.join()
        os.close(self._reader)


def test_yuv4mpeg_from_standard_input(y4m: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with open_stereo(y4m, settings=BESIDE) as source:
        expected = [frame.left.tobytes() for frame in source]
        digest = source.describe()["both"]["sha256"]
    stdin = Given(y4m.read_bytes())
    monkeypatch.setattr(sys, "stdin", stdin)
    with open_stereo("-", settings=BESIDE) as source:
        assert source.describe()["both"]["sha256"] is None  # not known before the end
        assert [frame.left.tobytes() for frame in source] == expected
        assert source.damage == []
        described = source.describe()["both"]
    stdin.end()
    assert described["path"] == "standard input"
    assert (described["bytes"], described["sha256"]) == (y4m.stat().st_size, digest)


@pytest.mark.parametrize("share", [0.4, 0.7])
def test_standard_input_that_ends_midway(
    y4m: Path, monkeypatch: pytest.MonkeyPatch, share: float
) -> None:
    content = y4m.read_bytes()
    stdin = Given(content[: int(len(content) * share)])
    monkeypatch.setattr(sys, "stdin", stdin)
    with open_stereo("-", settings=BESIDE) as source:
        frames = list(source)
        assert source.damage == ["standard input: 1 image missing at its end"]
        assert source.counts["left"]["damaged"] == source.counts["right"]["damaged"] == 1
    stdin.end()
    assert len(frames) == int(COUNT * share)


def test_an_mp4_on_standard_input_needs_its_index_in_front(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    noise = np.random.default_rng(0)
    images = [noise.integers(0, 256, (256, 512), np.uint8) for _ in range(4)]
    path = encode(tmp_path / "both.mp4", images, "mjpeg", "yuvj420p", FULL)
    assert path.stat().st_size > 200_000  # more than FFmpeg keeps
    monkeypatch.setattr(sys, "stdin", path.open("rb"))
    with pytest.raises(InputError, match=r"^standard input: .*-movflags \+faststart") as caught:
        open_stereo("-", settings=BESIDE)
    assert "\n" not in str(caught.value)
    front = remux(path, tmp_path / "front.mp4", lambda _, packet: packet)
    stdin = Given(front.read_bytes())
    monkeypatch.setattr(sys, "stdin", stdin)
    with open_stereo("-", settings=BESIDE) as source:
        assert len(list(source)) == 4
    stdin.end()


def test_leaving_while_standard_input_waits(y4m: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = y4m.read_bytes()
    stdin = Given(content[: len(content) * 3 // 4], waits=True)
    monkeypatch.setattr(sys, "stdin", stdin)
    with open_stereo("-", settings=BESIDE) as source:
        next(iter(source))
        time.sleep(0.3)  # let the decoding thread run into the wait
    assert not [each for each in threading.enumerate() if each.name == "prefetch"]
    stdin.end()


def test_standard_input_that_cannot_be_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", None)
    with pytest.raises(InputError, match="standard input is closed"):
        open_stereo("-", settings=BESIDE)
    with pytest.raises(InputError, match="standard input is closed"):
        open_stereo("-")


def test_standard_input_is_one_recording(y4m: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", y4m.open("rb"))
    with pytest.raises(SettingsError, match="standard input is one recording"):
        open_stereo("-")


# --- The command line -------------------------------------------------------------------------

COMMAND = [sys.executable, "-m", "motionstereo_cli"]


def test_run_from_standard_input_cut_off(y4m: Path, tmp_path: Path) -> None:
    content = y4m.read_bytes()
    done = subprocess.run(
        [*COMMAND, "run", "--layout", "side-by-side", "-", "-o", str(tmp_path / "out")],
        input=content[: len(content) // 2],
        capture_output=True,
        check=False,
    )
    assert done.returncode == 3
    assert "warning: standard input: 1 image missing at its end" in done.stderr.decode()
    record = json.loads((tmp_path / "out/run.json").read_text())
    assert record["counts"]["written"] == 5
    assert record["counts"]["left"]["read"] == 6
    assert record["input_settings"]["layout"] == "side-by-side"
    assert (tmp_path / "out/steering.csv").read_text().count("\n") == 6


def test_an_interrupt_while_waiting_for_standard_input(y4m: Path) -> None:
    process = subprocess.Popen(
        [*COMMAND, "info", "-", "--layout", "side-by-side"],
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert process.stdin is not None
    assert process.stderr is not None
    process.stdin.write(y4m.read_bytes()[:2000])  # less than an image
    process.stdin.flush()
    time.sleep(1.5)
    process.terminate()
    assert process.stderr.read() == b"error: interrupted\n"
    assert process.wait() == 130


def test_a_corrupt_image_and_a_gap_at_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    left = folder(Path("left"), scene(), ".png")
    right = folder(Path("right"), scene(), ".png")
    cut(left / "frame3.png", left / "frame3.png", 0.5)
    (right / "frame7.png").unlink()
    assert main(["run", "left", "right", "--save", "steering", "--no-check"]) == 3
    said = capsys.readouterr().err.splitlines()
    warnings = [line for line in said if "warning" in line and "no heading" not in line]
    assert warnings == [
        "warning: right: numbers are missing between 6 and 8: check that no images are lost",
        "warning: left: 1 image could not be read, the first is frame3.png",
        "warning: left: 1 image dropped: no partner on the other side",
        "warning: right: 1 image dropped: no partner on the other side",
    ]
    record = json.loads(Path("motionstereo_out/run.json").read_text())
    left_counts = record["counts"]["left"]
    assert left_counts == {
        "read": 12,
        "paired": 10,
        "unpaired": 1,
        "damaged": 1,
        "flawed": 0,
        "repeated": 0,
        "unread": 0,
    }
    assert [warning["code"] for warning in record["warnings"]] == ["recording", "no-heading"]
    assert record["warnings"][0]["text"] == warnings[0].removeprefix("warning: ")


def test_the_rig_of_a_run_follows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    folder(Path("both"), beside(scene(), negative(scene())), ".png")
    Path("rig.yaml").write_text(
        "width: 64\nheight: 48\nfocal_px: 50\nbaseline_m: 0.1\ncx: 31.5\ncy: 23.5\ndoffs: 2\n"
    )
    args = ["both", "--layout", "side-by-side", "--rig", "rig.yaml", "--scale", "0.5"]
    assert main(["run", *args, "--crop", "8,4,40,20", "--save", "steering"]) == 0
    rig = json.loads(Path("motionstereo_out/run.json").read_text())["rig"]
    assert (rig["width"], rig["focal_px"], rig["cx"], rig["doffs"]) == (20, 25, 11.5, 1)


def test_previews_of_camera_clocks_begin_at_nought(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    euroc(Path("euroc"))
    assert main(["run", "euroc", "--save", "charge,steering"]) == 0
    with av.open("motionstereo_out/charge.mp4") as video:
        assert [round(frame.time, 3) for frame in video.decode(video=0)] == [
            round(0.05 * n, 3) for n in range(COUNT)
        ]
    row = Path("motionstereo_out/steering.csv").read_text().splitlines()[1]
    assert row.startswith(f"0,{BEGIN_NS},1403636579.763556,")


def test_info(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.chdir(tmp_path)
    encode(Path("left.mp4"), scene(), "libx264", "yuv420p", degrees=180)
    folder(Path("right"), scene(), ".png")
    Path("rig.yaml").write_text(
        "width: 64\nheight: 48\nfocal_px: 50\nbaseline_m: 0.1\ncx: 31.5\ncy: 23.5\n"
    )
    args = ["info", "left.mp4", "right", "--frame-rate", "15", "--every", "2", "--scale", "0.5"]
    assert main([*args, "--rig", "rig.yaml"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "layout     two",
        "left       64x48 px, 12 images, 30 per second, h264, yuv420p, limited range, "
        "turned by 180 degrees, left.mp4",
        "right      64x48 px, 12 images, 15 per second, png, grey 8 bit, full range, right",
        "delivered  32x24 px, 6 images, 7.5 per second",
        "rig        width 32, height 24, focal_px 25, baseline_m 0.1, cx 15.5, cy 11.5, doffs 0",
        "rig from   rig.yaml",
    ]
    assert main([*args, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["left"]["rotation_deg"] == 180
    assert facts["delivered"] == {"width": 32, "height": 24, "frames": 6, "frame_rate": "15/2"}
    Path("rig.yaml").write_text(Path("rig.yaml").read_text().replace("64", "640"))
    assert main([*args, "--rig", "rig.yaml"]) == 1
    assert "the rig is for 640x48 but the recordings are 64x48" in capsys.readouterr().err


def test_a_folder_beside_that_of_both_cameras_is_told_which_it_is(tmp_path: Path) -> None:
    whole = tmp_path / "kitti" / "sequences" / "00"
    whole.mkdir(parents=True)
    for side in ("image_0", "image_1"):
        folder(whole / side, scene()[:2], ".png")
    for path in (whole / "image_0", tmp_path / "kitti"):
        with pytest.raises(SettingsError, match=r"not the folder of both cameras, but .*/00 is"):
            open_stereo(path)
