"""Points in space: from depth to the camera's frame, and on to the world's."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float64]


def points(
    depth_m: NDArray[np.float32],
    which: NDArray[np.bool_],
    *,
    focal_px: tuple[float, float],
    cx_px: float,
    cy_px: float,
) -> Reals:
    """Return pixels as points of their camera's optical frame, (n, 3) float64 m, in reading order.

    The frame is that of OpenCV and REP 103: origin in the optical centre, x right, y down, z along
    the optical axis: x = (column - cx) z / fx, y = (row - cy) z / fy.

    Args:
        depth_m: depth along the optical axis, (height, width) float32.
        which: pixels to give; their depth has to be known, (height, width) bool.
        focal_px: focal lengths along x and y.
        cx_px, cy_px: principal point.
    """
    row, column = np.nonzero(which)
    z = depth_m[row, column].astype(np.float64)
    fx_px, fy_px = focal_px
    return np.stack([(column - cx_px) * z / fx_px, (row - cy_px) * z / fy_px, z], axis=1)


def in_world(
    points_m: Reals,
    *,
    camera_left_m: float,
    place_m: tuple[float, float, float],
    quaternion: tuple[float, float, float, float],
) -> Reals:
    """Return points of a camera's optical frame in the world frame, (n, 3) float64 m.

    Args:
        points_m: (n, 3) float64 m, x right, y down, z forward.
        camera_left_m: how far left of the rig's middle the camera sits.
        place_m: the rig's middle in the world.
        quaternion: qx, qy, qz, qw: turns directions of the rig (x forward, y left, z up) into the
            world's; its length does not matter.
    """
    right, down, forward = points_m.T
    x, y, z, w = np.asarray(quaternion) / np.linalg.norm(quaternion)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    of_rig = np.stack([forward, camera_left_m - right, -down], axis=1)
    turned: Reals = of_rig @ rotation.T + np.asarray(place_m)
    return turned
