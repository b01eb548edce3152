"""Semi-global matching: the loops of :mod:`motionstereo_cli.method.dense`.

Costs are int16, and the innermost loops run over disparities, which are contiguous in memory, so
that compilers vectorise them.

The path from below needs the costs of all rows below first. Rows are processed in strips, so that
the volume of all costs is never in memory: a first pass from the last strip to the second stores
the path at the border of each strip, and a second pass, from the first strip on, computes the costs
of the strip again, takes the path up, and then along its rows and down. An image of one strip needs
no first pass.
"""

import cython
import numpy as np

NAN = cython.declare(cython.float, np.nan)
#: Cost outside the range, above any other cost.
OUTSIDE = cython.declare(cython.short, 20000)
MAX_COST = cython.declare(cython.short, 32767)
#: Proposals are in parts of a px.
PARTS = cython.declare(cython.int, 16)


#: Memory for the costs of a strip, in bytes.
STRIP_BYTES = cython.declare(cython.Py_ssize_t, 1 << 25)


@cython.cclass
class Workspace:
    """Reusable buffers for matching a frame.

    Args:
        rows, width: of the images in px.
        count: number of disparities.
        strip_rows: rows of a strip, even; 0 = as many as :data:`STRIP_BYTES` hold.
    """

    strip_rows: cython.int
    low: cython.short[::1]  # of a left row, continued beyond its border by its last pixel:
    high: cython.short[::1]  # the least and the largest grey within half a pixel
    slope: cython.short[::1]
    single: cython.short[:, ::1]  # costs of the pixels of a row
    boxes: cython.short[:, :, ::1]  # of three rows, added up across
    window: cython.short[:, ::1]  # and added up down
    cost: cython.short[:, :, ::1]  # of the rows of a strip
    total: cython.short[:, :, ::1]  # of all paths, likewise
    across: cython.short[:, ::1]  # paths: from the left and from the right, old and new
    down: cython.short[:, ::1]  # from above, to all columns, old and new
    min_down: cython.short[::1]  # below 0 where no path comes from above
    up: cython.short[:, ::1]  # from below, likewise
    min_up: cython.short[::1]
    brought: cython.short[:, :, ::1]  # to each strip by the path from below: the second half of up
    min_brought: cython.short[:, ::1]
    best: cython.int[::1]
    partner: cython.int[::1]  # of each left pixel: its disparity
    partner_cost: cython.int[::1]

    def __init__(
        self,
        rows: cython.Py_ssize_t,
        width: cython.Py_ssize_t,
        count: cython.Py_ssize_t,
        strip_rows: cython.Py_ssize_t = 0,
    ):
        fitting: cython.Py_ssize_t = STRIP_BYTES // (2 * width * count)
        height: cython.Py_ssize_t = min(strip_rows or max(fitting // 2 * 2, 2), rows)
        strips: cython.Py_ssize_t = (rows + height - 1) // height
        self.strip_rows = cython.cast(cython.int, height)
        self.low = np.zeros(width + count, np.int16)
        self.high = np.zeros(width + count, np.int16)
        self.slope = np.zeros(width + count, np.int16)
        self.single = np.zeros((width, count), np.int16)
        self.boxes = np.zeros((3, width, count), np.int16)
        self.window = np.zeros((width, count), np.int16)
        self.cost = np.zeros((height, width, count), np.int16)
        self.total = np.zeros((height, width, count), np.int16)
        self.across = np.full((4, count + 2), OUTSIDE, np.int16)
        self.down = np.full((2 * width, count + 2), OUTSIDE, np.int16)
        self.min_down = np.zeros(width, np.int16)
        self.up = np.full((2 * width, count + 2), OUTSIDE, np.int16)
        self.min_up = np.zeros(width, np.int16)
        self.brought = np.full((strips, width, count + 2), OUTSIDE, np.int16)
        self.min_brought = np.zeros((strips, width), np.int16)
        self.best = np.zeros(width, np.int32)
        self.partner = np.zeros(width + count, np.int32)
        self.partner_cost = np.zeros(width + count, np.int32)


@cython.cclass
@cython.dataclasses.dataclass
class Weights:
    """Parameters of the costs; see :mod:`motionstereo_cli.method.dense`."""

    max_grey: cython.short
    max_slope: cython.short
    step: cython.short
    leap: cython.short
    min_leap: cython.short
    per_grey_level: cython.short
    min_margin: cython.float
    min_share: cython.float


@cython.cclass
@cython.dataclasses.dataclass(eq=False)
class Frame:
    """Input of the matching: two views and proposals. All are (rows, width).

    Attributes:
        right, left: grey.
        right_slope, left_slope: slopes of grey, of the same kind.
        where: pixels to match, 0 or 1.
        proposed: preferred disparities in px.
        weight: cost of all others, 0 where none is preferred.
    """

    right: cython.const[cython.short][:, ::1]
    left: cython.const[cython.short][:, ::1]
    right_slope: cython.const[cython.short][:, ::1]
    left_slope: cython.const[cython.short][:, ::1]
    where: cython.const[cython.uchar][:, ::1]
    proposed: cython.const[cython.float][:, ::1]
    weight: cython.const[cython.short][:, ::1]


def semi_global(
    frame: Frame,
    weights: Weights,
    work: Workspace,
    disparity: cython.float[:, ::1],
    margin: cython.float[:, ::1],
) -> None:
    """Fill in disparity and margin, (rows, width); ``work`` is for this size and range."""
    rows: cython.int = cython.cast(cython.int, disparity.shape[0])
    width: cython.Py_ssize_t = disparity.shape[1]
    height: cython.int = work.strip_rows
    strips: cython.int = (rows + height - 1) // height
    strip: cython.int
    y: cython.int
    with cython.nogil:
        work.min_up[:] = -1
        for strip in range(strips - 1, 0, -1):
            work.brought[strip, :, :] = work.up[width:]
            work.min_brought[strip, :] = work.min_up
            fill_costs(frame, strip, weights, work)
            go_up(frame, strip, weights, work)
        work.min_down[:] = -1
        for strip in range(strips):
            if strip > 0:
                work.up[width:, :] = work.brought[strip]
                work.min_up[:] = work.min_brought[strip]
            fill_costs(frame, strip, weights, work)
            go_up(frame, strip, weights, work)
            for y in range(strip * height, min((strip + 1) * height, rows)):
                go_across(frame, y, weights, work)
                go_along(frame, y, y - 1, work.down, work.min_down, -1, weights, work)
                choose(frame, y, weights, work, margin)
                paint(y, work, disparity, margin)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def fill_costs(frame: Frame, strip: cython.int, weights: Weights, work: Workspace) -> cython.void:
    """Fill in the costs of the rows of a strip."""
    rows: cython.int = cython.cast(cython.int, frame.right.shape[0])
    first: cython.int = strip * work.strip_rows
    end: cython.int = min(first + work.strip_rows, rows)
    last: cython.int
    work.window[:, :] = 0
    work.boxes[:, :, :] = 0
    for last in range(first - 1, end + 1):  # row of the window
        source: cython.int = min(max(last, 0), rows - 1)
        extend(frame, source, work)
        differences(frame, source, weights, work)
        add_up((last + 1) % 3, work)
        if last > first:
            propose(frame, last - 1, work)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def extend(frame: Frame, y: cython.int, work: Workspace) -> cython.void:
    """Fill in slopes, and the least and largest grey within half a pixel, of a left row."""
    x: cython.int
    last: cython.int = cython.cast(cython.int, frame.left.shape[1]) - 1
    for x in range(cython.cast(cython.int, work.low.shape[0])):
        here: cython.int = frame.left[y, min(x, last)]
        before: cython.int = (here + frame.left[y, min(max(x - 1, 0), last)]) // 2
        after: cython.int = (here + frame.left[y, min(x + 1, last)]) // 2
        work.low[x] = cython.cast(cython.short, min(here, before, after))
        work.high[x] = cython.cast(cython.short, max(here, before, after))
        work.slope[x] = frame.left_slope[y, min(x, last)]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def differences(frame: Frame, y: cython.int, weights: Weights, work: Workspace) -> cython.void:
    """Fill in the difference of each right pixel of a row to the left one at each disparity."""
    x: cython.Py_ssize_t
    d: cython.Py_ssize_t
    low: cython.short[::1] = work.low
    high: cython.short[::1] = work.high
    slopes: cython.short[::1] = work.slope
    cost: cython.short[:, ::1] = work.single
    max_grey: cython.short = weights.max_grey
    max_slope: cython.short = weights.max_slope
    for x in range(cost.shape[0]):
        grey: cython.short = frame.right[y, x]
        slope: cython.short = frame.right_slope[y, x]
        for d in range(cost.shape[1]):
            below: cython.short = low[x + d] - grey
            above: cython.short = grey - high[x + d]
            differs: cython.short = above if above > below else below
            differs = differs if differs > 0 else 0
            differs = differs if differs < max_grey else max_grey
            less: cython.short = slopes[x + d] - slope
            more: cython.short = slope - slopes[x + d]
            leans: cython.short = more if more > less else less
            leans = leans if leans < max_slope else max_slope
            cost[x, d] = differs + leans


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def add_up(slot: cython.int, work: Workspace) -> cython.void:
    """Add up a row's costs across, and replace those of the oldest row in the windows."""
    x: cython.Py_ssize_t
    d: cython.Py_ssize_t
    single: cython.short[:, ::1] = work.single
    boxes: cython.short[:, :, ::1] = work.boxes
    window: cython.short[:, ::1] = work.window
    last: cython.Py_ssize_t = single.shape[0] - 1
    for x in range(last + 1):
        before: cython.Py_ssize_t = max(x - 1, 0)
        after: cython.Py_ssize_t = min(x + 1, last)
        for d in range(single.shape[1]):
            box: cython.short = single[before, d] + single[x, d] + single[after, d]
            window[x, d] = window[x, d] - boxes[slot, x, d] + box
            boxes[slot, x, d] = box


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def propose(frame: Frame, y: cython.int, work: Workspace) -> cython.void:
    """Fill in the costs of a row: those of the windows, and more where another is proposed."""
    x: cython.Py_ssize_t
    d: cython.Py_ssize_t
    k: cython.int
    window: cython.short[:, ::1] = work.window
    cost: cython.short[:, ::1] = work.cost[y % work.strip_rows]
    total: cython.short[:, ::1] = work.total[y % work.strip_rows]
    count: cython.int = cython.cast(cython.int, cost.shape[1])
    for x in range(cost.shape[0]):
        if not frame.where[y, x]:
            continue
        w: cython.short = frame.weight[y, x]
        for d in range(cost.shape[1]):
            cost[x, d] = window[x, d] + w
            total[x, d] = 0
        wanted: cython.float = frame.proposed[y, x]
        if w > 0 and -3 < wanted < count + 3:
            parts: cython.int = cython.cast(cython.int, wanted * PARTS)
            near: cython.int = parts // PARTS
            for k in range(max(near - 2, 0), min(near + 4, count)):
                share: cython.int = 2 * PARTS - abs(PARTS * k - parts)
                if share > 0:
                    less: cython.int = w * share // (2 * PARTS)
                    cost[x, k] = cost[x, k] - cython.cast(cython.short, less)


@cython.cfunc
@cython.nogil
@cython.inline
@cython.exceptval(check=False)
def go_on(
    path: cython.short[:, ::1],
    now: cython.Py_ssize_t,
    after: cython.Py_ssize_t,
    least: cython.short,
    edge: cython.int,
    cost: cython.short[:, ::1],
    total: cython.short[:, ::1],
    x: cython.Py_ssize_t,
    keeps: cython.short,
    weights: Weights,
) -> cython.short:
    """Advance a path to the pixel ``x``, add its costs to the total, and return the least of them.

    Row ``now`` of ``path`` has the costs so far, of which ``least`` is the least, below 0 where the
    path begins; row ``after`` gets those at ``x``. ``edge`` is by how much grey changes on the way.
    ``keeps``: bits that the total gets of what the step adds to the cost of the pixel.
    """
    d: cython.Py_ssize_t
    count: cython.Py_ssize_t = cost.shape[1]
    step: cython.short = weights.step
    leap: cython.short = cython.cast(
        cython.short, max(weights.leap - weights.per_grey_level * edge, weights.min_leap)
    )
    if least < 0:
        least = leap = 0
        for d in range(1, count + 1):
            path[now, d] = 0
    limit: cython.short = least + leap
    for d in range(count):
        here: cython.short = path[now, d + 1]
        up: cython.short = path[now, d] + step
        more: cython.short = path[now, d + 2] + step
        here = here if here < up else up
        here = here if here < more else more
        here = here if here < limit else limit
        here = here - least
        path[after, d + 1] = here + cost[x, d]
        total[x, d] = total[x, d] + (here & keeps) + cost[x, d]
    least = OUTSIDE
    for d in range(1, count + 1):
        least = path[after, d] if path[after, d] < least else least
    return least


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def go_across(frame: Frame, y: cython.int, weights: Weights, work: Workspace) -> cython.void:
    """Go along a row from both ends in turn, and add the paths' costs to the total.

    Each step depends on the last one; two alternating paths keep the processor busy.
    """
    i: cython.Py_ssize_t
    cost: cython.short[:, ::1] = work.cost[y % work.strip_rows]
    total: cython.short[:, ::1] = work.total[y % work.strip_rows]
    path: cython.short[:, ::1] = work.across
    width: cython.Py_ssize_t = cost.shape[0]
    min_left: cython.short = -1  # below 0 where no path comes from before
    min_right: cython.short = -1
    for i in range(2 * width):
        from_right: cython.Py_ssize_t = i & 1
        x: cython.Py_ssize_t = width - 1 - (i >> 1) if from_right else i >> 1
        now: cython.Py_ssize_t = (i & 2) + from_right
        after: cython.Py_ssize_t = 2 - (i & 2) + from_right
        least: cython.short = -1
        if frame.where[y, x]:
            least = min_right if from_right else min_left
            beside: cython.Py_ssize_t = min(x + 1, width - 1) if from_right else max(x - 1, 0)
            edge: cython.int = abs(frame.right[y, x] - frame.right[y, beside])
            least = go_on(path, now, after, least, edge, cost, total, x, -1, weights)
        if from_right:
            min_right = least
        else:
            min_left = least


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def go_up(frame: Frame, strip: cython.int, weights: Weights, work: Workspace) -> cython.void:
    """Go up the rows of a strip, and add the path's costs to the totals."""
    rows: cython.int = cython.cast(cython.int, frame.right.shape[0])
    first: cython.int = strip * work.strip_rows
    y: cython.int
    for y in range(min(first + work.strip_rows, rows) - 1, first - 1, -1):
        go_along(frame, y, y + 1, work.up, work.min_up, ~1, weights, work)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def go_along(
    frame: Frame,
    y: cython.int,
    before: cython.int,
    path: cython.short[:, ::1],
    min_path: cython.short[::1],
    keeps: cython.short,
    weights: Weights,
    work: Workspace,
) -> cython.void:
    """Go from the row ``before`` to ``y`` in all columns, and add the path's costs to the total."""
    x: cython.Py_ssize_t
    cost: cython.short[:, ::1] = work.cost[y % work.strip_rows]
    total: cython.short[:, ::1] = work.total[y % work.strip_rows]
    width: cython.Py_ssize_t = cost.shape[0]
    now: cython.Py_ssize_t = (y & 1) * width
    after: cython.Py_ssize_t = width - now
    source: cython.int = min(max(before, 0), cython.cast(cython.int, frame.right.shape[0]) - 1)
    for x in range(width):
        least: cython.short = -1
        if frame.where[y, x]:
            least = min_path[x]
            edge: cython.int = abs(frame.right[y, x] - frame.right[source, x])
            least = go_on(path, now + x, after + x, least, edge, cost, total, x, keeps, weights)
        min_path[x] = least


@cython.cfunc
@cython.nogil
@cython.inline
@cython.exceptval(check=False)
def min_of(
    total: cython.short[:, ::1],
    x: cython.Py_ssize_t,
    begin: cython.Py_ssize_t,
    end: cython.Py_ssize_t,
) -> cython.short:
    """Return the least of a pixel's costs for some disparities."""
    d: cython.Py_ssize_t
    least: cython.short = MAX_COST
    for d in range(begin, end):
        least = total[x, d] if total[x, d] < least else least
    return least


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def choose(
    frame: Frame, y: cython.int, weights: Weights, work: Workspace, margin: cython.float[:, ::1]
) -> cython.void:
    """Fill in the disparity of least cost, -1 = unknown, and its margin."""
    x: cython.Py_ssize_t
    total: cython.short[:, ::1] = work.total[y % work.strip_rows]
    count: cython.Py_ssize_t = total.shape[1]
    work.partner[:] = -2
    for x in range(total.shape[0]):
        work.best[x] = -1
        if not frame.where[y, x]:
            continue
        least: cython.short = min_of(total, x, 0, count)
        found: cython.Py_ssize_t = 0
        while total[x, found] != least:
            found += 1
        # Its neighbours are not rivals.
        second: cython.short = min(
            min_of(total, x, 0, found - 1), min_of(total, x, found + 2, count)
        )
        if work.partner[x + found] == -2 or least < work.partner_cost[x + found]:
            work.partner[x + found] = cython.cast(cython.int, found)
            work.partner_cost[x + found] = least
        excess: cython.float = cython.cast(cython.float, second - least)
        if excess >= max(weights.min_margin, weights.min_share * second):
            work.best[x] = cython.cast(cython.int, found)
            margin[y, x] = excess


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def paint(
    y: cython.int, work: Workspace, disparity: cython.float[:, ::1], margin: cython.float[:, ::1]
) -> cython.void:
    """Fill in sub-pixel disparities: where lines of equal slope through three costs meet.

    A left pixel is the partner of one right pixel, and of those that agree with it within 1 px. A
    partner beyond the border is not visible: it has to continue the partner of the last pixel.
    """
    x: cython.int
    total: cython.short[:, ::1] = work.total[y % work.strip_rows]
    width: cython.int = cython.cast(cython.int, total.shape[0])
    last: cython.Py_ssize_t = total.shape[1] - 1
    before: cython.int = -2
    for x in range(width):
        d: cython.int = work.best[x]
        if d >= 0 and (
            abs(work.partner[x + d] - d) > 1 or (x + d >= width and abs(before - d) > 1)
        ):
            d = -1
        before = d if d >= 0 else -2
        if d < 0:
            disparity[y, x] = NAN
            margin[y, x] = NAN
            continue
        disparity[y, x] = cython.cast(cython.float, d)
        if 0 < d < last:
            below: cython.int = total[x, d - 1] - total[x, d]
            above: cython.int = total[x, d + 1] - total[x, d]
            disparity[y, x] += cython.cast(cython.float, below - above) / (2 * max(below, above, 1))


def weigh(
    proposed: cython.const[cython.float][:, ::1],
    keys: cython.const[cython.ushort][:, ::1],
    fresh: cython.const[cython.uchar][:, ::1],
    reach: cython.int,
    if_fresh: cython.short,
    if_old: cython.short,
    ends: cython.uchar[::1],
    near: cython.uchar[::1],
    weight: cython.short[:, ::1],
) -> None:
    """Fill in weights: see :func:`motionstereo_cli.method.dense.weights_of`.

    Args:
        proposed: disparities of trails, (rows, width), NaN = none.
        keys: equal within a trail.
        fresh: where they are of this very frame, 0 or 1.
        reach: how far from the end of a trail it proposes, px.
        if_fresh, if_old: the weights.
        ends, near: room for a row, ``ends`` for 2 * reach more, all 0.
        weight: gets the result.
    """
    y: cython.Py_ssize_t
    k: cython.Py_ssize_t
    with cython.nogil:
        for y in range(keys.shape[0]):
            find_ends(keys[y], reach, ends)
            near[:] = 0
            for k in range(1, 2 * reach + 1):
                join(ends[k:], near)
            weigh_row(proposed[y], fresh[y], near, if_fresh, if_old, weight[y])


# Compilers vectorise loops over arrays that are arguments of a separate function.


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def find_ends(
    keys: cython.const[cython.ushort][::1], reach: cython.Py_ssize_t, ends: cython.uchar[::1]
) -> cython.void:
    """Fill in where a trail begins that is not the first of its row, from place ``reach`` on."""
    x: cython.Py_ssize_t
    for x in range(1, keys.shape[0]):
        ends[reach + x] = keys[x] != keys[x - 1]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def join(row: cython.const[cython.uchar][::1], result: cython.uchar[::1]) -> cython.void:
    """Add what is set in a row."""
    x: cython.Py_ssize_t
    for x in range(result.shape[0]):
        result[x] |= row[x]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def weigh_row(
    proposed: cython.const[cython.float][::1],
    fresh: cython.const[cython.uchar][::1],
    near: cython.const[cython.uchar][::1],
    if_fresh: cython.short,
    if_old: cython.short,
    weight: cython.short[::1],
) -> cython.void:
    """Fill in a row of weights."""
    x: cython.Py_ssize_t
    for x in range(weight.shape[0]):
        proposes: cython.bint = (proposed[x] == proposed[x]) & (near[x] != 0)
        w: cython.short = if_fresh if fresh[x] else if_old
        weight[x] = w if proposes else 0
