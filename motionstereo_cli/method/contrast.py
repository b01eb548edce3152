"""Local contrast: grey independent of brightness."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

#: Grey levels of the result per standard deviation of the texture; the middle is 128.
_SPREAD = 48

#: Mean and deviation are smooth, so they are computed at a quarter of the size.
_SMALLER = 4

#: Deviations below this many times the noise are weak, and are not amplified further.
_PER_NOISE = 8

#: A filter that responds to noise only: not to ramps, hardly to edges (Immerkaer, "Fast Noise
#: Variance Estimation", 1996). Its answer to noise of sigma 1 has a mean of 6 * sqrt(2 / pi).
_LAPLACIANS = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
_ANSWER = 6 * np.sqrt(2 / np.pi)

#: Noise is measured in blocks of this size, in the share of them with the least of it.
_BLOCK_PX, _QUIET_SHARE = 16, 0.2


def contrast(grey: NDArray[np.uint8], sigma_px: float, min_deviation: float) -> NDArray[np.uint8]:
    """Return local contrast, 128 + 48 (grey - mean) / (deviation + floor), (height, width) uint8.

    Mean and standard deviation are those of a Gaussian window. Bands of it neither depend on how
    bright a camera is nor on how light changes. The floor keeps noise from being taken for
    contrast: it is ``min_deviation``, or 8 times the noise where that is more.

    Args:
        grey: (height, width) uint8.
        sigma_px: standard deviation of the window; 0 returns the grey as it is.
        min_deviation: grey levels.
    """
    if sigma_px == 0:
        return grey
    noise = noise_of(grey)
    height, width = grey.shape
    small = max(width // _SMALLER, 1), max(height // _SMALLER, 1)
    levels = grey.astype(np.float32)
    sigma = sigma_px / _SMALLER
    mean, squares = (
        cv2.GaussianBlur(cv2.resize(image, small, interpolation=cv2.INTER_AREA), (0, 0), sigma)
        for image in (levels, levels * levels)
    )
    deviation = np.sqrt(np.maximum(squares - mean * mean - np.float32(noise * noise), 0))
    gain = np.float32(_SPREAD) / (deviation + np.float32(max(min_deviation, _PER_NOISE * noise)))
    offset = np.float32(128) - mean * gain
    gains, offsets = (cv2.resize(image, (width, height)) for image in (gain, offset))
    return np.asarray(cv2.convertScaleAbs(np.maximum(levels * gains + offsets, 0)), np.uint8)


def noise_of(grey: NDArray[np.uint8]) -> float:
    """Return the standard deviation of the noise of an image (height, width) uint8, grey levels.

    It is that of its smoothest blocks, so fine texture all over the image counts as noise.
    """
    height, width = (max(size // _BLOCK_PX, 1) for size in grey.shape)
    answer = cv2.absdiff(cv2.filter2D(grey, cv2.CV_16S, _LAPLACIANS), np.zeros(1))
    blocks = cv2.resize(answer.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    return float(np.quantile(blocks, _QUIET_SHARE)) / float(_ANSWER)
