"""How the rows of two views agree, and how far the views are out of step.

In rectified views a feature lies on one row in both. So where the right view is n frames ahead of
the left one, and a feature moves down by v px a frame, it lies n v px lower in the right view. n is
the slope of that line.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from motionstereo_cli.check.features import FrameWindow, Matches, joined
from motionstereo_cli.check.findings import Drift

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Column = NDArray[np.float64]


_MIN_MATCHES = 30


# Steps in time.
MAX_STEP = 4


_MOVING_PX = 0.1  # a frame


_MIN_MOVING = 20


_MIN_REST = 0.3


_CERTAIN_SIGMAS = 5.0


# Rows at a step that is certain agree by this factor better than at the next ones.
_CLEARLY_BETTER_ROWS = 0.9


_CERTAIN_FRAMES = 0.14  # standard error of a step beside which none of the next ones is likely


# Where a step leads, rows agree by this factor better than without; more so for one of many tried.
_BETTER_ROWS, _MUCH_BETTER_ROWS = 0.85, 0.5


@dataclass(frozen=True, slots=True)
class Fit:
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
        """Frames by which the right view is ahead."""
        return float(self.terms[3])


def _design(matches: Matches, shape: tuple[int, ...]) -> NDArray[np.float64]:
    half = shape[1] / 2
    x, y = matches.x / half - 1, (matches.y - shape[0] / 2) / half
    return np.column_stack([np.ones_like(x), x, y, matches.down])


def fit_rows(matches: Matches, shape: tuple[int, ...]) -> Fit | None:
    """Fit robustly, from no step and from the likeliest; None where too few matches agree."""
    if len(matches) < _MIN_MATCHES:
        return None
    moving = np.abs(matches.down) > _MOVING_PX
    starts = [0.0]
    if moving.sum() >= _MIN_MOVING:
        starts.append(_roughly(matches.lower[moving], matches.down[moving]))
    fits = [_refined(matches, shape, moving, start, len(starts) > 1) for start in starts]
    return min((fit for fit in fits if fit), key=lambda fit: fit.error_px, default=None)


def _refined(
    matches: Matches,
    shape: tuple[int, ...],
    moving: NDArray[np.bool_],
    start: float,
    with_step: bool,
) -> Fit | None:
    lower = matches.lower
    design = _design(matches, shape)[:, : 4 if with_step else 3]
    # What moves tells the step and is often little beside what does not: the same say for both.
    say = np.where(moving, 1.0, min(1.0, max(moving.sum(), 1) / max((~moving).sum(), 1)))
    rest = lower - start * matches.down
    chosen = np.abs(rest - np.median(rest)) < 3
    for _ in range(10):
        if chosen.sum() < _MIN_MATCHES / 2:
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
        return Fit(np.append(terms, 0.0), math.inf, chosen, error_px, error_px)
    weighted = design[chosen] * say[chosen][:, None]
    variance = np.linalg.pinv(design[chosen].T @ weighted)[3, 3] * spread**2
    off = np.abs(lower - design[:, :3] @ terms[:3])[moving]
    off_px = float(np.minimum(off, 1).mean())
    return Fit(terms, math.sqrt(max(variance, 0.0)), chosen, off_px, error_px)


def _roughly(lower: Column, down: Column) -> float:
    """Return the step that makes most rows agree, by trying."""
    steps = np.arange(-MAX_STEP - 1, MAX_STEP + 1.5, 0.5)
    rest = lower - steps[:, None] * down
    off = np.abs(rest - np.median(rest, axis=1, keepdims=True))
    return float(steps[np.minimum(off, 1).sum(axis=1).argmin()])


class PairingStep(NamedTuple):
    """By how many frames the right view is ahead.

    Attributes:
        whole: as a whole number.
        frames: as it was measured.
        sigma: standard error of that.
    """

    whole: int
    frames: float
    sigma: float = math.inf

    @property
    def is_certain(self) -> bool:
        """Whether no other whole number can be meant."""
        return abs(self.frames - self.whole) < _MIN_REST and self.sigma < _CERTAIN_FRAMES


def _walk(windows: Sequence[FrameWindow], matches: Matches) -> PairingStep | None:
    """Return the step of some windows, searched from 0; None if it cannot be found.

    Speeds change, and those of slow objects are uncertain, so a fit gives little more than the
    direction: the search moves that way by whole frames while fits point onward. Where speeds
    change much, the direction misleads: if the best fit still points onward, all steps are tried.
    """
    tried: dict[int, Fit] = {}

    def attempt(whole: int) -> bool:
        if whole in tried or abs(whole) > MAX_STEP:
            return False
        pooled = joined([window.matches(whole) for window in windows]) if whole else matches
        fit = fit_rows(pooled, windows[0].shape)
        if fit is None or math.isinf(fit.sigma):
            return False
        tried[whole] = fit
        return True

    whole = 0
    while attempt(whole) and abs(tried[whole].step) >= _MIN_REST:
        rest = tried[whole].step
        whole += max(1, round(abs(rest))) * (1 if rest > 0 else -1)
    if not tried:
        return None
    if len(tried) > 1:
        nearest = min(tried, key=lambda whole: tried[whole].off_px)
        attempt(nearest - 1)
        attempt(nearest + 1)
    walked = set(tried)
    nearest = min(tried, key=lambda whole: tried[whole].off_px)
    if abs(tried[nearest].step) >= _MIN_REST:
        for step in range(-MAX_STEP, MAX_STEP + 1):
            attempt(step)
    # Where it leads, rows have to agree better without any step than they did at first.
    best = min(tried, key=lambda whole: tried[whole].off_px)
    better = _BETTER_ROWS if best in walked else _MUCH_BETTER_ROWS
    certain = (
        tried[best].off_px < better * tried[0].off_px
        and abs(best + tried[best].step) > _CERTAIN_SIGMAS * tried[best].sigma
    )
    if best and certain:
        return PairingStep(best, best + tried[best].step, tried[best].sigma)
    if abs(tried[0].step) < _MIN_REST:
        return PairingStep(0, tried[0].step, tried[0].sigma)
    return None


def confirmed_step(windows: Sequence[FrameWindow]) -> PairingStep | None:
    """Return the step of some windows; None if nothing tells it.

    No step is certain only if rows agree clearly worse at the next steps on both sides.
    """
    step = _walk(windows, joined([window.matches(0) for window in windows]))
    if step is None or step.whole:
        return step
    pooled = (joined([window.matches(whole) for window in windows]) for whole in (0, -1, 1))
    off_px = [fit.off_px for each in pooled if (fit := fit_rows(each, windows[0].shape))]
    if len(off_px) > 1 and off_px[0] > _CLEARLY_BETTER_ROWS * min(off_px[1:]):
        return step._replace(sigma=math.inf)
    return step


def step_or_drift(
    windows: Sequence[FrameWindow], matches: Sequence[Matches]
) -> tuple[PairingStep | None, Drift | None]:
    """Return the step of a whole recording, or how it changes; None where that is not known.

    Args:
        windows: parts of the recording.
        matches: the matches of each, in step.
    """
    steps = [
        (step, window.start)
        for window, each in zip(windows, matches, strict=True)
        if (step := _walk([window], each)) is not None
    ]
    wholes = [step.whole for step, _ in steps]
    # Lost frames stay lost, so drift goes one way; a single window is mistaken.
    if steps and wholes[0] != wholes[-1] and wholes in (sorted(wholes), sorted(wholes)[::-1]):
        (first, first_at), (last, last_at) = steps[0], steps[-1]
        if first.is_certain and last.is_certain:
            return None, Drift(first.frames, first_at, last.frames, last_at)
    return _walk(windows, joined(matches)), None
