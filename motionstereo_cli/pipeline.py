"""The stream: stereo frames in, results out. The only place with state in time.

In permanency mode the state before guidance is gone ceil((Chmax - Chmin) / D) frames later.
"""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from motionstereo_cli.robot.guide import Guide
from motionstereo_cli.robot.tracker import Tracker
from motionstereo_cli.settings import FOREVER, Settings
from motionstereo_cli.stages.bands import band_table, bands, blur
from motionstereo_cli.stages.charge import accumulate, age, permanency
from motionstereo_cli.stages.cleaning import filled, without_speckles
from motionstereo_cli.stages.confidence import confidence
from motionstereo_cli.stages.depth import depth
from motionstereo_cli.stages.match_keys import match_keys
from motionstereo_cli.stages.motion import motion
from motionstereo_cli.stages.regions import match_regions
from motionstereo_cli.stages.residual import residual
from motionstereo_cli.stages.trails import match_trails
from motionstereo_cli.types import (
    FrameResult,
    MovingObject,
    Pose,
    Rig,
    StereoFrame,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.types import Grey, MatchKeys, Real

_T = TypeVar("_T", bound=np.generic)

#: A disparity shows where a moving object is now if it moved there at most so many frames ago.
FRESH_FRAMES = 3


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
            objects = state.tracker.follow(disparity, fresh, frame, pose)
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
        tracker: the moving objects.
    """

    right: Memory
    left: Memory
    guide: Guide
    tracker: Tracker

    @staticmethod
    def unknown(settings: Settings, rig: Rig | None) -> State:
        """Return the state before the first frame."""
        return State(
            Memory(settings), Memory(settings), Guide(settings, rig), Tracker(settings, rig)
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
    s, wanted = settings, right.match_keys()
    if s.matcher == "regions":
        disparity = match_regions(wanted, left.match_keys(), s.max_disparity)
        chance = np.full_like(disparity, np.nan)
    else:
        disparity, votes = match_trails(
            wanted,
            left.match_keys(),
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

    def match_keys(self) -> MatchKeys:
        """Return what has to be equal for pixels to correspond, (height, width) uint16."""
        by_band = self._settings.match_on == "charge-band"
        return match_keys(self.charge, self._settings.charge_min, self.bands if by_band else None)

    def mirrored(self) -> Memory:
        """Return what a camera would remember that saw the same in a mirror."""
        twin = copy.copy(self)
        twin.grey, twin.bands = _mirrored(self.grey), _mirrored(self.bands)
        twin.moved, twin.charge = _mirrored(self.moved), _mirrored(self.charge)
        return twin


def _mirrored(image: NDArray[_T]) -> NDArray[_T]:
    return np.ascontiguousarray(image[:, ::-1])
