"""Disparity by pairing the trails of the right memory with those of the left one.

A *trail* is a maximal run of equal match keys in one row. Its two ends are the positions of a
moving edge at two successive instants, so each end of a pair of corresponding trails has the
disparity of that edge.

The loops are in :mod:`motionstereo_cli.compiled.trails`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import checked_array, checked_number, reused, trails

Reals = NDArray[np.float32]


def match_trails(
    right: NDArray[np.uint16],
    left: NDArray[np.uint16],
    max_disparity: int,
    *,
    block_px: tuple[int, int] = (8, 8),
    max_ratio: float = 0.9,
    min_votes: int = 16,
) -> tuple[Reals, Reals]:
    """Return the disparity of each right pixel in px, and how many votes agree with it.

    Trails of equal key are paired; each pair votes at both its ends for the disparity there, and
    neighbouring rows agree on the true ones. A pair's support is the votes at its two ends. A
    pair wins if it is the best for both its trails and stands out from the second best. Then
    only the winners vote again, and each end takes the centroid of the votes around it, which makes
    it sub-pixel. Between the ends disparity runs linearly. Trails without a partner, often split
    by noise or cut by an occlusion, take the disparity that their block elected, pixel by pixel,
    where the keys agree.

    Both images are (height, width) float32, NaN where the disparity is unknown.

    Args:
        right, left: match keys of the two views, (height, width) uint16, 0 = at rest.
        max_disparity: largest x in the left view minus x in the right one, px.
        block_px: height and width of the blocks that vote together.
        max_ratio: largest support of a trail's second best pair as a share of the best's.
        min_votes: votes, in 3 x 3 blocks and within +-2 px, that a disparity needs.
    """
    right = checked_array(right, np.uint16)
    left = checked_array(left, np.uint16, right.shape)
    checked_number("max_disparity", max_disparity, 0)
    for size_px in block_px:
        checked_number("block_px", size_px, 1)
    work = reused(trails.Workspace, *right.shape, max_disparity, *block_px)
    disparity, votes = np.empty(right.shape, np.float32), np.empty(right.shape, np.float32)
    trails.match(right, left, max_ratio, min_votes, work, disparity, votes)
    return disparity, votes
