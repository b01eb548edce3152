"""``--sync-offset auto``: how far two recordings are apart is measured before they are paired."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from motionstereo_cli.check.lag import BANDS, MIN_OVERLAP, lag_of, lags_of, profile, profiles, small
from motionstereo_cli.check.measure import step_of
from motionstereo_cli.check.sound import LISTENED_S, sound_shift_s
from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.sources import StereoSource, open_stereo
from motionstereo_cli.sources.settings import InputSettings
from motionstereo_cli.types import Say

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.check.synchrony import PairingStep


Prepare = Callable[[StereoSource], object]

#: Images of each side that are looked at: a few, and more where these do not tell.
_STAGES = (360, 2400)

#: Images at the end that tell whether the step is still the same, and how far they may be off.
_END_FRAMES, _END_REACH = 240, 60

#: A lag needs an overlap of one of this many parts of all.
_LEAST_PART = 4

#: Lags by motion that are looked at closely, and how often one is followed to the next.
_CANDIDATES, _ROUNDS = 3, 3

#: Where this many images overlap, rows or motion alone is believed to the image; where that many
#: do, both together are.
_ALONE, _TOGETHER = 120, 40

#: Standard error in images up to which rows support what motion says.
_SUPPORTING = 0.25

#: Drift over a recording that is worth a word, in s.
_DRIFT_S = 0.01


class _Sighted(NamedTuple):
    """One side: profiles of its images, (n, bands), and the number of each, (n,)."""

    profiles: NDArray[np.float32]
    numbers: NDArray[np.int64]


def with_offset(
    left: str | Path,
    right: str | Path | None,
    settings: InputSettings,
    say: Say,
    prepare: Prepare = lambda _: None,
) -> InputSettings:
    """Return the settings with what was measured in the place of ``--sync-offset auto``.

    By the sound in both files, where they have it, ``sync_shift`` in s; otherwise by motion,
    ``sync_offset`` in images: how much whole rows change tells it to a few images, and the rows of
    features that move up or down tell it exactly.

    Args:
        left, right: the recordings; they are read several times.
        settings: how to read them.
        say: called with a kind, ``note`` or ``warning``, and a line.
        prepare: called with each source that is opened, to have it rectify its images.

    Raises:
        InputError: neither tells it.
        SettingsError: the recordings can be read only once.
    """
    if not settings.measures_offset:
        return settings
    recordings = _Recordings(left, right, prepare)
    unsettled = dataclasses.replace(settings, sync_offset="")
    return _by_sound(recordings, unsettled, say) or _by_motion(recordings, unsettled, say)


class _Recordings(NamedTuple):
    """What is measured, and what is called with each source of it that is opened."""

    left: str | Path
    right: str | Path | None
    prepare: Prepare

    @contextlib.contextmanager
    def opened(self, settings: InputSettings) -> Iterator[StereoSource]:
        with open_stereo(self.left, self.right, settings) as source:
            self.prepare(source)
            yield source


def _by_sound(recordings: _Recordings, settings: InputSettings, say: Say) -> InputSettings | None:
    with open_stereo(recordings.left, recordings.right, settings) as source:
        if not source.rereadable:
            raise SettingsError("--sync-offset auto reads the recordings twice: give files")
        files, length_s = source.recorded, source.length_s
        timed = source.time_base is not None
    if len(files) != 2 or not timed:
        return None
    shift_s = sound_shift_s(files[0], files[1], settings.max_pixels)
    if shift_s is None:
        return None
    shift_s = round(shift_s, 4)
    say("note", f"--sync-shift {shift_s:g}: measured by the sound in both recordings")
    if length_s and length_s > 2 * LISTENED_S:
        late_s = length_s - LISTENED_S
        again_s = sound_shift_s(files[0], files[1], settings.max_pixels, late_s)
        if again_s is not None and abs(again_s - shift_s) > _DRIFT_S:
            say(
                "warning",
                f"the clocks drift apart: by {1000 * (again_s - shift_s):+.0f} ms in "
                f"{late_s:.0f} s: give parts with --start and --end, each with its own offset",
            )
    return dataclasses.replace(settings, sync_shift=f"{shift_s:g}")


def _by_motion(recordings: _Recordings, settings: InputSettings, say: Say) -> InputSettings:
    likeliest = ""
    for most in _STAGES:
        sides = []
        for view in (0, 1):  # opened for each: one recording may hold both
            with recordings.opened(settings) as source:
                sides.append(_seen(source, view, most))
        lengths = [len(side.profiles) for side in sides]
        overlap = max(MIN_OVERLAP, min(lengths) // _LEAST_PART)
        found = lags_of(
            sides[0].profiles, sides[1].profiles, max(lengths), overlap, most=_CANDIDATES
        )
        for lag in found[: 1 if found and found[0].is_certain else None]:
            likely = _with(settings, _in_numbers(lag.images, *sides))
            common = min(lengths[0], lengths[1] - lag.images) - max(0, -lag.images) + 1
            settled, step = _settled(recordings, likely)
            by_rows = step is not None and step.is_certain
            if lag.is_certain and not by_rows and common >= _ALONE:
                settled = likely
            elif settled is None or not (by_rows or lag.is_certain):
                continue
            agreed = settled == likely and step is not None and step.sigma < _SUPPORTING
            sure = common >= _ALONE or (agreed and common >= _TOGETHER)
            _say_found(settled, min(lengths) + 1, None if sure else common, say)
            _say_drift(recordings, settled, say)
            return settled
        if found:
            likeliest = str(_in_numbers(found[0].images, *sides))
        if max(lengths) < most - 1:
            break
    likely_words = f" ({likeliest} seems likeliest, but is not certain)" if likeliest else ""
    raise InputError(
        "--sync-offset auto: the motion in both recordings does not tell how far they are apart: "
        f"give --sync-offset N{likely_words}, or longer recordings, in which something moves up "
        "or down, nearer or farther"
    )


def _with(settings: InputSettings, offset: int) -> InputSettings:
    return dataclasses.replace(settings, sync_offset=str(offset))


def _settled(
    recordings: _Recordings, settings: InputSettings
) -> tuple[InputSettings | None, PairingStep | None]:
    """Return settings at which the rows of both views agree, and how well they tell that.

    Args:
        recordings: the recordings.
        settings: nearly such settings.

    Returns:
        None where rows do not tell them.
    """
    for _ in range(_ROUNDS):
        with recordings.opened(settings) as source:
            expected = min(source.expected_frames or _STAGES[0], _STAGES[0])
            step = step_of(itertools.islice(source, expected), expected)
        if step is None:
            break
        if not step.whole:
            return settings, step
        settings = _with(settings, (settings.offset or 0) - step.whole)
    return None, None


def _say_found(settings: InputSettings, images: int, overlap: int | None, say: Say) -> None:
    """Say what was measured, and of how few images if that is not certain."""
    found = f"--sync-offset {settings.sync_offset}"
    say("note", f"{found}: measured by the motion in {images} images")
    if overlap is not None:
        say(
            "warning",
            f"{found} may be off by an image or two, as little moves in the {overlap} images that "
            "both recordings have in common: see that depth is as expected, or give the offset",
        )


def _seen(source: StereoSource, view: int, most: int) -> _Sighted:
    rows, numbers = [], []
    last = None
    for number, grey in itertools.islice(source.unpaired(view), most):
        image = small(grey)
        if last is not None:
            rows.append(profile(image, last))
            numbers.append(number)
        last = image
    profiles = np.array(rows, np.float32).reshape(-1, BANDS)
    return _Sighted(profiles, np.array(numbers, np.int64))


def _in_numbers(lag: int, left: _Sighted, right: _Sighted) -> int:
    """Return a lag in images as one of numbers, which leave lost images out."""
    begin, end = max(0, -lag), min(len(left.numbers), len(right.numbers) - lag)
    apart = right.numbers[begin + lag : end + lag] - left.numbers[begin:end]
    return int(np.median(apart))


def _say_drift(recordings: _Recordings, settings: InputSettings, say: Say) -> None:
    """Warn where the step at the end of long recordings is another one."""
    with recordings.opened(settings) as source:
        begin = (source.expected_frames or 0) - _END_FRAMES
        if begin < _END_FRAMES or not source.begin_at(begin):
            return
        shown = [
            (small(frame.left), small(frame.right))
            for frame in itertools.islice(source, _END_FRAMES)
        ]
    lefts, rights = (profiles(views) for views in zip(*shown, strict=True))
    found = lag_of(lefts, rights, _END_REACH)
    if found is not None and found.is_certain and found.images:
        say(
            "warning",
            f"the recordings drift apart: at their end {found.images:+d} images more than at their "
            "beginning: frames were dropped, or their rates differ: pair them by time, with "
            "--sync-tolerance",
        )
