"""Frames, rigs, poses and results."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Grey = NDArray[np.uint8]
    MatchKeys = NDArray[np.uint16]
    Real = NDArray[np.float32]

    #: A number, or an array of them.
    T = TypeVar("T", float, Real, NDArray[np.float64])


#: Called with a kind, ``note`` or ``warning``, and a line for people.
Say = Callable[[str, str], object]


@dataclass(frozen=True, slots=True)
class Rig:
    """A rectified stereo camera.

    Attributes:
        width, height: size of the images in px.
        focal_px: focal length, the same for both cameras, in px.
        baseline_m: distance between the cameras in m.
        cx, cy: principal point of the left camera in px; the right one's is (cx + doffs, cy).
        doffs: x of the right principal point minus x of the left one in px, so that
            depth = focal_px * baseline_m / (disparity + doffs), as Middlebury has it.
        focal_y_px: focal length along y, if different (pixels that are not square); None if equal.
    """

    width: int
    height: int
    focal_px: float
    baseline_m: float
    cx: float
    cy: float
    doffs: float = 0.0
    focal_y_px: float | None = None

    @property
    def fy_px(self) -> float:
        """Focal length along y in px."""
        return self.focal_px if self.focal_y_px is None else self.focal_y_px

    @property
    def focal_baseline(self) -> float:
        """Depth in m times nearness in px: focal_px * baseline_m."""
        return self.focal_px * self.baseline_m

    def nearness_px(self, disparity_px: T) -> T:
        """Return disparity + doffs in px, which is proportional to inverse depth.

        Takes and returns a number, or an array of float32 or float64.
        """
        return disparity_px + float(self.doffs)

    def depth_m(self, disparity_px: T) -> T:
        """Return depth in m: Z = focal_px * baseline_m / (disparity_px + doffs).

        Takes and returns a number, or an array of float32 or float64, where nearness is not 0.
        """
        return float(self.focal_baseline) / self.nearness_px(disparity_px)

    def disparity_px(self, depth_m: T) -> T:
        """Return the disparity in px at a depth in m, the inverse of :meth:`depth_m`."""
        return float(self.focal_baseline) / depth_m - float(self.doffs)

    def left_of_middle_m(self, camera: str) -> float:
        """Return how far left of the rig's middle the ``left`` or ``right`` camera is, in m."""
        return self.baseline_m / (-2 if camera == "right" else 2)

    def camera_on_floor(self, pose: Pose, camera: str) -> tuple[float, float]:
        """Return where the ``left`` or ``right`` camera is in the world, x and y in m."""
        to_left_m = self.left_of_middle_m(camera)
        return (
            pose.x_m - to_left_m * math.sin(pose.yaw_rad),
            pose.y_m + to_left_m * math.cos(pose.yaw_rad),
        )

    def cx_of(self, camera: str) -> float:
        """Return the x of the principal point of the ``left`` or ``right`` camera in px."""
        return self.cx + self.doffs if camera == "right" else self.cx

    def with_disparity_offset(self, offset_px: float) -> Rig:
        """Return the rig if its disparities are too small by a constant; the right camera stays."""
        return replace(self, cx=self.cx - offset_px, doffs=self.doffs + offset_px)


@dataclass(frozen=True, slots=True)
class Pose:
    """Position and orientation of the rig in the world.

    The rig stands for its robot frame: origin halfway between the cameras, x forward, y left, z up.

    Attributes:
        x_m, y_m, z_m: its position in m.
        qx, qy, qz, qw: unit quaternion that rotates directions of the robot frame to the world's.
    """

    x_m: float
    y_m: float
    z_m: float
    qx: float
    qy: float
    qz: float
    qw: float

    @property
    def yaw_rad(self) -> float:
        """Heading about the world's z axis, counter-clockwise from its x axis."""
        return math.atan2(
            2 * (self.qw * self.qz + self.qx * self.qy), 1 - 2 * (self.qy**2 + self.qz**2)
        )


@dataclass(frozen=True, slots=True)
class FrameTime:
    """Number and time of a frame.

    Attributes:
        index, pts, time_s, number: as in :class:`StereoFrame`.
    """

    index: int
    pts: int
    time_s: float | None
    number: int | None = None

    @property
    def clock_s(self) -> float:
        """Time in s, the number of the frame where the source has no times."""
        return float(self.index) if self.time_s is None else self.time_s

    @property
    def place(self) -> int:
        """Place of the image in its recording, from 0."""
        return self.index if self.number is None else self.number


@dataclass(frozen=True, slots=True)
class StereoFrame:
    """Two rectified images taken at one moment.

    Attributes:
        index: number of the pair in the stream, from 0.
        pts: presentation time stamp of the right frame in units of the source's time base; the
            index if the source has no times.
        time_s: the same in seconds, None if the source has no times.
        left, right: (height, width) uint8 grey levels 0..255; not to be written to.
        number: place of the right image in its recording, from 0, with missing ones counted where
            names of files tell; None if unknown.
        colours: (height, width, 3) uint8 RGB of the requested view; None without colour.
        disparity_px: what another program found in the view that results are of, (height, width)
            float32 px, NaN = unknown; None where it is to be matched.
    """

    index: int
    pts: int
    time_s: float | None
    left: Grey
    right: Grey
    number: int | None = None
    colours: NDArray[np.uint8] | None = None
    disparity_px: Real | None = None

    @property
    def time(self) -> FrameTime:
        """The frame without its images."""
        return FrameTime(self.index, self.pts, self.time_s, self.number)


@dataclass(frozen=True, slots=True)
class Steering:
    """The heading, and the free distance.

    Attributes:
        status: ``ok``; ``held`` (nothing new is seen, last heading kept); ``blind`` (nothing
            was seen yet).
        steer: heading as a share of half the image width, -1..1, positive = left.
        steer_rad: the same as an angle, positive = left (counter-clockwise, REP 103); None
            without a rig.
        depth_m: depth in the direction of the heading or, with poses, the free distance there; None
            without a rig or where unknown.
        nearest_m: depth of the nearest object; None without a rig or where unknown.
        risk_s: time until contact with the nearest thing in the way that is steered, which needs no
            rig; None where it does not come closer or would need over a minute, where the source
            has no time, and as long as it is unknown.
    """

    status: str
    steer: float | None
    steer_rad: float | None
    depth_m: float | None
    nearest_m: float | None
    risk_s: float | None = None


@dataclass(frozen=True, slots=True)
class MovingObject:
    """An object that moves, or that a moving camera passes, followed from frame to frame.

    Attributes:
        id: its number while it is followed, from 1.
        x, y, width, height: its box in px of the reference camera's view, upper left corner first.
        depth_m: median depth; None without a rig.
        closing_mps: rate at which its depth decreases in m/s, positive = approaching; with poses,
            turns of the camera do not count. None without a rig, without times, or while unknown.
        time_to_contact_s: depth_m / closing_mps, which needs no rig; None without times, if it
            does not approach or would need over a minute, or while unknown.
        confidence: of the object and its speed, 0..1.
        place_m: position in the world, x and y in m; None without a rig and poses.
        velocity_mps: velocity over ground, x and y in m/s; None without a rig and poses, without
            times, or while unknown.
        sigma_mps: standard deviation of the velocity; None without one.
        by_itself: whether it moves over ground, by more than its standard deviation explains;
            None if unknown.
        shadow: whether it is as deep as what lies beside it, as a shadow or a patch of light is;
            None if too little is known there.
    """

    id: int
    x: int
    y: int
    width: int
    height: int
    depth_m: float | None
    closing_mps: float | None
    time_to_contact_s: float | None
    confidence: float
    place_m: tuple[float, float] | None = None
    velocity_mps: tuple[float, float] | None = None
    sigma_mps: float | None = None
    by_itself: bool | None = None
    shadow: bool | None = None

    @property
    def over_ground_mps(self) -> float | None:
        """Speed over ground."""
        return None if self.velocity_mps is None else math.hypot(*self.velocity_mps)

    @property
    def direction_rad(self) -> float | None:
        """Direction of :attr:`velocity_mps`, counter-clockwise from the world's x axis."""
        if self.velocity_mps is None:
            return None
        return math.atan2(self.velocity_mps[1], self.velocity_mps[0])


@dataclass(frozen=True, slots=True)
class Fix:
    """Quality of a pose that was found from the videos.

    Attributes:
        lost: the motion of this frame is unknown, and the last one assumed to continue, or it is
            very uncertain.
        sigma_m, sigma_rad: standard deviation of position and orientation, of errors that frames
            do not share.
        disparity_offset_px: error of disparity at the left view's principal point, positive = too
            small; 0 if unknown.
        agreeing: share of the points whose grey agrees with the motion, 0..1; 0 if unknown.
    """

    lost: bool
    sigma_m: float
    sigma_rad: float
    disparity_offset_px: float
    agreeing: float


@dataclass(frozen=True, slots=True)
class FrameImages:
    """The images of one frame in the reference view; not to be written to.

    Attributes:
        time: which frame it is.
        view: (height, width) uint8, the reference camera's image.
        colours: the same in colour, (height, width, 3) uint8 RGB; None if it has none or no output
            needs it.
        charge, disparity_px: as in :class:`FrameResult`.
        bands, motion, age_frames, confidence, sigma_px, depth_m, occlusion, own_charge: as there;
            None if no output needs it.
    """

    time: FrameTime
    view: Grey
    charge: Grey
    disparity_px: Real
    bands: NDArray[np.uint8 | np.uint16] | None = None
    motion: NDArray[np.bool_] | None = None
    age_frames: Grey | None = None
    confidence: Real | None = None
    depth_m: Real | None = None
    occlusion: Grey | None = None
    own_charge: Grey | None = None
    sigma_px: Real | None = None
    colours: NDArray[np.uint8] | None = None

    @property
    def look(self) -> NDArray[np.uint8]:
        """The reference camera's image to look at: in colour if it has colours, else grey."""
        return self.view if self.colours is None else self.colours


@dataclass(frozen=True, slots=True)
class Step:
    """The sequential results of one frame.

    Attributes:
        time: which frame it is.
        steering: its heading.
        objects: what moves, once it was followed for a few frames.
        pose: pose of the rig; None if unknown.
        fix: quality of the pose, if it was found from the videos.
        charged, matched: shares of the image, 0..1, that carry charge and have a disparity.
        at_limit: share of the image, 0..1, whose best match was the last one of the range: unknown,
            and perhaps nearer.
        points: what moved, (n, 3) float64 m in the reference camera's optical frame, and its
            grey, (n,) uint8; None if no output needs it.
        images: the frame's images; None if no output needs them together with these numbers.
    """

    time: FrameTime
    steering: Steering
    objects: tuple[MovingObject, ...]
    pose: Pose | None
    charged: float
    matched: float
    points: tuple[NDArray[np.float64], Grey] | None = None
    images: FrameImages | None = None
    at_limit: float = 0.0
    fix: Fix | None = None

    @property
    def place(self) -> Pose | None:
        """The pose, None where the rig is lost, too."""
        return None if self.fix is not None and self.fix.lost else self.pose


@dataclass(frozen=True, slots=True)
class FrameResult:
    """All results of one stereo frame, in the reference camera's view.

    Attributes:
        frame: the input.
        bands: (height, width) uint8 (uint16 for 256 bands) grey-level bands 1..n.
        motion: (height, width) bool, where the band has just changed.
        charge: (height, width) uint8 permanency memory.
        age_frames: (height, width) uint8 frames since something moved there, 255 = forgotten; 0
            in the general mode, which does not know; None if not requested.
        disparity_px: (height, width) float32, NaN = unknown.
        confidence: (height, width) float32 chance 0..1 that the disparity is right within 1 px,
            NaN = unknown; all NaN for the regions matcher, which has none; None if not requested.
        sigma_px: (height, width) float32 standard deviation of the disparity, NaN = unknown; None
            if not requested.
        occlusion: (height, width) uint8, why the disparity is unknown, by the codes of
            :data:`~motionstereo_cli.method.settings.OCCLUSION`; None if not asked for.
        depth_m: (height, width) float32, NaN = unknown; None without a rig or if not requested.
        steering: heading for this frame.
        charged, matched: shares of the image, 0..1, that carry charge and have a disparity.
        state: the state after this frame, from which :func:`~motionstereo_cli.pipeline.process`
            continues.
        pose: pose of the rig; None if unknown.
        fix: quality of the pose, if it was found from the videos.
        own_charge: (height, width) uint8 permanency memory of what moves by itself, while the rig
            moves; None if own motion is not requested.
        objects: what moves, once it was followed for a few frames.
    """

    frame: StereoFrame
    bands: NDArray[np.uint8 | np.uint16]
    motion: NDArray[np.bool_]
    charge: Grey
    age_frames: Grey | None
    disparity_px: Real
    confidence: Real | None
    depth_m: Real | None
    steering: Steering
    charged: float
    matched: float
    occlusion: Grey | None = None
    sigma_px: Real | None = None
    state: Any = None
    pose: Pose | None = None
    objects: tuple[MovingObject, ...] = ()
    fix: Fix | None = None
    own_charge: Grey | None = None
