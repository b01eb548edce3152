"""A run: from two recordings to files."""

from __future__ import annotations

import dataclasses
import itertools
import logging
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from motionstereo_cli.check.measure import watched
from motionstereo_cli.check.shortfall import (
    beyond_range,
    falls_short,
    lost_poses,
    shortfall,
    unmoved,
    without_heading,
)
from motionstereo_cli.errors import (
    NO_FRAMES,
    InputError,
    MotionStereoError,
    OutputError,
    SettingsError,
)
from motionstereo_cli.files.atomic import reported
from motionstereo_cli.files.folders import remove
from motionstereo_cli.files.reading import real
from motionstereo_cli.files.targets import check_target, is_stream, open_stream
from motionstereo_cli.method.settings import FOREVER, GIVEN
from motionstereo_cli.params import near_match
from motionstereo_cli.pipeline import State, steps
from motionstereo_cli.report import PAGE, is_report
from motionstereo_cli.rig.calibration import Calibration, rectify_source
from motionstereo_cli.rig.settings import NO_RIG
from motionstereo_cli.runs.checkpoint import check_state
from motionstereo_cli.runs.colour_range import with_colour_range
from motionstereo_cli.runs.cores import check_memory, usable_cores
from motionstereo_cli.runs.disparity_offset import with_measured_offset
from motionstereo_cli.runs.disparity_range import RANGE, with_range, with_range_of_opening
from motionstereo_cli.runs.folder import RunFolder
from motionstereo_cli.runs.folder_files import TABLE
from motionstereo_cli.runs.given_disparity import take_disparity
from motionstereo_cli.runs.interrupts import finishing
from motionstereo_cli.runs.onnx_model import files_of, load_model
from motionstereo_cli.runs.open_outputs import Sinks, Totals
from motionstereo_cli.runs.plan import AUTO_POSES, RunPlan
from motionstereo_cli.runs.record import (
    Job,
    RunReport,
    Warned,
    identity_of,
    outcome,
    report_of,
    report_on,
    shown_outputs,
)
from motionstereo_cli.runs.threaded_sink import Threaded
from motionstereo_cli.sinks.outputs import OUTPUTS, available, check_video_size
from motionstereo_cli.sinks.scale import DepthScale
from motionstereo_cli.sinks.sink import DEFAULT_TIME_BASE, OPTICAL_FRAME, RunContext, Sink
from motionstereo_cli.sinks.steering_table import SteeringCopy, SteeringStream
from motionstereo_cli.sources import StereoSource, open_stereo
from motionstereo_cli.sources.settings import adapted_rig
from motionstereo_cli.types import Rig, Say, Step, StereoFrame

if TYPE_CHECKING:
    from motionstereo_cli.rig.poses import Trajectory

#: Memory of all frames in flight by default, and of a pixel of each: memories of both views,
#: disparity, depth, and the workspace of a thread.
_IN_FLIGHT_BYTES, _BYTES_PER_PX = 1 << 30, 110

_Step = tuple[StereoFrame, Step, State]

LOG = logging.getLogger("motionstereo")


def _nothing(*_: object) -> None:
    pass


def _log(kind: str, text: str) -> None:
    LOG.warning(text) if kind == "warning" else LOG.info(text)


@dataclasses.dataclass(frozen=True, slots=True)
class Watcher:
    """Callbacks during a run.

    Attributes:
        say: called with a kind, ``note`` or ``warning``, and a line; by default it goes to the
            logger ``motionstereo``, which also has what is for ``--verbose``, as DEBUG.
        begin: called before the first frame with the number of frames, None if unknown.
        progress: called after each frame.
    """

    say: Say = _log
    begin: Callable[[int | None], object] = _nothing
    progress: Callable[[], object] = _nothing


def run(plan: RunPlan, watcher: Watcher | None = None, stdout: BinaryIO | None = None) -> RunReport:
    """Process recordings and write the results.

    ``run.json`` is written last: if it exists, everything beside it is complete. If the run ends
    early, its results so far stay: complete images, tables and videos under ``.part`` names, and
    a checkpoint from which another process continues, with the same bytes in the end. An
    interrupt waits until all outputs have the current frame.

    Args:
        plan: what to do.
        watcher: its callbacks.
        stdout: the stream for a table on standard output; the process's own if None.

    Raises:
        InputError: a recording, rig or pose cannot be used, or there are no frames.
        OutputError: the results cannot be written, or the folder belongs to another run.
        SettingsError: an output needs a rig, or poses.
        BrokenPipeError: the reader of standard output closed it.
    """
    watcher = watcher or Watcher()
    stdout = stdout or _standard_output(plan)
    check_memory()
    warned = Warned(watcher.say)
    plan = _with_offset(plan, warned)
    with open_stereo(plan.left, plan.right, plan.input_settings) as source:
        job = job_of(plan, source, warned, in_order=True)
        latest = _Latest(job.frames)
        job = dataclasses.replace(job, frames=latest)
        check_memory()
        watcher.begin(source.expected_frames)
        sinks = _sinks(job)
        started_s = time.perf_counter()
        resumed = 0
        page = plan.folder / PAGE if plan.folder and plan.resume else None
        had_page = page is not None and "report" not in job.save and is_report(page)
        try:
            with sinks:
                if sinks.finished is not None:
                    return report_of(sinks.finished, plan)
                if page is not None and had_page:
                    with reported(page):
                        remove(page.parent, [page])
                    watcher.say("note", f"{page} of the interrupted run was removed")
                resumed = sinks.totals.frames
                _open(sinks, job, stdout)
                _write(sinks, job, watcher)
                warn_of_what_is_missing(job, sinks.totals, lambda: latest.frame)
                report = report_on(job, sinks.totals, resumed, started_s)
                sinks.complete(options=plan.options, **outcome(source, report))
                return report
        except BrokenPipeError:
            if plan.folder is None:  # the reader closed the pipe
                raise
            raise OutputError(
                "the reader of the steering table closed it before the run was done: what was done "
                f"is in {plan.folder}"
            ) from None
        except KeyboardInterrupt:
            report = report_on(job, sinks.totals, resumed, started_s)
            return dataclasses.replace(report, interrupted=True)
        except Exception as error:
            if plan.folder is not None and sinks.totals.frames > resumed:
                # After other errors the same command fails again at the same frame.
                goes_on = isinstance(error, OutputError | OSError) and source.rereadable
                advice = ": with --resume the same command goes on from the last checkpoint"
                error.add_note(f"what was done is in {plan.folder}{advice if goes_on else ''}")
            raise


def _with_offset(plan: RunPlan, warned: Warned) -> RunPlan:
    if not plan.input_settings.measures_offset:
        return plan
    from motionstereo_cli.check.offset import with_offset

    say = partial(warned.say, "sync-offset")
    prepare = partial(rectify_source, paths=plan.rig, settings=plan.rig_settings)
    measured = with_offset(plan.left, plan.right, plan.input_settings, say, prepare)
    return plan.with_measured("input_settings", dataclasses.asdict(measured))


def try_out(plan: RunPlan, watcher: Watcher | None = None) -> tuple[int | None, tuple[str, ...]]:
    """Check all that can be checked before the first frame, and write nothing.

    Returns:
        The number of frames, None if unknown, and what :func:`run` would write into the folder,
        numbered files as their folder.

    Raises:
        InputError, OutputError, SettingsError: as of :func:`run`.
    """
    warned = Warned((watcher or Watcher()).say)
    plan = _with_offset(plan, warned)
    with open_stereo(plan.left, plan.right, plan.input_settings) as source:
        job = job_of(plan, source, warned)
        sinks = _sinks(job)
        if isinstance(sinks, RunFolder):
            sinks.check()
        if source.expected_frames is not None and source.expected_frames < 1:
            raise InputError(
                f"--start {plan.input_settings.start} lies behind the last frame: give an earlier "
                "one"
            )
        return source.expected_frames, shown_outputs(job.save) if plan.folder else ()


def _standard_output(plan: RunPlan) -> BinaryIO | None:
    if not plan.to_stdout:
        return None
    if sys.stdout is None:
        raise OutputError("cannot write the steering table: standard output is closed")
    return sys.stdout.buffer


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
    LOG.debug("frames matched at a time: %d", job.plan.jobs or default_jobs(source))


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


def _sinks(job: Job) -> Sinks:
    """Return the folder of the results, or its substitute without one; not yet entered."""
    plan, source = job.plan, job.source
    inputs = inputs_of(job)
    if plan.folder is None:
        return Sinks()
    check_target(plan.folder, inputs)
    if plan.table and not plan.to_stdout:
        check_target(plan.table, inputs)
        if real(plan.table).is_relative_to(real(plan.folder)):
            raise OutputError(
                f"{plan.table} is in the output folder: --save steering puts a table there"
            )
    return RunFolder(
        *(plan.folder, job.save),
        identity=identity_of(job, inputs),
        overwrite=plan.overwrite,
        resume=plan.resume,
        inputs=inputs,
        table=table_of(plan),
        check=partial(
            check_state, settings=plan.settings, width=source.width, height=source.height
        ),
    )


def _open(sinks: Sinks, job: Job, stdout: BinaryIO | None) -> None:
    """Open all outputs, at the checkpoint of an earlier process."""
    plan, table_format = job.plan, job.context.output.steering_format
    if stdout is not None:
        stream = SteeringStream(stdout, "the steering table", table_format)
        sinks.add(TABLE, lambda _: stream)
    else:
        add_table(sinks, job)
    if plan.folder is not None:
        for name in job.save:
            if (takes := OUTPUTS[name].takes) is not None:
                sinks.add(name, partial(opened, name, plan.folder, job.context), takes)


def table_of(plan: RunPlan) -> Path | None:
    """Return the file of a further steering table; None if there is none, or it is a stream."""
    path = None if plan.to_stdout else plan.table
    return None if path is None or is_stream(path) else path


def add_table(sinks: Sinks, job: Job) -> None:
    """Open the steering table that the user named, if any."""
    if job.plan.table is not None:
        sinks.add(TABLE, partial(_table, job.plan, job.context.output.steering_format))


def _table(plan: RunPlan, table_format: str, since: Any) -> Sink[Step]:
    assert plan.table is not None
    assert plan.folder is not None
    if (path := table_of(plan)) is None:
        with reported(plan.table):
            return SteeringStream(open_stream(plan.table), plan.table, table_format)
    return Threaded(SteeringCopy(plan.folder / TABLE, path, table_format, since))


def opened(name: str, folder: Path, context: RunContext, since: object) -> Threaded:
    """Return an output that writes in its own thread, continuing from a checkpoint."""
    return Threaded(OUTPUTS[name].open(folder, context, since))


def default_jobs(source: StereoSource) -> int:
    """Return how many frames are matched at the same time, limited by memory."""
    frame_bytes = _BYTES_PER_PX * source.width * source.height
    return max(1, min(usable_cores(), _IN_FLIGHT_BYTES // frame_bytes))


class _Latest:
    """Frames, of which the latest is kept.

    Attributes:
        frame: the latest; None before the first.
    """

    def __init__(self, frames: Iterable[StereoFrame]) -> None:
        self._frames = frames
        self.frame: StereoFrame | None = None

    def __iter__(self) -> Iterator[StereoFrame]:
        for frame in self._frames:
            self.frame = frame
            yield frame


def _write(sinks: Sinks, job: Job, watcher: Watcher) -> None:
    """Process the remaining frames, and complete the outputs."""
    for _, step, state in _steps(job, sinks, watcher):
        with finishing():
            sinks.write(step, state)
            due = sinks.totals.frames % job.context.output.checkpoint_frames == 0
            if due and job.source.rereadable:
                sinks.checkpoint()
                LOG.debug("checkpoint after %d frames", sinks.totals.frames)
        del _, step, state  # which take much memory
        watcher.progress()
    if not sinks.totals.frames:
        raise InputError(NO_FRAMES)
    sinks.close()


def warn_of_what_is_missing(
    job: Job, totals: Totals, last: Callable[[], StereoFrame | None]
) -> None:
    """Warn if little moved, little was matched, most frames have no heading, or poses are lost.

    Why little was matched is found in the last frame.

    Args:
        job: the run.
        totals: sums over all its frames.
        last: returns the last frame; called if little was matched.
    """
    s, said = job.plan.settings, {each.code: each.numbers for each in job.warned.found}
    charged, matched, at_limit = totals.means
    blind = totals.blind / max(totals.frames, 1)
    numbers = {"charged": charged, "matched": matched, "at_limit": at_limit, "blind": blind}
    numbers = {name: round(share, 4) for name, share in numbers.items()}
    short = falls_short(charged, matched)
    # Old charge and uncertain disparities may be left out on purpose.
    everything = s.max_age >= FOREVER and not s.min_confidence
    told = totals.frames == 1 or "still" in said  # nothing moves there
    steers = "steering" in job.save or job.plan.to_stdout or job.plan.table
    if short and everything and s.matcher == GIVEN:
        what = f"only {matched / charged:.0%} of what moved lately has a disparity: what"
        why = "says elsewhere, if anything, does not agree with the images; see --max-residual"
        job.warned.warn("unmatched", f"{what} {job.plan.disparity} {why}", numbers)
    elif short and everything:
        if (frame := last()) is not None:
            advised = int(said.get("beyond-range", {}).get("advised_max_disparity", 0))
            views = frame.right, frame.left
            reason = shortfall(charged, matched, *views, s.max_disparity, advised)
            job.warned.warn("unmatched", reason, numbers)
    elif not told and s.depth_of == "moved" and (text := unmoved(charged)):
        job.warned.warn("unmoved", text, numbers)
    elif not told and steers and (text := without_heading(blind, matched)):
        job.warned.warn("no-heading", text, numbers)
    if everything and not short and (text := beyond_range(matched, at_limit, s.max_disparity)):
        job.warned.warn("at-limit", text, numbers)
    if text := lost_poses(totals.frames, totals.lost, totals.first_lost):
        names = "frames", "lost", "first_lost", "last_of_first"
        found = totals.frames, totals.lost, *(totals.first_lost or ())
        job.warned.warn("lost-poses", text, dict(zip(names, found, strict=True)))


def _steps(job: Job, sinks: Sinks, watcher: Watcher) -> Iterator[_Step]:
    """Yield images, step and state of the frames that an earlier process did not do."""
    plan, frames = job.plan, job.frames
    job.warned.begin()
    if plan.with_check:
        frames = watched(
            frames,
            plan.settings.max_disparity,
            job.warn_of,
            rig=job.context.rig,
            given_offset_px=plan.input_settings.disparity_offset_px or 0.0,
        )
    frames = iter(frames)
    for _ in itertools.islice(frames, sinks.totals.frames):
        watcher.progress()
    results = steps(
        frames,
        job.stream,
        job.pose_of,
        jobs=plan.jobs or (default_jobs(job.source) if job.source.rereadable else 1),
        state=sinks.state,
    )
    if sinks.state is not None:
        yield from _first(results, plan)
    yield from results


def _first(results: Iterator[_Step], plan: RunPlan) -> Iterable[_Step]:
    """Return the first result after a checkpoint; it shows whether the checkpoint fits."""
    try:
        return list(itertools.islice(results, 1))
    except (MotionStereoError, OSError, MemoryError):
        raise
    except Exception as error:
        raise OutputError(
            f"{plan.folder} cannot be resumed, its checkpoint does not fit ({error}): "
            "give --overwrite to start again"
        ) from error
