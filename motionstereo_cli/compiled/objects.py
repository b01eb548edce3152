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
    share: cython.float[:, ::1],
    mean: cython.float[:, ::1],
) -> None:
    """Fill in the known share of each cell and its mean nearness, NaN = unknown or mixed.

    Args:
        nearness: disparity + doffs in px, (height, width) float32, NaN = unknown.
        fresh: where something has just moved, (height, width), 0 or 1.
        cell_px: height and width of a cell.
        min_share: known share, 0..1, of a cell that is known.
        jump_px, jump_share: largest standard deviation in a cell, px or share of its nearness.
        share, mean: (rows, columns) of cells, float32.
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
                mean[row, column] = NAN
                if share[row, column] >= min_share:
                    middle: cython.double = total / count
                    jump: cython.double = max(jump_px, jump_share * middle)
                    if squares / count - middle * middle <= jump * jump:
                        mean[row, column] = middle


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
