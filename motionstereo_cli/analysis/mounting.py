"""Whether a view was mirrored, or mounted upside down or on its side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from motionstereo_cli.analysis.features import keypoints, mutual_matches

if TYPE_CHECKING:
    from motionstereo_cli.types import Grey

#: Images are looked at in at most this width, in px.
_WIDTH = 480

#: Views stand alike where all matches differ by nearly the same y, within this share of the
#: height; this many, and this many times as many as without the turn, show that a turn mends it.
_ROW_REACH = 0.03
_MIN_MATCHES = 25
_TIMES_AS_MANY = 3

#: Views stand one above the other where most matches lie in one column, and not in one row, in px.
_COLUMN_PX = 1.5
_ABOVE_PX = 3.0


class _Turn(NamedTuple):
    """What may have been done to the right view: how it is, what mends it, and the mending."""

    text: str
    option: str
    mend: Callable[[Grey], Grey]


_TURNS = (
    _Turn("upside down", "--rotate-right 180", lambda image: image[::-1, ::-1]),
    _Turn("mirrored", "--mirror-right", lambda image: image[:, ::-1]),
    _Turn(
        "mirrored and upside down",
        "--mirror-right --rotate-right 180",
        lambda image: image[::-1],
    ),
    _Turn("on its side", "--rotate-right 90", lambda image: np.rot90(image, -1)),
    _Turn("on its side", "--rotate-right 270", np.rot90),
)


def mounted(lefts: Sequence[Grey], rights: Sequence[Grey]) -> str:
    """Return how the right view stands against the left one and what mends it, empty if alike.

    Args:
        lefts, rights: a few pairs of images of one moment, (height, width) uint8.
    """
    pairs = [(_small(left), _small(right)) for left, right in zip(lefts, rights, strict=True)]
    found = [_rows_and_columns(left, right) for left, right in pairs]
    across, down = np.concatenate(found).T if found else np.empty((2, 0))
    reach = _ROW_REACH * pairs[0][0].shape[0] if pairs else 0.0
    alike = _alike(down, reach)
    if len(down) >= _MIN_MATCHES and np.median(np.abs(across)) < _COLUMN_PX:
        above = float(np.median(down))
        if abs(above) > _ABOVE_PX:
            degrees = 270 if above < 0 else 90
            return (
                "the views stand one above the other: give --rotate-left "
                f"{degrees} --rotate-right {degrees}"
            )
    if 2 * alike > len(down) and alike >= _MIN_MATCHES:
        return ""
    counts = [_count(pairs, turn, reach) for turn in _TURNS]
    best = int(np.argmax(counts))
    if counts[best] < max(_MIN_MATCHES, _TIMES_AS_MANY * alike):
        return ""
    turn = _TURNS[best]
    return f"the right view is {turn.text} against the left one: give {turn.option}"


def _count(pairs: Sequence[tuple[Grey, Grey]], turn: _Turn, reach: float) -> int:
    """Return how many matches lie in like rows once the right view is turned."""
    count = 0
    for left, right in pairs:
        mended = np.ascontiguousarray(turn.mend(right))
        if mended.shape == left.shape:
            count += _alike(_rows_and_columns(left, mended)[:, 1], reach)
    return count


def _alike(down: np.ndarray[tuple[int, ...], np.dtype[np.float64]], reach: float) -> int:
    return int(np.sum(np.abs(down - np.median(down)) < reach)) if len(down) else 0


def _rows_and_columns(left: Grey, right: Grey) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Return by how much matches lie further right and lower in the right image, (n, 2) px."""
    one, other = keypoints(left), keypoints(right)
    mutual = mutual_matches(one, other)
    return (other.points[mutual[:, 1]] - one.points[mutual[:, 0]]).astype(np.float64)


def _small(image: Grey) -> Grey:
    if image.shape[1] <= _WIDTH:
        return image
    size = (_WIDTH, max(1, round(image.shape[0] * _WIDTH / image.shape[1])))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
