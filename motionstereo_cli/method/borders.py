"""Borders of objects: matching windows enlarge near objects and cover what is behind them.

In the right view, the left camera does not see what is just to the right of a near object.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import borders as loops
from motionstereo_cli.compiled import checked_array

Reals = NDArray[np.float32]

#: A step of disparity between pixels by more than this, in px, is an object's border.
_LEAP = 1.5

#: Maximum width of a border that may belong to what is behind, in px.
_REACH_PX = 4

#: Mean difference of grey of a pixel that is hidden from the left camera, and the limit of
#: differences, in sixteenths of a grey level.
_HIDDEN, _MAX_GREY = 6 * 16, 20 * 16

#: Borders of objects are borders of grey: the gain per level of a grey step, and the minimum gain,
#: in sixteenths of a grey level.
_PER_GREY_LEVEL, _MIN_GAIN = 6, 8

#: A hidden area is as wide as the step of disparity plus this, in px.
_MORE_PX = 4

#: The disparity behind an object is the smallest of so many pixels, if it is not smaller by more
#: than the second: the first pixels are matched together with the hidden ones.
_BEHIND_PX, _MAX_LEAP = 8, 4.0


def trimmed(
    disparity_px: Reals, right: NDArray[np.uint8], left: NDArray[np.uint8], wide: int = 1
) -> NDArray[np.float32]:
    """Return disparity with the borders of objects moved to where grey places them.

    From each border inward, pixels are assigned to what is behind as long as that fits their grey
    better; borders at steps of grey are preferred. On the right side of an object these pixels are
    hidden from the left camera, and become unknown.

    Args:
        disparity_px: (height, width) float32, NaN = unknown.
        right, left: views of equal brightness, (height, width) uint8.
        wide: px of these views in one of those that were matched.
    """
    disparity_px = checked_array(disparity_px, np.float32)
    right, left = (checked_array(view, np.uint8, disparity_px.shape) for view in (right, left))
    result = np.empty_like(disparity_px)
    scene = loops.Scene(disparity_px, right, left)  # type: ignore[call-arg]
    limits = loops.Limits(  # type: ignore[call-arg]  # mypy does not know its dataclasses
        _LEAP, _REACH_PX * wide, _HIDDEN, _PER_GREY_LEVEL, _MAX_GREY, _MIN_GAIN
    )
    loops.trim(scene, limits, np.empty(right.shape[1], np.uint8), result)
    return result


def hidden_filled(
    disparity_px: Reals, where: NDArray[np.bool_], wide: int = 1
) -> NDArray[np.float32]:
    """Return disparity with areas hidden from the left camera filled from what is behind.

    Args:
        disparity_px: (height, width) float32, NaN = unknown.
        where: pixels that may be filled, (height, width) bool.
        wide: px of the image in one of those that were matched.
    """
    disparity_px = checked_array(disparity_px, np.float32)
    where = checked_array(where, np.bool_, disparity_px.shape)
    result = np.empty_like(disparity_px)
    loops.fill_hidden(
        *(disparity_px, where.view(np.uint8)),
        *(_LEAP, _MORE_PX * wide, _BEHIND_PX, _MAX_LEAP, result),
    )
    return result
