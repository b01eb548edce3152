"""How sure a disparity is: the chance that it is right within 1 px."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import kernel

#: Logistic regression on what is known of a match: constant, log2 of votes, residual in grey
#: levels, age in frames. Fitted to whether disparities are within 1 px of the truth, on the
#: rendered corridor and cards, straight, turning, still and panning, at noise 1.5 and 4, each
#: scene with the same weight.
_CONSTANT = -4.38
_PER_DOUBLING = 0.918
_PER_GREY_LEVEL = np.float32(-0.157)
_PER_FRAME = np.float32(-0.093)

#: More votes than this say no more.
_MAX_VOTES = 512

#: A gap filled between two matches is right as often as a match with this evidence.
_FILLED_VOTES = np.float32(340)
_FILLED_RESIDUAL = np.float32(3)

#: The same for the dense matcher: constant, log2 of the margin, age in frames.
_DENSE_CONSTANT = -6.0
_PER_DOUBLED_MARGIN = 1.0
_PER_DENSE_FRAME = np.float32(-0.03)
_MOST_MARGIN = 1024
_FILLED_MARGIN = np.float32(100)

#: Tables, for logarithms and exponentials take their time: what votes contribute, and the
#: logistic function from minus to plus the largest logit in steps of 1/64.
_PER_VOTE = (_CONSTANT + _PER_DOUBLING * np.log2(np.maximum(np.arange(_MAX_VOTES + 1), 1))).astype(
    np.float32
)
_PER_MARGIN = (
    _DENSE_CONSTANT + _PER_DOUBLED_MARGIN * np.log2(np.maximum(np.arange(_MOST_MARGIN + 1), 1))
).astype(np.float32)
_LARGEST_LOGIT = np.float32(10)
_STEPS = np.float32(64)
_LOGISTIC = (1 / (1 + np.exp(10 - np.arange(2 * 10 * 64 + 1) / 64))).astype(np.float32)


@kernel
def confidence(
    disparity_px: NDArray[np.float32],
    matched_px: NDArray[np.float32],
    votes: NDArray[np.float32],
    residual: NDArray[np.float32],
    age_frames: NDArray[np.uint8],
) -> NDArray[np.float32]:
    """Return the chance 0..1 that each disparity is within 1 px, (height, width) float32.

    The chance is that of the truth *now*: an old trail may show what has moved on. NaN where the
    disparity is unknown.

    Args:
        disparity_px: (height, width) float32, NaN = unknown.
        matched_px: the same without what was filled in, (height, width) float32.
        votes: how many votes agree with a match, (height, width) float32.
        residual: difference of grey between the views, (height, width) float32.
        age_frames: frames since something moved there, (height, width) uint8.
    """
    height, width = disparity_px.shape
    chance = np.empty((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            if np.isnan(disparity_px[y, x]):
                chance[y, x] = np.nan
                continue
            count, grey = votes[y, x], residual[y, x]
            if np.isnan(matched_px[y, x]):
                count, grey = _FILLED_VOTES, _FILLED_RESIDUAL
            logit = (
                _PER_VOTE[min(int(count), _MAX_VOTES)]
                + _PER_GREY_LEVEL * grey
                + _PER_FRAME * np.float32(age_frames[y, x])
            )
            step = int((logit + _LARGEST_LOGIT) * _STEPS)
            chance[y, x] = _LOGISTIC[max(min(step, len(_LOGISTIC) - 1), 0)]
    return chance


@kernel
def confidence_by_margin(
    disparity_px: NDArray[np.float32],
    matched_px: NDArray[np.float32],
    margin: NDArray[np.float32],
    age_frames: NDArray[np.uint8],
) -> NDArray[np.float32]:
    """Return the chance 0..1 that each disparity of the dense matcher is within 1 px, float32.

    Args:
        disparity_px: (height, width) float32, NaN = unknown.
        matched_px: the same without what was filled in, (height, width) float32.
        margin: by how much the second best disparity is worse, (height, width) float32.
        age_frames: frames since something moved there, (height, width) uint8.
    """
    height, width = disparity_px.shape
    chance = np.full((height, width), np.nan, np.float32)
    for y in range(height):
        for x in range(width):
            if np.isnan(disparity_px[y, x]):
                continue
            is_filled = np.isnan(matched_px[y, x]) or np.isnan(margin[y, x])
            excess = _FILLED_MARGIN if is_filled else margin[y, x]
            logit = _PER_MARGIN[min(int(excess), _MOST_MARGIN)] + _PER_DENSE_FRAME * np.float32(
                age_frames[y, x]
            )
            step = int((logit + _LARGEST_LOGIT) * _STEPS)
            chance[y, x] = _LOGISTIC[max(min(step, len(_LOGISTIC) - 1), 0)]
    return chance
