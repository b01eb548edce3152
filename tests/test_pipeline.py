"""The stream from frames to steering, on scenes whose truth is known."""

import dataclasses
import math

import cv2
import numpy as np
import pytest

from motionstereo_cli.errors import SettingsError
from motionstereo_cli.method import matching
from motionstereo_cli.method.bands import band_table
from motionstereo_cli.method.charge import permanency
from motionstereo_cli.method.memory import keys_of, see
from motionstereo_cli.method.motion import motion
from motionstereo_cli.method.settings import GIVEN, MATCHERS, PRESETS, Settings
from motionstereo_cli.pipeline import process
from motionstereo_cli.simulate.scenes import render_scene
from motionstereo_cli.simulate.settings import SimulateSettings
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


#: For headings: in these small scenes a fifth of the right view lies outside the left one.
TRAILS = Settings(matcher="trails")


def last(results):
    *_, result = results
    return result


def test_at_the_first_frame_nothing_has_moved():
    result = next(process(sliding([10, 10])))
    assert (result.charged, result.matched) == (0, 0)
    assert np.isnan(result.disparity_px).all()
    assert result.steering.status == "blind"
    assert result.steering.steer is None


@pytest.mark.parametrize("matcher", [name for name in MATCHERS if name != GIVEN])
@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("disparity", [3, 17])
def test_a_sliding_wall_has_its_disparity(matcher, preset, disparity):
    settings = Settings.preset(preset, matcher=matcher, max_disparity=32)
    result = last(process(sliding([disparity]), settings, RIG))
    seen = result.disparity_px[:, 8 : 150 - disparity]
    known = ~np.isnan(seen)
    assert known.mean() > 0.5
    assert np.median(np.abs(seen[known] - disparity)) < 0.2
    depth = result.depth_m[~np.isnan(result.depth_m)]
    assert np.median(depth) == pytest.approx(140 * 0.12 / disparity, rel=0.02)
    assert result.matched == pytest.approx((~np.isnan(result.disparity_px)).mean())


def test_heads_for_the_far_side_and_says_left_is_positive():
    for disparities, sign in (([4, 24], 1), ([24, 4], -1)):
        steering = last(process(sliding(disparities), TRAILS, RIG)).steering
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
    result = last(process(sliding([4, 24]), TRAILS))
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
    settings = Settings(charge_mode="general", charge_gain=50, contrast_px=0, blur_px=0, min_jump=0)
    levels = [(0, 200)[index % 2] for index in range(4)]
    flicker = [np.full((8, 9), level, np.uint8) for level in levels]
    frames = [StereoFrame(i, i, None, grey, grey) for i, grey in enumerate(flicker)]
    assert [int(r.charge[0, 0]) for r in process(frames, settings)] == [0, 50, 100, 150]


def test_what_makes_pixels_equal_is_a_setting():
    for match_on, several_units_a_charge in (("charge", False), ("charge-band", True)):
        settings, memory = Settings(match_on=match_on), None
        for frame in sliding([8]):
            memory = see(memory, frame.right, settings)
        full = keys_of(memory, settings)[memory.charge == 255]
        assert (len(np.unique(full)) > 1) == several_units_a_charge


def test_the_settings_reach_the_stages():
    frames = list(sliding([8]))
    plain = last(process(frames))
    for change in (
        {"contrast_px": 15.0},
        {"bands": 3},
        {"blur_px": 3.0},
        {"grey_min": 100},
        {"grey_max": 120},
        {"min_jump": 90},
        {"charge_max": 100},
        {"charge_leak": 90},
        {"charge_mode": "general", "charge_gain": 9},
        {"charge_min": 90},
    ):
        changed = last(process(frames, Settings(**change)))
        assert not np.array_equal(plain.charge, changed.charge), change
    for change in ({"max_disparity": 5}, {"matcher": "trails"}, {"speckle_px": 100_000}):
        changed = last(process(frames, Settings(**change)))
        assert not np.array_equal(plain.disparity_px, changed.disparity_px, equal_nan=True), change


def test_max_age_keeps_what_moved_lately():
    frames = list(sliding([12], frames=8))
    frames += [dataclasses.replace(frames[-1], index=8 + i, pts=8 + i) for i in range(3)]
    everything = last(process(frames))
    fresh = last(process(frames, Settings(max_age=4)))
    known = ~np.isnan(everything.disparity_px)
    old = everything.age_frames > 4
    assert known[old].any()
    assert np.isnan(fresh.disparity_px[old]).all()
    np.testing.assert_array_equal(fresh.disparity_px[~old], everything.disparity_px[~old])


def test_min_confidence_keeps_what_is_likely_right():
    frames = list(sliding([12, 25], frames=8))
    everything = last(process(frames))
    likely = last(process(frames, Settings(min_confidence=0.98)))
    kept = everything.confidence >= np.float32(0.98)
    assert 0.2 < kept[~np.isnan(everything.disparity_px)].mean() < 0.9
    assert np.array_equal(~np.isnan(likely.disparity_px), kept)


@pytest.mark.parametrize(
    "change",
    [
        {"charge_mode": "general", "max_age": 3},
        {"matcher": "regions", "min_confidence": 0.5},
        {"grey_min": 9, "grey_max": 9},
        {"charge_min": 9, "charge_max": 9},
    ],
)
def test_settings_that_contradict_each_other_are_refused(change):
    with pytest.raises(SettingsError):
        Settings(**change)


@pytest.fixture(scope="module")
def corridor():
    """Errors in px and confidence of the corridor's matched pixels, up to its end, with noise."""
    scene = list(render_scene(SimulateSettings(frames="310:350", noise_sigma=1.5)))
    frames = (StereoFrame(i, i, None, f.left, f.right) for i, f in enumerate(scene))
    errors, chances = [], []
    for result, truth in zip(process(frames), scene, strict=True):
        known = ~np.isnan(result.disparity_px)
        errors.append(np.abs(result.disparity_px - truth.disparity_px)[known])
        chances.append(result.confidence[known])
    return np.concatenate(errors), np.concatenate(chances)


def test_the_corridor_is_matched_rightly(corridor):
    errors, _ = corridor
    assert len(errors) > 0.3 * 40 * 320 * 240
    assert (errors > 1).mean() < 0.2  # at the corner, trails of the inner wall cover what opens
    assert np.median(errors) < 0.3


def test_confidence_is_calibrated(corridor):
    errors, chance = corridor
    for low, high in ((0.8, 0.9), (0.9, 0.95), (0.95, 1.0)):
        within = (chance >= low) & (chance < high)
        assert within.sum() > 1000
        assert (errors[within] <= 1).mean() == pytest.approx(chance[within].mean(), abs=0.11)


def test_the_surer_the_fewer_errors(corridor):
    """The sparsification curve: the mean error of the surest share falls steadily."""
    errors, chance = corridor
    best_first = errors[np.argsort(-chance, kind="stable")]
    kept = [best_first[: int(share * len(errors))].mean() for share in (0.25, 0.5, 0.75, 1.0)]
    assert kept == sorted(kept)
    assert kept[0] < 0.8 * kept[-1]


@pytest.mark.parametrize("leak", [1, 16, 255])
def test_memories_in_one_pass_are_those_of_the_equations(leak):
    random = np.random.default_rng(leak)
    charges = {"charge_leak": leak, "charge_max": 200, "charge_min": 7}
    options = Settings(**charges, min_jump=3, blur_px=0, contrast_px=0)
    memory, bands, charge = None, None, np.full((9, 21), 7, np.uint8)
    table = band_table(options.bands)
    for _ in range(6):
        grey = random.integers(90, 102, (9, 21)).astype(np.uint8)
        before, memory = memory, see(memory, grey, options)
        if before is not None:
            moved = motion(table[grey], bands, grey, before.grey, 3)
            charge = permanency(charge, moved, charge_max=200, charge_min=7, leak=leak)
            assert np.array_equal(memory.moved, moved)
        assert np.array_equal(memory.charge, charge)
        bands = table[grey]
    assert charge.max() == 200


def test_what_is_not_asked_for_is_not_found():
    result = last(process(sliding([10], frames=2), rig=RIG, extras=()))
    assert result.depth_m is None
    assert result.age_frames is None
    assert result.confidence is None
    assert result.disparity_px is not None


@pytest.mark.parametrize("reference", ["right", "left"])
@pytest.mark.parametrize("matcher", ["sgbm", "bm", "consensus"])
def test_matchers_of_images_need_no_memory_of_the_other_view(monkeypatch, matcher, reference):
    frames = list(sliding([20]))
    settings = Settings(matcher=matcher, reference=reference, max_disparity=31)
    found = list(process(frames, settings))
    whole = MATCHERS[matcher]._replace(compares_memories=True)
    monkeypatch.setitem(MATCHERS, matcher, whole)
    for one, other in zip(found, process(frames, settings), strict=True):
        assert np.array_equal(one.disparity_px, other.disparity_px, equal_nan=True)
        assert np.array_equal(one.charge, other.charge)
        assert one.steering == other.steering
        left, right = one.state.left, one.state.right
        resting = left if reference == "right" else right
        assert not resting.moved.any()
    assert any(np.isfinite(result.disparity_px).any() for result in found)


@pytest.mark.parametrize("large", [(70, 150), (35, 75)])
@pytest.mark.parametrize("size", [(80, 160), (81, 163), (95, 157), (82, 161)])
def test_large_views_are_matched_at_half_the_size_and_refined(monkeypatch, large, size):
    monkeypatch.setattr(matching, "_LARGE_PX", large)
    height, width = size
    noise = np.random.default_rng(0).standard_normal((height, width + 40)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 3)
    wall = (120 + 35 * smooth / smooth.std()).clip(0, 255).astype(np.uint8)
    frames = []
    for index in range(3):
        first = 40 - 3 * index  # 13 px further to the left in the left view
        right, left = (wall[:, begin : begin + width] for begin in (first, first - 13))
        frames.append(StereoFrame(index, index, None, left, right))
    *_, last = process(frames, Settings(max_disparity=24, depth_of="all"))
    inside = last.disparity_px[:, : width - 13]
    assert np.mean(~np.isnan(inside)) > 0.95
    np.testing.assert_allclose(np.nanmedian(inside), 13, atol=0.1)
    assert np.nanmean(np.abs(inside - 13) > 1) < 0.02
    np.testing.assert_array_equal(np.isnan(last.confidence), np.isnan(last.disparity_px))
