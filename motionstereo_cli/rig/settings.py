"""Parameters of poses: which frame and time they are in."""

from __future__ import annotations

from dataclasses import dataclass

from motionstereo_cli.params import checked, param


@dataclass(frozen=True, slots=True)
class PoseSettings:
    """How a file of poses is to be understood.

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
    )
    pose_time_unit: str = param(
        "auto",
        "Unit of the poses' times. frames: numbers of frames from 0. auto: what the header says, "
        "ns for EuRoC's form, frames for those without times, otherwise s, or what a time since "
        "1970 shows.",
        choices=("auto", "s", "ms", "us", "ns", "frames"),
    )
    pose_time_offset: float = param(
        0.0,
        "Added to the poses' times, to bring them to the recording's.",
        unit="s",
        low=-1e10,
        high=1e10,
    )

    def __post_init__(self) -> None:
        checked(self)
