"""Disparity averaged in time: against a slow oracle, and over threads and interruptions."""

from dataclasses import replace

import numpy as np
import oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from motionstereo_cli.method.settings import Settings
from motionstereo_cli.method.steady import averaged, in_parts
from motionstereo_cli.pipeline import process
from motionstereo_cli.simulate.scenes import render_scene
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.types import StereoFrame


def sighting(rng):
    disparity = (5 + rng.integers(0, 9, (6, 9)) / 8).astype(np.float32)
    disparity[rng.random(disparity.shape) < 0.2] = np.nan
    return disparity, rng.integers(100, 108, disparity.shape).astype(np.uint8)


def in_short(seen):
    return in_parts(seen[0]), seen[1]


@settings(max_examples=40)
@given(st.integers(0, 10_000), st.integers(0, 5))
def test_averages_are_the_oracles(seed, count):
    rng = np.random.default_rng(seed)
    now, before = sighting(rng), [sighting(rng) for _ in range(count)]
    age = rng.choice([0, 1, 2, 5, 255], now[0].shape).astype(np.uint8)
    found = averaged(now[0], in_short(now), age, [in_short(each) for each in before])
    np.testing.assert_allclose(found, oracles.averaged(*now, age, before), rtol=0, atol=1e-5)


def test_parts_are_32nds_of_a_px():
    parts = in_parts(np.array([[np.nan, 0, 0.02, 3.26, 2039.5, 3000]], np.float32))
    assert parts.tolist() == [[0, 1, 1, 104, 65264, 65280]]


def test_what_moved_just_now_is_not_averaged():
    rng = np.random.default_rng(0)
    now = sighting(rng)
    age = np.zeros(now[0].shape, np.uint8)
    np.testing.assert_array_equal(averaged(now[0], in_short(now), age, [in_short(now)] * 2), now[0])


@pytest.fixture(scope="module")
def frames():
    """Cards that cross before a still camera, small."""
    scene = SimulateSettings(
        scene="cards", frames="14", width=128, height=96, noise_sigma=2.0, seed=3
    )
    return [
        StereoFrame(index, index, None, shot.left, shot.right)
        for index, shot in enumerate(render_scene(scene))
    ]


def disparities(frames, values=None, **more):
    return [result.disparity_px for result in process(frames, values, **more)]


def test_what_rests_changes_less_from_frame_to_frame(frames):
    steps = {}
    for count in (1, 8):
        results = list(process(frames, Settings(average_frames=count)))
        rests = (results[-1].age_frames > 3) & (results[-1].age_frames < 12)
        change = np.abs(results[-1].disparity_px - results[-2].disparity_px)[rests]
        steps[count] = np.nanmedian(change)
    assert steps[8] < 0.7 * steps[1]


@pytest.mark.parametrize("jobs", [2, 3])
def test_frames_side_by_side_give_the_same(frames, jobs):
    for one, other in zip(disparities(frames), disparities(frames, jobs=jobs), strict=True):
        np.testing.assert_array_equal(one, other)


def test_going_on_from_a_state_gives_the_same(frames):
    results = list(process(frames))
    later = disparities(frames[9:], state=results[8].state, jobs=2)
    for one, other in zip(results[9:], later, strict=True):
        np.testing.assert_array_equal(one.disparity_px, other)


def test_nothing_older_than_the_memories_and_the_average_matters(frames):
    values = Settings(charge_leak=85, average_frames=3)  # three frames, and two more
    other = [replace(frame, right=frame.right[::-1].copy()) for frame in frames[:6]]
    for one, two in zip(
        disparities(frames, values)[11:], disparities(other + frames[6:], values)[11:], strict=True
    ):
        np.testing.assert_array_equal(one, two)


def test_a_failure_in_one_frame_ends_all(frames, monkeypatch):
    def fail(*_, **__):
        raise MemoryError("too large")

    monkeypatch.setattr("motionstereo_cli.pipeline.match", fail)
    with pytest.raises(MemoryError, match="too large"):
        disparities(frames, jobs=3)
