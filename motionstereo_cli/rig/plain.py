"""Calibrations as plain text: KITTI, Middlebury, ROS's ost.txt, and bare numbers.

Readers raise InputError where a value is missing, or is not what it has to be.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from motionstereo_cli.errors import InputError
from motionstereo_cli.rig.cameras import (
    Camera,
    Pair,
    checked_intrinsics,
    intrinsic_matrix,
    rectified_pair,
)
from motionstereo_cli.rig.values import Source

if TYPE_CHECKING:
    from motionstereo_cli.rig.structure import Values

#: Patterns that identify a format.
MIDDLEBURY = re.compile(r"^\s*cam0\s*=", re.MULTILINE)
KITTI = re.compile(r"^P(_rect_)?\d+[ \t]*:[ \t]*[-+.\d]", re.MULTILINE)
OST = re.compile(r"^camera matrix\s*$", re.MULTILINE)


def read_kitti(
    path: Path, text: str, pair: tuple[int, int] | None, recorded: tuple[int, int] | None = None
) -> Pair:
    """Return the pair of KITTI's calib.txt or calib_cam_to_cam.txt, by its numbers.

    The latter also tells how to rectify images as they were recorded, by their width and height.
    """
    values: dict[str, Any] = {}
    for line in text.splitlines():
        key, colon, numbers = line.partition(":")
        if colon:
            values[key.strip()] = _floats(numbers)
    raw = any(key.startswith("P_rect_") for key in values)
    labels = {
        int(found[1]): key
        for key in values
        if (found := re.fullmatch(r"P_rect_(\d+)" if raw else r"P(\d+)", key))
    }
    notes: tuple[str, ...] = ()
    if pair is None:
        pair = (0, 1) if labels.keys() >= {0, 1} else (2, 3)
        if len(labels) == 2:
            first, second = sorted(labels)
            pair = first, second
        if labels.keys() >= {0, 1, 2, 3}:
            notes = (f"the file has four cameras: {pair[0]} and {pair[1]} are taken",)
    source = Source(path, values)
    left, right = (
        source.matrix((label,), label, (3, 4))
        for label in (labels.get(n, f"P_rect_{n:02d}" if raw else f"P{n}") for n in pair)
    )
    size = source.size(labels.get(pair[0], "P").replace("P_", "S_")) if raw else None
    if raw and recorded is not None and recorded != size:
        names = [labels[n].removeprefix("P_rect_") for n in pair]
        if all(source.size(f"S_{name}") == recorded for name in names):
            return _as_recorded(source, names, recorded, notes)
    measured_m = _measured_m(values, [labels[n] for n in pair]) if raw else None
    # A focal length that is none is refused with all else that the pair has to be.
    stated_m = (left[0, 3] - right[0, 3]) / right[0, 0] if right[0, 0] > 0 else np.nan
    if measured_m and abs(stated_m - measured_m) > _MAX_BASELINES_APART * measured_m:
        notes += (
            f"{path}: {labels[pair[1]]} places the cameras {stated_m:.4g} m apart, and T "
            f"{measured_m:.4g} m, as where P was made for images of another size: T is taken",
        )
        right[0, 3] = left[0, 3] - right[0, 0] * measured_m
    return rectified_pair("KITTI", (left, right), size, "m", notes)


def _as_recorded(
    source: Source, names: list[str], size: tuple[int, int], notes: tuple[str, ...]
) -> Pair:
    """Return the pair of two cameras' images that are not rectified, by the cameras' numbers."""
    cameras, turns, shifts = [], [], []
    for name in names:
        matrix = source.intrinsics((f"K_{name}",), f"K_{name}")
        cameras.append(Camera(matrix, source.matrix((f"D_{name}",), f"D_{name}", (5,))))
        turns.append(source.rotation((f"R_{name}",), f"R_{name}"))
        shifts.append(source.matrix((f"T_{name}",), f"T_{name}", (3,)))
    turn = turns[1] @ turns[0].T
    shift = shifts[1] - turn @ shifts[0]
    left, right = cameras
    return Pair("KITTI", (left, right), turn, shift, size=size, unit="m", notes=notes)


#: Share by which the baseline in P may differ from that between the cameras as they were measured.
_MAX_BASELINES_APART = 0.05


def _measured_m(values: dict[str, Any], labels: list[str]) -> float | None:
    """Return how far two cameras are apart by R_xx and T_xx, None where these are not there."""
    places = []
    turn: Any
    shift: Any
    for label in labels:
        turn, shift = (values.get(label.replace("P_rect", name)) for name in "RT")
        if np.size(turn) != 9 or np.size(shift) != 3:
            return None
        places.append(np.reshape(turn, (3, 3)).T @ np.ravel(shift))
    return float(np.linalg.norm(places[1] - places[0]))


def read_middlebury(path: Path, text: str) -> Pair:
    """Return the pair of Middlebury's and ETH3D's calib.txt."""
    values: dict[str, Any] = {}
    for line in text.splitlines():
        key, equals, numbers = line.partition("=")
        if equals:
            values[key.strip()] = _floats(numbers)
    source = Source(path, values)
    first, second = (source.intrinsics((name,), name) for name in ("cam0", "cam1"))
    baseline = source.number(("baseline",), "baseline")
    doffs = second[0, 2] - first[0, 2]
    if "doffs" in values:
        stated = source.number(("doffs",), "doffs")
        if abs(stated - doffs) > 0.01:
            raise InputError(
                f"{path}: doffs is {stated:g} but cam1 and cam0 differ by {doffs:g} px: "
                "check the file"
            )
    right = np.column_stack([second, [-second[0, 0] * baseline, 0, 0]])
    left = np.column_stack([first, np.zeros(3)])
    return rectified_pair("Middlebury", (left, right), source.size("width", "height"), "mm")


def _floats(text: str) -> list[float] | None:
    try:
        return [float(part) for part in re.split(r"[\s,;\[\]]+", text.strip()) if part]
    except ValueError:
        return None  # dates and names


def read_rows(path: Path, text: str) -> Pair | None:
    """Return the pair of bare numbers; None if they are none.

    Two (or more) rows of 12 are projections, as KITTI's without names; 9 numbers and one more are
    K and the baseline, as FoundationStereo's K.txt has them. Images are rectified.

    Raises:
        InputError: they are of one camera.
    """
    rows = [_floats(line) for line in text.splitlines() if line.strip()]
    numbers = [row for row in rows if row is not None]
    if len(numbers) < len(rows) or not numbers:
        return None
    counts = [len(row) for row in numbers]
    if counts in ([9, 1], [3, 3, 3, 1]):
        (*k, baseline) = [value for row in numbers for value in row]
        source = Source(path, {"K": k})
        left = np.column_stack([source.intrinsics(("K",), "K"), np.zeros(3)])
        right = left.copy()
        right[0, 3] = -left[0, 0] * baseline
        return rectified_pair("K and baseline", (left, right), None, "m")
    if counts in ([12, 12], [12] * 4):
        first, second = (np.reshape(row, (3, 4)) for row in numbers[:2])
        notes: tuple[str, ...] = (
            f"{path} has {len(counts)} rows of 12 numbers: they are taken for the projections P0 "
            "and P1 of rectified images",
        )
        return rectified_pair("bare P0, P1", (first, second), None, "m", notes)
    if (len(counts) == 1 and 4 <= counts[0] <= 9) or counts == [3, 3, 3]:
        raise InputError(
            f"{path} has the numbers of one camera (fx fy cx cy ..., or K): a stereo camera needs "
            "M1 D1 M2 D2 of both, and R and T between them; for images that are rectified already, "
            "give rig.yaml with focal_px, cx, cy and baseline_m"
        )
    return None


def read_stereodemo(path: Path, values: Values) -> Pair:
    """Return the pair of stereodemo's JSON, of rectified images: fx, cx0, cx1, baseline_meters."""
    source = Source(path, values)
    fx, fy, cy = (source.number((name,), name) for name in ("fx", "fy", "cy"))
    left, right = (
        np.column_stack([intrinsic_matrix(fx, fy, source.number((cx,), cx), cy), np.zeros(3)])
        for cx in ("cx0", "cx1")
    )
    right[0, 3] = -fx * source.number(("baselinemeters",), "baseline_meters")
    return rectified_pair("stereodemo", (left, right), source.size("width", "height"), "m")


def read_stvo(path: Path, values: Values) -> Pair:
    """Return the pair of PL-StVO's cam0: Kl, Kr, Dl, Dr, R and t, or rectified with cam_bl."""
    source = Source(f"{path}: cam0", values["cam0"])
    size = source.size("camwidth", "camheight")
    if source.find(("kl",)):
        cameras, notes = [], list[str]()
        for side in "lr":
            matrix = intrinsic_matrix(*source.matrix((f"k{side}",), f"K{side}", (4,)))
            camera, assumed = source.camera(
                checked_intrinsics(source.name, f"K{side}", matrix), (f"d{side}",), f"D{side}"
            )
            cameras.append(camera)
            notes += assumed
        placed = source.rotation(("r",), "R"), source.matrix(("t",), "t", (3,))
        return Pair(
            "PL-StVO", (cameras[0], cameras[1]), *placed, size=size, unit="m", notes=tuple(notes)
        )
    numbers = [source.number((f"cam{part}",), f"cam_{part}") for part in ("fx", "fy", "cx", "cy")]
    if any(source.number((f"camd{n}",), f"cam_d{n}") for n in range(4)):
        raise InputError(
            f"{path} has the distortion of one camera: give the calibration of both, or, of images "
            "that are rectified already, one whose cam_d0 to cam_d3 are 0"
        )
    left = np.column_stack([intrinsic_matrix(*numbers), np.zeros(3)])
    right = left.copy()
    baseline_m = source.number(("cambl",), "cam_bl")
    right[0, 3] = -numbers[0] * baseline_m
    warning = f"{path}: cam_bl is 1, as settings of RGB-D cameras have it: see that it is in m"
    return rectified_pair(
        "PL-StVO", (left, right), size, "m", (warning,) if baseline_m == 1 else ()
    )


def ost_cameras(path: Path, text: str) -> list[tuple[Path, dict[str, Any]]]:
    """Return the cameras of ROS's ost.txt or .ini, each as the values of a camera_info.

    Names are on lines of their own, with numbers below; ``[...]`` begins a camera, except
    ``[image]``, which has its size.
    """
    cameras: list[tuple[Path, dict[str, Any]]] = []
    size: dict[str, Any] = {}
    rows: list[float] = []
    for whole in text.splitlines():
        line = whole.partition("#")[0].strip()
        numbers = _floats(line) if line else []
        if numbers:
            rows += numbers
        elif line.startswith("["):
            if line != "[image]":
                cameras.append((Path(f"{path}: {line.strip('[]')}"), dict(size)))
        elif line:
            key = _OST_NAMES.get(line.lower(), line.lower())
            rows = []
            (cameras[-1][1] if cameras and key not in ("imagewidth", "imageheight") else size)[
                key
            ] = rows
    return [(name, values | size) for name, values in cameras]


#: Names in ost.txt by those of camera_info.
_OST_NAMES = {
    **{"width": "imagewidth", "height": "imageheight", "camera matrix": "cameramatrix"},
    **{"distortion": "distortioncoefficients", "rectification": "rectificationmatrix"},
    "projection": "projectionmatrix",
}
