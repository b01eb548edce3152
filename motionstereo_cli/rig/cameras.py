"""Calibrated cameras and their lens models."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from motionstereo_cli.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.types import Real, Rig

    Matrix = NDArray[np.float64]

    #: Where each pixel of a rectified image lies in the recorded one, x and y, (height, width) px.
    Maps = tuple[Real, Real]

    #: Rotation (3, 3) and projection (3, 4) into a rectified image.
    Rectified = tuple[Matrix, Matrix]

#: Names of lens models, in lower case without punctuation. Kannala and Brandt's has many.
_FISHEYE = frozenset(
    {
        *("fisheye", "equidistant", "equi", "pinholeequi", "pinholeequidistant", "kb", "kb4"),
        *("kb8", "kannalabrandt", "kannalabrandt4", "kannalabrandt8", "opencvfisheye"),
        *("fisheyeopencv",),
    }
)
_OMNI = frozenset({"omni", "mei", "omniradtan", "omnidirectional", "omnidir"})
_DOUBLE_SPHERE = frozenset({"ds", "doublesphere", "dsnone"})
_EUCM = frozenset({"eucm", "eucmnone", "extendedunified"})
_FOV = frozenset({"fov", "atan", "pinholefov"})
_PINHOLE = frozenset(
    {
        *("pinhole", "perspective", "plumbbob", "radtan", "radtan4", "radtan5", "radtan8"),
        *("pinholeradtan", "pinholeradtan4", "pinholeradtan5", "pinholeradtan8"),
        *("pinholeradialtangential", "radialtangential", "radialtangential4"),
        *("radialtangential8", "brown", "brownconrady", "rational", "rationalpolynomial"),
        *("thinprism", "opencv", "fullopencv", "opencvpinhole", "standard", "linear", "rectified"),
        *("none", "no", "ideal", "nodistortion", "undistorted"),
    }
)
#: Names for pinholes without distortion, and for those with eight coefficients.
_IDEAL = frozenset({"linear", "rectified", "none", "no", "ideal", "nodistortion", "undistorted"})
_RATIONAL = frozenset({"rational", "rationalpolynomial", "radtan8"})
_NAMES = {
    **{"fisheye": _FISHEYE, "omni": _OMNI, "ds": _DOUBLE_SPHERE, "eucm": _EUCM, "fov": _FOV},
    "pinhole": _PINHOLE,
}

#: Numbers of distortion coefficients that each model takes; missing ones are zero. Names of
#: further parameters, which come first.
_COUNTS = {
    **{"pinhole": (4, 5, 8, 12, 14), "fisheye": (4,), "omni": (4, 5), "ds": (0,), "eucm": (0,)},
    "fov": (1,),
}
SHAPES = {"omni": ("xi",), "ds": ("xi", "alpha"), "eucm": ("alpha", "beta")}

#: Focal lengths are larger than this, in px.
_MIN_FOCAL_PX = 1e-3


@dataclass(frozen=True, slots=True)
class Camera:
    """One calibrated camera.

    Attributes:
        matrix: (3, 3) intrinsic matrix K in px.
        distortion: (n,) coefficients in OpenCV's order, after the model's other parameters (xi, or
            xi and alpha, or alpha and beta).
        model: ``pinhole``, ``fisheye`` (Kannala and Brandt), ``omni``, ``ds``, ``eucm`` or ``fov``;
            see :func:`~motionstereo_cli.rig.lenses.project`.
    """

    matrix: Matrix
    distortion: Matrix
    model: str = "pinhole"


@dataclass(frozen=True, slots=True)
class Pair:
    """The calibration of two cameras in files, the left one first.

    A point x (3,) in the left camera's frame is ``rotation @ x + translation`` in the right one's.

    Attributes:
        kind: name of the format.
        cameras: left and right; None if the images are rectified already.
        rotation, translation: (3, 3) and (3,), the latter in the file's unit of length; None
            if ``rectified`` suffices.
        rectified: rotations (3, 3) and projections (3, 4) into the rectified images, left then
            right; None if they are to be computed.
        size: width and height in px, None if unknown.
        unit: the format's unit of length, None if it has none.
        notes: assumptions, one line each.
        body_from_left: (4, 4), takes points of the left camera's frame to that of the body whose
            poses the format has, in ``unit``; None if there is none.
        maps: of the left and the right camera, where each rectified pixel lies in the recorded
            image, each x and y, (height, width) float32 px; None if they are to be computed.
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
    maps: tuple[Maps, Maps] | None = None


def rectified_pair(
    kind: str,
    projections: tuple[Matrix, Matrix],
    size: tuple[int, int] | None = None,
    unit: str | None = None,
    notes: tuple[str, ...] = (),
) -> Pair:
    """Return a pair of rectified images with these projections (3, 4)."""
    left, right = ((np.eye(3), projection) for projection in projections)
    return Pair(kind, rectified=(left, right), size=size, unit=unit, notes=notes)


def of_rig(rig: Rig) -> Pair:
    """Return the pair of the rectified images that a rig describes."""
    matrix = intrinsic_matrix(rig.focal_px, rig.focal_y_px or rig.focal_px, rig.cx, rig.cy)
    left = np.column_stack([matrix, np.zeros(3)])
    right = left.copy()
    right[0, 2:] = rig.cx + rig.doffs, -rig.focal_px * rig.baseline_m
    return rectified_pair("rig.yaml", (left, right), (rig.width, rig.height), "m")


def lens_model(name: object, models: Sequence[str]) -> str:
    """Return the model of :class:`Camera` for the names in a file.

    Args:
        name: the file, for messages.
        models: names of models, empty where it has none.

    Raises:
        InputError: one is unknown, or they contradict.
    """
    found = set()
    for model in filter(None, models):
        plain = _plain(model)
        known = next((each for each, names in _NAMES.items() if plain in names), None)
        if known is None:
            raise InputError(
                f"{name}: the lens model {model[:60]!r} is not known: calibrate with OpenCV's "
                "pinhole model (plumb_bob, radtan), its fisheye model (equidistant), or omni, ds, "
                "eucm or fov"
            )
        found.add(known)
    special = found - {"pinhole"}
    if len(special) > 1:
        raise InputError(
            f"{name}: the lens models {' and '.join(sorted(filter(None, models)))} do not go "
            "together: check the file"
        )
    return special.pop() if special else "pinhole"


def _plain(model: str) -> str:
    return re.sub(r"[^a-z0-9]", "", model.lower())


def lens_camera(
    name: object,
    label: str,
    matrix: Matrix,
    distortion: Matrix,
    models: Sequence[str],
    shape: Sequence[float] = (),
) -> tuple[Camera, tuple[str, ...]]:
    """Return a camera, and notes on assumptions about its lens.

    Args:
        name: the file, for messages.
        label: the name of the coefficients in the file.
        matrix: (3, 3).
        distortion: coefficients, (n,) or in a row or column.
        models: names of lens models in the file, empty where it has none.
        shape: the model's further parameters.

    Raises:
        InputError: a model is unknown, or its number of coefficients does not fit.
    """
    model, said = lens_model(name, models), {_plain(each): each for each in models if each}
    coefficients, notes = distortion.ravel(), tuple[str, ...]()
    wanted = SHAPES.get(model, ())
    if len(shape) != len(wanted):
        raise InputError(
            f"{name}: a lens of the model {model} has {' and '.join(wanted)} beside its focal "
            "lengths, which are not here: check the file"
        )
    if said.keys() & _IDEAL and model == "pinhole" and coefficients.any():
        raise InputError(
            f"{name}: the lens model {said[min(said.keys() & _IDEAL)]!r} has no distortion, but "
            f"{label} is not zero: give the model that the coefficients are of"
        )
    if not said and distortion.shape == (4, 1) and coefficients.any():
        notes = (
            f"{name}: {label} has four coefficients in a column, as cv2.fisheye writes them, and "
            "no lens model: they are taken for pinhole k1 k2 p1 p2; if they are not, add the line "
            "'distortion_model: fisheye'",
        )
    if said.keys() & _RATIONAL and model == "pinhole" and 0 < coefficients.size < 8:
        notes = (
            f"{name}: {label} has {coefficients.size} coefficients where rational_polynomial has "
            "8: they are taken for k1 k2 p1 p2 k3, the others for 0",
        )
    counts = _COUNTS[model]
    if counts == (0,) and not coefficients.any():
        coefficients = coefficients[:0]
    if coefficients.size < counts[0]:
        coefficients = np.append(coefficients, np.zeros(counts[0] - coefficients.size))
    if coefficients.size not in counts:
        raise InputError(
            f"{name}: {label} is not {' or '.join(map(str, counts))} numbers, as the {model} model "
            f"has them, but {coefficients.size}: check the file"
        )
    if model == "fov" and not 0 < coefficients[0] < math.pi:
        raise InputError(
            f"{name}: {label} is {coefficients[0]:g}, no angle of view: check the file"
        )
    return Camera(matrix, np.append(shape, coefficients), model), notes


def checked_intrinsics(name: object, label: str, matrix: Matrix) -> Matrix:
    """Return an intrinsic matrix after checking that it is plausible.

    Raises:
        InputError: its focal lengths are not positive and alike, or its last row is not 0 0 1.
    """
    fx, fy = matrix[0, 0], matrix[1, 1]
    if not (min(fx, fy) > _MIN_FOCAL_PX and 0.2 < fx / fy < 5):
        raise InputError(f"{name}: {label} has focal lengths {fx:g} and {fy:g} px: check the file")
    if not np.allclose(matrix[2, :3], [0, 0, 1]):
        raise InputError(f"{name}: the last row of {label} is not 0 0 1: check the file")
    return matrix


def intrinsic_matrix(fx: float, fy: float, cx: float, cy: float) -> Matrix:
    """Return the intrinsic matrix (3, 3) of focal lengths and a principal point in px."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
