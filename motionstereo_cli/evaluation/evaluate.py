"""Errors of disparity or depth against ground truth, in the usual measures.

Both sides must be of one view; a run's is the right one unless it ran with --reference left.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.errors import InputError
from motionstereo_cli.evaluation.numbers import ratio
from motionstereo_cli.files.maps import numbered_files
from motionstereo_cli.sinks.read_back import Maps, read_mask, size_of
from motionstereo_cli.types import Rig

if TYPE_CHECKING:
    from motionstereo_cli.types import Real


#: Error thresholds of bad disparities in px.
BAD_PX = (0.5, 1.0, 2.0, 3.0)

#: Maximum depth that counts in m, as on KITTI since Eigen et al. (2014): disparities near 0 would
#: otherwise outweigh all others.
FAR_M = 80.0


#: The median comes from a histogram: exact for disparities in 1/256 px, and up to 256 px.
_BINS_PER_PX = 256
_BINS = 65536


#: Ranges of true disparity, in px, whose bias is told apart; an error counts as this much at most.
BIAS_FROM_PX = (0, 1, 3, 10)
_MAX_BIAS_PX = 3.0


class FramePair(NamedTuple):
    """One frame of both sides, (height, width) float32 each, NaN = unknown or not counted.

    Attributes:
        found_px, truth_px: disparity in px.
        found_m, truth_m: depth in m; None where no rig is known.
        reference: the camera whose view it is.
    """

    found_px: Real
    truth_px: Real
    found_m: Real | None = None
    truth_m: Real | None = None
    reference: str = "right"


@dataclass(frozen=True, slots=True)
class Score:
    """Scores of a frame, or of all pixels of all frames together.

    Shares are 0..1 and, except coverage, of the pixels that have both truth and a result. A
    measure of no pixel at all is NaN.

    Attributes:
        frame: its number; None for all frames together.
        truth_pixels: how many pixels have truth and are not masked out.
        both_pixels: how many of these have a result.
        coverage: both_pixels / truth_pixels.
        bad_0_5, bad_1, bad_2, bad_3: share whose disparity is wrong by more than 0.5, 1, 2, 3 px:
            the bad-pixel measure B of Scharstein and Szeliski, "A Taxonomy and Evaluation of
            Dense Two-Frame Stereo Correspondence Algorithms" (2002), section 5.1.
        d1: share wrong by more than 3 px and by more than 5 % of the truth, the outliers of KITTI
            2015: Menze and Geiger, "Object Scene Flow for Autonomous Vehicles" (2015).
        mean_px, median_px: mean and median of the absolute error of the disparity.
        rms_px: root of its mean square: R of Scharstein and Szeliski (2002).
        abs_rel: mean of abs(depth - truth) / truth, of depths up to :data:`FAR_M`: Eigen et al.,
            "Depth Map Prediction from a Single Image using a Multi-Scale Deep Network" (2014).
        rmse_m: root of the mean square of depth - truth, of the same pixels and source.
        coverage_seen: coverage of the pixels that both cameras see, by the truth: the others have
            no partner.
        bias_0_1_px, bias_1_3_px, bias_3_10_px, bias_10_px: mean of disparity - truth, each error
            cut to 3 px, where the truth is 0 to 1, 1 to 3, 3 to 10, and 10 px or more.
        tepe_px, tepe_1: temporal end-point error: mean change of the error from the frame before at
            the same pixel, and the share that changes by over 1 px.
        flicker_px, flicker_1: median change of the disparity where the truth has not changed, and
            the share that changes by over 1 px.
    """

    frame: int | None
    truth_pixels: int
    both_pixels: int
    coverage: float
    bad_0_5: float
    bad_1: float
    bad_2: float
    bad_3: float
    d1: float
    mean_px: float
    median_px: float
    rms_px: float
    abs_rel: float
    rmse_m: float
    coverage_seen: float
    bias_0_1_px: float
    bias_1_3_px: float
    bias_3_10_px: float
    bias_10_px: float
    tepe_px: float
    tepe_1: float
    flicker_px: float
    flicker_1: float


@dataclass(frozen=True, slots=True, eq=False)
class Tally:
    """Sums over pixels, from which a score follows; tallies can be added.

    Attributes:
        truth, both: number of pixels with truth, and with truth and a result.
        bad: number of pixels wrong by more than each of :data:`BAD_PX`, (4,) int64.
        outliers: number of pixels that D1 counts.
        error_px, error_px2: sums of the absolute and of the squared error of the disparity.
        histogram: number of pixels by absolute error in steps of 1/256 px, int64.
        depths: number of pixels where both depths are known and the true one is at most FAR_M.
        error_rel, error_m2: sums of the relative absolute and of the squared error of the depth.
        seen, seen_both: number of pixels that both cameras see, and of those with a result.
        biased, bias_px: number of pixels, and the sum of their errors, from each of
            :data:`BIAS_FROM_PX` on, (4,) each.
        pairs, pairs_over, pairs_px: number of pixels with an error in this frame and the one
            before, of those whose error changed by over 1 px, and the sum of the changes.
        changes: number of pixels whose truth has not changed by the change of their disparity, in
            steps of 1/256 px, int64.
    """

    truth: int
    both: int
    bad: NDArray[np.int64]
    outliers: int
    error_px: float
    error_px2: float
    histogram: NDArray[np.int64]
    depths: int
    error_rel: float
    error_m2: float
    seen: int
    seen_both: int
    biased: NDArray[np.int64]
    bias_px: NDArray[np.float64]
    pairs: int
    pairs_over: int
    pairs_px: float
    changes: NDArray[np.int64]

    def __add__(self, other: Tally) -> Tally:
        return Tally(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))

    def score(self, frame: int | None = None) -> Score:
        """Return the measures of the pixels counted."""
        bad_0_5, bad_1, bad_2, bad_3 = (ratio(int(count), self.both) for count in self.bad)
        near_0, near_1, near_3, near_10 = (
            ratio(float(total), int(count))
            for total, count in zip(self.bias_px, self.biased, strict=True)
        )
        still = int(self.changes.sum())
        return Score(
            frame=frame,
            truth_pixels=self.truth,
            both_pixels=self.both,
            coverage=ratio(self.both, self.truth),
            bad_0_5=bad_0_5,
            bad_1=bad_1,
            bad_2=bad_2,
            bad_3=bad_3,
            d1=ratio(self.outliers, self.both),
            mean_px=ratio(self.error_px, self.both),
            median_px=_median(self.histogram),
            rms_px=math.sqrt(ratio(self.error_px2, self.both)),
            abs_rel=ratio(self.error_rel, self.depths),
            rmse_m=math.sqrt(ratio(self.error_m2, self.depths)),
            coverage_seen=ratio(self.seen_both, self.seen),
            bias_0_1_px=near_0,
            bias_1_3_px=near_1,
            bias_3_10_px=near_3,
            bias_10_px=near_10,
            tepe_px=ratio(self.pairs_px, self.pairs),
            tepe_1=ratio(self.pairs_over, self.pairs),
            flicker_px=_median(self.changes),
            flicker_1=ratio(int(self.changes[_BINS_PER_PX + 1 :].sum()), still),
        )


def _median(histogram: NDArray[np.int64]) -> float:
    """Return the median of what is counted in steps of 1/256 px, NaN of nothing."""
    count = int(histogram.sum())
    if not count:
        return math.nan
    middle = [(count + 1) // 2, count // 2 + 1]  # two where their number is even
    return float(np.searchsorted(np.cumsum(histogram), middle).mean()) / _BINS_PER_PX


def _counted(values_px: Real) -> NDArray[np.int64]:
    """Return how many absolute values there are of each step of 1/256 px."""
    steps = np.minimum(np.rint(np.abs(values_px) * _BINS_PER_PX), _BINS - 1).astype(np.int64)
    return np.bincount(steps, minlength=_BINS)


def seen_by_both(truth_px: Real, reference: str = "right") -> NDArray[np.bool_]:
    """Return which pixels the other camera sees, too, by the truth, (height, width) bool.

    Their partner lies within the other view, and nothing nearer has the same one.
    """
    if reference == "left":
        return seen_by_both(truth_px[:, ::-1])[:, ::-1]
    width = truth_px.shape[1]
    known = ~np.isnan(truth_px)
    rows, columns = np.nonzero(known)
    partner = np.rint(columns + truth_px[known]).astype(np.int64)
    inside = (partner >= 0) & (partner < width)
    rows, columns, partner = rows[inside], columns[inside], partner[inside]
    nearest = np.full(truth_px.shape, -np.inf, np.float32)
    disparity = truth_px[rows, columns]
    np.maximum.at(nearest, (rows, partner), disparity)
    result = np.zeros(truth_px.shape, np.bool_)
    result[rows, columns] = disparity > nearest[rows, partner] - 1
    return result


def tally(pair: FramePair, before: FramePair | None = None) -> Tally:
    """Return the sums over the pixels of a frame.

    Args:
        pair: the frame.
        before: the frame before it, for what changes; None where there is none.
    """
    has_truth = ~np.isnan(pair.truth_px)
    both = has_truth & ~np.isnan(pair.found_px)
    truth_px = pair.truth_px[both]
    signed_px = pair.found_px[both] - truth_px
    error_px = np.abs(signed_px)
    ranges = np.searchsorted(BIAS_FROM_PX, truth_px, side="right") - 1
    ranges = np.maximum(ranges, 0)
    cut_px = np.clip(signed_px, -_MAX_BIAS_PX, _MAX_BIAS_PX)
    seen = seen_by_both(pair.truth_px, pair.reference)
    error_change, still_change = np.zeros((2, 0), np.float32)
    if before is not None:
        change = pair.found_px - before.found_px
        error_change = change - (pair.truth_px - before.truth_px)
        error_change = np.abs(error_change[~np.isnan(error_change)])
        still_change = change[(pair.truth_px == before.truth_px) & ~np.isnan(change)]
    depths, error_rel, error_m2 = 0, 0.0, 0.0
    if pair.found_m is not None and pair.truth_m is not None:
        compared = ~np.isnan(pair.found_m) & (pair.truth_m <= FAR_M)
        truth_m = pair.truth_m[compared].astype(np.float64)
        error_m = np.minimum(pair.found_m[compared], FAR_M) - truth_m
        depths = len(truth_m)
        error_rel, error_m2 = float((np.abs(error_m) / truth_m).sum()), float(error_m @ error_m)
    return Tally(
        truth=int(np.count_nonzero(has_truth)),
        both=len(error_px),
        bad=np.array([np.count_nonzero(error_px > limit) for limit in BAD_PX], np.int64),
        outliers=int(np.count_nonzero((error_px > 3) & (error_px > 0.05 * truth_px))),
        error_px=float(error_px.sum(dtype=np.float64)),
        error_px2=float(np.square(error_px, dtype=np.float64).sum()),
        histogram=_counted(error_px),
        depths=depths,
        error_rel=error_rel,
        error_m2=error_m2,
        seen=int(np.count_nonzero(seen)),
        seen_both=int(np.count_nonzero(seen & both)),
        biased=np.bincount(ranges, minlength=len(BIAS_FROM_PX)),
        bias_px=np.bincount(ranges, cut_px, len(BIAS_FROM_PX)).astype(np.float64),
        pairs=len(error_change),
        pairs_over=int(np.count_nonzero(error_change > 1)),
        pairs_px=float(error_change.sum(dtype=np.float64)),
        changes=_counted(still_change),
    )


class Comparison:
    """A result and its truth, frame by frame.

    Args:
        out, truth: the two sides.
        rig: the camera; None = each side's own rig or, without one, the other's.
        mask: folder of PNG files; only pixels where they are not 0 count.

    Attributes:
        numbers: the frames that both sides have, in order, by their places in the recording: those
            of a run that began later, or left frames out, have other names.
        only_out, only_truth: the frames that only one side has.
        numbering: that of the result.
        has_depth: whether a rig is known, so that there are errors in m.
        views: the cameras whose views both sides are in, None if unknown.

    Raises:
        InputError: the sides have no frame in common, a mask is missing, or depth has to be
            converted and there is no rig.
    """

    def __init__(
        self, out: Maps, truth: Maps, rig: Rig | None = None, mask: Path | None = None
    ) -> None:
        self._out, self._truth = out, truth
        self._out_rig = rig or out.rig or truth.rig
        self._truth_rig = rig or truth.rig or out.rig
        self.has_depth = self._out_rig is not None
        self.views = (out.reference, truth.reference)
        if not self.has_depth and "depth" in (out.kind, truth.kind):
            raise InputError(
                "depth is converted to disparity by a rig, and none was found: give --rig"
            )
        self.numbering = out.numbering
        self._own, self._true = (
            {side.numbering.of(number): number for number in side.files} for side in (out, truth)
        )
        self.numbers = [number for number in self._true if number in self._own]
        self.only_out = sorted(self._own.keys() - self._true.keys())
        self.only_truth = sorted(self._true.keys() - self._own.keys())
        if not self.numbers:
            raise InputError(
                f"no frame number is common to {_span(out)} and {_span(truth)}: "
                "give results and truth of the same frames"
            )
        self._masks = None if mask is None else numbered_files(mask, (".png",))
        for number in self.numbers:
            if self._masks is not None and number not in self._masks:
                raise InputError(f"{mask} has no PNG for frame {number}: add it (not 0 = count)")

    def pair(self, number: int) -> FramePair:
        """Return both sides of a frame.

        Raises:
            InputError: one side lacks the frame, a file cannot be read, or sizes differ.
        """
        if not (number in self._own and number in self._true):
            raise InputError(
                f"frame {number} is not on both sides, by its place in the recording: "
                f"{_span(self._out)}, {_span(self._truth)}"
            )
        own, true = self._own[number], self._true[number]
        out, truth = self._out.read(own), self._truth.read(true)
        out_path, truth_path = self._out.files[own], self._truth.files[true]
        self._check_size(out_path, out)
        self._check_size(truth_path, truth)
        if out.shape != truth.shape:
            raise InputError(
                f"{out_path} is {size_of(out)} but {truth_path} is {size_of(truth)}: give results "
                "and truth of the same size"
            )
        if self._masks is not None:
            counted = read_mask(self._masks[number])
            if counted.shape != truth.shape:
                raise InputError(
                    f"{self._masks[number]} is {size_of(counted)} but the truth is "
                    f"{size_of(truth)}: give masks of the same size"
                )
            truth = np.where(counted, truth, np.float32(np.nan))
        found_px, found_m = _both_kinds(out, self._out.kind, self._out_rig)
        truth_px, truth_m = _both_kinds(truth, self._truth.kind, self._truth_rig)
        assert found_px is not None
        assert truth_px is not None
        return FramePair(found_px, truth_px, found_m, truth_m, self.views[1] or "right")

    def times(self, number: int) -> float:
        """Return how many times as large as the true one depth is, the median of a frame.

        NaN where no pixel has both.
        """
        pair = self.pair(number)
        both = ~np.isnan(pair.found_px) & (pair.truth_px > 0)
        if pair.found_m is None or pair.truth_m is None or not both.any():
            return math.nan
        return float(np.nanmedian(pair.found_m[both] / pair.truth_m[both]))

    def _check_size(self, path: Path, image: Real) -> None:
        for rig in (self._out_rig, self._truth_rig):
            if rig is not None and (rig.height, rig.width) != image.shape:
                raise InputError(
                    f"{path} is {size_of(image)} but the rig is for {rig.width}x{rig.height}: "
                    "give the rig of these images with --rig"
                )


@dataclass(frozen=True, slots=True)
class Report:
    """Scores of a comparison.

    Attributes:
        overall: all pixels of all frames together.
        frames: each frame.
        only_out, only_truth: number of frames that only one side has; they are not scored.
    """

    overall: Score
    frames: Sequence[Score]
    only_out: int
    only_truth: int

    @property
    def worst(self) -> Score:
        """The frame with the most pixels wrong by more than 1 px, else with the most compared."""
        return max(
            self.frames,
            key=lambda s: (s.both_pixels and s.bad_1 * s.both_pixels, s.both_pixels),
        )


def evaluate(comparison: Comparison, progress: Callable[[], object] = lambda: None) -> Report:
    """Score every frame that both sides have, one at a time in memory.

    Args:
        comparison: result and truth.
        progress: called after each frame.

    Raises:
        InputError: a file cannot be used, or no pixel at all has truth.
    """
    total: Tally | None = None
    frames = []
    before: tuple[int, FramePair] | None = None
    for number in comparison.numbers:
        pair = comparison.pair(number)
        sums = tally(pair, None if before is None or before[0] != number - 1 else before[1])
        before = number, pair
        frames.append(sums.score(number))
        total = sums if total is None else total + sums
        progress()
    if total is None or not total.truth:
        raise InputError("no pixel has truth: check the truth, its kind and the mask")
    return Report(total.score(), frames, len(comparison.only_out), len(comparison.only_truth))


def _both_kinds(values: Real, kind: str, rig: Rig | None) -> tuple[Real | None, Real | None]:
    """Return disparity in px and depth in m; None for the one that would need a rig."""
    if rig is None:
        return (values, None) if kind == "disparity" else (None, values)
    if kind == "depth":
        return rig.disparity_px(values), values
    finite = rig.nearness_px(values) > 0  # only depths that are finite and positive
    return values, rig.depth_m(np.where(finite, values, np.float32(np.nan)))


def _span(maps: Maps) -> str:
    first, *_ = maps.files
    *_, last = maps.files
    of = maps.numbering.of
    return f"{maps.files[first].parent} ({of(first)} to {of(last)})"
