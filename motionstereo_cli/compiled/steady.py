"""The average of disparities in time: the loops of :mod:`motionstereo_cli.method.steady`."""

import cython

ZERO = cython.declare(cython.float, 0)


def add(
    disparity: cython.const[cython.float][:, ::1],
    grey: cython.const[cython.uchar][:, ::1],
    age: cython.const[cython.uchar][:, ::1],
    earlier: cython.const[cython.float][:, ::1],
    earlier_grey: cython.const[cython.uchar][:, ::1],
    frames: cython.int,
    max_grey: cython.int,
    tolerance_px: cython.float,
    total: cython.float[:, ::1],
    count: cython.uchar[:, ::1],
) -> None:
    """Add an earlier result where it agrees on the same surface, and count it.

    Args:
        disparity, grey, age: of now, (height, width).
        earlier, earlier_grey: of ``frames`` frames ago.
        frames: how long ago.
        max_grey: largest change of grey in levels.
        tolerance_px: largest change of disparity.
        total, count: of disparities so far.
    """
    y: cython.Py_ssize_t
    with cython.nogil:
        for y in range(disparity.shape[0]):
            add_row(
                disparity[y],
                grey[y],
                age[y],
                earlier[y],
                earlier_grey[y],
                frames,
                max_grey,
                tolerance_px,
                total[y],
                count[y],
            )


def divide(count: cython.const[cython.uchar][:, ::1], total: cython.float[:, ::1]) -> None:
    """Turn sums into means."""
    y: cython.Py_ssize_t
    with cython.nogil:
        for y in range(total.shape[0]):
            divide_row(count[y], total[y])


# Compilers vectorise loops over arrays that are arguments of a separate function.


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def add_row(
    disparity: cython.const[cython.float][::1],
    grey: cython.const[cython.uchar][::1],
    age: cython.const[cython.uchar][::1],
    earlier: cython.const[cython.float][::1],
    earlier_grey: cython.const[cython.uchar][::1],
    frames: cython.int,
    max_grey: cython.int,
    tolerance_px: cython.float,
    total: cython.float[::1],
    count: cython.uchar[::1],
) -> cython.void:
    """Add a row."""
    x: cython.Py_ssize_t
    for x in range(total.shape[0]):
        step: cython.int = cython.cast(cython.int, grey[x]) - cython.cast(
            cython.int, earlier_grey[x]
        )
        counts: cython.bint = (
            (abs(earlier[x] - disparity[x]) <= tolerance_px)
            & (age[x] >= frames)
            & (step <= max_grey)
            & (step >= -max_grey)
        )
        total[x] += earlier[x] if counts else ZERO
        count[x] += counts


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def divide_row(count: cython.const[cython.uchar][::1], total: cython.float[::1]) -> cython.void:
    """Turn a row of sums into means."""
    x: cython.Py_ssize_t
    for x in range(total.shape[0]):
        total[x] /= count[x]
