"""The free space before a camera and the way through it, on scenes worked out by hand."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from motionstereo_cli.compiled import free_space as loops
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.robot.course import steadied
from motionstereo_cli.robot.free_space import (
    FreeSpace,
    Ground,
    StripValues,
    find_ground,
    free_space,
    nearest,
    way_ahead,
)
from motionstereo_cli.robot.guide import ImageGuide
from motionstereo_cli.types import Rig

NAN = np.float32(np.nan)
WIDTH, HEIGHT = 240, 160
FOCAL, CX, CY = 200.0, 119.5, 79.5
#: Baseline over the camera's height: px of nearness a row.
SLOPE = 0.3
GROUND = Ground(SLOPE, CY)
RIG = Rig(WIDTH, HEIGHT, FOCAL, baseline_m=SLOPE * 1.2, cx=CX, cy=CY)


def road(*boxes, ground=GROUND, walls=None):
    """Nearness of a level road under the sky.

    Args:
        boxes: what stands on it: from left, to right and how far ahead, in camera heights, and
            its lower and upper end.
        walls: how far to the left and to the right there are walls without end.
    """
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    near = np.maximum(ground.slope * (v - ground.horizon), 0)
    for side in walls or ():
        aside = (u - CX) / FOCAL  # per camera height ahead
        with np.errstate(divide="ignore"):
            wall = np.where(aside * side > 0, FOCAL * ground.slope * aside / side, 0)
        low = ground.slope * (v - ground.horizon) <= wall
        near = np.where(low & (wall > near), wall, near)
    for left, right, ahead, low, high in sorted(boxes, key=lambda box: -box[2]):
        here = FOCAL * ground.slope / ahead
        inside = (u - CX >= left * FOCAL / ahead) & (u - CX <= right * FOCAL / ahead)
        row = ground.horizon + FOCAL / ahead * (1 - np.array([high, low]))
        near = np.where(inside & (v >= row[0]) & (v <= row[1]), here, near)
    return np.where(near > 0.3, near, np.nan).astype(np.float32)  # the sky is unknown


def place_of(near, ground=GROUND, strips=48):
    return way_ahead(free_space(StripValues.of(near, strips), ground), FOCAL, CX)[0]


def noisy(near, seed, share=0.5, wrong=0.05, sigma=0.4):
    rng = np.random.default_rng(seed)
    near = near + rng.normal(0, sigma, near.shape).astype(np.float32)
    lost = rng.random(near.shape)
    near = np.where(lost < wrong, rng.uniform(1, 40, near.shape), near)
    return np.where(lost > share, NAN, near).astype(np.float32)


def cut(near, limit_px, wrong=0.05):
    """What a range of disparity leaves of it: what is nearer is unknown, but for wrong matches."""
    rng = np.random.default_rng(4)
    lost = rng.random(near.shape)
    flecks = np.where(lost < wrong, rng.uniform(1, limit_px, near.shape), NAN)
    return np.where(near < limit_px, near, flecks).astype(np.float32)


class TestGround:
    @pytest.mark.parametrize(("slope", "horizon"), [(0.3, 79.5), (0.12, 70.0), (0.5, 92.0)])
    def test_is_found_among_things_and_noise(self, slope, horizon):
        ground = Ground(slope, horizon)
        near = road((-6, -2, 6, 0, 2), (1, 3, 9, 0, 1.2), ground=ground, walls=(-8, 7))
        found = find_ground(StripValues.of(noisy(near, 1), 1), CY)
        bottom = [g.slope * (HEIGHT - g.horizon) for g in (found, ground)]
        assert bottom[0] == pytest.approx(bottom[1], rel=0.12)
        assert found.horizon == pytest.approx(horizon, abs=8)

    def test_is_found_by_the_feet_of_walls_where_the_floor_itself_is_unknown(self):
        near = road(walls=(-1.5, 1.5))
        v = np.arange(HEIGHT)[:, None]
        near[np.abs(near - SLOPE * (v - CY)) < 0.2] = NAN
        found = find_ground(StripValues.of(near, 1), CY)
        assert found.slope * (HEIGHT - found.horizon) == pytest.approx(SLOPE * 80, rel=0.25)

    def test_a_wall_has_none_and_nothing_has_none(self):
        assert find_ground(StripValues.of(np.full((HEIGHT, WIDTH), NAN, np.float32), 1), CY) is None
        wall = np.full((HEIGHT, WIDTH), 12, np.float32)
        wall[120:] = NAN
        found = find_ground(StripValues.of(wall, 1), CY)
        assert found is None or found.slope * (HEIGHT - found.horizon) > 12

    @pytest.mark.parametrize("limit_px", [12, 15])
    def test_is_found_where_it_is_nearer_than_the_range_before_the_camera(self, limit_px):
        near = cut(road((1, 3, 9, 0, 1.2), walls=(-8, 7)), limit_px)
        assert find_ground(StripValues.of(near, 1), CY) is None
        found = find_ground(StripValues.of(near, 1), CY, limit_px)
        assert found.slope == pytest.approx(SLOPE, rel=0.2)
        assert found.horizon == pytest.approx(CY, abs=8)

    @pytest.mark.parametrize("limit_px", [math.inf, 4.0])
    def test_the_fit_of_a_line_is_what_lies_on_it_less_twice_what_lies_below(self, limit_px):
        seen = np.random.default_rng(5).random((3, 8)) / 8
        farther = np.pad(seen.cumsum(axis=1), ((0, 0), (1, 0)))
        rows, horizons, bottoms = (
            np.array([0.2, 0.5, 0.8]),
            np.array([0.1, 0.4]),
            np.array([3.0, 7]),
        )
        fits = np.empty((2, 2))
        given = 0.8, 1.2, 0.5, 2.0, limit_px
        loops.fit_lines(farther, 0.9, rows, horizons, bottoms, *given, fits)
        for i, horizon in enumerate(horizons):
            for j, bottom in enumerate(bottoms):
                parts = []
                for row, before in zip(rows, farther, strict=True):
                    line = bottom * (row - horizon) / (1 - horizon)
                    ends = np.array([line * 0.8 - 0.5, line * 1.2 + 0.5]) / 0.9
                    low, high = np.interp(ends, np.arange(9), before)
                    parts.append((high - low) - 2 * low if 1 < line < limit_px else 0)
                assert fits[i, j] == pytest.approx(np.mean(parts), abs=1e-6)


class TestFreeSpace:
    def test_only_what_stands_in_the_way_counts(self):
        board, branch, sign = (-9, 9, 5, 0, 0.1), (-9, 9, 6, 1.6, 3), (-9, 9, 10, 0, 1)
        seen = free_space(StripValues.of(road(board, branch, sign), 12), GROUND)
        assert seen.standing_px == pytest.approx(FOCAL * SLOPE / 10, rel=1e-3)
        assert seen.ground_px == pytest.approx(FOCAL * SLOPE / 10, rel=0.2)
        assert (seen.slope, seen.width) == (SLOPE, WIDTH)

    def test_a_strip_is_as_near_as_all_but_a_fifth_of_it_and_unknown_where_little_is_known(self):
        near = np.full((10, 4), NAN, np.float32)
        near[:, 0] = np.arange(1, 11)
        seen = free_space(StripValues.of(near, 2), None)
        assert seen.standing_px[0] == pytest.approx(8.2)
        assert np.isnan(seen.standing_px[1])
        assert np.isnan(seen.ground_px).all()

    def test_thinned_images_give_the_same(self):
        near = road((-20, 20, 6, 0, 1.2))
        thinned = free_space(
            StripValues.of(near[::2, ::3], 12), Ground(2 * SLOPE, CY / 2), row_px=2, column_px=3
        )
        whole = free_space(StripValues.of(near, 12), GROUND)
        assert (thinned.slope, thinned.width) == (whole.slope, whole.width)
        assert thinned.standing_px == pytest.approx(whole.standing_px)


class TestWayAhead:
    def test_an_open_road_is_driven_straight_on(self):
        assert place_of(road()) == pytest.approx(0.5, abs=0.01)

    def test_the_middle_between_walls_is_the_way(self):
        assert place_of(road(walls=(-2, 2))) == pytest.approx(0.5, abs=0.02)
        # Nearer to the right wall it keeps to the left of straight on.
        assert 0.3 < place_of(road(walls=(-4, 0.9))) < 0.49

    def test_it_goes_around_what_stands_in_the_way(self):
        right = place_of(road((-3, 0.4, 8, 0, 1)))
        left = place_of(road((-0.4, 3, 8, 0, 1)))
        assert right > 0.53
        assert left == pytest.approx(1 - right, abs=0.02)

    def test_a_gap_has_to_be_as_wide_as_a_vehicle(self):
        # Gaps at both sides of the middle: the left one is wide enough; the right one, less far
        # off the way, is only so in the second scene.
        def wall(right_gap_end):
            return (-20, -3.2, 6, 0, 1), (-1.2, 0.8, 6, 0, 1), (right_gap_end, 20, 6, 0, 1)

        assert place_of(road(*wall(1.7))) < 0.45
        assert place_of(road(*wall(2.8))) > 0.5

    def test_it_follows_a_bend(self):
        # Posts on both sides of a road that bends to the left with a radius of 22 heights.
        boxes = []
        for ahead in np.arange(4, 24, 1.5):
            middle = -(ahead**2) / 2 / 22
            boxes += [(middle + s, middle + s + 0.6, ahead, 0, 1.2) for s in (-3.5, 3)]
        place = place_of(road(*boxes))
        wanted = 0.5 - 8 / 2 / 22 * FOCAL / WIDTH
        assert place == pytest.approx(wanted, abs=0.06)

    def test_the_unknown_is_neither_way_nor_obstacle(self):
        near = road((-20, 20, 12, 0, 1.2))
        hidden = near.copy()
        hidden[:, 100:140] = NAN  # a gap that counts as what is beside it
        assert place_of(hidden) == pytest.approx(place_of(near), abs=0.02)
        hidden[:, :140] = NAN  # and a side of which nothing is known
        assert place_of(hidden) > 0.55
        assert (
            way_ahead(free_space(StripValues.of(np.full_like(near, NAN), 48), None), FOCAL, CX)[0]
            is None
        )

    def test_without_a_ground_it_heads_for_the_farthest(self):
        near = np.full((HEIGHT, WIDTH), 12, np.float32)
        near[:, 90:170] = 6
        assert place_of(near, None) == pytest.approx(130 / WIDTH, abs=0.04)

    @settings(max_examples=30)
    @given(st.integers(0, 2**32 - 1))
    def test_the_mirrored_scene_gives_the_mirrored_heading(self, seed):
        rng = np.random.default_rng(seed)
        standing = rng.uniform(2, 40, 24).astype(np.float32)
        standing[rng.random(24) < 0.2] = NAN
        ground = np.where(rng.random(24) < 0.5, rng.uniform(1, 9, 24), NAN).astype(np.float32)
        there = way_ahead(FreeSpace(standing, ground, SLOPE, WIDTH), FOCAL, CX)[0]
        mirror = FreeSpace(standing[::-1], ground[::-1], SLOPE, WIDTH)
        back = way_ahead(mirror, FOCAL, CX)[0]
        assert there == pytest.approx(1 - back, abs=1e-6)


class TestGuide:
    def steered(self, images, rig=RIG):
        guide, state, found = ImageGuide(Settings(), rig), None, []
        for near in images:
            seen = guide.profile(near, np.ones(near.shape, bool))
            state, steering = guide.steer(state, seen)
            found.append(steering)
        return found

    @pytest.mark.parametrize("rig", [RIG, None])
    def test_is_steady_in_noise(self, rig):
        near = road((-4, -2.2, 6, 0, 1), (2.2, 4, 9, 0, 1), walls=(-6, 6))
        found = [one.steer for one in self.steered([noisy(near, n) for n in range(12)], rig)]
        assert np.abs(found).max() < 0.15
        assert np.abs(np.diff(found)).max() < 0.1

    def test_positive_is_left_and_the_last_heading_is_held(self):
        blocked = road((-0.4, 8, 8, 0, 1))
        nothing = np.full((HEIGHT, WIDTH), NAN, np.float32)
        found = self.steered([nothing, blocked, nothing])
        assert [one.status for one in found] == ["blind", "ok", "held"]
        assert found[1].steer > 0.06
        assert found[1].steer_rad == pytest.approx(
            math.atan(found[1].steer * WIDTH / 2 / FOCAL), abs=1e-6
        )
        assert found[2].steer == found[1].steer
        assert found[0].steer is None

    @pytest.mark.parametrize(("limit_px", "status"), [(7, "blind"), (13, "ok"), (64, "ok")])
    def test_what_is_nearer_than_the_range_is_no_way(self, limit_px, status):
        """Houses to the left, and a road of which the near part is out of range."""
        near = road((-20, -4, 12, 0, 9), walls=(-9, 9))
        guide = ImageGuide(Settings(max_disparity=limit_px), RIG)
        seen = guide.profile(cut(near, limit_px - 1), np.ones(near.shape, bool))
        _, steering = guide.steer(None, seen)
        assert steering.status == status
        if status == "ok":
            assert abs(steering.steer) < 0.15

    def test_depth_is_that_of_what_stands_in_the_way_not_of_the_road(self):
        steering = self.steered([road((-20, 20, 10, 0, 1.2))])[0]
        assert steering.depth_m == pytest.approx(12, rel=0.05)
        assert steering.nearest_m < 4


def test_steadied_goes_a_share_of_the_way():
    assert steadied(None, 0.7, 0.3) == 0.7
    assert steadied(0.5, 0.7, 0.25) == pytest.approx(0.55)


def test_the_nearest_thing_is_not_one_stray_pixel():
    near = np.full((20, 20), 4, np.float32)
    near[0, 0] = 60
    assert nearest(StripValues.of(near, 1)) == 4
    near[:3] = 30
    assert nearest(StripValues.of(near, 1)) == 30
    assert nearest(StripValues.of(np.full((4, 4), NAN, np.float32), 1)) is None
