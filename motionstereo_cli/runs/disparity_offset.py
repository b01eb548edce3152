"""``--disparity-offset auto``: the constant error of disparity, measured before the first frame."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable

from motionstereo_cli.check.findings import MAX_OFFSET_PX, offset_warning
from motionstereo_cli.check.measure import WINDOW_FRAMES
from motionstereo_cli.runs.disparity_range import sample_of
from motionstereo_cli.runs.job import Job
from motionstereo_cli.types import Say, StereoFrame


def with_measured_offset(job: Job, say: Say) -> Job:
    """Return the job, with a measured disparity offset if the settings ask for one.

    Own motion always uses a measured offset that matters, even if depth is not corrected by it. The
    sample is that of ``--max-disparity auto``, or its beginning if that tells that none does.

    Args:
        job: the job, with a range of disparities that is a number.
        say: called with a kind, ``note`` or ``warning``, and a line.

    Raises:
        InputError: the recordings cannot be read.
    """
    rig, asked = job.context.rig, job.plan.input_settings.disparity_offset_px is None
    if rig is None or not (asked or job.with_own_motion):
        return job
    from motionstereo_cli.robot.odometer import Odometer, disparity_offset_px

    sample: Iterable[StereoFrame] = ()
    frames = job.frames
    if job.source.rereadable:
        sample = sample_of(job.plan)
    else:
        rest = iter(frames)
        sample = list(itertools.islice(rest, WINDOW_FRAMES))
        frames = itertools.chain(sample, rest)
    odometer = Odometer(rig, job.plan.settings.max_disparity)
    # A small offset matters only where depth is to be corrected by it.
    negligible_px = 0.0 if asked else MAX_OFFSET_PX
    offset_px = round(disparity_offset_px(sample, odometer, negligible_px), 3) + 0.0  # no -0
    if asked:
        say("note", f"--disparity-offset {offset_px:g}: measured from how things move")
        context = dataclasses.replace(job.context, rig=rig.with_disparity_offset(offset_px))
        return dataclasses.replace(job, frames=frames, context=context)
    if abs(offset_px) < MAX_OFFSET_PX:
        return dataclasses.replace(job, frames=frames)
    say("warning", offset_warning(offset_px))
    return dataclasses.replace(job, frames=frames, motion_offset_px=offset_px)
