"""Robust planes of disparity: the loops of :mod:`motionstereo_cli.method.planes`.

Sums over samples are of whole numbers: they are exact in any order, so compilers make vectors of
them. They do so of loops over arrays that are arguments of a function of their own.
"""

import cython
import numpy as np
from cython.cimports.libc.math import sqrt

#: Minimum number of samples of a plane, and their minimum variance in squared px.
LEAST = cython.declare(cython.int, 12)
MIN_VARIANCE = cython.declare(cython.double, 0.0225)
NAN = cython.declare(cython.float, np.nan)
HALF = cython.declare(cython.float, 0.5)

#: Disparities of samples are whole numbers of a 64th px, and of larger parts where they may exceed
#: 1,000 px: sums of their products have to stay below 2**31.
PER_PX_BITS = cython.declare(cython.int, 6)
LARGEST = cython.declare(cython.int, 1000 * 64)


@cython.cclass
@cython.dataclasses.dataclass
class Window:
    """The samples that a plane is fitted to, and the conditions for using it.

    Attributes:
        reach_x, reach_y: samples lie so many px and rows away at most.
        step_x, step_y: one of so many px and rows is a sample.
        shift: in each such row samples lie so many px farther to the right than in the one before,
            or as many less a step: else a vertical edge might miss all of them.
        block_x, block_y: a plane is fitted once for blocks of this size.
        max_grey: samples differ in grey by at most so many levels from the block.
        tolerance_px: inliers are within this of the plane.
        rounds: how often it is fitted; the tolerance is twice as large before the last two.
        min_share: inliers have this share of the samples' weight.
        max_off_centre: and their centroid is within this share of the reach.
        dependent: samples of one surface are not independent: the error is larger by this factor.
    """

    reach_x: cython.int
    reach_y: cython.int
    step_x: cython.int
    step_y: cython.int
    shift: cython.int
    block_x: cython.int
    block_y: cython.int
    max_grey: cython.float
    tolerance_px: cython.float
    rounds: cython.int
    min_share: cython.float
    max_off_centre: cython.float
    dependent: cython.float


@cython.cclass
@cython.dataclasses.dataclass
class Rule:
    """Which pixels take a plane's disparity.

    Attributes:
        decides: all that are wanted do, and are unknown where there is no plane. Else only those
            take one that is good enough:
        below_px: whose disparity so far is less than this, or unknown,
        max_error_px: where the plane's error is less than this,
        max_change_px: and it changes what was known by at most this,
        far_px: and the disparity is less than this, before or after.
        tells_error: the plane's error is kept,
        unseen: and the pixel's partner lies beyond the left view's border.
    """

    decides: cython.bint
    below_px: cython.float
    max_error_px: cython.float
    max_change_px: cython.float
    far_px: cython.float
    tells_error: cython.bint
    unseen: cython.bint


@cython.cclass
class Samples:
    """Room for the samples of an image and for those of one plane.

    Args:
        rows, width: of the image.
        max_disparity: px.
    """

    first: cython.int[:, ::1]  # of the image, row by row: the first one from each step across on
    steps: cython.int[::1]  # across: a step is farther to the right by ``shift`` in each row
    depth: cython.int[::1]
    half: cython.int[::1]
    grey: cython.float[::1]
    # Around one pixel: steps across and rows from it, disparity, twice the weight.
    x: cython.int[::1]
    y: cython.int[::1]
    disparity: cython.int[::1]
    weight: cython.int[::1]
    counts: cython.int[::1]  # weight of the samples by twice their disparity
    wanted: cython.uchar[::1]  # columns of a row of blocks in which a plane is
    sums: cython.int[::1]  # over inliers, see :func:`add_up`
    used: cython.int
    total: cython.int  # their weight
    per_px: cython.int
    bits: cython.int

    def __init__(
        self,
        rows: cython.Py_ssize_t,
        width: cython.Py_ssize_t,
        max_disparity: cython.Py_ssize_t,
    ):
        count = rows * width  # at most; unused pages take no memory
        self.first = np.empty((rows, width + 1), np.int32)
        self.steps = np.empty(count, np.int32)
        self.depth = np.empty(count, np.int32)
        self.half = np.empty(count, np.int32)
        self.grey = np.empty(count, np.float32)
        self.x = np.empty(count, np.int32)
        self.y = np.empty(count, np.int32)
        self.disparity = np.empty(count, np.int32)
        self.weight = np.empty(count, np.int32)
        self.counts = np.zeros(2 * max_disparity + 4, np.int32)
        self.wanted = np.empty(width, np.uint8)
        self.sums = np.zeros(10, np.int32)
        self.bits = PER_PX_BITS
        while self.bits > 1 and (max_disparity + 1) << self.bits > LARGEST:
            self.bits -= 1
        self.per_px = 1 << self.bits


@cython.cclass
class Plane:
    """Disparity = here + along * x + down * y, and how good that is.

    Attributes:
        weight: of the inliers.
        middle_x, middle_y: their centroid.
        xx, xy, yy: their spread around it, times their weight.
        share: of the samples' weight that the inliers have, 0 where there is no plane.
        error_px: expected standard error here.
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
    weight: cython.const[cython.uchar][:, ::1],
    grey: cython.const[cython.float][:, ::1],
    where: cython.const[cython.uchar][:, ::1],
    window: Window,
    rule: Rule,
    samples: Samples,
    result: cython.float[:, ::1],
    share: cython.float[:, ::1],
    error: cython.float[:, ::1],
) -> None:
    """Give pixels the disparity of planes, its inliers' share and its error.

    Args:
        disparity: of the samples, px, (rows, width), NaN = none.
        weight: twice what they weigh, 0 = none.
        grey: levels.
        where: pixels that want a plane, 0 or 1.
        window, rule, samples: see there.
        result: px; gets the planes' disparity.
        share, error: get the inliers' share and the error in px.
    """
    rows: cython.int = cython.cast(cython.int, disparity.shape[0])
    width: cython.int = cython.cast(cython.int, disparity.shape[1])
    plane: Plane = Plane()
    down: cython.int
    across: cython.int
    i: cython.int
    j: cython.int
    with cython.nogil:
        lay_out(disparity, weight, grey, window, samples)
        for down in range((rows + window.block_y - 1) // window.block_y):
            top: cython.int = down * window.block_y
            bottom: cython.int = min(top + window.block_y, rows)
            join(where[top:bottom], samples.wanted)
            for across in range((width + window.block_x - 1) // window.block_x):
                left: cython.int = across * window.block_x
                right: cython.int = min(left + window.block_x, width)
                if not is_some(samples.wanted, left, right):
                    continue
                # The wanted pixel nearest to the block's middle represents it.
                nearest: cython.int = rows + width
                y: cython.int = 0
                x: cython.int = 0
                for j in range(top, bottom):
                    for i in range(left, right):
                        if where[j, i] and not result[j, i] >= rule.below_px:
                            away: cython.int = abs(2 * j - top - bottom + 1) + abs(
                                2 * i - left - right + 1
                            )
                            if away < nearest:
                                nearest = away
                                y = j
                                x = i
                if nearest == rows + width:
                    continue
                collect(rows, width, grey[y, x], y, x, window, samples)
                solve(y, x, window, samples, plane)
                if plane.share <= 0 and not rule.decides:
                    continue
                for j in range(top, bottom):
                    for i in range(left, right):
                        if where[j, i] and not result[j, i] >= rule.below_px:
                            take(plane, j - y, i - x, rule, result[j], share[j], error[j], i)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def join(where: cython.const[cython.uchar][:, ::1], result: cython.uchar[::1]) -> cython.void:
    """Fill in the columns in which something is set in any row."""
    y: cython.Py_ssize_t
    x: cython.Py_ssize_t
    result[:] = 0
    for y in range(where.shape[0]):
        for x in range(result.shape[0]):
            result[x] |= where[y, x]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def is_some(
    wanted: cython.const[cython.uchar][::1], begin: cython.int, end: cython.int
) -> cython.bint:
    """Return whether anything is set in some columns."""
    x: cython.int
    some: cython.uchar = 0
    for x in range(begin, end):
        some |= wanted[x]
    return some != 0


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def take(
    plane: Plane,
    down: cython.int,
    along: cython.int,
    rule: Rule,
    result: cython.float[::1],
    share: cython.float[::1],
    error: cython.float[::1],
    x: cython.int,
) -> cython.void:
    """Give a pixel the disparity of a plane, if the rule lets it."""
    found: cython.float = cython.cast(
        cython.float, plane.here + plane.along * along + plane.down * down
    )
    if rule.decides:
        result[x] = found if plane.share > 0 else NAN
        share[x] = cython.cast(cython.float, plane.share) if plane.share > 0 else NAN
        if rule.tells_error:
            error[x] = cython.cast(cython.float, plane.error_px) if plane.share > 0 else NAN
        return
    before: cython.float = result[x]
    if (
        cython.cast(cython.float, plane.error_px) < rule.max_error_px
        and not abs(found - before) > rule.max_change_px
        and (before < rule.far_px or found < rule.far_px)
        and (not rule.unseen or x + found > result.shape[0] - 1)
    ):
        result[x] = found
        share[x] = cython.cast(cython.float, plane.share)
        if rule.tells_error:
            error[x] = cython.cast(cython.float, plane.error_px)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def lay_out(
    disparity: cython.const[cython.float][:, ::1],
    weight: cython.const[cython.uchar][:, ::1],
    grey: cython.const[cython.float][:, ::1],
    window: Window,
    samples: Samples,
) -> cython.void:
    """Collect all samples of an image: of some weight and of known disparity."""
    rows: cython.int = cython.cast(cython.int, disparity.shape[0])
    width: cython.int = cython.cast(cython.int, disparity.shape[1])
    per_px: cython.float = cython.cast(cython.float, samples.per_px)
    largest: cython.float = cython.cast(cython.float, samples.counts.shape[0] - 1) / 2
    i: cython.int
    j: cython.int
    n: cython.int = 0
    for j in range((rows + window.step_y - 1) // window.step_y):
        y: cython.int = j * window.step_y
        offset: cython.int = j * window.shift % window.step_x
        across: cython.int = (width - offset + window.step_x - 1) // window.step_x
        for i in range(across):
            x: cython.int = offset + i * window.step_x
            d: cython.float = disparity[y, x]
            w: cython.int = weight[y, x]
            samples.first[j, i] = n
            if w > 0 and d >= 0:
                d = min(d, largest)
                samples.steps[n] = i - j * window.shift // window.step_x
                samples.depth[n] = cython.cast(cython.int, d * per_px + HALF)
                samples.half[n] = w
                samples.grey[n] = grey[y, x]
                n += 1
        samples.first[j, across] = n


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def collect(
    rows: cython.int,
    width: cython.int,
    here: cython.float,
    y: cython.int,
    x: cython.int,
    window: Window,
    samples: Samples,
) -> cython.void:
    """Collect the samples around a pixel that have about its grey."""
    j: cython.int
    k: cython.int
    n: cython.int = 0
    total: cython.int = 0
    at_y: cython.int = y // window.step_y
    at_x: cython.int = x // window.step_x - at_y * window.shift // window.step_x
    top: cython.int = (max(y - window.reach_y, 0) + window.step_y - 1) // window.step_y
    bottom: cython.int = min(y + window.reach_y, rows - 1) // window.step_y + 1
    for j in range(top, bottom):
        offset: cython.int = j * window.shift % window.step_x
        left: cython.int = (
            max(x - window.reach_x - offset, 0) + window.step_x - 1
        ) // window.step_x
        right: cython.int = (
            min(x + window.reach_x, width - 1) - offset + window.step_x
        ) // window.step_x
        for k in range(samples.first[j, left], samples.first[j, right]):
            samples.x[n] = samples.steps[k] - at_x
            samples.y[n] = j - at_y
            samples.disparity[n] = samples.depth[k]
            samples.weight[n] = samples.half[k]
            alike: cython.bint = abs(samples.grey[k] - here) <= window.max_grey
            total += samples.half[k] if alike else 0
            n += alike
    samples.used = n
    samples.total = total


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def median_of(samples: Samples) -> cython.double:
    """Return the weighted median of the samples' disparities, to 0.5 px."""
    k: cython.int
    part: cython.int = 0
    half_px: cython.int = samples.bits - 1  # bits that are less
    samples.counts[:] = 0
    for k in range(samples.used):
        samples.counts[samples.disparity[k] >> half_px] += samples.weight[k]
    for k in range(cython.cast(cython.int, samples.counts.shape[0])):
        part += samples.counts[k]
        if 2 * part >= samples.total:
            break
    return 0.5 * k + 0.25


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def solve(
    y: cython.int, x: cython.int, window: Window, samples: Samples, plane: Plane
) -> cython.void:
    """Fit a plane repeatedly to samples near the last one, first to those near the median."""
    turn: cython.int
    plane.share = 0
    if samples.used < LEAST:
        return
    plane.here = median_of(samples)
    plane.along = plane.down = 0
    # Where the point that samples are counted from lies.
    at_y: cython.int = y // window.step_y
    at_x: cython.int = x // window.step_x - at_y * window.shift // window.step_x
    right: cython.int = at_x * window.step_x + at_y * window.shift - x
    below: cython.int = at_y * window.step_y - y
    for turn in range(window.rounds):
        wider: cython.int = 1 << min(max(window.rounds - 2 - turn, 0), 2)
        add_up(
            samples.x[: samples.used],
            samples.y,
            samples.disparity,
            samples.weight,
            origin(plane, right, below, samples.per_px),
            cython.cast(cython.float, plane.along * window.step_x * samples.per_px),
            cython.cast(cython.float, a_row_down(plane, window) * samples.per_px),
            window.tolerance_px * wider * samples.per_px,
            samples.sums,
        )
        if not improve(samples, right, below, window, plane):
            return
    residual: cython.int = squared(
        samples.x[: samples.used],
        samples.y,
        samples.disparity,
        samples.weight,
        origin(plane, right, below, samples.per_px),
        cython.cast(cython.float, plane.along * window.step_x * samples.per_px),
        cython.cast(cython.float, a_row_down(plane, window) * samples.per_px),
        window.tolerance_px * samples.per_px,
    )
    judge(window, samples, residual, plane)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def add_up(
    at_x: cython.const[cython.int][::1],
    at_y: cython.const[cython.int][::1],
    disparity: cython.const[cython.int][::1],
    weight: cython.const[cython.int][::1],
    here: cython.float,
    along: cython.float,
    down: cython.float,
    tolerance: cython.float,
    sums: cython.int[::1],
) -> cython.void:
    """Fill in, of the samples near a plane, the number, the weight, and weighted sums of products.

    These are x, y, disparity d, x x, x y, y y, x d and y d.
    """
    k: cython.Py_ssize_t
    count: cython.int = 0
    s: cython.int = 0
    sx: cython.int = 0
    sy: cython.int = 0
    sd: cython.int = 0
    xx: cython.int = 0
    xy: cython.int = 0
    yy: cython.int = 0
    xd: cython.int = 0
    yd: cython.int = 0
    for k in range(at_x.shape[0]):
        x: cython.int = at_x[k]
        y: cython.int = at_y[k]
        d: cython.int = disparity[k]
        there: cython.float = here + along * x + down * y
        near: cython.bint = abs(d - there) <= tolerance
        w: cython.int = weight[k] if near else 0
        count += near
        s += w
        sx += w * x
        sy += w * y
        sd += w * d
        xx += w * x * x
        xy += w * x * y
        yy += w * y * y
        xd += w * x * d
        yd += w * y * d
    sums[0] = count
    sums[1] = s
    sums[2] = sx
    sums[3] = sy
    sums[4] = sd
    sums[5] = xx
    sums[6] = xy
    sums[7] = yy
    sums[8] = xd
    sums[9] = yd


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def squared(
    at_x: cython.const[cython.int][::1],
    at_y: cython.const[cython.int][::1],
    disparity: cython.const[cython.int][::1],
    weight: cython.const[cython.int][::1],
    here: cython.float,
    along: cython.float,
    down: cython.float,
    tolerance: cython.float,
) -> cython.int:
    """Return the weighted sum of squared distances of the samples near a plane from it."""
    k: cython.Py_ssize_t
    total: cython.int = 0
    for k in range(at_x.shape[0]):
        away: cython.float = abs(disparity[k] - (here + along * at_x[k] + down * at_y[k]))
        steps: cython.int = cython.cast(cython.int, away + HALF) if away <= tolerance else 0
        total += weight[k] * steps * steps
    return total


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def a_row_down(plane: Plane, window: Window) -> cython.double:
    """Return what a plane's disparity changes by from a sample to one a row farther down."""
    return plane.down * window.step_y + plane.along * window.shift


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def origin(plane: Plane, right: cython.int, below: cython.int, per_px: cython.int) -> cython.float:
    """Return a plane's disparity where samples are counted from."""
    return cython.cast(
        cython.float, (plane.here + plane.along * right + plane.down * below) * per_px
    )


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def improve(
    samples: Samples, right: cython.int, below: cython.int, window: Window, plane: Plane
) -> cython.bint:
    """Fit a plane by least squares to the inliers of the last; return whether they are enough.

    ``right`` and ``below`` tell where samples are counted from.
    """
    if samples.sums[0] < LEAST:
        return False
    wide: cython.double = window.step_x
    high: cython.double = window.step_y
    more: cython.double = window.shift
    # Sums of weights, not of twice the weights; in px, and from the pixel on.
    s: cython.double = 0.5 * samples.sums[1]
    sx: cython.double = 0.5 * (samples.sums[2] * wide + samples.sums[3] * more)
    sy: cython.double = 0.5 * samples.sums[3] * high
    sd: cython.double = 0.5 * samples.sums[4] / samples.per_px
    xx: cython.double = 0.5 * (
        samples.sums[5] * wide * wide
        + 2 * samples.sums[6] * wide * more
        + samples.sums[7] * more * more
    )
    xy: cython.double = 0.5 * (samples.sums[6] * wide + samples.sums[7] * more) * high
    yy: cython.double = 0.5 * samples.sums[7] * high * high
    xd: cython.double = 0.5 * (samples.sums[8] * wide + samples.sums[9] * more) / samples.per_px
    yd: cython.double = 0.5 * samples.sums[9] * high / samples.per_px
    # Around their centroid. A little is added to the spread, so that few rows or columns make no
    # steep plane.
    xx += 4 * s - sx * sx / s
    yy += 4 * s - sy * sy / s
    xy -= sx * sy / s
    xd -= sd * sx / s
    yd -= sd * sy / s
    plane.weight = s
    plane.middle_x = sx / s + right
    plane.middle_y = sy / s + below
    plane.along = (xd * yy - yd * xy) / (xx * yy - xy * xy)
    plane.down = (yd * xx - xd * xy) / (xx * yy - xy * xy)
    plane.here = sd / s - plane.along * plane.middle_x - plane.down * plane.middle_y
    plane.xx = xx
    plane.xy = xy
    plane.yy = yy
    return True


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def judge(window: Window, samples: Samples, residual: cython.int, plane: Plane) -> cython.void:
    """Fill in a plane's error and its inliers' share, if it qualifies."""
    x: cython.double = plane.middle_x
    y: cython.double = plane.middle_y
    total: cython.double = 0.5 * samples.total
    if (
        plane.here < 0
        or plane.weight < window.min_share * total
        or abs(x) > window.max_off_centre * window.reach_x
        or abs(y) > window.max_off_centre * window.reach_y
    ):
        return
    variance: cython.double = (
        0.5 * residual / (cython.cast(cython.double, samples.per_px) * samples.per_px)
    ) / plane.weight
    lever: cython.double = 1 / plane.weight + (
        x * x * plane.yy - 2 * x * y * plane.xy + y * y * plane.xx
    ) / (plane.xx * plane.yy - plane.xy * plane.xy)
    plane.share = plane.weight / total
    plane.error_px = window.dependent * sqrt(max(variance, MIN_VARIANCE) * lever)
