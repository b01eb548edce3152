"""Trajectories, read from files and written in the TUM format.

A pose is that of the robot frame (REP 103: x forward, y left, z up), whose origin is the point
halfway between the cameras, in a fixed world frame with z up.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.errors import InputError
from motionstereo_cli.rig.pose_forms import PoseTable, quaternions, read_pose_table, rotations
from motionstereo_cli.rig.settings import PoseSettings
from motionstereo_cli.types import FrameTime, Pose, StereoFrame

if TYPE_CHECKING:
    from motionstereo_cli.types import Rig

    Reals = NDArray[np.float64]

HEAD = "# time_s x_m y_m z_m qx qy qz qw (x forward, y left, z up)\n"
#: Of a recording without times: the place of an image in it, from 0.
NUMBERED_HEAD = HEAD.replace("time_s", "frame")

#: Tolerance of frames before the first pose or after the last, in s: containers round times.
_SLACK_S = 0.02

#: Tolerance of an estimated end of the recording, as a share, and in s.
_END_SHARE, _END_S = 0.02, 0.1

#: Excess of numbered poses over images that is accepted: containers estimate their number.
_END_IMAGES = 1

#: Poses that last longer than a recording by this, in s and as a share of it, may belong to another
#: one, unless their times are since 1970.
_LONGER_S, _LONGER_SHARE, _SINCE_1970_S = 1.0, 0.1, 1e8

#: Seconds in each unit of time.
_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}

#: Limits of plausible poses: the time between two in s, and the speed in m/s.
_MAX_INTERVAL_S, _MAX_SPEED_MPS = 1.0, 100.0

#: A step between poses of more than this many times the median is a gap, in which the rig is lost.
_MAX_GAP = 10
#: Share of a recording that poses have to cover, or they belong to another one.
_MIN_COVERED = 0.5

#: A robot is upright: the z component of its own up. It moves ahead: a larger share of its motion
#: upward is implausible, over at least this distance in m.
_MIN_UPRIGHT, _MOSTLY_UP, _FAR_UP_M = 0.3, 0.8, 0.5

#: Directions of the robot frame in the optical one: forward is z, left is -x, up is -y.
OPTICAL_FROM_ROBOT = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])

#: Directions of the optical frame in that of x forward, y right, z down.
_NED_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])

#: Directions of a world with z up in the worlds of poses that have another.
_WORLDS = {"optical": OPTICAL_FROM_ROBOT, "ned": np.diag([1.0, -1.0, -1.0])}


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses over time.

    Attributes:
        name: its file, for messages.
        time_s: (n,) float64, rising; numbers of frames where ``by_number``.
        poses: (n, 7) float64, a row each: x, y, z in m, qx, qy, qz, qw.
        by_number: poses belong to images by their numbers in the recording, from 0.
        settings: how the file is interpreted.
        notes: assumptions, one line each.
    """

    name: str
    time_s: Reals
    poses: Reals
    by_number: bool = False
    settings: PoseSettings = field(default_factory=PoseSettings)
    notes: tuple[str, ...] = ()

    def at(self, time_s: float) -> Pose | None:
        """Return the pose at a time, interpolated between the two around it.

        None where the rig is lost: in a gap, and after the last pose.

        Raises:
            InputError: the time is before the first pose.
        """
        first_s, last_s = float(self.time_s[0]), float(self.time_s[-1])
        if time_s < first_s - _SLACK_S:
            raise InputError(
                f"{self.name} has no pose for the frame at {self._shown(time_s)}: its poses cover "
                f"{self._shown(first_s, last_s)}, give those of this recording"
            )
        if time_s > last_s + _SLACK_S:
            return None
        after = int(np.searchsorted(self.time_s, time_s))
        if after == len(self.time_s) or after == 0 or self.time_s[after] == time_s:
            return Pose(*self.poses[min(after, len(self.time_s) - 1)].tolist())
        before_s, after_s = self.time_s[after - 1 : after + 1]
        share = (time_s - before_s) / (after_s - before_s)
        if self._are_gaps(np.array([after_s - before_s])).any():
            if min(time_s - before_s, after_s - time_s) > (0 if self.by_number else _SLACK_S):
                return None
            share = round(share)
        one, other = self.poses[after - 1 : after + 1].copy()
        if one[3:] @ other[3:] < 0:  # q and -q are the same turn: take the short way
            other[3:] *= -1
        mixed = one + share * (other - one)
        mixed[3:] /= np.linalg.norm(mixed[3:])
        return Pose(*mixed.tolist())

    def of(self, frame: StereoFrame | FrameTime) -> Pose | None:
        """Return the pose of a frame, None where the rig is lost.

        Raises:
            InputError: the frame has no time, or one before the first pose.
        """
        time = frame.time if isinstance(frame, StereoFrame) else frame
        if self.by_number:
            return self.at(time.place)
        if time.time_s is None:
            raise self._timeless()
        return self.at(time.time_s)

    def _are_gaps(self, steps: Reals) -> NDArray[np.bool_]:
        """Return which steps between two poses, (n,) in s or frames, are gaps."""
        found = steps > (_MAX_GAP if self.by_number else _MAX_INTERVAL_S)
        if found.any():  # a median for each frame would take long
            found &= steps > _MAX_GAP * np.median(np.diff(self.time_s))
        return found

    def check_covers(
        self,
        first: float | None,
        last: float | None,
        whole: float | None = None,
        begin: float | None = None,
    ) -> tuple[str, ...]:
        """Check that the poses cover a recording, before any of it is processed.

        Returns assumptions and possible mistakes, one line each.

        Args:
            first: time of the first frame in s (its number where ``by_number``); None where the
                recording has no time.
            last: approximate time of the last frame, None if unknown.
            whole: approximate end of the whole recording, beyond the last frame that is used;
                None if unknown. Poses that last longer may belong to another recording.
            begin: time of the first frame of the whole recording; None: it is ``first``.

        Raises:
            InputError: the recording begins before the poses, they cover less than half of it, the
                poses' unit of time is implausible, or they move too fast for a camera.
        """
        if first is None:
            raise self._timeless()
        start, end = float(self.time_s[0]), float(self.time_s[-1])
        if not self.by_number:
            self._check_unit(first, last)
        slack = 0.0 if self.by_number else _SLACK_S
        if not start - slack <= first <= end + slack:
            raise InputError(
                f"{self.name}: its poses cover {self._shown(start, end)}, but the recording "
                f"begins at {self._shown(first)}: give those of this recording"
                f"{self._advice(first, last)}"
            )
        ends = max(_END_S, _END_SHARE * ((last or first) - first)) if not self.by_number else 0.0
        more = () if whole is None else self._more(whole)
        if last is not None and last > end + ends:
            more += (
                f"{self.name}: its poses cover {self._shown(start, end)}, but the recording goes "
                f"on to about {self._shown(last)}: after them the rig is lost",
            )
        if last is not None and last > end + ends and end - first < _MIN_COVERED * (last - first):
            begin = first if begin is None else begin
            kept = f"{int(end) + 1}" if self.by_number else f"{max(end - begin, 0):.3f}s"
            raise InputError(
                f"{self.name}: its poses cover {self._shown(start, end)}, but the recording goes "
                f"on to about {self._shown(last)}: give poses for all of it, or --end {kept}"
            )
        return self.notes + more + self._gaps(first, end if last is None else last) + self._odd()

    def _more(self, whole: float) -> tuple[str, ...]:
        """Return a warning if there are more poses than images."""
        end, begin = float(self.time_s[-1]), float(self.time_s[0])
        if self.by_number:
            count, images = int(end) + 1, int(whole) + 1
            if count <= images + max(_END_IMAGES, _END_SHARE * images):
                return ()
            return (
                f"{self.name} has {count} poses for {images} images: the pose of number n is taken "
                "for image n. See that both begin together and that no image was left out; "
                "otherwise give the poses of these images",
            )
        # Two clocks that count from 1970 agree on what belongs together.
        longer_s = end - whole
        if begin > _SINCE_1970_S or longer_s <= max(_LONGER_S, _LONGER_SHARE * (whole - begin)):
            return ()
        return (
            f"{self.name} goes on for {longer_s:.1f} s after the recording ends: see that both "
            "begin together, as poses of a whole sequence do not fit a part of it; "
            "--pose-time-offset shifts them",
        )

    def _gaps(self, first: float, last: float) -> tuple[str, ...]:
        steps = np.diff(self.time_s)
        if not steps.size:
            return ()
        inside = (self.time_s[:-1] < last) & (self.time_s[1:] > first)
        found = np.flatnonzero(inside & self._are_gaps(steps))
        if not found.size:
            return ()
        longest = found[np.argmax(steps[found])]
        where = self._shown(*self.time_s[longest : longest + 2].tolist())
        return (
            f"{self.name} has {found.size} gap{'s' if found.size > 1 else ''}, the longest from "
            f"{where}: the rig is lost there",
        )

    def _odd(self) -> tuple[str, ...]:
        """Return a warning if the robot lies on its side, or moves up instead of ahead."""
        advice = (
            "if these are poses of a camera, give --pose-frame optical or optical-z-up; see also "
            "that qw is the last number of a line"
        )
        qx, qy = self.poses[:, 3], self.poses[:, 4]
        upright = float(np.median(1 - 2 * (qx**2 + qy**2)))  # z of the rig's own upwards
        if upright < _MIN_UPRIGHT:
            return (f"{self.name}: by these poses the rig is not upright: {advice}",)
        steps = np.abs(np.diff(self.poses[:, :3], axis=0)).sum(axis=0)
        if steps[2] > max(_MOSTLY_UP * float(np.linalg.norm(steps)), _FAR_UP_M):
            return (f"{self.name}: by these poses the rig moves up or down, not ahead: {advice}",)
        return ()

    def _check_unit(self, first_s: float, last_s: float | None) -> None:
        if len(self.time_s) < 2:
            return
        interval_s = float(np.median(np.diff(self.time_s)))
        span_s = float(self.time_s[-1] - self.time_s[0])
        steps_m = np.linalg.norm(np.diff(self.poses[:, :3], axis=0), axis=1)
        speed_mps = float(steps_m.sum()) / span_s
        if speed_mps > _MAX_SPEED_MPS:
            raise InputError(
                f"{self.name}: its poses move at {speed_mps:.4g} m/s: places have to be in m, and "
                "times in s or in what --pose-time-unit says"
            )
        recorded_s = (last_s - first_s) if last_s is not None else None
        if (
            self.settings.pose_time_unit != "auto"
            or interval_s <= _MAX_INTERVAL_S
            or not recorded_s
        ):
            return
        likely = min(_UNITS, key=lambda unit: abs(np.log(span_s * _UNITS[unit] / recorded_s)))
        if likely != "s":
            raise InputError(
                f"{self.name}: its poses go on for {span_s:.4g} s, one in {interval_s:.3g} s, at "
                f"{speed_mps:.2g} m/s, but the recording has {recorded_s:.4g} s: their times are "
                f"likely in {likely}: give --pose-time-unit {likely}, or s if that is right"
            )

    def _advice(self, first: float, last: float | None) -> str:
        """Return advice on a unit or offset that would cover the recording."""
        if self.by_number or self.settings.pose_time_unit != "auto":
            return "" if self.by_number else self._offset(first)
        for unit, factor in _UNITS.items():
            if self.time_s[0] * factor <= first and (last or first) <= self.time_s[-1] * factor:
                return f", or --pose-time-unit {unit}, which fits"
        return self._offset(first)

    def _offset(self, first: float) -> str:
        offset_s = first - float(self.time_s[0])
        both = f"{offset_s:.6f} if both begin together"
        return f", or --pose-time-offset if they have another clock ({both})"

    def _timeless(self) -> InputError:
        return InputError(
            f"{self.name} cannot be used: these recordings do not say when a frame was taken"
        )

    def _shown(self, *times: float) -> str:
        if self.by_number:
            return "frame " + " to ".join(f"{time:.0f}" for time in times)
        return " to ".join(f"{time:.3f}" for time in times) + " s"


def read_poses(
    path: str | Path,
    settings: PoseSettings | None = None,
    rig: Rig | None = None,
    body_from_left: Reals | None = None,
) -> Trajectory:
    """Read a trajectory in any of the forms of read_pose_table.

    Args:
        path: the file, as :func:`~motionstereo_cli.rig.pose_forms.read_pose_table` takes it.
        settings: how to interpret it; None: the defaults.
        rig: the camera, needed for poses of another frame than the robot's.
        body_from_left: (4, 4) m, takes points from the rectified left camera's optical frame to the
            frame of the body; needed for poses of the body.

    Raises:
        InputError: the file cannot be read, has no poses, or a line (which is named) is not a pose
            after the one before; or the frame of the poses is unknown.
    """
    s, table = settings or PoseSettings(), read_pose_table(path)
    unit = table.unit if s.pose_time_unit == "auto" else s.pose_time_unit
    time_s = table.times
    if unit != "frames" and (_UNITS[unit] != 1 or s.pose_time_offset):
        time_s = time_s * _UNITS[unit] + s.pose_time_offset
        if not (np.diff(time_s) > 0).all():
            raise InputError(f"{path}: its times are too close for {unit}: give --pose-time-unit")
    frame = table.frame if s.pose_frame == "auto" else s.pose_frame
    if frame is None:
        raise InputError(
            f"{path} has matrices and does not say what they are of: give --pose-frame optical "
            "(of the left camera, in a world of its axes), optical-z-up (in a world with z up, as "
            "KITTI-360's cam0_to_world.txt) or robot; KITTI-360's poses.txt is of its IMU and is "
            "not read"
        )
    if frame != "robot":
        places, turns = _of_robot(str(path), table, frame, rig, body_from_left)
    else:
        places, turns = table.places, table.turns
    return Trajectory(
        str(path),
        time_s,
        np.column_stack([places, turns]),
        by_number=unit == "frames",
        settings=s,
        notes=table.notes,
    )


def _of_robot(
    path: str, table: PoseTable, frame: str, rig: Rig | None, body_from_left: Reals | None
) -> tuple[Reals, Reals]:
    """Return positions (n, 3) and quaternions (n, 4) of the robot frame from another frame's."""
    if rig is None:
        raise InputError(f"{path} has poses of the {frame} frame, which need the rig: give --rig")
    turns, places = rotations(table.turns), table.places
    if frame == "body":
        if body_from_left is None:
            raise InputError(
                f"{path} has poses of a body, and the calibration does not say where the left "
                "camera sits in it (EuRoC's T_BS, kalibr's T_cam_imu): give that calibration to "
                "--rig, or --pose-frame"
            )
        places = places + turns @ body_from_left[:3, 3]
        turns = turns @ body_from_left[:3, :3]
    elif frame == "ned":
        turns = turns @ _NED_FROM_OPTICAL
    # The middle is half a baseline to the right of the left camera.
    places = places + turns @ np.array([rig.baseline_m / 2, 0, 0])
    turns = turns @ OPTICAL_FROM_ROBOT
    if frame in _WORLDS:
        world = _WORLDS[frame]
        places, turns = places @ world, world.T @ turns
    return places, quaternions(turns)


def format_pose(at: float | int, pose: Pose) -> str:
    """Return a pose as a line of the TUM format: time and place with 6 decimals, turn with 9.

    Args:
        at: time in s; or the number of the image, an int.
        pose: the pose.
    """
    when = str(at) if isinstance(at, int) else f"{at:.6f}"
    place = f"{pose.x_m:z.6f} {pose.y_m:z.6f} {pose.z_m:z.6f}"
    turn = f"{pose.qx:z.9f} {pose.qy:z.9f} {pose.qz:z.9f} {pose.qw:z.9f}"
    return f"{when} {place} {turn}\n"


def as_written(pose: Pose) -> Pose:
    """Return a pose after writing to a file and reading it back."""
    return Pose(*[float(text) for text in format_pose(0.0, pose).split()[1:]])
