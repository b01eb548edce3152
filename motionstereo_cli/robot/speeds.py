"""Speeds of objects: by their places in the last frames, or by velocities of single frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.robot.objects import KEPT, NORMAL, WAY_SIGHTINGS, Observation, Track, median

#: Places tell a speed once there are so many.
_MIN_FITTED = 6
_LATER, _EARLIER = np.tril_indices(KEPT, -1)
#: How much a velocity may change in a second.
_ACCELERATION_MPS2 = 3.0
#: What moves by itself is faster than the first over ground, and nothing than the second.
_MIN_OVER_GROUND_MPS, _MAX_OVER_GROUND_MPS = 0.2, 50.0
#: And than so many standard deviations by its places; by single frames, in mean and median.
_SIGMAS, _MEAN_SIGMAS, _SURE_SIGMAS = 2.0, 1.0, 0.5
#: A fit that misses the nearness by so much, on average, is worth half.
_HALF_WORTH_PX = 0.5


@dataclass(frozen=True, slots=True)
class Movement:
    """The recent motion of an object, at constant velocity.

    Attributes:
        from_camera_mps: along the x and y axes of the world, as seen from the camera.
        over_ground_mps: the same over ground.
        residual: by how much its observations miss that, the median, as a share of its distance.
        sigma_mps: standard deviation of the speed over ground, from these residuals.
    """

    from_camera_mps: tuple[float, float]
    over_ground_mps: tuple[float, float]
    residual: float
    sigma_mps: float


def movement(track: Track) -> Movement | None:
    """Return the motion of an object; None while unknown.

    The mean of its velocities by single frames, the less weight the older; where there are none,
    the median of the slopes between all pairs of observations (Theil and Sen), of the middle and
    of both ends of the box: what something before it hides moves one of these.
    """
    time_s = np.array([observation.time_s for observation in track.observations])
    places = np.array([(*s.offset_m, *s.place_m) for s in track.observations])
    measured = _mean_velocity(track.observations)
    if measured is not None and len(time_s) > 1:
        velocity_mps, *sigmas = measured
        sigma = math.hypot(*sigmas)
        camera_m = (places[:, 2:] - places[:, :2])[-WAY_SIGHTINGS:]
        camera_mps = (camera_m[-1] - camera_m[0]) / (time_s[-1] - time_s[-len(camera_m)])
        speed = np.concatenate([velocity_mps - camera_mps, velocity_mps])
    elif len(time_s) >= _MIN_FITTED:
        count = len(time_s) * (len(time_s) - 1) // 2
        later, earlier = _LATER[:count], _EARLIER[:count]
        apart_s = (time_s[later] - time_s[earlier])[:, None]
        ends = np.array([(0, 0, *each.ends_m) for each in track.observations]).reshape(-1, 3, 2)
        each = places[:, None] + np.tile(ends, 2)
        speeds = median((each[later] - each[earlier]) / apart_s[..., None])
        speed = median(speeds)
        sigma = _slope_sigma(time_s, places[:, 2:] - speeds[0, 2:] * time_s[:, None])
        sigma = math.hypot(sigma, *(np.ptp(speeds[:, 2:], axis=0) / 2))
    else:
        return None
    offset = places[:, :2]
    off = offset - speed[:2] * time_s[:, None]
    off = np.abs(off - median(off)).sum(axis=1)
    residual = float(median(off)) / float(np.abs(offset).sum(axis=1).min())
    x, y, ground_x, ground_y = speed.tolist()
    return Movement((x, y), (ground_x, ground_y), residual, sigma)


def moves_surely(track: Track) -> bool:
    """Return whether velocities by single frames are significant and possible, where there are any.

    Not only their mean, which a single frame that is wrong may decide, but also their median. What
    they may have changed by since does not count: it moved.
    """
    mean = _mean_velocity(track.observations)
    if mean is None:
        return True
    told = ((each.velocity_mps, each.region.sigma_mps) for each in track.observations)
    sigmas = [math.hypot(*velocity) / sigma for velocity, sigma in told if velocity is not None]
    speed_mps = math.hypot(*mean[0])
    fast = max(_MIN_OVER_GROUND_MPS, _MEAN_SIGMAS * mean[1]) < speed_mps < _MAX_OVER_GROUND_MPS
    return fast and float(median(np.array(sigmas))) > _SURE_SIGMAS


def by_itself(track: Track, moves: Movement) -> bool:
    """Return whether an object moves over ground significantly."""
    if _mean_velocity(track.observations) is not None:
        return moves_surely(track)
    speed_mps = math.hypot(*moves.over_ground_mps)
    return speed_mps > max(_MIN_OVER_GROUND_MPS, _SIGMAS * moves.sigma_mps)


def _mean_velocity(
    observations: Sequence[Observation],
) -> tuple[NDArray[np.float64], float, float] | None:
    """Return the weighted mean of the velocities by single frames, (2,), and two sigmas.

    That of their errors, which are independent, and that of an acceleration since then, which is
    common to all.
    """
    known = [each for each in observations if each.velocity_mps is not None]
    if not known:
        return None
    last_s = known[-1].time_s
    changed_mps = _ACCELERATION_MPS2 * np.array([last_s - k.time_s + k.region.age_s for k in known])
    sigma_mps = np.array([each.region.sigma_mps for each in known])
    weight = 1 / np.square([sigma_mps, changed_mps]).sum(axis=0)
    weight = weight / weight.sum()
    velocity_mps = weight @ np.array([each.velocity_mps for each in known])
    return velocity_mps, math.hypot(*(weight * sigma_mps)), float(weight @ changed_mps)


def _slope_sigma(time_s: NDArray[np.float64], left_m: NDArray[np.float64]) -> float:
    """Return the standard deviation of a slope over (n,) times, from what it leaves, (n, 2)."""
    off_m = np.abs(left_m - median(left_m))
    spread = float(np.hypot(*(NORMAL * median(off_m))))
    along_s = time_s - time_s.mean()
    return spread / float(np.sqrt(along_s @ along_s))


def trust(track: Track, moves: Movement | None) -> float:
    """Return the confidence of an object and its speed, 0..1.

    The share of the fitted frames that it has been seen in, times the known share of its pixels,
    times 1 / (1 + r / 0.5 px) for observations that miss the fitted movement by r, in disparity.
    """
    region = track.observations[-1].region
    off_px = 0.0 if moves is None else moves.residual * region.nearness_px
    return min(track.seen / KEPT, 1) * region.known / (1 + off_px / _HALF_WORTH_PX)
