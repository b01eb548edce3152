"""Quantiles and counts of nearness: the loops of :mod:`motionstereo_cli.robot.free_space`."""

import cython
import numpy as np

NAN = cython.declare(cython.float, np.nan)
BUCKETS = cython.declare(cython.int, 256)  # one more for the unknown
LAST = cython.declare(cython.float, 255)
UNKNOWN = cython.declare(cython.float, 256)
PER_PX = cython.declare(cython.float, 2)  # buckets in a px
ZERO = cython.declare(cython.float, 0)
ONE = cython.declare(cython.float, 1)


@cython.cclass
class Workspace:
    """Reusable buffers for a frame.

    Args:
        height, width: size of the images in px.
    """

    counts: cython.int[::1]  # of the known values of a strip by bucket
    values: cython.float[::1]  # these values
    bucket: cython.ushort[::1]  # and their buckets

    def __init__(self, height, width):
        self.counts = np.empty(257, np.int32)
        self.values = np.empty(height * width + 1, np.float32)
        self.bucket = np.empty(height * width + 1, np.uint16)


@cython.locals(strip=cython.int)
def quantiles(
    nearness: cython.const[cython.float][:, ::1],
    begin: cython.const[cython.int][::1],
    share: cython.double,
    min_share: cython.double,
    work: Workspace,
    result: cython.float[::1],
) -> None:
    """Fill in the quantile of the known values in each strip, NaN where too few are known.

    Exact: finally the values of its bucket are sorted.

    Args:
        nearness: (height, width) float32, NaN = unknown.
        begin: first column of each strip and, at the end, the width.
        share: which quantile, 0..1; between two values it is interpolated linearly.
        min_share: share of a strip that has to be known.
        work: workspace for this size.
        result: quantile of each strip, (strips,) float32.
    """
    with cython.nogil:
        for strip in range(cython.cast(cython.int, result.shape[0])):
            known: cython.int = gather(nearness, begin[strip], begin[strip + 1], work)
            width: cython.int = begin[strip + 1] - begin[strip]
            result[strip] = NAN
            if known > min_share * (width * nearness.shape[0]):
                result[strip] = quantile(known, share, work)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(x=cython.Py_ssize_t, y=cython.Py_ssize_t)
def gather(
    nearness: cython.const[cython.float][:, ::1],
    begin: cython.Py_ssize_t,
    end: cython.Py_ssize_t,
    work: Workspace,
) -> cython.int:
    """Copy the known values of some columns, count them by bucket, and return their number."""
    known: cython.int = 0
    work.counts[:] = 0
    for y in range(nearness.shape[0]):
        for x in range(begin, end):
            value: cython.float = nearness[y, x]
            # Buckets are monotonic in the values.
            place: cython.float = value * PER_PX
            place = place if place > ZERO else ZERO
            place = place if place < LAST else LAST
            place = place if value == value else UNKNOWN  # noqa: PLR0124
            bucket: cython.int = cython.cast(cython.int, place)
            work.values[known] = value
            work.bucket[known] = bucket
            work.counts[bucket] += 1
            known += bucket < BUCKETS  # without a branch, which could not be predicted
    return known


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(k=cython.int, bucket=cython.int, value=cython.float)
def quantile(known: cython.int, share: cython.double, work: Workspace) -> cython.float:
    """Return the quantile of the values gathered; their order is lost."""
    place: cython.double = (known - 1) * share
    number: cython.int = cython.cast(cython.int, place)
    part: cython.float = cython.cast(cython.float, place - number)
    bucket = 0
    while work.counts[bucket] <= number:
        number -= work.counts[bucket]
        bucket += 1
    following: cython.int = bucket  # the bucket of the next value, if there is one
    if number == work.counts[bucket] - 1:
        following += 1
        while following < BUCKETS and work.counts[following] == 0:
            following += 1
    size: cython.int = 0
    for k in range(known):
        work.values[size] = work.values[k]
        size += (work.bucket[k] == bucket) | (work.bucket[k] == following)
    value = select(work.values, size, number)
    if number + 1 == size:
        return value
    after: cython.float = work.values[number + 1]
    for k in range(number + 2, size):
        after = work.values[k] if work.values[k] < after else after
    return value + (after - value) * part if part > 0 else value


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(i=cython.int, j=cython.int, left=cython.int, right=cython.int)
def select(values: cython.float[::1], count: cython.int, k: cython.int) -> cython.float:
    """Return the value that sorting would put at place ``k``, with none smaller after it.

    Hoare's selection; ``values`` are reordered.
    """
    left = 0
    right = count - 1
    while left < right:
        pivot: cython.float = values[(left + right) // 2]
        i = left
        j = right
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                swap: cython.float = values[i]
                values[i] = values[j]
                values[j] = swap
                i += 1
                j -= 1
        if k <= j:
            right = j
        elif k >= i:
            left = i
        else:
            break
    return values[k]


def count_in_rows(
    nearness: cython.const[cython.float][:, ::1],
    bin_px: cython.float,
    counts: cython.int[:, ::1],
) -> None:
    """Count the known values in each of some groups of rows by bins, the last of which is open.

    Args:
        nearness: (height, width) float32, NaN = unknown.
        bin_px: width of a bin.
        counts: (groups of rows, bins) int32, 0 at first.
    """
    x: cython.Py_ssize_t
    y: cython.Py_ssize_t
    last: cython.float = cython.cast(cython.float, counts.shape[1] - 1)
    with cython.nogil:
        for y in range(nearness.shape[0]):
            group: cython.Py_ssize_t = y * counts.shape[0] // nearness.shape[0]
            for x in range(nearness.shape[1]):
                place: cython.float = nearness[y, x] / bin_px
                if place == place:  # noqa: PLR0124
                    place = place if place > ZERO else ZERO
                    place = place if place < last else last
                    counts[group, cython.cast(cython.int, place)] += 1


def fit_lines(
    farther: cython.const[cython.double][:, ::1],
    bin_px: cython.double,
    rows: cython.const[cython.double][::1],
    horizons: cython.const[cython.double][::1],
    bottom_px: cython.const[cython.double][::1],
    low: cython.double,
    high: cython.double,
    error_px: cython.double,
    below_cost: cython.double,
    fits: cython.double[:, ::1],
) -> None:
    """Fill in the share of an image on each line from row to nearness, minus what is below.

    Args:
        farther: share of what is known in each group of rows that lies before each bin, (rows,
            bins + 1).
        bin_px: width of a bin.
        rows: place of the rows in the image, 0 top .. 1 bottom.
        horizons: where each line is 0 px, in the same way.
        bottom_px: what each line comes to at the bottom.
        low, high, error_px: what lies between these shares of a line, or so far off, is on it.
        below_cost: what is below counts so many times.
        fits: (horizons, bottoms).
    """
    i: cython.Py_ssize_t
    j: cython.Py_ssize_t
    row: cython.Py_ssize_t
    least_px: cython.double = bin_px if bin_px > 1 else 1.0
    with cython.nogil:
        for i in range(horizons.shape[0]):
            for j in range(bottom_px.shape[0]):
                total: cython.double = 0
                for row in range(rows.shape[0]):
                    line: cython.double = bottom_px[j] * (rows[row] - horizons[i])
                    line = line / (1 - horizons[i])
                    if line > least_px:
                        below: cython.double = share_before(
                            (line * low - error_px) / bin_px, farther, row
                        )
                        on: cython.double = share_before(
                            (line * high + error_px) / bin_px, farther, row
                        )
                        total += (on - below) - below_cost * below
                fits[i, j] = total / rows.shape[0]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def share_before(
    place: cython.double, farther: cython.const[cython.double][:, ::1], row: cython.Py_ssize_t
) -> cython.double:
    """Return the share that lies before a place in bins, between two of them in proportion."""
    last: cython.double = cython.cast(cython.double, farther.shape[1] - 1) - 1e-6
    place = place if place > 0 else 0.0
    place = place if place < last else last
    index: cython.int = cython.cast(cython.int, place)
    before: cython.double = farther[row, index]
    return before + (place - index) * (farther[row, index + 1] - before)


def split(
    nearness: cython.const[cython.float][:, ::1],
    slope: cython.float,
    horizon: cython.float,
    error_px: cython.float,
    ground_share: cython.float,
    ground_up: cython.float,
    overhead_up: cython.float,
    standing: cython.float[:, ::1],
    lying: cython.float[:, ::1],
) -> None:
    """Fill in the nearness of what stands on a level ground, and of the ground, NaN elsewhere.

    Args:
        nearness: (height, width) float32, NaN = unknown.
        slope, horizon: the ground's nearness is ``slope * (row - horizon)`` px.
        error_px: of nearness; it counts as at least so much.
        ground_share: error of the ground's own height, in camera heights as all heights are.
        ground_up, overhead_up: what stands is in part between these heights.
        standing, lying: (height, width) float32.
    """
    x: cython.Py_ssize_t
    y: cython.Py_ssize_t
    with cython.nogil:
        for y in range(nearness.shape[0]):
            at_horizon: cython.float = slope * (cython.cast(cython.float, y) - horizon)
            for x in range(nearness.shape[1]):
                value: cython.float = nearness[y, x]
                near: cython.float = value if value > error_px else error_px  # also where unknown
                # Height over the ground: it is 1 at the camera's own, that of the horizon.
                up: cython.float = ONE - at_horizon / near
                error: cython.float = error_px / near
                stands: cython.bint = (up > ground_up + error) & (up < overhead_up)
                standing[y, x] = value if stands else NAN
                lying[y, x] = value if abs(up) < ground_share + error else NAN
