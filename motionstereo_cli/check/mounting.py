"""Whether a view was mirrored, or mounted upside down or on its side."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from motionstereo_cli.check.features import (
    FrameWindow,
    Keypoints,
    keypoints,
    mutual_matches,
    shrunk,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.types import Grey

    _Matches = NDArray[np.float64]

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


class Mounting(NamedTuple):
    """How the views stand against one another, and the options of the input that mend it."""

    text: str
    options: Mapping[str, int]


class _Turn(NamedTuple):
    """What may have been done to the right view: how it is, what mends it, and the mending."""

    text: str
    options: Mapping[str, int]
    mend: Callable[[Grey], Grey]


_TURNS = (
    _Turn("upside down", {"rotate_right": 180}, lambda image: image[::-1, ::-1]),
    _Turn("mirrored", {"mirror_right": True}, lambda image: image[:, ::-1]),
    _Turn(
        "mirrored and upside down",
        {"mirror_right": True, "rotate_right": 180},
        lambda image: image[::-1],
    ),
    _Turn("on its side", {"rotate_right": 90}, lambda image: np.rot90(image, -1)),
    _Turn("on its side", {"rotate_right": 270}, np.rot90),
)


def mounted(windows: Sequence[FrameWindow]) -> Mounting | None:
    """Return how the right view is mounted unlike the left one, and what mends it; None if alike.

    Args:
        windows: windows of the recording; the pair in the middle of each is used.
    """
    pairs, found = [], []
    for window in windows:
        t = len(window.left) // 2
        pair = shrunk(window.left[t], _WIDTH), shrunk(window.right[t], _WIDTH)
        small = window.shape[1] > _WIDTH
        pairs.append(pair)
        found.append(_rows_and_columns(*(map(keypoints, pair) if small else window.middle())))
    across, down = np.concatenate(found).T if found else np.empty((2, 0))
    reach = _ROW_REACH * pairs[0][0].shape[0] if pairs else 0.0
    alike = _alike(down, reach)
    if len(down) >= _MIN_MATCHES and np.median(np.abs(across)) < _COLUMN_PX:
        above = float(np.median(down))
        if abs(above) > _ABOVE_PX:
            degrees = 270 if above < 0 else 90
            return _advised(
                "the views stand one above the other",
                {"rotate_left": degrees, "rotate_right": degrees},
            )
    if 2 * alike > len(down) and alike >= _MIN_MATCHES:
        return None
    looks = [_mended(pairs, turn) for turn in _TURNS]
    counts = [_alike(look[:, 1], reach) for look in looks]
    best = int(np.argmax(counts))
    if counts[best] < max(_MIN_MATCHES, _TIMES_AS_MANY * alike):
        return None
    turn = _TURNS[best]
    if _is_left(looks[best], turn):
        options = {name.replace("right", "left"): value for name, value in turn.options.items()}
        if options.get("rotate_left", 180) != 180:
            options["rotate_left"] = 360 - options["rotate_left"]
        return _advised(f"the left view is {turn.text} against the right one", options)
    return _advised(f"the right view is {turn.text} against the left one", turn.options)


def _is_left(look: _Matches, turn: _Turn) -> bool:
    """Return whether it is the left view that was turned, not the right one.

    If so, both views are turned after the right one is mended: disparities have the wrong sign, or
    are vertical.
    """
    across, down = np.median(look, axis=0)
    if turn.options.get("rotate_right", 180) == 180:
        # A view with top and bottom exchanged has its left where it was: either may be it.
        return len(turn.options) == 1 and bool(across > 0)
    return bool(abs(down) > abs(across))


def _advised(text: str, options: Mapping[str, int]) -> Mounting:
    words = " ".join(
        "--" + name.replace("_", "-") + ("" if value is True else f" {value}")
        for name, value in options.items()
    )
    return Mounting(f"{text}: give {words}", options)


def _mended(pairs: Sequence[tuple[Grey, Grey]], turn: _Turn) -> _Matches:
    """Return where matches lie once the right view is turned."""
    found = [np.empty((0, 2))]
    for left, right in pairs:
        mended = np.ascontiguousarray(turn.mend(right))
        if mended.shape == left.shape:
            found.append(_rows_and_columns(keypoints(left), keypoints(mended)))
    return np.concatenate(found)


def _alike(down: _Matches, reach: float) -> int:
    return int(np.sum(np.abs(down - np.median(down)) < reach)) if len(down) else 0


def _rows_and_columns(one: Keypoints, other: Keypoints) -> _Matches:
    """Return by how much matches lie further right and lower in the right image, (n, 2) px."""
    mutual = mutual_matches(one, other)
    return (other.points[mutual[:, 1]] - one.points[mutual[:, 0]]).astype(np.float64)
