"""The way to a goal on a grid."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from motionstereo_cli.compiled import grid as loops
from motionstereo_cli.robot.course import DIRECTIONS_RAD, Course
from motionstereo_cli.robot.route import first_unknown, route, toward

CELL_M, RADIUS_M, SIZE = 0.1, 0.25, 80


@given(st.integers(0, 2**32 - 1))
def test_each_cell_costs_what_its_neighbours_make_it(seed):
    """The equation that fast sweeping solves, cell by cell; a goal costs nothing."""
    rng = np.random.default_rng(seed)
    cost = rng.choice(np.array([1, 2, 30], np.float32), (12, 9), p=(0.6, 0.2, 0.2))
    goal = int(rng.integers(12)), int(rng.integers(9))
    to = np.full(cost.shape, np.inf, np.float32)
    to[goal] = 0
    loops.ways_to(cost, to, 60)
    beyond = np.pad(to.astype(float), 1, constant_values=np.inf)
    a = np.minimum(beyond[:-2, 1:-1], beyond[2:, 1:-1])
    b = np.minimum(beyond[1:-1, :-2], beyond[1:-1, 2:])
    apart = np.abs(np.where(np.isinf(a) | np.isinf(b), np.inf, a - b))
    both = (a + b + np.sqrt(np.maximum(2 * cost**2 - np.minimum(apart, 1e3) ** 2, 0))) / 2
    wanted = np.where(apart < cost, both, np.minimum(a, b) + cost)
    wanted[goal] = 0
    assert to == pytest.approx(wanted, abs=0.01)


def test_on_free_ground_the_way_is_straight():
    cost = np.ones((60, 60), np.float32)
    to = np.full(cost.shape, np.inf, np.float32)
    to[30, 20] = 0
    loops.ways_to(cost, to, 60)
    x, y = np.indices(cost.shape)
    assert to == pytest.approx(np.hypot(x - 30, y - 20), rel=0.03, abs=1.2)


def room(door=None, wall=40):
    """A room of 8 m with a wall across it, and its free cells; the door: cells of the wall."""
    occupied = np.zeros((SIZE, SIZE), bool)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    occupied[wall] = True
    if door:
        occupied[wall, door[0] : door[1]] = False
    return occupied, ~occupied


def driven(occupied, known, goal, place=(20.0, 20.0), frames=150):
    """Drive as a robot that sees all within 2.5 m before it, but for cells that are never known.

    Return its path in cells and whether it came to the goal.
    """
    course, yaw_rad, turned_rad, path = Course(0.0, 0.0), 0.0, 0.0, [place]
    seen = np.zeros(occupied.shape, bool)
    x, y = np.indices(occupied.shape) + 0.5
    for _ in range(frames):
        place = path[-1]
        away_m = np.hypot(x - place[0], y - place[1]) * CELL_M
        off = np.arctan2(y - place[1], x - place[0]) - yaw_rad
        inside = np.abs((off + math.pi) % math.tau - math.pi) < 0.5
        seen |= known & ((inside & (away_m < 2.5)) | (away_m < 0.4))
        course, free_m = toward(
            *(course, yaw_rad, occupied & seen, ~occupied & seen, place),
            *(yaw_rad + DIRECTIONS_RAD, goal),
            corner=(-3, 5),
            turned_rad=turned_rad,
            cell_m=CELL_M,
            radius_m=RADIUS_M,
        )
        turned_rad = math.remainder(course.heading_rad - yaw_rad, math.tau)
        turned_rad = max(-0.2, min(0.2, turned_rad))
        yaw_rad += turned_rad
        if free_m is not None and abs(turned_rad) < 0.2:
            step = min(free_m, 0.15) / CELL_M
            place = place[0] + step * math.cos(yaw_rad), place[1] + step * math.sin(yaw_rad)
        path.append(place)
        if math.dist(place, goal) * CELL_M < 0.5:
            break
    path = np.array(path)
    assert not occupied[tuple(path.astype(int).T)].any()
    return path, math.dist(path[-1], goal) * CELL_M < 0.5


@pytest.mark.parametrize("door", [(20, 32), (34, 45), (60, 72)])
def test_finds_a_door_and_goes_through_it(door):
    occupied, _ = room(door)
    path, reached = driven(occupied, np.ones_like(occupied), (65.5, 20.5))
    assert reached
    through = path[np.argmin(np.abs(path[:, 0] - 40.5)), 1]
    assert door[0] + 2 < through < door[1] - 2


def test_goes_around_a_wall_that_is_never_known():
    """Such as a plain one, on which nothing is matched."""
    occupied, _ = room((60, 72))
    known = np.ones_like(occupied)
    known[38:44, 12:28] = False
    path, reached = driven(occupied, known, (65.5, 20.5), frames=250)
    assert reached
    assert path[:, 1].max() > 60


def test_a_goal_beyond_the_grid_is_headed_for():
    occupied, free = np.zeros((2, SIZE, SIZE), bool)
    to_m, way = route(occupied, free, (40, 40), (140, 40), cell_m=CELL_M, radius_m=RADIUS_M)
    assert np.isfinite(to_m).all()
    assert (np.diff(way[:, 0]) >= 0).all()
    assert np.abs(way[:, 1] - 40).max() < 4


def once(occupied, free, goal, *, place=(40.5, 40.5), look=0, radius_m=RADIUS_M):
    """The course and free distance after one frame of a robot that turned to 0.3 rad."""
    return toward(
        *(Course(0.3, 0.3, look), 0.3, occupied, free, place, 0.3 + DIRECTIONS_RAD, goal),
        corner=(0, 0),
        turned_rad=0.0,
        cell_m=CELL_M,
        radius_m=radius_m,
    )


@pytest.mark.parametrize("radius_m", [0.05, 0.25])
@pytest.mark.parametrize("stands", [False, True])
def test_where_nothing_is_known_to_be_free_it_looks(radius_m, stands):
    """Even if it is smaller than a cell and stands at its corner."""
    occupied = np.full((SIZE, SIZE), stands)
    course, free_m = once(
        *(occupied, np.zeros_like(occupied), (70.5, 40.0)), place=(40.0, 40.0), radius_m=radius_m
    )
    assert free_m is None
    assert course.look != 0


@pytest.mark.parametrize("look", [0, 1])
@pytest.mark.parametrize("ahead", [6, 9])
def test_a_goal_near_by_on_free_ground_is_driven_to(look, ahead):
    free = np.ones((SIZE, SIZE), bool)
    course, free_m = once(~free, free, (40.5 + ahead, 40.5), look=look)
    assert free_m > ahead * CELL_M
    assert course.heading_rad == pytest.approx(0, abs=0.3)


def test_at_the_goal_it_keeps_its_heading():
    free = np.ones((SIZE, SIZE), bool)
    course, free_m = once(~free, free, (40.5, 40.5))
    assert (course.heading_rad, free_m) == (0.3, None)


def test_a_goal_in_what_stands_is_headed_for():
    free = np.ones((SIZE, SIZE), bool)
    free[60:70, 35:46] = False
    course, free_m = once(~free, free, (65.5, 40.5))
    assert free_m > 1
    assert abs(course.heading_rad) < 0.6


def test_the_first_unknown_place_of_a_way_is_not_one_behind_a_wall():
    occupied, free = room()
    way = np.array([[20.5, 20.5], [40.5, 20.5], [41.5, 20.5]])
    assert first_unknown(way, occupied, free) is None
    free[20, 20] = False
    assert first_unknown(way, occupied, free) == (20.5, 20.5)
    assert first_unknown(way[:0], occupied, free) is None
