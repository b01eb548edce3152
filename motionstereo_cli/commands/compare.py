"""``motionstereo compare``: a run against an earlier one."""

from __future__ import annotations

import math
from pathlib import Path

import click

from motionstereo_cli.commands.forms import print_form, write_files
from motionstereo_cli.commands.grouped import GroupedCommand
from motionstereo_cli.commands.messages import say
from motionstereo_cli.commands.options import config_files, settings_options
from motionstereo_cli.commands.progress import no_bar, quiet_option
from motionstereo_cli.errors import DIFFERENT_EXIT_CODE, MotionStereoError
from motionstereo_cli.evaluation.settings import COLUMN_TOLERANCE, CompareSettings

_FILE = click.Path(dir_okay=False, path_type=Path)


def _tolerances(
    ctx: click.Context, option: click.Parameter, given: tuple[str, ...]
) -> dict[str, float]:
    tolerances = {}
    for text in given:
        column, _, value = text.partition("=")
        try:
            tolerance = float(value)
        except ValueError:
            tolerance = math.nan
        if not 0 <= tolerance < math.inf:
            raise click.UsageError(
                f"--tolerance cannot be {text!r}: give COLUMN=VALUE, such as steer=0.02", ctx
            )
        tolerances[column.strip()] = tolerance
    return tolerances


@click.command(
    cls=GroupedCommand,
    examples=(
        "motionstereo run left.mp4 right.mp4 --rig rig.yaml -o out/before",
        "motionstereo run left.mp4 right.mp4 --rig rig.yaml -o out/after",
        "motionstereo compare out/after out/before",
    ),
)
@click.argument("actual", type=click.Path(path_type=Path))
@click.argument("golden", type=click.Path(path_type=Path))
@click.option(
    "--tolerance",
    multiple=True,
    metavar="COLUMN=VALUE",
    callback=_tolerances,
    help="Tolerance of a table's column, in the column's unit. May be repeated. Other columns must "
    "be equal.  "
    f"[default: {', '.join(f'{name}={value:g}' for name, value in COLUMN_TOLERANCE.items())}]",
)
@click.option(
    "--picture",
    type=_FILE,
    help="PNG file for the images that differ most. Where none differs, that of an earlier "
    "comparison is removed.",
)
@click.option(
    "--json",
    "json_path",
    type=click.Path(dir_okay=False, allow_dash=True, path_type=Path),
    help="Write the report as JSON. - is standard output.",
)
@click.option("--junit", type=_FILE, help="Write a JUnit report with a test case for each output.")
@settings_options(CompareSettings)
@quiet_option
def compare(
    *,
    actual: Path,
    golden: Path,
    tolerance: dict[str, float],
    picture: Path | None,
    json_path: Path | None,
    junit: Path | None,
    settings: CompareSettings,
) -> int:
    """Compare a run with an earlier one; exit code 4 if they differ.

    ACTUAL and GOLDEN are output folders of run. GOLDEN may be incomplete, such as steering.csv,
    run.json and every tenth depth image; only its files are compared. Tables, depth and disparity
    images, the cells of map.png, the values of map.yaml, and the settings and counts in run.json
    are compared; other files only have to exist.
    """
    from tqdm import tqdm

    from motionstereo_cli.evaluation import compare_report
    from motionstereo_cli.evaluation.compare import compare as compare_library
    from motionstereo_cli.evaluation.compare_picture import put_picture
    from motionstereo_cli.files.targets import check_targets

    inputs = (actual, golden, *config_files())
    check_targets((picture, junit, json_path), inputs)
    try:
        with tqdm(unit="image", disable=no_bar()) as bar:
            report = compare_library(
                actual, golden, settings, tolerances=tolerance, progress=bar.update
            )
    except MotionStereoError as error:  # files of an earlier comparison would be taken for this one
        failed = ((junit, compare_report.junit_of_error), (json_path, compare_report.json_of_error))
        write_files(error, failed, inputs)
        if picture:
            put_picture(picture, None, golden, inputs)
        raise
    drawn = put_picture(picture, report.worst_image, golden, inputs) if picture else None
    forms = (
        (junit, compare_report.format_junit),
        (json_path, compare_report.format_json),
    )
    write_files(report, forms, inputs)

    for line in report.notes:
        say("note", line)
    if drawn:
        say("note", drawn)
    print_form(report, forms, compare_report.format_table)
    return DIFFERENT_EXIT_CODE if report.differs else 0
