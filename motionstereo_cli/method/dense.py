"""The dense matcher: semi-global matching of the current views, with trails as proposals.

After Hirschmueller, "Stereo Processing by Semiglobal Matching and Mutual Information" (2008), with
four paths (from the left, the right, above and below). A cost is the difference of grey,
insensitive to sampling (Birchfield and Tomasi, "A Pixel Dissimilarity Measure That Is Insensitive
to Image Sampling", 1998), and that of its slope.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import bilateral, checked_array, checked_number, reused, slopes
from motionstereo_cli.compiled import dense as loops

try:
    from motionstereo_cli.compiled import vectors
except ImportError:  # in plain Python, and without a compiler's vector types
    vectors = None  # type: ignore[assignment]

#: Limits of differences of grey, and of its slope in quarters of a level per px.
_MAX_GREY, _MAX_SLOPE = 20, 20

#: Larger slopes are taken for this one, in eighths of a level per px.
_LARGEST_SLOPE = 80

#: Costs are summed over 3 x 3 pixels. Penalties of a step by 1 px and by more between neighbours;
#: the latter falls by a share of the step of grey there, because objects end at steps of grey.
_STEP, _LEAP, _MIN_LEAP, _PER_GREY_LEVEL = 200, 330, 200, 3

#: Cost of all other disparities where one is proposed, in this frame or before.
_FRESH, _OLD = 15, 5

#: A trail proposes within so many px of its ends: between them its disparity is interpolated.
_END_PX = 6

#: Minimum margin of the second best disparity over the best, and as a share of the best; below it
#: the disparity is unknown.
_MIN_MARGIN, _MIN_SHARE = 80, 0.05

#: Pixels so many rows above and below, and px to the sides, of those wanted are matched as well, as
#: context.
_AROUND_ROWS, _AROUND_COLUMNS = 8, 32

#: From this range and width in px on, each tile of an image has its own set of disparities, found
#: in views of a quarter of the width, or of an eighth from the third on.
_TILED_PX, _TILED_WIDTH, _WIDE = 48, 320, 1000

#: Size of a tile, in rows of half height and in columns; the least number of disparities in a
#: chunk, of which it has a set; how far off small views may be, in px; size of their cells in px,
#: and how many cells around a tile may tell its disparities.
_TILE, _CHUNK, _REACH_PX, _CELL, _AROUND_CELLS = (16, 16), 2, 7, 2, 2

#: Margin and share where a tile has a set: fewer rivals are seen than there are.
_TILED_MARGIN, _TILED_SHARE = 90, 0.058

#: Memory for what paths from below add to the costs of a frame, in each thread.
_STRIP_BYTES = 16 << 20

#: The same for the loops.
_PENALTIES = _MAX_GREY, _MAX_SLOPE, _STEP, _LEAP, _MIN_LEAP, _PER_GREY_LEVEL
WEIGHTS = loops.Weights(  # type: ignore[call-arg]  # mypy does not know its dataclasses
    *(*_PENALTIES, _MIN_MARGIN, _MIN_SHARE)
)


def smoothed(view: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a view with less noise and sharp edges, (height, width) uint8: a bilateral filter."""
    view = checked_array(view, np.uint8)
    result = np.empty_like(view)
    if vectors is not None and vectors.CAN_SMOOTH:
        vectors.smooth(view, reused(vectors.Workspace), result)
    else:
        bilateral.smooth(view, reused(bilateral.Workspace, view.shape[1]), result)
    return result


def weights_of(
    proposed_px: NDArray[np.float32], keys: NDArray[np.uint16], fresh: NDArray[np.bool_]
) -> NDArray[np.int16]:
    """Return the costs of all disparities other than the proposed ones, 0 = none proposed.

    Args:
        proposed_px: disparities of trails, (rows, width) float32, NaN = none.
        keys: match keys, equal within a trail, (rows, width) uint16.
        fresh: where they are of this frame, (rows, width) bool.
    """
    keys = checked_array(keys, np.uint16)
    weights = np.empty(keys.shape, np.int16)
    loops.weigh(
        checked_array(proposed_px, np.float32, keys.shape),
        keys,
        checked_array(fresh, np.bool_, keys.shape).view(np.uint8),
        *(_END_PX, _FRESH, _OLD),
        *(np.zeros(keys.shape[1] + 2 * _END_PX, np.uint8), np.empty(keys.shape[1], np.uint8)),
        weights,
    )
    return weights


def match_dense(
    right: NDArray[np.uint8],
    left: NDArray[np.uint8],
    where: NDArray[np.bool_],
    proposed_px: NDArray[np.float32],
    weights: NDArray[np.int16],
    max_disparity: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return disparity and its margin, (rows, width) float32 each, NaN = unknown.

    Some pixels around those wanted have one as well. The margin is the cost of the second best
    disparity minus that of the best.

    Args:
        right, left: views of equal brightness and of half the rows, (rows, width) uint8.
        where: right pixels wanted, (rows, width) bool.
        proposed_px: preferred disparities where grey does not decide, (rows, width) float32.
        weights: of these, see :func:`weights_of`, (rows, width).
        max_disparity: largest x in the left view minus x in the right one, px.
    """
    sets = _sets(right, left, where, max_disparity)
    disparity, margin = semi_global(
        right,
        left,
        slopes_of(right),
        slopes_of(left),
        _around(where),
        proposed_px,
        weights,
        max_disparity,
        sets=sets,
        margins=(_MIN_MARGIN, _MIN_SHARE) if sets is None else (_TILED_MARGIN, _TILED_SHARE),
    )
    return disparity, margin


def slopes_of(grey: NDArray[np.uint8]) -> NDArray[np.int8]:
    """Return slopes of grey, which do not depend on a difference in brightness of the views."""
    grey = checked_array(grey, np.uint8)
    result = np.empty(grey.shape, np.int8)
    slopes.fill_slopes(grey, _LARGEST_SLOPE, reused(slopes.Workspace, grey.shape[1]), result)
    return result


def _around(where: NDArray[np.bool_]) -> NDArray[np.bool_]:
    size = 2 * _AROUND_COLUMNS + 1, 2 * _AROUND_ROWS + 1
    box = cv2.getStructuringElement(cv2.MORPH_RECT, size)
    return np.asarray(cv2.dilate(where.view(np.uint8), box), np.uint8).view(np.bool_)


def _sets(
    right: NDArray[np.uint8], left: NDArray[np.uint8], where: NDArray[np.bool_], max_disparity: int
) -> NDArray[np.uint64] | None:
    """Return which disparities to look at in each tile, None = all, by matching small views.

    Args:
        right, left: views of half the height, (rows, width) uint8.
        where: right pixels wanted, (rows, width) bool.
        max_disparity: px.
    """
    rows, width = right.shape
    scale = 4 if width < _WIDE else 8
    small = width // scale, 2 * rows // scale
    reach = -(-max_disparity // scale)
    if vectors is None or max_disparity < _TILED_PX or width < max(_TILED_WIDTH, 2 * max_disparity):
        return None
    small_right, small_left, small_where = (
        np.asarray(cv2.resize(view, small, interpolation=cv2.INTER_AREA), np.uint8)
        for view in (right, left, 255 * where.view(np.uint8))
    )
    nothing = np.zeros(small_right.shape, np.int16)
    found = semi_global(
        *(small_right, small_left, slopes_of(small_right), slopes_of(small_left), small_where > 0),
        *(nothing.astype(np.float32), nothing, reach),
        margins=(0, 0),
        with_rivals=True,
    )
    tiles = -(-rows // _TILE[0]), -(-width // _TILE[1])
    sets = np.zeros(tiles, np.uint64)
    cells = np.zeros([-(-side // _CELL) for side in small_right.shape], np.uint64)
    tile = 2 * _TILE[0] // (scale * _CELL), _TILE[1] // (scale * _CELL)
    count = max_disparity + 1
    vectors.fill_sets(
        *(np.ascontiguousarray(found[::2]), scale, _REACH_PX, _CELL, *tile, _AROUND_CELLS),
        *(count, _chunk(count), cells, sets),
    )
    return sets


def _chunk(count: int) -> int:
    """Return how many disparities a chunk has, of so many in all."""
    return max(_CHUNK, -(-count // vectors.MAX_CHUNKS))


def semi_global(
    right: NDArray[np.uint8],
    left: NDArray[np.uint8],
    right_slope: NDArray[np.int8],
    left_slope: NDArray[np.int8],
    where: NDArray[np.bool_],
    proposed_px: NDArray[np.float32],
    weight: NDArray[np.int16],
    max_disparity: int,
    *,
    sets: NDArray[np.uint64] | None = None,
    margins: tuple[float, float] = (_MIN_MARGIN, _MIN_SHARE),
    with_rivals: bool = False,
    with_vectors: bool = vectors is not None,
    strip_bytes: int = _STRIP_BYTES,
) -> NDArray[np.float32]:
    """Return disparity and margin, (2, rows, width) float32, NaN = unknown.

    Args:
        right, left, right_slope, left_slope: grey and its slope in both views, (rows, width).
        where: right pixels to match, (rows, width) bool.
        proposed_px: preferred disparities, (rows, width) float32.
        weight: cost of all others, 0 where none is proposed, (rows, width).
        max_disparity: px.
        sets: chunks of disparities to look at in each tile of 16 x 16 pixels, a bit for each,
            (tiles down, tiles across) uint64; None = all.
        margins: minimum margin of the second best disparity, and as a share of the best; below it
            the disparity is unknown.
        with_rivals: return a third image: the second best disparity where it costs hardly more.
        with_vectors: use vectors of the processor if the range allows it; the plain loops have
            neither sets nor rivals, take longer, and give the same bytes.
        strip_bytes: memory for the vectors.
    """
    right = checked_array(right, np.uint8)
    shape = right.shape
    count = 1 + checked_number("max_disparity", max_disparity, 0)
    left = checked_array(left, np.uint8, shape)
    right_slope, left_slope = (
        checked_array(each, np.int8, shape) for each in (right_slope, left_slope)
    )
    wanted = checked_array(where, np.bool_, shape).view(np.uint8)
    proposed_px = checked_array(proposed_px, np.float32, shape)
    weight = checked_array(weight, np.int16, shape)
    found = np.empty((2 + with_rivals, *shape), np.float32)
    if with_vectors and count <= vectors.MAX_COUNT:
        tile, chunk = _TILE, _chunk(count)
        if sets is None:
            tile, sets = shape, np.full((1, 1), (1 << -(-count // chunk)) - 1, np.uint64)
        frame = vectors.Frame(  # type: ignore[call-arg]
            *(right, left, right_slope, left_slope, wanted, proposed_px, weight)
        )
        vectors.semi_global(
            *(frame, count, np.array((*_PENALTIES, *margins), np.float32), sets, *tile, chunk),
            strip_bytes,
            *(reused(vectors.Workspace), found[0], found[1], found[-1][: shape[0] * with_rivals]),
        )
    else:
        slow = loops.Frame(  # type: ignore[call-arg]
            *(each.astype(np.int16) for each in (right, left, right_slope, left_slope)),
            *(wanted, proposed_px, weight),
        )
        loops.semi_global(slow, WEIGHTS, reused(loops.Workspace, *shape, count), *found)
    return found
