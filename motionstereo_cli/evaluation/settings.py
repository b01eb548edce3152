"""Parameters of comparing runs."""

from __future__ import annotations

from dataclasses import dataclass

from motionstereo_cli.method.settings import MAX_DISPARITY
from motionstereo_cli.params import checked, param


@dataclass(frozen=True, slots=True)
class CompareSettings:
    """Tolerances of images.

    Raises:
        SettingsError: a value is out of range.
    """

    tolerance_px: float = param(
        0.25,
        "Tolerance of a disparity.",
        unit="px",
        low=0,
        high=MAX_DISPARITY,
    )
    tolerance_mm: float = param(100.0, "Tolerance of a depth.", unit="mm", low=0, high=65535)
    max_differing: float = param(
        0.01,
        "Maximum share of an image's pixels that differ by more, or are known in only one image.",
        low=0,
        high=1,
    )

    def __post_init__(self) -> None:
        checked(self)


@dataclass(frozen=True, slots=True)
class EvaluateSettings:
    """How the truth is read, and what counts where objects are compared with it.

    Raises:
        SettingsError: a value is out of range.
    """

    min_overlap: float = param(
        0.3,
        "Minimum overlap of the boxes of an object and its truth (intersection over union).",
        low=0.01,
        high=1,
        only_with="files of objects",
    )
    min_box_px: float = param(
        0.0,
        "Minimum number of pixels of a true box: smaller ones, and rows that lie in them or "
        "match them, do not count.",
        unit="px",
        low=0,
        only_with="files of objects",
    )
    label_rate: float = param(
        10.0,
        "Frame rate of labels of KITTI's tracking benchmark, which have no times.",
        unit="fps",
        low=0.01,
        high=1000,
        only_with="files of objects",
    )

    truth_scale: int = param(
        0,
        "Units per m of the depth PNG in TRUTH. 0: as the run.json beside it says, else 1000, mm; "
        "TUM has 5000, KITTI 256.",
        unit="per m",
        low=0,
        high=65535,
        only_with="folders of images",
    )

    def __post_init__(self) -> None:
        checked(self)


#: Tolerances of table columns. Encoders, decoders and SIMD differ in the last digits. Columns that
#: are not listed must be equal as text.
COLUMN_TOLERANCE = {
    "time_s": 1e-6,
    "steer": 0.02,
    "steer_rad": 0.012,
    "depth_m": 0.3,
    "nearest_m": 0.1,
    "charged": 0.003,
    "matched": 0.005,
    "risk_s": 0.5,
    "x": 2.0,
    "y": 2.0,
    "width": 2.0,
    "height": 2.0,
    "closing_mps": 0.2,
    "time_to_contact_s": 0.5,
    "confidence": 0.1,
}
