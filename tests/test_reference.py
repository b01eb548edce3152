"""Results in the left camera's view: as right as those in the right one's."""

import math

import numpy as np
import pytest

from motionstereo_cli.method.settings import Settings
from motionstereo_cli.pipeline import process
from motionstereo_cli.robot.guide import ImageGuide, MapGuide
from motionstereo_cli.robot.local_map import CELL_M
from motionstereo_cli.simulate.scenes import render_scene
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.types import Pose, Rig, StereoFrame

LEFT = Settings(reference="left")


def seen_from_the_left(disparity_px):
    """The left view's disparity from the right view's: each point moves, the nearer one hides."""
    height, width = disparity_px.shape
    left = np.full((height, width), -np.inf, np.float32)
    y, x = np.indices((height, width))
    place = np.rint(x + disparity_px).astype(int)
    inside = place < width
    np.maximum.at(left, (y[inside], place[inside]), disparity_px[inside])
    return np.where(np.isinf(left), np.nan, left)


def score(found, truth):
    """Coverage of the pixels that have truth, and of those covered, the share over 1 px off."""
    both = ~np.isnan(found) & ~np.isnan(truth)
    return both.sum() / (~np.isnan(truth)).sum(), np.mean(np.abs(found - truth)[both] > 1)


@pytest.mark.parametrize("scene", ["corridor", "cards"])
def test_left_results_are_as_right_as_right_ones(scene):
    settings = SimulateSettings(scene=scene, frames="250:262", pan=scene == "cards")
    shots = list(render_scene(settings))
    frames = [StereoFrame(n, n, None, shot.left, shot.right) for n, shot in enumerate(shots)]
    *_, right = process(frames, Settings())
    *_, left = process(frames, LEFT)
    right_coverage, right_bad = score(right.disparity_px, shots[-1].disparity_px)
    left_coverage, left_bad = score(left.disparity_px, seen_from_the_left(shots[-1].disparity_px))
    assert left_coverage > right_coverage - 0.05
    assert left_bad < right_bad + 0.02
    # And the truth of the other view would not do.
    assert score(left.disparity_px, shots[-1].disparity_px)[1] > 2 * left_bad


def test_everything_is_of_the_left_view():
    [*_, before, shot] = render_scene(SimulateSettings(frames="250:252", width=160, height=96))
    frames = [StereoFrame(n, n, None, s.left, s.right) for n, s in enumerate((before, shot))]
    *_, left = process(frames, LEFT)
    mirror = [
        StereoFrame(
            n, n, None, *(np.ascontiguousarray(view[:, ::-1]) for view in (s.right, s.left))
        )
        for n, s in enumerate((before, shot))
    ]
    *_, right = process(mirror, Settings())
    assert right.matched == left.matched > 0.05
    assert right.charged == left.charged
    for name in ("bands", "motion", "charge", "age_frames", "disparity_px", "confidence"):
        expected = getattr(right, name)[:, ::-1]
        np.testing.assert_array_equal(getattr(left, name), expected, err_msg=name)
        assert getattr(left, name).flags.c_contiguous, name
    assert left.steering.steer == pytest.approx(-right.steering.steer, abs=1e-6)


def test_angles_and_depth_are_those_of_the_left_camera():
    """A gap in the columns 100 to 129 of 160: the heading leads into it."""
    rig = Rig(width=160, height=96, focal_px=100, baseline_m=0.1, cx=80, cy=47.5, doffs=7)
    disparity_px = np.full((96, 160), 13, np.float32)
    disparity_px[:, 100:130] = 3
    for reference, cx in (("left", 80), ("right", 87)):
        settings = Settings(reference=reference, steer_gain=1)
        guide = ImageGuide(settings, rig)
        _, steering = guide.steer(None, guide.profile(disparity_px, disparity_px > 0))
        column = (1 - steering.steer) / 2 * 160 - 0.5
        assert 105 < column < 125
        assert steering.steer_rad == pytest.approx(math.atan2(cx - column, 100))
        assert steering.depth_m == pytest.approx(100 * 0.1 / (3 + 7))


@pytest.mark.parametrize("reference", ["left", "right"])
def test_the_map_has_things_where_they_are(reference):
    """A post 3 m ahead of the rig's middle; with a baseline of 1 m, each camera has it aside."""
    rig = Rig(width=161, height=96, focal_px=60, baseline_m=1, cx=80, cy=47.5)
    aside_px = 60 * 0.5 / 3
    column = round(80 + (aside_px if reference == "left" else -aside_px))
    disparity_px = np.full((96, 161), np.nan, np.float32)
    disparity_px[30:60, column - 1 : column + 2] = 60 * 1 / 3
    guide, state = MapGuide(Settings(reference=reference, max_disparity=32), rig), None
    seen = guide.profile(disparity_px, ~np.isnan(disparity_px))
    for _ in range(6):
        state, _ = guide.steer(state, seen, Pose(0, 0, 1, 0, 0, 0, 1))
    occupied = np.argwhere(state.map.evidence > 0) + state.map.corner + 0.5
    assert len(occupied)
    assert np.abs(occupied * CELL_M - (3, 0)).max() <= 0.25
