"""Visual odometry: poses of the rig from its two videos alone."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from motionstereo_cli.rig.pose_forms import quaternions
from motionstereo_cli.rig.poses import OPTICAL_FROM_ROBOT
from motionstereo_cli.robot.alignment import Lens
from motionstereo_cli.robot.odometry import (
    Motion,
    Odometry,
    TravelledPath,
    ViewPair,
    setting_out,
    step,
    told,
    travelled,
)
from motionstereo_cli.types import Fix, Pose, Rig, StereoFrame

if TYPE_CHECKING:
    from collections.abc import Iterable

    from motionstereo_cli.types import Grey


@dataclass(frozen=True, slots=True)
class Odometer:
    """Finds the poses of the rig; the world is its robot frame at the first frame.

    Args:
        rig: the camera.
        max_disparity: largest disparity in px.
        offset_px: constant by which disparities are too small, as the left view shows it.
    """

    rig: Rig
    max_disparity: int
    offset_px: float = 0.0

    @property
    def lens(self) -> Lens:
        """The geometry of the rig."""
        rig = self.rig.with_disparity_offset(self.offset_px)
        focal_px = rig.focal_px, rig.fy_px
        return Lens(focal_px, rig.cx_of("right"), rig.cx, rig.cy, rig.baseline_m)

    def step(
        self,
        before: Odometry | None,
        last: tuple[Grey, Grey] | None,
        right: Grey,
        left: Grey,
        number: int,
        *,
        with_error: bool = False,
    ) -> tuple[Odometry, Motion | None]:
        """Return the state after a frame, and the motion; see :mod:`.odometry`.

        Args:
            before: the state before; None at the first frame.
            last: right and left view of the frame before; None at the first frame.
            right, left: the views.
            number: of the frame.
            with_error: find the motion with the constant error of disparity, which may be large.
        """
        return step(
            before,
            None if last is None else ViewPair(*last),
            ViewPair(right, left),
            *(number, self.lens, self.max_disparity),
            with_error=with_error,
        )

    def follow(
        self, path: TravelledPath | None, motion: Motion | None
    ) -> tuple[TravelledPath, Pose, Fix]:
        """Return the path after a frame, and the pose of the rig."""
        path = travelled(path or setting_out(), motion)
        turn = OPTICAL_FROM_ROBOT.T @ path.pose[:3, :3] @ OPTICAL_FROM_ROBOT
        middle = np.array([-self.rig.baseline_m / 2, 0.0, 0.0])
        place = path.pose[:3, :3] @ middle + path.pose[:3, 3] - middle
        pose = Pose(*(OPTICAL_FROM_ROBOT.T @ place).tolist(), *quaternions(turn[None])[0].tolist())
        variance = np.diag(path.covariance)
        return (
            path,
            pose,
            Fix(
                lost=path.lost > 0,
                sigma_m=math.sqrt(float(variance[:3].sum())),
                sigma_rad=math.sqrt(float(variance[3:].sum())),
                disparity_offset_px=self.offset_px + float(told(path.error_px)[0]),
                agreeing=0.0 if motion is None else motion.score,
            ),
        )


class OffsetFinder:
    """Finds the constant by which disparities are too small, from stretches of consecutive frames.

    What is far off has disparity 0 (less doffs), and how a thing moves through the image while the
    rig moves says how far off it is: where disparity contradicts both by a constant, the principal
    points are wrong, as by a small turn between the cameras.

    Args:
        odometer: the rig as it is believed to be.
    """

    def __init__(self, odometer: Odometer) -> None:
        self._odometer = odometer
        self._path = setting_out()
        self._state: Odometry | None = None
        self._last: tuple[Grey, Grey] | None = None
        self._number: int | None = None

    def see(self, frame: StereoFrame) -> None:
        """Take in a frame; a gap in their numbers begins the next stretch."""
        if self._number is None or frame.index != self._number + 1:
            self._state, self._last = None, None
        right, left = map(np.ascontiguousarray, (frame.right, frame.left))
        self._state, motion = self._odometer.step(
            *(self._state, self._last, right, left, frame.index), with_error=True
        )
        if motion is not None:  # the slopes of the error count as none: depth knows a constant only
            information, evidence = np.zeros((3, 3)), np.zeros(3)
            information[0, 0], evidence[0] = motion.information[0, 0], motion.evidence[0]
            motion = replace(motion, information=information, evidence=evidence)
        self._path = travelled(self._path, motion)
        self._last, self._number = (right, left), frame.index

    @property
    def offset_px(self) -> float:
        """The constant, 0 where none can be told."""
        return float(told(self._path.error_px)[0])

    def is_within(self, limit_px: float) -> bool:
        """Return whether the constant is certainly smaller, by three standard deviations."""
        variance = np.linalg.inv(self._path.information)[0, 0]
        return bool(abs(self._path.error_px[0]) + 3 * math.sqrt(variance) < limit_px)


def disparity_offset_px(
    frames: Iterable[StereoFrame], odometer: Odometer, negligible_px: float = 0.0
) -> float:
    """Return what an :class:`OffsetFinder` finds in some frames.

    Args:
        frames: stretches of consecutive frames.
        odometer: the rig as it is believed to be.
        negligible_px: no more frames are taken once the constant is certainly smaller than this.
    """
    finder = OffsetFinder(odometer)
    for frame in frames:
        finder.see(frame)
        if finder.is_within(negligible_px):
            break
    return finder.offset_px
