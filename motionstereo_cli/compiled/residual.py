"""The difference of the views: the loops of :mod:`motionstereo_cli.method.residual`."""

import cython
import numpy as np
from cython.cimports.libc.math import isnan

NAN = cython.declare(cython.float, np.nan)
ZERO = cython.declare(cython.float, 0)
ONE = cython.declare(cython.float, 1)
HALF = cython.declare(cython.float, 0.5)
LEVELS = cython.declare(cython.float, 256)
PER_GREY_LEVEL = cython.declare(cython.int, 16)  # steps of the median
MOST = cython.declare(cython.float, 64)  # limit of differences


@cython.cclass
class Workspace:
    """Reusable buffers for a frame.

    Args:
        height, width: size of the images in px.
    """

    difference: cython.float[:, ::1]
    histogram: cython.int[::1]
    off: cython.float[:, ::1]  # of three rows: how far off the median, 0 = unknown
    known: cython.float[:, ::1]  # of three rows: 1 = known
    total: cython.float[::1]  # their sums, with a border of nothing
    count: cython.float[::1]

    def __init__(self, height: cython.Py_ssize_t, width: cython.Py_ssize_t):
        self.difference = np.empty((height, width), np.float32)
        self.histogram = np.empty(2 * 256 * 16, np.int32)
        self.off = np.empty((3, width), np.float32)
        self.known = np.empty((3, width), np.float32)
        self.total = np.zeros(width + 2, np.float32)
        self.count = np.zeros(width + 2, np.float32)


def residual(
    disparity: cython.const[cython.float][:, ::1],
    right: cython.const[cython.uchar][:, ::1],
    left: cython.const[cython.uchar][:, ::1],
    work: Workspace,
    result: cython.float[:, ::1],
) -> None:
    """Fill in the residual: see :func:`motionstereo_cli.method.residual.residual`."""
    y: cython.int
    height: cython.int = cython.cast(cython.int, disparity.shape[0])
    with cython.nogil:
        median: cython.float = differences(disparity, right, left, work)
        work.off[:, :] = 0
        work.known[:, :] = 0
        measure(0, median, work)
        for y in range(height):
            if y + 1 < height:
                measure(y + 1, median, work)
            else:
                work.off[(y + 1) % 3, :] = 0
                work.known[(y + 1) % 3, :] = 0
            average(y, work, result)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def measure(y: cython.int, median: cython.float, work: Workspace) -> cython.void:
    """Note how far off the median a row is."""
    x: cython.Py_ssize_t
    difference: cython.float[::1] = work.difference[y]
    off: cython.float[::1] = work.off[y % 3]
    known: cython.float[::1] = work.known[y % 3]
    for x in range(difference.shape[0]):
        here: cython.float = abs(difference[x] - median)
        here = MOST if here > MOST else here
        off[x] = here if here >= ZERO else ZERO  # not where it is NaN
        known[x] = ONE if here >= ZERO else ZERO


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(x=cython.Py_ssize_t, sum=cython.float, number=cython.float)
def average(y: cython.int, work: Workspace, result: cython.float[:, ::1]) -> cython.void:
    """Fill in a row of the residual: means of three rows and three columns."""
    total: cython.float[::1] = work.total
    count: cython.float[::1] = work.count
    above: cython.float[::1] = work.off[(y + 2) % 3]
    here: cython.float[::1] = work.off[y % 3]
    below: cython.float[::1] = work.off[(y + 1) % 3]
    for x in range(result.shape[1]):
        total[x + 1] = above[x] + here[x] + below[x]
    above = work.known[(y + 2) % 3]
    here = work.known[y % 3]
    below = work.known[(y + 1) % 3]
    for x in range(result.shape[1]):
        count[x + 1] = above[x] + here[x] + below[x]
    for x in range(result.shape[1]):
        sum = total[x] + total[x + 1] + total[x + 2]
        number = count[x] + count[x + 1] + count[x + 2]
        number = number if number > ONE else ONE
        result[y, x] = sum / number if here[x] > ZERO else NAN


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def differences(
    disparity: cython.const[cython.float][:, ::1],
    right: cython.const[cython.uchar][:, ::1],
    left: cython.const[cython.uchar][:, ::1],
    work: Workspace,
) -> cython.float:
    """Note the difference of each pair of pixels, right less left, and return the median."""
    x: cython.int
    y: cython.int
    step: cython.int
    known: cython.int = 0
    width: cython.int = cython.cast(cython.int, disparity.shape[1])
    last: cython.float = cython.cast(cython.float, width - 1)
    difference: cython.float[:, ::1] = work.difference
    histogram: cython.int[::1] = work.histogram
    histogram[:] = 0
    for y in range(cython.cast(cython.int, disparity.shape[0])):
        for x in range(width):
            if isnan(disparity[y, x]):
                difference[y, x] = NAN
                continue
            # Beyond a border the view is continued by its last pixel.
            place: cython.float = min(max(x + disparity[y, x], ZERO), last)
            column: cython.int = cython.cast(cython.int, place)
            near: cython.float = cython.cast(cython.float, left[y, column])
            far: cython.float = cython.cast(cython.float, left[y, min(column + 1, width - 1)])
            part: cython.float = place - cython.cast(cython.float, column)
            here: cython.float = cython.cast(cython.float, right[y, x]) - (
                near + (far - near) * part
            )
            difference[y, x] = here
            step = cython.cast(cython.int, (here + LEVELS) * PER_GREY_LEVEL + HALF)
            histogram[step] += 1
            known += 1
    # The two in the middle, which are one if the number is odd.
    lower: cython.int = -1
    upper: cython.int = -1
    below: cython.int = 0
    for step in range(cython.cast(cython.int, histogram.shape[0])):
        below += histogram[step]
        if lower < 0 and 2 * below >= known:
            lower = step
        if 2 * below > known:
            upper = step
            break
    middle: cython.double = cython.cast(cython.double, lower + upper) / (2 * PER_GREY_LEVEL)
    return cython.cast(cython.float, middle - 256)
