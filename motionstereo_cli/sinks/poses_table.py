"""Poses in the formats of TUM and KITTI, and their quality."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from motionstereo_cli.rig.pose_forms import rotations
from motionstereo_cli.rig.poses import HEAD, NUMBERED_HEAD, OPTICAL_FROM_ROBOT, format_pose
from motionstereo_cli.sinks.writers import TableFile, TableMark, cell
from motionstereo_cli.types import Step

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.sinks.sink import RunContext
    from motionstereo_cli.types import Pose

ODOMETRY_HEADER = "frame,time_s,lost,sigma_m,sigma_rad,disparity_offset_px,agreeing"


def optical_matrix(pose: Pose, left_m: float) -> NDArray[np.float64]:
    """Return the matrix that takes places in a camera's optical frame to the world, (4, 4).

    Args:
        pose: where the rig is.
        left_m: how far left of its middle the camera sits.
    """
    turn = rotations(np.array([[pose.qx, pose.qy, pose.qz, pose.qw]]))[0]
    matrix = np.eye(4)
    matrix[:3, :3] = turn @ OPTICAL_FROM_ROBOT.T
    matrix[:3, 3] = (pose.x_m, pose.y_m, pose.z_m) + turn @ (0.0, left_m, 0.0)
    return matrix


class TumFile(TableFile):
    """Poses in the format of TUM: a line for each frame that has one.

    In place of times that a recording does not have are the places of the images in it, from 0.

    Args:
        path: final name.
        since: continue from this checkpoint of an earlier table.
    """

    def __init__(self, path: Path, since: TableMark | None = None) -> None:
        super().__init__(path, "", since)
        self._has_head = since is not None

    def write(self, step: Step) -> None:
        """Append the line of a frame."""
        time = step.time
        if not self._has_head:
            self.add([(NUMBERED_HEAD if time.time_s is None else HEAD).rstrip("\n")])
            self._has_head = True
        if step.place is not None:
            number = time.index if time.number is None else time.number
            words = format_pose(time.time_s or 0.0, step.place).rstrip("\n")
            if time.time_s is None:
                words = f"{number} {words.partition(' ')[2]}"
            self.add([words])


class KittiFile(TableFile):
    """Poses in the format of KITTI: a line for each frame, of NaN where no pose is given.

    Args:
        path: final name.
        baseline_m: distance between the cameras.
        since: continue from this checkpoint: one of the table, and the first pose.
    """

    def __init__(
        self,
        path: Path,
        baseline_m: float,
        since: tuple[TableMark, tuple[float, ...]] | None = None,
    ) -> None:
        super().__init__(path, "", None if since is None else since[0])
        self._to_left_m = baseline_m / 2
        self._first = None if since is None else np.reshape(since[1], (4, 4))

    def write(self, step: Step) -> None:
        """Append the line of a frame."""
        if step.pose is None:
            self.add([" ".join(["nan"] * 12)])
            return
        here = optical_matrix(step.pose, self._to_left_m)
        if self._first is None:
            self._first = here
        rows = (np.linalg.inv(self._first) @ here)[:3]
        self.add([" ".join(f"{value:z.9e}" for value in rows.ravel().tolist())])

    def checkpoint(self) -> tuple[TableMark, tuple[float, ...]]:  # type: ignore[override]
        """Make sure that all so far is on the disk."""
        first = np.eye(4) if self._first is None else self._first
        return super().checkpoint(), tuple(first.ravel().tolist())


class OdometryFile(TableFile):
    """The quality of poses that were found from the recording."""

    def write(self, step: Step) -> None:
        """Append the row of a frame."""
        fix, time = step.fix, step.time
        told = ("",) * 5
        if fix is not None:
            told = (
                str(int(fix.lost)),
                cell(fix.sigma_m, 4),
                cell(fix.sigma_rad, 5),
                cell(fix.disparity_offset_px, 3),
                cell(fix.agreeing, 2),
            )
        self.add([",".join((str(time.index), cell(time.time_s, 6), *told))])


def tum_file(path: Path, _: RunContext, since: TableMark | None = None) -> TumFile:
    """Return a sink for poses in the format of TUM."""
    return TumFile(path, since)


def kitti_file(
    path: Path, context: RunContext, since: tuple[TableMark, tuple[float, ...]] | None = None
) -> KittiFile:
    """Return a sink for poses in the format of KITTI."""
    assert context.rig is not None
    return KittiFile(path, context.rig.baseline_m, since)


def odometry_file(path: Path, _: RunContext, since: TableMark | None = None) -> OdometryFile:
    """Return a sink for the table on own motion."""
    return OdometryFile(path, ODOMETRY_HEADER, since)
