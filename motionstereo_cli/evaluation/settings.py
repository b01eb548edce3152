"""Parameters of the analysis."""

from __future__ import annotations

from dataclasses import dataclass

from motionstereo_cli.method.settings import MAX_DISPARITY
from motionstereo_cli.params import checked, param


@dataclass(frozen=True, slots=True)
class CompareSettings:
    """How far images may differ.

    Raises:
        SettingsError: a value is out of range.
    """

    tolerance_px: float = param(
        0.25,
        "How far a disparity may be from the golden one.",
        unit="px",
        low=0,
        high=MAX_DISPARITY,
    )
    tolerance_mm: float = param(
        100.0, "How far a depth may be from the golden one.", unit="mm", low=0, high=65535
    )
    max_differing: float = param(
        0.01,
        "Share of an image's pixels that may differ by more, or be known in only one image.",
        low=0,
        high=1,
    )

    def __post_init__(self) -> None:
        checked(self)


#: How far a number of a table may be from the golden one, by its column. Encoders, decoders and
#: SIMD differ in the last digits. A column that is not here has to be the same text.
COLUMN_TOLERANCE = {
    "time_s": 1e-6,
    "steer": 0.02,
    "steer_rad": 0.012,
    "depth_m": 0.3,
    "nearest_m": 0.1,
    "charged": 0.003,
    "matched": 0.005,
    "x": 2.0,
    "y": 2.0,
    "width": 2.0,
    "height": 2.0,
    "closing_mps": 0.2,
    "time_to_contact_s": 0.5,
    "confidence": 0.1,
}
