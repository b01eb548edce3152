"""A robot in a world, frame by frame: its views, its motion, and how its drive ends."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.records import builtins_of
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.rig.poses import as_written
from motionstereo_cli.simulate.camera import (
    EYE_HEIGHT_M,
    FloorPose,
    SceneCamera,
    View,
    stereo_cameras,
)
from motionstereo_cli.simulate.corridor import Corridor
from motionstereo_cli.simulate.floor_plan import prisms, read_plan
from motionstereo_cli.simulate.plan_scene import Outlines, PlanScene
from motionstereo_cli.simulate.scenes import exposed
from motionstereo_cli.simulate.settings import CORRIDOR, ROBOT_RADIUS_M, DriveSettings
from motionstereo_cli.simulate.truth import moving_objects
from motionstereo_cli.simulate.walkers import RADIUS_M, Walker, WalkerPaint, place_walkers, step
from motionstereo_cli.types import MovingObject, Pose, Steering, StereoFrame

if TYPE_CHECKING:
    from motionstereo_cli.types import Real

#: What an outline is of: a floor, what stands on it, or what hangs so low that the robot, though it
#: would pass under it, keeps clear of it.
Outline = Literal["free", "stands", "hangs"]

#: Frames a second, whose time stamps are whole milliseconds, as Matroska has them.
FRAME_RATE = 10
FRAME_MS = 1000 // FRAME_RATE

#: The robot: maximum distance and turn of one frame.
MAX_FORWARD_M = 0.16
MAX_TURN_RAD = math.radians(6)
#: A lap takes this many times as long as at full speed, because of the turns; longer with walkers.
_SLOWER = 1.25

#: Free distance at which it drives at full speed, and at which it stops.
_FULL_SPEED_M = 1.8
_STOP_M = 0.35
#: Errors of the yaw by drift, as a share of a turn, also come from the way ahead: rad per m.
_TURN_PER_M = 0.2
#: The robot's top; what is lower than the second, it drives over.
ROBOT_TOP_M = EYE_HEIGHT_M + 0.1
PASSED_OVER_M = 0.1
#: The guidance keeps clear of what hangs lower.
_KEPT_CLEAR_M = EYE_HEIGHT_M + Settings().robot_above_m
#: A goal is reached within this distance.
GOAL_M = 0.5
_REACHED = "goal reached"

#: Angle to its heading from which it only turns.
_TURN_ONLY_RAD = math.radians(22)
#: Share of the angle to its heading that it turns in a frame.
_TURN_GAIN = 0.5


class Shot(NamedTuple):
    """The views of the robot at one moment.

    Attributes:
        frame: the images, with the sensor's noise.
        disparity_px: (height, width) float32 true disparity of every pixel of the right view.
        pose: where the rig is.
        objects: what walks, as far as the right view shows it, with its true speed since the last
            frame.
    """

    frame: StereoFrame
    disparity_px: Real
    pose: Pose
    objects: tuple[MovingObject, ...] = ()


@dataclass(frozen=True, slots=True)
class Command:
    """The motion of the robot in a frame.

    Attributes:
        forward_m: how far forward.
        turn_rad: counter-clockwise.
    """

    forward_m: float
    turn_rad: float


def command(steering: Steering) -> Command:
    """Return the motion for a steering: turn to the heading, and slow down before obstacles.

    If the free distance is unknown it only turns, to the left if the heading is unknown, too.
    """
    if steering.steer_rad is None:
        return Command(0.0, MAX_TURN_RAD)
    turn_rad = max(-MAX_TURN_RAD, min(MAX_TURN_RAD, _TURN_GAIN * steering.steer_rad))
    if steering.depth_m is None:
        return Command(0.0, math.copysign(MAX_TURN_RAD, steering.steer_rad))
    share = (steering.depth_m - _STOP_M) / (_FULL_SPEED_M - _STOP_M)
    ahead = 1 - abs(steering.steer_rad) / _TURN_ONLY_RAD
    return Command(MAX_FORWARD_M * max(0.0, min(1.0, share)) * max(0.0, ahead), turn_rad)


class RobotWorld:
    """The robot and what stands and walks around it, until the drive ends.

    A touch of the robot's round outline with anything ends the drive. What there is around the
    robot is said by the kinds of worlds, which also set ``start`` before they call ``__init__``.

    Args:
        settings: the world.
        start: where the robot starts.
        max_frames: the drive ends after so many frames.
        speed: the robot's maximum distance of a frame, as a multiple of :data:`MAX_FORWARD_M`.
        latency_frames: after so many frames it does what it was told.
        drift: standard deviation of the errors of its own motion, as a share of each step.
        goal: place that it is to reach, (x, y) in m, where the drive ends; None: it explores.

    Attributes:
        goal: as given.
        robot: where the robot is now.
        path: where it has been, (x, y) in m.
        path_m: length of its path.
        nearest_pass_m: minimum distance of its outline to anything so far.
        ended: reason for the end; None during the drive.
    """

    walkers: Sequence[Walker] = ()
    _walkers_before: Sequence[Walker] = ()

    def __init__(
        self,
        settings: DriveSettings,
        start: FloorPose,
        max_frames: int,
        *,
        speed: float = 1.0,
        latency_frames: int = 0,
        drift: float = 0.0,
        goal: tuple[float, float] | None = None,
    ) -> None:
        self.settings = settings
        self.goal = goal
        self.robot = start
        self._max_frames = settings.max_frames or max_frames
        self._speed = speed
        self._waiting = deque([Command(0.0, 0.0)] * latency_frames)
        self._drift, self._off = drift, np.zeros(3)
        self._drift_rng = np.random.default_rng([settings.seed, 6])
        self._cameras = stereo_cameras(settings.rig)
        self.frames = 0
        self.path = [(self.robot.x_m, self.robot.y_m)]
        self.path_m = 0.0
        self.nearest_pass_m = math.inf
        self.ended: str | None = None
        self._judge()
        if goal is not None and self.ended == _REACHED:
            raise InputError(
                f"{settings.world}: the goal {goal[0]:g},{goal[1]:g} is within {GOAL_M:g} m of the "
                "start: give one that is further away"
            )

    @property
    def laps(self) -> float:
        """Rounds so far, where the world is one to go round in."""
        return 0.0

    @property
    def lap_m(self) -> float:
        """Length of a round; 0 where there is none."""
        return 0.0

    @property
    def expected_frames(self) -> int:
        """Estimated number of frames."""
        return self._max_frames

    @property
    def described(self) -> dict[str, Any]:
        """What the record says of the world, besides the settings."""
        raise NotImplementedError

    def outlines(self) -> Iterator[tuple[NDArray[np.float64], Outline]]:
        """Yield the outlines on the floor, (n, 2) in m each, and what they are of."""
        raise NotImplementedError

    def openings(self) -> Iterator[tuple[str, list[tuple[float, float]]]]:
        """Yield the kind, ``door`` or ``window``, and the two ends of each opening of a wall."""
        return iter(())

    def _render(self, camera: SceneCamera) -> View:
        """Return what a camera sees now."""
        raise NotImplementedError

    def _nearest(self) -> tuple[float, str]:
        """Return how far the robot's middle is from what is nearest, and what that is.

        The distance is negative inside of it.
        """
        raise NotImplementedError

    def _finished(self) -> str | None:
        """Return why the drive is over, although nothing was touched; None if it goes on."""
        away_m = self.to_goal_m
        return _REACHED if away_m is not None and away_m <= GOAL_M else None

    @property
    def to_goal_m(self) -> float | None:
        """The distance to the goal in m; None without one."""
        if self.goal is None:
            return None
        return math.hypot(self.robot.x_m - self.goal[0], self.robot.y_m - self.goal[1])

    def _went(self, before: FloorPose) -> None:
        """Take in that the robot has moved by a frame: what walks does so, too."""

    def shots(self) -> Iterator[Shot]:
        """Yield the views of the robot until the drive ends; call :meth:`act_on` after each."""
        while self.ended is None:
            yield self.shot()

    def shot(self) -> Shot:
        """Return the present views of the robot."""
        s, number = self.settings, self.frames
        left, right = map(self._render, self._cameras)
        pts = number * FRAME_MS
        frame = StereoFrame(
            index=number,
            pts=pts,
            time_s=pts / 1000,
            left=exposed(left.grey, s.noise_sigma, (s.seed, 3, number, 0)),
            right=exposed(right.grey, s.noise_sigma, (s.seed, 3, number, 1)),
        )
        objects: Iterator[MovingObject] = iter(())
        if right.mover is not None:
            objects = moving_objects(
                *(right.mover, right.depth_m, pts / 1000), self._pose_at, self._walkers_at
            )
        disparity_px = s.rig.disparity_px(right.depth_m)
        return Shot(frame, disparity_px, as_written(self.believed.rig_pose), tuple(objects))

    def _pose_at(self, time_s: float) -> FloorPose:
        """Return where the robot is if it goes on as in the last frame."""
        frames = time_s * FRAME_RATE - self.frames
        (x0, y0), (x1, y1) = self.path[-2:] if len(self.path) > 1 else self.path * 2
        return FloorPose(x1 + frames * (x1 - x0), y1 + frames * (y1 - y0), self.robot.yaw_rad)

    def _walkers_at(self, time_s: float) -> dict[int, tuple[float, float]]:
        """Return where the walkers are, by their numbers, if they go on as in the last frame."""
        frames = time_s * FRAME_RATE - self.frames
        return {
            number: (
                now.x_m + frames * (now.x_m - then.x_m),
                now.y_m + frames * (now.y_m - then.y_m),
            )
            for number, (then, now) in enumerate(
                zip(self._walkers_before or self.walkers, self.walkers, strict=True), start=1
            )
        }

    def around_px(self) -> Real:
        """Return the true disparities of what is around the robot now, in four directions, (n,)."""
        s, at = self.settings, self.robot
        views = []
        for quarter in range(4):
            self.robot = FloorPose(at.x_m, at.y_m, at.yaw_rad + quarter * math.pi / 2)
            views.append(s.rig.disparity_px(self._render(self._cameras[1]).depth_m).ravel())
        self.robot = at
        return np.concatenate(views)

    @property
    def believed(self) -> FloorPose:
        """Where the robot is by its own motion, which drifts."""
        x_m, y_m, yaw_rad = np.array([self.robot.x_m, self.robot.y_m, self.robot.yaw_rad])
        off_x, off_y, off_rad = map(float, self._off)
        return FloorPose(float(x_m) + off_x, float(y_m) + off_y, float(yaw_rad) + off_rad)

    def act_on(self, steering: Steering) -> None:
        """Move the robot by :func:`command`, and what walks, by a frame."""
        self.act(command(steering))

    def act(self, move: Command) -> None:
        """Move the robot and what walks by a frame; the robot keeps to its bounds."""
        self._waiting.append(move)
        move = self._waiting.popleft()
        before = self.robot
        forward_m = self._speed * max(0.0, min(MAX_FORWARD_M, move.forward_m))
        turn_rad = max(-MAX_TURN_RAD, min(MAX_TURN_RAD, move.turn_rad))
        middle_rad = before.yaw_rad + turn_rad / 2
        self.robot = FloorPose(
            before.x_m + forward_m * math.cos(middle_rad),
            before.y_m + forward_m * math.sin(middle_rad),
            math.remainder(before.yaw_rad + turn_rad, math.tau),
        )
        if self._drift:
            step = np.array([forward_m, forward_m, abs(turn_rad) + _TURN_PER_M * forward_m])
            self._off = self._off + self._drift_rng.normal(0, self._drift, 3) * step
        self.frames += 1
        self.path_m += forward_m
        self.path.append((self.robot.x_m, self.robot.y_m))
        self._went(before)
        self._judge()

    def _judge(self) -> None:
        away_m, what = self._nearest()
        self.nearest_pass_m = min(self.nearest_pass_m, away_m - ROBOT_RADIUS_M)
        if away_m <= ROBOT_RADIUS_M:
            self.ended = f"touched {what}"
        elif (finished := self._finished()) is not None:
            self.ended = finished
        elif self.frames >= self._max_frames:
            self.ended = "out of frames"


class DriveWorld(RobotWorld):
    """A square corridor with walkers.

    Args:
        settings: the world.
        goal: as of the robot's world.

    Attributes:
        corridor: the corridor.
        walkers: the walkers as they are now.
        turned_rad: how far round the square's middle it has come, in the direction of its start.
    """

    def __init__(self, settings: DriveSettings, goal: tuple[float, float] | None = None) -> None:
        rng = np.random.default_rng([settings.seed, 2])
        width_m = settings.corridor_width_m or rng.uniform(2.0, 3.5)
        length_m = settings.corridor_length_m or rng.uniform(12, 18)
        self.corridor = Corridor(width_m, length_m, settings.seed, lamp_m=rng.uniform(7, 14))
        # The corridor's own length is that of the paper's path, which cuts the corners.
        middle_m = (self.corridor.outer_m + self.corridor.inner_m) / 2
        self._sense = int(rng.choice((-1, 1)))
        side_m = rng.uniform(-0.15, 0.15) * width_m
        yaw_rad = (0 if self._sense > 0 else math.pi) + rng.uniform(-0.15, 0.15)
        start = FloorPose(rng.uniform(-0.3, 0.3) * middle_m, -middle_m + side_m, yaw_rad)
        self.walkers: list[Walker] = place_walkers(
            settings.walkers, width_m, self.corridor.inner_m, start, rng
        )
        self._paint = WalkerPaint(settings.walkers, rng)
        self.turned_rad = 0.0
        laps_m = 8 * middle_m * settings.laps
        super().__init__(settings, start, math.ceil(3 * laps_m / MAX_FORWARD_M), goal=goal)

    @property
    def lap_m(self) -> float:
        """Length of the corridor's middle line."""
        return 4 * (self.corridor.outer_m + self.corridor.inner_m)

    @property
    def expected_frames(self) -> int:
        """Estimated number of frames."""
        frames = math.ceil(_SLOWER * self.settings.laps * self.lap_m / MAX_FORWARD_M)
        return min(frames, self.settings.max_frames or frames)

    @property
    def laps(self) -> float:
        """Rounds so far."""
        return self.turned_rad / math.tau

    @property
    def described(self) -> dict[str, Any]:
        """Width and length of the corridor, and its light."""
        return {
            "corridor_width_m": round(self.corridor.width_m, 3),
            "corridor_length_m": round(self.lap_m / 4, 3),
            "lamp_m": round(self.corridor.lamp_m, 3),
        }

    def outlines(self) -> Iterator[tuple[NDArray[np.float64], Outline]]:
        """Yield the outer and the inner square."""
        square = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]], float)
        yield self.corridor.outer_m * square, "free"
        yield self.corridor.inner_m * square, "stands"

    def openings(self) -> Iterator[tuple[str, list[tuple[float, float]]]]:
        """Yield doors and windows."""
        for each in self.corridor.openings:
            ends = self.corridor.along_wall(each.wall, (each.start_m, each.stop_m))
            yield each.kind, ends

    def _render(self, camera: SceneCamera) -> View:
        empty = self.corridor.render(self.robot, camera)
        return self._paint.render(empty, self.walkers, self.robot, camera, self.corridor.lamp_m)

    def _nearest(self) -> tuple[float, str]:
        x, y = self.robot.x_m, self.robot.y_m
        inner_m = self.corridor.inner_m
        to_inner = math.hypot(max(abs(x) - inner_m, 0), max(abs(y) - inner_m, 0))
        walls_m = min(self.corridor.outer_m - max(abs(x), abs(y)), to_inner)
        walkers_m = [walker.distance_m(x, y) - RADIUS_M for walker in self.walkers]
        if walkers_m and min(walkers_m) < walls_m:
            return min(walkers_m), "a walker"
        return walls_m, "a wall"

    def _finished(self) -> str | None:
        return "laps done" if self.laps >= self.settings.laps else super()._finished()

    def _went(self, before: FloorPose) -> None:
        self._walkers_before = self.walkers
        self.walkers = [
            step(
                walker,
                self.robot,
                robot_radius_m=ROBOT_RADIUS_M,
                inner_m=self.corridor.inner_m,
                outer_m=self.corridor.outer_m,
                frame_s=1 / FRAME_RATE,
            )
            for walker in self.walkers
        ]
        self.turned_rad += self._sense * _angle_between(before, self.robot)


def _angle_between(one: FloorPose, other: FloorPose) -> float:
    """Return the angle from one place to another about the square's middle."""
    angle_rad = math.atan2(other.y_m, other.x_m) - math.atan2(one.y_m, one.x_m)
    return math.remainder(angle_rad, math.tau)


class PlanWorld(RobotWorld):
    """A floor plan.

    Args:
        settings: the world; its ``world`` names the plan.
        goal: as of the robot's world; None: the plan's.

    Raises:
        InputError: the plan cannot be used.
        SettingsError: there is no such plan.
    """

    def __init__(self, settings: DriveSettings, goal: tuple[float, float] | None = None) -> None:
        self.plan = read_plan(settings.world)
        plan, robot = self.plan, self.plan.robot
        self._prisms = prisms(plan)
        (x0, y0), (x1, y1) = self._bounds_m
        places = {"robot.start": robot.start, "the goal": goal or robot.goal}
        for name, place in places.items():
            if place is not None and not (x0 < place[0] < x1 and y0 < place[1] < y1):
                raise InputError(
                    f"{settings.world}: {name} {place[0]:g},{place[1]:g} lies outside of all that "
                    f"stands: give x from {x0:g} to {x1:g} and y from {y0:g} to {y1:g}"
                )
        self._scene = PlanScene(self._prisms, plan.ceiling_m, settings.seed)
        in_way = [p for p in self._prisms if p.bottom_m < ROBOT_TOP_M and p.top_m > PASSED_OVER_M]
        self._outlines = Outlines(in_way) if in_way else None
        start = FloorPose(*robot.start, math.radians(robot.heading_deg))
        super().__init__(
            *(settings, start, robot.frames),
            speed=robot.speed_m_s / (MAX_FORWARD_M * FRAME_RATE),
            latency_frames=robot.latency_frames,
            drift=robot.drift,
            goal=goal or robot.goal,
        )
        if self.ended is not None and self.ended.startswith("touched"):
            what = self.ended.removeprefix("touched ")
            raise InputError(
                f"{settings.world}: robot.start: {what} is nearer than the robot's radius of "
                f"{ROBOT_RADIUS_M:g} m"
            )
        if self.goal is not None and self._outlines is not None:
            away_m, what = self._outlines.nearest(*self.goal)
            if away_m <= 0:
                raise InputError(
                    f"{settings.world}: the goal {self.goal[0]:g},{self.goal[1]:g} lies in {what}: "
                    "give one that the robot can reach"
                )

    @property
    def described(self) -> dict[str, Any]:
        """The plan."""
        return {"plan": builtins_of(self.plan)}

    @property
    def _bounds_m(self) -> NDArray[np.float64]:
        """The least and the largest x and y of what stands, (2, 2)."""
        corners = np.concatenate([prism.corners_m for prism in self._prisms])
        return np.array([corners.min(0), corners.max(0)])

    def outlines(self) -> Iterator[tuple[NDArray[np.float64], Outline]]:
        """Yield what stands and hangs, within a free rectangle."""
        (x0, y0), (x1, y1) = self._bounds_m
        yield np.array([[x0, y1], [x1, y1], [x1, y0], [x0, y0]]), "free"
        for prism in self._prisms:
            if prism.bottom_m < _KEPT_CLEAR_M:
                yield prism.corners_m, "stands" if prism.bottom_m < ROBOT_TOP_M else "hangs"

    def _render(self, camera: SceneCamera) -> View:
        return self._scene.render(self.robot, camera)

    def _nearest(self) -> tuple[float, str]:
        if self._outlines is None:
            return math.inf, ""
        return self._outlines.nearest(self.robot.x_m, self.robot.y_m)


def world_of(settings: DriveSettings, goal: tuple[float, float] | None = None) -> RobotWorld:
    """Return the world that settings name; the goal is its own if None."""
    world = DriveWorld if settings.world == CORRIDOR else PlanWorld
    return world(settings, goal)
