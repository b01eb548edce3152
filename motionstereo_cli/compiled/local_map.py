"""What a camera sees of a grid: the loops of :mod:`motionstereo_cli.robot.local_map`."""

import cython
import numpy as np
from cython.cimports.libc.math import ceil, fabs

NAN = cython.declare(cython.float, np.nan)
HALF = cython.declare(cython.float, 0.5)


@cython.cclass
@cython.dataclasses.dataclass
class Things:
    """What counts as an obstacle, and as its upper side; see :mod:`.local_map` of the robot.

    Attributes:
        cy_px: row of the principal point.
        up_per_row: height in m times nearness in px, of a row.
        focal_baseline: depth in m times nearness in px.
        below_m, above_m: heights that are in the way, about the camera's.
        nearer_share, least: as many points, a share and a number, are as near as the nearest.
        one_share, one_px: what lies within the larger of these of it is of one thing.
        higher_share: share of its points that are above its top.
        low_m, high_m: tops between these are seen from above.
        level_m: the upper side is within this height of the top.
        cell_m, gap_m: it is looked for in steps, and ends at a wider gap.
    """

    cy_px: cython.double
    up_per_row: cython.double
    focal_baseline: cython.float
    below_m: cython.double
    above_m: cython.double
    nearer_share: cython.double
    least: cython.int
    one_share: cython.float
    one_px: cython.float
    higher_share: cython.double
    low_m: cython.float
    high_m: cython.float
    level_m: cython.double
    cell_m: cython.double
    gap_m: cython.double


@cython.cclass
class Workspace:
    """The points in each bearing.

    Args:
        bearings: their number.
        points: the most in one of them.
        cells: steps in which upper sides are looked for.
    """

    count: cython.int[::1]
    near: cython.float[:, ::1]
    up: cython.double[:, ::1]
    ranked: cython.float[::1]
    filled: cython.uchar[::1]

    def __init__(self, bearings, points, cells):
        self.count = np.zeros(bearings, np.int32)
        self.near = np.zeros((bearings, points), np.float32)
        self.up = np.zeros((bearings, points))
        self.ranked = np.zeros(points, np.float32)
        self.filled = np.zeros(cells, np.uint8)


def profile(
    nearness: cython.const[cython.float][:, :],
    fresh: cython.const[cython.uchar][:, :],
    things: Things,
    work: Workspace,
    near: cython.float[::1],
    top: cython.float[::1],
    far: cython.float[::1],
) -> None:
    """Fill in the nearest thing in each bearing.

    Args:
        nearness: disparity + doffs, (height, width), NaN = unknown.
        fresh: pixels that show the present, (height, width), 0 or 1.
        things: what counts.
        work: for so many bearings.
        near: nearness of the nearest thing, (bearings,) px, NaN = unknown.
        top: height of its top above the camera, (bearings,) m.
        far: how far ahead its upper side ends, (bearings,) m; 0 where none is seen.
    """
    b: cython.Py_ssize_t
    with cython.nogil:
        gather(nearness, fresh, things, work)
        for b in range(near.shape[0]):
            one_bearing(b, things, work, near, top, far)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def gather(
    nearness: cython.const[cython.float][:, :],
    fresh: cython.const[cython.uchar][:, :],
    things: Things,
    work: Workspace,
) -> cython.void:
    """Take the points of obstacles, by bearing."""
    x: cython.Py_ssize_t
    y: cython.Py_ssize_t
    width: cython.Py_ssize_t = nearness.shape[1]
    bearings: cython.Py_ssize_t = work.count.shape[0]
    work.count[:] = 0
    for y in range(nearness.shape[0]):
        up_px: cython.double = (things.cy_px - y) * things.up_per_row
        for x in range(width):
            near: cython.float = nearness[y, x]
            if not (fresh[y, x] and near > 0):
                continue
            up: cython.double = up_px / near
            if -things.below_m < up < things.above_m:
                b: cython.Py_ssize_t = x * bearings // width
                work.near[b, work.count[b]] = near
                work.up[b, work.count[b]] = up
                work.count[b] += 1


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def one_bearing(
    b: cython.Py_ssize_t,
    things: Things,
    work: Workspace,
    near: cython.float[::1],
    top: cython.float[::1],
    far: cython.float[::1],
) -> cython.void:
    """Fill in what is in a bearing."""
    n: cython.int
    kept: cython.int = 0
    count: cython.int = work.count[b]
    near[b] = NAN
    top[b] = NAN
    far[b] = 0
    for n in range(count):
        work.ranked[n] = work.near[b, n]
    near[b] = ranked(work.ranked, count, things.nearer_share, things.least)
    margin: cython.float = things.one_share * near[b]
    margin = margin if margin > things.one_px else things.one_px
    for n in range(count):
        if work.near[b, n] >= near[b] - margin:
            work.ranked[kept] = cython.cast(cython.float, work.up[b, n])
            kept += 1
    top[b] = ranked(work.ranked, kept, things.higher_share, 1)
    if not things.low_m < top[b] < things.high_m:
        return
    cells: cython.int = cython.cast(cython.int, work.filled.shape[0])
    cell_m: cython.float = cython.cast(cython.float, things.cell_m)
    work.filled[:] = 0
    for n in range(count):
        if fabs(work.up[b, n] - top[b]) < things.level_m:
            place: cython.float = things.focal_baseline / work.near[b, n] / cell_m
            if place < cells:
                work.filled[cython.cast(cython.int, place)] = 1
    front: cython.float = things.focal_baseline / near[b] / cell_m
    last: cython.int = cells - 1 if front > cells - 1 else cython.cast(cython.int, front)
    first: cython.int = last
    for n in range(first + 1, cells):
        if work.filled[n]:
            last = n
        if (n - last) * things.cell_m > things.gap_m:
            break
    far[b] = cell_m * cython.cast(cython.float, last + 1)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def ranked(
    values: cython.float[::1], count: cython.int, share: cython.double, least: cython.int
) -> cython.float:
    """Return the value that a share of the first values, but at least so many, are as high as.

    NaN if there are too few. The values are reordered (Hoare's selection).
    """
    k: cython.int = max(cython.cast(cython.int, ceil(share * count)), least) - 1
    if k >= count:
        return NAN
    left: cython.int = 0
    right: cython.int = count - 1
    while left < right:
        pivot: cython.float = values[(left + right) // 2]
        i: cython.int = left
        j: cython.int = right
        while i <= j:
            while values[i] > pivot:
                i += 1
            while values[j] < pivot:
                j -= 1
            if i <= j:
                swap: cython.float = values[i]
                values[i] = values[j]
                values[j] = swap
                i += 1
                j -= 1
        if k <= j:
            right = j
        elif k >= i:
            left = i
        else:
            break
    return values[k]


@cython.cclass
@cython.dataclasses.dataclass
class Camera:
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
    camera: Camera,
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
        free, hit, bearing, ahead: as :class:`~motionstereo_cli.robot.local_map.Sight` has them.
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
    camera: Camera,
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
