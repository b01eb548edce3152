"""How well the two views agree on grey where they are said to see the same point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import kernel

#: Differences of grey beyond this say no more.
_MOST = np.float32(64)

#: The median of all differences is told to this part of a grey level.
_PER_GREY_LEVEL = 16


@kernel
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
    height, width = disparity_px.shape
    difference = np.empty((height, width), np.float32)
    histogram = np.zeros(2 * 256 * _PER_GREY_LEVEL, np.int32)
    known = 0
    for y in range(height):
        for x in range(width):
            if np.isnan(disparity_px[y, x]):
                difference[y, x] = np.nan
                continue
            place = np.float32(x) + disparity_px[y, x]
            column = min(int(place), width - 1)
            near = np.float32(left[y, column])
            far = np.float32(left[y, min(column + 1, width - 1)])
            here = np.float32(right[y, x]) - (near + (far - near) * (place - np.float32(column)))
            difference[y, x] = here
            histogram[
                int((here + np.float32(256)) * np.float32(_PER_GREY_LEVEL) + np.float32(0.5))
            ] += 1
            known += 1
    # The two in the middle, which are one if the number is odd.
    lower = upper = -1
    below = 0
    for step in range(len(histogram)):
        below += histogram[step]
        if lower < 0 and 2 * below >= known:
            lower = step
        if 2 * below > known:
            upper = step
            break
    median = np.float32((lower + upper) / (2 * _PER_GREY_LEVEL) - 256)

    result = np.empty((height, width), np.float32)
    total = np.zeros(width + 2, np.float32)  # of three rows, with a border of nothing
    count = np.zeros(width + 2, np.float32)
    for y in range(height):
        total.fill(0)
        count.fill(0)
        for row in range(max(y - 1, 0), min(y + 2, height)):
            for x in range(width):
                here = min(abs(difference[row, x] - median), _MOST)
                is_known = not np.isnan(here)
                total[x + 1] += here if is_known else np.float32(0)
                count[x + 1] += np.float32(1) if is_known else np.float32(0)
        for x in range(width):
            mean = (total[x] + total[x + 1] + total[x + 2]) / max(
                count[x] + count[x + 1] + count[x + 2], np.float32(1)
            )
            result[y, x] = np.float32(np.nan) if np.isnan(difference[y, x]) else mean
    return result
