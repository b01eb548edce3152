"""What the robot remembers of its surroundings: a small map that moves along and fades.

A grid in the world's directions, centred on the robot. Each cell holds *evidence*: positive =
occupied, negative = free, near 0 = unknown. What is unknown is neither free nor occupied. A point
seen in some direction makes its own cell occupied and those before it free, as in occupancy grids
with an inverse sensor model (Thrun, Burgard and Fox, Probabilistic Robotics, chapter 9). Evidence
halves in :data:`HALF_LIFE_FRAMES`, because an object that moves on leaves no sign.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float32]

CELL_M = 0.1
#: Cells along one side of the map: 16 m.
CELLS = 160
HALF_LIFE_FRAMES = 50

#: Evidence of one frame, and the most that is kept. A cell counts as free or occupied beyond
#: CERTAIN: after two frames or more.
_HIT = 0.5
_MISS = -0.5
_MOST = 4.0
CERTAIN = 0.7

#: How far points of the map around the robot are marked as occupied.
_HIT_REACH_M = 6.0
#: Errors of a disparity, in px, that a free cell and an occupied place allow for.
_FREE_ERROR_PX = 1.0
_HIT_ERROR_PX = 0.5

#: A bearing's nearness is that of its nearest pixels but for these.
_MIN_PIXELS = 4
_NEARER_SHARE = 0.1

#: Bearings without points are bridged: up to this angle as free, up to this length as occupied.
_BRIDGED_RAD = math.radians(10)
_BRIDGED_M = 1.5


@dataclass(frozen=True, slots=True)
class LocalMap:
    """The map.

    Attributes:
        evidence: (CELLS, CELLS) float32, axis 0 along the world's x, axis 1 along its y.
        corner: world cell of ``evidence[0, 0]``; world cell i spans i..i+1 times CELL_M.
    """

    evidence: Reals
    corner: tuple[int, int]

    @classmethod
    def unknown(cls, x_m: float, y_m: float) -> LocalMap:
        """Return an empty map around a place."""
        return cls(np.zeros((CELLS, CELLS), np.float32), _corner(x_m, y_m))


@dataclass(frozen=True, slots=True)
class FloorView:
    """A camera on the floor plane.

    Attributes:
        x_m, y_m: its place in the world.
        yaw_rad: its heading.
        focal_px, focal_y_px: focal lengths along x and y.
        cx_px, cy_px: principal point.
        focal_baseline: focal length in px times baseline in m.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    focal_px: float
    focal_y_px: float
    cx_px: float
    cy_px: float
    focal_baseline: float


def profile(
    nearness_px: Reals,
    fresh: NDArray[np.bool_],
    view: FloorView,
    *,
    bearings: int,
    below_m: float,
    above_m: float,
) -> Reals:
    """Return how near the nearest object is in each bearing, (bearings,) float32 px, NaN = unknown.

    A bearing is a range of columns of equal width. Its nearness is such that a tenth of its
    points, but at least four, are as near.

    Args:
        nearness_px: disparity + doffs, (height, width) float32, NaN = unknown.
        fresh: pixels that show where objects are now, (height, width) bool.
        view: the camera.
        bearings: number of bearings.
        below_m, above_m: points farther below or above the camera are no obstacles.
    """
    width = nearness_px.shape[1]
    with np.errstate(invalid="ignore"):
        row, column = np.nonzero(fresh & (nearness_px > 0))
    near = nearness_px[row, column]
    up_m = (view.cy_px - row) * (view.focal_baseline / view.focal_y_px) / near
    in_way = (up_m > -below_m) & (up_m < above_m)
    return nearest_by_bearing(near[in_way], column[in_way] * bearings // width, bearings)


def nearest_by_bearing(near_px: Reals, bearing: NDArray[np.intp], bearings: int) -> Reals:
    """Return the nearness in each bearing, as :func:`profile` has it, (bearings,) float32 px.

    Args:
        near_px: nearness of points that are obstacles, (n,) float32.
        bearing: the bearing of each, 0 to ``bearings`` - 1, (n,).
        bearings: number of bearings.
    """
    order = np.lexsort((-near_px, bearing))
    count = np.bincount(bearing, minlength=bearings)
    first = np.cumsum(count) - count
    rank = np.maximum(_MIN_PIXELS, np.ceil(_NEARER_SHARE * count).astype(np.int64)) - 1
    enough = rank < count
    result = np.full(bearings, np.nan, np.float32)
    result[enough] = near_px[order][(first + rank)[enough]]
    return result


def moved(known: LocalMap, x_m: float, y_m: float) -> LocalMap:
    """Return the map with its middle at a place: what falls off its edge is forgotten."""
    corner = _corner(x_m, y_m)
    evidence = np.zeros_like(known.evidence)
    spans = []
    for axis in (0, 1):
        shift = corner[axis] - known.corner[axis]
        low, high = max(shift, 0), min(CELLS + shift, CELLS)
        if low >= high:
            return LocalMap(evidence, corner)
        spans.append((slice(low - shift, high - shift), slice(low, high)))
    (to_x, from_x), (to_y, from_y) = spans
    evidence[to_x, to_y] = known.evidence[from_x, from_y]
    return LocalMap(evidence, corner)


def seen(known: LocalMap, near_px: Reals, view: FloorView, width: int) -> LocalMap:
    """Return the map a frame later, with what a camera has seen in it.

    Args:
        known: the map.
        near_px: profile of the frame, (bearings,) float32 px, NaN = unknown.
        view: the camera.
        width: width of its images in px.
    """
    free, hit = sighted(
        known.evidence.shape,
        known.corner,
        near_px,
        view,
        width,
        cell_m=CELL_M,
        reach_m=_HIT_REACH_M,
        error_px=_HIT_ERROR_PX,
    )
    evidence = known.evidence * np.float32(0.5 ** (1 / HALF_LIFE_FRAMES))
    evidence[free] += np.float32(_MISS)
    # What comes into a place that was free for long is believed as soon as anything.
    evidence[hit] = np.maximum(evidence[hit], 0) + np.float32(_HIT)
    return LocalMap(evidence.clip(-_MOST, _MOST), known.corner)


def sighted(
    shape: tuple[int, ...],
    corner: tuple[int, int],
    near_px: Reals,
    view: FloorView,
    width: int,
    *,
    cell_m: float,
    reach_m: float,
    error_px: float,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which cells of a grid a camera sees through, and in which it sees something.

    Args:
        shape: number of cells along the world's x and y.
        corner: world cell of the first.
        near_px: profile of the frame, (bearings,) float32 px, NaN = unknown.
        view: the camera.
        width: width of its images in px.
        cell_m: size of a cell.
        reach_m: farther points are too uncertain to be marked; the space up to them is free.
        error_px: error of a disparity that an occupied place allows for.

    Returns:
        Both of the given shape.
    """
    bridged, solid = _bridged(near_px, view, width)
    ahead, leftward = _camera_frame(shape, corner, view, cell_m)
    with np.errstate(divide="ignore", invalid="ignore"):
        column = view.cx_px - view.focal_px * leftward / ahead
        bearing = np.floor((column + 0.5) * len(near_px) / width)
    inside = (ahead > cell_m) & (bearing >= 0) & (bearing < len(near_px))
    bearing = np.where(inside, bearing, 0).astype(np.intp)
    near = np.where(inside, bridged[bearing], np.float32(np.nan))
    with np.errstate(divide="ignore", invalid="ignore"):
        # Depth errors grow with the square of depth: a disparity's error is the same everywhere.
        off_px = np.abs(view.focal_baseline / ahead - near)
        depth_m = view.focal_baseline / near
        free = ahead < view.focal_baseline / (near + _FREE_ERROR_PX)
        hit = (off_px < error_px) | (np.abs(ahead - depth_m) < 0.75 * cell_m)
        hit &= (depth_m < reach_m) & solid[bearing]
    return free, hit


def disc(known: LocalMap, x_m: float, y_m: float, radius_m: float) -> NDArray[np.bool_]:
    """Return the cells within a radius of a place in the world, (CELLS, CELLS) bool."""
    x, y = (
        (np.arange(CELLS) + known.corner[axis] + 0.5) * CELL_M - place
        for axis, place in ((0, x_m), (1, y_m))
    )
    inside: NDArray[np.bool_] = np.hypot(x[:, None], y) <= radius_m
    return inside


def _corner(x_m: float, y_m: float) -> tuple[int, int]:
    return (
        math.floor(x_m / CELL_M) - CELLS // 2,
        math.floor(y_m / CELL_M) - CELLS // 2,
    )


def _camera_frame(
    shape: tuple[int, ...], corner: tuple[int, int], view: FloorView, cell_m: float
) -> tuple[Reals, Reals]:
    """Return how far ahead and leftward of the camera each cell's middle is, in m."""
    x, y = (
        ((np.arange(shape[axis]) + corner[axis] + 0.5) * cell_m - place).astype(np.float32)
        for axis, place in ((0, view.x_m), (1, view.y_m))
    )
    cos, sin = np.float32(math.cos(view.yaw_rad)), np.float32(math.sin(view.yaw_rad))
    ahead: Reals = cos * x[:, None] + sin * y
    leftward: Reals = cos * y - sin * x[:, None]
    return ahead, leftward


def _bridged(near_px: Reals, view: FloorView, width: int) -> tuple[Reals, NDArray[np.bool_]]:
    """Return the profile with short gaps filled, and where it is dense enough to be a surface.

    A plane is linear in disparity: between two points a wall runs in a straight line.
    """
    bearing = np.arange(len(near_px))
    points = np.flatnonzero(~np.isnan(near_px))
    if not len(points):
        return near_px, np.zeros(len(near_px), np.bool_)
    after = np.searchsorted(points, bearing).clip(0, len(points) - 1)
    before = np.maximum(np.where(points[after] == bearing, after, after - 1), 0)
    low, high = points[before], points[after]
    near = np.interp(bearing, points, near_px[points])
    pixels = width / len(near_px)
    gap_rad = (high - low) * pixels / view.focal_px
    between = (low <= bearing) & (bearing <= high) & (gap_rad <= _BRIDGED_RAD)
    depth_low, depth_high = (view.focal_baseline / near_px[ends] for ends in (low, high))
    gap_m = np.hypot(depth_high - depth_low, gap_rad * (depth_low + depth_high) / 2)
    solid: NDArray[np.bool_] = between & (gap_m <= _BRIDGED_M)
    return np.where(between, near, np.nan).astype(np.float32), solid
