"""The free space before a camera, from one disparity image, and the direction to drive in.

Lengths are in camera heights over the ground, which the image itself gives: on level ground
    nearness (disparity plus doffs) grows by ``baseline / height`` px per row below the horizon. So
    no rig is needed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import checked_array, checked_number, reused
from motionstereo_cli.compiled import free_space as loops

#: Share of an image, and of a strip, below which its matches count as noise.
MIN_KNOWN_SHARE = 0.002
_MIN_STRIP_SHARE = 0.01

#: Width of the buckets by which quantiles are found.
_BUCKET_PX = 0.5

#: Share of standing pixels in a strip that may be nearer than its nearness: noise.
_NEARER_SHARE = 0.2
#: Share of ground pixels in a strip that may be farther than the farthest ground.
_FARTHER_SHARE = 0.05
#: Share of known pixels that are farther than the nearest obstacle.
_NEAREST_SHARE = 0.99

#: Height up to which the ground reaches, and above which a vehicle passes under, in camera heights.
_GROUND_UP, _OVERHEAD_UP = 0.2, 1.4
#: Tolerance of the ground's nearness: a share of it, and px.
_GROUND_SHARE, _GROUND_PX = 0.15, 0.5

#: Search range of the horizon about the image's middle row, as a share of its height.
_HORIZON_SHARE = 0.15
_HORIZONS, _SLOPES, _BINS, _ROWS = 16, 32, 128, 32
#: Where the range of disparity ends, within this share of what is known, ground before the camera
#: may be nearer: it is sought with slopes up to so many times steeper, by what lies in the range.
_NEAR_LIMIT, _STEEPER = 0.75, 4.0
#: Share of known pixels that the bins cover.
_FULL_SCALE = 0.995
#: Such a share of an image, as :func:`find_ground` counts it, has to lie on the ground: on a line
#: through a mere wall lie 0.125, on the floor of a smooth corridor 0.14, on a road 0.3 to 0.4.
_MIN_GROUND = 0.13
#: Weight of pixels below the ground against it.
_BELOW_COST = 2.0

#: A vehicle's width, the longest way that is told from longer ones, and how far off the point is
#: that it steers to, in camera heights; in a narrow place that point is nearer.
VEHICLE, _FARTHEST, _AIM = 1.5, 25.0, 8.0
_AIM_SHARE = 0.25
#: Without obstacles the way is open if ground is seen as far as 1 / this of the longest way.
_OPEN = 2.0
#: Smaller differences of nearness are noise.
_MIN_PX = 0.25
#: What a whole half image off straight ahead is worth in way, as a share of the longest, and how
#: much shorter a way is that counts a third.
_TURN_COST, _CHANGE_COST, _SOFTNESS = 0.1, 0.2, 0.05
#: Ways shorter than this share of the best one end the gap that it leads through.
_GAP_LENGTH = 0.5
#: One level surface before the camera: nearness up to this many times that of the farthest part,
#: and px; the share of what is known, and of the strips, that have to lie on it. Down on people
#: they are 0.57 and 0.83 or more, on roads 0.25 and 0.45 at most.
_LEVEL, _LEVEL_PX = 1.12, 0.5
_LEVEL_SHARE, _LEVEL_STRIPS = 0.5, 0.8
_FARTHEST_SHARE, _STRIP_SHARE = 0.1, 0.25
#: What lies before the camera is out of range where of so much of the height, at least, less
#: than this share is known, and this quantile of what is above is close to the limit.
_CUT_SHARE, _CUT_KNOWN, _CUT_RANK = 0.125, 0.2, 0.9
#: Maximum gap of unknown strips that is interpolated, as a share of all.
_GAP_SHARE = 0.25


@dataclass(frozen=True, slots=True)
class Ground:
    """A level ground: its nearness is ``slope * (row - horizon)`` px.

    Attributes:
        slope: px of nearness a row.
        horizon: row at which it is at infinity.
    """

    slope: float
    horizon: float


@dataclass(frozen=True, slots=True)
class FreeSpace:
    """Obstacles and ground in each vertical strip of an image.

    Attributes:
        standing_px: nearness of the nearest obstacle there, (strips,) float32; NaN where
            none is known.
        ground_px: nearness of the farthest ground seen there, (strips,) float32; NaN = none.
        slope: px of the ground's nearness a row of the camera's image; NaN where none was found.
        width: width of the image in px.
    """

    standing_px: NDArray[np.float32]
    ground_px: NDArray[np.float32]
    slope: float
    width: int


@dataclass(frozen=True, slots=True)
class StripValues:
    """The values of an image, sorted into buckets for quantiles of it and of its vertical strips.

    Attributes:
        values: (height, width) float32, NaN = unknown.
        borders: those of the strips, see :func:`strip_borders`, int32.
        buckets: the bucket of each value, (height, width) uint8, 255 = unknown.
        counts: pixels of each strip in each bucket, (strips, 256) int32.
    """

    values: NDArray[np.float32]
    borders: NDArray[np.int32]
    buckets: NDArray[np.uint8]
    counts: NDArray[np.int32]

    @classmethod
    def of(cls, values: NDArray[np.float32], strips: int) -> StripValues:
        """Sort the values of an image.

        Args:
            values: (height, width) float32, NaN = unknown.
            strips: number of strips, at most the width.
        """
        values = checked_array(values, np.float32)
        width = values.shape[1]
        borders = strip_borders(width, checked_number("strips", strips, 1, width))
        return cls._counted(values, borders.astype(np.int32), _buckets(values, _BUCKET_PX, 254))

    @classmethod
    def _counted(
        cls, values: NDArray[np.float32], borders: NDArray[np.int32], buckets: NDArray[np.uint8]
    ) -> StripValues:
        rows = np.array([0, len(values)], np.int32)
        return cls(values, borders, buckets, _counts(buckets, rows, borders)[0])

    def split(self, ground: Ground) -> tuple[StripValues, StripValues]:
        """Return the same of what stands on a ground, and of the ground."""
        stands, lies = np.empty_like(self.buckets), np.empty_like(self.buckets)
        heights = (_GROUND_SHARE, _GROUND_UP, _OVERHEAD_UP)
        line = (ground.slope, ground.horizon)
        loops.split(self.values, self.buckets, *line, _GROUND_PX, *heights, stands, lies)
        parts = (self._counted(self.values, self.borders, each) for each in (stands, lies))
        standing, lying = parts
        return standing, lying

    def quantile(self, share: float) -> float:
        """Return a quantile of all known values; NaN where too few are known."""
        totals = self.counts.sum(axis=0, dtype=np.int32)
        values, buckets, borders, counts = self.values, self.buckets, self.borders, self.counts
        found = reused(_buffer, values.size + 1)
        of_all = (counts, totals, share, MIN_KNOWN_SHARE, found)
        return float(loops.quantile_of_all(values, buckets, borders, *of_all))

    def quantiles(
        self, share: float, *, min_share: float = _MIN_STRIP_SHARE
    ) -> NDArray[np.float32]:
        """Return a quantile of the known values of each strip, (strips,) float32.

        Args:
            share: which quantile, 0..1.
            min_share: share of a strip that has to be known, else NaN.
        """
        result = np.empty(len(self.counts), np.float32)
        values, buckets, borders, counts = self.values, self.buckets, self.borders, self.counts
        found = reused(_buffer, values.size + 1)
        loops.quantiles(values, buckets, borders, counts, share, min_share, found, result)
        return result


def find_ground(near: StripValues, middle_row: float, limit_px: float = math.inf) -> Ground | None:
    """Return the ground in an image: the line from row to nearness that most of the image fits.

    Nothing is below the ground, so pixels below a line count against it (compare Labayrade et al.
    2002, v-disparity). None if no line fits.

    Args:
        near: nearness in px, disparity + doffs.
        middle_row: where the horizon would be if the camera were level.
        limit_px: nearness up to which it is measured.
    """
    height, width = near.values.shape
    far_px = near.quantile(_FULL_SCALE)
    if math.isnan(far_px):
        return None
    bin_px = max(far_px, 1.0) * 1.1 / _BINS
    top = -(-np.arange(_ROWS + 1, dtype=np.int32) * height // _ROWS)
    columns = np.array([0, width], np.int32)
    counts = _counts(_buckets(near.values, bin_px, _BINS - 1), top, columns)[:, 0, :_BINS]
    # Rows have equal weight, but less with few known pixels.
    few = 0.02 * width * height / _ROWS
    farther = np.zeros((_ROWS, _BINS + 1))
    np.cumsum(counts / np.maximum(counts.sum(axis=1, keepdims=True), few), 1, out=farther[:, 1:])

    rows = (np.arange(_ROWS) + 0.5) / _ROWS
    horizons = (middle_row + 0.5) / height + np.linspace(-_HORIZON_SHARE, _HORIZON_SHARE, _HORIZONS)
    near_far = (1 - _GROUND_SHARE, 1 + _GROUND_SHARE, _GROUND_PX)
    slopes = [(np.linspace(0.04, 1, _SLOPES), math.inf)]
    if far_px > _NEAR_LIMIT * limit_px:
        slopes.append((np.linspace(1, _STEEPER, 2 * _SLOPES), limit_px))
    for share, most_px in slopes:
        bottom_px = share * _BINS * bin_px
        fits = np.empty((_HORIZONS, len(share)))
        tolerance = *near_far, _BELOW_COST, most_px
        loops.fit_lines(farther, bin_px, rows, horizons, bottom_px, *tolerance, fits)
        best = np.unravel_index(int(fits.argmax()), fits.shape)
        if fits[best] >= _MIN_GROUND:
            horizon = float(horizons[best[0]])
            slope = float(bottom_px[best[1]]) / ((1 - horizon) * height)
            return Ground(slope, horizon * height - 0.5)
    return None


def free_space(
    near: StripValues,
    ground: Ground | None,
    *,
    row_px: float = 1.0,
    column_px: int = 1,
) -> FreeSpace:
    """Return the obstacle in each strip of an image, and how far its ground is seen.

    What is flat on the ground or high above it is not an obstacle. Without a ground everything is.

    Args:
        near: nearness in px, disparity + doffs.
        ground: the ground in it.
        row_px, column_px: px of the camera's image for each row and column of these; rows as if
            pixels were square.
    """
    width = near.values.shape[1] * column_px
    if ground is None:
        standing_px = near.quantiles(1 - _NEARER_SHARE)
        return FreeSpace(standing_px, np.full_like(standing_px, np.nan), math.nan, width)
    standing, lying = near.split(ground)
    farther = standing.quantiles(1 - _NEARER_SHARE), lying.quantiles(_FARTHER_SHARE)
    return FreeSpace(*farther, ground.slope / row_px, width)


def way_ahead(
    seen: FreeSpace, focal_px: float, cx_px: float, before: float | None = None
) -> tuple[float | None, NDArray[np.float32]]:
    """Return the heading, and the nearness of the end of the way in each strip.

    A vehicle can turn right or left by more or less: each such way is an arc, which is as long as
    it meets nothing and stays in the view. The heading is the mean of the ways, of which a longer
    one counts more (a Boltzmann mean, which moves smoothly as one outdoes another), and one
    straight ahead more than a turn. Without a ground the width of a vehicle is unknown: a way
    ends where something stands in its own strip.

    Args:
        seen: the free space.
        focal_px: focal length.
        cx_px: column of the principal point.
        before: the last heading, from which none departs for little; None if there is none.

    Returns:
        The place across the image to steer to, 0 left .. 1 right, None where nothing is known;
        and the nearness (strips,) of what stands in each strip or else of the farthest ground, as
        known or between known neighbours, NaN = unknown.
    """
    near = np.maximum(seen.standing_px.astype(np.float64), _MIN_PX)
    place = (np.arange(len(near)) + 0.5) / len(near)
    slant, half = (place * seen.width - 0.5 - cx_px) / focal_px, seen.width / 2 / focal_px
    if math.isnan(seen.slope):
        known, length = near, 1 / near
    else:
        far_px = focal_px * seen.slope / _FARTHEST
        open_way = np.isnan(near) & (seen.ground_px <= _OPEN * far_px)
        known = _filled(np.where(open_way, seen.ground_px, near))
        length = _lengths(
            focal_px * seen.slope / near,
            slant,
            half,
            focal_px * seen.slope / np.fmax(np.fmin.reduce(known), far_px),
        )
    if np.isnan(known).all():
        return None, known.astype(np.float32)
    length = np.where(np.isnan(known), 0, length)
    worth = length / length.max() - _TURN_COST * np.abs(slant) / half
    worth -= _CHANGE_COST * np.abs(place - (0.5 if before is None else before))
    best = int(worth.argmax())
    # Only ways beside the best one, up to the next obstacle: the mean of two gaps is not a gap.
    short = np.flatnonzero(length < _GAP_LENGTH * length[best])
    gap = slice(
        short[short < best].max(initial=-1) + 1, short[short > best].min(initial=len(place))
    )
    weight = np.exp((worth[gap] - worth[best]) / _SOFTNESS)
    return float(np.average(place[gap], weights=weight)), known.astype(np.float32)


def _lengths(
    ahead: NDArray[np.float64], slant: NDArray[np.float64], half: float, farthest: float
) -> NDArray[np.float64]:
    """Return how far a vehicle can drive toward each strip, in camera heights.

    Args:
        ahead: distance of the obstacle in each strip, NaN = unknown.
        slant: lateral offset of the strips per distance ahead, positive = right.
        half: the same for the borders of the image.
        farthest: the longest way that counts.
    """
    aim = min(_AIM, _AIM_SHARE * farthest)

    def free(aside: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return lengths of ways that are so far aside (ways, strips) at what stands there."""
        meets = np.abs(slant * ahead - aside) < VEHICLE / 2
        first: NDArray[np.float64] = np.where(meets, ahead, farthest).min(axis=1)
        return first

    # An arc that is a * aim aside at the aim is a * z^2 / aim aside at z, and may leave the view.
    arc = free(slant[:, None] * ahead**2 / aim)
    arc = np.minimum(arc, aim * half / np.maximum(np.abs(slant), 1e-6))
    # In a narrow place, turning on the spot toward a far strip is as good as an arc.
    share = min(1.0, _AIM / float(arc.max()))
    return np.maximum(arc, share * free(slant[:, None] * ahead))


def level_surface(near: StripValues, *, min_known: float = 0.0) -> float | None:
    """Return up to which nearness one surface reaches that fills the view, None if none does.

    A wall, or the floor for a camera that looks down, lies across the line of sight: then no
    direction is farther than another.

    Args:
        near: nearness in px, disparity + doffs.
        min_known: share of the strips of which something has to be known.
    """
    level_px = _LEVEL * near.quantile(_FARTHEST_SHARE) + _LEVEL_PX
    with np.errstate(invalid="ignore"):
        # First what takes least time.
        known = int(near.counts[:, :-1].sum())
        if np.count_nonzero(near.values < level_px) < _LEVEL_SHARE * known:
            return None
        in_strip = near.quantiles(_STRIP_SHARE)
        known_strips = np.count_nonzero(~np.isnan(in_strip))
        level_strips = np.count_nonzero(in_strip < level_px)
    if not known_strips or known_strips < min_known * len(in_strip):
        return None
    return level_px if level_strips >= _LEVEL_STRIPS * known_strips else None


def is_out_of_range(near: StripValues, limit_px: float) -> bool:
    """Return whether what lies before the camera is nearer than the range of disparity.

    From the bottom of the image up little is known, and what is known next is close to the limit.
    What is nearer is unknown then, and what is known of it is mostly wrong.

    Args:
        near: nearness in px, disparity + doffs.
        limit_px: nearness up to which it is measured.
    """
    known = ~np.isnan(near.values)
    height = len(known)
    rows = np.flatnonzero(known.mean(axis=1) >= _CUT_KNOWN)
    if not len(rows) or height - 1 - rows[-1] < _CUT_SHARE * height:
        return False
    band = slice(max(rows[-1] - height // _ROWS, 0), rows[-1] + 1)
    found = np.sort(near.values[band][known[band]])
    return bool(found[int(_CUT_RANK * len(found))] > _NEAR_LIMIT * limit_px)


def nearest(near: StripValues) -> float | None:
    """Return the nearness of the nearest obstacle in px; None where too little is known.

    All but a hundredth of the known pixels are farther.

    Args:
        near: nearness in px, disparity + doffs.
    """
    found = near.quantile(_NEAREST_SHARE)
    return None if math.isnan(found) else found


def _buckets(values: NDArray[np.float32], bucket_px: float, last: int) -> NDArray[np.uint8]:
    """Return the bucket of each value, 255 where it is unknown."""
    buckets = np.empty(values.shape, np.uint8)
    loops.bucket(values, bucket_px, last, buckets)
    return buckets


def _counts(
    buckets: NDArray[np.uint8], rows: NDArray[np.int32], columns: NDArray[np.int32]
) -> NDArray[np.int32]:
    """Return the pixels in each bucket in the blocks between rows and columns, of int32."""
    counts = np.empty((len(rows) - 1, len(columns) - 1, 256), np.int32)
    loops.count(buckets, rows, columns, reused(_buffer_of_counts), counts)
    return counts


def _buffer(size: int) -> NDArray[np.float32]:
    return np.empty(size, np.float32)


def _buffer_of_counts() -> NDArray[np.int32]:
    return np.empty((4, 256), np.int32)


def strip_borders(width: int, strips: int) -> NDArray[np.int64]:
    """Return the borders of strips of nearly equal width, (strips + 1,), symmetric in a mirror."""
    index = np.arange(strips + 1)
    from_left = index * width // strips
    return np.where(2 * index <= strips, from_left, width - from_left[::-1])


def _filled(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return values with gaps between known ones interpolated, unless they are too wide."""
    index, known = np.arange(len(values)), np.flatnonzero(~np.isnan(values))
    if not len(known):
        return values
    after = np.searchsorted(known, index).clip(0, len(known) - 1)
    before = np.maximum(after - (known[after] > index), 0)
    between = (known[before] <= index) & (index <= known[after])
    short = known[after] - known[before] - 1 <= _GAP_SHARE * len(values)
    return np.where(between & short, np.interp(index, known, values[known]), np.nan)
