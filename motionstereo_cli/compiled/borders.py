"""Where objects end: the loops of :mod:`motionstereo_cli.method.borders`."""

import cython
import numpy as np
from cython.cimports.libc.math import isnan

NAN = cython.declare(cython.float, np.nan)
ALMOST = cython.declare(cython.float, 0.999)  # of a leap: sums are rounded
PER_PX = cython.declare(cython.int, 16)  # sixteenths of a px, and of a grey level


@cython.cclass
@cython.dataclasses.dataclass(eq=False)
class Scene:
    """Two views, and what was found in them; all are (height, width).

    Attributes:
        disparity: px, NaN = unknown.
        right, left: grey.
    """

    disparity: cython.const[cython.float][:, ::1]
    right: cython.const[cython.uchar][:, ::1]
    left: cython.const[cython.uchar][:, ::1]


@cython.cclass
@cython.dataclasses.dataclass
class Limits:
    """See the constants of :mod:`motionstereo_cli.method.borders`."""

    leap: cython.float
    reach: cython.int
    hidden: cython.int
    per_grey_level: cython.int
    max_grey: cython.int
    min_gain: cython.int


def trim(
    scene: Scene, limits: Limits, borders: cython.uchar[::1], result: cython.float[:, ::1]
) -> None:
    """Trim objects: see :func:`motionstereo_cli.method.borders.trimmed`.

    Args:
        scene, limits: see there.
        borders: room for a row.
        result: gets the disparity.
    """
    x: cython.Py_ssize_t
    y: cython.int
    column: cython.int
    disparity: cython.const[cython.float][:, ::1] = scene.disparity
    leap: cython.float = limits.leap
    with cython.nogil:
        result[:, :] = disparity
        for y in range(cython.cast(cython.int, disparity.shape[0])):
            find_borders(disparity[y], disparity[max(y - 1, 0)], leap, borders)
            for x in range(disparity.shape[1]):
                if not borders[x]:
                    continue
                column = cython.cast(cython.int, x)
                here: cython.float = disparity[y, x]
                if x > 0:
                    before: cython.float = disparity[y, x - 1]
                    if before > here + leap or (isnan(here) and not isnan(before)):
                        go_in(scene, limits, y, column - 1, 0, -1, NAN, result)
                    elif here > before + leap:
                        go_in(scene, limits, y, column, 0, 1, before, result)
                if y > 0:
                    above: cython.float = disparity[y - 1, x]
                    if above > here + leap:
                        go_in(scene, limits, y - 1, column, -1, 0, here, result)
                    elif here > above + leap:
                        go_in(scene, limits, y, column, 1, 0, above, result)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def find_borders(
    disparity: cython.const[cython.float][::1],
    above: cython.const[cython.float][::1],
    leap: cython.float,
    borders: cython.uchar[::1],
) -> cython.void:
    """Fill in where a row leaps from the pixel before or above, or ends.

    Compilers vectorise loops over arrays that are arguments of a separate function.
    """
    x: cython.Py_ssize_t
    borders[0] = abs(disparity[0] - above[0]) > leap * ALMOST
    for x in range(1, disparity.shape[0]):
        here: cython.float = disparity[x]
        before: cython.float = disparity[x - 1]
        borders[x] = (
            (abs(here - before) > leap * ALMOST)
            | (abs(here - above[x]) > leap * ALMOST)
            | ((here != here) & (before == before))  # noqa: PLR0124
        )


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def go_in(
    scene: Scene,
    limits: Limits,
    y: cython.int,
    x: cython.int,
    down: cython.int,
    across: cython.int,
    farther: cython.float,
    result: cython.float[:, ::1],
) -> cython.void:
    """Go from the border of an object inward, and find the best position of the border.

    The pixels on the way get the disparity that lies behind, NaN = hidden from the left camera.
    """
    step: cython.int
    height: cython.int = cython.cast(cython.int, scene.right.shape[0])
    width: cython.int = cython.cast(cython.int, scene.right.shape[1])
    total: cython.int = 0
    least: cython.int = -limits.min_gain
    found: cython.int = 0
    first: cython.float = scene.disparity[y, x]
    for step in range(limits.reach):
        row: cython.int = y + step * down
        column: cython.int = x + step * across
        if not (0 <= row < height and 0 <= column < width):
            break
        near: cython.float = scene.disparity[row, column]
        if isnan(near) or abs(near - first) > limits.leap:
            break
        behind: cython.int = limits.hidden
        if not isnan(farther):
            behind = difference(scene, limits, row, column, down != 0, farther)
        total += behind - difference(scene, limits, row, column, down != 0, near)
        after: cython.int = min(max(row + down, 0), height - 1)
        beside: cython.int = min(max(column + across, 0), width - 1)
        edge: cython.int = abs(
            cython.cast(cython.int, scene.right[row, column])
            - cython.cast(cython.int, scene.right[after, beside])
        )
        if total - limits.per_grey_level * edge < least:
            least = total - limits.per_grey_level * edge
            found = step + 1
    for step in range(found):
        result[y + step * down, x + step * across] = farther


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def difference(
    scene: Scene,
    limits: Limits,
    y: cython.int,
    x: cython.int,
    beside: cython.bint,
    disparity: cython.float,
) -> cython.int:
    """Return how much the views differ at a disparity: a pixel and its two neighbours.

    Neighbours beside it, or else above and below, but never across a border.
    """
    k: cython.int
    height: cython.int = cython.cast(cython.int, scene.right.shape[0])
    width: cython.int = cython.cast(cython.int, scene.right.shape[1])
    # Beyond a border the view is continued by its last pixel.
    disparity = disparity if disparity > 0 else 0
    disparity = disparity if disparity < width else width
    whole: cython.int = cython.cast(cython.int, disparity)
    share: cython.int = cython.cast(cython.int, (disparity - whole) * PER_PX)
    total: cython.int = 0
    for k in range(-1, 2):
        row: cython.int = y if beside else min(max(y + k, 0), height - 1)
        column: cython.int = min(max(x + k, 0), width - 1) if beside else x
        partner: cython.int = min(column + whole, width - 1)
        near: cython.int = cython.cast(cython.int, scene.left[row, partner])
        after: cython.int = cython.cast(cython.int, scene.left[row, min(partner + 1, width - 1)])
        left: cython.int = near * (PER_PX - share) + after * share
        right: cython.int = cython.cast(cython.int, scene.right[row, column])
        total += min(abs(right * PER_PX - left), limits.max_grey)
    return total // 3


def fill_hidden(
    disparity: cython.const[cython.float][:, ::1],
    where: cython.const[cython.uchar][:, ::1],
    leap: cython.float,
    more: cython.int,
    behind: cython.int,
    max_leap: cython.float,
    result: cython.float[:, ::1],
) -> None:
    """Fill what is hidden: see :func:`motionstereo_cli.method.borders.hidden_filled`."""
    x: cython.int
    y: cython.int
    column: cython.int
    width: cython.int = cython.cast(cython.int, disparity.shape[1])
    with cython.nogil:
        for y in range(cython.cast(cython.int, disparity.shape[0])):
            last: cython.int = -1
            for x in range(width):
                here: cython.float = disparity[y, x]
                result[y, x] = here
                if isnan(here):
                    continue
                gap: cython.int = x - last - 1
                if last >= 0 and gap > 0:
                    change: cython.float = disparity[y, last] - here
                    if change > leap and gap <= change + more:
                        far: cython.float = here
                        for column in range(x, min(x + behind, width)):
                            if far - max_leap < disparity[y, column] < far:
                                far = disparity[y, column]
                        for column in range(last + 1, x):
                            if where[y, column]:
                                result[y, column] = far
                last = x
