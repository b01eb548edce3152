"""A bilateral filter in whole numbers: the loops of :func:`motionstereo_cli.method.dense.smoothed`.

Results are the same on every machine. All numbers fit 16 bits, so that compilers vectorise the
innermost loops; they do so only for arrays that are arguments of a separate function.
"""

import cython
import numpy as np

#: A pixel that differs by so many grey levels weighs nothing; 59 more than its square.
FAR = cython.declare(cython.short, 29)
LIMIT = cython.declare(cython.short, 900)

#: The weight of a pixel of the same grey, and in 256th of it that of pixels at a distance of 1,
#: sqrt(2) and 2 px: a Gaussian of 1.5 px.
MOST = cython.declare(cython.short, 150)
BESIDE = cython.declare(cython.ushort, 205)
DIAGONAL = cython.declare(cython.ushort, 164)
SECOND = cython.declare(cython.ushort, 105)

#: Makes a number positive, so that it is rounded down as in OpenCV.
SHIFT = cython.declare(cython.float, 256)
WHOLE = cython.declare(cython.int, 256)


@cython.cclass
class Workspace:
    """Reusable buffers of the filter.

    Args:
        width: of the images in px.
    """

    rows: cython.short[:, ::1]  # five rows of grey, continued beyond the border by two pixels
    total: cython.short[::1]  # of each pixel of a row: weighted differences
    weight: cython.short[::1]  # and the sum of the weights

    def __init__(self, width: cython.Py_ssize_t):
        self.rows = np.zeros((5, width + 4), np.int16)
        self.total = np.zeros(width, np.int16)
        self.weight = np.zeros(width, np.int16)


def smooth(
    view: cython.const[cython.uchar][:, ::1], work: Workspace, result: cython.uchar[:, ::1]
) -> None:
    """Fill in the view with less noise and sharp edges, (height, width) uint8.

    A pixel becomes the mean of the 13 pixels at most 2 px away. One that differs by d grey levels
    weighs (1 - d^2 / 900)^4, about a Gaussian of 10 levels, times a Gaussian of its distance.
    """
    last: cython.int
    height: cython.int = cython.cast(cython.int, view.shape[0])
    total: cython.short[::1] = work.total
    weight: cython.short[::1] = work.weight
    with cython.nogil:
        for last in range(-2, height + 2):
            take(view[mirrored(last, height)], work.rows[(last + 5) % 5])
            y: cython.int = last - 2
            if y < 0:
                continue
            total[:] = 0
            weight[:] = MOST
            add(work.rows, y, total, weight)
            mean(work.rows[y % 5], total, weight, result[y])


@cython.cfunc
@cython.nogil
@cython.inline
@cython.exceptval(check=False)
def mirrored(place: cython.int, size: cython.int) -> cython.int:
    """Return an index within a size; beyond the border the image is mirrored."""
    place = abs(place)
    place = place if place < size else 2 * size - 2 - place
    return max(place, 0)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def take(view: cython.const[cython.uchar][::1], row: cython.short[::1]) -> cython.void:
    """Fill in a row and its continuation beyond the borders."""
    x: cython.int
    width: cython.int = cython.cast(cython.int, view.shape[0])
    for x in range(width):
        row[x + 2] = view[x]
    for x in range(1, 3):
        row[2 - x] = view[mirrored(-x, width) if x < width else 0]
        row[width + 1 + x] = view[mirrored(width - 1 + x, width)]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def add(
    rows: cython.const[cython.short][:, ::1],
    y: cython.int,
    total: cython.short[::1],
    weight: cython.short[::1],
) -> cython.void:
    """Add the weights of each pixel's neighbours, and their weighted differences."""
    x: cython.Py_ssize_t
    down: cython.int
    across: cython.int
    here: cython.int = y % 5
    width: cython.Py_ssize_t = total.shape[0]
    far_off: cython.short = FAR
    limit: cython.short = LIMIT
    for down in range(-2, 3):
        row: cython.int = (y + down + 5) % 5
        for across in range(-2, 3):
            far: cython.int = down * down + across * across
            if far == 0 or far > 4:
                continue
            share: cython.ushort = BESIDE if far == 1 else DIAGONAL if far == 2 else SECOND
            start: cython.Py_ssize_t = 2 + across
            for x in range(width):
                brighter: cython.short = rows[row, start + x] - rows[here, 2 + x]
                away: cython.short = -brighter if brighter < 0 else brighter
                away = away if away < far_off else far_off
                alike: cython.ushort = cython.cast(cython.ushort, limit - away * away) >> 3
                alike = cython.cast(cython.ushort, alike * alike) >> 6
                alike = cython.cast(cython.ushort, alike * alike) >> 8
                alike = cython.cast(cython.ushort, alike * share) >> 8
                weighs: cython.short = cython.cast(cython.short, alike)
                total[x] = total[x] + weighs * brighter
                weight[x] = weight[x] + weighs


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def mean(
    here: cython.const[cython.short][::1],
    total: cython.const[cython.short][::1],
    weight: cython.const[cython.short][::1],
    result: cython.uchar[::1],
) -> cython.void:
    """Fill in a row of means."""
    x: cython.Py_ssize_t
    for x in range(result.shape[0]):
        brighter: cython.float = cython.cast(cython.float, total[x]) / cython.cast(
            cython.float, weight[x]
        )
        rounded: cython.int = cython.cast(cython.int, brighter + SHIFT) - WHOLE
        result[x] = cython.cast(cython.uchar, here[x + 2] + rounded)
