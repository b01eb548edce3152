"""Robust planes of disparity: the loops of :mod:`motionstereo_cli.method.planes`."""

import cython
import numpy as np
from cython.cimports.libc.math import sqrt

#: Fewer samples than this make no plane; none has a smaller variance, in squared px.
LEAST = cython.declare(cython.int, 12)
MIN_VARIANCE = cython.declare(cython.double, 0.0225)
NAN = cython.declare(cython.float, np.nan)


@cython.cclass
@cython.dataclasses.dataclass
class Window:
    """Which samples a plane is fitted to, and when it counts.

    Attributes:
        reach_x, reach_y: samples lie so many px and rows away at most.
        step_x, step_y: one of so many px and rows is a sample.
        block_x, block_y: a plane is fitted once for blocks of this size.
        max_grey: samples differ in grey by at most so many levels from the block.
        tolerance_px: inliers are within this of the plane.
        rounds: how often it is fitted; the tolerance is twice as large before the last two.
        min_share: inliers have this share of the samples' weight.
        max_off_centre: and their centroid is within this share of the reach.
    """

    reach_x: cython.int
    reach_y: cython.int
    step_x: cython.int
    step_y: cython.int
    block_x: cython.int
    block_y: cython.int
    max_grey: cython.float
    tolerance_px: cython.float
    rounds: cython.int
    min_share: cython.float
    max_off_centre: cython.float


@cython.cclass
class Samples:
    """Room for the samples of one plane.

    Args:
        rows, width: of the image.
        max_disparity: px.
    """

    x: cython.float[::1]
    y: cython.float[::1]
    disparity: cython.float[::1]
    weight: cython.float[::1]
    counts: cython.float[::1]  # weight of the samples by twice their disparity
    used: cython.int

    def __init__(
        self,
        rows: cython.Py_ssize_t,
        width: cython.Py_ssize_t,
        max_disparity: cython.Py_ssize_t,
    ):
        count = rows * width  # at most; what is not used takes no memory
        self.x = np.empty(count, np.float32)
        self.y = np.empty(count, np.float32)
        self.disparity = np.empty(count, np.float32)
        self.weight = np.empty(count, np.float32)
        self.counts = np.zeros(2 * max_disparity + 4, np.float32)


@cython.cclass
class Plane:
    """Disparity = here + along * x + down * y, and how good that is.

    Attributes:
        weight: of the inliers.
        middle_x, middle_y: their centroid.
        xx, xy, yy: their spread around it, times their weight.
        share: of the samples' weight that the inliers have, 0 where there is no plane.
        error_px: standard error that is to be expected here.
    """

    here: cython.double
    along: cython.double
    down: cython.double
    weight: cython.double
    middle_x: cython.double
    middle_y: cython.double
    xx: cython.double
    xy: cython.double
    yy: cython.double
    share: cython.double
    error_px: cython.double


def fit(
    disparity: cython.const[cython.float][:, ::1],
    weight: cython.const[cython.float][:, ::1],
    grey: cython.const[cython.float][:, ::1],
    where: cython.const[cython.uchar][:, ::1],
    window: Window,
    samples: Samples,
    result: cython.float[:, ::1],
    error: cython.float[:, ::1],
    share: cython.float[:, ::1],
) -> None:
    """Fill in the plane's disparity, its error and its inliers' share, NaN where there is none."""
    rows: cython.int = cython.cast(cython.int, disparity.shape[0])
    width: cython.int = cython.cast(cython.int, disparity.shape[1])
    plane: Plane = Plane()
    down: cython.int
    across: cython.int
    i: cython.int
    j: cython.int
    with cython.nogil:
        for down in range((rows + window.block_y - 1) // window.block_y):
            top: cython.int = down * window.block_y
            bottom: cython.int = min(top + window.block_y, rows)
            for across in range((width + window.block_x - 1) // window.block_x):
                left: cython.int = across * window.block_x
                right: cython.int = min(left + window.block_x, width)
                # The pixel that is wanted nearest to the block's middle stands for it.
                nearest: cython.int = rows + width
                y: cython.int = 0
                x: cython.int = 0
                for j in range(top, bottom):
                    for i in range(left, right):
                        result[j, i] = error[j, i] = share[j, i] = NAN
                        away: cython.int = abs(2 * j - top - bottom + 1) + abs(
                            2 * i - left - right + 1
                        )
                        if where[j, i] and away < nearest:
                            nearest = away
                            y = j
                            x = i
                if nearest == rows + width:
                    continue
                collect(disparity, weight, grey, y, x, window, samples)
                solve(window, samples, plane)
                if plane.share <= 0:
                    continue
                for j in range(top, bottom):
                    for i in range(left, right):
                        if where[j, i]:
                            result[j, i] = cython.cast(
                                cython.float,
                                plane.here + plane.along * (i - x) + plane.down * (j - y),
                            )
                            error[j, i] = cython.cast(cython.float, plane.error_px)
                            share[j, i] = cython.cast(cython.float, plane.share)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def collect(
    disparity: cython.const[cython.float][:, ::1],
    weight: cython.const[cython.float][:, ::1],
    grey: cython.const[cython.float][:, ::1],
    y: cython.int,
    x: cython.int,
    window: Window,
    samples: Samples,
) -> cython.void:
    """Collect the samples around a pixel: of some weight, of known disparity, of like grey."""
    rows: cython.int = cython.cast(cython.int, disparity.shape[0])
    width: cython.int = cython.cast(cython.int, disparity.shape[1])
    i: cython.int
    j: cython.int
    n: cython.int = 0
    here: cython.float = grey[y, x]
    first_y: cython.int = y - min(window.reach_y, y) // window.step_y * window.step_y
    first_x: cython.int = x - min(window.reach_x, x) // window.step_x * window.step_x
    down: cython.int = (min(y + window.reach_y, rows - 1) - first_y) // window.step_y + 1
    across: cython.int = (min(x + window.reach_x, width - 1) - first_x) // window.step_x + 1
    for j in range(down):
        at_y: cython.int = first_y + j * window.step_y
        for i in range(across):
            at_x: cython.int = first_x + i * window.step_x
            w: cython.float = weight[at_y, at_x]
            d: cython.float = disparity[at_y, at_x]
            if w > 0 and d >= 0 and abs(grey[at_y, at_x] - here) <= window.max_grey:
                samples.x[n] = cython.cast(cython.float, at_x - x)
                samples.y[n] = cython.cast(cython.float, at_y - y)
                samples.disparity[n] = d
                samples.weight[n] = w
                n += 1
    samples.used = n


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def median_of(samples: Samples) -> cython.double:
    """Return the weighted median of the samples' disparities, to 0.5 px."""
    k: cython.int
    total: cython.float = 0
    part: cython.float = 0
    samples.counts[:] = 0
    for k in range(samples.used):
        twice: cython.Py_ssize_t = cython.cast(cython.Py_ssize_t, 2 * samples.disparity[k])
        samples.counts[twice] += samples.weight[k]
        total += samples.weight[k]
    for k in range(cython.cast(cython.int, samples.counts.shape[0])):
        part += samples.counts[k]
        if 2 * part >= total:
            break
    return 0.5 * k + 0.25


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def solve(window: Window, samples: Samples, plane: Plane) -> cython.void:
    """Fit a plane a few times to what is near the last one, first to what is near the median."""
    turn: cython.int
    plane.share = 0
    if samples.used < LEAST:
        return
    plane.here = median_of(samples)
    plane.along = plane.down = 0
    for turn in range(window.rounds):
        wider: cython.int = 1 << min(max(window.rounds - 2 - turn, 0), 2)
        if not improve(samples, window.tolerance_px * wider, plane):
            return
    judge(window, samples, plane)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def improve(samples: Samples, tolerance_px: cython.double, plane: Plane) -> cython.bint:
    """Fit a plane by least squares to what is near the last one; return whether that is enough."""
    k: cython.int
    count: cython.int = 0
    s: cython.double = 0
    sx: cython.double = 0
    sy: cython.double = 0
    sd: cython.double = 0
    sdx: cython.double = 0
    sdy: cython.double = 0
    xx: cython.double = 0
    xy: cython.double = 0
    yy: cython.double = 0
    for k in range(samples.used):
        x: cython.double = samples.x[k]
        y: cython.double = samples.y[k]
        d: cython.double = samples.disparity[k]
        if abs(d - (plane.here + plane.along * x + plane.down * y)) > tolerance_px:
            continue
        w: cython.double = samples.weight[k]
        count += 1
        s += w
        sx += w * x
        sy += w * y
        sd += w * d
        xx += w * x * x
        xy += w * x * y
        yy += w * y * y
        sdx += w * d * x
        sdy += w * d * y
    if count < LEAST:
        return False
    plane.weight = s
    plane.middle_x = sx / s
    plane.middle_y = sy / s
    # A little is added to the spread, so that few rows or columns make no steep plane.
    xx += 4 * s - sx * plane.middle_x
    yy += 4 * s - sy * plane.middle_y
    xy -= sx * plane.middle_y
    sdx -= sd * plane.middle_x
    sdy -= sd * plane.middle_y
    plane.along = (sdx * yy - sdy * xy) / (xx * yy - xy * xy)
    plane.down = (sdy * xx - sdx * xy) / (xx * yy - xy * xy)
    plane.here = (sd - plane.along * sx - plane.down * sy) / s
    plane.xx = xx
    plane.xy = xy
    plane.yy = yy
    return True


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def judge(window: Window, samples: Samples, plane: Plane) -> cython.void:
    """Fill in a plane's error and its inliers' share, if it counts."""
    k: cython.int
    total: cython.double = 0
    residual: cython.double = 0
    for k in range(samples.used):
        total += samples.weight[k]
        away: cython.double = samples.disparity[k] - (
            plane.here + plane.along * samples.x[k] + plane.down * samples.y[k]
        )
        if abs(away) <= window.tolerance_px:
            residual += samples.weight[k] * away * away
    x: cython.double = plane.middle_x
    y: cython.double = plane.middle_y
    if (
        plane.here < 0
        or plane.weight < window.min_share * total
        or abs(x) > window.max_off_centre * window.reach_x
        or abs(y) > window.max_off_centre * window.reach_y
    ):
        return
    plane.share = plane.weight / total
    lever: cython.double = 1 / plane.weight + (
        x * x * plane.yy - 2 * x * y * plane.xy + y * y * plane.xx
    ) / (plane.xx * plane.yy - plane.xy * plane.xy)
    plane.error_px = sqrt(max(residual / plane.weight, MIN_VARIANCE) * lever)
