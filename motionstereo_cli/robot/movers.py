"""Movers: change that the rig's own motion does not explain.

A pixel of the current view is a point in space by its disparity, and the rig's own motion gives its
position in an earlier view. If it stands still, its grey is found there, in both cameras. If not, a
patch around it is aligned with the earlier views: it moved by itself if its grey is found elsewhere
in both, farther away than an error of its disparity explains, and at a consistent disparity.
Patches with similar motion form one mover; it has a minimum size, and moved likewise in the last
frame. Where nothing is found, because it has little texture or the rig's own motion is wrong, it
is still a mover for a few frames, if its surface is where it is expected.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import movers as loops
from motionstereo_cli.compiled import patches, point_disparity, reused

Grey = NDArray[np.uint8]
Real = NDArray[np.float32]
Reals = NDArray[np.float64]

#: A view is compared with an earlier one for which the static scene moved by about the first share
#: of the image's width and, where it moved by less than the second, with one three times as far
#: back, which reveals far and slow movers; at most so many frames back.
_WAY, _SHORT_WAY = 0.02, 0.02
#: No farther back than turns move it by this share, if there is a nearer one.
_TURN = 0.15
_FARTHER, GAPS = 3, 6
#: Where turns move it by this share since, it is also compared with the last one: what the camera
#: follows stays near its place in the image.
_FOLLOWING = 0.05
#: Where disparity is unknown it is measured at the steepest pixel of each square of so many px.
_EDGE_PX, _MIN_SLOPE = 8, 2.5
#: Minimum ratio of the second best cost to the best, and maximum standard deviation.
_SECOND_BEST, _MAX_SIGMA_PX = 1.5, 0.3
#: Levels of the pyramid, each half as large; differences are searched at the second one.
LEVELS = 4
#: Smoothing before, standard deviation and side of the kernel in px: what is beyond it rounds to 0.
_BLUR_PX, _BLUR_SIDE_PX = 0.8, 5
#: Distance of patches, and how far they reach from their middle, in px of each level: as the loops
#: have them.
CELL_PX, _REACH_PX = 4, 4

#: Standard deviation of grey at each level, and what its slope adds to its variance; differences of
#: so many times that are unexplained.
_NOISE = 1.5, 0.9, 0.6, 0.4
_PER_SLOPE, _UNEXPLAINED = 0.03, 5.0
#: Maximum difference of nearness within a patch, so that it is one surface: the larger of these.
_JUMP_PX, _JUMP_SHARE = 0.5, 0.06
#: Standard deviation of disparity: px, and share of nearness.
_SIGMA_PX, _SIGMA_SHARE = 0.25, 0.02
#: No patch moves farther, in px of the coarsest level.
_MAX_SHIFT_PX = 16.0
#: What was nearer by more than the larger of these hid a point.
_HIDDEN_PX, _HIDDEN_SHARE = 1.5, 0.25

#: At the finest level, patches are aligned around those that at the next one, or at this one, moved
#: by so many squared standard deviations.
_PROMISE = 6.0
#: A patch moved if that is so many squared standard deviations and px, if so little of what
#: differed is left, if disparity then was what it had to be, and if nearness changed by no larger
#: share of it. Below a nearness fewer squared standard deviations do, in proportion, down to the
#: least: errors of disparity and of the rig's way shift what is far off less.
_SURE, _LEAST_PX, _LEFT = 100.0, 0.5, 0.45
_SURE_NEAR_PX, _LEAST_SURE = 8.0, 50.0
_OFF_PX, _OFF_SHARE = 0.5, 0.05
_MAX_NEARER = 0.3
#: Maximum difference of the shifts of neighbouring patches of a mover: the larger of these.
_ALIKE_PX, _ALIKE_SHARE = 0.7, 0.2
#: Minimum number of patches of a mover, and the share of them that also moved in the last frame.
_MIN_PATCHES, _LASTING = 3, 0.45
#: That is, by a shift that differs by at most the larger of these.
_LASTING_PX, _LASTING_SHARE = 2.0, 0.5

#: The rig's way tells how its camera is tilted if it is so long in m, and leads ahead or back by
#: so much of it.
_WAY_M, _AHEAD = 0.02, 0.7

#: What moved is remembered for so many frames, where the nearness is at least the first and differs
#: from what is expected by at most the larger of the others. Farther off all depths look alike.
_REMEMBERED_FRAMES = 6
_MIN_REMEMBERED_PX, _REMEMBERED_PX, _REMEMBERED_SHARE = 7.0, 0.7, 0.08

#: Number of earlier frames on which a result depends.
RUN_IN_FRAMES = GAPS + 1 + _REMEMBERED_FRAMES


@dataclass(frozen=True, slots=True)
class ReferenceCamera:
    """The camera whose view it is.

    Attributes:
        focal_px: focal lengths along x and y.
        cx_px, cy_px: principal point.
        other_cx_px: that of the other camera.
        side: 1 where the other camera is at the left, -1 where it is at the right.
        focal_baseline: depth in m times nearness in px.
        doffs_px: nearness less disparity.
        range_px: largest disparity.
    """

    focal_px: tuple[float, float]
    cx_px: float
    cy_px: float
    other_cx_px: float
    side: int
    focal_baseline: float
    doffs_px: float
    range_px: int

    def places_m(self, x_px: NDArray[Any], y_px: NDArray[Any], near_px: NDArray[Any]) -> Reals:
        """Return places in space before the camera, (n, 3), from those in its view, (n,) each."""
        depth_m = self.focal_baseline / np.asarray(near_px, np.float64)
        across = (x_px - self.cx_px) / self.focal_px[0]
        down = (y_px - self.cy_px) / self.focal_px[1]
        return np.stack([across * depth_m, down * depth_m, depth_m], axis=1)

    def in_view_px(self, places_m: Reals) -> Reals:
        """Return where places before the camera (n, 3) are in its view, x and y, (n, 2) px."""
        return places_m[:, :2] / places_m[:, 2:] * self.focal_px + (self.cx_px, self.cy_px)

    def at(self, level: int) -> Any:
        """Return the camera of a pyramid level for the loops."""
        q = 0.5**level
        return loops.CameraLevel(  # type: ignore[call-arg]
            *(self.focal_px[0] * q, self.focal_px[1] * q, self.cx_px * q, self.cy_px * q),
            *(self.other_cx_px * q, self.side, self.focal_baseline * q, self.doffs_px * q),
        )


@dataclass(frozen=True, slots=True)
class Moment:
    """An earlier frame for comparison.

    Attributes:
        views: at each level, grey of the camera and of the other one, (2, height, width) uint8.
        disparity_px: of the camera's view, NaN = unknown.
        before_from_now: (4, 4) takes places in the camera then to those in the one a frame before.
        time_s: time in s.
        smaller_px: the disparity at the other levels, once it is filled.
    """

    views: tuple[Grey, ...]
    disparity_px: Real
    before_from_now: Reals
    time_s: float
    smaller_px: tuple[Real, ...] = ()

    def filled(self, disparity_px: Real) -> Moment:
        """Return the moment with another disparity, at all levels."""
        smaller = [disparity_px]
        while len(smaller) < LEVELS:
            smaller.append(smaller[-1][::2, ::2] * np.float32(0.5))
        return replace(self, disparity_px=disparity_px, smaller_px=tuple(smaller[1:]))

    def levels(self) -> list[Any]:
        """Return the moment at each level for the loops."""
        level: Any = patches.FrameLevel
        return [
            level(*views.reshape(2, -1), near_px.ravel(), *near_px.shape)
            for views, near_px in zip(
                self.views, (self.disparity_px, *self.smaller_px), strict=True
            )
        ]


@dataclass(frozen=True, slots=True)
class Movers:
    """What is kept from frame to frame.

    Attributes:
        moments: the last frames, :data:`GAPS` at most, the last one last.
        moving: how cells moved by themselves in the last frame, a frame, whether or not they did so
            before: shift along x, y and of disparity in px, (rows, columns, 3), NaN = they did not;
            None at first.
        lately: points of what moved by itself in the last frames, (n, 7) float32: place x, y and
            nearness in px, how they moved by themselves, a frame, and frames since that was found.
    """

    moments: tuple[Moment, ...] = ()
    moving: Real | None = None
    lately: Real = field(default_factory=lambda: np.empty((0, 7), np.float32))

    @property
    def disparity_px(self) -> Real:
        """Disparity of the last frame, also where single edges tell it, NaN = unknown."""
        return self.moments[-1].disparity_px


def pyramid(view: Grey, other: Grey) -> tuple[Grey, ...]:
    """Return two views at each level, as they are compared."""
    levels = [np.empty((2, *view.shape), np.uint8)]
    for grey, blurred in zip((view, other), levels[0], strict=True):
        cv2.GaussianBlur(grey, (_BLUR_SIDE_PX, _BLUR_SIDE_PX), _BLUR_PX, dst=blurred)
    while len(levels) < LEVELS:
        height, width = levels[-1].shape[1:]
        smaller = np.empty((2, (height + 1) // 2, (width + 1) // 2), np.uint8)
        for grey, half in zip(levels[-1], smaller, strict=True):
            cv2.pyrDown(grey, dst=half)
        levels.append(smaller)
    return tuple(levels)


def see(
    movers: Movers, now: Moment, camera: ReferenceCamera
) -> tuple[Movers, NDArray[np.bool_], Real]:
    """Return what is known after a frame, where something moved by itself, and how fast.

    The second is (height, width) bool. The third, (rows, columns, 6), NaN = unknown, has the
    velocity over ground of cells of :data:`CELL_PX` in m/s: to the right of the camera; down, at
    right angles to the rig's way; ahead; and by how much the last is wrong per px by which the
    change of disparity is. Down is unknown where the rig does not drive ahead or back. Then comes
    how long ago that was, in s; last, the frames since a cell was found to move; where that is not
    in this one, it has no velocity.

    Args:
        movers: what was known before.
        now: the frame.
        camera: the camera.
    """
    shape = now.disparity_px.shape
    rows, columns = (side // CELL_PX for side in shape)
    moving, (moved, lasting) = None, np.zeros((2, rows, columns), np.bool_)
    velocity_mps = np.full((rows, columns, 6), np.nan, np.float32)
    lately = np.empty((0, 7), np.float32)
    now = now.filled(_filled(now, camera))
    if movers.moments:
        gap, levels = _gap(movers, now, camera), now.levels()
        near = _in_cells(now.disparity_px) + np.float32(camera.doffs_px)
        near[np.isnan(near)] = 0
        farther = min(_FARTHER * gap, len(movers.moments))
        moving = np.full((rows, columns, 3), np.nan, np.float32)
        parallaxes_px = {farther: _SHORT_WAY * shape[1], gap: math.inf}
        if _turn_rad(_motion(movers, now, gap)) * camera.focal_px[0] > _FOLLOWING * shape[1]:
            parallaxes_px[1] = math.inf
        for back in sorted(parallaxes_px):
            then, motion = movers.moments[-back], _motion(movers, now, back)
            found = _shifts(levels, motion, then, camera, parallaxes_px[back])
            new = _moved(found, near) & ~moved
            if not new.any():
                continue
            moving[new] = found[new][:, :3] / np.float32(back)
            velocity_mps[new, :5] = _velocity_mps(
                new, found[new], near[new], motion, camera, now.time_s - then.time_s
            )
            moved |= new
        count, labels = _labelled(moved, moving, near)
        some = labels > 0
        moving[moved & ~some] = np.nan
        if movers.moving is not None and some.any():
            step = now.before_from_now
            stood = _places_m(some, near[some], camera) @ step[:3, :3].T + step[:3, 3]
            lasting = _lasting(count, labels, moving, movers.moving, camera.in_view_px(stood))
        velocity_mps[moved & ~lasting] = np.nan
        velocity_mps[lasting, 5] = 0
        again = _seen_again(movers.lately, now, lasting, camera)
        column, row = (again[:, :2] / CELL_PX).astype(np.intp).T
        velocity_mps[row, column, 5] = again[:, 6]
        lately = np.concatenate([_points(lasting, near, moving), again])
    kept = (*movers.moments, now)[-GAPS:]
    return Movers(kept, moving, lately), _in_pixels(lasting, shape), velocity_mps


def _points(lasting: NDArray[np.bool_], near: Real, shifts: Real) -> Real:
    """Return the points of cells that move in this frame, (n, 7), as :class:`Movers` has them.

    Args:
        lasting: these cells, (rows, columns).
        near: nearness of cells in px, (rows, columns).
        shifts: how cells moved by themselves, a frame, (rows, columns, 3) px.
    """
    row, column = np.nonzero(lasting)
    places = np.stack([column, row], axis=1) * CELL_PX + CELL_PX // 2
    age_frames = np.zeros(len(row), np.float32)
    return np.column_stack([places, near[lasting], shifts[lasting], age_frames]).astype(np.float32)


def _seen_again(
    lately: Real, now: Moment, lasting: NDArray[np.bool_], camera: ReferenceCamera
) -> Real:
    """Return the points of the last frame that go on as they did, where none is found to move.

    Args:
        lately: the points of the last frame, (n, 7), as :class:`Movers` has them.
        now: the frame.
        lasting: the cells that are found to move in it, (rows, columns).
        camera: the camera.
    """
    step = now.before_from_now
    stand_m = (camera.places_m(*lately[:, :3].T) - step[:3, 3]) @ step[:3, :3]
    kept = (lately[:, 6] < _REMEMBERED_FRAMES) & (stand_m[:, 2] > 0)
    lately, stand_m = lately[kept], stand_m[kept]
    there = np.column_stack([camera.in_view_px(stand_m), camera.focal_baseline / stand_m[:, 2]])
    there -= lately[:, 3:6]
    height, width = (side * CELL_PX for side in lasting.shape)
    x, y = there[:, :2].T
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    there, lately = there[inside], lately[inside]
    x, y = there[:, :2].astype(np.intp).T
    near = now.disparity_px[y, x] + np.float32(camera.doffs_px)
    limit_px = np.maximum(_REMEMBERED_PX, _REMEMBERED_SHARE * near)
    kept = (np.abs(near - there[:, 2]) <= limit_px) & (near >= _MIN_REMEMBERED_PX)
    kept &= ~lasting[y // CELL_PX, x // CELL_PX]
    each = there[kept, :2], near[kept], lately[kept, 3:6], lately[kept, 6] + 1
    return np.column_stack(each).astype(np.float32)


def _gap(movers: Movers, now: Moment, camera: ReferenceCamera) -> int:
    """Return how many frames before the one is to compare with."""
    near = now.disparity_px[::8, ::8] + np.float32(camera.doffs_px)
    near = near[near > 0]
    typical = float(np.partition(near, near.size // 2)[near.size // 2]) if near.size else 1.0
    max_turn_rad = _TURN * now.disparity_px.shape[1] / camera.focal_px[0]
    wanted_m = (
        _WAY * now.disparity_px.shape[1] / typical * camera.focal_baseline / camera.focal_px[0]
    )
    for gap in range(1, len(movers.moments)):
        if np.linalg.norm(_motion(movers, now, gap)[:3, 3]) >= wanted_m:
            return gap
        if _turn_rad(_motion(movers, now, gap + 1)) > max_turn_rad:
            return gap
    return len(movers.moments)


def _turn_rad(motion: Reals) -> float:
    """Return the angle of the turn of a motion (4, 4)."""
    return math.acos(min(max((float(np.trace(motion[:3, :3])) - 1) / 2, -1.0), 1.0))


def _motion(movers: Movers, now: Moment, gap: int) -> Reals:
    """Return the motion to a frame so many before (4, 4)."""
    motion = now.before_from_now
    for moment in movers.moments[:-gap:-1]:
        motion = moment.before_from_now @ motion
    return np.ascontiguousarray(motion)


def _filled(now: Moment, camera: ReferenceCamera) -> Real:
    """Return the disparity in px, (height, width), also around edges that did not change.

    A vehicle ahead at the speed of the rig hardly changes, and has no charge.
    """
    view, other = (image.astype(np.float32) for image in now.views[0])
    squares = (view.shape[0] // _EDGE_PX) * (view.shape[1] // _EDGE_PX)
    places = np.empty((squares, 2), np.int32)
    columns = np.empty((2, view.shape[1]), np.float32)
    squares = point_disparity.edges(view, now.disparity_px, _EDGE_PX, _MIN_SLOPE, columns, places)
    places = places[:squares]
    there = places
    if camera.side < 0:  # in a mirror the other camera is at the left
        view, other = (np.ascontiguousarray(image[:, ::-1]) for image in (view, other))
        there = np.array([view.shape[1] - 1, 0], np.int32) + np.array([-1, 1], np.int32) * places
    found = np.empty((len(places), 2), np.float32)
    work = np.empty((2, camera.range_px + 1), np.float32)
    point_disparity.measure(
        view, other, there, camera.range_px, _NOISE[0], _SECOND_BEST, work, found
    )
    filled = now.disparity_px.copy()
    point_disparity.fill(places, found, _MAX_SIGMA_PX, _REACH_PX, now.disparity_px, filled)
    return filled


def _shifts(
    now: list[Any], motion: Reals, then: Moment, camera: ReferenceCamera, max_parallax_px: float
) -> Real:
    """Return how patches moved since a frame, (rows, columns, fields), NaN = explained or unknown.

    Patches that differ at the second level are aligned at all levels, from coarse to fine.

    Args:
        now: the frame, at each level.
        motion: (4, 4) takes places in the camera of now to those in the earlier one.
        then: the earlier frame.
        camera: the camera.
        max_parallax_px: only where what stands moved at most so far in the image, but for turns.
    """
    height, width = then.disparity_px.shape
    moments = list(zip(now, then.levels(), strict=True))
    limits = [_limits(level) for level in range(LEVELS)]
    wanted = np.zeros((height // CELL_PX // 2, width // CELL_PX // 2), np.uint8)
    if not wanted.size:  # OpenCV resizes no empty image
        return np.full((height // CELL_PX, width // CELL_PX, loops.FIELDS), np.nan, np.float32)
    work: Any = reused(loops.Workspace)
    loops.find(*moments[1], camera.at(1), motion, limits[1], max_parallax_px / 2, work, wanted)
    asked_at = {1: wanted}
    for level in range(2, LEVELS):
        shape = tuple(side // 2**level // CELL_PX for side in (height, width))
        asked_at[level] = _any_of_four(asked_at[level - 1], shape)
    found = np.empty((0, 0, loops.FIELDS), np.float32)
    for level in range(LEVELS - 1, -1, -1):
        shape = tuple(side // 2**level // CELL_PX for side in (height, width))
        asked = asked_at.get(level)
        if asked is None:
            asked = cv2.resize(wanted, shape[::-1], interpolation=cv2.INTER_NEAREST)
        coarse, found = found, np.empty((*shape, loops.FIELDS), np.float32)
        loops.align(
            *(*moments[level], camera.at(level), motion, limits[level]),
            *(np.asarray(asked), coarse, 0.0 if level else _PROMISE, work, found),
        )
    return found


def _any_of_four(wanted: Grey, shape: tuple[int, ...]) -> Grey:
    """Return cells twice as large, (rows, columns), 1 where any of the four in them is wanted."""
    rows, columns = shape
    pairs = wanted[: 2 * rows : 2, : 2 * columns] | wanted[1 : 2 * rows : 2, : 2 * columns]
    return pairs[:, ::2] | pairs[:, 1::2]


def _limits(level: int) -> Any:
    """Return what counts as a difference at a pyramid level."""
    q = 0.5**level
    return loops.Limits(  # type: ignore[call-arg]
        *(_NOISE[level], _PER_SLOPE, _UNEXPLAINED, _JUMP_PX * q, _JUMP_SHARE),
        *(_SIGMA_PX * q, _SIGMA_SHARE, _MAX_SHIFT_PX * 2.0 ** (LEVELS - 1 - level)),
        *(_HIDDEN_PX * q, _HIDDEN_SHARE),
    )


def _in_cells(disparity_px: Real) -> Real:
    """Return the disparity in the middle of each cell, (rows, columns) px."""
    rows, columns = (side // CELL_PX * CELL_PX for side in disparity_px.shape)
    half = CELL_PX // 2
    return disparity_px[half:rows:CELL_PX, half:columns:CELL_PX]


def _moved(shifts: Real, near: Real) -> NDArray[np.bool_]:
    """Return which cells moved by themselves, (rows, columns)."""
    moved = np.zeros(near.shape, np.bool_)
    known = np.nonzero(np.isfinite(shifts[..., 4]))
    shift, (sure, off, left), n = shifts[known][:, :3], shifts[known][:, 3:].T, near[known]
    moved[known] = (
        (sure > _SURE * np.clip(n / _SURE_NEAR_PX, _LEAST_SURE / _SURE, 1))
        & (np.abs(shift).max(axis=1) > _LEAST_PX)
        & (left < _LEFT)
        & (np.abs(off) < np.maximum(_OFF_PX, _OFF_SHARE * n))
        & (np.abs(shift[:, 2]) < _MAX_NEARER * n)
    )
    return moved


def _velocity_mps(
    where: NDArray[np.bool_],
    shift: Real,
    near: Real,
    motion: Reals,
    camera: ReferenceCamera,
    apart_s: float,
) -> Reals:
    """Return how fast cells moved over ground, (n, 5), as :func:`see` has it.

    A patch is a place in space now by its disparity, and another one then by where its grey was and
    the disparity that it had there.

    Args:
        where: the cells, (rows, columns).
        shift, near: how they moved since then, and their nearness now, (n, fields) and (n,).
        motion: (4, 4) takes places in the camera of now to those in the earlier one.
        camera: the camera.
        apart_s: time since then in s.
    """
    here = _places_m(where, near, camera)
    stood = here @ motion[:3, :3].T + motion[:3, 3]
    x_px, y_px = (camera.in_view_px(stood) + shift[:, :2]).T
    there = camera.places_m(x_px, y_px, camera.focal_baseline / stood[:, 2] + shift[:, 2])
    moved_m = here - (there - motion[:3, 3]) @ motion[:3, :3]
    moved_m[:, 1] = moved_m @ _down(motion)
    rates = np.column_stack([moved_m, here[:, 2] / near]) / (apart_s or 1)
    known = (there[:, 2] > 0) & (apart_s > 0)
    # It is the mean of all the time since then.
    return np.where(known[:, None], np.insert(rates, 4, apart_s / 2, axis=1), np.nan)


def _down(motion: Reals) -> Reals:
    """Return the direction down in the camera of now (3,), NaN where its way does not tell.

    Args:
        motion: (4, 4) takes places in the camera of now to those in the earlier one.
    """
    way = motion[:3, :3].T @ motion[:3, 3]
    length = float(np.linalg.norm(way))
    if abs(way[2]) < max(_WAY_M, _AHEAD * length):
        return np.full(3, np.nan)
    way = way / length
    down = np.array([0.0, 1.0, 0.0]) - way[1] * way
    return np.asarray(down / np.linalg.norm(down))


def _places_m(where: NDArray[np.bool_], near: Real, camera: ReferenceCamera) -> Reals:
    """Return the places in space of cells (rows, columns) with a nearness (n,), (n, 3)."""
    row, column = np.nonzero(where)
    half = CELL_PX // 2
    return camera.places_m(column * CELL_PX + half, row * CELL_PX + half, near)


def _labelled(moved: NDArray[np.bool_], shifts: Real, near: Real) -> tuple[int, NDArray[np.int32]]:
    """Return the number of movers plus one, and the mover of each cell, 0 = none."""
    if not moved.any():
        return 1, np.zeros(moved.shape, np.int32)
    rows, columns = moved.shape
    maze = np.zeros((2 * rows - 1, 2 * columns - 1), np.uint8)
    maze[::2, ::2] = moved
    values = np.dstack([shifts[..., :3], near])
    for down, right in ((0, 1), (1, 0), (1, 1)):
        here, there = slice(rows - down), slice(columns - right)
        row, column = np.nonzero(moved[here, there] & moved[down:, right:])
        alike = _alike(values[row, column], values[row + down, column + right])
        maze[2 * row + down, 2 * column + right] = alike
    count, connected = cv2.connectedComponents(maze, connectivity=8)
    labels = np.array(connected[::2, ::2], np.int32)
    small = np.bincount(labels.ravel(), minlength=count) < _MIN_PATCHES
    small[0] = False
    labels[small[labels]] = 0
    return count, labels


def _alike(one: Real, other: Real) -> NDArray[np.bool_]:
    """Return whether cells (n, 4), shift and nearness, moved alike and are of one surface."""
    off = np.abs(one - other)
    near = np.minimum(one[:, 3], other[:, 3])
    size = np.maximum(np.abs(one[:, :3]).max(axis=1), np.abs(other[:, :3]).max(axis=1))
    alike = off[:, :3].max(axis=1) <= np.maximum(_ALIKE_PX, _ALIKE_SHARE * size)
    return np.asarray(alike & (off[:, 3] <= np.maximum(_JUMP_PX, _JUMP_SHARE * near)))


def _lasting(
    count: int, labels: NDArray[np.int32], moving: Real, before: Real, stood_px: Reals
) -> NDArray[np.bool_]:
    """Return the cells of movers that moved alike in the frame before.

    Args:
        count, labels: of this frame, see :func:`_labelled`.
        moving, before: of this frame and the one before, as :class:`Movers` has them.
        stood_px: where the cells of movers were then if they stand, x and y, (n, 2).
    """
    row, column = np.nonzero(labels)
    shift, limits = moving[row, column], np.array(labels.shape) - 1
    then = np.floor((stood_px + shift[:, :2]).T[::-1] / CELL_PX).astype(np.intp)
    alike_px = np.maximum(_LASTING_PX, _LASTING_SHARE * np.abs(shift).max(axis=1))
    alike = np.zeros(len(row), np.bool_)
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            at = np.clip(then + np.array([[down], [right]]), 0, limits[:, None])
            off = np.abs(before[at[0], at[1]] - shift).max(axis=1)
            alike |= off <= alike_px  # not where it is NaN
    label = labels[row, column]
    share = np.bincount(label, alike, count) / np.maximum(np.bincount(label, minlength=count), 1)
    return np.asarray((share >= _LASTING)[labels] & (labels > 0))


def _in_pixels(cells: NDArray[np.bool_], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return the pixels of cells (rows, columns), (height, width)."""
    result = np.zeros(shape, np.bool_)
    rows, columns = (side * CELL_PX for side in cells.shape)
    if cells.any():
        large = cv2.resize(cells.view(np.uint8), (columns, rows), interpolation=cv2.INTER_NEAREST)
        result[:rows, :columns] = large.view(np.bool_)
    return result
