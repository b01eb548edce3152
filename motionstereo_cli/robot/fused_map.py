"""The fused map in the world frame: a grid of the floor plane and a cloud of voxels.

Both grow with the area that was seen, not with time. Cells of the grid hold *evidence* in whole
steps: positive = occupied, negative = free, 0 = unknown. Unlike the local map
nothing fades: what was seen once stays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.robot.grid import window

Cells = NDArray[np.int64]

#: Evidence of one frame, and its limit.
_HIT = 2
_MISS = -1
_MOST = 30
#: Evidence from which a cell is occupied or free; number of frames that have to see a voxel.
OCCUPIED = 6
FREE = -2
MIN_FRAMES = 3

#: The grid grows by this many cells at a time.
_GROWTH = 64
#: Bits of each of the three numbers of a voxel in its key.
_BITS = 21


@dataclass(frozen=True, slots=True)
class Grid:
    """The grid of the floor plane.

    Attributes:
        evidence: (nx, ny) int8, axis 0 along the world's x, axis 1 along its y.
        corner: world cell of ``evidence[0, 0]``; world cell i spans i..i+1 times the cell's size.
    """

    evidence: NDArray[np.int8]
    corner: tuple[int, int]

    @classmethod
    def empty(cls) -> Grid:
        """Return a grid without cells."""
        return cls(np.zeros((0, 0), np.int8), (0, 0))


def marked(
    known: Grid, corner: tuple[int, int], free: NDArray[np.bool_], hit: NDArray[np.bool_]
) -> Grid:
    """Return the grid a frame later, grown as far as necessary.

    Args:
        known: the grid.
        corner: world cell of ``free[0, 0]`` and ``hit[0, 0]``.
        free: cells that a frame saw through, (mx, my) bool.
        hit: cells in which it saw something, (mx, my) bool.
    """
    change = np.where(hit, _HIT, np.where(free, _MISS, 0)).astype(np.int8)
    at = np.argwhere(change)
    if not len(at):
        return known
    low, high = at.min(axis=0), at.max(axis=0) + 1
    change = change[low[0] : high[0], low[1] : high[1]]
    low += corner
    grown = _grown(known, low, low + change.shape)
    i, j = low - grown.corner
    part = grown.evidence[i : i + change.shape[0], j : j + change.shape[1]]
    part[:] = np.clip(part + change, -_MOST, _MOST)  # far from the limits of int8
    return grown


def _grown(known: Grid, low: Cells, high: Cells) -> Grid:
    """Return a copy of the grid that reaches at least from ``low`` to before ``high``, (2,)."""
    first, end = low // _GROWTH * _GROWTH, -(-high // _GROWTH) * _GROWTH
    if known.evidence.size:
        first = np.minimum(first, known.corner)
        end = np.maximum(end, np.add(known.corner, known.evidence.shape))
    evidence = window(known.evidence, known.corner, first, end - first)
    return Grid(evidence, (int(first[0]), int(first[1])))


def trimmed(known: Grid) -> Grid:
    """Return the part of the grid that holds all evidence; one cell where there is none."""
    at = np.argwhere(known.evidence)
    if not len(at):
        return Grid(np.zeros((1, 1), np.int8), known.corner)
    low, high = at.min(axis=0) + known.corner, at.max(axis=0) + 1 + known.corner
    part = window(known.evidence, known.corner, low, high - low)
    return Grid(part, (int(low[0]), int(low[1])))


@dataclass(frozen=True, slots=True)
class Voxels:
    """The cloud.

    Attributes:
        origin: world voxel that the keys count from.
        key: (n,) int64, which voxel it is; sorted, each once.
        frames: (n,) int32, how many frames saw something in it.
        total: (n, 4 or 6) float32, sum over these frames of the means of x, y, z within the voxel
            (0..1) and of grey, or red, green and blue (0..255).
    """

    origin: tuple[int, int, int]
    key: NDArray[np.int64]
    frames: NDArray[np.int32]
    total: NDArray[np.float32]

    @classmethod
    def empty(cls, origin: tuple[int, int, int]) -> Voxels:
        """Return a cloud without voxels."""
        return cls(
            origin, np.zeros(0, np.int64), np.zeros(0, np.int32), np.zeros((0, 4), np.float32)
        )


def voxels_of(
    points: NDArray[np.float64], look: NDArray[np.uint8], origin: tuple[int, int, int]
) -> Voxels:
    """Return the cloud of one frame; points over a million voxels from the origin are left out.

    Args:
        points: what the frame saw, in voxels along the world's axes, (n, 3) float64.
        look: its grey levels, (n,) uint8, or colours, (n, 3) uint8.
        origin: world voxel that the keys count from.
    """
    cell = np.floor(points)
    index = cell.astype(np.int64) - origin + (1 << _BITS - 1)
    inside = ((index >= 0) & (index < 1 << _BITS)).all(axis=1)
    values = np.column_stack([points - cell, look])[inside]
    i, j, k = index[inside].T
    key, which, count = np.unique(
        (i << 2 * _BITS) | (j << _BITS) | k, return_inverse=True, return_counts=True
    )
    means = [np.bincount(which, column, len(key)) / count for column in values.T]
    return Voxels(
        origin, key, np.ones(len(key), np.int32), np.stack(means, axis=1).astype(np.float32)
    )


def merged(one: Voxels, other: Voxels) -> Voxels:
    """Return both clouds, which have one origin, as one."""
    if not (len(one.key) and len(other.key)):  # an empty cloud does not know of colours
        return other if len(other.key) else one
    at = np.searchsorted(one.key, other.key)
    both = np.append(one.key, -1)[at] == other.key
    frames, total = one.frames.copy(), one.total.copy()
    frames[at[both]] += other.frames[both]
    total[at[both]] += other.total[both]
    at, new = at[~both], ~both
    return Voxels(
        one.origin,
        np.insert(one.key, at, other.key[new]),
        np.insert(frames, at, other.frames[new]),
        np.insert(total, at, other.total[new], axis=0),
    )


def seen_often(known: Voxels) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return the mean place and the mean look of what lies in each voxel.

    Voxels that fewer than MIN_FRAMES frames saw are left out.

    Returns:
        (n, 3) float64, in voxels along the world's axes; (n,) uint8 grey or (n, 3) uint8 RGB.
    """
    often = known.frames >= MIN_FRAMES
    key = known.key[often]
    index = np.stack([key >> 2 * _BITS, key >> _BITS, key], axis=1) & ((1 << _BITS) - 1)
    mean = known.total[often] / known.frames[often, None]
    places: NDArray[np.float64] = index - (1 << _BITS - 1) + known.origin + mean[:, :3]
    look = mean[:, 3] if mean.shape[1] == 4 else mean[:, 3:]
    return places, np.rint(look).astype(np.uint8)


def known_free(known: Grid, places: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which places lie in free cells of the grid, (n,) bool.

    Args:
        known: the grid.
        places: in cells along the world's x and y, (n, 2) float64.
    """
    index = np.floor(places).astype(np.int64) - known.corner
    inside = ((index >= 0) & (index < known.evidence.shape)).all(axis=1)
    free = np.zeros(len(places), np.bool_)
    free[inside] = known.evidence[tuple(index[inside].T)] <= FREE
    return free
