"""The convention of a map of disparity, its view and scale, found from the images."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

if TYPE_CHECKING:
    from motionstereo_cli.types import Grey, Real

#: Candidate scales of whole numbers, KITTI's first, and the limit of values that may be fractions
#: of the width.
_WHOLE = (256.0, 128.0, 100.0, 64.0, 32.0, 16.0, 8.0, 4.0, 2.0, 1.0)
_MAX_FRACTION = 1.5

#: Pixels compared in a frame, their minimum slope of grey along a row, and the limit of differences
#: in grey levels.
_PIXELS, _TEXTURE, _WORST = 5_000, 12.0, 24.0
#: Fewer than so many tell nothing.
_MIN_PIXELS = 100
#: Maximum difference of a map that fits, or its share of the difference with the other sign.
_GOOD, _MAX_SHARE = 8.0, 0.65
#: Factors by which the other view has to differ more, and all others if one image is to suffice.
_ALIKE, _SURE = 1.02, 1.1


class Convention(NamedTuple):
    """A view and a scale, and how well the images agree then.

    Attributes:
        view: camera whose view the maps are in, ``left`` or ``right``.
        scale: value for 1 px; negative if signs are exchanged.
        differs: mean difference of grey levels of corresponding pixels, 0..24.
        inverted: the same with the other sign.
        sure: whether all other views and scales differ much more.
    """

    view: str
    scale: float
    differs: float
    inverted: float
    sure: bool

    @property
    def fits(self) -> bool:
        """Whether maps fit these images under this convention."""
        return not (self.differs > _GOOD and self.differs > _MAX_SHARE * self.inverted)


def scales_of(values: Real, width: int, *, whole_numbers: bool) -> tuple[float, ...]:
    """Return the candidate scales of a map, the likeliest first.

    Args:
        values: (height, width) float32, NaN = unknown.
        width: of the map in its file, in px.
        whole_numbers: whether the file has whole numbers.
    """
    known = values[np.isfinite(values)]
    if whole_numbers:
        return _WHOLE
    sign = -1.0 if np.count_nonzero(known < 0) > np.count_nonzero(known > 0) else 1.0
    if len(known) and np.abs(known).max() <= _MAX_FRACTION:
        return sign, sign / width
    return (sign,)


def convention(
    looks: Iterable[tuple[str, Real, Grey, Grey]], scales: Sequence[float]
) -> Convention | None:
    """Return the convention under which the images agree best, None if undecided.

    Args:
        looks: for each frame and view: the view, the map as its file has it, (height, width)
            float32, NaN = unknown; and the right and the left image, (height, width) uint8.
        scales: the candidates.
    """
    sums: dict[tuple[str, float], list[tuple[float, float]]] = {}
    for view, values, right, left in looks:
        found = _differences(view, values, scales, right, left)
        for scale, each in zip(scales, found, strict=bool(found)):
            sums.setdefault((view, scale), []).append(each)
    means = {key: np.mean(each, axis=0).tolist() for key, each in sums.items()}
    if not means:
        return None
    order = sorted(means, key=lambda key: means[key][0])
    best = order[0]
    # If both views agree equally, other programs mostly use the left one.
    if best[0] == "right" and (left_key := ("left", best[1])) in means:
        best = left_key if means[left_key][0] <= _ALIKE * means[best][0] else best
    differs = means[best][0]
    sure = all(means[key][0] > _SURE * differs for key in order if key != best)
    return Convention(*best, differs, means[best][1], sure)


def _differences(
    view: str, values: Real, scales: Sequence[float], right: Grey, left: Grey
) -> list[tuple[float, float]]:
    """Return by scale the mean difference of grey of corresponding pixels.

    Each with that for the other sign. Empty with too little texture.
    """
    if view == "left":  # in a mirror, the right one
        right, left = left[:, ::-1], right[:, ::-1]
        values = values[:, ::-1]
    one, other = (cv2.GaussianBlur(each, (5, 5), 0).astype(np.float32) for each in (right, left))
    texture = np.abs(cv2.Sobel(one, cv2.CV_32F, 1, 0, ksize=3)) / 4
    sign = np.float32(np.sign(scales[0]))
    row, column = np.nonzero((texture > _TEXTURE) & (sign * values > 0) & np.isfinite(values))
    if len(row) < _MIN_PIXELS:
        return []
    chosen = slice(None, None, max(len(row) // _PIXELS, 1))
    row, column = row[chosen], column[chosen]
    here = one[row, column]

    def mean(there_px: Real) -> float:
        at = np.clip(np.floor(there_px), 0, one.shape[1] - 2).astype(np.intp)
        share = there_px - at
        there = (1 - share) * other[row, at] + share * other[row, at + 1]
        inside = (there_px >= 0) & (there_px <= one.shape[1] - 1)
        off = np.full(len(row), _WORST)
        if inside.any():
            apart = (here - there)[inside]
            off[inside] = np.minimum(np.abs(apart - np.median(apart)), _WORST)
        return float(off.mean())

    shifts = [values[row, column] / np.float32(scale) for scale in scales]
    return [(mean(column + shift), mean(column - shift)) for shift in shifts]
