"""What flows through the house: frames in, results out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Grey = NDArray[np.uint8]
    Units = NDArray[np.uint16]
    Real = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Rig:
    """A rectified stereo camera.

    Attributes:
        width, height: size of the images in px.
        focal_px: focal length, the same for both cameras, in px.
        baseline_m: distance between the cameras in m.
        cx, cy: principal point of the left camera in px; the right one's is (cx + doffs, cy).
        doffs: x of the right principal point minus x of the left one in px, so that
            depth = focal_px * baseline_m / (disparity + doffs), as Middlebury has it.
    """

    width: int
    height: int
    focal_px: float
    baseline_m: float
    cx: float
    cy: float
    doffs: float = 0.0


@dataclass(frozen=True, slots=True)
class StereoFrame:
    """Two rectified images taken at one moment.

    Attributes:
        index: number of the pair in the stream, from 0.
        pts: presentation time stamp of the right frame in units of the source's time base; the
            index where the source has no time.
        time_s: the same in seconds, None where the source has no time.
        left, right: (height, width) uint8 grey levels 0..255; not to be written to.
    """

    index: int
    pts: int
    time_s: float | None
    left: Grey
    right: Grey


@dataclass(frozen=True, slots=True)
class Steering:
    """Where to go, and what is known of the way.

    Attributes:
        status: ``ok``; ``held`` (nothing new to see, last heading kept); ``blind`` (never
            seen anything).
        steer: heading as a share of half the image width, -1..1, positive = left.
        steer_rad: the same as an angle, positive = left (counter-clockwise, REP 103); None
            without a rig.
        depth_m: depth in the direction of the heading; None without a rig or where unknown.
        nearest_m: depth of the nearest thing; None without a rig or where unknown.
    """

    status: str
    steer: float | None
    steer_rad: float | None
    depth_m: float | None
    nearest_m: float | None


@dataclass(frozen=True, slots=True)
class FrameResult:
    """All that the processing found out about one stereo frame, in the right camera's view.

    Attributes:
        frame: the input.
        bands: (height, width) uint8 (uint16 for 256 bands) grey-level bands 1..n.
        motion: (height, width) bool, where the band has just changed.
        charge: (height, width) uint8 permanency memory.
        disparity_px: (height, width) float32, NaN = unknown.
        depth_m: (height, width) float32, NaN = unknown; None without a rig.
        steering: heading for this frame.
        charged, matched: shares of the image, 0..1, that carry charge and have a disparity.
    """

    frame: StereoFrame
    bands: NDArray[np.uint8 | np.uint16]
    motion: NDArray[np.bool_]
    charge: Grey
    disparity_px: Real
    depth_m: Real | None
    steering: Steering
    charged: float
    matched: float
