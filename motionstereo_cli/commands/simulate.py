"""``motionstereo simulate``: a rendered recording with exact truth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from motionstereo_cli.commands.grouped import GroupedCommand
from motionstereo_cli.commands.messages import say
from motionstereo_cli.commands.options import config_files, settings_options
from motionstereo_cli.commands.progress import Bar, foretelling, progress_options
from motionstereo_cli.simulate.settings import SimulateSettings

if TYPE_CHECKING:
    from motionstereo_cli.simulate.scenes import SceneFrame


@click.command(
    cls=GroupedCommand,
    examples=(
        "motionstereo simulate out/turn --frames 250:350 --noise-sigma 1.5",
        "motionstereo simulate out/street --scene street --frames 100",
    ),
)
@progress_options
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--overwrite", is_flag=True, help="Replace an earlier simulation in OUT.")
@settings_options(SimulateSettings, "Scene")
def simulate(out: Path, overwrite: bool, settings: SimulateSettings) -> None:
    """Render a stereo recording with exact truth into the folder OUT.

    It writes left.mp4, right.mp4, rig.yaml, disparity/ (KITTI format: 16-bit PNG, 1/256 px; right
    view) and poses.txt (TUM format, m; the point halfway between the cameras). Of cards and streets
    also what moves by itself: movers/ (8-bit PNG, its number in each pixel of the right view, 0 =
    none) and objects.csv, as run --save objects has it.
    """
    from motionstereo_cli.simulate.write import simulate as write

    frames = len(settings.frame_range)
    with Bar(frames) as bar:
        advance = foretelling(frames, bar)

        def progress(shot: SceneFrame) -> None:
            advance()
            bar.tell(lambda: _words(shot, settings))

        write(
            out,
            settings,
            overwrite=overwrite,
            inputs=config_files(),
            progress=progress,
        )
    say("note", f"{frames} frames of the {settings.scene} in {out}")


def _words(shot: SceneFrame, settings: SimulateSettings) -> str:
    """Return where the cameras are, and what is before them."""
    nearest_m = settings.rig.depth_m(shot.disparity_px).min()
    movers = f"; moving by themselves: {len(shot.objects)}" if shot.mover is not None else ""
    return f"frame {shot.frame}: {shot.pose.words}; nearest {nearest_m:.1f} m{movers}"
