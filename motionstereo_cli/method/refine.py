"""Disparity between whole px: one step of Lucas and Kanade.

After "An Iterative Image Registration Technique with an Application to Stereo Vision" (1981):
within a window, the shift that makes the left view equal the right one follows from grey's slope.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float32]

#: Windows around each pixel, px and rows. Where disparities in it differ by more than this, in px,
#: things end: there disparity stays as it is.
_WINDOW, _MAX_RANGE_PX = (15, 7), 3.0

#: Damping in squared grey levels per px, and how much of the mean squared difference of grey is
#: added to it: where views differ by more than a shift, it moves less.
_DAMPING, _PER_DIFFERENCE = np.float32(1), np.float32(1)

#: Differences of more grey levels than this do not count. It moves by at most so many px.
_MAX_GREY, _MAX_STEP_PX = 20.0, 0.75


def refined(disparity_px: Reals, right: Reals, left: Reals) -> NDArray[np.float32]:
    """Return disparity moved to where the views are alike, (rows, width) float32, NaN = unknown.

    Args:
        disparity_px: (rows, width) float32, NaN = unknown.
        right, left: views of equal brightness, (rows, width) float32.
    """
    known = ~np.isnan(disparity_px)
    weight = known.astype(np.float32)
    value = np.where(known, disparity_px, np.float32(0))
    box = np.ones(_WINDOW[::-1], np.uint8)
    highest = cv2.dilate(np.where(known, disparity_px, np.float32(-1e4)), box)
    lowest = cv2.erode(np.where(known, disparity_px, np.float32(1e4)), box)
    flat = known & (highest - lowest <= _MAX_RANGE_PX)
    start = np.where(flat, _mean(value) / np.maximum(_mean(weight), np.float32(1e-3)), value)
    across, down = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in value.shape[::-1]))
    across += start
    there, slope = (
        cv2.remap(image, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for image in (left, _slope(left))
    )
    slope = (slope + _slope(right)) / np.float32(2)
    differs = there - right
    weight *= (np.abs(differs) < _MAX_GREY) & (across <= value.shape[1] - 1)
    damping = _DAMPING + _PER_DIFFERENCE * _mean(weight * differs * differs)
    step = _mean(weight * slope * differs) / (_mean(weight * slope * slope) + damping)
    moved = np.clip(start - step, value - _MAX_STEP_PX, value + _MAX_STEP_PX)
    return np.where(flat, np.maximum(moved, 0), disparity_px)


def _mean(image: Reals) -> Reals:
    return cv2.boxFilter(image, -1, _WINDOW, borderType=cv2.BORDER_REPLICATE)  # type: ignore[return-value]


def _slope(grey: Reals) -> Reals:
    return cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=1, scale=0.5)  # type: ignore[return-value]
