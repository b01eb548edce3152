"""What moves by itself, seen from a moving camera, against a slow oracle and exact masks."""

import dataclasses
import math

import cv2
import numpy as np
import pytest

from motionstereo_cli.compiled import movers as loops
from motionstereo_cli.compiled import patches, point_disparity
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.pipeline import StreamContext, process, steps
from motionstereo_cli.robot.movers import Moment, Movers, ReferenceCamera, _down, pyramid, see
from motionstereo_cli.simulate.scenes import render_scene
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.types import StereoFrame

CAMERA = ReferenceCamera((60.0, 55.0), 31.2, 23.7, 30.0, 1, 12.0, 1.2, 16)
LIMITS = loops.Limits(2.0, 0.05, 3.0, 0.5, 0.06, 0.25, 0.02, 16.0, 1.5, 0.25)


def between(image, x, y):
    """Grey between pixels."""
    column, row = int(x), int(y)
    square = image[row : row + 2, column : column + 2].astype(float)
    return np.array([1 - y + row, y - row]) @ square @ np.array([1 - x + column, x - column])


def unexplained_slowly(now, then, motion, cell):
    """Cells whose grey is not explained, with points in space."""
    (view, other, disparity), (old_view, old_other, _) = now, then
    height, width = view.shape
    result = np.zeros((height // cell, width // cell), np.uint8)
    fx, fy = CAMERA.focal_px
    for row, column in np.ndindex(result.shape):
        middle = disparity[row * cell + cell // 2, column * cell + cell // 2]
        if not middle + CAMERA.doffs_px > 0:
            continue
        offs, slopes = ([], []), 0
        for y, x in np.ndindex(cell, cell):
            y, x = y + row * cell, x + column * cell  # noqa: PLW2901
            near = disparity[y, x] + CAMERA.doffs_px
            if (x + y) % 2:
                continue  # every second pixel, as on a chessboard
            edge = not (0 < x < width - 1 and 0 < y < height - 1)
            jump = max(0.5, 0.06 * (middle + CAMERA.doffs_px))
            if edge or not abs(disparity[y, x] - middle) <= jump:
                continue
            place = x + float(disparity[y, x])
            depth = CAMERA.focal_baseline / near
            here = [(x - CAMERA.cx_px) / fx * depth, (y - CAMERA.cy_px) / fy * depth, depth, 1]
            X, Y, Z, _ = motion @ here
            u, v = CAMERA.cx_px + fx * X / Z, CAMERA.cy_px + fy * Y / Z
            w = u - CAMERA.doffs_px + CAMERA.focal_baseline / Z
            inside = 0 <= u < width and 0 <= w < width and 0 <= v < height
            if not (2 <= place < width - 3 and inside):
                continue
            u, w = (min(each, width - 1.001) for each in (u, w))
            v = min(v, height - 1.001)
            offs[0].append(between(old_view, u, v) - view[y, x])
            offs[1].append(between(old_other, w, v) - between(other, place, y))
            slopes += ((float(view[y, x + 1]) - view[y, x - 1]) / 2) ** 2
            slopes += ((float(view[y + 1, x]) - view[y - 1, x]) / 2) ** 2
        count = len(offs[0])
        if 4 * count >= cell * cell:
            squares = sum(np.var(each) * count for each in offs)
            result[row, column] = squares > 3 * (2 * count * 4 + 0.05 * slopes)
    return result


def rough(rng, shape, blur=1.5):
    """Texture without fine detail, which survives interpolation."""
    noise = cv2.GaussianBlur(rng.standard_normal(shape).astype(np.float32), (0, 0), blur)
    return np.clip(128 + 60 * noise / noise.std(), 0, 255).astype(np.uint8)


def test_the_search_for_what_is_not_explained_does_what_is_said():
    rng = np.random.default_rng(7)
    shape = 48, 64
    now, then = (
        [*(rough(rng, shape, 6) for _ in range(2)), rng.uniform(3, 3.6, shape).astype(np.float32)]
        for _ in range(2)
    )
    then[:2] = (np.where(np.arange(64) < 30, a, b) for a, b in zip(now, then[:2], strict=False))
    now[2][rng.random(shape) < 0.1] = np.nan
    motion = np.eye(4)
    motion[:3, :3] = cv2.Rodrigues(np.array([0.002, -0.003, 0.001]))[0]
    motion[:3, 3] = 0.01, -0.02, 0.03
    result = np.full((12, 16), 99, np.uint8)
    work = loops.Workspace()
    moments = [moment(*each) for each in (now, then)]
    loops.find(*moments, CAMERA.at(0), motion, LIMITS, math.inf, work, result)
    wanted = unexplained_slowly(now, then, motion, 4)
    assert np.array_equal(result, wanted)
    assert 0.1 < wanted.mean() < 0.6


def moment(view, other, disparity):
    """A moment for the loops."""
    return patches.FrameLevel(
        *(np.ravel(each) for each in (view, other, disparity)), *disparity.shape
    )


def moved_scene(rng, shift, change, shape=(64, 96), disparity=6.0):
    """A flat scene now and then; before, its grey was ``shift`` and ``change`` px elsewhere."""
    ground = rough(rng, (shape[0] + 40, shape[1] + 80), 2)

    def seen(right, down):
        way = np.array([[1, 0, right + 40], [0, 1, down + 20]], np.float32)
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        return cv2.warpAffine(ground, way, shape[::-1], flags=flags)

    flat = np.full(shape, disparity, np.float32)
    now = moment(seen(0, 0), seen(-disparity, 0), flat)
    before = disparity + change
    views = seen(-shift[0], -shift[1]), seen(-shift[0] - before, -shift[1])
    return now, moment(*views, flat + np.float32(change))


@pytest.mark.parametrize("shift", [(2.4, -0.6), (-1.3, 0.8), (0.0, 1.5)])
@pytest.mark.parametrize("change", [0.0, 0.7])
def test_a_shift_is_measured_in_both_views(shift, change):
    now, then = moved_scene(np.random.default_rng(5), shift, change)
    result = np.zeros((16, 24, loops.FIELDS), np.float32)
    camera = ReferenceCamera((90.0, 90.0), 47.5, 31.5, 47.5, 1, 9.0, 0.0, 16).at(0)
    wanted, coarse = np.ones((16, 24), np.uint8), np.empty((0, 0, loops.FIELDS), np.float32)
    work = loops.Workspace()
    loops.align(now, then, camera, np.eye(4), LIMITS, wanted, coarse, 0.0, work, result)
    inner = result[4:12, 5:19]
    assert np.isfinite(inner[..., 0]).mean() > 0.9
    assert np.nanmedian(inner[..., :3], axis=(0, 1)) == pytest.approx([*shift, change], abs=0.1)
    assert np.nanmedian(inner[..., 3]) > 100  # it is sure
    assert abs(np.nanmedian(inner[..., 4])) < 0.1  # disparity then was what it had to be
    assert np.nanmedian(inner[..., 5]) < 0.2  # what differed is explained


def test_what_the_camera_follows_by_a_turn_is_found_where_it_stays_in_the_image():
    """The turn takes what stands 23 px and more across the image, farther than patches reach."""
    now, then = moved_scene(np.random.default_rng(5), (1.0, 0.0), 0.0)
    focal_px, middle_x, turn = 90.0, 47.5, 0.25
    camera = ReferenceCamera((focal_px, focal_px), middle_x, 31.5, middle_x, 1, 9.0, 0.0, 16).at(0)
    motion = np.eye(4)
    motion[:3, :3] = cv2.Rodrigues(np.array([0, -turn, 0]))[0]
    limits = loops.Limits(2.0, 0.05, 3.0, 0.5, 0.06, 0.25, 0.02, 64.0, 1.5, 0.25)
    wanted, coarse = np.ones((16, 24), np.uint8), np.empty((0, 0, loops.FIELDS), np.float32)
    result = np.zeros((16, 24, loops.FIELDS), np.float32)
    loops.align(now, then, camera, motion, limits, wanted, coarse, 0.0, loops.Workspace(), result)
    x = 4 * np.arange(10, 19) + 2
    stood = middle_x + focal_px * np.tan(np.arctan((x - middle_x) / focal_px) - turn)
    assert np.nanmedian(result[4:12, 10:19, 0], axis=0) == pytest.approx(x + 1 - stood, abs=1)


def test_only_what_promises_to_have_moved_is_aligned_and_what_is_beside_that():
    now, then = moved_scene(np.random.default_rng(5), (2.4, -0.6), 0.0)
    camera = ReferenceCamera((90.0, 90.0), 47.5, 31.5, 47.5, 1, 9.0, 0.0, 16).at(0)
    wanted, work = np.ones((16, 24), np.uint8), loops.Workspace()

    def aligned(coarse, promise):
        result = np.zeros((16, 24, loops.FIELDS), np.float32)
        moments = now, then, camera, np.eye(4), LIMITS
        loops.align(*moments, wanted, coarse, promise, work, result)
        return result

    coarse = np.full((8, 12, loops.FIELDS), np.nan, np.float32)
    assert np.isnan(aligned(coarse, 6.0)).all()
    coarse[4, 6] = 1.2, -0.3, 0, 5, 0, 0.1  # not sure enough
    assert np.isnan(aligned(coarse, 6.0)).all()
    coarse[4, 6, 3] = 50
    found, whole = aligned(coarse, 6.0), aligned(coarse, 0.0)
    assert np.isnan(found[:7]).all()
    assert np.isnan(found[7, :11]).all()
    there = np.isfinite(found[7:, 11:20, 0])
    assert there.mean() > 0.7  # it grows to the right and down
    assert np.allclose(found[7:, 11:20, :2][there], whole[7:, 11:20, :2][there], atol=0.05)


def test_the_steepest_unknown_pixel_of_each_square_is_taken():
    rng = np.random.default_rng(8)
    view = rng.integers(0, 9, (26, 35)).astype(np.float32) * 10  # often equally steep
    disparity = np.where(rng.random(view.shape) < 0.7, np.float32(np.nan), np.float32(3))
    places = np.empty((12, 2), np.int32)
    count = point_disparity.edges(view, disparity, 8, 8.0, np.empty((2, 35), np.float32), places)
    wanted = []
    for top, left in np.ndindex(3, 4):
        best = 64.0, None
        for y, x in np.ndindex(8, 8):
            y, x = 8 * top + y, 8 * left + x  # noqa: PLW2901
            if min(x, y) < 1 or y > 24 or x > 33 or not np.isnan(disparity[y, x]):
                continue
            slope = abs((view[y - 1 : y + 2, x + 1] - view[y - 1 : y + 2, x - 1]) @ (1, 2, 1))
            best = max(best, (slope, (x, y)), key=lambda each: each[0])
        wanted += [best[1]] if best[1] else []
    assert places[:count].tolist() == [list(place) for place in wanted]
    assert count > 6


@pytest.mark.parametrize("size", [(1, 1), (5, 40), (40, 5), (8, 8)])
def test_nothing_is_found_in_views_that_hold_hardly_a_patch(size):
    view = np.random.default_rng(1).integers(0, 256, size, np.uint8)
    known = Movers()
    for time_s in (0.0, 0.1):
        now = Moment(pyramid(view, view), np.full(size, 4, np.float32), np.eye(4), time_s)
        known, found, _ = see(known, now, CAMERA)
        assert found.shape == size
        assert not found.any()


def test_what_stands_or_was_hidden_or_is_not_asked_for_has_no_shift():
    shape = 16, 24, loops.FIELDS
    camera = ReferenceCamera((90.0, 90.0), 47.5, 31.5, 47.5, 1, 9.0, 0.0, 16).at(0)
    coarse, work = np.empty((0, 0, loops.FIELDS), np.float32), loops.Workspace()
    for shift, asked, hides in ((0.0, 1, 0.0), (2.0, 0, 0.0), (2.0, 1, 4.0)):
        now, then = moved_scene(np.random.default_rng(5), (shift, 0.0), 0.0)
        then = moment(then.view, then.other, np.full((64, 96), 6 + hides, np.float32))
        result = np.zeros(shape, np.float32)
        wanted = np.full((16, 24), asked, np.uint8)
        loops.align(now, then, camera, np.eye(4), LIMITS, wanted, coarse, 0.0, work, result)
        assert np.isnan(result).all()


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
    assert (fresh & near).sum() > 40
    assert (fresh & ~near).sum() < 0.1 * fresh.sum()
    moved = (last.charge == 255).mean()
    assert moved > 10 * fresh.mean()  # the plain memory has the whole street
    boxes = [(each.x, each.y, each.width, each.height) for each in last.objects]
    assert boxes
    speeds = [each.over_ground_mps for each in last.objects if each.over_ground_mps is not None]
    assert speeds == pytest.approx([8.0] * len(speeds), abs=1)
    for x, y, width, height in boxes:
        assert near[y : y + height, x : x + width].any()


def test_what_moves_by_itself_is_not_in_a_map_that_has_poses_and_the_heading_is_the_same():
    rig, shots, frames = frames_of(scene="street", frames="14:30", seed=8, street_winding_deg=25)
    entered, headings = [], []
    for with_movers in (False, True):
        context = StreamContext.of(
            *(Settings(max_disparity=48), rig),
            with_poses=True,
            with_objects=with_movers,
            poses_are_given=True,
            with_own_motion=with_movers,
            with_movers=with_movers,
            extras=("depth_m",),
            with_points=True,
        )
        found = [
            step for _, step, _ in steps(frames, context, lambda f: shots[f.index].pose.rig_pose)
        ]
        headings.append([step.steering for step in found])
        on_movers, others = 0, 0
        for shot, step in zip(shots[5:], found[5:], strict=True):
            x, y, z = step.points[0].T
            column = np.rint(x / z * rig.focal_px + rig.cx).astype(int)
            row = np.rint(y / z * rig.fy_px + rig.cy).astype(int)
            on_mover = shot.mover[row, column] > 0
            on_movers, others = on_movers + on_mover.sum(), others + (~on_mover).sum()
        entered.append((on_movers, others))
    (before, standing), (after, standing_after) = entered
    assert before > 1000
    assert after < 0.3 * before, (before, after)
    assert standing_after > 0.9 * standing
    assert headings[0] == headings[1]


def test_movers_heed_the_constant_error_of_disparity_that_own_motion_has():
    rig, _, frames = frames_of(scene="street", frames="14:30", seed=8, street_winding_deg=25)
    wrong = rig.with_disparity_offset(-1.5)
    found = []
    for believed, offset_px in ((rig, 0.0), (wrong, 1.5)):
        context = StreamContext.of(
            *(Settings(max_disparity=48), believed),
            with_poses=True,
            with_objects=True,
            with_own_motion=True,
            with_movers=True,
            motion_offset_px=offset_px,
            extras=(),
        )
        rows = [step.objects for _, step, _ in steps(frames, context, lambda _: None)]
        found.append([(o.id, o.x, o.y, o.over_ground_mps) for row in rows for o in row])
    assert len(found[0]) > 10
    assert len(found[0]) == len(found[1])
    for one, other in zip(*found, strict=True):
        assert other == pytest.approx(one, abs=0.1)


def test_with_given_poses_the_same_moves_by_itself():
    rig, _, frames = frames_of(scene="street", frames="14:28", seed=8)
    settings = Settings(max_disparity=48)
    auto = list(process(frames, settings, rig, "auto", extras=()))
    poses = {result.frame.index: result.pose for result in auto}
    given = list(process(frames, settings, rig, lambda frame: poses[frame.index], extras=()))
    rows = [[dataclasses.astuple(each) for each in result.objects] for result in given]
    assert rows == [[dataclasses.astuple(each) for each in result.objects] for result in auto]
    assert any(each.by_itself for result in given for each in result.objects)
    assert all(np.array_equal(a.own_charge, b.own_charge) for a, b in zip(auto, given, strict=True))


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


@pytest.mark.parametrize(
    ("places", "size", "wall_px", "even"),
    [
        ((60, 64, 68, 72), 40, 0, True),
        ((60, 64, 60, 64), 40, 0, False),
        ((10, 19, 28, 37), 88, 0, True),
        ((60, 64, 68, 72), 40, 8, True),
    ],
)
def test_a_thing_has_to_move_on_as_it_did(places, size, wall_px, even):
    """A patch that crosses is seen; one that is now here, now there, is not.

    In the first frame nothing has changed yet, so that edges alone have a disparity. The rig
    stands, or goes up by as much as moves the wall by some px down.
    """
    rng = np.random.default_rng(3)
    wall, card = rough(rng, (120, 240), 2), rough(rng, (size, size), size / 20)
    camera, movers, found = (
        ReferenceCamera((150.0, 150.0), 99.5, 59.5, 99.5, 1, 15.0, 0.0, 24),
        Movers(),
        [],
    )
    for number, place in enumerate(places):
        moved_wall = np.roll(wall, number * wall_px, axis=0)
        view, other = moved_wall.copy(), np.roll(moved_wall, 4, axis=1)
        top = 4 + 3 * wall_px * number
        bottom = top + size
        view[top:bottom, place : place + size] = card
        other[top:bottom, place + 12 : place + 12 + size] = card
        disparity = np.full(wall.shape, 4.0 if number else np.nan, np.float32)
        if number:
            disparity[top:bottom, place : place + size] = 12
        step = np.eye(4)
        step[1, 3] = -wall_px * 3.75 / 150
        now = Moment(pyramid(view, other), disparity, step, 0.1 * number)
        movers, moved, velocity_mps = see(movers, now, camera)
        found.append(moved)
        known = np.isfinite(movers.disparity_px)
        assert known.all() if number else 0.1 < known.mean() < 1
    assert not found[0].any()
    assert not found[1].any()  # nothing is known of the frame before
    inside = np.zeros(wall.shape, np.bool_)
    inside[max(top - 4, 0) : bottom + 4, place - 4 : place + size + 4] = True
    assert not (found[-1] & ~inside).any()
    assert (found[-1].sum() > 600) == even
    told = velocity_mps[np.isfinite(velocity_mps[..., 0])]
    assert 16 * len(told) == found[-1].sum()
    assert found[2].any() == even
    if even:  # at 1.25 m, with 150 px a radian
        across_mps = 10 * (places[1] - places[0]) * 1.25 / 150
        right, down, ahead, per_px, age_s = np.median(told[:, :5], axis=0)
        assert (right, ahead) == pytest.approx((across_mps, 0), rel=0.03, abs=0.02)
        assert np.isnan(down)  # the rig does not drive ahead
        back = round(1.25 / 12 / (0.1 * per_px))
        assert per_px == pytest.approx(1.25 / 12 / (0.1 * back), rel=1e-4)
        assert back in (1, 2, 3)
        assert age_s == pytest.approx(0.1 * back / 2)


@pytest.mark.parametrize("is_there", [True, False])
def test_what_moved_is_remembered_where_it_is_expected(is_there):
    """A card crosses; then no grey is left to see, and only the disparity tells where it is."""
    rng = np.random.default_rng(3)
    wall, card = rough(rng, (120, 240), 2), rough(rng, (40, 40), 2)
    camera, movers = ReferenceCamera((150.0, 150.0), 99.5, 59.5, 99.5, 1, 15.0, 0.0, 24), Movers()
    ages = []
    for number in range(12):
        place = 60 + 4 * number
        view, other = wall.copy(), np.roll(wall, 4, axis=1)
        view[40:80, place : place + 40] = other[40:80, place + 12 : place + 52] = card
        disparity = np.full(wall.shape, 4, np.float32)
        if number < 4:
            disparity[40:80, place : place + 40] = 12
        else:
            view, other = np.full_like(view, 128), np.full_like(view, 128)
            if is_there:
                disparity[40:80, place : place + 40] = 12
        now = Moment(pyramid(view, other), disparity, np.eye(4), 0.1 * number)
        movers, moved, velocity_mps = see(movers, now, camera)
        known = np.isfinite(velocity_mps[..., 5])
        inside = np.zeros(wall.shape, np.bool_)
        inside[36:84, place - 4 : place + 44] = True
        assert inside[2::4, 2::4][known].all()
        assert number < 4 or not moved.any()
        assert np.isnan(velocity_mps[..., 0][known]).all() == (number >= 4) or not known.any()
        ages.append(set(velocity_mps[..., 5][known].astype(int)))
    assert 0 in ages[3]
    later = [{age} for age in range(1, 7)] + [set()] * 2
    if is_there:
        assert all(expected <= found for expected, found in zip(later, ages[4:], strict=True))
    assert ages[-1] == set()
    assert is_there or not any(ages[4:])


@pytest.mark.parametrize("tilt_rad", [0.0, 0.4, -0.3])
@pytest.mark.parametrize("turn_rad", [0.0, 0.1])
def test_the_way_tells_how_a_camera_is_tilted(tilt_rad, turn_rad):
    """It drives ahead, level, and turns; the camera looks down by the tilt."""
    cos, sin = math.cos(tilt_rad), math.sin(tilt_rad)
    level_from_camera = np.array([[1, 0, 0], [0, cos, sin], [0, -sin, cos]])
    cos, sin = math.cos(turn_rad), math.sin(turn_rad)
    turn = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    motion = np.eye(4)
    motion[:3, :3] = level_from_camera.T @ turn @ level_from_camera
    motion[:3, 3] = level_from_camera.T @ turn @ (0, 0, 0.2)
    np.testing.assert_allclose(_down(motion), level_from_camera.T @ (0, 1, 0), atol=1e-9)
    motion[:3, 3] = 0.2, 0, 0.05  # it drives aside
    assert np.isnan(_down(motion)).all()
