"""Flat textured pieces before a camera: the loops of :mod:`motionstereo_cli.simulate.surfaces`."""

import cython
from cython.cimports.libc.math import floor, hypot, log2

SAMPLES = cython.declare(cython.Py_ssize_t, 3)  # of a pixel, along each side
HALF = cython.declare(cython.double, 0.5)


def enter(
    nearness: cython.double[:, ::1],
    owner: cython.int[:, ::1],
    number: cython.int,
    bounds: cython.const[cython.Py_ssize_t][::1],
    near: cython.const[cython.double][::1],
    right: cython.const[cython.double][::1],
    down: cython.const[cython.double][::1],
    edges: cython.const[cython.double][:, ::1],
    holes: cython.const[cython.uchar][:, ::1],
    nearest: cython.double,
) -> None:
    """Enter the samples of a surface that are not hidden by nearer ones.

    Args:
        nearness, owner: of each sample, its reciprocal depth and the surface that it shows.
        number: the surface's.
        bounds: first row and column in which it may be seen, and those after the last, px.
        near, right, down, edges: linear forms, see ``simulate/surfaces.py``.
        holes: where its texture has a hole, 0 or 1; its sides are powers of two, or 0.
        nearest: largest reciprocal depth that is visible.
    """
    row: cython.Py_ssize_t
    column: cython.Py_ssize_t
    edge: cython.Py_ssize_t
    samples: cython.double = SAMPLES
    high: cython.Py_ssize_t = holes.shape[0]
    wide: cython.Py_ssize_t = holes.shape[1]
    with cython.nogil:
        for row in range(bounds[0] * SAMPLES, bounds[2] * SAMPLES):
            v: cython.double = (row + HALF) / samples - HALF
            for column in range(bounds[1] * SAMPLES, bounds[3] * SAMPLES):
                u: cython.double = (column + HALF) / samples - HALF
                here: cython.double = near[0] + near[1] * u + near[2] * v
                if here <= nearness[row, column] or here > nearest:
                    continue
                inside: cython.bint = True
                for edge in range(edges.shape[0]):
                    if edges[edge, 0] + edges[edge, 1] * u + edges[edge, 2] * v < 0:
                        inside = False
                        break
                if inside and high > 0:
                    x: cython.Py_ssize_t = cython.cast(
                        cython.Py_ssize_t, floor((right[0] + right[1] * u + right[2] * v) / here)
                    )
                    y: cython.Py_ssize_t = cython.cast(
                        cython.Py_ssize_t, floor((down[0] + down[1] * u + down[2] * v) / here)
                    )
                    inside = holes[y & (high - 1), x & (wide - 1)] == 0
                if inside:
                    nearness[row, column] = here
                    owner[row, column] = number


def paint(
    grey: cython.float[:, ::1],
    owner: cython.const[cython.int][:, ::1],
    number: cython.int,
    bounds: cython.const[cython.Py_ssize_t][::1],
    near: cython.const[cython.double][::1],
    right: cython.const[cython.double][::1],
    down: cython.const[cython.double][::1],
    levels: cython.const[cython.float][:, ::1],
    level_rows: cython.const[cython.Py_ssize_t][::1],
    level_columns: cython.const[cython.Py_ssize_t][::1],
    gain: cython.double,
) -> None:
    """Add a surface's share of each pixel's grey, (height, width) float32.

    Args:
        grey: what it is added to.
        owner, number, bounds, near, right, down: as for :func:`enter`.
        levels, level_rows, level_columns: its texture.
        gain: factor of the texture's grey.
    """
    u: cython.Py_ssize_t
    v: cython.Py_ssize_t
    row: cython.Py_ssize_t
    column: cython.Py_ssize_t
    with cython.nogil:
        for v in range(bounds[0], bounds[2]):
            for u in range(bounds[1], bounds[3]):
                mine: cython.int = 0
                for row in range(v * SAMPLES, (v + 1) * SAMPLES):
                    for column in range(u * SAMPLES, (u + 1) * SAMPLES):
                        mine += owner[row, column] == number
                if mine == 0:
                    continue
                here: cython.double = max(near[0] + near[1] * u + near[2] * v, 1e-6)
                x: cython.double = (right[0] + right[1] * u + right[2] * v) / here
                y: cython.double = (down[0] + down[1] * u + down[2] * v) / here
                # The derivative of a ratio of linear forms.
                wide: cython.double = hypot(right[1] - x * near[1], right[2] - x * near[2]) / here
                high: cython.double = hypot(down[1] - y * near[1], down[2] - y * near[2]) / here
                seen: cython.double = mean_grey(levels, level_rows, level_columns, y, x, high, wide)
                grey[v, u] += cython.cast(cython.float, gain * seen * mine / 9.0)


@cython.ccall
@cython.nogil
@cython.exceptval(check=False)
def mean_grey(
    levels: cython.const[cython.float][:, ::1],
    rows: cython.const[cython.Py_ssize_t][::1],
    columns: cython.const[cython.Py_ssize_t][::1],
    middle_y: cython.double,
    middle_x: cython.double,
    high: cython.double,
    wide: cython.double,
) -> cython.double:
    """Return the mean grey of a block of a texture.

    Args:
        levels, rows, columns: as :class:`~motionstereo_cli.simulate.texture.Texture` has them.
        middle_y, middle_x: row and column of the block's middle, in texels.
        high, wide: its sides.
    """
    down: cython.int
    across: cython.int
    total: cython.double = 0
    last_down: cython.int = cython.cast(cython.int, rows.shape[0]) - 1
    last_across: cython.int = cython.cast(cython.int, columns.shape[0]) - 1
    level_down: cython.double = min(
        max(log2(max(high, 1e-9)), 0.0), cython.cast(cython.double, last_down)
    )
    level_across: cython.double = min(
        max(log2(max(wide, 1e-9)), 0.0), cython.cast(cython.double, last_across)
    )
    first_down: cython.int = cython.cast(cython.int, level_down)
    first_across: cython.int = cython.cast(cython.int, level_across)
    # Between the levels below and above, and between texels, it is interpolated linearly.
    for down in range(first_down, min(first_down + 2, last_down + 1)):
        y: cython.double = periodic(middle_y, 1 << last_down) / (1 << down) - HALF
        top: cython.double = floor(y)
        for across in range(first_across, min(first_across + 2, last_across + 1)):
            x: cython.double = periodic(middle_x, 1 << last_across) / (1 << across) - HALF
            left: cython.double = floor(x)
            share: cython.double = (1.0 - abs(level_down - down)) * (
                1.0 - abs(level_across - across)
            )
            row: cython.Py_ssize_t = rows[down] + cython.cast(cython.Py_ssize_t, top)
            column: cython.Py_ssize_t = columns[across] + cython.cast(cython.Py_ssize_t, left)
            to_right: cython.double = left + 1.0 - x
            upper: cython.double = levels[row, column] * to_right + levels[row, column + 1] * (
                x - left
            )
            row += 1
            lower: cython.double = levels[row, column] * to_right + levels[row, column + 1] * (
                x - left
            )
            total += share * (upper * (top + 1.0 - y) + lower * (y - top))
    return total


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def periodic(place: cython.double, period: cython.double) -> cython.double:
    """Return a place within a period, 0..period; the period is a power of two."""
    return place - floor(place / period) * period
