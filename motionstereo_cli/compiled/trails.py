"""Trails found, paired, elected and painted: the loops of :mod:`motionstereo_cli.method.trails`."""

import cython
import numpy as np

NAN = cython.declare(cython.float, np.nan)
MOST_VOTES = cython.declare(cython.int, 65535)
ONE = cython.declare(cython.float, 1)


@cython.cclass
class Workspace:
    """Reusable buffers for matching a frame.

    Args:
        height, width: size of the images in px.
        max_disparity: largest disparity in px.
        block_rows, block_columns: height and width of the blocks that vote together, px.
    """

    height: cython.Py_ssize_t
    width: cython.Py_ssize_t
    disparities: cython.Py_ssize_t
    block_rows: cython.int
    columns: cython.Py_ssize_t
    # Trails of the right (0) and the left (1) image in reading order: number of the first of each
    # row and, at the end, of all; first column, the one after the last, and match key of each.
    first = cython.declare(cython.int[:, ::1], visibility="readonly")
    start = cython.declare(cython.int[:, ::1], visibility="readonly")
    stop = cython.declare(cython.int[:, ::1], visibility="readonly")
    key = cython.declare(cython.ushort[:, ::1], visibility="readonly")
    # Pairs of a right and a left trail that may be the same, ordered by right trail: number of
    # the first pair of each right trail; left trail, left minus right column of starts and stops.
    first_pair: cython.int[::1]
    pairs: cython.int[:, ::1]
    run_stop: cython.int[::1]  # the column after each run of a row, at rest or not
    newest: cython.int[::1]  # of each key, the left trail to try first; -1 between rows
    following: cython.int[::1]  # of each left trail, the next one of its key
    ends: cython.int[:, ::1]  # disparities at the two ends of each right trail, -1 = no winner
    best_left: cython.int[::1]  # of each left trail, the largest support and the next
    next_left: cython.int[::1]
    best: cython.int[:, ::1]  # of the right trails of a row: support, pair
    column: cython.int[::1]  # which column of blocks each pixel of a row lies in
    votes: cython.ushort[:, :, ::1]  # (three rows of blocks, columns of blocks, disparities)
    down: cython.int[:, ::1]  # sums of three rows of blocks, with a border of nothing
    pooled: cython.int[:, ::1]  # sums of 3 x 3 blocks, with a border of two disparities
    near: cython.int[:, ::1]  # the same within +-1 px
    choice: cython.int[::1]  # what each block of a row elected, -1 = not asked yet

    def __init__(self, height, width, max_disparity, block_rows, block_columns):
        self.height, self.width, self.disparities = height, width, max_disparity + 1
        self.block_rows = block_rows
        self.columns = columns = -(-width // block_columns)
        trails = height * width  # at most; unused pages take no memory
        self.first = np.zeros((2, height + 1), np.int32)
        self.start = np.empty((2, trails), np.int32)
        self.stop = np.empty((2, trails), np.int32)
        self.key = np.empty((2, trails), np.uint16)
        self.first_pair = np.zeros(trails + 1, np.int32)
        self.pairs = np.empty((4 * trails + width, 3), np.int32)
        self.run_stop = np.empty(width + 1, np.int32)
        self.newest = np.full(65536, -1, np.int32)
        self.following = np.empty(trails, np.int32)
        self.ends = np.empty((trails, 2), np.int32)
        self.best_left, self.next_left = np.empty((2, trails), np.int32)
        self.best = np.empty((width + 1, 2), np.int32)
        self.column = (np.arange(width) // block_columns).astype(np.int32)
        self.votes = np.empty((3, columns, max_disparity + 1), np.uint16)
        self.down = np.zeros((columns + 2, max_disparity + 1), np.int32)
        self.pooled = np.zeros((columns, max_disparity + 5), np.int32)
        self.near = np.empty((columns, max_disparity + 1), np.int32)
        self.choice = np.empty(columns, np.int32)


def match(
    right: cython.const[cython.ushort][:, ::1],
    left: cython.const[cython.ushort][:, ::1],
    max_ratio: cython.double,
    min_votes: cython.int,
    work: Workspace,
    disparity: cython.float[:, ::1],
    agreement: cython.float[:, ::1],
) -> None:
    """Match two images of match keys: see :func:`motionstereo_cli.method.trails.match_trails`.

    Args:
        right, left: match keys, (height, width) uint16, 0 = at rest.
        max_ratio, min_votes: as there.
        work: workspace for these sizes.
        disparity, agreement: get the disparity in px and the votes that agree with it.
    """
    enough: cython.bint = False
    while not enough:
        with cython.nogil:
            find_trails(right, 0, work)
            find_trails(left, 1, work)
            enough = pair_trails(work)
        if not enough:
            work.newest[:] = -1
            work.pairs = np.empty((2 * work.pairs.shape[0], 3), np.int32)
    with cython.nogil:
        elect_winners(max_ratio, work)
        paint(right, left, min_votes, work, disparity, agreement)


@cython.ccall
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(x=cython.int, y=cython.int, k=cython.int)
def find_trails(
    key: cython.const[cython.ushort][:, ::1], side: cython.int, work: Workspace
) -> cython.void:
    """Find the trails of an image of match keys; ``side`` is 0 for the right one, else 1."""
    trail: cython.int = 0
    width: cython.int = cython.cast(cython.int, key.shape[1])
    for y in range(key.shape[0]):
        runs: cython.int = 0
        for x in range(1, width):
            work.run_stop[runs] = x
            runs += key[y, x] != key[y, x - 1]  # without a branch, which could not be predicted
        work.run_stop[runs] = width
        begin: cython.int = 0
        for k in range(runs + 1):
            work.start[side, trail] = begin
            work.stop[side, trail] = work.run_stop[k]
            work.key[side, trail] = key[y, begin]
            trail += key[y, begin] > 0
            begin = work.run_stop[k]
        work.first[side, y + 1] = trail


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(row=cython.Py_ssize_t, i=cython.int, j=cython.int, key=cython.int)
def pair_trails(work: Workspace) -> cython.bint:
    """Pair trails of equal key on a row whose ends lie 0..max_disparity px apart.

    An end on the border of either image is cut off: then the other end gives both disparities. A
    pair whose two ends disagree by more than max(2 px, 0.3 of its width) is not one surface.
    Returns whether there was room for all pairs.
    """
    count: cython.int = 0
    width: cython.int = cython.cast(cython.int, work.width)
    most: cython.int = cython.cast(cython.int, work.disparities) - 1
    for row in range(work.height):
        begin: cython.int = work.first[1, row]
        end: cython.int = work.first[1, row + 1]
        for j in range(end - 1, begin - 1, -1):
            key = work.key[1, j]
            work.following[j] = work.newest[key]
            work.newest[key] = j
        for i in range(work.first[0, row], work.first[0, row + 1]):
            if count + end - begin > work.pairs.shape[0]:
                return False
            start: cython.int = work.start[0, i]
            stop: cython.int = work.stop[0, i]
            key = work.key[0, i]
            j = work.newest[key]
            while j >= 0 and work.start[1, j] < start:
                j = work.following[j]
            work.newest[key] = j  # starts only grow, so earlier ones are not needed again
            while j >= 0 and work.start[1, j] <= start + most:
                left_stop: cython.int = work.stop[1, j]
                at_start: cython.int = work.start[1, j] - start
                at_stop: cython.int = left_stop - stop
                span: cython.int = max(stop - start, left_stop - work.start[1, j])
                start_is_cut: cython.bint = start == 0
                stop_is_cut: cython.bint = (stop == width) | (left_stop == width)
                first: cython.int = at_stop if start_is_cut else at_start
                last: cython.int = at_start if stop_is_cut else at_stop
                work.pairs[count, 0] = j
                work.pairs[count, 1] = first
                work.pairs[count, 2] = last
                # Without a branch: whether a pair qualifies cannot be predicted.
                count += (
                    (not (start_is_cut & stop_is_cut))
                    & (min(first, last) >= 0)
                    & (max(first, last) <= most)
                    & (10 * abs(first - last) <= max(20, 3 * span))
                )
                j = work.following[j]
            work.first_pair[i + 1] = count
        for j in range(begin, end):
            work.newest[work.key[1, j]] = -1
    return True


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def give(
    work: Workspace, row: cython.Py_ssize_t, column: cython.int, disparity: cython.int
) -> cython.void:
    """Give a block's disparity one more vote, if it has not as many as a number can hold."""
    if work.votes[row, column, disparity] < MOST_VOTES:
        work.votes[row, column, disparity] += 1


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(y=cython.Py_ssize_t, i=cython.int, k=cython.int)
def vote(y: cython.Py_ssize_t, work: Workspace) -> cython.void:
    """Count the pairs in a row of blocks, each at both its ends."""
    begin: cython.Py_ssize_t = y * work.block_rows
    end: cython.Py_ssize_t = min(begin + work.block_rows, work.height)
    if begin >= end:
        return
    y = y % 3
    work.votes[y, :, :] = 0
    for i in range(work.first[0, begin], work.first[0, end]):
        at_start: cython.int = work.column[work.start[0, i]]
        at_stop: cython.int = work.column[work.stop[0, i] - 1]
        for k in range(work.first_pair[i], work.first_pair[i + 1]):
            give(work, y, at_start, work.pairs[k, 1])
            give(work, y, at_stop, work.pairs[k, 2])


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(y=cython.Py_ssize_t, i=cython.int)
def vote_again(y: cython.Py_ssize_t, work: Workspace) -> cython.void:
    """Count the winners only, each at both its ends."""
    begin: cython.Py_ssize_t = y * work.block_rows
    end: cython.Py_ssize_t = min(begin + work.block_rows, work.height)
    if begin >= end:
        return
    y = y % 3
    work.votes[y, :, :] = 0
    for i in range(work.first[0, begin], work.first[0, end]):
        if work.ends[i, 0] >= 0:
            give(work, y, work.column[work.start[0, i]], work.ends[i, 0])
            give(work, y, work.column[work.stop[0, i] - 1], work.ends[i, 1])


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(column=cython.Py_ssize_t, d=cython.Py_ssize_t, other=cython.Py_ssize_t)
def pool(row: cython.Py_ssize_t, work: Workspace) -> cython.void:
    """Add up the votes of 3 x 3 blocks in a row of blocks."""
    votes: cython.ushort[:, :, ::1] = work.votes
    down: cython.int[:, ::1] = work.down
    pooled: cython.int[:, ::1] = work.pooled
    above: cython.Py_ssize_t = max(row - 1, 0)
    last: cython.Py_ssize_t = (work.height - 1) // work.block_rows
    below: cython.Py_ssize_t = min(row + 1, last)
    for column in range(work.columns):
        for d in range(work.disparities):
            down[column + 1, d] = votes[row % 3, column, d]
        for other in range(above, below + 1):
            if other != row:
                for d in range(work.disparities):
                    down[column + 1, d] += votes[other % 3, column, d]
    for column in range(work.columns):
        for d in range(work.disparities):
            pooled[column, d + 2] = down[column, d] + down[column + 1, d] + down[column + 2, d]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(row=cython.Py_ssize_t, block=cython.Py_ssize_t, d=cython.Py_ssize_t)
@cython.locals(i=cython.int, j=cython.int, k=cython.int)
def elect_winners(max_ratio: cython.double, work: Workspace) -> cython.void:
    """Find the disparities at the two ends of each right trail.

    A pair's support is the votes at its ends in 3 x 3 blocks and within +-1 px. It wins if only
    it has the largest support for both its trails, and the second best of the right one has no
    more than ``max_ratio`` of that.
    """
    pairs: cython.int[:, ::1] = work.pairs
    near: cython.int[:, ::1] = work.near
    pooled: cython.int[:, ::1] = work.pooled
    best_left: cython.int[::1] = work.best_left
    next_left: cython.int[::1] = work.next_left
    for j in range(work.first[1, work.height]):
        best_left[j] = next_left[j] = 0
    vote(0, work)
    for row in range(work.height):
        if row % work.block_rows == 0:
            vote(row // work.block_rows + 1, work)
            pool(row // work.block_rows, work)
            for block in range(work.columns):
                for d in range(work.disparities):
                    near[block, d] = (
                        pooled[block, d + 1] + pooled[block, d + 2] + pooled[block, d + 3]
                    )
        begin: cython.int = work.first[0, row]
        end: cython.int = work.first[0, row + 1]
        for i in range(begin, end):
            at_start: cython.int = work.column[work.start[0, i]]
            at_stop: cython.int = work.column[work.stop[0, i] - 1]
            most: cython.int = 0
            second: cython.int = 0
            winner: cython.int = -1
            for k in range(work.first_pair[i], work.first_pair[i + 1]):
                j = pairs[k, 0]
                support: cython.int = near[at_start, pairs[k, 1]] + near[at_stop, pairs[k, 2]]
                second = max(second, min(most, support))
                winner = k if support > most else winner
                most = max(most, support)
                next_left[j] = max(next_left[j], min(best_left[j], support))
                best_left[j] = max(best_left[j], support)
            work.best[i - begin, 0] = most
            work.best[i - begin, 1] = winner if second <= max_ratio * most and second < most else -1
        for i in range(begin, end):
            work.ends[i, 0] = work.ends[i, 1] = -1
            k = work.best[i - begin, 1]
            if k >= 0:
                j = pairs[k, 0]
                most = work.best[i - begin, 0]
                if next_left[j] < most and best_left[j] == most:
                    work.ends[i, 0] = pairs[k, 1]
                    work.ends[i, 1] = pairs[k, 2]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def votes_near(block: cython.int, disparity: cython.int, work: Workspace) -> cython.float:
    """Return how many votes a block has within +-2 px of a disparity."""
    d: cython.int
    total: cython.int = 0
    for d in range(disparity, disparity + 5):
        total += work.pooled[block, d]
    return cython.cast(cython.float, total)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def centroid(
    block: cython.int, disparity: cython.int, total: cython.float, work: Workspace
) -> cython.float:
    """Return the centroid of a block's ``total`` votes within +-2 px of a disparity, px."""
    a: cython.int = work.pooled[block, disparity]
    b: cython.int = work.pooled[block, disparity + 1]
    d: cython.int = work.pooled[block, disparity + 3]
    e: cython.int = work.pooled[block, disparity + 4]
    moment: cython.float = cython.cast(cython.float, d - b + 2 * (e - a))
    at_least_one: cython.float = max(total, ONE)
    return cython.cast(cython.float, disparity) + moment / at_least_one


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def elected(block: cython.int, work: Workspace) -> cython.int:
    """Return the disparity within +-1 px of which a block has the most votes."""
    most: cython.int = -1
    winner: cython.int = 0
    d: cython.int
    for d in range(cython.cast(cython.int, work.disparities)):
        count: cython.int = (
            work.pooled[block, d + 1] + work.pooled[block, d + 2] + work.pooled[block, d + 3]
        )
        if count > most:
            most, winner = count, d
    return winner


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(x=cython.int, y=cython.int, i=cython.int, column=cython.int)
def paint(
    right: cython.const[cython.ushort][:, ::1],
    left: cython.const[cython.ushort][:, ::1],
    min_votes: cython.int,
    work: Workspace,
    disparity: cython.float[:, ::1],
    agreement: cython.float[:, ::1],
) -> cython.void:
    """Fill in the images of disparity and of votes, NaN = unknown."""
    width: cython.int = cython.cast(cython.int, work.width)
    vote_again(0, work)
    for y in range(cython.cast(cython.int, work.height)):
        disparity[y, :] = NAN
        agreement[y, :] = NAN
        if y % work.block_rows == 0:
            vote_again(y // work.block_rows + 1, work)
            pool(y // work.block_rows, work)
            work.choice[:] = -1
        for i in range(work.first[0, y], work.first[0, y + 1]):
            start: cython.int = work.start[0, i]
            stop: cython.int = work.stop[0, i]
            if work.ends[i, 0] >= 0:
                block: cython.int = work.column[start]
                begin_votes: cython.float = votes_near(block, work.ends[i, 0], work)
                begin: cython.float = centroid(block, work.ends[i, 0], begin_votes, work)
                block = work.column[stop - 1]
                end_votes: cython.float = votes_near(block, work.ends[i, 1], work)
                end: cython.float = centroid(block, work.ends[i, 1], end_votes, work)
                for x in range(start, stop):
                    # Ends lie between pixels: pixel centres begin half a pixel after the start.
                    share: cython.float = cython.cast(
                        cython.float, (x - start + 0.5) / (stop - start)
                    )
                    rest: cython.float = ONE - share
                    votes: cython.float = begin_votes * rest + end_votes * share
                    agreement[y, x] = votes
                    if votes >= min_votes:
                        disparity[y, x] = begin * rest + end * share
                continue
            for x in range(start, stop):
                block = work.column[x]
                if work.choice[block] < 0:
                    work.choice[block] = elected(block, work)
                choice: cython.int = work.choice[block]
                agreeing: cython.float = votes_near(block, choice, work)
                if agreeing < min_votes:
                    continue
                there: cython.int = x + choice
                for column in range(max(there - 1, 0), min(there + 2, width)):
                    if left[y, column] == right[y, x]:
                        disparity[y, x] = centroid(block, choice, agreeing, work)
                        agreement[y, x] = agreeing
