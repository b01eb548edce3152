"""Temporal average of disparity where nothing moves, against flicker.

Only independent results of single frames are averaged, and only where nothing has moved since; so
an average never keeps what is gone, and depends on nothing older than its frames.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import checked_array
from motionstereo_cli.compiled import steady as loops

Reals = NDArray[np.float32]
Parts = NDArray[np.uint16]
Greys = NDArray[np.uint8]

#: Disparity of earlier frames is kept in whole parts of a px, in 16 bits.
PARTS_PER_PX = 32

#: Maximum differences of an averaged result: disparity in px, and grey in levels.
_TOLERANCE_PX, _MAX_GREY = 0.6, 4


def in_parts(disparity_px: Reals) -> Parts:
    """Return disparity in 32nds of a px, (height, width) uint16, 0 = unknown.

    That is half the memory. A known 0 becomes 1, and what is over 2,040 px that.
    """
    disparity_px = checked_array(disparity_px, np.float32)
    parts = np.empty(disparity_px.shape, np.uint16)
    loops.fill_parts(disparity_px.ravel(), PARTS_PER_PX, parts.ravel())
    return parts


def averaged(
    disparity_px: Reals,
    now: tuple[Parts, Greys],
    age: Greys,
    before: Sequence[tuple[Parts, Greys]],
) -> Reals:
    """Return disparity averaged with that of earlier frames, (height, width) float32.

    Args:
        disparity_px: of this frame alone, (height, width) float32, NaN = unknown.
        now: the same as :func:`in_parts` gives it, and grey of the reference view, with little
            noise, (height, width) uint8.
        age: frames since something moved there, (height, width) uint8.
        before: the same two of earlier frames, each of that frame alone, the oldest first.
    """
    disparity_px = checked_array(disparity_px, np.float32)
    shape, pixels = disparity_px.shape, disparity_px.size
    parts = checked_array(now[0], np.uint16, shape).ravel()
    grey = checked_array(now[1], np.uint8, shape).ravel()
    age = checked_array(age, np.uint8, shape).ravel()
    total, count = np.zeros(pixels, np.int16), np.zeros(pixels, np.uint8)
    for frames, (earlier, earlier_grey) in enumerate(reversed(before), 1):
        loops.add(
            *(parts, grey, age),
            checked_array(earlier, np.uint16, shape).ravel(),
            checked_array(earlier_grey, np.uint8, shape).ravel(),
            *(frames, _MAX_GREY, int(_TOLERANCE_PX * PARTS_PER_PX), total, count),
        )
    result = np.empty(shape, np.float32)
    loops.divide(disparity_px.ravel(), parts, PARTS_PER_PX, total, count, result.ravel())
    return result
