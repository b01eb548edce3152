"""Open the inputs of a run, and find all that is known before its first frame."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.params import near_match
from motionstereo_cli.rig.calibration import Calibration, rectify_source
from motionstereo_cli.rig.settings import NO_RIG
from motionstereo_cli.runs.colour_range import with_colour_range
from motionstereo_cli.runs.disparity_offset import with_measured_offset
from motionstereo_cli.runs.disparity_range import RANGE, with_range, with_range_of_opening
from motionstereo_cli.runs.given_disparity import take_disparity
from motionstereo_cli.runs.job import Job, Warned
from motionstereo_cli.runs.onnx_model import files_of, load_model
from motionstereo_cli.runs.plan import AUTO_POSES, RunPlan
from motionstereo_cli.sinks.outputs import OUTPUTS, available, check_video_size
from motionstereo_cli.sinks.scale import DepthScale
from motionstereo_cli.sinks.sink import DEFAULT_TIME_BASE, OPTICAL_FRAME, RunContext
from motionstereo_cli.sources import StereoSource, open_stereo
from motionstereo_cli.sources.settings import adapted_rig
from motionstereo_cli.types import Rig, Say, StereoFrame

if TYPE_CHECKING:
    from motionstereo_cli.rig.poses import Trajectory

LOG = logging.getLogger("motionstereo")


def job_of(plan: RunPlan, source: StereoSource, warned: Warned, *, in_order: bool = False) -> Job:
    """Open a run's inputs, and read all that is known before the first frame.

    Args:
        plan: the run.
        source: its recordings, open.
        warned: shows and keeps warnings.
        in_order: all frames will be read from the job, in order; so it may read the first ones.
    """
    note = partial(warned.say, "", "note")
    for line in source.warnings:
        warned.warn("recording", line)
    calibration = rectify_source(source, plan.rig, plan.rig_settings)
    if calibration is not None:
        for line in calibration.notes:
            note(line)
        for line in calibration.warnings:
            warned.warn("calibration", line)
        plan = dataclasses.replace(plan, rig=calibration.found or plan.rig)
    rig, poses = None, None
    if calibration is None:
        _do_without_rig(plan, note)
        for line in source.calibration_notes:
            note(line)
    else:
        check_size(calibration.rig, source)
        rig = adapted_rig(calibration.rig, source.settings)
        if plan.poses_file:
            poses = _poses(plan.poses_file, plan, calibration, source, warned)
    take_disparity(plan, source, warned)
    load_model(plan.settings)
    shows_colours = any(OUTPUTS[name].shows_colours for name in plan.outputs)
    source.keep_colours(plan.settings.reference if shows_colours else "")
    time_base = source.time_base or DEFAULT_TIME_BASE
    frames: Iterable[StereoFrame] = source
    say = partial(warned.say, RANGE)
    if source.rereadable:
        plan = with_range(plan, say)
    else:
        plan, frames = with_range_of_opening(plan, source, say)
    frame_id = source.frame_id(plan.settings.reference) or OPTICAL_FRAME
    context = RunContext(
        *(time_base, plan.settings, rig, plan.output_settings, frame_id),
        with_map="map" in plan.outputs,
    )
    job = Job(plan, source, frames, context, poses, warned)
    job = with_measured_offset(job, partial(warned.say, "disparity-offset"))
    job = with_colour_range(job, in_order=in_order)
    _log_job(job)
    if plan.folder is not None:
        check_video_size(job.save, source.width, source.height)
    _tell_of_options(job, note)
    return job


def _poses(
    path: Path, plan: RunPlan, calibration: Calibration, source: StereoSource, warned: Warned
) -> Trajectory:
    """Return the poses of a file that covers a source."""
    from motionstereo_cli.rig.poses import read_poses

    if not path.exists() and (meant := near_match(str(path).lower(), [AUTO_POSES])):
        raise SettingsError(f"--poses {path}: there is no such file{meant}")
    poses = read_poses(path, plan.pose_settings, calibration.rig, calibration.body_from_left)
    first, last = source.numbers if poses.by_number else source.span_s
    whole = source.last_number if poses.by_number else source.last_s
    for line in poses.check_covers(first, last, whole, source.begin_s):
        warned.warn("poses", line)
    return poses


def _do_without_rig(plan: RunPlan, note: Callable[[str], object]) -> None:
    """Check that a run without a calibration needs none."""
    output = plan.output_settings
    for flags, given in (
        ("--poses", plan.poses),
        ("--disparity-offset", plan.input_settings.disparity_offset_px != 0),
        ("--near-m and --far-m", output.near_m or output.far_m),
    ):
        if given:
            raise SettingsError(f"{flags} need --rig: without it nothing is in metres")
    if available(plan.outputs, rig=False) != plan.outputs:
        note("depth in m needs --rig: disparity takes the place of depth")


def check_size(rig: Rig, source: StereoSource) -> None:
    """Check that a rig is for the full views of a source.

    Raises:
        InputError: it is for another size.
    """
    if (rig.width, rig.height) != (source.view_width, source.view_height):
        width, height = source.view_width, source.view_height
        advice = "give the rig of these recordings"
        if (focal_px := source.projected_focal_px) is not None:
            advice = (
                f"give a rig.yaml of the projected images: width {width}, height {height}, "
                f"focal_px {focal_px:g}, cx {(width - 1) / 2:g}, cy {(height - 1) / 2:g}, and the "
                "baseline_m of the camera"
            )
        raise InputError(
            f"the rig is for {rig.width}x{rig.height} but the recordings are {width}x{height}: "
            f"{advice}"
        )


def _tell_of_options(job: Job, note: Callable[[str], object]) -> None:
    """Say what is done, or missing, for own motion and speeds, and what has no effect.

    Raises:
        SettingsError: a goal needs poses.
    """
    plan = job.plan
    if job.with_own_motion and (plan.poses is None or job.poses):
        rows = ((name, OUTPUTS[name]) for name in job.save)
        asking = (n for n, row in rows if row.needs_movers or (row.needs_poses and not job.poses))
        how = "to tell what moves by itself" if job.poses else "as by --poses auto"
        note(f"{', '.join(asking)}: the rig's own motion is found, {how}")
    if "objects" in job.save and job.source.begin_s is None:
        note("objects: the recordings have no times, and speeds are empty: give --frame-rate")
    for line in plan.idle(rig=job.context.rig is not None):
        note(line)
    if plan.settings.goal and plan.poses is None:
        raise SettingsError("--goal needs --poses: without it nothing is known of the world")


def _log_job(job: Job) -> None:
    """Log what a run is made of, before its first frame."""
    if not LOG.isEnabledFor(logging.DEBUG):
        return
    source = job.source
    for name, said in source.describe(fingerprint=False).items():
        LOG.debug("%s: %s", name, ", ".join(f"{key} {value}" for key, value in said.items()))
    LOG.debug("delivered: %dx%d px, frames %s", source.width, source.height, source.expected_frames)
    LOG.debug("rig: %s", job.context.rig)
    LOG.debug("settings: %s", job.plan.settings)
    scale = DepthScale.of(job.plan.settings, job.context.output, job.context.rig)
    LOG.debug("colours: %g to %g %s", *scale.ends, scale.unit)
    LOG.debug("outputs: %s", ", ".join(job.save))
    LOG.debug("frames matched at a time: %d", job.frames_at_once)


def settled(plan: RunPlan, say: Say) -> RunPlan:
    """Return a plan in which what is measured before the first frame is a number.

    Args:
        plan: the run; of recordings that can be read twice.
        say: called with a kind, ``note`` or ``warning``, and a line.

    Raises:
        InputError: the recordings, or what is known of them, cannot be used.
        SettingsError: an output needs a rig, or poses.
    """
    with open_stereo(plan.left, plan.right, plan.input_settings) as source:
        job = job_of(plan, source, Warned(say))
    found = ("settings", "output_settings", "measured")
    return dataclasses.replace(plan, **{name: getattr(job.plan, name) for name in found})


def inputs_of(job: Job) -> list[Path]:
    """Return the files and folders that a run reads."""
    plan = job.plan
    return [
        *job.source.paths,
        *(path for path in plan.rig if path != NO_RIG),
        *(path for path in (plan.poses_file, plan.disparity) if path),
        *files_of(plan.settings),
        *plan.reads,
    ]


def with_sync_offset(plan: RunPlan, warned: Warned) -> RunPlan:
    """Return a plan with the offset between its recordings measured, if that is asked for.

    Raises:
        InputError: the recordings do not tell it.
        SettingsError: they can be read only once.
    """
    if not plan.input_settings.measures_offset:
        return plan
    from motionstereo_cli.check.offset import with_offset

    say = partial(warned.say, "sync-offset")
    prepare = partial(rectify_source, paths=plan.rig, settings=plan.rig_settings)
    measured = with_offset(plan.left, plan.right, plan.input_settings, say, prepare)
    return plan.with_measured("input_settings", dataclasses.asdict(measured))
