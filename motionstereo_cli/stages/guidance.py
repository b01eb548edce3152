"""Guidance: the heading toward where depth is largest.

Works on *nearness*, disparity plus doffs in px, which is proportional to inverse depth: so it
needs no rig.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: Of the pixels of a strip, the share allowed to be nearer than its nearness says: noise.
_NEARER_SHARE = 0.2


def strip_nearness(
    nearness_px: NDArray[np.float32], strips: int, least_share: float
) -> NDArray[np.float32]:
    """Return how near things are in each vertical strip of the image, (strips,) float32 px.

    That is the nearness which all but a fifth of the strip's known pixels stay below.
    NaN where less than ``least_share`` (0..1) of the strip is known.

    Args:
        nearness_px: disparity + doffs, (height, width) float32, NaN = unknown.
        strips: number of strips, at most the width.
        least_share: share of a strip that has to be known.
    """
    result = np.full(strips, np.nan, np.float32)
    for number, strip in enumerate(np.array_split(nearness_px, strips, axis=1)):
        known = strip[~np.isnan(strip)]
        if len(known) > least_share * strip.size:
            result[number] = np.quantile(known, 1 - _NEARER_SHARE)
    return result


def heading(nearness_px: NDArray[np.float32]) -> float | None:
    """Return the direction of the largest depth as a place across the image, 0 left .. 1 right.

    The centre of the farthest strip and its two neighbours, each weighted by depth to the fourth
    power, so that the heading moves smoothly as one strip outdoes another. None where no strip is
    known.

    Args:
        nearness_px: nearness of each strip, (strips,) float32, NaN = unknown.
    """
    if np.isnan(nearness_px).all():
        return None
    farthest = int(np.nanargmin(nearness_px))
    near = np.arange(max(farthest - 1, 0), min(farthest + 2, len(nearness_px)))
    near = near[~np.isnan(nearness_px[near])]
    least = max(float(nearness_px[farthest]), 1.0)  # px: finer differences are noise
    weight = (least / np.maximum(nearness_px[near], least)) ** 4
    return float(np.average(near + 0.5, weights=weight)) / len(nearness_px)


def steadied(before: float | None, target: float, gain: float) -> float:
    """Return the heading moved from the one before toward a target by a share ``gain``, 0..1."""
    return target if before is None else before + gain * (target - before)


def nearest(nearness_px: NDArray[np.float32], least_share: float) -> float | None:
    """Return the nearness of the nearest thing in px; None where too little is known.

    All but a hundredth of the known pixels are farther.

    Args:
        nearness_px: disparity + doffs, (height, width) float32, NaN = unknown.
        least_share: share of the image, 0..1, that has to be known.
    """
    known = nearness_px[~np.isnan(nearness_px)]
    if len(known) <= least_share * nearness_px.size:
        return None
    return float(np.quantile(known, 0.99))
