"""Bodies: what moves in parts at different depths, as head and shoulders seen from above.

Parts of a body stay at one place over ground and have one velocity, however high each of them is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.robot.objects import Region, Track, lies
from motionstereo_cli.types import Rig

#: Two parts of a body have stayed so near each other over ground in so many of the last frames.
_NEAR_M, _MIN_FRAMES = 0.5, 6
#: Their velocities differ by no more than the larger of this and so many standard deviations.
_ALIKE_MPS, _SIGMAS = 0.3, 2.0
#: None are farther apart over ground, nor in height.
_WIDTH_M, _HEIGHT_M = 1.0, 2.2


def joined(tracks: Sequence[Track], rig: Rig) -> tuple[Track, ...]:
    """Return tracks, each with the body that it is a part of.

    Only what is in the last frame, and no shadow, joins a body or leaves it.
    """
    seen = [each for each in tracks if not each.missed and not lies(each)]
    seen.sort(key=lambda each: each.number)
    if len(seen) < 2:
        return tuple(tracks)
    looks_down = _looks_down(seen, rig)
    place_m = _places([each.observations[-1].region for each in seen], rig, looks_down)
    apart_m = np.abs(place_m[:, None] - place_m)
    over_ground_m = np.hypot(apart_m[..., 0], apart_m[..., 1])
    wide = (over_ground_m > _WIDTH_M) | (apart_m[..., 2] > _HEIGHT_M)
    body = np.array([each.body for each in seen])
    for older, younger in np.argwhere(np.triu(wide, 1)):
        if body[older] == body[younger]:
            body[younger] = seen[younger].number
    for older, younger in np.argwhere(np.triu(over_ground_m <= _NEAR_M, 1)):
        both = (body == body[older]) | (body == body[younger])
        if body[older] == body[younger] or wide[np.ix_(both, both)].any():
            continue
        if _stay_together(seen[older], seen[younger], rig, looks_down):
            body[both] = body[both].min()
    found = {each.number: number for each, number in zip(seen, body.tolist(), strict=True)}
    return tuple(replace(each, part_of=found.get(each.number, each.part_of)) for each in tracks)


def _stay_together(one: Track, other: Track, rig: Rig, looks_down: bool) -> bool:
    """Return whether two objects have been at one place over ground, with one velocity."""
    ones = {each.time_s: each.region for each in one.observations}
    others = {each.time_s: each.region for each in other.observations if each.time_s in ones}
    if len(others) < _MIN_FRAMES:
        return False
    one_m = _places([ones[time_s] for time_s in others], rig, looks_down)
    apart_m = (_places([*others.values()], rig, looks_down) - one_m)[:, :2]
    along_s = np.array([*others]) - np.mean([*others])
    drift_mps = along_s @ apart_m / (along_s @ along_s)
    left_m = apart_m - apart_m.mean(axis=0) - along_s[:, None] * drift_mps
    sigma_mps = math.sqrt((left_m**2).sum() / (len(others) - 2) / (along_s @ along_s))
    alike = np.hypot(*drift_mps) <= max(_ALIKE_MPS, _SIGMAS * sigma_mps)
    return bool(alike and np.hypot(*apart_m.T).max() <= _NEAR_M)


def _looks_down(tracks: Sequence[Track], rig: Rig) -> bool:
    """Return whether all stand on the surface that filled the view lately: no higher than a body.

    Of a wall far behind them they do not.
    """
    regions = [each.region for track in tracks for each in track.observations]
    floor_px = [each.surface_px for each in regions if each.surface_px is not None]
    if not floor_px:
        return False
    nearest_px = max(each.nearness_px for each in regions)
    return rig.focal_baseline * (1 / min(floor_px) - 1 / nearest_px) <= _HEIGHT_M


def _places(regions: Sequence[Region], rig: Rig, looks_down: bool) -> NDArray[np.float64]:
    """Return where regions are from the camera, (n, 3), in m: two axes over ground, and height."""
    ahead_m = rig.focal_baseline / np.array([each.nearness_px for each in regions])
    across_m = (np.array([each.middle_x for each in regions]) - rig.cx) * ahead_m / rig.focal_px
    down_m = (np.array([each.middle_y for each in regions]) - rig.cy) * ahead_m / rig.fy_px
    rest_m = (down_m, ahead_m) if looks_down else (ahead_m, down_m)
    return np.stack([across_m, *rest_m], axis=1)
