"""Pixels in the formats of files: the loops of :mod:`motionstereo_cli.files` and of the sinks."""

import cython

#: Added to a float and subtracted again, it rounds half to even, as rint does.
ROUND = cython.declare(cython.float, 8388608)
ZERO = cython.declare(cython.float, 0)
ONE = cython.declare(cython.float, 1)
MOST = cython.declare(cython.float, 65535)


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
    x: cython.Py_ssize_t
    y: cython.Py_ssize_t
    with cython.nogil:
        for y in range(values.shape[0]):
            for x in range(values.shape[1]):
                value: cython.float = values[y, x]
                scaled: cython.float = value * per_unit
                scaled = scaled if scaled > ONE else ONE  # also where it is unknown
                scaled = scaled if scaled < MOST else MOST
                step: cython.int = cython.cast(cython.int, (scaled + ROUND) - ROUND)
                known: cython.bint = (value >= 0) & (value <= largest)
                result[y, x] = step if known else 0


# Compilers vectorise a loop that writes bytes only if arrays are arguments of a separate function:
# otherwise such a byte might alias the pointers of the arrays.


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


def planes(
    levels: cython.const[cython.uchar][:, ::1],
    table: cython.const[cython.uchar][:, ::1],
    luma: cython.uchar[:, :],
    blue: cython.uchar[:, :],
    red: cython.uchar[:, :],
) -> None:
    """Fill in the planes of a yuv420p picture whose colours are in a table.

    Args:
        levels: which colour each pixel has, (height, width) uint8; both even.
        table: luma, blue and red difference of each colour, (3, 256) uint8.
        luma: (height, width) uint8.
        blue, red: (height / 2, width / 2) uint8; each has the colour of the upper left of its four.
    """
    with cython.nogil:
        look_up(levels, table[0], 1, luma)
        look_up(levels, table[1], 2, blue)
        look_up(levels, table[2], 2, red)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def look_up(
    levels: cython.const[cython.uchar][:, ::1],
    table: cython.const[cython.uchar][::1],
    step: cython.Py_ssize_t,
    result: cython.uchar[:, :],
) -> cython.void:
    """Fill in what a table has for the levels in every ``step``-th row and column."""
    x: cython.Py_ssize_t
    y: cython.Py_ssize_t
    for y in range(levels.shape[0] // step):
        for x in range(levels.shape[1] // step):
            result[y, x] = table[levels[step * y, step * x]]


def levels_of(
    disparity: cython.const[cython.float][:, ::1],
    doffs: cython.float,
    per_px: cython.float,
    table: cython.const[cython.uchar][::1],
    view: cython.const[cython.uchar][:, ::1],
    greys: cython.int,
    result: cython.uchar[:, ::1],
) -> None:
    """Fill in the level of each disparity by a table and, where it is unknown, a grey of the view.

    Args:
        disparity: px, (height, width) float32, NaN = unknown.
        doffs: added to it, px.
        per_px: entries of the table in a px.
        table: level of each disparity from 0 on; of larger ones, the last.
        view: grey levels, (height, width) uint8.
        greys: the levels below this one, at most 256, are those of greys.
        result: (height, width) uint8.
    """
    x: cython.Py_ssize_t
    y: cython.Py_ssize_t
    last: cython.float = cython.cast(cython.float, table.shape[0] - 1)
    with cython.nogil:
        for y in range(disparity.shape[0]):
            for x in range(disparity.shape[1]):
                place: cython.float = (disparity[y, x] + doffs) * per_px
                result[y, x] = (view[y, x] * greys) >> 8
                if place == place:  # noqa: PLR0124
                    place = max(min(place, last), ZERO)
                    result[y, x] = table[cython.cast(cython.int, place)]
