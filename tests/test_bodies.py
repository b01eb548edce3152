"""Parts of one body are one object, and bodies that pass each other are two."""

from itertools import pairwise

import numpy as np
import pytest

from motionstereo_cli.method.settings import Settings
from motionstereo_cli.robot.objects import CELL_PX, Region
from motionstereo_cli.robot.tracker import Tracker, Tracks
from motionstereo_cli.types import FrameTime, Rig

RIG = Rig(width=640, height=400, focal_px=480, baseline_m=0.1, cx=319.5, cy=199.5)
FLOOR_M = 2.7
SIZE_PX = 40


def part(across_m, down_m, ahead_m, floor_m=None):
    """A square region around a place from the camera."""
    x, y = (480 * of / ahead_m for of in (across_m, down_m))
    near_px, floor_px = 48 / ahead_m, None if floor_m is None else 48 / floor_m
    middle_x, middle_y = x + 319.5, y + 199.5
    left, top = (round((middle - SIZE_PX / 2) / CELL_PX) for middle in (middle_x, middle_y))
    cells = np.full((2, SIZE_PX // CELL_PX, SIZE_PX // CELL_PX), near_px, np.float32)
    cells[0] = 1
    box = left * CELL_PX, top * CELL_PX, SIZE_PX, SIZE_PX
    known = {"known": 1.0, "nearer": 9, "surface_px": floor_px, "cells": cells}
    return Region(*box, middle_x, middle_y, near_px, **known)


def rows_of(frames, *, timed=True):
    """Follow regions, 20 frames a second; the rows of each frame."""
    tracker, tracks, rows = Tracker(Settings(reference="left"), RIG), Tracks(), []
    for n, regions in enumerate(frames):
        moment = FrameTime(n, n, n / 20 if timed else None)
        tracks, seen = tracker.follow(tracks, regions, moment)
        rows.append(seen)
    return rows


def ids(rows):
    return [[each.id for each in seen] for seen in rows]


def walk(count, *starts, mps=1.0, floor_m=None):
    """Places that move on across the view together."""
    return [
        [part(x + mps * n / 20, y, ahead, floor_m) for x, y, ahead in starts] for n in range(count)
    ]


HEAD, SHOULDER, OTHER_SHOULDER = (0.0, 0.0, 1.0), (-0.1, 0.2, 1.3), (-0.1, -0.25, 1.32)


class TestFromAbove:
    def test_head_and_shoulders_are_one_object_after_six_frames(self):
        frames = walk(9, SHOULDER, HEAD, OTHER_SHOULDER, floor_m=FLOOR_M)
        rows = rows_of(frames)
        assert ids(rows) == [[]] * 2 + [[1, 2, 3]] * 3 + [[1]] * 4
        (row,) = rows[-1]
        assert row.depth_m == pytest.approx(1.0)
        boxes = [(r.x, r.y, r.x + r.width, r.y + r.height) for r in frames[-1]]
        corners = np.array(boxes)
        around = (*corners[:, :2].min(axis=0), *corners[:, 2:].max(axis=0))
        assert (row.x, row.y, row.x + row.width, row.y + row.height) == around

    def test_what_is_left_of_a_body_keeps_its_id(self):
        frames = walk(12, SHOULDER, HEAD, floor_m=FLOOR_M)
        frames[9:] = [each[1:] for each in frames[9:]]
        assert ids(rows_of(frames))[8:] == [[1]] * 4

    def test_a_surface_that_is_not_seen_in_every_frame_is_the_floor_all_the_same(self):
        frames = walk(9, SHOULDER, HEAD, floor_m=FLOOR_M)
        frames[5:] = walk(9, SHOULDER, HEAD)[5:]
        assert ids(rows_of(frames))[-1] == [1]

    @pytest.mark.parametrize("other", [(0.0, 0.6, 1.0), (0.55, 0.0, 1.3)])
    def test_two_beside_each_other_are_two(self, other):
        assert ids(rows_of(walk(12, HEAD, other, floor_m=FLOOR_M)))[-1] == [1, 2]

    def test_two_that_pass_each_other_closely_are_two(self):
        one, other = (
            walk(12, (x, y, 1.1), mps=mps, floor_m=FLOOR_M)
            for x, y, mps in ((-0.2, 0.0, 0.6), (0.2, 0.3, -0.6))
        )
        frames = [a + b for a, b in zip(one, other, strict=True)]
        assert all(each == [1, 2] for each in ids(rows_of(frames))[2:])

    def test_those_who_part_are_two_again(self):
        frames = walk(8, HEAD, (0.0, 0.4, 1.0), floor_m=FLOOR_M)
        frames += [
            [part(0.35, -0.04 * n, 1.0, FLOOR_M), part(0.35, 0.4 + 0.04 * n, 1.0, FLOOR_M)]
            for n in range(12)
        ]
        found = ids(rows_of(frames))
        assert found[7] == [1]
        assert found[-1] == [1, 2]
        counts = [len(each) for each in found[7:]]
        assert all(a <= b for a, b in pairwise(counts))

    def test_a_crowd_is_not_one_body(self):
        """Each is within half a metre of the next, and the ends are far apart."""
        row = [(0.0, 0.4 * n - 0.8, 1.2) for n in range(5)]
        assert len(ids(rows_of(walk(14, *row, floor_m=FLOOR_M)))[-1]) >= 2

    def test_without_times_nothing_is_joined(self):
        rows = rows_of(walk(9, SHOULDER, HEAD, floor_m=FLOOR_M), timed=False)
        assert ids(rows)[-1] == [1, 2]


class TestAhead:
    def test_what_is_above_the_other_at_one_place_is_one_object(self):
        """As trunk and legs, however far apart in the image."""
        assert ids(rows_of(walk(9, (0.0, -0.6, 3.0), (0.1, 0.6, 3.2))))[-1] == [1]

    @pytest.mark.parametrize("wall_m", [None, 7.0])
    def test_what_is_behind_the_other_is_another(self, wall_m):
        frames = walk(12, (0.0, 0.3, 3.0), (0.1, -0.3, 3.7), floor_m=wall_m)
        assert ids(rows_of(frames))[-1] == [1, 2]
