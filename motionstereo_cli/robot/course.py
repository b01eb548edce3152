"""The course of a robot with known poses, on a map of what it has seen recently.

It heads for its goal where the way there is free, else for the direction with the longest free way.
For guidance by single images, see :mod:`~motionstereo_cli.robot.free_space`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import grid as loops
from motionstereo_cli.robot.grid import cells_within


def steadied(before: float | None, target: float, gain: float) -> float:
    """Return the heading moved from the last one toward a target by a share ``gain``, 0..1."""
    return target if before is None else before + gain * (target - before)


#: Candidate directions about the robot's yaw: a full circle, in steps of 3 degrees.
_STEP_RAD = math.radians(3)
DIRECTIONS_RAD = np.radians(np.arange(-180, 180, 3, dtype=np.float64))

#: Limit of distances: beyond it depth is too uncertain, and the map ends at 8 m.
_LONGEST_M = 7.0
_STEP_M = 0.05
#: Clearance beside the robot, and how fast it has to grow where it is less.
CLEARANCE_M = 0.2
_WIDENING = 0.35
#: Half the width of the strip that has to be free; beside it nothing may be occupied.
_KNOWN_M = 0.15

#: Free distance that offsets a radian away from the direction of travel, or the last heading.
_TRAVEL_COST_M = 1.0
_CHANGE_COST_M = 0.5
#: Directions farther from the direction of travel lead back.
_BACK_RAD = math.radians(100)
#: Free distance that offsets a radian away from the way to a goal.
_GOAL_COST_M = 0.5
#: Free distances below the first are blocked: the robot looks around until one exceeds the second.
_MIN_FREE_M = 0.9
_FOUND_FREE_M = 1.5
_AHEAD_RAD = math.radians(35)
#: After looking around by this angle without success, the direction back is allowed.
_LOOK_RAD = math.radians(540)
#: The same where nothing that is known closes the way ahead in so many directions.
_OPEN_RAD, _LOOK_LONGER_RAD = math.radians(30), math.radians(720)
#: The same where somebody walks.
_WAIT_RAD = math.radians(1080)
#: How far a rig has turned is looked at over the first number of frames, what it was asked to do
#: over the second, as it may be late. In each it turns by the angle that it is asked, at most.
TURN_FRAMES, ASKED_FRAMES = 8, 12
#: Distance over which the direction of travel follows the robot.
_TRAVEL_M = 2.5


@dataclass(frozen=True, slots=True)
class Course:
    """The course of a moving robot.

    Attributes:
        heading_rad: its heading, as a yaw in the world.
        travel_rad: yaw of its recent path.
        look: 1 while it turns left to look around, -1 to the right, 0 while it has a heading.
        looked_rad: angle turned while looking around.
        vain: what it has looked at on its way to a goal, and learnt nothing: places in cells of the
            world.
    """

    heading_rad: float
    travel_rad: float
    look: int = 0
    looked_rad: float = 0.0
    vain: tuple[tuple[float, float], ...] = ()


def free_distances(
    occupied: NDArray[np.bool_],
    free: NDArray[np.bool_],
    place: tuple[float, float],
    directions_rad: NDArray[np.float64],
    *,
    cell_m: float,
    radius_m: float,
    beside_m: float = CLEARANCE_M,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how far a round robot can drive in each direction, (n,) float64 m.

    First the distance that is known to be free, second the distance without a known obstacle.

    Args:
        occupied, free: cells known to be so, (nx, ny) bool; the rest is unknown.
        place: the robot's middle in cells along both axes.
        directions_rad: yaws along the axes of the cells, (n,).
        cell_m: size of a cell in m.
        radius_m: radius of the robot in m.
        beside_m: clearance beside it; less is wanted where it starts with less.
    """
    # The robot's own place is free.
    here = cells_within(occupied.shape, place, radius_m, cell_m)
    to_occupied, to_unknown = (
        cv2.distanceTransform((cells | here).astype(np.uint8), cv2.DIST_L2, 5) * np.float32(cell_m)
        for cells in (~occupied, free)
    )
    step = np.arange(_STEP_M, _LONGEST_M + _STEP_M, _STEP_M)
    clearance_m = float(to_occupied[int(place[0]), int(place[1])])
    wanted_m = np.minimum(radius_m + beside_m, max(clearance_m - cell_m, 0) + _WIDENING * step)
    known, possible = np.empty((2, len(directions_rad)), np.int32)
    loops.free_ways(
        *(to_occupied, to_unknown, *place, np.cos(directions_rad), np.sin(directions_rad), step),
        *(cell_m, wanted_m, np.minimum(_KNOWN_M, 0.15 * step), known, possible),
    )
    return known * np.float64(_STEP_M), possible * np.float64(_STEP_M)


def plan(
    course: Course,
    yaw_rad: float,
    free_m: NDArray[np.float64],
    possible_m: NDArray[np.float64],
    directions_rad: NDArray[np.float64],
    *,
    turned_rad: float,
    goal_rad: float | None = None,
    walks: bool = False,
) -> tuple[Course, float | None]:
    """Return the next course and the free distance on it in m, None while looking around.

    Args:
        course: the last one.
        yaw_rad: yaw of the robot in the world.
        free_m, possible_m: free distances, see :func:`free_distances`.
        directions_rad: their yaws in the world.
        turned_rad: how far the robot has turned since the last frame.
        goal_rad: yaw in the world of the way to a goal, if there is one.
        walks: whether somebody may walk there.
    """
    looked_rad = course.looked_rad + abs(turned_rad) if course.look else 0.0
    from_travel = np.abs(wrapped(directions_rad - course.travel_rad))
    smooth_m = np.mean([np.roll(free_m, k) for k in (-2, -1, 0, 1, 2)], axis=0)
    worth = np.minimum(free_m, smooth_m) - _TRAVEL_COST_M * from_travel
    worth -= _CHANGE_COST_M * np.abs(wrapped(directions_rad - course.heading_rad))
    if goal_rad is not None:
        worth -= _GOAL_COST_M * np.abs(wrapped(directions_rad - goal_rad))
    # A short free distance is enough to continue, but not to turn to.
    ahead = (np.abs(wrapped(directions_rad - yaw_rad)) <= _AHEAD_RAD) & (course.look == 0)
    allowed = free_m >= np.where(ahead, _MIN_FREE_M, _FOUND_FREE_M)
    ahead_rad = _STEP_RAD * np.count_nonzero(
        (possible_m >= _FOUND_FREE_M) & (from_travel <= _BACK_RAD)
    )
    look_rad = _LOOK_RAD if ahead_rad < _OPEN_RAD else _LOOK_LONGER_RAD
    if looked_rad < (_WAIT_RAD if walks else look_rad):
        allowed &= from_travel <= _BACK_RAD
    if allowed.any():
        best = int(np.argmax(np.where(allowed, worth, -np.inf)))
        heading_rad = float(directions_rad[best])
        # The way back is the new direction of travel: it does not lead back again.
        turns_back = bool(from_travel[best] > _BACK_RAD)
        travel_rad = heading_rad if turns_back else course.travel_rad
        return replace(
            course, heading_rad=heading_rad, travel_rad=travel_rad, look=0, looked_rad=0.0
        ), float(free_m[best])
    look = course.look or _side_to_look(possible_m, directions_rad, course.travel_rad)
    heading_rad = yaw_rad + look * math.pi / 2
    return replace(course, heading_rad=heading_rad, look=look, looked_rad=looked_rad), None


def travelled(course: Course, forward_m: float, direction_rad: float) -> Course:
    """Return the course after a piece of path: the direction of travel follows it.

    Args:
        course: the last one.
        forward_m: length of the piece in m.
        direction_rad: its yaw in the world.
    """
    share = min(1.0, forward_m / _TRAVEL_M)
    off_rad = math.remainder(direction_rad - course.travel_rad, math.tau)
    travel_rad = course.travel_rad + share * off_rad
    return replace(course, travel_rad=travel_rad)


def taken_along(course: Course, yaws_rad: Sequence[float], asked_rad: Sequence[float]) -> Course:
    """Return the course of a rig that turns away from it, as it was not asked to: it turns along.

    Somebody drives it, and knows more of the way, such as which way to go at a corner. A robot that
    does what it is asked, perhaps late, turns toward its course, or a little too far.

    Args:
        course: the last one.
        yaws_rad: yaws of the rig in the world in the last frames, up to this one.
        asked_rad: angles that it was asked to turn by in these and earlier frames.
    """
    yaw_rad = yaws_rad[-1]
    off_rad = math.remainder(yaw_rad - course.heading_rad, math.tau)
    side = math.copysign(1.0, off_rad)
    turned_rad, last_rad = (
        side * math.remainder(yaw_rad - yaws_rad[-n], math.tau) for n in (len(yaws_rad), 2)
    )
    its_own_rad = sum(max(0.0, side * each) for each in asked_rad)
    if course.look or last_rad <= 0 or turned_rad <= its_own_rad:
        return course
    along_rad = side * min(last_rad, abs(off_rad))
    return replace(
        course,
        heading_rad=course.heading_rad + along_rad,
        travel_rad=course.travel_rad + along_rad,
    )


def wrapped(angle_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return angles as -pi..pi."""
    return (angle_rad + math.pi) % math.tau - math.pi


def _side_to_look(
    possible_m: NDArray[np.float64], directions_rad: NDArray[np.float64], travel_rad: float
) -> int:
    """Return 1 if more may be free to the left of the path than to its right, else -1."""
    off = wrapped(directions_rad - travel_rad)
    left = possible_m[(off > 0.3) & (off < 2.2)].sum()
    right = possible_m[(off < -0.3) & (off > -2.2)].sum()
    return 1 if left >= right else -1
