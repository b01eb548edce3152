"""Moving objects: regions, following, speeds, the nearest contact, and their table."""

import csv
import itertools
import math
from collections import Counter
from dataclasses import replace
from fractions import Fraction

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from bench import objects as bench
from motionstereo_cli.commands import cli
from motionstereo_cli.compiled import objects as loops
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.method.steady import in_parts
from motionstereo_cli.pipeline import process
from motionstereo_cli.robot import objects
from motionstereo_cli.robot.assignment import assignment
from motionstereo_cli.robot.objects import (
    CELL_PX,
    Observation,
    Region,
    Track,
    follow,
    regions,
    uncovered,
)
from motionstereo_cli.robot.speeds import Movement, by_itself, movement, moves_surely, trust
from motionstereo_cli.robot.tracker import MAX_CONTACT_S, Tracker, Tracks
from motionstereo_cli.simulate.scenes import render_scene
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.sinks.outputs import OUTPUTS
from motionstereo_cli.sinks.sink import RunContext
from motionstereo_cli.types import (
    FrameTime,
    MovingObject,
    Pose,
    Rig,
    Steering,
    Step,
    StereoFrame,
)

WIDTH = 160
HEIGHT = 96
RIG = Rig(width=WIDTH, height=HEIGHT, focal_px=140, baseline_m=0.12, cx=79.5, cy=47.5)
FB = 140 * 0.12
NAN = np.float32(np.nan)


def scene(*patches, ground=NAN):
    """Nearness of (x, y, width, height, nearness) on a ground."""
    near = np.full((HEIGHT, WIDTH), ground, np.float32)
    for x, y, width, height, value in patches:
        near[y : y + height, x : x + width] = value
    return near


def found(near, fresh=None, min_share=0.002):
    return regions(near, np.full(near.shape, True) if fresh is None else fresh, min_share)


class TestRegions:
    def test_a_patch_is_a_region_with_its_box_middle_and_nearness(self):
        (region,) = found(scene((40, 20, 32, 48, 12.25)))
        assert (region.x, region.y, region.width, region.height) == (40, 20, 32, 48)
        # Pixels 40..71 and 20..67: the middle pixel is half way.
        assert (region.middle_x, region.middle_y) == pytest.approx((55.5, 43.5))
        assert region.nearness_px == 12.25
        assert region.known == 1

    def test_a_jump_parts_what_touches_and_a_slope_does_not(self):
        parts = found(scene((20, 20, 40, 40, 10), (60, 20, 40, 40, 14)))
        assert sorted((r.x, r.nearness_px) for r in parts) == [(20, 10), (60, 14)]
        slope = scene((20, 20, 80, 40, np.linspace(10, 14, 80)))
        (region,) = found(slope)
        assert (region.x, region.width) == (20, 80)

    @pytest.mark.parametrize(("gap_px", "count"), [(8, 1), (16, 1), (24, 2)])
    def test_gaps_close_up_to_16_px(self, gap_px, count):
        near = scene((20, 20, 32, 40, 10), (52 + gap_px, 20, 32, 40, 10))
        assert len(found(near)) == count

    def test_only_what_is_fresh_counts(self):
        near = scene((20, 20, 40, 40, 10))
        fresh = np.zeros(near.shape, bool)
        assert found(near, fresh) == ()
        fresh[20:60, 20:40] = True
        (region,) = found(near, fresh)
        assert (region.x, region.width) == (20, 20)
        fresh[::2] = False  # every other row
        (region,) = found(near, fresh)
        assert region.known == 0.5

    def test_tiny_ones_are_dropped(self):
        near = scene((20, 20, 8, 8, 10))  # 4 cells of 960
        assert len(found(near, min_share=4 / 960)) == 1
        assert found(near, min_share=5 / 960) == ()

    def test_what_others_stand_before_is_none_but_they_are(self):
        """A camera that turns: the wall moves as well, even in pieces."""
        cards = (30, 0, 24, 96, 20), (100, 0, 24, 96, 20)
        found_cards = found(scene(*cards, ground=6))
        assert sorted(region.x for region in found_cards) == [
            32,
            100,
        ]  # 30 and 31 are of mixed cells

    def test_what_stands_before_something_is_one_even_between_nearer_ones(self):
        near = scene((8, 0, 24, 96, 20), (32, 0, 80, 96, 10), (112, 0, 24, 96, 20))
        fresh = np.isfinite(near)
        assert [region.nearness_px for region in found(near, fresh)] == [20, 20]
        near[20:60, 32:64] = 6  # seen behind the middle one, which so is no wall
        fresh[20:60, 32:64] = False
        assert sorted(region.nearness_px for region in found(near, fresh)) == [10, 20, 20]

    def test_what_a_mover_uncovers_has_not_moved(self):
        was, now = scene((40, 20, 40, 48, 20), ground=8), scene((64, 20, 40, 48, 20), ground=8)
        fresh = scene((40, 20, 64, 48, 1), ground=0) > 0
        lost = np.full(now.shape, NAN)
        for earlier in ([was], [was, now, lost]):
            hidden = uncovered(now, fresh, [in_parts(each) for each in earlier], 32, 0.0)
            assert hidden[20:68, 40:64].all()
            assert np.count_nonzero(hidden) == 24 * 48
        assert not uncovered(now, fresh, [], 32, 0.0).any()
        drew_back = in_parts(now + np.float32(1))  # a little
        assert not uncovered(now, fresh, [drew_back], 32, 0.0).any()
        parts = [in_parts(was)]
        assert not uncovered(now, fresh, parts, 32, 200.0).any()  # 12 px are a small share of 208

    @given(
        arrays(np.float32, (3, 5, 7), elements=st.sampled_from([np.nan, 0.5, 4, 5, 5.5, 40, 43])),
        arrays(np.bool_, (5, 7)),
        st.sampled_from([0.0, 3.5]),
    )
    def test_uncovered_is_as_its_formula_says(self, disparity, fresh, doffs_px):
        now, *earlier = disparity
        with np.errstate(invalid="ignore"):
            before = np.fmax(*earlier)
            wanted = fresh & (before - now > np.maximum(1, np.float32(0.06) * (now + doffs_px)))
        parts = [in_parts(each) for each in earlier]
        assert np.array_equal(uncovered(now, fresh, parts, 32, doffs_px), wanted)

    def test_what_recedes_uncovers_nothing(self):
        earlier = [scene((40, 20, 64, 48, 20 * 1.015**ago)) for ago in range(7, 0, -1)]
        fresh, parts = np.isfinite(earlier[0]), [in_parts(each) for each in earlier]
        assert not uncovered(scene((40, 20, 64, 48, 20)), fresh, parts, 32, 0.0).any()

    def test_what_reaches_across_the_image_is_none(self):
        assert found(scene((0, 40, 160, 56, 10))) == ()
        assert len(found(scene((8, 40, 152, 56, 10)))) == 1

    @pytest.mark.parametrize("shape", [(1, 1), (3, 5), (4, 4), (7, 200)])
    def test_any_size_of_image_will_do(self, shape):
        assert len(found(np.full(shape, 5, np.float32))) <= 1

    @given(arrays(np.float32, (7, 9), elements=st.sampled_from([0.0, 5.0, 5.4, 6.0, 12.0])))
    def test_labels_are_those_of_a_flood(self, near):
        """Against the plain way: cells that a step of no jump joins are one region."""
        count, labels = objects._labelled(near)
        numbers = {}
        for y, x in np.ndindex(near.shape):
            if not near[y, x]:
                assert labels[y, x] == 0
                continue
            flooded = self.flood(near, y, x)
            number = numbers.setdefault(flooded.tobytes(), labels[y, x])
            assert np.array_equal(labels == number, flooded)
        assert len(set(numbers.values())) == len(numbers) == count - 1

    def flood(self, near, y, x):
        reached, todo = np.zeros(near.shape, bool), [(y, x)]
        while todo:
            y, x = todo.pop()
            if reached[y, x]:
                continue
            reached[y, x] = True
            for v, u in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)):
                inside = 0 <= v < near.shape[0] and 0 <= u < near.shape[1] and near[v, u] > 0
                if inside and abs(near[v, u] - near[y, x]) <= 0.5:
                    todo.append((v, u))
        return reached


def region(x, nearness_px=10.0, size=20, y=40.0):
    return Region(int(x), int(y), size, size, x + size / 2, y + size / 2, nearness_px, 1.0)


def observation(time_s, place=(1.0, 0.0), where=None):
    return Observation(time_s, where or region(0), place, place)


def followed(frames):
    """Follow lists of regions; yields the numbers of those seen in each frame."""
    tracks, last = (), 0
    for index, found_regions in enumerate(frames):
        observations = [observation(index / 10, where=each) for each in found_regions]
        tracks = follow(tracks, observations, index / 10, last + 1)
        last = max([last, *(track.number for track in tracks)])
        yield (
            [next(t.number for t in tracks if t.observations[-1] is each) for each in observations],
            tracks,
        )


class TestFollowing:
    def test_two_that_cross_keep_their_numbers(self):
        frames = [[region(10 + 4 * n, 10), region(130 - 4 * n, 20)] for n in range(31)]
        frames[15:17] = [[each[1]] for each in frames[15:17]]  # the far one is hidden
        numbers = [numbers for numbers, _ in followed(frames)]
        assert numbers[14] == numbers[30] == [1, 2]
        assert numbers[15] == [2]

    def test_out_of_sight_for_a_while_it_is_the_same_and_after_long_another(self):
        def last_number(gap):
            frames = [[region(50)]] * 40 + [[]] * gap + [[region(52)]]
            *_, (numbers, _) = followed(frames)
            return numbers

        assert last_number(30) == [1]
        assert last_number(31) == [2]

    def test_what_was_seen_once_is_not_waited_for(self):
        *_, (_, tracks) = followed([[region(50)], [], []])
        assert tracks == ()

    def test_a_jump_in_place_or_depth_is_another_object(self):
        for other in (region(50 + 25), region(50, 14)):
            *_, (numbers, _) = followed([[region(50)]] * 5 + [[other]])
            assert numbers == [2]
        *_, (numbers, _) = followed([[region(50)]] * 5 + [[region(55, 11)]])
        assert numbers == [1]

    def test_the_total_cost_decides_and_not_who_comes_first(self):
        """The nearest for the first would leave the second without."""
        *_, (numbers, _) = followed([[region(50), region(62)]] * 3 + [[region(46), region(57)]])
        assert numbers == [1, 2]

    def test_state_is_bounded(self):
        *_, (_, tracks) = followed([[region(50)]] * 100)
        assert len(tracks[0].observations) == 12
        assert tracks[0].seen == 100


class TestMovement:
    def track(self, places, seen=None):
        observations = tuple(observation(0.1 * n, place) for n, place in enumerate(places))
        return Track(1, observations, len(observations) if seen is None else seen)

    def test_even_motion_is_found_in_spite_of_three_in_twelve_that_are_off(self):
        places = [(4 - 0.05 * n, 0.02 * n) for n in range(12)]
        for wrong in (2, 5, 9):
            places[wrong] = (7.0, -3.0)
        moves = movement(self.track(places))
        assert moves.from_camera_mps == pytest.approx((-0.5, 0.2))
        assert moves.over_ground_mps == pytest.approx((-0.5, 0.2))
        assert moves.residual == pytest.approx(0, abs=1e-9)

    def test_it_is_unknown_before_the_sixth_frame(self):
        assert movement(self.track([(1.0, 0.0)] * 5)) is None
        assert movement(self.track([(1.0, 0.0)] * 6)).from_camera_mps == (0, 0)

    def test_velocities_of_single_frames_weigh_the_less_the_older_and_the_less_sure(self):
        """Positions that slide along a body do not count then."""
        told = [((1.0, 0.0), 0.1, 0.0), ((2.0, 1.0), 0.2, 0.1)]
        observations = tuple(
            Observation(
                time_s,
                replace(region(60), sigma_mps=sigma_mps, age_s=0.05),
                (2.0 - 3 * time_s, 0.0),
                (4.0 - 5 * time_s, 0.0),
                velocity_mps,
            )
            for velocity_mps, sigma_mps, time_s in told
        )
        moves = movement(Track(1, observations, 3))
        # Half the time that each took, and the time since: it changes by 3 m/s in a second.
        changed = np.array([0.15, 0.05]) * 3
        weight = 1 / (np.square([0.1, 0.2]) + changed**2)
        older, newer = weight / weight.sum()
        ahead = older + 2 * newer
        assert moves.over_ground_mps == pytest.approx((ahead, newer))
        # The camera goes back at 2 m/s.
        assert moves.from_camera_mps == pytest.approx((ahead + 2, newer))
        sigmas = older * 0.1, newer * 0.2, older * changed[0] + newer * changed[1]
        assert moves.sigma_mps == pytest.approx(math.hypot(*sigmas))
        assert movement(Track(1, observations[:1], 2)) is None

    @pytest.mark.parametrize("hidden", ["left", "right", "inside"])
    def test_what_something_before_it_hides_moves_no_speed_by_more_than_sigma(self, hidden):
        """Its right end moves on by 0.02 m a frame; a half of what is seen of it does not."""
        observations = []
        for number in range(12):
            ends = np.array([0.5, -0.5]) - 0.02 * number
            if hidden == "left":
                ends[0] = 0.5
            elif hidden == "right":
                ends[1] = -0.5
            middle = ends.mean() if hidden != "inside" else -0.04 * number
            offs = (0.0, ends[0] - middle, 0.0, ends[1] - middle)
            place = (4.0, middle)
            observations.append(replace(observation(0.1 * number, place), ends_m=offs))
        moves = movement(Track(1, tuple(observations), 12))
        off_mps = abs(moves.over_ground_mps[1] + 0.2)
        assert off_mps == pytest.approx(0 if hidden == "inside" else 0.1, abs=1e-6)
        assert moves.sigma_mps == pytest.approx(0.1, rel=0.01)

    @pytest.mark.parametrize(("sigma_mps", "sure"), [(0.9, True), (1.1, False)])
    def test_what_moves_surely_does_so_in_the_median(self, sigma_mps, sure):
        observations = tuple(
            Observation(0.1 * n, replace(region(60), sigma_mps=sigma_mps), (2, 0), (2, 0), speed)
            for n, speed in enumerate(
                [(0.5, 0.0), (0.3, -0.4), None, (9.0, 0.0), (9.0, 0.1), (0.0, 0.1)]
            )
        )
        assert moves_surely(Track(1, observations, 5)) == sure
        assert moves_surely(Track(1, observations[2:3], 5))  # nothing is measured

    def test_what_moves_surely_does_so_in_the_mean_too(self):
        observations = tuple(
            Observation(0.1 * n, replace(region(60), sigma_mps=0.5), (2, 0), (2, 0), speed)
            for n, speed in enumerate([(1.0, 0.0), (-1.0, 0.0), (1.0, 0.0), (-1.0, 0.0)])
        )
        assert not moves_surely(Track(1, observations, 4))

    @pytest.mark.parametrize(("speed_mps", "possible"), [(49.0, True), (51.0, False)])
    def test_nothing_on_the_ground_is_faster_than_50_m_per_s(self, speed_mps, possible):
        fast = Observation(0.0, replace(region(60), sigma_mps=5.0), (2, 0), (2, 0), (speed_mps, 0))
        assert moves_surely(Track(1, (fast,), 3)) == possible

    def test_what_is_slow_moves_surely_though_its_speed_may_have_changed_since(self):
        """At 0.4 m/s, in a frame that shows what was a fifth of a second ago."""
        shown = replace(region(60), sigma_mps=0.1, age_s=0.2)
        seen = (Observation(n / 10, shown, (2, 0), (2, 0), (0.4, 0.0)) for n in range(4))
        track = Track(1, tuple(seen), 4)
        assert moves_surely(track)
        moves = movement(track)
        assert moves.sigma_mps > 0.4
        assert by_itself(track, moves)

    def test_what_single_frames_show_is_by_itself_at_one_standard_deviation(self):
        moves = Movement((0.0, 0.0), (1.5, 0.0), 0.0, 1.0)
        places = self.track([(1.0, 0.0)] * 6)
        assert not by_itself(places, moves)
        last = places.observations[-1]
        shown = replace(last, velocity_mps=(1.5, 0.0), region=replace(last.region, sigma_mps=1.0))
        assert by_itself(Track(1, (*places.observations, shown), 7), moves)

    def test_trust_by_hand(self):
        half_known = Region(0, 0, 20, 20, 10, 10, 10.0, 0.5)
        track = Track(1, (observation(0.0, where=half_known),), seen=3)
        assert trust(track, None) == pytest.approx(3 / 12 * 0.5)
        # 1 m away, and at 10 px; two of three observations are 5 cm off, which is 0.5 px.
        uneven = self.track([(1.0, y) for y in [0.0, 0.05, -0.05] * 4])
        moves = movement(uneven)
        assert moves.residual == pytest.approx(0.05, rel=0.2)
        assert trust(uneven, moves) == pytest.approx(0.5, rel=0.1)


def frame(index, time_s):
    grey = np.zeros((HEIGHT, WIDTH), np.uint8)
    return StereoFrame(index, index, time_s, grey, grey)


def coming(depths_m, *, rig=RIG, poses=None, timed=True, columns=None):
    """Follow a square of 24 px at depths a tenth of a second apart; return its last state."""
    tracker, tracks = Tracker(Settings(), rig), Tracks()
    everywhere = np.full((HEIGHT, WIDTH), True)
    for index, depth_m in enumerate(depths_m):
        x = 68 if columns is None else columns[index]
        near = scene((x, 36, 24, 24, FB / depth_m))
        moment = frame(index, index / 10 if timed else None)
        regions = tracker.regions(near, everywhere)
        tracks, seen = tracker.follow(tracks, regions, moment.time, poses and poses[index])
    return seen


APPROACH_M = [4 - 0.1 * n for n in range(12)]


class TestTracker:
    def test_what_comes_closer_has_a_positive_speed_and_a_time(self):
        (thing,) = coming(APPROACH_M)
        assert (thing.id, thing.x, thing.y, thing.width, thing.height) == (1, 68, 36, 24, 24)
        assert thing.depth_m == pytest.approx(2.9)
        assert thing.closing_mps == pytest.approx(1.0)
        assert thing.time_to_contact_s == pytest.approx(2.9)
        assert thing.confidence == pytest.approx(1, abs=0.02)
        assert (thing.place_m, thing.velocity_mps) == (None, None)

    def test_what_goes_away_has_a_negative_speed_and_no_time(self):
        (thing,) = coming(APPROACH_M[::-1])
        assert thing.closing_mps == pytest.approx(-1.0)
        assert thing.time_to_contact_s is None

    def test_a_contact_a_long_time_away_is_none(self):
        (thing,) = coming([4 - 0.003 * n for n in range(12)])
        assert 0 < thing.closing_mps < 4 / MAX_CONTACT_S
        assert thing.time_to_contact_s is None

    def test_doffs_counts(self):
        rig = Rig(WIDTH, HEIGHT, 140, 0.12, 70.0, 47.5, doffs=2.0)
        (plain,) = coming([4 - 0.1 * n for n in range(12)])
        (shifted,) = coming([FB / (FB / z - 2) for z in APPROACH_M], rig=rig)
        assert shifted.depth_m == pytest.approx(plain.depth_m, rel=1e-4)
        assert shifted.closing_mps == pytest.approx(plain.closing_mps, rel=1e-3)

    def test_without_a_rig_the_time_is_known_alone(self):
        (thing,) = coming(APPROACH_M, rig=None)
        assert (thing.depth_m, thing.closing_mps) == (None, None)
        assert thing.time_to_contact_s == pytest.approx(2.9)

    def test_without_time_there_is_no_speed(self):
        (thing,) = coming(APPROACH_M, timed=False)
        assert thing.depth_m == pytest.approx(2.9)
        assert (thing.closing_mps, thing.time_to_contact_s) == (None, None)

    def test_it_is_told_from_the_third_frame_on_and_its_speed_from_the_sixth(self):
        counts = [len(coming(APPROACH_M[:n])) for n in (1, 2, 3)]
        assert counts == [0, 0, 1]
        assert coming(APPROACH_M[:5])[0].closing_mps is None
        assert coming(APPROACH_M[:6])[0].closing_mps == pytest.approx(1.0)

    def test_with_poses_the_way_of_the_camera_is_told_from_that_of_the_object(self):
        """The camera drives toward what stands, then toward what comes."""
        driving = [Pose(0.06 * n, 0, 0, 0, 0, 0, 1) for n in range(12)]
        (stands,) = coming([4 - 0.06 * n for n in range(12)], poses=driving)
        assert stands.closing_mps == pytest.approx(0.6)
        assert stands.velocity_mps == pytest.approx((0, 0), abs=0.02)
        assert stands.place_m == pytest.approx((4.0, -0.06), abs=0.01)  # before the right camera
        (comes,) = coming(APPROACH_M, poses=driving)
        assert comes.closing_mps == pytest.approx(1.0)
        assert comes.velocity_mps == pytest.approx((-0.4, 0), abs=0.02)

    def test_a_turn_of_the_camera_is_no_approach(self):
        """What stands 3 m away and 1 m to the left, while the camera turns left to face it."""
        turns = [0.02 * n for n in range(12)]
        ahead = [3 * math.cos(a) + 1 * math.sin(a) for a in turns]
        left = [-3 * math.sin(a) + 1 * math.cos(a) for a in turns]
        columns = [round(79.5 - 140 * y / x - 12) for x, y in zip(ahead, left, strict=True)]
        poses = [Pose(0, 0, 0, 0, 0, math.sin(a / 2), math.cos(a / 2)) for a in turns]
        assert coming(ahead, columns=columns)[0].closing_mps < -0.1
        (thing,) = coming(ahead, columns=columns, poses=poses)
        assert thing.closing_mps == pytest.approx(0, abs=0.05)

    def test_when_time_goes_back_it_begins_anew(self):
        tracker = Tracker(Settings(), RIG)
        everywhere = np.full((HEIGHT, WIDTH), True)
        times_s = [0.0, 0.1, 0.2, 0.1, 0.2, 0.3]
        regions = tracker.regions(scene((68, 36, 24, 24, 9)), everywhere)
        tracks, ids = Tracks(), []
        for n, time_s in enumerate(times_s):
            tracks, seen = tracker.follow(tracks, regions, frame(n, time_s).time)
            ids.append([one.id for one in seen])
        assert ids == [[], [], [1], [], [], [2]]


def test_the_table_to_the_letter(tmp_path):
    sink = OUTPUTS["objects"].open(tmp_path, RunContext(Fraction(1, 30), Settings(), None))
    more = {"velocity_mps": (0.0, 1.5), "sigma_mps": 0.25, "by_itself": True, "shadow": False}
    known = MovingObject(3, 0, 4, 8, 12, 2.71849, -0.00001, 12.5, 1 / 3, **more)
    unknown = MovingObject(12, 100, 4, 8, 12, None, None, None, 1.0)
    for index, seen in ((0, ()), (7, (known, unknown))):
        blind = Steering("blind", None, None, None, None)
        sink.write(Step(frame(index, None).time, blind, seen, None, charged=0, matched=0))
    assert [path.name for path in tmp_path.iterdir()] == ["objects.csv.part"]
    sink.close()
    assert (tmp_path / "objects.csv").read_bytes() == (
        b"frame,id,x,y,width,height,depth_m,closing_mps,time_to_contact_s,confidence,"
        b"over_ground_mps,direction_rad,sigma_mps,by_itself,shadow\n"
        b"7,3,0,4,8,12,2.718,0.000,12.500,0.33,1.500,1.571,0.250,1,0\n"
        b"7,12,100,4,8,12,,,,1.00,,,,,\n"
    )


@pytest.mark.parametrize("keep", [True, False])
def test_an_abandoned_table_never_gets_its_name(tmp_path, keep):
    sink = OUTPUTS["objects"].open(tmp_path, RunContext(Fraction(1, 30), Settings(), None))
    sink.abandon(keep=keep)
    assert [path.name for path in tmp_path.iterdir()] == (["objects.csv.part"] if keep else [])


def test_run_follows_a_square_that_slides_over_a_wall(tmp_path):
    """From images to the table: 2 px a frame to the right, at 12 px of disparity."""
    paint = np.random.default_rng(0).integers(0, 256, (2, 48, 40), np.uint8)
    paint = cv2.GaussianBlur(np.moveaxis(paint, 0, 2), (0, 0), 1.2)
    wall, square = cv2.normalize(paint, None, 0, 255, cv2.NORM_MINMAX).transpose(2, 0, 1)
    for side, shift in (("right", 0), ("left", 12)):
        (tmp_path / side).mkdir()
        for number in range(12):
            image = np.tile(wall, (2, 4))
            x = 30 + 2 * number + shift
            image[24:72, x : x + 40] = square
            assert cv2.imwrite(str(tmp_path / side / f"{number:03d}.png"), image)
    out = tmp_path / "out"
    given_paths = [str(tmp_path / side) for side in ("left", "right")]
    done = CliRunner().invoke(cli, ["run", *given_paths, "--save", "objects", "-o", str(out)])
    assert done.exit_code == 0, done.output
    with (out / "objects.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    # What the square uncovers has moved too: a row each, of the wall behind it.
    square_id = Counter(row["id"] for row in rows if int(row["width"]) > 30).most_common(1)[0][0]
    rows = [row for row in rows if row["id"] == square_id]
    assert [int(row["frame"]) for row in rows] == list(range(int(rows[0]["frame"]), 12))
    assert len(rows) >= 6
    last = rows[-1]
    x, y, width, height = (int(last[name]) for name in ("x", "y", "width", "height"))
    # The square, where it was in the last three frames, and a cell.
    assert 52 - 6 - 4 <= x <= 52
    assert 92 <= x + width <= 92 + 4
    assert 24 - 4 <= y <= 24
    assert 72 <= y + height <= 72 + 4
    assert (last["depth_m"], last["closing_mps"]) == ("", "")


def test_cards_are_followed_through_noise_and_h264(capsys):
    """The reach: speed within 15 %, no wrong sign, at most a switch per object in 100 frames."""
    settings = SimulateSettings(
        scene="cards", frames="0:60", width=320, height=214, noise_sigma=1.5
    )
    score = bench.measure(settings)
    assert len(score.errors) >= 20
    assert score.error < 0.15
    assert score.wrong_signs == 0
    assert score.switches_per_100 <= 1
    assert score.found > 0.6 * score.visible
    assert np.median(score.across_mps) < 0.1


def test_the_bench_prints_its_table(capsys):
    bench.main(["--frames", "0:40", "--width", "240"])
    table = capsys.readouterr().out.splitlines()
    assert [line.split("|")[1].strip() for line in table] == ["camera", "---", "still", "panning"]


@given(
    arrays(
        np.float64,
        st.tuples(st.integers(1, 4), st.integers(1, 5)),
        elements=st.one_of(st.just(1e6), st.floats(0, 3)),
    )
)
def test_tracks_and_regions_are_paired_at_the_least_cost(cost):
    pairs = assignment(cost)
    tall = cost if cost.shape[0] >= cost.shape[1] else cost.T
    rows, columns = tall.shape
    best = min(
        sum(tall[row, column] for column, row in enumerate(chosen))
        for chosen in itertools.permutations(range(rows), columns)
    )
    assert len(pairs) == columns
    assert len({row for row, _ in pairs}) == len({column for _, column in pairs}) == columns
    assert sum(cost[pair] for pair in pairs) == pytest.approx(best)


def test_shadows_on_the_floor_below_a_camera_lie_on_it():
    """A camera looks down from 2.7 m: a shadow lies on the floor, a head is 1 m above it."""
    near = np.full((HEIGHT, WIDTH), FB / 2.7, np.float32)
    moved = np.zeros(near.shape, np.bool_)
    moved[20:50, 20:50] = moved[60:90, 90:120] = True
    near[20:50, 20:50] = FB / 1.7
    tracker, tracks = Tracker(Settings(), RIG), Tracks()
    for n in range(3):
        tracks, seen = tracker.follow(tracks, tracker.regions(near, moved), frame(n, n / 10).time)
    marks = {round(each.depth_m, 1): each.shadow for each in seen}
    assert marks == {1.7: False, 2.7: True}


@pytest.mark.parametrize(
    ("opening", "deep_m", "marks"),
    [
        (0, 2.7, {True}),  # a shadow
        (0, 3.1, {True}),  # a reflection in the floor
        (60, 3.1, {False}),  # somebody in a doorway, behind whom it is 6 m
    ],
)
def test_only_a_surface_that_fills_the_view_has_nothing_behind_it(opening, deep_m, marks):
    """What was 1 m before the surface goes on as what lies on it, or deeper."""
    moved = np.zeros((HEIGHT, WIDTH), np.bool_)
    moved[20:50, 20:50] = True
    near = np.full(moved.shape, FB / 2.7, np.float32)
    near[:, 10 : 10 + opening] = FB / 6
    tracker, tracks, seen = Tracker(Settings(), RIG), Tracks(), []
    for n in range(12):
        near[moved] = FB / min(1.7 + 0.15 * n, deep_m)
        tracks, rows = tracker.follow(tracks, tracker.regions(near, moved), frame(n, n / 10).time)
        seen += rows
    assert {each.id for each in seen} == {1}
    assert {each.shadow for each in seen if each.depth_m < 2.1} == {False}
    assert {each.shadow for each in seen if each.depth_m > 2.65} == marks


def beside(labels, cells, gap, reach, jump_px, jump_share, min_near):
    """Rows of each region that are nearer than what is beside them, and as near, cell by cell."""
    counts = np.zeros((labels.max() + 1, 2), np.int32)
    for label in range(1, len(counts)):
        for row, owners in zip(cells, labels, strict=True):
            mine = np.flatnonzero(owners == label)
            if not len(mine):
                continue
            known = [x for x in range(len(row)) if owners[x] != label and not np.isnan(row[x])]
            left = [x for x in known if gap < mine[0] - x <= reach][-1:]
            right = [x for x in known if gap < x - mine[-1] <= reach][:1]
            ends = left + right
            if not ends:
                continue
            middle = (mine[0] + mine[-1]) / 2
            there = np.interp(middle, ends, [row[x] for x in ends])
            here = np.mean(row[mine], dtype=float)
            limit = max(jump_px, jump_share * here)
            counts[label, 0] += here - there > limit
            counts[label, 1] += abs(here - there) <= limit and here >= min_near
    return counts


@given(
    arrays(np.int32, (4, 24), elements=st.integers(0, 3)),
    arrays(np.float32, (4, 24), elements=st.sampled_from([NAN, 4, 6, 6.25, 8, 8.375, 9])),
    st.integers(0, 2),
    st.integers(2, 9),
)
def test_rows_are_compared_with_what_is_beside_them(labels, cells, gap, reach):
    labels[np.isnan(cells)] = 0
    count, limits = labels.max() + 1, (gap, reach, 0.5, 0.0625, 7.0)
    counts = np.empty((count, 2), np.int32)
    loops.compare_beside(labels, cells, *limits, np.empty((count, 4)), counts)
    np.testing.assert_array_equal(counts[1:], beside(labels, cells, *limits)[1:])


def test_shadows_on_a_wall_are_marked_and_cards_are_not():
    """Rendered cards that move before a wall, with their shadows on it."""
    rendered = SimulateSettings(
        scene="cards", frames="100:112", width=240, height=160, baseline_m=0.24, shadows=True
    )
    shots = render_scene(rendered)
    frames = [StereoFrame(n, n, n / 30, s.left, s.right) for n, s in enumerate(shots)]
    marks = Counter()
    for result in process(frames, rig=rendered.rig, extras=()):
        marks.update((each.depth_m > 6.5, each.shadow) for each in result.objects)
    assert marks[True, True] > 5
    assert marks[True, False] == marks[False, True] == 0
    assert marks[False, False] > 10


def moving(velocity_mps, moved, age_frames=0):
    """Velocities of cells with the age of those that moved."""
    age = np.where(moved[::CELL_PX, ::CELL_PX], np.float32(age_frames), NAN)
    return np.dstack([velocity_mps, age]).astype(np.float32)


@pytest.mark.parametrize(("top", "stands"), [(60, True), (4, False)])
def test_what_moves_by_itself_stands_on_ground(top, stands):
    rig = Rig(160, 120, 140.0, 0.12, 79.5, 59.5)
    disparity, moved = np.full((120, 160), NAN), np.zeros((120, 160), np.bool_)
    disparity[top : top + 24, 40:64] = 1.5
    moved[top : top + 24, 40:64] = True
    velocity_mps = np.full((30, 40, 5), np.float32([1, 0, 1, 1, 0]))
    found = Tracker(Settings(), rig).moving_regions(disparity, moving(velocity_mps, moved))
    assert [(each.x, each.y, each.width, each.height) for each in found] == (
        [(40, top, 24, 24)] if stands else []
    )
    assert all(each.middle_x == 51.5 and each.middle_y == top + 11.5 for each in found)
    still = moving(velocity_mps, np.zeros_like(moved))
    assert not Tracker(Settings(), rig).moving_regions(disparity, still)


@pytest.mark.parametrize("driven_m", [0.0, 0.1])
def test_the_velocity_of_a_region_is_the_median_of_its_cells(driven_m):
    """Half of the cells tell it, a fifth of these wrongly; the rig has turned left, and drives."""
    disparity, moved = np.full((HEIGHT, WIDTH), NAN), np.zeros((HEIGHT, WIDTH), np.bool_)
    disparity[40:80, 40:100] = 6
    moved[40:80, 40:100] = True
    disparity[40:80, 120:140] = 3  # beside it, but not of it
    moved[40:80, 120:140] = True
    velocity_mps = np.full((HEIGHT // 4, WIDTH // 4, 5), NAN)
    velocity_mps[10:20, 10:25:2] = (-0.5, 0.02, 1.0, 2.0, 0.1)
    velocity_mps[10:20, 10] = (3.0, 0.0, 4.0, 2.0, 0.1)
    tracker, tracks = Tracker(Settings(), RIG), Tracks()
    for number in range(2):
        found = tracker.moving_regions(disparity, moving(velocity_mps, moved))
        assert [each.velocity_mps for each in found] == [(1.0, 0.5)]
        # A tenth of a px in each of 80 cells, of which five show the same.
        assert found[0].sigma_mps == pytest.approx(0.2 / math.sqrt(80 / 5))
        assert found[0].age_s == pytest.approx(0.1)
        pose = Pose(0, driven_m * number, 0, 0, 0, math.sqrt(0.5), math.sqrt(0.5))
        tracks, seen = tracker.follow(tracks, found, FrameTime(number, number, number / 10), pose)
    assert seen[0].velocity_mps == pytest.approx((-0.5, 1.0))
    assert seen[0].closing_mps == pytest.approx(10 * driven_m - 1)


@pytest.mark.parametrize(
    ("sinks_mps", "ahead_mps", "count"),
    [(0.1, 2.0, 1), (0.3, 2.0, 0), (-0.3, 2.0, 0), (NAN, 2.0, 1), (0.01, 0.15, 0), (0.0, 0.15, 1)],
)
def test_what_leaves_the_ground_is_no_mover(sinks_mps, ahead_mps, count):
    """A speed that is not significant, 0.1 m/s times 2, has to be level all the more."""
    disparity, moved = np.full((HEIGHT, WIDTH), NAN), np.zeros((HEIGHT, WIDTH), np.bool_)
    disparity[40:60, 40:60] = 6
    moved[40:60, 40:60] = True
    velocity_mps = np.full((HEIGHT // 4, WIDTH // 4, 5), NAN)
    velocity_mps[10:15, 10:15] = (0.0, sinks_mps, ahead_mps, 2.0, 0.1)
    found = Tracker(Settings(), RIG).moving_regions(disparity, moving(velocity_mps, moved))
    assert len(found) == count


@pytest.mark.parametrize(
    ("beside_px", "speed_mps", "rows"),
    [
        (NAN, 1.0, [2, 3, 4, 5]),
        (4, 1.0, [2, 3, 4, 5]),
        (8, 1.0, [2, 3]),  # it lies on what is beside it
        (NAN, 20.0, [2, 3]),  # it may be anywhere
    ],
)
def test_what_is_remembered_goes_on_but_does_not_begin(beside_px, speed_mps, rows):
    """It is found in four frames; another thing never is, and is remembered all the same."""
    tracker, tracks, seen_in = Tracker(Settings(), RIG), Tracks(), []
    moved = np.zeros((HEIGHT, WIDTH), np.bool_)
    moved[40:60, 40:60] = True
    other = np.zeros_like(moved)
    other[40:60, 120:140] = True
    for number in range(6):
        disparity = np.full((HEIGHT, WIDTH), NAN)
        disparity[40:60, 20:80] = beside_px
        disparity[moved | other] = 8
        velocity_mps = np.full((HEIGHT // 4, WIDTH // 4, 5), NAN)
        if number < 4:
            velocity_mps[10:15, 10:15] = (0.0, 0.0, speed_mps, 0.1, 0.05)
        cells = moving(velocity_mps, moved, max(number - 3, 0))
        cells[10:15, 30:35, 5] = 3
        found = tracker.moving_regions(disparity, cells)
        pose = Pose(0, 0, 0, 0, 0, 0, 1)
        tracks, seen = tracker.follow(tracks, found, FrameTime(number, number, number / 10), pose)
        assert len(seen) <= 1
        seen_in += [number] * len(seen)
        assert all(each.x < 80 for each in seen)
        assert all(each.over_ground_mps == pytest.approx(speed_mps) for each in seen)
    assert seen_in == [1, *rows]


def test_a_mover_beside_nearer_ones_is_found():
    disparity, moved = np.full((HEIGHT, WIDTH), NAN), np.zeros((HEIGHT, WIDTH), np.bool_)
    disparity[40:60, 40:60] = 6
    disparity[40:60, 20:40] = disparity[40:60, 60:80] = 12
    moved[40:60, 20:80] = True
    velocity_mps = np.full((HEIGHT // 4, WIDTH // 4, 5), np.float32([2, 0, 2, 1, 0]))
    found = Tracker(Settings(), RIG).moving_regions(disparity, moving(velocity_mps, moved))
    assert sorted(each.nearness_px for each in found) == [6, 12, 12]


@pytest.mark.parametrize(("inner_px", "count"), [(6.6, 1), (10, 2)])
def test_a_part_of_what_moves_is_no_other_thing(inner_px, count):
    disparity, moved = np.full((HEIGHT, WIDTH), 6, np.float32), np.zeros((HEIGHT, WIDTH), np.bool_)
    moved[40:80, 40:100] = True
    disparity[:40] = disparity[80:] = disparity[:, :40] = disparity[:, 100:] = np.nan
    disparity[52:68, 60:76] = inner_px
    velocity_mps = np.full((HEIGHT // 4, WIDTH // 4, 5), np.float32([1, 0, 1, 1, 0]))
    found = Tracker(Settings(), RIG).moving_regions(disparity, moving(velocity_mps, moved))
    assert [each.width for each in found] == [60, 16][:count]


@pytest.mark.parametrize("behind_px", [9.8, 10.0, 10.9])
def test_things_that_pass_each_other_at_one_depth_stay_two(behind_px):
    """One crosses at 10 px of nearness before another that stands; they touch for 20 frames."""
    tracker, tracks, ids = Tracker(Settings(), RIG), Tracks(), []
    for index in range(30):
        near = scene((64, 24, 32, 32, min(behind_px, 10)), (4 * index, 40, 32, 40, 10))
        if behind_px > 10:
            near[24:56, 64:96] = behind_px
        found = tracker.regions(near, np.isfinite(near))
        time = FrameTime(index, index, index / 10)
        tracks, things = tracker.follow(tracks, found, time)
        if index >= 3:
            standing, crossing = sorted(things, key=lambda thing: thing.y)
            ids.append((standing.id, crossing.id))
            off = standing.x - 64, standing.width - 32, crossing.x - 4 * index, crossing.width - 32
            assert np.abs(off).max() <= 8
    assert len(set(ids)) == 1


def test_sigma_covers_the_error_of_speeds_where_things_cross():
    settings = SimulateSettings("cards", width=320, height=240, frames="36", noise_sigma=1.5)
    shots = list(render_scene(settings))
    frames = (StereoFrame(n, n, n / 30, shot.left, shot.right) for n, shot in enumerate(shots))
    results = process(frames, None, settings.rig, "auto", extras=())
    sigmas = [
        math.hypot(*np.subtract(row.velocity_mps, true.velocity_mps)) / row.sigma_mps
        for shot, result in zip(shots, results, strict=True)
        for row, true in itertools.product(result.objects, shot.objects)
        if row.velocity_mps is not None
        and bench.overlap((row.x, row.y, row.width, row.height), true) > 0.4
    ]
    assert len(sigmas) > 100
    assert np.mean(np.array(sigmas) < 2) > 0.85
