"""Depth from disparity."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def depth(
    disparity_px: NDArray[np.float32], focal_px: float, baseline_m: float, doffs_px: float = 0.0
) -> NDArray[np.float32]:
    """Return depth along the optical axis in m, (height, width) float32, NaN = unknown.

    Z = focal_px * baseline_m / (disparity_px + doffs_px). Where the divisor is not positive the
    point would lie at or beyond infinity: unknown.

    Args:
        disparity_px: x in the left image minus x in the right one, float32, NaN = unknown.
        focal_px: focal length in px.
        baseline_m: distance between the cameras in m.
        doffs_px: x of the right principal point minus x of the left one, in px.
    """
    inverse = disparity_px + np.float32(doffs_px)
    np.copyto(inverse, np.nan, where=inverse <= 0)
    np.divide(np.float32(focal_px * baseline_m), inverse, out=inverse)
    return inverse
