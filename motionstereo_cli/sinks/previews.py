"""Videos of the results: most to look at, depth also lossless."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from motionstereo_cli.compiled.pictures import levels_of
from motionstereo_cli.files.video import (
    Indexed,
    Picture,
    SegmentedVideo,
    VideoMark,
    table_of,
)
from motionstereo_cli.sinks.images import depth_png, known_depth_m, motion_png
from motionstereo_cli.sinks.legend import strip, time_text
from motionstereo_cli.sinks.scale import FARTHEST, DepthScale, palette
from motionstereo_cli.types import FrameResult

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.sinks import RunContext
    from motionstereo_cli.types import Grey, Real

#: Steps in which disparities are told apart for their colours, and how many there are at most.
_LEVELS_PER_PX = 256
_MAX_LEVELS = 1 << 20

#: Time stamps that begin beyond this count from an epoch; no player waits for that long.
EPOCH_S = 86_400


def beginning(pts: int, time_base: Fraction) -> int:
    """Return the time stamp at which a video begins whose first frame has the time stamp ``pts``.

    Times that count from an epoch, as camera clocks do, begin with the first frame, others at 0.
    """
    return pts if pts * time_base > EPOCH_S else 0


class ResultVideo:
    """A video of one image a frame, at the times of the frames.

    Where these count from an epoch, as camera clocks do, the video begins at 0.

    Args:
        path: final name; its suffix says the format, see :class:`SegmentedVideo`.
        stream: what is known of the run.
        since: go on from this checkpoint: that of the video, and the first time stamp.
        image: makes what the video shows of a result, as ``VideoWriter.write`` takes it.

    Raises:
        OutputError: the file cannot be written, or is not what the checkpoint says.
    """

    def __init__(
        self,
        path: Path,
        stream: RunContext,
        since: tuple[VideoMark, int | None] | None = None,
        *,
        image: Callable[[FrameResult, RunContext], Picture | list[Picture]],
    ) -> None:
        segments, self._begin = since or (((), None), None)
        self._video = SegmentedVideo(path, stream.time_base, segments)
        self._stream = stream
        self._image = image

    def write(self, result: FrameResult) -> None:
        """Append the image of a frame."""
        pts = result.frame.pts
        if self._begin is None:
            self._begin = beginning(pts, self._stream.time_base)
        self._video.write(self._image(result, self._stream), pts - self._begin)

    def checkpoint(self) -> tuple[VideoMark, int | None]:
        """End a segment."""
        return self._video.checkpoint(), self._begin

    def close(self) -> None:
        """Complete the video and give it its name."""
        self._video.close()

    def abandon(self, *, keep: bool) -> None:
        """Complete the last segment or, without ``keep``, remove all."""
        self._video.abandon(keep=keep)


def depth_colours(
    disparity_px: Real, near_px: float, far_px: float = 1.0, colours: str = "turbo"
) -> NDArray[np.uint8]:
    """Return depth in colour, black = unknown; in turbo, red = near and blue = far.

    The scale is the logarithm of the disparity, the same for every frame: equal steps of colour
    are equal ratios of depth, so that far and near both show contrast, and no rig is needed.

    Args:
        disparity_px: (height, width) float32, doffs added if there is one; NaN = unknown.
        near_px: disparity of the nearest colour in px.
        far_px: disparity of the farthest colour in px, above 0; ``near_px`` counts as at least
            twice as much.
        colours: name of an OpenCV colour map.

    Returns:
        (height, width, 3) uint8 RGB.
    """
    scale = DepthScale(max(near_px, 2 * far_px), far_px, None, colours)
    levels, _ = depth_levels(disparity_px, scale)
    return cv2.applyColorMap(levels, palette(colours)).astype(np.uint8, copy=False)


def depth_levels(disparity_px: Real, scale: DepthScale) -> tuple[NDArray[np.uint8], bool]:
    """Return which colour of the palette each disparity has, 0 = unknown, and whether any is known.

    Args:
        disparity_px: (height, width) float32, without doffs; NaN = unknown.
        scale: the scale of the colours.

    Returns:
        (height, width) uint8; True where a disparity is known.
    """
    disparity_px = np.ascontiguousarray(disparity_px)
    per_px, table = _level_table(scale)
    levels = np.empty(disparity_px.shape, np.uint8)
    known = levels_of(disparity_px, scale.doffs, per_px, table, levels)
    return levels, bool(known)


@functools.lru_cache(maxsize=8)
def _level_table(scale: DepthScale) -> tuple[float, NDArray[np.uint8]]:
    """Return how many entries there are in a px, and the level of each disparity from 0 px on."""
    per_px = min(_LEVELS_PER_PX, _MAX_LEVELS / scale.near_px)
    disparity_px = np.arange(math.ceil(scale.near_px * per_px) + 1) / per_px
    nearness = np.log(np.maximum(disparity_px / scale.far_px, 1))
    step = (255 - FARTHEST) / math.log(scale.near_px / scale.far_px)
    return per_px, np.minimum(FARTHEST + nearness * step, 255).astype(np.uint8)


@functools.lru_cache(maxsize=8)
def _colour_table(colours: str) -> NDArray[np.uint8]:
    return table_of(palette(colours))


def _bands(result: FrameResult, stream: RunContext) -> NDArray[np.uint8]:
    steps = stream.settings.bands - 1
    return ((result.bands.astype(np.uint16) - 1) * 255 // steps).astype(np.uint8)


def depth_scale(stream: RunContext) -> DepthScale:
    """Return the scale of the depth colours of a run."""
    return DepthScale.of(stream.settings, stream.output, stream.rig)


def reference_view(result: FrameResult, stream: RunContext) -> Grey:
    """Return the reference camera's image, (height, width) uint8."""
    view: Grey = getattr(result.frame, stream.settings.reference)
    return view


def grey_picture(grey: Grey) -> NDArray[np.uint8]:
    """Return grey levels, (height, width) uint8, as RGB."""
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB), np.uint8)


def depth_picture(result: FrameResult, stream: RunContext) -> NDArray[np.uint8]:
    """Return depth in colour, (height, width, 3) uint8 RGB.

    Where nothing at all is known, as at the beginning of a recording, it is the reference view,
    darkened: a black picture says nothing, and players show it for the file.
    """
    if np.isnan(result.disparity_px).all():
        return grey_picture(reference_view(result, stream) // np.uint8(3))
    scale = depth_scale(stream)
    return depth_colours(
        result.disparity_px + np.float32(scale.doffs), scale.near_px, scale.far_px, scale.colours
    )


def _depth(result: FrameResult, stream: RunContext) -> list[Picture]:
    scale = depth_scale(stream)
    levels, known = depth_levels(result.disparity_px, scale)
    parts: list[Picture] = [
        Indexed(levels, _colour_table(scale.colours))
        if known
        else reference_view(result, stream) // np.uint8(3)
    ]
    if stream.output.legend:
        parts.append(strip(levels.shape[1], scale, time_text(result.frame)))
    return parts


def _preview(result: FrameResult, stream: RunContext) -> NDArray[np.uint8]:
    from motionstereo_cli.sinks.preview import preview_picture

    return preview_picture(result, stream)


# The sinks by their names in OUTPUTS; each takes the path and the stream.


def _video(
    image: Callable[[FrameResult, RunContext], Picture | list[Picture]],
) -> functools.partial[ResultVideo]:
    return functools.partial(ResultVideo, image=image)


depth = _video(_depth)
depth_lossless = _video(
    lambda result, stream: depth_png(known_depth_m(result), stream.output.depth_scale)
)
bands = _video(_bands)
motion = _video(lambda result, _: motion_png(result.motion))
view = _video(reference_view)
preview = _video(_preview)
charge = _video(lambda result, _: result.charge)
