"""``motionstereo simulate``: a rendered recording with exact truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from motionstereo_cli.commands.grouped import GroupedCommand
from motionstereo_cli.commands.messages import say
from motionstereo_cli.commands.options import config_files, settings_options
from motionstereo_cli.commands.progress import Bar, foretelling, progress_options
from motionstereo_cli.simulate.settings import SimulateSettings


@click.command(cls=GroupedCommand)
@progress_options
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--overwrite", is_flag=True, help="Replace an earlier simulation in OUT.")
@settings_options(SimulateSettings, "Scene")
def simulate(out: Path, overwrite: bool, chosen: dict[str, Any]) -> None:
    """Render a stereo recording with exact truth into the folder OUT.

    It writes left.mp4, right.mp4, rig.yaml, disparity/ (KITTI format: 16-bit PNG, 1/256 px; right
    view) and poses.txt (TUM format, m; the point halfway between the cameras).
    """
    settings = SimulateSettings(**chosen)

    from motionstereo_cli.simulate.write import simulate as write

    frames = len(settings.frame_range)
    with Bar(frames) as bar:
        write(
            out,
            settings,
            overwrite=overwrite,
            inputs=config_files(),
            progress=foretelling(frames, bar),
        )
    say("note", f"{frames} frames of the {settings.scene} in {out}")
