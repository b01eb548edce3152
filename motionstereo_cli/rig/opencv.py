"""Calibrations with OpenCV's names: of its samples, of .npz files, of left and right in JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from motionstereo_cli.errors import InputError
from motionstereo_cli.rig.cameras import Pair, checked_intrinsics, intrinsic_matrix, rectified_pair
from motionstereo_cli.rig.values import Source, coefficients, flattened

if TYPE_CHECKING:
    from motionstereo_cli.rig.cameras import Camera, Matrix, Rectified
    from motionstereo_cli.rig.structure import Values

_SIDES = (("1", "left", "l"), ("2", "right", "r"))
_SIDES_FROM_0 = (("0", "left", "l"), ("1", "right", "r"))
_K = ("m", "k", "cameramatrix", "intrinsics", "intrinsic", "intrinsicmatrix", "mtx", "matrix")
_D = (
    *("d", "distcoeffs", "distcoeff", "dist", "distortion", "distortioncoefficients", "distcoefs"),
    *("distortioncoeffs", "distortioncoeff", "disto", "coeffs", "coefficients"),
)
_R_RECT = ("r", "rect", "rectification", "rectificationmatrix")
_P_RECT = ("p", "projection", "projectionmatrix")
_R = ("r", "rotation", "rotationmatrix", "rmat", "rot")
_T = ("t", "translation", "translationvector", "tvec", "trans")
_MODELS = ("distortionmodel", "cameramodel", "lensmodel", "model", "distortiontype")
#: Names of the matrix that makes points of disparities.
_OF_Q = ("q", "disparitytodepthmap", "dispartitytodepthmap")
_SIZE = ("imagesize", "imgsize", "size", "resolution", "imageshapewh")

#: The smallest inverse length that Q may hold.
_SMALLEST = 1e-12


def read_opencv(name: str, values: Values) -> Pair:
    """Return the pair of a file with OpenCV's names, or of two of intrinsics and extrinsics.

    Raises:
        InputError: a value is missing or invalid.
    """
    source = Source(name, flattened(values))
    sides = _SIDES
    if source.find(_names(_K, ("0",))) and not source.find(_names(_K, ("2",))):
        sides = _SIDES_FROM_0
    size = source.size(*_SIZE) or source.size("imagewidth", "imageheight")
    size = size or source.size("width", "height") or source.size("leftwidth", "leftheight")
    size = size or next(filter(None, (source.size(f"left{each}") for each in _SIZE)), None)
    projections = _projections(source, sides)
    has_cameras = any(source.find([*_names(_K, side), *_names(("fx",), side)]) for side in sides)
    names = [*_R, *_T, *_OF_Q, "p1", *(name for side in sides for name in _names(_D, side))]
    if not has_cameras and not source.find(names):
        found = ", ".join(list(values)[:6]) or "none"
        raise InputError(
            f"{name} is no calibration of a form that is read (its first names are {found[:80]}): "
            "give one of those that 'motionstereo rig --help' lists, or rig.yaml"
        )
    if not has_cameras:
        if projections is not None:
            half = (_without_intrinsics(name),) if source.find(_T) else ()
            return rectified_pair("OpenCV P1, P2", projections, size, notes=half)
        if source.find(_OF_Q):
            q = source.matrix(_OF_Q, "Q", (4, 4))
            return rectified_pair("OpenCV Q", _projections_of(q, name), size)
    (left, left_notes), (right, right_notes) = (_camera(source, side) for side in sides)
    cameras, notes = (left, right), (*left_notes, *right_notes)
    if projections is not None and all(source.find(_names(_R_RECT, side)) for side in sides):
        rotations = [source.rotation(_names(_R_RECT, side), f"R{side[0]}") for side in sides]
        first, second = zip(rotations, projections, strict=True)
        rectified: tuple[Rectified, Rectified] = first, second
        between = _right_from_left(source, sides) if source.find(_R) and source.find(_T) else None
        rotation, translation = between or (None, None)
        return Pair("OpenCV", cameras, rotation, translation, rectified, size, notes=notes)
    if source.find(("baseline", "baselinem")) and not source.find([*_R, *_T]):
        tx = -source.number(("baseline", "baselinem"), "baseline")
        notes += (f"{name} has a baseline and no R: the cameras are taken to be parallel",)
        parallel = np.eye(3), np.array([tx, 0, 0])
        return Pair("OpenCV", cameras, *parallel, size=size, notes=notes)
    if not source.find([*_R, *_T, *_names(_R, sides[1]), *_names(_T, sides[1])]):
        raise InputError(
            f"{name} has the intrinsics of both cameras, but R is missing, and T: give the file "
            "with them as well (--rig intrinsics.yml --rig extrinsics.yml)"
        )
    rotation, translation = _right_from_left(source, sides)
    return Pair("OpenCV", cameras, rotation, translation, size=size, notes=notes)


def _without_intrinsics(name: str) -> str:
    return (
        f"{name} has R, T and P1, but no M1 and D1: the images are taken to be rectified already. "
        "If they are as recorded, give the intrinsics as well (--rig intrinsics.yml --rig "
        "extrinsics.yml)"
    )


def has_numbered_cameras(values: Values) -> bool:
    """Return whether a file has matrices of two cameras under OpenCV's numbered names."""
    return all(
        any(
            np.asarray(values.get(f"{name}{number}"), object).size == 9
            for name in ("m", "k", "cameramatrix")
        )
        for number in (1, 2)
    )


def _right_from_left(source: Source, sides: Sequence[Sequence[str]]) -> tuple[Matrix, Matrix]:
    of_right = _names(_R, sides[1]), _names(_T, sides[1])
    if source.find([*_R, *_T]) or not all(map(source.find, of_right)):
        return source.rotation(_R, "R"), source.matrix(_T, "T", (3,))
    # Each camera's pose in a common frame, often the left camera's.
    rotation, translation = (
        source.rotation(of_right[0], "right R"),
        source.matrix(of_right[1], "right T", (3,)),
    )
    of_left = _names(_R, sides[0]), _names(_T, sides[0])
    if not all(map(source.find, of_left)):
        return rotation, translation
    rotation = rotation @ source.rotation(of_left[0], "left R").T
    return rotation, translation - rotation @ source.matrix(of_left[1], "left T", (3,))


def _names(bases: Sequence[str], side: Sequence[str]) -> list[str]:
    return [name for base in bases for each in side for name in (base + each, each + base)]


def _projections(source: Source, sides: Sequence[Sequence[str]]) -> tuple[Matrix, Matrix] | None:
    if not all(source.find(_names(_P_RECT, side)) for side in sides):
        return None
    left, right = (source.matrix(_names(_P_RECT, side), f"P{side[0]}", (3, 4)) for side in sides)
    if left[0, 3] == right[0, 3] and source.find(("bf",)):  # AirSLAM
        right[0, 3] = left[0, 3] - source.number(("bf",), "bf")
    return left, right


def _camera(source: Source, side: Sequence[str]) -> tuple[Camera, tuple[str, ...]]:
    number = side[0]
    label = f"M{number} (or K{number}, cameraMatrix{number}, {side[1]}_camera_matrix)"
    parts = [_names((part,), side) for part in ("fx", "fy", "cx", "cy")]
    if source.find(_names(_K, side)) is None and all(map(source.find, parts)):
        numbers = [source.number(names, names[0]) for names in parts]
        matrix = checked_intrinsics(source.name, label, intrinsic_matrix(*numbers))
    else:
        matrix = source.intrinsics(_names(_K, side), label)
    label = f"D{number} (or distCoeffs{number}, {side[1]}_distortion_coefficients)"
    names = _names(_D, side)
    single = coefficients(source, side) if source.find(names) is None else None
    if single is not None:
        source = Source(source.name, {**source.values, names[0]: single})
    models = [*_MODELS, *_names(_MODELS, side)]
    return source.camera(matrix, names, label, models)


def _projections_of(q: Matrix, name: str) -> tuple[Matrix, Matrix]:
    """Return the projections whose reprojection matrix is Q, as cv2.stereoRectify defines it."""
    if not (q[2, 3] > 0 and abs(q[3, 2]) > _SMALLEST):
        raise InputError(f"{name}: Q is singular: check the file")
    tx = -1 / q[3, 2]
    left = np.array([[q[2, 3], 0, -q[0, 3], 0], [0, q[2, 3], -q[1, 3], 0], [0, 0, 1, 0]])
    right = left.copy()
    right[0, 2] = left[0, 2] - q[3, 3] * tx
    right[0, 3] = q[2, 3] * tx
    return left, right
