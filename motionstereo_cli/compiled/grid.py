"""What a camera sees of a grid, and ways on it: the loops of :mod:`.robot.grid`, course, route."""

import cython
import numpy as np
from cython.cimports.libc.math import sqrt

HALF = cython.declare(cython.float, 0.5)
INFINITY = cython.declare(cython.float, np.inf)
#: One over the length of a diagonal; a way is easier if it costs less by this much.
DIAGONAL = cython.declare(cython.float, 0.70710678)
EASIER = cython.declare(cython.float, 1e-3)


@cython.cclass
@cython.dataclasses.dataclass
class FloorCamera:
    """A camera on a floor plane, its images, and what it is trusted with.

    Attributes:
        cos, sin: of its heading.
        cx_px, focal_px: principal point and focal length along x.
        focal_baseline: depth in m times nearness in px.
        width: of its images in px.
        cell_m: size of a cell.
        reach_m: farther points are not marked.
        error_px: error of a disparity that an occupied place allows for.
        free_px: the same for a free one.
        error_m: an occupied place is as near its depth.
    """

    cos: cython.float
    sin: cython.float
    cx_px: cython.float
    focal_px: cython.float
    focal_baseline: cython.float
    width: cython.float
    cell_m: cython.float
    reach_m: cython.float
    error_px: cython.float
    free_px: cython.float
    error_m: cython.float


def sight(
    x_m: cython.const[cython.float][::1],
    y_m: cython.const[cython.float][::1],
    camera: FloorCamera,
    near: cython.const[cython.float][::1],
    solid: cython.const[cython.uchar][::1],
    far: cython.const[cython.float][::1],
    place: cython.float[::1],
    free: cython.uchar[:, ::1],
    hit: cython.uchar[:, ::1],
    bearing: cython.Py_ssize_t[:, ::1],
    ahead: cython.float[:, ::1],
) -> None:
    """Fill in what a camera sees of a grid.

    Args:
        x_m, y_m: places of the cells along both axes, from the camera.
        camera: the camera.
        near: nearness in each bearing in px, NaN = unknown.
        solid: where a surface is, by bearing.
        far: up to where its upper side is seen, by bearing; 0 = none.
        place: for a row of cells.
        free, hit, bearing, ahead: as :class:`~motionstereo_cli.robot.grid.Sight` has them.
    """
    row: cython.Py_ssize_t
    column: cython.Py_ssize_t
    bearings: cython.float = cython.cast(cython.float, near.shape[0])
    with cython.nogil:
        for row in range(x_m.shape[0]):
            look_along(x_m[row], y_m, camera, bearings, ahead[row], place)
            for column in range(y_m.shape[0]):
                free[row, column] = 0
                hit[row, column] = 0
                bearing[row, column] = 0
                off: cython.float = ahead[row, column]
                if not (off > camera.cell_m and place[column] >= 0 and place[column] < bearings):
                    continue
                b: cython.Py_ssize_t = cython.cast(cython.Py_ssize_t, place[column])
                bearing[row, column] = b
                depth: cython.float = camera.focal_baseline / near[b]
                free[row, column] = off < camera.focal_baseline / (near[b] + camera.free_px)
                is_there: cython.bint = (
                    abs(camera.focal_baseline / off - near[b]) < camera.error_px
                ) | (abs(off - depth) < camera.error_m)
                is_there = is_there & (depth < camera.reach_m) & (solid[b] != 0)
                hit[row, column] = is_there | ((off > depth) & (off < far[b]))


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def look_along(
    x: cython.float,
    y_m: cython.const[cython.float][::1],
    camera: FloorCamera,
    bearings: cython.float,
    ahead: cython.float[::1],
    place: cython.float[::1],
) -> cython.void:
    """Fill in how far ahead a row of cells lies, and in which bearing."""
    column: cython.Py_ssize_t
    cos: cython.float = camera.cos
    sin: cython.float = camera.sin
    cx: cython.float = camera.cx_px
    focal: cython.float = camera.focal_px
    width: cython.float = camera.width
    for column in range(ahead.shape[0]):
        y: cython.float = y_m[column]
        off: cython.float = cos * x + sin * y
        left: cython.float = cos * y - sin * x
        ahead[column] = off
        place[column] = (cx - focal * left / off + HALF) * bearings / width


def free_ways(
    to_occupied: cython.const[cython.float][:, ::1],
    to_unknown: cython.const[cython.float][:, ::1],
    x: cython.double,
    y: cython.double,
    cos: cython.const[cython.double][::1],
    sin: cython.const[cython.double][::1],
    steps_m: cython.const[cython.double][::1],
    cell_m: cython.double,
    wanted_m: cython.const[cython.double][::1],
    known_m: cython.const[cython.double][::1],
    known: cython.int[::1],
    possible: cython.int[::1],
) -> None:
    """Fill in for how many steps the way is known to be free, and without a known obstacle.

    Args:
        to_occupied, to_unknown: distance of cells from those, m.
        x, y: the robot's place in cells.
        cos, sin: of each direction.
        steps_m: distances of the steps.
        cell_m: size of a cell.
        wanted_m, known_m: least distance from what is occupied and unknown, by step.
        known, possible: get the result, by direction.
    """
    n: cython.Py_ssize_t
    step: cython.Py_ssize_t
    with cython.nogil:
        for n in range(cos.shape[0]):
            known[n] = 0
            possible[n] = 0
            for step in range(steps_m.shape[0]):
                row: cython.int = cython.cast(cython.int, x + cos[n] * steps_m[step] / cell_m)
                column: cython.int = cython.cast(cython.int, y + sin[n] * steps_m[step] / cell_m)
                inside: cython.bint = 0 <= row < to_occupied.shape[0]
                inside = inside and 0 <= column < to_occupied.shape[1]
                if not (inside and to_occupied[row, column] >= wanted_m[step]):
                    break
                possible[n] += 1
                if known[n] == step and to_unknown[row, column] >= known_m[step]:
                    known[n] += 1


def ways_to(
    cost: cython.const[cython.float][:, ::1], to: cython.float[:, ::1], rounds: cython.int
) -> None:
    """Lower what the way from each cell costs, by the ways through its neighbours.

    The eikonal equation, by fast sweeping (Zhao 2005): in rounds of four sweeps, one from each
    corner, until nothing changes.

    Args:
        cost: of a way through each cell, (nx, ny).
        to: what is known at first, infinity where nothing is; gets the result. (nx, ny).
        rounds: the most.
    """
    sweep: cython.int
    i: cython.Py_ssize_t
    k: cython.Py_ssize_t
    row: cython.Py_ssize_t
    column: cython.Py_ssize_t
    rows: cython.Py_ssize_t = to.shape[0]
    columns: cython.Py_ssize_t = to.shape[1]
    with cython.nogil:
        for _ in range(rounds):
            changed: cython.bint = False
            for sweep in range(4):
                for i in range(rows):
                    row = i if sweep & 1 == 0 else rows - 1 - i
                    for k in range(columns):
                        column = k if sweep & 2 == 0 else columns - 1 - k
                        low: cython.float = through(cost[row, column], to, row, column)
                        if low < to[row, column] - EASIER:
                            to[row, column] = low
                            changed = True
            if not changed:
                break


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def through(
    cost: cython.float, to: cython.float[:, ::1], row: cython.Py_ssize_t, column: cython.Py_ssize_t
) -> cython.float:
    """Return what the way from a cell costs that leads through its neighbours."""
    rows: cython.Py_ssize_t = to.shape[0]
    columns: cython.Py_ssize_t = to.shape[1]
    a: cython.float = INFINITY
    b: cython.float = INFINITY
    if row > 0:
        a = to[row - 1, column]
    if row < rows - 1 and to[row + 1, column] < a:
        a = to[row + 1, column]
    if column > 0:
        b = to[row, column - 1]
    if column < columns - 1 and to[row, column + 1] < b:
        b = to[row, column + 1]
    if a > b:
        a, b = b, a
    if a + cost <= b or a == INFINITY:
        return a + cost
    return (a + b + cython.cast(cython.float, sqrt(2 * cost * cost - (b - a) * (b - a)))) / 2


def downhill(
    to: cython.const[cython.float][:, ::1],
    row: cython.Py_ssize_t,
    column: cython.Py_ssize_t,
    path: cython.int[:, ::1],
) -> cython.Py_ssize_t:
    """Fill in the cells of the way from a cell, each the best neighbour of the one before.

    Args:
        to: what the way from each cell costs.
        row, column: the cell.
        path: gets the cells after it, (n, 2).

    Returns:
        The number of cells; the way ends where no neighbour is better.
    """
    n: cython.Py_ssize_t
    i: cython.Py_ssize_t
    k: cython.Py_ssize_t
    for n in range(path.shape[0]):
        steepest: cython.float = 0
        best_row: cython.Py_ssize_t = row
        best_column: cython.Py_ssize_t = column
        for i in range(max(row - 1, 0), min(row + 2, to.shape[0])):
            for k in range(max(column - 1, 0), min(column + 2, to.shape[1])):
                fall: cython.float = to[row, column] - to[i, k]
                if i != row and k != column:
                    fall *= DIAGONAL
                if fall > steepest:
                    steepest, best_row, best_column = fall, i, k
        if steepest == 0:
            return n
        row, column = best_row, best_column
        path[n, 0] = cython.cast(cython.int, row)
        path[n, 1] = cython.cast(cython.int, column)
    return path.shape[0]
