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
from motionstereo_cli.errors import InputError, OutputError
from motionstereo_cli.pipeline import process
from motionstereo_cli.settings import Settings
from motionstereo_cli.sinks import DEFAULT_SAVES, SAVES, Sink, available
from motionstereo_cli.sinks.folder import complete, prepare, tidy
from motionstereo_cli.sinks.steering import SteeringStream
from motionstereo_cli.sinks.threaded import Threaded
from motionstereo_cli.sources import StereoSource
from motionstereo_cli.types import FrameResult, Rig

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
    out: Path | BinaryIO,
    settings: Settings,
    rig: Rig | None = None,
    *,
    save: Sequence[str] = DEFAULT_SAVES,
    overwrite: bool = False,
    inputs: Iterable[Path] = (),
    progress: Callable[[], object] = lambda: None,
) -> RunReport:
    """Process a stereo source and write the results.

    ``run.json`` is written last: where it stands, everything beside it is complete. When the
    run is interrupted (KeyboardInterrupt), the images written so far stay, the tables and
    videos stay up to there under their ``.part`` names, and there is no ``run.json``. After
    any other error the ``.part`` files are removed as well.

    Args:
        source: an open source, not yet iterated.
        out: the output folder, or a binary stream that gets the steering table alone.
        settings: parameters of the processing.
        rig: the camera; without one there are no lengths and angles, and disparity images take
            the place of depth images.
        save: names of the outputs, from :data:`~motionstereo_cli.sinks.SAVES`.
        overwrite: replace the results of a former run in ``out``.
        inputs: files and folders that must not be written to.
        progress: called after each frame.

    Raises:
        InputError: the rig is for another size, or the source has no frames.
        OutputError: the results cannot be written.
        BrokenPipeError: whoever read the stream ``out`` has gone.
    """
    if rig is not None:
        _check_size(rig, source)
    if isinstance(out, Path):
        save = available(save, rig=rig is not None)
        prepare(out, save, overwrite=overwrite, inputs=inputs)
    else:
        save = ()

    totals = _Totals()
    sinks: list[Sink] = []
    interrupted = False
    started_s = time.perf_counter()
    try:
        for sink in _opened(out, save, source, settings):
            sinks.append(sink)  # one by one: should the next fail, this one is abandoned
        for result in process(source, settings, rig):
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
    except BaseException:
        _abandon(sinks, keep=False)
        if isinstance(out, Path):
            tidy(out)
        raise

    report = RunReport(
        frames=totals.frames,
        charged=totals.charged / max(totals.frames, 1),
        matched=totals.matched / max(totals.frames, 1),
        wall_s=time.perf_counter() - started_s,
        outputs=tuple(SAVES[name].shown for name in save),
        damage=tuple(source.damage),
        interrupted=interrupted,
    )
    if isinstance(out, Path) and not interrupted:
        complete(out, save, _record(source, settings, rig, report))
    return report


def _check_size(rig: Rig, source: StereoSource) -> None:
    if (rig.width, rig.height) != (source.width, source.height):
        raise InputError(
            f"the rig is for {rig.width}x{rig.height} but the recordings are "
            f"{source.width}x{source.height}: give the rig of these recordings"
        )


def _opened(
    out: Path | BinaryIO, save: Sequence[str], source: StereoSource, settings: Settings
) -> Iterator[Sink]:
    if not isinstance(out, Path):
        yield SteeringStream(out, "the steering table")
        return
    time_base = source.time_base or DEFAULT_TIME_BASE
    for name in save:
        path = out / SAVES[name].path
        yield Threaded(SAVES[name].open(path, time_base, settings.max_disparity))


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


def _record(
    source: StereoSource, settings: Settings, rig: Rig | None, report: RunReport
) -> dict[str, Any]:
    """Return what ``run.json`` says besides the outputs; all but ``timing`` is repeatable."""
    return {
        "versions": {
            "motionstereo": __version__,
            "python": platform.python_version(),
            "numpy": np.__version__,
            "cv2": cv2.__version__,
            "av": av.__version__,
        },
        "settings": dataclasses.asdict(settings),
        "inputs": source.describe(),
        "rig": None if rig is None else dataclasses.asdict(rig),
        "time_base": None if source.time_base is None else str(source.time_base),
        "grey": GREY,
        "counts": {"written": report.frames, **source.counts},
        "damage": list(report.damage),
        "timing": {
            "wall_s": round(report.wall_s, 3),
            "frames_per_second": round(report.frames_per_second, 2),
        },
    }
