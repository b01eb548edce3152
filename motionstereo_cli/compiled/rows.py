"""Half the rows, and back: the loops of :mod:`motionstereo_cli.method.rows`."""

import cython
import numpy as np

NAN = cython.declare(cython.float, np.nan)
HALF = cython.declare(cython.float, 0.5)


def halve(view: cython.const[cython.uchar][:, ::1], result: cython.uchar[:, ::1]) -> None:
    """Fill in means of two rows each, a half rounded to even; the last row may stand alone."""
    y: cython.Py_ssize_t
    with cython.nogil:
        for y in range(result.shape[0]):
            mean(view[2 * y], view[min(2 * y + 1, view.shape[0] - 1)], result[y])


def halve_exactly(view: cython.const[cython.uchar][:, ::1], result: cython.float[:, ::1]) -> None:
    """Fill in the same, not rounded."""
    y: cython.Py_ssize_t
    with cython.nogil:
        for y in range(result.shape[0]):
            exact_mean(view[2 * y], view[min(2 * y + 1, view.shape[0] - 1)], result[y])


# Compilers vectorise loops over arrays that are arguments of a separate function.


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def mean(
    upper: cython.const[cython.uchar][::1],
    lower: cython.const[cython.uchar][::1],
    result: cython.uchar[::1],
) -> cython.void:
    """Fill in the mean of two rows."""
    x: cython.Py_ssize_t
    for x in range(result.shape[0]):
        both: cython.int = cython.cast(cython.int, upper[x]) + cython.cast(cython.int, lower[x])
        result[x] = (both >> 1) + (both & (both >> 1) & 1)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def exact_mean(
    upper: cython.const[cython.uchar][::1],
    lower: cython.const[cython.uchar][::1],
    result: cython.float[::1],
) -> cython.void:
    """Fill in the mean of two rows, not rounded."""
    x: cython.Py_ssize_t
    for x in range(result.shape[0]):
        both: cython.int = cython.cast(cython.int, upper[x]) + cython.cast(cython.int, lower[x])
        result[x] = cython.cast(cython.float, both) * HALF


def whole(
    disparity: cython.const[cython.float][:, ::1],
    half_grey: cython.const[cython.float][:, ::1],
    grey: cython.const[cython.uchar][:, ::1],
    tolerance_px: cython.float,
    nearer: cython.float,
    result: cython.float[:, ::1],
) -> None:
    """Fill in the disparity of each row from the two half rows nearest to it.

    Args:
        disparity: px, (rows, width), NaN = unknown.
        half_grey: grey of the same rows.
        grey: of all rows, (height, width).
        tolerance_px: half rows that differ by less are mixed.
        nearer: where they differ by more, a pixel takes the other half row's disparity if that is
            nearer to it in grey by so many levels.
        result: (height, width).
    """
    y: cython.int
    x: cython.int
    rows: cython.int = cython.cast(cython.int, disparity.shape[0])
    with cython.nogil:
        for y in range(cython.cast(cython.int, result.shape[0])):
            own: cython.int = y // 2
            other: cython.int = min(max(own + (1 if y % 2 else -1), 0), rows - 1)
            for x in range(cython.cast(cython.int, result.shape[1])):
                here: cython.float = disparity[own, x]
                there: cython.float = disparity[other, x]
                level: cython.float = grey[y, x]
                if abs(here - there) < tolerance_px:
                    here = 0.75 * here + 0.25 * there
                elif abs(level - half_grey[other, x]) + nearer < abs(level - half_grey[own, x]):
                    here = there
                result[y, x] = here


@cython.cclass
class Workspace:
    """What :func:`drop_fringes` needs besides input and output, used again for the next frame.

    Args:
        width: of the image in px.
    """

    majority: cython.schar[:, ::1]  # of five rows: -1 where a disparity can be, 1 where it is
    down: cython.schar[::1]  # added up down; both have two more columns on each side

    def __init__(self, width: cython.Py_ssize_t):
        self.majority = np.zeros((5, width + 4), np.int8)
        self.down = np.zeros(width + 4, np.int8)


def drop_fringes(
    disparity: cython.const[cython.float][:, ::1],
    where: cython.const[cython.uchar][:, ::1],
    work: Workspace,
    result: cython.float[:, ::1],
) -> None:
    """Keep disparities where at least half of the pixels around that can have one do.

    Args:
        disparity: px, (height, width), NaN = unknown.
        where: pixels that can have one, (height, width), 0 or 1.
        work: workspace for this width.
        result: gets the disparities that stay, NaN elsewhere.
    """
    y: cython.Py_ssize_t
    height: cython.Py_ssize_t = disparity.shape[0]
    with cython.nogil:
        work.majority[:, :] = 0
        for y in range(height + 2):
            if y < height:
                count_known(disparity[y], where[y], work.majority[y % 5])
            else:
                work.majority[y % 5, :] = 0
            if y >= 2:
                add_five(work.majority, work.down)
                keep(disparity[y - 2], where[y - 2], work.down, result[y - 2])


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def count_known(
    disparity: cython.const[cython.float][::1],
    where: cython.const[cython.uchar][::1],
    majority: cython.schar[::1],
) -> cython.void:
    """Fill in what a row contributes."""
    x: cython.Py_ssize_t
    for x in range(disparity.shape[0]):
        d: cython.float = disparity[x]
        known: cython.int = 2 if d == d else 0  # noqa: PLR0124
        majority[x + 2] = cython.cast(cython.schar, known * where[x] - where[x])


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def add_five(majority: cython.const[cython.schar][:, ::1], down: cython.schar[::1]) -> cython.void:
    """Fill in sums of five rows."""
    x: cython.Py_ssize_t
    for x in range(down.shape[0]):
        down[x] = cython.cast(
            cython.schar,
            majority[0, x] + majority[1, x] + majority[2, x] + majority[3, x] + majority[4, x],
        )


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def keep(
    disparity: cython.const[cython.float][::1],
    where: cython.const[cython.uchar][::1],
    down: cython.const[cython.schar][::1],
    result: cython.float[::1],
) -> cython.void:
    """Fill in a row of what stays."""
    x: cython.Py_ssize_t
    for x in range(disparity.shape[0]):
        total: cython.int = down[x] + down[x + 1] + down[x + 2] + down[x + 3] + down[x + 4]
        stays: cython.bint = (total >= 0) & (where[x] != 0)
        result[x] = disparity[x] if stays else NAN
