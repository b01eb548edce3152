"""``motionstereo check``."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from motionstereo_cli.commands.grouped import GroupedCommand
from motionstereo_cli.commands.messages import printable, say
from motionstereo_cli.commands.options import (
    config_files,
    config_option,
    input_options,
    rig_options,
    say_idle,
)
from motionstereo_cli.commands.progress import no_bar, quiet_option
from motionstereo_cli.method.settings import MAX_DISPARITY, Settings
from motionstereo_cli.params import params
from motionstereo_cli.rig.settings import RigSettings
from motionstereo_cli.sources.settings import InputSettings

if TYPE_CHECKING:
    from motionstereo_cli.check.findings import CheckReport
    from motionstereo_cli.sources import StereoSource


@click.command(
    cls=GroupedCommand,
    examples=(
        "motionstereo check left.mp4 right.mp4 --rig rig.yaml",
        "motionstereo check left.mp4 right.mp4 --write advised.toml",
    ),
)
@input_options
@rig_options
@click.option(
    "--max-disparity",
    type=next(item for item in params(Settings) if item.name == "max_disparity").parse,
    metavar="INTEGER",
    default=Settings().max_disparity,
    show_default=True,
    help="Maximum disparity that run will search, in px, or auto.",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@click.option(
    "--write",
    "advice",
    type=click.Path(dir_okay=False, path_type=Path),
    help="Write the advised options to a file for run --config. Replaces an older file.",
)
@config_option
@quiet_option
def check(
    *,
    left: str,
    right: str | None,
    input_settings: InputSettings,
    rig: tuple[Path, ...],
    rig_settings: RigSettings,
    max_disparity: int,
    as_json: bool,
    advice: Path | None,
) -> int:
    """Look for faults in a recording that would spoil a run.

    It checks row alignment, disparity range, camera order, exposure, motion, and whether the
    two recordings are synchronised. It reads the whole input and matches features in a few frames.
    It prints the measurements and one line for each fault: what is wrong, by how much, and what to
    do. Exit code 1 if a fault spoils the result, 3 if the input is damaged, 0 otherwise.
    """
    from tqdm import tqdm

    from motionstereo_cli.check.measure import check as check_library
    from motionstereo_cli.check.offset import with_offset
    from motionstereo_cli.errors import DAMAGED_EXIT_CODE, NO_FRAMES, InputError
    from motionstereo_cli.rig.calibration import rectify_source
    from motionstereo_cli.sources import open_stereo
    from motionstereo_cli.sources.settings import adapted_rig

    prepare = partial(rectify_source, paths=rig, settings=rig_settings)
    input_settings = with_offset(left, right, input_settings, say, prepare)
    with (
        open_stereo(left, right, input_settings) as source,
        tqdm(total=source.expected_frames, unit="frame", disable=no_bar()) as bar,
    ):
        calibration = rectify_source(source, rig, rig_settings)
        report = check_library(
            source,
            max_disparity or MAX_DISPARITY,
            expected_frames=source.expected_frames,
            rig=adapted_rig(calibration.rig, input_settings) if calibration else None,
            given_offset_px=input_settings.disparity_offset_px or 0.0,
            progress=bar.update,
        )
    say_idle({"--rig"} if calibration else set(), input_settings, rig_settings)
    for line in calibration.notes if calibration else ():
        say("note", line)
    for line in (*source.warnings, *(calibration.warnings if calibration else ()), *source.damage):
        say("warning", line)
    if not report.frames:
        raise InputError(NO_FRAMES)
    click.echo(json.dumps(report.as_json(), indent=2) if as_json else _table(report), nl=as_json)
    if advice is not None:
        _write(advice, report, source, rig, rig_settings)
    return 1 if report.ruined else DAMAGED_EXIT_CODE if source.damage else 0


def _write(
    path: Path,
    report: CheckReport,
    source: StereoSource,
    rig: tuple[Path, ...],
    rig_settings: RigSettings,
) -> None:
    """Write the advised options and print how to use them."""
    from motionstereo_cli.check.advice import advised, as_toml
    from motionstereo_cli.files.targets import write_output

    names = [str(name) for name in source.paths]
    head = [
        f"What motionstereo check advises for {printable(', '.join(names))}:",
        "motionstereo run LEFT RIGHT --config with the name of this file.",
    ]
    found = advised(report, source.settings, source.frame_rate, source.likely_white)
    content = as_toml(head, (source.settings, rig_settings), rig, found)
    write_output(path, content, (*source.paths, *rig, *config_files()))
    say("note", f"advised options are in {path}: use them with run --config {path}")


def _table(report: CheckReport) -> str:
    """Return the report as lines of text."""
    facts = {
        "frames": f"{report.frames}, with {report.matches} matches",
        "rows": "unknown"
        if report.misaligned_px is None
        else f"{report.misaligned_px:.2f} px off (median), {report.misaligned_p90_px:.2f} px "
        f"(90th percentile), right view turned by {report.turned_deg:+.2f} degrees",
        "disparity": "unknown"
        if report.disparity_low_px is None
        else f"{report.disparity_low_px:.1f} to {report.disparity_high_px:.1f} px, "
        f"advised: --max-disparity {report.advised_max_disparity}",
        "grey": "unknown"
        if report.grey_difference is None
        else f"left {abs(report.grey_difference):.1f} levels "
        f"{'brighter' if report.grey_difference >= 0 else 'darker'}",
        "motion": "unknown"
        if report.moving is None
        else f"{report.moving:.1%} of the image changes from one frame to the next, "
        f"{report.repeated_left} left and {report.repeated_right} right images repeated",
        "step": "unknown"
        if report.ahead_frames is None
        else f"right {report.ahead_frames:+.2f} frames ahead of left",
    }
    if report.disparity_offset_px is not None:
        facts["offset"] = (
            f"disparities off by {report.disparity_offset_px:+.2f} px (positive: too small)"
        )
    lines = [f"{name + ':':<11}{fact}" for name, fact in facts.items()]
    for finding in report.findings:
        lines.append(f"{'problem' if finding.ruins else 'warning'}: {finding.text}")
    return "\n".join([*lines, *([] if report.findings else ["nothing wrong found"]), ""])
