"""Grey-level bands, equation (4) of the paper."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import memory as loops


def blur(grey: NDArray[np.uint8], sigma_px: float) -> NDArray[np.uint8]:
    """Return a grey image (height, width) uint8 smoothed by a Gaussian; sigma 0 returns it as is.

    Noise makes pixels near the edge of a band flicker, and each flicker counts as motion; a
    light blur prevents most of it.
    """
    if sigma_px == 0:
        return grey
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), sigma_px), np.uint8)


def band_table(n: int, grey_min: int = 0, grey_max: int = 255) -> NDArray[np.uint8 | np.uint16]:
    """Return the band 1..n of each grey level 0..255, (256,), uint8 or, for n = 256, uint16.

    Equation (4): GLB = floor((GL - GLmin) * n / (GLmax - GLmin + 1)) + 1. Levels outside
    GLmin..GLmax fall into the first or last band.
    """
    level = np.clip(np.arange(256), grey_min, grey_max) - grey_min
    band = level * n // (grey_max - grey_min + 1) + 1
    return band.astype(np.uint8 if n < 256 else np.uint16)


def bands(
    grey: NDArray[np.uint8], n: int, grey_min: int = 0, grey_max: int = 255
) -> NDArray[np.uint8 | np.uint16]:
    """Return the band of each pixel of a grey image (height, width) uint8.

    As :func:`band_table` has them: where there are fewer bands than levels, one product gives the
    same.
    """
    levels = grey_max - grey_min + 1
    if n >= levels:
        return band_table(n, grey_min, grey_max)[grey]
    band = np.empty(grey.shape, np.uint8)
    loops.bands(np.ravel(grey), grey_min, grey_max, -((-n << 16) // levels), band.ravel())
    return band
