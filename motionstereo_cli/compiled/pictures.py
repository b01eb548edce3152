"""Pixels in the formats of files: the loops of :mod:`motionstereo_cli.files` and of the sinks."""

import cython
import numpy as np

#: Added to a float and subtracted again, it rounds half to even, as rint does.
ROUND = cython.declare(cython.float, 8388608)
NAN = cython.declare(cython.float, np.nan)
ZERO = cython.declare(cython.float, 0)
ONE = cython.declare(cython.float, 1)
MOST = cython.declare(cython.float, 65535)


def depth(
    disparity: cython.const[cython.float][:, ::1],
    doffs: cython.float,
    focal_baseline: cython.float,
    result: cython.float[:, ::1],
) -> None:
    """Fill in depth, focal * baseline / (disparity + doffs), NaN where that is not positive.

    Args:
        disparity: px, (height, width) float32, NaN = unknown.
        doffs: px.
        focal_baseline: px m.
        result: m, (height, width) float32.
    """
    y: cython.Py_ssize_t
    with cython.nogil:
        for y in range(disparity.shape[0]):
            depth_row(disparity[y], doffs, focal_baseline, result[y])


def depth_uint16(
    disparity: cython.const[cython.float][:, ::1],
    doffs: cython.float,
    focal_baseline: cython.float,
    per_unit: cython.float,
    largest: cython.float,
    row: cython.float[::1],
    result: cython.ushort[:, ::1],
) -> None:
    """Fill in :func:`to_uint16` of :func:`depth`.

    Args:
        disparity, doffs, focal_baseline: as of :func:`depth`.
        per_unit, largest, result: as of :func:`to_uint16`.
        row: buffer, (width,) float32.
    """
    y: cython.Py_ssize_t
    with cython.nogil:
        for y in range(disparity.shape[0]):
            depth_row(disparity[y], doffs, focal_baseline, row)
            row_to_uint16(row, per_unit, largest, result[y])


def to_uint16(
    values: cython.const[cython.float][:, ::1],
    per_unit: cython.float,
    largest: cython.float,
    result: cython.ushort[:, ::1],
) -> None:
    """Fill in 16-bit fixed point: 0 = unknown or over ``largest``; what rounds to 0 is 1.

    Args:
        values: (height, width) float32, NaN = unknown.
        per_unit: steps of the result in a unit of ``values``.
        largest: largest value that fits.
        result: (height, width) uint16.
    """
    y: cython.Py_ssize_t
    with cython.nogil:
        for y in range(values.shape[0]):
            row_to_uint16(values[y], per_unit, largest, result[y])


# Compilers vectorise loops over arrays that are arguments of a separate function: otherwise a byte
# that is written might alias the pointers of the arrays.


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def depth_row(
    disparity: cython.const[cython.float][::1],
    doffs: cython.float,
    focal_baseline: cython.float,
    result: cython.float[::1],
) -> cython.void:
    """Fill in a row of depth."""
    x: cython.Py_ssize_t
    for x in range(result.shape[0]):
        nearness: cython.float = disparity[x] + doffs
        result[x] = focal_baseline / nearness if nearness > ZERO else NAN


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def row_to_uint16(
    values: cython.const[cython.float][::1],
    per_unit: cython.float,
    largest: cython.float,
    result: cython.ushort[::1],
) -> cython.void:
    """Fill in a row in 16-bit fixed point."""
    x: cython.Py_ssize_t
    for x in range(result.shape[0]):
        value: cython.float = values[x]
        scaled: cython.float = value * per_unit
        scaled = scaled if scaled > ONE else ONE  # also where it is unknown
        scaled = scaled if scaled < MOST else MOST
        step: cython.int = cython.cast(cython.int, (scaled + ROUND) - ROUND)
        known: cython.bint = (value >= 0) & (value <= largest)
        result[x] = step if known else 0


def up_filtered_8(image: cython.const[cython.uchar][:, ::1], result: cython.uchar[:, ::1]) -> None:
    """Fill in PNG's rows of an 8-bit image by the filter Up, (height, width + 1) uint8."""
    y: cython.Py_ssize_t
    with cython.nogil:
        for y in range(image.shape[0]):
            result[y, 0] = 2
            up_8(image[y], image[y - 1 if y > 0 else 0], 255 if y > 0 else 0, result[y])


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def up_8(
    row: cython.const[cython.uchar][::1],
    above: cython.const[cython.uchar][::1],
    mask: cython.uchar,
    result: cython.uchar[::1],
) -> cython.void:
    """Fill in a row; ``mask`` is 0 where there is none above."""
    x: cython.Py_ssize_t
    for x in range(row.shape[0]):
        result[x + 1] = (row[x] - (above[x] & mask)) & 255


def up_filtered_16(
    image: cython.const[cython.ushort][:, ::1], result: cython.uchar[:, ::1]
) -> None:
    """Fill in PNG's rows of a 16-bit image by the filter Up, (height, 2 * width + 1) uint8."""
    y: cython.Py_ssize_t
    with cython.nogil:
        for y in range(image.shape[0]):
            result[y, 0] = 2
            up_16(image[y], image[y - 1 if y > 0 else 0], 65535 if y > 0 else 0, result[y])


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def up_16(
    row: cython.const[cython.ushort][::1],
    above: cython.const[cython.ushort][::1],
    mask: cython.ushort,
    result: cython.uchar[::1],
) -> cython.void:
    """Fill in a row; ``mask`` is 0 where there is none above."""
    x: cython.Py_ssize_t
    for x in range(row.shape[0]):
        here: cython.int = cython.cast(cython.int, row[x])
        over: cython.int = cython.cast(cython.int, above[x] & mask)
        result[2 * x + 1] = ((here >> 8) - (over >> 8)) & 255
        result[2 * x + 2] = (here - over) & 255


def full_range(luma: cython.const[cython.uchar][:, ::1], grey: cython.uchar[:, ::1]) -> None:
    """Fill in 255 / 219 (luma - 16), rounded and limited to 0..255, as BT.601 has it.

    Args:
        luma: of limited range, (height, at least width) uint8.
        grey: (height, width) uint8.
    """
    y: cython.Py_ssize_t
    with cython.nogil:
        for y in range(luma.shape[0]):
            full_range_row(luma[y], grey[y])


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def full_range_row(luma: cython.const[cython.uchar][::1], grey: cython.uchar[::1]) -> cython.void:
    """Fill in a row, in 16 bits; of all 256 levels the result is exact."""
    x: cython.Py_ssize_t
    for x in range(grey.shape[0]):
        level: cython.uchar = luma[x]
        level = level if level > 16 else 16
        level = level if level < 235 else 235
        above: cython.ushort = level - 13
        grey[x] = level - 16 + (cython.cast(cython.uint, above) * 10776 >> 16)


def grey_planes(
    grey: cython.const[cython.uchar][:, ::1],
    luma: cython.uchar[:, ::1],
    blue: cython.uchar[:, ::1],
    red: cython.uchar[:, ::1],
) -> None:
    """Fill in the planes of a grey yuv420p picture of limited range.

    Args:
        grey: (height, width) uint8; both even.
        luma, blue, red: as of :func:`planes`; 16 + 219 / 255 grey, rounded, and 128.
    """
    x: cython.Py_ssize_t
    y: cython.Py_ssize_t
    with cython.nogil:
        for y in range(grey.shape[0]):
            limited_range_row(grey[y], luma[y])
        for y in range(grey.shape[0] // 2):
            for x in range(grey.shape[1] // 2):
                blue[y, x] = 128
            for x in range(grey.shape[1] // 2):
                red[y, x] = 128


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def limited_range_row(
    grey: cython.const[cython.uchar][::1], luma: cython.uchar[::1]
) -> cython.void:
    """Fill in a row, in 16 bits; of all 256 levels the result is exact."""
    x: cython.Py_ssize_t
    for x in range(grey.shape[0]):
        level: cython.ushort = cython.cast(cython.ushort, grey[x])
        less: cython.uint = cython.cast(cython.uint, 2 * level + 7) * 4627 >> 16
        luma[x] = level + 16 - less


def planes(
    levels: cython.const[cython.uchar][:, ::1],
    table: cython.const[cython.uchar][:, ::1],
    luma: cython.uchar[:, ::1],
    blue: cython.uchar[:, ::1],
    red: cython.uchar[:, ::1],
) -> None:
    """Fill in the planes of a yuv420p picture whose colours are in a table.

    Args:
        levels: which colour each pixel has, (height, width) uint8; both even.
        table: luma, blue and red difference of each colour, (3, 256) uint8.
        luma: at least (height, width) uint8; what is beyond stays as it is.
        blue, red: the same of half the size; each has the colour of the upper left of its four.
    """
    y: cython.Py_ssize_t
    with cython.nogil:
        for y in range(levels.shape[0]):
            look_up(levels[y], table[0], 1, luma[y])
        for y in range(levels.shape[0] // 2):
            look_up(levels[2 * y], table[1], 2, blue[y])
            look_up(levels[2 * y], table[2], 2, red[y])


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def look_up(
    levels: cython.const[cython.uchar][::1],
    table: cython.const[cython.uchar][::1],
    step: cython.Py_ssize_t,
    result: cython.uchar[::1],
) -> cython.void:
    """Fill in what a table has for every ``step``-th level of a row."""
    x: cython.Py_ssize_t
    for x in range(levels.shape[0] // step):
        result[x] = table[levels[step * x]]


def levels_of(
    disparity: cython.const[cython.float][:, ::1],
    doffs: cython.float,
    per_px: cython.float,
    table: cython.const[cython.uchar][::1],
    view: cython.const[cython.uchar][:, ::1],
    entry: cython.int[::1],
    result: cython.uchar[:, ::1],
) -> None:
    """Fill in the level of each disparity and, where it is unknown, of the view's grey.

    Args:
        disparity: px, (height, width) float32, NaN = unknown.
        doffs: added to it, px.
        per_px: entries of the table in a px.
        table: level of each disparity from 0 on, the last also of larger ones; then of each grey,
            (n + 256,) uint8.
        view: grey levels, (height, width) uint8.
        entry: buffer, (width,) int32.
        result: (height, width) uint8.
    """
    x: cython.Py_ssize_t
    y: cython.Py_ssize_t
    greys: cython.int = cython.cast(cython.int, table.shape[0]) - 256
    with cython.nogil:
        for y in range(disparity.shape[0]):
            entries(disparity[y], doffs, per_px, view[y], greys, entry)
            for x in range(disparity.shape[1]):
                result[y, x] = table[entry[x]]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def entries(
    disparity: cython.const[cython.float][::1],
    doffs: cython.float,
    per_px: cython.float,
    view: cython.const[cython.uchar][::1],
    greys: cython.int,
    entry: cython.int[::1],
) -> cython.void:
    """Fill in the entry of the table for each pixel of a row; those of grey begin at ``greys``."""
    x: cython.Py_ssize_t
    last: cython.float = cython.cast(cython.float, greys - 1)
    for x in range(entry.shape[0]):
        place: cython.float = (disparity[x] + doffs) * per_px
        known: cython.bint = place == place  # noqa: PLR0124
        place = place if place > ZERO else ZERO
        place = place if place < last else last
        grey: cython.int = view[x]
        entry[x] = cython.cast(cython.int, place) if known else greys + grey
