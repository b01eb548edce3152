"""Files that are recognised but not read: what they are, and what to give instead."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from motionstereo_cli.errors import InputError

if TYPE_CHECKING:
    from motionstereo_cli.rig.structure import Values

_AS_JSON = "save the matrices as JSON, as M1 D1 M2 D2 R T"
#: First bytes of files that are not read, and what to do.
_BYTES = {
    b"\x80": "is a Python pickle, which could run programs: save the arrays with numpy.savez",
    b"\x93NUMPY": "is one array: save all of them with numpy.savez",
    b"MATLAB": f"is a MATLAB file: {_AS_JSON}",
    b"\x89HDF": f"is an HDF5 file: {_AS_JSON}",
    b"#ROSBAG": "is a ROS bag: give it as the recording, and its camera_info is found",
}

#: Patterns that identify files by their text before it is parsed: tables of maps are large.
_TEXTS = {
    r"^# (Camera|Image) list with": (
        "is COLMAP's, whose lengths have no known unit: give the calibration of the stereo camera"
    ),
    r"\"(transform_matrix|camera_angle_x)\"": (
        "is a transforms.json, of one camera and no known scale: give the calibration of the "
        "stereo camera"
    ),
    r"\"(camera_intrinsic|camera_data_)": (
        "is nuScenes' or Argoverse's table of sensors: give rig.yaml of the two cameras, or M1 D1 "
        "M2 D2 R T of them as JSON"
    ),
    r"^[ \t]*(?-i:VERTEX_CAM|EDGE_[A-Z])": (
        "is a graph of g2o: give the calibration of the stereo camera"
    ),
}


def refuse_foreign_bytes(path: Path, content: bytes) -> None:
    """Refuse files that are neither text nor .npz.

    Raises:
        InputError: it is such a file.
    """
    for start, advice in _BYTES.items():
        if content.startswith(start):
            raise InputError(f"{path} {advice}")


def refuse_foreign_text(path: Path, text: str) -> None:
    """Refuse texts that are identified by their first lines.

    Raises:
        InputError: it is such a file.
    """
    for pattern, advice in _TEXTS.items():
        if re.search(pattern, text[:_BEGINNING], re.MULTILINE | re.IGNORECASE):
            raise InputError(f"{path} {advice}")


#: How far into a text they are searched.
_BEGINNING = 4096


def refuse_foreign_values(path: Path, values: Values) -> None:
    """Refuse files that are identified by the names in them.

    Raises:
        InputError: it is such a file.
    """
    if "relativeconfigimucam" in values:
        chain = str(values["relativeconfigimucam"])
        raise InputError(
            f"{path} is the configuration of OpenVINS: give the file of the cameras that it names, "
            f"{chain}"
        )
    if "cammodel" in values:
        raise InputError(
            f"{path} is of one camera, as the former SVO has it: give rig.yaml, or kalibr's "
            "camchain of both"
        )
    cameras = [name for name in values if re.fullmatch(r"cam\d", name)]
    if not cameras and values.keys() & {"imu0", "accelerometernoisedensity"}:
        raise InputError(f"{path} is of an IMU: give the camchain, or the files, of the cameras")
    alone = values[cameras[0]] if len(cameras) == 1 else None
    if isinstance(alone, dict) and "cambl" not in alone:
        raise InputError(
            f"{path} has one camera, {cameras[0]}: give the camchain of both cameras of the rig"
        )
    lone = "cameramatrix" if "cameramatrix" in values else "k"
    if _is_matrix(values.get(lone)) and not values.keys() & {
        *("projectionmatrix", "rectificationmatrix", "cameramatrix2", "cameramatrix1"),
        *("p", "r", "t", "tbs"),
    }:
        raise InputError(
            f"{path} is of one camera: a stereo camera needs M1 D1 M2 D2 of both, and R and T "
            "between them (cv2.stereoCalibrate finds them)"
        )


def _is_matrix(value: Any) -> bool:
    return bool(np.asarray(value, object).size == 9)
