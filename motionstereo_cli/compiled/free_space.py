"""Quantiles of nearness: the loops of :mod:`motionstereo_cli.robot.free_space`."""

import cython
import numpy as np

NAN = cython.declare(cython.float, np.nan)
INFINITE = cython.declare(cython.float, np.inf)
BUCKETS = cython.declare(cython.int, 2048)  # one more for the unknown
LAST = cython.declare(cython.float, 2047)
UNKNOWN = cython.declare(cython.float, 2048)
PER_PX = cython.declare(cython.float, 16)  # buckets in a px
ZERO = cython.declare(cython.float, 0)


@cython.cclass
class Workspace:
    """What a frame needs besides input and output, used again for the next one.

    Args:
        strips: number of strips.
        height, width: size of the images in px.
    """

    strips: cython.int
    # Of each strip and, at the end, of the whole image:
    counts: cython.int[:, ::1]  # of the known values by bucket
    odd: cython.int[:, ::1]  # those of the odd columns of strips, apart: it is faster
    wanted: cython.int[::1]  # the bucket with the quantile; -1 = too few known
    number: cython.int[::1]  # which value of that bucket it is, in order
    part: cython.float[::1]  # and how far it lies toward the next one, 0..1
    after: cython.int[::1]  # the bucket with the next value
    size: cython.int[::1]  # how many values are in these buckets
    values: cython.float[:, ::1]  # these values
    bucket: cython.ushort[:, ::1]  # of each pixel

    def __init__(self, strips, height, width):
        self.strips = strips
        self.counts = np.empty((strips + 1, 2049), np.int32)
        self.odd = np.empty((strips, 2049), np.int32)
        self.wanted = np.empty(strips + 1, np.int32)
        self.number = np.empty(strips + 1, np.int32)
        self.part = np.empty(strips + 1, np.float32)
        self.after = np.empty(strips + 1, np.int32)
        self.size = np.empty(strips + 1, np.int32)
        self.values = np.empty((strips + 1, height * width), np.float32)
        self.bucket = np.empty((height, width), np.uint16)


@cython.locals(x=cython.int, strip=cython.int, value=cython.float, after=cython.float)
def quantiles(
    nearness: cython.const[cython.float][:, ::1],
    begin: cython.const[cython.int][::1],
    share: cython.double,
    whole_share: cython.double,
    min_share: cython.double,
    work: Workspace,
    result: cython.float[::1],
) -> None:
    """Fill in the quantiles of the known values, NaN where too few are known.

    Exact: the values of the bucket that holds it are sorted out at last.

    Args:
        nearness: (height, width) float32, NaN = unknown.
        begin: first column of each strip and, at the end, the width.
        share, whole_share: which quantile of the strips and of the whole image, 0..1; between
            two values it is interpolated linearly.
        min_share: share of a strip or of the image that has to be known.
        work: workspace for this size.
        result: quantile of each strip and of the whole image, (strips + 1,) float32.
    """
    with cython.nogil:
        count(nearness, begin, work)
        for strip in range(work.strips):
            width: cython.int = begin[strip + 1] - begin[strip]
            choose(strip, share, min_share * (width * nearness.shape[0]), work)
        choose(work.strips, whole_share, min_share * (nearness.shape[1] * nearness.shape[0]), work)
        gather(nearness, begin, work)
        for strip in range(work.strips + 1):
            if work.wanted[strip] < 0:
                result[strip] = NAN
                continue
            value = select(work.values[strip], work.size[strip], work.number[strip])
            after = INFINITE
            for x in range(work.number[strip] + 1, work.size[strip]):
                after = work.values[strip, x] if work.values[strip, x] < after else after
            part: cython.float = work.part[strip]
            result[strip] = value + (after - value) * part if part > 0 else value


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def bucket_of(value: cython.float) -> cython.int:
    """Return the bucket of a value; it never falls as the value grows."""
    place: cython.float = value * PER_PX
    place = place if place > ZERO else ZERO
    place = place if place < LAST else LAST
    return cython.cast(cython.int, place if value == value else UNKNOWN)  # noqa: PLR0124


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(x=cython.Py_ssize_t, y=cython.Py_ssize_t, strip=cython.int)
def count(
    nearness: cython.const[cython.float][:, ::1],
    begin: cython.const[cython.int][::1],
    work: Workspace,
) -> cython.void:
    """Count the known values by bucket."""
    bucket: cython.int
    work.counts[:, :] = 0
    work.odd[:, :] = 0
    for y in range(nearness.shape[0]):
        for x in range(nearness.shape[1]):
            work.bucket[y, x] = bucket_of(nearness[y, x])
        for strip in range(work.strips):
            for x in range(begin[strip], begin[strip + 1] - 1, 2):
                work.counts[strip, work.bucket[y, x]] += 1
                work.odd[strip, work.bucket[y, x + 1]] += 1
            if (begin[strip + 1] - begin[strip]) & 1:
                work.counts[strip, work.bucket[y, begin[strip + 1] - 1]] += 1
    for strip in range(work.strips):
        for bucket in range(BUCKETS):
            work.counts[strip, bucket] += work.odd[strip, bucket]
            work.counts[work.strips, bucket] += work.counts[strip, bucket]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def choose(
    strip: cython.int, share: cython.double, too_few: cython.double, work: Workspace
) -> cython.void:
    """Find the bucket of a strip's quantile; ``too_few`` known values are too few."""
    known: cython.int = 0
    bucket: cython.int
    for bucket in range(BUCKETS):
        known += work.counts[strip, bucket]
    work.size[strip] = 0
    work.wanted[strip] = work.after[strip] = -1
    if known <= too_few:
        return
    place: cython.double = (known - 1) * share
    number: cython.int = cython.cast(cython.int, place)
    work.part[strip] = cython.cast(cython.float, place - number)
    below: cython.int = 0
    bucket = 0
    while work.counts[strip, bucket] <= number:
        number -= work.counts[strip, bucket]
        below += work.counts[strip, bucket]
        bucket += 1
    work.wanted[strip] = work.after[strip] = bucket
    if number == work.counts[strip, bucket] - 1 and below + number < known - 1:
        bucket += 1
        while work.counts[strip, bucket] == 0:
            bucket += 1
        work.after[strip] = bucket
    work.number[strip] = number


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(x=cython.Py_ssize_t, y=cython.Py_ssize_t, strip=cython.int)
def gather(
    nearness: cython.const[cython.float][:, ::1],
    begin: cython.const[cython.int][::1],
    work: Workspace,
) -> cython.void:
    """Copy the values of the wanted buckets."""
    whole: cython.int = work.strips
    for y in range(nearness.shape[0]):
        for strip in range(work.strips):
            for x in range(begin[strip], begin[strip + 1]):
                bucket: cython.int = work.bucket[y, x]
                if (bucket == work.wanted[strip]) | (bucket == work.after[strip]):
                    work.values[strip, work.size[strip]] = nearness[y, x]
                    work.size[strip] += 1
                if (bucket == work.wanted[whole]) | (bucket == work.after[whole]):
                    work.values[whole, work.size[whole]] = nearness[y, x]
                    work.size[whole] += 1


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
