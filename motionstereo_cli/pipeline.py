"""The stream: stereo frames in, results out.

Three steps, each apart from the others. The memories see the images one after the other, which
is cheap. What one moment of the memories decides by itself is then found side by side, in threads
or in pieces of a recording (:func:`analyse`). What follows from frame to frame, heading and
objects, is done in order, on the few numbers that each analysis has left (:func:`follow`).

In permanency mode the memories forget ceil((Chmax - Chmin) / D) frames later.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from motionstereo_cli.compiled import checked_array
from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.method.depth import depth
from motionstereo_cli.method.matching import matcher_of
from motionstereo_cli.method.memory import Memory, age_of, in_mirror, mirrored, see
from motionstereo_cli.method.settings import AUTO, FOREVER, Settings
from motionstereo_cli.robot.guide import Guide, guide_of
from motionstereo_cli.robot.mapper import camera_points
from motionstereo_cli.robot.tracker import Tracker, Tracks
from motionstereo_cli.types import (
    FrameImages,
    FrameResult,
    FrameTime,
    MovingObject,
    Pose,
    Rig,
    Step,
    StereoFrame,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.robot.objects import Region
    from motionstereo_cli.types import Grey, Real

#: What of a result takes time and is not always asked for.
EXTRAS = frozenset({"age_frames", "confidence", "depth_m"})

#: A disparity shows where a moving object is now if it moved there at most this many frames ago.
FRESH_FRAMES = 3


@dataclass(frozen=True, slots=True)
class TrackingState:
    """What follows from frame to frame, besides the memories.

    Attributes:
        guided: what the guide knows.
        tracks: the moving objects.
    """

    guided: Any = None
    tracks: Tracks = field(default_factory=Tracks)


@dataclass(frozen=True, slots=True)
class State:
    """All that is kept from frame to frame.

    Attributes:
        right, left: the permanency memories; None before the first frame.
        tracking: heading and objects.
    """

    right: Memory | None = None
    left: Memory | None = None
    tracking: TrackingState = field(default_factory=TrackingState)


@dataclass(frozen=True, slots=True)
class FrameSummary:
    """The few numbers of a frame that later frames build on.

    Attributes:
        time: which frame it is.
        profile: what the guide takes from it.
        regions: what may be an object.
        charged, matched, points: as :class:`~motionstereo_cli.types.Step` has them.
    """

    time: FrameTime
    profile: Any
    regions: tuple[Region, ...]
    charged: float
    matched: float
    points: tuple[NDArray[np.float64], Grey] | None


class FrameAnalysis(NamedTuple):
    """What one moment of the memories decides by itself: images, and what later frames need."""

    images: FrameImages
    summary: FrameSummary


class StreamContext(NamedTuple):
    """What is the same for all frames of a stream.

    Attributes:
        settings: parameters of the processing.
        rig: the camera; None if unknown.
        guide: makes the headings.
        tracker: follows moving objects; None where nobody asks for them.
        extras: which of :data:`EXTRAS` the images have.
        with_points: whether steps have points.
    """

    settings: Settings
    rig: Rig | None
    guide: Guide[Any, Any]
    tracker: Tracker | None
    extras: frozenset[str]
    with_points: bool

    @classmethod
    def of(
        cls,
        settings: Settings,
        rig: Rig | None,
        *,
        with_poses: bool,
        with_objects: bool,
        extras: Collection[str] = EXTRAS,
        with_points: bool = False,
    ) -> StreamContext:
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
        return cls(settings, rig, guide, tracker, frozenset(extras), with_points)


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
        frames: rectified stereo frames of one size, that of the rig.
        settings: parameters; the defaults if None.
        rig: the camera, for depth in m and steering angles; without one they are None.
        pose_of: tells where the rig was; asked once a frame, in order. With it and a rig, the
            guidance remembers what it has seen around it.
        with_objects: find moving objects; with poses, the guidance keeps clear of them.
        extras: which of :data:`EXTRAS` the results have; the others are None, and take no time.
        jobs: frames matched at a time; all but one of them are taken before a result is given.
        state: what is known before the first frame, as the ``state`` of an earlier result; nothing
            if None.

    Raises:
        InputError: a frame is not two (height, width) uint8 images, or of another size than the
            rig, the state, or the frames before it.
        SettingsError: a setting is not of its kind.
    """
    settings = settings or Settings()
    if not isinstance(settings, Settings):
        raise SettingsError(f"settings are a {type(settings).__name__}: give Settings")
    if unknown := set(extras) - EXTRAS:
        raise SettingsError(f"there are no extras {unknown}: choose from {sorted(EXTRAS)}")
    if jobs < 1:
        raise SettingsError(f"jobs is {jobs}: give at least 1")
    context = StreamContext.of(
        settings,
        rig,
        with_poses=pose_of is not None,
        with_objects=with_objects,
        extras=extras,
    )
    for frame, step, after in steps(frames, context, pose_of, jobs=jobs, state=state):
        images = step.images
        assert images is not None
        assert images.bands is not None
        assert images.motion is not None
        yield FrameResult(
            frame=frame,
            bands=images.bands,
            motion=images.motion,
            charge=images.charge,
            age_frames=images.age_frames,
            disparity_px=images.disparity_px,
            confidence=images.confidence,
            depth_m=images.depth_m,
            steering=step.steering,
            charged=step.charged,
            matched=step.matched,
            state=after,
            pose=step.pose,
            objects=step.objects,
        )


def steps(
    frames: Iterable[StereoFrame],
    context: StreamContext,
    pose_of: Callable[[StereoFrame], Pose | None] | None = None,
    *,
    jobs: int = 1,
    state: State | None = None,
) -> Iterator[tuple[StereoFrame, Step, State]]:
    """Yield each frame, its step with images, and the state after it, in order.

    Args:
        frames, pose_of, jobs, state: see :func:`process`.
        context: what is the same for all frames.
    """
    state = state or State()
    tracking = state.tracking
    for frame, right, left, found in analysed(frames, context, state, jobs):
        pose = None if pose_of is None else pose_of(frame)
        tracking, step = follow(tracking, found.summary, pose, context, found.images)
        yield frame, step, State(right, left, tracking)


def follow(
    tracking: TrackingState,
    summary: FrameSummary,
    pose: Pose | None,
    context: StreamContext,
    images: FrameImages | None = None,
) -> tuple[TrackingState, Step]:
    """Return what is known after a frame, and the frame's step.

    Args:
        tracking: what was known before.
        summary: what the frame shows.
        pose: where the rig was; None where it is not known.
        context: what is the same for all frames.
        images: what the step is to have for images.
    """
    tracks, objects = tracking.tracks, tuple[MovingObject, ...]()
    if context.tracker is not None:
        tracks, objects = context.tracker.follow(tracks, summary.regions, summary.time, pose)
    guided, steering = context.guide.steer(tracking.guided, summary.profile, pose, objects)
    return TrackingState(guided, tracks), Step(
        time=summary.time,
        steering=steering,
        objects=objects,
        pose=pose,
        charged=summary.charged,
        matched=summary.matched,
        points=summary.points,
        images=images,
    )


def analysed(
    frames: Iterable[StereoFrame], context: StreamContext, state: State, jobs: int
) -> Iterator[tuple[StereoFrame, Memory, Memory, FrameAnalysis]]:
    """Yield each frame, the right and the left memory after it, and what they show."""
    right, left = state.right, state.left
    with ThreadPoolExecutor(jobs, "match") as threads:
        waiting: deque[tuple[StereoFrame, Memory, Memory, Future[FrameAnalysis]]] = deque()
        for frame in frames:
            right_view, left_view = checked_views(frame, right, context.rig)
            right = see(right, right_view, context.settings)
            left = see(left, left_view, context.settings)
            found = threads.submit(analyse, frame, right, left, context)
            waiting.append((frame, right, left, found))
            if len(waiting) >= jobs:
                first, its_right, its_left, found = waiting.popleft()
                yield first, its_right, its_left, found.result()
        for first, its_right, its_left, found in waiting:
            yield first, its_right, its_left, found.result()


def checked_views(frame: StereoFrame, before: Memory | None, rig: Rig | None) -> tuple[Grey, Grey]:
    """Return the right and the left view of a frame, contiguous in memory.

    Args:
        frame: what was given.
        before: the right memory before it, which is of the same size; None at the first frame.
        rig: its camera; None where it is not known.

    Raises:
        InputError: they are no grey images of one size, that of the memory and of the rig.
    """
    size = None if rig is None else (rig.height, rig.width)
    if before is not None:
        size = before.grey.shape
    try:
        right = checked_array(frame.right, np.uint8, size)
        return right, checked_array(frame.left, np.uint8, right.shape)
    except InputError as error:
        raise InputError(f"frame {frame.index}: {error}") from None


def analyse(
    frame: StereoFrame, right: Memory, left: Memory, context: StreamContext
) -> FrameAnalysis:
    """Return what one moment of the memories decides by itself, in the reference view."""
    with_confidence = "confidence" in context.extras
    disparity_px, confidence = match(right, left, context.settings, with_confidence=with_confidence)
    shown = right if context.settings.reference == "right" else left
    return described(frame, shown, disparity_px, confidence, context)


def described(
    frame: StereoFrame,
    shown: Memory,
    disparity_px: Real,
    confidence: Real | None,
    context: StreamContext,
) -> FrameAnalysis:
    """Return all that follows from one frame's disparity.

    Args:
        frame: the frame.
        shown: the memory of the reference camera after it.
        disparity_px, confidence: as :func:`match` gives them.
        context: what is the same for all frames.
    """
    s, rig = context.settings, context.rig
    regions: tuple[Region, ...] = ()
    if context.tracker is not None:
        regions = context.tracker.regions(disparity_px, age_of(shown, s) <= FRESH_FRAMES)
    images = FrameImages(
        time=frame.time,
        view=frame.right if s.reference == "right" else frame.left,
        charge=shown.charge,
        disparity_px=disparity_px,
        bands=shown.bands,
        motion=shown.moved,
        age_frames=age_of(shown, s) if "age_frames" in context.extras else None,
        confidence=confidence,
        depth_m=depth_of(disparity_px, rig) if "depth_m" in context.extras else None,
    )
    points = None
    if context.with_points and rig is not None and images.depth_m is not None:
        points = camera_points(images.depth_m, images.view, shown.moved, s.reference, rig)
    summary = FrameSummary(
        time=frame.time,
        profile=context.guide.profile(disparity_px, shown.moved),
        regions=regions,
        charged=float(np.count_nonzero(shown.charge > s.charge_min)) / disparity_px.size,
        matched=float(np.count_nonzero(~np.isnan(disparity_px))) / disparity_px.size,
        points=points,
    )
    return FrameAnalysis(images, summary)


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
    disparity, confidence = matcher_of(s)(right, left, s)
    chance = confidence() if with_confidence or s.min_confidence > 0 else None
    if s.min_confidence > 0 or s.max_age < FOREVER:
        dropped = age_of(right, s) > s.max_age
        if chance is not None:
            dropped |= chance < s.min_confidence
            chance[dropped] = np.nan
        disparity[dropped] = np.nan
    return disparity, chance
