"""One step of Lucas and Kanade: the loops of :mod:`motionstereo_cli.method.refine`.

Rows are processed once. Sums over windows are made down first, then across; at the border the last
pixel is repeated. They are of whole numbers, so that a row can be taken from a sum exactly.
Compilers vectorise loops over arrays that are arguments of a separate function.
"""

import cython
import numpy as np

NAN = cython.declare(cython.float, np.nan)
ZERO = cython.declare(cython.float, 0)
HALF = cython.declare(cython.float, 0.5)
ONE = cython.declare(cython.float, 1)

#: Whole numbers are parts of a px, and of a grey level: sums over a window stay below 2**31.
PER_PX = cython.declare(cython.float, 256)
PER_LEVEL = cython.declare(cython.float, 16)
BIAS = cython.declare(cython.float, 8192)  # more than any slope
NONE = cython.declare(cython.int, -(1 << 24))  # less than any disparity

#: A window reaches so many rows up and down, and 7 px to both sides.
DOWN = cython.declare(cython.int, 3)
PIXELS = cython.declare(cython.float, 7 * 15)
KEPT = cython.declare(cython.int, 8)  # rows: those of a window, and the one above it

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

    # Of the rows of a window: disparity, pixels, minus the least and the most; and products of
    # slope and difference of grey.
    known: cython.int[:, :, ::1]
    fields: cython.int[:, :, ::1]
    # Of a row, down, and likewise across.
    down: cython.int[:, ::1]
    field_down: cython.int[:, ::1]
    whole: cython.int[:, ::1]
    part: cython.int[:, ::1]  # sums of 2, 4 and 8 px
    start: cython.float[:, ::1]  # of the rows of a window: disparity to begin at, NaN = to be kept
    place: cython.float[::1]  # of a row in the left view
    slope: cython.float[:, ::1]  # of a row of the left and the right view

    def __init__(self, width: cython.Py_ssize_t):
        self.known = np.zeros((8, 4, width), np.int32)
        self.fields = np.zeros((8, 3, width), np.int32)
        self.down = np.zeros((4, width + 16), np.int32)
        self.field_down = np.zeros((3, width + 16), np.int32)
        self.whole = np.zeros((4, width), np.int32)
        self.part = np.zeros((3, width + 16), np.int32)
        self.start = np.zeros((8, width), np.float32)
        self.place = np.zeros(width, np.float32)
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
    new: cython.int
    y: cython.int
    i: cython.int
    last: cython.int = cython.cast(cython.int, disparity.shape[0]) - 1
    with cython.nogil:
        work.down[:, :] = 0
        work.field_down[:, :] = 0
        for new in range(last + 2 * DOWN + 1):
            if new <= last:
                tell(disparity[new], work.known[new % KEPT])
            y = new - DOWN  # the row of which the window is complete
            if y >= 0 and y <= last:
                surround(y, last, work)
                incline(left[y], work.slope[0])
                incline(right[y], work.slope[1])
                compare(disparity[y], right[y], left[y], limits, y % KEPT, work)
            y -= DOWN
            if y >= 0:
                for i in range(3):
                    go_down(work.fields, i, y, last, work.field_down[i])
                    combine(work.field_down[i], work.part, work.whole[i], SUM)
                move(disparity[y], work.start[y % KEPT], limits, work.whole, result[y])


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def tell(disparity: cython.const[cython.float][::1], known: cython.int[:, ::1]) -> cython.void:
    """Fill in disparity, 1, minus the disparity and the disparity of what is known of a row."""
    tell_row(disparity, known[0], known[1], known[2], known[3])


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def tell_row(
    disparity: cython.const[cython.float][::1],
    total: cython.int[::1],
    count: cython.int[::1],
    least: cython.int[::1],
    most: cython.int[::1],
) -> cython.void:
    """Do so, into separate rows."""
    x: cython.Py_ssize_t
    for x in range(disparity.shape[0]):
        d: cython.float = disparity[x]
        is_known: cython.bint = d == d  # noqa: PLR0124
        whole: cython.int = cython.cast(cython.int, (d if is_known else ZERO) * PER_PX + HALF)
        total[x] = whole
        count[x] = is_known
        least[x] = -whole if is_known else NONE
        most[x] = whole if is_known else NONE


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def go_down(
    rows: cython.const[cython.int][:, :, ::1],
    i: cython.int,
    y: cython.int,
    last: cython.int,
    total: cython.int[::1],
) -> cython.void:
    """Turn sums over the window of the row before into those of row ``y``."""
    j: cython.int
    if y == 0:
        for j in range(-DOWN, DOWN):
            add(rows[min(max(j, 0), last) % KEPT, i], total)
    else:
        take_away(rows[max(y - 1 - DOWN, 0) % KEPT, i], total)
    add(rows[min(y + DOWN, last) % KEPT, i], total)
    continue_border(total)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def surround(y: cython.int, last: cython.int, work: Workspace) -> cython.void:
    """Fill in sum, number, minus the least and the largest of the disparities around each pixel."""
    j: cython.int
    i: cython.int
    for i in range(2):
        go_down(work.known, i, y, last, work.down[i])
        combine(work.down[i], work.part, work.whole[i], SUM)
    for i in range(2, 4):
        work.down[i, :] = NONE
        for j in range(y - DOWN, y + DOWN + 1):
            raise_to(work.known[min(max(j, 0), last) % KEPT, i], work.down[i])
        continue_border(work.down[i])
        combine(work.down[i], work.part, work.whole[i], MOST)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def raise_to(row: cython.const[cython.int][::1], most: cython.int[::1]) -> cython.void:
    """Fill in the larger of both, from the eighth place on."""
    x: cython.Py_ssize_t
    for x in range(row.shape[0]):
        most[x + 7] = row[x] if row[x] > most[x + 7] else most[x + 7]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def add(row: cython.const[cython.int][::1], total: cython.int[::1]) -> cython.void:
    """Add a row to a sum, from the eighth place on."""
    x: cython.Py_ssize_t
    for x in range(row.shape[0]):
        total[x + 7] += row[x]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def take_away(row: cython.const[cython.int][::1], total: cython.int[::1]) -> cython.void:
    """Take a row from a sum, from the eighth place on."""
    x: cython.Py_ssize_t
    for x in range(row.shape[0]):
        total[x + 7] -= row[x]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def continue_border(row: cython.int[::1]) -> cython.void:
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
    row: cython.const[cython.int][::1],
    part: cython.int[:, ::1],
    result: cython.int[::1],
    how: cython.int,
) -> cython.void:
    """Fill in the sum or the largest of 15 pixels, by those of 2, 4 and 8."""
    x: cython.Py_ssize_t
    width: cython.Py_ssize_t = result.shape[0]
    two: cython.int[::1] = part[0]
    four: cython.int[::1] = part[1]
    eight: cython.int[::1] = part[2]
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
    begin(
        disparity,
        work.whole[0],
        work.whole[1],
        work.whole[2],
        work.whole[3],
        cython.cast(cython.int, limits.max_range * PER_PX),
        work.start[slot],
        work.place,
    )
    x: cython.Py_ssize_t
    last: cython.int = cython.cast(cython.int, disparity.shape[0]) - 1
    fields: cython.int[:, ::1] = work.fields[slot]
    fields[:, :] = 0
    for x in range(disparity.shape[0]):
        place: cython.float = work.place[x]
        if place < 0:
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
        level: cython.int = rounded(differs * PER_LEVEL)
        lean: cython.int = rounded(slope * PER_LEVEL)
        fields[0, x] = level * level
        fields[1, x] = lean * level
        fields[2, x] = lean * lean


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def begin(
    disparity: cython.const[cython.float][::1],
    total: cython.const[cython.int][::1],
    count: cython.const[cython.int][::1],
    least: cython.const[cython.int][::1],
    most: cython.const[cython.int][::1],
    max_range: cython.int,
    start: cython.float[::1],
    place: cython.float[::1],
) -> cython.void:
    """Fill in disparities to begin at, and where in the left view each pixel is, -1 = nowhere."""
    x: cython.int
    end: cython.float = cython.cast(cython.float, disparity.shape[0] - 1)
    for x in range(cython.cast(cython.int, disparity.shape[0])):
        here: cython.float = disparity[x]
        is_known: cython.bint = here == here  # noqa: PLR0124
        is_smooth: cython.bint = is_known & (most[x] + least[x] <= max_range)
        known: cython.int = count[x] if is_known else 1
        mean: cython.float = cython.cast(cython.float, total[x])
        mean = mean / (cython.cast(cython.float, known) * PER_PX)
        start[x] = mean if is_smooth else NAN
        there: cython.float = cython.cast(cython.float, x) + (mean if is_smooth else here)
        place[x] = there if there <= end else -ONE  # not of NaN


@cython.cfunc
@cython.nogil
@cython.inline
@cython.exceptval(check=False)
def rounded(value: cython.float) -> cython.int:
    """Return a whole number; casts cut off, below 0 as above."""
    return cython.cast(cython.int, value + BIAS + HALF) - cython.cast(cython.int, BIAS)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def move(
    disparity: cython.const[cython.float][::1],
    start: cython.const[cython.float][::1],
    limits: Limits,
    whole: cython.const[cython.int][:, ::1],
    result: cython.float[::1],
) -> cython.void:
    """Fill in a row of refined disparities."""
    move_row(
        disparity,
        start,
        limits.damping,
        limits.per_difference,
        limits.max_step,
        whole[0],
        whole[1],
        whole[2],
        result,
    )


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def move_row(
    disparity: cython.const[cython.float][::1],
    start: cython.const[cython.float][::1],
    damping: cython.float,
    per_difference: cython.float,
    max_step: cython.float,
    differences: cython.const[cython.int][::1],
    products: cython.const[cython.int][::1],
    slopes: cython.const[cython.int][::1],
    result: cython.float[::1],
) -> cython.void:
    """Do so, from the window's sums of squares and products."""
    x: cython.Py_ssize_t
    area: cython.float = PIXELS * PER_LEVEL * PER_LEVEL
    for x in range(disparity.shape[0]):
        here: cython.float = disparity[x]
        noise: cython.float = cython.cast(cython.float, differences[x]) / area
        product: cython.float = cython.cast(cython.float, products[x]) / area
        slope: cython.float = cython.cast(cython.float, slopes[x]) / area
        moved: cython.float = start[x] - product / (slope + (damping + per_difference * noise))
        moved = moved if moved < here + max_step else here + max_step
        moved = moved if moved > here - max_step else here - max_step
        moved = moved if moved > ZERO else ZERO
        result[x] = moved if start[x] == start[x] else here
