"""The matchers once more, slow and obvious: loops over pixels, rows, trails and pairs."""

import itertools
import math
from collections import Counter, defaultdict

import numpy as np


def match_regions(right, left, max_disparity):
    """The paper's words: displace, find regions of equal units, keep the largest."""
    height, width = right.shape
    best = {"right": {}, "left": {}}
    for d in range(max_disparity + 1):
        equal = {
            (y, x)
            for y in range(height)
            for x in range(width - d)
            if right[y, x] > 0 and right[y, x] == left[y, x + d]
        }
        while equal:
            region, todo = set(), [equal.pop()]
            while todo:
                y, x = todo.pop()
                region.add((y, x))
                for place in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)):
                    if place in equal:
                        equal.remove(place)
                        todo.append(place)
            for y, x in region:
                for view, place in (("right", (y, x)), ("left", (y, x + d))):
                    if len(region) > best[view].get(place, (0, None))[0]:
                        best[view][place] = (len(region), d)
    result = np.full(right.shape, np.nan, np.float32)
    for (y, x), (_, d) in best["right"].items():
        if best["left"][y, x + d][1] == d:
            result[y, x] = d
    return result


def trails_of(units):
    """All (row, start, stop, unit) of maximal runs of one unit."""
    found = []
    for y, row in enumerate(units.tolist()):
        x = 0
        for unit, run in itertools.groupby(row):
            length = len(list(run))
            if unit:
                found.append((y, x, x + length, unit))
            x += length
    return found


def pairs_of(right, left, width, max_disparity):
    """All (right trail, left trail, disparity at start, disparity at stop) that may be."""
    found = []
    for r in right:
        for l in left:  # noqa: E741
            if r[0] != l[0] or r[3] != l[3] or not 0 <= l[1] - r[1] <= max_disparity:
                continue
            start, stop = l[1] - r[1], l[2] - r[2]
            start_is_cut = r[1] == 0 or l[1] == 0
            stop_is_cut = r[2] == width or l[2] == width
            if start_is_cut and stop_is_cut:
                continue
            if start_is_cut:
                start = stop
            if stop_is_cut:
                stop = start
            if not (0 <= start <= max_disparity and 0 <= stop <= max_disparity):
                continue
            if abs(start - stop) <= max(2, 0.3 * max(r[2] - r[1], l[2] - l[1])):
                found.append((r, l, start, stop))
    return found


def match_trails(right, left, max_disparity, block_px, max_ratio, min_votes):
    """Pairs vote at both ends, the best wins, winners correct one another and elect for the rest.

    Returns disparity and the votes that agree with it.
    """
    height, width = right.shape
    pairs = pairs_of(trails_of(right), trails_of(left), width, max_disparity)

    def block(row, column):
        return row // block_px[0], column // block_px[1]

    def ends(pair):
        (row, start, stop, _), _, at_start, at_stop = pair
        return (block(row, start), at_start), (block(row, stop - 1), at_stop)

    def tally(pairs):
        return Counter(end for pair in pairs for end in ends(pair))

    def around(votes, place, disparity):
        return sum(
            votes[(place[0] + i, place[1] + j), disparity] for i in (-1, 0, 1) for j in (-1, 0, 1)
        )

    def centroid(votes, place, disparity):
        near = {k: around(votes, place, disparity + k) for k in range(-2, 3)}
        total = sum(near.values())
        return disparity + sum(k * n for k, n in near.items()) / max(total, 1), total

    votes = tally(pairs)
    support = {
        pair: sum(around(votes, place, d + k) for place, d in ends(pair) for k in (-1, 0, 1))
        for pair in pairs
    }
    rivals = {0: defaultdict(list), 1: defaultdict(list)}
    for pair in pairs:
        for side in (0, 1):
            rivals[side][pair[side]].append(support[pair])

    def wins(pair):
        others = [sorted(rivals[side][pair[side]], reverse=True) for side in (0, 1)]
        for ranked in others:
            if support[pair] < ranked[0] or (len(ranked) > 1 and ranked[1] == ranked[0]):
                return False
        return len(others[0]) == 1 or others[0][1] <= max_ratio * support[pair]

    won = [pair for pair in pairs if wins(pair)]
    votes = tally(won)
    disparity = np.full(right.shape, np.nan, np.float32)
    agreement = np.full(right.shape, np.nan, np.float32)
    for pair in won:
        (start_at, start_votes), (stop_at, stop_votes) = (
            centroid(votes, place, d) for place, d in ends(pair)
        )
        row, start, stop, _ = pair[0]
        for x in range(start, stop):
            share = (x + 0.5 - start) / (stop - start)
            disparity[row, x] = start_at * (1 - share) + stop_at * share
            agreement[row, x] = start_votes * (1 - share) + stop_votes * share

    for y in range(height):
        for x in range(width):
            if right[y, x] == 0 or not np.isnan(disparity[y, x]):
                continue
            place = block(y, x)
            counts = [
                sum(around(votes, place, d + k) for k in (-1, 0, 1) if 0 <= d + k <= max_disparity)
                for d in range(max_disparity + 1)
            ]
            peak = counts.index(max(counts))
            elected, agreeing = centroid(votes, place, peak)
            there = [x + peak + k for k in (-1, 0, 1)]
            if agreeing >= min_votes and any(
                0 <= column < width and left[y, column] == right[y, x] for column in there
            ):
                disparity[y, x], agreement[y, x] = elected, agreeing
    disparity[agreement < min_votes] = np.nan
    return disparity, agreement


def smoothed(view):
    """The bilateral filter, pixel by pixel."""
    height, width = view.shape

    def mirrored(place, size):
        place = abs(place)
        return max(place if place < size else 2 * size - 2 - place, 0)

    result = np.empty_like(view)
    for y, x in np.ndindex(height, width):
        total, weight = 0, 150
        for j, i in itertools.product(range(-2, 3), repeat=2):
            share = {1: 205, 2: 164, 4: 105}.get(j * j + i * i)
            if share:
                other = view[mirrored(y + j, height), mirrored(x + i, width)]
                brighter = int(other) - int(view[y, x])
                alike = (900 - min(abs(brighter), 29) ** 2) // 8
                alike = (alike**2 // 64) ** 2 // 256 * share // 256
                total, weight = total + alike * brighter, weight + alike
        result[y, x] = int(view[y, x]) + math.floor(total / weight)
    return result


def semi_global(  # noqa: PLR0912
    right,
    left,
    right_slope,
    left_slope,
    where,
    proposed_px,
    weight,
    max_disparity,
    looked_at=lambda y, x, d: True,
):
    """Disparity and margin of each right pixel by semi-global matching, path by path.

    Only disparities that are looked at have costs; a path makes no step from any other.
    """
    rows, width = right.shape
    reach = range(max_disparity + 1)

    def pixel_cost(y, x, d):
        def grey(at):
            return int(left[y, min(max(at, 0), width - 1)])

        at = x + d
        between = [grey(at), (grey(at) + grey(at - 1)) // 2, (grey(at) + grey(at + 1)) // 2]
        here = int(right[y, x])
        differs = max(0, min(between) - here, here - max(between))
        leans = abs(int(right_slope[y, x]) - int(left_slope[y, min(at, width - 1)]))
        return min(differs, 20) + min(leans, 20)

    def cost(y, x, d):
        total = sum(
            pixel_cost(min(max(y + i, 0), rows - 1), min(max(x + j, 0), width - 1), d)
            for i in (-1, 0, 1)
            for j in (-1, 0, 1)
        )
        w = int(weight[y, x])
        share = max(32 - abs(16 * d - int(16 * proposed_px[y, x])), 0) if w else 0
        return total + w - w * share // 32

    costs = {
        (y, x): {d: cost(y, x, d) for d in reach if looked_at(y, x, d)}
        for y in range(rows)
        for x in range(width)
        if where[y, x]
    }
    totals = {place: dict.fromkeys(costs[place], 0) for place in costs}
    for down, across in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        path = {}
        for y, x in sorted(costs, reverse=across < 0 or down < 0):
            before = path.get((y - down, x - across))
            if before is None:
                path[y, x] = dict(costs[y, x])
            else:
                change = abs(int(right[y, x]) - int(right[y - down, x - across]))
                leap = max(200, 330 - 3 * change)
                path[y, x] = {
                    d: costs[y, x][d]
                    - min(before.values())
                    + min(
                        before[e]
                        + (0 if d == e else 200 if abs(d - e) == 1 and e in costs[y, x] else leap)
                        for e in before
                    )
                    for d in costs[y, x]
                }
            for d in costs[y, x]:
                added = path[y, x][d] - costs[y, x][d]  # from below, in steps of 2
                totals[y, x][d] += costs[y, x][d] + (added // 2 * 2 if down < 0 else added)
    disparity, margin = np.full((2, rows, width), np.nan, np.float32)
    for y in range(rows):
        partner = {}  # of each left place: cost and disparity
        for x in range(width):
            if where[y, x]:
                d = min(totals[y, x], key=totals[y, x].get)
                found = totals[y, x][d], d
                if x + d not in partner or found[0] < partner[x + d][0]:
                    partner[x + d] = found
        before = -2  # the last pixel's whole disparity
        for x in range(width):
            last, before = before, -2
            if not where[y, x]:
                continue
            total = totals[y, x]
            d = min(total, key=total.get)
            second = min((total[e] for e in total if abs(d - e) > 1), default=32767)
            excess = second - total[d]
            seen = x + d < width or abs(last - d) <= 1
            if not seen or excess < max(80, 0.05 * second) or abs(partner[x + d][1] - d) > 1:
                continue
            before = d
            margin[y, x], disparity[y, x] = excess, d
            if 0 < d < max_disparity:
                # Of a neighbour that was not looked at, the other one's cost.
                below, above = (
                    total.get(d + i, total.get(d - i, total[d])) - total[d] for i in (-1, 1)
                )
                disparity[y, x] += (below - above) / (2 * max(below, above, 1))
    return disparity, margin


def plane(disparity, weight, grey, y, x, window):
    """Disparity, error and inliers' share of the plane at a pixel, by numpy's least squares."""
    rows, width = disparity.shape
    samples = [
        (i - x, j - y, float(disparity[j, i]), float(weight[j, i]))
        for j in range(0, rows, window.step_y)
        for i in range(j // window.step_y * window.shift % window.step_x, width, window.step_x)
        if abs(j - y) <= window.reach_y
        and abs(i - x) <= window.reach_x
        and weight[j, i] > 0
        and disparity[j, i] >= 0
        and abs(float(grey[j, i]) - float(grey[y, x])) <= window.max_grey
    ]
    nothing = (np.nan, np.nan, np.nan)
    if len(samples) < 12:
        return nothing
    at_x, at_y, d, w = np.array(samples).T
    halves = np.floor(2 * d)
    median = next(h for h in sorted(halves) if 2 * w[halves <= h].sum() >= w.sum()) / 2 + 0.25
    fitted = np.full(len(d), median)
    for turn in range(window.rounds):
        wide = {0: 1, 1: 1, 2: 2}.get(window.rounds - 1 - turn, 4)
        inlier = np.abs(d - fitted) <= window.tolerance_px * wide
        if inlier.sum() < 12:
            return nothing
        v = w * inlier
        along, down = at_x - (v @ at_x) / v.sum(), at_y - (v @ at_y) / v.sum()
        normal = np.array([[v @ along**2, v @ (along * down)], [v @ (along * down), v @ down**2]])
        normal += 4 * v.sum() * np.eye(2)
        slopes = np.linalg.solve(normal, [v @ (along * d), v @ (down * d)])
        here = (v @ d) / v.sum() - slopes @ [(v @ at_x) / v.sum(), (v @ at_y) / v.sum()]
        fitted = here + slopes[0] * at_x + slopes[1] * at_y
    middle = np.array([v @ at_x, v @ at_y]) / v.sum()
    off = np.abs(middle) / [window.reach_x, window.reach_y]
    if here < 0 or v.sum() < window.min_share * w.sum() or off.max() > window.max_off_centre:
        return nothing
    near = w * (np.abs(d - fitted) <= window.tolerance_px)
    variance = max(near @ (d - fitted) ** 2 / v.sum(), 0.15**2)
    lever = 1 / v.sum() + middle @ np.linalg.solve(normal, middle)
    return here, v.sum() / w.sum(), np.sqrt(variance * lever)


def refined(disparity, right, left):
    """Disparity after a step of Lucas and Kanade, window by window."""
    rows, width = disparity.shape
    result = disparity.copy()

    def at(image, y, x):
        return image[min(max(y, 0), rows - 1), min(max(x, 0), width - 1)]

    def slope(image, y, x):
        reflected = x + 1 if x + 1 < width else width - 2
        return (image[y, reflected] - image[y, abs(x - 1)]) / 2

    def between(y, x, value):
        whole = int(np.floor(x))
        one, other = (value(y, min(max(whole + i, 0), width - 1)) for i in (0, 1))
        return one + (other - one) * (x - whole)

    def window(y, x):
        return [
            (min(max(y + j, 0), rows - 1), min(max(x + i, 0), width - 1))
            for j in range(-3, 4)
            for i in range(-7, 8)
        ]

    def clipped(y, x):
        return {(j, i) for j, i in window(y, x) if abs(j - y) <= 3 and abs(i - x) <= 7}

    start = disparity.copy()
    flat = np.zeros(disparity.shape, bool)
    for y, x in np.argwhere(~np.isnan(disparity)):
        nearby = [disparity[p] for p in clipped(y, x) if not np.isnan(disparity[p])]
        flat[y, x] = max(nearby) - min(nearby) <= 3
        if flat[y, x]:
            known = [disparity[p] for p in window(y, x) if not np.isnan(disparity[p])]
            start[y, x] = np.mean(known)
    sums = np.zeros((3, rows, width))
    for y, x in np.argwhere(~np.isnan(disparity)):
        there = x + start[y, x]
        differs = between(y, there, lambda j, i: left[j, i]) - right[y, x]
        g = (between(y, there, lambda j, i: slope(left, j, i)) + slope(right, y, x)) / 2
        if abs(differs) < 20 and there <= width - 1:
            sums[:, y, x] = g * differs, g * g, differs * differs
    for y, x in np.argwhere(flat):
        up, down, noise = np.mean([sums[:, j, i] for j, i in window(y, x)], axis=0)
        moved = start[y, x] - up / (down + 1 + noise)
        d = disparity[y, x]
        result[y, x] = max(min(max(moved, d - 0.75), d + 0.75), 0)
    return result


def whole_rows(disparity, half_grey, grey):
    """Disparity of all rows from that of half of them, pixel by pixel."""
    result = np.empty(grey.shape, np.float32)
    for y, x in np.ndindex(grey.shape):
        own = y // 2
        other = min(max(own + (1 if y % 2 else -1), 0), len(disparity) - 1)
        here, there = disparity[own, x], disparity[other, x]
        away, beside = (abs(float(grey[y, x]) - half_grey[row, x]) for row in (own, other))
        if abs(here - there) < 1.5:
            here = 0.75 * here + 0.25 * there
        elif beside + 2 < away:
            here = there
        result[y, x] = here
    return result


def averaged(disparity, grey, age, before):
    """Disparity averaged with what earlier frames say of the same thing, pixel by pixel."""
    result = disparity.copy()
    for place in np.ndindex(result.shape):
        agreeing = [disparity[place]]
        for frames, (earlier, its_grey) in enumerate(reversed(before), 1):
            change = abs(earlier[place] - disparity[place])
            step = abs(int(its_grey[place]) - int(grey[place]))
            if change <= 0.6 and step <= 4 and age[place] >= frames:
                agreeing.append(earlier[place])
        result[place] = np.mean(agreeing)
    return result
