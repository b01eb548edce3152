"""The stream: stereo frames in, results out. The only place with state in time.

In permanency mode the state before guidance is gone ceil((Chmax - Chmin) / D) frames later.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from motionstereo_cli.settings import Settings
from motionstereo_cli.stages.bands import band_table, bands, blur
from motionstereo_cli.stages.charge import accumulate, age, permanency
from motionstereo_cli.stages.cleaning import filled, without_speckles
from motionstereo_cli.stages.confidence import confidence
from motionstereo_cli.stages.depth import depth
from motionstereo_cli.stages.guidance import (
    DIRECTIONS_RAD,
    Course,
    free_ways,
    heading,
    nearest,
    plan,
    steadied,
    strip_nearness,
    travelled,
)
from motionstereo_cli.stages.local_map import CELL_M, CERTAIN, LocalMap, View, moved, profile, seen
from motionstereo_cli.stages.motion import motion
from motionstereo_cli.stages.regions import match_regions
from motionstereo_cli.stages.residual import residual
from motionstereo_cli.stages.trails import match_trails
from motionstereo_cli.stages.units import units
from motionstereo_cli.types import FrameResult, Pose, Rig, Steering, StereoFrame

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.types import Grey, Real, Units

#: Share of a strip of the image, or of all of it, below which its matches are taken for noise.
LEAST_KNOWN_SHARE = 0.002

#: Bearings that a robot tells apart: less than a degree each for most lenses.
BEARINGS = 80


def process(
    frames: Iterable[StereoFrame],
    settings: Settings | None = None,
    rig: Rig | None = None,
    pose_of: Callable[[StereoFrame], Pose] | None = None,
) -> Iterator[FrameResult]:
    """Yield the result of each stereo frame, in order.

    Args:
        frames: rectified stereo frames of one size.
        settings: parameters; the defaults if None.
        rig: the camera, for depth in m and steering angles; without one they are None.
        pose_of: tells where the rig was; asked once a frame, in order. With it and a rig, the
            guidance remembers what it has seen around it.
    """
    settings = settings or Settings()
    right, left = Memory(settings), Memory(settings)
    guide = Guide(settings, rig)
    for frame in frames:
        right.see(frame.right)
        left.see(frame.left)
        disparity, chance = match(right, left, settings)
        pose = None if pose_of is None else pose_of(frame)
        yield FrameResult(
            frame=frame,
            bands=right.bands,
            motion=right.moved,
            charge=right.charge,
            age_frames=right.age_frames,
            disparity_px=disparity,
            confidence=chance,
            depth_m=None
            if rig is None
            else depth(disparity, rig.focal_px, rig.baseline_m, rig.doffs),
            steering=guide.steer(disparity, right.moved, pose),
            charged=float(np.count_nonzero(right.charge > settings.charge_min)) / disparity.size,
            matched=float(np.count_nonzero(~np.isnan(disparity))) / disparity.size,
            pose=pose,
        )


def match(right: Memory, left: Memory, settings: Settings) -> tuple[Real, Real]:
    """Return disparity in px and confidence 0..1 of the right view, NaN = unknown.

    Both are (height, width) float32.
    """
    s, wanted = settings, right.units()
    if s.matcher == "regions":
        disparity = match_regions(wanted, left.units(), s.max_disparity)
        chance = np.full_like(disparity, np.nan)
    else:
        disparity, votes = match_trails(
            wanted,
            left.units(),
            s.max_disparity,
            block_px=(s.vote_rows, s.vote_columns),
            max_ratio=s.max_ratio,
            least_votes=s.least_votes,
        )
        differs = residual(disparity, right.grey, left.grey)
        disparity[differs > s.max_residual] = np.nan
        disparity = without_speckles(disparity, s.speckle_px)
        votes[np.isnan(disparity)] = differs[np.isnan(disparity)] = np.nan
        disparity = filled(disparity, wanted > 0, s.gap_px)
        chance = confidence(disparity, votes, differs, right.age_frames)
        disparity[chance < s.min_confidence] = np.nan
    disparity[right.age_frames > s.max_age] = np.nan
    chance[np.isnan(disparity)] = np.nan
    return disparity, chance


class Memory:
    """What one camera remembers: its last bands and the charge of each pixel."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._table = band_table(settings.bands, settings.grey_min, settings.grey_max)
        self.grey: Grey
        self._first = True
        self.bands: NDArray[np.uint8 | np.uint16]
        self.moved: NDArray[np.bool_]
        self.charge: Grey

    def see(self, grey: Grey) -> None:
        """Take in the next image; at the first, nothing has moved and all is at rest."""
        s = self._settings
        grey = blur(grey, s.blur_px)
        banded = bands(grey, self._table)
        if self._first:
            self._first = False
            self.moved = np.zeros(grey.shape, np.bool_)
            self.charge = np.full_like(grey, s.charge_min)
        else:
            self.moved = motion(banded, self.bands, grey, self.grey, s.least_jump)
            limits = {"charge_max": s.charge_max, "charge_min": s.charge_min}
            if s.charge_mode == "permanency":
                self.charge = permanency(self.charge, self.moved, leak=s.charge_leak, **limits)
            else:
                self.charge = accumulate(
                    self.charge, self.moved, gain=s.charge_gain, leak=s.charge_leak, **limits
                )
        self.grey, self.bands = grey, banded

    @property
    def age_frames(self) -> Grey:
        """Frames since something moved, (height, width) uint8, 255 = forgotten."""
        s = self._settings
        if s.charge_mode == "general":
            return np.where(self.charge > s.charge_min, np.uint8(0), np.uint8(255))
        limits = {"charge_max": s.charge_max, "charge_min": s.charge_min}
        return age(self.charge, leak=s.charge_leak, **limits)

    def units(self) -> Units:
        """Return what has to be equal for pixels to correspond, (height, width) uint16."""
        by_band = self._settings.match_on == "charge-band"
        return units(self.charge, self._settings.charge_min, self.bands if by_band else None)


class Guide:
    """Steers frame by frame.

    It remembers the last heading or, where it knows the rig and its poses, a map of its
    surroundings and a course through them.

    Args:
        settings: parameters of the guidance.
        rig: the camera, None if unknown.

    Attributes:
        map: the surroundings, None before the first pose.
    """

    def __init__(self, settings: Settings, rig: Rig | None) -> None:
        self._settings = settings
        self._rig = rig
        self._place: float | None = None  # the last heading across the image, 0 left .. 1 right
        self._pose: Pose | None = None
        self._course: Course | None = None
        self.map: LocalMap | None = None

    def steer(
        self, disparity_px: Real, fresh: NDArray[np.bool_], pose: Pose | None = None
    ) -> Steering:
        """Return the heading for a frame.

        Args:
            disparity_px: (height, width) float32, NaN = unknown.
            fresh: where the disparity is of now and not of earlier frames, (height, width) bool.
            pose: where the rig is; None where nobody knows.
        """
        near = disparity_px + np.float32(self._rig.doffs if self._rig else 0)
        if self._rig is None or pose is None:
            return self._steer_by_image(near)
        return self._steer_by_map(self._rig, near, fresh, pose)

    def _steer_by_image(self, near: Real) -> Steering:
        s = self._settings
        strips = strip_nearness(near, min(s.steer_strips, near.shape[1]), LEAST_KNOWN_SHARE)
        target = heading(strips)
        if target is not None:
            self._place = steadied(self._place, target, s.steer_gain)
        if self._place is None:
            return Steering("blind", None, None, None, None)
        ahead = float(strips[min(int(self._place * len(strips)), len(strips) - 1)])
        return Steering(
            status="held" if target is None else "ok",
            steer=1 - 2 * self._place,
            steer_rad=self._angle_rad(self._place, near.shape[1]),
            depth_m=self._depth_m(ahead),
            nearest_m=self._depth_m(nearest(near, LEAST_KNOWN_SHARE)),
        )

    def _steer_by_map(self, rig: Rig, near: Real, fresh: NDArray[np.bool_], pose: Pose) -> Steering:
        s, yaw = self._settings, pose.yaw_rad
        half_m = rig.baseline_m / 2
        view = View(
            x_m=pose.x_m + half_m * math.sin(yaw),  # the right camera
            y_m=pose.y_m - half_m * math.cos(yaw),
            yaw_rad=yaw,
            focal_px=rig.focal_px,
            cx_px=rig.cx + rig.doffs,
            cy_px=rig.cy,
            focal_baseline=rig.focal_px * rig.baseline_m,
        )
        near_px = profile(
            near,
            fresh,
            view,
            bearings=min(BEARINGS, near.shape[1]),
            below_m=s.robot_below_m,
            above_m=s.robot_above_m,
        )
        new = bool(np.isfinite(near_px).any())
        self.map = moved(self.map or LocalMap.unknown(pose.x_m, pose.y_m), pose.x_m, pose.y_m)
        self.map = seen(self.map, near_px, view, near.shape[1])
        before = self._pose or pose
        self._pose = pose
        if self._course is None and not new:
            return Steering("blind", None, None, None, None)
        course = self._course or Course(yaw, yaw)
        x_m, y_m = pose.x_m - before.x_m, pose.y_m - before.y_m
        course = travelled(course, math.hypot(x_m, y_m), math.atan2(y_m, x_m))
        directions = yaw + DIRECTIONS_RAD
        way_m, possible_m = free_ways(
            self.map.evidence > CERTAIN,
            self.map.evidence < -CERTAIN,
            (pose.x_m / CELL_M - self.map.corner[0], pose.y_m / CELL_M - self.map.corner[1]),
            directions,
            cell_m=CELL_M,
            radius_m=s.robot_radius_m,
        )
        turned = math.remainder(yaw - before.yaw_rad, math.tau)
        self._course, free_m = plan(course, yaw, way_m, possible_m, directions, turned_rad=turned)
        angle_rad = math.remainder(self._course.heading_rad - yaw, math.tau)
        self._place = steadied(self._place, self._place_of(angle_rad, near.shape[1]), s.steer_gain)
        return Steering(
            status="ok" if new else "held",
            steer=1 - 2 * self._place,
            steer_rad=self._angle_rad(self._place, near.shape[1]),
            depth_m=free_m,
            nearest_m=self._depth_m(nearest(near, LEAST_KNOWN_SHARE)),
        )

    def _place_of(self, angle_rad: float, width: int) -> float:
        """Return the place across the image of an angle, cut to what the image sees."""
        assert self._rig is not None
        if abs(angle_rad) >= math.pi / 2:
            return 0.0 if angle_rad > 0 else 1.0
        column = self._rig.cx + self._rig.doffs - self._rig.focal_px * math.tan(angle_rad)
        return min(max((column + 0.5) / width, 0.0), 1.0)

    def _angle_rad(self, place: float, width: int) -> float | None:
        if self._rig is None:
            return None
        column = place * width - 0.5  # of pixel centres
        return math.atan2(self._rig.cx + self._rig.doffs - column, self._rig.focal_px)

    def _depth_m(self, nearness_px: float | None) -> float | None:
        if self._rig is None or nearness_px is None or not nearness_px > 0:
            return None
        return self._rig.focal_px * self._rig.baseline_m / nearness_px
