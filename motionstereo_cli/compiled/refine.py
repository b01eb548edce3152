"""One step of Lucas and Kanade: the loops of :mod:`motionstereo_cli.method.refine`.

Rows are processed once. Sums over windows are made down first, then across; at the border the last
pixel is repeated. Compilers vectorise loops over arrays that are arguments of a separate function.
"""

import cython
import numpy as np

NAN = cython.declare(cython.float, np.nan)
ZERO = cython.declare(cython.float, 0)
HALF = cython.declare(cython.float, 0.5)
ONE = cython.declare(cython.float, 1)
NONE = cython.declare(cython.float, 10000)  # px: more than any disparity

#: A window reaches so many rows up and down, and 7 px to both sides.
DOWN = cython.declare(cython.int, 3)
PIXELS = cython.declare(cython.float, 7 * 15)
KEPT = cython.declare(cython.int, 7)  # rows: those of a window

#: What :func:`combine` does.
SUM = cython.declare(cython.int, 0)
MOST = cython.declare(cython.int, 1)


@cython.cclass
@cython.dataclasses.dataclass
class Limits:
    """See the constants of :mod:`motionstereo_cli.method.refine`."""

    max_range: cython.float
    damping: cython.float
    per_difference: cython.float
    max_grey: cython.float
    max_step: cython.float


@cython.cclass
class Workspace:
    """Reusable buffers for a frame.

    Args:
        width: of the images in px.
    """

    sums: cython.float[:, ::1]  # of a row, down: disparity, pixels, -least, most; or the fields
    whole: cython.float[:, ::1]  # likewise, and across
    part: cython.float[:, ::1]  # sums of 2, 4 and 8 px
    fields: cython.float[:, :, ::1]  # of the rows of a window: products of difference and slope
    start: cython.float[:, ::1]  # of the same rows: disparity to begin at, NaN = to be kept
    slope: cython.float[:, ::1]  # of a row of the left and the right view

    def __init__(self, width: cython.Py_ssize_t):
        self.sums = np.zeros((4, width + 16), np.float32)
        self.whole = np.zeros((4, width), np.float32)
        self.part = np.zeros((3, width + 16), np.float32)
        self.fields = np.zeros((7, 3, width), np.float32)
        self.start = np.zeros((7, width), np.float32)
        self.slope = np.zeros((2, width), np.float32)


def refine(
    disparity: cython.const[cython.float][:, ::1],
    right: cython.const[cython.float][:, ::1],
    left: cython.const[cython.float][:, ::1],
    limits: Limits,
    work: Workspace,
    result: cython.float[:, ::1],
) -> None:
    """Fill in disparity: see :func:`motionstereo_cli.method.refine.refined`."""
    last: cython.int
    i: cython.int
    j: cython.int
    rows: cython.int = cython.cast(cython.int, disparity.shape[0])
    with cython.nogil:
        for last in range(rows + DOWN):
            if last < rows:
                surround(disparity, last, work)
                incline(left[last], work.slope[0])
                incline(right[last], work.slope[1])
                compare(disparity[last], right[last], left[last], limits, last % KEPT, work)
            y: cython.int = last - DOWN
            if y < 0:
                continue
            for i in range(3):
                work.sums[i, :] = 0
                for j in range(y - DOWN, y + DOWN + 1):
                    add(work.fields[min(max(j, 0), rows - 1) % KEPT, i], work.sums[i])
                continue_border(work.sums[i])
                combine(work.sums[i], work.part, work.whole[i], SUM)
            move(disparity[y], work.start[y % KEPT], limits, work.whole, result[y])


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def surround(
    disparity: cython.const[cython.float][:, ::1], y: cython.int, work: Workspace
) -> cython.void:
    """Fill in sum, number, minus the least and the largest of the disparities around each pixel."""
    j: cython.int
    i: cython.int
    rows: cython.int = cython.cast(cython.int, disparity.shape[0])
    work.sums[0, :] = 0
    work.sums[1, :] = 0
    work.sums[2, :] = -NONE
    work.sums[3, :] = -NONE
    for j in range(y - DOWN, y + DOWN + 1):
        row: cython.const[cython.float][::1] = disparity[min(max(j, 0), rows - 1)]
        take(row, work.sums[0], work.sums[1], work.sums[2], work.sums[3])
    for i in range(4):
        continue_border(work.sums[i])
    combine(work.sums[0], work.part, work.whole[0], SUM)
    combine(work.sums[1], work.part, work.whole[1], SUM)
    combine(work.sums[2], work.part, work.whole[2], MOST)
    combine(work.sums[3], work.part, work.whole[3], MOST)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def take(
    disparity: cython.const[cython.float][::1],
    total: cython.float[::1],
    known: cython.float[::1],
    least: cython.float[::1],
    most: cython.float[::1],
) -> cython.void:
    """Add a row to the sums, from the eighth place on; ``least`` is the largest of -disparity."""
    x: cython.Py_ssize_t
    for x in range(disparity.shape[0]):
        d: cython.float = disparity[x]
        is_known: cython.bint = d == d  # noqa: PLR0124
        total[x + 7] = total[x + 7] + (d if is_known else ZERO)
        known[x + 7] = known[x + 7] + (ONE if is_known else ZERO)
        low: cython.float = -d if is_known else -NONE
        high: cython.float = d if is_known else -NONE
        least[x + 7] = low if low > least[x + 7] else least[x + 7]
        most[x + 7] = high if high > most[x + 7] else most[x + 7]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def add(row: cython.const[cython.float][::1], total: cython.float[::1]) -> cython.void:
    """Add a row to a sum, from the eighth place on."""
    x: cython.Py_ssize_t
    for x in range(row.shape[0]):
        total[x + 7] = total[x + 7] + row[x]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def continue_border(row: cython.float[::1]) -> cython.void:
    """Continue a row by its first and its last pixel; it begins at the eighth place."""
    x: cython.Py_ssize_t
    last: cython.Py_ssize_t = row.shape[0] - 10
    for x in range(7):
        row[x] = row[7]
    for x in range(last + 1, row.shape[0]):
        row[x] = row[last]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def combine(
    row: cython.const[cython.float][::1],
    part: cython.float[:, ::1],
    result: cython.float[::1],
    how: cython.int,
) -> cython.void:
    """Fill in the sum or the largest of 15 pixels, by those of 2, 4 and 8."""
    x: cython.Py_ssize_t
    width: cython.Py_ssize_t = result.shape[0]
    two: cython.float[::1] = part[0]
    four: cython.float[::1] = part[1]
    eight: cython.float[::1] = part[2]
    if how == SUM:
        for x in range(width + 13):
            two[x] = row[x] + row[x + 1]
        for x in range(width + 11):
            four[x] = two[x] + two[x + 2]
        for x in range(width + 7):
            eight[x] = four[x] + four[x + 4]
        for x in range(width):
            result[x] = eight[x] + four[x + 8] + two[x + 12] + row[x + 14]
    else:
        for x in range(width + 13):
            two[x] = row[x] if row[x] > row[x + 1] else row[x + 1]
        for x in range(width + 11):
            four[x] = two[x] if two[x] > two[x + 2] else two[x + 2]
        for x in range(width + 7):
            eight[x] = four[x] if four[x] > four[x + 4] else four[x + 4]
        for x in range(width):
            result[x] = eight[x] if eight[x] > eight[x + 7] else eight[x + 7]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def incline(grey: cython.const[cython.float][::1], slope: cython.float[::1]) -> cython.void:
    """Fill in slopes of grey; 0 at the border, as if the image were mirrored."""
    x: cython.Py_ssize_t
    last: cython.Py_ssize_t = grey.shape[0] - 1
    slope[0] = 0
    slope[last] = 0
    for x in range(1, last):
        slope[x] = (grey[x + 1] - grey[x - 1]) * HALF


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def compare(
    disparity: cython.const[cython.float][::1],
    right: cython.const[cython.float][::1],
    left: cython.const[cython.float][::1],
    limits: Limits,
    slot: cython.int,
    work: Workspace,
) -> cython.void:
    """Fill in products of slopes and differences of a row, and the disparities to begin at."""
    x: cython.Py_ssize_t
    last: cython.int = cython.cast(cython.int, disparity.shape[0]) - 1
    fields: cython.float[:, ::1] = work.fields[slot]
    for x in range(disparity.shape[0]):
        fields[0, x] = 0
        fields[1, x] = 0
        fields[2, x] = 0
        work.start[slot, x] = NAN
        here: cython.float = disparity[x]
        if here != here:  # noqa: PLR0124
            continue
        if work.whole[3, x] + work.whole[2, x] <= limits.max_range:
            here = work.whole[0, x] / work.whole[1, x]
            work.start[slot, x] = here
        place: cython.float = cython.cast(cython.float, x) + here
        if place > last or place < 0:
            continue
        column: cython.int = cython.cast(cython.int, place)
        beside: cython.int = min(column + 1, last)
        share: cython.float = place - cython.cast(cython.float, column)
        near: cython.float = left[column]
        differs: cython.float = near + (left[beside] - near) * share - right[x]
        if abs(differs) >= limits.max_grey:
            continue
        near = work.slope[0, column]
        slope: cython.float = near + (work.slope[0, beside] - near) * share
        slope = (slope + work.slope[1, x]) * HALF
        fields[0, x] = differs * differs
        fields[1, x] = slope * differs
        fields[2, x] = slope * slope


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def move(
    disparity: cython.const[cython.float][::1],
    start: cython.const[cython.float][::1],
    limits: Limits,
    whole: cython.const[cython.float][:, ::1],
    result: cython.float[::1],
) -> cython.void:
    """Fill in a row of refined disparities."""
    x: cython.Py_ssize_t
    for x in range(disparity.shape[0]):
        here: cython.float = disparity[x]
        result[x] = here
        if start[x] != start[x]:
            continue
        damping: cython.float = limits.damping + limits.per_difference * (whole[0, x] / PIXELS)
        step: cython.float = (whole[1, x] / PIXELS) / (whole[2, x] / PIXELS + damping)
        moved: cython.float = start[x] - step
        moved = max(min(moved, here + limits.max_step), here - limits.max_step)
        result[x] = max(moved, ZERO)
