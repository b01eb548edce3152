"""Calibration files where datasets keep them: in the folder of a recording of still images."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from motionstereo_cli.files.stills import SUFFIXES

#: Files of both cameras, in the folder that holds both sides; the first that exists is used.
_OF_BOTH = (
    *("rig.yaml", "calib.txt", "calib_cam_to_cam.txt", "camchain.yaml"),
    *("stereodemo_calibration.json", "K.txt"),
)

#: File of one camera beside its folder ``data`` (EuRoC).
_OF_ONE = "sensor.yaml"


def calibration_beside(paths: Sequence[Path]) -> tuple[Path, ...]:
    """Return the calibration files of a recording of still images; none if there are none.

    EuRoC's ``sensor.yaml`` of both cameras, or a file in the folder that holds both sides: KITTI's
    and Middlebury's ``calib.txt``, ``camchain.yaml``, ``stereodemo_calibration.json``, ``K.txt`` or
    ``rig.yaml``; of KITTI's raw recordings also ``calib_cam_to_cam.txt`` in the folder of the day.

    Args:
        paths: folders of images, or images, left then right; others have no such files.
    """
    folders = [_folder_of(path) for path in paths]
    if len(folders) != 2 or not all(folders):
        return ()
    left, right = (Path(os.path.abspath(folder)) for folder in folders if folder)
    own = tuple(folder.parent / _OF_ONE for folder in (left, right))
    if left != right and all(file.is_file() for file in own):
        return own
    common = Path(os.path.commonpath([left, right]))
    places = [common / name for name in _OF_BOTH]
    if left.name == right.name == "data":
        places.append(common.parent / "calib_cam_to_cam.txt")
    return next(((place,) for place in places if place.is_file()), ())


def _folder_of(path: Path) -> Path | None:
    if path.is_dir():
        return path
    return path.parent if path.suffix.lower() in SUFFIXES else None
