"""The local map: a small map that moves with the robot and fades.

A grid in the world's directions, centred on the robot. Each cell holds *evidence*: positive =
occupied, negative = free, near 0 = unknown. A point seen in some direction makes its own cell
occupied and those before it free, as in occupancy grids with an inverse sensor model (Thrun,
Burgard and Fox, Probabilistic Robotics, chapter 9). Evidence halves in :data:`HALF_LIFE_FRAMES`,
because objects may move away unseen.

A camera looks over low objects nearby. So a cell also holds the height of its object, and is not
made free by a line of sight that passes above it. What is seen of its upper side from farther off
is occupied, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import free_space as loops
from motionstereo_cli.compiled import reused
from motionstereo_cli.robot.grid import FloorView, Reals, sighted, window

CELL_M = 0.1
#: Cells along one side of the map: 16 m.
CELLS = 160
HALF_LIFE_FRAMES = 50
#: The same where a robot has a goal, and plans its way by what it has passed.
GOAL_HALF_LIFE_FRAMES = 200

#: Evidence of one frame, and its limit. A cell counts as free or occupied beyond
#: CERTAIN: after two frames or more.
_HIT = 0.5
_MISS = -0.5
_MOST = 4.0
CERTAIN = 0.7

#: Evidence of one frame, at least, that is not freed again.
ONE_HIT = 0.3
#: A cell has been free for long below this evidence. Where something enters so many such cells,
#: within so many cells of the middle along both axes, somebody walks there, and is expected to for
#: so many frames more.
_LONG_FREE, _ENTERED, _AROUND, _WALKS_FRAMES = -2.0, 3, 30, 50

#: Distance from the robot up to which points are marked as occupied.
_HIT_REACH_M = 6.0
#: Tolerance of disparity, in px, for occupied cells.
_HIT_ERROR_PX = 0.5

#: Nearest pixels of a bearing that are ignored: a share, and a number.
_MIN_PIXELS = 4
_NEARER_SHARE = 0.1

#: What lies within this share of the nearest nearness in a bearing, or this many px, is of one
#: thing, whose top is that of all its points but this share.
_ONE_THING_SHARE, _ONE_THING_PX = 0.1, 1.0
_HIGHER_SHARE = 0.1
#: How far low things may reach beyond what was seen of them.
_LOW_THING_M = 0.35
_LOW_THING = cv2.getStructuringElement(
    cv2.MORPH_ELLIPSE, (2 * round(_LOW_THING_M / CELL_M) + 1,) * 2
)
#: Evidence from which on a thing is believed to stand where no view reaches it; one that rises less
#: than this length above what is no obstacle may be the floor, wrongly matched, and needs more.
_SURE, _SURE_IF_LOW, _LOW_M = 0.9, 2.0, 0.25
#: Beyond this distance it is taken for floor, which beside the edge of a wall has the wall's depth.
_LOW_REACH_M = 3.5
#: The upper side of a low thing: as near its top as this, nearer than this, without a longer gap.
_LEVEL_M, _LEVEL_REACH_M, _LEVEL_GAP_M = 0.12, 4.0, 0.45
#: How far above the top of a thing a sight has to pass to be said to pass over it.
_TOP_ERROR_M = 0.1


@dataclass(frozen=True, slots=True)
class LocalMap:
    """The map.

    Attributes:
        evidence: (CELLS, CELLS) float32, axis 0 along the world's x, axis 1 along its y.
        top_m: (CELLS, CELLS) float32, height above the cameras of what stands in the cell.
        corner: world cell of ``evidence[0, 0]``; world cell i spans i..i+1 times CELL_M.
        walks_frames: number of further frames in which somebody is expected to walk there; 0 =
            nobody.
    """

    evidence: Reals
    top_m: Reals
    corner: tuple[int, int]
    walks_frames: int = 0

    @classmethod
    def unknown(cls, x_m: float, y_m: float) -> LocalMap:
        """Return an empty map around a place."""
        nothing = np.zeros((CELLS, CELLS), np.float32)
        return cls(nothing, nothing, _corner(x_m, y_m))

    def cells_of(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Return a place in the world in cells along both axes."""
        return x_m / CELL_M - self.corner[0], y_m / CELL_M - self.corner[1]


class Bearings(NamedTuple):
    """The nearest obstacle in each bearing, a range of columns of equal width.

    Attributes:
        near_px: its nearness, (bearings,) float32 px, NaN = unknown.
        top_m: height of its top above the camera, as far as it is in the way, (bearings,) float32.
        far_m: how far ahead its upper side ends, (bearings,) float32; 0 where none is seen.
    """

    near_px: Reals
    top_m: Reals
    far_m: Reals


def profile(
    nearness_px: Reals,
    fresh: NDArray[np.bool_],
    view: FloorView,
    *,
    bearings: int,
    below_m: float,
    above_m: float,
) -> Bearings:
    """Return the nearest obstacle in each bearing.

    A tenth of the bearing's points, but at least four, are as near as its nearness.

    Args:
        nearness_px: disparity + doffs, (height, width) float32, NaN = unknown.
        fresh: pixels that show the present, (height, width) bool.
        view: the camera.
        bearings: number of bearings.
        below_m, above_m: points farther below or above the camera are no obstacles.
    """
    height, width = nearness_px.shape
    things: Any = loops.Things(  # type: ignore[call-arg]
        *(view.cy_px, view.focal_baseline / view.focal_y_px, view.focal_baseline),
        *(below_m, above_m, _NEARER_SHARE, _MIN_PIXELS, _ONE_THING_SHARE, _ONE_THING_PX),
        *(_HIGHER_SHARE, _LOW_M - below_m, -_LEVEL_M, _LEVEL_M, CELL_M, _LEVEL_GAP_M),
    )
    points = height * -(-width // bearings)
    work: Any = reused(loops.Workspace, bearings, points, round(_LEVEL_REACH_M / CELL_M))
    found = Bearings(*np.empty((3, bearings), np.float32))
    loops.profile(nearness_px, fresh.view(np.uint8), things, work, *found)
    return found


def ranked_by_bearing(
    values: Reals, bearing: NDArray[np.intp], bearings: int, *, share: float, least: int = 1
) -> Reals:
    """Return a high value of each bearing, (bearings,) float32, NaN where there are too few.

    Args:
        values: (n,) float32.
        bearing: the bearing of each, 0 to ``bearings`` - 1, (n,).
        bearings: number of bearings.
        share: share of a bearing's values that are as high or higher.
        least: as many are, at least.
    """
    # By bearing, then from the highest down, as whole numbers: their sort is several times faster.
    bits = values.view(np.int32)
    rising = (bits ^ (bits >> 31 & 0x7FFFFFFF)).astype(np.int64)
    keys = np.sort(bearing.astype(np.int64) << 32 | (0x7FFFFFFF - rising))
    count = np.bincount(bearing, minlength=bearings)
    first = np.cumsum(count) - count
    rank = np.maximum(least, np.ceil(share * count).astype(np.int64)) - 1
    enough = rank < count
    result = np.full(bearings, np.nan, np.float32)
    found = (0x7FFFFFFF - (keys[(first + rank)[enough]] & 0xFFFFFFFF)).astype(np.int32)
    result[enough] = (found ^ (found >> 31 & 0x7FFFFFFF)).view(np.float32)
    return result


def nearest_by_bearing(near_px: Reals, bearing: NDArray[np.intp], bearings: int) -> Reals:
    """Return the nearness in each bearing, as :func:`profile` has it, (bearings,) float32 px.

    Args:
        near_px: nearness of points that are obstacles, (n,) float32.
        bearing: the bearing of each, 0 to ``bearings`` - 1, (n,).
        bearings: number of bearings.
    """
    return ranked_by_bearing(near_px, bearing, bearings, share=_NEARER_SHARE, least=_MIN_PIXELS)


def moved(known: LocalMap, x_m: float, y_m: float) -> LocalMap:
    """Return the map with its middle at a place; what is beyond its edge is dropped."""
    corner = _corner(x_m, y_m)
    evidence, top_m = (
        window(each, known.corner, corner, each.shape) for each in (known.evidence, known.top_m)
    )
    return replace(known, evidence=evidence, top_m=top_m, corner=corner)


def seen(
    known: LocalMap,
    found: Bearings,
    view: FloorView,
    size: tuple[int, int],
    below_m: float,
    half_life: int = HALF_LIFE_FRAMES,
) -> LocalMap:
    """Return the map after a frame, with what a camera has seen.

    Args:
        known: the map.
        found: profile of the frame.
        view: the camera.
        size: width and height of its images in px.
        below_m: as of the profile.
        half_life: number of frames in which evidence halves.
    """
    width, height = size
    sight = sighted(
        known.evidence.shape,
        known.corner,
        found.near_px,
        view,
        width,
        cell_m=CELL_M,
        reach_m=_HIT_REACH_M,
        error_px=_HIT_ERROR_PX,
        far_m=found.far_m,
    )
    evidence = known.evidence * np.float32(0.5 ** (1 / half_life))
    # The lowest row passes over what is lower and near.
    lowest_m = sight.ahead_m * np.float32((view.cy_px - (height - 1)) / view.focal_y_px)
    low_m = np.float32(_LOW_M - below_m)
    needed = np.where(known.top_m < low_m, _SURE_IF_LOW, _SURE)
    passed_over = (evidence > needed) & (known.top_m < lowest_m + np.float32(_TOP_ERROR_M))
    # Behind its front it is assumed to be as low, and its end is not visible from here.
    beside = cv2.dilate(passed_over.astype(np.uint8), _LOW_THING).astype(np.bool_)
    passed_over |= beside & (np.abs(evidence) < CERTAIN)
    evidence[sight.free & ~passed_over] += np.float32(_MISS)
    top_m = _filled(found.top_m)[sight.bearing]
    hit = sight.hit & ((top_m >= low_m) | (sight.ahead_m < _LOW_REACH_M))
    top_m = np.where(evidence > 0, (known.top_m + top_m) / 2, top_m)
    around = (slice(CELLS // 2 - _AROUND, CELLS // 2 + _AROUND),) * 2
    entered = np.count_nonzero((hit & (evidence < _LONG_FREE))[around]) >= _ENTERED
    walks_frames = _WALKS_FRAMES if entered else max(known.walks_frames - 1, 0)
    # An object that enters a long-free cell is believed as soon as any other.
    evidence[hit] = np.maximum(evidence[hit], 0) + np.float32(_HIT)
    top_m = np.where(hit, top_m, known.top_m)
    evidence = evidence.clip(-_MOST, _MOST)
    return LocalMap(evidence, top_m, known.corner, walks_frames)


def _corner(x_m: float, y_m: float) -> tuple[int, int]:
    return (
        math.floor(x_m / CELL_M) - CELLS // 2,
        math.floor(y_m / CELL_M) - CELLS // 2,
    )


def _filled(values: Reals) -> Reals:
    """Return values with NaN interpolated between the others; 0 where there are none."""
    at = np.flatnonzero(~np.isnan(values))
    if not len(at):
        return np.zeros_like(values)
    return np.interp(np.arange(len(values)), at, values[at]).astype(np.float32)
