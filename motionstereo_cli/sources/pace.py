"""Gaps in a constant rate: images that should have come and did not."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np

#: At a constant rate, steps are multiples of a period within this share.
_JITTER = 0.25

#: If more than this share of the steps are longer, the rate varies and nothing is missing.
_LEAPING_SHARE = 0.25

#: A longer step, in s, is a pause of the recording.
_PAUSE_S = 10


class Rhythm(NamedTuple):
    """The rate in an index of time stamps.

    Attributes:
        rate: constant rate in images per second, None if it varies.
        places: number of images and gaps.
    """

    rate: Fraction | None
    places: int


def rhythm(stamps: Sequence[int], time_base: Fraction) -> Rhythm:
    """Return the rhythm of time stamps in units of ``time_base``, in any order."""
    ordered = sorted(stamps)
    steps = [later - sooner for sooner, later in itertools.pairwise(ordered)]
    period = float(np.median(steps)) if steps else 0
    if period <= 0:
        return Rhythm(None, len(stamps))
    paused = _PAUSE_S / time_base
    counted = [(step, round(step / period)) for step in steps if step < paused]
    leaps = sum(whole > 1 for _, whole in counted)
    even = all(abs(step / period - whole) < _JITTER and whole for step, whole in counted)
    if not even or leaps > _LEAPING_SHARE * len(counted):
        return Rhythm(None, len(stamps))
    wholes = sum(whole for _, whole in counted)
    ticks = sum(step for step, _ in counted)
    holes = sum(whole - 1 for _, whole in counted)
    return Rhythm(Fraction(wholes) / (ticks * time_base), len(stamps) + holes)


class Pace:
    """Follows the time stamps of a stream, and finds gaps in a constant rate.

    Args:
        rate: images per second, None if unknown.
        time_base: seconds per unit of the time stamps.
        steady: whether the rate is constant; None = to be found out.
        places: total number of images and gaps, None if unknown.

    Attributes:
        steady: as given, or as found so far.
        missing: images missing so far.
        pause: the first step that is too long for a gap: its length and begin in s.
    """

    def __init__(
        self,
        rate: Fraction | None,
        time_base: Fraction,
        *,
        steady: bool | None,
        places: int | None,
    ) -> None:
        self._time_base = time_base
        # Whole numbers: fractions take ten times as long, of every image.
        self._longest = math.floor(_PAUSE_S / time_base)
        per_tick = time_base * (rate or 0)
        self._periods, self._ticks = per_tick.numerator, per_tick.denominator
        self._known, self._places = steady is not None, places
        self.steady = steady if rate else False
        self.missing = 0
        self.pause: tuple[float, float] | None = None
        self._steps = self._leaps = 0

    def hole(self, last_pts: int, pts: int, failed: int, last_number: int) -> int:
        """Return how many images are missing between two that came.

        Args:
            last_pts, pts: time stamps of the two.
            failed: number of images between them that could not be decoded.
            last_number: number of the first of the two.
        """
        if not self.steady and (self._known or self.steady is False):
            return 0
        step = pts - last_pts
        if step > self._longest:
            begin_s, step_s = (float(each * self._time_base) for each in (last_pts, step))
            self.pause = self.pause or (step_s, begin_s)
            return 0
        periods = step * self._periods / self._ticks
        steps = round(periods)
        hole = steps - 1 - failed
        if not self._known:
            self._steps += 1
            self._leaps += hole > 0
            self.steady = self._still_steady(periods, hole, last_number)
            if not self.steady:
                return 0
        self.missing += max(hole, 0)
        return max(hole, 0)

    def _still_steady(self, periods: float, hole: int, last_number: int) -> bool:
        if self._leaps > max(2, _LEAPING_SHARE * self._steps):
            self.missing = 0  # the rate varies: nothing was missing before either
            return False
        return (
            abs(periods - round(periods)) < _JITTER
            and hole >= 0
            # A long first step means that the rate is mislabelled.
            and not (hole and self.steady is None)
            # A step beyond the end is a damaged time stamp.
            and (self._places is None or last_number + round(periods) < self._places)
        )
