"""Confidence: the chance that a disparity is right within 1 px."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import checked_array
from motionstereo_cli.compiled import confidence as loops

#: Logistic regression on properties of a match: constant, log2 of votes, residual in grey
#: levels, age in frames. Fitted to whether disparities are within 1 px of the truth, on the
#: rendered corridor and cards, straight, turning, still and panning, at noise 1.5 and 4, each
#: scene with the same weight.
_CONSTANT = -4.38
_PER_DOUBLING = 0.918
_PER_GREY_LEVEL = np.float32(-0.157)
_PER_FRAME = np.float32(-0.093)

#: More votes add no confidence.
_MAX_VOTES = 512

#: A filled gap is right as often as a match with these votes and this residual.
_FILLED_VOTES = np.float32(340)
_FILLED_RESIDUAL = np.float32(3)

#: The same for the dense matcher, whose margin says more than all else: constant, log2 of the
#: margin. Fitted on 60 clips of rendered corridors, turns, cards, layers and streets, unequal
#: cameras and strong compression among them, and on a rendered walk.
_DENSE_CONSTANT = -8.02
_PER_DOUBLED_MARGIN = 1.153
_MAX_MARGIN = 2048
_FILLED_MARGIN = np.float32(243)

#: Where a plane decides, its inliers' share says how sure it is: log2 of a margin that is as sure,
#: constant and per share. Fitted likewise.
_PLANE_CONSTANT, _PER_SHARE = np.float32(4.01), np.float32(5.19)

#: Standard deviation of disparity in px by its confidence, and its factor by the range of disparity
#: in a window around, in px: half of what 95 of 100 errors have at most, fitted likewise.
_CHANCES = (0.6, 0.75, 0.88, 0.94, 0.965, 0.98, 0.99)
_SIGMAS_PX = (3.0, 3.0, 1.56, 1.02, 0.50, 0.31, 0.18)
_BEYOND_PX = np.float32(1e6)  # more than any disparity
_WINDOW_PX, _RANGES_PX, _FACTORS = 5, (0.05, 0.2, 0.8, 3.0, 8.0), (0.3, 0.6, 0.93, 0.93, 9.4)

#: Tables, because logarithms and exponentials are slow: the contribution of votes, and the logistic
#: function from minus to plus the largest logit in steps of 1/64.
_PER_VOTE = (_CONSTANT + _PER_DOUBLING * np.log2(np.maximum(np.arange(_MAX_VOTES + 1), 1))).astype(
    np.float32
)
_PER_MARGIN = (
    _DENSE_CONSTANT + _PER_DOUBLED_MARGIN * np.log2(np.maximum(np.arange(_MAX_MARGIN + 1), 1))
).astype(np.float32)
_LARGEST_LOGIT = np.float32(10)
_STEPS = np.float32(64)
_LOGISTIC = (1 / (1 + np.exp(10 - np.arange(2 * 10 * 64 + 1) / 64))).astype(np.float32)


def confidence(
    disparity_px: NDArray[np.float32],
    matched_px: NDArray[np.float32],
    votes: NDArray[np.float32],
    residual: NDArray[np.float32],
    age_frames: NDArray[np.uint8],
) -> NDArray[np.float32]:
    """Return the chance 0..1 that each disparity is within 1 px, (height, width) float32.

    It is the chance of being right *now*: an old trail may show what has moved away. NaN where the
    disparity is unknown.

    Args:
        disparity_px: (height, width) float32, NaN = unknown.
        matched_px: the same without what was filled in, (height, width) float32.
        votes: how many votes agree with a match, (height, width) float32.
        residual: difference of grey between the views, (height, width) float32.
        age_frames: frames since something moved there, (height, width) uint8.
    """
    disparity_px = checked_array(disparity_px, np.float32)
    chance, shape = np.empty_like(disparity_px), disparity_px.shape
    loops.confidence(
        disparity_px,
        checked_array(matched_px, np.float32, shape),
        checked_array(votes, np.float32, shape),
        checked_array(residual, np.float32, shape),
        checked_array(age_frames, np.uint8, shape),
        *(_PER_VOTE, _PER_GREY_LEVEL, _PER_FRAME, _FILLED_VOTES, _FILLED_RESIDUAL),
        *(_LOGISTIC, _LARGEST_LOGIT, _STEPS, chance),
    )
    return chance


def margin_of_planes(share: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the margin that is as sure as a plane, (rows, width) float32.

    Args:
        share: of the samples that are its inliers, (rows, width) float32, NaN = no plane.
    """
    return np.asarray(np.exp2(_PLANE_CONSTANT + _PER_SHARE * share), np.float32)


def sigma_px(
    confidence: NDArray[np.float32], disparity_px: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the standard deviation of each disparity in px, (height, width) float32.

    95 of 100 errors are within two of it. Errors have longer tails than a normal distribution: 85
    of 100 are within one.

    Args:
        confidence: chance to be right within 1 px, (height, width) float32, NaN = unknown.
        disparity_px: (height, width) float32, NaN = unknown. Where it changes a lot, at the borders
            of objects, errors are larger.
    """
    window = np.ones((_WINDOW_PX, _WINDOW_PX), np.uint8)
    unknown = np.isnan(disparity_px)
    most = cv2.dilate(np.where(unknown, -_BEYOND_PX, disparity_px), window)
    least = cv2.erode(np.where(unknown, _BEYOND_PX, disparity_px), window)
    logs = np.log(np.maximum(most - least, np.float32(_RANGES_PX[0])))
    factor = np.exp(np.interp(logs, np.log(_RANGES_PX), np.log(_FACTORS)))
    return np.asarray(factor * np.interp(confidence, _CHANCES, _SIGMAS_PX), np.float32)


def confidence_by_margin(
    disparity_px: NDArray[np.float32],
    matched_px: NDArray[np.float32],
    margin: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Return the same for the dense matcher, (height, width) float32.

    Args:
        disparity_px: (height, width) float32, NaN = unknown.
        matched_px: the same without what was filled in, (height, width) float32.
        margin: by how much the second best disparity costs more, (height, width) float32; NaN where
            a disparity comes from a neighbour.
    """
    disparity_px = checked_array(disparity_px, np.float32)
    chance, nothing = np.empty_like(disparity_px), np.float32(0)
    margin = checked_array(margin, np.float32, disparity_px.shape)
    margin = np.where(np.isnan(margin), _FILLED_MARGIN, margin)
    loops.confidence(
        disparity_px,
        checked_array(matched_px, np.float32, disparity_px.shape),
        *(margin, margin, np.zeros(margin.shape, np.uint8)),
        *(_PER_MARGIN, nothing, nothing, _FILLED_MARGIN, nothing),
        *(_LOGISTIC, _LARGEST_LOGIT, _STEPS, chance),
    )
    return chance
