"""``motionstereo run``."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from motionstereo_cli.commands.grouped import GroupedCommand, GroupedOption
from motionstereo_cli.commands.messages import say
from motionstereo_cli.commands.options import (
    Count,
    config_files,
    input_options,
    output_options,
    pose_options,
    processing_options,
    rig_options,
)
from motionstereo_cli.commands.progress import Bar, progress_options
from motionstereo_cli.errors import DAMAGED_EXIT_CODE, INTERRUPTED_EXIT_CODE
from motionstereo_cli.runs.plan import RunPlan
from motionstereo_cli.sinks.outputs import DEFAULT_OUTPUTS, OUTPUTS

if TYPE_CHECKING:
    from motionstereo_cli.runs.record import RunReport


def _names(_: click.Context, __: click.Parameter, lists: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(name.strip() for text in lists for name in text.split(","))


def _complete_names(_: click.Context, __: click.Parameter, incomplete: str) -> list[str]:
    before, comma, name = incomplete.rpartition(",")
    return [before + comma + known for known in OUTPUTS if known.startswith(name)]


_OPTIONS = (
    click.option(
        "-o",
        "--out",
        type=click.Path(allow_dash=True, path_type=Path),
        default="motionstereo_out",
        show_default=True,
        help="Output folder. - writes only the steering table, to standard output.",
    ),
    rig_options,
    pose_options,
    click.option(
        "--disparity",
        type=click.Path(path_type=Path),
        cls=GroupedOption,
        group="Method",
        help="Folder with a map of disparity for each image, which another program found: 16-bit "
        "PNG, PFM, TIFF or NPY of the rectified images, named like them or by number. It takes the "
        "place of the matching. See --disparity-view and --disparity-scale.",
    ),
    click.option(
        "--save",
        multiple=True,
        metavar="NAMES",
        callback=_names,
        shell_complete=_complete_names,
        help="Outputs, such as report,objects,map: see motionstereo help outputs. May be repeated. "
        f"Names are {', '.join(OUTPUTS)}.  "
        f"[default: {','.join(DEFAULT_OUTPUTS)}]",
    ),
    click.option(
        "--csv",
        "table",
        type=click.Path(dir_okay=False, allow_dash=True, path_type=Path),
        help="Also write the steering table to this file. - is standard output, row by row.",
    ),
    output_options,
    click.option("--overwrite", is_flag=True, help="Replace the results of an earlier run in OUT."),
    click.option(
        "--resume",
        is_flag=True,
        help="Continue an interrupted run in OUT. Starts a new run if there is none.",
    ),
    click.option(
        "--jobs",
        type=Count(1, 256),
        metavar="INTEGER",
        help="Frames matched in parallel. Results do not depend on it, but with more than one each "
        "comes up to so many frames later.  [default: number of cores, 1 with a pipe]",
    ),
    click.option(
        "--check/--no-check",
        "with_check",
        cls=GroupedOption,
        group="Robustness",
        default=True,
        help="Check the first frames as the command check does the whole recording, and warn.  "
        "[default: on]",
    ),
    input_options,
    processing_options,
)


def run_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command LEFT, RIGHT and all options of ``run``: what a plan is made of."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


@click.command(
    cls=GroupedCommand,
    examples=(
        "motionstereo run left.mp4 right.mp4 --rig rig.yaml -o out/first",
        "motionstereo run both.mp4 --layout side-by-side --save report -o out/both",
        "motionstereo run kitti/sequences/00 --save report,preview -o out/kitti",
        "motionstereo run drive_bag/ -o out/bag",
    ),
)
@progress_options
@click.option(
    "--dry-run",
    cls=GroupedOption,
    group="Robustness",
    is_flag=True,
    help="Check everything, say what would be written, and write nothing.",
)
@run_options
def run(*, dry_run: bool, **given: Any) -> int:
    """Find depth and steering in the two videos of a stereo camera.

    LEFT and RIGHT are video files, folders of images, or quoted patterns such as 'cam0_*.png'; -
    is a video on standard input. Without RIGHT, LEFT is a KITTI or EuRoC folder, a ROS bag or, with
    --layout, one recording of both views.
    """
    plan = RunPlan(**given, reads=config_files())

    from motionstereo_cli.runs.run import Watcher, try_out
    from motionstereo_cli.runs.run import run as library

    if dry_run:
        frames, outputs = try_out(plan, Watcher(say))
        say("note", would_write(plan, frames, outputs))
        return 0
    with Bar(quiet=_shares_terminal(plan)) as bar:
        try:
            report = library(plan, Watcher(bar.say, bar.begin, bar.update))
        except KeyboardInterrupt as interrupt:
            interrupt.add_note("no frame was reached: give the same command again")
            raise
    return _summarise(plan, report)


def would_write(plan: RunPlan, frames: int | None, outputs: Sequence[str]) -> str:
    """Return in words what a run would do that was tried out."""
    count = "an unknown number of frames" if frames is None else f"{frames} frames"
    files = f"into {plan.folder}: {', '.join((*outputs, 'run.json'))}"
    place = files if plan.folder else "as a steering table to standard output"
    return f"a dry run: {count} would be processed, and the results written {place}"


def _summarise(plan: RunPlan, report: RunReport) -> int:
    """Print a summary and return the exit code."""
    for line in report.damage:
        say("warning", line)
    frames = "1 frame" if report.frames == 1 else f"{report.frames} frames"
    if report.resumed == report.frames and not report.interrupted:
        say("note", f"{plan.folder} is complete already")
    else:
        before = f", {report.resumed} of them before," if report.resumed else ""
        say(
            "note",
            f"{frames}{before} in {report.wall_s:.1f} s "
            f"({report.frames_per_second:.0f} frames per second): "
            f"{'depth' if report.in_metres else 'disparity'} for {report.matched:.0%} of the image "
            f"({report.charged:.0%} moved lately)",
        )
    if report.interrupted:
        kept = f": what was done is in {plan.folder}, --resume goes on from there"
        say("error", f"interrupted after {frames}{kept if plan.folder else ''}")
        return INTERRUPTED_EXIT_CODE
    if plan.folder:
        if "objects.csv" in report.outputs:
            say("note", _found(plan.folder))
        say("note", f"results in {plan.folder}: {', '.join((*report.outputs, 'run.json'))}")
    return DAMAGED_EXIT_CODE if report.damage else 0


def _found(folder: Path) -> str:
    """Return in words how many moving objects a run found."""
    from motionstereo_cli.report.run_folder import read_results

    marks = Counter[str]()
    for row in read_results(folder).objects() or ():
        marks[row["id"]] += 1 if row.get("shadow") == "1" else -1
    count, dark = len(marks), sum(mark > 0 for mark in marks.values())
    also = f", {dark} marked as shadow{'' if dark == 1 else 's'}" if dark else ""
    return f"{count or 'no'} moving object{'' if count == 1 else 's'} found{also}"


def _shares_terminal(plan: RunPlan) -> bool:
    """Return whether a bar would mix with the rows of the table."""
    return plan.to_stdout and sys.stdout is not None and sys.stdout.isatty()
