"""Videos of the results: most to look at, depth also lossless."""

from __future__ import annotations

import functools
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from motionstereo_cli.files.video import Indexed, Picture, SegmentedVideo, VideoMark
from motionstereo_cli.sinks.drawing import (
    colour_table,
    depth_levels,
    depth_scale,
    reference_view,
)
from motionstereo_cli.sinks.images import depth_png, known_depth_m, motion_png
from motionstereo_cli.sinks.legend import strip, time_text
from motionstereo_cli.sinks.preview import preview_picture
from motionstereo_cli.types import FrameResult

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.sinks.sink import RunContext

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


def _bands(result: FrameResult, stream: RunContext) -> NDArray[np.uint8]:
    steps = stream.settings.bands - 1
    return ((result.bands.astype(np.uint16) - 1) * 255 // steps).astype(np.uint8)


def _depth(result: FrameResult, stream: RunContext) -> list[Picture]:
    scale = depth_scale(stream)
    levels, known = depth_levels(result.disparity_px, scale)
    parts: list[Picture] = [
        Indexed(levels, colour_table(scale.colours))
        if known
        else reference_view(result, stream) // np.uint8(3)
    ]
    if stream.output.legend:
        parts.append(strip(levels.shape[1], scale, time_text(result.frame)))
    return parts


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
preview = _video(preview_picture)
charge = _video(lambda result, _: result.charge)
