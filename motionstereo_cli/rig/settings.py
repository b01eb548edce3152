"""Parameters of a calibration, and of poses: which frame and time they are in."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from motionstereo_cli.errors import SettingsError
from motionstereo_cli.params import checked, param

#: Value for using no calibration, even if one is found.
NO_RIG = Path("none")

#: Units of length of calibrations, in m.
LENGTHS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001}

#: The narrowest view of a stereo camera.
_LEAST_FOV_DEG = 5

_SQUARE = re.compile(r"(\d+(?:\.\d*)?|\.\d+) ?(m|cm|mm)")


@dataclass(frozen=True, slots=True)
class RigSettings:
    """How to interpret a calibration.

    Raises:
        SettingsError: a value is out of range.
    """

    baseline_unit: str = param(
        "auto",
        "Unit of length in the calibration: m, cm, mm, or the side of a square of the board, such "
        "as 25mm, where it was calibrated with squares of size 1. auto: that of the format, or "
        "guessed with a warning.",
        only_with="--rig",
    )
    fov: float = param(
        0.0,
        "Horizontal view of the rectified images, chosen anew whatever the calibration says. auto "
        "(0): as the calibration says; otherwise, of wide lenses, what keeps the resolution of "
        "the lens's middle, at most 120, and of pinhole lenses, what has no empty border.",
        unit="degrees",
        low=0.0,
        high=150.0,
        words={"auto": 0.0},
        only_with="--rig",
    )

    def __post_init__(self) -> None:
        checked(self)
        if self.baseline_unit != "auto" and not self.length_m:
            raise SettingsError(
                f"--baseline-unit cannot be {self.baseline_unit!r}: give m, cm, mm, the side of a "
                "square such as 25mm, or auto"
            )
        if 0 < self.fov < _LEAST_FOV_DEG:
            raise SettingsError(
                f"--fov cannot be {self.fov:g}: give {_LEAST_FOV_DEG} to 150 degrees"
            )

    @property
    def length_m(self) -> float | None:
        """The calibration's unit of length in m; None for auto."""
        square = _SQUARE.fullmatch(self.baseline_unit)
        if square is not None:
            return float(square[1]) * LENGTHS_M[square[2]] or None
        return LENGTHS_M.get(self.baseline_unit)


@dataclass(frozen=True, slots=True)
class PoseSettings:
    """How to interpret a file of poses.

    Raises:
        SettingsError: a value is out of range.
    """

    pose_frame: str = param(
        "auto",
        "What the poses are of. robot: the point halfway between the cameras, x forward, y left, z "
        "up. optical: the left camera, x right, y down, z forward, and the world likewise (KITTI, "
        "ORB-SLAM). optical-z-up: the same in a world with z up (motion capture). body: the body "
        "of the calibration's T_BS or T_cam_imu (EuRoC). ned: the left camera, x forward, y right, "
        "z down, and the world likewise (TartanAir, AirSim). auto: optical for KITTI's form, body "
        "for EuRoC's, ned for TartanAir's, otherwise robot.",
        choices=("auto", "robot", "optical", "optical-z-up", "body", "ned"),
        only_with="--poses FILE",
    )
    pose_time_unit: str = param(
        "auto",
        "Unit of the poses' times. frames: numbers of frames from 0. auto: what the header says, "
        "ns for EuRoC's form, frames for those without times, otherwise s, or what a time since "
        "1970 shows.",
        choices=("auto", "s", "ms", "us", "ns", "frames"),
        only_with="--poses FILE",
    )
    pose_time_offset: float = param(
        0.0,
        "Added to the poses' times, to bring them to the recording's.",
        unit="s",
        low=-1e10,
        high=1e10,
        only_with="--poses FILE",
    )

    def __post_init__(self) -> None:
        checked(self)
