"""Calibrations that place each camera in the frame of a body, as SLAM programs do.

Readers raise InputError where a value is missing, or is not what it has to be.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from motionstereo_cli.errors import InputError
from motionstereo_cli.rig.cameras import (
    SHAPES,
    Pair,
    checked_intrinsics,
    intrinsic_matrix,
    lens_model,
)
from motionstereo_cli.rig.values import Source, coefficients

if TYPE_CHECKING:
    from motionstereo_cli.rig.cameras import Camera, Matrix
    from motionstereo_cli.rig.structure import Values

    Files = Sequence[tuple[Path, Values]]
    Numbers = tuple[int, int] | None

#: Names of distortion coefficients in ROS and related programs.
DISTORTION = ("distortioncoefficients", "distortioncoeffs", "d")
#: Names of lens parameters in files with one name per number.
_FOCAL = ("fx", "fy", "cx", "cy")
_FOCAL_OF_MEI = ("gamma1", "gamma2", "u0", "v0")
_FOCAL_OF_KANNALA = ("mu", "mv", "u0", "v0")


@dataclass(frozen=True, slots=True)
class Placed:
    """A camera and its pose.

    Attributes:
        camera: the camera.
        body_from_camera: (4, 4), takes points from the camera's frame to the body's.
        size: width and height in px, None if unknown.
        notes: assumptions, one line each.
    """

    camera: Camera
    body_from_camera: Matrix
    size: tuple[int, int] | None = None
    notes: tuple[str, ...] = ()


def pair_of(name: object, kind: str, cameras: Sequence[Placed], numbers: Numbers = None) -> Pair:
    """Return the pair of two of the cameras; the first two if no numbers are given.

    Raises:
        InputError: there are no such cameras, or their images differ in size.
    """
    if len(cameras) < 2:
        raise InputError(
            f"{name} is of {kind} and has one camera: give the file with both cameras of the rig"
        )
    if numbers is not None and max(numbers) >= len(cameras):
        raise InputError(f"{name} has {len(cameras)} cameras, from 0: give two of their numbers")
    left, right = (cameras[number] for number in numbers or (0, 1))
    notes = left.notes + right.notes
    if len(cameras) > 2 and numbers is None:
        notes += (f"{name} has {len(cameras)} cameras: the first two are taken",)
    return by_transform(
        *(kind, (left.camera, right.camera)),
        inverse(right.body_from_camera) @ left.body_from_camera,
        size=common_size(name, (left.size, right.size)),
        notes=notes,
        body_from_left=left.body_from_camera,
    )


def by_transform(
    kind: str,
    cameras: tuple[Camera, Camera],
    right_from_left: Matrix,
    *,
    size: tuple[int, int] | None,
    notes: tuple[str, ...],
    body_from_left: Matrix | None = None,
) -> Pair:
    """Return the pair of cameras, with the transform (4, 4) from the left to the right one in m."""
    turn, shift = right_from_left[:3, :3], right_from_left[:3, 3]
    return Pair(
        *(kind, cameras, turn, shift),
        size=size,
        unit="m",
        notes=notes,
        body_from_left=body_from_left,
    )


def common_size(name: object, sizes: Sequence[tuple[int, int] | None]) -> tuple[int, int] | None:
    """Return the size of both cameras' images, as far as it is known.

    Raises:
        InputError: they differ.
    """
    known = [size for size in sizes if size is not None]
    if len(set(known)) > 1:
        (w1, h1), (w2, h2) = known
        raise InputError(
            f"{name}: the cameras are of {w1}x{h1} and {w2}x{h2} px: give the calibration of one "
            "rig"
        )
    return next(iter(known), None)


def names_of(files: Files) -> str:
    """Return what messages call several files."""
    return " and ".join(str(path) for path, _ in files)


def inverse(transform: Matrix) -> Matrix:
    """Return the inverse of a transform (4, 4)."""
    return np.asarray(np.linalg.inv(transform), np.float64)


def joined(values: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Return nested values by the joined names of all levels."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            flat |= joined(value, before + name)
        else:
            flat[before + name] = value
    return flat


def cameras_in(values: Values) -> list[Any]:
    """Return the ``cameras`` of a file, or of the sensor that has them (maplab)."""
    cameras = _lists(values, "cameras")
    rigs = (_lists(sensor, "cameras") for sensor in _lists(values, "sensors"))
    return cameras or next(filter(None, rigs), [])


def _lists(values: Values, name: str) -> list[Any]:
    found = values.get(name)
    return [each for each in found if isinstance(each, Mapping)] if isinstance(found, list) else []


def read_euroc(files: Files) -> Pair:
    """Return the pair of two EuRoC sensor.yaml, with ``T_BS``."""
    placed = []
    for path, values in files:
        source = Source(path, values)
        lens, notes = source.camera_of_list(("intrinsics",), DISTORTION, "distortion_coefficients")
        pose = source.transform(("tbs",), "T_BS")
        placed.append(Placed(lens, pose, source.size("resolution"), notes))
    return pair_of(names_of(files), "EuRoC", placed)


def read_okvis(path: Path, values: Values, numbers: Numbers) -> Pair:
    """Return the pair of OKVIS' and OKVIS2's ``cameras``, with ``T_SC``."""
    placed = []
    for number, camera in enumerate(cameras_in(values)):
        source = Source(f"{path}: camera {number}", camera)
        focal = source.matrix(("focallength",), "focal_length", (2,))
        centre = source.matrix(("principalpoint",), "principal_point", (2,))
        matrix = intrinsic_matrix(*focal, *centre)
        checked_intrinsics(source.name, "focal_length", matrix)
        lens, notes = source.camera(
            matrix, ("distortioncoefficients",), "distortion_coefficients", ("distortiontype",)
        )
        pose = source.transform(("tsc",), "T_SC")
        placed.append(Placed(lens, pose, source.size("imagedimension"), notes))
    return pair_of(path, "OKVIS", placed, numbers)


def read_ncamera(path: Path, values: Values, numbers: Numbers) -> Pair:
    """Return the pair of an ncamera of maplab, ROVIO and SVO, with ``T_B_C`` or ``T_C_B``."""
    placed = []
    for number, item in enumerate(cameras_in(values)):
        inner = item.get("camera")
        flat = {**item, **(joined(inner) if isinstance(inner, Mapping) else {})}
        source = Source(f"{path}: camera {number}", flat)
        models = ("type", "distortiontype")
        lens, notes = source.camera_of_list(
            *(("intrinsics", "intrinsicsdata"), ("distortionparameters",)),
            *("distortion parameters", models),
        )
        pose = (
            source.transform(("tbc",), "T_B_C")
            if source.find(("tbc",))
            else inverse(source.transform(("tcb",), "T_B_C (or T_C_B)"))
        )
        placed.append(Placed(lens, pose, source.size("imagewidth", "imageheight"), notes))
    return pair_of(path, "ncamera (maplab, SVO)", placed, numbers)


def read_basalt(path: Path, values: Values, numbers: Numbers) -> Pair:
    """Return the pair of Basalt's calibration, with ``T_imu_cam``."""
    calibration = values["value0"]
    sizes = calibration.get("resolution")
    poses, placed = _lists(calibration, "timucam"), []
    for number, (item, pose) in enumerate(
        zip(_lists(calibration, "intrinsics"), poses, strict=False)
    ):
        inner = item.get("intrinsics")
        given = {**item, **(inner if isinstance(inner, Mapping) else {})}
        name = f"{path}: camera {number}"
        source = Source(name, given)
        kind = source.text("cameratype")
        if kind == "ucm":  # the extended model with beta = 1
            given = {**given, "cameratype": "eucm", "beta": 1.0}
        lens, notes = _by_parts(Source(name, given), _FOCAL, ("cameratype",))
        size = None
        if isinstance(sizes, list) and number < len(sizes):
            size = Source(name, {"resolution": sizes[number]}).size("resolution")
        placed.append(Placed(lens, _of_quaternion(Source(name, pose)), size, notes))
    return pair_of(path, "Basalt", placed, numbers)


def read_t265(path: Path, values: Values, numbers: Numbers) -> Pair:
    """Return the pair of a RealSense T265's JSON; T and W take a camera's points to the body."""
    placed = []
    for number, item in enumerate(cameras_in(values)):
        flat = joined(item)
        source = Source(f"{path}: camera {number}", flat)
        focal = source.matrix(("focallengthpx",), "focal_length_px", (2,))
        centre = source.matrix(("centerpx",), "center_px", (2,))
        matrix = checked_intrinsics(
            source.name, "focal_length_px", intrinsic_matrix(*focal, *centre)
        )
        lens, notes = source.camera(matrix, ("distortionk",), "distortion k", ("distortiontype",))
        pose = np.eye(4)
        pose[:3, :3] = source.rotation(("extrinsicsw",), "extrinsics W")
        pose[:3, 3] = source.matrix(("extrinsicst",), "extrinsics T", (3,))
        placed.append(Placed(lens, pose, source.size("sizepx"), notes))
    return pair_of(path, "RealSense T265", placed, numbers)


def read_ov2slam(path: Path, values: Values, numbers: Numbers) -> Pair:
    """Return the pair of OV2SLAM's settings: ``Camera.fxl`` ..., ``body_T_cam0``."""
    placed = []
    for number, side in enumerate(("left", "right")):
        letter = side[0]
        names = (*_FOCAL, "k1", "k2", "p1", "p2", "k3", "k4")
        given = {
            part: values[f"camera{part}{letter}"]
            for part in names
            if values.get(f"camera{part}{letter}") is not None
        }
        source = Source(f"{path}: {side}", given | {"model": values.get(f"cameramodel{side}")})
        lens, notes = _by_parts(source, _FOCAL, ("model",))
        whole = Source(path, values)
        size = whole.size(f"camera{side}nwidth", f"camera{side}nheight")
        pose = whole.transform((f"bodytcam{number}",), f"body_T_cam{number}")
        placed.append(Placed(lens, pose, size, notes))
    return pair_of(path, "OV2SLAM", placed, numbers)


def read_vins(files: Files, numbers: Numbers) -> Pair:
    """Return the pair of VINS-Fusion: its configuration and the files of both cameras.

    Where both cameras share a file, it is given once.
    """
    configs = [each for each in files if "bodytcam0" in each[1]]
    lenses = [each for each in files if is_camodocal(each[1])]
    name = names_of(files)
    if len(configs) != 1 or not 1 <= len(lenses) <= 2:
        raise InputError(
            f"{name}: VINS-Fusion keeps the cameras and where they sit in several files: give its "
            "configuration with body_T_cam0 and body_T_cam1 and the files of both cameras, the "
            "left one's first: --rig config.yaml --rig cam0.yaml --rig cam1.yaml"
        )
    config = Source(*configs[0])
    if not config.find(("bodytcam1",)):
        raise InputError(f"{config.name} is VINS' of one camera: body_T_cam1 is missing")
    _check_order(configs[0], lenses)
    placed = []
    for number, (path, values) in enumerate((lenses * 2)[:2]):
        flat = {**values}
        for part in ("distortionparameters", "projectionparameters", "mirrorparameters"):
            inner = values.get(part)
            flat |= inner if isinstance(inner, Mapping) else {}
        source = Source(path, flat)
        if _is_kannala(flat):
            moved = {f"k{n}": source.number((f"k{n + 1}",), f"k{n + 1}") for n in (1, 2, 3, 4)}
            source = Source(path, {**flat, **moved, "k5": None})
        focal = next((each for each in (_FOCAL, _FOCAL_OF_MEI, _FOCAL_OF_KANNALA)
                      if source.find(each[:1])), _FOCAL)  # fmt: skip
        lens, notes = _by_parts(source, focal, ("modeltype",))
        pose = config.transform((f"bodytcam{number}",), f"body_T_cam{number}")
        size = source.size("imagewidth", "imageheight")
        placed.append(Placed(lens, pose, size, notes))
    return pair_of(name, "VINS-Fusion", placed, numbers)


def _check_order(config: tuple[Path, Values], lenses: Files) -> None:
    """Make sure that the files of the cameras are in the order in which a configuration has them.

    Raises:
        InputError: it names them the other way round.
    """
    path, values = config
    named = [Path(str(values.get(f"cam{number}calib"))).name for number in (0, 1)]
    given = [file.name for file, _ in lenses]
    if len(given) == 2 and given != named and given[::-1] == named:
        raise InputError(
            f"{path} says that {named[0]} is of the left camera (cam0) and {named[1]} of the right "
            "one: give them in that order"
        )


def is_camodocal(values: Values) -> bool:
    """Return whether a file is a camera of camodocal, as VINS uses them."""
    return "modeltype" in values and "projectionparameters" in values


def _is_kannala(flat: Mapping[str, Any]) -> bool:
    # Its k2 to k5 are cv2.fisheye's k1 to k4.
    model = re.sub("[^a-z]", "", str(flat.get("modeltype")).lower())
    return model == "kannalabrandt"


def read_mrcal(files: Files) -> Pair:
    """Return the pair of two cameramodels of mrcal, the left camera's first."""
    placed = []
    for path, values in files:
        source = Source(path, values)
        intrinsics = source.array(("intrinsics",), "intrinsics").ravel()
        model = source.text("lensmodel").removeprefix("lensmodel_")
        known = re.fullmatch(r"(pinhole|opencv(?:4|5|8|12))", model)
        if known is None or intrinsics.size < 4:
            raise InputError(
                f"{path} is a cameramodel of mrcal with the lens model {model[:40]!r}: convert it "
                "to LENSMODEL_OPENCV8 (mrcal-convert-lensmodel)"
            )
        matrix = checked_intrinsics(path, "intrinsics", intrinsic_matrix(*intrinsics[:4]))
        given = Source(path, {"d": intrinsics[4:]})
        lens, notes = given.camera(matrix, ("d",), "the distortion in intrinsics", ())
        rt = source.matrix(("extrinsics", "rtcamref"), "extrinsics", (6,))
        camera_from_body = np.eye(4)
        camera_from_body[:3, :3] = cv2.Rodrigues(rt[:3])[0]
        camera_from_body[:3, 3] = rt[3:]
        size = source.size("imagersize")
        placed.append(Placed(lens, inverse(camera_from_body), size, notes))
    return pair_of(names_of(files), "mrcal", placed)


def _by_parts(
    source: Source, focal: Sequence[str], models: Sequence[str]
) -> tuple[Camera, tuple[str, ...]]:
    """Return a camera whose parameters have one name each: fx, k1, xi ..."""
    numbers = [source.number((part,), part) for part in focal]
    matrix = checked_intrinsics(source.name, focal[0], intrinsic_matrix(*numbers))
    said = source.lenses(models)
    wanted = SHAPES.get(lens_model(source.name, said), ())
    shape = [source.number((part,), part) for part in wanted]
    model = lens_model(source.name, said)
    found = coefficients(source, ("",)) or []
    if model == "fov":
        found = [source.number(("w",), "w")]
    elif model == "fisheye" and not found:
        raise InputError(f"{source.name}: k1 to k4 of the fisheye are missing: add them")
    given = Source(source.name, {"d": found, **{name: source.values.get(name) for name in models}})
    return given.camera(matrix, ("d",), "k1 ...", models, shape)


def _of_quaternion(source: Source) -> Matrix:
    from motionstereo_cli.rig.pose_forms import rotations

    place = [source.number((part,), part) for part in ("px", "py", "pz")]
    turn = np.array([[source.number((part,), part) for part in ("qx", "qy", "qz", "qw")]])
    if not 0.9 < np.linalg.norm(turn) < 1.1:
        raise InputError(f"{source.name}: qx qy qz qw is not a rotation: check the file")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotations(turn)[0], place
    return pose
