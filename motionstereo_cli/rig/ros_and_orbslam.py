"""Calibrations of SLAM programs and drivers: one file per camera, or one for both.

Readers raise InputError where a value is missing, or is not what it has to be.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from motionstereo_cli.errors import InputError
from motionstereo_cli.rig.cameras import Pair, checked_intrinsics, intrinsic_matrix, rectified_pair
from motionstereo_cli.rig.placed import (
    DISTORTION,
    by_transform,
    common_size,
    inverse,
    joined,
    names_of,
)
from motionstereo_cli.rig.values import Source, coefficients, flattened

if TYPE_CHECKING:
    from motionstereo_cli.rig.cameras import Camera, Matrix
    from motionstereo_cli.rig.structure import Values

    Files = Sequence[tuple[Path, Values]]


#: Share of the baseline and angle by which a transform may differ from the same one stated twice.
_MAX_APART_SHARE, _MAX_APART_DEG = 0.1, 1.0


def read_ros(files: Files) -> Pair:
    """Return the pair of two ROS camera_info files, or of two messages as ``ros2 topic`` prints."""
    cameras, rectified, sizes = [], [], []
    notes: list[str] = []
    for path, values in files:
        source = Source(path, values)
        matrix = source.intrinsics(("cameramatrix", "k"), "camera_matrix")
        camera, assumed = source.camera(matrix, DISTORTION, "distortion_coefficients")
        cameras.append(camera)
        notes += assumed
        rotation = source.rotation(("rectificationmatrix", "r"), "rectification_matrix")
        projection = source.matrix(("projectionmatrix", "p"), "projection_matrix", (3, 4))
        rectified.append((rotation, projection))
        sizes.append(source.size("imagewidth", "imageheight") or source.size("width", "height"))
    size = common_size(names_of(files), sizes)
    (_, first), (_, second) = rectified
    if first[0, 3] and not second[0, 3]:
        raise InputError(
            f"{files[0][0]}: P[0,3] is {first[0, 3]:g} and that of {files[1][0]} is 0, which is "
            "the left camera's in ROS: give that file first"
        )
    return Pair(
        "ROS camera_info",
        (cameras[0], cameras[1]),
        rectified=(rectified[0], rectified[1]),
        size=size,
        unit="m",
        notes=tuple(notes),
    )


def read_kalibr(path: Path, values: Values) -> Pair:
    """Return the pair of kalibr's camchain: cam0 and cam1, whose T_cn_cnm1 leads from cam0."""
    cameras, sizes = [], []
    notes: list[str] = []
    parts = [Source(f"{path}: {name}", values[name]) for name in ("cam0", "cam1")]
    for source in parts:
        camera, assumed = source.camera_of_list(("intrinsics",), DISTORTION, "distortion_coeffs")
        cameras.append(camera)
        notes += assumed
        sizes.append(source.size("resolution"))
    if "cam2" in values:
        notes.append(f"{path} has more than two cameras: cam0 and cam1 are taken")
    left_from_body = right_from_body = None
    if all(source.find(("tcamimu",)) for source in parts):
        left_from_body, right_from_body = (
            source.transform(("tcamimu",), "T_cam_imu") for source in parts
        )
    elif all(source.find(("timucam",)) for source in parts):  # OpenVINS has them the other way
        left_from_body, right_from_body = (
            inverse(source.transform(("timucam",), "T_imu_cam")) for source in parts
        )
    placed = None
    if right_from_body is not None and left_from_body is not None:
        placed = right_from_body @ inverse(left_from_body)
    if placed is None or parts[1].find(("tcncnm1",)):
        right_from_left = parts[1].transform(("tcncnm1",), "T_cn_cnm1")
        if placed is not None:
            _check_agree(path, right_from_left, placed)
    else:
        right_from_left = placed
    return by_transform(
        "kalibr camchain",
        (cameras[0], cameras[1]),
        right_from_left,
        size=common_size(path, sizes),
        notes=tuple(notes),
        body_from_left=None if left_from_body is None else inverse(left_from_body),
    )


def _check_agree(path: Path, chained: Matrix, placed: Matrix) -> None:
    """Make sure that both transforms from the left to the right camera are nearly the same.

    Raises:
        InputError: they are not.
    """
    one_m, other_m = (float(np.linalg.norm(each[:3, 3])) for each in (chained, placed))
    apart_m = float(np.linalg.norm(chained[:3, 3] - placed[:3, 3]))
    turn, _ = cv2.Rodrigues(chained[:3, :3] @ placed[:3, :3].T)
    apart_deg = math.degrees(float(np.linalg.norm(turn)))
    if apart_m > _MAX_APART_SHARE * max(one_m, other_m) or apart_deg > _MAX_APART_DEG:
        raise InputError(
            f"{path} contradicts itself: T_cn_cnm1 places the cameras {one_m:.4g} m apart, and the "
            f"poses in the frame of the IMU {other_m:.4g} m, turned by {apart_deg:.3g} degrees "
            "against that: delete T_cn_cnm1 of cam1, or those poses, whichever is wrong"
        )


def read_stella(path: Path, values: Values) -> Pair:
    """Return the pair of stella_vslam's and OpenVSLAM's settings of a stereo camera.

    ``Camera`` is the rectified camera; ``StereoRectifier`` has the rectification.
    """
    source = Source(path, joined(values))
    setup = source.text("camerasetup")
    if setup not in ("", "stereo"):
        raise InputError(
            f"{path} is of stella_vslam and of a {setup} camera: give the one of the stereo camera "
            "(setup: stereo)"
        )
    fx, fy, cx, cy = (
        source.number((f"camera{part}",), f"Camera.{part}") for part in ("fx", "fy", "cx", "cy")
    )
    left = np.column_stack([intrinsic_matrix(fx, fy, cx, cy), np.zeros(3)])
    right = left.copy()
    right[0, 3] = -source.number(("camerafocalxbaseline",), "Camera.focal_x_baseline")
    size = source.size("cameracols", "camerarows")
    if source.find(("stereorectifierkleft",)) is None:
        return rectified_pair("stella_vslam", (left, right), size, "m")
    cameras, rotations = [], []
    notes: list[str] = []
    for side in ("left", "right"):
        name = f"StereoRectifier.{{}}_{side}"
        matrix = source.intrinsics((f"stereorectifierk{side}",), name.format("K"))
        names = (f"stereorectifierd{side}",)
        camera, assumed = source.camera(matrix, names, name.format("D"), ("stereorectifiermodel",))
        cameras.append(camera)
        notes += assumed
        rotations.append(source.rotation((f"stereorectifierr{side}",), name.format("R")))
    return Pair(
        "stella_vslam",
        (cameras[0], cameras[1]),
        rectified=((rotations[0], left), (rotations[1], right)),
        size=size,
        unit="m",
        notes=tuple(notes),
    )


def read_orb_slam(path: Path, values: Values) -> Pair:
    """Return the pair of ORB-SLAM2's or ORB-SLAM3's settings.

    LEFT.K ... RIGHT.P, or Camera1.fx ... and Stereo.T_c1_c2, or, for rectified images, Camera.fx
    ... and Camera.bf or Stereo.b.
    """
    source = Source(path, flattened(values))
    size = source.size("camerawidth", "cameraheight")
    if source.find(("leftk",)):
        return _orb_slam_maps(source, size)
    if source.find(("depthmapfactor", "rgbddepthmapfactor")):
        raise InputError(
            f"{path} is ORB-SLAM's of an RGB-D camera (DepthMapFactor), whose Camera.bf is of no "
            "second camera: give the settings of the stereo camera"
        )
    left = "camera1" if source.find(("camera1fx",)) else "camera"
    first, notes = _orb_slam_camera(source, left)
    in_left = next((n for n in ("stereotc1c2", "tlr") if source.find((n,))), None)
    if in_left is None:
        fx = first.matrix[0, 0]
        if source.find(("stereob",)):
            baseline = source.number(("stereob",), "Stereo.b")
        elif source.find(("camerabf",)):
            baseline = source.number(("camerabf",), "Camera.bf") / fx
        else:
            raise InputError(
                f"{path} is ORB-SLAM's of one camera (Camera.bf, or Stereo.b, is missing): give "
                "the settings of the stereo camera"
            )
        if first.distortion.any():
            raise InputError(
                f"{path}: Camera has distortion and there is no second camera: give LEFT.K ... "
                "RIGHT.P, or Camera2.fx ... and Stereo.T_c1_c2"
            )
        projection = np.column_stack([first.matrix, np.zeros(3)])
        second_projection = projection.copy()
        second_projection[0, 3] = -fx * baseline
        return rectified_pair("ORB-SLAM", (projection, second_projection), size, "m", notes)
    second, more = _orb_slam_camera(source, "camera2")
    left_from_right = source.transform((in_left,), "Stereo.T_c1_c2 (or Tlr)")
    right_from_left = inverse(left_from_right)
    notes += more
    return by_transform("ORB-SLAM", (first, second), right_from_left, size=size, notes=notes)


def _orb_slam_camera(source: Source, prefix: str) -> tuple[Camera, tuple[str, ...]]:
    label = prefix.capitalize()
    numbers = [
        source.number((prefix + part,), f"{label}.{part}") for part in ("fx", "fy", "cx", "cy")
    ]
    matrix = checked_intrinsics(source.name, label, intrinsic_matrix(*numbers))
    found = coefficients(source, (prefix,)) or []
    given = Source(source.name, {**source.values, "d": found})
    return given.camera(matrix, ("d",), f"{label}.k1 ...", ("cameratype",))


def _orb_slam_maps(source: Source, size: tuple[int, int] | None) -> Pair:
    cameras, rectified = [], []
    notes: list[str] = []
    for side in ("left", "right"):
        label = side.upper()
        matrix = source.intrinsics((f"{side}k",), f"{label}.K")
        camera, assumed = source.camera(matrix, (f"{side}d",), f"{label}.D", ("cameratype",))
        cameras.append(camera)
        notes += assumed
        rotation = source.rotation((f"{side}r",), f"{label}.R")
        rectified.append((rotation, source.matrix((f"{side}p",), f"{label}.P", (3, 4))))
    return Pair(
        "ORB-SLAM",
        (cameras[0], cameras[1]),
        rectified=(rectified[0], rectified[1]),
        size=source.size("leftwidth", "leftheight") or size,
        unit="m",
        notes=tuple(notes),
    )
