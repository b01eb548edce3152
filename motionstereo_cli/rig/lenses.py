"""Lens models: their equations, their validity, and maps of pixels."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.rig.cameras import Camera, Maps, Matrix

    Reals = NDArray[np.float64]
    Flattened = tuple[Reals, Reals, NDArray[np.bool_]]

#: Rows of a map that are computed at a time, to save memory.
_ROWS = 32

#: Angles from the axis at which a model's validity is tested.
_ANGLES_RAD = np.linspace(0.0, np.pi, 1801)[:-1]

#: A direction near the axis, as x / z.
_NEAR = 1e-3

#: Coordinate in a map for pixels that a lens does not see; it is outside every image.
_NOWHERE_PX = -1.0


def project(camera: Camera, x: Reals, y: Reals, z: Reals) -> tuple[Reals, Reals]:
    """Return pixels u and v of directions x, y, z in a camera's frame; NaN where there is none.

    All have the same shape. ``pinhole``: OpenCV's. ``fisheye``: Kannala and Brandt (2006), as
    cv2.fisheye. ``omni``: Mei and Rives (2007), as cv2.omnidir and kalibr: xi comes before the
    distortion. ``eucm``: Khomutenko et al. (2016), alpha and beta. ``ds``: Usenko et al. (2018), xi
    and alpha. ``fov``: Devernay and Faugeras (2001), w.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        flat_x, flat_y, holds = _FLATTENED[camera.model](camera.distortion, x, y, z)
    (fx, skew, cx), (below, fy, cy) = camera.matrix[:2]
    u = np.where(holds, fx * flat_x + skew * flat_y + cx, np.nan)
    v = np.where(holds, below * flat_x + fy * flat_y + cy, np.nan)
    return u, v


def _pinhole(parameters: Matrix, x: Reals, y: Reals, z: Reals) -> Flattened:
    holds = z > 0
    points = np.where(holds, [x / z, y / z, np.ones_like(z)], [[0.0], [0.0], [1.0]]).T
    zero = np.zeros(3)
    found = cv2.projectPoints(np.ascontiguousarray(points), zero, zero, np.eye(3), parameters)[0]
    flat_x, flat_y = np.asarray(found, np.float64).reshape(-1, 2).T
    return flat_x, flat_y, holds


def _omni(parameters: Matrix, x: Reals, y: Reals, z: Reals) -> Flattened:
    xi, k1, k2, p1, p2, k3 = np.append(parameters, np.zeros(6 - len(parameters)))
    length = np.sqrt(x * x + y * y + z * z)
    # Beyond this angle the mirror shows nothing.
    holds = z > -length * (xi if xi <= 1 else 1 / xi)
    depth = z + xi * length
    x, y = x / depth, y / depth
    square = x * x + y * y
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    flat_x = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x)
    flat_y = y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y
    return flat_x, flat_y, holds


def _scaled(scale: Reals, x: Reals, y: Reals, holds: NDArray[np.bool_]) -> Flattened:
    """Return components scaled across the axis; on the axis both are 0."""
    scale = np.where((x != 0) | (y != 0), scale, 0.0)
    return x * scale, y * scale, holds & (scale >= 0)


def _fisheye(parameters: Matrix, x: Reals, y: Reals, z: Reals) -> Flattened:
    k1, k2, k3, k4 = parameters
    across = np.hypot(x, y)
    theta = np.arctan2(across, z)
    square = theta * theta
    bent = theta * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4))))
    return _scaled(bent / across, x, y, (across > 0) | (z > 0))


def _fov(parameters: Matrix, x: Reals, y: Reals, z: Reals) -> Flattened:
    w = parameters[0]
    across = np.hypot(x, y)
    bent = np.arctan2(2 * np.tan(w / 2) * across, z) / w
    return _scaled(bent / across, x, y, (across > 0) | (z > 0))


def _eucm(parameters: Matrix, x: Reals, y: Reals, z: Reals) -> Flattened:
    alpha, beta = parameters
    length = np.sqrt(beta * (x * x + y * y) + z * z)
    scale = 1 / (alpha * length + (1 - alpha) * z)
    return _scaled(scale, x, y, z > -length * _behind(alpha))


def _double_sphere(parameters: Matrix, x: Reals, y: Reals, z: Reals) -> Flattened:
    xi, alpha = parameters
    square = x * x + y * y
    length = np.sqrt(square + z * z)
    shifted = z + xi * length
    scale = 1 / (alpha * np.sqrt(square + shifted * shifted) + (1 - alpha) * shifted)
    w1 = _behind(alpha)
    w2 = (w1 + xi) / np.sqrt(2 * w1 * xi + xi**2 + 1)
    return _scaled(scale, x, y, z > -length * w2)


def _behind(alpha: float) -> float:
    return alpha / (1 - alpha) if alpha <= 0.5 else (1 - alpha) / alpha


#: Pixels at focal length 1 around the axis, and where they are valid, by model.
_FLATTENED: dict[str, Callable[[Matrix, Reals, Reals, Reals], Flattened]] = {
    **{"pinhole": _pinhole, "omni": _omni, "fisheye": _fisheye, "fov": _fov, "eucm": _eucm},
    "ds": _double_sphere,
}


def middle_focal_px(camera: Camera) -> float:
    """Return the focal length at the middle of a lens, the mean of both axes, in px."""
    u, v = project(camera, *np.array([[0, _NEAR, 0], [0, 0, _NEAR], [1.0, 1, 1]]))
    return float(np.hypot(u[1:] - u[0], v[1:] - v[0]).mean()) / _NEAR


def widest_rad(camera: Camera) -> float:
    """Return the angle from the axis up to which a model is valid.

    Beyond it a polynomial folds back, and would show the middle of the image again.
    """
    zero = np.zeros_like(_ANGLES_RAD)
    u, _ = project(camera, np.sin(_ANGLES_RAD), zero, np.cos(_ANGLES_RAD))
    grows = np.diff(u) > 0
    return float(_ANGLES_RAD[-1] if grows.all() else _ANGLES_RAD[np.argmin(grows)])


def maps_of(camera: Camera, rotation: Matrix, projection: Matrix, size: tuple[int, int]) -> Maps:
    """Return the position of each rectified pixel in a camera's image: x and y, (height, width).

    Pixels that the lens does not see are outside the image.
    """
    width, height = size
    least_cos = np.cos(widest_rad(camera))
    into_camera = np.linalg.inv(projection[:, :3] @ rotation)
    maps = np.empty((2, height, width), np.float32)
    if camera.model == "pinhole":
        maps[:] = cv2.initUndistortRectifyMap(
            *(camera.matrix, camera.distortion, rotation, projection[:, :3]),
            *(size, cv2.CV_32FC1),
        )
    columns = np.arange(width, dtype=np.float64)
    for top in range(0, height, _ROWS):
        rows = np.arange(top, min(top + _ROWS, height), dtype=np.float64)[:, None]
        x, y, z = (columns * a + (rows * b + c) for a, b, c in into_camera)
        part = maps[:, top : top + _ROWS]
        if camera.model != "pinhole":
            part[:] = project(camera, x, y, z)
        seen = z >= least_cos * np.sqrt(x * x + y * y + z * z)
        part[:, ~(seen & np.isfinite(part).all(axis=0))] = _NOWHERE_PX
    return maps[0], maps[1]
