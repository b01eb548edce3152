"""Disparity by pairing the trails of the right memory with those of the left one.

A *trail* is a maximal run of equal units on one row. Its two ends are where a moving edge was at
two successive instants, so each end of a pair of corresponding trails has the disparity of that
edge.

Compiled by numba: the same in NumPy took four times as long as cv2.StereoBM.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import kernel

Ints = NDArray[np.int32]
Reals = NDArray[np.float32]


class Trails(NamedTuple):
    """The trails of one image in reading order.

    Attributes:
        first: number of the first trail of each row and, at the end, of all, (height + 1,) int32.
        start, stop: first column of each trail, and the one after its last, (trails,) int32.
        unit: what its pixels have in common, (trails,) uint16.
    """

    first: Ints
    start: Ints
    stop: Ints
    unit: NDArray[np.uint16]


class Pairs(NamedTuple):
    """Pairs of a right and a left trail that may be the same, ordered by right trail.

    Attributes:
        first: number of the first pair of each right trail and, at the end, of all,
            (right trails + 1,) int32.
        each: left trail, left minus right column of their starts and of their stops in px,
            (at least pairs, 3) int32.
    """

    first: Ints
    each: Ints


class Blocks(NamedTuple):
    """A grid over the right image whose cells gather the votes of the trails in them.

    Votes are counted in int32 arrays of (rows, columns, disparities).

    Attributes:
        height: height of a block in px.
        column: which column of blocks each pixel of a row lies in, (width,) int32.
    """

    height: int
    column: Ints


def match_trails(
    right: NDArray[np.uint16],
    left: NDArray[np.uint16],
    max_disparity: int,
    *,
    block_px: tuple[int, int] = (8, 8),
    max_ratio: float = 0.9,
    min_votes: int = 16,
) -> tuple[Reals, Reals]:
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
        min_votes: votes, in 3 x 3 blocks and within +-2 px, that a disparity needs.
    """
    width = right.shape[1]
    rows, columns = (-(-right.shape[i] // block_px[i]) for i in (0, 1))
    blocks = Blocks(block_px[0], (np.arange(width) // block_px[1]).astype(np.int32))
    trails, others = find_trails(right), find_trails(left)
    pairs = pair_trails(trails, others, width, max_disparity)
    votes = np.zeros((rows, columns, max_disparity + 1), np.int32)
    vote(trails, pairs, blocks, votes)
    ends = winners(trails, others, pairs, blocks, max_ratio, votes)
    votes[:] = 0
    vote_again(trails, ends, blocks, votes)
    return painted(right, left, trails, ends, blocks, min_votes, votes)


@kernel
def find_trails(units: NDArray[np.uint16]) -> Trails:
    """Return the trails of an image of units, (height, width) uint16, 0 = at rest."""
    height, width = units.shape
    count = 0
    for y in range(height):
        count += units[y, 0] > 0
        for x in range(1, width):
            count += (units[y, x] > 0) & (units[y, x] != units[y, x - 1])
    first = np.zeros(height + 1, np.int32)
    start, stop = np.empty(count, np.int32), np.empty(count, np.int32)
    unit = np.empty(count, np.uint16)
    stops = np.empty(width, np.int32)  # of all runs of a row, at rest or not
    trail = 0
    for y in range(height):
        runs = 0
        for x in range(1, width):
            stops[runs] = x
            runs += units[y, x] != units[y, x - 1]  # no branch: nobody can foresee it
        stops[runs] = width
        begin = 0
        for k in range(runs + 1):
            if units[y, begin] > 0:
                start[trail], stop[trail], unit[trail] = begin, stops[k], units[y, begin]
                trail += 1
            begin = stops[k]
        first[y + 1] = trail
    return Trails(first, start, stop, unit)


@kernel
def pair_trails(right: Trails, left: Trails, width: int, max_disparity: int) -> Pairs:
    """Return the pairs of equal unit on a row whose ends lie 0..max_disparity px apart.

    An end on the border of either image is cut off: then the other end speaks for both. A pair
    whose two ends disagree by more than max(2 px, 0.3 of its width) is not one surface.
    """
    first = np.zeros(len(right.start) + 1, np.int32)
    each = np.empty((16 * len(right.start) + width, 3), np.int32)
    newest = np.full(65536, -1, np.int32)  # of each unit, the left trail to try first
    following = np.empty(len(left.start), np.int32)  # the next one of its unit
    count = 0
    for row in range(len(right.first) - 1):
        begin, end = left.first[row], left.first[row + 1]
        for j in range(end - 1, begin - 1, -1):
            following[j] = newest[left.unit[j]]
            newest[left.unit[j]] = j
        for i in range(right.first[row], right.first[row + 1]):
            if count + end - begin > len(each):
                each = np.concatenate((each, np.empty_like(each)))
            start, stop = right.start[i], right.stop[i]
            j = newest[right.unit[i]]
            while j >= 0 and left.start[j] < start:
                j = following[j]
            newest[right.unit[i]] = j  # starts only grow: nobody comes back to those before
            while j >= 0 and left.start[j] <= start + max_disparity:
                at_start, at_stop = left.start[j] - start, left.stop[j] - stop
                span = max(stop - start, left.stop[j] - left.start[j])
                start_is_cut = start == 0
                stop_is_cut = (stop == width) | (left.stop[j] == width)
                at_start, at_stop = (
                    at_stop if start_is_cut else at_start,
                    at_start if stop_is_cut else at_stop,
                )
                each[count, 0], each[count, 1], each[count, 2] = j, at_start, at_stop
                # No branch: whether a pair is one cannot be foreseen.
                count += (
                    (not (start_is_cut & stop_is_cut))
                    & (min(at_start, at_stop) >= 0)
                    & (max(at_start, at_stop) <= max_disparity)
                    & (10 * abs(at_start - at_stop) <= max(20, 3 * span))
                )
                j = following[j]
            first[i + 1] = count
        for j in range(begin, end):
            newest[left.unit[j]] = -1
    return Pairs(first, each)


@kernel
def vote(right: Trails, pairs: Pairs, blocks: Blocks, votes: Ints) -> None:
    """Count all pairs, each at both its ends, in ``votes``."""
    for row in range(len(right.first) - 1):
        y = row // blocks.height
        for i in range(right.first[row], right.first[row + 1]):
            at_start = votes[y, blocks.column[right.start[i]]]
            at_stop = votes[y, blocks.column[right.stop[i] - 1]]
            for k in range(pairs.first[i], pairs.first[i + 1]):
                at_start[pairs.each[k, 1]] += 1
                at_stop[pairs.each[k, 2]] += 1


@kernel
def vote_again(right: Trails, ends: Ints, blocks: Blocks, votes: Ints) -> None:
    """Count the winners alone, each at both its ends, in ``votes``."""
    for row in range(len(right.first) - 1):
        y = row // blocks.height
        for i in range(right.first[row], right.first[row + 1]):
            if ends[i, 0] >= 0:
                votes[y, blocks.column[right.start[i]], ends[i, 0]] += 1
                votes[y, blocks.column[right.stop[i] - 1], ends[i, 1]] += 1


@kernel
def pool(votes: Ints, row: int, down: Ints, pooled: Ints) -> None:
    """Add up the votes of 3 x 3 blocks in a row of blocks.

    Args:
        votes: votes in each block for each disparity, (rows, columns, disparities).
        row: number of the row.
        down: room for the sums of three rows, (columns + 2, disparities), whose border stays 0.
        pooled: gets the sums, (columns, disparities + 4), whose border of two stays 0.
    """
    rows, columns, disparities = votes.shape
    above, below = max(row - 1, 0), min(row + 1, rows - 1)
    for column in range(columns):
        for d in range(disparities):
            down[column + 1, d] = votes[row, column, d]
        if above < row:
            for d in range(disparities):
                down[column + 1, d] += votes[above, column, d]
        if below > row:
            for d in range(disparities):
                down[column + 1, d] += votes[below, column, d]
    for column in range(columns):
        for d in range(disparities):
            pooled[column, d + 2] = down[column, d] + down[column + 1, d] + down[column + 2, d]


@kernel
def winners(
    right: Trails, left: Trails, pairs: Pairs, blocks: Blocks, max_ratio: float, votes: Ints
) -> Ints:
    """Return the disparities at the two ends of each right trail, (trails, 2), -1 = no winner.

    A pair's support is the votes at its ends in 3 x 3 blocks and within +-1 px. It wins if it
    alone has the largest support for both its trails, and the second best of the right one has
    no more than ``max_ratio`` of that.
    """
    ends = np.full((len(right.start), 2), -1, np.int32)
    best_left = np.zeros(len(left.start), np.int32)
    next_left = np.zeros(len(left.start), np.int32)
    best = np.empty((max(len(blocks.column), 1), 2), np.int32)  # of a row: support, pair
    columns, disparities = votes.shape[1], votes.shape[2]
    down = np.zeros((columns + 2, disparities), np.int32)
    pooled = np.zeros((columns, disparities + 4), np.int32)
    near = np.zeros((columns, disparities), np.int32)  # within +-1 px
    for row in range(len(right.first) - 1):
        if row % blocks.height == 0:
            pool(votes, row // blocks.height, down, pooled)
            for block in range(columns):
                for d in range(disparities):
                    near[block, d] = (
                        pooled[block, d + 1] + pooled[block, d + 2] + pooled[block, d + 3]
                    )
        begin = right.first[row]
        for i in range(begin, right.first[row + 1]):
            at_start = near[blocks.column[right.start[i]]]
            at_stop = near[blocks.column[right.stop[i] - 1]]
            most = second = 0
            winner = -1
            for k in range(pairs.first[i], pairs.first[i + 1]):
                j = pairs.each[k, 0]
                support = at_start[pairs.each[k, 1]] + at_stop[pairs.each[k, 2]]
                second = max(second, min(most, support))
                winner = k if support > most else winner
                most = max(most, support)
                next_left[j] = max(next_left[j], min(best_left[j], support))
                best_left[j] = max(best_left[j], support)
            best[i - begin, 0] = most
            best[i - begin, 1] = winner if second <= max_ratio * most and second < most else -1
        for i in range(begin, right.first[row + 1]):
            most, k = best[i - begin, 0], best[i - begin, 1]
            if k >= 0:
                j = pairs.each[k, 0]
                if next_left[j] < most and best_left[j] == most:
                    ends[i, 0], ends[i, 1] = pairs.each[k, 1], pairs.each[k, 2]
    return ends


@kernel
def centroid(near: Ints, disparity: int) -> tuple[np.float32, np.float32]:
    """Return the centroid of votes within +-2 px of a disparity, and how many they are, float32.

    Args:
        near: votes for each disparity, with a border of two, (disparities + 4,).
        disparity: px.
    """
    a, b, c = near[disparity], near[disparity + 1], near[disparity + 2]
    d, e = near[disparity + 3], near[disparity + 4]
    total = np.float32(a + b + c + d + e)
    shift = np.float32(d - b + 2 * (e - a)) / max(total, np.float32(1))
    return np.float32(disparity) + shift, total


@kernel
def elected(near: Ints) -> int:
    """Return the disparity within +-1 px of which there are the most votes."""
    most, winner = -1, 0
    for d in range(len(near) - 4):
        count = near[d + 1] + near[d + 2] + near[d + 3]
        if count > most:
            most, winner = count, d
    return winner


@kernel
def painted(
    right: NDArray[np.uint16],
    left: NDArray[np.uint16],
    trails: Trails,
    ends: Ints,
    blocks: Blocks,
    min_votes: int,
    votes: Ints,
) -> tuple[Reals, Reals]:
    """Return the images of disparity and of votes, (height, width) float32, NaN = unknown."""
    height, width = right.shape
    disparity = np.full((height, width), np.nan, np.float32)
    agreement = np.full((height, width), np.nan, np.float32)
    down = np.zeros((votes.shape[1] + 2, votes.shape[2]), np.int32)
    near = np.zeros((votes.shape[1], votes.shape[2] + 4), np.int32)
    choice = np.empty(votes.shape[1], np.int32)
    one = np.float32(1)
    for y in range(height):
        if y % blocks.height == 0:
            pool(votes, y // blocks.height, down, near)
            choice.fill(-1)
        for i in range(trails.first[y], trails.first[y + 1]):
            start, stop = trails.start[i], trails.stop[i]
            if ends[i, 0] >= 0:
                begin, begin_votes = centroid(near[blocks.column[start]], ends[i, 0])
                end, end_votes = centroid(near[blocks.column[stop - 1]], ends[i, 1])
                for x in range(start, stop):
                    # Ends lie between pixels: pixel centres begin half a pixel after the start.
                    share = np.float32((x - start + 0.5) / (stop - start))
                    agreement[y, x] = begin_votes * (one - share) + end_votes * share
                    if agreement[y, x] >= min_votes:
                        disparity[y, x] = begin * (one - share) + end * share
                continue
            for x in range(start, stop):
                block = blocks.column[x]
                if choice[block] < 0:
                    choice[block] = elected(near[block])
                at, agreeing = centroid(near[block], choice[block])
                there = x + choice[block]
                for column in range(max(there - 1, 0), min(there + 2, width)):
                    if left[y, column] == right[y, x] and agreeing >= min_votes:
                        disparity[y, x], agreement[y, x] = at, agreeing
    return disparity, agreement
