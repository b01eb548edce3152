"""What moved by itself: the loops of :mod:`motionstereo_cli.robot.movers`."""

import cython
import numpy as np
from cython.cimports.libc.math import fabs, isfinite

NAN = cython.declare(cython.float, np.nan)
#: Minimum depth of points before the camera.
MIN_DEPTH = cython.declare(cython.double, 0.05)
#: Of what an alignment tells: shift along x and y and change of disparity in px; how sure; by how
#: much disparity then misses that change; share of the squared differences that is left.
FIELDS = 6
#: An alignment that after so many steps has more than this share of what differed is given up.
PATIENCE = cython.declare(cython.int, 3)
HOPELESS = cython.declare(cython.double, 0.8)


@cython.cclass
@cython.dataclasses.dataclass
class Camera:
    """A camera of a rig; px are of the images that it comes with.

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
@cython.dataclasses.dataclass(eq=False)
class Moment:
    """What was seen at a moment, (height, width) each.

    Attributes:
        view, other: grey of the camera and of the other one.
        disparity: of the camera's view in px, NaN = unknown.
    """

    view: cython.const[cython.uchar][:, ::1]
    other: cython.const[cython.uchar][:, ::1]
    disparity: cython.const[cython.float][:, ::1]


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
    """The pixels of a patch, 48 at most, for both views: used again and again."""

    grey: cython.float[:, ::1]  # of now
    slope_x: cython.float[:, ::1]  # less its mean, once they are centred
    slope_y: cython.float[:, ::1]
    column: cython.float[:, ::1]  # where it was if it stands
    row: cython.float[::1]
    place: cython.int[::1]  # columns and rows of pixels then, in lanes of 48
    there: cython.float[::1]  # shares of a px beyond these, four greys, difference
    normal: cython.double[:, ::1]
    inverse: cython.double[:, ::1]  # of the same, damped
    right: cython.double[::1]  # the right side
    # Of the patch: place and nearness then; their errors by one of 1 px now; now less then.
    middle: cython.double[::1]
    shift: cython.double[::1]
    trial: cython.double[::1]
    none: cython.double[::1]

    def __init__(self, pixels):
        images = np.zeros((4, 2, pixels), np.float32)
        self.grey, self.slope_x, self.slope_y, self.column = images
        self.row = np.zeros(pixels, np.float32)
        self.place = np.zeros(2 * 48, np.int32)
        self.there = np.zeros(7 * 48, np.float32)
        self.normal, self.inverse = np.zeros((2, 3, 3))
        self.right, self.shift, self.trial, self.none = np.zeros((4, 3))
        self.middle = np.zeros(9)


@cython.locals(row=cython.int, column=cython.int, n=cython.int)
def find(
    now: Moment,
    then: Moment,
    camera: Camera,
    motion: cython.const[cython.double][:, ::1],
    limits: Limits,
    cell_px: cython.int,
    max_way: cython.double,
    work: Workspace,
    result: cython.uchar[:, ::1],
) -> None:
    """Mark the cells whose grey the rig's own motion does not explain.

    Args:
        now, then, camera: two moments of a camera.
        motion: (4, 4) takes places in the camera of now to those in the earlier one.
        limits: what counts.
        cell_px: height and width of a cell.
        max_way: only where what stands came at most so far across the image, px, turns apart.
        work: for the pixels of a cell.
        result: (rows, columns) receives 1 for such cells, 0 for others and where that is unknown.
    """
    with cython.nogil:
        for row in range(cython.cast(cython.int, result.shape[0])):
            for column in range(cython.cast(cython.int, result.shape[1])):
                result[row, column] = 0
                x: cython.int = column * cell_px
                y: cython.int = row * cell_px
                middle: cython.double = now.disparity[y + cell_px // 2, x + cell_px // 2]
                near: cython.double = middle + camera.doffs
                if not (near > 0 and way(camera, motion, x, y, near) <= max_way):
                    continue
                count: cython.int = gather(
                    now, then, camera, motion, limits, x, y, cell_px, middle, work
                )
                if 4 * count < cell_px * cell_px:
                    continue
                slopes: cython.double = 0
                for n in range(count):
                    slopes += work.slope_x[0, n] ** 2 + work.slope_y[0, n] ** 2
                off: cython.double = misfit(then, camera, count, work.none, work)
                expected: cython.double = 2 * count * limits.noise * limits.noise
                expected += limits.per_slope * slopes
                result[row, column] = off > limits.unexplained * expected


@cython.locals(row=cython.int, column=cython.int, k=cython.int)
def align(
    now: Moment,
    then: Moment,
    camera: Camera,
    motion: cython.const[cython.double][:, ::1],
    limits: Limits,
    cell_px: cython.int,
    reach: cython.int,
    wanted: cython.const[cython.uchar][:, ::1],
    coarse: cython.const[cython.float][:, :, ::1],
    work: Workspace,
    result: cython.float[:, :, ::1],
) -> None:
    """Fill in how cells moved in both views beyond what the rig's own motion explains.

    Gauss and Newton over three unknowns, a shift along x and y and a change of disparity, from
    what was found at the next coarser level, from none, and from what neighbours did.

    Args:
        now, then, camera, motion, limits: as :func:`find` has them.
        cell_px: distance of cells.
        reach: a patch reaches so many px from the middle of its cell.
        wanted: cells that are asked for, (rows, columns), 0 or 1.
        coarse: the result at the next coarser level, of no rows = there is none.
        work: for the pixels of a patch.
        result: (rows, columns, :data:`FIELDS`) receives it, NaN where unknown.
    """
    side: cython.int = 2 * reach + 1
    with cython.nogil:
        for row in range(cython.cast(cython.int, result.shape[0])):
            for column in range(cython.cast(cython.int, result.shape[1])):
                for k in range(cython.cast(cython.int, result.shape[2])):
                    result[row, column, k] = NAN
                x: cython.int = column * cell_px + cell_px // 2
                y: cython.int = row * cell_px + cell_px // 2
                inside: cython.bint = reach <= x < now.view.shape[1] - reach
                inside = inside and reach <= y < now.view.shape[0] - reach
                if not (inside and wanted[row, column]):
                    continue
                middle: cython.double = now.disparity[y, x]
                if not middle + camera.doffs > 0:
                    continue
                count: cython.int = gather(
                    now, then, camera, motion, limits, x - reach, y - reach, side, middle, work
                )
                if 6 * count >= side * side and look_up(
                    then, camera, motion, limits, x, y, middle, work
                ):
                    one(then, camera, limits, middle, count, row, column, coarse, work, result)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def way(
    camera: Camera,
    motion: cython.const[cython.double][:, ::1],
    x: cython.int,
    y: cython.int,
    near: cython.double,
) -> cython.double:
    """Return how far a standing place came across the image because the camera changed place."""
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
@cython.exceptval(check=False)
@cython.locals(x=cython.int, y=cython.int)
def gather(
    now: Moment,
    then: Moment,
    camera: Camera,
    motion: cython.const[cython.double][:, ::1],
    limits: Limits,
    left: cython.int,
    top: cython.int,
    side: cython.int,
    middle: cython.double,
    work: Workspace,
) -> cython.int:
    """Take every second pixel of a square, as on a chessboard, of one surface; return how many."""
    count: cython.int = 0
    per_px: cython.double = 1 / camera.focal_baseline
    per_focal: cython.double = 1 / camera.focal_x
    height: cython.int = cython.cast(cython.int, now.view.shape[0])
    width: cython.int = cython.cast(cython.int, now.view.shape[1])
    jump: cython.double = max(limits.jump_px, limits.jump_share * (middle + camera.doffs))
    for y in range(max(top, 1), min(top + side, height - 1)):
        down: cython.double = (y - camera.cy) / camera.focal_y
        first_x: cython.int = max(left, 1)
        for x in range(first_x + (first_x + y & 1), min(left + side, width - 1), 2):
            disparity: cython.double = now.disparity[y, x]
            if not fabs(disparity - middle) <= jump:  # nor where it is NaN
                continue
            place: cython.double = x + camera.side * disparity
            if not (place >= 2 and place < width - 3):
                continue
            near: cython.double = disparity + camera.doffs
            inverse: cython.double = near * per_px
            across: cython.double = (x - camera.cx) * per_focal
            z: cython.double = along(motion, 2, across, down, inverse)
            per_z: cython.double = 1 / z
            u: cython.double = camera.cx + camera.focal_x * per_z * along(
                motion, 0, across, down, inverse
            )
            v: cython.double = camera.cy + camera.focal_y * per_z * along(
                motion, 1, across, down, inverse
            )
            w: cython.double = u + camera.other_cx - camera.cx + camera.side * near * per_z
            before: cython.bint = z >= MIN_DEPTH and v >= 0 and v < height
            if not (before and u >= 0 and u < width and w >= 0 and w < width):
                continue
            work.grey[0, count] = now.view[y, x]
            work.slope_x[0, count] = 0.5 * (
                cython.cast(cython.float, now.view[y, x + 1]) - now.view[y, x - 1]
            )
            work.slope_y[0, count] = 0.5 * (
                cython.cast(cython.float, now.view[y + 1, x]) - now.view[y - 1, x]
            )
            first: cython.int = cython.cast(cython.int, place)
            a: cython.float = cython.cast(cython.float, place - first)
            work.grey[1, count] = between(now.other, y, first, a)
            work.slope_x[1, count] = 0.5 * (
                between(now.other, y, first + 1, a) - between(now.other, y, first - 1, a)
            )
            work.slope_y[1, count] = 0.5 * (
                between(now.other, y + 1, first, a) - between(now.other, y - 1, first, a)
            )
            work.column[0, count] = u
            work.column[1, count] = w
            work.row[count] = v
            count += 1
    return count


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
    then: Moment,
    camera: Camera,
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
def disparity_at(then: Moment, u: cython.double, v: cython.double) -> cython.double:
    """Return the disparity at a place, NaN outside of the view."""
    if not (u >= 0 and v >= 0 and u < then.view.shape[1] - 1 and v < then.view.shape[0] - 1):
        return NAN
    return then.disparity[cython.cast(cython.int, v + 0.5), cython.cast(cython.int, u + 0.5)]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(k=cython.int, trial=cython.int)
def one(
    then: Moment,
    camera: Camera,
    limits: Limits,
    disparity: cython.double,
    count: cython.int,
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
        if not (isfinite(work.trial[0]) and settled(then, camera, limits, count, first, work)):
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
def settled(
    then: Moment,
    camera: Camera,
    limits: Limits,
    count: cython.int,
    first: cython.double,
    work: Workspace,
) -> cython.bint:
    """Improve the trial until it rests, or return False; ``first`` is the misfit of none."""
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
    limits: Limits, near: cython.double, left: cython.double, count: cython.int, work: Workspace
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
@cython.locals(side=cython.int, n=cython.int)
def misfit(
    then: Moment,
    camera: Camera,
    count: cython.int,
    moved: cython.const[cython.double][::1],
    work: Workspace,
) -> cython.double:
    """Return the sum of squared differences of grey after a shift, a brighter view apart.

    Fills in the right side of the equations, for slopes that are centred.
    """
    place: cython.int[::1] = work.place
    there: cython.float[::1] = work.there
    all: cython.double = 0
    none: cython.float = 0
    down: cython.float = cython.cast(cython.float, moved[1])
    last_column: cython.float = cython.cast(cython.float, then.view.shape[1] - 1.001)
    last_row: cython.float = cython.cast(cython.float, then.view.shape[0] - 1.001)
    work.right[:] = 0
    for side in range(2):
        view: cython.const[cython.uchar][:, ::1] = then.other if side else then.view
        right: cython.float = cython.cast(
            cython.float, moved[0] + (camera.side * moved[2] if side else 0.0)
        )
        total: cython.double = 0
        squares: cython.double = 0
        by_x: cython.double = 0
        by_y: cython.double = 0
        for n in range(48):
            u: cython.float = min(max(work.column[side, n] + right, none), last_column)
            v: cython.float = min(max(work.row[n] + down, none), last_row)
            place[n] = cython.cast(cython.int, u)
            place[n + 48] = cython.cast(cython.int, v)
            there[n] = u - place[n]
            there[n + 48] = v - place[n + 48]
        for n in range(count):
            there[n + 96] = view[place[n + 48], place[n]]
            there[n + 144] = view[place[n + 48], place[n] + 1]
            there[n + 192] = view[place[n + 48] + 1, place[n]]
            there[n + 240] = view[place[n + 48] + 1, place[n] + 1]
        for n in range(48):
            upper: cython.float = there[n + 96] + there[n] * (there[n + 144] - there[n + 96])
            lower: cython.float = there[n + 192] + there[n] * (there[n + 240] - there[n + 192])
            there[n + 288] = upper + there[n + 48] * (lower - upper) - work.grey[side, n]
        for n in range(count):
            off: cython.float = there[n + 288]
            total += off
            squares += off * off
            by_x += off * work.slope_x[side, n]
            by_y += off * work.slope_y[side, n]
        all += max(squares - total * total / count, 0.0)
        work.right[0] -= by_x
        work.right[1] -= by_y
        work.right[2] -= camera.side * side * by_x
    return all


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(side=cython.int, n=cython.int, i=cython.int, k=cython.int)
def equations(camera: Camera, count: cython.int, work: Workspace) -> cython.void:
    """Centre the slopes, and fill in the equations and the inverse of them damped."""
    a: cython.double[:, ::1] = work.normal
    a[:, :] = 0
    for side in range(2):
        by_disparity: cython.double = camera.side * side
        mean_x: cython.float = 0
        mean_y: cython.float = 0
        for n in range(count):
            mean_x += work.slope_x[side, n]
            mean_y += work.slope_y[side, n]
        xx: cython.double = 0
        xy: cython.double = 0
        yy: cython.double = 0
        for n in range(count):
            # A brighter view says nothing.
            x: cython.float = work.slope_x[side, n] - mean_x / count
            y: cython.float = work.slope_y[side, n] - mean_y / count
            work.slope_x[side, n] = x
            work.slope_y[side, n] = y
            xx += x * x
            xy += x * y
            yy += y * y
        a[0, 0] += xx
        a[0, 1] += xy
        a[1, 1] += yy
        a[0, 2] += by_disparity * xx
        a[1, 2] += by_disparity * xy
        a[2, 2] += by_disparity * by_disparity * xx
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


@cython.cfunc
@cython.nogil
@cython.inline
@cython.exceptval(check=False)
def between(
    view: cython.const[cython.uchar][:, ::1], row: cython.int, column: cython.int, a: cython.float
) -> cython.float:
    """Return the grey a share ``a`` from a pixel to the next one in its row."""
    here: cython.float = cython.cast(cython.float, view[row, column])
    return here + a * (view[row, column + 1] - here)
