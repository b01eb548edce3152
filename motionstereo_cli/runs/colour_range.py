"""The ends of the scale of depth colours, measured before the first frame."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np

from motionstereo_cli.check.measure import WINDOW_FRAMES, starts
from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.method.matching import match
from motionstereo_cli.method.memory import checked_views, see
from motionstereo_cli.runs.disparity_range import begun_with, sample_of
from motionstereo_cli.runs.job import Job
from motionstereo_cli.sinks.outputs import OUTPUTS
from motionstereo_cli.sinks.scale import ENDS, measured_ends

if TYPE_CHECKING:
    from motionstereo_cli.types import Real, StereoFrame

#: Interval of frames of a window whose depth is used, and of its pixels and rows.
_STEP_FRAMES, _STEP_PX = 4, 2

#: A recording whose windows lie near one another is decoded up to here.
_DECODED_FRAMES = 50


def with_colour_range(job: Job, *, in_order: bool = False) -> Job:
    """Return the job with measured ends of the depth colours where an output shows them.

    They are the same for all frames, and numbers of ``output_settings``. The sample is that of
    ``--max-disparity auto``. A resumed run keeps its numbers.

    Args:
        job: the job, with a range of disparities that is a number.
        in_order: its frames will be read in order: the first ones need not be read twice.

    Raises:
        InputError: the recordings cannot be read.
        SettingsError: the ends are given in px, and there is a rig.
    """
    output, rig = job.context.output, job.context.rig
    in_px = {"--near-px": output.near_px, "--far-px": output.far_px}
    if rig is not None and any(in_px.values()):
        given = " and ".join(flag for flag, value in in_px.items() if value)
        raise SettingsError(f"with a rig depth is in m: give --near-m and --far-m, not {given}")
    near, far = (output.near_px, output.far_px) if rig is None else (output.near_m, output.far_m)
    if (near and far) or not any(OUTPUTS[name].shows_scale for name in job.save):
        return job
    if begun := begun_with(job.plan):
        said = begun.values("output_settings")
        return _settled(job, {name: said[name] for name in ENDS if name in said})
    frames = job.frames
    first: Iterable[StereoFrame] = ()
    sample: Iterable[StereoFrame]
    if job.source.rereadable:
        plan = dataclasses.replace(job.plan, input_settings=job.source.settings)
        places = starts(job.source.expected_frames or 1)
        alone = in_order and (len(places) == 1 or places[1] > _DECODED_FRAMES)
        how = (_STEP_FRAMES, _DECODED_FRAMES, places[1:] if alone else None)
        sample = sample_of(plan, *how, sparse=True)
    else:
        alone, rest = False, iter(frames)
        sample = list(itertools.islice(rest, WINDOW_FRAMES))
        frames = itertools.chain(sample, rest)
    # The threads' workspaces are freed with them.
    with ThreadPoolExecutor(2, "sample") as threads:
        later = threads.submit(_nearness_px, sample, job)
        if alone:
            first, frames = _opening(frames)
        parts = [threads.submit(_nearness_px, first, job), later]
        nearness_px = np.concatenate([part.result() for part in parts])
    found = measured_ends(nearness_px, None if rig is None else rig.focal_baseline)
    job = dataclasses.replace(job, frames=frames)
    if found is None:
        return job
    # A given end is kept, and the other one stays at least a factor of 2 away.
    if rig is None:
        nearest, farthest = max(found[0], 2 * far), min(found[1], near / 2 or found[1])
        return _settled(job, {"near_px": near or nearest, "far_px": far or farthest})
    nearest, farthest = min(found[0], far / 2 or found[0]), max(found[1], 2 * near)
    return _settled(job, {"near_m": near or nearest, "far_m": far or farthest})


def _opening(frames: Iterable[StereoFrame]) -> tuple[list[StereoFrame], Iterable[StereoFrame]]:
    """Return the first frames of a sample, and all frames; what fails, fails in these."""
    rest, failed = iter(frames), list[InputError]()
    first: list[StereoFrame] = []
    try:
        first.extend(itertools.islice(rest, _STEP_FRAMES))
    except InputError as error:
        failed.append(error)

    def again() -> Iterator[StereoFrame]:
        while first:
            yield first.pop(0)
        for error in failed:
            raise error
        yield from rest

    return list(first), again()


def _settled(job: Job, ends: dict[str, Any]) -> Job:
    plan = job.plan.with_measured("output_settings", ends)
    context = dataclasses.replace(job.context, output=plan.output_settings)
    return dataclasses.replace(job, plan=plan, context=context)


def _nearness_px(sample: Iterable[StereoFrame], job: Job) -> Real:
    """Return the known disparities of some frames, doffs added, (n,) float32."""
    return np.concatenate([np.empty(0, np.float32), *_each_nearness_px(sample, job)])


def _each_nearness_px(sample: Iterable[StereoFrame], job: Job) -> Iterator[Real]:
    """Yield the same, frame by frame."""
    settings, rig = job.plan.settings, job.context.rig
    right = left = None
    begun = last = -1
    for frame, following in itertools.pairwise(itertools.chain(_readable(sample), (None,))):
        assert frame is not None
        if frame.index != last + 1:  # another window
            right = left = None
            begun = frame.index
        last = frame.index
        right_view, left_view = checked_views(frame, right, None)
        right, left = see(right, right_view, settings), see(left, left_view, settings)
        ends = following is None or following.index != last + 1
        if ends or (last - begun) % _STEP_FRAMES == _STEP_FRAMES - 1:
            disparity_px = match(
                right, left, settings, frame.disparity_px, with_confidence=False
            ).disparity_px
            disparity_px = disparity_px[::_STEP_PX, ::_STEP_PX]
            nearness_px = disparity_px if rig is None else rig.nearness_px(disparity_px)
            yield nearness_px[nearness_px >= 0]


def _readable(sample: Iterable[StereoFrame]) -> Iterator[StereoFrame]:
    """Yield the frames up to one that cannot be read: the run itself says what is wrong there."""
    with contextlib.suppress(InputError):
        yield from sample
