"""``motionstereo rig``: a calibration of any format as rig.yaml."""

from __future__ import annotations

import logging
import re
from functools import partial
from pathlib import Path

import click

from motionstereo_cli.commands.grouped import GroupedCommand
from motionstereo_cli.commands.messages import level, say
from motionstereo_cli.commands.options import calibration_options
from motionstereo_cli.commands.progress import quiet_option
from motionstereo_cli.rig.settings import RigSettings

_STDOUT = Path("-")


def _two_numbers(
    ctx: click.Context, option: click.Parameter, text: str | None
) -> tuple[int, int] | None:
    if text is None:
        return None
    found = re.fullmatch(r"(\d{1,6})[x,](\d{1,6})", text.strip(), re.ASCII)
    if found is None:
        raise click.UsageError(f"{option.opts[0]} cannot be {text!r}: give {option.metavar}", ctx)
    return int(found[1]), int(found[2])


@click.command(
    cls=GroupedCommand,
    examples=(
        "motionstereo rig stereo.yml",
        "motionstereo rig calibration.yaml --size 1280x1024 -o rig.yaml",
    ),
)
@click.argument(
    "files", metavar="FILE...", nargs=-1, required=True, type=click.Path(path_type=Path)
)
@click.option(
    "-o",
    "--out",
    type=click.Path(dir_okay=False, allow_dash=True, path_type=Path),
    default="-",
    show_default=True,
    help="rig.yaml to write; replaces an older one. - is standard output.",
)
@click.option(
    "--size",
    metavar="WIDTHxHEIGHT",
    callback=_two_numbers,
    help="Size of the images in px, where the files do not say it.",
)
@click.option(
    "--cameras",
    metavar="LEFT,RIGHT",
    callback=_two_numbers,
    help="Numbers of KITTI's cameras.  [default: 0,1, or 2,3 if only these are there]",
)
@partial(calibration_options, present={"--rig"})
@quiet_option
def rig(
    *,
    files: tuple[Path, ...],
    out: Path,
    size: tuple[int, int] | None,
    cameras: tuple[int, int] | None,
    rig_settings: RigSettings,
) -> None:
    """Convert a calibration to rig.yaml and show how it was read.

    FILE is an OpenCV (YAML, XML, JSON, npz), KITTI, Middlebury, kalibr, OpenVINS, ORB-SLAM,
    stella_vslam, OKVIS, maplab, SVO, Basalt, T265, DepthAI or ZED file, ROS' ost.txt, or rig.yaml;
    two files, the left camera's first, are a ROS camera_info, EuRoC sensor.yaml or mrcal pair, or
    OpenCV's intrinsics and extrinsics; three are VINS-Fusion's configuration and cameras. A
    rig.yaml describes rectified images: if yours are not rectified, give FILE itself to run --rig.
    """
    from motionstereo_cli.files.targets import write_output
    from motionstereo_cli.rig import format_rig
    from motionstereo_cli.rig.calibration import read_calibration

    calibration = read_calibration(files, size, rig_settings, pair=cameras)
    if level.get() <= logging.INFO:
        click.echo(calibration.describe(), nl=False, err=True)
    for line in calibration.warnings:
        say("warning", line)
    if out == _STDOUT:
        click.echo(format_rig(calibration.rig), nl=False)
    else:
        write_output(out, format_rig(calibration.rig).encode(), files)
        say("note", f"the rig of the rectified images is in {out}")
