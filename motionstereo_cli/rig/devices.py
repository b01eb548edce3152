"""Calibrations of stereo cameras with a memory of their own: DepthAI and ZED.

Readers raise InputError where a value is missing, or is not what it has to be.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from motionstereo_cli.errors import InputError
from motionstereo_cli.rig.cameras import Pair, checked_intrinsics, intrinsic_matrix
from motionstereo_cli.rig.values import Source, coefficients

if TYPE_CHECKING:
    from motionstereo_cli.rig.cameras import Camera, Matrix
    from motionstereo_cli.rig.structure import Values

#: Sizes of a ZED's recordings by their names in its files.
_ZED_SIZES = {
    **{"2k": (2208, 1242), "fhd": (1920, 1080), "fhd1200": (1920, 1200), "hd": (1280, 720)},
    **{"vga": (672, 376), "svga": (960, 600), "qhdplus": (3200, 1800), "4k": (3840, 2160)},
}

#: DepthAI's camera types.
_DEPTHAI_LENSES = {0: "perspective", 1: "fisheye", 2: "equirectangular", 3: "radial division"}

#: Cameras of one device, with extrinsics relative to one another.
_MAX_LINKS = 16


def read_depthai(path: Path, values: Values, size: tuple[int, int] | None) -> Pair:
    """Return the pair of DepthAI's calibration JSON: its stereo pair; lengths are in cm.

    Images of another size than the calibration's are assumed to be scaled, and cropped equally at
    top and bottom (or left and right), as the device does.
    """
    cameras = _sockets(path, values)
    stereo = Source(path, values.get("stereorectificationdata") or {})
    left, right = (
        int(stereo.number((f"{side}camerasocket",), f"{side}CameraSocket"))
        for side in ("left", "right")
    )
    for socket in (left, right):
        if socket not in cameras:
            raise InputError(f"{path}: there is no camera at socket {socket}: check the file")
    found, sizes = [], []
    notes: list[str] = []
    for socket in (left, right):
        source = Source(f"{path}: camera {socket}", cameras[socket])
        own = source.size("width", "height")
        matrix = source.intrinsics(("intrinsicmatrix",), "intrinsicMatrix")
        if own is not None:
            matrix = _resized(matrix, own, size or own)
        kind = int(source.number(("cameratype",), "cameraType"))
        lens = _DEPTHAI_LENSES.get(kind, f"cameraType {kind}")
        source = Source(source.name, {**source.values, "lensmodel": lens})
        camera, assumed = source.camera(
            matrix, ("distortioncoeff",), "distortionCoeff", ("lensmodel",)
        )
        found.append(camera)
        notes += assumed
        sizes.append(own)
    places = _from_socket(path, cameras, left), _from_socket(path, cameras, right)
    common = next((socket for socket in places[0] if socket in places[1]), None)
    if common is None:
        raise InputError(f"{path}: no extrinsics lead from camera {left} to camera {right}")
    right_from_left = np.linalg.inv(places[1][common]) @ places[0][common]
    if size is not None and sizes[0] not in (None, size):
        notes.append(
            f"{path} is for {sizes[0][0]}x{sizes[0][1]}: it is scaled to {size[0]}x{size[1]}"
        )
    return Pair(
        "DepthAI",
        (found[0], found[1]),
        right_from_left[:3, :3],
        right_from_left[:3, 3],
        size=size or sizes[0],
        unit="cm",
        notes=tuple(notes),
    )


def _sockets(path: Path, values: Values) -> dict[int, Any]:
    cameras = {}
    for item in values.get("cameradata") or ():
        if isinstance(item, list) and len(item) == 2 and isinstance(item[1], dict):
            cameras[int(Source(path, {"socket": item[0]}).number(("socket",), "socket"))] = item[1]
    return cameras


def _from_socket(path: Path, cameras: dict[int, Any], socket: int) -> dict[int, Matrix]:
    """Return the transforms from a camera's frame to those of others, by their sockets."""
    reached, there = {socket: np.eye(4)}, np.eye(4)
    for _ in range(_MAX_LINKS):
        extrinsics = cameras.get(socket, {}).get("extrinsics")
        if not isinstance(extrinsics, dict):
            break
        source = Source(f"{path}: camera {socket}", extrinsics)
        to = int(source.number(("tocamerasocket",), "toCameraSocket"))
        translation = extrinsics.get("translation")
        if to not in cameras or to in reached or not isinstance(translation, dict):
            break
        part = Source(source.name, translation)
        step = np.eye(4)
        step[:3, :3] = source.rotation(("rotationmatrix",), "rotationMatrix")
        step[:3, 3] = [part.number((axis,), f"translation.{axis}") for axis in "xyz"]
        there = step @ there
        reached[to] = there
        socket = to
    return reached


def _resized(matrix: Matrix, own: tuple[int, int], size: tuple[int, int]) -> Matrix:
    scale = max(size[0] / own[0], size[1] / own[1])
    cut_px = [(own[axis] * scale - size[axis]) / 2 for axis in (0, 1)]
    scaled = matrix * scale
    scaled[0, 2] -= cut_px[0]
    scaled[1, 2] -= cut_px[1]
    scaled[2] = matrix[2]
    return scaled


def read_zed(path: Path, values: Values, size: tuple[int, int] | None) -> Pair:
    """Return the pair of a ZED's SN*.conf at the size of the recordings; lengths are in mm."""
    known = {
        name: each
        for name, each in _ZED_SIZES.items()
        if isinstance(values.get(f"leftcam{name}"), dict)
    }
    sizes = ", ".join(f"{width}x{height}" for width, height in known.values())
    if size is None and len(known) == 1:
        (size,) = known.values()
    if size is None:
        raise InputError(f"{path} has a calibration for each of {sizes}: give --size WIDTHxHEIGHT")
    name = next((name for name, each in known.items() if each == size), None)
    if name is None:
        raise InputError(
            f"{path} has calibrations for {sizes or 'no size'}, not for {size[0]}x{size[1]}: "
            "give the recording in one of these sizes"
        )
    stereo = Source(f"{path}: STEREO", values.get("stereo") or {})
    turns = [
        stereo.number((f"{axis}{name}", axis), f"{axis}_{name}") for axis in ("rx", "cv", "rz")
    ]
    lengths = [stereo.number(("baseline",), "Baseline")]
    for axis in ("ty", "tz"):
        found = stereo.find((f"{axis}{name}", axis))
        lengths.append(stereo.number((found,), found) if found else 0.0)
    left, right = (_zed_camera(path, values, f"{side}cam{name}") for side in ("left", "right"))
    rotation = np.asarray(cv2.Rodrigues(np.array(turns))[0], np.float64)
    return Pair("ZED", (left, right), rotation, -np.array(lengths), size=size, unit="mm")


def _zed_camera(path: Path, values: Values, section: str) -> Camera:
    source = Source(f"{path}: {section}", values.get(section) or {})
    numbers = [source.number((part,), part) for part in ("fx", "fy", "cx", "cy")]
    matrix = checked_intrinsics(source.name, "the camera", intrinsic_matrix(*numbers))
    given = Source(source.name, {"d": coefficients(source, ("",)) or []})
    camera, _ = given.camera(matrix, ("d",), "k1 k2 p1 p2 k3")
    return camera
