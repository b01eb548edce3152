"""Regions that hold several objects, separated by where these are expected.

Things that overlap in the image at nearly the same depth are one connected region. If they were
followed before they met, each is expected in a box and at a nearness, and takes its cells.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float32]
#: Middle x and y, width and height in cells, and nearness in px of an object.
Box = NDArray[np.float64]
#: Column and row of the first cell of a region, and its cells: known share, nearness in px and
#: whatever else is measured, (2 or more, height, width), NaN = not in it.
Place = tuple[int, int, Reals]

#: A region holds an object if so much of where it is expected is at its nearness, up to the larger
#: of these.
_HELD_SHARE = 0.2
_OFF_PX, _OFF_SHARE = 0.6, 0.08
#: Two objects whose expected boxes overlap by more (intersection over union) are one.
_SAME = 0.6
#: A cell outside of all boxes goes to the nearest, in cells; a nearness that is off by this share
#: counts as one cell.
_CELL_SHARE = 0.04
#: To which of two objects a cell belongs is sure if these differ by so much.
_SURE = 1.0
#: A part has at least this share of the cells that are expected.
_LEAST_SHARE = 0.1


def parts(regions: Sequence[Place], expected: Box) -> list[list[Place]]:
    """Return the parts of each region, several where it holds several objects.

    Args:
        regions: the regions of a frame.
        expected: the objects that were followed lately, (objects, 5).
    """
    held: dict[int, list[int]] = {}
    for index, box in enumerate(expected):
        shares = [_held_share(region, box) for region in regions]
        best = max(range(len(shares)), key=shares.__getitem__, default=0)
        if shares and shares[best] >= _HELD_SHARE:
            held.setdefault(best, []).append(index)
    result = []
    for number, region in enumerate(regions):
        boxes = _different(expected[held.get(number, [])])
        apart = _separated(region, boxes) if len(boxes) > 1 else []
        result.append(apart if len(apart) > 1 else [region])
    return result


def _edges(box: Box) -> tuple[float, float, float, float]:
    x, y, width, height = box[:4].tolist()
    return x - width / 2, y - height / 2, x + width / 2, y + height / 2


def _held_share(region: Place, box: Box) -> float:
    """Return how much of an expected box a region fills at the expected nearness, 0..1."""
    left, top, cells = region
    x, y, x_end, y_end = (round(edge) for edge in _edges(box))
    columns = slice(max(x - left, 0), max(x_end - left, 0))
    rows = slice(max(y - top, 0), max(y_end - top, 0))
    _, height, width = cells.shape
    if columns.start >= min(columns.stop, width) or rows.start >= min(rows.stop, height):
        return 0.0
    near = np.abs(cells[1, rows, columns] - box[4]) <= max(_OFF_PX, _OFF_SHARE * box[4])
    return float(np.count_nonzero(near) / max(box[2] * box[3], 1))


def _different(boxes: Box) -> Box:
    """Return expected boxes without those that are nearly the same as an earlier one."""
    kept: list[Box] = []
    for box in boxes:
        if all(_overlap(box, other) <= _SAME for other in kept):
            kept.append(box)
    return np.array(kept)


def _overlap(a: Box, b: Box) -> float:
    one, two = _edges(a), _edges(b)
    across = min(one[2], two[2]) - max(one[0], two[0])
    down = min(one[3], two[3]) - max(one[1], two[1])
    both = max(across, 0.0) * max(down, 0.0)
    return float(both / (a[2] * a[3] + b[2] * b[3] - both))


def _separated(region: Place, boxes: Box) -> list[Place]:
    """Return the parts of a region that belong to some expected boxes."""
    left, top, cells = region
    row, column = np.nonzero(~np.isnan(cells[1]))
    x, y, width, height, near_px = boxes.T[..., None]
    across = np.abs(left + column + 0.5 - x) - width / 2
    outside = np.maximum(np.maximum(across, np.abs(top + row + 0.5 - y) - height / 2), 0)
    inside = outside == 0
    # What lies in some boxes belongs to one of these, by its nearness.
    cost = outside + np.abs(cells[1, row, column] - near_px) / (_CELL_SHARE * near_px)
    cost[~inside & inside.any(axis=0)] = np.inf
    owner, ordered = np.argmin(cost, axis=0), np.sort(cost, axis=0)
    unsure = (inside.sum(axis=0) > 1) & (ordered[1] < ordered[0] + _SURE)
    # Where that is unsure, all that lies in the same boxes belongs to what is in front.
    boxes_of = (1 << np.arange(len(boxes))) @ inside
    for each in np.unique(boxes_of[unsure]).tolist():
        here = boxes_of == each
        owner[here & unsure] = np.argmin(np.median(cost[:, here], axis=1))
    result = []
    for index, box in enumerate(boxes):
        rows, columns = row[owner == index], column[owner == index]
        if len(rows) < max(_LEAST_SHARE * box[2] * box[3], 1):
            continue
        first_row, first = int(rows.min()), int(columns.min())
        part = np.full((len(cells), np.ptp(rows) + 1, np.ptp(columns) + 1), np.nan, np.float32)
        part[:, rows - first_row, columns - first] = cells[:, rows, columns]
        result.append((left + first, top + first_row, part))
    return result
