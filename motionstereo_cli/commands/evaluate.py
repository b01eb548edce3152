"""``motionstereo evaluate``: a result against the truth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from motionstereo_cli.commands.forms import STDOUT, print_form, write_files
from motionstereo_cli.commands.grouped import GroupedCommand
from motionstereo_cli.commands.messages import say
from motionstereo_cli.commands.options import config_files, say_idle, settings_options
from motionstereo_cli.commands.progress import no_bar, quiet_option
from motionstereo_cli.evaluation.settings import EvaluateSettings

if TYPE_CHECKING:
    from motionstereo_cli.evaluation.evaluate import Comparison, Report
    from motionstereo_cli.evaluation.objects import ObjectReport
    from motionstereo_cli.evaluation.poses import PoseReport

_KIND = click.Choice(["disparity", "depth"])
#: Depths this many times too large or too small are of another unit or rig.
_MAX_TIMES = 1.5
_TABLE = click.Path(dir_okay=False, allow_dash=True, path_type=Path)
_PICTURE = "errors.png"
#: What OUT and TRUTH may be, as conditions of parameters name it.
_IMAGES, _OBJECTS = "folders of images", "files of objects"


@click.command(
    cls=GroupedCommand,
    examples=(
        "motionstereo simulate out/truth --frames 250:350 --noise-sigma 1.5",
        "motionstereo run out/truth/left.mp4 out/truth/right.mp4 -o out/found",
        "motionstereo evaluate out/found out/truth",
    ),
)
@click.argument("result", metavar="OUT", type=click.Path(path_type=Path))
@click.argument("truth", type=click.Path(path_type=Path))
@click.option(
    "--rig",
    type=click.Path(path_type=Path),
    help="rig.yaml for conversion between disparity and depth.  "
    "[default: the rig in OUT's run.json or TRUTH's rig.yaml]",
)
@click.option("--out-kind", type=_KIND, help="What OUT holds.  [default: from the folder's name]")
@click.option(
    "--truth-kind", type=_KIND, help="What TRUTH holds.  [default: from the folder's name]"
)
@click.option(
    "--mask",
    type=click.Path(path_type=Path),
    help="Folder of PNG masks, one for each frame: only pixels that are not 0 count.",
)
@click.option(
    "--csv", "csv_path", type=_TABLE, help="Write one row for each frame. - is standard output."
)
@click.option(
    "--json", "json_path", type=_TABLE, help="Write the report as JSON. - is standard output."
)
@click.option(
    "--picture",
    type=int,
    metavar="FRAME",
    help="Draw the errors of this frame, by its place in the recording, as TRUTH has it.",
)
@click.option(
    "-o",
    "--picture-out",
    "picture_path",
    type=click.Path(dir_okay=False, path_type=Path),
    help=f"PNG file for --picture; replaces an older one.  [default: {_PICTURE}]",
)
@settings_options(EvaluateSettings)
@quiet_option
def evaluate(
    *,
    result: Path,
    truth: Path,
    rig: Path | None,
    out_kind: str | None,
    truth_kind: str | None,
    mask: Path | None,
    csv_path: Path | None,
    json_path: Path | None,
    picture: int | None,
    picture_path: Path | None,
    settings: EvaluateSettings,
) -> None:
    """Compare the disparity or depth of a run with ground truth.

    OUT and TRUTH are folders that run or simulate wrote, or folders of images, both in the same
    view: KITTI disparity PNG (uint16, 1/256 px), depth PNG (uint16, mm or the unit in run.json),
    PFM or float32 TIFF (px or m). Frames are matched by the number in their names. It prints a
    table of coverage, bad-pixel shares, D1, errors in px and, with a rig, in m; - as the file of
    --csv or --json prints those instead.

    Two files of poses, both of the same frame and in the form of TUM, EuRoC or KITTI, are compared
    as paths: drift over 5 to 100 m as KITTI has it, absolute and relative error of the trajectory.

    Two files of objects, each an objects.csv or labels of KITTI's tracking benchmark, are compared
    object by object: found, false, changes of identity, errors of depth and speed.
    """
    if csv_path == json_path == STDOUT:
        raise click.UsageError("--csv - and --json - cannot both go to standard output")
    of_images = {"--rig": rig, "--out-kind": out_kind, "--truth-kind": truth_kind, "--mask": mask}
    _say_without_effect(result, of_images | {"--picture": picture}, picture_path, settings)
    if result.is_file():
        _evaluate_files(result, truth, csv_path, json_path, settings)
        return
    picture_path = picture_path or Path(_PICTURE)

    from tqdm import tqdm

    from motionstereo_cli.evaluation import evaluate_report
    from motionstereo_cli.evaluation.evaluate import Comparison
    from motionstereo_cli.evaluation.evaluate import evaluate as evaluate_library
    from motionstereo_cli.files.encode import encode_png
    from motionstereo_cli.files.targets import check_targets, write_output
    from motionstereo_cli.rig import read_rig
    from motionstereo_cli.sinks.read_back import Maps

    comparison = Comparison(
        Maps(result, out_kind, within=result),
        Maps(truth, truth_kind, per_m=settings.truth_scale),
        rig=None if rig is None else read_rig(rig),
        mask=mask,
    )
    given = [path for path in (rig, mask) if path is not None]
    inputs = (result, truth, *given, *config_files())
    check_targets((csv_path, json_path, None if picture is None else picture_path), inputs)
    if picture is not None:
        drawn = encode_png(evaluate_report.draw_errors(comparison.pair(picture)))
        write_output(picture_path, drawn, inputs)
    with tqdm(total=len(comparison.numbers), unit="frame", disable=no_bar()) as bar:
        report = evaluate_library(comparison, bar.update)

    _say_what_is_not_scored(comparison, report)
    forms = ((csv_path, evaluate_report.format_csv), (json_path, evaluate_report.format_json))
    write_files(report, forms, inputs)
    print_form(report, forms, evaluate_report.format_table)
    if picture is not None:
        say("note", f"errors of frame {picture} in {picture_path}")


def _say_without_effect(
    result: Path,
    of_images: Mapping[str, object],
    picture_path: Path | None,
    settings: EvaluateSettings,
) -> None:
    if of_images["--picture"] is None and picture_path is not None:
        say("note", "--picture-out has no effect without --picture")
    if result.is_dir():
        say_idle({_IMAGES}, settings)
        return
    for flag, value in of_images.items():
        if value is not None:
            say("note", f"{flag} has no effect without {_IMAGES}")


def _evaluate_files(
    result: Path,
    truth: Path,
    csv_path: Path | None,
    json_path: Path | None,
    settings: EvaluateSettings,
) -> None:
    """Compare two files of objects or of poses."""
    from motionstereo_cli.evaluation import numbers, objects, poses
    from motionstereo_cli.files.targets import check_targets

    inputs = (result, truth, *config_files())
    check_targets((csv_path, json_path), inputs)
    report: PoseReport | ObjectReport
    of_objects = objects.is_objects(result) or (truth.is_file() and objects.is_objects(truth))
    say_idle({_OBJECTS} if of_objects else set(), settings)
    if of_objects:
        report = objects.evaluate_objects(result, truth, settings)
    else:
        report = poses.evaluate_poses(result, truth)
    forms = ((csv_path, numbers.format_csv), (json_path, numbers.format_json))
    write_files(report, forms, inputs)
    print_form(report, forms, numbers.format_table)
    if missing := getattr(report, "without_truth", 0):
        say("warning", f"{missing} poses of OUT have no true one, and do not count")
    if unknown := [name for name, value in asdict(report).items() if math.isnan(value)]:
        say("note", f"{', '.join(unknown)}: unknown, as {report.NOTHING}")


def _say_what_is_not_scored(comparison: Comparison, report: Report) -> None:
    for side, count in (("OUT", report.only_out), ("TRUTH", report.only_truth)):
        if count:
            say("warning", f"{count} frames are only in {side} and not scored")
    first, every, lost = comparison.numbering
    if first or every > 1:
        say("note", f"frame n of OUT is image {first} + {every} n of its recording, as in TRUTH")
    if lost and report.only_truth:
        say(
            "warning",
            f"{lost} images of the recording were lost or had no partner: behind each, frames are "
            "compared with the truth of the image before",
        )
    if None not in comparison.views and len(set(comparison.views)) > 1:
        out_view, truth_view = comparison.views
        say("warning", f"OUT is in the {out_view} view, but TRUTH in the {truth_view} one")
    if not comparison.has_depth:
        say("note", "errors in m need a rig: give --rig")
    elif max(times := comparison.times(comparison.numbers[0]), 1 / times) > _MAX_TIMES:
        say(
            "warning",
            f"depths are {times:.2g} times those of TRUTH: check its unit (--truth-scale), its "
            "kind, and the rig",
        )
