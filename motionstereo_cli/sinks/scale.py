"""The scale of depth in colour, in m or, without a rig, in px."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from motionstereo_cli.method.settings import Settings
from motionstereo_cli.sinks.settings import OutputSettings
from motionstereo_cli.types import Rig

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.sinks.records import RunRecord

#: The darkest colours of the map are not used: they are hard to tell from black.
FARTHEST = 32

#: Settings that the scale depends on: of the processing, and of the output.
_SAID = ("max_disparity",), ("near_m", "far_m", "colours")


@dataclass(frozen=True, slots=True)
class DepthScale:
    """A logarithmic scale of depth: equal steps are equal ratios of depth.

    Attributes:
        near_px, far_px: disparity at its ends in px, doffs added if there is one; near_px is at
            least twice far_px.
        px_m: depth in m times disparity in px: focal length times baseline; None without a rig.
        colours: name of an OpenCV colour map; near = its end.
        doffs: the constant that was added to disparities, in px.
    """

    near_px: float
    far_px: float
    px_m: float | None
    colours: str
    doffs: float = 0.0

    @classmethod
    def of(cls, settings: Settings, output: OutputSettings, rig: Rig | None) -> DepthScale:
        """Return the scale of a run, the same for all its frames."""
        doffs = rig.doffs if rig else 0.0
        px_m = rig.focal_baseline if rig else None
        near_px, far_px = settings.max_disparity + doffs, max(1 + doffs, 1)
        if px_m and output.near_m:
            near_px = px_m / output.near_m
        if px_m and output.far_m:
            far_px = px_m / output.far_m
        return cls(max(near_px, 2 * far_px), far_px, px_m, output.colours, doffs)

    @classmethod
    def recorded(cls, record: RunRecord) -> DepthScale:
        """Return the scale of a run from its ``run.json``; the default where that has none.

        Raises:
            SettingsError: two values contradict each other.
        """
        said = (
            {name: value for name, value in record.values(group).items() if name in names}
            for group, names in zip(("settings", "output_settings"), _SAID, strict=True)
        )
        settings, output = Settings(**next(said)), OutputSettings(**next(said))
        return cls.of(settings, output, record.camera)

    @property
    def unit(self) -> str:
        """Unit of :attr:`ends` and :meth:`ticks`: m of depth, or px of disparity."""
        return "m" if self.px_m else "px"

    @property
    def ends(self) -> tuple[float, float]:
        """The nearest and the farthest value."""
        if self.px_m:
            return self.px_m / self.near_px, self.px_m / self.far_px
        return self.near_px, self.far_px

    def place(self, value: float) -> float:
        """Return the position of a value between the ends: 0 nearest, 1 farthest."""
        near, far = self.ends
        return math.log(value / near) / math.log(far / near)

    def ticks(self) -> list[float]:
        """Return the round numbers (1, 2, 5, 10, ...) on the scale, the nearest first."""
        low, high = sorted(self.ends)
        decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        round_numbers = [step * 10.0**decade for decade in decades for step in (1, 2, 5)]
        inside = [each for each in round_numbers if low * 0.999 <= each <= high * 1.001]
        return sorted(inside, key=self.place)

    def colour(self, place: float) -> tuple[int, int, int]:
        """Return the colour of a place on the scale, RGB."""
        level = round(255 - (255 - FARTHEST) * min(max(place, 0), 1))
        red, green, blue = palette(self.colours)[level, 0].tolist()
        return red, green, blue


@functools.cache
def palette(colours: str) -> NDArray[np.uint8]:
    """Return the (256, 1, 3) RGB table of a colour map, with black at 0."""
    colour_map = getattr(cv2, f"COLORMAP_{colours.upper()}")
    bgr = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, np.newaxis], colour_map)
    rgb = np.ascontiguousarray(bgr[..., ::-1], np.uint8)
    rgb[0] = 0
    return rgb
