"""Pixels of patches now and then: loops of :mod:`motionstereo_cli.compiled.movers`.

A block holds 64 pixels. They are those of 8 cells of 4 x 4 px, 8 of each cell, where pixel n is of
cell n modulo 8; or the first 41 are those of a patch of 9 x 9 px, the next 7 are outside of every
image, and the rest is not used. Of cells and patches every second pixel is taken, as on a
chessboard. Each quantity of the pixels is a row of 64 values, see :func:`at`, so that compilers
make vectors of them. The rows of ``values`` are

- 0: disparity in the middle of the patch, 1: of the pixel, 2: 1 = it counts, else 0
- 3, 4: column in both views then, if it stands, 5: row, 6: share of a px in the other view
- 7, 8: grey now in both views, 9, 10: its slopes along x, 0 where it does not count, less their
  mean once they are centred, 11, 12: along y
- 13, 14: shares of a px along x and y then, 15: difference of grey, 16 to 18: sums by lane

and those of ``places`` are 0, 1: column and row now, 2, 3: index in the view and in the other one.
:func:`gather` then keeps grey and its differences in rows 0 to 2, and :func:`compare` the index in
the earlier view in row 3.
"""

import cython
import numpy as np


class FrameLevel:
    """The views and the disparity of a frame at a pyramid level.

    Args:
        view, other: grey of the camera and of the other one, row by row, (height * width,) uint8.
        disparity: of the camera's view in px, float32, NaN = unknown.
        height, width: in px.
    """

    def __init__(self, view, other, disparity, height, width):
        self.view, self.other, self.disparity = view, other, disparity
        self.height, self.width = height, width


class Block:
    """Pixels of cells or of a patch; a thread uses one again and again.

    Attributes:
        values, places: 19 and 4 rows of 64, see above.
        pairs: 5 rows of 64, greys beside each other, see :func:`pair_at`.
        aside, below: pixels of a patch, by where its chessboard begins, and of a cell.
        numbers: of the camera and its motion; see :func:`project`.
        sums: of a patch: squared differences, these by slopes along x and y; squares and products
            of slopes.
    """

    def __init__(self):
        self.values = np.zeros(19 * 64, np.float32)
        self.places = np.zeros(4 * 64, np.int32)
        self.pairs = np.zeros(5 * 64, np.uint32)
        # What is beyond a patch is outside of every image.
        aside, below = np.full((2, 3, 64), -(1 << 20), np.int32)
        for begin in range(2):
            y, x = np.nonzero((np.indices((9, 9)).sum(axis=0) + begin) % 2 == 0)
            aside[begin, : len(x)], below[begin, : len(y)] = x, y
        y, x = np.nonzero(np.indices((4, 4)).sum(axis=0) % 2 == 0)
        aside[2], below[2] = np.repeat(x, 8), np.repeat(y, 8)
        self.aside, self.below = aside, below
        self.numbers = np.zeros(25, np.float32)
        self.sums = np.zeros(6)


@cython.locals(n=cython.Py_ssize_t)
def take_cell(
    block: Block, cell: cython.Py_ssize_t, x: cython.int, y: cython.int, middle: cython.float
) -> cython.void:
    """Take one of 8 cells, from its upper left pixel on; of a disparity NaN, none of it counts."""
    for n in range(cell, 64, 8):
        block.values[at(0, n)] = middle
        block.places[at(0, n)] = x + block.aside[2, n]
        block.places[at(1, n)] = y + block.below[2, n]


@cython.locals(cell=cython.Py_ssize_t, side=cython.Py_ssize_t)
def compare_cells(now: FrameLevel, then: FrameLevel, block: Block) -> cython.void:
    """Fill in, by cell, squared differences of grey, a brighter view apart, pixels and slopes."""
    values: cython.float[::1] = block.values
    gather(now, block, 64, 64)
    for cell in range(8):
        values[at(16, cell)] = 0
        values[at(17, cell)] = over_cell(values, 2, 2, cell)
        values[at(18, cell)] = over_cell(values, 9, 9, cell) + over_cell(values, 11, 11, cell)
    for side in range(2):
        compare(then, block, side, 0, 0, 64, 64)
        for cell in range(8):
            total: cython.float = over_cell(values, 15, 2, cell)
            count: cython.float = max(values[at(17, cell)], 1)
            squares: cython.float = over_cell(values, 15, 15, cell)
            values[at(16, cell)] += max(squares - total * total / count, 0)


@cython.locals(n=cython.Py_ssize_t)
def take_patch(
    now: FrameLevel, block: Block, x: cython.int, y: cython.int, middle: cython.float
) -> cython.float:
    """Take the patch around a pixel of a disparity; return how many of its pixels count."""
    begin: cython.int = x + y & 1
    for n in range(48):
        block.values[at(0, n)] = middle
        block.places[at(0, n)] = x - 4 + block.aside[begin, n]
        block.places[at(1, n)] = y - 4 + block.below[begin, n]
    gather(now, block, 41, 48)
    return over_patch(block.values, 2, 2)


@cython.locals(n=cython.Py_ssize_t)
def centre_patch(block: Block, side: cython.Py_ssize_t, count: cython.float) -> cython.void:
    """Centre the slopes in one view: a brighter view says nothing; fill in their products."""
    values: cython.float[::1] = block.values
    mean_x: cython.float = over_patch(values, 9 + side, 2) / count
    mean_y: cython.float = over_patch(values, 11 + side, 2) / count
    for n in range(48):
        values[at(9 + side, n)] -= mean_x * values[at(2, n)]
        values[at(11 + side, n)] -= mean_y * values[at(2, n)]
    block.sums[3] = over_patch(values, 9 + side, 9 + side)
    block.sums[4] = over_patch(values, 9 + side, 11 + side)
    block.sums[5] = over_patch(values, 11 + side, 11 + side)


def compare_patch(
    then: FrameLevel,
    block: Block,
    side: cython.Py_ssize_t,
    count: cython.float,
    right: cython.float,
    down: cython.float,
) -> cython.void:
    """Fill in the sums of differences of grey in one view after a shift, a brighter view apart."""
    values: cython.float[::1] = block.values
    compare(then, block, side, right, down, 41, 48)
    total: cython.double = over_patch(values, 15, 2)
    block.sums[0] = max(over_patch(values, 15, 15) - total * total / count, 0.0)
    block.sums[1] = over_patch(values, 15, 9 + side)
    block.sums[2] = over_patch(values, 15, 11 + side)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(n=cython.Py_ssize_t)
def gather(
    now: FrameLevel,
    work: Block,
    pixels: cython.Py_ssize_t,
    count: cython.Py_ssize_t,
) -> cython.void:
    """Fill in the first pixels of a block: of one surface, and in view now and then."""
    block: cython.float[::1] = work.values
    places: cython.int[::1] = work.places
    pairs: cython.uint[::1] = work.pairs
    width: cython.int = now.width
    below: cython.Py_ssize_t = width
    height: cython.int = now.height
    for n in range(count):
        x: cython.int = places[at(0, n)]
        y: cython.int = places[at(1, n)]
        inside: cython.Py_ssize_t = min(x, y, width - 1 - x, height - 1 - y)
        x = x if inside > 0 else 1  # any place will do
        y = y if inside > 0 else 1
        places[at(0, n)] = x
        places[at(1, n)] = y
        places[at(2, n)] = y * width + x
        block[at(2, n)] = inside > 0
    for n in range(pixels):
        block[at(1, n)] = now.disparity[places[at(2, n)]]
    project(work.numbers, width, height, count, block, places)
    for n in range(pixels):
        i: cython.Py_ssize_t = places[at(2, n)]
        places[at(0, n)] = now.view[i]
        places[at(1, n)] = grey(now.view, i + 1) - grey(now.view, i - 1)
        places[at(2, n)] = grey(now.view, i + below) - grey(now.view, i - below)
        i = places[at(3, n)]
        pairs[at(1, n)] = pair_at(now.other, i - 1)
        pairs[at(2, n)] = pair_at(now.other, i + 1)
        pairs[at(3, n)] = pair_at(now.other, i - below)
        pairs[at(4, n)] = pair_at(now.other, i + below)
    for n in range(count):
        a: cython.float = block[at(6, n)]
        half: cython.float = block[at(2, n)] * cython.cast(cython.float, 0.5)
        block[at(7, n)] = cython.cast(cython.float, places[at(0, n)])
        block[at(9, n)] = half * places[at(1, n)]
        block[at(11, n)] = half * places[at(2, n)]
        before: cython.uint = pairs[at(1, n)]
        after: cython.uint = pairs[at(2, n)]
        here: cython.float = byte(before, 8)
        next: cython.float = byte(after, 0)
        block[at(8, n)] = interpolated(here, next, a)
        block[at(10, n)] = half * (
            interpolated(next, byte(after, 8), a) - interpolated(byte(before, 0), here, a)
        )
        block[at(12, n)] = half * (within(pairs[at(4, n)], a) - within(pairs[at(3, n)], a))


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(n=cython.Py_ssize_t)
def project(  # noqa: PLR0915
    numbers: cython.const[cython.float][::1],
    width: cython.int,
    height: cython.int,
    count: cython.Py_ssize_t,
    block: cython.float[::1],
    places: cython.int[::1],
) -> cython.void:
    """Fill in where pixels are in the other view, and were in both if they stand."""
    jump_px: cython.float = numbers[0]
    jump_share: cython.float = numbers[1]
    doffs: cython.float = numbers[2]
    side: cython.float = numbers[3]
    per_px: cython.float = numbers[4]
    per_focal_x: cython.float = numbers[5]
    per_focal_y: cython.float = numbers[6]
    focal_x: cython.float = numbers[7]
    focal_y: cython.float = numbers[8]
    cx: cython.float = numbers[9]
    cy: cython.float = numbers[10]
    apart: cython.float = numbers[11]
    xx: cython.float = numbers[12]
    xy: cython.float = numbers[13]
    xz: cython.float = numbers[14]
    along_x: cython.float = numbers[15]
    yx: cython.float = numbers[16]
    yy: cython.float = numbers[17]
    yz: cython.float = numbers[18]
    along_y: cython.float = numbers[19]
    zx: cython.float = numbers[20]
    zy: cython.float = numbers[21]
    zz: cython.float = numbers[22]
    along_z: cython.float = numbers[23]
    right: cython.float = cython.cast(cython.float, width)
    bottom: cython.float = cython.cast(cython.float, height)
    none: cython.float = 0
    border: cython.float = 2
    least: cython.float = numbers[24]
    for n in range(count):
        middle: cython.float = block[at(0, n)]
        disparity: cython.float = block[at(1, n)]
        jump: cython.float = max(jump_px, jump_share * (middle + doffs))
        alike: cython.bint = abs(disparity - middle) <= jump  # not where it is NaN
        block[at(2, n)] = block[at(2, n)] if alike else none
        block[at(1, n)] = disparity if alike else none
    for n in range(count):
        x: cython.float = cython.cast(cython.float, places[at(0, n)])
        y: cython.float = cython.cast(cython.float, places[at(1, n)])
        place: cython.float = x + side * block[at(1, n)]
        across: cython.float = (x - cx) * per_focal_x
        down: cython.float = (y - cy) * per_focal_y
        near: cython.float = block[at(1, n)] + doffs
        inverse: cython.float = near * per_px
        z: cython.float = zx * across + zy * down + zz + along_z * inverse
        before: cython.float = max(z, least)
        u: cython.float = (xx * across + xy * down + xz + along_x * inverse) / before
        v: cython.float = (yx * across + yy * down + yz + along_y * inverse) / before
        u = cx + focal_x * u
        v = cy + focal_y * v
        w: cython.float = u + apart + side * near / before
        inside: cython.bint = (
            (z >= least)
            & (place >= border)
            & (place < right - 3)
            & (min(u, v, w) >= none)
            & (max(u, w) < right)
            & (v < bottom)
        )
        block[at(2, n)] = block[at(2, n)] * inside
        block[at(3, n)] = u
        block[at(4, n)] = w
        block[at(5, n)] = v
        place = min(max(place, border), right - 4)
        first: cython.int = cython.cast(cython.int, place)
        block[at(6, n)] = place - first
        places[at(3, n)] = places[at(2, n)] - places[at(0, n)] + first


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(n=cython.Py_ssize_t)
def compare(
    then: FrameLevel,
    work: Block,
    side: cython.Py_ssize_t,
    right: cython.float,
    down: cython.float,
    pixels: cython.Py_ssize_t,
    count: cython.Py_ssize_t,
) -> cython.void:
    """Fill in the differences of grey of one view after a shift, 0 where pixels do not count."""
    block: cython.float[::1] = work.values
    places: cython.int[::1] = work.places
    pairs: cython.uint[::1] = work.pairs
    view: cython.const[cython.uchar][::1] = then.other if side else then.view
    width: cython.int = then.width
    below: cython.Py_ssize_t = width
    none: cython.float = 0
    last_column: cython.float = cython.cast(cython.float, width - 1.001)
    last_row: cython.float = cython.cast(cython.float, then.height - 1.001)
    for n in range(count):
        u: cython.float = min(max(block[at(3 + side, n)] + right, none), last_column)
        v: cython.float = min(max(block[at(5, n)] + down, none), last_row)
        column: cython.int = cython.cast(cython.int, u)
        row: cython.int = cython.cast(cython.int, v)
        places[at(3, n)] = row * width + column
        block[at(13, n)] = u - column
        block[at(14, n)] = v - row
    for n in range(pixels):
        i: cython.Py_ssize_t = places[at(3, n)]
        pairs[at(0, n)] = pair_at(view, i)
        pairs[at(1, n)] = pair_at(view, i + below)
    for n in range(count):
        a: cython.float = block[at(13, n)]
        upper: cython.float = within(pairs[at(0, n)], a)
        lower: cython.float = within(pairs[at(1, n)], a)
        off: cython.float = interpolated(upper, lower, block[at(14, n)]) - block[at(7 + side, n)]
        block[at(15, n)] = off * block[at(2, n)]


@cython.cfunc
@cython.nogil
@cython.inline
@cython.exceptval(check=False)
def over_cell(
    block: cython.float[::1],
    one: cython.Py_ssize_t,
    other: cython.Py_ssize_t,
    cell: cython.Py_ssize_t,
) -> cython.float:
    """Return the sum of the products of two rows over the 8 pixels of a cell."""
    first: cython.float = block[at(one, cell)] * block[at(other, cell)]
    first += block[at(one, cell + 8)] * block[at(other, cell + 8)]
    first += block[at(one, cell + 16)] * block[at(other, cell + 16)]
    first += block[at(one, cell + 24)] * block[at(other, cell + 24)]
    first += block[at(one, cell + 32)] * block[at(other, cell + 32)]
    first += block[at(one, cell + 40)] * block[at(other, cell + 40)]
    first += block[at(one, cell + 48)] * block[at(other, cell + 48)]
    return first + block[at(one, cell + 56)] * block[at(other, cell + 56)]


@cython.cfunc
@cython.nogil
@cython.inline
@cython.exceptval(check=False)
@cython.locals(lane=cython.Py_ssize_t)
def over_patch(
    block: cython.float[::1], one: cython.Py_ssize_t, other: cython.Py_ssize_t
) -> cython.float:
    """Return the sum of the products of two rows over the pixels of a patch."""
    for lane in range(8):
        sum: cython.float = block[at(one, lane)] * block[at(other, lane)]
        sum += block[at(one, lane + 8)] * block[at(other, lane + 8)]
        sum += block[at(one, lane + 16)] * block[at(other, lane + 16)]
        sum += block[at(one, lane + 24)] * block[at(other, lane + 24)]
        sum += block[at(one, lane + 32)] * block[at(other, lane + 32)]
        sum += block[at(one, lane + 40)] * block[at(other, lane + 40)]
        block[at(16, lane)] = sum
    for lane in range(4):
        block[at(16, lane)] += block[at(16, lane + 4)]
    upper: cython.float = block[at(16, 0)] + block[at(16, 1)]
    return upper + (block[at(16, 2)] + block[at(16, 3)])


@cython.cfunc
@cython.nogil
@cython.inline
@cython.exceptval(check=False)
def at(row: cython.Py_ssize_t, lane: cython.Py_ssize_t) -> cython.Py_ssize_t:
    """Return where a value of a block is: compilers have to know how far apart rows are."""
    return 64 * row + lane


@cython.cfunc
@cython.nogil
@cython.inline
@cython.exceptval(check=False)
def byte(pair: cython.uint, shift: cython.int) -> cython.float:
    """Return the first or the second of a pair of greys, by a shift of 0 or 8."""
    return cython.cast(cython.float, cython.cast(cython.int, pair >> shift & 255))


@cython.cfunc
@cython.nogil
@cython.inline
@cython.exceptval(check=False)
def grey(view: cython.const[cython.uchar][::1], i: cython.Py_ssize_t) -> cython.int:
    """Return a grey as a number that may become negative."""
    return cython.cast(cython.int, view[i])


@cython.cfunc
@cython.nogil
@cython.inline
@cython.exceptval(check=False)
def pair_at(view: cython.const[cython.uchar][::1], i: cython.Py_ssize_t) -> cython.uint:
    """Return a grey and the next one: compilers load them together."""
    return cython.cast(cython.uint, view[i]) | cython.cast(cython.uint, view[i + 1]) << 8


@cython.cfunc
@cython.nogil
@cython.inline
@cython.exceptval(check=False)
def interpolated(here: cython.float, next: cython.float, a: cython.float) -> cython.float:
    """Return the grey a share ``a`` from a pixel to the next one."""
    return here + a * (next - here)


@cython.cfunc
@cython.nogil
@cython.inline
@cython.exceptval(check=False)
def within(pair: cython.uint, a: cython.float) -> cython.float:
    """Return the grey a share ``a`` from the first to the second of a pair of greys."""
    return interpolated(byte(pair, 0), byte(pair, 8), a)
