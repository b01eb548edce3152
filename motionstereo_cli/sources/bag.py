"""One camera from a ROS bag.

Messages are decoded one at a time, and each camera has a reader of its own, so that both decode
side by side.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.reading import MAX_PIXELS
from motionstereo_cli.files.stills import DamagedImageError, decode, grey_of
from motionstereo_cli.sources.bag_topics import (
    bag_damage,
    camera_info_of,
    image_topics,
    opened_bag,
)
from motionstereo_cli.sources.recording import Image, Recording, images

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.types import Grey

#: Encodings of raw images: bytes per pixel, what cv2 makes grey of them, None where they are.
_ENCODINGS: dict[str, tuple[int, int | None]] = {
    "mono8": (1, None),
    "8UC1": (1, None),
    "mono16": (2, None),
    "16UC1": (2, None),
    "rgb8": (3, cv2.COLOR_RGB2GRAY),
    "bgr8": (3, cv2.COLOR_BGR2GRAY),
    "8UC3": (3, cv2.COLOR_BGR2GRAY),
    "rgba8": (4, cv2.COLOR_RGBA2GRAY),
    "bgra8": (4, cv2.COLOR_BGRA2GRAY),
    # OpenCV names a Bayer pattern by its second row's second and third pixel.
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2GRAY),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2GRAY),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2GRAY),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2GRAY),
    "yuv422": (2, cv2.COLOR_YUV2GRAY_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2GRAY_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2GRAY_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2GRAY_YUY2),
}


class BagRecording(Recording):
    """The images of one topic, in the order in which they were recorded.

    The time of an image is the stamp in its header, in ns; where the first is 0, the time at
    which the message was recorded. A message that cannot be decoded is counted and its number
    left out; where the bag cannot be read on, the images behind it are lost.

    Args:
        path: the bag.
        topic: name of the topic.
        white: level that becomes 255 in images of 16 bits; 0 = 65535.
        max_pixels: largest width times height of an image.

    Attributes:
        camera_info: the calibration that was recorded beside the images, the fields of
            ``sensor_msgs/CameraInfo`` as JSON; None where there is none.

    Raises:
        InputError: the bag cannot be read, or has no such images; while iterating: an image is too
            large, has another size or an unknown encoding.
    """

    stamped = True
    time_base = Fraction(1, 10**9)

    def __init__(
        self, path: Path, topic: str, *, white: int = 0, max_pixels: int = MAX_PIXELS
    ) -> None:
        self._path, self._topic, self._max_pixels = path, topic, max_pixels
        self._white, self._judged = white, bool(white)
        self._lost, self._ended = 0, ""
        self._going_back = 0
        with contextlib.ExitStack() as opened:
            self._reader = opened.enter_context(opened_bag(path))
            found = {each.name: each for each in image_topics(self._reader)}
            if topic not in found:
                raise InputError(f"{path} has no images on {topic}")
            self._about = found[topic]
            self.expected_images = self._about.messages
            rate = self._about.rate
            self.frame_rate = None if rate is None else Fraction(rate).limit_denominator(1001)
            self.camera_info = camera_info_of(self._reader, topic)
            self.rectified = "rect" in topic
            self._start(self._images_of(), f"{path} {topic}")
            self._opened = opened.pop_all()

    def close(self) -> None:
        """Close the bag."""
        self._opened.close()

    @property
    def lost(self) -> int:
        """Messages that could not be decoded so far, and those behind a damaged place."""
        return self._lost

    @property
    def files(self) -> tuple[Path, ...]:
        """The bag."""
        return (self._path,)

    @property
    def damage(self) -> list[str]:
        """One line for each kind of damage."""
        lines = []
        if self._lost:
            why = f" ({self._ended})" if self._ended else ""
            lines.append(f"{self.name}: {images(self._lost)} could not be read{why}")
        if self._going_back:
            lines.append(f"{self.name}: the stamps go back {self._going_back} times")
        return lines

    def describe(self) -> dict[str, Any]:
        """Return what the topic is, as JSON-able values."""
        return {
            "path": str(self._path),
            "topic": self._topic,
            "kind": "bag",
            "codec": self._about.kind.rpartition("/")[2],
            "pixel_format": self._about.encoding,
            "range": "full",
            "rotation_deg": 0,
            "width": self.width,
            "height": self.height,
            "frame_rate": str(self.frame_rate) if self.frame_rate else None,
            "images": self.expected_images,
            "camera_info": self.camera_info is not None,
        }

    def fingerprint(self) -> dict[str, Any]:
        """Return the size of the bag's files in bytes, and their SHA-256, one after another."""
        sums, size = hashlib.sha256(), 0
        files = sorted(self._path.iterdir()) if self._path.is_dir() else [self._path]
        for file in files:
            if file.is_file():
                with file.open("rb") as opened:
                    while block := opened.read(1 << 20):
                        sums.update(block)
                        size += len(block)
        return {"bytes": size, "sha256": sums.hexdigest()}

    def _images_of(self) -> Iterator[Image]:
        shape: tuple[int, ...] | None = None
        by_record, last_ns = False, -1
        for number, (recorded_ns, message) in enumerate(self._messages()):
            if message is None:
                self._lost += 1
                continue
            stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
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
                    f"{self._path} {self._topic}: image {number} is {grey.shape[1]}x"
                    f"{grey.shape[0]} but those before it are {shape[1]}x{shape[0]}"
                )
            time_ns = recorded_ns if by_record else stamp_ns
            self._going_back += time_ns < last_ns
            last_ns = time_ns
            yield Image(number, time_ns, grey)

    def _messages(self) -> Iterator[tuple[int, Any]]:
        """Yield the time at which each message was recorded, and the message or None."""
        from rosbags.highlevel import AnyReaderError

        wanted = [each for each in self._reader.connections if each.topic == self._topic]
        count = 0
        try:
            for connection, recorded_ns, raw in self._reader.messages(connections=wanted):
                count += 1
                try:
                    yield recorded_ns, self._reader.deserialize(raw, connection.msgtype)
                except AnyReaderError:
                    yield recorded_ns, None
        except bag_damage() as error:
            self._ended = str(error).rstrip(".")
            self._lost += max(self._about.messages - count, 1)

    def _grey(self, message: Any) -> Grey:
        """Return the grey levels of a message."""
        name = f"{self._path} {self._topic}"
        if not hasattr(message, "encoding"):
            return self._scaled(decode(bytes(message.data), Path(name), self._max_pixels)[0], name)
        if message.encoding not in _ENCODINGS:
            raise InputError(
                f"{name} has images of encoding {message.encoding!r}: convert them to one of "
                f"{', '.join(_ENCODINGS)}"
            )
        width, height = message.width, message.height
        if not 0 < width * height <= self._max_pixels:
            raise InputError(f"{name}: images of {width}x{height} px: see --max-pixels")
        bytes_per_pixel, conversion = _ENCODINGS[message.encoding]
        data = np.frombuffer(message.data, np.uint8)
        if message.step < width * bytes_per_pixel or len(data) < message.step * height:
            raise DamagedImageError(f"{len(data)} bytes are not an image of {width}x{height} px")
        rows = data[: message.step * height].reshape(height, message.step)
        rows = np.ascontiguousarray(rows[:, : width * bytes_per_pixel])
        if message.encoding in ("mono16", "16UC1"):
            order = ">u2" if message.is_bigendian else "<u2"
            return self._scaled(rows.view(order).astype(np.uint16), name)
        if conversion is None:
            return rows
        pixels: NDArray[np.uint8] = rows
        if bytes_per_pixel > 1:
            pixels = rows.reshape(height, width, bytes_per_pixel)
        return np.asarray(cv2.cvtColor(pixels, conversion), np.uint8)

    def _scaled(self, pixels: NDArray[Any], name: str) -> Grey:
        """Return grey levels; of the first image note whether it leaves much of 16 bits unused."""
        if pixels.dtype == np.uint16 and not self._judged:
            self._judge_depth(name, int(pixels.max(initial=0)), 16)
        self._judged = True
        return grey_of(pixels, Path(name), self._white)
