"""The stream: stereo frames in, results out.

Three separate steps. The memories take the images in order, which is cheap. What depends only on
the memories at one moment is then computed in parallel, in threads or in pieces of a recording
(:func:`analyse`). Heading and objects are sequential; they are computed in order from the few
numbers that each analysis leaves (:func:`follow`).

In permanency mode the memories forget ceil((Chmax - Chmin) / D) frames later.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli import robot
from motionstereo_cli.compiled import checked_array, pictures
from motionstereo_cli.errors import SettingsError
from motionstereo_cli.method.confidence import sigma_px
from motionstereo_cli.method.matching import Match, match
from motionstereo_cli.method.memory import (
    Memory,
    Sighting,
    age_of,
    charged,
    checked_views,
    glance,
    see,
)
from motionstereo_cli.method.settings import AUTO, MATCHERS, Settings
from motionstereo_cli.method.steady import PARTS_PER_PX, averaged
from motionstereo_cli.robot.guide import Guide, guide_of
from motionstereo_cli.robot.objects import Region
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
    from motionstereo_cli.types import Real

#: Parts of a result that take time and are computed on request.
EXTRAS = frozenset({"age_frames", "confidence", "depth_m", "occlusion", "sigma_px"})

#: Of frames with fewer pixels, one more waits than are matched at a time, so that no thread waits
#: for the next: larger ones take much memory, and the wait is a small part of their time.
_SMALL_PX = 1_000_000

#: A disparity locates a moving object if it moved there at most this many frames ago.
FRESH_FRAMES = 3


@dataclass(frozen=True, slots=True)
class TrackingState:
    """The sequential state, besides the memories.

    Attributes:
        guided: the guide's state.
        tracks: the moving objects.
        path: the path of the rig by its own motion; None if that is not followed.
    """

    guided: Any = None
    tracks: Tracks = field(default_factory=Tracks)
    path: robot.odometry.TravelledPath | None = None


@dataclass(frozen=True, slots=True)
class State:
    """All that is kept from frame to frame.

    Attributes:
        right, left: the permanency memories; None before the first frame.
        odometry: state of the odometry; None if not requested.
        movers: state of finding movers; None if not requested.
        own_charge: permanency memory of movers; None if not requested.
        tracking: heading, objects and path.
        recent: results of the last frames, the oldest first.
    """

    right: Memory | None = None
    left: Memory | None = None
    odometry: robot.odometry.Odometry | None = None
    movers: robot.movers.Movers | None = None
    own_charge: NDArray[np.uint8] | None = None
    tracking: TrackingState = field(default_factory=TrackingState)
    recent: tuple[Sighting, ...] = ()


@dataclass(frozen=True, slots=True)
class FrameSummary:
    """The few numbers of a frame that later frames build on.

    Attributes:
        time: which frame it is.
        profile: what the guide takes from it.
        regions: candidates for objects.
        motion: the rig's own since the frame before; None if unknown or not requested.
        charged, matched, at_limit, points: as :class:`~motionstereo_cli.types.Step` has them.
    """

    time: FrameTime
    profile: Any
    regions: tuple[Region, ...]
    motion: robot.odometry.Motion | None
    charged: float
    matched: float
    at_limit: float
    points: tuple[NDArray[np.float64], NDArray[np.uint8]] | None


class FrameAnalysis(NamedTuple):
    """The result of one frame: images, and what later frames need."""

    images: FrameImages
    summary: FrameSummary


class StreamContext(NamedTuple):
    """The constants of a stream.

    Attributes:
        settings: parameters of the processing.
        rig: the camera; None if unknown.
        guide: computes the headings.
        tracker: follows moving objects; None if not requested.
        odometer: finds the rig's own motion; None if not requested.
        mover_finder: finds movers, of which objects then are, while the rig moves; None if not
            requested.
        extras: which of :data:`EXTRAS` the images have.
        with_points: whether steps have points.
        poses_are_given: a frame without a pose is one in which the rig is lost.
    """

    settings: Settings
    rig: Rig | None
    guide: Guide[Any, Any]
    tracker: Tracker | None
    odometer: robot.odometer.Odometer | None
    mover_finder: robot.mover_finder.MoverFinder | None
    extras: frozenset[str]
    with_points: bool
    poses_are_given: bool

    @classmethod
    def of(
        cls,
        settings: Settings,
        rig: Rig | None,
        *,
        with_poses: bool,
        with_objects: bool,
        poses_are_given: bool = False,
        with_own_motion: bool = False,
        with_movers: bool = False,
        motion_offset_px: float = 0.0,
        extras: Collection[str] = EXTRAS,
        with_points: bool = False,
    ) -> StreamContext:
        """Return the context of a stream.

        Movers are found by own motion; ``motion_offset_px`` is added to disparity for that.

        Raises:
            SettingsError: ``max_disparity`` is still to be measured, or a rig is missing.
        """
        if settings.max_disparity == AUTO:
            raise SettingsError(
                "--max-disparity auto: the range is measured by run and batch; give a number here"
            )
        guide = guide_of(settings, rig, with_poses=with_poses)
        tracker = Tracker(settings, rig) if with_objects else None
        odometer, mover_finder = None, None
        if with_own_motion:
            if rig is None:
                raise SettingsError("own motion needs a rig: without it nothing is in metres")
            odometer = robot.odometer.Odometer(rig, settings.max_disparity, motion_offset_px)
            if with_movers:
                mended = rig.with_disparity_offset(motion_offset_px)
                mover_finder = robot.mover_finder.MoverFinder(
                    mended, settings.reference, settings.max_disparity
                )
        finders = tracker, odometer, mover_finder
        asked = frozenset(extras), with_points, poses_are_given
        return cls(settings, rig, guide, *finders, *asked)


def process(
    frames: Iterable[StereoFrame],
    settings: Settings | None = None,
    rig: Rig | None = None,
    pose_of: Callable[[StereoFrame], Pose | None] | Literal["auto"] | None = None,
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
        pose_of: returns the pose of the rig, None where it is lost; called once per frame, in
            order. With it and a rig, the guidance keeps a map of its surroundings. ``auto``: poses
            are found from the frames, in the robot frame of the first one.
        with_objects: find moving objects. With poses and a rig they are what moves by itself, as of
            ``run --save objects``: the rig's own motion is found besides given poses to tell that.
        extras: which of :data:`EXTRAS` the results have; the others are None, and take no time.
        jobs: frames matched at a time; with more than one, up to so many are read before a result
            is given.
        state: the state before the first frame, from an earlier result; None: the initial one.

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
    with_own_motion = pose_of == "auto" or (
        pose_of is not None and with_objects and rig is not None
    )
    context = StreamContext.of(
        settings,
        rig,
        with_poses=pose_of is not None,
        with_objects=with_objects,
        poses_are_given=callable(pose_of),
        with_own_motion=with_own_motion,
        with_movers=with_own_motion,
        extras=extras,
    )
    given = None if pose_of == "auto" else pose_of
    for frame, step, after in steps(frames, context, given, jobs=jobs, state=state):
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
            occlusion=images.occlusion,
            sigma_px=images.sigma_px,
            depth_m=images.depth_m,
            steering=step.steering,
            charged=step.charged,
            matched=step.matched,
            state=after,
            pose=step.pose,
            fix=step.fix,
            own_charge=images.own_charge,
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
        context: the constants of the stream.
    """
    state = state or State()
    tracking = state.tracking
    for frame, after, found in analysed(frames, context, state, jobs):
        pose = None if pose_of is None else pose_of(frame)
        tracking, step = follow(tracking, found.summary, pose, context, found.images)
        after = replace(after, tracking=tracking)  # noqa: PLW2901
        del found
        yield frame, step, after
        del frame, step, after  # a frame takes much memory: none stays while the next one is made


def follow(
    tracking: TrackingState,
    summary: FrameSummary,
    pose: Pose | None,
    context: StreamContext,
    images: FrameImages | None = None,
) -> tuple[TrackingState, Step]:
    """Return the sequential state after a frame, and the frame's step.

    Args:
        tracking: the state before.
        summary: the summary of the frame.
        pose: the pose of the rig; None if unknown, lost, or to be found.
        context: the constants of the stream.
        images: the images of the step.
    """
    tracks, objects = tracking.tracks, tuple[MovingObject, ...]()
    path, fix = tracking.path, None
    is_lost = context.poses_are_given and pose is None
    if context.odometer is not None:
        path, found, quality = context.odometer.follow(path, summary.motion)
        if not context.poses_are_given:
            pose, fix = found, quality
    if context.tracker is not None:
        # Where the rig is lost, nothing is known of places in the world.
        regions = () if is_lost else summary.regions
        tracks, objects = context.tracker.follow(tracks, regions, summary.time, pose)
    seen = summary.profile, pose, summary.time.time_s
    guided, steering = context.guide.steer(tracking.guided, *seen)
    return TrackingState(guided, tracks, path), Step(
        time=summary.time,
        steering=steering,
        objects=objects,
        pose=pose,
        fix=fix,
        charged=summary.charged,
        matched=summary.matched,
        at_limit=summary.at_limit,
        points=summary.points,
        images=images,
    )


def analysed(
    frames: Iterable[StereoFrame], context: StreamContext, state: State, jobs: int
) -> Iterator[tuple[StereoFrame, State, FrameAnalysis]]:
    """Yield each frame, the state after it except the tracking, and its analysis."""
    for frame, after, found in side_by_side(frames, context, state, jobs):
        state, found = with_movers(state, after, found, context)  # noqa: PLW2901
        yield frame, state, found
        del frame, after, found


def side_by_side(
    frames: Iterable[StereoFrame], context: StreamContext, state: State, jobs: int
) -> Iterator[tuple[StereoFrame, State, FrameAnalysis]]:
    """Yield each frame, the memories after it, and its own analysis."""
    recent = deque[Future[Sighting]](maxlen=recent_frames(context.settings))
    for sighting in state.recent:
        recent.append(Future())
        recent[-1].set_result(sighting)
    with ThreadPoolExecutor(jobs, "match") as threads:
        waiting: deque[_Waiting] = deque()
        for frame in frames:
            state, motion = remembered(state, frame, context)
            now, before = Future[Sighting](), tuple(recent)
            recent.append(now)
            found = threads.submit(analyse, frame, state, motion, context, now, before)
            waiting.append(_Waiting(frame, state, tuple(recent), found))
            one_more = jobs > 1 and frame.right.size < _SMALL_PX
            del frame, found
            if len(waiting) >= jobs + one_more:
                yield waiting.popleft().result()
        for each in waiting:
            yield each.result()


class _Waiting(NamedTuple):
    """A frame that is being analysed, the memories after it, and the recent results."""

    frame: StereoFrame
    state: State
    recent: tuple[Future[Sighting], ...]
    found: Future[FrameAnalysis]

    def result(self) -> tuple[StereoFrame, State, FrameAnalysis]:
        """Wait for the result."""
        found = self.found.result()
        recent = tuple(sighting.result() for sighting in self.recent)
        return self.frame, replace(self.state, recent=recent), found


def recent_frames(settings: Settings) -> int:
    """Return the maximum number of earlier frames with which a disparity is averaged."""
    matcher = MATCHERS.get(settings.matcher)
    return settings.average_frames - 1 if matcher is not None and matcher.is_averaged else 0


def remembered(
    state: State, frame: StereoFrame, context: StreamContext
) -> tuple[State, robot.odometry.Motion | None]:
    """Return the memories after a frame, and the rig's own motion if requested.

    Raises:
        InputError: the views cannot be used.
    """
    right, left = checked_views(frame, state.right, context.rig)
    odometry, motion = state.odometry, None
    if context.odometer is not None:
        last = None
        if state.right is not None and state.left is not None:
            last = state.right.grey, state.left.grey
        odometry, motion = context.odometer.step(odometry, last, right, left, frame.index)
    s = context.settings
    matcher = MATCHERS.get(s.matcher)
    other = glance if matcher is not None and not matcher.compares_memories else see
    of_right, of_left = (see, other) if s.reference == "right" else (other, see)
    memories = of_right(state.right, right, s), of_left(state.left, left, s)
    return State(*memories, odometry=odometry), motion


def with_movers(
    before: State, after: State, found: FrameAnalysis, context: StreamContext
) -> tuple[State, FrameAnalysis]:
    """Return the state after a frame, and its analysis, with movers."""
    images, summary = found
    if context.mover_finder is None or after.right is None or after.left is None:
        return after, found
    movers, moved, velocity_mps = context.mover_finder.see(
        *(before.movers, after.right.grey, after.left.grey),
        *(images.disparity_px, summary.motion, images.motion),
        time_s=summary.time.clock_s,
    )
    charge = charged(before.own_charge, moved, context.settings)
    if context.tracker and not robot.mover_finder.stands(summary.motion):
        regions = context.tracker.moving_regions(movers.disparity_px, velocity_mps)
        summary = replace(summary, regions=regions)
    if summary.points is not None and context.rig is not None:
        s = context.settings
        from motionstereo_cli.robot.mapper import apart_from

        recent = charge >= s.charge_max - FRESH_FRAMES * s.charge_leak
        points = apart_from(summary.points, recent, s.reference, context.rig)
        summary = replace(summary, points=points)
    after = replace(after, movers=movers, own_charge=charge)
    return after, FrameAnalysis(replace(images, own_charge=charge), summary)


def analyse(
    frame: StereoFrame,
    state: State,
    motion: robot.odometry.Motion | None,
    context: StreamContext,
    now: Future[Sighting],
    before: Sequence[Future[Sighting]],
) -> FrameAnalysis:
    """Return the analysis of a frame, in the reference view.

    Args:
        frame: the frame.
        state: the memories after it.
        motion: the rig's own.
        context: the constants of the stream.
        now: receives the result of this frame alone, as soon as it is known.
        before: the same of earlier frames, whose analysis began before.
    """
    s, (right, left) = context.settings, (state.right, state.left)
    assert right is not None
    assert left is not None
    shown = right if s.reference == "right" else left
    try:
        found = match(
            *(right, left, s, frame.disparity_px),
            with_confidence=not context.extras.isdisjoint({"confidence", "sigma_px"}),
            with_occlusion="occlusion" in context.extras,
        )
        sighting = Sighting.of(found.disparity_px, shown.grey)
    except BaseException as error:
        now.set_exception(error)
        raise
    now.set_result(sighting)
    earlier = [(each.result().parts, each.result().grey) for each in before]
    if earlier:
        age = age_of(shown, s)
        steady = averaged(found.disparity_px, (sighting.parts, sighting.grey), age, earlier)
        found = found._replace(disparity_px=steady)
    images, summary = described(
        frame, shown, found, motion, context, [parts for parts, _ in earlier]
    )
    return FrameAnalysis(images, summary)


def described(
    frame: StereoFrame,
    shown: Memory,
    found: Match,
    motion: robot.odometry.Motion | None,
    context: StreamContext,
    earlier: Sequence[NDArray[np.uint16]] = (),
) -> tuple[FrameImages, FrameSummary]:
    """Return all results that depend on one frame's disparity.

    Args:
        frame: the frame.
        shown: the memory of the reference camera after it.
        found: its disparity, and further results of the matcher.
        motion: the rig's own.
        context: the constants of the stream.
        earlier: disparity of the last frames, each of its own alone, in parts of a px.
    """
    s, rig, disparity_px = context.settings, context.rig, found.disparity_px
    regions: tuple[Region, ...] = ()
    if context.tracker and (context.mover_finder is None or robot.mover_finder.stands(motion)):
        fresh = age_of(shown, s) <= FRESH_FRAMES
        regions = context.tracker.regions(disparity_px, fresh, earlier, PARTS_PER_PX)
    images = FrameImages(
        time=frame.time,
        view=frame.right if s.reference == "right" else frame.left,
        charge=shown.charge,
        disparity_px=disparity_px,
        bands=shown.bands,
        motion=shown.moved,
        age_frames=age_of(shown, s) if "age_frames" in context.extras else None,
        confidence=found.confidence,
        occlusion=found.occlusion,
        sigma_px=None
        if found.confidence is None or "sigma_px" not in context.extras
        else sigma_px(found.confidence, disparity_px),
        depth_m=depth_of(disparity_px, rig) if "depth_m" in context.extras else None,
        colours=frame.colours,
    )
    points = None
    if context.with_points and rig is not None and images.depth_m is not None:
        from motionstereo_cli.robot.mapper import camera_points

        points = camera_points(images.depth_m, images.look, shown.moved, s.reference, rig)
    summary = FrameSummary(
        time=frame.time,
        profile=context.guide.profile(disparity_px, shown.moved),
        regions=regions,
        motion=motion,
        charged=float(np.count_nonzero(shown.charge > s.charge_min)) / disparity_px.size,
        matched=float(np.count_nonzero(~np.isnan(disparity_px))) / disparity_px.size,
        at_limit=found.at_limit,
        points=points,
    )
    return images, summary


def depth_of(disparity_px: Real, rig: Rig | None) -> Real | None:
    """Return depth in m, (height, width) float32, NaN = unknown; None without a rig.

    Where disparity plus doffs is not positive, the point would be at or beyond infinity: unknown.

    Args:
        disparity_px: x in the left image minus x in the right one, float32, NaN = unknown.
        rig: the camera.
    """
    if rig is None:
        return None
    disparity_px = checked_array(disparity_px, np.float32)
    depth_m = np.empty_like(disparity_px)
    pictures.depth(disparity_px, rig.doffs, rig.focal_baseline, depth_m)
    return depth_m
