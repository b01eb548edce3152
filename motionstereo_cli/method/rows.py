"""Matching at half the height, and disparity of all rows from it.

It takes half the time and is no worse, because noise averages out. Row j of the halves is the mean
of rows 2 j and 2 j + 1.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import checked_array, reused
from motionstereo_cli.compiled import rows as loops

#: Rows that make one.
ROWS = 2

#: Half rows whose disparities differ by less than this in px are interpolated; if they differ by
#: more, a pixel takes the one that is closer in grey by so many levels.
_TOLERANCE_PX, _NEARER = 1.5, 2.0


def halved(view: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the means of pairs of rows; the last of an odd number of rows is kept."""
    view = checked_array(view, np.uint8)
    result = np.empty((-(-len(view) // ROWS), view.shape[1]), np.uint8)
    loops.halve(view, result)
    return result


def halved_exactly(view: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the same in float32, not rounded."""
    view = checked_array(view, np.uint8)
    result = np.empty((-(-len(view) // ROWS), view.shape[1]), np.float32)
    loops.halve_exactly(view, result)
    return result


def halved_mask(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return where one of the two rows is set, (ceil(height / 2), width) bool."""
    upper, lower = mask[::2], mask[1::2]
    return np.concatenate((upper[: len(lower)] | lower, upper[len(lower) :]))


def whole(
    disparity_px: NDArray[np.float32], half_grey: NDArray[np.float32], grey: NDArray[np.uint8]
) -> NDArray[np.float32]:
    """Return the disparity of all rows, (height, width) float32, NaN = unknown.

    The upper row of a pair is a quarter of a half row above their middle. If the half row above
    has nearly the same disparity, both are interpolated; else grey decides between them, so that
    borders of objects and of holes follow the image. The lower row is treated likewise.

    Args:
        disparity_px: (ceil(height / 2), width) float32, NaN = unknown.
        half_grey: grey of the same rows, float32.
        grey: (height, width) uint8.
    """
    grey = checked_array(grey, np.uint8)
    half = (grey.shape[0] + 1) // ROWS, grey.shape[1]
    result = np.empty(grey.shape, np.float32)
    loops.whole(
        checked_array(disparity_px, np.float32, half),
        checked_array(half_grey, np.float32, half),
        *(grey, _TOLERANCE_PX, _NEARER, result),
    )
    return result


def without_fringes(
    disparity_px: NDArray[np.float32], where: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Return disparity where one can be, and most of the pixels around that can have one do.

    Those around are in a window of 5 x 5.

    Args:
        disparity_px: (height, width) float32, NaN = unknown.
        where: pixels that could, (height, width) bool.
    """
    disparity_px = checked_array(disparity_px, np.float32)
    where = checked_array(where, np.bool_, disparity_px.shape)
    result = np.empty_like(disparity_px)
    work = reused(loops.Workspace, disparity_px.shape[1])
    loops.drop_fringes(disparity_px, where.view(np.uint8), work, result)
    return result
