"""run.json and the run's report."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import os
import platform
import re
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from msgspec import UNSET, UnsetType, structs

import motionstereo_cli
from motionstereo_cli import __version__
from motionstereo_cli.errors import OutputError
from motionstereo_cli.files.reading import real, sha256_of
from motionstereo_cli.files.records import typed
from motionstereo_cli.files.targets import is_stream
from motionstereo_cli.rig import rig_values
from motionstereo_cli.runs.folder_files import head
from motionstereo_cli.runs.job import Job
from motionstereo_cli.runs.open_outputs import Totals
from motionstereo_cli.runs.plan import AUTO_POSES, RunPlan
from motionstereo_cli.sinks.outputs import OUTPUTS, RECORD
from motionstereo_cli.sinks.records import (
    Counts,
    FileRecord,
    FolderRecord,
    InputRecord,
    RigRecord,
    RunRecord,
    Shares,
    Timing,
    WarningRecord,
)
from motionstereo_cli.sources import StereoSource

GREY = (
    "luma of the decoded video, expanded to 0..255 where the stream is limited range; "
    "BT.601 luma of still images"
)


@dataclasses.dataclass(frozen=True, slots=True)
class RunReport:
    """Outcome of a run.

    Attributes:
        frames: stereo frames processed.
        resumed: how many of them an earlier process had done.
        charged, matched, at_limit: mean shares of the image, 0..1, with charge, with a disparity,
            and at the limit of the range.
        wall_s: duration in s, from the first frame's decoding to the last output's completion.
        outputs: paths under the output folder, numbered files as their folder.
        in_metres: whether there was a rig.
        damage: what was lost of the input, one line each.
        warnings: what looks wrong, in the order of the warnings.
        interrupted: the run ended before the end of the input; see :func:`run`.
    """

    frames: int
    resumed: int
    charged: float
    matched: float
    at_limit: float
    wall_s: float
    outputs: tuple[str, ...]
    in_metres: bool
    damage: tuple[str, ...]
    warnings: tuple[WarningRecord, ...]
    interrupted: bool

    @property
    def frames_per_second(self) -> float:
        """Speed of this process, 0 if there was nothing left to do."""
        return (self.frames - self.resumed) / self.wall_s if self.wall_s else 0.0


def identity_of(job: Job, inputs: Iterable[Path]) -> RunRecord:
    """Return the identity of a run in ``run.json``: all that its results depend on."""
    plan, source, context = job.plan, job.source, job.context
    known = {*source.paths, *plan.reads, plan.disparity}
    files = [FileRecord(str(path), sha256_of(path)) for path in inputs if path not in known]
    if source.given is not None:
        files.append(FileRecord(str(plan.disparity), source.given.sha256()))
    table: str | UnsetType = UNSET
    if plan.table and plan.folder and not plan.to_stdout and not is_stream(plan.table):
        # The same, however it is given.
        place = real(plan.table.parent) / plan.table.name
        table = os.path.relpath(place, real(plan.folder))
    own_motion = job.with_own_motion
    return structs.replace(
        head(job.save),
        table=table,
        versions=versions(),
        settings=dataclasses.asdict(plan.settings),
        input_settings=dataclasses.asdict(source.settings),
        output_settings=dataclasses.asdict(context.output),
        inputs=_described(source),
        files=files,
        rig=None if context.rig is None else typed(rig_values(context.rig), RigRecord, "the rig"),
        time_base=None if source.time_base is None else str(source.time_base),
        grey=GREY,
        rig_settings=UNSET if context.rig is None else dataclasses.asdict(plan.rig_settings),
        pose_settings=dataclasses.asdict(job.poses.settings) if job.poses else UNSET,
        poses=AUTO_POSES if plan.poses and not job.poses else UNSET,
        motion_offset_px=job.motion_offset_px if own_motion else UNSET,
        measured=list(plan.measured) or UNSET,
        warnings=list(job.warned.found),
    )


def _described(source: StereoSource) -> dict[str, InputRecord]:
    return {name: InputRecord(**said) for name, said in source.describe().items()}


def versions() -> dict[str, str]:
    """Return the versions of all packages that results and speed depend on."""
    return {
        "motionstereo": __version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "cv2": cv2.__version__,
        "av": av.__version__,
    }


_LIBRARY = re.compile(r"\.(so|dll|dylib|pyd)\b")


@functools.cache
def builds() -> dict[str, str]:
    """Return what the bytes of results depend on: versions and builds of libraries.

    For this package it is a hash of its files: two states of one version may differ.
    """
    import importlib.metadata  # it takes long to load, and only a batch asks

    home = Path(motionstereo_cli.__file__).parent
    own = {str(path.relative_to(home)): sha256_of(path) for path in home.rglob("*.py")}
    files = importlib.metadata.files("av") or ()
    libraries = [
        f"{file} {file.hash.value}" for file in files if file.hash and _LIBRARY.search(str(file))
    ]
    return {
        **versions(),
        "this package": _short_hash(own),
        "FFmpeg": _short_hash([av.library_versions, sorted(libraries)]),
        "OpenCV": _short_hash(cv2.getBuildInformation()),
    }


def _short_hash(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]


def report_on(job: Job, totals: Totals, resumed: int, started_s: float) -> RunReport:
    """Return the report of a run.

    Args:
        job: the run.
        totals: sums over all its frames.
        resumed: how many of them an earlier process had done.
        started_s: its start, by ``time.perf_counter``.
    """
    charged, matched, at_limit = totals.means
    return RunReport(
        frames=totals.frames,
        resumed=resumed,
        charged=charged,
        matched=matched,
        at_limit=at_limit,
        wall_s=time.perf_counter() - started_s,
        outputs=shown_outputs(job.save),
        in_metres=job.context.rig is not None,
        damage=tuple(job.source.damage),
        warnings=job.warned.found,
        interrupted=False,
    )


def outcome(source: StereoSource, report: RunReport) -> dict[str, Any]:
    """Return the outcome of a run in ``run.json``; all but ``timing`` is repeatable."""
    return {
        # The content of a pipe is known at its end.
        **({} if source.rereadable else {"inputs": _described(source)}),
        "counts": Counts(written=report.frames, **source.counts),
        "shares": Shares(report.charged, report.matched, report.at_limit),
        "warnings": list(report.warnings),
        "damage": list(report.damage),
        "timing": Timing(round(report.wall_s, 3), round(report.frames_per_second, 2)),
    }


def report_of(record: FolderRecord, plan: RunPlan) -> RunReport:
    """Return the report of a run that was complete already.

    Raises:
        OutputError: its table is missing, or its record lacks a field.
    """
    if plan.table is not None and not plan.table.exists():
        raise OutputError(
            f"{plan.folder} is complete, but {plan.table} is missing: give --overwrite to begin "
            "again, or leave it out"
        )
    assert isinstance(record, RunRecord)
    if not (record.counts and record.shares) or record.damage is UNSET:
        raise OutputError(
            f"{plan.folder}/{RECORD} is damaged: counts, shares or damage are missing: give "
            "--overwrite to start again"
        )
    frames = record.counts.written
    return RunReport(
        frames=frames,
        resumed=frames,
        charged=record.shares.charged,
        matched=record.shares.matched,
        at_limit=record.shares.at_limit,
        wall_s=0.0,
        outputs=shown_outputs(name for name in record.outputs or () if name in OUTPUTS),
        in_metres=record.camera is not None,
        damage=tuple(record.damage),
        warnings=record.warned,
        interrupted=False,
    )


def shown_outputs(save: Iterable[str]) -> tuple[str, ...]:
    """Return what outputs write, numbered files as their folder."""
    return tuple(shown for name in save for shown in (OUTPUTS[name].shown, *OUTPUTS[name].beside))
