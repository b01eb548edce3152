"""The stream from frames to steering, on scenes whose truth is known."""

import dataclasses
import math

import numpy as np
import pytest

from motionstereo_cli.pipeline import process
from motionstereo_cli.settings import PRESETS, Settings
from motionstereo_cli.types import Rig, StereoFrame

RIG = Rig(width=160, height=96, focal_px=140, baseline_m=0.12, cx=79.5, cy=47.5)


def texture(width, seed=0, height=96):
    """Upright stripes of random grey and width, some broken: something for motion to show on."""
    random = np.random.default_rng(seed)
    stripes = np.repeat(random.integers(0, 256, width), random.integers(3, 9, width))[:width]
    return np.tile(stripes, (height, 1)).astype(np.uint8)


def sliding(disparities, frames=6, step=2, seed=0):
    """Frames of a scene in vertical parts of equal width, each sliding and each at a disparity."""
    part = 160 // len(disparities)
    for index in range(frames):
        right, left = np.full((96, 160), 90, np.uint8), np.full((96, 160), 90, np.uint8)
        for number, d in reversed(list(enumerate(disparities))):
            strip = texture(part + 100, seed + number)[:, 40 - step * index :][:, :part]
            right[:, number * part : (number + 1) * part] = strip
            x = number * part + d
            left[:, x : x + part] = strip[:, : max(0, 160 - x)]
        yield StereoFrame(index, index, index / 30, left, right)


def last(results):
    *_, result = results
    return result


def test_at_the_first_frame_nothing_has_moved():
    result = next(process(sliding([10, 10])))
    assert (result.charged, result.matched) == (0, 0)
    assert np.isnan(result.disparity_px).all()
    assert result.steering.status == "blind"
    assert result.steering.steer is None


@pytest.mark.parametrize("matcher", ["trails", "regions"])
@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("disparity", [3, 17])
def test_a_sliding_wall_has_its_disparity(matcher, preset, disparity):
    settings = Settings.preset(preset, matcher=matcher, max_disparity=32)
    result = last(process(sliding([disparity]), settings, RIG))
    seen = result.disparity_px[:, 8 : 150 - disparity]
    known = ~np.isnan(seen)
    assert known.mean() > 0.5
    assert np.median(np.abs(seen[known] - disparity)) < 0.1
    depth = result.depth_m[~np.isnan(result.depth_m)]
    assert np.median(depth) == pytest.approx(140 * 0.12 / disparity, rel=0.02)
    assert result.matched == pytest.approx((~np.isnan(result.disparity_px)).mean())


def test_heads_for_the_far_side_and_says_left_is_positive():
    for disparities, sign in (([4, 24], 1), ([24, 4], -1)):
        steering = last(process(sliding(disparities), rig=RIG)).steering
        assert steering.status == "ok"
        assert math.copysign(1, steering.steer) == sign
        assert math.copysign(1, steering.steer_rad) == sign
        assert steering.depth_m == pytest.approx(140 * 0.12 / 4, rel=0.1)
        assert steering.nearest_m == pytest.approx(140 * 0.12 / 24, rel=0.1)


def test_the_angle_is_that_of_the_heading_seen_from_the_right_camera():
    rig = dataclasses.replace(RIG, cx=70.0, doffs=6.0)
    steering = last(process(sliding([24, 4]), rig=rig)).steering
    column = (1 - steering.steer) / 2 * 160 - 0.5
    assert steering.steer_rad == pytest.approx(math.atan((76.0 - column) / 140))


def test_holds_the_heading_when_all_has_been_forgotten():
    frames = list(sliding([4, 24]))
    still = [
        dataclasses.replace(frames[-1], index=len(frames) + i, pts=len(frames) + i)
        for i in range(17)
    ]
    results = list(process(frames + still, rig=RIG))
    moving, before, after = (results[i].steering for i in (len(frames) - 1, -3, -1))
    assert (moving.status, before.status, after.status) == ("ok", "ok", "held")
    assert results[-1].charged == 0
    assert after.steer == results[-2].steering.steer
    assert (after.depth_m, after.nearest_m) == (None, None)


def test_without_a_rig_nothing_is_in_metres_or_radians():
    result = last(process(sliding([4, 24])))
    assert result.depth_m is None
    steering = result.steering
    assert (steering.steer_rad, steering.depth_m, steering.nearest_m) == (None, None, None)
    assert steering.steer > 0


@pytest.mark.parametrize("leak", [16, 40])
def test_frames_older_than_the_memory_do_not_matter(leak):
    """The property that lets a long video be cut into pieces."""
    settings = Settings(charge_leak=leak)
    lasts = -(-255 // leak)
    frames = [*sliding([5, 30], 10, 3, seed=7), *sliding([9, 4], lasts + 2, seed=1)]
    whole = last(process(frames, settings))
    piece = last(process(frames[-lasts - 1 :], settings))
    np.testing.assert_array_equal(whole.charge, piece.charge)
    np.testing.assert_array_equal(whole.disparity_px, piece.disparity_px)


def test_general_charge_grows_step_by_step():
    settings = Settings(charge_mode="general", charge_gain=50, blur_px=0, least_jump=0)
    levels = [(0, 200)[index % 2] for index in range(4)]
    flicker = [np.full((8, 9), level, np.uint8) for level in levels]
    frames = [StereoFrame(i, i, None, grey, grey) for i, grey in enumerate(flicker)]
    assert [int(r.charge[0, 0]) for r in process(frames, settings)] == [0, 50, 100, 150]


def test_the_settings_reach_the_stages():
    frames = list(sliding([8]))
    plain = last(process(frames))
    for change in (
        {"bands": 3},
        {"blur_px": 3.0},
        {"grey_min": 100},
        {"grey_max": 120},
        {"least_jump": 90},
        {"charge_max": 100},
        {"charge_leak": 90},
        {"charge_mode": "general", "charge_gain": 9},
        {"charge_min": 90},
    ):
        changed = last(process(frames, Settings(**change)))
        assert not np.array_equal(plain.charge, changed.charge), change
    for change in ({"max_disparity": 5}, {"match_on": "charge"}, {"speckle_px": 10_000}):
        changed = last(process(frames, Settings(**change)))
        assert not np.array_equal(plain.disparity_px, changed.disparity_px, equal_nan=True), change
