"""A run: from a stereo source to files."""

from __future__ import annotations

import contextlib
import dataclasses
import platform
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO

import av
import cv2
import numpy as np

from motionstereo_cli import __version__
from motionstereo_cli.check import Finding, watched
from motionstereo_cli.errors import InputError, OutputError
from motionstereo_cli.pipeline import process
from motionstereo_cli.poses import Trajectory
from motionstereo_cli.settings import Settings
from motionstereo_cli.sinks import DEFAULT_SAVES, SAVES, Sink, Stream, available
from motionstereo_cli.sinks.folder import complete, prepare, tidy
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
        charged, matched: mean shares of the image, 0..1, with charge and with a disparity.
        wall_s: duration in s, from the first frame's decoding to the last output's completion.
        outputs: paths under the output folder, numbered files as their folder.
        damage: what was lost of the input, one line each.
        interrupted: the run was ended before the end of the input; see :func:`run`.
    """

    frames: int
    charged: float
    matched: float
    wall_s: float
    outputs: tuple[str, ...]
    damage: tuple[str, ...]
    interrupted: bool

    @property
    def frames_per_second(self) -> float:
        """Speed of the whole run."""
        return self.frames / self.wall_s


def run(
    source: StereoSource,
    out: Path | None,
    settings: Settings,
    rig: Rig | None = None,
    *,
    poses: Trajectory | None = None,
    save: Sequence[str] = DEFAULT_SAVES,
    table: Path | BinaryIO | None = None,
    output: OutputSettings | None = None,
    overwrite: bool = False,
    inputs: Iterable[Path] = (),
    progress: Callable[[], object] = lambda: None,
    warn: Callable[[Finding], object] | None = None,
) -> RunReport:
    """Process a stereo source and write the results.

    ``run.json`` is written last: where it stands, everything beside it is complete. When the
    run is interrupted (KeyboardInterrupt), the images written so far stay, the tables and
    videos stay up to there under their ``.part`` names, and there is no ``run.json``; so too
    when the reader of ``table`` goes. After any other error the ``.part`` files are removed.

    Args:
        source: an open source, not yet iterated.
        out: the output folder; None if there is to be nothing but ``table``.
        settings: parameters of the processing.
        rig: the camera, as it is before the source's crop and scale; without one there are no
            lengths and angles, and disparity images take the place of depth images.
        poses: where the rig was, in the times of the source; needs a rig.
        save: names of the outputs in ``out``, from :data:`~motionstereo_cli.sinks.SAVES`.
        table: where the steering table goes besides: a file, or a binary stream that gets each
            row at once.
        output: parameters of the output; the defaults if None.
        overwrite: replace the results of a former run in ``out``, and a file ``table``.
        inputs: files and folders that must not be written to.
        progress: called after each frame.
        warn: called with each mistake found in the first frames; they are not checked if None.

    Raises:
        InputError: the rig is for another size, the source has no frames, or a frame has no pose.
        OutputError: the results cannot be written.
        SettingsError: an output needs a rig, or poses.
        BrokenPipeError: whoever read the stream ``table`` has gone.
    """
    if rig is not None:
        check_size(rig, source)
        rig = adapted_rig(rig, source.settings)
    stream = Stream(
        source.time_base or DEFAULT_TIME_BASE, settings, rig, output or OutputSettings()
    )
    save = _prepared(
        out,
        save,
        table,
        stream,
        poses=poses is not None,
        overwrite=overwrite,
        inputs=list(inputs),
    )

    totals = _Totals()
    sinks: list[Sink] = []
    interrupted = False
    started_s = time.perf_counter()
    try:
        for sink in _opened(out, save, stream, table):
            sinks.append(sink)  # one by one: should the next fail, this one is abandoned
        pose_of = None if poses is None else poses.of
        for result in process(_checked(source, settings, rig, warn), settings, rig, pose_of):
            for sink in sinks:
                sink.write(result)
            totals.add(result)
            progress()
        if not totals.frames:
            raise InputError("the recordings have no frame in common: check that they are whole")
        for sink in sinks:
            sink.close()
    except KeyboardInterrupt:
        interrupted = True
        _abandon(sinks, keep=totals.frames > 0)
    except BaseException as error:
        _abandon(sinks, keep=isinstance(error, BrokenPipeError) and totals.frames > 0)
        if out is not None:
            tidy(out)
        raise

    report = RunReport(
        frames=totals.frames,
        charged=totals.charged / max(totals.frames, 1),
        matched=totals.matched / max(totals.frames, 1),
        wall_s=time.perf_counter() - started_s,
        outputs=tuple(shown for name in save for shown in (SAVES[name].shown, *SAVES[name].beside)),
        damage=tuple(source.damage),
        interrupted=interrupted,
    )
    if out is not None and not interrupted:
        complete(out, save, _record(source, stream, report))
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


def _prepared(
    out: Path | None,
    save: Sequence[str],
    table: Path | BinaryIO | None,
    stream: Stream,
    *,
    poses: bool,
    overwrite: bool,
    inputs: Sequence[Path],
) -> tuple[str, ...]:
    """Make ``out`` ready and return the names of the outputs in it."""
    if isinstance(table, Path):
        _check_free(table, out, overwrite=overwrite, inputs=inputs)
    if out is None:
        return ()
    save = available(
        save,
        rig=stream.rig is not None,
        poses=poses,
        steering_format=stream.output.steering_format,
    )
    prepare(out, save, overwrite=overwrite, inputs=inputs)
    return save


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
    out: Path | None, save: Sequence[str], stream: Stream, table: Path | BinaryIO | None
) -> Iterator[Sink]:
    if isinstance(table, Path):
        yield SteeringFile(table, stream.output.steering_format)
    elif table is not None:
        yield SteeringStream(table, "the steering table", stream.output.steering_format)
    if out is not None:
        for name in save:
            yield Threaded(SAVES[name].open(out, stream))


@dataclasses.dataclass(slots=True)
class _Totals:
    frames: int = 0
    charged: float = 0.0
    matched: float = 0.0

    def add(self, result: FrameResult) -> None:
        self.frames += 1
        self.charged += result.charged
        self.matched += result.matched


def _abandon(sinks: Iterable[Sink], *, keep: bool) -> None:
    for sink in sinks:
        with contextlib.suppress(OutputError):  # why the run ends matters more
            sink.abandon(keep=keep)


def _record(source: StereoSource, stream: Stream, report: RunReport) -> dict[str, Any]:
    """Return what ``run.json`` says besides the outputs; all but ``timing`` is repeatable."""
    return {
        "versions": {
            "motionstereo": __version__,
            "python": platform.python_version(),
            "numpy": np.__version__,
            "cv2": cv2.__version__,
            "av": av.__version__,
        },
        "settings": dataclasses.asdict(stream.settings),
        "input_settings": dataclasses.asdict(source.settings),
        "output_settings": dataclasses.asdict(stream.output),
        "inputs": source.describe(),
        "rig": None if stream.rig is None else dataclasses.asdict(stream.rig),
        "time_base": None if source.time_base is None else str(source.time_base),
        "grey": GREY,
        "counts": {"written": report.frames, **source.counts},
        "warnings": source.warnings,
        "damage": list(report.damage),
        "timing": {
            "wall_s": round(report.wall_s, 3),
            "frames_per_second": round(report.frames_per_second, 2),
        },
    }
