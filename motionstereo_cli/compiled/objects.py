"""Cells and boxes of regions: the loops of :mod:`motionstereo_cli.robot.objects`."""

import cython
import numpy as np
from cython.cimports.libc.math import isfinite

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


def take_larger(
    values: cython.const[cython.ushort][:, ::1], largest: cython.ushort[:, ::1]
) -> None:
    """Put values in place of smaller ones, pixel by pixel."""
    y: cython.Py_ssize_t
    with cython.nogil:
        for y in range(values.shape[0]):
            larger_row(values[y], largest[y])


def hidden_before(
    disparity: cython.const[cython.float][:, ::1],
    fresh: cython.const[cython.uchar][:, ::1],
    before: cython.const[cython.ushort][:, ::1],
    per_px: cython.float,
    doffs_px: cython.float,
    hidden_px: cython.float,
    hidden_share: cython.float,
    result: cython.uchar[:, ::1],
) -> None:
    """Mark fresh pixels before which something nearer was.

    Args:
        disparity: px, (height, width), NaN = unknown.
        fresh: where something has just moved, (height, width), 0 or 1.
        before: the largest disparity of the last frames, in parts of a px, 0 = unknown.
        per_px: parts of a px.
        doffs_px: nearness less disparity.
        hidden_px, hidden_share: it was nearer by more than the larger of these.
        result: gets 0 or 1.
    """
    y: cython.Py_ssize_t
    with cython.nogil:
        for y in range(disparity.shape[0]):
            hidden_row(
                disparity[y],
                fresh[y],
                before[y],
                per_px,
                doffs_px,
                hidden_px,
                hidden_share,
                result[y],
            )


# Compilers vectorise loops over arrays that are arguments of a separate function.


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def larger_row(
    values: cython.const[cython.ushort][::1], largest: cython.ushort[::1]
) -> cython.void:
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
    before: cython.const[cython.ushort][::1],
    per_px: cython.float,
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
        result[x] = fresh[x] & (before[x] / per_px - disparity[x] > limit)


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


def compare_beside(
    labels: cython.const[cython.int][:, ::1],
    cells: cython.const[cython.float][:, ::1],
    gap: cython.int,
    reach: cython.int,
    jump_px: cython.double,
    jump_share: cython.double,
    min_near: cython.double,
    work: cython.double[:, ::1],
    result: cython.int[:, ::1],
) -> None:
    """Count the rows of each region that are nearer than what is known beside them, or alike.

    What is beside a row is the nearest known cell of another region or of none, at both ends; a
    slanted surface lies between these.

    Args:
        labels: region of each cell, (rows, columns) int32, 0..n - 1; 0 = none.
        cells: nearness in px, (rows, columns) float32, NaN = unknown.
        gap: so many cells beside the end of a row may be of either.
        reach: the farthest that is looked at, in cells from the end of a row.
        jump_px, jump_share: nearness differs by more than the larger of these, or is alike.
        min_near: nearness in px below which alike says nothing.
        work: (n, 4), used again and again.
        result: (n, 2) int32 gets the rows that are nearer, and those that are alike.
    """
    row: cython.int
    column: cython.int
    label: cython.int
    columns: cython.int = cython.cast(cython.int, labels.shape[1])
    with cython.nogil:
        result[:, :] = 0
        for row in range(cython.cast(cython.int, labels.shape[0])):
            work[:, :] = 0
            for column in range(columns):
                label = labels[row, column]
                if label:
                    if not work[label, 0]:
                        work[label, 2] = column
                    work[label, 0] += 1
                    work[label, 1] += cells[row, column]
                    work[label, 3] = column
            for label in range(1, cython.cast(cython.int, result.shape[0])):
                if not work[label, 0]:
                    continue
                first: cython.int = cython.cast(cython.int, work[label, 2])
                last: cython.int = cython.cast(cython.int, work[label, 3])
                left: cython.int = first - gap - 1
                while (
                    left >= 0
                    and first - left <= reach
                    and not is_other(labels, cells, row, left, label)
                ):
                    left -= 1
                right: cython.int = last + gap + 1
                while (
                    right < columns
                    and right - last <= reach
                    and not is_other(labels, cells, row, right, label)
                ):
                    right += 1
                has_left: cython.bint = left >= 0 and first - left <= reach
                has_right: cython.bint = right < columns and right - last <= reach
                if not (has_left or has_right):
                    continue
                there: cython.double = cells[row, left if has_left else right]
                if has_left and has_right:
                    share: cython.double = (0.5 * (first + last) - left) / (right - left)
                    there += share * (cells[row, right] - there)
                here: cython.double = work[label, 1] / work[label, 0]
                limit: cython.double = max(jump_px, jump_share * here)
                if here - there > limit:
                    result[label, 0] += 1
                elif there - here <= limit and here >= min_near:
                    result[label, 1] += 1


@cython.cfunc
@cython.nogil
@cython.inline
@cython.exceptval(check=False)
def is_other(
    labels: cython.const[cython.int][:, ::1],
    cells: cython.const[cython.float][:, ::1],
    row: cython.int,
    column: cython.int,
    label: cython.int,
) -> cython.bint:
    """Return whether a cell is known, and not of a region."""
    return labels[row, column] != label and isfinite(cells[row, column])
