"""Parameters of the output: units, formats and colours."""

from __future__ import annotations

from dataclasses import dataclass

from motionstereo_cli.errors import SettingsError
from motionstereo_cli.params import checked, param

#: Outputs that show depth in colours.
_IN_COLOUR = "--save depth-video, preview or report"


@dataclass(frozen=True, slots=True)
class OutputSettings:
    """How results are written; the results themselves do not depend on it.

    Raises:
        SettingsError: a value is out of range, or two values contradict each other.
    """

    depth_scale: int = param(
        1000,
        "Units per m of depth in 16-bit images and video. 1000 = mm; TUM has 5000, KITTI 256.",
        unit="per m",
        low=1,
        high=65535,
        only_with="--rig and --save depth or depth-mkv",
    )
    steering_format: str = param(
        "csv",
        "Format of the steering table. jsonl: JSON lines, one object for each frame.",
        choices=("csv", "jsonl"),
        only_with="--save steering",
    )
    colours: str = param(
        "plasma",
        "Colour map of depth. Near is bright in all but turbo and jet, where it is red; those tell "
        "more depths apart, but not to the colour-blind.",
        choices=("plasma", "turbo", "viridis", "cividis", "magma", "inferno", "jet", "bone"),
        only_with=_IN_COLOUR,
    )
    near_m: float = param(
        0.0,
        "Depth with the nearest colour. auto (or 0): measured in a sample of the recording.",
        unit="m",
        low=0,
        high=1_000_000,
        words={"auto": 0.0},
        only_with=_IN_COLOUR,
    )
    far_m: float = param(
        0.0,
        "Depth with the farthest colour. auto (or 0): measured likewise.",
        unit="m",
        low=0,
        high=1_000_000,
        words={"auto": 0.0},
        only_with=_IN_COLOUR,
    )
    near_px: float = param(
        0.0,
        "Disparity with the nearest colour, without a rig. auto (or 0): measured likewise.",
        unit="px",
        low=0,
        high=1_000_000,
        words={"auto": 0.0},
        only_with=_IN_COLOUR,
    )
    far_px: float = param(
        0.0,
        "Disparity with the farthest colour, without a rig. auto (or 0): measured likewise.",
        unit="px",
        low=0,
        high=1_000_000,
        words={"auto": 0.0},
        only_with=_IN_COLOUR,
    )
    legend: bool = param(
        True,
        "Add a strip below the images of depth-video: the scale of depth, and the time.",
        only_with="--save depth-video or report",
    )
    map_cell_m: float = param(
        0.05,
        "Side of the cells of map.png and of the voxels; map.ply has one point for each voxel.",
        unit="m",
        low=0.005,
        high=10,
        only_with="--save map",
    )
    map_top_m: float = param(
        1000.0,
        "map.ply ends so far above the cameras: less leaves out a ceiling, for a look from above.",
        unit="m",
        low=-100,
        high=1000,
        only_with="--save map",
    )
    checkpoint_frames: int = param(
        250,
        "Number of frames between checkpoints, from which --resume goes on. Videos have a key "
        "frame at each.",
        unit="frames",
        low=1,
        high=1_000_000,
        group="Robustness",
        only_with="-o FOLDER",
    )

    def __post_init__(self) -> None:
        checked(self)
        if 0 < self.far_m <= self.near_m:
            raise SettingsError(f"--near-m {self.near_m:g} is not below --far-m {self.far_m:g}")
        if 0 < self.near_px <= self.far_px:
            raise SettingsError(f"--near-px {self.near_px:g} is not above --far-px {self.far_px:g}")
