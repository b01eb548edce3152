"""Disparity by what both views show now: semi-global matching, with trails as proposals.

After Hirschmueller, "Stereo Processing by Semiglobal Matching and Mutual Information" (2008), with
three paths (from the left, from the right, from above): so it goes row by row and holds no volume
of costs. Costs are int16, and the loops over disparities run along the memory: compilers turn them
into vector instructions.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import kernel

Shorts = NDArray[np.int16]

#: Views are matched at half the height: half the time, and no worse, for noise averages out.
_ROWS = 2

#: Largest difference of grey, and of its slope in quarters of a level per px, that counts.
_MOST_GREY, _MOST_SLOPE = 20, 20

#: Costs are added up over so many pixels to each side.
_RADIUS = 1

#: Penalties of a step by 1 px and by more between neighbours. The latter falls by a share of the
#: step of grey between them: that is where things end.
_STEP, _LEAP, _LEAST_LEAP, _PER_GREY_LEVEL = 72, 300, 120, 3

#: What speaks against all other disparities where one is proposed, in this very frame or before.
_FRESH, _OLD = 15, 5

#: Nothing is known where the second best disparity costs less than this more than the best, or
#: less than this share more.
_LEAST_MARGIN, _LEAST_SHARE = 60, 0.05

#: Pixels so far above and below, and to the sides, of those wanted are matched as well: they tell
#: what lies around.
_AROUND_ROWS, _AROUND_COLUMNS = 16, 32

#: Cost of what lies outside the range.
_OUTSIDE = np.int16(20000)


def match_dense(
    right: NDArray[np.uint8],
    left: NDArray[np.uint8],
    where: NDArray[np.bool_],
    proposed_px: NDArray[np.float32],
    fresh: NDArray[np.bool_],
    max_disparity: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return disparity and its margin, (height, width) float32 each, NaN = unknown.

    Some pixels around those wanted have one as well. The margin is by how much the cost of the
    second best disparity exceeds that of the best.

    Args:
        right, left: views of equal brightness, (height, width) uint8.
        where: right pixels wanted, (height, width) bool.
        proposed_px: disparities to prefer where grey does not decide, (height, width) float32,
            NaN = none.
        fresh: where they are of this very frame, (height, width) bool.
        max_disparity: largest x in the left view minus x in the right one, px.
    """
    height = right.shape[0]
    upper = np.arange(0, height, _ROWS)
    lower = np.minimum(upper + 1, height - 1)
    right_grey, left_grey = (_halved(view, lower) for view in (right, left))
    weights = np.where(fresh, np.int16(_FRESH), np.int16(_OLD))
    weights[np.isnan(proposed_px)] = 0
    heavier = np.where(weights[lower] > weights[upper], lower[:, None], upper[:, None])
    disparity, margin = semi_global(
        right_grey.astype(np.int16),
        left_grey.astype(np.int16),
        _slopes(right_grey),
        _slopes(left_grey),
        _around(where[upper] | where[lower]),
        np.take_along_axis(proposed_px, heavier, axis=0),
        np.take_along_axis(weights, heavier, axis=0),
        max_disparity,
    )
    return (
        np.repeat(disparity, _ROWS, axis=0)[:height],
        np.repeat(margin, _ROWS, axis=0)[:height],
    )


def _halved(view: NDArray[np.uint8], lower: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Return an image of means of two rows; of an odd number of rows the last one stands alone."""
    even = view if len(view) == 2 * len(lower) else np.concatenate((view, view[-1:]))
    size = view.shape[1], len(lower)
    return np.asarray(cv2.resize(even, size, interpolation=cv2.INTER_AREA), np.uint8)


def _slopes(grey: NDArray[np.uint8]) -> NDArray[np.int16]:
    """Return slopes of grey, which do not mind a difference in brightness between the views."""
    return (np.clip(cv2.Sobel(grey, cv2.CV_16S, 1, 0), -80, 80) // 2).astype(np.int16)


def _around(where: NDArray[np.bool_]) -> NDArray[np.bool_]:
    size = 2 * _AROUND_COLUMNS + 1, 2 * _AROUND_ROWS // _ROWS + 1
    box = cv2.getStructuringElement(cv2.MORPH_RECT, size)
    return np.asarray(cv2.dilate(where.view(np.uint8), box), np.uint8).view(np.bool_)


@kernel
def semi_global(
    right: Shorts,
    left: Shorts,
    right_slope: Shorts,
    left_slope: Shorts,
    where: NDArray[np.bool_],
    proposed_px: NDArray[np.float32],
    weight: Shorts,
    max_disparity: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return disparity and margin, (rows, width) float32 each, of images of that size.

    Arguments as for :func:`match_dense`; all numbers of images are int16.
    """
    rows, width = right.shape
    count = max_disparity + 1
    disparity = np.full((rows, width), np.nan, np.float32)
    margin = np.full((rows, width), np.nan, np.float32)
    # Rows of the left view go on beyond its border with their last pixel.
    low, high = np.zeros(width + count, np.int16), np.zeros(width + count, np.int16)
    slope = np.zeros(width + count, np.int16)
    single = np.zeros((width, count), np.int16)  # costs of the pixels of a row
    boxes = np.zeros((2 * _RADIUS + 1, width, count), np.int16)  # of rows, added up across
    window = np.zeros((width, count), np.int16)  # and added up down
    cost = np.zeros((width, count), np.int16)
    total = np.zeros((width, count), np.int16)  # of all paths
    across = np.full((4, count + 2), _OUTSIDE)
    down = np.full((2, width, count + 2), _OUTSIDE)
    least_down = np.full(width, np.int16(-1))  # below 0 where no path comes from above
    best = np.empty(width, np.int32)
    for last in range(-_RADIUS, rows + _RADIUS):  # row of the window
        source = min(max(last, 0), rows - 1)
        _continue(left[source], left_slope[source], low, high, slope)
        _differences(right[source], right_slope[source], low, high, slope, single)
        _add_up(single, boxes[last % (2 * _RADIUS + 1)], window)
        y = last - _RADIUS
        if y < 0:
            continue
        _propose(window, where[y], proposed_px[y], weight[y], cost)
        total.fill(0)
        _go_across(right[y], where[y], cost, across, total)
        above = right[max(y - 1, 0)]
        _go_down(right[y], above, where[y], cost, least_down, down[y % 2], down[1 - y % 2], total)
        _choose(total, where[y], best, margin[y])
        _paint(total, best, disparity[y])
    return disparity, margin


@kernel
def _continue(row: Shorts, slopes: Shorts, low: Shorts, high: Shorts, slope: Shorts) -> None:
    """Fill in slopes, and the least and largest grey within half a pixel, of a left row.

    Between pixels grey is linear: Birchfield and Tomasi, "A Pixel Dissimilarity Measure That Is
    Insensitive to Image Sampling" (1998).
    """
    last = len(row) - 1
    for x in range(len(low)):
        here = row[min(x, last)]
        before = (here + row[min(max(x - 1, 0), last)]) // 2
        after = (here + row[min(x + 1, last)]) // 2
        low[x] = min(here, before, after)
        high[x] = max(here, before, after)
        slope[x] = slopes[min(x, last)]


@kernel
def _differences(
    grey: Shorts, slope: Shorts, low: Shorts, high: Shorts, slopes: Shorts, cost: Shorts
) -> None:
    """Fill in how much each right pixel of a row differs from the left pixel of each disparity."""
    most_grey, most_slope, nothing = np.int16(_MOST_GREY), np.int16(_MOST_SLOPE), np.int16(0)
    width, count = cost.shape
    for x in range(width):
        g, s = grey[x], slope[x]
        for d in range(count):
            below, above = np.int16(low[x + d] - g), np.int16(g - high[x + d])
            differs = above if above > below else below
            differs = differs if differs > nothing else nothing
            differs = differs if differs < most_grey else most_grey
            less, more = np.int16(slopes[x + d] - s), np.int16(s - slopes[x + d])
            leans = more if more > less else less
            leans = leans if leans < most_slope else most_slope
            cost[x, d] = np.int16(differs + leans)


@kernel
def _add_up(single: Shorts, across: Shorts, window: Shorts) -> None:
    """Add up a row's costs across, and put them in the place of an older row's in the windows."""
    width, count = single.shape
    for x in range(width):
        a, b = max(x - 1, 0), min(x + 1, width - 1)
        for d in range(count):
            box = np.int16(np.int16(single[a, d] + single[x, d]) + single[b, d])
            window[x, d] = np.int16(np.int16(window[x, d] - across[x, d]) + box)
            across[x, d] = box


@kernel
def _propose(
    window: Shorts,
    where: NDArray[np.bool_],
    proposed_px: NDArray[np.float32],
    weight: Shorts,
    cost: Shorts,
) -> None:
    """Fill in the costs of a row: those of the windows, and more where another is proposed."""
    width, count = cost.shape
    for x in range(width):
        w = weight[x]
        if where[x]:
            for d in range(count):
                cost[x, d] = np.int16(window[x, d] + w)
        if where[x] and w > 0:
            near = int(proposed_px[x] + np.float32(0.5))
            for d in range(max(near - 2, 0), min(near + 3, count)):
                share = np.float32(1) - abs(np.float32(d) - proposed_px[x]) / np.float32(2)
                cost[x, d] -= np.int16(w * max(share, np.float32(0)))


@kernel
def _leap(grey: np.int16, before: np.int16) -> np.int16:
    """Return the penalty of another disparity than a neighbouring one."""
    leap = _LEAP - _PER_GREY_LEVEL * abs(int(grey) - int(before))
    return np.int16(max(_LEAST_LEAP, leap))


@kernel
def _go_across(
    grey: Shorts, where: NDArray[np.bool_], cost: Shorts, path: Shorts, total: Shorts
) -> None:
    """Go along a row from both ends at once, and add the paths' costs to the total.

    A step has to wait for the one before: two ways at once wait for each other no longer.
    """
    width, count = cost.shape
    step = np.int16(_STEP)
    least_of = np.full(2, np.int16(-1))  # below 0 where no path comes from before
    for i in range(2 * width):
        way = i % 2
        x = width - 1 - i // 2 if way else i // 2
        now, after = 2 * ((i // 2) % 2) + way, 2 * (1 - (i // 2) % 2) + way
        least = least_of[way]
        if not where[x]:
            least_of[way] = -1
            continue
        leap = np.int16(0)
        if least < 0:
            for d in range(1, count + 1):
                path[now, d] = 0
            least = np.int16(0)
        else:
            leap = _leap(grey[x], grey[x + 1 if way else x - 1])
        limit = np.int16(least + leap)
        for d in range(count):
            here = path[now, d + 1]
            up, more = np.int16(path[now, d] + step), np.int16(path[now, d + 2] + step)
            here = here if here < up else up
            here = here if here < more else more
            here = here if here < limit else limit
            here = np.int16(np.int16(here - least) + cost[x, d])
            path[after, d + 1] = here
            total[x, d] = np.int16(total[x, d] + here)
        least = _OUTSIDE
        for d in range(1, count + 1):
            least = path[after, d] if path[after, d] < least else least
        least_of[way] = least


@kernel
def _go_down(
    grey: Shorts,
    above: Shorts,
    where: NDArray[np.bool_],
    cost: Shorts,
    least_down: Shorts,
    path: Shorts,
    after: Shorts,
    total: Shorts,
) -> None:
    """Go a row down in all columns, and add the paths' costs to the total."""
    width, count = cost.shape
    step = np.int16(_STEP)
    for x in range(width):
        if not where[x]:
            least_down[x] = -1
            continue
        leap, least = np.int16(0), least_down[x]
        if least < 0:
            for d in range(1, count + 1):
                path[x, d] = 0
            least = np.int16(0)
        else:
            leap = _leap(grey[x], above[x])
        limit = np.int16(least + leap)
        for d in range(count):
            here = path[x, d + 1]
            up, more = np.int16(path[x, d] + step), np.int16(path[x, d + 2] + step)
            here = here if here < up else up
            here = here if here < more else more
            here = here if here < limit else limit
            here = np.int16(np.int16(here - least) + cost[x, d])
            after[x, d + 1] = here
            total[x, d] = np.int16(total[x, d] + here)
        least = _OUTSIDE
        for d in range(1, count + 1):
            least = after[x, d] if after[x, d] < least else least
        least_down[x] = least


@kernel
def _choose(
    total: Shorts, where: NDArray[np.bool_], best: NDArray[np.int32], margin: NDArray[np.float32]
) -> None:
    """Fill in the disparity of least cost, -1 = unknown, and its margin, NaN = unknown.

    A left pixel is the partner of one right pixel, and of those that agree with it within 1 px.
    """
    width, count = total.shape
    most = np.int16(32767)
    partner = np.full(width + count, -2, np.int32)
    partner_cost = np.full(width + count, 2**30, np.int32)
    near = np.empty(3, np.int16)
    for x in range(width):
        best[x] = -1
        if not where[x]:
            continue
        least, second = most, most
        for d in range(count):
            least = total[x, d] if total[x, d] < least else least
        found = 0
        while total[x, found] != least:
            found += 1
        first, last = max(found - 1, 0), min(found + 1, count - 1)
        for d in range(first, last + 1):
            near[d - first], total[x, d] = total[x, d], most
        for d in range(count):
            second = total[x, d] if total[x, d] < second else second
        for d in range(first, last + 1):
            total[x, d] = near[d - first]
        if least < partner_cost[x + found]:
            partner[x + found], partner_cost[x + found] = found, least
        excess = np.float32(second) - np.float32(least)
        if excess >= max(_LEAST_MARGIN, _LEAST_SHARE * second):
            best[x] = found
            margin[x] = excess
    for x in range(width):
        if best[x] >= 0 and abs(partner[x + best[x]] - best[x]) > 1:
            best[x] = -1
            margin[x] = np.nan


@kernel
def _paint(total: Shorts, best: NDArray[np.int32], disparity: NDArray[np.float32]) -> None:
    """Fill in disparities between whole px: where lines of equal slope through three costs meet."""
    width, count = total.shape
    for x in range(width):
        d = best[x]
        if d < 0:
            continue
        disparity[x] = d
        if 0 < d < count - 1:
            below = total[x, d - 1] - total[x, d]
            above = total[x, d + 1] - total[x, d]
            disparity[x] += np.float32(below - above) / np.float32(2 * max(below, above, 1))
