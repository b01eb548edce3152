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
from typing import Any, BinaryIO

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
)
from motionstereo_cli.files.atomic import reported
from motionstereo_cli.files.folders import remove
from motionstereo_cli.files.reading import real
from motionstereo_cli.files.targets import check_target, is_stream, open_stream
from motionstereo_cli.method.settings import FOREVER, GIVEN
from motionstereo_cli.pipeline import State, steps
from motionstereo_cli.report import PAGE, is_report
from motionstereo_cli.runs.checkpoint import check_state
from motionstereo_cli.runs.cores import check_memory
from motionstereo_cli.runs.folder import RunFolder
from motionstereo_cli.runs.folder_files import TABLE
from motionstereo_cli.runs.interrupts import finishing
from motionstereo_cli.runs.job import Job, Warned
from motionstereo_cli.runs.open_outputs import Sinks, Totals
from motionstereo_cli.runs.opening import inputs_of, job_of, with_sync_offset
from motionstereo_cli.runs.plan import RunPlan
from motionstereo_cli.runs.record import (
    RunReport,
    identity_of,
    outcome,
    report_of,
    report_on,
    shown_outputs,
)
from motionstereo_cli.runs.threaded_sink import Threaded
from motionstereo_cli.sinks.outputs import OUTPUTS
from motionstereo_cli.sinks.sink import RunContext, Sink
from motionstereo_cli.sinks.steering_table import SteeringCopy, SteeringStream
from motionstereo_cli.sources import open_stereo
from motionstereo_cli.types import Say, Step, StereoFrame

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
    plan = with_sync_offset(plan, warned)
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


def try_out(plan: RunPlan, watcher: Watcher | None = None) -> tuple[int | None, tuple[str, ...]]:
    """Check all that can be checked before the first frame, and write nothing.

    Returns:
        The number of frames, None if unknown, and what :func:`run` would write into the folder,
        numbered files as their folder.

    Raises:
        InputError, OutputError, SettingsError: as of :func:`run`.
    """
    warned = Warned((watcher or Watcher()).say)
    plan = with_sync_offset(plan, warned)
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
        jobs=job.frames_at_once,
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
