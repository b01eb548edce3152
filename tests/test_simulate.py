"""Rendered scenes: geometry, light, noise, truth and files, each against something independent."""

from __future__ import annotations

import csv
import math
from dataclasses import replace
from itertools import pairwise

import av
import cv2
import numpy as np
import pytest
from hypothesis import given, reject
from hypothesis import settings as profile
from hypothesis import strategies as st

from motionstereo_cli.compiled.surfaces import mean_grey
from motionstereo_cli.errors import OutputError, SettingsError
from motionstereo_cli.rig import read_rig
from motionstereo_cli.simulate import write as write_module
from motionstereo_cli.simulate.camera import EYE_HEIGHT_M, FloorPose, SceneCamera, stereo_cameras
from motionstereo_cli.simulate.cards import CARDS, WALL_M, Cards, card_state, pan_pose
from motionstereo_cli.simulate.corridor import HEIGHT_M, Corridor
from motionstereo_cli.simulate.layers import Layers
from motionstereo_cli.simulate.scenes import render_scene
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.simulate.street import Street
from motionstereo_cli.simulate.surfaces import NEAR_M, rectangle, render
from motionstereo_cli.simulate.texture import Texture
from motionstereo_cli.simulate.write import simulate
from motionstereo_cli.types import Rig

RIG = SimulateSettings().rig


def small(**values):
    return SimulateSettings(**{"width": 64, "height": 48, "frames": "3", **values})


def warped(left, disparity_px):
    """The left image seen from the right camera; NaN where it looks past the left image."""
    height, width = left.shape
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    source_u = u + disparity_px
    seen = cv2.remap(left.astype(np.float32), source_u, v, cv2.INTER_CUBIC)
    return np.where(source_u <= width - 1, seen, np.nan)


def finer(camera: SceneCamera, times: int) -> SceneCamera:
    """The same camera with each pixel cut into times x times."""
    return SceneCamera(
        camera.width * times,
        camera.height * times,
        camera.focal_px * times,
        (camera.cx + 0.5) * times - 0.5,
        (camera.cy + 0.5) * times - 0.5,
        camera.left_m,
    )


# The corridor.


def test_end_of_the_corridor_has_the_depth_worked_out_by_hand():
    # 16 m straight, then a quarter circle of 4 m: its radius is 8 / pi. The robot starts 8 m
    # before the middle of the side; the end wall is 8 m + the radius + half of 3 m beyond it.
    corridor = Corridor()
    depth = corridor.render(corridor.path(0), stereo_cameras(RIG)[1]).depth_m
    assert depth[118:122, 158:162] == pytest.approx(16 + 8 / math.pi + 1.5)


def test_walls_floor_and_ceiling_have_the_depths_of_similar_triangles():
    corridor = Corridor()
    right = stereo_cameras(RIG)[1]
    depth = corridor.render(corridor.path(250), right).depth_m
    f = RIG.focal_px
    # The right camera is 0.06 m nearer to the right wall.
    assert depth[120, 319] == pytest.approx(f * (1.5 - 0.06) / (319 - right.cx))
    assert depth[120, 0] == pytest.approx(f * (1.5 + 0.06) / right.cx)
    assert depth[239, 160] == pytest.approx(f * EYE_HEIGHT_M / (239 - right.cy))
    assert depth[0, 160] == pytest.approx(f * (HEIGHT_M - EYE_HEIGHT_M) / right.cy)


def test_the_robot_drives_as_in_the_paper():
    corridor = Corridor()
    poses = [corridor.path(frame) for frame in range(501)]
    steps = [math.dist((a.x_m, a.y_m), (b.x_m, b.y_m)) for a, b in pairwise(poses)]
    turns = np.array([math.remainder(b.yaw_rad - a.yaw_rad, math.tau) for a, b in pairwise(poses)])
    turning = np.arange(500) % 125 >= 100
    assert steps == pytest.approx(np.full(500, 0.16), rel=1e-3)  # a chord is short of its arc
    assert turns[~turning] == pytest.approx(0)
    assert turns[turning] == pytest.approx(math.pi / 2 / 25)  # positive: to the left
    assert (poses[500].x_m, poses[500].y_m) == pytest.approx((poses[0].x_m, poses[0].y_m))
    assert poses[500].yaw_rad == pytest.approx(0)


def marched_depth(corridor, pose, camera, u_px, v_px):
    """Slow oracle: walk along one ray until it leaves free space, then bisect."""
    lateral, up = (camera.cx - u_px) / camera.focal_px, (camera.cy - v_px) / camera.focal_px
    cos, sin = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)

    def free(depth_m):
        left_m = camera.left_m + depth_m * lateral
        x_m = pose.x_m + depth_m * cos - left_m * sin
        y_m = pose.y_m + depth_m * sin + left_m * cos
        inside = corridor.inner_m < max(abs(x_m), abs(y_m)) < corridor.outer_m
        return inside and 0 < EYE_HEIGHT_M + depth_m * up < HEIGHT_M

    far = 0.0
    while free(far):
        near, far = far, far + 0.002
    for _ in range(30):
        middle = (near + far) / 2
        near, far = (middle, far) if free(middle) else (near, middle)
    return near


@pytest.mark.parametrize("frame", [0, 60, 110, 265, 340, 355, 365, 370, 499])
def test_depth_agrees_with_a_ray_walked_step_by_step(frame):
    corridor = Corridor(width_m=2.5, length_m=18)
    rng = np.random.default_rng(frame)
    exact = corridor.path(frame)
    pose = FloorPose(exact.x_m + 0.1, exact.y_m - 0.1, exact.yaw_rad + rng.uniform(-3, 3))
    for camera in stereo_cameras(RIG):
        depth = corridor.render(pose, camera).depth_m
        rows, columns = rng.integers(0, 240, 10), rng.integers(0, 320, 10)
        oracle = [
            marched_depth(corridor, pose, camera, *uv) for uv in zip(columns, rows, strict=True)
        ]
        assert depth[rows, columns] == pytest.approx(oracle, rel=1e-5)


@pytest.mark.parametrize("frame", [0, 300, 355, 372])
def test_a_pixel_is_the_mean_of_its_area(frame):
    corridor = Corridor()
    pose, camera = corridor.path(frame), stereo_cameras(RIG)[0]
    grey = corridor.render(pose, camera).grey
    fine = corridor.render(pose, finer(camera, 6)).grey
    mean = fine.reshape(240, 6, 320, 6).mean(axis=(1, 3))
    error = np.abs(grey - mean)
    assert error.mean() < 0.02
    assert np.quantile(error, 0.999) < 2  # slanted edges: one depth stands for half a column


@pytest.mark.parametrize(
    "settings",
    [
        SimulateSettings(width=480, height=320, frames="300:301"),
        SimulateSettings(width=480, height=320, frames="360:361"),
        SimulateSettings(width=480, height=320, frames="40:41", scene="cards"),
        SimulateSettings(width=480, height=320, frames="75:76", scene="cards", pan=True),
        SimulateSettings(width=480, height=320, frames="40:41", scene="layers", pan=True),
        SimulateSettings(width=320, height=240, frames="9:10", scene="street"),
    ],
)
def test_left_image_moved_by_the_true_disparity_is_the_right_image(settings):
    shot = next(render_scene(settings))
    error = np.abs(warped(shot.left, shot.disparity_px) - shot.right)
    assert np.nanmedian(error) < 1
    # The rest is hidden from the left camera.
    made_of_surfaces = settings.scene in ("layers", "street")
    assert (error[np.isfinite(error)] < 8).mean() > (0.92 if made_of_surfaces else 0.95)
    for wrong in (-1, 1):
        moved = np.abs(warped(shot.left, shot.disparity_px + wrong) - shot.right)
        assert np.nanmean(moved) > 1.5 * np.nanmean(error)


def test_remote_parts_are_darker_and_brighten_as_they_come_near():
    corridor = Corridor()
    camera = stereo_cameras(RIG)[1]
    views = [corridor.render(corridor.path(frame), camera) for frame in (300, 325, 349)]
    for view in views:
        centre = view.grey[:119, 160]  # the ceiling, from overhead to the end
        ceiling = centre[view.depth_m[:119, 160] < view.depth_m[119, 160] - 0.5]
        assert np.all(np.diff(ceiling) < 0)
    ends = [np.median(view.grey[118:122, 150:170]) for view in views]
    assert ends[0] < ends[1] < ends[2]


def test_windows_are_on_outer_walls_alone_and_doors_on_all():
    openings = Corridor(seed=3).openings
    assert {o.wall for o in openings if o.kind == "window"} == {0, 1, 2, 3}
    assert {o.wall for o in openings if o.kind == "door"} == set(range(8))
    for wall in range(8):
        ends = [m for o in openings if o.wall == wall for m in (o.start_m, o.stop_m)]
        assert ends == sorted(ends)


def test_walls_are_smooth_between_openings_and_openings_are_where_they_are_said_to_be():
    corridor = Corridor()
    camera = stereo_cameras(RIG)[1]
    for opening in corridor.openings:
        if opening.wall != 0:
            continue
        # Look squarely at the wall y = -outer from 1.5 m, once at its opening's either end.
        for end_m in (opening.start_m, opening.stop_m):
            x_m = end_m - corridor.outer_m
            view = corridor.render(FloorPose(x_m, -corridor.outer_m + 1.5, -math.pi / 2), camera)
            row = np.abs(np.diff(view.grey[118]))
            column = camera.cx + camera.focal_px * camera.left_m / 1.5  # of x_m
            edge = round(column)
            assert row[edge - 4 : edge + 4].max() > 20
    bare = corridor.render(
        FloorPose(-corridor.outer_m + 0.4, -corridor.outer_m + 1.5, -1.6), camera
    )
    assert np.abs(np.diff(bare.grey[118, 100:220])).max() < 1


def test_the_seed_decides_on_the_paint():
    same, again, other = (Corridor(seed=seed).openings for seed in (1, 1, 2))
    assert same == again
    assert same != other


# The cards.


@given(st.sampled_from(CARDS), st.floats(0, 1000))
def test_a_card_keeps_its_speed_and_its_bounds(card, time_s):
    step_s = 1e-4
    before, after = card_state(card, time_s), card_state(card, time_s + step_s)
    places = [(s.y_m if card.axis else s.x_m) for s in (before, after)]
    assert card.low_m <= min(places)
    assert max(places) <= card.high_m
    speed = before.leftward_m_s if card.axis else -before.closing_m_s
    assert abs(speed) == abs(card.speed_m_s)
    if speed == (after.leftward_m_s if card.axis else -after.closing_m_s):
        assert (places[1] - places[0]) / step_s == pytest.approx(speed, abs=1e-6)


def test_a_card_begins_as_declared_and_turns_round():
    receding = next(card for card in CARDS if card.name == "receding")
    state = card_state(receding, 0)
    assert (state.x_m, state.closing_m_s) == pytest.approx((1.6, -0.7))
    # 2.6 m away and 1.3 m back at 0.7 m/s.
    back = card_state(receding, 3.9 / 0.7)
    assert (back.x_m, back.closing_m_s) == pytest.approx((2.9, 0.7))


@pytest.mark.parametrize("pan", [False, True])
def test_true_depth_is_that_of_the_nearest_card(pan):
    time_s = 2.3
    pose = pan_pose(time_s) if pan else FloorPose(0, 0, 0)
    camera = stereo_cameras(RIG)[1]
    depth = Cards(RIG.focal_px).render(pose, camera, time_s).depth_m
    cos, sin = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
    rng = np.random.default_rng(0)
    seen = set()
    for row, column in zip(rng.integers(0, 240, 400), rng.integers(0, 320, 400), strict=True):
        lateral = (camera.cx - column) / camera.focal_px
        up = (camera.cy - row) / camera.focal_px
        hits = [((WALL_M - camera.left_m * -sin) / (cos - lateral * sin), "wall")]
        for card in CARDS:
            state = card_state(card, time_s)
            z = (state.x_m - camera.left_m * -sin) / (cos - lateral * sin)
            y_m = camera.left_m * cos + z * (sin + lateral * cos)
            z_m = EYE_HEIGHT_M + z * up
            if abs(y_m - state.y_m) < card.width_m / 2 and abs(z_m - state.z_m) < card.height_m / 2:
                hits.append((z, card.name))
        seen.add(min(hits)[1])
        assert depth[row, column] == pytest.approx(min(hits)[0], rel=1e-5)
    assert len(seen) >= 4


@pytest.mark.parametrize("width", [320, 640])
def test_textures_do_not_alias(width):
    # A pixel sampled at its centre is next to the mean of its area.
    rig = SimulateSettings(width=width, height=width * 3 // 4).rig
    cards, camera = Cards(rig.focal_px), stereo_cameras(rig)[0]
    grey = cards.render(FloorPose(0, 0, 0), camera, 0).grey
    fine = cards.render(FloorPose(0, 0, 0), finer(camera, 4), 0).grey
    mean = fine.reshape(rig.height, 4, width, 4).mean(axis=(1, 3))
    assert grey.std() > 30  # contrasty
    assert np.corrcoef(grey.ravel(), mean.ravel())[0, 1] > 0.99


def test_disparities_of_the_cards_scene_suit_a_search_of_64_px():
    settings = SimulateSettings(width=480, height=320, frames="300", scene="cards")
    disparity = settings.rig.focal_px * settings.rig.baseline_m
    depths = [card_state(c, t / 30).x_m for c in CARDS for t in range(300)] + [WALL_M]
    assert disparity / max(depths) > 5
    assert disparity / min(depths) < 50


def test_shadows_of_cards_lie_on_the_wall_and_have_no_depth():
    plain, shaded = (
        next(render_scene(small(scene="cards", frames="20:21", shadows=shadows)))
        for shadows in (False, True)
    )
    np.testing.assert_array_equal(shaded.disparity_px, plain.disparity_px)
    np.testing.assert_array_equal(shaded.mover, plain.mover)
    darker = shaded.right < plain.right
    assert 0.01 < darker.mean() < 0.3
    inner = cv2.erode((plain.mover > 0).astype(np.uint8), np.ones((3, 3))) > 0
    assert not darker[inner].any()
    np.testing.assert_array_equal(shaded.right[~darker], plain.right[~darker])


def test_panning_moves_the_wall_a_few_pixels_a_frame():
    moved = [
        abs(pan_pose((t + 1) / 30).yaw_rad - pan_pose(t / 30).yaw_rad) * 0.87 * 480
        for t in range(120)
    ]
    assert 2 < max(moved) < 5


# Flat pieces in space, and the scenes that are made of them.


def checks(texels, grey=(40, 200)):
    """A texture of checks, each half its side."""
    half = texels // 2
    return Texture.of(np.kron(np.array([grey, grey[::-1]]), np.ones((half, half))))


def test_a_wall_seen_squarely_has_its_depth_and_its_texture_where_they_belong():
    camera = stereo_cameras(RIG)[1]
    # 4 m ahead; its upper left corner is 1 m to the left of the camera, and 0.5 m above it.
    corner = 4, 1 + camera.left_m, EYE_HEIGHT_M + 0.5
    wall = rectangle(corner, (0, -2, 0), (0, 0, -1), checks(64))
    view = render([wall], FloorPose(0, 0, 0), camera)
    quarter_px = RIG.focal_px / 4
    left, top = camera.cx - quarter_px, camera.cy - quarter_px / 2
    inside = np.zeros((240, 320), bool)
    inside[math.ceil(top) : math.ceil(top + quarter_px)] = True
    inside[:, : math.ceil(left)] = inside[:, math.ceil(left + 2 * quarter_px) :] = False
    assert np.array_equal(np.isfinite(view.depth_m), inside)
    assert view.depth_m[inside] == pytest.approx(4)
    assert np.all(view.grey[~inside & (view.grey == 0)] == 0)
    rows = int(top + quarter_px / 4), int(top + 3 * quarter_px / 4)
    columns = int(left + quarter_px / 2), int(left + 3 * quarter_px / 2)
    assert view.grey[np.ix_(rows, columns)] == pytest.approx(np.array([[40, 200], [200, 40]]))


@given(st.integers(0, 2**32 - 1))
@profile(max_examples=15)
def test_the_nearest_of_surfaces_in_any_position_wins(seed):
    rng = np.random.default_rng(seed)
    pose = FloorPose(*rng.uniform(-1, 1, 2), rng.uniform(-3, 3))
    camera = SceneCamera(40, 30, 35.0, 19.5, 14.5, 0.1)
    eye = np.array([*camera.eye(pose), EYE_HEIGHT_M])
    surfaces = []
    for _ in range(4):
        right, down = np.linalg.qr(rng.standard_normal((3, 2)))[0].T * rng.uniform(0.5, 3)
        surfaces.append(rectangle(eye + rng.uniform(-2, 2, 3), right, down, checks(8)))
    depth = render(surfaces, pose, camera).depth_m
    for row, column in zip(rng.integers(0, 30, 40), rng.integers(0, 40, 40), strict=True):
        ray = np.array([*camera.rays(pose, np.array([column]))[0], (14.5 - row) / 35])
        hits = [math.inf]
        for one in surfaces:
            sides = one.corners_m[1] - one.corners_m[0], one.corners_m[3] - one.corners_m[0]
            away, right, down = np.linalg.solve(
                np.column_stack([ray, -sides[0], -sides[1]]), one.corners_m[0] - eye
            )
            if away > NEAR_M and 0 <= right <= 1 and 0 <= down <= 1:
                hits.append(away)
        assert depth[row, column] == pytest.approx(min(hits), rel=1e-5)


def test_holes_of_a_texture_let_what_is_behind_through():
    solid = np.ones((8, 8), bool)
    solid[:, 4:] = False
    grid = Texture.of(np.full((8, 8), 200.0), solid)
    near = rectangle((2, 4, 5), (0, -8, 0), (0, 0, -8), grid)
    far = rectangle((4, 8, 9), (0, -16, 0), (0, 0, -16), checks(8, (50, 50)))
    view = render([near, far], FloorPose(0, 0, 0), stereo_cameras(RIG)[0])
    assert np.all(view.depth_m[:, :160] == 2)
    assert np.all(view.depth_m[:, 180:] == 4)
    assert view.grey[120, 10] == pytest.approx(200)
    assert view.grey[120, 300] == pytest.approx(50)


def test_a_texture_gives_the_mean_of_any_block():
    picture = np.random.default_rng(0).uniform(0, 255, (16, 32))
    texture = Texture.of(picture)

    def mean(*block):
        return mean_grey(texture.levels, texture.rows, texture.columns, *block[0], *block[1])

    # Blocks of the ripmap itself: rows 8 and 9, columns 4..7 and 28..31; a period further.
    for column in (4, 28):
        wanted = pytest.approx(picture[8:10, column : column + 4].mean(), rel=1e-5)
        assert mean((9.0, column + 2.0), (2.0, 4.0)) == wanted
        assert mean((9.0 - 16, column + 34.0), (2.0, 4.0)) == wanted
    # Between texels and at the seam; between the sizes of blocks.
    assert mean((0.0, 3.5), (1.0, 1.0)) == pytest.approx((picture[0, 3] + picture[15, 3]) / 2)
    sizes = [mean((1.0, 2.0), (2.0, size)) for size in (2.0, 2.0 * math.sqrt(2), 4.0)]
    assert sizes[1] == pytest.approx((sizes[0] + sizes[2]) / 2)
    assert mean((5.0, 7.0), (1e9, 1e9)) == pytest.approx(picture.mean(), rel=1e-5)


def test_a_pixel_of_surfaces_is_the_mean_of_its_area():
    camera = stereo_cameras(small(width=120, height=80, focal_px=100).rig)[1]
    layers, pose = Layers(camera, 3), FloorPose(0, 0, 0)
    grey = layers.render(pose, camera, 0.5).grey
    fine = layers.render(pose, finer(camera, 4), 0.5).grey
    mean = fine.reshape(80, 4, 120, 4).mean(axis=(1, 3))
    assert np.abs(grey - mean).mean() < 3
    assert np.corrcoef(grey.ravel(), mean.ravel())[0, 1] > 0.98


def test_layers_overlap_at_many_depths_that_a_search_of_64_px_reaches():
    settings = small(scene="layers", width=480, height=320, frames="30:31")
    disparities = [
        next(render_scene(replace(settings, seed=seed))).disparity_px for seed in range(2)
    ]
    for disparity in disparities:
        assert 5 < disparity.min() < disparity.max() < 50
        assert len(np.unique((disparity / 3).astype(int))) > 5
    assert not np.array_equal(*disparities)


def test_the_street_is_driven_at_its_speed_along_its_way():
    street = Street(100, speed_m_s=5, winding_rad=0.6, seed=1)
    poses = [street.path(frame / 10) for frame in range(100)]
    steps = np.diff([(pose.x_m, pose.y_m) for pose in poses], axis=0)
    ways = np.hypot(*steps.T)
    assert ways == pytest.approx(0.5, rel=0.08)  # the lane is outside or inside of a bend
    yaws = np.array([pose.yaw_rad for pose in poses])
    assert np.arctan2(steps[:, 1], steps[:, 0]) == pytest.approx(
        (yaws[1:] + yaws[:-1]) / 2, abs=0.02
    )
    assert 0.5 < np.abs(yaws).max() <= 0.6
    straight = Street(100, seed=1)
    assert np.ptp([straight.path(t).yaw_rad for t in (0, 5, 10)]) == 0


def test_the_road_has_the_depth_of_similar_triangles_and_things_stand_on_it():
    camera = stereo_cameras(RIG)[1]
    street = Street(20, seed=3)
    depth = street.render(street.path(0), camera, 0).depth_m
    rows = np.arange(180, 240)
    ground = RIG.focal_px * EYE_HEIGHT_M / (rows - camera.cy)
    lane = depth[180:, 150:170].min(axis=1)
    assert lane == pytest.approx(ground, rel=0.02)  # lines and patches lie on it
    above = depth[:100]
    assert above.max() > 1000  # sky
    assert (above < 30).mean() > 0.1  # houses and trees
    assert (depth[130:] <= 1.03 * (RIG.focal_px * EYE_HEIGHT_M / (rows[0] - 50 - camera.cy))).all()


def test_the_scenes_have_their_own_frame_rate_and_baseline():
    street, cards = SimulateSettings(scene="street"), SimulateSettings(scene="cards")
    assert (street.frame_rate, street.baseline_m) == (10, 0.4)
    assert (cards.frame_rate, cards.baseline_m) == (30, 0.12)
    assert SimulateSettings(scene="street", frame_rate=25).frame_rate == 25


# Noise, light and frames.


def test_the_left_camera_may_be_brighter():
    plain = next(render_scene(small(scene="layers")))
    other = next(render_scene(small(scene="layers", left_gain=1.1, left_offset=5)))
    assert np.array_equal(plain.right, other.right)
    wanted = (plain.left * 1.1 + 5).clip(0, 255)
    assert np.abs(other.left - wanted).max() < 1.2


def test_flicker_changes_both_cameras_alike_from_frame_to_frame():
    plain, other = (list(render_scene(small(flicker=f, frames="4"))) for f in (0.0, 0.2))
    for side in ("left", "right"):
        light = np.array(
            [
                getattr(o, side).mean(axis=1) / getattr(p, side).mean(axis=1)
                for p, o in zip(plain, other, strict=True)
            ]
        )
        turn = 0.37 * np.arange(4)[:, None] + np.arange(48) / 48
        assert light == pytest.approx(1 + 0.2 * np.sin(2 * np.pi * turn), abs=0.03)


def test_an_open_shutter_blurs_what_moves_and_keeps_the_truth():
    values = {"scene": "cards", "frames": "7:8", "frame_rate": 5, "width": 160, "height": 120}
    sharp, blurred = (next(render_scene(small(shutter=s, **values))) for s in (0.0, 1.0))
    assert np.array_equal(sharp.disparity_px, blurred.disparity_px)
    moving = sharp.disparity_px > sharp.disparity_px.min() + 0.5
    steps = [np.abs(np.diff(s.right.astype(float)))[moving[:, 1:]].mean() for s in (sharp, blurred)]
    assert steps[1] < 0.8 * steps[0]
    still = ~cv2.dilate(moving.astype(np.uint8), np.ones((15, 15))).astype(bool)
    assert np.abs(sharp.right[still].astype(int) - blurred.right[still]).max() <= 1


def test_compression_costs_detail(tmp_path):
    sharp, poor = (next(render_scene(small(scene="layers", jpeg_quality=q))) for q in (0, 10))
    assert 2 < np.abs(sharp.right.astype(float) - poor.right).mean() < 30
    for crf in (10, 51):
        simulate(tmp_path / str(crf), small(scene="layers", crf=crf))
    sizes = [(tmp_path / str(crf) / "right.mp4").stat().st_size for crf in (10, 51)]
    assert sizes[1] < sizes[0] / 2


def test_noise_has_its_sigma_and_differs_between_cameras_and_frames():
    clean = list(render_scene(SimulateSettings(frames="2")))
    noisy = list(render_scene(SimulateSettings(frames="2", noise_sigma=3.0)))
    grains = [
        getattr(n, side).astype(float) - getattr(c, side)
        for n, c in zip(noisy, clean, strict=True)
        for side in ("left", "right")
    ]
    for grain in grains:
        assert grain.std() == pytest.approx(math.hypot(3, math.sqrt(1 / 12)), rel=0.05)
        assert abs(grain.mean()) < 0.05
    correlation = np.corrcoef([grain.ravel() for grain in grains])
    assert np.abs(correlation - np.eye(4)).max() < 0.03


@pytest.mark.parametrize("scene", ["corridor", "cards", "layers", "street"])
def test_a_frame_is_the_same_alone_and_in_a_run(scene):
    given = {"scene": scene, "noise_sigma": 2, "pan": scene in ("cards", "layers")}
    run = list(render_scene(small(frames="98:103", **given)))
    alone = next(render_scene(small(frames="101:102", **given)))
    assert [shot.frame for shot in run] == [98, 99, 100, 101, 102]
    for one, other in zip(run[3], alone, strict=True):
        assert np.array_equal(one, other) if isinstance(one, np.ndarray) else one == other


def test_nonsense_is_refused_in_one_line():
    for values, said in (
        ({"frames": "0"}, "--frames"),
        ({"frames": "9:5"}, "--frames"),
        ({"frames": "-3"}, "--frames"),
        ({"frames": "ten"}, "--frames"),
        ({"frames": "9999999999"}, "--frames"),
        ({"frames": "2000000"}, "--frames"),
        ({"width": 321}, "--width"),
        ({"height": 241}, "--height"),
        ({"focal_px": 10}, "--focal-px"),
        ({"focal_px": math.nan}, "--focal-px"),
        ({"baseline_m": -1}, "--baseline-m"),
        ({"corridor_width_m": 1.0}, "--corridor-width-m"),
        ({"corridor_width_m": 12.0}, "--corridor-width-m"),
        ({"scene": "beach"}, "--scene"),
        ({"noise_sigma": -1}, "--noise-sigma"),
        ({"seed": -1}, "--seed"),
    ):
        with pytest.raises(SettingsError, match=said) as caught:
            SimulateSettings(**values)
        assert "\n" not in str(caught.value)


@profile(max_examples=40)
@given(st.floats(5, 100), st.floats(0.5, 20), st.floats(0.001, 1), st.floats(0, 125))
def test_both_cameras_stay_in_any_corridor_that_is_accepted(length_m, width_m, baseline_m, frame):
    try:
        SimulateSettings(
            corridor_length_m=length_m, corridor_width_m=width_m, baseline_m=baseline_m
        )
    except SettingsError:
        reject()
    corridor = Corridor(width_m, length_m)
    pose = corridor.path(frame)
    for side in (-0.5, 0.5):
        x_m, y_m = np.array([pose.x_m, pose.y_m]) + side * baseline_m * pose.left
        assert corridor.inner_m + 0.09 < max(abs(x_m), abs(y_m)) < corridor.outer_m - 0.09


# Files.


def decoded(path):
    with av.open(str(path)) as container:
        return [frame.to_ndarray()[: frame.height] for frame in container.decode(video=0)]


def contents(folder):
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_files_hold_what_was_rendered(tmp_path):
    settings = small(frames="248:252", lossless=True, noise_sigma=1, frame_rate=25)
    calls = []
    simulate(tmp_path, settings, progress=lambda shot: calls.append(shot.frame))
    shots = list(render_scene(settings))
    names = {str(path) for path in contents(tmp_path)}
    assert names == {"left.mkv", "right.mkv", "rig.yaml", "poses.txt"} | {
        f"disparity/{number:06d}.png" for number in range(4)
    }
    assert len(calls) == 4
    assert np.array_equal(decoded(tmp_path / "left.mkv"), [shot.left for shot in shots])
    assert np.array_equal(decoded(tmp_path / "right.mkv"), [shot.right for shot in shots])
    for number, shot in enumerate(shots):
        png = cv2.imread(str(tmp_path / f"disparity/{number:06d}.png"), cv2.IMREAD_UNCHANGED)
        assert png.dtype == np.uint16
        assert np.array_equal(png, np.rint(256 * shot.disparity_px))
    assert read_rig(tmp_path / "rig.yaml") == Rig(64, 48, 0.87 * 64, 0.12, 31.5, 23.5)
    poses = np.loadtxt(tmp_path / "poses.txt")
    assert poses[:, 0] == pytest.approx([0, 0.04, 0.08, 0.12])
    assert poses[:, 1:3] == pytest.approx(
        np.array([(s.pose.x_m, s.pose.y_m) for s in shots]), abs=1e-6
    )
    assert 2 * np.arctan2(poses[:, 6], poses[:, 7]) == pytest.approx(
        [s.pose.yaw_rad for s in shots]
    )
    assert np.all(poses[:, 3] == EYE_HEIGHT_M)
    assert np.all(poses[:, 4:6] == 0)


@pytest.mark.parametrize("scene", ["cards", "street"])
def test_what_moves_by_itself_is_written_with_its_speeds(tmp_path, scene):
    settings = small(scene=scene, frames="20:23", frame_rate=10, pan=False, seed=3)
    simulate(tmp_path, settings)
    rows = list(csv.DictReader((tmp_path / "objects.csv").open()))
    assert {row["frame"] for row in rows} == {"0", "1", "2"}
    rig_mps = settings.street_speed_m_s if scene == "street" else 0.0
    for row in rows:
        image = cv2.imread(f"{tmp_path}/movers/{int(row['frame']):06d}.png", cv2.IMREAD_UNCHANGED)
        y, x = np.nonzero(image == int(row["id"]))
        box = [int(row[name]) for name in ("x", "y", "width", "height")]
        assert box == [x.min(), y.min(), np.ptp(x) + 1, np.ptp(y) + 1]
        along = float(row["over_ground_mps"]) * math.cos(float(row["direction_rad"]))
        assert float(row["closing_mps"]) == pytest.approx(rig_mps - along, abs=0.01)
        if scene == "cards":
            state = card_state(CARDS[int(row["id"]) - 1], (20 + int(row["frame"])) / 10)
            assert float(row["depth_m"]) == pytest.approx(state.x_m, abs=0.01)
            speed = math.hypot(state.closing_m_s, state.leftward_m_s)
            assert float(row["over_ground_mps"]) == pytest.approx(speed, abs=0.002)
    if scene == "street":  # seed 3: oncoming cars at 8 m/s
        assert any(abs(float(row["closing_mps"]) - rig_mps - 8) < 0.02 for row in rows)


def test_h264_is_close_to_what_was_rendered(tmp_path):
    settings = small(frames="3")
    simulate(tmp_path, settings)
    for luma, shot in zip(decoded(tmp_path / "right.mp4"), render_scene(settings), strict=True):
        grey = (luma.astype(float) - 16) * 255 / 219
        assert np.abs(grey - shot.right).mean() < 3


@pytest.mark.parametrize("lossless", [False, True])
def test_same_settings_give_the_same_bytes(tmp_path, lossless):
    for name in ("a", "b"):
        simulate(tmp_path / name, small(noise_sigma=1.5, lossless=lossless))
    simulate(tmp_path / "c", small(noise_sigma=1.5, lossless=lossless, seed=1))
    a, b, c = (contents(tmp_path / name) for name in "abc")
    assert a == b
    assert a != c


def test_a_folder_in_use_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="not empty"):
        simulate(tmp_path, small())
    assert len(contents(tmp_path)) == 1
    with pytest.raises(OutputError, match="cannot write"):
        simulate(tmp_path / "notes.txt", small())


def test_overwrite_replaces_a_simulation_and_nothing_else(tmp_path):
    simulate(tmp_path, small(frames="5", lossless=True))
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "disparity/000777.png").write_text("mine")
    simulate(tmp_path, small(frames="2"), overwrite=True)
    simulate(tmp_path / "fresh", small(frames="2"))
    left = contents(tmp_path)
    fresh = contents(tmp_path / "fresh")
    for path, data in fresh.items():
        assert left.pop(path) == data
        left.pop("fresh" / path)
    assert sorted(map(str, left)) == ["disparity/000777.png", "notes.txt"]


def test_overwrite_does_not_touch_the_recordings_of_others(tmp_path):
    (tmp_path / "left.mp4").write_text("mine")
    with pytest.raises(OutputError, match=r"left\.mp4 is not from an earlier run"):
        simulate(tmp_path, small(), overwrite=True)
    assert list(contents(tmp_path).values()) == [b"mine"]


@pytest.mark.parametrize(
    "name", ["left.mp4", "poses.txt", "rig.yaml", "objects.csv", "movers/000002.png"]
)
def test_a_file_that_somebody_puts_there_during_a_simulation_stays(tmp_path, name):
    def put(_):
        (tmp_path / name).write_text("mine")

    with pytest.raises(OutputError, match=f"{name} is not from this run: move it"):
        simulate(tmp_path, small(scene="cards", frames="3"), progress=put)
    assert list(contents(tmp_path).values()) == [b"mine"]


@pytest.mark.parametrize("failing", ["frame", "end"])
@pytest.mark.parametrize("error", [KeyboardInterrupt, OutputError])
def test_a_failure_leaves_no_file(tmp_path, monkeypatch, failing, error):
    def fail(*_):
        raise error

    if failing == "end":
        monkeypatch.setattr(write_module, "write_rig", fail)
    with pytest.raises(error):
        simulate(tmp_path, small(), **({"progress": fail} if failing == "frame" else {}))
    assert contents(tmp_path) == {}
