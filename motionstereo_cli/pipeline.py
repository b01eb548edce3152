"""The stream: stereo frames in, results out. The only place with state in time.

In permanency mode the state before guidance is gone ceil((Chmax - Chmin) / D) frames later.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from motionstereo_cli.settings import Settings
from motionstereo_cli.stages.bands import band_table, bands, blur
from motionstereo_cli.stages.charge import accumulate, permanency
from motionstereo_cli.stages.depth import depth
from motionstereo_cli.stages.guidance import heading, nearest, steadied, strip_nearness
from motionstereo_cli.stages.motion import motion
from motionstereo_cli.stages.regions import match_regions
from motionstereo_cli.stages.trails import match_trails
from motionstereo_cli.stages.units import units
from motionstereo_cli.types import FrameResult, Rig, Steering, StereoFrame

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.types import Grey, Real, Units

#: Share of a strip of the image, or of all of it, below which its matches are taken for noise.
LEAST_KNOWN_SHARE = 0.002


def process(
    frames: Iterable[StereoFrame], settings: Settings | None = None, rig: Rig | None = None
) -> Iterator[FrameResult]:
    """Yield the result of each stereo frame, in order.

    Args:
        frames: rectified stereo frames of one size.
        settings: parameters; the defaults if None.
        rig: the camera, for depth in m and steering angles; without one they are None.
    """
    settings = settings or Settings()
    right, left = Memory(settings), Memory(settings)
    guide = Guide(settings, rig)
    for frame in frames:
        right.see(frame.right)
        left.see(frame.left)
        disparity = match(right.units(), left.units(), settings)
        yield FrameResult(
            frame=frame,
            bands=right.bands,
            motion=right.moved,
            charge=right.charge,
            disparity_px=disparity,
            depth_m=None
            if rig is None
            else depth(disparity, rig.focal_px, rig.baseline_m, rig.doffs),
            steering=guide.steer(disparity),
            charged=float(np.count_nonzero(right.charge > settings.charge_min)) / disparity.size,
            matched=float(np.count_nonzero(~np.isnan(disparity))) / disparity.size,
        )


def match(right: Units, left: Units, settings: Settings) -> Real:
    """Return the disparity of the right view's units, (height, width) float32, NaN = unknown."""
    if settings.matcher == "regions":
        return match_regions(right, left, settings.max_disparity)
    return match_trails(
        right,
        left,
        settings.max_disparity,
        block_px=(settings.vote_rows, settings.vote_columns),
        max_ratio=settings.max_ratio,
        speckle_px=settings.speckle_px,
        gap_px=settings.gap_px,
    )


class Memory:
    """What one camera remembers: its last bands and the charge of each pixel."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._table = band_table(settings.bands, settings.grey_min, settings.grey_max)
        self._grey: Grey | None = None
        self.bands: NDArray[np.uint8 | np.uint16]
        self.moved: NDArray[np.bool_]
        self.charge: Grey

    def see(self, grey: Grey) -> None:
        """Take in the next image; at the first, nothing has moved and all is at rest."""
        s = self._settings
        grey = blur(grey, s.blur_px)
        banded = bands(grey, self._table)
        if self._grey is None:
            self.moved = np.zeros(grey.shape, np.bool_)
            self.charge = np.full_like(grey, s.charge_min)
        else:
            self.moved = motion(banded, self.bands, grey, self._grey, s.least_jump)
            limits = {"charge_max": s.charge_max, "charge_min": s.charge_min}
            if s.charge_mode == "permanency":
                self.charge = permanency(self.charge, self.moved, leak=s.charge_leak, **limits)
            else:
                self.charge = accumulate(
                    self.charge, self.moved, gain=s.charge_gain, leak=s.charge_leak, **limits
                )
        self._grey, self.bands = grey, banded

    def units(self) -> Units:
        """Return what has to be equal for pixels to correspond, (height, width) uint16."""
        by_band = self._settings.match_on == "charge-band"
        return units(self.charge, self._settings.charge_min, self.bands if by_band else None)


@dataclass
class Guide:
    """Steers frame by frame, and remembers the last heading.

    Attributes:
        settings: parameters of the guidance.
        rig: the camera, None if unknown.
        place: the last heading as a place across the image, 0 left .. 1 right.
    """

    settings: Settings
    rig: Rig | None
    place: float | None = None

    def steer(self, disparity_px: Real) -> Steering:
        """Return the heading for a frame's disparity, (height, width) float32, NaN = unknown."""
        s, rig = self.settings, self.rig
        near = disparity_px + np.float32(rig.doffs if rig else 0)
        strips = strip_nearness(near, min(s.steer_strips, near.shape[1]), LEAST_KNOWN_SHARE)
        target = heading(strips)
        if target is not None:
            self.place = steadied(self.place, target, s.steer_gain)
        if self.place is None:
            return Steering("blind", None, None, None, None)
        ahead = float(strips[min(int(self.place * len(strips)), len(strips) - 1)])
        return Steering(
            status="held" if target is None else "ok",
            steer=1 - 2 * self.place,
            steer_rad=self._angle_rad(near.shape[1]),
            depth_m=self._depth_m(ahead),
            nearest_m=self._depth_m(nearest(near, LEAST_KNOWN_SHARE)),
        )

    def _angle_rad(self, width: int) -> float | None:
        if self.rig is None or self.place is None:
            return None
        column = self.place * width - 0.5  # of pixel centres
        return math.atan2(self.rig.cx + self.rig.doffs - column, self.rig.focal_px)

    def _depth_m(self, nearness_px: float | None) -> float | None:
        if self.rig is None or nearness_px is None or not nearness_px > 0:
            return None
        return self.rig.focal_px * self.rig.baseline_m / nearness_px
