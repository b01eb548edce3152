"""Grids of the floor plane, and what a camera sees of them.

World cell i of a grid spans i..i+1 times the size of its cells; axis 0 is along the world's x, axis
1 along its y. The local map and the fused map are such grids: they differ in what evidence means.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import grid as loops

Reals = NDArray[np.float32]

_Number = TypeVar("_Number", bound=np.generic)

#: Tolerance of disparity, in px, for free cells.
_FREE_ERROR_PX = 1.0

#: Bearings without points are interpolated: up to this angle as free, up to this length as
#: occupied. Straight ahead, between points that are far, little shifts in the images while the rig
#: drives there, and a wider gap may be free.
_BRIDGED_RAD = math.radians(10)
_BRIDGED_AHEAD_RAD, _FAR_M = math.radians(20), 6.0
_BRIDGED_M = 1.5


def window(
    cells: NDArray[_Number],
    corner: Sequence[int] | NDArray[np.int64],
    new_corner: Sequence[int] | NDArray[np.int64],
    shape: Sequence[int] | NDArray[np.int64],
) -> NDArray[_Number]:
    """Return the cells of a grid in another rectangle, 0 where it has none.

    Args:
        cells: (nx, ny).
        corner: world cell of the first of them.
        new_corner, shape: world cell of the first of the rectangle, and its numbers of cells.
    """
    found = np.zeros(shape, cells.dtype)
    low = np.maximum(corner, new_corner)
    high = np.minimum(np.add(corner, cells.shape), np.add(new_corner, shape))
    if (low < high).all():
        to, of = (
            tuple(slice(*ends) for ends in zip(low - first, high - first, strict=True))
            for first in (new_corner, corner)
        )
        found[to] = cells[of]
    return found


def cells_within(
    shape: tuple[int, ...], place: tuple[float, float], radius_m: float, cell_m: float
) -> NDArray[np.bool_]:
    """Return the cells whose middle is within a radius of a place, (nx, ny).

    Args:
        shape: number of cells along both axes.
        place: in cells along both axes.
        radius_m: the radius.
        cell_m: size of a cell.
    """
    inside, reach = np.zeros(shape, np.bool_), radius_m / cell_m + 1
    low, high = (
        [min(max(int(at + off), 0), size) for at, size in zip(place, shape, strict=True)]
        for off in (-reach, reach + 1)
    )
    x, y = (np.arange(a, b) + 0.5 - at for a, b, at in zip(low, high, place, strict=True))
    near = np.hypot(x[:, None], y) * cell_m <= radius_m
    inside[low[0] : high[0], low[1] : high[1]] = near
    return inside


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


class Sight(NamedTuple):
    """What a camera sees of a grid, of the grid's shape each.

    Attributes:
        free: cells that it sees through, bool.
        hit: cells in which it sees something, bool.
        bearing: in which bearing a cell lies, 0 where in none, int.
        ahead_m: how far ahead of the camera a cell lies, float32.
    """

    free: NDArray[np.bool_]
    hit: NDArray[np.bool_]
    bearing: NDArray[np.intp]
    ahead_m: Reals


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
    far_m: Reals | None = None,
) -> Sight:
    """Return the cells of a grid that a camera sees through, and those in which it sees something.

    Args:
        shape: number of cells along the world's x and y.
        corner: world cell of the first.
        near_px: profile of the frame, (bearings,) float32 px, NaN = unknown.
        view: the camera.
        width: width of its images in px.
        cell_m: size of a cell.
        reach_m: farther points are too uncertain to be marked; the space up to them is free.
        error_px: error of a disparity that an occupied place allows for.
        far_m: as of the profile: what it sees onto is occupied up to there.
    """
    bridged, solid = _bridged(near_px, view, width)
    x_m, y_m = (
        ((np.arange(count) + first + 0.5) * cell_m - place).astype(np.float32)
        for count, first, place in zip(shape, corner, (view.x_m, view.y_m), strict=True)
    )
    camera: Any = loops.FloorCamera(  # type: ignore[call-arg]
        *(math.cos(view.yaw_rad), math.sin(view.yaw_rad), view.cx_px, view.focal_px),
        *(view.focal_baseline, width, cell_m, reach_m, error_px, _FREE_ERROR_PX, 0.75 * cell_m),
    )
    far_m = np.zeros_like(bridged) if far_m is None else far_m
    free, hit = np.empty((2, *shape), np.bool_)
    sight = Sight(free, hit, np.empty(shape, np.intp), np.empty(shape, np.float32))
    loops.sight(
        *(x_m, y_m, camera, bridged, solid.view(np.uint8), far_m, np.empty(shape[1], np.float32)),
        *(free.view(np.uint8), hit.view(np.uint8), sight.bearing, sight.ahead_m),
    )
    return sight


def _bridged(near_px: Reals, view: FloorView, width: int) -> tuple[Reals, NDArray[np.bool_]]:
    """Return the profile with short gaps filled, and where it is dense enough for a surface.

    A plane is linear in disparity, so a wall between two points is interpolated linearly.
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
    depth_low, depth_high = (view.focal_baseline / near_px[ends] for ends in (low, high))
    ahead = view.cx_px / pixels
    is_far_ahead = (low <= ahead) & (ahead <= high) & (np.minimum(depth_low, depth_high) > _FAR_M)
    most_rad = np.where(is_far_ahead, _BRIDGED_AHEAD_RAD, _BRIDGED_RAD)
    between = (low <= bearing) & (bearing <= high) & (gap_rad <= most_rad)
    gap_m = np.hypot(depth_high - depth_low, gap_rad * (depth_low + depth_high) / 2)
    solid: NDArray[np.bool_] = between & (gap_rad <= _BRIDGED_RAD) & (gap_m <= _BRIDGED_M)
    return np.where(between, near, np.nan).astype(np.float32), solid
