"""A run: from a stereo source to files."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import platform
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO

import av
import cv2
import numpy as np

from motionstereo_cli import __version__
from motionstereo_cli.analysis.check import watched
from motionstereo_cli.analysis.findings import Finding
from motionstereo_cli.batch.checkpoint import (
    Checkpoint,
    check_same,
    read_checkpoint,
    write_checkpoint,
)
from motionstereo_cli.batch.folder import (
    CHECKPOINT,
    clear,
    complete,
    head,
    locked,
    prepare,
    record_of,
    tidy,
)
from motionstereo_cli.batch.interrupts import finishing
from motionstereo_cli.errors import InputError, OutputError
from motionstereo_cli.files.atomic import part_of
from motionstereo_cli.files.reading import sha256_of
from motionstereo_cli.pipeline import State, process
from motionstereo_cli.rig import rig_values
from motionstereo_cli.rig.poses import Trajectory
from motionstereo_cli.settings import Settings
from motionstereo_cli.sinks import DEFAULT_OUTPUTS, OUTPUTS, RECORD, RunContext, Sink, available
from motionstereo_cli.sinks.settings import OutputSettings
from motionstereo_cli.sinks.steering import SteeringFile, SteeringStream
from motionstereo_cli.sinks.threaded import Threaded
from motionstereo_cli.sources import StereoSource
from motionstereo_cli.sources.settings import adapted_rig
from motionstereo_cli.types import FrameResult, Rig, StereoFrame

#: Time from frame to frame in the videos written, in s, where the source has no time.
DEFAULT_TIME_BASE = Fraction(1, 25)

GREY = (
    "luma of the decoded video, expanded to 0..255 where the stream is limited range; "
    "BT.601 luma of still images"
)


@dataclasses.dataclass(frozen=True, slots=True)
class RunReport:
    """What a run did.

    Attributes:
        frames: stereo frames processed.
        resumed: how many of them a former process had done.
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


def run(
    source: StereoSource,
    out: Path | None,
    settings: Settings,
    rig: Rig | None = None,
    *,
    poses: Trajectory | None = None,
    save: Sequence[str] = DEFAULT_OUTPUTS,
    table: Path | BinaryIO | None = None,
    output: OutputSettings | None = None,
    jobs: int = 1,
    overwrite: bool = False,
    resume: bool = False,
    inputs: Iterable[Path] = (),
    options: Sequence[str] = (),
    progress: Callable[[], object] = lambda: None,
    warn: Callable[[Finding], object] | None = None,
) -> RunReport:
    """Process a stereo source and write the results.

    ``run.json`` is written last: where it stands, everything beside it is complete. However the
    run ends before, what was done stays: images whole, tables and videos under ``.part`` names,
    and what another process needs to go on from the last checkpoint. Its results are then the
    same to the byte. An interrupt waits until all outputs have the frame at hand.

    Args:
        source: an open source, not yet iterated.
        out: the output folder; None if there is to be nothing but ``table``.
        settings: parameters of the processing.
        rig: the camera, as it is before the source's crop and scale; without one there are no
            lengths and angles, and disparity images take the place of depth images.
        poses: where the rig was, in the times of the source; needs a rig.
        save: names of the outputs in ``out``, from :data:`~motionstereo_cli.sinks.OUTPUTS`.
        table: where the steering table goes besides: a file, or a binary stream that gets each
            row at once.
        output: parameters of the output; the defaults if None.
        jobs: frames matched at a time; results do not depend on it.
        overwrite: replace the results of a former run in ``out``, and a file ``table``.
        resume: go on where the same run was ended in ``out``, or begin if it has not yet.
        inputs: files and folders that must not be written to. The content of those that are not
            the source's own, such as calibration and poses, is part of what the run is.
        options: what the command line has besides the input and the parameters, such as
            ``--rig rig.yaml``: recorded, so that it can be given again.
        progress: called after each frame.
        warn: called with each mistake found in the first frames; they are not checked if None.

    Raises:
        InputError: the rig is for another size, the source has no frames, or a frame has no pose.
        OutputError: the results cannot be written, or what is there is of another run.
        SettingsError: an output needs a rig, or poses.
        BrokenPipeError: whoever read the stream ``table`` has gone.
    """
    if rig is not None:
        check_size(rig, source)
        rig = adapted_rig(rig, source.settings)
    if poses is not None:
        poses.check_covers(*(source.numbers if poses.by_number else source.span_s))
    stream = RunContext(
        source.time_base or DEFAULT_TIME_BASE, settings, rig, output or OutputSettings()
    )
    inputs = list(inputs)
    if isinstance(table, Path):
        ours = resume and out is not None and (out / CHECKPOINT).exists()
        _check_free(table, out, overwrite=overwrite or ours, inputs=inputs)
    save = () if out is None else _available(save, stream, poses)
    identity = functools.cache(lambda: _identity(source, stream, save, inputs, poses))

    with contextlib.ExitStack() as held:
        since: Checkpoint | None = None
        if out is not None:
            held.enter_context(locked(out))
            if resume and (finished := record_of(out)):
                check_same(out, identity(), finished)
                clear(out)
                return _report_of(finished)
            if resume:
                since = _resumed(out, identity, [*save, *_table_name(table)])
                overwrite = part_of(out / RECORD).exists()
            if since is None:
                prepare(out, save, overwrite=overwrite, inputs=inputs)
        since = since or Checkpoint(State(), _Totals(), {})
        totals: _Totals = since.totals
        resumed = totals.frames

        def checkpoint(state: State) -> None:
            if out is not None and source.rereadable:
                write_checkpoint(out / CHECKPOINT, identity(), state, totals, sinks)

        sinks: dict[str, Sink] = {}
        interrupted = False
        started_s = time.perf_counter()
        try:
            for name, sink in _opened(out, save, stream, table, since.sinks):
                sinks[name] = sink  # one by one: should the next fail, this one is abandoned
            frames = iter(_checked(source, settings, rig, warn))
            for _ in itertools.islice(frames, resumed):
                progress()
            pose_of = None if poses is None else poses.of
            results = process(
                frames,
                settings,
                rig,
                pose_of,
                # They take time: only for whom it concerns.
                with_objects="objects" in save or poses is not None,
                jobs=jobs,
                state=since.state,
            )
            _write(results, sinks, totals, checkpoint, stream.output.checkpoint_frames, progress)
        except BaseException as error:
            interrupted = isinstance(error, KeyboardInterrupt)
            _end_early(sinks.values(), out, totals.frames, error)
            if not interrupted:
                raise

        report = RunReport(
            frames=totals.frames,
            resumed=resumed,
            charged=totals.charged / max(totals.frames, 1),
            matched=totals.matched / max(totals.frames, 1),
            wall_s=time.perf_counter() - started_s,
            outputs=_shown(save),
            damage=tuple(source.damage),
            interrupted=interrupted,
        )
        if out is not None and not interrupted:
            complete(out, identity() | {"options": list(options)} | _results(source, report))
    return report


def _checked(
    source: StereoSource,
    settings: Settings,
    rig: Rig | None,
    warn: Callable[[Finding], object] | None,
) -> Iterable[StereoFrame]:
    if warn is None:
        return source
    doffs = rig.doffs if rig is not None else 0.0
    return watched(source, settings.max_disparity, warn, doffs=doffs)


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


def _available(
    save: Sequence[str], stream: RunContext, poses: Trajectory | None
) -> tuple[str, ...]:
    return available(
        save,
        rig=stream.rig is not None,
        poses=poses is not None,
        steering_format=stream.output.steering_format,
    )


def _resumed(
    out: Path, identity: Callable[[], Mapping[str, Any]], sinks: Sequence[str]
) -> Checkpoint | None:
    """Return where the same run was ended in ``out``, None if it left nothing to go on from."""
    since = read_checkpoint(out / CHECKPOINT)
    if since is not None:
        check_same(out, identity(), since.identity)
        if set(since.sinks) != set(sinks):
            raise OutputError(
                f"{out} was begun with the outputs {', '.join(since.sinks)}: "
                "give the same ones, or --overwrite to begin anew"
            )
    return since


def _table_name(table: Path | BinaryIO | None) -> tuple[str, ...]:
    return (str(table),) if isinstance(table, Path) else ()


def _shown(save: Iterable[str]) -> tuple[str, ...]:
    return tuple(shown for name in save for shown in (OUTPUTS[name].shown, *OUTPUTS[name].beside))


def _check_free(table: Path, out: Path | None, *, overwrite: bool, inputs: Sequence[Path]) -> None:
    """Make sure that a table is written over nothing that matters."""
    place = table.resolve()
    if place in {path.resolve() for path in inputs}:
        raise OutputError(f"{table} is an input of this run: give the table another name")
    if out is not None and place.is_relative_to(out.resolve()):
        raise OutputError(f"{table} is in the output folder: --save steering puts a table there")
    if table.exists() and not overwrite:
        raise OutputError(f"{table} is there already: give another name, or --overwrite")


def _opened(
    out: Path | None,
    save: Sequence[str],
    stream: RunContext,
    table: Path | BinaryIO | None,
    marks: Mapping[str, Any],
) -> Iterator[tuple[str, Sink]]:
    """Open the sinks, where there are ``marks`` to go on from them, and yield their names too."""
    if isinstance(table, Path):
        name = str(table)
        file = SteeringFile(table, stream.output.steering_format, marks.get(name))
        yield name, Threaded(file)
    elif table is not None:
        name = "the steering table"
        yield name, SteeringStream(table, name, stream.output.steering_format)
    if out is not None:
        for name in save:
            yield name, Threaded(OUTPUTS[name].open(out, stream, marks.get(name)))


@dataclasses.dataclass(slots=True)
class _Totals:
    frames: int = 0
    charged: float = 0.0
    matched: float = 0.0

    def add(self, result: FrameResult) -> None:
        self.frames += 1
        self.charged += result.charged
        self.matched += result.matched


def _write(
    results: Iterable[FrameResult],
    sinks: Mapping[str, Sink],
    totals: _Totals,
    checkpoint: Callable[[State], object],
    checkpoint_frames: int,
    progress: Callable[[], object],
) -> None:
    """Write the results to the sinks, and complete these."""
    for result in results:
        with finishing():
            for sink in sinks.values():
                sink.write(result)
            totals.add(result)
            if totals.frames % checkpoint_frames == 0:
                assert result.state is not None
                checkpoint(result.state)
        progress()
    if not totals.frames:
        raise InputError("the recordings have no frame in common: check that they are whole")
    for sink in sinks.values():
        sink.close()


def _end_early(sinks: Iterable[Sink], out: Path | None, frames: int, error: BaseException) -> None:
    """Leave what was done in order, and say where it is."""
    for sink in sinks:
        with contextlib.suppress(OutputError):  # why the run ends matters more
            sink.abandon(keep=frames > 0)
    if out is not None and frames:
        error.add_note(
            f"what was done is in {out}: with --resume the same command goes on from the last "
            "checkpoint"
        )
    elif out is not None:
        tidy(out)


def _identity(
    source: StereoSource,
    stream: RunContext,
    save: Sequence[str],
    inputs: Iterable[Path],
    poses: Trajectory | None,
) -> dict[str, Any]:
    """Return what ``run.json`` says of what the run is: its results follow from it."""
    files = [path for path in inputs if path not in source.paths]
    return {
        **head(save),
        "versions": versions(),
        "settings": dataclasses.asdict(stream.settings),
        "input_settings": dataclasses.asdict(source.settings),
        "output_settings": dataclasses.asdict(stream.output),
        "inputs": source.describe(),
        "files": [{"path": str(path), "sha256": sha256_of(path)} for path in files],
        "rig": None if stream.rig is None else rig_values(stream.rig),
        "time_base": None if source.time_base is None else str(source.time_base),
        "grey": GREY,
        **({"pose_settings": dataclasses.asdict(poses.settings)} if poses else {}),
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


def _results(source: StereoSource, report: RunReport) -> dict[str, Any]:
    """Return what ``run.json`` says of what came of it; all but ``timing`` is repeatable."""
    return {
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
