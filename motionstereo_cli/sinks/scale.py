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
    from motionstereo_cli.types import Real

#: Levels below this one are greys, for what is unknown: the darkest colours of a map, which are
#: hard to tell from each other, are left out.
FARTHEST = 32

#: The greys in which the view shows through where depth is unknown, darkest and brightest.
_GREYS = 44, 137

#: Settings of the output that are the ends of the scale; 0 = measured or, in the record of a run
#: that shows no colours, unknown.
ENDS = ("near_m", "far_m", "near_px", "far_px")

#: Settings that the scale follows from: those of the processing, and of the output.
_SAID = ("max_disparity",), (*ENDS, "colours")

#: The round numbers that ends are chosen from, up to the largest that an option takes.
_STEPS = (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8)
_ROUND = np.array([float(f"{step}e{decade}") for decade in range(-9, 6) for step in _STEPS])

#: Shares of what is known that are nearer, and farther, than the middle of the scale, which leaves
#: so much of it free at each end; rounding one end takes some of that from the other.
_NEARER, _FARTHER, _MARGIN = 0.015, 0.03, 0.07

#: Fewer ticks say too little.
_FEW_TICKS = 4

#: What has less disparity in px, doffs added, is as good as infinitely far.
_FAR_PX = 0.5


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
    far_px: float = 1.0
    px_m: float | None = None
    colours: str = OutputSettings().colours
    doffs: float = 0.0

    @classmethod
    def of(cls, settings: Settings, output: OutputSettings, rig: Rig | None) -> DepthScale:
        """Return the scale of a run, the same for all its frames."""
        doffs = rig.doffs if rig else 0.0
        px_m = rig.focal_baseline if rig else None
        near_px, far_px = settings.max_disparity + doffs, max(1 + doffs, 1)
        if px_m is None:
            near_px, far_px = output.near_px or near_px, output.far_px or far_px
        else:
            near_px = px_m / output.near_m if output.near_m else near_px
            far_px = px_m / output.far_m if output.far_m else far_px
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
    def quantity(self) -> str:
        """What the colours stand for: ``depth`` or, without a rig, ``disparity``."""
        return "depth" if self.px_m else "disparity"

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
        """Return the round numbers (1, 2, 5, 10, ...) on the scale, the nearest first.

        Where there are few of these, there are some between them.
        """
        low, high = sorted(self.ends)
        decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        inside: list[float] = []
        for steps in ((1, 2, 5), (1, 1.5, 2, 3, 4, 5, 6, 8)):
            if len(inside) < _FEW_TICKS:
                round_numbers = [step * 10.0**decade for decade in decades for step in steps]
                inside = [each for each in round_numbers if low * 0.999 <= each <= high * 1.001]
        return sorted(inside, key=self.place)

    @property
    def unknown(self) -> tuple[int, int, int]:
        """The middle one of the greys of what is unknown, RGB."""
        red, green, blue = palette(self.colours)[FARTHEST // 2, 0].tolist()
        return red, green, blue

    def colour(self, place: float) -> tuple[int, int, int]:
        """Return the colour of a place on the scale, RGB."""
        level = round(255 - (255 - FARTHEST) * min(max(place, 0), 1))
        red, green, blue = palette(self.colours)[level, 0].tolist()
        return red, green, blue


def measured_ends(nearness_px: Real, px_m: float | None) -> tuple[float, float] | None:
    """Return the nearest and the farthest value of a scale in whose middle nearly all depths lie.

    On the logarithmic scale 95 % of them are in its middle 90 %, as far as they are not as good as
    infinite. The ends are round numbers, and one is at least twice the other.

    Args:
        nearness_px: (n,) known disparities, doffs added.
        px_m: focal length times baseline, for ends in m; None: they are in px.

    Returns:
        The ends; None where nothing is known, or all is farther than any scale reaches.
    """
    if not nearness_px.size:
        return None
    found = np.quantile(nearness_px, [_FARTHER, 1 - _NEARER])
    low, high = np.log10(np.maximum(found, _FAR_PX)).tolist()
    spare = max((high - low) / (1 - 2 * _MARGIN), math.log10(2)) - (high - low)
    ends = 10 ** (high + spare / 2), 10 ** (low - spare / 2)
    if px_m is None:
        return _round_above(ends[0]), _round_below(ends[1])
    near_m, far_m = _round_below(px_m / ends[0]), _round_above(px_m / ends[1])
    return (near_m, far_m) if near_m < far_m else None


def _round_below(value: float) -> float:
    return float(_ROUND[max(int(np.searchsorted(_ROUND, value, "right")) - 1, 0)])


def _round_above(value: float) -> float:
    return float(_ROUND[min(int(np.searchsorted(_ROUND, value)), len(_ROUND) - 1)])


@functools.cache
def palette(colours: str) -> NDArray[np.uint8]:
    """Return the (256, 1, 3) RGB table of a colour map, with greys below :data:`FARTHEST`."""
    colour_map = getattr(cv2, f"COLORMAP_{colours.upper()}")
    bgr = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, np.newaxis], colour_map)
    rgb = np.ascontiguousarray(bgr[..., ::-1], np.uint8)
    rgb[:FARTHEST, 0] = np.linspace(*_GREYS, FARTHEST).round()[:, np.newaxis]
    return rgb
