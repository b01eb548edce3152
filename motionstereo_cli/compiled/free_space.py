"""Quantiles of nearness, and what is nearest in each bearing.

The loops of :mod:`motionstereo_cli.robot.free_space`, and of the profile of
:mod:`motionstereo_cli.robot.local_map`.
"""

import cython
import numpy as np
from cython.cimports.libc.math import ceil, fabs

NAN = cython.declare(cython.float, np.nan)
UNKNOWN = cython.declare(cython.int, 255)  # the bucket of what is unknown
ZERO = cython.declare(cython.float, 0)
ONE = cython.declare(cython.float, 1)
NO_BUCKET = cython.declare(cython.float, 255)


def bucket(
    nearness: cython.const[cython.float][:, ::1],
    bucket_px: cython.float,
    last: cython.float,
    buckets: cython.uchar[:, ::1],
) -> None:
    """Fill in the bucket of each value, from 0 to ``last``, which is open; unknown ones have 255.

    Args:
        nearness: (height, width) float32, NaN = unknown.
        bucket_px: width of a bucket.
        last: the last bucket, below 255.
        buckets: (height, width) uint8.
    """
    y: cython.Py_ssize_t
    with cython.nogil:
        for y in range(nearness.shape[0]):
            bucket_row(nearness[y], bucket_px, last, buckets[y])


# Compilers vectorise loops over arrays that are arguments of a separate function.


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def bucket_row(
    nearness: cython.const[cython.float][::1],
    bucket_px: cython.float,
    last: cython.float,
    buckets: cython.uchar[::1],
) -> cython.void:
    """Fill in the buckets of a row."""
    x: cython.Py_ssize_t
    for x in range(buckets.shape[0]):
        value: cython.float = nearness[x]
        place: cython.float = value / bucket_px
        place = place if place > ZERO else ZERO
        place = place if place < last else last
        place = place if value == value else NO_BUCKET  # noqa: PLR0124
        buckets[x] = cython.cast(cython.int, place)


def count(
    buckets: cython.const[cython.uchar][:, ::1],
    top: cython.const[cython.int][::1],
    begin: cython.const[cython.int][::1],
    four: cython.int[:, ::1],
    counts: cython.int[:, :, ::1],
) -> None:
    """Fill in how many pixels of each block of an image are in each bucket.

    Args:
        buckets: (height, width) uint8.
        top: first row of the blocks and, at the end, the height.
        begin: first column of the blocks and, at the end, the width.
        four: buffer, (4, 256) int32.
        counts: (blocks down, blocks across, 256) int32.
    """
    i: cython.Py_ssize_t
    j: cython.Py_ssize_t
    k: cython.Py_ssize_t
    x: cython.Py_ssize_t
    y: cython.Py_ssize_t
    with cython.nogil:
        for i in range(counts.shape[0]):
            for j in range(counts.shape[1]):
                four[:, :] = 0
                for y in range(top[i], top[i + 1]):
                    for x in range(begin[j], begin[j + 1]):
                        # Neighbours are often in one bucket: no count waits for the one before.
                        four[x & 3, buckets[y, x]] += 1
                for k in range(256):
                    counts[i, j, k] = (four[0, k] + four[1, k]) + (four[2, k] + four[3, k])


def quantiles(
    values: cython.const[cython.float][:, ::1],
    buckets: cython.const[cython.uchar][:, ::1],
    begin: cython.const[cython.int][::1],
    counts: cython.const[cython.int][:, ::1],
    share: cython.double,
    min_share: cython.double,
    found: cython.float[::1],
    result: cython.float[::1],
) -> None:
    """Fill in the quantile of the known values in each strip, NaN where too few are known.

    Exact: finally the values of its bucket are sorted.

    Args:
        values: (height, width) float32.
        buckets: bucket of each, (height, width) uint8; monotonic in the values, 255 = unknown.
        begin: first column of each strip and, at the end, the width.
        counts: pixels of each strip by bucket, (strips, 256) int32.
        share: which quantile, 0..1; between two values it is interpolated linearly.
        min_share: share of a strip that has to be known.
        found: buffer, one larger than there are values.
        result: quantile of each strip, (strips,) float32.
    """
    strip: cython.Py_ssize_t
    with cython.nogil:
        for strip in range(result.shape[0]):
            result[strip] = quantile(
                values,
                buckets,
                begin,
                counts,
                strip,
                strip + 1,
                counts[strip],
                share,
                min_share,
                found,
            )


def quantile_of_all(
    values: cython.const[cython.float][:, ::1],
    buckets: cython.const[cython.uchar][:, ::1],
    begin: cython.const[cython.int][::1],
    counts: cython.const[cython.int][:, ::1],
    totals: cython.const[cython.int][::1],
    share: cython.double,
    min_share: cython.double,
    found: cython.float[::1],
) -> cython.double:
    """Return the quantile of all known values, see :func:`quantiles`.

    Args:
        values, buckets, begin, counts, share, min_share, found: see there.
        totals: pixels of the image by bucket, (256,) int32.
    """
    result: cython.float
    with cython.nogil:
        result = quantile(
            values,
            buckets,
            begin,
            counts,
            0,
            counts.shape[0],
            totals,
            share,
            min_share,
            found,
        )
    return result


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(k=cython.int, bucket=cython.int, value=cython.float, strip=cython.Py_ssize_t)
def quantile(
    values: cython.const[cython.float][:, ::1],
    buckets: cython.const[cython.uchar][:, ::1],
    begin: cython.const[cython.int][::1],
    counts: cython.const[cython.int][:, ::1],
    first: cython.Py_ssize_t,
    end: cython.Py_ssize_t,
    totals: cython.const[cython.int][::1],
    share: cython.double,
    min_share: cython.double,
    found: cython.float[::1],
) -> cython.float:
    """Return the quantile of strips ``first`` to ``end``, whose ``totals`` are given."""
    known: cython.int = 0
    for k in range(255):
        known += totals[k]
    if known <= min_share * ((begin[end] - begin[first]) * values.shape[0]):
        return NAN
    place: cython.double = (known - 1) * share
    number: cython.int = cython.cast(cython.int, place)
    part: cython.float = cython.cast(cython.float, place - number)
    bucket = 0
    while totals[bucket] <= number:
        number -= totals[bucket]
        bucket += 1
    following: cython.int = bucket  # the bucket of the next value, if there is one
    if number == totals[bucket] - 1:
        following += 1
        while following < UNKNOWN and totals[following] == 0:
            following += 1
        following = following if following < UNKNOWN else bucket
    size: cython.int = 0
    for strip in range(first, end):
        wanted: cython.int = size + counts[strip, bucket]
        wanted += counts[strip, following] if following != bucket else 0
        size = gather(
            values, buckets, begin[strip], begin[strip + 1], bucket, following, wanted, size, found
        )
    value = select(found, size, number)
    if number + 1 == size:
        return value
    after: cython.float = found[number + 1]
    for k in range(number + 2, size):
        after = found[k] if found[k] < after else after
    return value + (after - value) * part if part > 0 else value


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(x=cython.Py_ssize_t, y=cython.Py_ssize_t)
def gather(
    values: cython.const[cython.float][:, ::1],
    buckets: cython.const[cython.uchar][:, ::1],
    begin: cython.Py_ssize_t,
    end: cython.Py_ssize_t,
    bucket: cython.int,
    following: cython.int,
    wanted: cython.int,
    size: cython.int,
    found: cython.float[::1],
) -> cython.int:
    """Append the values of two buckets in some columns until there are as many as wanted."""
    y = 0
    while size < wanted:
        for x in range(begin, end):
            found[size] = values[y, x]
            # Without a branch, which could not be predicted.
            size += (buckets[y, x] == bucket) | (buckets[y, x] == following)
        y += 1
    return size


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
    limit_px: cython.double,
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
        limit_px: rows in which a line is nearer do not count.
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
                    if least_px < line < limit_px:
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
    buckets: cython.const[cython.uchar][:, ::1],
    slope: cython.float,
    horizon: cython.float,
    error_px: cython.float,
    ground_share: cython.float,
    ground_up: cython.float,
    overhead_up: cython.float,
    standing: cython.uchar[:, ::1],
    lying: cython.uchar[:, ::1],
) -> None:
    """Fill in the buckets of what stands on a level ground, and of the ground, 255 elsewhere.

    Args:
        nearness: (height, width) float32, NaN = unknown.
        buckets: the bucket of each, (height, width) uint8.
        slope, horizon: the ground's nearness is ``slope * (row - horizon)`` px.
        error_px: of nearness; it counts as at least so much.
        ground_share: error of the ground's own height, in camera heights as all heights are.
        ground_up, overhead_up: what stands is in part between these heights.
        standing, lying: (height, width) uint8.
    """
    y: cython.Py_ssize_t
    with cython.nogil:
        for y in range(nearness.shape[0]):
            split_row(
                nearness[y],
                buckets[y],
                slope * (cython.cast(cython.float, y) - horizon),
                error_px,
                ground_share,
                ground_up,
                overhead_up,
                standing[y],
                lying[y],
            )


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def split_row(
    nearness: cython.const[cython.float][::1],
    buckets: cython.const[cython.uchar][::1],
    at_horizon: cython.float,
    error_px: cython.float,
    ground_share: cython.float,
    ground_up: cython.float,
    overhead_up: cython.float,
    standing: cython.uchar[::1],
    lying: cython.uchar[::1],
) -> cython.void:
    """Fill in a row, in which the ground has the nearness ``at_horizon``."""
    x: cython.Py_ssize_t
    for x in range(standing.shape[0]):
        near: cython.float = nearness[x]
        near = near if near > error_px else error_px  # also where it is unknown
        # Height over the ground: it is 1 at the camera's own, that of the horizon.
        up: cython.float = ONE - at_horizon / near
        error: cython.float = error_px / near
        stands: cython.bint = (up > ground_up + error) & (up < overhead_up)
        lies: cython.bint = abs(up) < ground_share + error
        standing[x] = buckets[x] if stands else UNKNOWN
        lying[x] = buckets[x] if lies else UNKNOWN


@cython.cclass
@cython.dataclasses.dataclass
class Things:
    """What counts as an obstacle, and as its upper side.

    Attributes:
        cy_px: row of the principal point.
        up_per_row: height in m times nearness in px, of a row.
        focal_baseline: depth in m times nearness in px.
        below_m, above_m: heights that are in the way, about the camera's.
        nearer_share, least: as many points, a share and a number, are as near as the nearest.
        one_share, one_px: what lies within the larger of these of it is of one thing.
        higher_share: share of its points that are above its top.
        low_m, high_m: tops between these are seen from above.
        level_m: the upper side is within this height of the top.
        cell_m, gap_m: it is looked for in steps, and ends at a wider gap.
    """

    cy_px: cython.double
    up_per_row: cython.double
    focal_baseline: cython.float
    below_m: cython.double
    above_m: cython.double
    nearer_share: cython.double
    least: cython.int
    one_share: cython.float
    one_px: cython.float
    higher_share: cython.double
    low_m: cython.float
    high_m: cython.float
    level_m: cython.double
    cell_m: cython.double
    gap_m: cython.double


@cython.cclass
class Workspace:
    """The points in each bearing.

    Args:
        bearings: their number.
        points: the most in one of them.
        cells: steps in which upper sides are looked for.
    """

    count: cython.int[::1]
    near: cython.float[:, ::1]
    up: cython.double[:, ::1]
    ranked: cython.float[::1]
    filled: cython.uchar[::1]

    def __init__(self, bearings, points, cells):
        self.count = np.zeros(bearings, np.int32)
        self.near = np.zeros((bearings, points), np.float32)
        self.up = np.zeros((bearings, points))
        self.ranked = np.zeros(points, np.float32)
        self.filled = np.zeros(cells, np.uint8)


def profile(
    nearness: cython.const[cython.float][:, :],
    fresh: cython.const[cython.uchar][:, :],
    things: Things,
    work: Workspace,
    near: cython.float[::1],
    top: cython.float[::1],
    far: cython.float[::1],
) -> None:
    """Fill in the nearest thing in each bearing.

    Args:
        nearness: disparity + doffs, (height, width), NaN = unknown.
        fresh: pixels that show the present, (height, width), 0 or 1.
        things: what counts.
        work: for so many bearings.
        near: nearness of the nearest thing, (bearings,) px, NaN = unknown.
        top: height of its top above the camera, (bearings,) m.
        far: how far ahead its upper side ends, (bearings,) m; 0 where none is seen.
    """
    b: cython.Py_ssize_t
    with cython.nogil:
        take_points(nearness, fresh, things, work)
        for b in range(near.shape[0]):
            one_bearing(b, things, work, near, top, far)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def take_points(
    nearness: cython.const[cython.float][:, :],
    fresh: cython.const[cython.uchar][:, :],
    things: Things,
    work: Workspace,
) -> cython.void:
    """Take the points of obstacles, by bearing."""
    x: cython.Py_ssize_t
    y: cython.Py_ssize_t
    width: cython.Py_ssize_t = nearness.shape[1]
    bearings: cython.Py_ssize_t = work.count.shape[0]
    work.count[:] = 0
    for y in range(nearness.shape[0]):
        up_px: cython.double = (things.cy_px - y) * things.up_per_row
        for x in range(width):
            near: cython.float = nearness[y, x]
            if not (fresh[y, x] and near > 0):
                continue
            up: cython.double = up_px / near
            if -things.below_m < up < things.above_m:
                b: cython.Py_ssize_t = x * bearings // width
                work.near[b, work.count[b]] = near
                work.up[b, work.count[b]] = up
                work.count[b] += 1


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def one_bearing(
    b: cython.Py_ssize_t,
    things: Things,
    work: Workspace,
    near: cython.float[::1],
    top: cython.float[::1],
    far: cython.float[::1],
) -> cython.void:
    """Fill in what is in a bearing."""
    n: cython.int
    kept: cython.int = 0
    count: cython.int = work.count[b]
    near[b] = NAN
    top[b] = NAN
    far[b] = 0
    for n in range(count):
        work.ranked[n] = work.near[b, n]
    near[b] = high(work.ranked, count, things.nearer_share, things.least)
    margin: cython.float = things.one_share * near[b]
    margin = margin if margin > things.one_px else things.one_px
    for n in range(count):
        if work.near[b, n] >= near[b] - margin:
            work.ranked[kept] = cython.cast(cython.float, work.up[b, n])
            kept += 1
    top[b] = high(work.ranked, kept, things.higher_share, 1)
    if not things.low_m < top[b] < things.high_m:
        return
    cells: cython.int = cython.cast(cython.int, work.filled.shape[0])
    cell_m: cython.float = cython.cast(cython.float, things.cell_m)
    work.filled[:] = 0
    for n in range(count):
        if fabs(work.up[b, n] - top[b]) < things.level_m:
            place: cython.float = things.focal_baseline / work.near[b, n] / cell_m
            if place < cells:
                work.filled[cython.cast(cython.int, place)] = 1
    front: cython.float = things.focal_baseline / near[b] / cell_m
    last: cython.int = cells - 1 if front > cells - 1 else cython.cast(cython.int, front)
    first: cython.int = last
    for n in range(first + 1, cells):
        if work.filled[n]:
            last = n
        if (n - last) * things.cell_m > things.gap_m:
            break
    far[b] = cell_m * cython.cast(cython.float, last + 1)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def high(
    values: cython.float[::1], count: cython.int, share: cython.double, least: cython.int
) -> cython.float:
    """Return the value that a share of the first values, but at least so many, are as high as.

    NaN if there are too few. The values are reordered.
    """
    rank: cython.int = max(cython.cast(cython.int, ceil(share * count)), least)
    return select(values, count, count - rank) if rank <= count else NAN
