"""Own motion of the rig, from frame to frame, and the path that it adds up to.

The motion between two frames depends on at most :data:`BLOCK_FRAMES` frames: each frame is aligned
with a keyframe, and a frame whose number is a multiple of that always becomes the next keyframe,
without any earlier state. The path is the sum of motions (:func:`travelled`).

Coordinates are those of :mod:`motionstereo_cli.robot.alignment`: the right camera's optical frame,
x right, y down, z forward, in m. Vectors of six are translations in m and rotations in rad.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.robot.alignment import (
    ERROR_SIGMAS_PX,
    Alignment,
    Keyframe,
    Lens,
    align,
    keyframe,
    mismatch,
    nearness_of,
    pick,
    pyramid,
)

Grey = NDArray[np.uint8]
Real = NDArray[np.float32]
Reals = NDArray[np.float64]

#: A frame whose number is a multiple of this is a keyframe, independent of earlier ones.
BLOCK_FRAMES = 8
#: So is one that sees less than this share of the last keyframe's points.
_MIN_SEEN = 0.7

#: One alignment is enough with this share of the median score; at first, of the last value. Other
#: starts are tried below the second share, and corners below the third.
_GOOD, _ENOUGH, _POOR, _USUAL_SCORE = 0.9, 0.75, 0.7, 0.85
#: Below it, the rig is lost, unless so many corners agree, and such a share of them, or points of
#: now are found in the last views with the second score.
_MIN_SCORE, _MIN_BACK_SCORE = 0.3, 0.5
_MIN_INLIERS, _MIN_INLIER_SHARE = 15, 0.4
_CORNERS, _CORNER_CELLS = 400, (4, 8)

#: Initial motions without a prior: turns to either side, and ways ahead as shares of the depth.
_TURNS_RAD = np.radians([0, -2, 2, -4, 4, -6, 6, -8, 8, -10, 10])
_AHEAD = (0.0, 0.03, 0.06, 0.1, 0.16, -0.03)
_TRIED = 4
#: Where the motion before is not near enough, the likeliest of these turns is added: by how many
#: px they move the image.
_NEAR_TURNS_PX = np.array([-10.0, -8.0, -6.0, -4.0, -2.0, 2.0, 4.0, 6.0, 8.0, 10.0])

#: An alignment is doubtful if another has this share of its score, and directions to points differ
#: by such an angle, the median: something large that moves by itself may have drawn it away.
_RIVAL_SCORE, _RIVAL_RAD = 0.8, 0.01

#: Limits of the motion in a frame: rotation, and translation as a share of the points' depth.
_MAX_TURN_RAD, _MAX_AHEAD = float(np.radians(15)), 0.5

#: A camera that moves its points by less than the first of these, the median, stands still; so does
#: one that moves them by less than the second where grey agrees nearly as well if it does.
_STILL_PX, _NEARLY_STILL_PX, _STILL_SCORE = 0.1, 8.0, 0.94
#: One of so many points tells it.
_FLOW_STRIDE = 4

#: How much of what a frame says of the error of disparity counts, because points share their
#: errors, and frames their points; and how well it is known at best.
_ERROR_GAIN, _ERROR_FLOOR_PX = 0.0125, 0.02
#: Less than the first of these is not told from none; from the second on it is taken as it is. That
#: is its root mean square over points with such directions per depth.
_ERROR_TOLD_PX, _USUAL_RAYS = (0.06, 0.12), np.array([1.0, 0.3, 0.15])
#: It is lost, too, where the standard deviation of the shift is over such a share of the baseline,
#: or that of the turn over such an angle, and moves points in the image by so many px: before a
#: blank wall, few edges agree with many motions. The likeliest one goes into the path all the same.
_VAGUE_BASELINES, _VAGUE_RAD, _VAGUE_PX = 0.2, 0.014, 1.0
#: Standard deviations of shift and turn in a frame where the rig is lost.
_LOST_M, _LOST_RAD = 0.2, 0.1
#: There it goes on as it last certainly did for so many frames, and then slows down by a factor in
#: each: a motion that never ended would turn the path over. Standard deviations of the change.
_GOES_ON_FRAMES, _SLOWING, _CHANGE_M, _CHANGE_RAD = 16, 0.8, 0.05, 0.1
#: Covariance of a motion over that of its equations, whose points share their errors likewise.
_COVARIANCE = 10.0


#: Of a motion that says nothing of the error of disparity.
_NO_ERROR = np.zeros(3), np.zeros((6, 3)), np.zeros((3, 3)), np.zeros(3)


@dataclass(frozen=True, slots=True)
class Motion:
    """The motion of the rig between two frames.

    Attributes:
        before_from_now: (4, 4) takes places in the right camera of now to those in the one before.
        covariance: (6, 6) of its shift and turn.
        error_px: (3,) error of disparity that it was found with; see
            :data:`.alignment.ERROR_SIGMAS_PX`.
        per_error: (6, 3) shift and turn per px of that error.
        information, evidence: (3, 3) and (3,) normal equations of the error of disparity by this
            frame alone; 0 where it does not say.
        score: share of the points whose grey agrees, 0..1.
        vague: whether it is too uncertain to be a measurement.
    """

    before_from_now: Reals
    covariance: Reals
    error_px: Reals
    per_error: Reals
    information: Reals
    evidence: Reals
    score: float
    vague: bool = False


@dataclass(frozen=True, slots=True)
class Odometry:
    """The state of odometry, at most since the last keyframe by number.

    Attributes:
        key: the last keyframe; None if too few points were visible.
        motion: (4, 4) takes places in its camera to those in the last one.
        velocity: (4, 4) the last motion, from before to after; None where unknown.
        per_error: (6, 3) shift and turn of ``motion`` per px of the error of disparity.
        scores: of the frames since the last keyframe by number.
    """

    key: Keyframe | None
    motion: Reals
    velocity: Reals | None
    per_error: Reals
    scores: tuple[float, ...]


class ViewPair(NamedTuple):
    """Two views of one moment, (height, width) uint8."""

    right: Grey
    left: Grey


def step(
    before: Odometry | None,
    last: ViewPair | None,
    now: ViewPair,
    number: int,
    lens: Lens,
    range_px: int,
    *,
    with_error: bool = False,
) -> tuple[Odometry, Motion | None]:
    """Return the state after a frame, and the motion of the rig since the last one.

    The motion is None if the rig is lost. At the first frame it is zero.

    Args:
        before: the state before; None at the first frame.
        last: the views before.
        now: the views.
        number: of the frame.
        lens: the rig.
        range_px: largest disparity.
        with_error: find the motion with the constant error of disparity, which may be large. Else
            it is found without, and :func:`travelled` corrects for what is told of the error.
    """
    right, left = pyramid(now.right), pyramid(now.left)
    if before is None or last is None:
        return _anew(keyframe(right, left, lens, range_px)), _standing(1.0)
    found = None
    if before.key is not None:
        views = right, left, now.right
        found = _aligned(before, last, views, lens, range_px, with_error=with_error)
        found = _at_rest(before.key, found, right, left, lens) or found
    if found is None or found.score < _MIN_SCORE:
        key = keyframe(right, left, lens, range_px)
        backward = None if key is None else _backward(key, before.velocity, last, lens)
        return _anew(key), backward
    new = number % BLOCK_FRAMES == 0 or found.seen < _MIN_SEEN
    motion, per_error = _motion(before, found, lens)
    if new:
        key = keyframe(right, left, lens, range_px)
        # The start of a new block must not depend on earlier frames.
        if number % BLOCK_FRAMES == 0:
            return _anew(key), motion
        scores, velocity = (*before.scores, found.score), _inverse(motion.before_from_now)
        return replace(_anew(key), velocity=velocity, scores=scores), motion
    assert before.key is not None
    return (
        Odometry(
            replace(before.key, light=found.light),
            found.motion,
            _inverse(motion.before_from_now),
            per_error,
            (*before.scores, found.score),
        ),
        motion,
    )


def _anew(key: Keyframe | None) -> Odometry:
    return Odometry(key, np.eye(4), None, np.zeros((6, 3)), ())


def _standing(score: float) -> Motion:
    return Motion(np.eye(4), np.zeros((6, 6)), *_NO_ERROR, score)


def _aligned(
    before: Odometry,
    last: ViewPair,
    now: tuple[list[Real], list[Real], Grey],
    lens: Lens,
    range_px: int,
    *,
    with_error: bool,
) -> Alignment | None:
    """Return the best of the alignments from several starts."""
    right, left, image = now
    key = before.key
    assert key is not None
    best: Alignment | None = None
    others: list[Alignment] = []
    depth_m = _depth_m(key, lens)

    def attempt(start: Reals, *, near: bool = False) -> None:
        nonlocal best
        found = align(key, right, left, lens, start, with_error=with_error, near=near)
        if found is None or not _plausible(before.motion @ _inverse(found.motion), depth_m):
            return
        if best is None or found.score > best.score:
            best, found = found, best
        if found is not None:
            others.append(found)

    usual = float(np.median(before.scores)) if len(before.scores) > 2 else _USUAL_SCORE

    def below(share: float) -> bool:
        return best is None or best.score < share * usual

    if before.velocity is not None:
        # From farther off, something large that moves by itself may draw it away.
        attempt(before.velocity @ before.motion, near=True)
        if below(_ENOUGH):
            turned = _turns(_NEAR_TURNS_PX / lens.focal_px[0]) @ before.velocity @ before.motion
            costs = mismatch(key, right, lens, turned, near=True)
            attempt(turned[np.argmin(costs)], near=True)
        if below(_GOOD):
            attempt(before.velocity @ before.motion)
    if below(_ENOUGH):
        starts = _starts(depth_m) @ before.motion
        costs = mismatch(key, right, lens, starts)
        for number in np.argsort(costs, kind="stable")[:_TRIED]:
            attempt(starts[number])
            attempt(starts[number], near=True)
            if not below(_ENOUGH):
                break
    if below(_POOR):
        corners = _by_corners(last, image, lens, range_px)
        if corners is not None:
            motion, sure = corners
            attempt(motion @ before.motion)
            sure &= _plausible(motion, depth_m)
            if sure and (best is None or best.score < _MIN_SCORE):
                shift, turn = (_COVARIANCE / sigma**2 for sigma in (_LOST_M, _LOST_RAD))
                unknown = np.diag([shift] * 3 + [turn] * 3 + [1.0] * 7 + [0.0])[:13]
                there, quality = motion @ before.motion, (np.zeros(3), _MIN_SCORE, 0.0)
                return Alignment(there, key.light, *quality, unknown, by_corners=True)
    if best is not None and _has_rival(key, best, others, lens):
        best = replace(best, doubtful=True)
    return best


def _has_rival(key: Keyframe, best: Alignment, others: Iterable[Alignment], lens: Lens) -> bool:
    """Return whether another alignment agrees nearly as well, but with another motion."""
    back, enough = _inverse(best.motion), _RIVAL_SCORE * best.score
    rivals = (each.motion @ back for each in others if each.score > enough)
    most_px = _RIVAL_RAD * lens.focal_px[0]
    return any(_flow_px(key, motion, lens) > most_px for motion in rivals)


def _depth_m(key: Keyframe, lens: Lens) -> float:
    """Return the typical depth of a keyframe's points."""
    return lens.focal_px[0] * lens.baseline_m / float(np.median(key.points[:, 2]))


def _plausible(motion: Reals, depth_m: float) -> bool:
    """Return whether a motion between two frames is plausible."""
    cos = (float(np.trace(motion[:3, :3])) - 1) / 2
    near = float(np.linalg.norm(motion[:3, 3])) <= _MAX_AHEAD * depth_m
    return near and cos >= np.cos(_MAX_TURN_RAD)


def _starts(depth_m: float) -> Reals:
    """Return candidate motions (n, 4, 4): turns and ways ahead.

    Args:
        depth_m: about how far off things are.
    """
    turned = _turns(_TURNS_RAD)
    starts = np.repeat(turned[None], len(_AHEAD), axis=0)
    starts[:, :, 2, 3] = -np.array(_AHEAD)[:, None] * depth_m
    return starts.reshape(-1, 4, 4)


def _turns(angles_rad: Reals) -> Reals:
    """Return motions (n, 4, 4) that turn to the side by some angles (n,)."""
    motions = np.tile(np.eye(4), (len(angles_rad), 1, 1))
    motions[:, 0, 0] = motions[:, 2, 2] = np.cos(angles_rad)
    motions[:, 0, 2] = np.sin(angles_rad)
    motions[:, 2, 0] = -motions[:, 0, 2]
    return motions


def _at_rest(
    key: Keyframe, found: Alignment | None, right: list[Real], left: list[Real], lens: Lens
) -> Alignment | None:
    """Return the alignment of a rig at rest; None if it moves."""
    flow_px = 0.0
    if found is not None:
        flow_px, key = _flow_px(key, found.motion, lens), replace(key, light=found.light)
    if flow_px >= _NEARLY_STILL_PX:
        return None
    none = np.eye(4)
    rest = align(key, right, left, lens, none, pinned=True)
    if rest is None or found is None or flow_px < _STILL_PX:
        return rest
    return rest if rest.score >= _STILL_SCORE * found.score else None


def _flow_px(key: Keyframe, motion: Reals, lens: Lens) -> float:
    """Return the median displacement of a keyframe's points in the image by a motion."""
    points = key.points[::_FLOW_STRIDE]
    rays = np.column_stack([points[:, :2], np.ones(len(points))])
    inverse = points[:, 2] / (lens.focal_px[0] * lens.baseline_m)
    moved = rays @ motion[:3, :3].T + inverse[:, None] * motion[:3, 3]
    flow = (moved[:, :2] / np.maximum(moved[:, 2:], 1e-3) - rays[:, :2]) * lens.focal_px
    return float(np.median(np.hypot(*flow.T)))


def _motion(before: Odometry, found: Alignment, lens: Lens) -> tuple[Motion, Reals]:
    """Return the motion since the last frame, and how the one since the keyframe heeds the error.

    Args:
        before: what was known before.
        found: the alignment with the keyframe.
        lens: the rig.
    """
    step_back = before.motion @ _inverse(found.motion)
    normal = found.normal
    # Each unknown as the last ones, the error of disparity, and the right side determine it.
    solved: Any = np.linalg.solve(normal[:10, :10], normal[:10, 10:])
    reduced = normal[10:, 10:] - normal[10:, :10] @ solved
    covariance: Any = _COVARIANCE * np.linalg.inv(normal[:10, :10])[:6, :6]
    moves = not np.array_equal(found.motion, np.eye(4))
    per_error: Reals = -solved[:6, :3] if moves else np.zeros((6, 3))
    information, evidence = reduced[:, :3], reduced[:, :3] @ found.error_px - reduced[:, 3]
    variance = np.diag(covariance)
    sigma_m, sigma_rad = (float(np.sqrt(part.sum())) for part in (variance[:3], variance[3:]))
    seen_rad = _VAGUE_PX / lens.focal_px[0]
    assert before.key is not None
    unsure = sigma_m > max(
        _VAGUE_BASELINES * lens.baseline_m, seen_rad * _depth_m(before.key, lens)
    )
    unsure |= sigma_rad > max(_VAGUE_RAD, seen_rad)
    # Corners do not say how sure they are, but enough of them agree.
    vague = (moves and unsure and not found.by_corners) or found.doubtful
    motion = Motion(
        before_from_now=step_back,
        covariance=covariance,
        error_px=found.error_px,
        per_error=before.per_error - adjoint(step_back) @ per_error,
        information=information * moves,
        evidence=evidence * moves,
        score=found.score,
        vague=vague,
    )
    return motion, per_error


def _backward(key: Keyframe, velocity: Reals | None, last: ViewPair, lens: Lens) -> Motion | None:
    """Return the motion since the last frame by the points of now; None where they are not found.

    Args:
        key: the points of now.
        velocity: (4, 4) the motion before, from before to after; None where unknown.
        last: the views before.
        lens: the rig.
    """
    views = pyramid(last.right), pyramid(last.left)
    start = np.eye(4) if velocity is None else _inverse(velocity)
    tried = [align(key, *views, lens, start, near=near) for near in (True, False)]
    found = max((each for each in tried if each), key=lambda each: each.score, default=None)
    if found is None or found.score < _MIN_BACK_SCORE:
        return None
    if not _plausible(found.motion, _depth_m(key, lens)):
        return None
    back = replace(found, motion=_inverse(found.motion))
    motion, per_error = _motion(_anew(key), back, lens)
    return replace(motion, per_error=per_error)


def _by_corners(
    last: ViewPair, image: Grey, lens: Lens, range_px: int
) -> tuple[Reals, bool] | None:
    """Return the motion from matched corners, and whether many of them agree."""
    right, left = pyramid(last.right)[0], pyramid(last.left)[0]
    places = pick(right, _CORNERS, _CORNER_CELLS)
    near = nearness_of(right, left, places, lens, range_px)[:, 0]
    known = near > 0.5
    at = places[known].astype(np.float32)
    if len(at) < _MIN_INLIERS:
        return None
    none = np.empty(0, np.float32)
    track = partial(cv2.calcOpticalFlowPyrLK, nextPts=none, winSize=(15, 15), maxLevel=4)
    after, there, _ = track(last.right, image, prevPts=at)
    again, back, _ = track(image, last.right, prevPts=after)
    kept = (there[:, 0] == 1) & (back[:, 0] == 1) & (np.abs(again - at).max(axis=1) < 0.7)
    if np.count_nonzero(kept) < _MIN_INLIERS:
        return None
    depth_m = lens.focal_px[0] * lens.baseline_m / near[known][kept].astype(np.float64)
    centre = np.array([lens.right_cx_px, lens.cy_px])
    rays = (at[kept] - centre) / lens.focal_px
    points = np.column_stack([rays, np.ones(len(rays))]) * depth_m[:, None]
    camera = np.array(
        [[lens.focal_px[0], 0, centre[0]], [0, lens.focal_px[1], centre[1]], [0, 0, 1]]
    )
    found, turn, shift, agree = cv2.solvePnPRansac(
        *(points, after[kept].astype(np.float64), camera, None),
        iterationsCount=200,
        reprojectionError=2.0,
        confidence=0.999,
        flags=cv2.SOLVEPNP_SQPNP,
    )
    if not found or agree is None or len(agree) < 10:
        return None
    motion = np.eye(4)
    motion[:3, :3] = cv2.Rodrigues(turn)[0]
    motion[:3, 3] = shift[:, 0]
    sure = len(agree) >= _MIN_INLIERS and len(agree) > _MIN_INLIER_SHARE * len(points)
    return motion, sure


@dataclass(frozen=True, slots=True)
class TravelledPath:
    """The path of the rig.

    Attributes:
        pose: (4, 4) takes places in the right camera of now to those in the first one.
        covariance: (6, 6) of its shift and turn, of errors that frames do not share.
        error_px: (3,) error of disparity by all frames so far.
        information: (3, 3) inverse of its covariance.
        last: (4, 4) the last motion that is known, slower where that is long ago.
        lost: frames since one that was not lost.
    """

    pose: Reals
    covariance: Reals
    error_px: Reals
    information: Reals
    last: Reals
    lost: int = 0


def setting_out() -> TravelledPath:
    """Return the path before the first frame."""
    unsure = np.diag(1 / np.square(ERROR_SIGMAS_PX))
    return TravelledPath(np.eye(4), np.zeros((6, 6)), np.zeros(3), unsure, np.eye(4))


def travelled(path: TravelledPath, motion: Motion | None) -> TravelledPath:
    """Return the path a frame later.

    A motion is corrected, to first order, for the error of disparity estimated from all frames.
    While the rig is lost, which :attr:`TravelledPath.lost` tells, it is assumed to go on as before,
    and later to slow down; of a vague motion, only what is surer than that counts.
    """
    if motion is None or motion.vague:
        slowing = _SLOWING if path.lost >= _GOES_ON_FRAMES else 1.0
        last = moved = _small(slowing * _vector(path.last))
        if motion is not None:
            change = np.diag([_CHANGE_M**2] * 3 + [_CHANGE_RAD**2] * 3)
            gain = motion.covariance @ np.linalg.inv(motion.covariance + change)
            off = _vector(moved @ _inverse(motion.before_from_now))
            moved = _small(gain @ off) @ motion.before_from_now
        unsure = np.diag([_LOST_M**2] * 3 + [_LOST_RAD**2] * 3)
        turned = adjoint(_inverse(moved))
        return replace(
            path,
            pose=path.pose @ moved,
            covariance=turned @ (path.covariance + unsure) @ turned.T,
            last=last,
            lost=path.lost + 1,
        )
    information = path.information + _ERROR_GAIN * motion.information
    evidence = path.information @ path.error_px + _ERROR_GAIN * motion.evidence
    error: Any = np.linalg.solve(information, evidence)
    moved = _small(motion.per_error @ (told(error) - motion.error_px)) @ motion.before_from_now
    turned = adjoint(_inverse(moved))
    return TravelledPath(
        pose=path.pose @ moved,
        covariance=turned @ (path.covariance + motion.covariance) @ turned.T,
        error_px=error,
        information=_limited(information),
        last=moved,
    )


def _limited(information: Reals) -> Reals:
    """Return information of :data:`_ERROR_FLOOR_PX` at most."""
    values, vectors = np.linalg.eigh(information)
    limited: Reals = (vectors * np.minimum(values, _ERROR_FLOOR_PX**-2)) @ vectors.T
    return limited


def told(error_px: Reals) -> Reals:
    """Return a measured error of disparity (3,) in px, 0 if it is insignificant."""
    low_px, high_px = _ERROR_TOLD_PX
    size_px = float(np.linalg.norm(error_px * _USUAL_RAYS))
    return error_px * min(max((size_px - low_px) / (high_px - low_px), 0.0), 1.0)


def adjoint(motion: Reals) -> Reals:
    """Return the (6, 6) matrix that takes small motions to where a motion (4, 4) takes places."""
    turn, (x, y, z) = motion[:3, :3], motion[:3, 3].tolist()
    result = np.zeros((6, 6))
    result[:3, :3] = result[3:, 3:] = turn
    result[:3, 3:] = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ turn
    return result


def _small(shift_and_turn: Reals) -> Reals:
    motion = np.eye(4)
    motion[:3, :3] = cv2.Rodrigues(shift_and_turn[3:])[0]
    motion[:3, 3] = shift_and_turn[:3]
    return motion


def _vector(motion: Reals) -> Reals:
    """Return the shift and turn of a motion (4, 4), the inverse of :func:`_small`."""
    return np.concatenate([motion[:3, 3], cv2.Rodrigues(motion[:3, :3])[0][:, 0]])


def _inverse(motion: Reals) -> Reals:
    """Return the inverse of a motion (4, 4)."""
    back = np.eye(4)
    back[:3, :3] = motion[:3, :3].T
    back[:3, 3] = -motion[:3, :3].T @ motion[:3, 3]
    return back
