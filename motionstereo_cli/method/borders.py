"""Where objects end: a window of pixels makes them larger than they are, and hides what is behind.

In the right view, the left camera does not see what lies just to the right of a near object.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import borders as loops
from motionstereo_cli.compiled import checked_array

Reals = NDArray[np.float32]

#: Where disparity changes by more than this from pixel to pixel, in px, an object ends.
_LEAP = 1.5

#: So many pixels of a border may belong to what is behind.
_REACH_PX = 4

#: A pixel that is hidden from the left camera shows a difference of grey of this much, on average;
#: more than the second does not count. In sixteenths of a grey level.
_HIDDEN, _MAX_GREY = 6 * 16, 20 * 16

#: Grey changes where an object ends: what a level of that is worth. And what has to be gained. In
#: sixteenths of a grey level.
_PER_GREY_LEVEL, _MIN_GAIN = 6, 8

#: What is hidden is as wide as the leap of disparity, and by this much more, in px.
_MORE_PX = 4

#: Behind an object the disparity is the least of so many pixels, if that is not farther still by
#: the second: the first ones are matched together with what is hidden.
_BEHIND_PX, _MAX_LEAP = 8, 4.0


_LIMITS = loops.Limits(  # type: ignore[call-arg]  # mypy does not know its dataclasses
    _LEAP, _REACH_PX, _HIDDEN, _PER_GREY_LEVEL, _MAX_GREY, _MIN_GAIN
)


def trimmed(
    disparity_px: Reals, right: NDArray[np.uint8], left: NDArray[np.uint8]
) -> NDArray[np.float32]:
    """Return disparity with the borders of objects where grey says that they are.

    From each border inward, pixels go to what lies behind as long as that fits their grey better;
    a border where grey changes is preferred. On the right side of an object that is hidden from
    the left camera, and becomes unknown.

    Args:
        disparity_px: (height, width) float32, NaN = unknown.
        right, left: views of equal brightness, (height, width) uint8.
    """
    disparity_px = checked_array(disparity_px, np.float32)
    right, left = (checked_array(view, np.uint8, disparity_px.shape) for view in (right, left))
    result = np.empty_like(disparity_px)
    scene = loops.Scene(  # type: ignore[call-arg]
        disparity_px, right.astype(np.int16), left.astype(np.int16)
    )
    loops.trim(scene, _LIMITS, result)
    return result


def hidden_filled(disparity_px: Reals, where: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return disparity with what the left camera does not see as far as what is behind.

    Args:
        disparity_px: (height, width) float32, NaN = unknown.
        where: pixels that may be filled, (height, width) bool.
    """
    disparity_px = checked_array(disparity_px, np.float32)
    where = checked_array(where, np.bool_, disparity_px.shape)
    result = np.empty_like(disparity_px)
    loops.fill_hidden(
        disparity_px, where.view(np.uint8), _LEAP, _MORE_PX, _BEHIND_PX, _MAX_LEAP, result
    )
    return result
