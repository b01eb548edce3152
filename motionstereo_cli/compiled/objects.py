"""Cells and boxes of regions: the loops of :mod:`motionstereo_cli.robot.objects`."""

import cython
import numpy as np

NAN = cython.declare(cython.float, np.nan)


def in_cells(
    nearness: cython.const[cython.float][:, ::1],
    fresh: cython.const[cython.uchar][:, ::1],
    cell_px: cython.int,
    min_share: cython.float,
    jump_px: cython.double,
    jump_share: cython.double,
    wanted: cython.const[cython.uchar][:, ::1],
    share: cython.float[:, ::1],
    mean: cython.float[:, ::1],
) -> None:
    """Fill in the known share of wanted cells and their mean nearness, NaN = unknown or mixed.

    Args:
        nearness: disparity + doffs in px, (height, width) float32, NaN = unknown.
        fresh: where something has just moved, (height, width), 0 or 1.
        cell_px: height and width of a cell.
        min_share: known share, 0..1, of a cell that is known.
        jump_px, jump_share: largest standard deviation in a cell, px or share of its nearness.
        wanted: cells that are asked for, (rows, columns), 0 or 1.
        share, mean: (rows, columns) float32; 0 and NaN for other cells.
    """
    x: cython.int
    y: cython.int
    row: cython.int
    column: cython.int
    height: cython.int = cython.cast(cython.int, nearness.shape[0])
    width: cython.int = cython.cast(cython.int, nearness.shape[1])
    with cython.nogil:
        for row in range(cython.cast(cython.int, share.shape[0])):
            for column in range(cython.cast(cython.int, share.shape[1])):
                share[row, column] = 0
                mean[row, column] = NAN
                if not wanted[row, column]:
                    continue
                count: cython.int = 0
                total: cython.double = 0
                squares: cython.double = 0
                for y in range(row * cell_px, min((row + 1) * cell_px, height)):
                    for x in range(column * cell_px, min((column + 1) * cell_px, width)):
                        near: cython.float = nearness[y, x]
                        if fresh[y, x] and near > 0:
                            count += 1
                            total += near
                            squares += near * near
                share[row, column] = cython.cast(cython.double, count) / (cell_px * cell_px)
                if share[row, column] >= min_share:
                    middle: cython.double = total / count
                    jump: cython.double = max(jump_px, jump_share * middle)
                    if squares / count - middle * middle <= jump * jump:
                        mean[row, column] = middle


def take_larger(values: cython.const[cython.float][:, ::1], largest: cython.float[:, ::1]) -> None:
    """Put values in place of smaller ones, pixel by pixel; NaN are none."""
    y: cython.Py_ssize_t
    with cython.nogil:
        for y in range(values.shape[0]):
            larger_row(values[y], largest[y])


def hidden_before(
    disparity: cython.const[cython.float][:, ::1],
    fresh: cython.const[cython.uchar][:, ::1],
    before: cython.const[cython.float][:, ::1],
    doffs_px: cython.float,
    hidden_px: cython.float,
    hidden_share: cython.float,
    result: cython.uchar[:, ::1],
) -> None:
    """Mark fresh pixels before which something nearer was.

    Args:
        disparity: px, (height, width), NaN = unknown.
        fresh: where something has just moved, (height, width), 0 or 1.
        before: the largest disparity of the last frames.
        doffs_px: nearness less disparity.
        hidden_px, hidden_share: it was nearer by more than the larger of these.
        result: gets 0 or 1.
    """
    y: cython.Py_ssize_t
    with cython.nogil:
        for y in range(disparity.shape[0]):
            hidden_row(
                disparity[y], fresh[y], before[y], doffs_px, hidden_px, hidden_share, result[y]
            )


# Compilers vectorise loops over arrays that are arguments of a separate function.


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def larger_row(values: cython.const[cython.float][::1], largest: cython.float[::1]) -> cython.void:
    """Take the larger values of a row."""
    x: cython.Py_ssize_t
    for x in range(largest.shape[0]):
        largest[x] = values[x] if values[x] > largest[x] else largest[x]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def hidden_row(
    disparity: cython.const[cython.float][::1],
    fresh: cython.const[cython.uchar][::1],
    before: cython.const[cython.float][::1],
    doffs_px: cython.float,
    hidden_px: cython.float,
    hidden_share: cython.float,
    result: cython.uchar[::1],
) -> cython.void:
    """Mark the pixels of a row."""
    x: cython.Py_ssize_t
    for x in range(result.shape[0]):
        limit: cython.float = hidden_share * (disparity[x] + doffs_px)
        limit = limit if limit > hidden_px else hidden_px
        result[x] = fresh[x] & (before[x] - disparity[x] > limit)


def boxes(
    labels: cython.const[cython.int][:, ::1], size: cython.int[::1], box: cython.int[:, ::1]
) -> None:
    """Count the cells of each region and find its box.

    Args:
        labels: region of each cell, (rows, columns) int32, 0..n - 1.
        size: gets the cells of each region, (n,) int32, zeros before.
        box: gets left, top, and right and bottom of the first cell outside, (n, 4) int32.
    """
    row: cython.int
    column: cython.int
    with cython.nogil:
        box[:, 0] = cython.cast(cython.int, labels.shape[1])
        box[:, 1] = cython.cast(cython.int, labels.shape[0])
        box[:, 2:] = 0
        for row in range(cython.cast(cython.int, labels.shape[0])):
            for column in range(cython.cast(cython.int, labels.shape[1])):
                label: cython.int = labels[row, column]
                size[label] += 1
                box[label, 0] = min(box[label, 0], column)
                box[label, 1] = min(box[label, 1], row)
                box[label, 2] = max(box[label, 2], column + 1)
                box[label, 3] = max(box[label, 3], row + 1)
