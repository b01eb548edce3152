"""``--sync-offset auto``: how far two recordings are apart is measured before they are paired."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from motionstereo_cli.check.lag import BANDS, lag_of, profile, profiles, small
from motionstereo_cli.check.sound import LISTENED_S, sound_shift_s
from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.sources import StereoSource, open_stereo
from motionstereo_cli.sources.settings import AUTO_OFFSET, InputSettings

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.check.lag import Lag

Say = Callable[[str, str], object]

#: Images of each side that are looked at: a few, and more where these do not tell.
_STAGES = (360, 2400)

#: Images at the end that tell whether the step is still the same, and how far they may be off.
_END_FRAMES, _END_REACH = 240, 60

#: Overlap that a lag needs: at least so many images, and one of this many parts of all.
_MIN_OVERLAP, _LEAST_PART = 24, 4

#: A lag that is not certain is taken where the views agree by more than this.
_LIKELY = 0.6

#: Drift over a recording that is worth a word, in s.
_DRIFT_S = 0.01


class _Sighted(NamedTuple):
    """One side: profiles of its images, (n, bands), and the number of each, (n,)."""

    profiles: NDArray[np.float32]
    numbers: NDArray[np.int64]


def with_offset(
    left: str | Path, right: str | Path | None, settings: InputSettings, say: Say
) -> InputSettings:
    """Return the settings with what was measured in the place of ``--sync-offset auto``.

    By the sound in both files, where they have it, ``sync_shift`` in s; otherwise by motion,
    ``sync_offset`` in images.

    Args:
        left, right: the recordings; they are read twice.
        settings: how to read them.
        say: called with a kind, ``note`` or ``warning``, and a line.

    Raises:
        InputError: neither tells it.
        SettingsError: the recordings can be read only once.
    """
    if settings.sync_offset != AUTO_OFFSET:
        return settings
    unsettled = dataclasses.replace(settings, sync_offset=0)
    return _by_sound(left, right, unsettled, say) or _by_motion(left, right, unsettled, say)


def _by_sound(
    left: str | Path, right: str | Path | None, settings: InputSettings, say: Say
) -> InputSettings | None:
    with open_stereo(left, right, settings) as source:
        if not source.rereadable:
            raise SettingsError("--sync-offset auto reads the recordings twice: give files")
        files, length_s = source.first_files, source.length_s
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
    return dataclasses.replace(settings, sync_shift=shift_s)


def _by_motion(
    left: str | Path, right: str | Path | None, settings: InputSettings, say: Say
) -> InputSettings:
    found: Lag | None = None
    for most in _STAGES:
        sides = []
        for view in (0, 1):  # opened for each: one recording may hold both
            with open_stereo(left, right, settings) as source:
                sides.append(_seen(source, view, most))
        lengths = [len(side.profiles) for side in sides]
        found = lag_of(
            *(sides[0].profiles, sides[1].profiles),
            max(lengths),
            max(_MIN_OVERLAP, min(lengths) // _LEAST_PART),
        )
        if (found and found.is_certain) or max(lengths) < most - 1:
            break
    if found is None or not (found.is_certain or found.agreement > _LIKELY):
        raise InputError(
            "--sync-offset auto: the motion in both recordings does not tell how far they are "
            "apart: give --sync-offset N, or recordings in which something moves"
        )
    offset = _in_numbers(found.images, *sides)
    say(
        "note" if found.is_certain else "warning",
        f"--sync-offset {offset}: measured by the motion in {min(lengths) + 1} images"
        + ("" if found.is_certain else ", which other offsets explain nearly as well: check it"),
    )
    settled = dataclasses.replace(settings, sync_offset=offset)
    _say_drift(left, right, settled, say)
    return settled


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


def _say_drift(
    left: str | Path, right: str | Path | None, settings: InputSettings, say: Say
) -> None:
    """Warn where the step at the end of long recordings is another one."""
    with open_stereo(left, right, settings) as source:
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
