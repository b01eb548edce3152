"""True moving objects of a rendered view, for the evaluation of objects."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from motionstereo_cli.robot.tracker import contact_s
from motionstereo_cli.simulate.camera import FloorPose
from motionstereo_cli.types import MovingObject

if TYPE_CHECKING:
    from motionstereo_cli.types import Grey, Real

#: Places in m on the floor, by the number of what moves by itself, at a time in s.
Places = Callable[[float], Mapping[int, tuple[float, float]]]

#: Speeds are taken over so short a time.
_MOMENT_S = 1e-3


def moving_objects(
    mover: Grey,
    depth_m: Real,
    time_s: float,
    pose_at: Callable[[float], FloorPose],
    places_at: Places,
) -> Iterator[MovingObject]:
    """Yield what moves by itself in a view, as far as it is seen there.

    Args:
        mover: (height, width) uint8 number of what moves by itself, 0 = nothing.
        depth_m: (height, width) float32 depth.
        time_s: when it is.
        pose_at: where the rig is at a time.
        places_at: where everything that moves by itself is at a time.
    """
    places, soon = places_at(time_s), places_at(time_s + _MOMENT_S)
    pose, after = pose_at(time_s), pose_at(time_s + _MOMENT_S)
    for number in np.unique(mover[mover > 0]).tolist():
        rows, columns = np.nonzero(mover == number)
        way_m = np.subtract(soon[number], places[number])
        rig_m = np.array([after.x_m - pose.x_m, after.y_m - pose.y_m])
        closing_mps = float((rig_m - way_m) @ pose.forward) / _MOMENT_S
        ahead_m = float(np.median(depth_m[rows, columns]))
        yield MovingObject(
            id=number,
            x=int(columns.min()),
            y=int(rows.min()),
            width=int(np.ptp(columns)) + 1,
            height=int(np.ptp(rows)) + 1,
            depth_m=ahead_m,
            closing_mps=closing_mps,
            time_to_contact_s=contact_s(ahead_m, closing_mps),
            confidence=1.0,
            place_m=(float(places[number][0]), float(places[number][1])),
            velocity_mps=(float(way_m[0]) / _MOMENT_S, float(way_m[1]) / _MOMENT_S),
            sigma_mps=0.0,
            by_itself=bool(way_m.any()),
        )
