"""The matchers: from two memories to disparity.

A new matcher is a file of its own, a function here, and a row in ``settings.py``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from motionstereo_cli.method.balance import balanced
from motionstereo_cli.method.borders import hidden_filled, trimmed
from motionstereo_cli.method.cleaning import filled, without_speckles
from motionstereo_cli.method.confidence import confidence, confidence_by_margin
from motionstereo_cli.method.dense import ROWS, match_dense, smoothed, weights_of
from motionstereo_cli.method.memory import Memory, age_of, blurred, keys_of
from motionstereo_cli.method.regions import match_regions
from motionstereo_cli.method.residual import residual
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.method.trails import match_trails

if TYPE_CHECKING:
    from motionstereo_cli.types import Real

    #: Disparity, and what makes its confidence: it takes time, and few ask for it.
    Found = tuple[Real, Callable[[], Real]]


def _trails(right: Memory, left: Memory, settings: Settings) -> Found:
    s, wanted = settings, keys_of(right, settings)
    disparity, votes = match_trails(
        wanted,
        keys_of(left, s),
        s.max_disparity,
        block_px=(s.vote_rows, s.vote_columns),
        max_ratio=s.max_ratio,
        min_votes=s.min_votes,
    )
    differs = residual(disparity, blurred(right, s), blurred(left, s))
    matched = without_speckles(disparity, differs <= s.max_residual, s.speckle_px)
    disparity = filled(matched, wanted > 0, s.gap_px)
    return disparity, lambda: confidence(disparity, matched, votes, differs, age_of(right, s))


def _dense(right: Memory, left: Memory, settings: Settings) -> Found:
    s, wanted = settings, keys_of(right, settings)
    charged = wanted > 0
    proposed, _ = match_trails(
        wanted[::ROWS],
        keys_of(left, s)[::ROWS],
        s.max_disparity,
        block_px=(max(s.vote_rows // ROWS, 1), s.vote_columns),
        max_ratio=s.max_ratio,
        min_votes=max(s.min_votes // ROWS, 1),
    )
    right_grey = smoothed(right.grey)
    left_grey = balanced(right_grey, smoothed(left.grey), s.max_disparity)
    disparity, margin = match_dense(
        *(right_grey, left_grey, charged, proposed),
        weights_of(proposed, wanted[::ROWS], age_of(right, s)[::ROWS] == 0),
        s.max_disparity,
    )
    disparity = trimmed(disparity, right_grey, left_grey)
    matched = without_speckles(disparity, ~np.isnan(disparity), s.speckle_px)
    disparity = hidden_filled(filled(matched, charged, s.gap_px), charged)
    disparity[~charged] = np.nan
    return disparity, lambda: confidence_by_margin(disparity, matched, margin)


def _regions(right: Memory, left: Memory, settings: Settings) -> Found:
    s = settings
    disparity = match_regions(keys_of(right, s), keys_of(left, s), s.max_disparity)
    return disparity, lambda: np.full_like(disparity, np.nan)


#: By the name that users give, as :data:`~motionstereo_cli.method.settings.MATCHERS` describes
#: them. Each takes the right and the left memory and the settings; it returns the disparity in px
#: of each charged right pixel and what makes its confidence 0..1, both (height, width) float32,
#: NaN = unknown.
MATCH: dict[str, Callable[[Memory, Memory, Settings], Found]] = {
    "trails": _trails,
    "dense": _dense,
    "regions": _regions,
}
