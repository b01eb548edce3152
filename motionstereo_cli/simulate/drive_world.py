"""A robot in a corridor, frame by frame: its views, its motion, and how its drive ends."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from motionstereo_cli.rig.poses import as_written
from motionstereo_cli.simulate.camera import FloorPose, stereo_cameras
from motionstereo_cli.simulate.corridor import Corridor
from motionstereo_cli.simulate.scenes import exposed
from motionstereo_cli.simulate.settings import ROBOT_RADIUS_M, DriveSettings
from motionstereo_cli.simulate.walkers import RADIUS_M, WalkerPaint, place_walkers, step
from motionstereo_cli.types import Pose, Steering, StereoFrame

if TYPE_CHECKING:
    from motionstereo_cli.types import Real

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
    """

    frame: StereoFrame
    disparity_px: Real
    pose: Pose


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


class DriveWorld:
    """The corridor, the walkers and the robot, until the drive ends.

    A touch of the robot's round outline with a wall or a walker ends the drive.

    Args:
        settings: the world.

    Attributes:
        corridor: the corridor.
        walkers: the walkers as they are now.
        robot: where the robot is now.
        path: where it has been, (x, y) in m.
        turned_rad: how far round the square's middle it has come, in the direction of its start.
        path_m: length of its path.
        nearest_pass_m: minimum distance of its outline to a wall or walker so far.
        ended: reason for the end; None during the drive.
    """

    def __init__(self, settings: DriveSettings) -> None:
        self.settings = settings
        rng = np.random.default_rng([settings.seed, 2])
        width_m = settings.corridor_width_m or rng.uniform(2.0, 3.5)
        length_m = settings.corridor_length_m or rng.uniform(12, 18)
        self.corridor = Corridor(width_m, length_m, settings.seed, lamp_m=rng.uniform(7, 14))
        # The corridor's own length is that of the paper's path, which cuts the corners.
        middle_m = (self.corridor.outer_m + self.corridor.inner_m) / 2
        self.lap_m = 8 * middle_m
        self._sense = int(rng.choice((-1, 1)))
        side_m = rng.uniform(-0.15, 0.15) * width_m
        yaw_rad = (0 if self._sense > 0 else math.pi) + rng.uniform(-0.15, 0.15)
        self.robot = FloorPose(rng.uniform(-0.3, 0.3) * middle_m, -middle_m + side_m, yaw_rad)
        self.walkers = place_walkers(
            settings.walkers, width_m, self.corridor.inner_m, self.robot, rng
        )
        self._paint = WalkerPaint(settings.walkers, rng)
        self._cameras = stereo_cameras(settings.rig)
        self._max_frames = settings.max_frames or math.ceil(
            3 * settings.laps * self.lap_m / MAX_FORWARD_M
        )
        self.frames = 0
        self.path = [(self.robot.x_m, self.robot.y_m)]
        self.turned_rad = 0.0
        self.path_m = 0.0
        self.nearest_pass_m = math.inf
        self.ended: str | None = None
        self._judge()

    @property
    def expected_frames(self) -> int:
        """Estimated number of frames."""
        frames = math.ceil(_SLOWER * self.settings.laps * self.lap_m / MAX_FORWARD_M)
        return min(frames, self.settings.max_frames or frames)

    @property
    def laps(self) -> float:
        """Rounds so far."""
        return self.turned_rad / math.tau

    def shots(self) -> Iterator[Shot]:
        """Yield the views of the robot until the drive ends; call :meth:`act_on` after each."""
        while self.ended is None:
            yield self.shot()

    def shot(self) -> Shot:
        """Return the present views of the robot."""
        s, number = self.settings, self.frames
        left, right = (
            self._paint.render(
                self.corridor.render(self.robot, camera),
                self.walkers,
                self.robot,
                camera,
                self.corridor.lamp_m,
            )
            for camera in self._cameras
        )
        pts = number * FRAME_MS
        frame = StereoFrame(
            index=number,
            pts=pts,
            time_s=pts / 1000,
            left=exposed(left.grey, s.noise_sigma, (s.seed, 3, number, 0)),
            right=exposed(right.grey, s.noise_sigma, (s.seed, 3, number, 1)),
        )
        disparity_px = s.rig.disparity_px(right.depth_m)
        return Shot(frame, disparity_px, as_written(self.robot.rig_pose))

    def act_on(self, steering: Steering) -> None:
        """Move the robot by :func:`command`, and the walkers, by a frame."""
        self.act(command(steering))

    def act(self, move: Command) -> None:
        """Move the robot and the walkers by a frame; the robot keeps to its bounds."""
        before = self.robot
        forward_m = max(0.0, min(MAX_FORWARD_M, move.forward_m))
        turn_rad = max(-MAX_TURN_RAD, min(MAX_TURN_RAD, move.turn_rad))
        middle_rad = before.yaw_rad + turn_rad / 2
        self.robot = FloorPose(
            before.x_m + forward_m * math.cos(middle_rad),
            before.y_m + forward_m * math.sin(middle_rad),
            math.remainder(before.yaw_rad + turn_rad, math.tau),
        )
        inner_m, outer_m = self.corridor.inner_m, self.corridor.outer_m
        self.walkers = [
            step(
                walker,
                self.robot,
                robot_radius_m=ROBOT_RADIUS_M,
                inner_m=inner_m,
                outer_m=outer_m,
                frame_s=1 / FRAME_RATE,
            )
            for walker in self.walkers
        ]
        self.frames += 1
        self.path_m += forward_m
        self.path.append((self.robot.x_m, self.robot.y_m))
        self.turned_rad += self._sense * _angle_between(before, self.robot)
        self._judge()

    def _judge(self) -> None:
        walls_m = self._to_walls()
        walkers_m = min(
            (w.distance_m(self.robot.x_m, self.robot.y_m) - RADIUS_M for w in self.walkers),
            default=math.inf,
        )
        self.nearest_pass_m = min(self.nearest_pass_m, walls_m - ROBOT_RADIUS_M)
        self.nearest_pass_m = min(self.nearest_pass_m, walkers_m - ROBOT_RADIUS_M)
        if walls_m <= ROBOT_RADIUS_M:
            self.ended = "touched a wall"
        elif walkers_m <= ROBOT_RADIUS_M:
            self.ended = "touched a walker"
        elif self.laps >= self.settings.laps:
            self.ended = "laps done"
        elif self.frames >= self._max_frames:
            self.ended = "out of frames"

    def _to_walls(self) -> float:
        """Return how far the robot's middle is from the nearest wall; negative beyond it."""
        x, y = abs(self.robot.x_m), abs(self.robot.y_m)
        inner_m = self.corridor.inner_m
        to_inner = math.hypot(max(x - inner_m, 0), max(y - inner_m, 0))
        return min(self.corridor.outer_m - max(x, y), to_inner)


def _angle_between(one: FloorPose, other: FloorPose) -> float:
    """Return the angle from one place to another about the square's middle."""
    angle_rad = math.atan2(other.y_m, other.x_m) - math.atan2(one.y_m, one.x_m)
    return math.remainder(angle_rad, math.tau)
