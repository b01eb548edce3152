"""The heading of each frame.

What a guide takes from one frame, its *profile*, is a few numbers that follow from that frame
only. What it makes of one profile after the other is done in order: a guide's state is a value
that goes in and comes out.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

import numpy as np

from motionstereo_cli.robot.heading import (
    DIRECTIONS_RAD,
    MIN_KNOWN_SHARE,
    Course,
    free_distances,
    heading,
    nearest,
    plan,
    quantiles,
    steadied,
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
from motionstereo_cli.types import MovingObject, Pose, Rig, Steering

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.types import Real

#: An object is a contact if it would be at the camera within this time, with at least this
#: confidence. A robot keeps clear of where the first contact will be after each of these times.
CONTACT_S = 3.0
MIN_CONFIDENCE = 0.2
FORESEEN_S = (0.5, 1.0)

#: Standing objects are in the map already: a contact that matters moves over ground by itself.
#: Above the second speed it is a mistake. It is at most this wide.
CONTACT_MPS = (0.3, 2.5)
CONTACT_RADIUS_M = 0.5

#: A contact is a standing object if the map has more evidence than this within this distance of it:
#: the camera sees ever new parts of a wall that it passes, as if the wall moved along.
STANDS = 3.0
STANDS_WITHIN_M = 0.25

#: To steer by an image, this many of its rows are enough, and larger images take no longer.
STEERING_ROWS = 240

#: Bearings that a robot tells apart: less than a degree each for most lenses.
BEARINGS = 80

_Profile = TypeVar("_Profile")
_State = TypeVar("_State")


class Guide(Protocol, Generic[_Profile, _State]):
    """Steers frame by frame."""

    def profile(self, disparity_px: Real, fresh: NDArray[np.bool_]) -> _Profile:
        """Return what is taken from a frame.

        Args:
            disparity_px: (height, width) float32, NaN = unknown.
            fresh: where the disparity is of now and not of earlier frames, (height, width) bool.
        """

    def steer(
        self,
        state: _State | None,
        seen: _Profile,
        pose: Pose | None = None,
        objects: Iterable[MovingObject] = (),
    ) -> tuple[_State, Steering]:
        """Return what is known after a frame, and its heading.

        Args:
            state: what was known before; None at the first frame.
            seen: the profile of the frame.
            pose: where the rig is.
            objects: what moves; the first to arrive is kept clear of.
        """


def guide_of(settings: Settings, rig: Rig | None, *, with_poses: bool) -> Guide[Any, Any]:
    """Return the guide that uses all that is known of the rig."""
    if rig is None or not with_poses:
        return ImageGuide(settings, rig)
    return MapGuide(settings, rig)


def nearest_contact(objects: Iterable[MovingObject]) -> MovingObject | None:
    """Return the object that would be at the camera first; None where none would be soon."""
    first, first_s = None, CONTACT_S
    for each in objects:
        there_s = each.time_to_contact_s
        if there_s is not None and there_s < first_s and each.confidence >= MIN_CONFIDENCE:
            first, first_s = each, there_s
    return first


@dataclass(frozen=True, slots=True)
class ImageProfile:
    """What :class:`ImageGuide` takes from a frame.

    Attributes:
        strips_px: nearness of each vertical strip of the image, (strips,) float32, NaN = unknown.
        nearest_px: nearness of the nearest object; None where too little is known.
        width: width of the image in px.
    """

    strips_px: Real
    nearest_px: float | None
    width: int


@dataclass(frozen=True, slots=True)
class ImageHeading:
    """What :class:`ImageGuide` keeps from frame to frame.

    Attributes:
        place: the last heading across the image, 0 left .. 1 right; None before the first.
    """

    place: float | None


@dataclass(frozen=True, slots=True)
class ImageGuide:
    """Steers by one image at a time, toward where depth is largest.

    Args:
        settings: parameters of the guidance.
        rig: the camera, None if unknown.
    """

    settings: Settings
    rig: Rig | None

    def profile(self, disparity_px: Real, _: NDArray[np.bool_]) -> ImageProfile:
        """Return what is taken from a frame, see :meth:`Guide.profile`."""
        near = _thinned(disparity_px)
        near = self.rig.nearness_px(near) if self.rig else near
        width = near.shape[1]
        found = quantiles(near, min(self.settings.steer_strips, width), MIN_KNOWN_SHARE)
        nearest_px = float(found[-1])
        return ImageProfile(found[:-1], None if math.isnan(nearest_px) else nearest_px, width)

    def steer(
        self,
        state: ImageHeading | None,
        seen: ImageProfile,
        _: Pose | None = None,
        __: Iterable[MovingObject] = (),
    ) -> tuple[ImageHeading, Steering]:
        """Return the last heading and the steering, see :meth:`Guide.steer`."""
        strips, place = seen.strips_px, None if state is None else state.place
        target = heading(strips)
        if target is not None:
            place = steadied(place, target, self.settings.steer_gain)
        if place is None:
            return ImageHeading(None), _BLIND
        ahead_px = float(strips[min(int(place * len(strips)), len(strips) - 1)])
        return ImageHeading(place), Steering(
            status="held" if target is None else "ok",
            steer=1 - 2 * place,
            steer_rad=_angle_rad(place, seen.width, self.rig, self.settings.reference),
            depth_m=_depth_m(ahead_px, self.rig),
            nearest_m=_depth_m(seen.nearest_px, self.rig),
        )


@dataclass(frozen=True, slots=True)
class MapProfile:
    """What :class:`MapGuide` takes from a frame.

    Attributes:
        bearings_px: nearness of the nearest object in each bearing, (bearings,) float32, NaN =
            unknown; see :func:`~motionstereo_cli.robot.local_map.profile`.
        nearest_px: nearness of the nearest object; None where too little is known.
        width: width of the image in px.
    """

    bearings_px: Real
    nearest_px: float | None
    width: int


@dataclass(frozen=True, slots=True)
class MapCourse:
    """What :class:`MapGuide` keeps from frame to frame.

    Attributes:
        map: the surroundings.
        pose: where the rig was in the last frame.
        course: what the robot intends; None while nothing has been seen.
        place: the last heading across the image, 0 left .. 1 right; None before the first.
    """

    map: LocalMap
    pose: Pose
    course: Course | None = None
    place: float | None = None


@dataclass(frozen=True, slots=True)
class MapGuide:
    """Steers by a map of what was seen recently, around a rig whose poses are known.

    Args:
        settings: parameters of the guidance.
        rig: the camera.
    """

    settings: Settings
    rig: Rig

    def profile(self, disparity_px: Real, fresh: NDArray[np.bool_]) -> MapProfile:
        """Return what is taken from a frame, see :meth:`Guide.profile`."""
        s, near = self.settings, self.rig.nearness_px(disparity_px)
        width = near.shape[1]
        bearings_px = profile(
            near,
            fresh,
            view_of(self.rig, s.reference, (0.0, 0.0), 0.0),
            bearings=min(BEARINGS, width),
            below_m=s.robot_below_m,
            above_m=s.robot_above_m,
        )
        return MapProfile(bearings_px, nearest(_thinned(near), MIN_KNOWN_SHARE), width)

    def steer(
        self,
        state: MapCourse | None,
        seen_now: MapProfile,
        pose: Pose | None = None,
        objects: Iterable[MovingObject] = (),
    ) -> tuple[MapCourse, Steering]:
        """Return the map and the course after a frame, and the steering, see :meth:`Guide.steer`.

        ``pose`` has to be known.
        """
        assert pose is not None
        s, yaw = self.settings, pose.yaw_rad
        view = view_of(self.rig, s.reference, self.rig.camera_on_floor(pose, s.reference), yaw)
        new = bool(np.isfinite(seen_now.bearings_px).any())
        before = state or MapCourse(LocalMap.unknown(pose.x_m, pose.y_m), pose)
        known = seen(
            moved(before.map, pose.x_m, pose.y_m), seen_now.bearings_px, view, seen_now.width
        )
        if before.course is None and not new:
            return MapCourse(known, pose, None, before.place), _BLIND
        x_m, y_m = pose.x_m - before.pose.x_m, pose.y_m - before.pose.y_m
        course = before.course or Course(yaw, yaw)
        course = travelled(course, math.hypot(x_m, y_m), math.atan2(y_m, x_m))
        directions = yaw + DIRECTIONS_RAD
        known_m, possible_m = free_distances(
            (known.evidence > CERTAIN) | self._foreseen(nearest_contact(objects), known),
            known.evidence < -CERTAIN,
            (pose.x_m / CELL_M - known.corner[0], pose.y_m / CELL_M - known.corner[1]),
            directions,
            cell_m=CELL_M,
            radius_m=s.robot_radius_m,
        )
        turned = math.remainder(yaw - before.pose.yaw_rad, math.tau)
        course, free_m = plan(course, yaw, known_m, possible_m, directions, turned_rad=turned)
        angle_rad = math.remainder(course.heading_rad - yaw, math.tau)
        place = steadied(before.place, self._place_of(angle_rad, seen_now.width), s.steer_gain)
        return MapCourse(known, pose, course, place), Steering(
            status="ok" if new else "held",
            steer=1 - 2 * place,
            steer_rad=_angle_rad(place, seen_now.width, self.rig, s.reference),
            depth_m=free_m,
            nearest_m=_depth_m(seen_now.nearest_px, self.rig),
        )

    def _foreseen(self, contact: MovingObject | None, known: LocalMap) -> NDArray[np.bool_]:
        """Return the cells of the map where a contact will be."""
        cells = np.zeros(known.evidence.shape, np.bool_)
        if contact is None or contact.depth_m is None:
            return cells
        if contact.place_m is None or contact.velocity_mps is None:
            return cells
        m_per_px = contact.depth_m / self.rig.focal_px
        up_m = (self.rig.cy - contact.y - contact.height / 2) * (contact.depth_m / self.rig.fy_px)
        in_way = -self.settings.robot_below_m < up_m < self.settings.robot_above_m
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
        if abs(angle_rad) >= math.pi / 2:
            return 0.0 if angle_rad > 0 else 1.0
        cx_px = self.rig.cx_of(self.settings.reference)
        column = cx_px - self.rig.focal_px * math.tan(angle_rad)
        return min(max((column + 0.5) / width, 0.0), 1.0)


def view_of(rig: Rig, camera: str, place_m: tuple[float, float], yaw_rad: float) -> View:
    """Return the ``left`` or ``right`` camera on the floor plane, at a place and heading."""
    return View(
        x_m=place_m[0],
        y_m=place_m[1],
        yaw_rad=yaw_rad,
        focal_px=rig.focal_px,
        focal_y_px=rig.fy_px,
        cx_px=rig.cx_of(camera),
        cy_px=rig.cy,
        focal_baseline=rig.focal_baseline,
    )


_BLIND = Steering("blind", None, None, None, None)


def _thinned(near: Real) -> Real:
    return near[:: max(near.shape[0] // STEERING_ROWS, 1)]


def _angle_rad(place: float, width: int, rig: Rig | None, camera: str) -> float | None:
    if rig is None:
        return None
    column = place * width - 0.5  # of pixel centres
    return math.atan2(rig.cx_of(camera) - column, rig.focal_px)


def _depth_m(nearness_px: float | None, rig: Rig | None) -> float | None:
    if rig is None or nearness_px is None or not nearness_px > 0:
        return None
    return rig.focal_baseline / nearness_px
