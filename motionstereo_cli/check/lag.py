"""By how many images two recordings are apart in time, from how much moves in each row of both.

Rows of both views see the same objects, wherever these lie in the row. So how much each row changes
from image to image, over time, is about the same in both views; the lag at which both agree best is
that of the recordings. It needs no calibration, and rows that agree roughly are enough.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.types import Grey

    #: How much each band of rows changes up to an image, (bands,) float32 grey levels.
    Profile = NDArray[np.float32]

#: Images are looked at in this size, in which fine texture still tells neighbouring lags apart,
#: and rows in as many bands.
_WIDTH, _HEIGHT = 160, 120
BANDS = 30

#: Bands by which rows may be off: an eighth of the height.
_SHIFTS = 4

#: What changes by less, in grey levels, is noise of the encoder.
_LEAST_GREY = 0.2

#: Fewer images tell nothing.
MIN_OVERLAP = 24

#: Lags next to the best agree nearly as well; others must do so clearly worse, and the best well.
_NEXT = 2
_CLEARLY, _WELL = 1.25, 0.55

#: Lags that are tried one after the other are so many images apart: a step is told up to that.
_APART = 4

#: Where quick changes agree by more than this, and by half of it at no other lag, they tell the
#: place; and next to it they count by this share.
_TELLING, _QUICK_SHARE = 0.2, 0.1

#: Views of different scenes agree less than this.
_AGREE = 0.4


class Lag(NamedTuple):
    """How far the right recording is behind.

    Attributes:
        images: left image n belongs to right image n + images.
        agreement: correlation of both at that lag, -1..1.
        is_certain: no other lag explains the motion nearly as well.
    """

    images: int
    agreement: float
    is_certain: bool


def small(grey: Grey) -> Grey:
    """Return an image, (height, width) uint8, in the size in which motion is looked at."""
    return np.asarray(cv2.resize(grey, (_WIDTH, _HEIGHT), interpolation=cv2.INTER_AREA), np.uint8)


def profile(image: Grey, last: Grey) -> Profile:
    """Return how much each band of rows changes between two images of :func:`small`.

    Returns:
        (bands,) float32 grey levels.
    """
    changed = cv2.absdiff(image, last).reshape(BANDS, -1)
    return np.asarray(changed.mean(axis=1), np.float32)


def profiles(images: Iterable[Grey]) -> NDArray[np.float32]:
    """Return the profiles of images of :func:`small`, in order, (n - 1, bands)."""
    rows = [profile(image, last) for last, image in itertools.pairwise(images)]
    return np.array(rows, np.float32).reshape(-1, BANDS)


def lag_of(
    left: NDArray[np.float32],
    right: NDArray[np.float32],
    reach: int,
    min_overlap: int = MIN_OVERLAP,
) -> Lag | None:
    """Return the lag at which two recordings agree best, None if too little moves.

    Arguments as those of :func:`lags_of`.
    """
    return next(iter(lags_of(left, right, reach, min_overlap)), None)


def lags_of(
    left: NDArray[np.float32],
    right: NDArray[np.float32],
    reach: int,
    min_overlap: int = MIN_OVERLAP,
    most: int = 1,
) -> list[Lag]:
    """Return the lags at which two recordings agree best, none if too little moves.

    Rows may be off by a few bands, the same all over the image: the best such shift counts.

    Args:
        left, right: (n, bands) and (m, bands) profiles.
        reach: largest lag either way.
        min_overlap: images that have to overlap.
        most: how many lags, well apart, to return; only the first can be certain.
    """
    n, m = len(left), len(right)
    if (
        min(n, m) < min_overlap
        or min(float(side.std(axis=0).max(initial=0)) for side in (left, right)) < _LEAST_GREY
    ):
        return []
    lags = np.arange(-reach, reach + 1)
    begin, end = np.maximum(0, -lags), np.minimum(n, m - lags)  # of the overlap, on the left
    lags, begin, end = (each[end - begin >= min_overlap] for each in (lags, begin, end))
    if not len(lags):
        return []
    slow = _agreements(left, right, begin, end, lags)
    quick = _agreements(np.diff(left, axis=0), np.diff(right, axis=0), begin, end - 1, lags)
    places = [_peak(lags, each) for each in (quick, slow)]
    best, peak, rival = places[0]
    certain = peak > _TELLING and rival < peak / 2 and slow[lags == best][0] > _AGREE
    if not certain:
        best, peak, rival = places[1]
        certain = peak > _WELL and 1 - rival > _CLEARLY * (1 - peak)
    both = slow + _QUICK_SHARE * quick
    near = np.abs(lags - best) <= _NEXT
    found: list[Lag] = []
    while near.any() and len(found) < most:
        exact = int(lags[near][both[near].argmax()])
        found.append(Lag(exact, float(slow[lags == exact][0]), certain and not found))
        near = np.all([np.abs(lags - each.images) > _APART for each in found], axis=0)
    return found


def _peak(lags: NDArray[np.intp], agreement: NDArray[np.float64]) -> tuple[int, float, float]:
    """Return the lag of the best agreement, that, and the best at lags that are not next to it."""
    best = int(agreement.argmax())
    others = agreement[np.abs(lags - lags[best]) > _NEXT]
    return int(lags[best]), float(agreement[best]), float(others.max(initial=-1.0))


def _agreements(
    left: NDArray[np.float32],
    right: NDArray[np.float32],
    begin: NDArray[np.intp],
    end: NDArray[np.intp],
    lags: NDArray[np.intp],
) -> NDArray[np.float64]:
    """Return the largest correlation at some lags, over the bands by which rows may be off."""
    shifts = range(-_SHIFTS, _SHIFTS + 1)
    tried = [
        _agreement(
            left[:, max(0, -rows) : BANDS - max(0, rows)],
            right[:, max(0, rows) : BANDS - max(0, -rows)],
            *(begin, end, lags),
        )
        for rows in shifts
    ]
    return np.asarray(np.max(tried, axis=0))


def _agreement(
    left: NDArray[np.float32],
    right: NDArray[np.float32],
    begin: NDArray[np.intp],
    end: NDArray[np.intp],
    lags: NDArray[np.intp],
) -> NDArray[np.float64]:
    """Return the correlation of all bands together at some lags.

    Each band is taken without its mean over the images that overlap: with sums over these images
    of x, y, x^2, y^2 and x y for each band,
    r = sum(Sxy - Sx Sy / n) / sqrt(sum(Sxx - Sx^2 / n) sum(Syy - Sy^2 / n)).
    """
    x, y = left.astype(np.float64), right.astype(np.float64)
    size = 1 << (len(x) + len(y)).bit_length()
    spectrum = np.conj(np.fft.rfft(x, size, axis=0)) * np.fft.rfft(y, size, axis=0)
    sxy = np.fft.irfft(spectrum, size, axis=0)[lags % size]
    sx, sxx = _sums(x, begin, end)
    sy, syy = _sums(y, begin + lags, end + lags)
    count = (end - begin)[:, None]
    together = (sxy - sx * sy / count).sum(axis=1)
    powers = (sxx - sx**2 / count).sum(axis=1) * (syy - sy**2 / count).sum(axis=1)
    return np.asarray(np.where(powers > 1e-9, together / np.sqrt(np.maximum(powers, 1e-9)), 0.0))


def _sums(
    values: NDArray[np.float64], begin: NDArray[np.intp], end: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return sums of the values, and of their squares, from some rows to others."""
    running = [
        np.vstack([np.zeros((1, values.shape[1])), np.cumsum(each, axis=0)])
        for each in (values, values**2)
    ]
    first, second = (each[end] - each[begin] for each in running)
    return first, second
