"""Every parameter of the rendered scenes once: default, range, unit, help."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from motionstereo_cli.errors import SettingsError
from motionstereo_cli.params import checked, idle, options_of, param
from motionstereo_cli.types import Rig

#: Shares of one side's path that are straight and turn: the paper's 100 and 25 frames of 125.
STRAIGHT_SHARE = 0.8
TURN_SHARE = 0.2

#: Frame rate in Hz and baseline in m of all scenes but the street, and of the street.
_SCENE_DEFAULTS = (30.0, 0.12), (10.0, 0.4)

#: Frames are numbered with six digits.
_MAX_FRAMES = 1_000_000

#: Minimum distance of a turning camera from the inner corner, in m.
_MIN_ROOM_M = 0.1

#: The world that is no floor plan.
CORRIDOR = "corridor"

#: Radius of the driven robot, and its clearance.
ROBOT_RADIUS_M = 0.25
_MIN_DRIVE_ROOM_M = 0.5
#: Maximum width of a driven corridor by seed.
_WIDEST_M = 3.5


@dataclass(frozen=True, slots=True)
class SimulateSettings:
    """Parameters of a rendered recording.

    Raises:
        SettingsError: a value is out of range, or values contradict each other.
    """

    scene: str = param(
        "corridor",
        "Scene. corridor: a robot drives round a square corridor; cards: textured cards "
        "cross, approach and recede before a textured wall; layers: cards, some slanted or thin, "
        "overlap before a smooth wall; street: a car drives along a street with houses, "
        "trees, parked and moving cars.",
        choices=("corridor", "cards", "layers", "street"),
        common=True,
    )
    frames: str = param(
        "500",
        "Number of frames, or a range: 250:350 is 250 to 349. A round of the corridor takes 500; "
        "the last 25 of each 125 are a turn.",
        common=True,
    )
    width: int = param(320, "Width of the images, even.", unit="px", low=16, high=4096)
    height: int = param(240, "Height of the images, even.", unit="px", low=16, high=4096)
    focal_px: float = param(
        0.0, "Focal length (0 = 0.87 of the width).", unit="px", low=0, high=100_000
    )
    baseline_m: float = param(
        0.0, "Distance between the cameras (0 = 0.12, in the street 0.4).", unit="m", low=0, high=1
    )
    frame_rate: float = param(
        0.0, "Frames per second (0 = 30, in the street 10).", unit="Hz", low=0, high=1000
    )
    corridor_width_m: float = param(
        3.0,
        "Distance from inner to outer wall.",
        unit="m",
        low=0.5,
        high=20,
        only_with=f"--scene {CORRIDOR}",
    )
    corridor_length_m: float = param(
        20.0,
        "Length of one side and its turn, 125 frames.",
        unit="m",
        low=5,
        high=100,
        only_with=f"--scene {CORRIDOR}",
    )
    street_speed_m_s: float = param(
        8.0,
        "Speed of the car.",
        unit="m/s",
        low=0.1,
        high=50,
        only_with="--scene street",
    )
    street_winding_deg: float = param(
        0.0,
        "Maximum angle of the street to its first direction.",
        unit="degrees",
        low=0,
        high=60,
        only_with="--scene street",
    )
    pan: bool = param(
        False,
        "Swing the camera from side to side.",
        only_with="--scene cards or layers",
    )
    shadows: bool = param(False, "The cards cast shadows on the wall.", only_with="--scene cards")
    noise_sigma: float = param(
        0.0,
        "Standard deviation of the sensor noise.",
        unit="grey levels",
        low=0,
        high=100,
        common=True,
    )
    left_gain: float = param(1.0, "Factor of the left camera's grey.", low=0.1, high=10)
    left_offset: float = param(
        0.0, "Grey that the left camera adds.", unit="grey levels", low=-255, high=255
    )
    flicker: float = param(
        0.0,
        "Flicker of the light, as of mains lamps: the exposure varies by up to this share from "
        "frame to frame and from row to row, equally in both cameras.",
        low=0,
        high=1,
    )
    shutter: float = param(
        0.0,
        "Share of the time between frames that the shutter is open: motion blur.",
        low=0,
        high=1,
    )
    jpeg_quality: int = param(
        0, "Compress each image as JPEG before it is written (0 = not).", low=0, high=100
    )
    crf: int = param(
        18,
        "H.264 constant rate factor: 0 is best, 35 is poor.",
        low=0,
        high=51,
        only_with="--no-lossless",
    )
    seed: int = param(0, "Seed of the texture and of the noise.", low=0, common=True)
    lossless: bool = param(False, "Write FFV1 in Matroska (.mkv) instead of H.264 (.mp4).")

    def __post_init__(self) -> None:
        checked(self)
        for line in idle(self, {*options_of(self)}):
            raise SettingsError(f"{line}: leave it out")
        frame_rate, baseline_m = _SCENE_DEFAULTS[self.scene == "street"]
        object.__setattr__(self, "frame_rate", self.frame_rate or frame_rate)
        object.__setattr__(self, "baseline_m", self.baseline_m or baseline_m)
        if self.width % 2 or self.height % 2:
            raise SettingsError(
                f"--width {self.width} --height {self.height}: give even numbers, for H.264"
            )
        if self.focal_px and self.focal_px < self.width / 5:
            raise SettingsError(
                f"--focal-px {self.focal_px:g} is too short for a width of {self.width} px: "
                f"give at least {self.width / 5:g}"
            )
        if not 1 <= len(self.frame_range) <= _MAX_FRAMES:
            raise SettingsError(f"--frames {self.frames}: give 1 to {_MAX_FRAMES} frames")
        # The inner corner comes nearest to the turning robot in the middle of the turn.
        radius_m = TURN_SHARE * self.corridor_length_m / (math.pi / 2)
        room_m = (_MIN_ROOM_M + self.baseline_m / 2) / math.sqrt(2)
        min_m = 2 * (room_m + radius_m * (1 - math.sqrt(0.5)))
        if not min_m <= self.corridor_width_m <= self.corridor_length_m / 2:
            raise SettingsError(
                f"--corridor-width-m {self.corridor_width_m:g} does not suit a corridor length of "
                f"{self.corridor_length_m:g} m: give {min_m:.2f} to "
                f"{self.corridor_length_m / 2:g} m"
            )

    @property
    def frame_range(self) -> range:
        """The scene's frame numbers to render.

        Raises:
            SettingsError: ``frames`` is neither a number nor a range.
        """
        match = re.fullmatch(r"(?:(\d{1,9}):)?(\d{1,9})", self.frames)
        if match is None:
            raise SettingsError(
                f"--frames cannot be {self.frames!r}: give a number such as 500 "
                "or a range such as 250:350"
            )
        return range(int(match[1] or 0), int(match[2]))

    @property
    def rig(self) -> Rig:
        """The stereo camera; its principal points are the middle of the image."""
        return Rig(
            width=self.width,
            height=self.height,
            focal_px=self.focal_px or 0.87 * self.width,
            baseline_m=self.baseline_m,
            cx=(self.width - 1) / 2,
            cy=(self.height - 1) / 2,
        )


@dataclass(frozen=True, slots=True)
class DriveSettings:
    """Parameters of a driven world.

    Raises:
        SettingsError: a value is out of range, or there is no room for the robot.
    """

    world: str = param(
        CORRIDOR,
        "World: corridor, a floor plan in TOML, or the name of one that comes with the program, "
        "such as room-with-pillars; help robot lists them.",
        common=True,
    )
    laps: float = param(
        1.0,
        "Maximum number of rounds.",
        low=0.01,
        high=1000,
        common=True,
        only_with=f"--world {CORRIDOR}",
    )
    max_frames: int = param(
        0,
        "Maximum number of frames (0 = three times the expected number, or what the plan says).",
        low=0,
        old="most_frames",
    )
    walkers: int = param(
        0,
        "Number of people-sized obstacles that walk along and across the corridor.",
        low=0,
        high=20,
        common=True,
        only_with=f"--world {CORRIDOR}",
    )
    width: int = param(320, "Width of the images.", unit="px", low=64, high=4096)
    height: int = param(240, "Height of the images.", unit="px", low=48, high=4096)
    noise_sigma: float = param(
        1.5, "Standard deviation of the sensor noise.", unit="grey levels", low=0, high=100
    )
    corridor_width_m: float = param(
        0.0,
        "Distance from inner to outer wall (0 = 2 to 3.5, by the seed).",
        unit="m",
        low=0,
        high=20,
        only_with=f"--world {CORRIDOR}",
    )
    corridor_length_m: float = param(
        0.0,
        "Side of the square that the corridor's middle line makes (0 = 12 to 18, by the seed).",
        unit="m",
        low=0,
        high=100,
        only_with=f"--world {CORRIDOR}",
    )
    seed: int = param(
        0,
        "Seed of the world: the corridor's size, doors, windows and light, the direction of the "
        "round, the walkers and the noise.",
        low=0,
        common=True,
    )

    def __post_init__(self) -> None:
        checked(self)
        for line in idle(self, {*options_of(self)}):
            raise SettingsError(f"{line}: leave it out")
        min_m = 2 * ROBOT_RADIUS_M + _MIN_DRIVE_ROOM_M
        if self.corridor_width_m and self.corridor_width_m < min_m:
            raise SettingsError(
                f"--corridor-width-m {self.corridor_width_m:g} has no room for a robot of "
                f"{2 * ROBOT_RADIUS_M:g} m: give at least {min_m:g} m"
            )
        width_m = self.corridor_width_m or _WIDEST_M
        if self.corridor_length_m and self.corridor_length_m < 2 * width_m:
            raise SettingsError(
                f"--corridor-length-m {self.corridor_length_m:g} leaves no corridor of "
                f"{width_m:g} m width: give at least {2 * width_m:g} m"
            )

    @property
    def rig(self) -> Rig:
        """The robot's stereo camera."""
        return SimulateSettings(width=self.width, height=self.height).rig
