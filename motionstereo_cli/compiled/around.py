"""Counts around each pixel, and what cannot be: loops of :mod:`motionstereo_cli.method.planes`.

Two counts are kept in one number, which may overflow because only differences are used. Compilers
vectorise loops over arrays that are arguments of a separate function.
"""

import cython
import numpy as np

NAN = cython.declare(cython.float, np.nan)

#: The second count is multiplied by this; the bits of the first.
SECOND = cython.declare(cython.uint, 65536)
FIRST = cython.declare(cython.uint, 65535)


@cython.cclass
class Counts:
    """Room for two counts over a window around each pixel of a row.

    Args:
        width: of the image.
        reach_x, reach_y: the window reaches so many px and rows to each side.
    """

    row: cython.uint[::1]  # what counts in a row, see :data:`SECOND`
    down: cython.uint[::1]  # sums over the window's rows
    before: cython.uint[::1]  # of all columns before one, beginning at the first less the reach
    reach_x: cython.Py_ssize_t
    reach_y: cython.Py_ssize_t

    def __init__(
        self, width: cython.Py_ssize_t, reach_x: cython.Py_ssize_t, reach_y: cython.Py_ssize_t
    ):
        self.row = np.zeros(width, np.uint32)
        self.down = np.zeros(width, np.uint32)
        self.before = np.zeros(width + 2 * reach_x + 1, np.uint32)
        self.reach_x = reach_x
        self.reach_y = reach_y


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def add_row(counts: Counts, sign: cython.int) -> cython.void:
    """Add a row to the sums, or take it away."""
    x: cython.Py_ssize_t
    row: cython.uint[::1] = counts.row
    down: cython.uint[::1] = counts.down
    if sign > 0:
        for x in range(row.shape[0]):
            down[x] += row[x]
    else:
        for x in range(row.shape[0]):
            down[x] -= row[x]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def add_across(counts: Counts) -> cython.void:
    """Add up the sums of all columns before each. Only their differences count."""
    x: cython.Py_ssize_t
    total: cython.uint = 0
    reach: cython.Py_ssize_t = counts.reach_x
    width: cython.Py_ssize_t = counts.down.shape[0]
    for x in range(width):
        total += counts.down[x]
        counts.before[reach + 1 + x] = total
    for x in range(reach):
        counts.before[reach + 1 + width + x] = total


def believe(
    disparity: cython.const[cython.float][:, ::1],
    trails: cython.const[cython.float][:, ::1],
    smooth: cython.const[cython.uchar][:, ::1],
    agree_px: cython.float,
    agreeing: cython.float,
    counts: Counts,
    source: cython.float[:, ::1],
    weight: cython.uchar[:, ::1],
) -> None:
    """Fill in the samples of planes nearby: trails where they are trusted, else disparity.

    Args:
        disparity, trails: px, (rows, width), NaN = unknown.
        smooth: where grey tells little, 0 or 1.
        agree_px: they agree where they differ by at most this.
        agreeing: trails are believed where more than this share of them around agrees.
        counts: room for the numbers of those around.
        source: gets the disparity in px.
        weight: gets twice what it weighs: half as much where it is only smooth.
    """
    y: cython.Py_ssize_t
    rows: cython.Py_ssize_t = disparity.shape[0]
    reach: cython.Py_ssize_t = counts.reach_y
    with cython.nogil:
        counts.down[:] = 0
        for y in range(-reach, rows):
            if y + reach < rows:
                compare(disparity[y + reach], trails[y + reach], agree_px, counts.row)
                add_row(counts, 1)
            if y > reach:
                compare(disparity[y - reach - 1], trails[y - reach - 1], agree_px, counts.row)
                add_row(counts, -1)
            if y >= 0:
                add_across(counts)
                choose(
                    disparity[y],
                    trails[y],
                    smooth[y],
                    counts.before,
                    2 * counts.reach_x + 1,
                    agreeing,
                    source[y],
                    weight[y],
                )


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def compare(
    disparity: cython.const[cython.float][::1],
    trails: cython.const[cython.float][::1],
    agree_px: cython.float,
    row: cython.uint[::1],
) -> cython.void:
    """Fill in where both are known, and where they agree."""
    x: cython.Py_ssize_t
    for x in range(row.shape[0]):
        away: cython.float = abs(disparity[x] - trails[x])
        both: cython.uint = 1 if away == away else 0  # noqa: PLR0124
        agree: cython.uint = SECOND if away <= agree_px else 0
        row[x] = both + agree


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def choose(
    disparity: cython.const[cython.float][::1],
    trails: cython.const[cython.float][::1],
    smooth: cython.const[cython.uchar][::1],
    before: cython.const[cython.uint][::1],
    wide: cython.Py_ssize_t,
    agreeing: cython.float,
    source: cython.float[::1],
    weight: cython.uchar[::1],
) -> cython.void:
    """Fill in a row of what planes are fitted to."""
    x: cython.Py_ssize_t
    for x in range(source.shape[0]):
        both: cython.uint = before[x + wide] - before[x]
        agree: cython.int = cython.cast(cython.int, both >> 16)
        known: cython.int = cython.cast(cython.int, both & FIRST)
        t: cython.float = trails[x]
        d: cython.float = disparity[x]
        believed: cython.bint = (agree > agreeing * known) & (smooth[x] != 0) & (t == t)  # noqa: PLR0124
        source[x] = t if believed else d
        weight[x] = 1 if (smooth[x] != 0) & (not believed) else 2


def find_moving(
    textured: cython.const[cython.uchar][:, ::1],
    age: cython.const[cython.uchar][:, ::1],
    need: cython.const[cython.uchar][:, ::1],
    rest_frames: cython.int,
    resting: cython.float,
    least: cython.int,
    counts: Counts,
    result: cython.uchar[:, ::1],
) -> None:
    """Fill in where a plane is needed and the textured pixels around are not at rest.

    Args:
        textured, age, need: of each pixel, (rows, width).
        rest_frames: it rests if it has not moved for so many frames.
        resting: what is around rests if so large a share of it does,
        least: and if there is so much of it.
        counts: room for the numbers of what is around.
        result: gets 0 or 1.
    """
    y: cython.Py_ssize_t
    rows: cython.Py_ssize_t = textured.shape[0]
    reach: cython.Py_ssize_t = counts.reach_y
    with cython.nogil:
        counts.down[:] = 0
        for y in range(-reach, rows):
            if y + reach < rows:
                rest(textured[y + reach], age[y + reach], rest_frames, counts.row)
                add_row(counts, 1)
            if y > reach:
                rest(textured[y - reach - 1], age[y - reach - 1], rest_frames, counts.row)
                add_row(counts, -1)
            if y >= 0:
                add_across(counts)
                move(need[y], counts.before, 2 * counts.reach_x + 1, resting, least, result[y])


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def rest(
    textured: cython.const[cython.uchar][::1],
    age: cython.const[cython.uchar][::1],
    rest_frames: cython.int,
    row: cython.uint[::1],
) -> cython.void:
    """Fill in what is textured, and what of that rests."""
    x: cython.Py_ssize_t
    for x in range(row.shape[0]):
        known: cython.uint = cython.cast(cython.uint, textured[x])
        rests: cython.uint = 1 if age[x] >= rest_frames else 0
        row[x] = known + (known & rests) * SECOND


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def move(
    need: cython.const[cython.uchar][::1],
    before: cython.const[cython.uint][::1],
    wide: cython.Py_ssize_t,
    resting: cython.float,
    least: cython.int,
    result: cython.uchar[::1],
) -> cython.void:
    """Fill in a row of what is needed and does not rest."""
    x: cython.Py_ssize_t
    for x in range(result.shape[0]):
        both: cython.uint = before[x + wide] - before[x]
        rests: cython.int = cython.cast(cython.int, both >> 16)
        textured: cython.int = cython.cast(cython.int, both & FIRST)
        still: cython.bint = (textured >= least) & (rests + 1 > resting * (textured + 2))
        result[x] = 0 if still else need[x]


def forget_unseen(
    error: cython.const[cython.float][:, ::1],
    max_error_px: cython.float,
    result: cython.float[:, ::1],
    share: cython.float[:, ::1],
) -> None:
    """Forget disparities whose partner lies beyond the left view's border, but of sure planes."""
    y: cython.Py_ssize_t
    x: cython.Py_ssize_t
    last: cython.Py_ssize_t = result.shape[1] - 1
    with cython.nogil:
        for y in range(result.shape[0]):
            for x in range(result.shape[1]):
                if x + result[y, x] > last and not error[y, x] < max_error_px:
                    result[y, x] = share[y, x] = NAN
