"""What moves by itself, seen from a moving camera, against a slow oracle and exact masks."""

import math

import cv2
import numpy as np
import pytest

from motionstereo_cli.compiled import movers as loops
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.pipeline import process
from motionstereo_cli.robot.movers import Eye, Moment, Movers, see
from motionstereo_cli.simulate.scenes import render_scene
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.types import StereoFrame


def unexplained_slowly(view, other, disparity, then, eye, motion, way, jump, hidden):
    """The same pixel by pixel, with points in space. ``view``, ``other``: grey, low, high."""
    height, width = disparity.shape
    result = np.zeros((height, width), np.uint8)
    inside = lambda u: 1 <= u < width - 2  # noqa: E731
    for y in range(height):
        for x in range(width):
            nearness = disparity[y, x] + eye.doffs_px
            if not nearness > 0:
                continue
            depth = eye.focal_baseline / nearness
            fx, fy = eye.focal_px
            here = np.array([(x - eye.cx_px) / fx * depth, (y - eye.cy_px) / fy * depth, depth, 1])
            X, Y, Z, _ = motion @ here
            if Z / depth < 0.05:
                continue
            u, v = fx * X / Z + eye.cx_px, fy * Y / Z + eye.cy_px
            u2 = fx * (X + eye.side * eye.focal_baseline / fx) / Z + eye.other_cx_px
            x2 = math.floor(np.float64(x + eye.side * disparity[y, x]) + 0.5)
            seen = inside(u) and 1 <= v < height - 2 and inside(u2) and 0 <= x2 < width
            if not seen or max(abs(u - x), abs(v - y)) > way:
                continue
            offs = []
            for (grey, low, high), at, column in ((view, x, u), (other, x2, u2)):
                place = int(v + 0.5), int(column + 0.5)
                offs.append(
                    max(int(low[place]) - int(grey[y, at]), int(grey[y, at]) - int(high[place]))
                )
            near_then = then[int(v + 0.5), int(u + 0.5)] + eye.doffs_px
            wanted = eye.focal_baseline / Z
            was_hidden = near_then > wanted + max(hidden[0], hidden[1] * wanted)
            if min(offs) > jump and not was_hidden:
                result[y, x] = min(offs)
    return result


@pytest.mark.parametrize("side", [1, -1])
def test_the_loop_does_what_is_said(side):
    rng = np.random.default_rng(side + 5)
    eye = Eye((60.0, 55.0), 16.2, 11.7, 16.2 - side * 1.2, side, 12.0, 1.2)
    shape = 24, 36
    grey = [rng.integers(0, 256, shape).astype(np.uint8) for _ in range(6)]
    view, other = ((g, np.minimum(a, b), np.maximum(a, b)) for g, a, b in (grey[:3], grey[3:]))
    disparity, then = (rng.uniform(-2, 9, shape).astype(np.float32) for _ in range(2))
    disparity[rng.random(shape) < 0.2] = np.nan
    then[rng.random(shape) < 0.2] = np.nan
    motion = np.eye(4)
    motion[:3, :3] = cv2.Rodrigues(np.array([0.01, -0.03, 0.02]))[0]
    motion[:3, 3] = 0.05, -0.02, 0.2
    result = np.full(shape, 99, np.uint8)
    camera = loops.Camera(
        *(*eye.focal_px, eye.cx_px, eye.cy_px, eye.other_cx_px),
        *(eye.side, eye.focal_baseline, eye.doffs_px),
    )
    views = loops.View(*view), loops.View(*other)
    loops.unexplained(*views, disparity, then, camera, motion, 5.0, 12, 1.5, 0.25, result)
    wanted = unexplained_slowly(view, other, disparity, then, eye, motion, 5.0, 12, (1.5, 0.25))
    assert np.array_equal(result, wanted)
    assert 0.02 < (wanted > 0).mean() < 0.5


def frames_of(**given):
    settings = SimulateSettings(**{"width": 320, "height": 240, "noise_sigma": 1.5, **given})
    shots = list(render_scene(settings))
    frames = [
        StereoFrame(n, n, n / settings.frame_rate, shot.left, shot.right)
        for n, shot in enumerate(shots)
    ]
    return settings.rig, shots, frames


@pytest.mark.parametrize("reference", ["right", "left"])
def test_an_oncoming_car_is_seen_and_what_is_passed_is_not(reference):
    rig, shots, frames = frames_of(scene="street", frames="14:30", seed=8, street_winding_deg=25)
    settings = Settings(reference=reference, max_disparity=48)
    results = list(process(frames, settings, rig, "auto", extras=()))
    last, true = results[-1], shots[-1].mover > 0
    if reference == "left":  # the truth is of the right view
        true = cv2.dilate(true.astype(np.uint8), np.ones((3, 61), np.uint8)) > 0
    fresh = last.own_charge == 255
    near = cv2.dilate(true.astype(np.uint8), np.ones((21, 21), np.uint8)) > 0
    assert (fresh & near).sum() > 100
    assert (fresh & ~near).sum() < 0.1 * fresh.sum()
    moved = (last.charge == 255).mean()
    assert moved > 10 * fresh.mean()  # the plain memory has the whole street
    boxes = [(each.x, each.y, each.width, each.height) for each in last.objects]
    assert boxes
    for x, y, width, height in boxes:
        assert near[y : y + height, x : x + width].any()


def test_in_a_corridor_where_nothing_moves_nothing_is_listed():
    rig, _, frames = frames_of(scene="corridor", frames="92:112", seed=1)
    results = list(process(frames, Settings(max_disparity=48), rig, "auto", extras=()))
    assert sum(len(result.objects) for result in results) <= 1
    assert np.mean([(result.own_charge > 0).mean() for result in results]) < 0.005


def test_a_still_camera_has_what_it_has_without_own_motion():
    rig, _, frames = frames_of(scene="cards", frames="12", seed=3)
    plain = list(process(frames, None, rig, extras=()))
    found = list(process(frames, None, rig, "auto", extras=()))
    for one, other in zip(plain[1:], found[1:], strict=True):
        assert np.array_equal(one.charge, other.own_charge)
        assert [each.id for each in one.objects] == [each.id for each in other.objects]


def test_what_is_hidden_behind_is_not_new():
    """A wall that a pole hid a frame ago, and still does for nothing."""
    shape = 24, 36
    wall = np.full(shape, 60, np.uint8)
    then = wall.copy()
    then[:, 10:18] = 200
    flat = np.full(shape, 4.0, np.float32)
    hidden = flat.copy()
    hidden[:, 9:19] = 9
    found = {}
    for name, before in (("seen", flat), ("hidden", hidden)):
        movers = Movers()
        eye = Eye((60.0, 55.0), 16.0, 12.0, 16.0, 1, 12.0, 0.0)
        other = [np.roll(each, 4, axis=1) for each in (then, wall)]
        for view, left, disparity in ((then, other[0], before), (wall, other[1], flat)):
            movers, _ = see(movers, Moment(view, left, disparity, np.eye(4)), eye)
        found[name] = int(movers.found[-1].sum())
    assert found["seen"] > 20
    assert found["hidden"] == 0
