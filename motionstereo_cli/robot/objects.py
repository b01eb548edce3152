"""Moving objects: regions of fresh motion, followed from frame to frame.

A region is a connected patch of fresh disparity without a jump inside it. Each frame's regions
are assigned to known objects at the least total cost (the Hungarian method).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import checked_array
from motionstereo_cli.compiled import objects as loops
from motionstereo_cli.robot.assignment import assignment

Reals = NDArray[np.float32]

#: Side of the cells of regions in px, which is the resolution of their boxes.
CELL_PX = 4
#: Share of known pixels from which a cell is known.
_MIN_SHARE = 0.125
#: Maximum difference of nearness between neighbouring cells of a region: the larger of these.
#: Within a cell, it limits the standard deviation.
_JUMP_PX = 0.5
_JUMP_SHARE = 0.03
#: Gaps of twice this many cells are bridged.
_GAP_CELLS = 2
#: A region with nearer neighbours on more than the first share of its sides is background, unless
#: it has farther ones on the second.
_BEHIND_SHARE, _BEFORE_SHARE = 0.5, 0.1
#: Where nearness was larger before by the larger of these, and this within so many frames, what is
#: seen was hidden then.
_HIDDEN_PX, _HIDDEN_SHARE = 1.0, 0.06
_SOON_FRAMES = 3

#: What is beside a row of a region is known within the second number of cells, but for the first.
_BESIDE_GAP, _BESIDE_CELLS = 1, 7
#: Below this nearness, depths that differ by more than half a metre at 7 m look alike.
_MIN_ALIKE_PX = 7.0
#: An object whose rows can be compared lies on what is beside it, if no larger share is nearer.
_MIN_COMPARED, _NEARER_ROWS = 4, 0.2

#: Search range of an object about its expected position, in its sizes, and as a factor of nearness.
_MAX_SIZES = 1.0
_MAX_FACTOR = 1.3
#: Its path in the image is extrapolated from its last observations, but no farther than they span:
#: objects that disappear have often just come to rest.
WAY_SIGHTINGS = 5
#: So many of its last observations are kept.
KEPT = 12
#: An object is dropped after it was out of sight for this many frames.
_MAX_MISSED = 30
#: An observation shows an object's usual area if it differs by at most this share.
_USUAL_SHARE = 0.15

#: Of velocities by single frames: fewest cells that tell one; cells whose patches overlap; least
#: standard deviation of a change of disparity; so many standard deviations are significant.
_MIN_CELLS, _CELLS_ALIKE = 3, 5.0
_CELL_SIGMA_PX, _SIGMAS = 0.1, 2.0
#: It moves along the ground: by a single frame it rises or sinks by no larger share of its speed,
#: or of a speed that is not significant.
_SLOPE, _LEAST_SLOPE = 0.1, 0.03
#: Standard deviation over median absolute deviation of what is normally distributed.
NORMAL = 1.4826


@dataclass(frozen=True, slots=True)
class Region:
    """A connected patch of the image that has just moved, at about one depth.

    Attributes:
        x, y, width, height: its box in px, upper left corner first, to :data:`CELL_PX`.
        middle_x, middle_y: mean place of its pixels in px.
        nearness_px: median of disparity + doffs in it.
        known: share of its pixels whose disparity is known and fresh, 0..1.
        before: frames before that it is known to have moved in.
        velocity_mps: over ground, ahead and to the left of the camera; None where it is not
            measured in this frame alone.
        sigma_mps: standard deviation of that.
        age_s: how long before the frame it moved so.
        nearer, level: rows of cells that are nearer than what is known beside them, and rows that
            are as near.
        moves: whether it is found to move in this frame, or is remembered from the last ones.
        surface_px: up to which nearness one surface reaches that fills the view; None if none does.
        cells: known share and nearness in px of the cells of its box, and their velocity if it is
            measured, (2 or 8, height / 4, width / 4) float32, NaN = not in it; None in an
            :class:`Observation`.
    """

    x: int
    y: int
    width: int
    height: int
    middle_x: float
    middle_y: float
    nearness_px: float
    known: float
    before: int = 0
    velocity_mps: tuple[float, float] | None = None
    sigma_mps: float = math.inf
    age_s: float = 0.0
    nearer: int = 0
    level: int = 0
    moves: bool = True
    surface_px: float | None = None
    cells: Reals | None = field(default=None, compare=False, repr=False)

    @property
    def on_surface(self) -> bool:
        """Whether it lies on the surface that fills the view, or deeper, as a reflection in it."""
        return self.surface_px is not None and self.nearness_px <= self.surface_px


@dataclass(frozen=True, slots=True)
class Observation:
    """An object in one frame.

    Attributes:
        time_s: time in s.
        region: its region in the image.
        offset_m: from the camera to it, along the x and y axes of the world.
        place_m: its position in the world, x and y.
        velocity_mps: over ground along these axes, by this frame alone; None if unknown.
        ends_m: from its place to the left end of its box and to the right one, x, y, x, y.
    """

    time_s: float
    region: Region
    offset_m: tuple[float, float]
    place_m: tuple[float, float]
    velocity_mps: tuple[float, float] | None = None
    ends_m: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Track:
    """A followed object.

    Attributes:
        number: its number.
        observations: the last frames that it was seen in, oldest first.
        seen: frames that it has been found to move in.
        missed: frames since it was last seen; 0 = it is in the last frame.
        part_of: the number of the oldest part of its body; None = it has not been compared.
    """

    number: int
    observations: tuple[Observation, ...]
    seen: int = 1
    missed: int = 0
    part_of: int | None = None

    @property
    def body(self) -> int:
        """The number of the body that it belongs to."""
        return self.number if self.part_of is None else self.part_of


def regions(
    nearness_px: Reals,
    fresh: NDArray[np.bool_],
    min_share: float,
    velocity_mps: Reals | None = None,
) -> tuple[Region, ...]:
    """Return the regions of an image that may be objects.

    Regions that reach from the left border of the image to the right one are left out and, without
    velocities, background, as of a turning camera.

    Args:
        nearness_px: disparity + doffs, (height, width) float32, NaN = unknown.
        fresh: where something has just moved, (height, width) bool.
        min_share: share of the image, 0..1, that a region has to have.
        velocity_mps: of cells over ground, (rows or more, columns or more, 6), as
            :func:`~motionstereo_cli.robot.movers.see` has it.
    """
    share, cells = _in_cells(nearness_px, fresh)
    bridged = _bridged(cells)
    count, labels = _labelled(bridged)
    known = _around(cells, nearness_px)
    wanted = np.ones(count, np.bool_)
    if velocity_mps is None:
        behind, before, sides = _neighbours(labels, bridged, known, count)
        wanted = (behind <= _BEHIND_SHARE * sides) | (before > _BEFORE_SHARE * sides)
    labels[np.isnan(cells)] = 0
    size, boxes = _boxes(labels, count)
    wanted &= size >= min_share * cells.size
    wanted &= boxes[:, 2] - boxes[:, 0] < cells.shape[1]
    wanted[0] = False  # the unknown
    measured = [share[None], cells[None]]
    if velocity_mps is not None:
        rows, columns = cells.shape
        measured.append(np.moveaxis(velocity_mps[:rows, :columns], -1, 0))
    each = np.concatenate(measured)
    beside = np.empty((count, 2), np.int32)
    loops.compare_beside(
        *(np.ascontiguousarray(labels), known, _BESIDE_GAP, _BESIDE_CELLS, _JUMP_PX, _JUMP_SHARE),
        *(_MIN_ALIKE_PX, np.empty((count, 4)), beside),
    )
    numbers = np.flatnonzero(wanted).tolist()
    found = ((_region(labels, n, boxes[n].tolist(), each), *beside[n].tolist()) for n in numbers)
    return tuple(replace(region, nearer=near, level=level) for region, near, level in found)


def uncovered(
    disparity_px: Reals,
    fresh: NDArray[np.bool_],
    earlier: Sequence[NDArray[np.uint16]],
    parts_per_px: int,
    doffs_px: float,
) -> NDArray[np.bool_]:
    """Return where something changed because what was before it moved on, (height, width) bool.

    Args:
        disparity_px: (height, width) float32, NaN = unknown.
        fresh: where something has just moved, (height, width) bool.
        earlier: disparity in the last frames, in parts of a px, (height, width), 0 = unknown.
        parts_per_px: these parts.
        doffs_px: nearness less disparity.
    """
    before = np.zeros(fresh.shape, np.uint16)
    for each in earlier:
        loops.take_larger(checked_array(each, np.uint16, fresh.shape), before)
    result = np.empty(fresh.shape, np.bool_)
    loops.hidden_before(
        checked_array(disparity_px, np.float32, fresh.shape),
        *(checked_array(fresh, np.bool_).view(np.uint8), before),
        *(parts_per_px, doffs_px, _HIDDEN_PX, _HIDDEN_SHARE, result.view(np.uint8)),
    )
    where = np.flatnonzero(result)
    after = [disparity_px.ravel()[where]]
    hidden_px = np.maximum(
        np.float32(_HIDDEN_PX), np.float32(_HIDDEN_SHARE) * (after[0] + np.float32(doffs_px))
    )
    # What recedes grows farther by and by; what uncovers something else, within few frames.
    soon = np.zeros(len(where), np.bool_)
    for each in reversed(earlier):
        was = each.ravel()[where] / np.float32(parts_per_px)
        level = was - hidden_px
        soon |= (level > after[0]) & (level > np.minimum.reduce(after[-_SOON_FRAMES:]))
        after.append(np.where(was > 0, was, after[-1]))
    result.ravel()[where] = soon
    return result


def _in_cells(
    nearness_px: Reals, fresh: NDArray[np.bool_], wanted: NDArray[np.bool_] | None = None
) -> tuple[Reals, Reals]:
    """Return the known share of wanted cells and their mean nearness, NaN = unknown or mixed."""
    shape = tuple(max(size // CELL_PX, 1) for size in nearness_px.shape)
    share, mean = np.empty(shape, np.float32), np.empty(shape, np.float32)
    wanted = np.ones(shape, np.bool_) if wanted is None else wanted
    loops.in_cells(
        checked_array(nearness_px, np.float32),
        checked_array(fresh, np.bool_, nearness_px.shape).view(np.uint8),
        *(CELL_PX, _MIN_SHARE, _JUMP_PX, _JUMP_SHARE, wanted.view(np.uint8), share, mean),
    )
    return share, mean


def _bridged(cells: Reals) -> Reals:
    """Return the cells with gaps filled by the nearest of their neighbours, 0 = unknown."""
    near = np.nan_to_num(cells)
    span = np.ones((2 * _GAP_CELLS + 1, 2 * _GAP_CELLS + 1), np.uint8)
    return np.where(near > 0, near, cv2.dilate(near, span))


def _labelled(near: Reals) -> tuple[int, NDArray[np.int32]]:
    """Return the number of regions and each cell's, 0 = none, which counts as one.

    Cells and the links between them become pixels, so that a common labelling of connected pixels
    heeds the jumps between cells.
    """
    maze = np.zeros((2 * near.shape[0] - 1, 2 * near.shape[1] - 1), np.uint8)
    maze[::2, ::2] = near > 0
    maze[::2, 1::2] = _linked(near[:, :-1], near[:, 1:])
    maze[1::2, ::2] = _linked(near[:-1], near[1:])
    count, labels = cv2.connectedComponents(maze, connectivity=4)
    return count, np.array(labels[::2, ::2], np.int32)


def _linked(a: Reals, b: Reals) -> NDArray[np.bool_]:
    least = np.minimum(a, b)
    jump = np.maximum(np.float32(_JUMP_PX), np.float32(_JUMP_SHARE) * least)
    return np.asarray((least > 0) & (np.abs(a - b) <= jump))


def _around(cells: Reals, nearness_px: Reals) -> Reals:
    """Return the cells with those beside them in their rows, whether or not these have moved."""
    moved = ~np.isnan(cells)
    span = np.ones((1, 2 * _BESIDE_CELLS + 1), np.uint8)
    beside = np.asarray(cv2.dilate(moved.view(np.uint8), span)).view(np.bool_) & ~moved
    _, still = _in_cells(nearness_px, np.ones(nearness_px.shape, np.bool_), beside)
    return np.where(moved, cells, still)


def _neighbours(
    labels: NDArray[np.int32], near: Reals, around: Reals, count: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Return counts of the sides of each region's rows, (count,) each.

    They are the sides at which a nearer region lies, those at which something is farther, whether
    or not it has moved, and all.
    """
    other = labels[:, :-1] != labels[:, 1:]
    left, right = labels[:, :-1][other], labels[:, 1:][other]
    left_is_near = near[:, :-1][other] > near[:, 1:][other]
    behind, sides = np.where(left_is_near, right, left), np.concatenate([left, right])
    known = np.where(near > 0, near, around)
    one, two = known[:, :-1][other], known[:, 1:][other]
    jump = np.maximum(np.float32(_JUMP_PX), _JUMP_SHARE * np.concatenate([one, two]))
    before = sides[np.concatenate([one - two, two - one]) > jump]
    return tuple(np.bincount(each, minlength=count) for each in (behind, before, sides))  # type: ignore[return-value]


def _boxes(labels: NDArray[np.int32], count: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the cells of each region, (count,), and its box (left, top, right, bottom).

    Right and bottom are those of the first cell outside.
    """
    found = np.zeros(count, np.int32), np.empty((count, 4), np.int32)
    loops.boxes(np.ascontiguousarray(labels), *found)
    return found


def _region(
    labels: NDArray[np.int32], label: int, box: tuple[int, int, int, int], measured: Reals
) -> Region:
    left, top, right, bottom = box
    cells = measured[:, top:bottom, left:right]
    mine = labels[top:bottom, left:right] == label
    return region_of(left, top, np.where(mine, cells, np.float32(np.nan)))


def region_of(left: int, top: int, cells: Reals) -> Region:
    """Return the region of cells whose box has its upper left corner at a cell.

    Args:
        left, top: column and row of that cell.
        cells: as :class:`Region` has them.
    """
    row, column = np.nonzero(~np.isnan(cells[1]))
    weight = cells[0, row, column]
    total = float(weight.sum())
    speed, sigma_mps, age_s = _median_velocity(cells[2:7, row, column].T)
    remembered = np.count_nonzero(cells[7:, row, column] > 0) >= _MIN_CELLS
    return Region(
        x=left * CELL_PX,
        y=top * CELL_PX,
        width=cells.shape[2] * CELL_PX,
        height=cells.shape[1] * CELL_PX,
        middle_x=(left + float(weight @ column) / total + 0.5) * CELL_PX - 0.5,
        middle_y=(top + float(weight @ row) / total + 0.5) * CELL_PX - 0.5,
        nearness_px=float(median(cells[1, row, column])),
        known=total / len(weight),
        velocity_mps=speed,
        sigma_mps=sigma_mps,
        age_s=age_s,
        moves=speed is not None or not remembered,
        cells=cells,
    )


def _median_velocity(velocity_mps: Reals) -> tuple[tuple[float, float] | None, float, float]:
    """Return the velocity ahead and to the left that cells (n, 5) agree on, its sigma and age.

    None where they significantly leave the ground: they are no mover.
    """
    if not velocity_mps.size:
        return None, math.inf, 0.0
    known = velocity_mps[np.isfinite(velocity_mps[:, 0])].astype(np.float64)
    if len(known) < _MIN_CELLS:
        return None, math.inf, 0.0
    each = known[:, [2, 0]] * (1, -1)
    middle = median(each)
    spread = np.hypot(*(NORMAL * median(np.abs(each - middle))))
    spread = np.hypot(spread, _CELL_SIGMA_PX * median(known[:, 3]))
    own = math.sqrt(max(len(known) / _CELLS_ALIKE, 1.0))
    ahead, left = middle.tolist()
    speed_mps, sigma_mps = math.hypot(ahead, left), float(spread) / own
    down = known[:, 1]
    sinks = float(median(down))
    sinks_sigma = float(NORMAL * median(np.abs(down - sinks))) / own
    slope = _SLOPE if speed_mps > _SIGMAS * sigma_mps else _LEAST_SLOPE
    if abs(sinks) > max(slope * speed_mps, sinks_sigma):
        return None, math.inf, 0.0
    return (ahead, left), sigma_mps, float(median(known[:, 4]))


def follow(
    tracks: Sequence[Track], observations: Sequence[Observation], time_s: float, next_number: int
) -> tuple[Track, ...]:
    """Return the tracks after a frame.

    Args:
        tracks: those of the last frame.
        observations: those of this frame.
        time_s: time of this frame, later than all before.
        next_number: the number of the first new track.
    """
    pairs = _assigned(tracks, [observation.region for observation in observations], time_s)
    result = []
    for index, track in enumerate(tracks):
        if index in pairs:
            kept = (*track.observations, observations[pairs[index]])[-KEPT:]
            seen = track.seen + kept[-1].region.moves
            result.append(replace(track, observations=kept, seen=seen, missed=0))
        elif track.missed < min(_MAX_MISSED, track.seen):
            result.append(replace(track, missed=track.missed + 1))
    new = (
        each
        for index, each in enumerate(observations)
        if index not in pairs.values() and each.region.moves
    )
    result += (Track(next_number + i, (o,), 1 + o.region.before) for i, o in enumerate(new))
    return tuple(result)


def _assigned(tracks: Sequence[Track], found: Sequence[Region], time_s: float) -> dict[int, int]:
    """Return the index of the region for each track that has one, by the track's index."""
    if not tracks or not found:
        return {}
    wanted = np.array([_expected(track, time_s) for track in tracks])[:, None]
    given = np.array([_measures(region) for region in found])[None]
    size = np.maximum(wanted[..., 2:4], given[..., 2:4])
    sizes = np.hypot(*np.moveaxis((given[..., :2] - wanted[..., :2]) / size, -1, 0))
    factor = np.abs(np.log(given[..., 4] / wanted[..., 4])) / math.log(_MAX_FACTOR)
    # If two tracks match a region, the one that was followed longer gets it.
    young = 0.3 / np.array([[track.seen] for track in tracks])
    cost = sizes / _MAX_SIZES + factor + young
    cost[(sizes > _MAX_SIZES) | (factor > 1)] = 1e6
    return {row: column for row, column in assignment(cost) if cost[row, column] < 1e6}


def _measures(region: Region) -> tuple[float, ...]:
    box = region.middle_x, region.middle_y, region.width, region.height
    return (*box, region.nearness_px)


def _expected(track: Track, time_s: float) -> tuple[float, ...]:
    """Return the expected measures of a track's region at a time."""
    first, last = track.observations[-WAY_SIGHTINGS:][0], track.observations[-1]
    x, y, *rest = _measures(last.region)
    if first is not last:
        share = min((time_s - last.time_s) / (last.time_s - first.time_s), 1.0)
        x += share * (x - first.region.middle_x)
        y += share * (y - first.region.middle_y)
    return (x, y, *rest)


def expected_box(track: Track, time_s: float) -> tuple[float, ...]:
    """Return where the box of a track is expected: middle, width, height and nearness, all px.

    Something before it may have hidden a part of it lately. So its size is that of the last
    observation of about its usual area, and of its sides one may be wrong.
    """
    seen = [observation.region for observation in track.observations]
    last = seen[-1]
    sizes = [each.width * each.height / each.nearness_px**2 for each in seen]
    usual = sorted(sizes)[(len(sizes) - 1) // 2]
    whole = next(
        each
        for each, size in zip(reversed(seen), reversed(sizes), strict=True)
        if abs(size / usual - 1) <= _USUAL_SHARE
    )
    grown = last.nearness_px / whole.nearness_px
    x, y, *_ = _expected(track, time_s)
    measures = []
    across = x - last.middle_x, last.x, whole.x, whole.width, last.width
    down = y - last.middle_y, last.y, whole.y, whole.height, last.height
    for at, now, start, size, span in (across, down):
        half = grown * size / 2
        middle = sorted((now + half, now + span - half, start + size / 2))[1]
        measures.append((middle + at, 2 * half))
    (x, width), (y, height) = measures
    return (x, y, width, height, last.nearness_px)


def lies(track: Track) -> bool | None:
    """Return whether an object is as near as what is beside it, as a shadow is; None if unknown.

    What now lies on the surface that fills the view is, whatever it was in the frames before.
    """
    if track.observations[-1].region.on_surface:
        return True
    nearer = sum(each.region.nearer for each in track.observations)
    compared = nearer + sum(each.region.level for each in track.observations)
    return None if compared < _MIN_COMPARED else nearer <= _NEARER_ROWS * compared


def median(values: NDArray[Any]) -> NDArray[Any]:
    """Return the median along the first axis, of an even number the lower; np.median is slow."""
    return np.asarray(np.sort(values, axis=0)[(len(values) - 1) // 2])
