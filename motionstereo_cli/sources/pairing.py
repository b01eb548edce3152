"""Pairing of left and right images."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from motionstereo_cli.errors import SettingsError
from motionstereo_cli.sources.names import joint_marks, natural_key

if TYPE_CHECKING:
    from motionstereo_cli.sources.recording import Recording
    from motionstereo_cli.sources.settings import InputSettings
    from motionstereo_cli.sources.sides import SideImage

T = TypeVar("T")

#: If rates differ by more than this share, times pair badly: one of them is mislabelled, or they
#: are not of one rig.
_RATES_APART = 0.1

#: Recordings that begin further apart, in s, have independent clocks.
_CLOCKS_APART_S = 1.0

#: Minimum number of images for comparing clocks.
_FEW = 3

#: Weight of a new difference when following the offset of two clocks.
_FOLLOWING = 0.2


@dataclass(frozen=True, slots=True)
class Pairing:
    """How images are paired.

    Attributes:
        lead: how much earlier a left image is than a right one; negative if it is later.
        tolerance: largest difference in a pair.
        by_time: whether differences are times.
        note: called with each pair.
        warning: what contradicts the pairing, empty if nothing does.
        thinned: the recording of the higher rate, if not all of its images have partners.
    """

    lead: Callable[[SideImage, SideImage], Fraction]
    tolerance: Fraction = Fraction(0)
    by_time: bool = False
    note: Callable[[SideImage, SideImage], object] = lambda *_: None
    warning: str = ""
    thinned: Recording | None = None


def pairing(left: Recording, right: Recording, settings: InputSettings) -> Pairing:
    """Return how images of two recordings are paired.

    As the settings say. Otherwise by the first of these that both have: time stamps of cameras,
    numbers in file names, common names, times of containers, positions.

    Raises:
        SettingsError: the settings need times that a recording does not have.
    """
    if settings.measures_offset:
        raise SettingsError("--sync-offset auto is to be measured first: give the number")
    how = _by_time(left, right, settings) if settings.offset is None else None
    return how or _by_names(left, right, settings.offset)


def _by_time(left: Recording, right: Recording, settings: InputSettings) -> Pairing | None:
    """Return the pairing by times, requested by the settings or given by cameras or containers."""
    tolerance = Fraction(str(settings.sync_tolerance))
    for flag, given in (
        ("--sync-tolerance", settings.sync_tolerance),
        ("--sync-shift", settings.sync_shift),
    ):
        if given:
            need_time(flag, left)
            need_time(flag, right)
    half_period = _half_period(left, right)
    stamped = left.stamped and right.stamped
    shift_s = settings.shift_s
    reach = tolerance or (half_period if stamped or shift_s is not None else None)
    if reach and stamped and shift_s is None and (ahead_s := _clocks_apart_s(left, right)):
        said = (
            f"the clock of {right.name} is {abs(float(ahead_s)):.3f} s "
            f"{'ahead of' if ahead_s > 0 else 'behind'} that of {left.name}, by the times at which "
            f"both were recorded: images are paired by that, as with --sync-shift "
            f"{float(ahead_s):.6f}; give another one if you know it better"
        )
        return Pairing(
            lambda one, other: _time_lead(one, other) - ahead_s, reach, True, warning=said
        )
    if reach:
        shift = shift_s or Fraction(0)
        apart = _apart(left, right, shift, reach) if stamped and not tolerance else ""
        return Pairing(
            lambda one, other: _time_lead(one, other) - shift, reach, True, warning=apart
        )
    told = (left.numbered and right.numbered) or _share_names(left.names, right.names)
    if half_period and left is not right and left.timed and right.timed and not told:
        return _by_containers(left, right, half_period)
    return None


def _clocks_apart_s(left: Recording, right: Recording) -> Fraction | None:
    """Return how far the right clock is ahead by one recorder's times; None if they agree."""
    if left.clock_ahead_s is None or right.clock_ahead_s is None:
        return None
    ahead_s = right.clock_ahead_s - left.clock_ahead_s
    return ahead_s if abs(ahead_s) >= _CLOCKS_APART_S else None


def _by_names(left: Recording, right: Recording, given: int | None) -> Pairing:
    """Return the pairing by numbers in names (which an offset is of), names, or positions."""
    offset = given or 0
    if left.numbered and right.numbered:
        return Pairing(
            lambda one, other: Fraction(other.pts - offset - one.pts),
            warning=_strangers(left, right, offset),
        )
    if given is None and _share_names(left.names, right.names):
        return Pairing(_NameLead(left.names, right.names))
    if given is None and (marks := joint_marks(left.names, right.names)):
        return _by_marks(*marks)
    return Pairing(lambda one, other: Fraction(other.number - offset - one.number))


def _strangers(left: Recording, right: Recording, offset: int) -> str:
    """Return a warning if the numbers in the names of both sides do not overlap."""
    (first, last), (begin, end) = (
        (side.begin_pts, side.outline()[-1][1]) if side.outline() else (0, 0)
        for side in (left, right)
    )
    if begin - offset <= last and first <= end - offset:
        return ""
    return (
        f"the images of {left.name} have the numbers {first} to {last} and those of {right.name} "
        f"{begin} to {end}: if the first ones belong together, give --sync-offset {begin - first}"
    )


def _half_period(left: Recording, right: Recording) -> Fraction | None:
    if left.frame_rate and right.frame_rate:
        return 1 / (2 * max(left.frame_rate, right.frame_rate))
    return None


def need_time(flag: str, recording: Recording) -> None:
    """Check that a recording has times, which an option needs.

    Raises:
        SettingsError: it has none.
    """
    if recording.time_base is None:
        raise SettingsError(f"{flag}: {recording.name} has no time stamps: give --frame-rate")


def _time_lead(one: SideImage, other: SideImage) -> Fraction:
    return (other.time_s or Fraction(0)) - (one.time_s or Fraction(0))


def _share_names(left: Sequence[str], right: Sequence[str]) -> bool:
    """Return whether most names of the shorter side are also names of the other."""
    common = len(set(left) & set(right))
    return common > 0 and 2 * common >= min(len(left), len(right))


class _NameLead:
    """Orders the names of both sides together."""

    def __init__(self, left: Sequence[str], right: Sequence[str]) -> None:
        self._left, self._right = left, right
        ordered = sorted({*left, *right}, key=natural_key)
        self._places = {name: place for place, name in enumerate(ordered)}

    def __call__(self, one: SideImage, other: SideImage) -> Fraction:
        left, right = self._left[one.number], self._right[other.number]
        return Fraction(self._places[right] - self._places[left])


def _by_marks(left: Sequence[int], right: Sequence[int]) -> Pairing:
    """Pair by the differing part of names, if both count from one origin; else by positions.

    Steps of one side that the other does not have indicate lost images.
    """
    steps = [np.diff(np.array(side, np.float64)) for side in (left, right)]
    step = Fraction(min((float(np.median(each)) for each in steps if len(each)), default=1.0))
    if min(left[-1], right[-1]) + step >= max(left[0], right[0]):
        return Pairing(
            lambda one, other: Fraction(right[other.number] - left[one.number]), step / 2
        )
    common = min(map(len, steps))
    differing = np.flatnonzero(np.abs(steps[0][:common] - steps[1][:common]) > step / 2)
    warning = ""
    if len(differing):
        warning = (
            "the numbers in the names of the images are of different clocks, and their steps "
            f"differ after image {differing[0]}: images are paired by place, and where one is lost "
            "on one side, all after it are of different moments"
        )
    return Pairing(lambda one, other: Fraction(other.number - one.number), warning=warning)


def _apart(left: Recording, right: Recording, shift: Fraction, reach: Fraction) -> str:
    """Return a warning if the nearest time stamps are always far apart, else an empty text."""
    times = []
    for side in (left, right):
        if len(outline := side.outline()) < _FEW or side.time_base is None:
            return ""
        # Differences in integers: a float cannot represent ns since 1970.
        ticks = np.array([pts for _, pts in outline], np.int64) - left.begin_pts
        times.append(ticks * float(side.time_base))
    one, other = times[0], times[1] - float(shift)
    after = np.searchsorted(other, one)
    near = np.stack([other[np.clip(after - back, 0, len(other) - 1)] - one for back in (0, 1)])
    nearest = np.where(np.abs(near[0]) < np.abs(near[1]), *near)
    apart_s = float(np.median(nearest))
    if abs(apart_s) < float(reach) / 2:
        return ""
    begin_s = float(other[0] - one[0] + shift)
    return (
        f"the time stamps of {right.name} are {apart_s:+.6g} s from the nearest ones of "
        f"{left.name}: if their clocks differ, say by how much with --sync-shift (if both begin "
        f"together, {begin_s:.6f})"
    )


def _by_containers(left: Recording, right: Recording, half_period: Fraction) -> Pairing:
    """Pair by the containers' times; if their clocks are independent, beginning at equal numbers.

    A lost image is a step of the difference by more than half a period. Smaller and slower
    changes are jitter and drift, which are followed.
    """
    one, other = left.frame_rate or 0, right.frame_rate or 0
    thinned = None
    if max(one, other) > (1 + _RATES_APART) * min(one, other):
        thinned = left if one > other else right
        said = (
            f"{left.name} has {float(one):.6g} images per second and {right.name} "
            f"{float(other):.6g}: "
        )
    if thinned is not None and not _as_long(left, right):
        return Pairing(
            lambda one, other: Fraction(other.number - one.number),
            warning=f"{said}they are paired by number; if both rates are right, give "
            "--sync-tolerance",
        )
    apart_s = float(right.begin_s - left.begin_s)
    same_clock = bool(left.clock) and left.clock == right.clock and abs(apart_s) < _CLOCKS_APART_S
    step = _Step(0.0 if same_clock else None, 2 * half_period)
    warning = ""
    if left.clock and left.clock == right.clock and abs(apart_s) >= half_period:
        later, sooner = (right, left) if apart_s > 0 else (left, right)
        warning = f"{later.name} begins {abs(apart_s):.3f} s after {sooner.name}: " + (
            "images before that have no partner"
            if same_clock
            else "their first images are paired all the same; if their clocks agree, give "
            f"--sync-tolerance {float(half_period):.3f}"
        )
    if thinned is not None:
        also = f"; {warning}" if warning else ""
        warning = f"{said}images are paired by time, those without a partner are left out{also}"
    return Pairing(
        step.lead, half_period, by_time=True, note=step.note, warning=warning, thinned=thinned
    )


def _as_long(left: Recording, right: Recording) -> bool:
    """Return whether two recordings are equally long by their rates."""
    lengths_s = [
        side.expected_images / side.frame_rate
        for side in (left, right)
        if side.expected_images and side.frame_rate
    ]
    if len(lengths_s) < 2:
        return False
    one, other = lengths_s
    return max(one, other) <= (1 + _RATES_APART) * min(one, other)


class _Step:
    """Follows the difference of two clocks.

    Args:
        offset_s: right time minus left time at one moment; None = not yet known.
        period_s: time between images.
    """

    def __init__(self, offset_s: float | None, period_s: Fraction) -> None:
        self._offset_s, self._period_s = offset_s, period_s

    def lead(self, one: SideImage, other: SideImage) -> Fraction:
        if self._offset_s is None:
            return (other.number - one.number) * self._period_s
        return _time_lead(one, other) - Fraction(self._offset_s)

    def note(self, one: SideImage, other: SideImage) -> None:
        apart_s = float(_time_lead(one, other))
        if self._offset_s is None:
            self._offset_s = apart_s
        self._offset_s += _FOLLOWING * (apart_s - self._offset_s)


def pair(
    lefts: Iterator[T],
    rights: Iterator[T],
    lead: Callable[[T, T], Fraction],
    tolerance: Fraction = Fraction(0),
) -> Iterator[tuple[T, T]]:
    """Yield pairs of left and right items, in order; each item is used at most once.

    An item is skipped if the next one on its side is nearer to its partner.

    Args:
        lefts, rights: items in ascending order.
        lead: how much earlier the left item is than the right one; negative if it is later.
        tolerance: largest difference in a pair.
    """
    left, right = next(lefts, None), next(rights, None)
    while left is not None and right is not None:
        gap = lead(left, right)
        if gap > 0:
            later = next(lefts, None)
            if gap <= tolerance and (later is None or abs(lead(later, right)) >= gap):
                yield left, right
                right = next(rights, None)
            left = later
        elif gap < 0:
            later = next(rights, None)
            if -gap <= tolerance and (later is None or abs(lead(left, later)) >= -gap):
                yield left, right
                left = next(lefts, None)
            right = later
        else:
            yield left, right
            left, right = next(lefts, None), next(rights, None)
