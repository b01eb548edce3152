"""Videos to look at: the charge as grey, the depth in colour."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from motionstereo_cli.sinks.video import VideoWriter
from motionstereo_cli.types import FrameResult

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.sinks import Stream
    from motionstereo_cli.types import Real

#: The darkest colour of the map is left out, for it is hard to tell from black.
_FARTHEST = 32


#: Time stamps that begin beyond this count from an epoch; no player waits for that long.
_EPOCH_S = 86_400


class Preview:
    """A video of one image a frame, at the times of the frames.

    Where these count from an epoch, as camera clocks do, the video begins at 0.

    Args:
        path: final name.
        time_base: seconds per unit of the frames' time stamps.
        image: makes the uint8 image of a result, grey or RGB.

    Raises:
        OutputError: the file cannot be written.
    """

    def __init__(
        self, path: Path, time_base: Fraction, image: Callable[[FrameResult], NDArray[np.uint8]]
    ) -> None:
        self._video = VideoWriter(path, time_base)
        self._image = image
        self._time_base = time_base
        self._begin: int | None = None

    def write(self, result: FrameResult) -> None:
        """Append the image of a frame."""
        pts = result.frame.pts
        if self._begin is None:
            self._begin = pts if pts * self._time_base > _EPOCH_S else 0
        self._video.write(self._image(result), pts - self._begin)

    def close(self) -> None:
        """Complete the video and give it its name."""
        self._video.close()

    def abandon(self, *, keep: bool) -> None:
        """Complete the video under its ``.part`` name or, without ``keep``, remove it."""
        if keep:
            self._video.finish()
        else:
            self._video.close(keep=False)


def charge_video(path: Path, stream: Stream) -> Preview:
    """Return a sink for the right permanency memory, the charge as grey level."""
    return Preview(path, stream.time_base, lambda result: result.charge)


def depth_video(path: Path, stream: Stream) -> Preview:
    """Return a sink for depth in colour; see :func:`depth_colours`."""
    return Preview(
        path,
        stream.time_base,
        lambda result: depth_colours(result.disparity_px, stream.max_disparity),
    )


def depth_colours(disparity_px: Real, max_disparity: int) -> NDArray[np.uint8]:
    """Return depth in colour: red = near, blue = far, black = unknown.

    The scale is the logarithm of the disparity from 1 px to ``max_disparity``, the same for
    every frame: equal steps of colour are equal ratios of depth, so that far and near both
    show contrast, and no rig is needed.

    Args:
        disparity_px: (height, width) float32, NaN = unknown.
        max_disparity: disparity of the warmest colour in px.

    Returns:
        (height, width, 3) uint8 RGB.
    """
    known = ~np.isnan(disparity_px)
    nearness = np.log(np.maximum(disparity_px[known], 1)) / math.log(max(max_disparity, 2))
    levels = np.zeros(disparity_px.shape, np.uint8)
    levels[known] = _FARTHEST + np.minimum(nearness, 1) * (255 - _FARTHEST)
    return cv2.applyColorMap(levels, _colours()).astype(np.uint8, copy=False)


@functools.cache
def _colours() -> NDArray[np.uint8]:
    """Return the (256, 1, 3) RGB table of the colour map, with black at 0."""
    bgr = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, np.newaxis], cv2.COLORMAP_TURBO)
    rgb = np.ascontiguousarray(bgr[..., ::-1], np.uint8)
    rgb[0] = 0
    return rgb
