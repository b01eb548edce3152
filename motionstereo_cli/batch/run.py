"""A run: from two recordings to files."""

from __future__ import annotations

import dataclasses
import itertools
import os
import platform
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import av
import cv2
import numpy as np

from motionstereo_cli import __version__
from motionstereo_cli.analysis.check import watched
from motionstereo_cli.batch.folder import CHECKPOINT, RunFolder, head
from motionstereo_cli.batch.interrupts import finishing
from motionstereo_cli.batch.plan import RunPlan
from motionstereo_cli.batch.sinks import Sinks
from motionstereo_cli.batch.totals import Totals
from motionstereo_cli.errors import InputError, OutputError
from motionstereo_cli.files.reading import sha256_of
from motionstereo_cli.pipeline import process
from motionstereo_cli.rig import rig_values
from motionstereo_cli.rig.calibration import rectify_source
from motionstereo_cli.rig.poses import Trajectory, read_poses
from motionstereo_cli.sinks import OUTPUTS, RunContext, available
from motionstereo_cli.sinks.steering import SteeringFile, SteeringStream
from motionstereo_cli.sinks.threaded import Threaded
from motionstereo_cli.sources import StereoSource, open_stereo
from motionstereo_cli.sources.settings import adapted_rig
from motionstereo_cli.types import FrameResult, Rig, StereoFrame

#: Time from frame to frame in the videos written, in s, where the source has no time.
DEFAULT_TIME_BASE = Fraction(1, 25)

GREY = (
    "luma of the decoded video, expanded to 0..255 where the stream is limited range; "
    "BT.601 luma of still images"
)

#: The steering table that lies elsewhere, among the names of outputs.
_TABLE = "table"


@dataclasses.dataclass(frozen=True, slots=True)
class RunReport:
    """What a run did.

    Attributes:
        frames: stereo frames processed.
        resumed: how many of them an earlier process had done.
        charged, matched: mean shares of the image, 0..1, with charge and with a disparity.
        wall_s: duration in s, from the first frame's decoding to the last output's completion.
        outputs: paths under the output folder, numbered files as their folder.
        damage: what was lost of the input, one line each.
        interrupted: the run was ended before the end of the input; see :func:`run`.
    """

    frames: int
    resumed: int
    charged: float
    matched: float
    wall_s: float
    outputs: tuple[str, ...]
    damage: tuple[str, ...]
    interrupted: bool

    @property
    def frames_per_second(self) -> float:
        """Speed of this process, 0 if there was nothing left to do."""
        return (self.frames - self.resumed) / self.wall_s if self.wall_s else 0.0


def _nothing(*_: object) -> None:
    pass


@dataclasses.dataclass(frozen=True, slots=True)
class Watcher:
    """Who hears how a run goes; by default nobody.

    Attributes:
        say: called with a kind, ``note`` or ``warning``, and a line.
        begin: called before the first frame with the number of frames, None if unknown.
        progress: called after each frame.
    """

    say: Callable[[str, str], object] = _nothing
    begin: Callable[[int | None], object] = _nothing
    progress: Callable[[], object] = _nothing


def run(plan: RunPlan, watcher: Watcher | None = None, stdout: BinaryIO | None = None) -> RunReport:
    """Process recordings and write the results.

    ``run.json`` is written last: where it stands, everything beside it is complete. However the
    run ends before, what was done stays: images whole, tables and videos under ``.part`` names,
    and what another process needs to go on from the last checkpoint. Its results are then the
    same to the byte. An interrupt waits until all outputs have the frame at hand.

    Args:
        plan: what to do.
        watcher: who hears how it goes.
        stdout: where a table goes that is for standard output; the process's own if None.

    Raises:
        InputError: a recording, rig or pose cannot be used, or there are no frames.
        OutputError: the results cannot be written, or what is there is of another run.
        SettingsError: an output needs a rig, or poses.
        BrokenPipeError: the reader of standard output has gone.
    """
    watcher = watcher or Watcher()
    stdout = stdout or _standard_output(plan)
    with open_stereo(plan.left, plan.right, plan.input_settings) as source:
        job = _job(plan, source, watcher)
        watcher.begin(source.expected_frames)
        sinks = _sinks(job)
        started_s = time.perf_counter()
        resumed = 0
        try:
            with sinks:
                if sinks.finished is not None:
                    return _report_of(sinks.finished)
                resumed = sinks.totals.frames
                _open(sinks, job, stdout)
                _write(sinks, job, watcher)
                report = _report(job, sinks.totals, resumed, started_s)
                sinks.complete({"options": plan.options} | _outcome(source, report))
                return report
        except KeyboardInterrupt:
            report = _report(job, sinks.totals, resumed, started_s)
            return dataclasses.replace(report, interrupted=True)
        except Exception as error:
            if plan.folder is not None and sinks.totals.frames:
                error.add_note(
                    f"what was done is in {plan.folder}: with --resume the same command goes on "
                    "from the last checkpoint"
                )
            raise


@dataclasses.dataclass(frozen=True, slots=True)
class _Job:
    """A plan whose input is open."""

    plan: RunPlan
    source: StereoSource
    context: RunContext
    poses: Trajectory | None

    @property
    def save(self) -> tuple[str, ...]:
        """The outputs, with a substitute for those that cannot be had."""
        return available(
            self.plan.outputs,
            rig=self.context.rig is not None,
            poses=self.poses is not None,
            steering_format=self.context.output.steering_format,
        )


def _standard_output(plan: RunPlan) -> BinaryIO | None:
    if not plan.to_stdout:
        return None
    if sys.stdout is None:
        raise OutputError("cannot write the steering table: standard output is closed")
    return sys.stdout.buffer


def _job(plan: RunPlan, source: StereoSource, watcher: Watcher) -> _Job:
    """Have the source rectify, and read what is known before the first frame."""
    for line in source.warnings:
        watcher.say("warning", line)
    if not plan.rig and available(plan.outputs, rig=False) != plan.outputs:
        watcher.say("note", "depth in m needs --rig: disparity takes the place of depth")
    calibration = rectify_source(source, plan.rig, plan.baseline_unit)
    for line in calibration.warnings if calibration else ():
        watcher.say("warning", line)
    rig, poses = None, None
    if calibration is not None:
        check_size(calibration.rig, source)
        rig = adapted_rig(calibration.rig, source.settings)
        if plan.poses:
            poses = read_poses(
                *(plan.poses, plan.pose_settings, calibration.rig, calibration.body_from_left)
            )
            poses.check_covers(*(source.numbers if poses.by_number else source.span_s))
    time_base = source.time_base or DEFAULT_TIME_BASE
    return _Job(
        plan, source, RunContext(time_base, plan.settings, rig, plan.output_settings), poses
    )


def check_size(rig: Rig, source: StereoSource) -> None:
    """Make sure that a rig is for the whole views of a source.

    Raises:
        InputError: it is for another size.
    """
    if (rig.width, rig.height) != (source.view_width, source.view_height):
        raise InputError(
            f"the rig is for {rig.width}x{rig.height} but the recordings are "
            f"{source.view_width}x{source.view_height}: give the rig of these recordings"
        )


def _sinks(job: _Job) -> Sinks:
    """Return the folder for the results, or what is there without one; not yet entered."""
    plan, source = job.plan, job.source
    inputs = [*source.paths, *plan.rig, *([plan.poses] if plan.poses else []), *plan.reads]
    if plan.table and not plan.to_stdout:
        _check_free(plan.table, plan, inputs)
    if plan.folder is None:
        return Sinks()
    return RunFolder(
        *(plan.folder, job.save),
        identity=_identity(job, inputs),
        overwrite=plan.overwrite,
        resume=plan.resume,
        inputs=inputs,
    )


def _check_free(table: Path, plan: RunPlan, inputs: Sequence[Path]) -> None:
    """Make sure that a table is written over nothing that matters."""
    place = table.resolve()
    if place in {path.resolve() for path in inputs}:
        raise OutputError(f"{table} is an input of this run: give the table another name")
    if plan.folder is not None and place.is_relative_to(plan.folder.resolve()):
        raise OutputError(f"{table} is in the output folder: --save steering puts a table there")
    ours = plan.resume and plan.folder is not None and (plan.folder / CHECKPOINT).exists()
    if table.exists() and not plan.overwrite and not ours:
        raise OutputError(f"{table} is there already: give another name, or --overwrite")


def _open(sinks: Sinks, job: _Job, stdout: BinaryIO | None) -> None:
    """Open all outputs, from where an earlier process was ended."""
    plan, table_format = job.plan, job.context.output.steering_format
    if stdout is not None:
        stream = SteeringStream(stdout, "the steering table", table_format)
        sinks.add(_TABLE, lambda _: stream)
    elif plan.table is not None:
        path = plan.table
        sinks.add(_TABLE, lambda since: Threaded(SteeringFile(path, table_format, since)))
    if plan.folder is not None:
        for name in job.save:
            sinks.add(name, partial(_opened, name, plan.folder, job.context))


def _opened(name: str, folder: Path, context: RunContext, since: object) -> Threaded:
    return Threaded(OUTPUTS[name].open(folder, context, since))


def _write(sinks: Sinks, job: _Job, watcher: Watcher) -> None:
    """Process the frames that are left, and complete the outputs."""
    for result in _results(job, sinks, watcher):
        with finishing():
            sinks.write(result)
            due = sinks.totals.frames % job.context.output.checkpoint_frames == 0
            if due and job.source.rereadable:
                sinks.checkpoint()
        watcher.progress()
    if not sinks.totals.frames:
        raise InputError("the recordings have no frame in common: check that they are whole")
    sinks.close()


def _results(job: _Job, sinks: Sinks, watcher: Watcher) -> Iterator[FrameResult]:
    """Yield the results that an earlier process did not give."""
    plan, context = job.plan, job.context
    frames: Iterable[StereoFrame] = job.source
    if plan.with_check:
        doffs = context.rig.doffs if context.rig is not None else 0.0
        frames = watched(
            job.source,
            plan.settings.max_disparity,
            lambda finding: watcher.say("warning", finding.text),
            doffs=doffs,
        )
    frames = iter(frames)
    for _ in itertools.islice(frames, sinks.totals.frames):
        watcher.progress()
    return process(
        frames,
        plan.settings,
        context.rig,
        None if job.poses is None else job.poses.of,
        # They take time: only where they are asked for.
        with_objects="objects" in job.save or job.poses is not None,
        jobs=plan.jobs or (1 if plan.from_stdin else os.cpu_count()) or 1,
        state=sinks.state,
    )


def _identity(job: _Job, inputs: Iterable[Path]) -> dict[str, Any]:
    """Return what ``run.json`` says of what the run is: its results follow from it."""
    plan, source, context = job.plan, job.source, job.context
    files = [path for path in inputs if path not in (*source.paths, *plan.reads)]
    table = None
    if plan.table and plan.folder and not plan.to_stdout:
        # The same, however either is given.
        table = os.path.relpath(plan.table.resolve(), plan.folder.resolve())
    return {
        **head(job.save),
        **({} if table is None else {"table": table}),
        "versions": versions(),
        "settings": dataclasses.asdict(plan.settings),
        "input_settings": dataclasses.asdict(source.settings),
        "output_settings": dataclasses.asdict(context.output),
        "inputs": source.describe(),
        "files": [{"path": str(path), "sha256": sha256_of(path)} for path in files],
        "rig": None if context.rig is None else rig_values(context.rig),
        "time_base": None if source.time_base is None else str(source.time_base),
        "grey": GREY,
        **({"pose_settings": dataclasses.asdict(job.poses.settings)} if job.poses else {}),
    }


def versions() -> dict[str, str]:
    """Return the versions of all that results and speed depend on."""
    return {
        "motionstereo": __version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "cv2": cv2.__version__,
        "av": av.__version__,
    }


def _report(job: _Job, totals: Totals, resumed: int, started_s: float) -> RunReport:
    return RunReport(
        frames=totals.frames,
        resumed=resumed,
        charged=totals.charged / max(totals.frames, 1),
        matched=totals.matched / max(totals.frames, 1),
        wall_s=time.perf_counter() - started_s,
        outputs=_shown(job.save),
        damage=tuple(job.source.damage),
        interrupted=False,
    )


def _outcome(source: StereoSource, report: RunReport) -> dict[str, Any]:
    """Return what ``run.json`` says of what came of it; all but ``timing`` is repeatable."""
    return {
        # What came through a pipe is known at its end.
        **({} if source.rereadable else {"inputs": source.describe()}),
        "counts": {"written": report.frames, **source.counts},
        "shares": {"charged": report.charged, "matched": report.matched},
        "warnings": source.warnings,
        "damage": list(report.damage),
        "timing": {
            "wall_s": round(report.wall_s, 3),
            "frames_per_second": round(report.frames_per_second, 2),
        },
    }


def _report_of(record: Mapping[str, Any]) -> RunReport:
    """Return the report of a run that was complete already."""
    frames = record["counts"]["written"]
    return RunReport(
        frames=frames,
        resumed=frames,
        charged=record["shares"]["charged"],
        matched=record["shares"]["matched"],
        wall_s=0.0,
        outputs=_shown(record["outputs"]),
        damage=tuple(record["damage"]),
        interrupted=False,
    )


def _shown(save: Iterable[str]) -> tuple[str, ...]:
    return tuple(shown for name in save for shown in (OUTPUTS[name].shown, *OUTPUTS[name].beside))
