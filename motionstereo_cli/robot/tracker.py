"""Tracking of moving objects from frame to frame."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from motionstereo_cli.method.settings import Settings
from motionstereo_cli.robot.approach import MAX_CONTACT_S
from motionstereo_cli.robot.bodies import joined
from motionstereo_cli.robot.free_space import MIN_KNOWN_SHARE, StripValues, level_surface
from motionstereo_cli.robot.objects import (
    CELL_PX,
    Observation,
    Region,
    Track,
    expected_box,
    follow,
    lies,
    region_of,
    regions,
    uncovered,
)
from motionstereo_cli.robot.separation import parts
from motionstereo_cli.robot.speeds import by_itself, movement, moves_surely, trust
from motionstereo_cli.types import (
    FrameTime,
    MovingObject,
    Pose,
    Rig,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.types import Real

#: Number of frames after which a region is an object.
MIN_SEEN = 3
#: Objects out of sight for longer are not expected in a region with others.
_LATELY_FRAMES = 5

#: Around what moved by itself, so many cells belong to it where their depth does. A region that
#: moves by itself has at least this share of the image.
_AROUND_CELLS, _MIN_MOVING_SHARE = 2, 0.0005
#: Regions of what moves by itself end within so many cells of it, gaps that are bridged included.
_MARGIN_CELLS = 6
#: A region is a part of another one if so much of its box is in the other's, and its nearness
#: differs by at most this share.
_PART_INSIDE, _PART_SHARE = 0.8, 0.15
#: What is remembered has rows that are nearer than what is beside them, at least as this share of
#: those that are as near, and its place is known if it moves by no larger share of its size.
_STANDING_OUT, _MAX_STEP = 0.3, 0.5
#: Nothing that moves by itself has its lower end farther above the camera.
_MAX_UP_M = 2.0

#: A surface before which things move is known in at least this share of the view's strips.
_SURFACE_STRIPS = 0.8


@dataclass(frozen=True, slots=True)
class Tracks:
    """The moving objects after a frame.

    Attributes:
        each: the tracks, in the last frame or recently out of sight.
        last_id: the number of the last new track.
        time_s: time of the last frame, its number where the source has no time.
    """

    each: tuple[Track, ...] = ()
    last_id: int = 0
    time_s: float = -math.inf


@dataclass(frozen=True, slots=True)
class Tracker:
    """Follows what moves from frame to frame.

    Args:
        settings: parameters of the processing.
        rig: the camera, None if unknown; lengths are then 1 / disparity.
    """

    settings: Settings
    rig: Rig | None

    def regions(
        self,
        disparity_px: Real,
        fresh: NDArray[np.bool_],
        earlier: Sequence[NDArray[np.uint16]] = (),
        parts_per_px: int = 1,
    ) -> tuple[Region, ...]:
        """Return the regions of a frame that may be objects; they depend on the last frames only.

        Args:
            disparity_px: (height, width) float32, NaN = unknown.
            fresh: where the disparity shows the present, (height, width) bool.
            earlier: disparity in the last frames, in parts of a px, 0 = unknown.
            parts_per_px: these parts.
        """
        near, doffs_px = disparity_px, 0.0
        if self.rig is not None:
            near, doffs_px = self.rig.nearness_px(disparity_px), self.rig.doffs
        fresh = fresh & ~uncovered(disparity_px, fresh, earlier, parts_per_px, doffs_px)
        found = regions(near, fresh, MIN_KNOWN_SHARE)
        if not found:
            return ()
        strips = StripValues.of(near, min(self.settings.steer_strips, near.shape[1]))
        surface_px = level_surface(strips, min_known=_SURFACE_STRIPS)
        if surface_px is None:
            return found
        # What moves on a surface that fills the view lies on it.
        found = tuple(replace(each, surface_px=surface_px) for each in found)
        return tuple(
            replace(each, nearer=0, level=each.height // CELL_PX) if each.on_surface else each
            for each in found
        )

    def moving_regions(self, disparity_px: Real, velocity_mps: Real) -> tuple[Region, ...]:
        """Return the regions of a frame that moved by themselves, in this frame and the last one.

        Those that are remembered from the last frames are among them.

        Args:
            disparity_px: (height, width) float32, NaN = unknown.
            velocity_mps: of cells over ground, (rows, columns, 6), as
                :func:`~motionstereo_cli.robot.movers.see` has it.
        """
        moved = np.isfinite(velocity_mps[..., 5]).view(np.uint8)
        x, y, width, height = cv2.boundingRect(moved)
        if not width:
            return ()
        left, top = max(x - _MARGIN_CELLS, 0), max(y - _MARGIN_CELLS, 0)
        part = slice(top, y + height + _MARGIN_CELLS), slice(left, x + width + _MARGIN_CELLS)
        around = np.ones((2 * _AROUND_CELLS + 1,) * 2, np.uint8)
        near = np.asarray(cv2.dilate(moved[part], around)).view(np.bool_)
        near = near.repeat(CELL_PX, axis=0).repeat(CELL_PX, axis=1)
        left, top = left * CELL_PX, top * CELL_PX
        nearness = disparity_px[top : top + near.shape[0], left : left + near.shape[1]]
        nearness = np.ascontiguousarray(nearness)
        nearness = self.rig.nearness_px(nearness) if self.rig else nearness
        min_share = _MIN_MOVING_SHARE * disparity_px.size / near.size
        found = regions(nearness, near, min_share, velocity_mps[part])
        placed = (
            replace(
                each,
                x=each.x + left,
                y=each.y + top,
                middle_x=each.middle_x + left,
                middle_y=each.middle_y + top,
                before=1,
            )
            for each in found
            if each.velocity_mps is not None or _stands_out(each)  # else what moved is beside it
        )
        return _whole(each for each in placed if not self._hangs(each))

    def _hangs(self, region: Region) -> bool:
        """Return whether a region ends so far above the camera that it cannot stand on ground."""
        if self.rig is None:
            return False
        depth_m = self.rig.focal_baseline / region.nearness_px
        up_m = (self.rig.cy - region.y - region.height) * depth_m / self.rig.fy_px
        return up_m > _MAX_UP_M

    def follow(
        self,
        tracks: Tracks,
        found: Iterable[Region],
        frame: FrameTime,
        pose: Pose | None = None,
    ) -> tuple[Tracks, tuple[MovingObject, ...]]:
        """Return the tracks after a frame, and the objects in it.

        Args:
            tracks: those before.
            found: the regions of the frame.
            frame: which it is.
            pose: where the rig is; None where it is not known.
        """
        time_s = frame.clock_s
        # If time goes back, another recording begins.
        before = tracks.each if time_s > tracks.time_s else ()
        apart = _separated(tuple(found), before, time_s)
        observations = [self._observation(region, time_s, pose) for region in apart]
        each = follow(before, observations, time_s, tracks.last_id + 1)
        last_id = max([tracks.last_id, *(track.number for track in each)])
        if self.rig is not None and frame.time_s is not None:
            view = replace(self.rig, cx=self.rig.cx_of(self.settings.reference))
            each = joined(each, view)
        things: dict[int, list[MovingObject]] = {}
        for track in each:
            sure = not track.missed and track.seen >= MIN_SEEN and moves_surely(track)
            if sure and (track.observations[-1].region.moves or self._is_slow(track)):
                thing = self._object(track, pose, timed=frame.time_s is not None)
                things.setdefault(track.body, []).append(thing)
        bodies = tuple(_body(number, parts) for number, parts in sorted(things.items()))
        return Tracks(each, last_id, time_s), bodies

    def _is_slow(self, track: Track) -> bool:
        """Return whether an object moves by a small part of its size from frame to frame."""
        moves, (before, last) = movement(track), track.observations[-2:]
        if moves is None or self.rig is None:
            return False
        region = last.region
        step_m = math.hypot(*moves.over_ground_mps) * (last.time_s - before.time_s)
        m_per_px = self.rig.focal_baseline / region.nearness_px / self.rig.focal_px
        return step_m <= _MAX_STEP * max(region.width, region.height) * m_per_px

    def _observation(self, region: Region, time_s: float, pose: Pose | None) -> Observation:
        region = replace(region, cells=None)
        if self.rig is None:
            ahead = 1 / region.nearness_px
            return Observation(time_s, region, (ahead, 0.0), (ahead, 0.0))
        ahead_m = self.rig.focal_baseline / region.nearness_px
        cx_px = self.rig.cx_of(self.settings.reference)
        left_m = (cx_px - region.middle_x) / self.rig.focal_px * ahead_m
        ends_px = region.x, region.x + region.width
        ends = [(region.middle_x - end_px) / self.rig.focal_px * ahead_m for end_px in ends_px]
        if pose is None:
            ends_m = 0.0, ends[0], 0.0, ends[1]
            place = ahead_m, left_m
            return Observation(time_s, region, place, place, ends_m=ends_m)
        x_m, y_m = _turned(ahead_m, left_m, pose)
        ends_m = (*_turned(0.0, ends[0], pose), *_turned(0.0, ends[1], pose))
        camera_x_m, camera_y_m = self.rig.camera_on_floor(pose, self.settings.reference)
        place_m = camera_x_m + x_m, camera_y_m + y_m
        speed = region.velocity_mps
        velocity_mps = None if speed is None else _turned(*speed, pose)
        return Observation(time_s, region, (x_m, y_m), place_m, velocity_mps, ends_m)

    def _object(self, track: Track, pose: Pose | None, *, timed: bool) -> MovingObject:
        last, moves = track.observations[-1], movement(track) if timed else None
        yaw_rad = 0.0 if pose is None else pose.yaw_rad
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        ahead, closing = cos * last.offset_m[0] + sin * last.offset_m[1], None
        if moves is not None:
            closing = -cos * moves.from_camera_mps[0] - sin * moves.from_camera_mps[1]
        in_world = self.rig is not None and pose is not None
        return MovingObject(
            id=track.number,
            x=last.region.x,
            y=last.region.y,
            width=last.region.width,
            height=last.region.height,
            depth_m=ahead if self.rig else None,
            closing_mps=closing if self.rig else None,
            time_to_contact_s=contact_s(ahead, closing),
            confidence=trust(track, moves),
            place_m=last.place_m if in_world else None,
            velocity_mps=moves.over_ground_mps if in_world and moves else None,
            sigma_mps=moves.sigma_mps if in_world and moves else None,
            by_itself=by_itself(track, moves) if in_world and moves else None,
            shadow=lies(track),
        )


def _body(number: int, each: Sequence[MovingObject]) -> MovingObject:
    """Return parts as one object: the box around them, and else the nearest of them."""
    nearest = min(each, key=lambda part: part.depth_m or 0.0)
    left, top = min(part.x for part in each), min(part.y for part in each)
    right = max(part.x + part.width for part in each)
    bottom = max(part.y + part.height for part in each)
    width, height = right - left, bottom - top
    return replace(nearest, id=number, x=left, y=top, width=width, height=height)


def _turned(ahead: float, left: float, pose: Pose) -> tuple[float, float]:
    """Return along the x and y axes of the world what is ahead and to the left of a pose."""
    cos, sin = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
    return cos * ahead - sin * left, sin * ahead + cos * left


def _separated(
    found: Sequence[Region], tracks: Sequence[Track], time_s: float
) -> tuple[Region, ...]:
    """Return regions, separated where one holds several objects that were followed lately."""
    lately = [
        expected_box(track, time_s)
        for track in tracks
        if track.seen >= MIN_SEEN and track.missed <= _LATELY_FRAMES
    ]
    if len(lately) < 2:
        return tuple(found)
    expected = np.array(lately) / (*[CELL_PX] * 4, 1)
    places = [
        (each.x // CELL_PX, each.y // CELL_PX, each.cells)
        for each in found
        if each.cells is not None
    ]
    result: list[Region] = []
    for region, each in zip(found, parts(places, expected), strict=True):
        if len(each) > 1:
            before, surface_px = region.before, region.surface_px
            result += [
                replace(region_of(*part), before=before, surface_px=surface_px) for part in each
            ]
        else:
            result.append(region)
    return tuple(result)


def _whole(found: Iterable[Region]) -> tuple[Region, ...]:
    """Return regions without those that are parts of larger ones."""
    kept: list[Region] = []
    for each in sorted(found, key=lambda region: -region.width * region.height):
        if not any(_is_part(each, other) for other in kept):
            kept.append(each)
    return tuple(kept)


def _stands_out(region: Region) -> bool:
    """Return whether a region is remembered and does not lie on what is beside it."""
    return not region.moves and region.nearer >= _STANDING_OUT * region.level


def _is_part(region: Region, other: Region) -> bool:
    """Return whether a region lies in the box of another one, at about its depth."""
    wide = min(region.x + region.width, other.x + other.width) - max(region.x, other.x)
    high = min(region.y + region.height, other.y + other.height) - max(region.y, other.y)
    inside = max(wide, 0) * max(high, 0) >= _PART_INSIDE * region.width * region.height
    off_px = abs(region.nearness_px - other.nearness_px)
    return inside and off_px <= _PART_SHARE * other.nearness_px


def contact_s(ahead: float, closing: float | None) -> float | None:
    """Return the time to contact; None if the object does not approach, or it is too long."""
    if closing is None or closing * MAX_CONTACT_S < ahead:
        return None
    return ahead / closing
