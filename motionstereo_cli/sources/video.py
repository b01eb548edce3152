"""One camera from a video file, decoded with PyAV."""

from __future__ import annotations

import functools
import logging
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import av
import av.logging
import cv2
import numpy as np
from av.video.reformatter import ColorRange

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.reading import MAX_PIXELS, sha256_of
from motionstereo_cli.sources.pipe import Pipe
from motionstereo_cli.sources.recording import Image, Recording, images

if TYPE_CHECKING:
    from motionstereo_cli.types import Grey

_PIPE_ADVICE = "pipe yuv4mpegpipe, Matroska, or MP4 with its index in front (-movflags +faststart)"

#: What a file may have FFmpeg open besides, where the network is allowed.
_NETWORK = "file,crypto,data,http,https,httpproxy,tls,tcp,udp,rtp"

#: How long a network address may be silent, in s.
_PATIENCE_S = 10.0

#: The decoder of this codec tells of wrong checksums in FFmpeg's log and nowhere else.
_TELLS_THE_LOG = "ffv1"

#: Grey level for each luma of a limited-range stream: 16..235 becomes 0..255.
_GREY_OF_LIMITED_LUMA = np.clip(np.rint((np.arange(256) - 16) * (255 / 219)), 0, 255).astype(
    np.uint8
)


class VideoRecording(Recording):
    """The grey images of a video file, in the order in which they are shown.

    Grey is the luma plane, expanded to 0..255 where the stream is limited range; RGB streams
    give BT.601 luma. Time stamps are those of the file, not shifted to begin at 0. Rotation
    metadata is obeyed.

    Images with visible decoding errors are delivered and counted, and so are those that are
    decoded from such or in place of lost ones, until the next key frame. An image that cannot be
    decoded leaves its number out, so that the numbers of those after it still hold. So does one
    that is missing from the file, which shows in either of two ways: the file's index lists more
    images than come, or, in files without an index and at a constant rate, time stamps leap.

    Decoding uses one thread: with more, FFmpeg decodes damaged files differently each time, and
    with slice threads it does not report the damage.

    Nothing but the file itself is read, whatever it holds: FFmpeg gets it as an open file, and
    may open no other.

    Args:
        path: an existing file, standard input, or a network address as text.
        max_pixels: largest width times height of an image.
        allow_network: let a playlist name files and network addresses.

    Raises:
        InputError: not a video, too large, or none of its images can be decoded.
    """

    def __init__(
        self,
        path: Path | Pipe | str,
        *,
        max_pixels: int = MAX_PIXELS,
        allow_network: bool = False,
    ) -> None:
        self._path = path
        self._corrupt = self._undecodable = self._missing = self._cut_off = 0
        self._failed: list[int] = []  # pts of packets that gave no image, not yet passed
        self._packets = 0
        self._packet_end = 0  # in bytes from the beginning of the file
        self._constant_rate: bool | None = None  # not known before the second image
        self._end_error = ""
        _keep_quiet()
        try:
            self._container = _opened(path, max_pixels, allow_network)
        except (av.FFmpegError, OSError) as error:
            self._check_interrupt()
            advice = "give a whole video file, or a folder of images"
            raise InputError(
                f"{path} is not a video that can be decoded ({error.strerror}): "
                f"{_PIPE_ADVICE if isinstance(path, Pipe) else advice}"
            ) from error
        try:
            if not self._container.streams.video:
                raise InputError(f"{path} has no video stream: give a video file")
            self._stream = self._container.streams.video[0]
            codec = self._stream.codec_context
            if codec is None:  # the type stub says otherwise
                raise InputError(f"{path} is in a format that cannot be decoded: convert it")
            if codec.width * codec.height > max_pixels:
                raise InputError(
                    f"{path} is {codec.width}x{codec.height}: that is more than --max-pixels "
                    f"{max_pixels}, raise it if the video is to be trusted"
                )
            codec.thread_count = 1
            codec.options = _decoder_limits(max_pixels)
            self.frame_rate = self._stream.average_rate or self._stream.guessed_rate
            self._begin_s = Fraction(self._container.start_time or 0, av.time_base)
            self._listed = self._count_listed()
            self.expected_images = self._listed or self._stream.frames or self._count_by_length()
            if self._stream.time_base is None:
                raise InputError(f"{path} has no time base: convert it to MP4 or Matroska")
            self.time_base: Fraction = self._stream.time_base
            self._start(self._read(), path, _PIPE_ADVICE if isinstance(path, Pipe) else "")
            self._check_interrupt()
        except BaseException:
            self._container.close()
            self._check_interrupt()
            raise

    def close(self) -> None:
        """Close the file."""
        self._container.close()

    def stop(self) -> None:
        """End a wait for standard input."""
        if isinstance(self._path, Pipe):
            self._path.stop()

    @property
    def lost(self) -> int:
        """Images not decodable or missing so far."""
        return self._undecodable + self._missing + self._cut_off

    @property
    def flawed(self) -> int:
        """Images decoded with errors so far."""
        return self._corrupt

    @property
    def damage(self) -> list[str]:
        """What was damaged so far, one line for each kind."""
        found = {
            "decoded with errors, or after errors and before a key frame": self._corrupt,
            "could not be decoded": self._undecodable,
            "missing within the video": self._missing,
            "missing at its end": self._cut_off,
        }
        lines = [f"{self._path}: {images(n)} {what}" for what, n in found.items() if n]
        if self._end_error:
            lines.append(f"{self._path}: reading stopped early: {self._end_error}")
        return lines

    def describe(self) -> dict[str, Any]:
        """Return what the video is, as JSON-able values."""
        return {
            "path": str(self._path),
            "kind": "video",
            "codec": self._stream.codec_context.name,
            "pixel_format": self._pixel_format,
            "range": "full" if self._full_range else "limited",
            "rotation_deg": 90 * self._quarters,  # counter-clockwise
            "width": self.width,
            "height": self.height,
            "frame_rate": str(self.frame_rate) if self.frame_rate else None,
            "images": self.expected_images,
        }

    def fingerprint(self) -> dict[str, Any]:
        """Return size in bytes and SHA-256 of the file, or of what came through the pipe."""
        if isinstance(self._path, Pipe):
            return {"bytes": self._path.bytes_read, "sha256": self._path.sha256}
        if isinstance(self._path, str):
            return {"bytes": None, "sha256": None}
        return {"bytes": self._path.stat().st_size, "sha256": sha256_of(self._path)}

    def _check_interrupt(self) -> None:
        if isinstance(self._path, Pipe) and self._path.interrupted:
            raise KeyboardInterrupt from None

    def _count_listed(self) -> int | None:
        # MP4 alone has an index that holds; not its frame count, for that includes what the edit
        # list cuts away. AVI counts empty places. A fragmented MP4 has no index of the whole.
        if self._stream.frames and "mp4" in self._container.format.name:
            return len(self._stream.index_entries)
        return None

    def _count_by_length(self) -> int | None:
        length_s: Fraction | None = None
        if self._stream.duration is not None and self._stream.time_base is not None:
            length_s = self._stream.duration * self._stream.time_base
        # Matroska tells the end of its longest stream alone.
        elif self._container.duration is not None and len(self._container.streams) == 1:
            length_s = Fraction(self._container.duration, av.time_base) - self._begin_s
        return round(length_s * self.frame_rate) if length_s and self.frame_rate else None

    def _read(self) -> Iterator[Image]:
        number, last_pts = -1, None
        shape: tuple[int, ...] | None = None
        flawed = False
        for frame, complained in self._decode():
            pts = self._pts(frame, last_pts)
            if shape is None:
                self._quarters = round(frame.rotation / 90) % 4
                self._pixel_format, self._full_range = frame.format.name, is_full_range(frame)
            grey = _rotated(grey_levels(frame), self._quarters)
            if shape is not None and grey.shape != shape:
                self._fail(pts)  # a damaged header, or a change that cannot be followed
                continue
            shape = grey.shape
            lost = self._lost_between(last_pts, pts, number)
            # What is wrong with an image is wrong with all that are decoded from it.
            inherited = (flawed or lost > 0) and not frame.key_frame
            flawed = frame.is_corrupt or complained or inherited
            self._corrupt += flawed
            number += 1 + lost
            last_pts = pts
            yield Image(number, pts, grey)
        self._cut_off = self._lost_at_end(last_pts)

    def _decode(self) -> Iterator[tuple[av.VideoFrame, bool]]:
        """Yield the images, and whether the decoder complained of them in its log alone."""
        heeded = self._stream.codec_context.name == _TELLS_THE_LOG
        packets = self._container.demux(self._stream)
        while True:
            try:
                packet = next(packets)
            except StopIteration:
                return
            except (av.FFmpegError, OSError) as error:
                self._end_error = error.strerror or str(error)
                return
            if packet.size or packet.dts is not None:  # the last one is empty: it flushes
                self._packets += 1
            if packet.pos is not None:
                self._packet_end = max(self._packet_end, packet.pos + packet.size)
            try:
                with av.logging.Capture() as log:  # of this thread alone
                    frames = packet.decode()
            except av.FFmpegError:
                self._fail(packet.pts if packet.pts is not None else packet.dts)
                continue
            for frame in frames:
                yield frame, heeded and bool(log)

    def _fail(self, pts: int | None) -> None:
        self._undecodable += 1
        if pts is not None:
            self._failed.append(pts)

    def _pts(self, frame: av.VideoFrame, last_pts: int | None) -> int:
        if frame.pts is not None:
            return frame.pts
        if last_pts is None:
            return 0
        return last_pts + (round(1 / (self.frame_rate * self.time_base)) if self.frame_rate else 1)

    def _lost_between(self, last_pts: int | None, pts: int, last_number: int) -> int:
        """Return how many images were lost between two delivered ones, and note them."""
        failed = sum(each < pts for each in self._failed)
        self._failed = [each for each in self._failed if each > pts]
        if last_pts is None or self._listed or not self.frame_rate or self._constant_rate is False:
            return failed
        # Nothing lists this file's images, so some may be gone without a trace but in time.
        periods = float((pts - last_pts) * self.time_base * self.frame_rate)
        steps = round(periods)
        missing = steps - 1 - failed
        self._constant_rate = (
            abs(periods - steps) < 0.25
            and missing >= 0
            # A leap at the very first step means that the rate is mislabelled.
            and not (missing and self._constant_rate is None)
            # A leap beyond the end is a damaged time stamp.
            and (self.expected_images is None or last_number + steps < self.expected_images)
        )
        if not self._constant_rate:
            return failed
        self._missing += missing
        return failed + missing

    def _lost_at_end(self, last_pts: int | None) -> int:
        if self._listed:
            return max(self._listed - self._packets, 0)
        if self._container.format.name == "yuv4mpegpipe":  # bare images: a rest is a torn one
            path = self._path
            if isinstance(path, str):
                return 0
            size = path.bytes_read if isinstance(path, Pipe) else path.stat().st_size
            return int(size > self._packet_end)
        # The length stands in the header of these; in others it is an estimate.
        headed = self._container.format.name in ("matroska,webm", "avi")
        if last_pts is None or not (headed and self._constant_rate and self.frame_rate):
            return 0
        last = round((last_pts * self.time_base - self._begin_s) * self.frame_rate)
        return max((self.expected_images or 0) - 1 - last - len(self._failed), 0)


def _opened(
    path: Path | Pipe | str, max_pixels: int, allow_network: bool
) -> av.container.InputContainer:
    limits = _decoder_limits(max_pixels)
    # Titles and the like may be anything, and do not matter.
    opened = functools.partial(av.open, mode="r", metadata_errors="replace")
    if isinstance(path, Pipe):
        return opened(path, options=limits | {"protocol_whitelist": "none"})
    if isinstance(path, str):
        return opened(path, options=limits, timeout=_PATIENCE_S)
    if allow_network:
        # An absolute path: FFmpeg takes what precedes a colon for a protocol.
        options = limits | {"protocol_whitelist": _NETWORK, "allowed_extensions": "ALL"}
        return opened(str(path.absolute()), options=options, timeout=_PATIENCE_S)
    with path.open("rb") as file:  # FFmpeg duplicates it
        options = limits | {"fd": str(file.fileno()), "protocol_whitelist": "fd"}
        return opened("fd:", options=options)


def _decoder_limits(max_pixels: int) -> dict[str, str]:
    # Twice, for coded images have a margin. This is for sizes that a file's head does not tell.
    return {"max_pixels": str(2 * max_pixels)}


def _keep_quiet() -> None:
    """Have FFmpeg's errors told to those who capture them, and to nobody else."""
    av.logging.set_level(av.logging.ERROR)
    av.logging.set_skip_repeated(False)
    logging.getLogger("libav").setLevel(logging.CRITICAL + 1)


def is_full_range(frame: av.VideoFrame) -> bool:
    """Return whether luma spans 0..255 rather than 16..235.

    What the stream says holds; where it says nothing, YUV is limited range, all else full.
    """
    if frame.color_range in (ColorRange.JPEG, ColorRange.MPEG):
        return frame.color_range == ColorRange.JPEG
    name = frame.format.name
    return frame.format.is_rgb or name.startswith(("gray", "yuvj", "ya", "pal", "mono"))


def grey_levels(frame: av.VideoFrame) -> Grey:
    """Return the grey levels of a decoded frame, (height, width) uint8 0..255.

    Luma of 8 bits in a plane of its own is taken as it is and, where limited range, looked up
    in a table. Other YUV goes through FFmpeg's scaler, RGB through BT.601 in full range.
    """
    form, full = frame.format, is_full_range(frame)
    if form.is_rgb or form.has_palette:
        rgb = frame.to_ndarray(format="rgb24")
        return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)
    plane_is_luma = form.is_planar or len(form.components) == 1
    if not (plane_is_luma and form.components[0].is_luma and form.components[0].bits == 8):
        source = ColorRange.JPEG if full else ColorRange.MPEG
        frame = frame.reformat(
            format="gray", src_color_range=source, dst_color_range=ColorRange.JPEG
        )
        full = True
    plane = frame.planes[0]
    rows = np.frombuffer(memoryview(plane), np.uint8).reshape(
        -1, plane.line_size
    )  # rows are padded
    luma = rows[: frame.height, : frame.width]
    return np.ascontiguousarray(luma if full else cv2.LUT(luma, _GREY_OF_LIMITED_LUMA), np.uint8)


def _rotated(grey: Grey, quarters: int) -> Grey:
    """Turn an image counter-clockwise by a number of right angles."""
    return np.ascontiguousarray(np.rot90(grey, quarters)) if quarters else grey
