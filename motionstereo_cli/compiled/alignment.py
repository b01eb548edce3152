"""Direct alignment of points: the loops of :mod:`motionstereo_cli.robot.alignment`."""

import cython
import numpy as np
from cython.cimports.libc.math import cos, fabs, isfinite, sin, sqrt

NAN = cython.declare(cython.double, np.nan)
#: Unknowns of an alignment: translation and rotation, gain and offset of both views, and the error
#: of disparity: its constant, and slopes to the right and down. One view has the first six, two of
#: its own, and the last three.
UNKNOWNS = cython.declare(cython.Py_ssize_t, 13)
OF_ONE = cython.declare(cython.Py_ssize_t, 11)
WITHOUT_ERROR = cython.declare(cython.Py_ssize_t, 8)
#: Points in a block. Its rows, see :func:`at`, are:
#:    0, 1: direction in the right camera; then their place now, over its depth
#:    2: nearness; then inverse depth before    3: standard deviation of nearness    4: grey before
#:    5: depth now over that before    6, 7: place in the view; then its fraction of a px
#:    8: residual in standard deviations    9: weight, 0 where it is not seen    10: 1 = in view
#:    11..22: grey of the pixels around: two above, four and four beside, two below; then, in the
#:        first three, grey between them, and its slopes along x and y
#:    23..34: slopes of the residual by the unknowns of one view, and the residual
#:    35..45: these slopes times the weight    46, 47: direction in the left camera before
LANES = cython.declare(cython.Py_ssize_t, 32)
ROWS = cython.declare(cython.Py_ssize_t, 48)
SLOPES = cython.declare(cython.Py_ssize_t, 23)
WEIGHTED = cython.declare(cython.Py_ssize_t, 35)
MIN_DEPTH = cython.declare(cython.double, 0.05)


@cython.cclass
@cython.dataclasses.dataclass
class RigLevel:
    """A rig at one level of a pyramid; px are of that level.

    Attributes:
        focal_x, focal_y: focal lengths in px.
        right_cx, left_cx, cy: principal points in px.
        baseline_m: distance between the cameras.
        focal_baseline: of the full image: depth in m times nearness in px.
        scale: px of this level in a px of the full image.
    """

    focal_x: cython.double
    focal_y: cython.double
    right_cx: cython.double
    left_cx: cython.double
    cy: cython.double
    baseline_m: cython.double
    focal_baseline: cython.double
    scale: cython.double


@cython.cclass
@cython.dataclasses.dataclass
class Weights:
    """Weights of residuals; see :mod:`motionstereo_cli.robot.alignment`."""

    grey: cython.double
    per_slope: cython.double
    huber: cython.double
    cut: cython.double


@cython.cclass
@cython.dataclasses.dataclass(eq=False)
class Views:
    """The input of an alignment at one level.

    Attributes:
        right, left: the current views.
        points: (n, 4): direction x and y per depth in the right camera, nearness in px of the full
            image, and its standard deviation.
        grey: (n,) of the points in the earlier right view.
        stride: one of so many points is used.
    """

    right: cython.const[cython.float][:, ::1]
    left: cython.const[cython.float][:, ::1]
    points: cython.const[cython.float][:, ::1]
    grey: cython.const[cython.float][::1]
    stride: cython.Py_ssize_t


@cython.cclass
class Workspace:
    """Reusable buffers of an alignment.

    Points are taken in blocks, and each quantity of a block is a row: so compilers make vectors of
    it, whose sums are the same on every machine.
    """

    block: cython.double[::1]
    sums: cython.double[::1]  # of the products of slopes, a row for each pair
    one: cython.double[:, ::1]  # normal equations of one view, the right side last
    normal: cython.double[:, ::1]  # of both
    factor: cython.double[:, ::1]
    step: cython.double[::1]
    turn: cython.double[::1]  # a rotation, row by row
    turned: cython.double[::1]

    def __init__(self):
        self.block = np.zeros(ROWS * LANES)
        self.sums = np.zeros(77 * LANES)
        self.one = np.zeros((11, 12))
        self.normal = np.zeros((13, 13))
        self.factor = np.zeros((13, 13))
        self.step = np.zeros(13)
        self.turn = np.zeros(9)
        self.turned = np.zeros(12)


def align(
    views: Views,
    camera: RigLevel,
    weights: Weights,
    prior: cython.const[cython.double][:, ::1],
    with_error: cython.bint,
    iterations: cython.int,
    least_step: cython.double,
    work: Workspace,
    state: cython.double[::1],
    normal: cython.double[:, ::1],
    residual: cython.float[::1],
) -> cython.int:
    """Align points of an earlier view with both views of now by Gauss and Newton, in place.

    Args:
        views, camera, weights: what is aligned, and how.
        prior: (2, 13) wanted values of the last seven unknowns, and information on all.
        with_error: whether the constant error of disparity is unknown, or stays as it is.
        iterations: maximum number.
        least_step: iterations end with a smaller step, in px of this level.
        work: the workspace.
        state: (19,) the motion as a matrix (3, 4), row by row, that takes places before to places
            now; gain and offset of the right and of the left view; error of disparity.
        normal: (13, 14) receives the normal equations, the right side last; or (0, 14).
        residual: (n,) receives what the right view's points differ by, in standard deviations,
            NaN = not seen.

    Returns:
        the number of points visible in the right view, -1 if the equations have no solution.
    """
    seen: cython.int = 0
    with cython.nogil:
        for _count in range(iterations):
            columns: cython.Py_ssize_t = WITHOUT_ERROR + with_error
            seen = equations(views, camera, weights, prior, columns, state, work, residual)
            solvable: cython.bint = seen >= 8 and solved(work)
            moved: cython.double = take_step(state, camera, views.points, work) if solvable else NAN
            if not isfinite(moved):
                seen = -1
            if seen < 0 or moved < least_step:
                break
        if seen >= 0 and normal.shape[0]:
            seen = equations(views, camera, weights, prior, OF_ONE, state, work, residual)
            normal[:, :UNKNOWNS] = work.normal
            normal[:, UNKNOWNS] = work.step
    return seen


@cython.locals(n=cython.Py_ssize_t, p=cython.Py_ssize_t)
def mismatches(
    views: Views,
    camera: RigLevel,
    weights: Weights,
    states: cython.const[cython.double][:, ::1],
    work: Workspace,
    residual: cython.float[::1],
    costs: cython.double[::1],
) -> None:
    """Fill in the mean residual of the right view for each of some states, (n,).

    Larger ones count as ``weights.cut``, and so does what is not seen; see :func:`align`.
    """
    count: cython.Py_ssize_t = (views.points.shape[0] + views.stride - 1) // views.stride
    with cython.nogil:
        for n in range(states.shape[0]):
            one_view(views, camera, weights, states[n], 0, 0, work, residual)
            total: cython.double = 0
            for p in range(count):
                off: cython.double = residual[p * views.stride]
                total += off if off < weights.cut else weights.cut
            costs[n] = total / count


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def equations(
    views: Views,
    camera: RigLevel,
    weights: Weights,
    prior: cython.const[cython.double][:, ::1],
    columns: cython.Py_ssize_t,
    state: cython.double[::1],
    work: Workspace,
    residual: cython.float[::1],
) -> cython.int:
    """Fill in the normal equations of both views and the prior."""
    i: cython.Py_ssize_t
    side: cython.int
    work.normal[:, :] = 0
    work.step[:] = 0
    seen: cython.int = 0
    for side in range(1, -1, -1):  # the right one last: its residuals stay
        seen = one_view(views, camera, weights, state, side, columns, work, residual)
        add(work, 2 * side, columns)
    for i in range(UNKNOWNS):
        work.normal[i, i] += prior[1, i]
        if i >= 6:
            work.step[i] += prior[1, i] * (state[6 + i] - prior[0, i])
    return seen


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(i=cython.Py_ssize_t, k=cython.Py_ssize_t)
def add(work: Workspace, shift: cython.Py_ssize_t, columns: cython.Py_ssize_t) -> cython.void:
    """Add the equations of one view: its gain and offset come ``shift`` after the sixth."""
    for i in range(columns):
        row: cython.Py_ssize_t = i if i < 6 else (i + shift if i < 8 else i + 2)
        work.step[row] += work.one[i, OF_ONE]
        for k in range(columns):
            column: cython.Py_ssize_t = k if k < 6 else (k + shift if k < 8 else k + 2)
            work.normal[row, column] += work.one[min(i, k), max(i, k)]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(i=cython.Py_ssize_t, k=cython.Py_ssize_t, n=cython.Py_ssize_t)
@cython.locals(number=cython.Py_ssize_t, lane=cython.Py_ssize_t)
def one_view(
    views: Views,
    camera: RigLevel,
    weights: Weights,
    m: cython.const[cython.double][::1],
    side: cython.int,
    columns: cython.Py_ssize_t,
    work: Workspace,
    residual: cython.float[::1],
) -> cython.int:
    """Fill in residuals of the right (0) or left (1) view, and equations of the first unknowns."""
    seen: cython.int = 0
    view: cython.const[cython.float][:, ::1] = views.left if side else views.right
    aside_m: cython.double = camera.baseline_m if side else 0.0
    # In the left view disparity is smaller than nearness by the error.
    error: cython.double = -camera.scale if side else 0.0
    cx: cython.double = camera.left_cx if side else camera.right_cx
    count: cython.Py_ssize_t = (views.points.shape[0] + views.stride - 1) // views.stride
    work.sums[:] = 0
    for number in range((count + LANES - 1) // LANES):
        n = number * LANES
        here: cython.Py_ssize_t = min(count - n, LANES)
        project(views, n * views.stride, here, camera, m, aside_m, cx, error, work.block)
        seen += look_up(view, here, work.block)
        differentiate(camera, weights, m, side, aside_m, error, work.block)
        for lane in range(here):
            off: cython.double = work.block[at(8, lane)] if work.block[at(10, lane)] else NAN
            residual[(n + lane) * views.stride] = cython.cast(cython.float, off)
        if columns > 0:
            add_products(work.block, columns, work.sums)
    n = 0
    for i in range(columns):
        for k in range(i, OF_ONE + 1):
            if columns <= k < OF_ONE:
                continue
            total: cython.double = 0
            for lane in range(LANES):
                total += work.sums[n + lane]
            work.one[i, k] = total
            n += LANES
    return seen


@cython.cfunc
@cython.nogil
@cython.inline
@cython.exceptval(check=False)
def at(row: cython.Py_ssize_t, lane: cython.Py_ssize_t) -> cython.Py_ssize_t:
    """Return where a value of a block is: compilers have to know how far apart rows are."""
    return 32 * row + lane


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def project(
    views: Views,
    first: cython.Py_ssize_t,
    count: cython.Py_ssize_t,
    camera: RigLevel,
    m: cython.const[cython.double][::1],
    aside_m: cython.double,
    cx: cython.double,
    error: cython.double,
    block: cython.double[::1],
) -> cython.void:
    """Fill in what is known of ``count`` points from ``first`` on, and where they are seen now.

    With inverse depth as the scale, a point is now at R ray + t / depth. ``cx`` is the column of
    the principal point; the rest is as for :func:`differentiate`.
    """
    lane: cython.Py_ssize_t
    focal_x: cython.double = camera.focal_x
    focal_y: cython.double = camera.focal_y
    cy: cython.double = camera.cy
    scale: cython.double = camera.focal_baseline
    per_px: cython.double = camera.scale / camera.focal_x
    constant: cython.double = m[16]
    by_x: cython.double = m[17]
    by_y: cython.double = m[18]
    xx: cython.double = m[0]
    xy: cython.double = m[1]
    xz: cython.double = m[2]
    along_x: cython.double = m[3] + aside_m
    yx: cython.double = m[4]
    yy: cython.double = m[5]
    yz: cython.double = m[6]
    along_y: cython.double = m[7]
    zx: cython.double = m[8]
    zy: cython.double = m[9]
    zz: cython.double = m[10]
    along_z: cython.double = m[11]
    for lane in range(count):
        p: cython.Py_ssize_t = first + lane * views.stride
        block[at(0, lane)] = views.points[p, 0]
        block[at(1, lane)] = views.points[p, 1]
        block[at(2, lane)] = views.points[p, 2]
        block[at(3, lane)] = views.points[p, 3]
        block[at(4, lane)] = views.grey[p]
    for lane in range(32):
        x: cython.double = block[at(0, lane)]
        y: cython.double = block[at(1, lane)]
        beside: cython.double = x + block[at(2, lane)] * per_px
        off: cython.double = constant + by_x * beside + by_y * y
        inverse: cython.double = (block[at(2, lane)] + off) / scale
        z: cython.double = zx * x + zy * y + zz + along_z * inverse
        ahead: cython.bint = z >= MIN_DEPTH
        z = z if ahead else 1.0
        right: cython.double = (xx * x + xy * y + xz + along_x * inverse) / z
        below: cython.double = (yx * x + yy * y + yz + along_y * inverse) / z
        off = constant + by_x * right + by_y * below
        u: cython.double = focal_x * right + cx + error * off
        block[at(0, lane)] = right
        block[at(1, lane)] = below
        block[at(2, lane)] = inverse
        block[at(5, lane)] = z
        block[at(6, lane)] = u if ahead else -1.0
        block[at(7, lane)] = focal_y * below + cy
        block[at(46, lane)] = beside
        block[at(47, lane)] = y


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def look_up(
    view: cython.const[cython.float][:, ::1],
    count: cython.Py_ssize_t,
    block: cython.double[::1],
) -> cython.int:
    """Fill in grey at the places of points and around, and which are in view; return how many."""
    lane: cython.Py_ssize_t
    seen: cython.int = 0
    right: cython.double = cython.cast(cython.double, view.shape[1] - 2)
    bottom: cython.double = cython.cast(cython.double, view.shape[0] - 2)
    for lane in range(LANES):
        u: cython.double = block[at(6, lane)]
        v: cython.double = block[at(7, lane)]
        inside: cython.bint = lane < count and u >= 1 and v >= 1 and u < right and v < bottom
        block[at(10, lane)] = inside
        seen += inside
        if not inside:  # any place will do
            u = 1
            v = 1
        column: cython.int = cython.cast(cython.int, u)
        row: cython.int = cython.cast(cython.int, v)
        block[at(6, lane)] = u - column
        block[at(7, lane)] = v - row
        block[at(11, lane)] = view[row - 1, column]
        block[at(12, lane)] = view[row - 1, column + 1]
        block[at(13, lane)] = view[row, column - 1]
        block[at(14, lane)] = view[row, column]
        block[at(15, lane)] = view[row, column + 1]
        block[at(16, lane)] = view[row, column + 2]
        block[at(17, lane)] = view[row + 1, column - 1]
        block[at(18, lane)] = view[row + 1, column]
        block[at(19, lane)] = view[row + 1, column + 1]
        block[at(20, lane)] = view[row + 1, column + 2]
        block[at(21, lane)] = view[row + 2, column]
        block[at(22, lane)] = view[row + 2, column + 1]
    for lane in range(32):  # the grey at these places, and its slopes: central differences
        a: cython.double = block[at(6, lane)]
        b: cython.double = block[at(7, lane)]
        before: cython.double = between(block[at(11, lane)], block[at(12, lane)], a)
        upper: cython.double = between(block[at(14, lane)], block[at(15, lane)], a)
        lower: cython.double = between(block[at(18, lane)], block[at(19, lane)], a)
        after: cython.double = between(block[at(21, lane)], block[at(22, lane)], a)
        of_upper: cython.double = between(
            block[at(15, lane)] - block[at(13, lane)], block[at(16, lane)] - block[at(14, lane)], a
        )
        of_lower: cython.double = between(
            block[at(19, lane)] - block[at(17, lane)], block[at(20, lane)] - block[at(18, lane)], a
        )
        block[at(11, lane)] = upper + b * (lower - upper)
        block[at(12, lane)] = 0.5 * ((1 - b) * of_upper + b * of_lower)
        block[at(13, lane)] = 0.5 * (lower - before + b * (after - upper - lower + before))
    return seen


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def differentiate(
    camera: RigLevel,
    weights: Weights,
    m: cython.const[cython.double][::1],
    side: cython.int,
    aside_m: cython.double,
    error: cython.double,
    block: cython.double[::1],
) -> cython.void:
    """Fill in residuals, their weights, and their slopes by all unknowns.

    Args:
        camera, weights, m: as :func:`align` has them.
        side: 0 for the right view, 1 for the left one.
        aside_m: how far its camera is to the left.
        error: px that it is seen farther to the right by a px of error.
        block: the points.
    """
    lane: cython.Py_ssize_t
    focal_x: cython.double = camera.focal_x
    focal_y: cython.double = camera.focal_y
    along_x: cython.double = m[3] + aside_m
    along_y: cython.double = m[7]
    along_z: cython.double = m[11]
    scale: cython.double = camera.focal_baseline
    gain: cython.double = m[12 + 2 * side]
    offset: cython.double = m[13 + 2 * side]
    noise: cython.double = weights.grey * weights.grey
    per_slope: cython.double = weights.per_slope
    huber: cython.double = weights.huber
    cut: cython.double = weights.cut
    for lane in range(32):
        gx: cython.double = block[at(12, lane)]
        gy: cython.double = block[at(13, lane)]
        x: cython.double = block[at(0, lane)]
        y: cython.double = block[at(1, lane)]
        z: cython.double = block[at(5, lane)]
        per_m: cython.double = block[at(2, lane)] / z
        ju: cython.double = gx * focal_x
        jv: cython.double = gy * focal_y
        out: cython.double = ju * x + jv * y
        # Rotations are about the right camera: the point relative to it.
        here: cython.double = x - aside_m * per_m
        by_depth: cython.double = (ju * along_x + jv * along_y - out * along_z) / (z * scale)
        r: cython.double = block[at(11, lane)] - gain * block[at(4, lane)] - offset
        block[at(23, lane)] = ju * per_m
        block[at(24, lane)] = jv * per_m
        block[at(25, lane)] = -out * per_m
        block[at(26, lane)] = -out * y - jv
        block[at(27, lane)] = out * here + ju
        block[at(28, lane)] = jv * here - ju * y
        block[at(29, lane)] = -block[at(4, lane)]
        block[at(30, lane)] = -1.0
        block[at(31, lane)] = by_depth + gx * error
        block[at(32, lane)] = by_depth * block[at(46, lane)] + gx * error * x
        block[at(33, lane)] = by_depth * block[at(47, lane)] + gx * error * y
        block[at(34, lane)] = r
        sd: cython.double = by_depth * block[at(3, lane)]
        variance: cython.double = noise + sd * sd + per_slope * (gx * gx + gy * gy)
        off: cython.double = fabs(r) / sqrt(variance)
        weight: cython.double = huber / off
        weight = weight if weight < 1 else 1.0
        weight = weight if off <= cut else 0.0
        block[at(8, lane)] = off
        block[at(9, lane)] = weight * block[at(10, lane)] / variance


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(i=cython.Py_ssize_t, k=cython.Py_ssize_t, lane=cython.Py_ssize_t)
def add_products(
    block: cython.double[::1], columns: cython.Py_ssize_t, sums: cython.double[::1]
) -> cython.void:
    """Fill in the slopes of a block times their weights, and add their products."""
    n: cython.Py_ssize_t = 0
    for i in range(columns):
        for lane in range(32):
            block[at(WEIGHTED + i, lane)] = block[at(9, lane)] * block[at(SLOPES + i, lane)]
        for k in range(i, OF_ONE + 1):
            if columns <= k < OF_ONE:
                continue
            for lane in range(32):
                sums[n + lane] += block[at(WEIGHTED + i, lane)] * block[at(SLOPES + k, lane)]
            n += LANES


@cython.cfunc
@cython.nogil
@cython.inline
@cython.exceptval(check=False)
def between(here: cython.double, next: cython.double, a: cython.double) -> cython.double:
    """Return the value a share ``a`` from one to the next."""
    return here + a * (next - here)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(i=cython.Py_ssize_t, k=cython.Py_ssize_t, n=cython.Py_ssize_t)
def solved(work: Workspace) -> cython.bint:
    """Replace the right side ``work.step`` by minus the solution (Cholesky); False if none."""
    normal: cython.double[:, ::1] = work.normal
    lower: cython.double[:, ::1] = work.factor
    step: cython.double[::1] = work.step
    total: cython.double
    for i in range(UNKNOWNS):
        for k in range(i + 1):
            total = normal[i, k]
            for n in range(k):
                total -= lower[i, n] * lower[k, n]
            if i == k:
                if not total > 0:
                    return False
                lower[i, i] = sqrt(total)
            else:
                lower[i, k] = total / lower[k, k]
    for i in range(UNKNOWNS):
        for n in range(i):
            step[i] -= lower[i, n] * step[n]
        step[i] /= lower[i, i]
    for i in range(UNKNOWNS - 1, -1, -1):
        for n in range(i + 1, UNKNOWNS):
            step[i] -= lower[n, i] * step[n]
        step[i] /= lower[i, i]
    for i in range(UNKNOWNS):
        step[i] = -step[i]
    return True


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(i=cython.Py_ssize_t, k=cython.Py_ssize_t)
def take_step(
    state: cython.double[::1],
    camera: RigLevel,
    points: cython.const[cython.float][:, ::1],
    work: Workspace,
) -> cython.double:
    """Change the state by ``work.step``; return the typical displacement of points, in px."""
    step: cython.double[::1] = work.step
    turn: cython.double[::1] = work.turn
    turned: cython.double[::1] = work.turned
    rotation(step[3], step[4], step[5], turn)
    for i in range(3):
        for k in range(4):
            turned[4 * i + k] = (
                turn[3 * i] * state[k]
                + turn[3 * i + 1] * state[4 + k]
                + turn[3 * i + 2] * state[8 + k]
            )
        turned[4 * i + 3] += step[i]
    for i in range(12):
        state[i] = turned[i]
    for i in range(7):
        state[12 + i] += step[6 + i]
    turns: cython.double = max(fabs(step[3]), fabs(step[4]), fabs(step[5])) * camera.focal_x
    middle: cython.double = points[points.shape[0] // 2, 2] / camera.focal_baseline
    shifts: cython.double = max(fabs(step[0]), fabs(step[1]), fabs(step[2])) * camera.focal_x
    return turns + shifts * middle


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def rotation(
    x: cython.double, y: cython.double, z: cython.double, turn: cython.double[::1]
) -> cython.void:
    """Fill in the matrix of a turn by a vector (Rodrigues)."""
    angle: cython.double = sqrt(x * x + y * y + z * z)
    s: cython.double = 1.0
    c: cython.double = 0.5
    if angle > 1e-9:
        s = sin(angle) / angle
        c = (1 - cos(angle)) / (angle * angle)
    turn[0] = 1 - c * (y * y + z * z)
    turn[1] = c * x * y - s * z
    turn[2] = c * x * z + s * y
    turn[3] = c * x * y + s * z
    turn[4] = 1 - c * (x * x + z * z)
    turn[5] = c * y * z - s * x
    turn[6] = c * x * z - s * y
    turn[7] = c * y * z + s * x
    turn[8] = 1 - c * (x * x + y * y)
