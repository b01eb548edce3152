"""The least time to contact along the heading.

The depth of an object that approaches at constant speed, 1 / nearness up to a factor, decreases
linearly with time, so its time to contact needs no unit of length and no rig.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

#: A speed is fitted to so many of the last frames, at least to the second.
_FITTED, _MIN_FITTED = 8, 4
#: If nearness changes by more than this factor between frames, or the heading moves by more than
#: this share of the image, it is another object.
_MAX_FACTOR, _MAX_MOVED = 1.3, 0.15
#: An approach is significant if it exceeds the residual of the fit by this factor.
_SURE = 3.0
#: Maximum time to contact: slower speeds cannot be distinguished from 0.
MAX_CONTACT_S = 60.0


@dataclass(frozen=True, slots=True)
class Approach:
    """What is kept from frame to frame.

    Attributes:
        seen: of the last frames: time in s, place of the heading across the image 0..1, and
            nearness in px of the nearest thing in the way.
    """

    seen: tuple[tuple[float, float, float], ...] = ()

    def after(self, time_s: float | None, place: float, near_px: float) -> Approach:
        """Return the state after a frame; nearness is NaN if nothing is in the way."""
        if time_s is None or not near_px > 0:
            return Approach()
        if self.seen:
            last_s, last_place, last_px = self.seen[-1]
            factor = max(near_px / last_px, last_px / near_px)
            if last_s >= time_s or factor > _MAX_FACTOR or abs(place - last_place) > _MAX_MOVED:
                return Approach(((time_s, place, near_px),))
        return Approach((*self.seen, (time_s, place, near_px))[-_FITTED:])

    @property
    def contact_s(self) -> float | None:
        """Time to contact in s; None if nothing approaches, or if unknown."""
        if len(self.seen) < _MIN_FITTED:
            return None
        time_s, _, near_px = np.array(self.seen).T
        depth = 1 / near_px
        later, earlier = np.tril_indices(len(depth), -1)
        # The median slope (Theil and Sen) and what it misses.
        slopes = (depth[later] - depth[earlier]) / (time_s[later] - time_s[earlier])
        speed = -float(np.sort(slopes)[len(slopes) // 2])
        level = np.sort(depth + speed * time_s)[len(depth) // 2]
        missed = float(np.sort(np.abs(depth + speed * time_s - level))[len(depth) // 2])
        if speed * float(time_s[-1] - time_s[0]) <= _SURE * missed:
            return None
        left = float(level) - speed * float(time_s[-1])
        if not 0 < left <= speed * MAX_CONTACT_S:
            return None
        return left / speed


def nearest_in_way(
    near_px: NDArray[np.float32], place: float, width: int, half_way: float
) -> float:
    """Return the nearness in px of the nearest thing in the way; NaN where nothing is known.

    Args:
        near_px: nearness of what stands in each of some strips of the image, (strips,), NaN = none.
        place: where the way leads, across the image, 0..1.
        width: of the image in px.
        half_way: half the width of the way, in px of the image per px of nearness; 0 = one strip.
    """
    strips = len(near_px)
    middle = (np.arange(strips) + 0.5) / strips
    aside_px = np.maximum(np.abs(middle - place) - 0.5 / strips, 0) * width
    with np.errstate(invalid="ignore"):
        inside = near_px[(aside_px <= half_way * near_px) & (near_px > 0)]
    return float(inside.max()) if inside.size else math.nan
