"""Direct alignment of points: the loops of :mod:`motionstereo_cli.robot.alignment`."""

import cython
import numpy as np
from cython.cimports.libc.math import cos, fabs, isfinite, sin, sqrt

NAN = cython.declare(cython.double, np.nan)
#: Unknowns of an alignment: translation and rotation, gain and offset of both views, and the
#: constant error of disparity. One view has the first six, two of its own, and the last.
UNKNOWNS = cython.declare(cython.Py_ssize_t, 11)
OF_ONE = cython.declare(cython.Py_ssize_t, 9)


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
    """Reusable buffers of an alignment."""

    slopes: cython.double[::1]  # of a residual by the unknowns of one view, and the residual
    one: cython.double[:, ::1]  # normal equations of one view, the right side last
    factor: cython.double[:, ::1]
    step: cython.double[::1]
    turn: cython.double[::1]  # a rotation, row by row
    turned: cython.double[::1]
    sampled: cython.double[::1]  # grey of a point, and its slopes along x and y

    def __init__(self):
        self.slopes = np.zeros(10)
        self.one = np.zeros((10, 10))
        self.factor = np.zeros((11, 11))
        self.step = np.zeros(11)
        self.turn = np.zeros(9)
        self.turned = np.zeros(12)
        self.sampled = np.zeros(3)


def align(
    views: Views,
    camera: RigLevel,
    weights: Weights,
    prior: cython.const[cython.double][:, ::1],
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
        prior: (2, 11) wanted values of the last five unknowns, and information on all.
        iterations: maximum number.
        least_step: iterations end with a smaller step, in px of this level.
        work: the workspace.
        state: (17,) the motion as a matrix (3, 4), row by row, that takes places before to places
            now; gain and offset of the right and of the left view; constant error of disparity.
        normal: (11, 11) receives the normal equations.
        residual: (n,) receives what the right view's points differ by, in standard deviations,
            NaN = not seen.

    Returns:
        the number of points visible in the right view, -1 if the equations have no solution.
    """
    seen: cython.int = 0
    with cython.nogil:
        for _count in range(iterations):
            seen = equations(views, camera, weights, prior, state, work, normal, residual)
            if seen < 8 or not solved(normal, work):
                seen = -1
                break
            moved: cython.double = take_step(state, camera, views.points, work)
            if not isfinite(moved):
                seen = -1
                break
            if moved < least_step:
                break
    return seen


def residuals(
    views: Views,
    camera: RigLevel,
    weights: Weights,
    state: cython.const[cython.double][::1],
    work: Workspace,
    residual: cython.float[::1],
) -> cython.int:
    """Fill in the residuals of the right view; see :func:`align`."""
    with cython.nogil:
        seen: cython.int = one_view(views, camera, weights, state, 0, work, residual)
    return seen


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def equations(
    views: Views,
    camera: RigLevel,
    weights: Weights,
    prior: cython.const[cython.double][:, ::1],
    state: cython.double[::1],
    work: Workspace,
    normal: cython.double[:, ::1],
    residual: cython.float[::1],
) -> cython.int:
    """Fill in the normal equations of both views and the prior."""
    i: cython.Py_ssize_t
    side: cython.int
    normal[:, :] = 0
    work.step[:] = 0
    seen: cython.int = 0
    for side in range(1, -1, -1):  # the right one last: its residuals stay
        seen = one_view(views, camera, weights, state, side, work, residual)
        add(work, 2 * side, normal)
    for i in range(UNKNOWNS):
        normal[i, i] += prior[1, i]
        if i >= 6:
            work.step[i] += prior[1, i] * (state[6 + i] - prior[0, i])
    return seen


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def add(work: Workspace, shift: cython.Py_ssize_t, normal: cython.double[:, ::1]) -> cython.void:
    """Add the equations of one view: its gain and offset come ``shift`` after the sixth."""
    i: cython.Py_ssize_t
    k: cython.Py_ssize_t
    for i in range(OF_ONE):
        row: cython.Py_ssize_t = i if i < 6 else (i + shift if i < 8 else UNKNOWNS - 1)
        work.step[row] += work.one[i, OF_ONE]
        for k in range(OF_ONE):
            column: cython.Py_ssize_t = k if k < 6 else (k + shift if k < 8 else UNKNOWNS - 1)
            normal[row, column] += work.one[min(i, k), max(i, k)]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def one_view(
    views: Views,
    camera: RigLevel,
    weights: Weights,
    m: cython.const[cython.double][::1],
    side: cython.int,
    work: Workspace,
    residual: cython.float[::1],
) -> cython.int:
    """Fill in the normal equations of the right (0) or left (1) view, and its residuals."""
    i: cython.Py_ssize_t
    k: cython.Py_ssize_t
    n: cython.Py_ssize_t
    p: cython.Py_ssize_t
    seen: cython.int = 0
    points: cython.const[cython.float][:, ::1] = views.points
    view: cython.const[cython.float][:, ::1] = views.left if side else views.right
    grey: cython.const[cython.float][::1] = views.grey
    one: cython.double[:, ::1] = work.one
    j: cython.double[::1] = work.slopes
    gain: cython.double = m[12 + 2 * side]
    offset: cython.double = m[13 + 2 * side]
    one[:, :] = 0
    for n in range((points.shape[0] + views.stride - 1) // views.stride):
        p = n * views.stride
        if not look_at(view, camera, points, p, m, side, weights, work):
            residual[p] = cython.cast(cython.float, NAN)
            continue
        r: cython.double = work.sampled[0] - gain * grey[p] - offset
        j[6] = -grey[p]
        j[7] = -1.0
        j[9] = r
        variance: cython.double = work.sampled[1]
        off: cython.double = fabs(r) / sqrt(variance)
        residual[p] = cython.cast(cython.float, off)
        seen += 1
        if off > weights.cut:
            continue
        weight: cython.double = (1.0 if off < weights.huber else weights.huber / off) / variance
        for i in range(OF_ONE):
            c: cython.double = weight * j[i]
            for k in range(i, OF_ONE + 1):
                one[i, k] += c * j[k]
    return seen


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def look_at(
    view: cython.const[cython.float][:, ::1],
    camera: RigLevel,
    points: cython.const[cython.float][:, ::1],
    p: cython.Py_ssize_t,
    m: cython.const[cython.double][::1],
    side: cython.int,
    weights: Weights,
    work: Workspace,
) -> cython.bint:
    """Fill in a point's grey now, its variance, and its slopes by motion and constant error.

    With inverse depth as the scale, a point is now at R ray + t / depth. False if out of view.
    """
    aside_m: cython.double = camera.baseline_m if side else 0.0
    # In the left view disparity is smaller than nearness by the constant error.
    error: cython.double = -camera.scale if side else 0.0
    inverse: cython.double = (points[p, 2] + m[16]) / camera.focal_baseline
    x: cython.double = points[p, 0]
    y: cython.double = points[p, 1]
    z: cython.double = m[8] * x + m[9] * y + m[10] + m[11] * inverse
    if z < 0.05:
        return False
    x, y = (
        (m[0] * x + m[1] * y + m[2] + (m[3] + aside_m) * inverse) / z,
        (m[4] * x + m[5] * y + m[6] + m[7] * inverse) / z,
    )
    u: cython.double = camera.focal_x * x + error * m[16]
    u += camera.left_cx if side else camera.right_cx
    v: cython.double = camera.focal_y * y + camera.cy
    if not (u >= 1 and v >= 1 and u < view.shape[1] - 2 and v < view.shape[0] - 2):
        return False
    sample(view, u, v, work.sampled)
    gx: cython.double = work.sampled[1]
    gy: cython.double = work.sampled[2]
    per_m: cython.double = inverse / z
    ju: cython.double = gx * camera.focal_x
    jv: cython.double = gy * camera.focal_y
    out: cython.double = ju * x + jv * y
    # Rotations are about the right camera: the point relative to it.
    here: cython.double = x - aside_m * per_m
    j: cython.double[::1] = work.slopes
    j[0] = ju * per_m
    j[1] = jv * per_m
    j[2] = -out * per_m
    j[3] = -out * y - jv
    j[4] = out * here + ju
    j[5] = jv * here - ju * y
    by_depth: cython.double = (ju * (m[3] + aside_m) + jv * m[7] - out * m[11]) / (
        z * camera.focal_baseline
    )
    j[8] = by_depth + gx * error
    sd: cython.double = by_depth * points[p, 3]
    work.sampled[1] = (
        weights.grey * weights.grey + sd * sd + weights.per_slope * (gx * gx + gy * gy)
    )
    return True


@cython.cfunc
@cython.nogil
@cython.inline
@cython.exceptval(check=False)
def sample(
    view: cython.const[cython.float][:, ::1],
    u: cython.double,
    v: cython.double,
    sampled: cython.double[::1],
) -> cython.void:
    """Fill in grey between pixels, and its slopes: central differences, interpolated likewise."""
    column: cython.int = cython.cast(cython.int, u)
    row: cython.int = cython.cast(cython.int, v)
    a: cython.double = u - column
    b: cython.double = v - row
    upper: cython.double = between(view, row, column, a)
    lower: cython.double = between(view, row + 1, column, a)
    before: cython.double = between(view, row - 1, column, a)
    after: cython.double = between(view, row + 2, column, a)
    sampled[0] = upper + b * (lower - upper)
    sampled[1] = 0.5 * ((1 - b) * slope(view, row, column, a) + b * slope(view, row + 1, column, a))
    sampled[2] = 0.5 * (lower - before + b * (after - upper - lower + before))


@cython.cfunc
@cython.nogil
@cython.inline
@cython.exceptval(check=False)
def between(
    view: cython.const[cython.float][:, ::1], row: cython.int, column: cython.int, a: cython.double
) -> cython.double:
    """Return the grey a share ``a`` from a pixel to the next one in its row."""
    here: cython.double = view[row, column]
    return here + a * (view[row, column + 1] - here)


@cython.cfunc
@cython.nogil
@cython.inline
@cython.exceptval(check=False)
def slope(
    view: cython.const[cython.float][:, ::1], row: cython.int, column: cython.int, a: cython.double
) -> cython.double:
    """Return twice the slope of grey along a row, a share ``a`` from a pixel to the next one."""
    here: cython.double = view[row, column + 1] - view[row, column - 1]
    after: cython.double = view[row, column + 2] - view[row, column]
    return here + a * (after - here)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def solved(normal: cython.const[cython.double][:, ::1], work: Workspace) -> cython.bint:
    """Replace the right side ``work.step`` by minus the solution (Cholesky); False if none."""
    i: cython.Py_ssize_t
    k: cython.Py_ssize_t
    n: cython.Py_ssize_t
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
def take_step(
    state: cython.double[::1],
    camera: RigLevel,
    points: cython.const[cython.float][:, ::1],
    work: Workspace,
) -> cython.double:
    """Change the state by ``work.step``; return the typical displacement of points, in px."""
    i: cython.Py_ssize_t
    k: cython.Py_ssize_t
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
    for i in range(5):
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
