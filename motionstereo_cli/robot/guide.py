"""The heading of each frame, and the map it is taken from."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from motionstereo_cli.robot.heading import (
    DIRECTIONS_RAD,
    LEAST_KNOWN_SHARE,
    Course,
    free_ways,
    heading,
    nearest,
    plan,
    steadied,
    strip_nearness,
    travelled,
)
from motionstereo_cli.robot.local_map import (
    CELL_M,
    CERTAIN,
    LocalMap,
    View,
    disc,
    moved,
    profile,
    seen,
)
from motionstereo_cli.settings import Settings
from motionstereo_cli.types import (
    MovingObject,
    Pose,
    Rig,
    Steering,
    camera_place,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.types import Real

#: An object is a contact if it would be at the camera within this time, and is to be believed so
#: far. A robot keeps clear of where the first of them will be after each of these times.
CONTACT_S = 3.0
LEAST_TRUST = 0.2
FORESEEN_S = (0.5, 1.0)

#: What stands is in the map already: a contact that matters moves over ground by itself. Beyond
#: the second speed it is a mistake. It is at most so wide.
CONTACT_MPS = (0.3, 2.5)
CONTACT_RADIUS_M = 0.5

#: Where the map has had more evidence than this, so near to a contact, it stands all the same: of
#: a wall that the camera passes, ever new parts are seen, as if it moved along.
STANDS = 3.0
STANDS_WITHIN_M = 0.25

#: To steer by an image, so many of its rows are enough, and larger images take no longer.
STEERING_ROWS = 240

#: Bearings that a robot tells apart: less than a degree each for most lenses.
BEARINGS = 80


def _thinned(near: Real) -> Real:
    return near[:: max(near.shape[0] // STEERING_ROWS, 1)]


def nearest_contact(objects: Iterable[MovingObject]) -> MovingObject | None:
    """Return the object that would be at the camera first; None where none would be soon."""
    first, first_s = None, CONTACT_S
    for thing in objects:
        there_s = thing.time_to_contact_s
        if there_s is not None and there_s < first_s and thing.confidence >= LEAST_TRUST:
            first, first_s = thing, there_s
    return first


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
        self,
        disparity_px: Real,
        fresh: NDArray[np.bool_],
        pose: Pose | None = None,
        objects: Iterable[MovingObject] = (),
    ) -> Steering:
        """Return the heading for a frame.

        Args:
            disparity_px: (height, width) float32, NaN = unknown.
            fresh: where the disparity is of now and not of earlier frames, (height, width) bool.
            pose: where the rig is; None where nobody knows.
            objects: what moves; with poses, the first to arrive is kept clear of.
        """
        near = disparity_px + np.float32(self._rig.doffs if self._rig else 0)
        if self._rig is None or pose is None:
            return self._steer_by_image(near)
        return self._steer_by_map(self._rig, near, fresh, pose, nearest_contact(objects))

    def _steer_by_image(self, near: Real) -> Steering:
        s = self._settings
        near = _thinned(near)
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

    def _steer_by_map(
        self,
        rig: Rig,
        near: Real,
        fresh: NDArray[np.bool_],
        pose: Pose,
        contact: MovingObject | None,
    ) -> Steering:
        s, yaw = self._settings, pose.yaw_rad
        x_m, y_m = camera_place(rig, pose, s.reference)
        view = View(
            x_m=x_m,
            y_m=y_m,
            yaw_rad=yaw,
            focal_px=rig.focal_px,
            cx_px=rig.cx_of(s.reference),
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
            (self.map.evidence > CERTAIN) | self._foreseen(contact, rig, self.map),
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
            nearest_m=self._depth_m(nearest(_thinned(near), LEAST_KNOWN_SHARE)),
        )

    def _foreseen(
        self, contact: MovingObject | None, rig: Rig, known: LocalMap
    ) -> NDArray[np.bool_]:
        """Return the cells of the map where a contact will be."""
        cells = np.zeros(known.evidence.shape, np.bool_)
        if contact is None or contact.depth_m is None:
            return cells
        if contact.place_m is None or contact.velocity_mps is None:
            return cells
        m_per_px = contact.depth_m / rig.focal_px
        up_m = (rig.cy - contact.y - contact.height / 2) * m_per_px
        in_way = -self._settings.robot_below_m < up_m < self._settings.robot_above_m
        low_mps, high_mps = CONTACT_MPS
        if not (in_way and low_mps <= math.hypot(*contact.velocity_mps) <= high_mps):
            return cells
        radius_m = min(contact.width * m_per_px / 2, CONTACT_RADIUS_M)
        (x, y), (vx, vy) = contact.place_m, contact.velocity_mps
        if not (known.evidence[disc(known, x, y, STANDS_WITHIN_M)] > STANDS).any():
            for after_s in FORESEEN_S:
                cells |= disc(known, x + vx * after_s, y + vy * after_s, radius_m)
        return cells

    def _place_of(self, angle_rad: float, width: int) -> float:
        """Return the place across the image of an angle, cut to what the image sees."""
        assert self._rig is not None
        if abs(angle_rad) >= math.pi / 2:
            return 0.0 if angle_rad > 0 else 1.0
        cx_px = self._rig.cx_of(self._settings.reference)
        column = cx_px - self._rig.focal_px * math.tan(angle_rad)
        return min(max((column + 0.5) / width, 0.0), 1.0)

    def _angle_rad(self, place: float, width: int) -> float | None:
        if self._rig is None:
            return None
        column = place * width - 0.5  # of pixel centres
        cx_px = self._rig.cx_of(self._settings.reference)
        return math.atan2(cx_px - column, self._rig.focal_px)

    def _depth_m(self, nearness_px: float | None) -> float | None:
        if self._rig is None or nearness_px is None or not nearness_px > 0:
            return None
        return self._rig.focal_px * self._rig.baseline_m / nearness_px
