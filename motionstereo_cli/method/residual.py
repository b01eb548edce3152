"""The difference of grey between corresponding pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import checked_array, reused
from motionstereo_cli.compiled import residual as loops


def residual(
    disparity_px: NDArray[np.float32], right: NDArray[np.uint8], left: NDArray[np.uint8]
) -> NDArray[np.float32]:
    """Return how much the grey of corresponding pixels differs, (height, width) float32.

    The mean, over a pixel and its eight neighbours, of the absolute difference of grey levels,
    less the median difference of all: two cameras rarely agree on brightness. It reveals
    wrong disparities on texture, including those that were right when the trail was made and no
    longer are. NaN where the disparity is unknown.

    Args:
        disparity_px: x in the left view minus x in the right one, float32, NaN = unknown.
        right, left: grey levels of the two views, (height, width) uint8.
    """
    disparity_px = checked_array(disparity_px, np.float32)
    right, left = (checked_array(view, np.uint8, disparity_px.shape) for view in (right, left))
    result = np.empty_like(disparity_px)
    work = reused(loops.Workspace, *disparity_px.shape)
    loops.residual(disparity_px, right, left, work, result)
    return result
