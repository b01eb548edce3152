"""Semi-global matching in vectors: what :mod:`motionstereo_cli.compiled.dense` does, faster.

The same results to the bit. The C source beside this file, ``semi_global.h``, is made of the vector
types of GCC and clang; where the compiler is another one, and in plain Python, there is no such
module.
"""

import cython
import numpy as np
from cython.cimports.motionstereo_cli.compiled.semi_global import (
    Penalties,
    Tiles,
    View,
    semi_global_vectors,
    workspace_bytes,
)

#: Disparities of a chunk, and the most that there may be.
CHUNK = 16
MAX_COUNT = 64 * CHUNK


@cython.cclass
class Workspace:
    """What the matching of a frame needs besides input and output, used again for the next one."""

    memory: cython.uchar[::1]

    def __init__(self):
        self.memory = np.empty(1, np.uint8)


@cython.cclass
@cython.dataclasses.dataclass(eq=False)
class Frame:
    """What is matched: two views, and what is known before. All are (rows, width).

    Attributes:
        right, left: grey.
        right_slope, left_slope: its slope.
        where: pixels to match, 0 or 1.
        proposed: preferred disparities in px.
        weight: what speaks against all others, 0 where none is preferred.
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
    strip_bytes: cython.Py_ssize_t,
    work: Workspace,
    disparity: cython.float[:, ::1],
    margin: cython.float[:, ::1],
) -> None:
    """Fill in disparity and margin, (rows, width) float32, NaN = unknown.

    Args:
        frame: what is matched.
        count: number of disparities, at most :data:`MAX_COUNT`.
        penalties: the fields of :class:`~motionstereo_cli.compiled.dense.Weights`, in order.
        sets: which chunks of 16 disparities are looked at in each tile, a bit for each, at least
            one, (tiles down, tiles across) uint64.
        tile_rows, tile_width: size of a tile, px.
        strip_bytes: what the costs of a strip of rows and those of its paths may take together:
            an image of several strips takes half as long again.
        work: used again for the next frame.
        disparity, margin: get the result.
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
    tiles: Tiles = Tiles(cython.address(sets[0, 0]), tile_rows, tile_width)
    size: cython.Py_ssize_t = workspace_bytes(view, tiles)
    if work.memory.shape[0] < size:
        work.memory = np.empty(size, np.uint8)
    with cython.nogil:
        semi_global_vectors(
            view,
            costs,
            tiles,
            cython.address(work.memory[0]),
            cython.address(disparity[0, 0]),
            cython.address(margin[0, 0]),
        )
