"""What is wrong with a stereo recording, before it costs an hour.

A few windows of consecutive frames are looked at closely: features (SIFT) are matched between the
views, and followed over time in the left one (Lucas-Kanade). All else is statistics on these
matches. How far the views are out of step comes only from the rows: in rectified views a feature
lies on one row in both, so where the right view is n frames ahead of the left one, and a feature
moves down by v px a frame, it lies n v px lower in the right view. n is the slope of that line.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from motionstereo_cli.check.features import (
    NO_MATCHES,
    FrameWindow,
    Matches,
    joined,
    shrunk,
    without_repetitions,
)
from motionstereo_cli.check.findings import DARK_GREY, CheckReport, Finding
from motionstereo_cli.check.lag import BANDS, lag_of, profile, small
from motionstereo_cli.check.mounting import mounted
from motionstereo_cli.check.synchrony import (
    MAX_STEP,
    Fit,
    PairingStep,
    confirmed_step,
    fit_rows,
    step_or_drift,
)
from motionstereo_cli.method.settings import MAX_DISPARITY
from motionstereo_cli.types import StereoFrame

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.check.lag import Profile
    from motionstereo_cli.types import Grey, Rig

    Column = NDArray[np.float64]

#: Frames in a window, those of them in which features are matched, and windows in a recording.
WINDOW_FRAMES = 16
MAX_WINDOWS = 5
_STEP_WINDOWS = 3
_MOMENTS = (3, 5, 7, 9, 11)
_FEW_MOMENTS = (4, 8, 12)

#: Images are looked at in at most this width, in px; at the start of a run in half their own, but
#: not less than the quick one.
_FEATURE_WIDTH = 640
_QUICK_WIDTH = 320
_MOTION_WIDTH = 160


#: Frames whose motion tells a step where the rows of few features do not.
_PROFILED_FRAMES = 600


#: Windows in which one pair of images is looked at for how the cameras stand.
_MOUNTED_WINDOWS = 2
#: Mean difference in grey levels of neighbouring pixels below which an image is blank.
_MIN_TEXTURE = 0.2
#: Disparities above minus this count as not negative.
_ZERO_PX = 0.5

#: Disparities up to so many px tell the constant error of all.
_OFFSET_RANGE_PX = 128

#: A range reaches so many times as far as 98 % of the features that are found.
_NEARER = 1.5
#: A pixel moves where its grey level changes by more; an image where this share of it does.
_MOTION_GREY = 6
_MOVING_SHARE = 5e-3


def check(
    frames: Iterable[StereoFrame],
    max_disparity: int,
    *,
    expected_frames: int | None = None,
    rig: Rig | None = None,
    given_offset_px: float = 0.0,
    progress: Callable[[], object] = lambda: None,
) -> CheckReport:
    """Look at windows spread over a recording, and at the motion in all of it.

    Args:
        frames: stereo frames of one size.
        max_disparity: range that the processing is to look in, in px.
        expected_frames: how many frames there are, None if unknown.
        rig: what a calibration says of the frames; None without one.
        given_offset_px: what ``--disparity-offset`` has added to its ``doffs``.
        progress: called after each frame.
    """
    windows = starts(expected_frames)
    checker = _Checker(windows, _MOMENTS)
    finder = None
    if rig is not None:
        from motionstereo_cli.robot.odometer import Odometer, OffsetFinder

        finder = OffsetFinder(Odometer(rig, min(max_disparity, _OFFSET_RANGE_PX)))
    for number, frame in enumerate(frames):
        checker.see(frame)
        if finder is not None and any(0 <= number - start < WINDOW_FRAMES for start in windows):
            finder.see(frame)
        progress()
    report = checker.report(max_disparity, rig, given_offset_px)
    offset_px = None if finder is None else round(finder.offset_px, 3)
    return dataclasses.replace(report, disparity_offset_px=offset_px)


def watched(
    frames: Iterable[StereoFrame],
    max_disparity: int,
    tell: Callable[[Sequence[Finding]], object],
    *,
    rig: Rig | None = None,
    given_offset_px: float = 0.0,
) -> Iterator[StereoFrame]:
    """Yield the frames as they come, and tell once what is wrong, soon after the first window.

    Where that is dark, the window is the first one in the light.

    No frame is held back or read twice: the window is looked at in a thread while frames go on.
    """
    checker, left_to_see, in_the_dark = _new_watch(), WINDOW_FRAMES, False
    known = max_disparity, rig, given_offset_px
    found: Future[list[Finding]] | None = None
    with ThreadPoolExecutor(1, "check") as thread:
        for frame in frames:
            if in_the_dark and not _is_dark(frame):
                # Only the opening was dark: what follows is looked at instead.
                checker, left_to_see, in_the_dark = _new_watch(), WINDOW_FRAMES, False
            if left_to_see:
                checker.see(frame)
                left_to_see -= 1
                if not left_to_see:
                    in_the_dark = _is_dark(frame)
                    if not in_the_dark:
                        found = thread.submit(_opening, checker, *known)
                        checker = _new_watch()  # what it saw is no longer needed
            if found is not None and found.done():
                tell(found.result())
                found = None
            yield frame
        if found is not None:
            tell(found.result())
    if left_to_see or in_the_dark:
        tell(_opening(checker, *known))


def advised_range(sample: Iterable[StereoFrame]) -> CheckReport:
    """Return the report of frames sampled to find the range of disparities, window after window."""
    windows = range(0, MAX_WINDOWS * WINDOW_FRAMES, WINDOW_FRAMES)
    checker = _Checker(windows, _MOMENTS)
    for frame in sample:
        checker.see(frame)
    return checker.report(MAX_DISPARITY, None, 0.0)


def step_of(frames: Iterable[StereoFrame], expected_frames: int | None) -> PairingStep | None:
    """Return how far the views are out of step, up to a few frames; None where rows do not tell it.

    Args:
        frames: stereo frames of one size.
        expected_frames: how many there are, None if unknown.
    """
    checker = _Checker(starts(expected_frames, _STEP_WINDOWS), _MOMENTS, quick=True)
    for frame in frames:
        checker.see(frame)
    return checker.step()


def _new_watch() -> _Checker:
    return _Checker([0], _FEW_MOMENTS, quick=True)


def _is_dark(frame: StereoFrame) -> bool:
    return bool(np.percentile(frame.left[::4, ::4], 99.9) < DARK_GREY)


def _opening(
    checker: _Checker, max_disparity: int, rig: Rig | None, given_offset_px: float
) -> list[Finding]:
    found = checker.report(max_disparity, rig, given_offset_px).findings
    # So little seen is no reason to interrupt a run.
    return [finding for finding in found if finding.name != "few-matches"]


def starts(expected_frames: int | None, most: int = MAX_WINDOWS) -> Sequence[int]:
    """Return the frames at which windows begin, at most so many.

    They are evenly spread, or ever farther apart where no end is known.
    """
    if expected_frames is None:
        return [0, *(100 * 4**i for i in range(most - 1))]
    room = max(expected_frames - WINDOW_FRAMES, 0)
    count = max(1, min(most, expected_frames // WINDOW_FRAMES))
    return [room * i // max(count - 1, 1) for i in range(count)]


class _Checker:
    """Takes in frames; keeps small copies of those in windows, and the motion of all."""

    def __init__(
        self, starts: Sequence[int], moments: Sequence[int], *, quick: bool = False
    ) -> None:
        self._starts = starts
        self._moments = moments
        self._quick = quick
        self._windows: list[FrameWindow] = []
        self._moved: tuple[list[float], list[float]] = ([], [])
        self._last: tuple[tuple[Grey, Grey], ...] = ()
        self._frames = 0
        self._scale = 1.0
        self._profiles: tuple[list[Profile], list[Profile]] = ([], [])
        self._last_small: list[Grey] = []

    def see(self, frame: StereoFrame) -> None:
        number, self._frames = self._frames, self._frames + 1
        sides = (frame.left, frame.right)
        now = (_for_motion(frame.left), _for_motion(frame.right))
        looked_at = tuple(zip(sides, now, strict=True))
        for moved, image, last in zip(self._moved, looked_at, self._last, strict=False):
            moved.append(_moved_share(*image, *last))
        self._last = looked_at
        if not self._quick and number <= _PROFILED_FRAMES:
            shown = [small(side) for side in sides]
            for rows, one, before in zip(self._profiles, shown, self._last_small, strict=False):
                rows.append(profile(one, before))
            self._last_small = shown
        if number in self._starts:
            self._windows.append(FrameWindow(number, self._moments))
        if self._windows and number < self._windows[-1].start + WINDOW_FRAMES:
            left, right = (shrunk(side, self._feature_width(frame)) for side in sides)
            self._scale = frame.left.shape[1] / left.shape[1]
            self._windows[-1].left.append(left)
            self._windows[-1].right.append(right)

    def _feature_width(self, frame: StereoFrame) -> int:
        if not self._quick:
            return _FEATURE_WIDTH
        half: int = frame.left.shape[1] // 2
        return min(_FEATURE_WIDTH, max(_QUICK_WIDTH, half))

    def report(self, max_disparity: int, rig: Rig | None, given_offset_px: float) -> CheckReport:
        report = CheckReport(
            *(max_disparity, self._frames),
            calibrated=rig is not None,
            given_offset_px=given_offset_px,
            **_motion(*self._moved),
        )
        if not self._windows:
            return report
        matches = [window.matches(0) for window in self._windows]
        step, drift = step_or_drift(self._windows, matches)
        by_motion = self._step_by_motion()
        # Rows of a few images know nothing of larger steps.
        if by_motion is not None and abs(by_motion.whole) > MAX_STEP:
            step, drift = by_motion, None
        elif drift is None:
            step = step or by_motion
        if step is not None and step.whole:  # rows and disparities once that is put right
            matches = [window.matches(step.whole) for window in self._windows]
        seen = joined(matches)
        rows = fit_rows(seen, self._windows[0].shape)
        repeats = np.concatenate([window.repeats() for window in self._windows])
        agreed = NO_MATCHES
        if rows is not None:
            agreed = without_repetitions(seen.where(rows.chosen), repeats)
        return dataclasses.replace(
            report,
            ahead_frames=None if step is None else step.frames,
            step_frames=0 if step is None else step.whole,
            step_certain=step is not None and step.is_certain,
            drift=drift,
            matches=len(seen),
            mounted=mounted(self._windows[:_MOUNTED_WINDOWS]),
            **_light(self._windows),
            **_alignment(rows, seen, self._windows[0].shape, self._scale),
            **_disparities(
                *(agreed, self._scale, max_disparity),
                *(rig.doffs if rig else 0.0, given_offset_px),
            ),
        )

    def step(self) -> PairingStep | None:
        """Return how far the views are out of step by their rows; None where these do not tell."""
        if not self._windows:
            return None
        return confirmed_step(self._windows)

    def _step_by_motion(self) -> PairingStep | None:
        """Return the step at which the motion of whole rows agrees, where that is certain."""
        left, right = (np.array(rows, np.float32).reshape(-1, BANDS) for rows in self._profiles)
        found = lag_of(left, right, len(left) // 2)
        if found is None or not found.is_certain:
            return None
        return PairingStep(-found.images, float(-found.images))


def _light(windows: Sequence[FrameWindow]) -> dict[str, Any]:
    """Return how bright images are, and how much alike the views."""
    pairs = [(window.left[-1], window.right[-1]) for window in windows]
    brightest = max(int(np.percentile(image, 99.9)) for pair in pairs for image in pair)
    apart = np.mean([np.mean(cv2.absdiff(left, right)) for left, right in pairs])
    aside = 0.0
    if pairs[0][0].shape[1] > 1:
        aside = np.mean([np.mean(cv2.absdiff(left[:, 1:], left[:, :-1])) for left, _ in pairs])
    alike = float(apart / aside) if aside > _MIN_TEXTURE else None
    return {"brightest": brightest, "alike": alike}


#: Share that moves where an image is not the last one, but hardly differs.
_HARDLY = 1e-9


def _for_motion(grey: Grey) -> Grey:
    # Small and blurred: a sensor's noise and a codec's are gone, objects that move are not.
    return np.asarray(cv2.blur(shrunk(grey, _MOTION_WIDTH), (3, 3)), np.uint8)


def _moved_share(image: Grey, small: Grey, last: Grey, last_small: Grey) -> float:
    """Return the share of the small image that has changed; 0 only if the image is the last one."""
    if np.array_equal(image, last):
        return 0.0
    return max(float(np.mean(cv2.absdiff(small, last_small) > _MOTION_GREY)), _HARDLY)


def _repeated(moved: Column, other: Column) -> NDArray[np.bool_]:
    """Return which images repeat the last one while objects move, (n,) bool.

    They do if the other view changes, or this one just before and after.

    Args:
        moved, other: (n,) shares of this view and the other one that move, n = frames - 1.
    """
    around = np.pad(moved, 1)
    moving = np.maximum(other, np.minimum(around[:-2], around[2:])) > _MOVING_SHARE
    repeated: NDArray[np.bool_] = (moved == 0) & moving
    return repeated


def _motion(left: Sequence[float], right: Sequence[float]) -> dict[str, Any]:
    """Return the fields of the report on motion, from the share of each view that moves.

    Args:
        left, right: the share, 0..1, of each frame after the first.
    """
    if not left:
        return {}
    moved = {"left": np.array(left), "right": np.array(right)}
    found: dict[str, Any] = {"moving": float((moved["left"].mean() + moved["right"].mean()) / 2)}
    for side, other in (("left", "right"), ("right", "left")):
        images = np.flatnonzero(_repeated(moved[side], moved[other]))
        found[f"repeated_{side}"] = len(images)
        found[f"first_repeated_{side}"] = int(images[0]) + 1 if len(images) else None
    return found


def _alignment(
    rows: Fit | None, matches: Matches, shape: tuple[int, ...], scale: float
) -> dict[str, Any]:
    """Return the fields of the report on row alignment; none with too few matches."""
    if rows is None:
        return {}
    still = matches.lower - rows.step * matches.down
    off = np.abs(still[rows.chosen]) * scale
    shift, turn, size = rows.terms[:3]
    # The same over the whole image, because features may lie in its middle only.
    x, y = np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-1, 1, 21) * shape[0] / shape[1])
    image_px = np.percentile(np.abs(shift + turn * x + size * y), 90) * scale
    return {
        "misaligned_px": float(np.median(off)),
        "misaligned_p90_px": float(np.percentile(off, 90)),
        "misaligned_image_px": float(image_px),
        "shifted_px": float(shift * scale),
        "turned_deg": math.degrees(math.atan(turn / (shape[1] / 2))),
    }


def _disparities(
    matches: Matches, scale: float, max_disparity: int, doffs: float, given_offset_px: float
) -> dict[str, Any]:
    """Return the fields of the report on disparities and grey levels; none without matches."""
    if not len(matches):
        return {}
    disparity = matches.disparity * scale
    low, high = (float(value) for value in np.percentile(disparity, [2, 98]))
    # Features are rare on what is nearest: ground before the camera, and what passes close by.
    nearest = _NEARER * high
    return {
        "disparity_low_px": low,
        "disparity_high_px": high,
        "advised_max_disparity": min(16 * math.ceil(max(nearest, 16) / 16), MAX_DISPARITY),
        "behind": float(np.mean(disparity + doffs - given_offset_px < -_ZERO_PX)),
        "put_behind": float(np.mean(disparity + doffs < -_ZERO_PX)),
        "negative": float(np.mean(disparity < -_ZERO_PX)),
        "beyond": float(np.mean(disparity > max_disparity)),
        "grey_difference": float(np.median(matches.grey)),
    }
