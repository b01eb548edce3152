"""``motionstereo figure``: the stages of some frames on one sheet."""

from __future__ import annotations

from pathlib import Path

import click

from motionstereo_cli.commands.grouped import GroupedCommand
from motionstereo_cli.commands.messages import say
from motionstereo_cli.commands.options import (
    config_files,
    input_options,
    processing_options,
    rig_options,
    say_idle,
)
from motionstereo_cli.commands.progress import quiet_option
from motionstereo_cli.errors import DAMAGED_EXIT_CODE
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.rig.settings import RigSettings
from motionstereo_cli.sources.settings import InputSettings


def _numbers(ctx: click.Context, _: click.Parameter, text: str) -> list[int]:
    numbers = [int(part) for part in text.split(",") if part.strip().isdecimal()]
    if len(numbers) != text.count(",") + 1:
        raise click.UsageError(
            f"--frames cannot be {text!r}: give frame numbers from 0, such as 350,355,360", ctx
        )
    return numbers


@click.command(
    cls=GroupedCommand,
    examples=("motionstereo figure left.mp4 right.mp4 --frames 20,54,72 -o sheet.png",),
)
@click.option(
    "--frames",
    "numbers",
    required=True,
    metavar="NUMBERS",
    callback=_numbers,
    help="Frames to draw: frame numbers from 0, separated by commas.",
)
@click.option(
    "-o",
    "--out",
    type=click.Path(dir_okay=False, path_type=Path),
    default="sheet.png",
    show_default=True,
    help="PNG file to write; replaces an older one.",
)
@input_options
@rig_options
@processing_options
@quiet_option
def figure(
    *,
    left: str,
    right: str | None,
    numbers: list[int],
    out: Path,
    input_settings: InputSettings,
    rig: tuple[Path, ...],
    rig_settings: RigSettings,
    settings: Settings,
) -> int:
    """Draw some frames stage by stage on one sheet.

    Figures 2 and 3 of the paper have this form: one row for each frame, with the right image (the
    left one with --reference left), its bands, its permanency memory, and its depth (without
    a rig disparity), bright where near and black where unknown. Images that are not rectified need
    --rig.
    """
    from motionstereo_cli.evaluation.figure import draw_figure
    from motionstereo_cli.files.encode import encode_png
    from motionstereo_cli.files.targets import check_target, write_output
    from motionstereo_cli.rig.calibration import rectify_source
    from motionstereo_cli.sources import open_stereo

    with open_stereo(left, right, input_settings) as source:
        calibration = rectify_source(source, rig, rig_settings)
        present = settings.options | ({"--rig"} if calibration else set())
        say_idle(present, input_settings, rig_settings)
        # No advice to give options that it does not have.
        say_idle(present | {"--rig", "--poses", "--save steering", "--save map"}, settings)
        for line in calibration.warnings if calibration else ():
            say("warning", line)
        inputs = (*source.paths, *rig, *config_files())
        check_target(out, inputs)
        sheet = draw_figure(source, numbers, settings, in_metres=calibration is not None)
        write_output(out, encode_png(sheet), inputs)
        damage = source.damage
    for line in damage:
        say("warning", line)
    say("note", f"{len(numbers)} frame{'s' if len(numbers) > 1 else ''} in {out}")
    return DAMAGED_EXIT_CODE if damage else 0
