"""Loops in vectors: what :mod:`motionstereo_cli.compiled.dense` and ``bilateral`` do, faster.

The same results to the bit. The C sources beside this file, ``semi_global.h`` and ``bilateral.h``,
use the vector types of GCC and clang; with other compilers, and in plain Python, this module does
not exist.
"""

import cython
import numpy as np

if not cython.compiled:
    raise ImportError("there are no vectors in plain Python")

from cython.cimports.motionstereo_cli.compiled.bilateral_vectors import (
    HAS_LOOKUPS,
    smooth_bytes,
    smooth_vectors,
)
from cython.cimports.motionstereo_cli.compiled.semi_global import (
    Penalties,
    Tiles,
    View,
    semi_global_vectors,
    workspace_bytes,
)

#: Maximum number of disparities, and of chunks of them.
MAX_COUNT, MAX_CHUNKS = 1024, 64

#: Whether :func:`smooth` works: the processor looks up bytes, 32 at a time.
CAN_SMOOTH = bool(HAS_LOOKUPS)


@cython.cclass
class Workspace:
    """Reusable buffers for matching a frame."""

    memory: cython.uchar[::1]

    def __init__(self):
        self.memory = np.empty(1, np.uint8)


@cython.cclass
@cython.dataclasses.dataclass(eq=False)
class Frame:
    """Input of the matching: two views and proposals. All are (rows, width).

    Attributes:
        right, left: grey.
        right_slope, left_slope: its slope.
        where: pixels to match, 0 or 1.
        proposed: preferred disparities in px.
        weight: cost of all others, 0 where none is preferred.
    """

    right: cython.const[cython.uchar][:, ::1]
    left: cython.const[cython.uchar][:, ::1]
    right_slope: cython.const[cython.schar][:, ::1]
    left_slope: cython.const[cython.schar][:, ::1]
    where: cython.const[cython.uchar][:, ::1]
    proposed: cython.const[cython.float][:, ::1]
    weight: cython.const[cython.short][:, ::1]


def semi_global(
    frame: Frame,
    count: cython.int,
    penalties: cython.const[cython.float][::1],
    sets: cython.const[cython.ulonglong][:, ::1],
    tile_rows: cython.int,
    tile_width: cython.int,
    chunk: cython.int,
    strip_bytes: cython.Py_ssize_t,
    work: Workspace,
    disparity: cython.float[:, ::1],
    margin: cython.float[:, ::1],
    rival: cython.float[:, ::1],
) -> None:
    """Fill in disparity and margin, (rows, width) float32, NaN = unknown.

    Args:
        frame: what is matched.
        count: number of disparities, at most :data:`MAX_COUNT`.
        penalties: the fields of :class:`~motionstereo_cli.compiled.dense.Weights`, in order.
        sets: which chunks of disparities are looked at in each tile, a bit for each, at least
            one, (tiles down, tiles across) uint64.
        tile_rows, tile_width: size of a tile, px: multiples of 16, or all of the image.
        chunk: number of disparities in a chunk, so that there are at most :data:`MAX_CHUNKS`.
        strip_bytes: memory for the costs of paths from below in a strip of rows: an image of
            several strips takes half as long again.
        work: reusable buffers.
        disparity, margin: get the result.
        rival: gets the second best disparity where it costs hardly more, of NaN; of no rows = not
            asked for.
    """
    view: View = View(
        cython.address(frame.right[0, 0]),
        cython.address(frame.left[0, 0]),
        cython.address(frame.right_slope[0, 0]),
        cython.address(frame.left_slope[0, 0]),
        cython.address(frame.where[0, 0]),
        cython.address(frame.proposed[0, 0]),
        cython.address(frame.weight[0, 0]),
        frame.right.shape[0],
        frame.right.shape[1],
        count,
        strip_bytes,
    )
    costs: Penalties = Penalties(
        cython.cast(cython.int, penalties[0]),
        cython.cast(cython.int, penalties[1]),
        cython.cast(cython.int, penalties[2]),
        cython.cast(cython.int, penalties[3]),
        cython.cast(cython.int, penalties[4]),
        cython.cast(cython.int, penalties[5]),
        penalties[6],
        penalties[7],
    )
    tiles: Tiles = Tiles(cython.address(sets[0, 0]), tile_rows, tile_width, chunk)
    size: cython.Py_ssize_t = workspace_bytes(view, tiles)
    if work.memory.shape[0] < size:
        work.memory = np.empty(size, np.uint8)
    rivals: cython.p_float = cython.NULL
    if rival.shape[0] > 0:
        rivals = cython.address(rival[0, 0])
    with cython.nogil:
        semi_global_vectors(
            view,
            costs,
            tiles,
            cython.address(work.memory[0]),
            cython.address(disparity[0, 0]),
            cython.address(margin[0, 0]),
            rivals,
        )


def smooth(
    view: cython.const[cython.uchar][:, ::1], work: Workspace, result: cython.uchar[:, ::1]
) -> None:
    """Do what :func:`motionstereo_cli.compiled.bilateral.smooth` does."""
    width: cython.int = cython.cast(cython.int, view.shape[1])
    size: cython.Py_ssize_t = smooth_bytes(width)
    if work.memory.shape[0] < size:
        work.memory = np.empty(size, np.uint8)
    with cython.nogil:
        smooth_vectors(
            cython.address(view[0, 0]),
            cython.cast(cython.int, view.shape[0]),
            width,
            cython.address(work.memory[0]),
            cython.address(result[0, 0]),
        )


def fill_sets(
    candidates: cython.const[cython.float][:, :, ::1],
    per_px: cython.float,
    reach: cython.float,
    cell: cython.int,
    rows: cython.int,
    width: cython.int,
    around: cython.int,
    count: cython.int,
    chunk: cython.int,
    cells: cython.ulonglong[:, ::1],
    sets: cython.ulonglong[:, ::1],
) -> None:
    """Fill in the chunks that may hold the disparities of each tile, from a small image.

    A tile gets the chunks within reach of any candidate in it or around it. Without any, it gets
    those of the nearest tiles on its left and right, else all.

    Args:
        candidates: disparities in the small image, (n, rows, width) float32, NaN = none.
        per_px: px of the image in a px of the small one.
        reach: how far candidates may be off, px of the image.
        cell: rows and px of the small image whose candidates are taken together.
        rows, width: cells that a tile takes.
        around: cells around a tile whose candidates it gets, too.
        count: number of disparities, at most :data:`MAX_COUNT`.
        chunk: disparities in a chunk.
        cells: gets the chunks of each cell, and is of that size.
        sets: gets the result, (tiles down, tiles across) uint64.
    """
    i: cython.Py_ssize_t
    y: cython.Py_ssize_t
    x: cython.Py_ssize_t
    row: cython.Py_ssize_t
    column: cython.Py_ssize_t
    one: cython.ulonglong = 1
    last: cython.int = count - 1
    every: cython.ulonglong = (one << (last // chunk) << 1) - 1
    across: cython.Py_ssize_t = sets.shape[1]
    with cython.nogil:
        cells[:, :] = 0
        for i in range(candidates.shape[0]):
            for y in range(candidates.shape[1]):
                for x in range(candidates.shape[2]):
                    place: cython.float = candidates[i, y, x] * per_px
                    if place == place:  # noqa: PLR0124
                        low: cython.int = cython.cast(cython.int, max(place - reach, 0))
                        high: cython.int = cython.cast(cython.int, place + reach)
                        low, high = min(low, last) // chunk, min(high, last) // chunk
                        cells[y // cell, x // cell] |= (one << high << 1) - (one << low)
        for y in range(sets.shape[0]):
            for x in range(across):
                sets[y, x] = 0
                for row in range(
                    max(y * rows - around, 0), min((y + 1) * rows + around, cells.shape[0])
                ):
                    for column in range(
                        max(x * width - around, 0), min((x + 1) * width + around, cells.shape[1])
                    ):
                        sets[y, x] |= cells[row, column]
            fill_gaps(sets[y], every)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def fill_gaps(sets: cython.ulonglong[::1], every: cython.ulonglong) -> cython.void:
    """Fill in the empty sets of a row by the nearest ones to the left and right, else all."""
    x: cython.Py_ssize_t
    across: cython.Py_ssize_t = sets.shape[0]
    before: cython.ulonglong = 0
    x = 0
    while x < across:
        if sets[x]:
            before = sets[x]
            x += 1
            continue
        end: cython.Py_ssize_t = x
        while end < across and not sets[end]:
            end += 1
        beside: cython.ulonglong = before | (sets[end] if end < across else 0)
        while x < end:
            sets[x] = beside if beside else every
            x += 1
