"""Where the rig was when: reading and writing trajectories in the TUM format.

A line is ``t x y z qx qy qz qw``: time in s, place in m, orientation as a unit quaternion. The pose
is that of the robot frame (REP 103: x forward, y left, z up), whose origin is the point halfway
between the cameras, in a fixed world frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.reading import MAX_TABLE_BYTES, read_text
from motionstereo_cli.types import Pose, StereoFrame

HEAD = "# time_s x_m y_m z_m qx qy qz qw (x forward, y left, z up)\n"

#: How far a frame may lie before the first pose or after the last: containers round their times.
_SLACK_S = 0.02

#: Numbers are smaller than this, so that differences of them stay finite.
_LARGEST = 1e100

#: How far the length of a quaternion may be from 1: files keep few decimals.
_LENGTH_ERROR = 0.01


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses over time.

    Attributes:
        name: what messages call it: its file.
        time_s: (n,) float64, rising.
        poses: (n, 7) float64, a row each: x, y, z in m, qx, qy, qz, qw.
    """

    name: str
    time_s: NDArray[np.float64]
    poses: NDArray[np.float64]

    def at(self, time_s: float) -> Pose:
        """Return the pose at a time, in a straight line between the two around it.

        Raises:
            InputError: the time lies outside the trajectory.
        """
        first_s, last_s = float(self.time_s[0]), float(self.time_s[-1])
        if not first_s - _SLACK_S <= time_s <= last_s + _SLACK_S:
            raise InputError(
                f"{self.name} has no pose for the frame at {time_s:.3f} s: its poses cover "
                f"{first_s:.3f} to {last_s:.3f} s, give those of this recording"
            )
        after = int(np.searchsorted(self.time_s, time_s))
        if after == len(self.time_s) or after == 0 or self.time_s[after] == time_s:
            return Pose(*self.poses[min(after, len(self.time_s) - 1)].tolist())
        before_s, after_s = self.time_s[after - 1 : after + 1]
        share = (time_s - before_s) / (after_s - before_s)
        one, other = self.poses[after - 1 : after + 1].copy()
        if one[3:] @ other[3:] < 0:  # q and -q are the same turn: take the short way
            other[3:] *= -1
        mixed = one + share * (other - one)
        mixed[3:] /= np.linalg.norm(mixed[3:])
        return Pose(*mixed.tolist())

    def of(self, frame: StereoFrame) -> Pose:
        """Return the pose of a stereo frame.

        Raises:
            InputError: the frame has no time, or one outside the trajectory.
        """
        if frame.time_s is None:
            raise InputError(
                f"{self.name} cannot be used: these recordings do not say when a frame was taken"
            )
        return self.at(frame.time_s)


def read_poses(path: str | Path) -> Trajectory:
    """Read a trajectory in the TUM format; empty lines and lines that begin with # are skipped.

    Raises:
        InputError: the file cannot be read, holds no pose, or a line (which is named) is not a
            pose that comes after the one before.
    """
    lines = read_text(path, "the poses", MAX_TABLE_BYTES).splitlines()
    rows: list[list[float]] = []
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        row = _row(line)
        if row is None:
            raise InputError(
                f"{path} line {number}: {line.strip()[:60]!r} is not a pose: "
                "give t x y z qx qy qz qw, in s and m and with a unit quaternion"
            )
        if rows and row[0] <= rows[-1][0]:
            raise InputError(
                f"{path} line {number}: time {row[0]:g} s does not come after {rows[-1][0]:g} s: "
                "sort the poses by time"
            )
        rows.append(row)
    if not rows:
        raise InputError(f"{path} has no poses: give lines of t x y z qx qy qz qw")
    table = np.array(rows)
    return Trajectory(str(path), table[:, 0], table[:, 1:])


def format_pose(time_s: float, pose: Pose) -> str:
    """Return a pose as a line of the TUM format: time and place with 6 decimals, turn with 9."""
    place = f"{pose.x_m:z.6f} {pose.y_m:z.6f} {pose.z_m:z.6f}"
    turn = f"{pose.qx:z.9f} {pose.qy:z.9f} {pose.qz:z.9f} {pose.qw:z.9f}"
    return f"{time_s:.6f} {place} {turn}\n"


def as_written(pose: Pose) -> Pose:
    """Return a pose as it comes back from a file."""
    return Pose(*[float(text) for text in format_pose(0.0, pose).split()[1:]])


def _row(line: str) -> list[float] | None:
    try:
        row = [float(text) for text in line.split()]
    except ValueError:
        return None
    if len(row) != 8 or not all(abs(number) < _LARGEST for number in row):
        return None
    return row if abs(math.hypot(*row[4:]) - 1) <= _LENGTH_ERROR else None
