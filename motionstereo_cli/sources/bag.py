"""One camera from a ROS bag.

Messages are decoded one at a time, and each camera has a reader of its own, so that both decode
side by side.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import itertools
import statistics
from collections.abc import Generator, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np

from motionstereo_cli.errors import InputError, is_damage, words_of
from motionstereo_cli.files.reading import MAX_PIXELS, open_regular
from motionstereo_cli.files.stills import DamagedImageError, colours_of, decode, grey_of
from motionstereo_cli.sources.bag_topics import (
    by_part,
    camera_info_of,
    image_topics,
    missing_parts,
    name_of,
    opened_bag,
)
from motionstereo_cli.sources.recording import Image, Recording, images

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.types import Grey


class _Encoding(NamedTuple):
    """Pixel format of raw images: samples per pixel, bytes per sample, conversion to grey."""

    samples: int
    sample_bytes: int
    conversion: int | None


#: Colour formats, and cv2's conversions to grey.
_COLOURS = {
    "rgb": (3, cv2.COLOR_RGB2GRAY),
    "bgr": (3, cv2.COLOR_BGR2GRAY),
    "rgba": (4, cv2.COLOR_RGBA2GRAY),
    "bgra": (4, cv2.COLOR_BGRA2GRAY),
    # OpenCV names a Bayer pattern by the second and third pixel of its second row.
    "bayer_rggb": (1, cv2.COLOR_BayerBG2GRAY),
    "bayer_bggr": (1, cv2.COLOR_BayerRG2GRAY),
    "bayer_gbrg": (1, cv2.COLOR_BayerGR2GRAY),
    "bayer_grbg": (1, cv2.COLOR_BayerGB2GRAY),
}

_ENCODINGS: dict[str, _Encoding] = {
    "mono8": _Encoding(1, 1, None),
    "mono16": _Encoding(1, 2, None),
    **{
        f"{name}{8 * size}": _Encoding(samples, size, conversion)
        for name, (samples, conversion) in _COLOURS.items()
        for size in (1, 2)
    },
    **{
        f"{8 * size}UC{samples}": _Encoding(samples, size, conversion)
        for samples, conversion in (
            (1, None),
            (3, cv2.COLOR_BGR2GRAY),
            (4, cv2.COLOR_BGRA2GRAY),
        )
        for size in (1, 2)
    },
    "yuv422": _Encoding(2, 1, cv2.COLOR_YUV2GRAY_UYVY),
    "uyvy": _Encoding(2, 1, cv2.COLOR_YUV2GRAY_UYVY),
    "yuv422_yuy2": _Encoding(2, 1, cv2.COLOR_YUV2GRAY_YUY2),
    "yuyv": _Encoding(2, 1, cv2.COLOR_YUV2GRAY_YUY2),
    # The luma plane precedes the colours.
    "nv12": _Encoding(1, 1, None),
    "nv21": _Encoding(1, 1, None),
    "nv16": _Encoding(1, 1, None),
    "nv24": _Encoding(1, 1, None),
}

#: Conversions to RGB of luma with half as many rows of chroma below.
_WITH_CHROMA = {"nv12": cv2.COLOR_YUV2RGB_NV12, "nv21": cv2.COLOR_YUV2RGB_NV21}

#: Conversions to RGB, by those to grey; None if the pixels are RGB.
_TO_RGB: dict[int, int | None] = {
    cv2.COLOR_RGB2GRAY: None,
    cv2.COLOR_BGR2GRAY: cv2.COLOR_BGR2RGB,
    cv2.COLOR_RGBA2GRAY: cv2.COLOR_RGBA2RGB,
    cv2.COLOR_BGRA2GRAY: cv2.COLOR_BGRA2RGB,
    cv2.COLOR_BayerBG2GRAY: cv2.COLOR_BayerBG2RGB,
    cv2.COLOR_BayerRG2GRAY: cv2.COLOR_BayerRG2RGB,
    cv2.COLOR_BayerGR2GRAY: cv2.COLOR_BayerGR2RGB,
    cv2.COLOR_BayerGB2GRAY: cv2.COLOR_BayerGB2RGB,
    cv2.COLOR_YUV2GRAY_UYVY: cv2.COLOR_YUV2RGB_UYVY,
    cv2.COLOR_YUV2GRAY_YUY2: cv2.COLOR_YUV2RGB_YUY2,
}

#: Number of first messages from which the offset of camera and recorder clocks is measured.
_CLOCK_MESSAGES = 9


class BagRecording(Recording):
    """The images of one topic, in the order in which they were recorded.

    The time of an image is the stamp in its header, in ns; if the first is 0, the time at which the
    message was recorded. A message that cannot be decoded is counted and its number skipped; if
    the bag cannot be read further, the remaining images are lost.

    Args:
        files: the bag, or the parts of one that was split.
        topic: name of the topic.
        white: level that becomes 255 in images of 16 bits; 0 = 65535.
        max_pixels: largest width times height of an image.

    Attributes:
        camera_info: the calibration that was recorded with the images, the fields of
            ``sensor_msgs/CameraInfo`` as JSON; None if there is none.

    Raises:
        InputError: the bag cannot be read, or has no such images; while iterating: an image is too
            large, has another size or an unknown encoding.
    """

    stamped = True
    time_base = Fraction(1, 10**9)

    def __init__(
        self,
        files: Path | Sequence[Path],
        topic: str,
        *,
        white: int = 0,
        max_pixels: int = MAX_PIXELS,
    ) -> None:
        self._files = (files,) if isinstance(files, Path) else tuple(files)
        self._topic, self._max_pixels = topic, max_pixels
        self._name = f"{name_of(self._files)} {topic}"
        self._white, self._judged = white, bool(white)
        self._lost, self._ended = 0, ""
        self._going_back = 0
        self._left_out: list[str] = []
        with contextlib.ExitStack() as opened:
            self._reader = opened.enter_context(opened_bag(self._files, self._left_out))
            found = {each.name: each for each in image_topics(self._reader)}
            if topic not in found:
                raise InputError(f"{name_of(self._files)} has no images on {topic}")
            self._about = found[topic]
            self._pixel_format = self._about.encoding
            self.frame_id = self._about.frame_id
            self.expected_images = self._about.messages
            rate = self._about.rate
            self.frame_rate = None if rate is None else Fraction(rate).limit_denominator(1001)
            self.rectified = "rect" in topic
            self.clock_ahead_s = self._clock_ahead_s()
            self._start(self._images_of(), self._name)
            size = (self.width, self.height)
            self.camera_info = camera_info_of(self._reader, topic, size)
            for line in missing_parts(self._files, self._reader):
                self.holes = f"{self._files[0].parent}: {line}"
                self.warnings += (self.holes,)
            self._opened = opened.pop_all()

    def close(self) -> None:
        """Close the bag."""
        self._opened.close()

    @property
    def lost(self) -> int:
        """Messages so far that could not be decoded, and those after a damaged place."""
        return self._lost

    @property
    def files(self) -> tuple[Path, ...]:
        """The bag, or its parts."""
        return self._files

    @property
    def damage(self) -> list[str]:
        """One line for each kind of damage."""
        lines = list(self._left_out)
        if self._lost:
            why = f" ({self._ended})" if self._ended else ""
            lines.append(f"{self.name}: {images(self._lost)} could not be read{why}")
        if self._going_back:
            lines.append(f"{self.name}: the stamps go back {self._going_back} times")
        return lines

    def describe(self) -> dict[str, Any]:
        """Describe the topic, as JSON-able values."""
        codec = self._about.kind.rpartition("/")[2]
        said = self._described(name_of(self._files), "bag", codec, topic=self._topic)
        return said | {"camera_info": self.camera_info is not None}

    def fingerprint(self) -> dict[str, Any]:
        """Return the total size of the bag's files in bytes, and a SHA-256 of all of them."""
        sums, size = hashlib.sha256(), 0
        for file in (
            each
            for path in self._files
            for each in (sorted(path.iterdir()) if path.is_dir() else [path])
        ):
            if file.is_file():
                with open_regular(file) as opened:
                    while block := opened.read(1 << 20):
                        sums.update(block)
                        size += len(block)
        return {"bytes": size, "sha256": sums.hexdigest()}

    def _clock_ahead_s(self) -> Fraction | None:
        """Return how far the camera's clock is ahead of the recorder's; None if unknown."""
        with contextlib.closing(self._messages()) as messages:
            first = [
                (_stamp_ns(message), recorded_ns)
                for recorded_ns, message in itertools.islice(messages, _CLOCK_MESSAGES)
                if message is not None
            ]
        self._lost, self._ended = 0, ""
        if not first:
            return None
        if first[0][0] == 0:  # no stamps: the recorder's are used
            return Fraction(0)
        return Fraction(statistics.median(stamp - recorded for stamp, recorded in first)) / 10**9

    def _images_of(self) -> Iterator[Image]:
        shape: tuple[int, ...] | None = None
        by_record, last_ns = False, -1
        for number, (recorded_ns, message) in enumerate(self._messages()):
            if message is None:
                self._lost += 1
                continue
            stamp_ns = _stamp_ns(message)
            if shape is None:
                by_record = stamp_ns == 0
            try:
                grey = self._grey(message)
            except DamagedImageError as error:
                self._lost, self._ended = self._lost + 1, str(error)
                continue
            shape = shape or grey.shape
            if grey.shape != shape:
                raise InputError(
                    f"{self._name}: image {number} is {grey.shape[1]}x"
                    f"{grey.shape[0]} but those before it are {shape[1]}x{shape[0]}"
                )
            time_ns = recorded_ns if by_record else stamp_ns
            self._going_back += time_ns < last_ns
            last_ns = time_ns
            yield Image(number, time_ns, grey, functools.partial(self._colours, message))

    def _messages(self) -> Generator[tuple[int, Any]]:
        """Yield the time at which each message was recorded, and the message or None."""
        wanted = [each for each in self._reader.connections if each.topic == self._topic]
        for part in by_part(self._reader, wanted):
            count = 0
            try:
                for connection, recorded_ns, raw in self._reader.messages(connections=part):
                    count += 1
                    yield recorded_ns, self._deserialized(raw, connection.msgtype)
            except Exception as error:
                if not is_damage(error):
                    raise
                self._ended = words_of(error)
                self._lost += max(sum(each.msgcount for each in part) - count, 1)
            else:  # what is damaged between messages is passed over
                self._lost += max(sum(each.msgcount for each in part) - count, 0)

    def _deserialized(self, raw: bytes, kind: str) -> Any:
        """Return a message, None if it is damaged."""
        try:
            return self._reader.deserialize(raw, kind)
        except Exception as error:
            if not is_damage(error):
                raise
            return None

    def _grey(self, message: Any) -> Grey:
        """Return the grey levels of a message."""
        pixels, conversion = self._pixels(message)
        if conversion is not None:
            pixels = np.asarray(cv2.cvtColor(pixels, conversion), pixels.dtype)
        return self._scaled(pixels, self._name)

    def _colours(self, message: Any) -> NDArray[np.uint8] | None:
        """Return the colours of a message, (height, width, 3) uint8 RGB; None if it is grey."""
        if getattr(message, "encoding", "") in _WITH_CHROMA:
            return self._with_chroma(message)
        pixels, conversion = self._pixels(message)
        if conversion is not None and (to_rgb := _TO_RGB[conversion]) is not None:
            pixels = np.asarray(cv2.cvtColor(pixels, to_rgb), pixels.dtype)
        make = colours_of(pixels)
        return make() if make is not None else None

    def _with_chroma(self, message: Any) -> NDArray[np.uint8] | None:
        """Return the colours of an image whose plane of chroma follows that of luma."""
        height, width, step = message.height, message.width, message.step
        rows = height + height // 2
        data = np.frombuffer(message.data, np.uint8)
        if width % 2 or height % 2 or len(data) < rows * step:
            return None
        planes = np.ascontiguousarray(data[: rows * step].reshape(rows, step)[:, :width])
        return np.asarray(cv2.cvtColor(planes, _WITH_CHROMA[message.encoding]), np.uint8)

    def _pixels(self, message: Any) -> tuple[NDArray[Any], int | None]:
        """Return the pixels of a message, and cv2's conversion to grey; None = they are grey."""
        name = self._name
        if not hasattr(message, "encoding"):
            return decode(bytes(message.data), Path(name), self._max_pixels)[0], None
        if message.encoding not in _ENCODINGS:
            raise InputError(
                f"{name} has images of encoding {message.encoding!r}: convert them to one of "
                f"{', '.join(_ENCODINGS)}"
            )
        width, height = message.width, message.height
        if not 0 < width * height <= self._max_pixels:
            raise InputError(f"{name}: images of {width}x{height} px: see --max-pixels")
        samples, sample_bytes, conversion = _ENCODINGS[message.encoding]
        row_bytes = width * samples * sample_bytes
        data = np.frombuffer(message.data, np.uint8)
        if message.step < row_bytes or len(data) < message.step * height:
            raise DamagedImageError(f"{len(data)} bytes are not an image of {width}x{height} px")
        rows = data[: message.step * height].reshape(height, message.step)
        pixels: NDArray[Any] = np.ascontiguousarray(rows[:, :row_bytes])
        if sample_bytes == 2:
            pixels = pixels.view(">u2" if message.is_bigendian else "<u2").astype(np.uint16)
        if samples > 1:
            pixels = pixels.reshape(height, width, samples)
        return pixels, conversion

    def _scaled(self, pixels: NDArray[Any], name: str) -> Grey:
        """Return grey levels; note whether the first image leaves much of 16 bits unused."""
        if pixels.dtype == np.uint16 and not self._judged:
            self._judge_depth(name, int(pixels.max(initial=0)), 16)
        self._judged = True
        return grey_of(pixels, Path(name), self._white)


def _stamp_ns(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec * 10**9 + stamp.nanosec)
