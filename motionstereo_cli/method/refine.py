"""Sub-pixel refinement: one step of Lucas and Kanade.

After "An Iterative Image Registration Technique with an Application to Stereo Vision" (1981):
within a window, the shift that makes the left view equal the right one follows from grey's slope.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import checked_array, reused
from motionstereo_cli.compiled import refine as loops

Reals = NDArray[np.float32]

#: Where disparities in a window of 15 px and 7 rows differ by more than this, in px, objects end,
#: and disparity is not refined.
_MAX_RANGE_PX = 3.0

#: Damping in squared grey levels per px, and how much of the mean squared difference of grey is
#: added to it: where views differ by more than a shift, steps are smaller.
_DAMPING, _PER_DIFFERENCE = 1.0, 1.0

#: Limit of differences in grey levels, and of a step in px.
_MAX_GREY, _MAX_STEP_PX = 20.0, 0.75

_LIMITS = loops.Limits(  # type: ignore[call-arg]  # mypy does not know its dataclasses
    _MAX_RANGE_PX, _DAMPING, _PER_DIFFERENCE, _MAX_GREY, _MAX_STEP_PX
)


def refined(disparity_px: Reals, right: Reals, left: Reals) -> NDArray[np.float32]:
    """Return disparity refined between whole px, (rows, width) float32, NaN = unknown.

    Args:
        disparity_px: (rows, width) float32, NaN = unknown.
        right, left: views of equal brightness, (rows, width) float32.
    """
    disparity_px = checked_array(disparity_px, np.float32)
    shape = disparity_px.shape
    right, left = (checked_array(view, np.float32, shape) for view in (right, left))
    result = np.empty_like(disparity_px)
    loops.refine(disparity_px, right, left, _LIMITS, reused(loops.Workspace, shape[1]), result)
    return result
