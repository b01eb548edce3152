"""What moved by itself: the loops of :mod:`motionstereo_cli.robot.movers`."""

import sys

import cython
import numpy as np
from cython.cimports.libc.math import fabs, isfinite

from motionstereo_cli.compiled import patches

if not cython.compiled:  # what is imported below is a plain module then
    sys.modules["cython.cimports.motionstereo_cli.compiled.patches"] = patches

from cython.cimports.motionstereo_cli.compiled.patches import (
    Block,
    FrameLevel,
    centre_patch,
    compare_cells,
    compare_patch,
    take_cell,
    take_patch,
)

NAN = cython.declare(cython.float, np.nan)
#: Minimum depth of points before the camera.
MIN_DEPTH = cython.declare(cython.float, 0.05)
#: Height and width of cells, and how far a patch reaches from the middle of its cell, in px.
CELL_PX = cython.declare(cython.int, 4)
REACH_PX = cython.declare(cython.int, 4)
#: Of what an alignment tells: shift along x and y and change of disparity in px; how sure; by how
#: much disparity then misses that change; share of the squared differences that is left.
FIELDS = 6
#: An alignment that after so many steps has more than this share of what differed is given up.
PATIENCE = cython.declare(cython.int, 3)
HOPELESS = cython.declare(cython.double, 0.8)


@cython.cclass
@cython.dataclasses.dataclass
class CameraLevel:
    """The camera of a pyramid level.

    Attributes:
        focal_x, focal_y, cx, cy: in px.
        other_cx: that of the other camera in px.
        side: 1 where the other camera is at the left, -1 where it is at the right.
        focal_baseline: depth in m times nearness in px.
        doffs: nearness less disparity in px.
    """

    focal_x: cython.double
    focal_y: cython.double
    cx: cython.double
    cy: cython.double
    other_cx: cython.double
    side: cython.int
    focal_baseline: cython.double
    doffs: cython.double


@cython.cclass
@cython.dataclasses.dataclass
class Limits:
    """What counts as a difference; see :mod:`motionstereo_cli.robot.movers`."""

    noise: cython.double
    per_slope: cython.double
    unexplained: cython.double
    jump_px: cython.double
    jump_share: cython.double
    sigma_px: cython.double
    sigma_share: cython.double
    max_shift: cython.double
    hidden_px: cython.double
    hidden_share: cython.double


@cython.cclass
class Workspace:
    """Pixels and equations: used again and again."""

    block: Block
    normal: cython.double[:, ::1]
    inverse: cython.double[:, ::1]  # of the same, damped
    right: cython.double[::1]  # the right side
    # Of the patch: place and nearness then; their errors by one of 1 px now; now less then.
    middle: cython.double[::1]
    shift: cython.double[::1]
    trial: cython.double[::1]
    none: cython.double[::1]

    def __init__(self):
        self.block = Block()
        self.normal, self.inverse = np.zeros((2, 3, 3))
        self.right, self.shift, self.trial, self.none = np.zeros((4, 3))
        self.middle = np.zeros(9)


@cython.cfunc
def set_up(
    block: Block, camera: CameraLevel, motion: cython.const[cython.double][:, ::1], limits: Limits
) -> cython.void:
    """Fill in what a block has to know of the camera and its motion."""
    numbers = [limits.jump_px, limits.jump_share, camera.doffs, camera.side]
    numbers += [1 / camera.focal_baseline, 1 / camera.focal_x, 1 / camera.focal_y]
    numbers += [camera.focal_x, camera.focal_y, camera.cx, camera.cy]
    numbers += [camera.other_cx - camera.cx, *np.asarray(motion)[:3].ravel(), MIN_DEPTH]
    block.numbers = np.array(numbers, np.float32)


@cython.locals(row=cython.int, column=cython.int, cell=cython.int)
def find(
    now: FrameLevel,
    then: FrameLevel,
    camera: CameraLevel,
    motion: cython.const[cython.double][:, ::1],
    limits: Limits,
    max_parallax: cython.double,
    work: Workspace,
    result: cython.uchar[:, ::1],
) -> None:
    """Mark the cells whose grey the rig's own motion does not explain.

    Args:
        now, then, camera: two frames of a camera, at one level.
        motion: (4, 4) takes places in the camera of now to those in the earlier one.
        limits: what counts.
        max_parallax: only where what stands moved at most so far in the image, px, but for turns.
        work: for the pixels of cells.
        result: (rows, columns) receives 1 for such cells, 0 for others and where that is unknown.
    """
    sums: cython.float[::1] = work.block.values
    noise: cython.double = 2 * limits.noise * limits.noise
    columns: cython.int = cython.cast(cython.int, result.shape[1])
    set_up(work.block, camera, motion, limits)
    with cython.nogil:
        for row in range(cython.cast(cython.int, result.shape[0])):
            for column in range(0, columns, 8):
                some: cython.bint = False
                y: cython.int = row * CELL_PX
                for cell in range(8):
                    x: cython.int = (column + cell) * CELL_PX
                    middle: cython.float = cython.cast(cython.float, NAN)
                    if column + cell < columns:
                        result[row, column + cell] = 0
                        middle = now.disparity[(y + CELL_PX // 2) * now.width + x + CELL_PX // 2]
                    near: cython.double = middle + camera.doffs
                    if near > 0 and parallax(camera, motion, x, y, near) <= max_parallax:
                        some = True
                    else:
                        middle = cython.cast(cython.float, NAN)
                    take_cell(work.block, cell, x, y, middle)
                if not some:
                    continue
                compare_cells(now, then, work.block)
                for cell in range(min(8, columns - column)):
                    # Rows of sums are 64 apart.
                    count: cython.double = sums[17 * 64 + cell]
                    expected: cython.double = (
                        count * noise + limits.per_slope * sums[18 * 64 + cell]
                    )
                    off: cython.bint = sums[16 * 64 + cell] > limits.unexplained * expected
                    result[row, column + cell] = off and 4 * count >= CELL_PX * CELL_PX


@cython.locals(row=cython.int, column=cython.int, k=cython.int)
def align(
    now: FrameLevel,
    then: FrameLevel,
    camera: CameraLevel,
    motion: cython.const[cython.double][:, ::1],
    limits: Limits,
    wanted: cython.const[cython.uchar][:, ::1],
    coarse: cython.const[cython.float][:, :, ::1],
    promise: cython.float,
    work: Workspace,
    result: cython.float[:, :, ::1],
) -> None:
    """Fill in how cells moved in both views beyond what the rig's own motion explains.

    Gauss and Newton over three unknowns, a shift along x and y and a change of disparity, from
    what was found at the next coarser level, from none, and from what neighbours did.

    Args:
        now, then, camera, motion, limits: as :func:`find` has them.
        wanted: cells that are asked for, (rows, columns), 0 or 1.
        coarse: the result at the next coarser level, of no rows = there is none.
        promise: only cells are aligned with something around them that moved by so many squared
            standard deviations; 0 = all.
        work: for the pixels of a patch.
        result: (rows, columns, :data:`FIELDS`) receives it, NaN where unknown.
    """
    side: cython.int = 2 * REACH_PX + 1
    set_up(work.block, camera, motion, limits)
    with cython.nogil:
        for row in range(cython.cast(cython.int, result.shape[0])):
            for column in range(cython.cast(cython.int, result.shape[1])):
                for k in range(cython.cast(cython.int, result.shape[2])):
                    result[row, column, k] = NAN
                x: cython.int = column * CELL_PX + CELL_PX // 2
                y: cython.int = row * CELL_PX + CELL_PX // 2
                inside: cython.bint = REACH_PX <= x < now.width - REACH_PX
                inside = inside and REACH_PX <= y < now.height - REACH_PX
                if not (inside and wanted[row, column]):
                    continue
                if promise > 0 and not promising(coarse, result, row, column, promise):
                    continue
                middle: cython.float = now.disparity[y * now.width + x]
                if not middle + camera.doffs > 0:
                    continue
                count: cython.float = take_patch(now, work.block, x, y, middle)
                if 6 * count >= side * side and look_up(
                    then, camera, motion, limits, x, y, middle, work
                ):
                    align_patch(
                        then, camera, limits, middle, count, row, column, coarse, work, result
                    )


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(i=cython.Py_ssize_t, k=cython.Py_ssize_t)
def promising(
    coarse: cython.const[cython.float][:, :, ::1],
    result: cython.const[cython.float][:, :, ::1],
    row: cython.Py_ssize_t,
    column: cython.Py_ssize_t,
    promise: cython.float,
) -> cython.bint:
    """Return whether something moved around a cell, at the coarser level or at this one so far."""
    for i in range(max(row - 1, 0) // 2, min((row + 1) // 2 + 1, coarse.shape[0])):
        for k in range(max(column - 1, 0) // 2, min((column + 1) // 2 + 1, coarse.shape[1])):
            if coarse[i, k, 3] > promise and coarse[i, k, 5] < HOPELESS:
                return True
    if column and result[row, column - 1, 3] > promise:
        return True
    if row:
        for k in range(max(column - 1, 0), min(column + 2, result.shape[1])):
            if result[row - 1, k, 3] > promise:
                return True
    return False


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def parallax(
    camera: CameraLevel,
    motion: cython.const[cython.double][:, ::1],
    x: cython.int,
    y: cython.int,
    near: cython.double,
) -> cython.double:
    """Return how far what stands moved in the image, in px, because the camera changed place."""
    axis: cython.int
    result: cython.double = 0
    across: cython.double = (x - camera.cx) / camera.focal_x
    down: cython.double = (y - camera.cy) / camera.focal_y
    inverse: cython.double = near / camera.focal_baseline
    far: cython.double = max(along(motion, 2, across, down, 0), MIN_DEPTH)
    z: cython.double = max(along(motion, 2, across, down, inverse), MIN_DEPTH)
    for axis in range(2):
        there: cython.double = along(motion, axis, across, down, 0) / far
        result = max(result, fabs(along(motion, axis, across, down, inverse) / z - there))
    return camera.focal_x * result


@cython.cfunc
@cython.nogil
@cython.inline
@cython.exceptval(check=False)
def along(
    motion: cython.const[cython.double][:, ::1],
    axis: cython.int,
    across: cython.double,
    down: cython.double,
    inverse: cython.double,
) -> cython.double:
    """Return a coordinate of a place after a motion, over its depth before."""
    turned: cython.double = motion[axis, 0] * across + motion[axis, 1] * down + motion[axis, 2]
    return turned + motion[axis, 3] * inverse


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def look_up(
    then: FrameLevel,
    camera: CameraLevel,
    motion: cython.const[cython.double][:, ::1],
    limits: Limits,
    x: cython.int,
    y: cython.int,
    disparity: cython.double,
    work: Workspace,
) -> cython.bint:
    """Fill in where the middle of a patch was if it stands; False where it was hidden."""
    near: cython.double = disparity + camera.doffs
    inverse: cython.double = near / camera.focal_baseline
    across: cython.double = (x - camera.cx) / camera.focal_x
    down: cython.double = (y - camera.cy) / camera.focal_y
    z: cython.double = along(motion, 2, across, down, inverse)
    if z < MIN_DEPTH:
        return False
    right: cython.double = along(motion, 0, across, down, inverse) / z
    below: cython.double = along(motion, 1, across, down, inverse) / z
    u: cython.double = camera.cx + camera.focal_x * right
    v: cython.double = camera.cy + camera.focal_y * below
    per_px: cython.double = 1 / (camera.focal_baseline * z)
    work.middle[0] = u
    work.middle[1] = v
    work.middle[2] = near / z
    work.middle[3] = camera.focal_x * (motion[0, 3] - right * motion[2, 3]) * per_px
    work.middle[4] = camera.focal_y * (motion[1, 3] - below * motion[2, 3]) * per_px
    work.middle[5] = 1 / z - near * motion[2, 3] * per_px / z - 1
    work.middle[6] = x - u
    work.middle[7] = y - v
    work.middle[8] = near - near / z
    before: cython.double = disparity_at(then, u, v) + camera.doffs
    return not before > near / z + max(limits.hidden_px, limits.hidden_share * near / z)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def disparity_at(then: FrameLevel, u: cython.double, v: cython.double) -> cython.double:
    """Return the disparity at a place, NaN outside of the view."""
    if not (u >= 0 and v >= 0 and u < then.width - 1 and v < then.height - 1):
        return NAN
    row: cython.int = cython.cast(cython.int, v + 0.5)
    return then.disparity[row * then.width + cython.cast(cython.int, u + 0.5)]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(k=cython.int, trial=cython.int)
def align_patch(
    then: FrameLevel,
    camera: CameraLevel,
    limits: Limits,
    disparity: cython.double,
    count: cython.float,
    row: cython.int,
    column: cython.int,
    coarse: cython.const[cython.float][:, :, ::1],
    work: Workspace,
    result: cython.float[:, :, ::1],
) -> cython.void:
    """Fill in how a patch moved."""
    equations(camera, count, work)
    first: cython.double = misfit(then, camera, count, work.none, work)
    slopes: cython.double = work.normal[0, 0] + work.normal[1, 1]
    expected: cython.double = 2 * count * limits.noise * limits.noise + limits.per_slope * slopes
    if first < limits.unexplained * expected:
        return
    least: cython.double = first
    upper: cython.int = cython.cast(cython.int, min(row // 2, coarse.shape[0] - 1))
    aside: cython.int = cython.cast(cython.int, min(column // 2, coarse.shape[1] - 1))
    for trial in range(5 if upper < 0 else 4):
        for k in range(3):
            work.trial[k] = 0
            if trial == 0 and upper >= 0:
                work.trial[k] = 2 * coarse[upper, aside, k]
            elif trial == 4:  # it keeps its place in the image, as what a camera follows
                work.trial[k] = work.middle[6 + k]
            elif trial >= 2:  # the one before it, and the one above
                work.trial[k] = result[max(row + 2 - trial, 0), max(column - 3 + trial, 0), k]
        if not (isfinite(work.trial[0]) and converged(then, camera, limits, count, first, work)):
            continue
        left: cython.double = misfit(then, camera, count, work.trial, work)
        if left < least:
            least = left
            for k in range(3):
                work.shift[k] = work.trial[k]
        if least < 0.2 * first:
            break
    if not least < first:
        return
    for k in range(3):
        result[row, column, k] = cython.cast(cython.float, work.shift[k])
    sure: cython.double = sureness(limits, disparity + camera.doffs, least, count, work)
    result[row, column, 3] = cython.cast(cython.float, sure)
    u: cython.double = work.middle[0] + work.shift[0]
    off: cython.double = disparity_at(then, u, work.middle[1] + work.shift[1])
    off -= work.middle[2] - camera.doffs + work.shift[2]
    result[row, column, 4] = cython.cast(cython.float, off)
    result[row, column, 5] = cython.cast(cython.float, least / first)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(i=cython.int, k=cython.int, steps=cython.int)
def converged(
    then: FrameLevel,
    camera: CameraLevel,
    limits: Limits,
    count: cython.float,
    first: cython.double,
    work: Workspace,
) -> cython.bint:
    """Improve the trial until it converges, or return False; ``first`` is the misfit of none."""
    rest: cython.double = 0
    for steps in range(8):
        left: cython.double = misfit(then, camera, count, work.trial, work)
        if steps >= PATIENCE and left > HOPELESS * first:
            return False
        rest = 0
        for k in range(3):
            step: cython.double = 0
            for i in range(3):
                step += work.inverse[k, i] * work.right[i]
            work.trial[k] += step
            rest += fabs(step)
            if not fabs(work.trial[k]) < limits.max_shift:
                return False
        if rest < 0.03:
            break
    return rest < 0.1


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(i=cython.int, k=cython.int)
def sureness(
    limits: Limits, near: cython.double, left: cython.double, count: cython.float, work: Workspace
) -> cython.double:
    """Return the squared shift in standard deviations, of which disparity's error is a part."""
    variance: cython.double = 2 * limits.noise * limits.noise + left / (2 * count)
    sigma: cython.double = limits.sigma_px + limits.sigma_share * near
    all: cython.double = 0
    mixed: cython.double = 0
    own: cython.double = 1 / (sigma * sigma)
    for i in range(3):
        # A standing patch whose disparity is wrong seems to move along this line.
        line: cython.double = work.middle[3 + i]
        for k in range(3):
            information: cython.double = work.normal[i, k] / variance
            all += work.shift[i] * information * work.shift[k]
            mixed += line * information * work.shift[k]
            own += line * information * work.middle[3 + k]
    return all - mixed * mixed / own


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(side=cython.int)
def misfit(
    then: FrameLevel,
    camera: CameraLevel,
    count: cython.float,
    moved: cython.const[cython.double][::1],
    work: Workspace,
) -> cython.double:
    """Return the sum of squared differences of grey after a shift, a brighter view apart.

    Fills in the right side of the equations, for slopes that are centred.
    """
    sums: cython.double[::1] = work.block.sums
    all: cython.double = 0
    work.right[:] = 0
    for side in range(2):
        by_disparity: cython.double = camera.side * side
        right: cython.double = moved[0] + by_disparity * moved[2]
        compare_patch(then, work.block, side, count, right, moved[1])
        all += sums[0]
        work.right[0] -= sums[1]
        work.right[1] -= sums[2]
        work.right[2] -= by_disparity * sums[1]
    return all


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(side=cython.int, i=cython.int, k=cython.int)
def equations(camera: CameraLevel, count: cython.float, work: Workspace) -> cython.void:
    """Centre the slopes, and fill in the equations and the inverse of them damped."""
    sums: cython.double[::1] = work.block.sums
    a: cython.double[:, ::1] = work.normal
    a[:, :] = 0
    for side in range(2):
        by_disparity: cython.double = camera.side * side
        centre_patch(work.block, side, count)
        a[0, 0] += sums[3]
        a[0, 1] += sums[4]
        a[1, 1] += sums[5]
        a[0, 2] += by_disparity * sums[3]
        a[1, 2] += by_disparity * sums[4]
        a[2, 2] += by_disparity * by_disparity * sums[3]
    a[1, 0] = a[0, 1]
    a[2, 0] = a[0, 2]
    a[2, 1] = a[1, 2]
    # The inverse, damped by 4, by cofactors.
    b: cython.double[:, ::1] = work.inverse
    p: cython.double = a[0, 0] + 4
    q: cython.double = a[1, 1] + 4
    r: cython.double = a[2, 2] + 4
    b[0, 0] = q * r - a[1, 2] * a[1, 2]
    b[0, 1] = a[0, 2] * a[1, 2] - a[0, 1] * r
    b[0, 2] = a[0, 1] * a[1, 2] - a[0, 2] * q
    b[1, 1] = p * r - a[0, 2] * a[0, 2]
    b[1, 2] = a[0, 1] * a[0, 2] - p * a[1, 2]
    b[2, 2] = p * q - a[0, 1] * a[0, 1]
    determinant: cython.double = p * b[0, 0] + a[0, 1] * b[0, 1] + a[0, 2] * b[0, 2]
    for i in range(3):
        for k in range(i, 3):
            b[i, k] /= determinant
            b[k, i] = b[i, k]
