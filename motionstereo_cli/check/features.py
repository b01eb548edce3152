"""Features found in both views of a recording, and followed in the left one."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.types import Grey

    Column = NDArray[np.float64]


# Features. Distances are in px of the image looked at.
_FEATURES = 600
_MIN_CONTRAST = 0.02
_MAX_RATIO = 0.8
_ROW_REACH = 0.1  # of the height: matches are looked for so far off the row
_REPEAT_PX = 2  # repetitions and disparities agree up to so many px
_MIN_REPEAT_PX = 8  # what is nearer is part of the same thing
_MIN_REPEATS, _REPEAT_SHARE = 10, 0.3  # as far apart, and of all: fewer are chance
_FOLLOW_SPANS = (2, 4)
_FOLLOW_BACK_PX = 0.5
_FOLLOW_CHANGE_PX = 0.1


@dataclass(frozen=True, slots=True)
class Matches:
    """Features found in both views, in px of the images looked at; all (n,).

    Attributes:
        x, y: place in the left image.
        disparity: x in the left image minus x in the right one.
        lower: y in the right image minus y in the left one.
        down: motion in the left image in px a frame, positive = down.
        grey: grey level in the left image minus that in the right one.
    """

    x: Column
    y: Column
    disparity: Column
    lower: Column
    down: Column
    grey: Column

    def __len__(self) -> int:
        return len(self.x)

    def where(self, chosen: NDArray[np.bool_]) -> Matches:
        """Return those that are chosen, (n,) bool."""
        return Matches(*(column[chosen] for column in self.columns()))

    def columns(self) -> list[Column]:
        """Return its columns in order."""
        return [getattr(self, item.name) for item in dataclasses.fields(self)]


def joined(parts: Sequence[Matches]) -> Matches:
    """Return the matches of all parts, one after the other."""
    columns = zip(*(part.columns() for part in parts), strict=True)
    return Matches(*(np.concatenate(column) for column in columns))


NO_MATCHES = Matches(*(np.empty(0) for _ in dataclasses.fields(Matches)))


class Keypoints(NamedTuple):
    """SIFT keypoints of an image: points (n, 2) float32 px, descriptors (n, 128) float32."""

    points: NDArray[np.float32]
    descriptors: NDArray[np.float32]


class FrameWindow:
    """Consecutive frames; images are (height, width) uint8."""

    def __init__(self, start: int, moments: Sequence[int]) -> None:
        self.start = start
        self.left: list[Grey] = []
        self.right: list[Grey] = []
        self._moments = moments
        self._features: dict[tuple[str, int], Keypoints] = {}
        self._moved: dict[int, tuple[Column, NDArray[np.bool_]]] = {}

    @property
    def shape(self) -> tuple[int, ...]:
        """Height and width of its images in px."""
        return self.left[0].shape

    def matches(self, ahead: int) -> Matches:
        """Return the matches at some moments, the right view being this many frames ahead."""
        last = len(self.left) - 1
        moments = (t for t in self._seen_moments if 0 <= t - ahead <= last)
        return joined([NO_MATCHES, *(self._match(t, t - ahead) for t in moments)])

    @property
    def _seen_moments(self) -> list[int]:
        last = len(self.left) - 1
        return [t for t in self._moments if t <= last] or [last // 2]

    def _match(self, t_left: int, t_right: int) -> Matches:
        left, right = self._seen("left", t_left), self._seen("right", t_right)
        mutual = mutual_matches(left, right)
        if not mutual.size:
            return NO_MATCHES
        at_left, at_right = left.points[mutual[:, 0]], right.points[mutual[:, 1]]
        down, followed = self._motion(t_left, mutual[:, 0])
        across, lower = (at_right - at_left).astype(np.float64).T
        matches = Matches(
            x=at_left[:, 0].astype(np.float64),
            y=at_left[:, 1].astype(np.float64),
            disparity=-across,
            lower=lower,
            down=down,
            grey=_grey_at(self.left[t_left], at_left) - _grey_at(self.right[t_right], at_right),
        )
        return matches.where(followed & (np.abs(lower) < _ROW_REACH * self.shape[0]))

    def _motion(self, t: int, chosen: NDArray[np.intp]) -> tuple[Column, NDArray[np.bool_]]:
        """Return :func:`_followed` of some keypoints of the left view, each computed once.

        ``chosen`` are their indices, (n,).
        """
        points = self._seen("left", t).points
        if t not in self._moved:
            self._moved[t] = np.full(len(points), np.nan), np.zeros(len(points), np.bool_)
        down, followed = self._moved[t]
        new = chosen[np.isnan(down[chosen])]
        if len(new):
            down[new], followed[new] = _followed(self.left, t, points[new])
        return down[chosen], followed[chosen]

    def repeats(self) -> Column:
        """Return the distances at which the left image looks alike on a row, in px, (n,)."""
        return np.concatenate([_repeats(self._seen("left", t)) for t in self._seen_moments])

    def middle(self) -> tuple[Keypoints, Keypoints]:
        """Return the keypoints of both views at the middle one of its moments."""
        t = self._seen_moments[len(self._seen_moments) // 2]
        return self._seen("left", t), self._seen("right", t)

    def _seen(self, side: str, t: int) -> Keypoints:
        if (side, t) not in self._features:
            image = (self.left if side == "left" else self.right)[t]
            self._features[side, t] = keypoints(image)
        return self._features[side, t]


def shrunk(image: Grey, width: int) -> Grey:
    """Return an image at most so many px wide, uint8; a wider one is scaled down by averages."""
    if image.shape[1] <= width:
        return image
    size = width, max(1, round(image.shape[0] * width / image.shape[1]))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def keypoints(image: Grey) -> Keypoints:
    """Return the SIFT keypoints of an image, (height, width) uint8."""
    sift = cv2.SIFT.create(_FEATURES, contrastThreshold=_MIN_CONTRAST)
    keys, descriptors = sift.detectAndCompute(image, None)
    points = np.array([key.pt for key in keys], np.float32).reshape(-1, 2)
    return Keypoints(points, np.asarray(descriptors, np.float32))


def mutual_matches(left: Keypoints, right: Keypoints) -> NDArray[np.intp]:
    """Return the indices of keypoints that clearly match each other, (n, 2): left, right."""
    if min(len(left.points), len(right.points)) < 2:
        return np.empty((0, 2), np.intp)
    across = _distances(left, right)
    forth = _clear_matches(across, _distances(left, left))
    back = _clear_matches(across.T, _distances(right, right))
    one = np.flatnonzero(forth >= 0)
    one = one[back[forth[one]] == one]
    return np.stack([one, forth[one]], axis=1)


def _repeats(seen: Keypoints) -> Column:
    """Return the distances, (n,) px, of keypoints on one row that are most alike to each other."""
    if len(seen.points) < 2:
        return np.empty(0)
    within = _distances(seen, seen)
    np.fill_diagonal(within, np.inf)
    like = within.argmin(axis=1)
    one = np.flatnonzero(like[like] == np.arange(len(like)))
    apart, off = (seen.points[like[one]] - seen.points[one]).T
    on_row = (apart > _MIN_REPEAT_PX) & (np.abs(off) < _REPEAT_PX)
    return np.asarray(apart[on_row], np.float64)


def without_repetitions(matches: Matches, repeats: Column) -> Matches:
    """Return the matches without those that a repeating pattern explains.

    Where an object hides the true partner and its likes, another repetition is matched. Its
    disparity is off by the distance of two repetitions, from one that has more matches. A distance
    counts if it is one of a few, and seen at least as often as the disparity that it explains.

    Args:
        matches: the matches.
        repeats: distances of two repetitions in px, (n,).
    """
    if not len(matches) or not len(repeats):
        return matches
    place = np.rint(matches.disparity).astype(np.intp)
    place -= place.min()
    size = int(place.max()) + 1
    found = _counts(place, size)
    distances = _counts(np.rint(repeats).astype(np.intp), size)
    explained = np.zeros(size, np.bool_)
    for apart in np.flatnonzero(distances >= max(_MIN_REPEATS, _REPEAT_SHARE * len(repeats))):
        less, more = found[:-apart], found[apart:]
        often = distances[apart]
        explained[:-apart] |= (less < more) & (less <= often)
        explained[apart:] |= (more < less) & (more <= often)
    return matches.where(~explained[place])


def _counts(places: NDArray[np.intp], size: int) -> NDArray[np.intp]:
    """Return how many places lie around each of 0..size - 1, (size,)."""
    exact = np.bincount(places[places < size], minlength=size)
    return np.convolve(exact, np.ones(2 * _REPEAT_PX + 1, np.intp))[_REPEAT_PX:][:size]


def _distances(one: Keypoints, other: Keypoints) -> NDArray[np.float32]:
    """Return the distances of all descriptors, (n, m); exact, for their elements are whole."""
    lengths = [np.square(each.descriptors).sum(axis=1) for each in (one, other)]
    products = one.descriptors @ other.descriptors.T
    squares = lengths[0][:, np.newaxis] + lengths[1] - 2 * products
    return np.asarray(np.sqrt(np.maximum(squares, 0)), np.float32)


def _clear_matches(across: NDArray[np.float32], within: NDArray[np.float32]) -> NDArray[np.intp]:
    """Return the index of the nearest of the others for each, (n,); -1 if it is ambiguous.

    It is if the second nearest, or another keypoint of the same image, is nearly as near: of a
    repeating pattern, the true partner may be hidden.

    Args:
        across: distances from the others, (n, m).
        within: distances in its own image, (n, n).
    """
    nearest = across.argmin(axis=1)
    best, second = np.partition(across, 1, axis=1)[:, :2].T
    like = np.partition(within, 1, axis=1)[:, 1]
    return np.where(best < _MAX_RATIO * np.minimum(second, like), nearest, -1)


def _grey_at(image: Grey, points: NDArray[np.float32]) -> Column:
    x, y = np.rint(points).astype(np.intp).T
    return np.asarray(cv2.blur(image, (5, 5))[y, x], np.float64)


def _followed(
    images: Sequence[Grey], moment: int, points: NDArray[np.float32]
) -> tuple[Column, NDArray[np.bool_]]:
    """Return the motion of points (n, 2) in px a frame down, and where it could be followed."""
    start = points[:, None]
    down, certain = np.zeros(len(points)), np.ones(len(points), np.bool_)
    for span in _FOLLOW_SPANS:  # the longer, the more exact, as far as it can be followed
        speeds, seen = [], np.ones(len(points), np.bool_)
        for step in (-span, span):
            if 0 <= moment + step < len(images):
                there, found = _flow(images[moment], images[moment + step], start)
                speeds.append((there - start)[:, 0, 1].astype(np.float64) / step)
                seen &= found
        if speeds:
            speed = np.mean(speeds, axis=0)
            if span == _FOLLOW_SPANS[0]:
                down, certain = speed, seen
            else:
                seen &= np.abs(speed - down) < _FOLLOW_CHANGE_PX
                down = np.where(seen, speed, down)
    return down, certain


def _flow(
    image: Grey, other: Grey, start: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return where points (n, 1, 2) have gone, and where following them back returns."""

    def go(image: Grey, other: Grey, start: Any) -> tuple[Any, Any]:
        there, seen, _ = cv2.calcOpticalFlowPyrLK(
            image, other, start, np.empty_like(start), winSize=(21, 21), maxLevel=3
        )
        return there, seen[:, 0] > 0

    there, seen = go(image, other, start)
    back, seen_back = go(other, image, there)
    returned = np.linalg.norm((back - start)[:, 0], axis=1) < _FOLLOW_BACK_PX
    return there, seen & seen_back & returned
