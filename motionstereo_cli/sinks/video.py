"""Encoding images as video with PyAV."""

from __future__ import annotations

import contextlib
import os
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import av
import numpy as np

from motionstereo_cli.sinks.files import part_of, reported

if TYPE_CHECKING:
    from numpy.typing import NDArray

#: Luma of a limited-range stream for each grey level: 0..255 becomes 16..235.
_LIMITED_LUMA = (16.5 + np.arange(256) * (219 / 255)).astype(np.uint8)


class VideoWriter:
    """A video file that appears under its name only when it is complete.

    H.264 in yuv420p (limited range, one encoder thread, so that the same images give the same
    bytes everywhere) or, for names that end in ``.mkv``, lossless FFV1 of the grey levels, 8 or
    16 bits; Matroska rounds times to ms. For yuv420p, which needs even sizes, images of odd size
    are padded by repeating their last row or column.

    Args:
        path: final name; ``.mp4`` or ``.mkv``.
        time_base: seconds per unit of the time stamps given to :meth:`write`.
        quality: H.264 constant rate factor, 0 (best) to 51.

    Raises:
        OutputError: the file cannot be written.
    """

    def __init__(self, path: Path, time_base: Fraction, *, quality: int = 18) -> None:
        self.path = path
        self._time_base = time_base
        self._quality = quality
        self._lossless = path.suffix == ".mkv"
        self._stream: Any = None
        self._last_pts: int | None = None
        with reported(path):
            self._container = av.open(
                str(part_of(path)),
                "w",
                format="matroska" if self._lossless else "mp4",
                # No random identifiers; the index in front, so that browsers start at once and
                # a cut copy can still be read.
                options={"fflags": "+bitexact"}
                | ({} if self._lossless else {"movflags": "+faststart"}),
            )

    def write(self, image: NDArray[np.uint8] | NDArray[np.uint16], pts: int) -> None:
        """Append an image.

        (height, width) uint8 grey; for .mp4 also (height, width, 3) uint8 RGB; for .mkv also
        (height, width) uint16.

        A time stamp that does not come after the one before is moved to just after it.

        Raises:
            OutputError: the file cannot be written.
        """
        frame = self._frame(image)
        if self._last_pts is not None:
            pts = max(pts, self._last_pts + 1)
        self._last_pts = frame.pts = pts
        frame.time_base = self._time_base
        with reported(self.path):
            if self._stream is None:
                self._stream = self._add_stream(frame)
            self._container.mux(self._stream.encode(frame))

    def finish(self) -> None:
        """Complete the file, still under its ``.part`` name.

        Raises:
            OutputError: the file cannot be written.
        """
        stream, self._stream = self._stream, None
        with reported(self.path):
            try:
                if stream is not None:
                    self._container.mux(stream.encode(None))
            finally:
                self._container.close()

    def close(self, *, keep: bool = True) -> None:
        """Complete the file and give it its name; with ``keep=False``, remove it instead.

        Raises:
            OutputError: the file cannot be written.
        """
        if keep:
            self.finish()
            with reported(self.path):
                os.replace(part_of(self.path), self.path)
        else:
            with contextlib.suppress(OSError):  # what is left to write does not matter
                self._container.close()
            with reported(self.path):
                part_of(self.path).unlink(missing_ok=True)

    def _add_stream(self, frame: av.VideoFrame) -> Any:
        # The rate is a label alone: the time stamps say when each frame is shown.
        codec = "ffv1" if self._lossless else "libx264"
        stream: Any = self._container.add_stream(codec, rate=30)
        stream.width, stream.height = frame.width, frame.height
        stream.pix_fmt = frame.format.name
        stream.time_base = stream.codec_context.time_base = self._time_base
        stream.codec_context.thread_count = 1
        if not self._lossless:
            # x264's macroblock tree is not repeatable with AVX2: it reads unset memory.
            stream.options = {"crf": str(self._quality), "preset": "veryfast", "mbtree": "0"}
            stream.codec_context.color_range = 1  # limited
        return stream

    def _frame(self, image: NDArray[Any]) -> av.VideoFrame:
        if self._lossless:
            grey = "gray16le" if image.dtype == np.uint16 else "gray"
            return av.VideoFrame.from_ndarray(image, grey)
        if image.ndim == 3:
            return av.VideoFrame.from_ndarray(_even(image), "rgb24").reformat(format="yuv420p")
        luma = _LIMITED_LUMA[_even(image)]
        chroma = np.full((luma.shape[0] // 2, luma.shape[1]), 128, np.uint8)
        return av.VideoFrame.from_ndarray(np.concatenate([luma, chroma]), "yuv420p")


def _even(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = image.shape[:2]
    if height % 2 == 0 and width % 2 == 0:
        return image
    padding = [(0, height % 2), (0, width % 2)] + [(0, 0)] * (image.ndim - 2)
    return np.pad(image, padding, mode="edge")
