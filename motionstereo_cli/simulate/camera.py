"""Pose and cameras of the rig, and the interface of a world.

World frame: x and y on the floor, z up, in m. Robot frame (REP 103): x forward, y left, z up; yaw
is counter-clockwise from the world's x axis. The cameras are level, :data:`EYE_HEIGHT_M` above the
floor, so an image column sees one vertical plane of the world. Pixel centres have whole
coordinates: column u covers u - 0.5 to u + 0.5.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.types import Pose

if TYPE_CHECKING:
    from motionstereo_cli.types import Grey, Real, Rig

#: Height of the optical centres above the floor.
EYE_HEIGHT_M = 1.2


@dataclass(frozen=True, slots=True)
class FloorPose:
    """Place and heading of the rig's middle, the point halfway between the cameras."""

    x_m: float
    y_m: float
    yaw_rad: float

    @property
    def forward(self) -> NDArray[np.float64]:
        """Unit vector ahead on the floor, (2,)."""
        return np.array([math.cos(self.yaw_rad), math.sin(self.yaw_rad)])

    @property
    def left(self) -> NDArray[np.float64]:
        """Unit vector to the left on the floor, (2,)."""
        return np.array([-math.sin(self.yaw_rad), math.cos(self.yaw_rad)])

    @property
    def words(self) -> str:
        """The same for people."""
        return f"x {self.x_m:.1f} m, y {self.y_m:.1f} m, facing {math.degrees(self.yaw_rad):.0f}°"

    @property
    def rig_pose(self) -> Pose:
        """The same in space."""
        half_rad = self.yaw_rad / 2
        turn = (0.0, 0.0, math.sin(half_rad), math.cos(half_rad))
        return Pose(self.x_m, self.y_m, EYE_HEIGHT_M, *turn)


@dataclass(frozen=True, slots=True)
class SceneCamera:
    """One pinhole camera of the rig.

    Attributes:
        width, height, focal_px, cx, cy: as in :class:`~motionstereo_cli.types.Rig`, in px.
        left_m: how far left of the rig's middle it sits, in m.
    """

    width: int
    height: int
    focal_px: float
    cx: float
    cy: float
    left_m: float

    def eye(self, pose: FloorPose) -> NDArray[np.float64]:
        """Return the optical centre's place on the floor, (2,), in m."""
        return np.array([pose.x_m, pose.y_m]) + self.left_m * pose.left

    def leftward(self, u_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far left per metre ahead the columns ``u_px`` look."""
        return (self.cx - u_px) / self.focal_px

    def upward(self, v_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far up per metre ahead the rows ``v_px`` look."""
        return (self.cy - v_px) / self.focal_px

    def rays(self, pose: FloorPose, u_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the floor directions (n, 2) of columns ``u_px`` (n,), one metre ahead long.

        A ray times a depth along the optical axis is a displacement in m.
        """
        return pose.forward + self.leftward(u_px)[:, None] * pose.left

    def project(self, pose: FloorPose, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the columns that see the floor points (n, 2) which lie ahead."""
        offset = points_m - self.eye(pose)
        ahead = offset @ pose.forward
        seen = ahead > 1e-6
        return self.cx - self.focal_px * (offset @ pose.left)[seen] / ahead[seen]


def stereo_cameras(rig: Rig) -> tuple[SceneCamera, SceneCamera]:
    """Return the left and the right camera of a rig whose principal points agree."""

    def camera(left_m: float) -> SceneCamera:
        return SceneCamera(rig.width, rig.height, rig.focal_px, rig.cx, rig.cy, left_m)

    return camera(rig.baseline_m / 2), camera(-rig.baseline_m / 2)


class View(NamedTuple):
    """The view of one camera, without noise.

    Attributes:
        grey: (height, width) float32 grey levels 0..255, averaged over each pixel's area.
        depth_m: (height, width) float32 depth along the optical axis at each pixel's centre.
        mover: (height, width) uint8 number of what moves by itself there, 0 = nothing; None where
            the scene does not say.
    """

    grey: Real
    depth_m: Real
    mover: Grey | None = None


class World(Protocol):
    """A scene that cameras can render."""

    def render(self, pose: FloorPose, camera: SceneCamera, time_s: float) -> View:
        """Return the view of ``camera`` from ``pose`` at ``time_s``."""
        ...
