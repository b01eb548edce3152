"""The chance of each disparity: the loop of :mod:`motionstereo_cli.method.confidence`."""

import cython
import numpy as np
from cython.cimports.libc.math import isnan

NAN = cython.declare(cython.float, np.nan)


def confidence(
    disparity: cython.const[cython.float][:, ::1],
    matched: cython.const[cython.float][:, ::1],
    votes: cython.const[cython.float][:, ::1],
    residual: cython.const[cython.float][:, ::1],
    age: cython.const[cython.uchar][:, ::1],
    per_vote: cython.const[cython.float][::1],
    per_grey_level: cython.float,
    per_frame: cython.float,
    filled_votes: cython.float,
    filled_residual: cython.float,
    logistic: cython.const[cython.float][::1],
    largest_logit: cython.float,
    steps: cython.float,
    chance: cython.float[:, ::1],
) -> None:
    """Fill in the chance of each disparity.

    Args:
        disparity, matched, votes, residual, age: as in the stage of this name.
        per_vote: logit of each number of votes, the constant included.
        per_grey_level, per_frame: logit of a unit of residual and of age.
        filled_votes, filled_residual: what counts where ``matched`` is unknown.
        logistic: its values from minus to plus the largest logit.
        largest_logit: see ``logistic``.
        steps: of ``logistic`` for a unit of logit.
        chance: gets the chance, (height, width) float32, NaN = unknown.
    """
    x: cython.int
    y: cython.int
    most_votes: cython.int = cython.cast(cython.int, per_vote.shape[0]) - 1
    last: cython.int = cython.cast(cython.int, logistic.shape[0]) - 1
    with cython.nogil:
        for y in range(cython.cast(cython.int, disparity.shape[0])):
            for x in range(cython.cast(cython.int, disparity.shape[1])):
                if isnan(disparity[y, x]):
                    chance[y, x] = NAN
                    continue
                is_filled: cython.bint = isnan(matched[y, x])
                count: cython.float = filled_votes if is_filled else votes[y, x]
                count = count if count > 0 else 0
                count = count if count < most_votes else most_votes
                grey: cython.float = filled_residual if is_filled else residual[y, x]
                frames: cython.float = cython.cast(cython.float, age[y, x])
                logit: cython.float = (
                    per_vote[cython.cast(cython.int, count)]
                    + per_grey_level * grey
                    + per_frame * frames
                )
                step: cython.float = (logit + largest_logit) * steps
                step = step if step > 0 else 0
                step = step if step < last else last
                chance[y, x] = logistic[cython.cast(cython.int, step)]
