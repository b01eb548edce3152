"""Slopes of grey: the loop of :mod:`motionstereo_cli.method.dense`."""

import cython
import numpy as np


@cython.cclass
class Workspace:
    """What a view needs besides input and output, used again for the next one.

    Args:
        width: of the view in px.
    """

    column: cython.short[::1]  # weighted sums of three rows

    def __init__(self, width: cython.Py_ssize_t):
        self.column = np.empty(width, np.int16)


def fill_slopes(
    grey: cython.const[cython.uchar][:, ::1],
    largest: cython.int,
    work: Workspace,
    result: cython.schar[:, ::1],
) -> None:
    """Fill in half of Sobel's filter, rounded down; the image is mirrored at the border.

    Args:
        grey: (height, width).
        largest: larger ones become this, before they are halved.
        work: workspace for this width.
        result: (height, width).
    """
    y: cython.Py_ssize_t
    last: cython.Py_ssize_t = grey.shape[0] - 1
    with cython.nogil:
        for y in range(last + 1):
            above: cython.Py_ssize_t = y - 1 if y > 0 else min(last, 1)
            below: cython.Py_ssize_t = y + 1 if y < last else max(last - 1, 0)
            add_down(grey[above], grey[y], grey[below], work.column)
            incline(work.column, largest, result[y])


# Compilers vectorise loops over arrays that are arguments of a separate function.


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def add_down(
    above: cython.const[cython.uchar][::1],
    here: cython.const[cython.uchar][::1],
    below: cython.const[cython.uchar][::1],
    column: cython.short[::1],
) -> cython.void:
    """Fill in weighted sums of three rows."""
    x: cython.Py_ssize_t
    for x in range(column.shape[0]):
        column[x] = cython.cast(
            cython.short,
            cython.cast(cython.int, above[x])
            + 2 * cython.cast(cython.int, here[x])
            + cython.cast(cython.int, below[x]),
        )


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def incline(
    column: cython.const[cython.short][::1], largest: cython.int, result: cython.schar[::1]
) -> cython.void:
    """Fill in a row of slopes."""
    x: cython.Py_ssize_t
    last: cython.Py_ssize_t = result.shape[0] - 1
    result[0] = 0
    result[last] = 0
    for x in range(1, last):
        step: cython.int = cython.cast(cython.int, column[x + 1]) - column[x - 1]
        step = largest if step > largest else step
        step = -largest if step < -largest else step
        result[x] = cython.cast(cython.schar, step >> 1)
