"""``motionstereo drive``: a simulated robot that drives by its own depth."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from motionstereo_cli.commands.grouped import GroupedCommand
from motionstereo_cli.commands.messages import say
from motionstereo_cli.commands.options import processing_options, say_idle, world_options
from motionstereo_cli.commands.progress import Bar, foretelling, progress_options
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.simulate.settings import DriveSettings

if TYPE_CHECKING:
    from motionstereo_cli.simulate.drive_world import RobotWorld
    from motionstereo_cli.types import Step


#: What a drive has of the options of ``run``.
_PRESENT = {"--rig", "--poses", "--save steering", "--save map", "-o FOLDER"}


@click.command(
    cls=GroupedCommand,
    examples=(
        "motionstereo drive out/drive --seed 3 --walkers 2 --view",
        "motionstereo drive out/office --world office",
        "motionstereo drive out/there --world room-with-pillars --goal 3,2.5",
    ),
)
@progress_options
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--view", is_flag=True, help="Write drive.mp4: right image, memory, depth, plan.")
@click.option("--overwrite", is_flag=True, help="Replace an earlier drive in OUT.")
@world_options
@partial(processing_options, present=_PRESENT)
def drive(out: Path, view: bool, overwrite: bool, world: DriveSettings, settings: Settings) -> None:
    """Drive a simulated robot by its own depth.

    It drives round a square corridor, or in the floor plan of --world. OUT then holds left.mkv and
    right.mkv, its views (FFV1, lossless); rig.yaml and poses.txt (TUM format, m); steering.csv,
    equal to that of run with --poses poses.txt and the same --goal; objects.csv, the true boxes and
    speeds of the walkers; plan.png, the drive from above; map.ply, map.png, map.yaml and
    map-sheet.png, equal to those of run --save map; drive.json with laps, distance, collisions,
    nearest pass and the reason for the end.
    """
    from motionstereo_cli.simulate.drive import drive as library
    from motionstereo_cli.simulate.drive_world import GOAL_M, world_of

    started_s = time.perf_counter()
    say_idle(settings.options | _PRESENT, settings)
    driven = world_of(world, settings.goal_m)
    frames = driven.expected_frames
    with Bar(frames) as bar:
        advance = foretelling(frames, bar)

        def progress(step: Step) -> None:
            advance()
            bar.tell(lambda: _words(driven, step))

        record = library(out, driven, settings, view=view, overwrite=overwrite, progress=progress)
    wall_s = time.perf_counter() - started_s
    laps = f"{record.laps:.2f} laps, " if driven.lap_m else ""
    away_m = driven.to_goal_m
    missed = "" if away_m is None or away_m <= GOAL_M else f"{away_m:.1f} m from the goal, "
    say(
        "note",
        f"{record.ended} after {record.frames} frames "
        f"({record.frames / wall_s:.0f} frames per second): {missed}{laps}"
        f"{record.distance_m:.1f} m, nearest pass {record.nearest_pass_m:.2f} m; "
        f"results in {out}",
    )


def _words(world: RobotWorld, step: Step) -> str:
    """Return where the robot is, where it steers, and how far it has come."""
    from motionstereo_cli.sinks.preview import heading_text

    nearest_m = step.steering.nearest_m
    nearest = "" if nearest_m is None else f"nearest {nearest_m:.1f} m; "
    laps = f"{world.laps:.2f} laps, " if world.lap_m else ""
    return (
        f"frame {step.time.index}: {world.robot.words}; {heading_text(step.steering)}; {nearest}"
        f"{laps}{world.path_m:.1f} m driven, nearest pass {world.nearest_pass_m:.2f} m"
    )
