"""``motionstereo run``."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from motionstereo_cli.commands.grouped import GroupedCommand, GroupedOption
from motionstereo_cli.commands.messages import announce_compiling
from motionstereo_cli.commands.messages import say as _say
from motionstereo_cli.commands.options import (
    input_options,
    near_match,
    output_options,
    pose_options,
    processing_options,
    rig_options,
)
from motionstereo_cli.errors import DAMAGED_EXIT_CODE, INTERRUPTED_EXIT_CODE, OutputError
from motionstereo_cli.settings import Settings
from motionstereo_cli.sinks import DEFAULT_OUTPUTS, OUTPUTS, available
from motionstereo_cli.sources.settings import InputSettings

if TYPE_CHECKING:
    from motionstereo_cli.rig.settings import PoseSettings
    from motionstereo_cli.sinks.settings import OutputSettings


def _names(ctx: click.Context, _: click.Parameter, lists: tuple[str, ...]) -> tuple[str, ...]:
    names = [name.strip() for text in lists for name in text.split(",")]
    for name in names:
        if name not in OUTPUTS:
            advice = near_match(name, OUTPUTS) or f": choose from {', '.join(OUTPUTS)}"
            raise click.UsageError(f"--save knows no {name!r}{advice}", ctx)
    return tuple(names)


def _complete_names(_: click.Context, __: click.Parameter, incomplete: str) -> list[str]:
    before, comma, name = incomplete.rpartition(",")
    return [before + comma + known for known in OUTPUTS if known.startswith(name)]


@click.command(cls=GroupedCommand)
@click.option(
    "-o",
    "--out",
    type=click.Path(allow_dash=True, path_type=Path),
    default="motionstereo_out",
    show_default=True,
    help="Folder for the results. - writes only the steering table, to standard output.",
)
@rig_options
@pose_options
@click.option(
    "--save",
    multiple=True,
    metavar="NAMES",
    callback=_names,
    shell_complete=_complete_names,
    help="What to write, as a comma list. May be repeated. Names are "
    f"{', '.join(OUTPUTS)}; motionstereo help outputs describes them.  "
    f"[default: {','.join(DEFAULT_OUTPUTS)}]",
)
@click.option(
    "--csv",
    type=click.Path(dir_okay=False, allow_dash=True, path_type=Path),
    help="Write the steering table here too. - is standard output, row by row.",
)
@output_options
@click.option("--overwrite", is_flag=True, help="Replace the results of an earlier run in OUT.")
@click.option(
    "--resume",
    is_flag=True,
    help="Go on where the same run into OUT was interrupted. Begins if there is none.",
)
@click.option(
    "--jobs",
    type=click.IntRange(1, 256),
    metavar="INTEGER",
    help="Frames matched at the same time. Results do not depend on it, but come that many frames "
    "later, less one.  [default: number of cores, 1 with standard input]",
)
@click.option(
    "--check/--no-check",
    "with_check",
    cls=GroupedOption,
    group="Robustness",
    default=True,
    help="Look for mistakes in the first frames, as the command check does in all frames, and "
    "warn.  "
    "[default: on]",
)
@input_options
@processing_options
def run(
    *,
    left: str,
    right: str | None,
    out: Path,
    rig: tuple[Path, ...],
    baseline_unit: str | None,
    poses: Path | None,
    pose_settings: PoseSettings,
    save: tuple[str, ...],
    csv: Path | None,
    overwrite: bool,
    resume: bool,
    jobs: int | None,
    with_check: bool,
    input_settings: InputSettings,
    output_settings: OutputSettings,
    settings: Settings,
) -> int:
    """Find depth and steering in the two videos of a stereo camera.

    LEFT and RIGHT are video files, folders of images, or quoted patterns such as 'cam0_*.png'; -
    is a video on standard input. LEFT alone is a KITTI or EuRoC folder or, with --layout, one
    recording that holds both views.
    """
    table_alone = str(out) == "-"
    to_stdout = table_alone or str(csv) == "-"
    in_metres = output_settings.near_m or output_settings.far_m
    no_metres = "need --rig: without it nothing is in metres"
    clashes = {
        "-o - writes the steering table alone: leave --save and --csv out": (
            table_alone and (save or csv)
        ),
        "--resume goes on, --overwrite begins anew: give one of them": resume and overwrite,
        "--resume cannot go on with a table on standard output: give a file": resume and to_stdout,
        "--resume cannot read standard input again: give files": resume and "-" in (left, right),
        f"--poses {no_metres}": poses and not rig,
        f"--near-m and --far-m {no_metres}": in_metres and not rig,
    }
    for message, given in clashes.items():
        if given:
            raise click.UsageError(message)
    if to_stdout and sys.stdout is None:
        raise OutputError("cannot write the steering table: standard output is closed")
    save = save or DEFAULT_OUTPUTS

    from tqdm import tqdm

    from motionstereo_cli.batch.run import run as run_library
    from motionstereo_cli.rig.calibration import rectify_source
    from motionstereo_cli.rig.poses import read_poses
    from motionstereo_cli.sources import open_stereo

    with (
        open_stereo(left, right, input_settings) as source,
        tqdm(total=source.expected_frames, unit="frame", disable=_quiet(to_stdout)) as bar,
    ):
        for line in source.warnings:
            _say("warning", line)
        if not table_alone and not rig and available(save, rig=False) != save:
            _say("note", "depth in m needs --rig: disparity takes the place of depth")
        calibration = rectify_source(source, rig, baseline_unit)
        for line in calibration.warnings if calibration else ():
            _say("warning", line)
        trajectory = None
        if poses and calibration:
            trajectory = read_poses(
                poses, pose_settings, calibration.rig, calibration.body_from_left
            )

        def say(kind: str, text: str) -> None:
            bar.clear()
            _say(kind, text)
            bar.refresh()

        announce_compiling(say)
        report = run_library(
            source,
            None if table_alone else out,
            settings,
            calibration.rig if calibration else None,
            save=save,
            table=sys.stdout.buffer if to_stdout else csv,
            output=output_settings,
            jobs=jobs or (1 if "-" in (left, right) else os.cpu_count()) or 1,
            overwrite=overwrite,
            resume=resume,
            poses=trajectory,
            inputs=[*source.paths, *rig, *([poses] if poses else [])],
            options=_again(rig, baseline_unit, poses),
            warn=(lambda finding: say("warning", finding.text)) if with_check else None,
            progress=bar.update,
        )

    for line in report.damage:
        _say("warning", line)
    frames = "1 frame" if report.frames == 1 else f"{report.frames} frames"
    if report.resumed == report.frames and not report.interrupted:
        _say("note", f"{out} is complete already")
    else:
        before = f", {report.resumed} of them before," if report.resumed else ""
        _say(
            "note",
            f"{frames}{before} in {report.wall_s:.1f} s "
            f"({report.frames_per_second:.0f} frames per second), "
            f"charged {report.charged:.1%}, matched {report.matched:.1%} of the image",
        )
    if report.interrupted:
        kept = "" if table_alone else f": what was done is in {out}, --resume goes on from there"
        _say("error", f"interrupted after {frames}{kept}")
        return INTERRUPTED_EXIT_CODE
    if not table_alone:
        _say("note", f"results in {out}: {', '.join((*report.outputs, 'run.json'))}")
    return DAMAGED_EXIT_CODE if report.damage else 0


def _again(rig: tuple[Path, ...], baseline_unit: str | None, poses: Path | None) -> list[str]:
    """Return the options that are neither parameters nor outputs, as they were given."""
    units = ["--baseline-unit", baseline_unit] if baseline_unit else []
    files = [("--rig", path) for path in rig] + ([("--poses", poses)] if poses else [])
    return [word for flag, path in files for word in (flag, str(path))] + units


def _quiet(to_stdout: bool) -> bool | None:
    """Return what tqdm's ``disable`` should be: None shows the bar on a terminal alone."""
    if sys.stderr is None or (to_stdout and sys.stdout.isatty()):
        return True
    return None
