"""The stream: stereo frames in, results out. The only place with state in time.

In permanency mode the state before guidance is gone ceil((Chmax - Chmin) / D) frames later.
"""

from __future__ import annotations

import copy
import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from motionstereo_cli.settings import FOREVER, Settings
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
from motionstereo_cli.stages.local_map import (
    CELL_M,
    CERTAIN,
    LocalMap,
    View,
    disc,
    moved,
    profile,
    seen,
)
from motionstereo_cli.stages.motion import motion
from motionstereo_cli.stages.objects import (
    Region,
    Sighting,
    Track,
    follow,
    movement,
    regions,
    trust,
)
from motionstereo_cli.stages.regions import match_regions
from motionstereo_cli.stages.residual import residual
from motionstereo_cli.stages.trails import match_trails
from motionstereo_cli.stages.units import units
from motionstereo_cli.types import FrameResult, MovingObject, Pose, Rig, Steering, StereoFrame

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.types import Grey, Real, Units

_T = TypeVar("_T", bound=np.generic)

#: Share of a strip of the image, or of all of it, below which its matches are taken for noise.
LEAST_KNOWN_SHARE = 0.002

#: A disparity shows where a moving object is now if it moved there at most so many frames ago.
FRESH_FRAMES = 3

#: A region is an object once it has been seen in so many frames.
LEAST_SEEN = 3

#: An object is a contact if it would be at the camera within this time, and is to be believed so
#: far. A robot keeps clear of where the first of them will be after each of these times.
CONTACT_S, LEAST_TRUST, FORESEEN_S = 3.0, 0.2, (0.5, 1.0)
#: What stands is in the map already: a contact that matters moves over ground by itself. Beyond
#: the second speed it is a mistake. It is at most so wide.
CONTACT_MPS, CONTACT_RADIUS_M = (0.3, 2.5), 0.5
#: Where the map has had more evidence than this, so near to a contact, it stands all the same: of
#: a wall that the camera passes, ever new parts are seen, as if it moved along.
STANDS, STANDS_WITHIN_M = 3.0, 0.25

#: To steer by an image, so many of its rows are enough, and larger images take no longer.
STEERING_ROWS = 240

#: Bearings that a robot tells apart: less than a degree each for most lenses.
BEARINGS = 80


def process(
    frames: Iterable[StereoFrame],
    settings: Settings | None = None,
    rig: Rig | None = None,
    pose_of: Callable[[StereoFrame], Pose] | None = None,
    *,
    with_objects: bool = True,
    jobs: int = 1,
    state: State | None = None,
) -> Iterator[FrameResult]:
    """Yield the result of each stereo frame, in order.

    Frames are matched side by side, for that takes most of the time and needs nothing from other
    frames but what the memories hold. What depends on the frame before is done in order.

    Args:
        frames: rectified stereo frames of one size.
        settings: parameters; the defaults if None.
        rig: the camera, for depth in m and steering angles; without one they are None.
        pose_of: tells where the rig was; asked once a frame, in order. With it and a rig, the
            guidance remembers what it has seen around it.
        with_objects: find moving objects; with poses, the guidance keeps clear of them.
        jobs: frames matched at a time; all but one of them are taken before a result is given.
        state: what is known before the first frame, nothing if None. With each result it becomes
            what is known after that frame.
    """
    settings = settings or Settings()
    state = state or State.unknown(settings, rig)
    for frame, right, left, found in _matched(frames, settings, state, jobs):
        disparity, chance = found
        state.right, state.left = right, left
        shown = right if settings.reference == "right" else left
        pose = None if pose_of is None else pose_of(frame)
        objects: tuple[MovingObject, ...] = ()
        if with_objects:
            fresh = shown.age_frames <= FRESH_FRAMES
            objects = state.follower.follow(disparity, fresh, frame, pose)
        yield FrameResult(
            frame=frame,
            bands=shown.bands,
            motion=shown.moved,
            charge=shown.charge,
            age_frames=shown.age_frames,
            disparity_px=disparity,
            confidence=chance,
            depth_m=None
            if rig is None
            else depth(disparity, rig.focal_px, rig.baseline_m, rig.doffs),
            steering=state.guide.steer(disparity, shown.moved, pose, objects),
            charged=float(np.count_nonzero(shown.charge > settings.charge_min)) / disparity.size,
            matched=float(np.count_nonzero(~np.isnan(disparity))) / disparity.size,
            pose=pose,
            objects=objects,
        )


@dataclass(slots=True)
class State:
    """All that is kept from frame to frame.

    Attributes:
        right, left: the permanency memories.
        guide: the heading, and the map it is taken from.
        follower: the moving objects.
    """

    right: Memory
    left: Memory
    guide: Guide
    follower: Follower

    @staticmethod
    def unknown(settings: Settings, rig: Rig | None) -> State:
        """Return the state before the first frame."""
        return State(
            Memory(settings), Memory(settings), Guide(settings, rig), Follower(settings, rig)
        )


def _matched(
    frames: Iterable[StereoFrame], settings: Settings, state: State, jobs: int
) -> Iterator[tuple[StereoFrame, Memory, Memory, tuple[Real, Real]]]:
    """Yield each frame, the right and the left memory after it, and what :func:`match` finds."""
    right, left = copy.copy(state.right), copy.copy(state.left)
    with ThreadPoolExecutor(jobs, "match") as threads:
        waiting: deque[tuple[StereoFrame, Memory, Memory, Future[tuple[Real, Real]]]] = deque()
        for frame in frames:
            right.see(frame.right)
            left.see(frame.left)
            moment = copy.copy(right), copy.copy(left)
            waiting.append((frame, *moment, threads.submit(match, *moment, settings)))
            if len(waiting) >= jobs:
                first, its_right, its_left, found = waiting.popleft()
                yield first, its_right, its_left, found.result()
        for first, its_right, its_left, found in waiting:
            yield first, its_right, its_left, found.result()


def match(right: Memory, left: Memory, settings: Settings) -> tuple[Real, Real]:
    """Return disparity in px and confidence 0..1 of the reference view, NaN = unknown.

    Both are (height, width) float32.
    """
    if settings.reference == "right":
        return _match(right, left, settings)
    # In a mirror the left camera is the right one, and disparities stay what they are.
    disparity, chance = _match(left.mirrored(), right.mirrored(), settings)
    return _mirrored(disparity), _mirrored(chance)


def _match(right: Memory, left: Memory, settings: Settings) -> tuple[Real, Real]:
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
        matched = without_speckles(disparity, differs <= s.max_residual, s.speckle_px)
        disparity = filled(matched, wanted > 0, s.gap_px)
        chance = confidence(disparity, matched, votes, differs, right.age_frames)
    if s.min_confidence > 0 or s.max_age < FOREVER:
        dropped = (chance < s.min_confidence) | (right.age_frames > s.max_age)
        disparity[dropped] = chance[dropped] = np.nan
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

    def mirrored(self) -> Memory:
        """Return what a camera would remember that saw the same in a mirror."""
        twin = copy.copy(self)
        twin.grey, twin.bands = _mirrored(self.grey), _mirrored(self.bands)
        twin.moved, twin.charge = _mirrored(self.moved), _mirrored(self.charge)
        return twin


def _mirrored(image: NDArray[_T]) -> NDArray[_T]:
    return np.ascontiguousarray(image[:, ::-1])


class Follower:
    """Follows what moves from frame to frame.

    Args:
        settings: parameters of the processing.
        rig: the camera, None if unknown; lengths are then 1 / disparity.

    Attributes:
        tracks: what is followed, in the last frame or lately out of sight.
        last_id: the number of the last new track.
        time_s: time of the last frame, its number where the source has no time.
    """

    def __init__(self, settings: Settings, rig: Rig | None) -> None:
        self._settings = settings
        self._rig = rig
        self.tracks: tuple[Track, ...] = ()
        self.last_id = 0
        self.time_s = -math.inf

    def follow(
        self,
        disparity_px: Real,
        fresh: NDArray[np.bool_],
        frame: StereoFrame,
        pose: Pose | None = None,
    ) -> tuple[MovingObject, ...]:
        """Return the objects of a frame.

        Args:
            disparity_px: (height, width) float32, NaN = unknown.
            fresh: where the disparity shows what is there now, (height, width) bool.
            frame: its number and time.
            pose: where the rig is; None where nobody knows.
        """
        time_s = float(frame.index) if frame.time_s is None else frame.time_s
        if time_s <= self.time_s:
            self.tracks = ()  # another recording begins
        self.time_s = time_s
        near = disparity_px + np.float32(self._rig.doffs if self._rig else 0)
        sightings = [
            self._sighting(region, time_s, pose)
            for region in regions(near, fresh, LEAST_KNOWN_SHARE)
        ]
        self.tracks = follow(self.tracks, sightings, time_s, self.last_id + 1)
        self.last_id = max([self.last_id, *(track.number for track in self.tracks)])
        return tuple(
            self._object(track, pose, timed=frame.time_s is not None)
            for track in self.tracks
            if not track.missed and track.seen >= LEAST_SEEN
        )

    def _sighting(self, region: Region, time_s: float, pose: Pose | None) -> Sighting:
        if self._rig is None:
            ahead = 1 / region.nearness_px
            return Sighting(time_s, region, (ahead, 0.0), (ahead, 0.0))
        ahead_m = self._rig.focal_px * self._rig.baseline_m / region.nearness_px
        cx_px = self._rig.cx_of(self._settings.reference)
        left_m = (cx_px - region.middle_x) / self._rig.focal_px * ahead_m
        if pose is None:
            return Sighting(time_s, region, (ahead_m, left_m), (ahead_m, left_m))
        cos, sin = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
        x_m, y_m = cos * ahead_m - sin * left_m, sin * ahead_m + cos * left_m
        camera_x_m, camera_y_m = camera_place(self._rig, pose, self._settings.reference)
        return Sighting(time_s, region, (x_m, y_m), (camera_x_m + x_m, camera_y_m + y_m))

    def _object(self, track: Track, pose: Pose | None, *, timed: bool) -> MovingObject:
        last, moves = track.sightings[-1], movement(track) if timed else None
        yaw_rad = 0.0 if pose is None else pose.yaw_rad
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        ahead, closing = cos * last.offset_m[0] + sin * last.offset_m[1], None
        if moves is not None:
            closing = -cos * moves.from_camera_mps[0] - sin * moves.from_camera_mps[1]
        in_world = self._rig is not None and pose is not None
        return MovingObject(
            id=track.number,
            x=last.region.x,
            y=last.region.y,
            width=last.region.width,
            height=last.region.height,
            depth_m=ahead if self._rig else None,
            closing_mps=closing if self._rig else None,
            time_to_contact_s=ahead / closing if closing is not None and closing > 0 else None,
            confidence=trust(track, moves),
            place_m=last.place_m if in_world else None,
            velocity_mps=moves.over_ground_mps if in_world and moves else None,
        )


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


def camera_place(rig: Rig, pose: Pose, camera: str) -> tuple[float, float]:
    """Return where the ``left`` or ``right`` camera is in the world, x and y in m."""
    to_right_m = rig.baseline_m / (2 if camera == "right" else -2)
    return (
        pose.x_m + to_right_m * math.sin(pose.yaw_rad),
        pose.y_m - to_right_m * math.cos(pose.yaw_rad),
    )


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
