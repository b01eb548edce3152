"""What is wrong with a stereo recording, before it costs an hour.

A few windows of consecutive frames are looked at closely: features (SIFT) are matched between the
views, and followed over time in the left one (Lucas-Kanade). All else is statistics on these
matches. How far the views are out of step comes from the rows alone: in rectified views a feature
lies on one row in both, so where the right view is n frames ahead of the left one, and a feature
moves down by v px a frame, it lies n v px lower in the right view. n is the slope of that line.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np

from motionstereo_cli.types import StereoFrame

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.types import Grey

    Column = NDArray[np.float64]

#: Frames in a window, those of them in which features are matched, and windows in a recording.
WINDOW_FRAMES = 16
_WINDOWS = 5
_MOMENTS = (3, 5, 7, 9, 11)
_FEW_MOMENTS = (4, 8, 12)

#: Images are looked at in at most this width, in px; at the start of a run in half their own, but
#: not less than the quick one.
_FEATURE_WIDTH = 640
_QUICK_WIDTH = 320
_MOTION_WIDTH = 160

# Features. Distances are in px of the image looked at.
_FEATURES = 600
_LEAST_CONTRAST = 0.02
_MAX_RATIO = 0.8
_ROW_REACH = 0.1  # of the height: matches are looked for so far off the row
_FOLLOW_SPANS = (2, 4)
_FOLLOW_BACK_PX = 0.5
_FOLLOW_CHANGE_PX = 0.1
_LEAST_MATCHES = 30

# Steps in time.
_MOST_STEP = 4
_MOVING_PX = 0.1  # a frame
_LEAST_MOVING = 20
_LEAST_REST = 0.3
_CERTAIN_SIGMAS = 5.0
_BETTER_ROWS = 0.85

# What ruins a result, and what is worth a warning.
_MISALIGNED_MEDIAN_PX = 1.0
_MISALIGNED_IMAGE_PX = 1.5
_SWAPPED_SHARE = 0.9
_RUINED_SHARE = 0.5
_NOTED_SHARE = 0.15
_ZERO_PX = 0.5  # disparities above minus this count as not negative
_GREY_DIFFERENCE = 8.0
_MOTION_GREY = 6
_STILL_SHARE = 5e-4
_MOVING_SHARE = 5e-3
_FROZEN_SHARE = 0.2


@dataclass(frozen=True, slots=True)
class Finding:
    """Something wrong.

    Attributes:
        name: which, for programs: few-matches, misaligned, swapped, negative-disparity,
            beyond-range, grey-difference, still, repeated, out-of-step, drifting.
        ruins: whether the result would be of no use.
        text: what, how much, and what to do, in one line.
    """

    name: str
    ruins: bool
    text: str


@dataclass(frozen=True, slots=True)
class CheckReport:
    """What was measured, None where too little was found to measure it, and what is wrong.

    Attributes:
        frames: stereo frames seen.
        matches: features matched between the views.
        misaligned_px, misaligned_p90_px: median and 90th percentile of their vertical distance.
        turned_deg: by how much the right view is turned against the left one, clockwise.
        disparity_low_px, disparity_high_px: 2nd and 98th percentile of their disparities.
        advised_max_disparity: a range that holds the latter, in px.
        grey_difference: median of left minus right grey level.
        moving: share of the image, 0..1, that changes from a frame to the next.
        repeated_left, repeated_right: images that repeat the one before though things move.
        ahead_frames: by how many frames the right view is ahead of the left one.
        findings: what is wrong, the worst first.
    """

    frames: int = 0
    matches: int = 0
    misaligned_px: float | None = None
    misaligned_p90_px: float | None = None
    turned_deg: float | None = None
    disparity_low_px: float | None = None
    disparity_high_px: float | None = None
    advised_max_disparity: int | None = None
    grey_difference: float | None = None
    moving: float | None = None
    repeated_left: int = 0
    repeated_right: int = 0
    ahead_frames: float | None = None
    findings: tuple[Finding, ...] = ()

    @property
    def ruined(self) -> bool:
        """Whether anything found would make the result useless."""
        return any(finding.ruins for finding in self.findings)

    def as_json(self) -> dict[str, Any]:
        """Return it as JSON-able values."""
        return {**dataclasses.asdict(self), "ruined": self.ruined}


def check(
    frames: Iterable[StereoFrame],
    max_disparity: int,
    *,
    expected_frames: int | None = None,
    doffs: float = 0.0,
    progress: Callable[[], object] = lambda: None,
) -> CheckReport:
    """Look at windows spread over a recording, and at the motion in all of it.

    Args:
        frames: stereo frames of one size.
        max_disparity: range that the processing is to look in, in px.
        expected_frames: how many frames there are, None if unknown.
        doffs: as in :class:`~motionstereo_cli.types.Rig`.
        progress: called after each frame.
    """
    checker = _Checker(_starts(expected_frames), _MOMENTS)
    for frame in frames:
        checker.see(frame)
        progress()
    return checker.report(max_disparity, doffs)


def watched(
    frames: Iterable[StereoFrame],
    max_disparity: int,
    say: Callable[[Finding], object],
    *,
    doffs: float = 0.0,
) -> Iterator[StereoFrame]:
    """Yield the frames as they come, and say what is wrong once the first window has gone by.

    No frame is held back or read twice.
    """
    checker = _Checker([0], _FEW_MOMENTS, quick=True)
    left_to_see = WINDOW_FRAMES
    for frame in frames:
        if left_to_see:
            checker.see(frame)
            left_to_see -= 1
            if not left_to_see:
                _tell(checker, max_disparity, doffs, say)
        yield frame
    if left_to_see:
        _tell(checker, max_disparity, doffs, say)


def _tell(
    checker: _Checker, max_disparity: int, doffs: float, say: Callable[[Finding], object]
) -> None:
    for finding in checker.report(max_disparity, doffs).findings:
        if finding.name != "few-matches":  # so little seen is no reason to interrupt a run
            say(finding)


def _starts(expected_frames: int | None) -> Sequence[int]:
    """Return where windows begin: evenly spread, or ever farther apart where no end is known."""
    if expected_frames is None:
        return [0, *(100 * 4**i for i in range(_WINDOWS - 1))]
    room = max(expected_frames - WINDOW_FRAMES, 0)
    count = max(1, min(_WINDOWS, expected_frames // WINDOW_FRAMES))
    return [room * i // max(count - 1, 1) for i in range(count)]


class _Checker:
    """Takes in frames; keeps small copies of those in windows, and the motion of all."""

    def __init__(
        self, starts: Sequence[int], moments: Sequence[int], *, quick: bool = False
    ) -> None:
        self._starts = starts
        self._moments = moments
        self._quick = quick
        self._windows: list[_Window] = []
        self._moved: tuple[list[float], list[float]] = ([], [])
        self._last: tuple[Grey, Grey] | None = None
        self._frames = 0
        self._scale = 1.0

    def see(self, frame: StereoFrame) -> None:
        number, self._frames = self._frames, self._frames + 1
        sides = (frame.left, frame.right)
        now = (_for_motion(frame.left), _for_motion(frame.right))
        if self._last is not None:
            for moved, image, last in zip(self._moved, now, self._last, strict=True):
                moved.append(_moved_share(image, last))
        self._last = now
        if number in self._starts:
            self._windows.append(_Window(number, self._moments))
        if self._windows and number < self._windows[-1].start + WINDOW_FRAMES:
            left, right = (_shrunk(side, self._feature_width(frame)) for side in sides)
            self._scale = frame.left.shape[1] / left.shape[1]
            self._windows[-1].left.append(left)
            self._windows[-1].right.append(right)

    def _feature_width(self, frame: StereoFrame) -> int:
        if not self._quick:
            return _FEATURE_WIDTH
        half: int = frame.left.shape[1] // 2
        return min(_FEATURE_WIDTH, max(_QUICK_WIDTH, half))

    def report(self, max_disparity: int, doffs: float) -> CheckReport:
        report = CheckReport(self._frames)
        if not self._windows:
            return report
        found = _Findings()
        matches = [window.matches(0) for window in self._windows]
        step = _step(self._windows, matches, found)
        if step is not None:
            report = dataclasses.replace(report, ahead_frames=step.frames)
            if step.whole:  # rows and disparities as they are once that is put right
                matches = [window.matches(step.whole) for window in self._windows]
        report = self._motion(report, found)
        report, agreed = _geometry(
            report, found, _joined(matches), self._windows[0].shape, self._scale
        )
        report = _disparities(
            report, found, agreed, scale=self._scale, max_disparity=max_disparity, doffs=doffs
        )
        ordered = sorted(found.findings, key=lambda finding: not finding.ruins)
        return dataclasses.replace(report, findings=tuple(ordered))

    def _motion(self, report: CheckReport, found: _Findings) -> CheckReport:
        left, right = (np.array(moved) for moved in self._moved)
        if not left.size:
            found.add(
                "still",
                True,
                "one frame alone shows no motion, so there will be no depth: give a recording",
            )
            return report
        moving = float((left.mean() + right.mean()) / 2)
        if moving < _STILL_SHARE:
            found.add(
                "still",
                True,
                f"nothing moves: {moving:.2%} of the image changes from frame to frame in "
                f"{self._frames} frames, and what stands still gets no depth: "
                "move the camera, or give a part with motion",
            )
        repeated = [_repeated(left, right), _repeated(right, left)]
        for side, images in zip(("left", "right"), repeated, strict=True):
            count = int(images.sum())
            if count >= max(2, 0.01 * len(images)):
                first = int(np.flatnonzero(images)[0]) + 1
                found.add(
                    "repeated",
                    count > _FROZEN_SHARE * len(images),
                    f"the {side} recording repeats itself in {count} of {self._frames} frames, "
                    f"first in frame {first}, while things move: record it again, or leave these "
                    "out with --start, --end or --every",
                )
        left_count, right_count = (int(images.sum()) for images in repeated)
        return dataclasses.replace(
            report, moving=moving, repeated_left=left_count, repeated_right=right_count
        )


class _Findings:
    def __init__(self) -> None:
        self.findings: list[Finding] = []

    def add(self, name: str, ruins: bool, text: str) -> None:
        self.findings.append(Finding(name, ruins, text))


# Motion.


def _shrunk(grey: Grey, width: int) -> Grey:
    if grey.shape[1] <= width:
        return grey
    size = (width, max(1, round(grey.shape[0] * width / grey.shape[1])))
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)


def _for_motion(grey: Grey) -> Grey:
    # Small and blurred: a sensor's noise and a codec's are gone, things that move are not.
    return np.asarray(cv2.blur(_shrunk(grey, _MOTION_WIDTH), (3, 3)), np.uint8)


def _moved_share(image: Grey, last: Grey) -> float:
    return float(np.mean(cv2.absdiff(image, last) > _MOTION_GREY))


def _repeated(moved: Column, other: Column) -> NDArray[np.bool_]:
    """Return where an image repeats the last one: nothing moves, but in the other view or around.

    Args:
        moved, other: (n,) shares of this view and the other one that move, n = frames - 1.
    """
    around = np.pad(moved, 1)
    moving = np.maximum(other, np.minimum(around[:-2], around[2:])) > _MOVING_SHARE
    repeated: NDArray[np.bool_] = (moved == 0) & moving
    return repeated


# Matches.


@dataclass(frozen=True, slots=True)
class _Matches:
    """Features found in both views, in px of the images looked at; all (n,).

    Attributes:
        x, y: place in the left image.
        disparity: x in the left image minus x in the right one.
        lower: y in the right image minus y in the left one.
        down: motion in the left image in px a frame, positive = down.
        grey: grey level in the left image minus that in the right one.
    """

    x: Column
    y: Column
    disparity: Column
    lower: Column
    down: Column
    grey: Column

    def __len__(self) -> int:
        return len(self.x)

    def where(self, chosen: NDArray[np.bool_]) -> _Matches:
        return _Matches(*(column[chosen] for column in self.columns()))

    def columns(self) -> list[Column]:
        return [getattr(self, item.name) for item in dataclasses.fields(self)]


def _joined(parts: Sequence[_Matches]) -> _Matches:
    columns = zip(*(part.columns() for part in parts), strict=True)
    return _Matches(*(np.concatenate(column) for column in columns))


_NO_MATCHES = _Matches(*(np.empty(0) for _ in dataclasses.fields(_Matches)))


class _Features(NamedTuple):
    """SIFT features of an image: places (n, 2) float32 in px, and traits (n, 128) float32."""

    places: NDArray[np.float32]
    traits: NDArray[np.float32]


class _Window:
    """Consecutive frames; images are (height, width) uint8."""

    def __init__(self, start: int, moments: Sequence[int]) -> None:
        self.start = start
        self.left: list[Grey] = []
        self.right: list[Grey] = []
        self._moments = moments
        self._features: dict[tuple[str, int], _Features] = {}

    @property
    def shape(self) -> tuple[int, ...]:
        return self.left[0].shape

    def matches(self, ahead: int) -> _Matches:
        """Return the matches at some moments, the right view being so many frames ahead."""
        last = len(self.left) - 1
        moments = [t for t in self._moments if t <= last] or [last // 2]
        return _joined(
            [_NO_MATCHES, *(self._match(t, t - ahead) for t in moments if 0 <= t - ahead <= last)]
        )

    def _match(self, t_left: int, t_right: int) -> _Matches:
        left, right = self._seen("left", t_left), self._seen("right", t_right)
        if min(len(left.places), len(right.places)) < 2:
            return _NO_MATCHES
        forth = _clear_matches(left.traits, right.traits)
        back = _clear_matches(right.traits, left.traits)
        mutual = np.array([(i, j) for i, j in forth.items() if back.get(j) == i], np.intp)
        if not mutual.size:
            return _NO_MATCHES
        at_left, at_right = left.places[mutual[:, 0]], right.places[mutual[:, 1]]
        down, followed = _followed(self.left, t_left, at_left)
        across, lower = (at_right - at_left).astype(np.float64).T
        matches = _Matches(
            x=at_left[:, 0].astype(np.float64),
            y=at_left[:, 1].astype(np.float64),
            disparity=-across,
            lower=lower,
            down=down,
            grey=_grey_at(self.left[t_left], at_left) - _grey_at(self.right[t_right], at_right),
        )
        return matches.where(followed & (np.abs(lower) < _ROW_REACH * self.shape[0]))

    def _seen(self, side: str, t: int) -> _Features:
        if (side, t) not in self._features:
            image = (self.left if side == "left" else self.right)[t]
            sift = cv2.SIFT.create(_FEATURES, contrastThreshold=_LEAST_CONTRAST)
            keys, traits = sift.detectAndCompute(image, None)
            places = np.array([key.pt for key in keys], np.float32).reshape(-1, 2)
            self._features[side, t] = _Features(places, np.asarray(traits, np.float32))
        return self._features[side, t]


def _clear_matches(traits: Any, others: Any) -> dict[int, int]:
    """Return for each its nearest of the others, where nothing else looks nearly like it.

    Neither the second nearest of the others may, nor another in its own image: of a pattern that
    repeats itself, the true partner may be hidden.
    """
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    across, within = (matcher.knnMatch(traits, each, k=2) for each in (others, traits))
    return {
        best.queryIdx: best.trainIdx
        for (best, second), (_, like) in zip(across, within, strict=True)
        if best.distance < _MAX_RATIO * min(second.distance, like.distance)
    }


def _grey_at(image: Grey, places: NDArray[np.float32]) -> Column:
    x, y = np.rint(places).astype(np.intp).T
    return np.asarray(cv2.blur(image, (5, 5))[y, x], np.float64)


def _followed(
    images: Sequence[Grey], moment: int, places: NDArray[np.float32]
) -> tuple[Column, NDArray[np.bool_]]:
    """Return the motion of places (n, 2) in px a frame down, and where it could be followed."""
    start = places[:, None]
    down, certain = np.zeros(len(places)), np.ones(len(places), np.bool_)
    for span in _FOLLOW_SPANS:  # the longer, the more exact, as far as it can be followed
        speeds, seen = [], np.ones(len(places), np.bool_)
        for step in (-span, span):
            if 0 <= moment + step < len(images):
                there, found = _flow(images[moment], images[moment + step], start)
                speeds.append((there - start)[:, 0, 1].astype(np.float64) / step)
                seen &= found
        if speeds:
            speed = np.mean(speeds, axis=0)
            if span == _FOLLOW_SPANS[0]:
                down, certain = speed, seen
            else:
                seen &= np.abs(speed - down) < _FOLLOW_CHANGE_PX
                down = np.where(seen, speed, down)
    return down, certain


def _flow(
    image: Grey, other: Grey, start: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return where places (n, 1, 2) have gone, and where the way back leads home."""

    def go(image: Grey, other: Grey, start: Any) -> tuple[Any, Any]:
        there, seen, _ = cv2.calcOpticalFlowPyrLK(
            image, other, start, np.empty_like(start), winSize=(21, 21), maxLevel=3
        )
        return there, seen[:, 0] > 0

    there, seen = go(image, other, start)
    back, seen_back = go(other, image, there)
    home = np.linalg.norm((back - start)[:, 0], axis=1) < _FOLLOW_BACK_PX
    return there, seen & seen_back & home


# Geometry.


@dataclass(frozen=True, slots=True)
class _Fit:
    """``lower`` as a shift, a turn, a scale and a step in time.

    Attributes:
        terms: shift in px, turn and scale in px over half the image's width, step in frames.
        sigma: standard error of the step, in frames; infinite where too little moves.
        chosen: matches that agree with it.
        off_px: mean distance of moving matches from the rows that shift, turn and scale give, at
            most 1 each: what a step costs if nothing is done about it.
        error_px: the same, from the rows that all terms give, of all matches.
    """

    terms: Column
    sigma: float
    chosen: NDArray[np.bool_]
    off_px: float
    error_px: float

    @property
    def step(self) -> float:
        return float(self.terms[3])


def _design(matches: _Matches, shape: tuple[int, ...]) -> NDArray[np.float64]:
    half = shape[1] / 2
    x, y = matches.x / half - 1, (matches.y - shape[0] / 2) / half
    return np.column_stack([np.ones_like(x), x, y, matches.down])


def _fit(matches: _Matches, shape: tuple[int, ...]) -> _Fit | None:
    """Fit robustly, from no step and from the likeliest; None where too few matches agree."""
    if len(matches) < _LEAST_MATCHES:
        return None
    moving = np.abs(matches.down) > _MOVING_PX
    starts = [0.0]
    if moving.sum() >= _LEAST_MOVING:
        starts.append(_roughly(matches.lower[moving], matches.down[moving]))
    fits = [_refined(matches, shape, moving, start, len(starts) > 1) for start in starts]
    return min((fit for fit in fits if fit), key=lambda fit: fit.error_px, default=None)


def _refined(
    matches: _Matches,
    shape: tuple[int, ...],
    moving: NDArray[np.bool_],
    start: float,
    with_step: bool,
) -> _Fit | None:
    lower = matches.lower
    design = _design(matches, shape)[:, : 4 if with_step else 3]
    # What moves tells the step and is often little beside what does not: the same say for both.
    say = np.where(moving, 1.0, min(1.0, max(moving.sum(), 1) / max((~moving).sum(), 1)))
    rest = lower - start * matches.down
    chosen = np.abs(rest - np.median(rest)) < 3
    for _ in range(10):
        if chosen.sum() < _LEAST_MATCHES / 2:
            return None
        weights = np.sqrt(say[chosen])
        solved = np.linalg.lstsq(design[chosen] * weights[:, None], lower[chosen] * weights)
        terms = np.asarray(solved[0], np.float64)
        error = np.abs(lower - design @ terms)
        judged = chosen & moving if with_step and (chosen & moving).any() else chosen
        spread = max(1.4826 * float(np.median(error[judged])), 0.1)
        better = error < 3 * spread
        if np.array_equal(better, chosen):
            break
        chosen = better
    error_px = float(np.average(np.minimum(error, 1), weights=say))
    if not with_step:
        return _Fit(np.append(terms, 0.0), math.inf, chosen, error_px, error_px)
    weighted = design[chosen] * say[chosen][:, None]
    variance = np.linalg.pinv(design[chosen].T @ weighted)[3, 3] * spread**2
    off = np.abs(lower - design[:, :3] @ terms[:3])[moving]
    off_px = float(np.minimum(off, 1).mean())
    return _Fit(terms, math.sqrt(max(variance, 0.0)), chosen, off_px, error_px)


def _roughly(lower: Column, down: Column) -> float:
    """Return the step that makes most rows agree, by trying."""
    steps = np.arange(-_MOST_STEP - 1, _MOST_STEP + 1.5, 0.5)
    rest = lower - steps[:, None] * down
    off = np.abs(rest - np.median(rest, axis=1, keepdims=True))
    return float(steps[np.minimum(off, 1).sum(axis=1).argmin()])


class _Step(NamedTuple):
    """By how many frames the right view is ahead: as a whole number, and measured."""

    whole: int
    frames: float


def _walk(windows: Sequence[_Window], matches: _Matches) -> _Step | None:
    """Return the step of some windows, from their matches in step on; None if nothing tells it.

    Speeds change, and that of slow things is known badly, so a fit gives little more than the
    direction: go there in whole frames while it points on.
    """
    tried: dict[int, _Fit] = {}

    def attempt(whole: int) -> bool:
        if whole in tried or abs(whole) > _MOST_STEP:
            return False
        pooled = _joined([window.matches(whole) for window in windows]) if whole else matches
        fit = _fit(pooled, windows[0].shape)
        if fit is None or math.isinf(fit.sigma):
            return False
        tried[whole] = fit
        return True

    whole = 0
    while attempt(whole) and abs(tried[whole].step) >= _LEAST_REST:
        rest = tried[whole].step
        whole += max(1, round(abs(rest))) * (1 if rest > 0 else -1)
    if not tried:
        return None
    if len(tried) > 1:
        nearest = min(tried, key=lambda whole: tried[whole].off_px)
        attempt(nearest - 1)
        attempt(nearest + 1)
    # Where it leads, rows have to agree better without any step than they did at first.
    best = min(tried, key=lambda whole: tried[whole].off_px)
    certain = (
        tried[best].off_px < _BETTER_ROWS * tried[0].off_px
        and abs(best + tried[best].step) > _CERTAIN_SIGMAS * tried[best].sigma
    )
    if best and certain:
        return _Step(best, best + tried[best].step)
    return _Step(0, tried[0].step) if abs(tried[0].step) < _LEAST_REST else None


def _step(
    windows: Sequence[_Window], matches: Sequence[_Matches], found: _Findings
) -> _Step | None:
    """Return the step of the whole recording, and note what is wrong with it."""
    steps = [
        (step, window.start)
        for window, each in zip(windows, matches, strict=True)
        if (step := _walk([window], each)) is not None
    ]
    wholes = [step.whole for step, _ in steps]
    # Lost frames stay lost, so drift goes one way; a window that stands alone is mistaken.
    if steps and wholes[0] != wholes[-1] and wholes in (sorted(wholes), sorted(wholes)[::-1]):
        (first, first_at), (last, last_at) = steps[0], steps[-1]
        found.add(
            "drifting",
            True,
            "the recordings drift apart: the right one is ahead of the left one by "
            f"{first.frames:+.1f} frames at frame {first_at} and by {last.frames:+.1f} at frame "
            f"{last_at}: frames were dropped, so pair them by time, with --sync-tolerance",
        )
        return None
    step = _walk(windows, _joined(matches))
    if step is not None and step.whole:
        found.add(
            "out-of-step",
            True,
            f"out of step: the right recording is {step.frames:+.1f} frames ahead of the left "
            f"one: add {-step.whole} to --sync-offset",
        )
    return step


def _geometry(
    report: CheckReport,
    found: _Findings,
    matches: _Matches,
    shape: tuple[int, ...],
    scale: float,
) -> tuple[CheckReport, _Matches]:
    """Measure the rows; return the matches that agree as well."""
    report = dataclasses.replace(report, matches=len(matches))
    fit = _fit(matches, shape)
    if fit is None:
        found.add(
            "few-matches",
            False,
            f"only {len(matches)} features agree between left and right, too few to check "
            "alignment: see that both show the same scene, in focus and lit",
        )
        return report, _NO_MATCHES
    still = matches.lower - fit.step * matches.down
    off = np.abs(still[fit.chosen]) * scale
    median, high = float(np.median(off)), float(np.percentile(off, 90))
    shift, turn, size = fit.terms[:3]
    # The same over the whole image, for features may lie in its middle alone.
    x, y = np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-1, 1, 21) * shape[0] / shape[1])
    whole = float(np.percentile(np.abs(shift + turn * x + size * y), 90)) * scale
    turned_deg = math.degrees(math.atan(turn / (shape[1] / 2)))
    if median > _MISALIGNED_MEDIAN_PX or whole > _MISALIGNED_IMAGE_PX:
        found.add(
            "misaligned",
            True,
            f"rows do not agree: things lie {median:.1f} px higher or lower on the right "
            f"(90th percentile {high:.1f}; shifted by {shift * scale:+.1f} px, turned by "
            f"{turned_deg:+.2f} degrees): rectify, by giving the calibration to --rig",
        )
    report = dataclasses.replace(
        report, misaligned_px=median, misaligned_p90_px=high, turned_deg=turned_deg
    )
    return report, matches.where(fit.chosen)


def _disparities(
    report: CheckReport,
    found: _Findings,
    matches: _Matches,
    *,
    scale: float,
    max_disparity: int,
    doffs: float,
) -> CheckReport:
    if not len(matches):
        return report
    disparity = matches.disparity * scale
    low, high = (float(value) for value in np.percentile(disparity, [2, 98]))
    advised = max(16, 16 * math.ceil(1.1 * high / 16))
    behind = float(np.mean(disparity + doffs < -_ZERO_PX))
    negative = float(np.mean(disparity < -_ZERO_PX))
    beyond = float(np.mean(disparity > max_disparity))
    if behind > _SWAPPED_SHARE:
        found.add(
            "swapped",
            True,
            f"left and right are swapped: {behind:.0%} of the matches lie farther right in the "
            "right image: exchange the two recordings (or, if the cameras converge, rectify)",
        )
    elif negative > _NOTED_SHARE:
        found.add(
            "negative-disparity",
            negative > _RUINED_SHARE,
            f"{negative:.0%} of the matches have disparities below 0 (down to {low:.0f} px), which "
            "are not looked for: the cameras converge, so rectify them by giving the calibration "
            "to --rig",
        )
    if beyond > _NOTED_SHARE:
        found.add(
            "beyond-range",
            beyond > _RUINED_SHARE,
            f"{beyond:.0%} of the matches have disparities above {max_disparity} px (up to "
            f"{high:.0f}): give --max-disparity {advised}",
        )
    grey = float(np.median(matches.grey))
    if abs(grey) > _GREY_DIFFERENCE:
        found.add(
            "grey-difference",
            False,
            f"the {'left' if grey > 0 else 'right'} recording is {abs(grey):.0f} grey levels "
            "brighter: give both cameras the same exposure and gain",
        )
    return dataclasses.replace(
        report,
        disparity_low_px=low,
        disparity_high_px=high,
        advised_max_disparity=advised,
        grey_difference=grey,
    )
