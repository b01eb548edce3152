"""How well the two views agree on grey where they are said to see the same point."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

#: Differences of grey beyond this say no more.
_MOST = 64.0


def residual(
    disparity_px: NDArray[np.float32], right: NDArray[np.uint8], left: NDArray[np.uint8]
) -> NDArray[np.float32]:
    """Return how much the grey of corresponding pixels differs, (height, width) float32.

    The mean, over a pixel and its eight neighbours, of the absolute difference of grey levels,
    less the median difference of all: two cameras rarely agree on brightness. A wrong disparity
    shows wherever there is texture; so does one that was right when the trail was left there and
    no longer is. NaN where the disparity is unknown.

    Args:
        disparity_px: x in the left view minus x in the right one, float32, NaN = unknown.
        right, left: grey levels of the two views, (height, width) uint8.
    """
    known = ~np.isnan(disparity_px)
    y, x = np.nonzero(known)
    place = x + disparity_px[y, x]
    column = np.minimum(place.astype(np.intp), left.shape[1] - 1)
    beyond = np.minimum(column + 1, left.shape[1] - 1)
    near, far = left[y, column].astype(np.float32), left[y, beyond].astype(np.float32)
    difference = right[y, x] - (near + (far - near) * (place - column))
    if len(difference):
        difference -= np.median(difference)
    total = np.zeros(disparity_px.shape, np.float32)
    total[y, x] = np.minimum(np.abs(difference), _MOST)
    count = _sum_3x3(known.astype(np.float32))
    mean = _sum_3x3(total) / np.maximum(count, 1)
    return np.where(known, mean, np.float32(np.nan))


def _sum_3x3(image: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(cv2.boxFilter(image, -1, (3, 3), normalize=False), np.float32)
