"""How true the map of a drive is: ``python -m bench map``.

The robot drives one round, and its map is held against the corridor. Wall counts in stretches of
:data:`STRETCH_M`; one is *visible* where the right camera, at its own height, had it in view in at
least one frame, with nothing before it and no farther away than :data:`VIEW_M`; it is *found* where
an occupied cell lies within :data:`NEAR_M`. A walker is where it was in any frame.

With ``--streets`` a car drives along streets. An obstacle is a cell of :data:`OBSTACLE_M` in which
the true depth of three frames or more shows what stands 0.3 m to 1.4 m above the road.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from tqdm import tqdm

from bench.markdown import table
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.pipeline import process
from motionstereo_cli.robot.mapper import Floor, Mapper, camera_points
from motionstereo_cli.robot.points import in_world
from motionstereo_cli.simulate.drive import driven
from motionstereo_cli.simulate.drive_world import DriveWorld, Shot
from motionstereo_cli.simulate.scenes import render_scene
from motionstereo_cli.simulate.settings import ROBOT_RADIUS_M, DriveSettings, SimulateSettings
from motionstereo_cli.simulate.walkers import RADIUS_M
from motionstereo_cli.sinks.settings import OutputSettings
from motionstereo_cli.types import StereoFrame

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Places = NDArray[np.float64]

SETTINGS = Settings(robot_radius_m=ROBOT_RADIUS_M)

NEAR_M = 0.25
VIEW_M = 5.0
STRETCH_M = 0.1
OBSTACLE_M = 0.2


@dataclass(frozen=True, slots=True)
class MapScore:
    """How true a map is.

    Attributes:
        ended: why the drive ended.
        laps: rounds driven.
        occupied: number of occupied cells.
        true_cells: share of them within NEAR_M of a wall or walker.
        wall_cells: share of them within NEAR_M of a wall.
        found_wall: share of the visible wall that was found.
        points: number of points.
        true_points: share of them, of those in the robot's way, within NEAR_M of a wall or walker.
    """

    ended: str
    laps: float
    occupied: int
    true_cells: float
    wall_cells: float
    found_wall: float
    points: int
    true_points: float


class _Watched(DriveWorld):
    """A world that notes which walls the robot saw, and where the walkers were.

    Attributes:
        seen: stretches of wall, by the cells of STRETCH_M that they lie in.
        walked: places of walkers' middles in m.
    """

    def __init__(self, settings: DriveSettings) -> None:
        self.seen: set[tuple[int, int]] = set()
        self.walked: list[tuple[float, float]] = []
        super().__init__(settings)

    def shot(self) -> Shot:
        shot = super().shot()
        rig, robot = self.settings.rig, self.robot
        ahead = rig.depth_m(shot.disparity_px[round(rig.cy)].astype(np.float64))
        right = (np.arange(rig.width) - rig.cx) * ahead / rig.focal_px
        near = np.hypot(ahead, right) <= VIEW_M
        leftward = rig.left_of_middle_m("right") - right[near]
        places = np.array([robot.x_m, robot.y_m]) + np.outer(ahead[near], robot.forward)
        places += np.outer(leftward, robot.left)
        on_wall = places[self.to_walls(places) < 0.01]  # the rest are walkers
        # Walls lie on edges of cells where the world's size is a multiple of theirs.
        cells = np.floor(on_wall / STRETCH_M + 1e-3).astype(int)
        self.seen.update(map(tuple, cells.tolist()))
        self.walked += [(walker.x_m, walker.y_m) for walker in self.walkers]
        return shot

    def to_walls(self, places: Places) -> Places:
        """Return the distance of places (n, 2) to the nearest wall, (n,) m."""
        halves = (self.corridor.inner_m, self.corridor.outer_m)
        one, other = (_to_square(places, half_m) for half_m in halves)
        return np.minimum(one, other)

    def to_anything(self, places: Places) -> Places:
        """Return the distance of places (n, 2) to the nearest wall or walker, (n,) m."""
        to_walkers = _to_nearest(places, np.array(self.walked).reshape(-1, 2)) - RADIUS_M
        return np.minimum(self.to_walls(places), to_walkers)


def score(settings: DriveSettings, cell_m: float) -> MapScore:
    """Return how true the map of a drive is."""
    world = _Watched(settings)
    mapper = Mapper(SETTINGS, settings.rig, cell_m)
    for _, step in driven(world, SETTINGS, with_map=True):
        assert step.points is not None
        assert step.pose is not None
        mapper.add(*step.points, step.pose)
        world.act_on(step.steering)
    floor = mapper.floor()
    cells = np.argwhere(floor.occupied).astype(np.float64) + 0.5
    occupied = cells * cell_m + (floor.x_m, floor.y_m)
    visible = (np.array(sorted(world.seen), np.float64).reshape(-1, 2) + 0.5) * STRETCH_M
    points_m, _ = mapper.points()
    assert mapper.known is not None
    low_m, high_m = mapper.known.heights_m
    in_way = points_m[(low_m < points_m[:, 2]) & (points_m[:, 2] < high_m), :2]
    return MapScore(
        ended=world.ended or "",
        laps=world.laps,
        occupied=len(occupied),
        true_cells=_share(world.to_anything(occupied) <= NEAR_M),
        wall_cells=_share(world.to_walls(occupied) <= NEAR_M),
        found_wall=_share(_to_nearest(visible, occupied) <= NEAR_M),
        points=len(points_m),
        true_points=_share(world.to_anything(in_way) <= NEAR_M),
    )


@dataclass(frozen=True, slots=True)
class StreetScore:
    """How true the map of a street is, as shares.

    Attributes:
        occupied, free: of the obstacles, those that it says are so.
        right: of the occupied cells, those within :data:`NEAR_M` of an obstacle.
        on_way: of the places of the rig, those that it says are occupied.
    """

    occupied: float
    free: float
    right: float
    on_way: float


def street_score(seed: int, cell_m: float, frames: int = 50) -> StreetScore:
    """Return how true the map of a street is; every other one winds."""
    settings = SimulateSettings(
        scene="street",
        frames=str(frames),
        width=480,
        height=240,
        seed=seed,
        noise_sigma=1.5,
        street_winding_deg=25.0 * (seed % 2),
    )
    rig, shots = settings.rig, list(render_scene(settings))
    mapper = Mapper(Settings(), rig, cell_m)
    seen = [
        StereoFrame(n, n, n / settings.frame_rate, shot.left, shot.right)
        for n, shot in enumerate(shots)
    ]
    obstacles: dict[tuple[int, int], int] = {}
    results = process(seen, None, rig, with_objects=False, extras=("depth_m",))
    for shot, result in zip(shots, results, strict=True):
        pose = shot.pose.rig_pose
        assert result.depth_m is not None
        found = camera_points(result.depth_m, shot.right, result.motion, "right", rig)
        mapper.add(*found, pose)
        depth_m = rig.depth_m(np.maximum(shot.disparity_px, 0.01)).astype(np.float32)
        true, _ = camera_points(depth_m, shot.right, depth_m < VIEW_M * 2, "right", rig)
        placed = in_world(
            true,
            camera_left_m=rig.left_of_middle_m("right"),
            place_m=(pose.x_m, pose.y_m, pose.z_m),
            quaternion=(pose.qx, pose.qy, pose.qz, pose.qw),
        )
        placed = placed[(placed[:, 2] > 0.3) & (placed[:, 2] < 1.4), :2]
        cells, points = np.unique(np.floor(placed / OBSTACLE_M), axis=0, return_counts=True)
        for cell in map(tuple, cells[points >= 6].astype(int).tolist()):
            obstacles[cell] = obstacles.get(cell, 0) + 1
    floor = mapper.floor()
    stands = np.array([cell for cell, count in obstacles.items() if count >= 3], np.float64)
    stands = (stands.reshape(-1, 2) + 0.5) * OBSTACLE_M
    way = np.array([(shot.pose.x_m, shot.pose.y_m) for shot in shots])
    occupied = (np.argwhere(floor.occupied).astype(np.float64) + 0.5) * floor.cell_m + (
        floor.x_m,
        floor.y_m,
    )
    return StreetScore(
        occupied=_share(_at(floor.occupied, floor, stands)),
        free=_share(_at(floor.free, floor, stands)),
        right=_share(_to_nearest(occupied, stands) <= NEAR_M),
        on_way=_share(_at(floor.occupied, floor, way)),
    )


def _at(cells: NDArray[np.bool_], floor: Floor, places: Places) -> NDArray[np.bool_]:
    """Return what cells of a floor plane say at places (n, 2), False outside of it."""
    index = np.floor((places - (floor.x_m, floor.y_m)) / floor.cell_m).astype(int)
    inside = ((index >= 0) & (index < cells.shape)).all(axis=1)
    found = np.zeros(len(places), np.bool_)
    found[inside] = cells[tuple(index[inside].T)]
    return found


def _share(which: NDArray[np.bool_]) -> float:
    return float(which.mean()) if len(which) else math.nan


def _to_square(places: Places, half_m: float) -> Places:
    """Return the distance of places (n, 2) to the outline of a square about the origin, (n,)."""
    off = np.abs(places) - half_m
    outside = np.hypot(*np.maximum(off, 0).T)
    distance: Places = np.abs(outside + np.minimum(off.max(axis=1), 0))
    return distance


def _to_nearest(places: Places, others: Places) -> Places:
    """Return the distance of places (n, 2) to the nearest of others (m, 2), (n,); inf if none."""
    if not len(places) or not len(others):
        return np.full(len(places), np.inf)
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    matches = matcher.match(places.astype(np.float32), others.astype(np.float32))
    return np.array([match.distance for match in matches], np.float64)


def summary(scores: dict[int, MapScore]) -> str:
    """Return the scores by seed as Markdown, and the mean and least of each share."""
    shares = ("true_cells", "wall_cells", "found_wall", "true_points")
    head = ["seed", "ended", "laps", "occupied cells", "at a wall or walker", "at a wall"]
    head += ["visible wall found", "points", "at a wall or walker"]
    lines: list[list[object]] = []
    for seed, one in scores.items():
        cells, wall, found, near = (f"{getattr(one, name):.3f}" for name in shares)
        laps = f"{one.laps:.2f}"
        lines.append([seed, one.ended, laps, one.occupied, cells, wall, found, one.points, near])
    for name, function in (("mean", np.mean), ("least", np.min)):
        cells, wall, found, near = (
            f"{function([getattr(one, share) for one in scores.values()]):.3f}" for share in shares
        )
        lines.append([name, "", "", "", cells, wall, found, "", near])
    return table(head, lines)


def main(args: Sequence[str] | None = None) -> None:
    """Drive, and print the table as Markdown on standard output."""
    parser = argparse.ArgumentParser(prog="python -m bench map")
    parser.add_argument("--seeds", type=int, default=10, help="how many worlds, from seed 0")
    parser.add_argument("--laps", type=float, default=1.0, help="rounds to drive in each")
    parser.add_argument("--walkers", type=int, default=0, help="walkers in each")
    parser.add_argument("--cell-m", type=float, default=OutputSettings().map_cell_m)
    parser.add_argument("--streets", action="store_true", help="streets in place of drives")
    given = parser.parse_args(args)
    if given.seeds < 1:
        parser.error("--seeds: give more than 0")
    if given.streets:
        shares = ("occupied", "free", "right", "on_way")
        lines: list[list[object]] = []
        for seed in tqdm(range(given.seeds), unit="street", disable=None):
            one = street_score(seed, max(given.cell_m, OBSTACLE_M))
            lines.append([seed, *(f"{getattr(one, share):.3f}" for share in shares)])
        print(table(["seed", "obstacles occupied", "free", "right", "occupied on the way"], lines))
        return
    scores = {
        seed: score(DriveSettings(seed=seed, laps=given.laps, walkers=given.walkers), given.cell_m)
        for seed in tqdm(range(given.seeds), unit="drive", disable=None)
    }
    print(summary(scores))
