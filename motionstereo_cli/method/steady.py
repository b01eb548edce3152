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
Greys = NDArray[np.uint8]

#: Maximum differences of an averaged result: disparity in px, and grey in levels.
_TOLERANCE_PX, _MAX_GREY = 0.6, 4


def averaged(
    disparity_px: Reals, grey: Greys, age: Greys, before: Sequence[tuple[Reals, Greys]]
) -> Reals:
    """Return disparity averaged with that of earlier frames, (height, width) float32.

    Args:
        disparity_px: of this frame alone, (height, width) float32, NaN = unknown.
        grey: of the reference view, with little noise, (height, width) uint8.
        age: frames since something moved there, (height, width) uint8.
        before: disparity and grey of earlier frames, each of that frame alone, the oldest first.
    """
    now = checked_array(disparity_px, np.float32)
    shape = now.shape
    grey, age = checked_array(grey, np.uint8, shape), checked_array(age, np.uint8, shape)
    total, count = now.copy(), np.ones(shape, np.uint8)
    for frames, (earlier_px, earlier_grey) in enumerate(reversed(before), 1):
        loops.add(
            *(now, grey, age),
            checked_array(earlier_px, np.float32, shape),
            checked_array(earlier_grey, np.uint8, shape),
            *(frames, _MAX_GREY, _TOLERANCE_PX, total, count),
        )
    loops.divide(count, total)
    return total
