"""Cleaning a disparity image: what has no company goes, short gaps close."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def without_speckles(disparity_px: NDArray[np.float32], least_px: int) -> NDArray[np.float32]:
    """Return a disparity image without connected patches of fewer than ``least_px`` pixels."""
    sixteenths = np.where(np.isnan(disparity_px), -16, disparity_px * 16).astype(np.int16)
    cv2.filterSpeckles(sixteenths, -16, least_px, 16)
    return np.where(sixteenths < 0, np.float32(np.nan), disparity_px)


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
    known = ~np.isnan(disparity_px)
    column = np.arange(disparity_px.shape[1], dtype=np.int32)
    before = np.maximum.accumulate(np.where(known, column, -1), axis=1)
    after = np.minimum.accumulate(np.where(known, column, len(column))[:, ::-1], axis=1)[:, ::-1]
    bridged = (before >= 0) & (after < len(column)) & (after - before <= gap_px + 1)
    y, x = np.nonzero(bridged & where & ~known)
    a, b = before[y, x], after[y, x]
    low, step = disparity_px[y, a], disparity_px[y, b] - disparity_px[y, a]
    result = disparity_px.copy()
    result[y, x] = np.where(np.abs(step) <= 2, low + step * ((x - a) / (b - a)), np.nan)
    return result
