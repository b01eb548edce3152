"""Calibrated cameras, and the lens models that are understood."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from motionstereo_cli.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Matrix = NDArray[np.float64]

    #: Rotation (3, 3) and projection (3, 4) into a rectified image.
    Rectified = tuple[Matrix, Matrix]

#: Names of lens models, in lower case without signs. Kannala and Brandt's has many.
_FISHEYE = frozenset(
    {
        "fisheye",
        "equidistant",
        "equi",
        "pinholeequi",
        "pinholeequidistant",
        "kb",
        "kb4",
        "kb8",
        "kannalabrandt",
        "kannalabrandt4",
        "kannalabrandt8",
        "opencvfisheye",
        "fisheyeopencv",
    }
)
_PINHOLE = frozenset(
    {
        "pinhole",
        "perspective",
        "plumbbob",
        "radtan",
        "radtan4",
        "radtan5",
        "radtan8",
        "pinholeradtan",
        "radialtangential",
        "radialtangential4",
        "brown",
        "brownconrady",
        "rational",
        "rationalpolynomial",
        "thinprism",
        "opencv",
        "fullopencv",
        "opencvpinhole",
        "standard",
        "linear",
        "rectified",
        "none",
        "no",
        "ideal",
        "nodistortion",
        "undistorted",
    }
)
#: Those of the pinhole that have no distortion at all, and those that have eight coefficients.
_IDEAL = frozenset({"linear", "rectified", "none", "no", "ideal", "nodistortion", "undistorted"})
_RATIONAL = frozenset({"rational", "rationalpolynomial", "radtan8"})

#: How many coefficients cv2.fisheye and OpenCV's pinhole camera take; fewer have zeros appended.
_FISHEYE_COUNTS, _PINHOLE_COUNTS = (4,), (4, 5, 8, 12, 14)

#: No focal length is as small.
_MIN_FOCAL_PX = 1e-3


@dataclass(frozen=True, slots=True)
class Camera:
    """One calibrated camera.

    Attributes:
        matrix: (3, 3) intrinsic matrix K in px.
        distortion: (n,) coefficients in OpenCV's order; n is 4 for a fisheye, 4, 5, 8, 12 or 14
            otherwise.
        fisheye: whether they are those of cv2.fisheye (Kannala and Brandt).
    """

    matrix: Matrix
    distortion: Matrix
    fisheye: bool = False


@dataclass(frozen=True, slots=True)
class Pair:
    """What calibration files say of two cameras, the left one first.

    A point x (3,) in the left camera's frame is ``rotation @ x + translation`` in the right one's.

    Attributes:
        kind: name of the format.
        cameras: left and right; None where the images are rectified already.
        rotation, translation: (3, 3) and (3,), the latter in the file's unit of length; None
            where ``rectified`` says it all.
        rectified: rotations (3, 3) and projections (3, 4) into the rectified images, left then
            right; None where they are to be computed.
        size: width and height in px, None where the files do not say.
        unit: the format's unit of length, None where it has none.
        notes: what was assumed, one line each.
        body_from_left: (4, 4), takes points of the left camera's frame to the body's that the
            files' poses are of, in ``unit``; None where the files have no such body.
    """

    kind: str
    cameras: tuple[Camera, Camera] | None = None
    rotation: Matrix | None = None
    translation: Matrix | None = None
    rectified: tuple[Rectified, Rectified] | None = None
    size: tuple[int, int] | None = None
    unit: str | None = None
    notes: tuple[str, ...] = ()
    body_from_left: Matrix | None = None


def rectified_pair(
    kind: str,
    projections: tuple[Matrix, Matrix],
    size: tuple[int, int] | None = None,
    unit: str | None = None,
    notes: tuple[str, ...] = (),
) -> Pair:
    """Return the pair whose images are rectified, by its projections (3, 4)."""
    left, right = ((np.eye(3), projection) for projection in projections)
    return Pair(kind, rectified=(left, right), size=size, unit=unit, notes=notes)


def known_lenses(name: object, models: Sequence[str]) -> dict[str, str]:
    """Return models of a lens by their plain names.

    Raises:
        InputError: one is not known.
    """
    known = {re.sub(r"[^a-z0-9]", "", model.lower()): model for model in models if model}
    for plain, model in known.items():
        if plain not in _FISHEYE | _PINHOLE:
            raise InputError(
                f"{name}: the lens model {model[:60]!r} is not known: calibrate with OpenCV's "
                "pinhole model (plumb_bob, radtan) or its fisheye model (equidistant)"
            )
    return known


def lens_camera(
    name: object, label: str, matrix: Matrix, distortion: Matrix, models: Sequence[str]
) -> tuple[Camera, tuple[str, ...]]:
    """Return a camera, and notes on what was assumed of its lens.

    Args:
        name: the file, for messages.
        label: what the file calls the coefficients.
        matrix: (3, 3).
        distortion: coefficients, (n,) or in a row or column.
        models: what the file says of the lens: names of models, empty where it says nothing.

    Raises:
        InputError: a model is not known, or its number of coefficients does not fit.
    """
    known = known_lenses(name, models)
    fisheye = bool(known.keys() & _FISHEYE)
    coefficients, notes = distortion.ravel(), tuple[str, ...]()
    if known.keys() & _IDEAL and not fisheye and coefficients.any():
        model = known[min(known.keys() & _IDEAL)]
        raise InputError(
            f"{name}: the lens model {model!r} has no distortion, but {label} is not zero: "
            "give the model that the coefficients are of"
        )
    if not known and distortion.shape == (4, 1) and coefficients.any():
        notes = (
            f"{name}: {label} has four coefficients in a column, as cv2.fisheye writes them, and "
            "no lens model: they are taken for pinhole k1 k2 p1 p2; if they are not, add the line "
            "'distortion_model: fisheye'",
        )
    if known.keys() & _RATIONAL and not fisheye and 0 < coefficients.size < 8:
        notes = (
            f"{name}: {label} has {coefficients.size} coefficients where rational_polynomial has "
            "8: they are taken for k1 k2 p1 p2 k3, the others for 0",
        )
    counts = _FISHEYE_COUNTS if fisheye else _PINHOLE_COUNTS
    if coefficients.size < counts[0]:
        coefficients = np.append(coefficients, np.zeros(counts[0] - coefficients.size))
    if coefficients.size not in counts:
        wanted = " or ".join(map(str, counts))
        model = "fisheye" if fisheye else "pinhole"
        raise InputError(
            f"{name}: {label} is not {wanted} numbers, as the {model} model has them, "
            f"but {coefficients.size}: check the file"
        )
    return Camera(matrix, coefficients, fisheye), notes


def checked_intrinsics(name: object, label: str, matrix: Matrix) -> Matrix:
    """Return an intrinsic matrix that a camera can have.

    Raises:
        InputError: its focal lengths are not positive and alike, or its last row is not 0 0 1.
    """
    fx, fy = matrix[0, 0], matrix[1, 1]
    if not (min(fx, fy) > _MIN_FOCAL_PX and 0.2 < fx / fy < 5):
        raise InputError(f"{name}: {label} has focal lengths {fx:g} and {fy:g} px: check the file")
    if not np.allclose(matrix[2, :3], [0, 0, 1]):
        raise InputError(f"{name}: the last row of {label} is not 0 0 1: check the file")
    return matrix
