"""The difference of the views: the loops of :mod:`motionstereo_cli.stages.residual`."""

import cython
import numpy as np
from cython.cimports.libc.math import isnan

NAN = cython.declare(cython.float, np.nan)
ZERO = cython.declare(cython.float, 0)
ONE = cython.declare(cython.float, 1)
HALF = cython.declare(cython.float, 0.5)
LEVELS = cython.declare(cython.float, 256)
PER_GREY_LEVEL = cython.declare(cython.int, 16)  # steps in which the median is told
MOST = cython.declare(cython.float, 64)  # larger differences say no more


@cython.cclass
class Workspace:
    """What a frame needs besides input and output, used again for the next one.

    Args:
        height, width: size of the images in px.
    """

    difference: cython.float[:, ::1]
    histogram: cython.int[::1]
    total: cython.float[::1]  # of three rows, with a border of nothing
    count: cython.float[::1]

    def __init__(self, height: cython.Py_ssize_t, width: cython.Py_ssize_t):
        self.difference = np.empty((height, width), np.float32)
        self.histogram = np.empty(2 * 256 * 16, np.int32)
        self.total = np.empty(width + 2, np.float32)
        self.count = np.empty(width + 2, np.float32)


def residual(
    disparity: cython.const[cython.float][:, ::1],
    right: cython.const[cython.uchar][:, ::1],
    left: cython.const[cython.uchar][:, ::1],
    work: Workspace,
    result: cython.float[:, ::1],
) -> None:
    """Fill in the residual: see :func:`motionstereo_cli.stages.residual.residual`."""
    x: cython.int
    y: cython.int
    row: cython.int
    height: cython.int = cython.cast(cython.int, disparity.shape[0])
    width: cython.int = cython.cast(cython.int, disparity.shape[1])
    with cython.nogil:
        median: cython.float = differences(disparity, right, left, work)
        for y in range(height):
            work.total[:] = 0
            work.count[:] = 0
            for row in range(max(y - 1, 0), min(y + 2, height)):
                for x in range(width):
                    here: cython.float = abs(work.difference[row, x] - median)
                    here = MOST if here > MOST else here
                    known: cython.bint = not isnan(here)
                    work.total[x + 1] += here if known else ZERO
                    work.count[x + 1] += ONE if known else ZERO
            for x in range(width):
                total: cython.float = work.total[x] + work.total[x + 1] + work.total[x + 2]
                count: cython.float = work.count[x] + work.count[x + 1] + work.count[x + 2]
                known = not isnan(work.difference[y, x])
                result[y, x] = total / max(count, ONE) if known else NAN


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
    work.histogram[:] = 0
    for y in range(cython.cast(cython.int, disparity.shape[0])):
        for x in range(width):
            if isnan(disparity[y, x]):
                work.difference[y, x] = NAN
                continue
            place: cython.float = cython.cast(cython.float, x) + disparity[y, x]
            column: cython.int = min(cython.cast(cython.int, place), width - 1)
            near: cython.float = cython.cast(cython.float, left[y, column])
            far: cython.float = cython.cast(cython.float, left[y, min(column + 1, width - 1)])
            part: cython.float = place - cython.cast(cython.float, column)
            here: cython.float = cython.cast(cython.float, right[y, x]) - (
                near + (far - near) * part
            )
            work.difference[y, x] = here
            step = cython.cast(cython.int, (here + LEVELS) * PER_GREY_LEVEL + HALF)
            work.histogram[step] += 1
            known += 1
    # The two in the middle, which are one if the number is odd.
    lower: cython.int = -1
    upper: cython.int = -1
    below: cython.int = 0
    for step in range(cython.cast(cython.int, work.histogram.shape[0])):
        below += work.histogram[step]
        if lower < 0 and 2 * below >= known:
            lower = step
        if 2 * below > known:
            upper = step
            break
    middle: cython.double = cython.cast(cython.double, lower + upper) / (2 * PER_GREY_LEVEL)
    return cython.cast(cython.float, middle - 256)
