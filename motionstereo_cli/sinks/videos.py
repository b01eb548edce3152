"""Videos of the results: to look at, and of depth also lossless."""

from __future__ import annotations

import functools
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from motionstereo_cli.files.records import restored
from motionstereo_cli.files.video import Indexed, Picture, SegmentedVideo, VideoMark
from motionstereo_cli.sinks.drawing import (
    colour_table,
    depth_levels,
    depth_scale,
)
from motionstereo_cli.sinks.images import asked_for, depth_png, motion_png
from motionstereo_cli.sinks.legend import strip, time_text
from motionstereo_cli.sinks.sink import EPOCH_S
from motionstereo_cli.types import FrameImages

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.sinks.sink import RunContext

    #: Makes the picture of a frame from its images or its step.
    Draw = Callable[[Any, RunContext], Picture | list[Picture]]

#: Checkpoint of a video: that of its segments, and the first time stamp.
ResultMark = tuple[VideoMark, int | None]


def beginning(pts: int, time_base: Fraction) -> int:
    """Return the time stamp at which a video begins whose first frame has ``pts``.

    It is ``pts`` for times that count from an epoch, as of camera clocks, and 0 for others.
    """
    return pts if pts * time_base > EPOCH_S else 0


class ResultVideo:
    """A video of one image per frame, at the times of the frames.

    If these count from an epoch, as of camera clocks, the video begins at 0.

    Args:
        path: final name; its suffix is the format, see :class:`SegmentedVideo`.
        stream: the run's context.
        since: continue from this checkpoint: that of the video, and the first time stamp.
        image: makes the picture of a frame, as ``VideoWriter.write`` takes it.

    Raises:
        OutputError: the file cannot be written, or is not what the checkpoint says.
    """

    def __init__(
        self,
        path: Path,
        stream: RunContext,
        since: ResultMark | None = None,
        *,
        image: Draw,
    ) -> None:
        segments, self._begin = restored(since or (((), None), None), ResultMark)
        self._video = SegmentedVideo(path, stream.time_base, segments)
        self._stream = stream
        self._image = image

    def write(self, given: Any) -> None:
        """Append the image of a frame, made of its images or its step."""
        pts = given.time.pts
        if self._begin is None:
            self._begin = beginning(pts, self._stream.time_base)
        self._video.write(self._image(given, self._stream), pts - self._begin)

    def checkpoint(self) -> ResultMark:
        """End a segment."""
        return self._video.checkpoint(), self._begin

    def close(self) -> None:
        """Complete the video and give it its name."""
        self._video.close()

    def abandon(self, *, keep: bool) -> None:
        """Complete the last segment or, without ``keep``, remove all."""
        self._video.abandon(keep=keep)


def _bands(images: FrameImages, stream: RunContext) -> NDArray[np.uint8]:
    steps = stream.settings.bands - 1
    return ((asked_for(images.bands).astype(np.uint16) - 1) * 255 // steps).astype(np.uint8)


def _depth(images: FrameImages, stream: RunContext) -> list[Picture]:
    scale = depth_scale(stream)
    levels = depth_levels(images.disparity_px, scale, images.view)
    parts: list[Picture] = [Indexed(levels, colour_table(scale.colours))]
    if stream.output.legend:
        parts.append(strip(levels.shape[1], scale, time_text(images.time)))
    return parts


# The sinks by their names in OUTPUTS; each takes the path and the stream.


def _video(
    image: Draw,
) -> functools.partial[ResultVideo]:
    return functools.partial(ResultVideo, image=image)


depth = _video(_depth)
depth_lossless = _video(
    lambda images, stream: depth_png(images.disparity_px, stream.rig, stream.output.depth_scale)
)
bands = _video(_bands)
motion = _video(lambda images, _: motion_png(asked_for(images.motion)))
view = _video(lambda images, _: images.look)
charge = _video(lambda images, _: images.charge)
own_charge = _video(lambda images, _: asked_for(images.own_charge))
