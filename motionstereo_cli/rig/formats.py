"""Calibration files as other programs write them, read as data alone.

Each format is told by its content, never by its name. What is read is either a
:class:`~motionstereo_cli.types.Rig`, for images that are rectified already, or a :class:`Pair` of
calibrated cameras.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.reading import MOST_CALIBRATION_BYTES, read_text
from motionstereo_cli.rig.rig_file import read_rig
from motionstereo_cli.types import Rig

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Matrix = NDArray[np.float64]

#: What a calibration file may hold by name: numbers, text, and arrays.
Values = Mapping[str, Any]

#: Names of the fisheye model in calibration files: all mean that of Kannala and Brandt.
_FISHEYE = ("fisheye", "equidistant", "kannala_brandt", "kannala-brandt", "kannalabrandt4")
_PINHOLE_COUNTS = (0, 4, 5, 8, 12, 14)
_FISHEYE_COUNTS = (4,)

#: No length, angle or coefficient is as large, and no focal length as small.
_LARGEST = 1e12
_SMALLEST_FOCAL_PX = 1e-3

#: A rotation matrix times its transpose may differ from one by this: files hold few digits.
_ROTATION_TOLERANCE = 1e-2


@dataclass(frozen=True, slots=True)
class Camera:
    """One calibrated camera.

    Attributes:
        matrix: (3, 3) intrinsic matrix K in px.
        distortion: (n,) coefficients in OpenCV's order; n is 4 for a fisheye, 0, 4, 5, 8, 12 or 14
            otherwise.
        fisheye: whether they are those of cv2.fisheye (Kannala and Brandt).
    """

    matrix: Matrix
    distortion: Matrix
    fisheye: bool = False


@dataclass(frozen=True, slots=True)
class Pair:
    """Two calibrated cameras, the left one first.

    A point x (3,) in the left camera's frame is ``rotation @ x + translation`` in the right one's.

    Attributes:
        cameras: left and right.
        rotation, translation: (3, 3) and (3,), the latter in the file's unit of length; None
            where ``rectified`` says it all.
        rectified: rotations (3, 3) and projections (3, 4) into the rectified images, left then
            right; None where they are to be computed.
    """

    cameras: tuple[Camera, Camera]
    rotation: Matrix | None = None
    translation: Matrix | None = None
    rectified: tuple[tuple[Matrix, Matrix], tuple[Matrix, Matrix]] | None = None


@dataclass(frozen=True, slots=True)
class Read:
    """What calibration files say.

    Attributes:
        kind: name of the format.
        content: a rectified pair's projections (3, 4), left then right; a pair of cameras; or a
            rig.
        size: width and height in px, None where the files do not say.
        unit: the format's unit of length, None where it has none.
        notes: what was assumed.
    """

    kind: str
    content: Rig | Pair | tuple[Matrix, Matrix]
    size: tuple[int, int] | None = None
    unit: str | None = None
    notes: tuple[str, ...] = ()


def read_files(paths: Sequence[Path], pair: tuple[int, int] | None = None) -> Read:
    """Read one calibration file, or two that belong together, the left camera's first.

    Args:
        paths: rig.yaml; OpenCV YAML, XML or JSON, perhaps intrinsics and extrinsics apart; KITTI
            calib.txt or calib_cam_to_cam.txt; Middlebury calib.txt; two ROS camera_info files;
            two EuRoC sensor.yaml.
        pair: numbers of the left and right camera where a file has more than two (KITTI); 0 and
            1 if None, or 2 and 3 where those alone are there.

    Raises:
        InputError: a file cannot be read, has another format, or lacks or spoils a value.
    """
    if not 1 <= len(paths) <= 2:
        raise InputError(f"{len(paths)} calibration files are too many: give one, or a pair")
    texts = [read_text(path, "the rig", MOST_CALIBRATION_BYTES) for path in paths]
    first = texts[0]
    if re.search(r"^\s*cam0\s*=", first, re.MULTILINE):
        return _middlebury(*_alone(paths, "a Middlebury calib.txt"), first)
    if re.search(r"^P(_rect_)?\d+[ \t]*:[ \t]*[-+.\d]", first, re.MULTILINE):
        return _kitti(*_alone(paths, "a KITTI calib.txt"), first, pair)
    if re.search(r"^(focal_px|baseline_m)\b", first, re.MULTILINE) or not _has_structure(first):
        return Read("rig.yaml", read_rig(*_alone(paths, "a rig.yaml")), unit="m")
    values = [_structured(path, text) for path, text in zip(paths, texts, strict=True)]
    if "projectionmatrix" in values[0]:
        return _ros(_both(paths, values, "ROS camera_info"))
    if "tbs" in values[0]:
        return _euroc(_both(paths, values, "EuRoC sensor.yaml"))
    return _opencv(
        " and ".join(str(path) for path in paths),
        {k: v for each in values for k, v in each.items()},
    )


def _alone(paths: Sequence[Path], what: str) -> tuple[Path]:
    if len(paths) > 1:
        raise InputError(f"{paths[0]} is {what}, which says all: leave {paths[1]} out")
    return (paths[0],)


def _both(paths: Sequence[Path], values: Sequence[Values], what: str) -> list[tuple[Path, Values]]:
    if len(paths) < 2:
        raise InputError(
            f"{paths[0]} is the {what} of one camera: give both, the left camera's first"
        )
    return list(zip(paths, values, strict=True))


# YAML, XML and JSON, by OpenCV's reader.


def _has_structure(text: str) -> bool:
    """Return whether there is anything but plain ``key: number`` lines, as in a rig file."""
    return bool(re.search(r"[\[{<]|^\s+\S|^\s*-\s", text, re.MULTILINE))


def _structured(path: Path, text: str) -> dict[str, Any]:
    """Return the top level of a YAML, XML or JSON file, its keys in lower case without signs."""
    if not text.lstrip().startswith(("<", "{")):
        # What OpenCV's reader wants more than YAML does: its header, and lists set in.
        text = re.sub(r"^(%YAML.*|---.*)$", "", text, flags=re.MULTILINE)
        text = re.sub(r"^( *)- ", r"\1  - ", text, flags=re.MULTILINE)
        text = f"%YAML:1.0\n---\n{text}\n"
    storage = cv2.FileStorage()
    try:
        storage.open(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = storage.root()
        names = root.keys() if root.isMap() else []
        return {
            re.sub(r"[^a-z0-9]", "", name.lower()): _value(root.getNode(name)) for name in names
        }
    except cv2.error as error:
        where = re.search(r"\((\d+)\): (.*?)'?\s*$", str(error).strip().splitlines()[0])
        reason = f" (near line {where[1]}: {where[2]})" if where else ""
        raise InputError(
            f"{path} is not a calibration file that can be read{reason}: "
            "check that it is whole YAML, XML or text"
        ) from None
    finally:
        storage.release()


def _value(node: Any) -> Any:
    if node.isMap():
        values = {name: _value(node.getNode(name)) for name in node.keys()}  # noqa: SIM118
        return _shaped(values) if "data" in values else values
    if node.isSeq():
        return [_value(node.at(i)) for i in range(node.size())]
    if node.isInt() or node.isReal():
        return node.real()
    return node.string() if node.isString() else None


def _shaped(values: Values) -> Any:
    try:
        # OpenCV 5 writes vectors with "sizes".
        sizes = values.get("sizes") or [values["rows"], values["cols"]]
        shape = [int(size) for size in np.atleast_1d(sizes)]
        return np.array(values["data"], np.float64).reshape(shape)
    except (LookupError, TypeError, ValueError, OverflowError):
        return None  # reported as missing by whoever needs it


class _Source:
    """Values of one file by name, with errors that name file and value."""

    def __init__(self, name: object, values: Values) -> None:
        self.name = name
        self.values = values

    def find(self, names: Sequence[str]) -> str | None:
        return next((name for name in names if self.values.get(name) is not None), None)

    def matrix(self, names: Sequence[str], label: str, *shapes: tuple[int, ...]) -> Matrix:
        """Return the value under any of the names as a finite array of the first shape that fits.

        Raises:
            InputError: it is missing, or not of that shape, or not finite.
        """
        found = self.find(names)
        if found is None:
            raise InputError(f"{self.name}: {label} is missing: add it, or give another file")
        try:
            array = np.asarray(self.values[found], np.float64)
        except (TypeError, ValueError):
            array = np.empty(0)
        for shape in shapes:
            if array.size == math.prod(shape) and array.ndim <= 2:
                if not (np.abs(array) < _LARGEST).all():
                    raise InputError(
                        f"{self.name}: {label} has values that are not finite or far too large: "
                        "check the file"
                    )
                return array.reshape(shape)
        size = " or ".join("x".join(str(n) for n in shape) for shape in shapes)
        raise InputError(f"{self.name}: {label} is not {size} numbers: check the file")

    def intrinsics(self, names: Sequence[str], label: str) -> Matrix:
        matrix = self.matrix(names, label, (3, 3))
        return checked_intrinsics(self.name, label, matrix)

    def rotation(self, names: Sequence[str], label: str) -> Matrix:
        matrix = self.matrix(names, label, (3, 3), (3,))
        if matrix.shape == (3,):
            matrix = np.asarray(cv2.Rodrigues(matrix)[0], np.float64)
        off = np.abs(matrix @ matrix.T - np.eye(3)).max()
        if off > _ROTATION_TOLERANCE or np.linalg.det(matrix) < 0:
            raise InputError(f"{self.name}: {label} is not a rotation: check the file")
        return matrix

    def distortion(self, names: Sequence[str], label: str, *, fisheye: bool) -> Matrix:
        counts = _FISHEYE_COUNTS if fisheye else _PINHOLE_COUNTS
        return self.matrix(names, label, *((count,) for count in counts))

    def text(self, *names: str) -> str:
        found = self.find(names)
        return str(self.values[found]).lower() if found else ""

    def size(self, *names: str) -> tuple[int, int] | None:
        """Return width and height, from one list or two numbers."""
        found = [self.values[name] for name in names if self.values.get(name) is not None]
        flat = np.ravel(np.array(found[:2] if len(found) > 1 else found[:1], dtype=object))
        if flat.size == 1 and isinstance(flat[0], list):
            flat = np.array(flat[0], dtype=object)
        if not found:
            return None
        try:
            width, height = (int(value) for value in flat)
        except (TypeError, ValueError, OverflowError):
            width = height = 0
        if width <= 0 or height <= 0:
            raise InputError(f"{self.name}: the image size is not two positive numbers")
        return width, height


def checked_intrinsics(name: object, label: str, matrix: Matrix) -> Matrix:
    """Return an intrinsic matrix that a camera can have.

    Raises:
        InputError: its focal lengths are not positive and alike, or its last row is not 0 0 1.
    """
    fx, fy = matrix[0, 0], matrix[1, 1]
    if not (min(fx, fy) > _SMALLEST_FOCAL_PX and 0.2 < fx / fy < 5):
        raise InputError(f"{name}: {label} has focal lengths {fx:g} and {fy:g} px: check the file")
    if not np.allclose(matrix[2, :3], [0, 0, 1]):
        raise InputError(f"{name}: the last row of {label} is not 0 0 1: check the file")
    return matrix


# OpenCV.


def _names(bases: Sequence[str], side: Sequence[str]) -> list[str]:
    return [name for base in bases for each in side for name in (base + each, each + base)]


_SIDES = (("1", "left", "l"), ("2", "right", "r"))
_K = ("m", "k", "cameramatrix", "intrinsics", "intrinsicmatrix", "mtx")
_D = ("d", "distcoeffs", "distcoeff", "dist", "distortion", "distortioncoefficients", "distcoefs")
_R_RECT = ("r", "rect", "rectification", "rectificationmatrix")
_P_RECT = ("p", "projection", "projectionmatrix")
_R = ("r", "rotation", "rotationmatrix", "rmat")
_T = ("t", "translation", "translationvector", "tvec")
_MODEL = ("distortionmodel", "cameramodel", "model")
_SIZE = ("imagesize", "size", "resolution")


def _opencv(name: str, values: Values) -> Read:
    source = _Source(name, values)
    size = source.size(*_SIZE) or source.size("imagewidth", "imageheight")
    size = size or source.size("width", "height")
    fisheye = source.text(*_MODEL) in _FISHEYE
    has_projections = all(source.find(_names(_P_RECT, side)) for side in _SIDES)
    projections = tuple(
        source.matrix(_names(_P_RECT, side), f"P{side[0]}", (3, 4)) if has_projections else None
        for side in _SIDES
    )
    if not any(source.find(_names(_K, side)) for side in _SIDES):
        left, right = projections
        if left is not None and right is not None:
            return Read("OpenCV P1, P2", (left, right), size)
        if source.find(("q",)):
            return Read("OpenCV Q", _projections_of(source.matrix(("q",), "Q", (4, 4)), name), size)
    cameras = tuple(_opencv_camera(source, side, fisheye) for side in _SIDES)
    left_camera, right_camera = cameras
    pair = Pair((left_camera, right_camera))
    if has_projections and all(source.find(_names(_R_RECT, side)) for side in _SIDES):
        first, second = (
            (source.rotation(_names(_R_RECT, side), f"R{side[0]}"), projection)
            for side, projection in zip(_SIDES, projections, strict=True)
            if projection is not None
        )
        pair = Pair(pair.cameras, rectified=(first, second))
    else:
        rotation = source.rotation(_R, "R")
        pair = Pair(pair.cameras, rotation, source.matrix(_T, "T", (3,)))
    return Read("OpenCV", pair, size)


def _opencv_camera(source: _Source, side: Sequence[str], fisheye: bool) -> Camera:
    number = side[0]
    matrix = source.intrinsics(
        _names(_K, side), f"M{number} (or K{number}, cameraMatrix{number}, {side[1]}_camera_matrix)"
    )
    label = f"D{number} (or distCoeffs{number}, {side[1]}_distortion_coefficients)"
    return Camera(matrix, source.distortion(_names(_D, side), label, fisheye=fisheye), fisheye)


def _projections_of(q: Matrix, name: str) -> tuple[Matrix, Matrix]:
    """Return the projections whose reprojection matrix is Q, as cv2.stereoRectify has it."""
    if not (q[2, 3] > 0 and abs(q[3, 2]) > 1 / _LARGEST):
        raise InputError(f"{name}: Q is singular: check the file")
    tx = -1 / q[3, 2]
    left = np.array([[q[2, 3], 0, -q[0, 3], 0], [0, q[2, 3], -q[1, 3], 0], [0, 0, 1, 0]])
    right = left.copy()
    right[0, 2] = left[0, 2] - q[3, 3] * tx
    right[0, 3] = q[2, 3] * tx
    return left, right


# KITTI and Middlebury.


def _kitti(path: Path, text: str, pair: tuple[int, int] | None) -> Read:
    values: dict[str, Any] = {}
    for line in text.splitlines():
        key, colon, numbers = line.partition(":")
        if colon:
            values[key.strip()] = _floats(numbers)
    prefix = "P_rect_" if any(key.startswith("P_rect_") for key in values) else "P"
    digits = "02d" if prefix == "P_rect_" else "d"
    labels = {number: f"{prefix}{number:{digits}}" for number in range(4)}
    notes: tuple[str, ...] = ()
    if pair is None:
        pair = (2, 3) if labels[0] not in values or labels[1] not in values else (0, 1)
        if all(label in values for label in labels.values()):
            notes = (f"the file has four cameras: {pair[0]} and {pair[1]} are taken",)
    source = _Source(path, values)
    left, right = (
        source.matrix((labels.get(n, f"{prefix}{n}"),), labels.get(n, f"{prefix}{n}"), (3, 4))
        for n in pair
    )
    size = source.size(f"S_rect_{pair[0]:02d}")
    return Read("KITTI", (left, right), size, unit="m", notes=notes)


def _middlebury(path: Path, text: str) -> Read:
    values: dict[str, Any] = {}
    for line in text.splitlines():
        key, equals, numbers = line.partition("=")
        if equals:
            values[key.strip()] = _floats(numbers)
    source = _Source(path, values)
    first, second = (source.intrinsics((name,), name) for name in ("cam0", "cam1"))
    baseline = source.matrix(("baseline",), "baseline", (1,))[0]
    doffs = second[0, 2] - first[0, 2]
    if "doffs" in values:
        stated = source.matrix(("doffs",), "doffs", (1,))[0]
        if abs(stated - doffs) > 0.01:
            raise InputError(
                f"{path}: doffs is {stated:g} but cam1 and cam0 differ by {doffs:g} px: "
                "check the file"
            )
    right = np.column_stack([second, [-second[0, 0] * baseline, 0, 0]])
    left = np.column_stack([first, np.zeros(3)])
    size = source.size("width", "height")
    return Read("Middlebury", (left, right), size, unit="mm")


def _floats(text: str) -> list[float] | None:
    try:
        return [float(part) for part in re.split(r"[\s,;\[\]]+", text.strip()) if part]
    except ValueError:
        return None  # dates and names


# One file a camera.


def _ros(files: list[tuple[Path, Values]]) -> Read:
    cameras, rectified, sizes = [], [], []
    for path, values in files:
        source = _Source(path, values)
        fisheye = source.text("distortionmodel") in _FISHEYE
        label = "distortion_coefficients"
        distortion = source.distortion(("distortioncoefficients",), label, fisheye=fisheye)
        matrix = source.intrinsics(("cameramatrix",), "camera_matrix")
        cameras.append(Camera(matrix, distortion, fisheye))
        rotation = source.rotation(("rectificationmatrix",), "rectification_matrix")
        projection = source.matrix(("projectionmatrix",), "projection_matrix", (3, 4))
        rectified.append((rotation, projection))
        sizes.append(source.size("imagewidth", "imageheight"))
    _check_sizes(files, sizes)
    pair = Pair((cameras[0], cameras[1]), rectified=(rectified[0], rectified[1]))
    return Read("ROS camera_info", pair, sizes[0], unit="m")


def _euroc(files: list[tuple[Path, Values]]) -> Read:
    cameras, poses, sizes = [], [], []
    for path, values in files:
        source = _Source(path, values)
        fisheye = source.text("distortionmodel") in _FISHEYE
        fu, fv, cu, cv = source.matrix(("intrinsics",), "intrinsics", (4,))
        matrix = np.array([[fu, 0, cu], [0, fv, cv], [0, 0, 1.0]])
        checked_intrinsics(path, "intrinsics", matrix)
        label = "distortion_coefficients"
        distortion = source.distortion(("distortioncoefficients",), label, fisheye=fisheye)
        cameras.append(Camera(matrix, distortion, fisheye))
        pose = source.matrix(("tbs",), "T_BS", (4, 4))
        _Source(path, {"tbs": pose[:3, :3]}).rotation(("tbs",), "the rotation in T_BS")
        if not np.allclose(pose[3], [0, 0, 0, 1]):
            raise InputError(f"{path}: the last row of T_BS is not 0 0 0 1: check the file")
        poses.append(pose)
        sizes.append(source.size("resolution"))
    _check_sizes(files, sizes)
    # T_BS takes points from the sensor's frame to the body's.
    right_from_left = np.linalg.inv(poses[1]) @ poses[0]
    rotation, translation = right_from_left[:3, :3], right_from_left[:3, 3]
    return Read("EuRoC", Pair((cameras[0], cameras[1]), rotation, translation), sizes[0], unit="m")


def _check_sizes(files: list[tuple[Path, Values]], sizes: list[tuple[int, int] | None]) -> None:
    left, right = sizes
    if left is not None and right is not None and left != right:
        raise InputError(
            f"{files[0][0]} is for {left[0]}x{left[1]} but {files[1][0]} is for "
            f"{right[0]}x{right[1]}: give the calibration of one rig"
        )
