"""Motion as a change of band, equation (3) of the paper."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def motion(
    bands: NDArray[np.uint8 | np.uint16],
    bands_before: NDArray[np.uint8 | np.uint16],
    grey: NDArray[np.uint8],
    grey_before: NDArray[np.uint8],
    min_jump: int = 0,
) -> NDArray[np.bool_]:
    """Return where something moved between two frames, (height, width) bool.

    Equation (3): Mov = 1 where GLB(t) != GLB(t-1). With ``min_jump`` the grey level must
    also have changed by at least as much: near the edge of a band noise of one grey level is enough
    to change the band.

    Args:
        bands, bands_before: bands at t and t-1, (height, width).
        grey, grey_before: grey levels that the bands were taken from, (height, width) uint8.
        min_jump: least change in grey levels, 0..255.
    """
    moved = np.not_equal(bands, bands_before)
    if min_jump > 1:  # a change of band is a change of at least one grey level
        moved &= cv2.absdiff(grey, grey_before) >= min_jump
    return moved
