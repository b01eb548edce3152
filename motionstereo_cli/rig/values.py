"""Checked access to values of a calibration file: errors name the file and the value."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from motionstereo_cli.errors import InputError
from motionstereo_cli.rig.cameras import (
    SHAPES,
    checked_intrinsics,
    intrinsic_matrix,
    lens_camera,
    lens_model,
)

if TYPE_CHECKING:
    from motionstereo_cli.rig.cameras import Camera, Matrix
    from motionstereo_cli.rig.structure import Values

#: Limit of lengths, angles and coefficients.
_LARGEST = 1e12

#: Tolerance of a rotation matrix times its transpose: files have few digits.
_ROTATION_TOLERANCE = 1e-2

#: Names under which files give the lens model.
_MODELS = ("distortionmodel", "cameramodel", "lensmodel", "model", "distortiontype", "cameratype")

#: Lens models that have a number for a name.
_NUMBERED = {"0.0": "radtan", "1.0": "fisheye"}

#: Names and values by which files mark a fisheye.
_FISHEYE_FLAGS, _TRUE = (
    ("fisheyemodel", "fisheye", "isfisheye", "usefisheye"),
    ("true", "1.0", "yes"),
)

#: Parts of nested names without meaning, and those that name a camera.
_WRAPPERS = re.compile(
    "(stereo|calibration|cameras?|intrinsics?|extrinsics?|distortion|parameters|params|rig)"
    "(calibration|parameters|params)?"
)
_SIDE = re.compile("(?:cam(?:era)?)?(left|right|l|r|[012])(?:cam(?:era)?|eye|lens)?")
_MAX_DEPTH = 8


class Source:
    """Values of one file by name, with errors that name file and value.

    Each method that takes a label raises InputError where the value is missing, or is not what the
    method returns.

    Args:
        name: the file, for messages.
        values: as read by :mod:`~motionstereo_cli.rig.structure`.
    """

    def __init__(self, name: object, values: Values) -> None:
        self.name = name
        self.values = values

    def find(self, names: Sequence[str]) -> str | None:
        """Return the first of the names that has a value."""
        return next((name for name in names if self.values.get(name) is not None), None)

    def array(self, names: Sequence[str], label: str) -> Matrix:
        """Return the value under any of the names as a finite array of at most two dimensions.

        Raises:
            InputError: it is missing, or not numbers, or not finite.
        """
        found = self.find(names)
        if found is None:
            raise InputError(f"{self.name}: {label} is missing: add it, or give another file")
        try:
            array = np.asarray(self.values[found], np.float64)
        except (TypeError, ValueError):
            raise InputError(f"{self.name}: {label} is not numbers: check the file") from None
        if array.ndim > 2:
            raise InputError(f"{self.name}: {label} is no matrix: check the file")
        if not (np.abs(array) < _LARGEST).all():
            raise InputError(
                f"{self.name}: {label} has values that are not finite or far too large: "
                "check the file"
            )
        return array

    def matrix(self, names: Sequence[str], label: str, *shapes: tuple[int, ...]) -> Matrix:
        """Return the value under any of the names as a finite array of the first shape that fits.

        Raises:
            InputError: it is missing, or not of that shape, or not finite.
        """
        size = " or ".join("x".join(str(n) for n in shape) for shape in shapes)
        found = self.find(names)
        try:
            numbers = found is None or np.asarray(self.values[found], np.float64).ndim <= 2
        except (TypeError, ValueError):
            numbers = False
        array = self.array(names, label) if numbers else np.empty(0)
        for shape in shapes:
            if array.size == math.prod(shape):
                return np.ascontiguousarray(array.reshape(shape))
        raise InputError(f"{self.name}: {label} is not {size} numbers: check the file")

    def number(self, names: Sequence[str], label: str) -> float:
        """Return the value under any of the names as one finite number."""
        return float(self.matrix(names, label, (1,))[0])

    def intrinsics(self, names: Sequence[str], label: str) -> Matrix:
        """Return an intrinsic matrix (3, 3), also from fx fy cx cy in a row."""
        found = self.find(names)
        if found is not None and np.asarray(self.values[found], object).shape == (4,):
            matrix = intrinsic_matrix(*self.matrix(names, label, (4,)))
        else:
            matrix = self.matrix(names, label, (3, 3))
        return checked_intrinsics(self.name, label, matrix)

    def rotation(self, names: Sequence[str], label: str) -> Matrix:
        """Return a rotation matrix (3, 3), also from a rotation vector."""
        return self.checked_rotation(self.matrix(names, label, (3, 3), (3,)), label)

    def checked_rotation(self, matrix: Matrix, label: str) -> Matrix:
        """Return the rotation matrix (3, 3) of a matrix or vector, checked to be one."""
        if matrix.shape == (3,):
            matrix = np.asarray(cv2.Rodrigues(matrix)[0], np.float64)
        off = np.abs(matrix @ matrix.T - np.eye(3)).max()
        if off > _ROTATION_TOLERANCE or np.linalg.det(matrix) < 0:
            raise InputError(f"{self.name}: {label} is not a rotation: check the file")
        return matrix

    def transform(self, names: Sequence[str], label: str) -> Matrix:
        """Return a rigid transform (4, 4), also from its first three rows."""
        matrix = self.matrix(names, label, (4, 4), (3, 4))
        if matrix.shape == (3, 4):
            matrix = np.vstack([matrix, [0, 0, 0, 1]])
        if not np.allclose(matrix[3], [0, 0, 0, 1]):
            raise InputError(f"{self.name}: the last row of {label} is not 0 0 0 1: check the file")
        self.checked_rotation(matrix[:3, :3], f"the rotation in {label}")
        return matrix

    def camera(
        self,
        matrix: Matrix,
        names: Sequence[str],
        label: str,
        models: Sequence[str] = _MODELS,
        shape: Sequence[float] = (),
    ) -> tuple[Camera, tuple[str, ...]]:
        """Return a camera with the distortion under any of the names, and notes on its lens.

        ``shape`` has the further parameters of the lens model.
        """
        distortion = self.array(names, label)
        return lens_camera(self.name, label, matrix, distortion, self.lenses(models), shape)

    def camera_of_list(
        self,
        names: Sequence[str],
        of_distortion: Sequence[str],
        distortion_label: str,
        models: Sequence[str] = _MODELS,
    ) -> tuple[Camera, tuple[str, ...]]:
        """Return a camera of a list of intrinsics, as kalibr has them, and notes on its lens.

        The list is fx fy cx cy after the other parameters of the lens model: xi, or xi and alpha,
        or alpha and beta. A matrix (3, 3) is accepted as well.
        """
        said, label = self.lenses(models), "intrinsics"
        model = lens_model(self.name, said)
        wanted = SHAPES.get(model, ())
        numbers = self.array(names, label).ravel()
        if numbers.size != len(wanted) + 4:
            if wanted:
                self.matrix(names, f"{label} ({' '.join(wanted)} fx fy cx cy)", (len(wanted) + 4,))
            matrix = self.intrinsics(names, label)
        else:
            own = intrinsic_matrix(*numbers[len(wanted) :])
            matrix = checked_intrinsics(self.name, label, own)
        shape = numbers[: len(wanted)].tolist()
        if self.find(of_distortion) is None and model in ("ds", "eucm"):
            return lens_camera(self.name, label, matrix, np.zeros(0), said, shape)
        return self.camera(matrix, of_distortion, distortion_label, models, shape)

    def lenses(self, models: Sequence[str] = _MODELS) -> list[str]:
        """Return the known names of lens models in the file."""
        said = [self.text(name) for name in models]
        # AirSLAM and AirVO number them.
        said = [_NUMBERED.get(each, each) for each in said]
        if any(self.text(name) in _TRUE for name in _FISHEYE_FLAGS):
            said.append("fisheye")
        lens_model(self.name, said)
        return said

    def text(self, *names: str) -> str:
        """Return the text under any of the names in lower case, empty if missing."""
        found = self.find(names)
        return str(self.values[found]).lower() if found else ""

    def size(self, *names: str) -> tuple[int, int] | None:
        """Return width and height, from one list or two numbers; None if missing."""
        found = [self.values[name] for name in names if self.values.get(name) is not None]
        if not found:
            return None
        numbers = found[:2] if len(found) > 1 else found[0]
        try:
            width, height = (float(value) for value in np.ravel(np.asarray(numbers, np.float64)))
            whole = width.is_integer() and height.is_integer() and min(width, height) > 0
        except (TypeError, ValueError):
            whole = False
        if not whole:
            raise InputError(f"{self.name}: the image size is not two positive whole numbers")
        return int(width), int(height)


def coefficients(source: Source, prefixes: Sequence[str]) -> list[float] | None:
    """Return distortion coefficients with one name each, k1 k2 p1 p2 k3; None without k1.

    Missing ones are 0; k1 to k4 without p1 and p2 are a fisheye's.
    """
    given: dict[str, float] = {}
    for name in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"):
        found = source.find(
            [each for prefix in prefixes for each in (prefix + name, name + prefix)]
        )
        if found is not None:
            given[name] = source.number((found,), found)
    if "k1" not in given:
        return None
    if "k4" in given and not given.keys() & {"p1", "p2", "k5", "k6"}:
        return [given.get(f"k{n}", 0.0) for n in (1, 2, 3, 4)]
    ordered = ["k1", "k2", "p1", "p2", "k3"]
    ordered += ["k4", "k5", "k6"] if given.keys() & {"k4", "k5", "k6"} else []
    return [given.get(name, 0.0) for name in ordered]


def flattened(values: Values) -> dict[str, Any]:
    """Return nested values by one name each: ``{"left": {"K": ...}}`` as ``leftk``.

    Names that only group others (stereo, extrinsics ...) are left out, and a side comes first.
    """
    flat: dict[str, Any] = {}

    def add(part: Values, side: str, path: str, depth: int) -> None:
        for name, value in part.items():
            if not isinstance(value, dict):
                flat.setdefault(side + path + name, value)
            elif depth < _MAX_DEPTH:
                found = _SIDE.fullmatch(name)
                if found is not None and not side:
                    add(value, _side(found[1], part), path, depth + 1)
                else:
                    wraps = _WRAPPERS.fullmatch(name) is not None
                    add(value, side, path if wraps else path + name, depth + 1)

    add(values, "", "", 0)
    return flat


def _side(name: str, beside: Values) -> str:
    if name == "1":
        # cam0 and cam1, or cam1 and cam2.
        name = "2" if any(re.fullmatch("(cam(era)?)?0", other) for other in beside) else "0"
    return {"l": "left", "0": "left", "r": "right", "2": "right"}.get(name, name)
