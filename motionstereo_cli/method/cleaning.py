"""Cleaning of disparity images: speckles are removed, short gaps filled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import checked_array, cleaning, reused


def without_speckles(
    disparity_px: NDArray[np.float32], where: NDArray[np.bool_], min_px: int
) -> NDArray[np.float32]:
    """Return a disparity image without connected patches of at most ``min_px`` pixels.

    Args:
        disparity_px: (height, width) float32, NaN = unknown.
        where: pixels that count, (height, width) bool; all others become unknown.
        min_px: size of the largest patch that is removed.
    """
    disparity_px = checked_array(disparity_px, np.float32)
    where = checked_array(where, np.bool_, disparity_px.shape)
    result = np.empty_like(disparity_px)
    work = reused(cleaning.Workspace, *disparity_px.shape)
    cleaning.without_speckles(disparity_px, where.view(np.uint8), min_px, work, result)
    return result


def filled(
    disparity_px: NDArray[np.float32], where: NDArray[np.bool_], gap_px: int
) -> NDArray[np.float32]:
    """Return a disparity image with gaps in its rows filled linearly from side to side.

    Trails of a pixel or two often have no match, because noise splits them in one view only. A gap
    is filled if it is short and the disparities on both sides agree within 2 px.

    Args:
        disparity_px: (height, width) float32, NaN = unknown.
        where: pixels that may be filled, (height, width) bool.
        gap_px: widest gap that is filled.
    """
    disparity_px = checked_array(disparity_px, np.float32)
    where = checked_array(where, np.bool_, disparity_px.shape)
    result = np.empty_like(disparity_px)
    cleaning.fill(disparity_px, where.view(np.uint8), gap_px, result)
    return result
