"""Equal brightness of both views: a difference would be mistaken for disparity."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

#: Views are looked at in about this size in px, the larger one: an eighth of 640 x 480, a sixteenth
#: of 1920 x 1080. If they differ there, they are looked at again in one that is larger by this.
_WIDTH_PX, _HEIGHT_PX, _CLOSER = 100, 60, 4

#: Parameters of cv2.StereoBM for images of that size. It finds points that both views show by
#: comparing slopes of grey, not grey; uncertain ones are dropped.
_BLOCK_PX, _UNIQUENESS, _TEXTURE, _SPECKLE_PX = 9, 15, 20, 50

#: Every second of its pixels, both ways, is used. At least so many are needed.
_STEP, _LEAST_POINTS = 2, 50

#: Differences above twice the median, and above these grey levels, are wrong matches.
_PLAIN = 6.0

#: Gain is fitted only if the standard deviation of grey levels is larger than this, else it is 1.
_LEVELS = 10.0

#: Smaller adjustments, in grey levels, may result from the matching itself; and larger ones of at
#: most this share of the image.
_LEAST, _FEW = 1.5, 0.1

#: Size in px of the Gaussian window in which the remaining offsets are averaged.
_SIGMA_PX = 48


def balanced(
    right: NDArray[np.uint8], left: NDArray[np.uint8], max_disparity: int
) -> NDArray[np.uint8]:
    """Return the left view as bright as the right one, (height, width) uint8.

    A gain, an offset, and an offset that varies slowly over the image, fitted to points found in
    both views. If too few are found, the left view is returned unchanged.

    Args:
        right, left: (height, width) uint8.
        max_disparity: of the points looked for, px.
    """
    height, width = right.shape
    scale = 2 ** max(1, round(math.log2(min(width / _WIDTH_PX, height / _HEIGHT_PX))))
    # Most views need no adjustment, which small ones show; larger ones give it more exactly.
    found = _adjustment(right, left, max_disparity, scale)
    if found is not None and scale > 2:
        found = _adjustment(right, left, max_disparity, max(scale // _CLOSER, 2))
    if found is None:
        return left
    gain, offset, offsets = found
    changed = left * np.float32(gain) + np.float32(offset)
    if offsets is not None:
        changed += cv2.resize(offsets, (width, height))
    return np.asarray(cv2.convertScaleAbs(np.maximum(changed, 0)), np.uint8)


def _adjustment(
    right: NDArray[np.uint8], left: NDArray[np.uint8], max_disparity: int, scale: int
) -> tuple[float, float, NDArray[np.float32] | None] | None:
    """Return gain, offset, and a coarse image of offsets or None; None without an adjustment.

    Args:
        right, left: (height, width) uint8.
        max_disparity: of the points looked for, px.
        scale: factor by which the views are reduced for it.
    """
    height, width = right.shape
    small = width // scale, height // scale
    disparities = -(-max_disparity // (16 * scale)) * 16
    if small[1] <= _BLOCK_PX or small[0] <= max(_BLOCK_PX, disparities):
        return None
    # Of whole squares of pixels: else it would take ten times as long.
    used = slice(small[1] * scale), slice(small[0] * scale)
    small_right, small_left = (
        cv2.resize(view[used], small, interpolation=cv2.INTER_AREA) for view in (right, left)
    )
    matcher = cv2.StereoBM.create(disparities, _BLOCK_PX)
    matcher.setUniquenessRatio(_UNIQUENESS)
    matcher.setTextureThreshold(_TEXTURE)
    matcher.setDisp12MaxDiff(1)
    matcher.setSpeckleWindowSize(_SPECKLE_PX)
    matcher.setSpeckleRange(1)
    steps = matcher.compute(small_left, small_right)[::_STEP, ::_STEP]  # 16 a px
    rows, columns = np.nonzero(steps > 0)
    if len(rows) < _LEAST_POINTS:
        return None
    smooth_right, smooth_left = (
        cv2.blur(view, (5, 5)).astype(np.float32) for view in (small_right, small_left)
    )
    place = np.maximum(_STEP * columns - steps[rows, columns].astype(np.float32) / 16, 0)
    whole = place.astype(np.int32)  # between pixels, grey is linear
    here, beside = (smooth_right[_STEP * rows, whole + i] for i in (0, 1))
    rights = (here + (beside - here) * (place - whole)).astype(np.float32)
    lefts = smooth_left[_STEP * rows, _STEP * columns]
    gain, offset = _line(lefts, rights)
    rest = rights - (gain * lefts + offset)
    if _median(np.abs((gain - 1) * lefts + offset)) < _LEAST:
        gain, offset = 1.0, 0.0
    offsets = _smooth(rest, rows, columns, steps.shape, (width, height))
    if np.count_nonzero(np.abs(offsets) >= _LEAST) <= _FEW * offsets.size:
        return None if gain == 1 and offset == 0 else (gain, offset, None)
    return gain, offset, offsets


def _smooth(
    rest: NDArray[np.float32],
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
    grid: tuple[int, int],
    size: tuple[int, int],
) -> NDArray[np.float32]:
    """Return the offset that remains after gain and offset, smoothed; 0 far from all points.

    One value for 16 x 16 px of the views, whose width and height is ``size``.
    """
    plain = np.abs(rest) <= 2 * _PLAIN
    points, counted = np.zeros((2, *grid), np.float32)
    points[rows[plain], columns[plain]] = rest[plain]
    counted[rows[plain], columns[plain]] = 1
    coarse = max(size[0] // 16, 1), max(size[1] // 16, 1)
    total, count = (
        cv2.GaussianBlur(
            cv2.resize(image, coarse, interpolation=cv2.INTER_AREA), (0, 0), _SIGMA_PX / 16
        )
        for image in (points, counted)
    )
    return np.asarray(total / (count + np.float32(0.1)), np.float32)


def _line(lefts: NDArray[np.float32], rights: NDArray[np.float32]) -> tuple[float, float]:
    """Return gain and offset from left to right grey levels, (points,) each."""
    gain, offset = 1.0, _median(rights - lefts)
    for _ in range(3):
        rest = np.abs(rights - (gain * lefts + offset))
        plain = rest <= max(_PLAIN, 2 * _median(rest))
        x, y = lefts[plain].astype(np.float64), rights[plain].astype(np.float64)
        if len(x) < _LEAST_POINTS:
            break
        prior = _LEVELS**2
        gain = (float(np.mean((x - x.mean()) * (y - y.mean()))) + prior) / (float(x.var()) + prior)
        offset = float(y.mean()) - gain * float(x.mean())
    return gain, offset


def _median(values: NDArray[np.float32]) -> float:
    """Return a median, of float32; np.median takes longer, and at first loads np.ma."""
    ends = (len(values) - 1) // 2, len(values) // 2
    middle = np.partition(values, ends)[[*ends]]
    return float((middle[0] + middle[1]) / 2)
