"""Matching at half the height or size, and disparity of all pixels from it.

Half the height takes half the time and is no worse, because noise averages out. Row j of the halves
is the mean of rows 2 j and 2 j + 1.
"""

from __future__ import annotations

from typing import Any, TypeVar, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import checked_array, reused
from motionstereo_cli.compiled import rows as loops

#: Rows that make one.
ROWS = 2

#: Half rows whose disparities differ by less than this in px are interpolated; if they differ by
#: more, a pixel takes the one that is closer in grey by so many levels.
_TOLERANCE_PX, _NEARER = 1.5, 2.0

_Image = TypeVar("_Image", bound=NDArray[Any])


def halved(view: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the means of pairs of rows; the last of an odd number of rows is kept."""
    view = checked_array(view, np.uint8)
    result = np.empty((-(-len(view) // ROWS), view.shape[1]), np.uint8)
    loops.halve(view, result)
    return result


def halved_exactly(view: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the same in float32, not rounded."""
    view = checked_array(view, np.uint8)
    result = np.empty((-(-len(view) // ROWS), view.shape[1]), np.float32)
    loops.halve_exactly(view, result)
    return result


def halved_mask(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return where one of the two rows is set, (ceil(height / 2), width) bool."""
    upper, lower = mask[::2], mask[1::2]
    return np.concatenate((upper[: len(lower)] | lower, upper[len(lower) :]))


def in_pairs(image: _Image) -> _Image:
    """Return an image of an even number of rows: the last of an odd number comes twice."""
    return image if len(image) % 2 == 0 else cast("_Image", np.concatenate((image, image[-1:])))


def reduced(view: _Image, columns: int = 2) -> _Image:
    """Return the means of squares of 2 x 2 pixels, (height // 2, width // 2).

    Args:
        view: (height, width) uint8 or float32.
        columns: 1 = of two pixels, one above the other.
    """
    rows, width = len(view) // 2, view.shape[1] // columns
    used = view[: 2 * rows, : columns * width]
    return cast("_Image", cv2.resize(used, (width, rows), interpolation=cv2.INTER_AREA))


def every_second(image: _Image) -> _Image:
    """Return the first pixel of each square of 2 x 2, (height // 2, width // 2)."""
    rows, width = (side // 2 for side in image.shape)
    return cast("_Image", np.ascontiguousarray(image[: 2 * rows : 2, : 2 * width : 2]))


def enlarged(image: _Image, shape: tuple[int, ...]) -> _Image:
    """Return an image of which each pixel was repeated, (height, width), at the border once more.

    Args:
        image: of halves of that size, or of halves of halves, uint8 or float32.
        shape: height and width.
    """
    rows, width = (round(whole / part) for whole, part in zip(shape, image.shape, strict=True))
    size = width * image.shape[1], rows * image.shape[0]
    result = cv2.resize(image, size, interpolation=cv2.INTER_NEAREST)[: shape[0], : shape[1]]
    missing = shape[0] - result.shape[0], shape[1] - result.shape[1]
    if any(missing):
        result = cv2.copyMakeBorder(result, 0, missing[0], 0, missing[1], cv2.BORDER_REPLICATE)
    return cast("_Image", result)


def whole(
    disparity_px: NDArray[np.float32],
    half_grey: NDArray[np.float32],
    grey: NDArray[np.uint8],
    steep: float = 1,
) -> NDArray[np.float32]:
    """Return the disparity of all rows, (height, width) float32, NaN = unknown.

    The upper row of a pair is a quarter of a half row above their middle. If the half row above
    has nearly the same disparity, both are interpolated; else grey decides between them, so that
    borders of objects and of holes follow the image. The lower row is treated likewise.

    Args:
        disparity_px: (ceil(height / 2), width) float32, NaN = unknown.
        half_grey: grey of the same rows, float32.
        grey: (height, width) uint8.
        steep: half rows may differ so many times as much.
    """
    grey = checked_array(grey, np.uint8)
    half = (grey.shape[0] + 1) // ROWS, grey.shape[1]
    result = np.empty(grey.shape, np.float32)
    loops.whole(
        checked_array(disparity_px, np.float32, half),
        checked_array(half_grey, np.float32, half),
        *(grey, steep * _TOLERANCE_PX, _NEARER, result),
    )
    return result


def without_fringes(
    disparity_px: NDArray[np.float32], where: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Return disparity where one can be, and most of the pixels around that can have one do.

    Those around are in a window of 5 x 5.

    Args:
        disparity_px: (height, width) float32, NaN = unknown.
        where: pixels that could, (height, width) bool.
    """
    disparity_px = checked_array(disparity_px, np.float32)
    where = checked_array(where, np.bool_, disparity_px.shape)
    result = np.empty_like(disparity_px)
    work = reused(loops.Workspace, disparity_px.shape[1])
    loops.drop_fringes(disparity_px, where.view(np.uint8), work, result)
    return result
