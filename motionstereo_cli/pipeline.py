"""The stream: stereo frames in, results out.

Three steps, each apart from the others. The memories see the images one after the other, which
is cheap. What one moment of the memories decides by itself is then found side by side, in threads
or in pieces of a recording (:func:`look`). What follows from frame to frame, heading and objects,
is done in order, on the few numbers that each look has left (:class:`Findings`).

In permanency mode the memories forget ceil((Chmax - Chmin) / D) frames later.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from motionstereo_cli.errors import SettingsError
from motionstereo_cli.method.depth import depth
from motionstereo_cli.method.matching import MATCH
from motionstereo_cli.method.memory import Memory, age_of, in_mirror, mirrored, see
from motionstereo_cli.method.settings import AUTO, FOREVER, Settings
from motionstereo_cli.robot.guide import Guide, guide_of
from motionstereo_cli.robot.tracker import Tracker, Tracks
from motionstereo_cli.types import FrameResult, MovingObject, Pose, Rig, Steering, StereoFrame

if TYPE_CHECKING:
    from motionstereo_cli.robot.objects import Region
    from motionstereo_cli.types import Grey, Real

#: What of a result takes time and is not always asked for.
EXTRAS = frozenset({"age_frames", "confidence", "depth_m"})

#: A disparity shows where a moving object is now if it moved there at most this many frames ago.
FRESH_FRAMES = 3


@dataclass(frozen=True, slots=True)
class State:
    """All that is kept from frame to frame; None before the first frame.

    Attributes:
        right, left: the permanency memories.
        guided: what the guide knows.
        tracks: the moving objects.
    """

    right: Memory | None = None
    left: Memory | None = None
    guided: Any = None
    tracks: Tracks | None = None


@dataclass(frozen=True, slots=True)
class Findings:
    """The few numbers of a frame that later frames build on.

    Attributes:
        profile: what the guide takes from it.
        regions: what may be an object.
        charged, matched: shares of the image, 0..1, that carry charge and have a disparity.
    """

    profile: Any
    regions: tuple[Region, ...]
    charged: float
    matched: float


class Look(NamedTuple):
    """What one moment of the memories decides by itself.

    Attributes:
        age_frames, disparity_px, confidence, depth_m: as :class:`FrameResult` has them.
        findings: what later frames build on.
    """

    age_frames: Grey | None
    disparity_px: Real
    confidence: Real | None
    depth_m: Real | None
    findings: Findings


class Joints(NamedTuple):
    """What is the same for all frames of a stream."""

    settings: Settings
    rig: Rig | None
    guide: Guide[Any, Any]
    tracker: Tracker | None
    extras: frozenset[str]

    @classmethod
    def of(
        cls,
        settings: Settings,
        rig: Rig | None,
        *,
        with_poses: bool,
        with_objects: bool,
        extras: Collection[str] = EXTRAS,
    ) -> Joints:
        """Return what a stream needs.

        Raises:
            SettingsError: ``max_disparity`` is still to be measured.
        """
        if settings.max_disparity == AUTO:
            raise SettingsError(
                "--max-disparity auto: the range is measured by run and batch; give a number here"
            )
        guide = guide_of(settings, rig, with_poses=with_poses)
        tracker = Tracker(settings, rig) if with_objects else None
        return cls(settings, rig, guide, tracker, frozenset(extras))


def process(
    frames: Iterable[StereoFrame],
    settings: Settings | None = None,
    rig: Rig | None = None,
    pose_of: Callable[[StereoFrame], Pose] | None = None,
    *,
    with_objects: bool = True,
    extras: Collection[str] = EXTRAS,
    jobs: int = 1,
    state: State | None = None,
) -> Iterator[FrameResult]:
    """Yield the result of each stereo frame, in order.

    Args:
        frames: rectified stereo frames of one size.
        settings: parameters; the defaults if None.
        rig: the camera, for depth in m and steering angles; without one they are None.
        pose_of: tells where the rig was; asked once a frame, in order. With it and a rig, the
            guidance remembers what it has seen around it.
        with_objects: find moving objects; with poses, the guidance keeps clear of them.
        extras: which of :data:`EXTRAS` the results have; the others are None, and take no time.
        jobs: frames matched at a time; all but one of them are taken before a result is given.
        state: what is known before the first frame, as the ``state`` of an earlier result; nothing
            if None.
    """
    settings, state = settings or Settings(), state or State()
    joints = Joints.of(
        settings,
        rig,
        with_poses=pose_of is not None,
        with_objects=with_objects,
        extras=extras,
    )
    course = Course(state.guided, state.tracks or Tracks())
    for frame, right, left, seen in looked(frames, joints, state, jobs):
        pose = None if pose_of is None else pose_of(frame)
        course, steering, objects = follow(course, seen.findings, frame, pose, joints)
        after = State(right, left, course.guided, course.tracks)
        shown = right if settings.reference == "right" else left
        yield result_of(frame, shown, seen, steering, state=after, pose=pose, objects=objects)


class Course(NamedTuple):
    """What follows from frame to frame, besides the memories: heading and objects."""

    guided: Any = None
    tracks: Tracks = Tracks()


def follow(
    course: Course, findings: Findings, frame: StereoFrame, pose: Pose | None, joints: Joints
) -> tuple[Course, Steering, tuple[MovingObject, ...]]:
    """Return the course after a frame, its heading, and the objects in it.

    Args:
        course: that of the frame before.
        findings: what the frame shows.
        frame: its number and time.
        pose: where the rig was; None where it is not known.
        joints: what is the same for all frames.
    """
    tracks = course.tracks
    objects: tuple[MovingObject, ...] = ()
    if joints.tracker is not None:
        tracks, objects = joints.tracker.follow(tracks, findings.regions, frame, pose)
    guided, steering = joints.guide.steer(course.guided, findings.profile, pose, objects)
    return Course(guided, tracks), steering, objects


def result_of(
    frame: StereoFrame, shown: Memory, seen: Look, steering: Steering, **more: Any
) -> FrameResult:
    """Return all that was found out about a frame.

    Args:
        frame: the frame.
        shown: the memory of the reference camera after it.
        seen: what that moment shows.
        steering: its heading.
        more: state, pose and objects, as :class:`FrameResult` has them.
    """
    return FrameResult(
        frame=frame,
        bands=shown.bands,
        motion=shown.moved,
        charge=shown.charge,
        age_frames=seen.age_frames,
        disparity_px=seen.disparity_px,
        confidence=seen.confidence,
        depth_m=seen.depth_m,
        steering=steering,
        charged=seen.findings.charged,
        matched=seen.findings.matched,
        **more,
    )


def looked(
    frames: Iterable[StereoFrame], joints: Joints, state: State, jobs: int
) -> Iterator[tuple[StereoFrame, Memory, Memory, Look]]:
    """Yield each frame, the right and the left memory after it, and what they show."""
    right, left = state.right, state.left
    with ThreadPoolExecutor(jobs, "match") as threads:
        waiting: deque[tuple[StereoFrame, Memory, Memory, Future[Look]]] = deque()
        for frame in frames:
            right = see(right, frame.right, joints.settings)
            left = see(left, frame.left, joints.settings)
            waiting.append((frame, right, left, threads.submit(look, right, left, joints)))
            if len(waiting) >= jobs:
                first, its_right, its_left, found = waiting.popleft()
                yield first, its_right, its_left, found.result()
        for first, its_right, its_left, found in waiting:
            yield first, its_right, its_left, found.result()


def look(right: Memory, left: Memory, joints: Joints) -> Look:
    """Return what one moment of the memories decides by itself, in the reference view."""
    s, rig = joints.settings, joints.rig
    shown = right if s.reference == "right" else left
    disparity, chance = match(right, left, s, with_confidence="confidence" in joints.extras)
    with_depth = "depth_m" in joints.extras
    regions: tuple[Region, ...] = ()
    if joints.tracker is not None:
        regions = joints.tracker.regions(disparity, age_of(shown, s) <= FRESH_FRAMES)
    return Look(
        age_of(shown, s) if "age_frames" in joints.extras else None,
        disparity,
        chance,
        depth_of(disparity, rig) if with_depth else None,
        Findings(
            joints.guide.profile(disparity, shown.moved),
            regions,
            charged=float(np.count_nonzero(shown.charge > s.charge_min)) / disparity.size,
            matched=float(np.count_nonzero(~np.isnan(disparity))) / disparity.size,
        ),
    )


def depth_of(disparity_px: Real, rig: Rig | None) -> Real | None:
    """Return depth in m of disparity in px, NaN = unknown; None without a rig."""
    return None if rig is None else depth(disparity_px, rig.focal_px, rig.baseline_m, rig.doffs)


def match(
    right: Memory, left: Memory, settings: Settings, *, with_confidence: bool = True
) -> tuple[Real, Real | None]:
    """Return disparity in px and confidence 0..1 of the reference view, NaN = unknown.

    Both are (height, width) float32; the confidence is None if it was not asked for.
    """
    if settings.reference == "left":
        # In a mirror the left camera is the right one, and disparities stay what they are.
        mirror = in_mirror(left), in_mirror(right)
        disparity, chance = _match(*mirror, settings, with_confidence=with_confidence)
        return mirrored(disparity), None if chance is None else mirrored(chance)
    return _match(right, left, settings, with_confidence=with_confidence)


def _match(
    right: Memory, left: Memory, settings: Settings, *, with_confidence: bool
) -> tuple[Real, Real | None]:
    s = settings
    disparity, confidence = MATCH[s.matcher](right, left, s)
    chance = confidence() if with_confidence or s.min_confidence > 0 else None
    if s.min_confidence > 0 or s.max_age < FOREVER:
        dropped = age_of(right, s) > s.max_age
        if chance is not None:
            dropped |= chance < s.min_confidence
            chance[dropped] = np.nan
        disparity[dropped] = np.nan
    return disparity, chance
