"""Own motion, and what moves by itself: ``python -m bench own_motion``.

Streets and corridors are rendered and followed with nothing but the two views; the exact poses and
the exact masks of what moves by itself are known. So are, with ``--drives``, the views of a robot
that drives by the depth of ``motionstereo``, as in ``bench drive``, and, with ``--walkers``, those
of one that drives by true depth past six walkers.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from tqdm import tqdm

from bench.drive import SETTINGS, steered
from bench.markdown import table
from motionstereo_cli.evaluation.poses import PoseReport, compare, matrices
from motionstereo_cli.pipeline import process
from motionstereo_cli.robot.odometer import Odometer
from motionstereo_cli.simulate.drive import aimed, driven
from motionstereo_cli.simulate.drive_world import world_of
from motionstereo_cli.simulate.floor_plan import plan_names
from motionstereo_cli.simulate.scenes import render_scene
from motionstereo_cli.simulate.settings import DriveSettings, SimulateSettings
from motionstereo_cli.types import Pose, StereoFrame

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.simulate.scenes import SceneFrame
    from motionstereo_cli.types import FrameResult

#: Scenes, by the name in the table; those that are held out had no part in the choice of values.
SCENES: dict[str, dict[str, Any]] = {
    "held-out street 65": {"scene": "street", "seed": 65, "street_winding_deg": 25.0},
    "held-out street 66": {"scene": "street", "seed": 66},
    "held-out street 67": {"scene": "street", "seed": 67, "street_winding_deg": 15.0},
    "held-out street 68": {"scene": "street", "seed": 68, "street_winding_deg": 35.0},
    "held-out corridor": {"scene": "corridor", "seed": 65, "frames": "200:255"},
    "street": {"scene": "street", "seed": 8, "street_winding_deg": 25.0},
    "straight street": {"scene": "street", "seed": 3},
    "corridor": {"scene": "corridor", "seed": 1, "frames": "70:125"},
}
_USUAL: dict[str, Any] = {"width": 640, "height": 480, "frames": "28", "noise_sigma": 1.5}
#: A thing that moves by itself counts from this frame on where it shows so many px; large or small.
_FIRST_FRAME, _SMALL_PX, _LARGE_PX = 3, 150, 800
#: A row is a thing's where their boxes overlap by this share of the smaller one.
_MIN_OVERLAP = 0.3
#: A walker counts where it is wider and has walked for so many frames. No value was chosen on
#: drives of these seeds.
_WALKER_PX, _WALKS_FRAMES = 20, 3
WALKER_SEEDS = 91, 92, 93
#: A motion from frame to frame that is off by more is wrong.
_WRONG_M, _WRONG_DEG = 0.03, 1.0


@dataclass(slots=True)
class Score:
    """What was found.

    Attributes:
        large, small: things of :data:`_LARGE_PX` or more and of :data:`_SMALL_PX` or more, summed
            over the frames: found, and all.
        false: rows that are no thing's, a frame.
        speeds_off_mps: errors of the speed over ground of what was found.
        path: of the poses.
    """

    large: list[int]
    small: list[int]
    false: float
    path: PoseReport
    speeds_off_mps: list[float] = field(default_factory=list)


def measure(given: dict[str, Any], picture: Path | None = None) -> Score:
    """Follow a rendered scene, and score what was found; draw the frame with the largest object."""
    settings = SimulateSettings(**{**_USUAL, **given})
    score = Score([0, 0], [0, 0], 0.0, PoseReport(0, *[float("nan")] * 7))
    shots = list(render_scene(settings))
    frames = [
        StereoFrame(index, index, index / settings.frame_rate, shot.left, shot.right)
        for index, shot in enumerate(shots)
    ]
    poses, false, shown, largest = [], 0, None, -1
    for shot, result in zip(
        shots, process(frames, None, settings.rig, "auto", extras=()), strict=True
    ):
        assert result.pose is not None
        poses.append(result.pose)
        area = max((each.width * each.height for each in result.objects), default=0)
        if picture is not None and area > largest:
            shown, largest = result, area
        if result.frame.index >= _FIRST_FRAME:
            false += _scored(score, result, shot)
    score.false = false / max(len(shots) - _FIRST_FRAME, 1)
    score.path = compare(_matrices(poses), _matrices([shot.pose.rig_pose for shot in shots]))
    if picture is not None and shown is not None:
        cv2.imwrite(str(picture), drawn(shown))
    return score


@dataclass(slots=True)
class DriveScore:
    """What was found of the path of a drive.

    Attributes:
        frames: their number.
        lost: those that are said to be lost.
        wrong: motions that are wrong and not said to be lost.
        path: of all poses.
        known: of the same; its drift is over stretches without a lost frame.
    """

    frames: int
    lost: int
    wrong: int
    path: PoseReport
    known: PoseReport


def measure_drive(settings: DriveSettings) -> DriveScore:
    """Let the robot drive by exact poses, and find its path by its views alone."""
    world = world_of(settings)
    odometer = Odometer(world.settings.rig, SETTINGS.max_disparity)
    state = last = path = None
    found, true, lost = [], [], []
    for shot, step in driven(world, aimed(SETTINGS, world)):
        frame = shot.frame
        true.append(world.robot.rig_pose)
        state, motion = odometer.step(state, last, frame.right, frame.left, frame.index)
        path, pose, fix = odometer.follow(path, motion)
        found.append(pose)
        lost.append(fix.lost)
        last = frame.right, frame.left
        world.act_on(step.steering)
    mine, exact, unknown = _matrices(found), _matrices(true), np.array(lost)
    off = np.linalg.inv(np.linalg.inv(exact[:-1]) @ exact[1:]) @ (
        np.linalg.inv(mine[:-1]) @ mine[1:]
    )
    cos = (np.trace(off[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    wrong = np.linalg.norm(off[:, :3, 3], axis=1) > _WRONG_M
    wrong |= cos < np.cos(np.radians(_WRONG_DEG))
    return DriveScore(
        *(len(lost), int(unknown.sum()), int((wrong & ~unknown[1:]).sum())),
        *(compare(mine, exact), compare(mine, exact, unknown)),
    )


@dataclass(frozen=True, slots=True)
class WalkerScore:
    """What was found of walkers, summed over the frames.

    Attributes:
        frames: frames of the drive.
        walking: walkers that count.
        found: of these, those with a row.
        false: rows of no walker.
    """

    frames: int
    walking: int
    found: int
    false: int


def measure_walkers(seed: int, max_frames: int = 200) -> WalkerScore:
    """Let a robot drive past six walkers by true depth, and look for them by its views alone."""
    world = world_of(DriveSettings(seed=seed, walkers=6, laps=1.0, max_frames=max_frames))
    shots = []
    for shot, steering in steered(world, lambda shot: shot.disparity_px):
        shots.append(shot)
        world.act_on(steering)
    results = process([shot.frame for shot in shots], None, world.settings.rig, "auto", extras=())
    walking = found = false = 0
    walked: dict[int, int] = {}
    for shot, result in zip(shots, results, strict=True):
        boxes = [(o.x, o.y, o.x + o.width, o.y + o.height) for o in result.objects]
        mine = set[int]()
        seen, walked = walked, {}
        for true in shot.objects:
            thing = true.x, true.y, true.x + true.width, true.y + true.height
            rows = {n for n, box in enumerate(boxes) if _overlap(box, thing) > _MIN_OVERLAP}
            mine |= rows
            if not true.by_itself or true.width <= _WALKER_PX:
                continue
            walked[true.id] = seen.get(true.id, 0) + 1
            if walked[true.id] >= _WALKS_FRAMES:
                walking += 1
                found += bool(rows)
        false += len(boxes) - len(mine)
    return WalkerScore(len(shots), walking, found, false)


def drives(seeds: Sequence[int]) -> dict[str, list[DriveSettings]]:
    """Return drives by kind: a lap of a corridor with 0, 1 and 2 walkers, and the floor plans."""
    noise_sigma = _USUAL["noise_sigma"]
    kinds = {
        f"corridor, {walkers} walkers": [
            DriveSettings(seed=seed, laps=1.0, walkers=walkers, noise_sigma=noise_sigma)
            for seed in seeds
        ]
        for walkers in (0, 1, 2)
    }
    return kinds | {
        world: [DriveSettings(seed=seed, world=world, noise_sigma=noise_sigma) for seed in seeds]
        for world in plan_names()
    }


def _drives_table(seeds: Sequence[int]) -> str:
    """Return a row for each kind of drive, and the mean."""
    rows: list[list[object]] = []
    scores: list[DriveScore] = []
    for name, settings in tqdm(drives(seeds).items(), disable=None):
        mine = [measure_drive(each) for each in settings]
        rows.append([name, *_in_words(mine)])
        scores += mine
    head = ["drive", "frames", "lost", "wrong, not said", "drift, %", "deg/m"]
    return table([*head, "drift without lost frames, %"], [*rows, ["all", *_in_words(scores)]])


def _in_words(scores: Sequence[DriveScore]) -> list[object]:
    drift = mean([score.path.drift_percent for score in scores])
    turn = mean([score.path.drift_deg_per_m for score in scores])
    known = mean([score.known.drift_percent for score in scores])
    counts = [sum(getattr(each, name) for each in scores) for name in ("frames", "lost", "wrong")]
    return [*counts, f"{drift:.2f}", f"{turn:.2f}", f"{known:.2f}"]


def _walkers_table(seeds: Sequence[int]) -> str:
    """Return a row for each drive past walkers."""
    rows: list[list[object]] = []
    for seed in tqdm(seeds, disable=None):
        score = measure_walkers(seed)
        found = f"{score.found} of {score.walking}"
        rows.append([seed, score.frames, found, f"{score.false / score.frames:.3f}"])
    return table(["seed", "frames", "walkers found", "false rows a frame"], rows)


def mean(values: Sequence[float]) -> float:
    """Return the mean of the values that are known; NaN where none is."""
    known = [value for value in values if not math.isnan(value)]
    return sum(known) / len(known) if known else math.nan


def _matrices(poses: Sequence[Pose]) -> NDArray[np.float64]:
    rows = [[getattr(pose, name) for name in Pose.__slots__] for pose in poses]
    return matrices(np.array(rows))


def _scored(score: Score, result: FrameResult, shot: SceneFrame) -> int:
    """Add a frame to the score, and return how many of its rows are no thing's."""
    boxes = [(o.x, o.y, o.x + o.width, o.y + o.height) for o in result.objects]
    mine = set[int]()
    for true in shot.objects:
        thing = true.x, true.y, true.x + true.width, true.y + true.height
        shares = [_overlap(box, thing) for box in boxes]
        found = {index for index, share in enumerate(shares) if share > _MIN_OVERLAP}
        mine |= found
        shown_px = np.count_nonzero(shot.mover == true.id)
        if shown_px >= _SMALL_PX:
            counts = score.large if shown_px >= _LARGE_PX else score.small
            counts[0] += bool(found)
            counts[1] += 1
        if found and shown_px >= _SMALL_PX:
            speed_mps = result.objects[int(np.argmax(shares))].over_ground_mps
            if speed_mps is not None and true.over_ground_mps is not None:
                score.speeds_off_mps.append(abs(speed_mps - true.over_ground_mps))
    return len(boxes) - len(mine)


def _overlap(one: Sequence[int], other: Sequence[int]) -> float:
    """Return the common area of two boxes as a share of the smaller one."""
    wide = min(one[2], other[2]) - max(one[0], other[0])
    high = min(one[3], other[3]) - max(one[1], other[1])
    areas = [(box[2] - box[0]) * (box[3] - box[1]) for box in (one, other)]
    return max(wide, 0) * max(high, 0) / max(min(areas), 1)


def drawn(result: FrameResult) -> NDArray[np.uint8]:
    """Return view with objects, plain memory, and memory of what moves by itself, BGR."""
    assert result.own_charge is not None
    view, *memories = (
        cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
        for grey in (result.frame.right, result.charge, result.own_charge)
    )
    for each in result.objects:
        corner, end = (each.x, each.y), (each.x + each.width, each.y + each.height)
        cv2.rectangle(view, corner, end, (0, 220, 255), 2)
        if each.depth_m is not None and each.over_ground_mps is not None:
            text = f"{each.depth_m:.1f} m, {each.over_ground_mps:.1f} m/s"
            place = each.x, max(each.y - 6, 14)
            cv2.putText(view, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.55, (0, 220, 255), 2)
    gap = np.full((view.shape[0], 8, 3), 255, np.uint8)
    panels = [view, gap, memories[0], gap, memories[1]]
    picture: Any = cv2.resize(np.hstack(panels), None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)
    return np.asarray(picture, np.uint8)


def main(args: Sequence[str]) -> None:
    """Print a table, a row for each scene."""
    parser = argparse.ArgumentParser(prog="bench own_motion", description=__doc__)
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument(
        "--drives", nargs="*", type=int, metavar="SEED", help="drives of these seeds; none: 0"
    )
    parser.add_argument(
        "--walkers",
        nargs="*",
        type=int,
        metavar="SEED",
        help="drives past walkers, of these seeds; none: held-out ones",
    )
    parser.add_argument("--picture", type=Path, help="PNG file for a frame of the last scene")
    given = parser.parse_args(args)
    if given.drives is not None:
        print(_drives_table(given.drives or [0]))
        return
    if given.walkers is not None:
        print(_walkers_table(given.walkers or WALKER_SEEDS))
        return
    rows = []
    for name in tqdm(given.scenes, disable=None):
        picture = given.picture if name == given.scenes[-1] else None
        score = measure(SCENES[name], picture)
        rows.append(
            [
                name,
                f"{score.path.drift_percent:.2f}",
                f"{score.path.drift_deg_per_m:.4f}",
                "{} of {}".format(*score.large),
                "{} of {}".format(*score.small),
                f"{score.false:.2f}",
                f"{np.median(score.speeds_off_mps):.2f}" if score.speeds_off_mps else "-",
            ]
        )
    head = ["scene", "drift, %", "deg/m", "800 px and more", "150 to 800 px", "false rows a frame"]
    head.append("error of speed over ground, m/s")
    print(table(head, rows))
