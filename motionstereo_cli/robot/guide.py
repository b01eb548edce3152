"""The heading of each frame.

A guide takes from each frame a *profile*: a few numbers that depend on that frame only. From
profiles it computes headings in order; its state is a value that is passed in and returned.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.method.settings import Settings
from motionstereo_cli.robot.approach import Approach, nearest_in_way
from motionstereo_cli.robot.course import (
    ASKED_FRAMES,
    DIRECTIONS_RAD,
    TURN_FRAMES,
    Course,
    free_distances,
    plan,
    steadied,
    taken_along,
    travelled,
)
from motionstereo_cli.robot.free_space import (
    VEHICLE,
    FreeSpace,
    StripValues,
    find_ground,
    free_space,
    is_out_of_range,
    level_surface,
    nearest,
    way_ahead,
)
from motionstereo_cli.robot.grid import FloorView, cells_within
from motionstereo_cli.robot.local_map import (
    CELL_M,
    CELLS,
    CERTAIN,
    GOAL_HALF_LIFE_FRAMES,
    HALF_LIFE_FRAMES,
    ONE_HIT,
    Bearings,
    LocalMap,
    moved,
    profile,
    seen,
)
from motionstereo_cli.robot.route import toward
from motionstereo_cli.types import Pose, Rig, Steering

if TYPE_CHECKING:
    from motionstereo_cli.types import Real

#: Where somebody walks, what one frame sees is an obstacle up to this distance: it is elsewhere in
#: the next.
_NEAR_M = 1.2

#: Rows and columns of an image that are used for guidance: larger images take no longer.
STEERING_PX = 240

#: Disparities so close to the limit of the range are often wrong matches of what is nearer, such as
#: flecks of the road before a vehicle.
_LIMIT_PX = 1.5

#: Number of frames of which the median is used: a single deviating one is ignored.
TARGETS = 3

#: For so many frames in which no direction is better than another, the heading of before is held.
HELD_FRAMES = 30

#: A rig is far-sighted if an error of this many px makes less than this many m at the border of the
#: map: then the image tells of a way that the map has no room for, from the second length on, and
#: at a speed at which the robot would cross the map in that many frames.
_SIGHT_PX, _SIGHT_M = 0.5, 0.55
_OPEN_M, _OPEN_FRAMES = 8.0, 20
#: On such a way, share of the heading that goes on along the arc of the last piece of path, as long
#: as this, to a point so far ahead.
_TRAVEL_SHARE, _ARC_M, _ARC_AIM_M = 0.3, 1.5, 10.0
#: Poses that are kept for it.
_TRAIL = 16

#: Focal length over width of an unknown lens: a view of 60 degrees.
_FOCAL_PER_WIDTH = 0.87

#: Number of bearings: less than a degree each for most lenses.
BEARINGS = 80

_Profile = TypeVar("_Profile")
_State = TypeVar("_State")


class Guide(Protocol, Generic[_Profile, _State]):
    """Steers frame by frame."""

    def profile(self, disparity_px: Real, fresh: NDArray[np.bool_]) -> _Profile:
        """Return the profile of a frame.

        Args:
            disparity_px: (height, width) float32, NaN = unknown.
            fresh: where the disparity is of this frame, not of earlier ones, (height, width) bool.
        """

    def steer(
        self,
        state: _State | None,
        seen: _Profile,
        pose: Pose | None = None,
        time_s: float | None = None,
    ) -> tuple[_State | None, Steering]:
        """Return the state after a frame, and its heading.

        Args:
            state: the state before; None at the first frame.
            seen: the profile of the frame.
            pose: the pose of the rig; None where it is lost, or nothing is known of poses.
            time_s: when it was taken; None where the source has no time.
        """


def guide_of(settings: Settings, rig: Rig | None, *, with_poses: bool) -> Guide[Any, Any]:
    """Return the guide for a rig with or without poses."""
    if rig is None or not with_poses:
        return ImageGuide(settings, rig)
    return MapGuide(settings, rig)


@dataclass(frozen=True, slots=True)
class ImageProfile:
    """Profile of a frame for :class:`ImageGuide`.

    Attributes:
        space: what stands in each vertical strip of the image.
        nearest_px: nearness of the nearest object; None where too little is known.
        undecided: no direction is better than another: one surface fills the view, or what lies
            before the camera is nearer than the range.
    """

    space: FreeSpace
    nearest_px: float | None
    undecided: bool


@dataclass(frozen=True, slots=True)
class ImageHeading:
    """State of :class:`ImageGuide`.

    Attributes:
        place: the last heading across the image, 0 left .. 1 right; None before the first.
        targets: targets of the last frames, :data:`TARGETS` at most.
        approach: what was in the way in the last frames.
        undecided_frames: for how many frames no direction has been better than another.
    """

    place: float | None = None
    targets: tuple[float, ...] = ()
    approach: Approach = field(default_factory=Approach)
    undecided_frames: int = 0


@dataclass(frozen=True, slots=True)
class ImageGuide:
    """Steers by single images, along the longest free way.

    Args:
        settings: parameters of the guidance.
        rig: the camera, None if unknown.
    """

    settings: Settings
    rig: Rig | None

    def profile(self, disparity_px: Real, _: NDArray[np.bool_]) -> ImageProfile:
        """Return what is taken from a frame, see :meth:`Guide.profile`."""
        step = _thinning(disparity_px)
        near_px = disparity_px[:: step[0], :: step[1]]
        most_px = np.float32(self.settings.max_disparity - _LIMIT_PX)
        near_px = np.where(near_px < most_px, near_px, np.float32(np.nan))
        limit_px = float(most_px)
        if self.rig:
            near_px, limit_px = self.rig.nearness_px(near_px), self.rig.nearness_px(limit_px)
        near = StripValues.of(near_px, min(self.settings.steer_strips, near_px.shape[1]))
        middle_row = self.rig.cy if self.rig else (len(disparity_px) - 1) / 2
        ground = find_ground(near, middle_row / step[0], limit_px)
        row_px = step[0] * (self.rig.focal_px / self.rig.fy_px if self.rig else 1.0)
        space = free_space(near, ground, row_px=row_px, column_px=step[1])
        undecided = level_surface(near) is not None
        undecided |= ground is None and is_out_of_range(near, limit_px)
        return ImageProfile(space, nearest(near), undecided)

    def steer(
        self,
        state: ImageHeading | None,
        seen: ImageProfile,
        _: Pose | None = None,
        time_s: float | None = None,
    ) -> tuple[ImageHeading, Steering]:
        """Return the last heading and the steering, see :meth:`Guide.steer`."""
        return self.steer_from(state or ImageHeading(), seen, None, time_s)

    def steer_from(
        self,
        before: ImageHeading,
        seen: ImageProfile,
        travel: float | None,
        time_s: float | None,
    ) -> tuple[ImageHeading, Steering]:
        """Return the last heading and the steering.

        Args:
            before: the last heading.
            seen: the profile of the frame.
            travel: place across the image where the rig would come to if it went on as it does;
                None where that is not known.
            time_s: when the frame was taken; None where that is not known.
        """
        width = seen.space.width
        if self.rig is None:
            focal_px, cx_px = width * _FOCAL_PER_WIDTH, (width - 1) / 2
        else:
            focal_px, cx_px = self.rig.focal_px, self.rig.cx_of(self.settings.reference)
        target, strips_px = way_ahead(seen.space, focal_px, cx_px, before.place)
        if seen.undecided:
            target = None
            before = replace(before, undecided_frames=before.undecided_frames + 1)
            if before.undecided_frames >= HELD_FRAMES:
                before = replace(before, place=None, targets=())
        elif target is not None:
            if travel is not None:
                target += _TRAVEL_SHARE * (travel - target)
            targets = (*before.targets, target)[-TARGETS:]
            place = steadied(before.place, _median(targets), self.settings.steer_gain)
            before = replace(before, place=place, targets=targets, undecided_frames=0)
        if before.place is None:
            return before, _BLIND
        place = before.place
        near_px = nearest_in_way(seen.space.standing_px, place, width, self._half_way(seen.space))
        before = replace(before, approach=before.approach.after(time_s, place, near_px))
        ahead_px = float(strips_px[min(int(place * len(strips_px)), len(strips_px) - 1)])
        return before, Steering(
            status="held" if target is None else "ok",
            steer=1 - 2 * place,
            steer_rad=None
            if self.rig is None
            else _angle_rad(place, width, self.rig, self.settings.reference),
            depth_m=_depth_m(ahead_px, self.rig),
            nearest_m=_depth_m(seen.nearest_px, self.rig),
            risk_s=before.approach.contact_s,
        )

    def _half_way(self, space: FreeSpace) -> float:
        """Return half the width of the way, see :func:`.approach.nearest_in_way`."""
        if not math.isnan(space.slope):  # px of nearness a row: so many rows are a camera height
            return VEHICLE / 2 / space.slope
        return self.settings.robot_radius_m / self.rig.baseline_m if self.rig else 0.0


@dataclass(frozen=True, slots=True)
class MapProfile:
    """Profile of a frame for :class:`MapGuide`.

    Attributes:
        bearings: what stands nearest in each bearing.
        nearest_px: nearness of the nearest object; None where too little is known.
        size: width and height of the image in px.
        undecided: no direction is better than another.
        image: the same for :class:`ImageGuide`; None where the rig does not see beyond the map.
    """

    bearings: Bearings
    nearest_px: float | None
    size: tuple[int, int]
    undecided: bool
    image: ImageProfile | None


@dataclass(frozen=True, slots=True)
class MapCourse:
    """State of :class:`MapGuide`.

    Attributes:
        map: the surroundings.
        pose: pose of the rig in the last frame.
        course: the robot's course; None while nothing has been seen.
        place: the last heading across the image, 0 left .. 1 right; None before the first.
        approach: what was in the way in the last frames.
        image: what :class:`ImageGuide` keeps.
        trail: places and yaws of the last frames, (x, y, yaw) in m and rad.
        asked_rad: by which angles the rig was asked to turn in the last frames.
    """

    map: LocalMap
    pose: Pose
    course: Course | None = None
    place: float | None = None
    approach: Approach = field(default_factory=Approach)
    image: ImageHeading = field(default_factory=ImageHeading)
    trail: tuple[tuple[float, float, float], ...] = ()
    asked_rad: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class MapGuide:
    """Steers by a map of what was seen recently around a rig with known poses.

    Args:
        settings: parameters of the guidance.
        rig: the camera.
    """

    settings: Settings
    rig: Rig

    def profile(self, disparity_px: Real, fresh: NDArray[np.bool_]) -> MapProfile:
        """Return what is taken from a frame, see :meth:`Guide.profile`."""
        s, (height, width) = self.settings, disparity_px.shape
        step = _thinning(disparity_px)
        thin = np.ascontiguousarray(disparity_px[:: step[0], :: step[1]])
        thin = self.rig.nearness_px(thin)
        view = view_of(self.rig, s.reference, (0.0, 0.0), 0.0)
        bearings = profile(
            thin,
            fresh[:: step[0], :: step[1]],
            replace(view, cy_px=view.cy_px / step[0], focal_y_px=view.focal_y_px / step[0]),
            bearings=min(BEARINGS, thin.shape[1]),
            below_m=s.robot_below_m,
            above_m=s.robot_above_m,
        )
        image = None
        if self._is_far_sighted:
            image = ImageGuide(s, self.rig).profile(disparity_px, fresh)
        near = StripValues.of(thin, min(s.steer_strips, thin.shape[1]))
        undecided = image.undecided if image else level_surface(near) is not None
        return MapProfile(bearings, nearest(near), (width, height), undecided, image)

    def steer(
        self,
        state: MapCourse | None,
        seen_now: MapProfile,
        pose: Pose | None = None,
        time_s: float | None = None,
    ) -> tuple[MapCourse | None, Steering]:
        """Return the map and the course after a frame, and the steering, see :meth:`Guide.steer`.

        Where the rig is lost, the map stays as it is and the heading is held.
        """
        if pose is None:
            return state, self._held(state, seen_now)
        s, yaw, (width, _) = self.settings, pose.yaw_rad, seen_now.size
        view = view_of(self.rig, s.reference, self.rig.camera_on_floor(pose, s.reference), yaw)
        new = bool(np.isfinite(seen_now.bearings.near_px).any())
        before = state or MapCourse(LocalMap.unknown(pose.x_m, pose.y_m), pose)
        shifted = moved(before.map, pose.x_m, pose.y_m)
        half_life = GOAL_HALF_LIFE_FRAMES if s.goal_m else HALF_LIFE_FRAMES
        known = seen(*(shifted, seen_now.bearings, view, seen_now.size, s.robot_below_m, half_life))
        trail = (*before.trail, (pose.x_m, pose.y_m, yaw))[-_TRAIL:]
        image, by_image = before.image, None
        if seen_now.image is not None:
            travel = self._arc_place(trail, width)
            image, by_image = ImageGuide(s, self.rig).steer_from(
                image, seen_now.image, travel, time_s
            )
        before = replace(before, map=known, image=image, trail=trail)
        if before.course is None and (seen_now.undecided or not new):
            return replace(before, pose=pose), _BLIND
        x_m, y_m = pose.x_m - before.pose.x_m, pose.y_m - before.pose.y_m
        course = before.course or Course(yaw, yaw)
        course = travelled(course, math.hypot(x_m, y_m), math.atan2(y_m, x_m))
        if len(before.asked_rad) == ASKED_FRAMES:
            yaws = [each for _, _, each in trail[-TURN_FRAMES - 1 :]]
            course = taken_along(course, yaws, before.asked_rad)
        turned_rad = math.remainder(yaw - before.pose.yaw_rad, math.tau)
        course, free_m, is_known = self._planned(course, known, pose, turned_rad)
        angle_rad = math.remainder(course.heading_rad - yaw, math.tau)
        place = steadied(before.place, self._place_of(angle_rad, width), s.steer_gain)
        half_way = s.robot_radius_m / self.rig.baseline_m
        near_px = nearest_in_way(seen_now.bearings.near_px, place, width, half_way)
        approach = before.approach.after(time_s, place, near_px)
        steer_rad = _angle_rad(place, width, self.rig, s.reference)
        asked = (*before.asked_rad, steer_rad)[-ASKED_FRAMES:]
        after = replace(before, pose=pose, place=place, approach=approach)
        if is_known:  # until then it only looks around
            after = replace(after, course=course, asked_rad=asked)
        if by_image is not None and self._is_open(by_image, seen_now, trail):
            return replace(after, place=image.place), by_image
        return after, Steering(
            status="ok" if new else "held",
            steer=1 - 2 * place,
            steer_rad=steer_rad,
            depth_m=free_m,
            nearest_m=_depth_m(seen_now.nearest_px, self.rig),
            risk_s=approach.contact_s,
        )

    def _planned(
        self, course: Course, known: LocalMap, pose: Pose, turned_rad: float
    ) -> tuple[Course, float | None, bool]:
        """Return the next course, the free distance on it in m, and whether any cell is known.

        Args:
            course: the last one.
            known: the map.
            pose: the rig's.
            turned_rad: how far the rig has turned since the last frame.
        """
        s, yaw_rad = self.settings, pose.yaw_rad
        middle = known.cells_of(pose.x_m, pose.y_m)
        occupied, free = known.evidence > CERTAIN, known.evidence < -CERTAIN
        if known.walks_frames:
            near = cells_within(free.shape, middle, _NEAR_M, CELL_M)
            occupied |= near & (known.evidence > ONE_HIT)
        is_known = bool(occupied.any() or free.any())
        directions_rad = yaw_rad + DIRECTIONS_RAD
        if s.goal_m is None:
            ways = free_distances(
                *(occupied, free, middle, directions_rad), cell_m=CELL_M, radius_m=s.robot_radius_m
            )
            walks = known.walks_frames > 0
            planned = plan(
                *(course, yaw_rad, *ways, directions_rad), turned_rad=turned_rad, walks=walks
            )
        else:
            planned = toward(
                *(course, yaw_rad, occupied, free, middle, directions_rad),
                known.cells_of(*s.goal_m),
                corner=known.corner,
                turned_rad=turned_rad,
                cell_m=CELL_M,
                radius_m=s.robot_radius_m,
            )
        return (*planned, is_known)

    def _held(self, state: MapCourse | None, seen_now: MapProfile) -> Steering:
        """Return the heading of before, on which nothing is known to be free."""
        if state is None or state.place is None:
            return _BLIND
        return Steering(
            status="held",
            steer=1 - 2 * state.place,
            steer_rad=_angle_rad(state.place, seen_now.size[0], self.rig, self.settings.reference),
            depth_m=None,
            nearest_m=_depth_m(seen_now.nearest_px, self.rig),
        )

    @property
    def _is_far_sighted(self) -> bool:
        """Whether the rig sees well beyond the map."""
        half_m = CELLS * CELL_M / 2
        return _SIGHT_PX * half_m**2 / self.rig.focal_baseline < _SIGHT_M

    def _is_open(
        self,
        by_image: Steering,
        seen_now: MapProfile,
        trail: tuple[tuple[float, float, float], ...],
    ) -> bool:
        """Return whether the way that the image shows leads beyond the map."""
        if by_image.status != "ok" or seen_now.image is None or self.settings.goal:
            return False
        if math.isnan(seen_now.image.space.slope):
            return False
        (x0, y0, _), (x1, y1, _) = trail[0], trail[-1]
        step_m = math.hypot(x1 - x0, y1 - y0) / max(len(trail) - 1, 1)
        is_far = by_image.depth_m is None or by_image.depth_m > _OPEN_M
        return is_far or step_m * _OPEN_FRAMES > CELLS * CELL_M / 2

    def _arc_place(self, trail: tuple[tuple[float, float, float], ...], width: int) -> float | None:
        """Return where across the image the arc of the last piece of path leads; None at rest."""
        way_m, turned_rad = 0.0, 0.0
        for (x0, y0, yaw0), (x1, y1, yaw1) in zip(trail[-2::-1], trail[:0:-1], strict=True):
            way_m += math.hypot(x1 - x0, y1 - y0)
            turned_rad += math.remainder(yaw1 - yaw0, math.tau)
            if way_m >= _ARC_M:
                # An arc of curvature k is k L^2 / 2 aside at L ahead.
                slant = turned_rad / way_m * _ARC_AIM_M / 2
                return self._place_of(math.atan(slant), width)
        return None

    def _place_of(self, angle_rad: float, width: int) -> float:
        """Return the position across the image of an angle, clipped to the image."""
        if abs(angle_rad) >= math.pi / 2:
            return 0.0 if angle_rad > 0 else 1.0
        cx_px = self.rig.cx_of(self.settings.reference)
        column = cx_px - self.rig.focal_px * math.tan(angle_rad)
        return min(max((column + 0.5) / width, 0.0), 1.0)


def view_of(rig: Rig, camera: str, place_m: tuple[float, float], yaw_rad: float) -> FloorView:
    """Return the ``left`` or ``right`` camera on the floor plane, at a place and heading."""
    return FloorView(
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


def _median(values: tuple[float, ...]) -> float:
    """Return the median of a few numbers; np.median is slow and imports np.ma."""
    ordered, count = sorted(values), len(values)
    return (ordered[(count - 1) // 2] + ordered[count // 2]) / 2


def _thinning(image: Real) -> tuple[int, int]:
    """Return the steps of rows and columns that are used for guidance."""
    height, width = (max(side // STEERING_PX, 1) for side in image.shape)
    return height, width


def _angle_rad(place: float, width: int, rig: Rig, camera: str) -> float:
    column = place * width - 0.5  # of pixel centres
    return math.atan2(rig.cx_of(camera) - column, rig.focal_px)


def _depth_m(nearness_px: float | None, rig: Rig | None) -> float | None:
    if rig is None or nearness_px is None or not nearness_px > 0:
        return None
    return rig.focal_baseline / nearness_px
