"""Encoding images as video with PyAV."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import av
import cv2
import numpy as np

from motionstereo_cli.errors import OutputError
from motionstereo_cli.files.atomic import open_new, part_of, reported, segment_of, sync
from motionstereo_cli.files.reading import sha256_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

#: Luma of a limited-range stream for each grey level: 0..255 becomes 16..235.
_LIMITED_LUMA = (16.5 + np.arange(256) * (219 / 255)).astype(np.uint8)


#: What shows for longer, in s, does not fit into MP4's numbers.
_LONGEST_S = 10_000


@contextlib.contextmanager
def _reported(path: Path) -> Iterator[None]:
    """Turn FFmpeg's errors, too, into one that names the path."""
    with reported(path):
        try:
            yield
        except av.FFmpegError as error:
            if isinstance(error, OSError):
                raise
            raise OSError(error.errno, error.strerror) from error


def _container(path: Path) -> dict[str, Any]:
    """Return how to open a container for writing: its format, and options."""
    # No random identifiers; the index in front, so that browsers start at once and a cut copy can
    # still be read.
    if path.suffix == ".mkv":
        return {"format": "matroska", "options": {"fflags": "+bitexact"}}
    return {"format": "mp4", "options": {"fflags": "+bitexact", "movflags": "+faststart"}}


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
        part: its name while it is being written; ``.part`` appended to ``path`` if None.
        preview: take half the time for a file twice as large, and have no picture depend on a
            later one, so that files can be joined.
        after: time stamp of the image before the first one, None if there was none.

    Attributes:
        last_pts: time stamp of the last image; at first ``after``.

    Raises:
        OutputError: the file cannot be written.
    """

    def __init__(
        self,
        path: Path,
        time_base: Fraction,
        *,
        quality: int = 18,
        part: Path | None = None,
        preview: bool = False,
        after: int | None = None,
    ) -> None:
        self.path = path
        self._part = part or part_of(path)
        self._time_base = time_base
        preset = {"preset": "ultrafast", "bf": "0"} if preview else {"preset": "veryfast"}
        # x264's macroblock tree is not repeatable with AVX2: it reads unset memory.
        self._options = {"crf": str(quality), "mbtree": "0", **preset}
        self._lossless = path.suffix == ".mkv"
        self._stream: Any = None
        self.last_pts = after
        self._spacing: int | None = None
        with _reported(path):
            os.close(open_new(self._part))
            self._container = av.open(str(self._part), "w", **_container(path))

    def write(self, image: NDArray[np.uint8] | NDArray[np.uint16], pts: int) -> None:
        """Append an image.

        (height, width) uint8 grey; for .mp4 also (height, width, 3) uint8 RGB; for .mkv also
        (height, width) uint16.

        A time stamp that does not come after the one before is moved to just after it.

        Raises:
            OutputError: the file cannot be written.
        """
        frame = self._frame(image)
        if self.last_pts is not None:
            pts = max(pts, self.last_pts + 1)
            self._spacing = pts - self.last_pts
        self.last_pts = frame.pts = pts
        frame.time_base = self._time_base
        with _reported(self.path):
            if self._stream is None:
                self._stream = self._add_stream(frame)
            self._mux(frame)

    def finish(self) -> None:
        """Complete the file, still under its ``.part`` name.

        Raises:
            OutputError: the file cannot be written.
        """
        with _reported(self.path):
            try:
                if self._stream is not None:
                    self._mux(None)
            finally:
                self._stream = None
                self._container.close()

    def close(self) -> None:
        """Complete the file and give it its name.

        Raises:
            OutputError: the file cannot be written.
        """
        self.finish()
        with _reported(self.path):
            os.replace(self._part, self.path)

    def abandon(self, *, keep: bool) -> None:
        """Complete the file under its ``.part`` name or, without ``keep``, remove it.

        Raises:
            OutputError: the file cannot be written.
        """
        if keep:
            self.finish()
            return
        with contextlib.suppress(OSError):  # what is left to write does not matter
            self._container.close()
        with _reported(self.path):
            self._part.unlink(missing_ok=True)

    def _mux(self, frame: av.VideoFrame | None) -> None:
        for packet in self._stream.encode(frame):
            if self._spacing is not None and self._spacing * self._time_base < _LONGEST_S:
                packet.duration = self._spacing  # else the label says how long the last one lasts
            self._container.mux(packet)

    def _add_stream(self, frame: av.VideoFrame) -> Any:
        # The rate is only a label: the time stamps say when each frame is shown.
        codec = "ffv1" if self._lossless else "libx264"
        stream: Any = self._container.add_stream(codec, rate=30)
        stream.width, stream.height = frame.width, frame.height
        stream.pix_fmt = frame.format.name
        stream.time_base = stream.codec_context.time_base = self._time_base
        stream.codec_context.thread_count = 1
        if self._lossless:
            stream.codec_context.framerate = 0  # Matroska then has no label: the times tell
        else:
            stream.options = self._options
            stream.codec_context.color_range = 1  # limited
        return stream

    def _frame(self, image: NDArray[Any]) -> av.VideoFrame:
        if self._lossless:
            grey = "gray16le" if image.dtype == np.uint16 else "gray"
            return av.VideoFrame.from_ndarray(image, grey)
        if image.ndim == 3:
            planes = cv2.cvtColor(_even(image), cv2.COLOR_RGB2YUV_I420)  # BT.601, limited range
            return av.VideoFrame.from_ndarray(np.asarray(planes, np.uint8), "yuv420p")
        luma = _LIMITED_LUMA[_even(image)]
        chroma = np.full((luma.shape[0] // 2, luma.shape[1]), 128, np.uint8)
        return av.VideoFrame.from_ndarray(np.concatenate([luma, chroma]), "yuv420p")


#: What is left of a video: the SHA-256 of each segment, and the last time stamp.
VideoMark = tuple[tuple[str, ...], int | None]


class SegmentedVideo:
    """A preview that can go on after the process that began it is gone.

    A new segment begins at each checkpoint: a video of its own, beside the final name. At the end
    the segments are joined, as they are, without decoding. They stay until the caller completes the
    output folder: until then another process may have to begin here.

    Args:
        path: final name; see :class:`VideoWriter`.
        time_base: seconds per unit of the time stamps given to :meth:`write`.
        since: go on from this checkpoint.

    Raises:
        OutputError: the file cannot be written, or a segment is missing or was changed.
    """

    def __init__(self, path: Path, time_base: Fraction, since: VideoMark = ((), None)) -> None:
        self._path = path
        self._time_base = time_base
        self._complete, self._last_pts = since
        self._writer: VideoWriter | None = None
        for segment, sums in zip(self._segments(), self._complete, strict=True):
            _check(segment, sums)

    def write(self, image: NDArray[np.uint8] | NDArray[np.uint16], pts: int) -> None:
        """Append an image; one not after the last gets the next time stamp.

        Raises:
            OutputError: the file cannot be written.
        """
        if self._writer is None:
            segment = segment_of(self._path, len(self._complete))
            self._writer = VideoWriter(
                self._path, self._time_base, part=segment, preview=True, after=self._last_pts
            )
        self._writer.write(image, pts)
        self._last_pts = self._writer.last_pts

    def checkpoint(self) -> VideoMark:
        """End the segment, and return what a new process needs to go on.

        Raises:
            OutputError: the segment cannot be completed.
        """
        if self._writer is not None:
            self._writer.finish()
            segment = segment_of(self._path, len(self._complete))
            sync(segment)
            self._writer = None
            with reported(segment):
                self._complete = (*self._complete, sha256_of(segment))
        return self._complete, self._last_pts

    def close(self) -> None:
        """Complete the video and give it its name.

        Raises:
            OutputError: the file cannot be written.
        """
        self.checkpoint()
        join(self._segments(), self._path)

    def abandon(self, *, keep: bool) -> None:
        """Complete the last segment or, without ``keep``, remove all."""
        if self._writer is not None:
            self._writer.abandon(keep=keep)
        if not keep:
            for segment in self._segments():
                segment.unlink(missing_ok=True)

    def _segments(self) -> list[Path]:
        return [segment_of(self._path, number) for number in range(len(self._complete))]


def _check(segment: Path, sums: str) -> None:
    """Make sure that a segment is what a checkpoint says."""
    try:
        found = None if segment.is_symlink() else sha256_of(segment)
    except OSError as error:
        raise OutputError(
            f"{segment} is missing ({error.strerror}): --resume cannot go on without it, give "
            "--overwrite"
        ) from error
    if found != sums:
        raise OutputError(f"{segment} was cut or changed: --resume cannot go on, give --overwrite")


def join(segments: Sequence[Path], path: Path) -> None:
    """Write the pictures of several videos of one kind, one after the other, as one video.

    Raises:
        OutputError: the file cannot be written, or a segment cannot be read.
    """
    with _reported(path):
        os.close(open_new(part_of(path)))
        with av.open(str(part_of(path)), "w", **_container(path)) as joined:
            stream: Any = None
            for segment in segments:
                with av.open(str(segment)) as source:
                    if stream is None:
                        stream = joined.add_stream_from_template(source.streams.video[0])
                    for packet in source.demux(source.streams.video[0]):
                        if packet.dts is not None:  # the last one is empty
                            packet.stream = stream
                            joined.mux(packet)
        sync(part_of(path))
        os.replace(part_of(path), path)


def _even(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = image.shape[:2]
    if height % 2 == 0 and width % 2 == 0:
        return image
    padding = [(0, height % 2), (0, width % 2)] + [(0, 0)] * (image.ndim - 2)
    return np.pad(image, padding, mode="edge")
