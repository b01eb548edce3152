"""Cleaning a disparity image: what has no company goes, short gaps close."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import kernel

#: cv2.filterSpeckles knows whole numbers alone.
_PER_PX = 16
_NOTHING = -_PER_PX


def without_speckles(
    disparity_px: NDArray[np.float32], where: NDArray[np.bool_], min_px: int
) -> NDArray[np.float32]:
    """Return a disparity image without connected patches of fewer than ``min_px`` pixels.

    Args:
        disparity_px: (height, width) float32, NaN = unknown.
        where: pixels that count, (height, width) bool; all others become unknown.
        min_px: pixels of the smallest patch that stays.
    """
    sixteenths = _sixteenths(disparity_px, where)
    cv2.filterSpeckles(sixteenths, _NOTHING, min_px, _PER_PX)
    return _kept(disparity_px, sixteenths)


@kernel
def _sixteenths(disparity_px: NDArray[np.float32], where: NDArray[np.bool_]) -> NDArray[np.int16]:
    height, width = disparity_px.shape
    result = np.empty((height, width), np.int16)
    for y in range(height):
        for x in range(width):
            known = where[y, x] and not np.isnan(disparity_px[y, x])
            result[y, x] = int(disparity_px[y, x] * _PER_PX) if known else _NOTHING
    return result


@kernel
def _kept(disparity_px: NDArray[np.float32], sixteenths: NDArray[np.int16]) -> NDArray[np.float32]:
    height, width = disparity_px.shape
    result = disparity_px.copy()
    for y in range(height):
        for x in range(width):
            if sixteenths[y, x] < 0:
                result[y, x] = np.nan
    return result


@kernel
def filled(
    disparity_px: NDArray[np.float32], where: NDArray[np.bool_], gap_px: int
) -> NDArray[np.float32]:
    """Return a disparity image with gaps in its rows filled linearly from side to side.

    Trails of a pixel or two often find no partner, for noise splits them in one view alone. A gap
    is filled where it is short and the disparities on its two sides agree within 2 px.

    Args:
        disparity_px: (height, width) float32, NaN = unknown.
        where: pixels that may be filled, (height, width) bool.
        gap_px: widest gap that is filled.
    """
    height, width = disparity_px.shape
    result = disparity_px.copy()
    for y in range(height):
        before = -gap_px - 2  # the last pixel known; before the row there is none in reach
        for x in range(width):
            if np.isnan(disparity_px[y, x]):
                continue
            length = x - before
            if 1 < length <= gap_px + 1:
                step = disparity_px[y, x] - disparity_px[y, before]
                if abs(step) <= 2:
                    for column in range(before + 1, x):
                        if where[y, column]:
                            share = (column - before) / length
                            result[y, column] = disparity_px[y, before] + step * share
            before = x
    return result
