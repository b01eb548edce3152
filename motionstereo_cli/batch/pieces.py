"""One long recording in pieces, on several workers at a time, with the same files as one run.

What depends on single frames (images, videos and the
:class:`~motionstereo_cli.pipeline.FrameSummary`) is made in pieces, each in its own folder. A
piece begins as many frames early as results reach back. What is sequential (heading, objects, map)
is then made in order, from the summaries that the pieces keep.

Pieces begin at multiples of ``checkpoint_frames``, where videos have key frames. They seek where
the recordings allow it. Seeking skips damage without noticing it: a piece after damage that another
piece noticed is made again by decoding from the start.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import struct
import time
import zlib
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from msgspec import UNSET, UnsetType, structs
from numpy.typing import NDArray

from motionstereo_cli.check.findings import Finding
from motionstereo_cli.check.measure import watched
from motionstereo_cli.errors import NO_FRAMES, InputError, OutputError, SettingsError
from motionstereo_cli.files.atomic import Temporary, reported
from motionstereo_cli.files.bounded import MAX_CONTENT_BYTES, decompressed
from motionstereo_cli.files.folders import make_folder, remove_empty
from motionstereo_cli.files.reading import open_regular
from motionstereo_cli.files.records import pack, restored, unpack
from motionstereo_cli.files.targets import link_new
from motionstereo_cli.files.video import join
from motionstereo_cli.pipeline import (
    FrameAnalysis,
    FrameSummary,
    State,
    TrackingState,
    analysed,
    depth_of,
    follow,
    recent_frames,
)
from motionstereo_cli.rig.calibration import rectify_source
from motionstereo_cli.robot.guide import ImageProfile, MapProfile
from motionstereo_cli.robot.movers import RUN_IN_FRAMES as MOVERS_FRAMES
from motionstereo_cli.robot.odometry import BLOCK_FRAMES
from motionstereo_cli.runs.folder import RunFolder, discard, record_of
from motionstereo_cli.runs.folder_files import FolderKind
from motionstereo_cli.runs.job import Job, Warned
from motionstereo_cli.runs.open_outputs import Totals
from motionstereo_cli.runs.opening import inputs_of, job_of
from motionstereo_cli.runs.plan import RunPlan
from motionstereo_cli.runs.record import (
    RunReport,
    identity_of,
    outcome,
    report_of,
    report_on,
)
from motionstereo_cli.runs.run import (
    Watcher,
    add_table,
    opened,
    table_of,
    warn_of_what_is_missing,
)
from motionstereo_cli.sinks.outputs import OUTPUTS
from motionstereo_cli.sinks.records import Counts, FolderRecord, RunRecord
from motionstereo_cli.sinks.videos import beginning
from motionstereo_cli.sources import open_stereo
from motionstereo_cli.types import FrameImages, Rig, StereoFrame

#: The summaries that a piece keeps of its frames, in order.
_KEPT = "summaries"


class PieceRecord(FolderRecord, kw_only=True, frozen=True):
    """``piece.json``.

    Attributes:
        run: identity of its run.
        piece: its first frame and the one after its last, None = the end.
        outcome: its outcome.
        sought: whether it began by seeking.
    """

    run: RunRecord | UnsetType = UNSET
    piece: tuple[int, int | None] | UnsetType = UNSET
    outcome: RunRecord | UnsetType = UNSET
    sought: bool = False


PIECE = FolderKind(
    "motionstereo piece",
    "piece.json",
    {**{name: each.paths for name, each in OUTPUTS.items()}, _KEPT: ("summaries.bin",)},
    kind=PieceRecord,
)


#: The classes of what a guide takes from a frame.
_PROFILES = {kind.__name__: kind for kind in (ImageProfile, MapProfile)}

#: Length of a frame's bytes, which follow.
_SIZE = struct.Struct("<Q")


class Piece(NamedTuple):
    """Frames of a recording: from ``first`` to before ``stop``, None = the end."""

    first: int
    stop: int | None


def pieces_of(plan: RunPlan, count: int) -> list[Piece]:
    """Return pieces of about equal length.

    Args:
        plan: the run.
        count: the number wanted; fewer, if they were shorter than ``checkpoint_frames``.

    Raises:
        InputError: the recordings cannot be read, or do not state their number of frames.
        SettingsError: this run cannot be done in pieces.
    """
    if plan.settings.charge_mode != "permanency":
        raise SettingsError(
            "--pieces needs --charge-mode permanency: the general charge never forgets, so a "
            "piece would have to begin at the first frame"
        )
    with open_stereo(plan.left, plan.right, plan.input_settings) as source:
        frames = source.expected_frames
    if frames is None:
        raise InputError(f"{plan.left} does not say how many frames it has: leave --pieces out")
    step = plan.output_settings.checkpoint_frames
    each = max(math.ceil(frames / count / step) * step, step)
    starts = range(0, max(frames, 1), each)
    return [Piece(*both) for both in itertools.zip_longest(starts, starts[1:])]


def folder_of(home: Path, piece: Piece) -> Path:
    """Return the folder of a piece."""
    return home / f"{piece.first:06d}"


def run_piece(
    plan: RunPlan, piece: Piece, home: Path, watcher: Watcher, *, seek: bool = True
) -> None:
    """Process the frames of a piece; a complete piece is kept.

    Args:
        plan: the run.
        piece: the piece.
        home: the folder of all pieces of the recording.
        watcher: callbacks.
        seek: begin by seeking if the recordings allow it; else decode from the start, and repeat
            a piece that began by seeking.

    Raises:
        InputError: the recordings cannot be read.
        OutputError: the results cannot be written.
    """
    folder = folder_of(home, piece)
    if not seek and (done := _done(folder)) and done.sought:
        discard(folder, PIECE)
    with open_stereo(plan.left, plan.right, plan.input_settings) as source:
        job = job_of(plan, source, Warned(watcher.say))
        names = tuple(name for name in job.save if OUTPUTS[name].takes == "images")
        outputs = (*names, _KEPT)
        identity = PieceRecord(
            program=PIECE.program,
            outputs=outputs,
            first=piece.first,
            run=identity_of(job, inputs_of(job)),
            piece=(piece.first, piece.stop),
        )
        with RunFolder(folder, outputs, PIECE, identity=identity, resume=True) as sinks:
            if sinks.finished is not None:
                return
            begin = max(piece.first - _run_in(job), 0)
            sought = seek and source.begin_at(begin)
            if seek and begin and not sought:
                watcher.say("note", "the recordings cannot be seeked: decoded from the start")
            frames = itertools.islice(source, 0 if seek else begin, None)
            kept = sinks.own(_KeptFile(folder / PIECE.outputs[_KEPT][0]))
            shows_images = any(OUTPUTS[name].shows_images for name in job.save)
            stop = None if piece.stop is None else piece.stop - begin
            totals = Totals()
            for found in _analyses(job, piece, itertools.islice(frames, stop), sinks, names):
                sinks.show(found.images)
                kept.add(found.summary, found.images if shows_images else None)
                totals = totals.plus(found.summary)
                if (found.summary.time.index + 1) % plan.output_settings.checkpoint_frames == 0:
                    sinks.end_segments()
                watcher.progress()
            if not totals.frames and piece.first == 0:
                raise InputError(NO_FRAMES)
            sinks.close()
            came = outcome(source, report_on(job, totals, 0, time.perf_counter()))
            counts = Counts(written=totals.frames)
            sinks.complete(counts=counts, outcome=RunRecord(**came), sought=sought)


def behind_damage(home: Path, pieces: Sequence[Piece]) -> list[Piece]:
    """Return the complete pieces that have to be made again without seeking."""
    records = [_done(folder_of(home, piece)) or PieceRecord() for piece in pieces]
    damaged = [bool(record.outcome and record.outcome.damage) for record in records]
    return [
        piece
        for number, (piece, record) in enumerate(zip(pieces, records, strict=True))
        if record.sought and any(damaged[:number])
    ]


def _done(folder: Path) -> PieceRecord | None:
    """Return the record of a complete piece, None if there is none."""
    found = record_of(folder, PIECE)
    return found if isinstance(found, PieceRecord) else None


def _run_in(job: Job) -> int:
    """Return on how many earlier frames a frame depends."""
    s = job.plan.settings
    memory = math.ceil((s.charge_max - s.charge_min) / s.charge_leak)
    shown = memory + recent_frames(s)
    if not job.with_own_motion:
        return shown
    # The memory of movers reaches back a few frames more.
    return memory + max(shown, BLOCK_FRAMES + 1) + MOVERS_FRAMES


def _analyses(
    job: Job,
    piece: Piece,
    frames: Iterable[StereoFrame],
    sinks: RunFolder,
    names: Sequence[str],
) -> Iterator[FrameAnalysis]:
    """Open the outputs at the first frame; yield the analysis of each frame."""
    last_pts = None
    for frame, _, found in analysed(frames, job.stream, State(), job.plan.jobs or 1):
        if frame.index < piece.first:
            last_pts = frame.pts
            continue
        if frame.index == piece.first:
            begin = beginning(job.source.first_pts, job.context.time_base)
            last = None if last_pts is None else last_pts - begin
            for name in names:
                mark = (((), last), begin) if OUTPUTS[name].is_video else None
                sinks.add(name, partial(_at, mark, name, sinks.path, job), "images")
        yield found


def _at(mark: object, name: str, folder: Path, job: Job, _: object) -> Any:
    return opened(name, folder, job.context, mark)


class _KeptFile:
    """The file of what a piece keeps of its frames, in order."""

    def __init__(self, path: Path) -> None:
        self._path = path
        with reported(path):
            self._file = Temporary(path)

    def add(self, summary: FrameSummary, images: FrameImages | None) -> None:
        """Append a frame, with the images that outputs show beside its step."""
        shown = None
        if images is not None:
            shown = images.view, images.charge, images.disparity_px, images.colours
        content = zlib.compress(pack(_Kept(summary, type(summary.profile).__name__, shown)), 1)
        with reported(self._path):
            self._file.content.write(_SIZE.pack(len(content)) + content)

    def close(self) -> None:
        """Complete the file and give it its name."""
        with reported(self._path):
            self._file.place()

    def abandon(self, *, keep: bool) -> None:
        """Remove the file."""
        self._file.discard()


def join_pieces(plan: RunPlan, pieces: Sequence[Piece], home: Path, watcher: Watcher) -> RunReport:
    """Run the sequential part, join the outputs, and complete the run.

    Raises:
        InputError: the recordings cannot be read.
        OutputError: a piece is missing or damaged, or the results cannot be written.
    """
    started_s = time.perf_counter()
    with open_stereo(plan.left, plan.right, plan.input_settings) as source:
        job = job_of(plan, source, Warned(watcher.say))
        assert plan.folder is not None
        inputs = inputs_of(job)
        with RunFolder(
            *(plan.folder, job.save),
            identity=identity_of(job, inputs),
            resume=True,
            inputs=inputs,
            table=table_of(plan),
        ) as sinks:
            if sinks.finished is not None:
                return report_of(sinks.finished, plan)
            folders = [folder_of(home, piece) for piece in pieces]
            _follow(job, folders, sinks, watcher)
            sinks.begin_naming()
            for name in job.save:
                if OUTPUTS[name].takes == "images":
                    _put_together(OUTPUTS[name].path, folders, plan.folder)
            sinks.close()
            last = _done(folders[-1])
            if last is None or not last.outcome or not last.outcome.counts:
                raise OutputError(f"{folders[-1]} has no outcome: give the same command again")
            _warn(job, sinks.totals, damaged=bool(last.outcome.damage))
            report = report_on(job, sinks.totals, 0, started_s)
            counts = structs.replace(last.outcome.counts, written=report.frames)
            came = outcome(source, report) | {"counts": counts, "damage": last.outcome.damage}
            sinks.complete(options=plan.options, **came)
    for folder in folders:
        discard(folder, PIECE)
    remove_empty(home)
    return report


def _warn(job: Job, totals: Totals, *, damaged: bool) -> None:
    """Give the warnings that a whole run derives from its first and last frames."""
    plan = job.plan
    job.warned.begin()
    told: list[Sequence[Finding]] = []
    if plan.with_check:
        for _ in watched(
            *(job.frames, plan.settings.max_disparity, told.append),
            rig=job.context.rig,
            given_offset_px=plan.input_settings.disparity_offset_px or 0.0,
        ):
            if told:
                break
    for findings in told:
        job.warn_of(findings)

    def last() -> StereoFrame:
        with open_stereo(plan.left, plan.right, plan.input_settings) as source:
            rectify_source(source, plan.rig, plan.rig_settings)
            if not damaged:  # seeking skips damage without noticing it
                source.begin_at(totals.frames - 1)
            return deque(source, maxlen=1).pop()

    warn_of_what_is_missing(job, totals, last)


def _follow(job: Job, folders: Sequence[Path], sinks: RunFolder, watcher: Watcher) -> None:
    """Write the outputs that need all frames in order."""
    plan = job.plan
    add_table(sinks, job)
    for name in job.save:
        if OUTPUTS[name].takes == "step":
            sinks.add(name, partial(_at, None, name, sinks.path, job))
    stream, tracking = job.stream, TrackingState()
    for folder in folders:
        for summary, images in _kept(folder, stream.rig):
            pose = job.pose_of(summary.time)
            tracking, step = follow(tracking, summary, pose, stream, images)
            sinks.write(step)
            if (summary.time.index + 1) % plan.output_settings.checkpoint_frames == 0:
                sinks.end_segments()
            watcher.progress()


@dataclass(frozen=True, slots=True)
class _Kept:
    """What is kept of a frame: its summary, the class of its profile, and images to be shown."""

    summary: FrameSummary
    profile: str
    images: (
        tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.float32], NDArray[np.uint8] | None]
        | None
    )


def _kept(folder: Path, rig: Rig | None) -> Iterator[tuple[FrameSummary, FrameImages | None]]:
    """Yield what a piece kept of its frames."""
    path = folder / PIECE.outputs[_KEPT][0]
    try:
        with open_regular(path) as file:
            while head := file.read(_SIZE.size):
                (size,) = _SIZE.unpack(head)
                if size > MAX_CONTENT_BYTES:
                    raise ValueError(f"a frame of {size} bytes")
                content = decompressed(zlib.decompressobj(), file.read(size))
                kept = unpack(content, _Kept)
                profile = restored(kept.summary.profile, _PROFILES[kept.profile])
                summary = dataclasses.replace(kept.summary, profile=profile)
                images = None
                if kept.images is not None:
                    view, charge, disparity_px, colours = kept.images
                    images = FrameImages(
                        *(summary.time, view, charge, disparity_px),
                        depth_m=depth_of(disparity_px, rig),
                        colours=colours,
                    )
                yield summary, images
    except (OSError, ValueError, LookupError, struct.error, zlib.error) as error:
        raise OutputError(
            f"{path} cannot be used ({error}): give the same command again"
        ) from error


def _put_together(path: str, folders: Sequence[Path], out: Path) -> None:
    """Join an output of the pieces in the folder of the run; the pieces keep theirs."""
    if "{" not in path:
        join([found for folder in folders if (found := folder / path).exists()], out / path)
        return
    make_folder((out / path).parent)
    for folder in folders:
        for file in sorted((folder / path).parent.glob(f"*{Path(path).suffix}")):
            target = (out / path).with_name(file.name)
            link_new(file, target)
