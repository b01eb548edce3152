"""Why a pixel has no disparity."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: Codes of reasons; 0 = known.
_NOT_MOVED, _HIDDEN, _OUTSIDE, _AMBIGUOUS, _AT_LIMIT = (np.uint8(code) for code in range(1, 6))

#: A step of disparity by more than this is an object's border; the hidden area is as wide as the
#: step plus so many px.
_LEAP_PX, _MORE_PX = 1.5, 4


def reasons(
    disparity_px: NDArray[np.float32], wanted: NDArray[np.bool_], at_limit: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """Return why each pixel is unknown, (height, width) uint8, 0 = known.

    In the right view, the left camera does not see what is just to the right of a near object, nor
    what is so far right that its partner is beyond the border. Both follow from the known
    disparities to the left and to the right in the row, of which the smaller is the background's.

    Args:
        disparity_px: (height, width) float32, NaN = unknown.
        wanted: pixels that could have one, (height, width) bool.
        at_limit: where the best match was the last one of the range, (height, width) bool.
    """
    known = ~np.isnan(disparity_px)
    width = disparity_px.shape[1]
    columns = np.arange(width)
    before = np.maximum.accumulate(np.where(known, columns, -1), axis=1)
    after = np.minimum.accumulate(np.where(known, columns, width)[:, ::-1], axis=1)[:, ::-1]
    # If nothing is known on one side, the other side counts for both.
    left = np.where(before >= 0, before, np.minimum(after, width - 1))
    right = np.where(after < width, after, left)
    nearer, behind = (np.take_along_axis(disparity_px, at, axis=1) for at in (left, right))
    leap = nearer - behind
    hidden = (leap > _LEAP_PX) & (before >= 0) & (columns - left <= leap + _MORE_PX)
    outside = columns + np.fmin(nearer, behind) > width - 1
    result = np.full(disparity_px.shape, _AMBIGUOUS)
    for where, code in (
        (hidden, _HIDDEN),
        (outside, _OUTSIDE),
        (at_limit, _AT_LIMIT),
        (~wanted, _NOT_MOVED),
    ):
        result[where] = code
    result[known] = 0
    return result
