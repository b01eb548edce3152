"""Speckles and gaps: the loops of :mod:`motionstereo_cli.method.cleaning`."""

import cython
import numpy as np
from cython.cimports.libc.math import isnan

NAN = cython.declare(cython.float, np.nan)
ZERO = cython.declare(cython.float, 0)
PER_PX = cython.declare(cython.int, 16)  # sixteenths of a px, in which neighbours are compared
NOTHING = cython.declare(cython.int, -16)


@cython.cclass
class Workspace:
    """Reusable buffers for the speckles of a frame.

    Args:
        height, width: size of the images in px.
    """

    sixteenths: cython.int[:, ::1]  # disparities of two rows in sixteenths of a px
    run: cython.int[:, ::1]  # which run each pixel of two rows belongs to
    place: cython.int[:, ::1]  # row, first column and the one after the last of each run
    parent: cython.int[::1]  # of each run, its parent in its patch, itself if it is the root
    size: cython.int[::1]  # of each root, the pixels of its patch

    def __init__(self, height: cython.Py_ssize_t, width: cython.Py_ssize_t):
        runs = height * width  # at most; unused pages take no memory
        self.sixteenths = np.empty((2, width), np.int32)
        self.run = np.empty((2, width), np.int32)
        self.place = np.empty((runs, 3), np.int32)
        self.parent = np.empty(runs, np.int32)
        self.size = np.empty(runs, np.int32)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def root_of(run: cython.int, work: Workspace) -> cython.int:
    """Return the root of a run's patch, and halve the path to it."""
    while work.parent[run] != run:
        work.parent[run] = work.parent[work.parent[run]]
        run = work.parent[run]
    return run


def without_speckles(
    disparity: cython.const[cython.float][:, ::1],
    where: cython.const[cython.uchar][:, ::1],
    speckle_px: cython.int,
    work: Workspace,
    result: cython.float[:, ::1],
) -> None:
    """Keep patches of more than ``speckle_px`` pixels.

    Neighbours above, below and beside are of one patch where they differ by at most 1 px. Such
    pixels of a row form a run; runs of neighbouring rows are joined (union-find).

    Args:
        disparity: px, (height, width) float32, NaN = unknown.
        where: pixels that count, (height, width), 0 or 1.
        speckle_px: size of the largest patch that is removed.
        work: workspace for this size.
        result: receives the remaining disparities; NaN elsewhere.
    """
    x: cython.int
    y: cython.int
    k: cython.int
    a: cython.int
    b: cython.int
    step: cython.int
    value: cython.int
    runs: cython.int = 0
    width: cython.int = cython.cast(cython.int, disparity.shape[1])
    sixteenths: cython.int[:, ::1] = work.sixteenths
    place: cython.int[:, ::1] = work.place
    run: cython.int[:, ::1] = work.run
    with cython.nogil:
        for y in range(cython.cast(cython.int, disparity.shape[0])):
            here: cython.int = y & 1
            above: cython.int = 1 - here
            result[y, :] = NAN
            for x in range(width):
                known: cython.bint = (where[y, x] != 0) & (disparity[y, x] >= 0)  # not NaN
                step = cython.cast(cython.int, (disparity[y, x] if known else ZERO) * PER_PX)
                sixteenths[here, x] = step if known else NOTHING
            before: cython.int = NOTHING
            joined: cython.int = -1  # the last run above that the present one was joined with
            for x in range(width):
                value = sixteenths[here, x]
                if value < 0:
                    before = NOTHING
                    continue
                if before < 0 or abs(value - before) > PER_PX:
                    place[runs, 0] = y
                    place[runs, 1] = x
                    work.parent[runs] = runs
                    work.size[runs] = 0
                    joined = -1
                    runs += 1
                place[runs - 1, 2] = x + 1
                run[here, x] = runs - 1
                before = value
                if y > 0:
                    step = sixteenths[above, x]
                    if step >= 0 and abs(value - step) <= PER_PX and run[above, x] != joined:
                        joined = run[above, x]
                        a = root_of(runs - 1, work)
                        b = root_of(joined, work)
                        if a != b:
                            work.parent[max(a, b)] = min(a, b)
        for k in range(runs):
            work.size[root_of(k, work)] += place[k, 2] - place[k, 1]
        for k in range(runs):
            if work.size[root_of(k, work)] > speckle_px:
                y = place[k, 0]
                for x in range(place[k, 1], place[k, 2]):
                    result[y, x] = disparity[y, x]


def fill(
    disparity: cython.const[cython.float][:, ::1],
    where: cython.const[cython.uchar][:, ::1],
    gap_px: cython.int,
    result: cython.float[:, ::1],
) -> None:
    """Fill gaps in rows: see :func:`motionstereo_cli.method.cleaning.filled`."""
    x: cython.int
    y: cython.int
    column: cython.int
    with cython.nogil:
        for y in range(cython.cast(cython.int, disparity.shape[0])):
            before: cython.int = -gap_px - 2  # the last pixel known; none in reach before the row
            for x in range(cython.cast(cython.int, disparity.shape[1])):
                here: cython.float = disparity[y, x]
                result[y, x] = here
                if isnan(here):
                    continue
                length: cython.int = x - before
                if 1 < length <= gap_px + 1:
                    near: cython.float = disparity[y, before]
                    step: cython.float = here - near
                    if abs(step) <= 2:
                        for column in range(before + 1, x):
                            if where[y, column]:
                                share: cython.double = (
                                    cython.cast(cython.double, column - before) / length
                                )
                                result[y, column] = near + step * share
                before = x
