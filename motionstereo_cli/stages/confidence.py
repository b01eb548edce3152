"""How sure a disparity is: the chance that it is right within 1 px."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: Logistic regression on what is known of a match: constant, log2 of votes, residual in grey
#: levels, age in frames. Fitted to whether disparities are within 1 px of the truth, on the
#: rendered corridor and cards, straight, turning, still and panning, at noise 1.5 and 4, each
#: scene with the same weight.
_CONSTANT, _PER_DOUBLING, _PER_GREY_LEVEL, _PER_FRAME = -4.38, 0.918, -0.157, -0.093

#: More votes than this say no more.
_MOST_VOTES = 512.0

#: A gap filled between two matches is right as often as a match with this evidence.
_FILLED_VOTES, _FILLED_RESIDUAL = 340.0, 3.0


def confidence(
    disparity_px: NDArray[np.float32],
    votes: NDArray[np.float32],
    residual: NDArray[np.float32],
    age_frames: NDArray[np.uint8],
) -> NDArray[np.float32]:
    """Return the chance 0..1 that each disparity is within 1 px, (height, width) float32.

    The chance is that of the truth *now*: an old trail may show what has moved on. NaN where the
    disparity is unknown.

    Args:
        disparity_px: (height, width) float32, NaN = unknown.
        votes: how many votes agree with it, (height, width) float32, NaN where it was filled in.
        residual: difference of grey between the views, (height, width) float32, NaN likewise.
        age_frames: frames since something moved there, (height, width) uint8.
    """
    at = ~np.isnan(disparity_px)
    doublings = np.log2(np.clip(np.nan_to_num(votes[at], nan=_FILLED_VOTES), 1, _MOST_VOTES))
    grey = np.nan_to_num(residual[at], nan=_FILLED_RESIDUAL)
    logit = _CONSTANT + _PER_DOUBLING * doublings + _PER_GREY_LEVEL * grey
    chance = np.full(disparity_px.shape, np.nan, np.float32)
    chance[at] = 1 / (1 + np.exp(-(logit + _PER_FRAME * age_frames[at])))
    return chance
