"""The way to a goal, on a map of what was seen recently.

It leads around what stands, and through what is not known where that is shorter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import grid as loops
from motionstereo_cli.robot.course import CLEARANCE_M, Course, free_distances, plan, wrapped
from motionstereo_cli.robot.grid import cells_within

#: Cost of a metre where nothing is known, next to what stands, and where the robot does not fit; it
#: is 1 on free floor that is farther from what stands than the robot's radius and this distance.
_UNKNOWN, _BESIDE, _BLOCKED = 2.0, 4.0, 30.0
_BESIDE_M = 0.4
#: How much more a metre costs within this distance of a place that the robot has looked at in vain,
#: such as a plain wall, on which nothing is matched.
_VAIN, _VAIN_M = 10.0, 0.7
#: Most rounds of fast sweeping; nothing changes any more long before.
_ROUNDS = 60
#: Length of the way that is returned, and how far ahead is looked to along it.
_AHEAD_M = 2.0
_TURN_M = 1.0
#: A direction is chosen for the least sum of the way left from a place on it, this share of the way
#: to that place, and so many m for each radian off the last heading.
_DRIVEN, _CHANGE_M = 0.8, 0.3
#: By how much the way left has to become less: as a rule, and for a robot that looks where the way
#: leads.
_NEARER_M, _SEEN_M = 0.3, 1.0
#: Clearance beside the robot, and least free distance unless the goal is nearer: as a rule, and
#: where there is no other way.
_CLEARANCES_M = (CLEARANCE_M, 0.9), (0.08, 0.5)
#: The robot has looked in vain once it has turned by the first angle to see where the way leads. A
#: frame counts as the second angle, at least. So many such places are kept.
_LOOK_RAD, _LEAST_RAD = math.radians(60), math.radians(4)
_MOST_VAIN = 12


class Route(NamedTuple):
    """The easiest way to a goal.

    Attributes:
        to_m: what the way from each cell costs, (nx, ny) float32: m, of free cells.
        way: the first metres from the robot, (n, 2) float64: places in cells.
    """

    to_m: NDArray[np.floating[Any]]
    way: NDArray[np.float64]


def toward(
    course: Course,
    yaw_rad: float,
    occupied: NDArray[np.bool_],
    free: NDArray[np.bool_],
    place: tuple[float, float],
    directions_rad: NDArray[np.float64],
    goal: tuple[float, float],
    *,
    corner: tuple[int, int],
    turned_rad: float,
    cell_m: float,
    radius_m: float,
) -> tuple[Course, float | None]:
    """Return the next course to a goal, and the free distance on it in m; None while it looks.

    It leads straight to where the goal is nearest, as far as cells are known to be free. Where the
    way leads through unknown cells, the robot turns to them; what it looks at in vain, it goes
    around.

    Args:
        course: the last one.
        yaw_rad: yaw of the robot in the world.
        occupied, free: cells known to be so, (nx, ny) bool; the rest is unknown.
        place: the robot's middle in cells along both axes.
        directions_rad: yaws along the axes of the cells, a full circle about the robot's, (n,).
        goal: the goal in cells; it may lie beyond the grid.
        corner: world cell of the grid's first one.
        turned_rad: how far the robot has turned since the last frame.
        cell_m: size of a cell in m.
        radius_m: radius of the robot in m.
    """
    vain = [(x - corner[0], y - corner[1]) for x, y in course.vain]
    found = route(occupied, free, place, goal, cell_m=cell_m, radius_m=radius_m, vain=vain)
    for beside_m, least_m in _CLEARANCES_M:
        free_m, possible_m = free_distances(
            *(occupied, free, place, directions_rad),
            cell_m=cell_m,
            radius_m=radius_m,
            beside_m=beside_m,
        )
        best = aim(
            *(found, place, free_m, directions_rad),
            cell_m=cell_m,
            least_m=least_m,
            heading_rad=course.heading_rad,
            looking=course.look != 0,
        )
        if best is not None:
            # As long as it turns there, it still moves straight on.
            ahead_m = possible_m[int(np.argmin(np.abs(wrapped(directions_rad - yaw_rad))))]
            heading_rad = float(directions_rad[best])
            course = replace(
                course, heading_rad=heading_rad, travel_rad=heading_rad, look=0, looked_rad=0.0
            )
            return course, float(min(free_m[best], ahead_m))
    # At the goal there is no way: it stays as it is.
    on_way_rad = ahead(found.way, place, cell_m) if len(found.way) else yaw_rad
    looked_rad = course.looked_rad + max(abs(turned_rad), _LEAST_RAD) if course.look else 0.0
    if looked_rad >= _LOOK_RAD:
        unknown = first_unknown(found.way, occupied, free)
        if unknown is None:
            return plan(
                *(course, yaw_rad, free_m, possible_m, directions_rad),
                turned_rad=turned_rad,
                goal_rad=on_way_rad,
            )
        x, y = unknown
        looked_rad = 0.0
        course = replace(course, vain=(*course.vain, (x + corner[0], y + corner[1]))[-_MOST_VAIN:])
    side = math.remainder(on_way_rad - yaw_rad, math.tau)
    look = course.look or (1 if side > 0 else -1)
    return replace(course, heading_rad=on_way_rad, look=look, looked_rad=looked_rad), None


def route(
    occupied: NDArray[np.bool_],
    free: NDArray[np.bool_],
    place: tuple[float, float],
    goal: tuple[float, float],
    *,
    cell_m: float,
    radius_m: float,
    vain: Sequence[tuple[float, float]] = (),
) -> Route:
    """Return the easiest way to a goal.

    It may lead through what stands if nothing else does: what stands may be a wrong match.

    Args:
        occupied, free: cells known to be so, (nx, ny) bool; the rest is unknown.
        place: the robot's middle, in cells along both axes.
        goal: the goal, likewise; it may lie beyond the grid.
        cell_m: size of a cell in m.
        radius_m: radius of the robot in m.
        vain: places that the robot has looked at and learnt nothing, in cells.
    """
    away_m = cv2.distanceTransform((~occupied).astype(np.uint8), cv2.DIST_L2, 5) * cell_m
    beside = (1 - (away_m - radius_m) / _BESIDE_M).clip(0, 1)
    unknown = np.full(occupied.shape, _UNKNOWN)
    for each in vain:
        unknown[cells_within(occupied.shape, each, _VAIN_M, cell_m)] += _VAIN
    cost = np.where(free, 1.0, unknown) + (_BESIDE - 1) * beside
    cost = np.where(away_m < radius_m, _BLOCKED, cost).astype(np.float32)
    to = np.full(occupied.shape, np.inf, np.float32)
    inside = all(0 <= at < size for at, size in zip(goal, occupied.shape, strict=True))
    if inside:
        to[int(goal[0]), int(goal[1])] = 0
    else:
        edge = np.ones(occupied.shape, np.bool_)
        edge[1:-1, 1:-1] = False
        x, y = np.nonzero(edge)
        to[x, y] = np.hypot(x + 0.5 - goal[0], y + 0.5 - goal[1]) + cost[x, y]
    loops.ways_to(cost, to, _ROUNDS)
    cells = np.empty((math.ceil(_AHEAD_M / cell_m), 2), np.int32)
    count = loops.downhill(to, int(place[0]), int(place[1]), cells)
    return Route(to * np.float32(cell_m), cells[:count] + np.float64(0.5))


def aim(
    found: Route,
    place: tuple[float, float],
    free_m: NDArray[np.float64],
    directions_rad: NDArray[np.float64],
    *,
    cell_m: float,
    least_m: float,
    heading_rad: float,
    looking: bool,
) -> int | None:
    """Return which direction leads straight to where the goal is nearest, None if none is nearer.

    Args:
        found: the way to the goal.
        place: the robot's middle in cells.
        free_m: free distances, see :func:`~motionstereo_cli.robot.course.free_distances`.
        directions_rad: their yaws along the axes of the cells.
        cell_m: size of a cell in m.
        least_m: directions with less free distance only count if they lead to the goal.
        heading_rad: the last heading, which is kept where another is hardly better.
        looking: whether it turns to see where the way leads; then small gains do not count.
    """
    to_m = found.to_m
    step_m = np.arange(cell_m, free_m.max() + cell_m, cell_m)
    if not len(step_m):
        return None
    x, y = (
        np.floor(at + np.outer(part(directions_rad), step_m / cell_m)).astype(np.intp)
        for at, part in zip(place, (np.cos, np.sin), strict=True)
    )
    inside = (x >= 0) & (x < to_m.shape[0]) & (y >= 0) & (y < to_m.shape[1])
    left_m = np.where(inside, to_m[x % to_m.shape[0], y % to_m.shape[1]], np.inf)
    can = (step_m <= free_m[:, None]) & ((free_m[:, None] >= least_m) | (left_m < cell_m))
    cost_m = np.where(can, left_m + _DRIVEN * step_m, np.inf)
    cost_m += _CHANGE_M * np.abs(wrapped(directions_rad - heading_rad))[:, None]
    best, step = np.unravel_index(int(cost_m.argmin()), cost_m.shape)
    here_m = to_m[int(place[0]), int(place[1])]
    nearer_m = _SEEN_M if looking else _NEARER_M
    if here_m >= cell_m:  # the goal itself is near enough, even where it is nearer than that
        nearer_m = min(nearer_m, here_m - cell_m)
    return int(best) if can[best, step] and left_m[best, step] < here_m - nearer_m else None


def ahead(way: NDArray[np.float64], place: tuple[float, float], cell_m: float) -> float:
    """Return the yaw of what lies a little ahead on a way, along the axes of the cells.

    Args:
        way: places in cells, (n, 2), one at least.
        place: the robot's middle in cells.
        cell_m: size of a cell in m.
    """
    x_m, y_m = ((way - place) * cell_m).T
    far = np.flatnonzero(np.hypot(x_m, y_m) >= _TURN_M)
    there = far[0] if len(far) else -1
    return math.atan2(y_m[there], x_m[there])


def first_unknown(
    way: NDArray[np.float64], occupied: NDArray[np.bool_], free: NDArray[np.bool_]
) -> tuple[float, float] | None:
    """Return the first place on a way of which nothing is known, in cells.

    None if something stands before it, or there is none.

    Args:
        way: places in cells, (n, 2).
        occupied, free: cells known to be so, (nx, ny) bool; the rest is unknown.
    """
    x, y = way.astype(np.intp).T
    closed = np.flatnonzero(~free[x, y])
    if not len(closed) or occupied[x[closed[0]], y[closed[0]]]:
        return None
    there_x, there_y = way[closed[0]]
    return float(there_x), float(there_y)
