"""The local map and the course through it, on surroundings that are known."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from motionstereo_cli.method.settings import Settings
from motionstereo_cli.robot.approach import Approach, nearest_in_way
from motionstereo_cli.robot.course import (
    DIRECTIONS_RAD,
    Course,
    free_distances,
    plan,
    taken_along,
    travelled,
    wrapped,
)
from motionstereo_cli.robot.grid import FloorView, sighted
from motionstereo_cli.robot.guide import HELD_FRAMES, ImageGuide, MapGuide
from motionstereo_cli.robot.local_map import (
    CELL_M,
    CELLS,
    CERTAIN,
    HALF_LIFE_FRAMES,
    Bearings,
    LocalMap,
    moved,
    nearest_by_bearing,
    profile,
    ranked_by_bearing,
    seen,
)
from motionstereo_cli.types import Pose, Rig

NAN = np.float32(np.nan)
WIDTH = 160
HEIGHT = 120
RIG = Rig(WIDTH, HEIGHT, focal_px=140, baseline_m=0.12, cx=79.5, cy=59.5)
FB = RIG.focal_px * RIG.baseline_m
SIZE = WIDTH, HEIGHT
BEARINGS = 80
#: Heights above the cameras of what reaches above them, and of a box of 0.5 m.
BELOW_M = 1.1
TALL_M, LOW_M = 0.5, -0.7
#: Tops above the cameras, distances, and whether that is an obstacle.
LOW_THINGS = [(-0.95, 3.0, True), (-0.95, 4.0, False), (LOW_M, 4.0, True)]


def view(x_m=0.0, y_m=0.0, yaw_rad=0.0):
    return FloorView(x_m, y_m, yaw_rad, RIG.focal_px, RIG.focal_px, RIG.cx, RIG.cy, FB)


def pose(x_m=0.0, y_m=0.0, yaw_rad=0.0):
    return Pose(x_m, y_m, 1.2, 0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2))


def stands(near_px, top_m=TALL_M):
    top_m = np.where(np.isnan(near_px), NAN, np.float32(top_m))
    return Bearings(near_px, top_m, np.zeros_like(near_px))


def wall_ahead(depth_m):
    return np.full(BEARINGS, FB / depth_m, np.float32)


def evidence_at(known, x_m, y_m):
    i, j = (math.floor(m / CELL_M) - c for m, c in zip((x_m, y_m), known.corner, strict=True))
    return known.evidence[i, j]


def after(frames, profile_px, top_m=TALL_M, **where):
    known = LocalMap.unknown(0, 0)
    for _ in range(frames):
        known = seen(known, stands(profile_px, top_m), view(**where), SIZE, BELOW_M)
    return known


class TestProfile:
    def look(self, disparity, fresh=None, below_m=1.1, above_m=0.6):
        fresh = np.ones(disparity.shape, bool) if fresh is None else fresh
        found = profile(disparity, fresh, view(), bearings=40, below_m=below_m, above_m=above_m)
        assert (np.isnan(found.near_px) == np.isnan(found.top_m)).all()
        return found.near_px

    def test_takes_the_nearest_tenth_and_at_least_four_pixels(self):
        disparity = np.full((HEIGHT, WIDTH), NAN, np.float32)
        disparity[50:70, 0:4] = 10  # 80 pixels of bearing 0
        disparity[50, 0:4], disparity[51, 0:3] = 20, 20  # 7 of them nearer: fewer than a tenth
        disparity[60, 4:7] = 10  # 3 pixels of bearing 1: too few
        disparity[60, 8:12] = (10, 11, 12, 13)  # just enough in bearing 2
        found = self.look(disparity)
        assert found[0] == 10
        assert np.isnan(found[1])
        assert found[2] == 10
        disparity[51, 3] = 20  # the eighth
        assert self.look(disparity)[0] == 20

    def test_floor_and_ceiling_and_old_points_are_not_in_the_way(self):
        # At 2 m (8.4 px) a row is 2/140 m: the band from -1.1 m to 0.6 m ends 42 rows above.
        disparity = np.full((HEIGHT, WIDTH), NAN, np.float32)
        disparity[:16] = FB / 2
        assert np.isnan(self.look(disparity)).all()
        disparity[18] = FB / 2
        assert np.allclose(self.look(disparity), FB / 2)
        assert np.isnan(self.look(disparity, below_m=0, above_m=0.5)).all()
        assert np.isnan(self.look(disparity, fresh=np.zeros((HEIGHT, WIDTH), bool))).all()

    def test_a_top_is_that_of_the_nearest_thing(self):
        # At 2 m a row is 2/140 m: a box from 0.5 m to 0.9 m below the camera, a wall behind it.
        disparity = np.full((HEIGHT, WIDTH), FB / 5, np.float32)
        disparity[95:, 80:] = FB / 2
        found = profile(disparity, disparity > 0, view(), bearings=2, below_m=1.1, above_m=0.6)
        np.testing.assert_allclose(found.near_px, [FB / 5, FB / 2])
        assert found.top_m[0] > 0.4
        assert found.top_m[1] == pytest.approx(-0.5, abs=0.06)

    @pytest.mark.parametrize(("seed", "width"), [(0, 160), (1, 150), (2, 33)])
    def test_is_as_its_words_say_of_random_points(self, seed, width):
        rng = np.random.default_rng(seed)
        near = rng.uniform(-2, 40, (HEIGHT, width)).astype(np.float32)
        near[rng.random(near.shape) < 0.3] = NAN
        fresh, here = rng.random(near.shape) < 0.6, view()
        found = profile(near, fresh, here, bearings=20, below_m=1.1, above_m=0.6)
        row, column = np.nonzero(fresh & (near > 0))
        up_m = (here.cy_px - row) * (FB / RIG.focal_px) / near[row, column]
        inside = (up_m > -1.1) & (up_m < 0.6)
        points, up_m = near[row, column][inside], up_m[inside].astype(np.float32)
        bearing = column[inside] * 20 // width
        nearest = nearest_by_bearing(points, bearing, 20)
        of_it = points >= (nearest - np.maximum(np.float32(0.1) * nearest, 1))[bearing]
        top_m = ranked_by_bearing(up_m[of_it], bearing[of_it], 20, share=0.1)
        assert np.array_equal(found.near_px, nearest, equal_nan=True)
        assert np.array_equal(found.top_m, top_m, equal_nan=True)

    def test_an_upper_side_reaches_from_the_front_to_its_end(self):
        """Rays meet a box from 2 m to 3 m ahead, 0.7 m below the cameras, or a wall at 5 m."""
        slant = (np.arange(HEIGHT) - RIG.cy) / RIG.focal_px
        with np.errstate(divide="ignore"):
            onto_m = np.where(slant > 0, 0.7 / slant, np.inf)
        depth_m = np.where(onto_m < 2, 2, np.where(onto_m < 3, onto_m, 5))
        disparity = np.repeat((FB / depth_m)[:, None], WIDTH, axis=1).astype(np.float32)
        disparity[:, WIDTH // 2 :] = FB / 5  # beside it
        every = np.ones(disparity.shape, bool)
        found = profile(disparity, every, view(), bearings=2, below_m=BELOW_M, above_m=0.6)
        assert found.far_m[0] == pytest.approx(3.0, abs=0.11)
        assert found.far_m[1] == 0
        known = LocalMap.unknown(0, 0)
        for _ in range(3):
            known = seen(known, found, view(), SIZE, BELOW_M)
        occupied = [evidence_at(known, x_m, 0.1) > CERTAIN for x_m in (1.5, 2.3, 2.8, 3.5)]
        assert occupied == [False, True, True, False]


class TestMap:
    def test_before_a_wall_is_free_the_wall_occupied_and_the_rest_unknown(self):
        known = after(2, wall_ahead(3.0))
        assert evidence_at(known, 1.5, 0) < -CERTAIN
        assert evidence_at(known, 3.0, 0) > CERTAIN
        assert evidence_at(known, 4.0, 0) == 0
        assert evidence_at(known, 1.5, 1.5) == 0  # beside the image
        assert evidence_at(known, -1, 0) == 0

    def test_directions_are_the_worlds(self):
        known = after(2, wall_ahead(3.0), x_m=1.0, yaw_rad=math.pi / 2)
        assert evidence_at(known, 1.0, 1.5) < -CERTAIN
        assert evidence_at(known, 1.0, 3.0) > CERTAIN
        left = np.where(np.arange(BEARINGS) < BEARINGS // 2, wall_ahead(3.0), NAN)
        known = after(2, left)
        assert evidence_at(known, 2, 0.5) < -CERTAIN
        assert evidence_at(known, 2, -0.5) == 0

    def test_one_frame_is_not_certain(self):
        known = after(1, wall_ahead(3.0))
        assert np.abs(known.evidence).max() < CERTAIN

    def test_what_comes_into_a_free_place_is_believed_in_two_frames(self):
        known = after(40, wall_ahead(5.0))
        for _ in range(2):
            known = seen(known, stands(wall_ahead(2.0)), view(), SIZE, BELOW_M)
        assert evidence_at(known, 2.0, 0) > CERTAIN

    def test_who_enters_a_long_free_place_is_noticed_and_remembered_for_a_while(self):
        known = after(40, wall_ahead(5.0))
        assert known.walks_frames == 0
        known = seen(known, stands(wall_ahead(2.0)), view(), SIZE, BELOW_M)
        remembered = known.walks_frames
        known = moved(known, 0.3, 0.0)
        for _ in range(3):
            known = seen(known, stands(wall_ahead(2.0)), view(0.3), SIZE, BELOW_M)
        assert 0 < known.walks_frames < remembered

    @pytest.mark.parametrize(("top_m", "place_m", "counts"), LOW_THINGS)
    def test_what_is_low_and_far_is_floor(self, top_m, place_m, counts):
        known = after(3, wall_ahead(place_m), top_m)
        assert (evidence_at(known, place_m, 0) > CERTAIN) == counts

    @pytest.mark.parametrize(("top_m", "stays"), [(LOW_M, True), (TALL_M, False)])
    @pytest.mark.parametrize(("place_m", "over"), [(1.2, True), (3.0, False)])
    def test_what_a_view_passes_over_stays(self, top_m, stays, place_m, over):
        """The lowest row sees 0.7 m below the cameras from 1.6 m on."""
        known = after(8, wall_ahead(place_m), top_m)
        assert evidence_at(known, place_m, 0) > CERTAIN
        for _ in range(16):
            known = seen(known, stands(np.full(BEARINGS, 1.0, np.float32)), view(), SIZE, BELOW_M)
        assert (evidence_at(known, place_m, 0) > CERTAIN) == (stays and over)
        assert (evidence_at(known, place_m, 0) < -CERTAIN) == (not (stays and over))
        beside = evidence_at(known, place_m + 0.35, 0)
        assert (beside < -CERTAIN) == (not (stays and over))
        assert evidence_at(known, place_m + 1.5, 0) < -CERTAIN

    def test_what_is_not_seen_again_is_forgotten(self):
        known = after(3, wall_ahead(3.0))
        nothing = np.full(BEARINGS, NAN, np.float32)
        later = known
        for _ in range(HALF_LIFE_FRAMES):
            later = seen(later, stands(nothing), view(), SIZE, BELOW_M)
        np.testing.assert_allclose(later.evidence, known.evidence / 2, rtol=1e-4)

    def test_a_narrow_gap_in_a_wall_is_wall_and_a_wide_one_unknown(self):
        gapped = wall_ahead(3.0)
        gapped[38:42] = NAN  # 8 px: 3 degrees, 0.2 m
        assert evidence_at(after(2, gapped), 3.0, 0) > CERTAIN
        gapped[24:56] = NAN  # 26 degrees
        known = after(2, gapped)
        assert evidence_at(known, 3.0, 0) == 0
        assert evidence_at(known, 1.5, 0) == 0

    def test_between_walls_the_way_ahead_is_free_where_nothing_shifts(self):
        """Straight driving leaves no trails around the point where it leads."""
        leftward = (39.5 - np.arange(BEARINGS)) * WIDTH / BEARINGS / RIG.focal_px
        walls = (FB / 1.0 * np.abs(leftward)).astype(np.float32)  # 1 m to the left and right
        walls[30:49] = NAN  # 16 degrees
        assert evidence_at(after(2, walls), 3.0, 0) < -CERTAIN
        aside = wall_ahead(3.0)
        aside[58:77] = NAN
        known = after(2, aside)
        assert evidence_at(known, 1.55, -0.75) == 0

    def test_moves_along_and_keeps_what_is_in_reach_in_its_place(self):
        known = after(2, wall_ahead(3.0))
        there = moved(known, 2.55, -1.3)
        assert evidence_at(there, 3.0, 0) == evidence_at(known, 3.0, 0) > CERTAIN
        assert evidence_at(there, 1.5, 0) == evidence_at(known, 1.5, 0)
        back = moved(moved(known, 20, 0), 0, 0)
        assert not back.evidence.any()


def corridor(half_width_m=1.0, end_m=4.0, behind_m=2.0):
    """A corridor along x with an end wall, all of it known, as cells; the robot at its middle."""
    x, y = ((np.arange(CELLS) + 0.5) * CELL_M - CELLS * CELL_M / 2 for _ in range(2))
    inside = (np.abs(y) < half_width_m) & (x[:, None] < end_m) & (x[:, None] > -behind_m)
    near = (np.abs(y) < half_width_m + 0.2) & (x[:, None] < end_m + 0.2) & (x[:, None] > -behind_m)
    return near & ~inside, inside


def ways(occupied, free, directions=(0.0,)):
    middle = (CELLS / 2, CELLS / 2)
    return free_distances(
        occupied, free, middle, np.array(directions), cell_m=CELL_M, radius_m=0.25
    )


class TestSight:
    @pytest.mark.parametrize("yaw_rad", [0.0, 0.7, -2.5])
    def test_is_what_lies_before_and_at_the_points_of_each_cell(self, yaw_rad):
        rng, here = np.random.default_rng(5), view(0.23, -0.41, yaw_rad)
        near_px = np.repeat(rng.uniform(3, 20, 16), 5).astype(np.float32)
        far_m = np.where(rng.random(80) < 0.2, 4.0, 0.0).astype(np.float32)
        given = {"cell_m": CELL_M, "reach_m": 5.0, "error_px": 0.5, "far_m": far_m}
        found = sighted((70, 60), (-30, -35), near_px, here, WIDTH, **given)
        free, hit = np.zeros((2, 70, 60), bool)
        for i in range(70):
            for j in range(60):
                x, y = (i - 29.5) * CELL_M - here.x_m, (j - 34.5) * CELL_M - here.y_m
                ahead = x * math.cos(yaw_rad) + y * math.sin(yaw_rad)
                left = y * math.cos(yaw_rad) - x * math.sin(yaw_rad)
                bearing = (RIG.cx + 0.5 - RIG.focal_px * left / ahead) / WIDTH * 80
                assert found.ahead_m[i, j] == pytest.approx(ahead, abs=1e-5)
                if ahead <= CELL_M or not 0 <= bearing < 80:
                    continue
                bearing = int(bearing)
                near, depth = near_px[bearing], FB / near_px[bearing]
                free[i, j] = ahead < FB / (near + 1)
                at_it = abs(FB / ahead - near) < 0.5 or abs(ahead - depth) < 0.75 * CELL_M
                hit[i, j] = (at_it and depth < 5) or depth < ahead < far_m[bearing]
        # In float32, cells at a border may fall to either side; surfaces end at wide steps.
        assert (found.free != free).mean() < 0.002
        assert (found.hit & ~hit).mean() < 0.002
        assert hit.sum() * 0.7 < found.hit.sum() <= hit.sum() * 1.01


class TestFreeWays:
    def test_ends_a_robot_and_its_room_before_a_wall(self):
        known, possible = ways(*corridor())
        assert known == possible == pytest.approx(4.0 - 0.45, abs=0.1)

    def test_robots_far_from_the_middle_of_the_map_end_at_its_border(self):
        free = np.ones((40, 30), bool)
        directions = np.radians([0.0, 90.0, 180.0, 270.0])
        known, possible = free_distances(
            ~free, free, (30.5, 10.5), directions, cell_m=CELL_M, radius_m=0.25
        )
        assert known == pytest.approx([0.95, 1.95, 3.05, 1.05], abs=0.11)
        assert np.array_equal(known, possible)

    def test_what_is_unknown_is_neither_free_nor_an_obstacle(self):
        occupied, free = corridor(end_m=6.0)
        free[CELLS // 2 + 20 : CELLS // 2 + 25] = False  # unknown from 2 m to 2.5 m
        known, possible = ways(occupied, free)
        assert known == pytest.approx(2.0, abs=0.2)
        assert possible == pytest.approx(5.55, abs=0.1)

    @pytest.mark.parametrize(("half_gap_m", "passes"), [(0.4, False), (0.6, True)])
    def test_a_gap_has_to_be_wide_enough(self, half_gap_m, passes):
        occupied, free = corridor(end_m=6.0)
        y = np.abs((np.arange(CELLS) + 0.5) * CELL_M - CELLS * CELL_M / 2)
        occupied[CELLS // 2 + 20, y > half_gap_m] = True
        assert (ways(occupied, free)[0] > 4) == passes

    def test_beside_a_wall_only_ways_that_lead_off_it_are_free(self):
        occupied, free = corridor(half_width_m=0.35, end_m=6.0)
        occupied[:, : CELLS // 2] &= False
        free[:, : CELLS // 2] = True  # a wall 0.35 m to the left, all free to the right
        along, off, into = ways(occupied, free, (0.0, -0.6, 0.3))[0]
        assert along < 0.6
        assert off > 3
        assert into < 0.6


class TestPlan:
    def planned(
        self,
        way,
        possible=None,
        course=None,
        yaw_rad=0.0,
        turned_rad=0.0,
        goal_rad=None,
        walks=False,
    ):
        way = np.array([way(d) for d in DIRECTIONS_RAD])
        possible = way if possible is None else np.array([possible(d) for d in DIRECTIONS_RAD])
        course = course or Course(0.0, 0.0)
        directions = yaw_rad + DIRECTIONS_RAD
        turned = {"turned_rad": turned_rad, "goal_rad": goal_rad, "walks": walks}
        return plan(course, yaw_rad, way, possible, directions, **turned)

    def test_heads_for_the_longest_way(self):
        course, free_m = self.planned(lambda d: 6.0 if abs(d - 0.4) < 0.2 else 2.0)
        assert course.heading_rad == pytest.approx(0.4, abs=0.15)
        assert free_m == 6

    def test_of_two_ways_takes_that_nearer_to_the_goal(self):
        def way(d):
            return 5.0 if 0.5 < abs(d) < 1.0 else 1.0

        for side in (-1, 1):
            course, _ = self.planned(way, goal_rad=side * 1.5)
            assert course.heading_rad * side > 0.4

    def test_does_not_turn_back_for_a_longer_way(self):
        course, _ = self.planned(lambda d: 7.0 if abs(d) > 2.5 else 1.2)
        assert abs(course.heading_rad) < math.radians(100)

    def test_at_a_dead_end_looks_to_where_more_may_be_free(self):
        def short(_):
            return 0.5

        course, free_m = self.planned(short, possible=lambda d: 5.0 if d < 0 else 0.5)
        assert (course.look, free_m) == (-1, None)
        assert course.heading_rad == pytest.approx(-math.pi / 2)
        # It goes on that way, whatever comes into view, until there is a way.
        course, free_m = self.planned(
            short, possible=lambda d: 5.0 if d > 0 else 0.5, course=course, turned_rad=-0.1
        )
        assert (course.look, free_m) == (-1, None)
        course, free_m = self.planned(lambda d: 3.0 if abs(d + 1.4) < 0.2 else 0.5, course=course)
        assert (course.look, free_m) == (0, 3.0)
        assert course.heading_rad == pytest.approx(-1.4, abs=0.15)

    @pytest.mark.parametrize(
        ("open_m", "walks", "turns_deg"),
        [(0.5, False, (500, 600)), (5.0, False, (680, 780)), (0.5, True, (1040, 1130))],
    )
    def test_after_looking_all_around_turns_back(self, open_m, walks, turns_deg):
        """Later where nothing known closes the way ahead, and where somebody walks."""

        def way(d):
            return 5.0 if abs(d) > 2.5 else 0.5

        course = Course(0.0, 0.0)
        turned = 0.0
        for _ in range(200):
            course, free_m = self.planned(
                way,
                possible=lambda d: max(way(d), open_m),
                course=course,
                turned_rad=0.1,
                walks=walks,
            )
            turned += 0.1
            if free_m is not None:
                break
        assert turns_deg[0] < math.degrees(turned) < turns_deg[1]
        assert abs(wrapped(np.array(course.heading_rad))) > 2.4
        # And it stays with that.
        course, free_m = self.planned(way, course=course)
        assert free_m == 5

    def test_the_direction_of_travel_follows_the_way(self):
        course = Course(0.0, 0.0)
        for _ in range(100):
            course = travelled(course, 0.16, math.pi / 2)
        assert course.travel_rad == pytest.approx(math.pi / 2, abs=0.01)
        assert travelled(course, 0.0, 0.0).travel_rad == course.travel_rad

    @pytest.mark.parametrize("side", [1, -1])
    def test_a_course_turns_along_with_a_rig_that_turns_away_unasked(self, side):
        def taken(*yaws, asked=0.0, look=0, heading=0.3):
            yaws = [side * yaw for yaw in yaws]
            course = Course(side * heading, 0.1, look)
            found = taken_along(course, yaws, [side * asked] * (len(yaws) - 1))
            return side * found.heading_rad, side * (found.travel_rad - 0.1)

        assert taken(0.0, 0.1) == (0.3, 0.0)  # it turns toward it
        assert taken(0.0, 0.2, 0.35) == pytest.approx((0.35, 0.05))
        assert taken(0.0, 0.2, 0.5, heading=0.1) == pytest.approx((0.4, 0.3))
        assert taken(0.0, 0.2, 0.5, heading=0.1, asked=0.1) == pytest.approx((0.4, 0.3))
        assert taken(0.0, 0.2, 0.5, heading=0.1, asked=0.3) == (0.1, 0.0)  # late, but as asked
        assert taken(0.0, 0.2, 0.5, look=1) == (0.3, 0.0)


class TestMapGuide:
    def steered(self, disparities, poses, fresh=True):
        guide, state = MapGuide(Settings(), RIG), None
        for disparity, where in zip(disparities, poses, strict=True):
            seen = guide.profile(disparity, np.full(disparity.shape, fresh))
            state, steering = guide.steer(state, seen, where)
        return steering

    def flat(self, depth_m):
        """A wall, and something nearer on either side of it."""
        disparity = np.full((HEIGHT, WIDTH), FB / depth_m, np.float32)
        disparity[:, : WIDTH // 7] *= 1.5
        disparity[:, -(WIDTH // 7) :] *= 1.5
        return disparity

    def test_before_one_level_surface_it_is_blind(self):
        """A camera that looks down, and one before a wall, see no direction that is farther."""
        level = np.full((HEIGHT, WIDTH), FB / 2.7, np.float32)
        level += np.random.default_rng(0).normal(0, 0.1, level.shape).astype(np.float32)
        level[40:80, 60:90] *= 1.5  # somebody
        steering = self.steered([level] * 10, [pose()] * 10)
        assert (steering.status, steering.steer) == ("blind", None)
        for rig in (None, RIG):
            guide, state = ImageGuide(Settings(), rig), None
            found = []
            for disparity in [self.road()] * 4 + [level] * (HELD_FRAMES + 1):
                state, steering = guide.steer(state, guide.profile(disparity, disparity > 0))
                found.append(steering)
            assert {each.status for each in found[:4]} == {"ok"}
            assert {(each.status, each.steer) for each in found[4:-2]} == {("held", found[3].steer)}
            assert found[-1].status == "blind"

    def road(self):
        """Level ground 1.2 m below the cameras between walls 3 m to either side, without end."""
        row, column = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
        ground = (row - RIG.cy) / 1.2
        walls = np.abs(column - RIG.cx) / 3
        return np.maximum(np.maximum(ground, walls), 0.05).astype(np.float32) * RIG.baseline_m

    def test_on_an_open_road_it_steers_by_the_image_and_goes_on_in_its_bend(self):
        """A rig that sees farther than the map does: its image decides, poses or not."""
        rig = replace(RIG, baseline_m=0.6)
        disparity = self.road() * 5
        image, state = ImageGuide(Settings(), rig), None
        for _ in range(12):
            state, plain = image.steer(state, image.profile(disparity, disparity > 0))
        found = {}
        for turn_rad in (-0.03, 0.0, 0.03):
            guide, state = MapGuide(Settings(), rig), None
            x_m = y_m = 0.0
            for n in range(12):
                seen = guide.profile(disparity, disparity > 0)
                state, steering = guide.steer(state, seen, pose(x_m, y_m, n * turn_rad))
                x_m += math.cos(n * turn_rad)
                y_m += math.sin(n * turn_rad)
            assert steering.status == "ok"
            found[turn_rad] = steering.steer
        assert found[0.0] == pytest.approx(plain.steer, abs=0.02)
        assert found[-0.03] < found[0.0] - 0.02
        assert found[0.03] > found[0.0] + 0.02

    def test_who_has_never_seen_anything_is_blind(self):
        nothing = np.full((HEIGHT, WIDTH), NAN, np.float32)
        steering = self.steered([nothing] * 20, [pose(0.1 * n) for n in range(20)])
        assert steering.status == "blind"
        assert steering.steer is None

    def test_a_free_way_is_known_after_it_was_seen_and_held_at_rest(self):
        seen_first = [self.flat(6.0)] * 15
        steering = self.steered(seen_first, [pose()] * 15)
        assert (steering.status, steering.steer) == ("ok", pytest.approx(0, abs=0.1))
        # The wall is 2.8 px away, and an error of 1 px is allowed for.
        assert steering.depth_m == pytest.approx(FB / 3.8, abs=0.2)
        nothing = [np.full((HEIGHT, WIDTH), NAN, np.float32)] * 5
        held = self.steered(seen_first + nothing, [pose()] * 20)
        assert held.status == "held"
        assert held.steer == pytest.approx(steering.steer, abs=0.05)
        assert held.depth_m == pytest.approx(steering.depth_m, abs=0.2)
        assert held.nearest_m is None

    def test_at_a_corner_it_goes_along_with_who_drives(self):
        """A wall 4 m ahead and one 1 m to the right; the rig turns left, where the way is."""

        def corner(yaw_rad):
            off_rad = np.arctan((RIG.cx - np.arange(WIDTH)) / RIG.focal_px)
            x, y = np.cos(yaw_rad + off_rad), np.sin(yaw_rad + off_rad)
            inverse_m = np.maximum.reduce([x / 4, y / 9, -y])
            return np.tile((FB * inverse_m / np.cos(off_rad)).astype(np.float32), (HEIGHT, 1))

        turns = [0.0] * 24 + [0.05 * n for n in range(1, 14)]
        guide, state, steers = MapGuide(Settings(), RIG), None, []
        for yaw_rad in turns:
            seen = guide.profile(corner(yaw_rad), np.full((HEIGHT, WIDTH), fill_value=True))
            state, steering = guide.steer(state, seen, pose(yaw_rad=yaw_rad))
            steers.append(steering.steer)
        steers = steers[9:]  # at first it looks around, until something is certain
        assert min(steers) > -0.1
        assert np.abs(np.diff(steers)).max() < 0.2

    def test_before_a_wall_there_is_no_free_way(self):
        steering = self.steered([self.flat(1.0)] * 5, [pose()] * 5)
        assert steering.depth_m is None
        assert abs(steering.steer) > 0.8

    def test_what_was_seen_is_remembered_in_its_place_after_a_turn(self):
        """It looks ahead, turns right by a right angle where it sees nothing, and knows its way."""
        nothing = np.full((HEIGHT, WIDTH), NAN, np.float32)
        frames = [self.flat(6.0)] * 5 + [nothing] * 15
        turns = [0.0] * 5 + [-math.radians(6 * n) for n in range(1, 16)]
        steering = self.steered(frames, [pose(yaw_rad=turn) for turn in turns])
        assert steering.status == "held"
        assert steering.steer > 0.9  # it lies to the left, beyond the image
        assert steering.depth_m > 4


class TestApproach:
    """The time until contact, from nearness over time."""

    @staticmethod
    def approach(depths, *, rate=10.0, place=0.5):
        known = Approach()
        for number, depth in enumerate(depths):
            known = known.after(number / rate, place, 40 / depth)
        return known

    def test_an_even_approach_has_its_time_to_contact_in_any_unit(self):
        for unit in (0.01, 1.0, 100.0):
            depths = [unit * (10 - 0.2 * number) for number in range(12)]  # 2 a second
            assert self.approach(depths).contact_s == pytest.approx(7.8 / 2)

    @pytest.mark.parametrize(
        "depths",
        [
            [10 + 0.2 * number for number in range(12)],  # it goes away
            [10 + 0.05 * (number % 2) for number in range(12)],  # noise
            [10 - 0.001 * number for number in range(12)],  # in over a minute
            [10 - 0.2 * number for number in range(3)],  # too few frames
            [10, 9.8, 9.6, 9.4, 9.2, 5, 4.9, 4.8],  # another thing since three frames
        ],
    )
    def test_nothing_is_said_where_nothing_comes_closer_for_sure(self, depths):
        assert self.approach(depths).contact_s is None

    def test_a_frame_without_anything_in_the_way_begins_anew(self):
        known = self.approach([10, 9.8, 9.6, 9.4, 9.2])
        assert known.contact_s is not None
        assert known.after(0.5, 0.5, float("nan")).contact_s is None
        assert known.after(None, 0.5, 4.0).contact_s is None
        assert known.after(0.5, 0.8, 40 / 9).contact_s is None  # the heading has moved on

    @given(st.floats(0.3, 5), st.floats(2, 20), st.integers(4, 12))
    def test_time_to_contact_is_distance_over_speed(self, speed, first, count):
        depths = [first - speed * number / 100 for number in range(count)]
        assume(0.5 < depths[-1] < 59 * speed)
        found = self.approach(depths, rate=100.0).contact_s
        assert found == pytest.approx(depths[-1] / speed, rel=1e-6)

    def test_a_way_is_as_wide_as_the_vehicle_at_the_distance_of_what_stands_there(self):
        near = np.full(20, np.nan, np.float32)
        near[3], near[10], near[12] = 8, 1, 4
        for half_way, nearest in ((0, 1), (3, 1), (6, 4), (30, 8)):
            assert nearest_in_way(near, 0.52, 200, half_way) == nearest
        assert math.isnan(nearest_in_way(np.full(4, np.nan, np.float32), 0.5, 200, 5))
