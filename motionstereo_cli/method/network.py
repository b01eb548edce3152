"""Inputs of stereo networks: padded, scaled or in tiles; and checks of their disparity."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Grey = NDArray[np.uint8]
Real = NDArray[np.float32]

#: Takes a left and a right image, (height, width) uint8, and returns the disparity of the left
#: view in px, (height, width) float32.
Network = Callable[[Grey, Grey], Real]

#: Rows by which tiles overlap: convolutions see no further near their borders.
_OVERLAP_PX = 32
#: Two passes agree where they differ by this at most, in px.
_AGREE_PX = np.float32(1)


def padded(network: Network, multiple: int) -> Network:
    """Return a network of which height and width of the images are a multiple of a number."""

    def run(left: Grey, right: Grey) -> Real:
        height, width = left.shape
        below, beside = -height % multiple, -width % multiple
        edges = (0, below, 0, beside, cv2.BORDER_REPLICATE)
        views = (np.asarray(cv2.copyMakeBorder(view, *edges), np.uint8) for view in (left, right))
        return network(*views)[:height, :width]

    return run


def scaled(network: Network, height: int, width: int) -> Network:
    """Return a network that takes images of a fixed size, to which all are scaled."""

    def run(left: Grey, right: Grey) -> Real:
        shape, size = left.shape, (width, height)
        how = cv2.INTER_AREA if shape[1] >= width else cv2.INTER_LINEAR
        views = (
            np.asarray(cv2.resize(view, size, interpolation=how), np.uint8)
            for view in (left, right)
        )
        found = np.asarray(
            cv2.resize(network(*views), shape[::-1], interpolation=cv2.INTER_NEAREST), np.float32
        )
        return found * np.float32(shape[1] / width)

    return run


def tiled(network: Network, height: int, width: int, max_disparity: int) -> Network:
    """Return a network that takes images of a fixed size, in tiles of which all are composed.

    Where a tile is not at the left border, the partners of its first ``max_disparity`` columns lie
    outside of it: they are taken from the tile before.

    Raises:
        ValueError: the range leaves nothing of a tile.
    """
    if max_disparity + _OVERLAP_PX >= width or height <= _OVERLAP_PX:
        raise ValueError(
            f"tiles of {width}x{height} px are too small for a range of {max_disparity} px"
        )

    def run(left: Grey, right: Grey) -> Real:
        rows, columns = left.shape
        below, beside = max(height - rows, 0), max(width - columns, 0)
        edges = (0, below, 0, beside, cv2.BORDER_REPLICATE)
        views = [np.asarray(cv2.copyMakeBorder(view, *edges), np.uint8) for view in (left, right)]
        result = np.empty(views[0].shape, np.float32)
        for y in _starts(views[0].shape[0], height, _OVERLAP_PX):
            for x in _starts(views[0].shape[1], width, max_disparity + _OVERLAP_PX):
                tile = network(*(view[y : y + height, x : x + width] for view in views))
                top = _OVERLAP_PX // 2 if y else 0
                first = max_disparity + _OVERLAP_PX // 2 if x else 0
                result[y + top : y + height, x + first : x + width] = tile[top:, first:]
        return result[:rows, :columns]

    return run


def _starts(length: int, size: int, overlap: int) -> Iterator[int]:
    """Yield where tiles of a size begin that cover a length, the last at its end."""
    yield from range(0, length - size, size - overlap)
    yield length - size


def in_right_view(network: Network, left: Grey, right: Grey) -> Real:
    """Return the disparity of the right view, (height, width) float32.

    In a mirror, the right view is the left one.
    """
    flipped = (np.ascontiguousarray(view[:, ::-1]) for view in (right, left))
    return np.ascontiguousarray(network(*flipped)[:, ::-1])


def of_right_view(network: Callable[[Any, Any], Real]) -> Network:
    """Return a network of the left view, from one that gives the disparity of the right view."""
    return lambda left, right: in_right_view(network, left, right)


def agreed(right_px: Real, left_px: Real) -> tuple[Real, Real]:
    """Return the disparity of the right view where both views agree, and a confidence.

    The confidence falls from 1, where they are equal, to 0.5 at 1 px; it is not fitted to truth.
    Both (height, width) float32, NaN = unknown.

    Args:
        right_px, left_px: disparity of each view, (height, width) float32, NaN = unknown.
    """
    width = right_px.shape[1]
    column = np.arange(width, dtype=np.float32) + right_px
    inside = (column >= 0) & (column <= width - 1)  # NaN is not
    at = np.where(inside, np.rint(column), 0).astype(np.intp)
    apart = np.abs(np.take_along_axis(left_px, at, axis=1) - right_px)
    agree = inside & (apart <= _AGREE_PX)
    unknown = np.float32(np.nan)
    return np.where(agree, right_px, unknown), np.where(agree, 1 - apart / 2, unknown)
