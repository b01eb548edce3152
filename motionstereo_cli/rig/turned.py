"""Cameras one above the other: the pair after its images are turned by 90 degrees."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from motionstereo_cli.errors import InputError
from motionstereo_cli.rig.cameras import Camera, Pair

if TYPE_CHECKING:
    from motionstereo_cli.rig.cameras import Matrix, Rectified


def is_vertical(pair: Pair) -> bool:
    """Return whether the cameras are one above the other."""
    if pair.translation is not None:
        tx, ty, tz = np.abs(pair.translation)
        return bool(ty > max(tx, tz))
    if pair.rectified is None:
        return False
    (_, left), (_, right) = pair.rectified
    tx, ty = np.abs(left[:2, 3] - right[:2, 3])
    return bool(ty > tx)


def turned(name: object, pair: Pair, size: tuple[int, int], degrees: int) -> Pair:
    """Return the calibration of a pair whose images are turned clockwise.

    Args:
        name: the file, for messages.
        pair: as read from the files.
        size: width and height of its images in px, before turning.
        degrees: 90 or 270.

    Raises:
        InputError: a lens has a tilted sensor, which cannot be turned.
    """
    width, height = size
    # Directions and pixels: the top moves to the right, or to the left.
    if degrees == 90:
        turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
        pixels = np.array([[0.0, -1, height - 1], [1, 0, 0], [0, 0, 1]])
    else:
        turn = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
        pixels = np.array([[0.0, 1, 0], [-1, 0, width - 1], [0, 0, 1]])
    in_space = np.eye(4)
    in_space[:3, :3] = turn

    def camera(before: Camera) -> Camera:
        distortion = _turned_distortion(name, before, clockwise=degrees == 90)
        return Camera(pixels @ before.matrix @ turn.T, distortion, before.model)

    def rectified(before: Rectified) -> Rectified:
        rotation, projection = before
        return turn @ rotation @ turn.T, pixels @ projection @ in_space.T

    return dataclasses.replace(
        pair,
        cameras=pair.cameras and (camera(pair.cameras[0]), camera(pair.cameras[1])),
        rotation=None if pair.rotation is None else turn @ pair.rotation @ turn.T,
        translation=None if pair.translation is None else turn @ pair.translation,
        rectified=pair.rectified and (rectified(pair.rectified[0]), rectified(pair.rectified[1])),
        size=(height, width),
        body_from_left=None if pair.body_from_left is None else pair.body_from_left @ in_space.T,
    )


def _turned_distortion(name: object, camera: Camera, *, clockwise: bool) -> Matrix:
    """Return OpenCV's coefficients of a turned lens: y becomes x."""
    if camera.model not in ("pinhole", "omni"):
        return camera.distortion  # rotationally symmetric
    if camera.model == "omni":
        xi, flat = camera.distortion[:1], Camera(camera.matrix, camera.distortion[1:])
        return np.append(xi, _turned_distortion(name, flat, clockwise=clockwise))
    found, sign = camera.distortion.copy(), 1 if clockwise else -1
    p1, p2 = found[2:4]
    found[2:4] = sign * p2, -sign * p1
    if found.size > 8:
        s1, s2, s3, s4 = found[8:12]
        found[8:12] = -sign * s3, -sign * s4, sign * s1, sign * s2
    if found[12:].any():
        raise InputError(f"{name}: a tilted sensor cannot be turned: calibrate the turned images")
    return found
