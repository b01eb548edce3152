"""Encoding images as video with PyAV."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import av
import cv2
import numpy as np

from motionstereo_cli.compiled import pictures as loops
from motionstereo_cli.files.atomic import Temporary, open_new, remove_own, reported
from motionstereo_cli.files.reading import open_regular
from motionstereo_cli.files.segments import Segments

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Indexed:
    """A picture of at most 256 colours.

    Attributes:
        levels: which colour each pixel has, (height, width) uint8.
        table: luma, blue and red difference of each, BT.601 in limited range, (3, 256) uint8.
    """

    levels: NDArray[np.uint8]
    table: NDArray[np.uint8]


def table_of(palette: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the table of an :class:`Indexed` picture for (256, 1, 3) uint8 RGB colours."""
    squares = np.repeat(palette.reshape(1, 256, 3), 2, axis=0).repeat(2, axis=1)
    planes = np.asarray(cv2.cvtColor(squares, cv2.COLOR_RGB2YUV_I420), np.uint8)
    return np.stack([planes[0, ::2], planes[2, :256], planes[2, 256:]])


#: Constant, so that x264 need not look ahead: 0.86 ms in place of 1.17 for a 640x480 frame of the
#: charge; SSIM 0.991 for it and 0.996 for depth, 14 and 12 kB a frame (rate factor 18: 0.994 and
#: 0.997, 16.5 and 14 kB).
_PREVIEW_QUANTIZER = "22"

#: The longest time in s that an image can show in MP4's numbers.
_LONGEST_S = 10_000


Picture: TypeAlias = "NDArray[np.uint8] | NDArray[np.uint16] | Indexed"


@contextlib.contextmanager
def _reported(path: Path) -> Iterator[None]:
    """Turn errors of the system and of FFmpeg into one that names the path."""
    with reported(path):
        try:
            yield
        except av.FFmpegError as error:
            if isinstance(error, OSError):
                raise
            raise OSError(error.errno, error.strerror) from error


def _new(part: Path, path: Path) -> av.container.OutputContainer:
    """Open a container for writing as ``part``, in the format of the final name ``path``."""
    # No random identifiers; the index in front, so that browsers start at once and a cut copy can
    # still be read.
    options, kind = {"fflags": "+bitexact"}, "matroska"
    if path.suffix != ".mkv":
        options, kind = options | {"movflags": "+faststart"}, "mp4"
    # An absolute path: FFmpeg takes what precedes a colon for a protocol.
    return av.open(str(part.absolute()), "w", format=kind, options=options)


class VideoWriter:
    """A video file that gets its final name when it is complete.

    H.264 in yuv420p (limited range, one encoder thread, so that the same images give the same
    bytes everywhere) or, for names that end in ``.mkv``, lossless FFV1 of the grey levels, 8 or
    16 bits; Matroska rounds times to ms. For yuv420p, which needs even sizes, images of odd size
    are padded by repeating their last row or column.

    Args:
        path: final name; ``.mp4`` or ``.mkv``.
        time_base: seconds per unit of the time stamps given to :meth:`write`.
        quality: H.264 constant rate factor, 0 (best) to 51.
        part: its name while it is being written, in a folder of results; random if None.
        preview: encode in a third of the time into a file twice as large, ignoring ``quality``;
            no picture depends on a later one, so that files can be joined.
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
        self._part = part
        self._file: Temporary | None = None
        self._time_base = time_base
        rate = {"preset": "veryfast", "crf": str(quality)}
        if preview:
            rate = {"preset": "ultrafast", "bf": "0", "qp": _PREVIEW_QUANTIZER}
        # x264's macroblock tree is not repeatable with AVX2: it reads unset memory.
        self._options = {"mbtree": "0", **rate}
        self._lossless = path.suffix == ".mkv"
        self._stream: Any = None
        self.last_pts = after
        self._spacing: int | None = None
        with _reported(path):
            if part is None:
                self._file = Temporary(path)
                part = self._file.path
            else:
                os.close(open_new(part))
            self._container = _new(part, path)

    def write(self, image: Picture | list[Picture], pts: int) -> None:
        """Append an image.

        (height, width) uint8 grey; for .mp4 also (height, width, 3) uint8 RGB, :class:`Indexed`,
        or a list of such, one below the other; for .mkv also (height, width) uint16.

        A time stamp that is not after the previous one is moved to just after it.

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
        """Complete the file, which keeps its temporary name.

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
        assert self._file is not None
        with _reported(self.path):
            self._file.place()

    def abandon(self, *, keep: bool) -> None:
        """Complete the file under the name ``part``, or remove it without ``keep`` or ``part``.

        Raises:
            OutputError: the file cannot be written.
        """
        if keep and self._part is not None:
            self.finish()
            return
        with contextlib.suppress(OSError):  # errors of the remaining writes do not matter
            self._container.close()
        if self._file is not None:
            self._file.discard()
        elif self._part is not None:
            remove_own(self._part)

    def _mux(self, frame: av.VideoFrame | None) -> None:
        for packet in self._stream.encode(frame):
            if self._spacing is not None and self._spacing * self._time_base < _LONGEST_S:
                packet.duration = self._spacing  # else that of the last image
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

    def _frame(self, image: Any) -> av.VideoFrame:
        if self._lossless:
            grey = "gray16le" if image.dtype == np.uint16 else "gray"
            return av.VideoFrame.from_ndarray(image, grey)
        parts = image if isinstance(image, list) else [image]
        pictures = [_even(part) for part in parts]
        height, width = sum(len(each) for each in pictures), pictures[0].shape[1]
        frame = av.VideoFrame(width, height, "yuv420p")
        planes = [
            np.frombuffer(memoryview(plane), np.uint8).reshape(-1, plane.line_size)
            for plane in frame.planes
        ]
        top = 0
        for picture, part in zip(pictures, parts, strict=True):
            rows = [
                plane[top // k : (top + len(picture)) // k]
                for plane, k in zip(planes, (1, 2, 2), strict=True)
            ]
            if isinstance(part, Indexed):
                loops.planes(picture, part.table, *rows)
            elif picture.ndim == 3:
                _convert(picture, rows)
            else:
                loops.grey_planes(picture, *rows)
            top += len(picture)
        return frame


def _convert(rgb: NDArray[np.uint8], planes: Sequence[NDArray[np.uint8]]) -> None:
    """Fill in the planes of an RGB picture: BT.601, limited range."""
    height, width = rgb.shape[:2]
    found = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV_I420), np.uint8)
    planes[0][:, :width] = found[:height]
    for plane, part in zip(planes[1:], found[height:].reshape(2, -1), strict=True):
        plane[:, : width // 2] = part.reshape(-1, width // 2)


#: Checkpoint of a video: the SHA-256 of each segment, and the last time stamp.
VideoMark = tuple[tuple[str, ...], int | None]


class SegmentedVideo:
    """A preview video that another process can continue.

    A new segment begins at each checkpoint: a video of its own, beside the final name. At the end
    the segments are joined, as they are, without decoding. They stay until the caller completes the
    output folder: until then another process may have to continue from them.

    Args:
        path: final name; see :class:`VideoWriter`.
        time_base: seconds per unit of the time stamps given to :meth:`write`.
        since: continue from this checkpoint.

    Raises:
        OutputError: the file cannot be written, or a segment is missing or was changed.
    """

    def __init__(self, path: Path, time_base: Fraction, since: VideoMark = ((), None)) -> None:
        self._path = path
        self._time_base = time_base
        sums, self._last_pts = since
        self._segments = Segments(path, sums)
        self._writer: VideoWriter | None = None

    def write(self, image: Picture | list[Picture], pts: int) -> None:
        """Append an image; one not after the last gets the next time stamp.

        Raises:
            OutputError: the file cannot be written.
        """
        if self._writer is None:
            part = self._segments.next
            self._writer = VideoWriter(
                self._path, self._time_base, part=part, preview=True, after=self._last_pts
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
            self._writer = None
            self._segments.end()
        return self._segments.sums, self._last_pts

    def close(self) -> None:
        """Complete the video and give it its name.

        Raises:
            OutputError: the file cannot be written.
        """
        paths = self._segments.paths
        if self._writer is not None:
            self._writer.finish()
            paths.append(self._segments.next)  # not synced to disk: the whole video is
        join(paths, self._path)
        self._writer = None

    def abandon(self, *, keep: bool) -> None:
        """Complete the last segment or, without ``keep``, remove all."""
        if self._writer is not None:
            self._writer.abandon(keep=keep)
        if not keep:
            self._segments.remove()


@contextlib.contextmanager
def opened_result(path: Path, within: Path) -> Iterator[av.container.InputContainer]:
    """Open a video that this program wrote, in the format of its suffix; it opens no other files.

    Args:
        path: the video, or a segment of it.
        within: a folder that no link may lead out of.

    Raises:
        OSError: it cannot be opened, or is no regular file.
        av.FFmpegError: it is not such a video.
    """
    kinds = {".mkv": "matroska", ".mp4": "mp4"}
    kind = next((kinds[suffix] for suffix in path.suffixes if suffix in kinds), None)
    with open_regular(path, within) as file:  # FFmpeg duplicates it
        options = {"fd": str(file.fileno()), "protocol_whitelist": "fd"}
        with av.open("fd:", format=kind, options=options, metadata_errors="replace") as opened:
            yield opened


def join(segments: Sequence[Path], path: Path) -> None:
    """Write the pictures of several videos of one kind, one after the other, as one video.

    Raises:
        OutputError: the file cannot be written, or a segment cannot be read.
    """
    with _reported(path), Temporary(path) as file:
        with _new(file.path, path) as joined:
            stream: Any = None
            for segment in segments:
                with opened_result(segment, segment.parent) as source:
                    if stream is None:
                        stream = joined.add_stream_from_template(source.streams.video[0])
                        # That of the first segment, which no other way of joining has.
                        stream.codec_context.bit_rate = 0
                    for packet in source.demux(source.streams.video[0]):
                        if packet.dts is not None:  # the last one is empty
                            packet.stream = stream
                            joined.mux(packet)
        file.place(durable=True)


def _even(image: Picture) -> NDArray[np.uint8]:
    if isinstance(image, Indexed):
        image = image.levels
    height, width = image.shape[:2]
    if height % 2 == 0 and width % 2 == 0:
        return np.ascontiguousarray(image)
    padding = [(0, height % 2), (0, width % 2)] + [(0, 0)] * (image.ndim - 2)
    return np.pad(image, padding, mode="edge")
