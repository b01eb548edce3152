"""``--sync-offset auto``: cameras that were not started together, by motion and by sound."""

from __future__ import annotations

import json
import tomllib
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from recordings import encode, folder, scene

from motionstereo_cli.__main__ import main
from motionstereo_cli.check.lag import BANDS, lag_of, profiles, small
from motionstereo_cli.check.offset import with_offset
from motionstereo_cli.check.sound import sound_shift_s
from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.sources import open_stereo
from motionstereo_cli.sources.settings import MEASURED, InputSettings

AUTO = InputSettings(sync_offset=MEASURED)


def quiet(*_: str) -> None:
    pass


def world(count: int, seed: int = 0) -> NDArray[np.uint8]:
    """Views of 160 x 120 px, (count, height, width), in which some objects move at random."""
    chance = np.random.default_rng(seed)
    texture = cv2.GaussianBlur(chance.integers(0, 256, (400, 480)).astype(np.float32), (0, 0), 2)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)  # type: ignore[call-overload]
    shown = texture.astype(np.uint8)
    steps = chance.normal(0, 1, (count, 4, 2))
    speeds = np.array([cv2.GaussianBlur(each, (1, 9), 2) for each in steps.transpose(1, 0, 2)])
    places = np.cumsum(2 * speeds, axis=1) + chance.uniform(20, 80, (4, 1, 2))
    images = np.repeat(shown[None, :120, :160], count, axis=0)
    for number in range(count):
        for index, (y, x) in enumerate(places[:, number] % (84, 124)):
            part = shown[200 + 30 * index :][:30, 300:330]
            images[number, int(y) : int(y) + 30, int(x) : int(x) + 30] = part
    return images


WORLD = world(320)
LEFTS, RIGHTS = WORLD, np.roll(WORLD, -7, axis=2)


@pytest.mark.parametrize("lag", [0, 1, -1, 5, 17, -38, 64, -90, 90])
@pytest.mark.parametrize("rows", [0, 6])
def test_the_lag_of_two_views_is_found(lag: int, rows: int) -> None:
    left = profiles(map(small, LEFTS[max(0, lag) :][:200]))
    right = profiles(map(small, np.roll(RIGHTS, rows, axis=1)[max(0, -lag) :][:200]))
    found = lag_of(left, right, 200, 50)
    assert found is not None
    assert (found.images, found.is_certain) == (lag, True)


def test_scenes_that_have_nothing_to_do_with_one_another_are_not_certain() -> None:
    for seed in range(1, 4):
        left, right = profiles(map(small, WORLD[:200])), profiles(map(small, world(200, seed)))
        found = lag_of(left, right, 200, 50)
        assert found is not None
        assert not found.is_certain


@settings(deadline=None, max_examples=40)
@given(
    n=st.integers(8, 40),
    m=st.integers(8, 40),
    reach=st.integers(0, 50),
    seed=st.integers(0, 1000),
)
def test_the_correlation_is_that_of_numpy(n: int, m: int, reach: int, seed: int) -> None:
    chance = np.random.default_rng(seed)
    left, right = (chance.gamma(1, 4, (k, BANDS)).astype(np.float32) for k in (n, m))
    found = lag_of(left, right, reach, 6)
    lags = [lag for lag in range(-reach, reach + 1) if min(n, m - lag) - max(0, -lag) >= 6]
    if not lags:
        assert found is None
        return
    assert found is not None
    assert found.images in lags
    expected = []
    for rows in range(-4, 5):
        kept = slice(max(0, -rows), BANDS - max(0, rows)), slice(max(0, rows), BANDS + min(0, rows))
        begin, end = max(0, -found.images), min(n, m - found.images)
        one, other = left[begin:end, kept[0]], right[begin + found.images :, kept[1]]
        other = other[: end - begin]
        one, other = one - one.mean(axis=0), other - other.mean(axis=0)
        expected.append(float((one * other).sum() / np.sqrt((one**2).sum() * (other**2).sum())))
    assert found.agreement == pytest.approx(max(expected), abs=1e-3)


def film(path: Path, images: NDArray[np.uint8]) -> Path:
    return encode(path, list(images), "libx264", "yuv420p", options={"preset": "ultrafast"})


@pytest.mark.parametrize("kind", ["video", "folder", "both views"])
def test_the_offset_is_measured_before_the_run(tmp_path: Path, kind: str) -> None:
    said: list[str] = []
    lefts, rights = LEFTS[:150], RIGHTS[31:181]
    if kind == "video":
        given = [film(tmp_path / "l.mp4", lefts), film(tmp_path / "r.mp4", rights)]
    elif kind == "folder":
        given = [
            folder(tmp_path / side, list(images), ".png", "{:04d}")
            for side, images in (("l", lefts), ("r", rights))
        ]
    else:
        both = np.concatenate([lefts, rights], axis=2)
        given = [film(tmp_path / "both.mp4", both)]
    layout = {"layout": "side-by-side"} if kind == "both views" else {}
    found = with_offset(
        given[0],
        given[1] if len(given) > 1 else None,
        InputSettings(sync_offset=MEASURED, **layout),
        lambda kind, text: said.append(f"{kind}: {text}"),
    )
    assert found == InputSettings(sync_offset=-31, **layout)
    assert said == ["note: --sync-offset -31: measured by the motion in 150 images"]


def test_the_commands_measure_it_and_check_writes_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [
        str(film(tmp_path / "l.mp4", LEFTS[40:170])),
        str(film(tmp_path / "r.mp4", RIGHTS[:130])),
    ]
    auto = ["--sync-offset", "auto"]
    out = tmp_path / "out"
    assert main(["run", *given, *auto, "-o", str(out), "--save", "steering", "--no-check"]) == 0
    assert "note: --sync-offset 40: measured by the motion" in capsys.readouterr().err
    assert json.loads((out / "run.json").read_text())["input_settings"]["sync_offset"] == "40"
    main(["check", *given, *auto, "--write", str(tmp_path / "run.toml")])
    assert tomllib.loads((tmp_path / "run.toml").read_text())["sync-offset"] == "40"
    # Without it, check finds the same by itself, far beyond what rows tell.
    main(["check", *given, "--write", str(tmp_path / "found.toml")])
    assert tomllib.loads((tmp_path / "found.toml").read_text())["sync-offset"] == 40


@pytest.mark.parametrize("lag", [0, 1, -3, 12, -17])
def test_of_short_recordings_the_rows_tell_it(tmp_path: Path, lag: int) -> None:
    left = film(tmp_path / "l.mp4", LEFTS[100 + max(0, lag) :][:40])
    right = film(tmp_path / "r.mp4", RIGHTS[100 + max(0, -lag) :][:40])
    assert with_offset(left, right, AUTO, quiet).offset == lag


def test_a_short_recording_whose_rows_tell_nothing_is_refused(tmp_path: Path) -> None:
    # A view that moves across alone is another one of the same later, at another disparity.
    wide = np.concatenate([WORLD[0], WORLD[200], WORLD[300]], axis=1)
    moving = np.array([wide[:, 3 * n :][:, :160] for n in range(60)])
    left, right = film(tmp_path / "l.mp4", moving[5:45]), film(tmp_path / "r.mp4", moving[:40])
    with pytest.raises(InputError, match=r"does not tell .* give --sync-offset N"):
        with_offset(left, right, AUTO, quiet)


@pytest.mark.parametrize(
    ("given", "pairs"),
    [
        *[({}, 6), ({"sync_offset": 0}, 8), ({"sync_offset": "2"}, 6)],
        *[({"sync_shift": 0}, 6), ({"sync_shift": "0.2"}, 8)],
    ],
)
def test_an_offset_or_a_shift_of_0_counts(
    tmp_path: Path, given: dict[str, Any], pairs: int
) -> None:
    sides = tmp_path / "left", tmp_path / "right"
    for begin, path in zip((0, 2), sides, strict=True):
        path.mkdir()
        for n, image in enumerate(LEFTS[:8]):
            cv2.imwrite(str(path / f"{1_700_000_000 + (n + begin) / 10:.6f}.png"), image)
    with open_stereo(*sides, InputSettings(**given)) as source:
        assert sum(1 for _ in source) == pairs


@pytest.mark.parametrize("value", ["x", "1.5", "1e99", "-2000000000"])
def test_an_offset_that_is_none_is_refused(value: str) -> None:
    with pytest.raises(SettingsError, match="--sync-offset cannot be"):
        InputSettings(sync_offset=value)
    if value != "1.5":
        with pytest.raises(SettingsError, match="--sync-shift cannot be"):
            InputSettings(sync_shift=value.replace("2000000000", "20000000000"))


def test_what_cannot_be_measured_is_said(tmp_path: Path) -> None:
    still = np.repeat(WORLD[:1], 40, axis=0)
    left, right = film(tmp_path / "l.mp4", still), film(tmp_path / "r.mp4", still)
    with pytest.raises(InputError, match="does not tell how far they are apart: give --sync-off"):
        with_offset(left, right, AUTO, quiet)
    with pytest.raises(SettingsError, match="auto is to be measured first"):
        open_stereo(left, right, AUTO)


def test_a_recording_that_loses_images_is_said_to_drift(tmp_path: Path) -> None:
    moving = world(900, 5)
    kept = [n for n in range(900) if n not in (400, 450, 500)]
    left = film(tmp_path / "l.mp4", moving[5:])
    right = film(tmp_path / "r.mp4", np.roll(moving, -7, axis=2)[kept])
    said: list[str] = []
    found = with_offset(left, right, AUTO, lambda kind, text: said.append(f"{kind}: {text}"))
    assert found.offset == 5
    assert "warning: the recordings drift apart: at their end -3 images more" in said[1]


def with_sound(path: Path, sound: NDArray[np.float32], rate: int, begin_s: float = 0) -> Path:
    """A video of 2 s or more that has a sound."""
    with av.open(str(path), "w") as container:
        video: Any = container.add_stream("libx264", rate=10)
        video.width, video.height, video.pix_fmt = 64, 48, "yuv420p"
        track: Any = container.add_stream("aac", rate=rate)
        track.codec_context.layout = "mono"
        for index in range(10 * len(sound) // rate):
            picture = scene()[index % 12]
            frame = av.VideoFrame.from_ndarray(picture, "gray").reformat(format="yuv420p")
            frame.pts, frame.time_base = index, Fraction(1, 10)
            container.mux(video.encode(frame))
        container.mux(video.encode(None))
        samples = av.AudioFrame.from_ndarray(sound[None], format="fltp", layout="mono")
        samples.sample_rate, samples.pts, samples.time_base = rate, 0, Fraction(1, rate)
        fifo = av.AudioFifo()
        fifo.write(samples)
        while (part := fifo.read(1024, partial=True)) is not None:
            container.mux(track.encode(part))
        container.mux(track.encode(None))
    return path


@pytest.mark.parametrize("shift_s", [0.0, 0.4567, -1.2345, 3.001])
def test_sound_tells_the_shift(tmp_path: Path, shift_s: float) -> None:
    chance = np.random.default_rng(1)
    noise = np.convolve(chance.normal(0, 0.1, 48000 * 8), np.ones(20) / 6, "same")
    loud = (noise * np.abs(np.sin(np.arange(len(noise)) / 30000))).astype(np.float32)
    begin = round(48000 * 3.1)
    left = with_sound(tmp_path / "l.mp4", loud[begin:], 48000)
    # What the right camera shows at t, the left one shows at t - shift_s.
    right = with_sound(tmp_path / "r.mp4", loud[round(begin - 48000 * shift_s) :], 48000)
    found = sound_shift_s(left, right, 10**6)
    assert found == pytest.approx(shift_s, abs=2e-3)
    said: list[str] = []
    measured = with_offset(left, right, AUTO, lambda kind, text: said.append(text))
    assert float(measured.shift_s or 0) == pytest.approx(shift_s, abs=2e-3)
    assert measured.offset is None
    assert "measured by the sound in both recordings" in said[0]


def test_silence_and_other_sounds_tell_nothing(tmp_path: Path) -> None:
    chance = np.random.default_rng(2)
    sounds = [chance.normal(0, 0.1, 96000).astype(np.float32) for _ in range(2)]
    paths = [with_sound(tmp_path / f"{n}.mp4", sound, 48000) for n, sound in enumerate(sounds)]
    assert sound_shift_s(*paths, 10**6) is None
    silent = with_sound(tmp_path / "s.mp4", np.zeros(96000, np.float32), 48000)
    assert sound_shift_s(paths[0], silent, 10**6) is None
    assert sound_shift_s(paths[0], film(tmp_path / "mute.mp4", WORLD[:9]), 10**6) is None
