"""Direct alignment: the motion of a rig since an earlier pair of views, from grey alone.

Points of the earlier right view, with nearness from the earlier pair, are moved and projected into
both current views; the motion is the one for which their grey agrees best (Gauss-Newton, Huber
weights, coarse to fine). Gain and offset of both views are estimated with it, and so is an error of
disparity: depth follows both from nearness and from motion in the image. Its constant, and slopes
to the right and down, are what small errors of calibration cause: a rotation between the cameras
about the vertical, different focal lengths, and a rotation about the optical axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import alignment as loops
from motionstereo_cli.compiled import point_disparity, reused

Real = NDArray[np.float32]
Reals = NDArray[np.float64]

LEVELS = 4
#: Smoothing before, standard deviation in px.
_BLUR_PX = 0.7
#: At each level, from fine to coarse: use one of so many points, if there are many, and so many
#: steps.
_STRIDES = 1, 1, 2, 4
_MANY = 300
_ITERATIONS = 8
#: Iterations end with a step that moves points by less, in px.
_LEAST_STEP_PX = 0.03

#: Points have the largest slopes, at least this, in each cell of so many rows and columns.
_MAX_POINTS = 2000
_CELLS = 8, 12
_MIN_SLOPE = 2.5
_BORDER_PX = 8
#: Minimum number of points, and maximum standard deviation of their nearness in px.
MIN_POINTS = 40
_MAX_SIGMA_PX = 1.0
_MIN_NEARNESS_PX = 0.1

#: Standard deviation of grey in a view, of a residual, and what a slope adds to its variance.
_NOISE = 2.0
_SECOND_BEST = 1.5
_WEIGHTS = (3.0, 0.02, 1.345, 4 * 1.345)
_COARSE_WEIGHTS = (6.0, 0.02, 1.345, 4.0)
#: A near start is aligned from this level on, and what differs by more is left out but at the
#: finest.
_NEAR_LEVEL, _NEAR_CUT = 1, 2.5

#: Prior information that gain is 1 and offset 0.
_GAIN_PRIOR, _OFFSET_PRIOR = 1e4, 1e-2
#: Prior standard deviations of the error of disparity: at the principal point of the left view in
#: px, and its slopes to the right and down in px where a direction is 1 per depth.
ERROR_SIGMAS_PX = 0.3, 1.0, 1.0
_PINNED = 1e12

#: A residual below this, in standard deviations, supports an alignment.
_AGREES = 2.5
#: Share of visible points from which an alignment has full score.
_FULLY_SEEN = 0.4


@dataclass(frozen=True, slots=True)
class Lens:
    """The geometry of a rectified rig.

    Attributes:
        focal_px: focal lengths along x and y.
        right_cx_px, left_cx_px, cy_px: principal points.
        baseline_m: distance between the cameras.
    """

    focal_px: tuple[float, float]
    right_cx_px: float
    left_cx_px: float
    cy_px: float
    baseline_m: float

    @property
    def doffs_px(self) -> float:
        """Nearness minus disparity."""
        return self.right_cx_px - self.left_cx_px

    def at(self, level: int) -> Any:
        """Return the camera of a pyramid level for the loops."""
        q = 0.5**level
        return loops.RigLevel(  # type: ignore[call-arg]
            *(self.focal_px[0] * q, self.focal_px[1] * q),
            *(self.right_cx_px * q, self.left_cx_px * q, self.cy_px * q),
            *(self.baseline_m, self.focal_px[0] * self.baseline_m, q),
        )


@dataclass(frozen=True, slots=True)
class Keyframe:
    """The points of a pair of views.

    Attributes:
        points: (n, 4) float32 direction x and y per depth, nearness in px, its standard deviation.
        grey: (levels, n) float32.
        light: (4,) float64 gain and offset of the right and of the left view since.
    """

    points: Real
    grey: Real
    light: Reals


@dataclass(frozen=True, slots=True)
class Alignment:
    """The alignment of a keyframe with the current views.

    Attributes:
        motion: (4, 4) transforms points of the keyframe's right camera to the current one.
        light: as in :class:`Keyframe`.
        error_px: (3,) error of disparity, nearness minus disparity; see :data:`ERROR_SIGMAS_PX`.
        score: share of the points whose grey agrees, 0..1.
        seen: share of the points in view, 0..1.
        normal: (13, 14) normal equations, the right side last: translation, rotation, light, error.
            They hold no prior of the error.
        by_corners: it is from matched corners, not from grey, so that its normal equations are a
            mere guess.
        doubtful: another motion agrees nearly as well.
    """

    motion: Reals
    light: Reals
    error_px: Reals
    score: float
    seen: float
    normal: Reals
    by_corners: bool = False
    doubtful: bool = False


def pyramid(image: NDArray[np.uint8]) -> list[Real]:
    """Return an image at each level, the full size first, (height, width) float32."""
    kernel = cv2.getGaussianKernel(7, _BLUR_PX, cv2.CV_32F)
    levels = [cv2.sepFilter2D(image, cv2.CV_32F, kernel, kernel)]
    while len(levels) < LEVELS:
        levels.append(cv2.pyrDown(levels[-1]))
    return levels  # type: ignore[return-value]


def pick(
    grey: Real, count: int = _MAX_POINTS, cells: tuple[int, int] = _CELLS
) -> NDArray[np.int32]:
    """Return the pixels of the largest slopes, spread over an image: (n, 2) int32 column and row.

    Args:
        grey: the image.
        count: approximate maximum number.
        cells: rows and columns of cells, which each contribute equally.
    """
    slope = np.empty_like(grey)
    places = np.empty((grey.size // 4, 2), np.int32)  # no two peaks touch, but for equal ones
    found = point_disparity.peaks(grey, _BORDER_PX, _MIN_SLOPE, slope, places)
    x, y = places[:found].T.astype(np.intp)
    strength = slope[y, x]
    cell = y * cells[0] // grey.shape[0] * cells[1] + x * cells[1] // grey.shape[1]
    # By cell, then by strength: the bits of positive numbers have their order.
    keys = cell << 56 | (0x7FFFFFFF - strength.view(np.int32).astype(np.int64)) << 25
    order = np.sort(keys | np.arange(len(keys))) & 0x1FFFFFF
    rank = np.arange(len(order)) - np.searchsorted(cell[order], cell[order])
    kept = order[rank < -(-2 * count // (cells[0] * cells[1]))]
    if len(kept) > count:
        kept = np.sort(kept[np.argsort(-strength[kept], kind="stable")[:count]])
    return np.stack([x[kept], y[kept]], axis=1).astype(np.int32)


def nearness_of(
    right: Real, left: Real, places: NDArray[np.int32], lens: Lens, range_px: int
) -> Real:
    """Return nearness and its standard deviation in px at pixels of the right view, (n, 2).

    NaN where it is uncertain.
    """
    found = np.empty((len(places), 2), np.float32)
    work = np.empty((2, range_px + 1), np.float32)
    point_disparity.measure(right, left, places, range_px, _NOISE, _SECOND_BEST, work, found)
    found[:, 0] += np.float32(lens.doffs_px)
    return found


def keyframe(right: list[Real], left: list[Real], lens: Lens, range_px: int) -> Keyframe | None:
    """Return the points of a pair of views; None if there are too few.

    Args:
        right, left: their pyramids.
        lens: the rig.
        range_px: largest disparity.
    """
    places = pick(right[0])
    found = nearness_of(right[0], left[0], places, lens, range_px)
    sure = (found[:, 1] < _MAX_SIGMA_PX) & (found[:, 0] > _MIN_NEARNESS_PX)
    if np.count_nonzero(sure) < MIN_POINTS:
        return None
    at = places[sure].astype(np.float32)
    centre = np.array([lens.right_cx_px, lens.cy_px], np.float32)
    rays = (at - centre) / np.array(lens.focal_px, np.float32)
    grey: Any = np.stack(
        [
            cv2.remap(level, at[:, 0] / 2**k, at[:, 1] / 2**k, cv2.INTER_LINEAR).ravel()
            for k, level in enumerate(right)
        ]
    )
    points = np.concatenate([rays, found[sure]], axis=1)
    return Keyframe(np.ascontiguousarray(points), grey, np.array([1.0, 0.0, 1.0, 0.0]))


def align(
    key: Keyframe,
    right: list[Real],
    left: list[Real],
    lens: Lens,
    start: Reals,
    *,
    with_error: bool = False,
    pinned: bool = False,
    near: bool = False,
) -> Alignment | None:
    """Align a keyframe with the current views; None if it fails.

    Args:
        key: the keyframe.
        right, left: pyramids of the current views.
        lens: the rig.
        start: (4, 4) initial motion.
        with_error: estimate the constant error of disparity too, which may be large; else the error
            counts as 0.
        pinned: keep the initial motion and estimate only the light.
        near: the initial motion is nearly right, and what contradicts it has no say.
    """
    prior = np.zeros((2, 13))
    prior[0, 6:10] = 1, 0, 1, 0
    prior[1, 6:10] = _GAIN_PRIOR, _OFFSET_PRIOR, _GAIN_PRIOR, _OFFSET_PRIOR
    prior[1, 10:] = 1 / np.square(ERROR_SIGMAS_PX)
    prior[1, :6] = _PINNED if pinned else 1e-9
    state = np.concatenate([start[:3].ravel(), key.light, np.zeros(3)])
    normal, residual = np.empty((13, 14)), np.empty(len(key.points), np.float32)
    work: Any = reused(loops.Workspace)
    first = 0 if pinned else _NEAR_LEVEL if near else LEVELS - 1
    for level in range(first, -1, -1):
        views = _views(key, right, left, level)
        cut = _NEAR_CUT if near and level else _WEIGHTS[3]
        weights: Any = loops.Weights(*_WEIGHTS[:3], cut)  # type: ignore[call-arg]
        seen = loops.align(
            *(views, lens.at(level), weights, prior, with_error, _ITERATIONS, _LEAST_STEP_PX),
            *(work, state, normal[: 0 if level else 13], residual),
        )
        if seen < 0:
            return None
    normal[10:, 13] -= prior[1, 10:] * state[16:]
    normal[range(10, 13), range(10, 13)] -= prior[1, 10:]
    score, share = _score(residual)
    motion = np.eye(4)
    motion[:3] = start[:3] if pinned else state[:12].reshape(3, 4)
    return Alignment(motion, state[12:16], state[16:], score, share, normal)


def mismatch(
    key: Keyframe, right: list[Real], lens: Lens, motions: Reals, *, near: bool = False
) -> Reals:
    """Return the mismatch of grey after each of some motions (n, 4, 4).

    It is that of the coarsest level, or of the one where a near start begins.
    """
    level = _NEAR_LEVEL if near else LEVELS - 1
    views, camera = _views(key, right, right, level), lens.at(level)
    residual = np.empty(len(key.points), np.float32)
    weights = loops.Weights(*_COARSE_WEIGHTS)  # type: ignore[call-arg]
    work = reused(loops.Workspace)
    states = np.zeros((len(motions), 19))
    states[:, :12] = motions[:, :3].reshape(-1, 12)
    states[:, 12:16] = key.light
    costs = np.empty(len(motions))
    loops.mismatches(views, camera, weights, states, work, residual, costs)
    return costs


def _views(key: Keyframe, right: list[Real], left: list[Real], level: int) -> Any:
    stride = max(1, min(_STRIDES[level], len(key.points) // _MANY))
    grey = key.grey[level]
    return loops.Views(right[level], left[level], key.points, grey, stride)  # type: ignore[call-arg]


def _score(residual: Real) -> tuple[float, float]:
    """Return the share of points whose grey agrees, and the share in view."""
    seen = np.isfinite(residual)
    count = np.count_nonzero(seen)
    agree = np.clip(1 - (residual[seen] / _AGREES) ** 2, 0, 1).sum() / max(count, 30)
    share = count / len(residual)
    return float(agree) * min(1.0, share / _FULLY_SEEN), share
