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

#: Columns of the quality of poses that are real numbers, and their decimals.
_QUALITY = {"sigma_m": 4, "sigma_rad": 5, "disparity_offset_px": 3, "agreeing": 2}
ODOMETRY_HEADER = ",".join(("frame", "time_s", "lost", *_QUALITY))


_UNKNOWN = " ".join(["nan"] * 12)


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

    def __init__(self, path: Path, _: RunContext, since: TableMark | None = None) -> None:
        super().__init__(path, "", since)
        self._has_head = since is not None

    def write(self, step: Step) -> None:
        """Append the line of a frame."""
        time = step.time
        if not self._has_head:
            self.add([(NUMBERED_HEAD if time.time_s is None else HEAD).rstrip("\n")])
            self._has_head = True
        if step.place is not None:
            at = time.place if time.time_s is None else time.time_s
            self.add([format_pose(at, step.place).rstrip("\n")])


#: What a Kitti file is continued from: its table, the number of its lines, and the first pose.
KittiMark = tuple[TableMark, int, tuple[float, ...]]


class KittiFile(TableFile):
    """Poses in the format of KITTI: a line for each image of the recording up to the last one.

    It is of NaN where the image is no frame of the run, or its pose is unknown.

    Args:
        path: final name.
        context: the run's; it has a rig.
        since: continue from this checkpoint of an earlier table.
    """

    def __init__(self, path: Path, context: RunContext, since: KittiMark | None = None) -> None:
        assert context.rig is not None
        super().__init__(path, "", None if since is None else since[0])
        self._to_left_m = context.rig.baseline_m / 2
        self._lines = 0 if since is None else since[1]
        self._first = np.reshape(since[2], (4, 4)) if since is not None and since[2] else None

    def write(self, step: Step) -> None:
        """Append the line of a frame."""
        number = step.time.place
        left_out = number if step.pose is not None else number + 1
        self.add(_UNKNOWN for _ in range(self._lines, left_out))
        self._lines = max(self._lines, number + 1)
        if step.pose is None:
            return
        here = optical_matrix(step.pose, self._to_left_m)
        if self._first is None:
            self._first = here
        rows = (np.linalg.inv(self._first) @ here)[:3]
        self.add([" ".join(f"{value:z.9e}" for value in rows.ravel().tolist())])

    def checkpoint(self) -> KittiMark:  # type: ignore[override]
        """Make sure that all so far is on the disk."""
        first = () if self._first is None else tuple(self._first.ravel().tolist())
        return super().checkpoint(), self._lines, first


class OdometryFile(TableFile):
    """The quality of poses that were found from the recording."""

    def __init__(self, path: Path, _: RunContext, since: TableMark | None = None) -> None:
        super().__init__(path, ODOMETRY_HEADER, since)

    def write(self, step: Step) -> None:
        """Append the row of a frame."""
        fix, time = step.fix, step.time
        told = [""] * (1 + len(_QUALITY))
        if fix is not None:
            real = (cell(getattr(fix, name), decimals) for name, decimals in _QUALITY.items())
            told = [str(int(fix.lost)), *real]
        self.add([",".join((str(time.index), cell(time.time_s, 6), *told))])
