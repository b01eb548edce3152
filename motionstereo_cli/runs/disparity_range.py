"""``--max-disparity auto``: the range of disparities is measured before the first frame."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence

from motionstereo_cli.check.measure import WINDOW_FRAMES, advised_range, starts
from motionstereo_cli.errors import InputError
from motionstereo_cli.files.atomic import part_of
from motionstereo_cli.method.settings import AUTO, Settings
from motionstereo_cli.rig.calibration import rectify_source
from motionstereo_cli.runs.folder_files import RUN, read_record
from motionstereo_cli.runs.plan import RunPlan
from motionstereo_cli.sinks.records import RunRecord
from motionstereo_cli.sources import StereoSource, open_stereo
from motionstereo_cli.types import Say, StereoFrame

#: Frames that are decoded of a recording that cannot be read from the middle.
_MAX_DECODED_FRAMES = 1000

#: Windows at most so many frames apart are read one after the other.
_NEAR = 250

#: Code of the warning that the range could not be measured.
RANGE = "range"


def with_range(plan: RunPlan, say: Say) -> RunPlan:
    """Return the plan with a measured ``max_disparity`` where it is to be measured.

    The sample is up to five windows of 16 frames spread over the recording, or over its beginning
    where it cannot be read from the middle. A resumed run keeps its number.

    Args:
        plan: the run; its recordings can be read twice.
        say: called with a kind, ``note`` or ``warning``, and a line.

    Raises:
        InputError: the recordings or the calibration cannot be read.
    """
    if plan.settings.max_disparity != AUTO:
        return plan
    if begun := begun_with(plan):
        for warning in begun.warned:
            if warning.code == RANGE:
                say("warning", warning.text)
        return _settled(plan, int(begun.values("settings")["max_disparity"]))
    return _measured(plan, sample_of(plan), say)


def sample_of(
    plan: RunPlan,
    window: int = WINDOW_FRAMES,
    decoded: int = _MAX_DECODED_FRAMES,
    later: Sequence[int] | None = None,
    *,
    sparse: bool = False,
) -> Iterator[StereoFrame]:
    """Yield the first ``window`` frames of up to five windows, spread over the recordings.

    Args:
        plan: the run.
        window: frames of each window.
        decoded: a recording that cannot be read from the middle is decoded up to this frame.
        later: where the windows after the first begin, if that one is read elsewhere.
        sparse: windows after that frame begin at the key frame before, so that nothing else has to
            be decoded, and those that lie near one before are left out.
    """
    number, places, windows = 0, [0], [-_NEAR]
    if later is not None:
        places, windows = list(later), [0]
    while True:
        while sparse and number < len(places) and places[number] - windows[-1] < _NEAR:
            number += 1
        if number == len(places):
            return
        with open_stereo(plan.left, plan.right, plan.input_settings) as source:
            source.ahead = 1
            rectify_source(source, plan.rig, plan.rig_settings)
            given = plan.input_settings
            if plan.disparity and given.disparity_scale and given.disparity_view != "auto":
                source.bring_disparity(
                    *(plan.disparity, given.disparity_view, given.disparity_scale),
                    plan.settings.reference,
                )
            if later is None and source.expected_frames:
                places = list(starts(source.expected_frames))
            begin = places[number]
            if sparse and begin > decoded:
                begin = source.key_before(begin)
                if begin <= windows[-1]:
                    number += 1
                    continue
            if begin and not source.begin_at(begin) and begin > decoded:
                return
            # What follows soon is decoded on the way: from the key frame before it takes longer.
            last = min(begin + _NEAR, decoded)
            windows = [begin, *(each for each in places[number + 1 :] if each <= last)]
            for place, frame in zip(range(begin, windows[-1] + window), source, strict=False):
                if any(first <= place < first + window for first in windows):
                    yield frame
            number += len(windows)


def with_range_of_opening(
    plan: RunPlan, source: StereoSource, say: Say
) -> tuple[RunPlan, Iterator[StereoFrame]]:
    """Measure the range of a source that can be read only once, on its first 16 frames.

    Returns:
        The plan, and all frames of the source.
    """
    frames = iter(source)
    if plan.settings.max_disparity != AUTO:
        return plan, frames
    opening = list(itertools.islice(frames, WINDOW_FRAMES))
    return _measured(plan, opening, say), itertools.chain(opening, frames)


def _measured(plan: RunPlan, sample: Iterable[StereoFrame], say: Say) -> RunPlan:
    report = advised_range(sample)
    if report.advised_max_disparity is None:
        usual = Settings().max_disparity
        say(
            "warning",
            f"--max-disparity auto: only {report.matches} features agree between left and right, "
            f"too few to measure: {usual} is taken",
        )
        return _settled(plan, usual)
    say(
        "note",
        f"--max-disparity {report.advised_max_disparity}: disparities of "
        f"{report.disparity_low_px:.1f} to {report.disparity_high_px:.1f} px were measured in "
        f"{report.frames} frame{'s' if report.frames > 1 else ''}",
    )
    return _settled(plan, report.advised_max_disparity)


def _settled(plan: RunPlan, max_disparity: int) -> RunPlan:
    return plan.with_measured("settings", {"max_disparity": max_disparity})


def begun_with(plan: RunPlan) -> RunRecord | None:
    """Return the record of the run to resume, None if there is none."""
    if plan.folder is None or not plan.resume:
        return None
    place = plan.folder / RUN.record
    try:
        found = read_record(place, RUN) or read_record(part_of(place), RUN)
    except InputError:
        return None  # the record is damaged, and the run will say so
    known = isinstance(found, RunRecord) and found.values("settings").get("max_disparity")
    return found if known and isinstance(found, RunRecord) else None
