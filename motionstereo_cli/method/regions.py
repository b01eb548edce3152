"""Disparity by the largest region of equal match keys: the paper's description read literally."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def match_regions(
    right: NDArray[np.uint16], left: NDArray[np.uint16], max_disparity: int
) -> NDArray[np.float32]:
    """Return the disparity of each right pixel, (height, width) float32 px, NaN = unknown.

    The left memory is displaced over the right one pixel by pixel. At each
    displacement the pixels of equal key form connected regions (4-neighbours). Each pixel keeps
    the displacement at which its region was largest, the smaller one if two are equal. A pixel
    counts if the left pixel it points at kept the same displacement: one partner per pixel.

    Args:
        right, left: match keys of the two views, (height, width) uint16, 0 = at rest.
        max_disparity: largest x in the left view minus x in the right one, px.
    """
    height, width = right.shape
    right_support = np.zeros((height, width), np.int32)
    left_support = np.zeros((height, width), np.int32)
    right_choice = np.full((height, width), -1, np.int32)
    left_choice = np.full((height, width), -2, np.int32)
    for displacement in range(min(max_disparity, width - 1) + 1):
        seen_by_right = np.s_[:, : width - displacement]
        seen_by_left = np.s_[:, displacement:]
        equal = (right[seen_by_right] == left[seen_by_left]) & (right[seen_by_right] > 0)
        _, region, stats, _ = cv2.connectedComponentsWithStats(
            equal.astype(np.uint8), connectivity=4
        )
        size = stats[:, cv2.CC_STAT_AREA]
        size[0] = 0  # the background
        support = size[region]
        for best, choice, seen in (
            (right_support, right_choice, seen_by_right),
            (left_support, left_choice, seen_by_left),
        ):
            larger = support > best[seen]
            best[seen][larger] = support[larger]
            choice[seen][larger] = displacement
    partner = np.arange(width) + np.maximum(right_choice, 0)
    mutual = right_choice == np.take_along_axis(left_choice, np.minimum(partner, width - 1), 1)
    return np.where(mutual, right_choice, np.nan).astype(np.float32)
