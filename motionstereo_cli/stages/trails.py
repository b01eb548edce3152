"""Disparity by pairing the trails of the right memory with those of the left one.

A *trail* is a maximal run of equal units on one row. Its two ends are where a moving edge was at
two successive instants, so each end of a pair of corresponding trails has the disparity of that
edge. Everything below works on flat arrays of trails and of pairs of trails.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Reals = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Trails:
    """The trails of one image in reading order; arrays of (trails,) int64.

    Attributes:
        row: row of the trail.
        start, stop: its first column, and the one after its last.
        unit: what its pixels have in common.
    """

    row: Ints
    start: Ints
    stop: Ints
    unit: Ints


@dataclass(frozen=True, slots=True)
class Pairs:
    """Pairs of a right and a left trail that may be the same, ordered by right trail.

    Attributes:
        right, left: numbers of the two trails, (pairs,) int64.
        disparity: left minus right column of their starts and of their stops in px,
            (2, pairs) int64.
    """

    right: Ints
    left: Ints
    disparity: Ints

    def only(self, which: NDArray[np.bool_]) -> Pairs:
        """Return the pairs where ``which``, (pairs,) bool, is true."""
        return Pairs(self.right[which], self.left[which], self.disparity[:, which])


@dataclass(frozen=True, slots=True)
class Blocks:
    """A grid over the right image whose cells gather the votes of the trails in them.

    Attributes:
        shape: height and width of the image in px.
        size: height and width of a block in px.
        disparities: number of disparities from 0.
    """

    shape: tuple[int, int]
    size: tuple[int, int]
    disparities: int

    def place(self, row: Ints, column: Ints) -> Ints:
        """Return the number of the block that each pixel lies in."""
        columns = -(-self.shape[1] // self.size[1])
        number: Ints = row // self.size[0] * columns + column // self.size[1]
        return number

    def places(self, trails: Trails, pairs: Pairs) -> Ints:
        """Return the block that each pair's start and stop lie in, (2, pairs) int64."""
        ends = np.stack([trails.start[pairs.right], trails.stop[pairs.right] - 1])
        return self.place(trails.row[pairs.right], ends)

    def votes(self, places: Ints, pairs: Pairs) -> Reals:
        """Return the votes of all ends for each disparity, (rows, columns, disparities)."""
        rows, columns = (-(-self.shape[i] // self.size[i]) for i in (0, 1))
        cells = (places * self.disparities + pairs.disparity).reshape(-1)
        votes = np.bincount(cells, minlength=rows * columns * self.disparities)
        return votes.reshape(rows, columns, self.disparities).astype(np.float32)


def match_trails(
    right: NDArray[np.uint16],
    left: NDArray[np.uint16],
    max_disparity: int,
    *,
    block_px: tuple[int, int] = (8, 8),
    max_ratio: float = 0.9,
    least_votes: int = 16,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the disparity of each right pixel in px, and how many votes agree with it.

    Trails of equal unit are paired; each pair votes at both its ends for the disparity there, and
    neighbouring rows agree on the true ones. A pair's support is the votes at its two ends. A
    pair wins if it is the best for both its trails and stands out from the second best. Then the
    winners alone vote again, and each end takes the centroid of the votes around it, which makes
    it sub-pixel. Between the ends disparity runs linearly. Trails without a partner, often split
    by noise or cut by an occlusion, take the disparity that their block elected, pixel by pixel,
    where the units agree.

    Both images are (height, width) float32, NaN where the disparity is unknown.

    Args:
        right, left: units of the two views, (height, width) uint16, 0 = at rest.
        max_disparity: largest x in the left view minus x in the right one, px.
        block_px: height and width of the blocks that vote together.
        max_ratio: largest support of a trail's second best pair as a share of the best's.
        least_votes: votes, in 3 x 3 blocks and within +-2 px, that a disparity needs.
    """
    shape = (right.shape[0], right.shape[1])
    trails = find_trails(right)
    pairs = pair_trails(trails, find_trails(left), shape[1], max_disparity)
    blocks = Blocks(shape, block_px, max_disparity + 1)

    places = blocks.places(trails, pairs)
    won = winners(pairs, support(blocks.votes(places, pairs), places, pairs), max_ratio)
    pairs, places = pairs.only(won), places[:, won]
    votes = blocks.votes(places, pairs)
    for axis in (0, 1):
        votes = with_neighbours(votes, axis)
    at_ends, agreeing = centroids(votes, places, pairs.disparity)
    disparity = painted(trails, pairs.right, at_ends, shape)
    agreement = painted(trails, pairs.right, agreeing, shape)

    peak = with_neighbours(votes, 2).argmax(axis=2).reshape(-1)
    elected, agreeing = centroids(votes, np.arange(len(peak)), peak)
    y, x = np.nonzero(np.isnan(disparity) & (right > 0))
    block = blocks.place(y, x)
    fits = (agreeing >= least_votes)[block] & has_nearby(left, y, x + peak[block], right[y, x])
    y, x, block = y[fits], x[fits], block[fits]
    disparity[y, x] = elected[block]
    agreement[y, x] = agreeing[block]
    disparity[agreement < least_votes] = np.nan
    return disparity, agreement


def find_trails(units: NDArray[np.uint16]) -> Trails:
    """Return the trails of an image of units, (height, width) uint16, 0 = at rest."""
    height, width = units.shape
    begins = np.ones((height, width), np.bool_)
    np.not_equal(units[:, 1:], units[:, :-1], out=begins[:, 1:])
    first = np.flatnonzero(begins)
    length = np.diff(first, append=height * width)
    unit = units.reshape(-1)[first]
    charged = unit > 0
    row, start = np.divmod(first[charged], width)
    return Trails(row, start, start + length[charged], unit[charged].astype(np.int64))


def pair_trails(right: Trails, left: Trails, width: int, max_disparity: int) -> Pairs:
    """Return the pairs of trails of equal unit on a row whose ends lie 0..max_disparity px apart.

    An end on the border of either image is cut off: then the other end speaks for both. A pair
    whose two ends disagree by more than max(2 px, 0.3 of its width) is not one surface.
    """
    # One integer orders left trails by row, unit and start: those in reach are neighbours.
    stride = width + max_disparity
    order_key = (left.row * 65536 + left.unit) * stride + left.start
    order = np.argsort(order_key, kind="stable")
    order_key = order_key[order]
    wanted = (right.row * 65536 + right.unit) * stride + right.start
    low = np.searchsorted(order_key, wanted)
    count = np.searchsorted(order_key, wanted + max_disparity, side="right") - low
    i = np.repeat(np.arange(len(count)), count)
    j = order[np.arange(len(i)) + np.repeat(low - np.cumsum(count) + count, count)]

    at_start = left.start[j] - right.start[i]
    at_stop = left.stop[j] - right.stop[i]
    cut_start = (right.start[i] == 0) | (left.start[j] == 0)
    cut_stop = (right.stop[i] == width) | (left.stop[j] == width)
    disparity = np.stack(
        [np.where(cut_start, at_stop, at_start), np.where(cut_stop, at_start, at_stop)]
    )
    span = np.maximum(right.stop[i] - right.start[i], left.stop[j] - left.start[j])
    possible = (
        ~(cut_start & cut_stop)
        & (disparity.min(0) >= 0)
        & (disparity.max(0) <= max_disparity)
        & (np.abs(disparity[0] - disparity[1]) <= np.maximum(2, 0.3 * span))
    )
    return Pairs(i[possible], j[possible], disparity[:, possible])


def support(votes: Reals, places: Ints, pairs: Pairs) -> Reals:
    """Return the votes at both ends of each pair, over 3 x 3 blocks and +-1 px, (pairs,)."""
    for axis in range(3):
        votes = with_neighbours(votes, axis)
    at_ends: Reals = votes.reshape(-1, votes.shape[2])[places, pairs.disparity].sum(0)
    return at_ends


def winners(pairs: Pairs, support: Reals, max_ratio: float) -> NDArray[np.bool_]:
    """Return which pairs are the best for both their trails, and clearly so, (pairs,) bool."""
    best = is_best(pairs.right, support)
    second = np.zeros(pairs.right.max(initial=-1) + 1, np.float32)
    np.maximum.at(second, pairs.right[~best], support[~best])
    won: NDArray[np.bool_] = best & is_best(pairs.left, support)
    won &= second[pairs.right] <= max_ratio * support
    return won


def is_best(trail: Ints, support: Reals) -> NDArray[np.bool_]:
    """Return which pairs alone have the largest support for their trail, (pairs,) bool."""
    largest = np.zeros(trail.max(initial=-1) + 1, np.float32)
    np.maximum.at(largest, trail, support)
    best: NDArray[np.bool_] = support == largest[trail]
    best &= np.bincount(trail[best], minlength=len(largest))[trail] == 1
    return best


def centroids(votes: Reals, places: Ints, disparity: Ints) -> tuple[Reals, Reals]:
    """Return the centroid of the votes within +-2 px, and how many they are.

    Args:
        votes: votes in each block for each disparity, (rows, columns, disparities).
        places: numbers of blocks, int64 of any shape.
        disparity: the disparity to look around at each, px, of the same shape.
    """
    reach = np.arange(-2, 3)
    padded = np.pad(votes.reshape(-1, votes.shape[2]), ((0, 0), (2, 2)))
    near = padded[places[..., None], disparity[..., None] + (reach + 2)]
    agreeing: Reals = near.sum(axis=-1)
    shift = (near @ reach.astype(np.float32)) / np.maximum(agreeing, 1)
    return disparity.astype(np.float32) + shift, agreeing


def has_nearby(
    left: NDArray[np.uint16], row: Ints, column: Ints, unit: NDArray[np.uint16]
) -> NDArray[np.bool_]:
    """Return where an image has the given units within 1 px of places on a row, (places,) bool."""
    width = left.shape[1]
    padded = np.pad(left, ((0, 0), (1, 3)))  # at rest: equal to no unit
    column = np.minimum(column, width + 1)
    found: NDArray[np.bool_] = padded[row, column] == unit
    for step in (1, 2):
        found |= padded[row, column + step] == unit
    return found


def with_neighbours(votes: Reals, axis: int) -> Reals:
    """Return the sum of each cell and its two neighbours along an axis."""
    votes = np.moveaxis(votes, axis, 0)
    total = votes.copy()
    total[1:] += votes[:-1]
    total[:-1] += votes[1:]
    return np.moveaxis(total, 0, axis)


def painted(
    trails: Trails, which: Ints, value: Reals, shape: tuple[int, int]
) -> NDArray[np.float32]:
    """Return an image, NaN but for some trails, on which a value runs from start to stop.

    Args:
        trails: trails of the image.
        which: numbers of the trails to paint, (n,) int64.
        value: value at their starts and at their stops, (2, n) float32.
        shape: height and width of the image in px.
    """
    first = trails.row[which] * shape[1] + trails.start[which]
    length = trails.stop[which] - trails.start[which]
    trail = np.repeat(np.arange(len(which)), length)
    step = np.arange(len(trail)) - np.repeat(np.cumsum(length) - length, length)
    # Ends lie between pixels, so that pixel centres begin half a pixel after the start.
    share = ((step + 0.5) / length[trail]).astype(np.float32)
    image = np.full(shape, np.nan, np.float32)
    image.reshape(-1)[first[trail] + step] = value[0, trail] * (1 - share) + value[1, trail] * share
    return image
