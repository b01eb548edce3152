"""Which images belong together: what both sides say of it decides by itself."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from recordings import COUNT, encode, number_in, remux, scene

from motionstereo_cli.sources import open_stereo
from motionstereo_cli.sources.names import side_of, stamps_in
from motionstereo_cli.sources.pairing import _Step, pair
from motionstereo_cli.sources.settings import InputSettings
from motionstereo_cli.sources.sides import Loss, SideImage

ALL = range(COUNT)


def named(path: Path, names: dict[int, str]) -> Path:
    path.mkdir()
    for number, name in names.items():
        assert cv2.imwrite(str(path / f"{name}.png"), scene()[number])
    return path


def pairs_of(left: Path, right: Path) -> list[tuple[int, int]]:
    with open_stereo(left, right) as source:
        return [(number_in(frame.left), number_in(frame.right)) for frame in source]


JITTER_MS = np.random.default_rng(0).integers(-9, 10, COUNT)


@pytest.mark.parametrize(
    "name",
    [
        lambda n: f"{33 * n + JITTER_MS[n] + 10:06d}",  # ms, from 0
        lambda n: f"{1403636579763555584 + 33_000_000 * n + 1_000_000 * JITTER_MS[n]}",
        lambda n: f"{1305031102 + (33 * n + JITTER_MS[n]) / 1000:.6f}",
        lambda n: f"take1_{n}_{JITTER_MS[n] + 10}",
    ],
)
def test_names_that_both_sides_have_decide(tmp_path: Path, name: object) -> None:
    assert callable(name)
    left = named(tmp_path / "left", {n: name(n) for n in ALL if n not in (2, 7)})
    right = named(tmp_path / "right", {n: name(n) for n in ALL if n not in (4, 5)})
    assert pairs_of(left, right) == [(n, n) for n in ALL if n not in (2, 4, 5, 7)]
    with open_stereo(left, right) as source:
        list(source)
        assert f"{left}: 2 images dropped: no partner on the other side" in source.damage


def test_times_in_names_need_not_be_equal(tmp_path: Path) -> None:
    left = named(tmp_path / "left", {n: f"{1305031102.1 + n / 30:.6f}" for n in ALL if n != 3})
    right = named(tmp_path / "right", {n: f"{1305031102.105 + n / 30:.6f}" for n in ALL if n != 8})
    assert pairs_of(left, right) == [(n, n) for n in ALL if n not in (3, 8)]
    with open_stereo(left, right) as source:
        assert float(source.frame_rate or 0) == pytest.approx(30, rel=1e-3)
        assert next(iter(source)).time_s == pytest.approx(1305031102.105)


#: Names of an image by its time in us, and whether it is of the right camera: they never agree.
FORMS = {
    "us and ns": lambda us, right: f"{1700000000_000000 + us}{'000' if right else ''}",
    "cameras in the prefix": lambda us, right: f"cam{right:d}_{1700000000 + us / 1e6:.6f}",
    "a counter before it": lambda us, right: (
        f"{us // 33000:04d}_{1700000000_000000000 + us * 1000}"
    ),
    "seconds since the start": lambda us, right: f"img{us / 1e6:.6f}",
    "ms since the start": lambda us, right: f"{us // 1000 + 812345}",
    "seconds and ns": lambda us, right: f"{us // 10**6 + 99}_{us % 10**6 * 1000:09d}",
    "dates": lambda us, right: (
        f"2023-11-14_22-13-{59 + us / 1e6:09.6f}"
        if us < 1_000_000
        else f"2023-11-14_22-14-{us / 1e6 - 1:09.6f}"
    ),
    "dates in one": lambda us, right: f"L_20231114T221320.{us // 1000:06d}",
}


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
@pytest.mark.parametrize("period_us", [33_333, 400_000])
def test_times_of_any_form_that_jitter_decide(tmp_path: Path, form: Any, period_us: int) -> None:
    # Each side lost one image: by place, all between would be of different moments.
    rng = np.random.default_rng(1)
    sides = []
    for right, lost in ((False, 2), (True, 8)):
        late_us = rng.integers(0, 3000, COUNT) + 2500 * right
        names = {n: form(int(period_us * n + late_us[n]), right) for n in ALL if n != lost}
        sides.append(named(tmp_path / str(right), names))
    assert pairs_of(sides[0], sides[1]) == [(n, n) for n in ALL if n not in (2, 8)]


def stamped(path: Path, shift_ms: int, kept: list[int]) -> Path:
    return named(path, {n: f"{1305031102000 + shift_ms + 33 * n}" for n in kept})


def test_clocks_that_differ_are_named_and_can_be_told(tmp_path: Path) -> None:
    kept = [n for n in ALL if n != 3]
    left = stamped(tmp_path / "left", 0, list(ALL))
    for number, (shift_ms, warned) in enumerate(((5, False), (20, True), (3_600_000, True))):
        right = stamped(tmp_path / f"right{number}", shift_ms, kept)
        with open_stereo(left, right) as source:
            said = [line for line in source.warnings if "--sync-shift" in line]
        assert len(said) == warned
        assert not warned or f"together, {shift_ms / 1000:.6f}" in said[0]
        settings = InputSettings(sync_shift=shift_ms / 1000)
        with open_stereo(left, right, settings) as source:
            assert [number_in(frame.left) for frame in source] == kept
            assert not source.warnings


def test_numbers_of_different_beginnings_are_named(tmp_path: Path) -> None:
    left = named(tmp_path / "left", {n: f"f{n}" for n in ALL})
    right = named(tmp_path / "right", {n: f"f{n + 100}" for n in ALL})
    with open_stereo(left, right) as source:
        assert source.warnings[0].endswith("give --sync-offset 100")
    clocks = [
        named(tmp_path / str(side), {n: f"{begin + 33 * n + n % 3}" for n in ALL if n != lost})
        for side, begin, lost in ((0, 100, 2), (1, 90_000, 8))
    ]
    with open_stereo(clocks[0], clocks[1]) as source:
        assert "of different clocks, and their steps differ after image 1" in source.warnings[0]


@pytest.mark.parametrize(
    ("stems", "ns"),
    [
        (["1305031102.175304", "1305031103.2"], None),
        (["1305031102.175304", "1305031103.275304"], [1305031102175304000, 1305031103275304000]),
        (["a1305031102175", "a1305031102275"], [1305031102175000000, 1305031102275000000]),
        (["1305031102175304", "1305031102275304"], [1305031102175304000, 1305031102275304000]),
        (["1305031102175304000"] * 2, None),
        (["a1305031102175", "b1305031102275"], None),
        (["000001", "000002"], None),
        (["1305031102175"], None),
        (["2023-02-29_10-00-00.000", "2023-02-29_10-00-00.100"], None),
        (["x20231114T221320Z", "x20231114T221321Z"], [1700000000 * 10**9, 1700000001 * 10**9]),
    ],
)
def test_times_in_names(stems: list[str], ns: list[int] | None) -> None:
    assert stamps_in(stems) == (ns or [])


# --- Videos -----------------------------------------------------------------------------------


def film(path: Path, kept: list[int], times: list[int]) -> Path:
    images, pts = [scene()[n] for n in kept], [times[n] for n in kept]
    return encode(path, images, "ffv1", "gray", pts=pts, options={"g": "1"})


@pytest.mark.parametrize("suffix", [".mkv", ".mp4"])
@pytest.mark.parametrize(
    "lost", [({4}, {8}), ({4, 5}, {5}), ({3}, {4}), ({0}, set()), ({2}, {0, 2})]
)
def test_times_of_a_varying_rate_decide(
    tmp_path: Path, suffix: str, lost: tuple[set[int], set[int]]
) -> None:
    times = np.cumsum([0, 4, 5, 3, 4, 6, 4, 4, 3, 5, 4, 4]).tolist()  # in 1/30 s
    left, right = (
        film(tmp_path / f"{side}{suffix}", [n for n in ALL if n not in gone], times)
        for side, gone in zip(("left", "right"), lost, strict=True)
    )
    assert pairs_of(left, right) == [(n, n) for n in ALL if n not in lost[0] | lost[1]]


def test_recordings_that_begin_apart_are_named(tmp_path: Path) -> None:
    left = film(tmp_path / "left.mkv", list(ALL), list(ALL))
    right = film(tmp_path / "right.mkv", list(ALL)[1:], list(ALL))
    with open_stereo(left, right) as source:
        assert source.warnings == [
            f"{right} begins 0.033 s after {left}: images before that have no partner"
        ]
        assert [number_in(frame.left) for frame in source] == list(ALL)[1:]
    late = film(tmp_path / "late.mkv", list(ALL), [100 + n for n in ALL])
    with open_stereo(left, late) as source:
        assert "late.mkv begins 3.333 s after" in source.warnings[0]
        assert "give --sync-tolerance 0.017" in source.warnings[0]
        assert len(list(source)) == COUNT
    with open_stereo(left, late, InputSettings(sync_tolerance=0.017)) as source:
        assert source.warnings == []


def test_rates_that_contradict_the_numbers_are_named(tmp_path: Path) -> None:
    left = film(tmp_path / "left.mp4", list(ALL), list(ALL))
    right = film(tmp_path / "right.mp4", list(ALL), [2 * n for n in ALL])
    with open_stereo(left, right) as source:
        assert "has 30 images per second and" in source.warnings[0]
        assert [number_in(frame.right) for frame in source] == list(ALL)


def test_rates_of_a_whole_ratio_are_paired_by_time(tmp_path: Path) -> None:
    left = film(tmp_path / "left.mp4", list(ALL), list(ALL))
    right = film(tmp_path / "right.mp4", list(ALL)[::2], list(ALL))
    for one, other in ((left, right), (right, left)):
        with open_stereo(one, other) as source:
            assert "are paired by time, those without a partner are left out" in source.warnings[0]
            frames = list(source)
            assert source.damage == []
        for view in ("left", "right"):
            assert [number_in(getattr(frame, view)) for frame in frames] == list(ALL)[::2]


def shot(number: int, time_s: float) -> SideImage:
    return SideImage(number, number, number, Fraction(time_s), (), False, Loss(0, 0, ()))


@pytest.mark.parametrize("drift", [0.0, 0.01, -0.04])
def test_clocks_that_drift_are_followed_and_leaps_are_not(drift: float) -> None:
    chance = np.random.default_rng(3)
    left = [shot(n, 7 + n / 30 + chance.uniform(-0.2, 0.2) / 30) for n in range(400) if n % 90]
    right = [shot(n, (1 + drift) * n / 30) for n in range(400) if n % 71]
    step = _Step(None, Fraction(1, 30))
    found = []
    for one, other in pair(iter(left), iter(right), step.lead, Fraction(1, 60)):
        step.note(one, other)
        found.append((one.number, other.number))
    assert found == [(n, n) for n in range(400) if n % 90 and n % 71]


# --- Beginning anywhere -----------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".mkv", ".mp4", ".png"])
@pytest.mark.parametrize(
    "given",
    [{}, {"start": "2", "every": 2}, {"start": "0.1s", "end": "0.35s"}, {"swap": True, "end": "9"}],
)
def test_frames_from_any_place_are_those_of_the_whole(
    tmp_path: Path, suffix: str, given: dict[str, Any]
) -> None:
    sides = []
    for side, gone in (("left", {4, 7}), ("right", {2})):
        kept = [n for n in ALL if n not in gone]
        if suffix == ".png":
            sides.append(named(tmp_path / side, {n: f"{n:03d}" for n in kept}))
        else:
            sides.append(film(tmp_path / f"{side}{suffix}", kept, list(ALL)))
    settings = InputSettings(**given, **({"frame_rate": 30} if suffix == ".png" else {}))

    def frames(index: int) -> tuple[list[tuple[Any, ...]], Any]:
        with open_stereo(*sides, settings) as source:
            sought = source.begin_at(index)
            found = [
                (f.index, f.pts, f.time_s, f.left.tobytes(), f.right.tobytes()) for f in source
            ]
            assert sought or not 0 < index < len(whole)
            return found, (source.counts, source.damage, source.first_pts)

    whole: list[tuple[Any, ...]] = []
    whole, came = frames(0)
    assert len(whole) >= 4
    for index in range(1, len(whole) + 1):
        assert frames(index) == (whole[index:], came)


@pytest.mark.parametrize("start", ["7", "0.25s"])
def test_what_is_before_the_start_is_not_decoded(tmp_path: Path, start: str) -> None:
    """The same frames and counts all the same."""
    options = {"g": "3", "sc_threshold": "0", "bf": "0"}
    sides = [
        encode(tmp_path / f"{side}.mp4", scene(), "libx264", "yuv420p", options=options)
        for side in ("left", "right")
    ]
    with open_stereo(*sides) as source:
        whole = [(frame.pts, frame.left.tobytes()) for frame in source]
    with open_stereo(*sides, InputSettings(start=start)) as source:
        found = list(source)
        first = len(whole) - len(found)
        assert first == {"7": 7, "0.25s": 8}[start]
        assert [(frame.pts, frame.left.tobytes()) for frame in found] == whole[first:]
        assert [frame.index for frame in found] == list(range(len(found)))
        assert source.counts["skipped"] == first
        assert source.counts["left"]["read"] == len(whole)
        assert source.damage == []
    spoilt = remux(
        sides[0], tmp_path / "spoilt.mp4", lambda n, packet: b"no image" if n == 1 else packet
    )
    with open_stereo(spoilt, sides[1], InputSettings(start=start)) as source:
        assert [frame.left.tobytes() for frame in source] == [
            frame.left.tobytes() for frame in found
        ]
        assert source.damage == []  # it is not looked at


def test_what_cannot_seek_is_decoded_from_the_start(tmp_path: Path) -> None:
    paths = [
        encode(tmp_path / f"{side}.mjpeg", scene(), "mjpeg", "yuvj420p", 2)
        for side in ("left", "right")
    ]
    with open_stereo(*paths) as source:
        assert not source.begin_at(5)
        assert [number_in(frame.left) for frame in source] == list(ALL)[5:]


@pytest.mark.parametrize(
    ("period_ns", "warned"), [(33_333_333, 0), (33_333, 1), (33_333_333_333, 1)]
)
def test_stamps_in_an_unlikely_unit_are_named(tmp_path: Path, period_ns: int, warned: int) -> None:
    for camera in ("cam0", "cam1"):
        (tmp_path / camera).mkdir()
        named(tmp_path / camera / "data", {n: f"{n:02d}" for n in ALL})
        rows = "".join(f"{10**9 + n * period_ns},{n:02d}.png\n" for n in ALL)
        (tmp_path / camera / "data.csv").write_text(rows)
    with open_stereo(tmp_path) as source:
        assert len([line for line in source.warnings if "images per second" in line]) == warned


@pytest.mark.parametrize(
    ("name", "side"),
    [
        *[("disparity_left", "left"), ("disp-right", "right"), ("left", "left")],
        *[("depth_cam1", "right"), ("infra1", "left"), ("cleft", None), ("disparity", None)],
    ],
)
def test_names_tell_the_camera(name, side):
    assert side_of(name) == side
