"""A drive: a simulated robot steered by the pipeline, frame by frame."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from msgspec import UNSET, Struct, UnsetType

from motionstereo_cli import __version__
from motionstereo_cli.files.atomic import write_whole
from motionstereo_cli.files.encode import encode_png
from motionstereo_cli.files.lettering import fitted
from motionstereo_cli.files.video import VideoWriter
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.pipeline import StreamContext, steps
from motionstereo_cli.rig import write_rig
from motionstereo_cli.rig.poses import HEAD, format_pose
from motionstereo_cli.runs.folder import RunFolder
from motionstereo_cli.runs.folder_files import FolderKind
from motionstereo_cli.simulate.drive_plan import Plan, plan_sheet
from motionstereo_cli.simulate.drive_world import RobotWorld, Shot
from motionstereo_cli.simulate.settings import ROBOT_RADIUS_M
from motionstereo_cli.sinks.drawing import depth_picture, grey_picture
from motionstereo_cli.sinks.map import MapFiles
from motionstereo_cli.sinks.objects_table import HEADER, object_row
from motionstereo_cli.sinks.preview import framed, with_heading
from motionstereo_cli.sinks.records import Count, FolderRecord, Plain
from motionstereo_cli.sinks.scale import measured_ends
from motionstereo_cli.sinks.settings import OutputSettings
from motionstereo_cli.sinks.sink import RunContext
from motionstereo_cli.sinks.steering_table import SteeringFile
from motionstereo_cli.sinks.writers import TableFile
from motionstereo_cli.types import Pose, Step, StereoFrame

if TYPE_CHECKING:
    from numpy.typing import NDArray

#: Matroska counts whole milliseconds.
_TIME_BASE = Fraction(1, 1000)

#: Files of a drive; the record is the last.
RECORD, _VIEW = "drive.json", "drive.mp4"
OUTPUTS = (
    *("left.mkv", "right.mkv", "rig.yaml", "steering.csv", "poses.txt", "objects.csv", "plan.png"),
    *("map.ply", "map.png", "map.yaml", "map-sheet.png", _VIEW, RECORD),
)


class Collision(Struct, frozen=True):
    """Where the robot touched something, and what."""

    frame: Count
    x_m: float
    y_m: float
    what: str


class DriveRecord(FolderRecord, kw_only=True, frozen=True):
    """``drive.json``: lengths in m; ``laps``: rounds driven; ``ended``: why the drive ended."""

    version: str = ""
    settings: dict[str, Plain] | UnsetType = UNSET
    world: dict[str, Any] | UnsetType = UNSET
    ended: str | None = None
    frames: Count = 0
    laps: float = 0.0
    distance_m: float = 0.0
    lap_m: float = 0.0
    collisions: list[Collision] | UnsetType = UNSET
    nearest_pass_m: float = 0.0


_KIND = FolderKind(
    "motionstereo drive", RECORD, {name: (name,) for name in OUTPUTS}, kind=DriveRecord
)


def drive(
    out: Path,
    world: RobotWorld,
    settings: Settings | None = None,
    *,
    view: bool = False,
    overwrite: bool = False,
    inputs: Iterable[Path] = (),
    progress: Callable[[Step], object] = lambda _: None,
) -> DriveRecord:
    """Drive until the end, write the results, and return the record.

    Writes left.mkv and right.mkv (FFV1), rig.yaml, poses.txt (TUM), steering.csv as ``run`` does,
    objects.csv with the true boxes and speeds of the walkers, plan.png, map.ply, map.png, map.yaml,
    map-sheet.png, the record drive.json and, with ``view``, drive.mp4.
    ``run`` on the recordings with that rig and those poses gives the same steering.csv and map.

    On failure or interruption no file remains.

    Args:
        out: the folder, made if missing.
        world: the world at the start.
        settings: parameters of the processing; the defaults for this robot if None.
        view: write drive.mp4.
        overwrite: replace an earlier drive in ``out``; other files are never touched.
        inputs: files that must not be written to.
        progress: called after each frame, with its step; the robot has moved on then.

    Raises:
        OutputError: ``out`` is not empty, or cannot be written.
    """
    settings = aimed(settings or Settings(robot_radius_m=ROBOT_RADIUS_M), world)
    rig = world.settings.rig
    plan = Plan(world)
    context = RunContext(_TIME_BASE, settings, rig, colours(world) if view else OutputSettings())
    poses = [HEAD]
    outputs = [name for name in OUTPUTS if view or name != _VIEW]
    with RunFolder(out, outputs, _KIND, overwrite=overwrite, inputs=inputs) as folder:
        names = [name for name in ("left.mkv", "right.mkv", _VIEW) if name in outputs]
        videos = [folder.own(VideoWriter(out / name, _TIME_BASE)) for name in names]
        surroundings = MapFiles(out / "map.ply", context)
        folder.add("map", lambda _: surroundings)
        folder.add("steering", lambda _: SteeringFile(out / "steering.csv"))
        walkers = folder.own(TableFile(out / "objects.csv", HEADER))
        for shot, step in driven(world, settings, with_map=True):
            frame = shot.frame
            assert step.pose is not None
            poses.append(format_pose(frame.pts * float(_TIME_BASE), step.pose))
            folder.write(step)
            plan.add_walkers()
            walkers.add(object_row(frame.index, each) for each in shot.objects)
            images = [frame.left, frame.right]
            if view:
                picture = plan.draw(surroundings.mapper.floor())
                images.append(_view(step, picture, context))
            for video, image in zip(videos, images, strict=True):
                video.write(image, frame.pts)
            world.act_on(step.steering)
            progress(step)
        folder.close()
        write_rig(out / "rig.yaml", rig)
        write_whole(out / "poses.txt", "".join(poses).encode())
        picture = plan.draw(surroundings.mapper.floor())
        write_whole(
            out / "plan.png",
            encode_png(plan_sheet(picture, world)[..., ::-1]),
        )
        record = folder.complete(**_outcome(world, settings))
    assert isinstance(record, DriveRecord)
    return record


def colours(world: RobotWorld) -> OutputSettings:
    """Return the ends of the depth colours by the rule of ``run``, for what is around the start."""
    rig = world.settings.rig
    ends = measured_ends(rig.nearness_px(world.around_px()), rig.focal_baseline)
    return OutputSettings(near_m=ends[0], far_m=ends[1]) if ends else OutputSettings()


def aimed(settings: Settings, world: RobotWorld) -> Settings:
    """Return the settings with the world's goal, if it has one."""
    if world.goal is None:
        return settings
    return dataclasses.replace(settings, goal=",".join(map(repr, world.goal)))


def driven(
    world: RobotWorld, settings: Settings, *, with_map: bool = False
) -> Iterator[tuple[Shot, Step]]:
    """Yield each shot and its step; the caller moves the robot before the next.

    See :meth:`RobotWorld.act_on`. Steps have points for a map if it is asked for.
    """
    shot: Shot

    def frames() -> Iterator[StereoFrame]:
        nonlocal shot
        for shot in world.shots():
            yield shot.frame

    def pose_of(_: StereoFrame) -> Pose:
        return shot.pose

    stream = StreamContext.of(
        *(settings, world.settings.rig),
        with_poses=True,
        with_objects=False,
        poses_are_given=True,
        with_own_motion=with_map,
        with_movers=with_map,
        with_points=with_map,
        extras=("depth_m",),
    )
    return ((shot, step) for _, step, _ in steps(frames(), stream, pose_of))


def _outcome(world: RobotWorld, settings: Settings) -> dict[str, Any]:
    touched = (world.ended or "").startswith("touched")
    place = world.frames, world.robot.x_m, world.robot.y_m
    return {
        "version": __version__,
        "settings": dataclasses.asdict(settings),
        "world": {
            **dataclasses.asdict(world.settings),
            **world.described,
        },
        "ended": world.ended,
        "frames": world.frames,
        "laps": round(world.laps, 4),
        "distance_m": round(world.path_m, 3),
        "lap_m": round(world.lap_m, 3),
        "collisions": [Collision(*place, world.ended or "")] if touched else [],
        "nearest_pass_m": round(world.nearest_pass_m, 3),
    }


def _view(step: Step, plan: NDArray[np.uint8], context: RunContext) -> NDArray[np.uint8]:
    """Return reference image, memory, depth and the plan side by side, RGB."""
    images = step.images
    assert images is not None
    view = with_heading(fitted(grey_picture(images.view)), step.steering)
    height = len(view)
    width = 2 * math.ceil(plan.shape[1] * height / plan.shape[0] / 2)
    small = cv2.resize(plan, (width, height), interpolation=cv2.INTER_AREA)
    panels = [
        view,
        fitted(grey_picture(images.charge)),
        fitted(depth_picture(images, context)),
        np.asarray(small, np.uint8),
    ]
    reference = context.settings.reference.capitalize()
    titles = (f"{reference} view, heading", "Charge", "Depth", "Plan: path blue, seen black")
    return framed(panels, titles, step, context)
