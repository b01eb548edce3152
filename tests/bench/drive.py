"""How well the robot finds its way by different depths: ``python -m bench drive``.

The same worlds, robot and guidance; only the depth differs. Without ``--worlds`` it drives round
corridors, with it in floor plans. Each drive is a row of a CSV file as soon as it is done, and
drives that stand there are not repeated.
"""

from __future__ import annotations

import argparse
import csv
import math
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from bench.markdown import table
from motionstereo_cli.method.block_matching import stereo_bm, stereo_sgbm
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.robot.guide import MapGuide
from motionstereo_cli.simulate.drive import aimed, driven
from motionstereo_cli.simulate.drive_world import RobotWorld, Shot, world_of
from motionstereo_cli.simulate.floor_plan import plan_names
from motionstereo_cli.simulate.settings import CORRIDOR, ROBOT_RADIUS_M, DriveSettings
from motionstereo_cli.types import Steering

if TYPE_CHECKING:
    from motionstereo_cli.types import Real

SETTINGS = Settings(robot_radius_m=ROBOT_RADIUS_M)

_KEY = ("depth", "world", "seed", "walkers", "laps_wanted", "noise_sigma")
_COLUMNS = (
    *_KEY,
    *("ended", "laps", "frames", "nearest_pass_m", "path_m", "lap_m"),
    "area_m2",
)


def _by_motion(world: RobotWorld) -> Iterator[Steering]:
    return (step.steering for _, step in driven(world, aimed(SETTINGS, world)))


def steered(
    world: RobotWorld, disparity: Callable[[Shot], Real]
) -> Iterator[tuple[Shot, Steering]]:
    """Yield the views of a robot that is steered by a disparity that is all of the moment."""
    guide, state = MapGuide(aimed(SETTINGS, world), world.settings.rig), None
    for shot in world.shots():
        disparity_px = disparity(shot)
        seen = guide.profile(disparity_px, ~np.isnan(disparity_px))
        state, steering = guide.steer(state, seen, shot.pose)
        yield shot, steering


def _by(disparity: Callable[[Shot], Real]) -> Callable[[RobotWorld], Iterator[Steering]]:
    return lambda world: (steering for _, steering in steered(world, disparity))


def _at_random(world: RobotWorld) -> Iterator[Steering]:
    """Steer to a heading that drifts at random, as if the way were always free."""
    rng = np.random.default_rng([world.settings.seed, 4])
    angle_rad = 0.0
    for _ in world.shots():
        angle_rad = 0.8 * angle_rad + rng.normal(0, 0.1)
        yield Steering("ok", None, angle_rad, 10.0, None)


def _peer(match: Callable[..., Real]) -> Callable[[Shot], Real]:
    return lambda shot: match(
        shot.frame.right, shot.frame.left, SETTINGS.max_disparity, filtered=True
    )


DEPTHS: dict[str, Callable[[RobotWorld], Iterator[Steering]]] = {
    "motionstereo": _by_motion,
    "true depth": _by(lambda shot: shot.disparity_px),
    "StereoBM": _by(_peer(stereo_bm)),
    "StereoSGBM": _by(_peer(stereo_sgbm)),
    "random steering": _at_random,
}


def drive_once(depth: str, settings: DriveSettings) -> dict[str, str]:
    """Return the row of one drive, to its end, as text."""
    world = world_of(settings)
    for steering in DEPTHS[depth](world):
        world.act_on(steering)
    values = (
        *(
            depth,
            settings.world,
            settings.seed,
            settings.walkers,
            settings.laps,
            settings.noise_sigma,
        ),
        *(world.ended, f"{world.laps:.4f}", world.frames, f"{world.nearest_pass_m:.3f}"),
        *(f"{world.path_m:.2f}", f"{world.lap_m:.2f}", f"{area_m2(world.path):.2f}"),
    )
    return dict(zip(_COLUMNS, map(str, values), strict=True))


def area_m2(path: Sequence[tuple[float, float]], cell_m: float = 0.5) -> float:
    """Return the area of the cells that a path passes through."""
    return len(set(map(tuple, np.floor(np.array(path) / cell_m).tolist()))) * cell_m**2


def summary_of_plans(rows: Sequence[dict[str, str]]) -> str:
    """Return drives in floor plans as Markdown: a line for each plan, and what they come to.

    A cell: the way in m, the area in m2 that it passes through, the nearest pass in m, and
    how the drive ended, unless its frames were over.
    """
    depths = list(dict.fromkeys(row["depth"] for row in rows))
    by_world: dict[str, dict[str, list[dict[str, str]]]] = {}
    for row in rows:
        by_world.setdefault(row["world"], {}).setdefault(row["depth"], []).append(row)
    lines: list[list[object]] = []
    for world, drives in by_world.items():
        lines.append([world, *("; ".join(map(_in_words, drives.get(d, []))) for d in depths)])
    totals: list[object] = ["all"]
    for depth in depths:
        mine = [row for row in rows if row["depth"] == depth]
        touched = sum(row["ended"].startswith("touched") for row in mine)
        path_m, covered_m2 = (sum(float(row[key]) for row in mine) for key in ("path_m", "area_m2"))
        totals.append(f"{path_m:.0f} m, {covered_m2:.0f} m2, touched in {touched} of {len(mine)}")
    return table(["world", *depths], [*lines, totals])


def _in_words(row: dict[str, str]) -> str:
    ended = "" if row["ended"] == "out of frames" else f", {row['ended']}"
    return f"{row['path_m']}, {row['area_m2']}, {row['nearest_pass_m']}{ended}"


def summary(rows: Sequence[dict[str, str]]) -> str:
    """Return the summary of drives as Markdown, a line for each depth.

    Lap length is the way driven for a lap by those that did at least half of one, against the
    corridor's middle line.
    """
    head = ["depth", "worlds finished without touching", "touched", "laps (mean)"]
    head += ["nearest pass (m)", "lap length"]
    lines = []
    for depth in dict.fromkeys(row["depth"] for row in rows):
        mine = [row for row in rows if row["depth"] == depth]
        touched = [row for row in mine if row["ended"].startswith("touched")]
        done = sum(row["ended"] == "laps done" for row in mine)
        lengths = [
            float(row["path_m"]) / float(row["laps"]) / float(row["lap_m"])
            for row in mine
            if float(row["laps"]) >= 0.5
        ]
        length = f"{np.mean(lengths):.3f}" if lengths else "-"
        laps = np.mean([float(row["laps"]) for row in mine])
        nearest_m = min(float(row["nearest_pass_m"]) for row in mine)
        passed = f"{max(nearest_m, 0):.2f}"
        finished = f"{done} of {len(mine)}"
        lines.append([depth, finished, len(touched), f"{laps:.2f}", passed, length])
    return table(head, lines)


def main(args: Sequence[str] | None = None) -> None:
    """Drive, and print the table as Markdown on standard output."""
    parser = argparse.ArgumentParser(prog="python -m bench drive")
    parser.add_argument("--seeds", type=int, default=20, help="how many worlds, from seed 0")
    parser.add_argument("--laps", type=float, default=2.0, help="rounds to drive in each")
    parser.add_argument("--walkers", type=int, default=0, help="walkers in each")
    parser.add_argument("--noise-sigma", type=float, default=1.5, help="sensor noise, grey levels")
    parser.add_argument("--depths", nargs="+", choices=DEPTHS, default=list(DEPTHS))
    parser.add_argument(
        "--worlds", nargs="*", help="floor plans, by name or file, in place of corridors; none: all"
    )
    parser.add_argument("--rows", type=Path, default=Path("out/bench_drives.csv"))
    given = parser.parse_args(args)
    if given.seeds < 1 or not (math.isfinite(given.laps) and given.laps > 0):
        parser.error("--seeds and --laps: give more than 0")

    given.rows.parent.mkdir(parents=True, exist_ok=True)
    known: dict[tuple[str, ...], dict[str, str]] = {}
    if given.rows.exists():
        with given.rows.open(newline="", encoding="utf-8") as file:
            known = {tuple(row[key] for key in _KEY): row for row in csv.DictReader(file)}
    rows = []
    with given.rows.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, _COLUMNS, lineterminator="\n")
        if not file.tell():
            writer.writeheader()
        worlds = [CORRIDOR] if given.worlds is None else given.worlds or plan_names()
        drives = list(product(given.depths, worlds, range(given.seeds)))
        for depth, world, seed in tqdm(drives, unit="drive", disable=None):
            corridor = {"laps": given.laps, "walkers": given.walkers} if world == CORRIDOR else {}
            settings = DriveSettings(
                seed=seed, world=world, noise_sigma=given.noise_sigma, **corridor
            )
            key = (depth, world, seed, settings.walkers, settings.laps, settings.noise_sigma)
            row = known.get(tuple(map(str, key)))
            if row is None:
                row = drive_once(depth, settings)
                writer.writerow(row)
                file.flush()
            rows.append(row)
    print(summary(rows) if given.worlds is None else summary_of_plans(rows))
