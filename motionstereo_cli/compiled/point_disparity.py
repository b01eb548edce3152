"""Disparity of single points: loops of :mod:`motionstereo_cli.robot.alignment` and movers."""

import cython
import numpy as np
from cython.cimports.libc.math import fabs, floor, sqrt

NAN = cython.declare(cython.float, np.nan)


def measure(
    right: cython.const[cython.float][:, ::1],
    left: cython.const[cython.float][:, ::1],
    places: cython.const[cython.int][:, ::1],
    range_px: cython.int,
    noise: cython.float,
    ratio: cython.float,
    work: cython.float[:, ::1],
    found: cython.float[:, ::1],
) -> None:
    """Fill in disparity and its standard deviation, (n, 2), of points of the right view.

    Searched along the row, as far as ``range_px``, by the squared difference of grey in 9 x 5 px
    less its mean; kept if the second best is ``ratio`` times as bad and the search back agrees;
    refined by Gauss-Newton in 7 x 7 px. NaN where it is uncertain.

    Args:
        right, left: the views.
        places: (n, 2) int32 column and row.
        range_px: largest disparity.
        noise: standard deviation of grey.
        ratio: see above.
        work: (2, range_px + 1), used again and again.
        found: receives the result.
    """
    i: cython.Py_ssize_t
    with cython.nogil:
        for i in range(places.shape[0]):
            x: cython.int = places[i, 0]
            y: cython.int = places[i, 1]
            found[i, 0] = cython.cast(cython.float, NAN)
            found[i, 1] = cython.cast(cython.float, NAN)
            d: cython.int = best(right, left, x, y, 1, range_px, noise, ratio, work)
            if d < 0:
                continue
            back: cython.int = best(left, right, x + d, y, -1, range_px, noise, 1, work)
            if back >= 0 and abs(back - d) <= 1:
                refine(right, left, x, y, d, noise, found, i)


def peaks(
    grey: cython.const[cython.float][:, ::1],
    border_px: cython.int,
    min_slope: cython.float,
    slope: cython.float[:, ::1],
    places: cython.int[:, ::1],
) -> cython.int:
    """Take the pixels whose slope is above all others around them; return how many there are.

    A slope is the size of that along the row and half that along the column (Sobel).

    Args:
        grey: the image.
        border_px: pixels nearer to the border are none.
        min_slope: least slope in grey levels a px.
        slope: for the slopes, of the image's size.
        places: (n, 2) receives columns and rows, as many as fit.
    """
    x: cython.int
    y: cython.int
    count: cython.int = 0
    height: cython.int = cython.cast(cython.int, grey.shape[0])
    width: cython.int = cython.cast(cython.int, grey.shape[1])
    with cython.nogil:
        for y in range(max(border_px, 2) - 1, min(height - border_px, height - 2) + 1):
            slopes_of_row(grey[y - 1], grey[y], grey[y + 1], slope[y])
        for y in range(max(border_px, 2), min(height - border_px, height - 2)):
            for x in range(max(border_px, 2), min(width - border_px, width - 2)):
                here: cython.float = slope[y, x]
                if not here > min_slope or here < slope[y, x - 1] or here < slope[y, x + 1]:
                    continue
                above: cython.float = max(slope[y - 1, x - 1], slope[y - 1, x], slope[y - 1, x + 1])
                below: cython.float = max(slope[y + 1, x - 1], slope[y + 1, x], slope[y + 1, x + 1])
                if here >= above and here >= below and count < places.shape[0]:
                    places[count, 0] = x
                    places[count, 1] = y
                    count += 1
    return count


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def slopes_of_row(
    above: cython.const[cython.float][::1],
    here: cython.const[cython.float][::1],
    below: cython.const[cython.float][::1],
    slope: cython.float[::1],
) -> cython.void:
    """Fill in the slopes of a row but at its ends."""
    x: cython.Py_ssize_t
    along: cython.float = 0.125
    down: cython.float = 0.0625
    for x in range(1, slope.shape[0] - 1):
        right: cython.float = above[x + 1] + 2 * here[x + 1] + below[x + 1]
        left: cython.float = above[x - 1] + 2 * here[x - 1] + below[x - 1]
        lower: cython.float = below[x - 1] + 2 * below[x] + below[x + 1]
        upper: cython.float = above[x - 1] + 2 * above[x] + above[x + 1]
        slope[x] = along * abs(right - left) + down * abs(lower - upper)


def edges(
    view: cython.const[cython.float][:, ::1],
    disparity: cython.const[cython.float][:, ::1],
    square_px: cython.int,
    min_slope: cython.float,
    work: cython.float[:, ::1],
    places: cython.int[:, ::1],
) -> cython.int:
    """Take the steepest pixel of each square of unknown disparity; return how many there are.

    Args:
        view: grey.
        disparity: NaN = unknown.
        square_px: side of a square.
        min_slope: least slope along the row, in grey levels a px, of the mean of three rows.
        work: (2, width).
        places: (squares, 2) receives their columns and rows.
    """
    row: cython.int
    column: cython.int
    y: cython.int
    x: cython.int
    count: cython.int = 0
    height: cython.int = cython.cast(cython.int, view.shape[0])
    width: cython.int = cython.cast(cython.int, view.shape[1])
    least: cython.float = 8 * min_slope
    with cython.nogil:
        for row in range(height // square_px):
            for x in range(width):
                work[0, x] = least
                work[1, x] = -1
            for y in range(max(row * square_px, 1), min((row + 1) * square_px, height - 1)):
                steepest_in_columns(view[y - 1], view[y], view[y + 1], disparity[y], y, work)
            for column in range(width // square_px):
                steepest: cython.float = least
                found: cython.bint = False
                for x in range(column * square_px, (column + 1) * square_px):
                    # The first one in reading order.
                    ahead: cython.bint = work[0, x] > steepest or (
                        found and work[0, x] == steepest and work[1, x] < places[count, 1]
                    )
                    if work[1, x] >= 0 and ahead:
                        steepest = work[0, x]
                        found = True
                        places[count, 0] = x
                        places[count, 1] = cython.cast(cython.int, work[1, x])
                count += found
    return count


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def steepest_in_columns(
    above: cython.const[cython.float][::1],
    here: cython.const[cython.float][::1],
    below: cython.const[cython.float][::1],
    disparity: cython.const[cython.float][::1],
    y: cython.int,
    work: cython.float[:, ::1],
) -> cython.void:
    """Renew the steepest slope of unknown disparity in each column, and its row."""
    x: cython.Py_ssize_t
    best: cython.float[::1] = work[0]
    where: cython.float[::1] = work[1]
    number: cython.float = y
    for x in range(1, here.shape[0] - 1):
        slope: cython.float = abs(
            above[x + 1]
            - above[x - 1]
            + 2 * (here[x + 1] - here[x - 1])
            + below[x + 1]
            - below[x - 1]
        )
        known: cython.bint = disparity[x] == disparity[x]
        before: cython.float = best[x]
        row: cython.float = where[x]
        slope = before if known else slope
        best[x] = slope if slope > before else before
        where[x] = number if slope > before else row


def fill(
    places: cython.const[cython.int][:, ::1],
    found: cython.const[cython.float][:, ::1],
    max_sigma: cython.float,
    reach: cython.int,
    disparity: cython.float[:, ::1],
    filled: cython.float[:, ::1],
) -> None:
    """Fill in the disparity around pixels where it is unknown, the largest where they compete.

    Args:
        places: (n, 2) column and row.
        found: (n, 2) disparity and its standard deviation, NaN = unknown.
        max_sigma: the largest one.
        reach: how far around a pixel.
        disparity: NaN = unknown.
        filled: the same; is changed.
    """
    i: cython.Py_ssize_t
    y: cython.int
    x: cython.int
    height: cython.int = cython.cast(cython.int, disparity.shape[0])
    width: cython.int = cython.cast(cython.int, disparity.shape[1])
    with cython.nogil:
        for i in range(places.shape[0]):
            if not found[i, 1] < max_sigma:
                continue
            near: cython.float = found[i, 0]
            for y in range(max(places[i, 1] - reach, 0), min(places[i, 1] + reach + 1, height)):
                for x in range(max(places[i, 0] - reach, 0), min(places[i, 0] + reach + 1, width)):
                    if disparity[y, x] != disparity[y, x] and not filled[y, x] >= near:
                        filled[y, x] = near


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def best(
    view: cython.const[cython.float][:, ::1],
    other: cython.const[cython.float][:, ::1],
    x: cython.int,
    y: cython.int,
    sign: cython.int,
    range_px: cython.int,
    noise: cython.float,
    ratio: cython.float,
    work: cython.float[:, ::1],
) -> cython.int:
    """Return the disparity of a pixel by search, -1 if it is uncertain."""
    row: cython.int
    column: cython.int
    width: cython.int = cython.cast(cython.int, view.shape[1])
    height: cython.int = cython.cast(cython.int, view.shape[0])
    if x < 4 or y < 2 or x >= width - 4 or y >= height - 2:
        return -1
    cells: cython.float = 45
    sum: cython.float = 0
    squares: cython.float = 0
    for row in range(y - 2, y + 3):
        for column in range(x - 4, x + 5):
            sum += view[row, column]
            squares += view[row, column] * view[row, column]
    least: cython.float = 1e30
    found: cython.int = -1
    reach: cython.int = min(range_px, width - 5 - x if sign > 0 else x - 4)
    first: cython.int = 0 if sign > 0 else -reach
    differences(view, other, x, y, first, reach + 1, work)
    for d in range(reach + 1):
        cost: cython.float = work[1, d]
        if cost < least or (cost == least and sign < 0):
            least = cost
            found = d
    if found < 0 or least > 6 * cells * noise * noise + cython.cast(cython.float, 0.1) * (
        squares - sum * sum / cells
    ):
        return -1
    limit: cython.float = ratio * (least + cython.cast(cython.float, 0.3) * cells * noise * noise)
    for d in range(reach + 1):
        if (d < found - 2 or d > found + 2) and work[1, d] <= limit:
            return -1
    return found if sign > 0 else reach - found


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def differences(
    view: cython.const[cython.float][:, ::1],
    other: cython.const[cython.float][:, ::1],
    x: cython.int,
    y: cython.int,
    first: cython.int,
    count: cython.int,
    work: cython.float[:, ::1],
) -> cython.void:
    """Fill in the squared differences of a patch at each of some shifts along the row, from first.

    Innermost are the shifts, which compilers make vectors of, as their numbers cannot wrap.
    """
    d: cython.Py_ssize_t
    shifts: cython.Py_ssize_t = count
    row: cython.int
    column: cython.int
    cells: cython.float = 45
    for d in range(shifts):
        work[0, d] = 0
        work[1, d] = 0
    for row in range(y - 2, y + 3):
        # Three columns at a time: sums are loaded and stored less often.
        for column in range(x - 4, x + 5, 3):
            one: cython.float = view[row, column]
            two: cython.float = view[row, column + 1]
            three: cython.float = view[row, column + 2]
            begin: cython.Py_ssize_t = column + first
            for d in range(shifts):
                a: cython.float = other[row, begin + d] - one
                b: cython.float = other[row, begin + d + 1] - two
                c: cython.float = other[row, begin + d + 2] - three
                work[0, d] = work[0, d] + a + b + c
                work[1, d] = work[1, d] + a * a + b * b + c * c
    for d in range(shifts):
        work[1, d] -= work[0, d] * work[0, d] / cells


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def refine(
    right: cython.const[cython.float][:, ::1],
    left: cython.const[cython.float][:, ::1],
    x: cython.int,
    y: cython.int,
    start: cython.int,
    noise: cython.float,
    found: cython.float[:, ::1],
    i: cython.Py_ssize_t,
) -> cython.void:
    """Fill in disparity and its standard deviation, to parts of a px."""
    row: cython.int
    column: cython.int
    width: cython.int = cython.cast(cython.int, right.shape[1])
    height: cython.int = cython.cast(cython.int, right.shape[0])
    if x < 4 or y < 4 or x >= width - 4 or y >= height - 4:
        return
    d: cython.double = start
    step: cython.double = 1
    squares: cython.double = 0
    errors: cython.double = 0
    for _count in range(6):
        place: cython.double = x + d
        if place < 5 or place > width - 6:
            return
        first: cython.int = cython.cast(cython.int, floor(place))
        a: cython.double = place - first
        here: cython.double = 0
        there: cython.double = 0
        for row in range(y - 3, y + 4):
            for column in range(-3, 4):
                here += right[row, x + column]
                there += between(left, row, first + column, a)
        mean: cython.double = (there - here) / 49
        squares = 0
        errors = 0
        product: cython.double = 0
        for row in range(y - 3, y + 4):
            for column in range(-3, 4):
                e: cython.double = (
                    between(left, row, first + column, a) - right[row, x + column] - mean
                )
                g: cython.double = 0.25 * (
                    between(left, row, first + column + 1, a)
                    - between(left, row, first + column - 1, a)
                    + right[row, x + column + 1]
                    - right[row, x + column - 1]
                )
                squares += g * g
                product += g * e
                errors += e * e
        if squares < 1:
            return
        step = max(min(-product / squares, 1.0), -1.0)
        d += step
        if fabs(step) < 0.01:
            break
    if fabs(step) > 0.2 or fabs(d - start) > 2.5:
        return
    found[i, 0] = cython.cast(cython.float, d)
    found[i, 1] = cython.cast(
        cython.float, sqrt((2 * noise * noise + errors / 49) / squares) + 0.03
    )


@cython.cfunc
@cython.nogil
@cython.inline
@cython.exceptval(check=False)
def between(
    view: cython.const[cython.float][:, ::1], row: cython.int, column: cython.int, a: cython.double
) -> cython.double:
    """Return the grey a share ``a`` from a pixel to the next one in its row."""
    here: cython.double = view[row, column]
    return here + a * (view[row, column + 1] - here)
