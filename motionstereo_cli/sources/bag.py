"""One camera from a ROS bag: ROS 1 (.bag), or ROS 2 (.db3, .mcap, or a folder of them).

Read by rosbags, which needs no ROS. Messages are decoded one at a time, and each camera has a
reader of its own, so that both decode side by side.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np

from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.files.reading import MAX_PIXELS
from motionstereo_cli.files.stills import DamagedImageError, decode, grey_of
from motionstereo_cli.sources.recording import Image, Recording, images

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

    from motionstereo_cli.types import Grey

SUFFIXES = frozenset({".bag", ".db3", ".mcap"})

#: Types of messages that hold an image, and that of a calibration.
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"

#: What the left camera is called in the names of topics, and the right one in its place.
_SIDES = (("left", "right"), ("infra1", "infra2"), ("cam0", "cam1"), ("camera0", "camera1"))

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


class Topic(NamedTuple):
    """A topic of images.

    Attributes:
        name: its name.
        kind: type of its messages.
        messages: how many there are.
        encoding: of the first one's pixels.
        width, height: size of the first one in px; 0 for a compressed one.
        rate: messages per second, a mean; None where one message tells none.
    """

    name: str
    kind: str
    messages: int
    encoding: str
    width: int
    height: int
    rate: float | None

    def __str__(self) -> str:
        """Return the topic in words."""
        size = f"{self.width}x{self.height} px, " if self.width else ""
        rate = f", {self.rate:.3g} per second" if self.rate else ""
        return f"{self.name} ({size}{self.encoding}, {images(self.messages)}{rate})"


def is_bag(path: Path) -> bool:
    """Return whether a path is that of a ROS bag."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    return path.suffix.lower() in SUFFIXES and path.is_file()


def stereo_topics(path: Path, given: str = "") -> tuple[str, str]:
    """Return the topics of the left and the right camera.

    Args:
        path: the bag.
        given: both, as ``/left/image_raw,/right/image_raw``; found by name if empty.

    Raises:
        InputError: the bag cannot be read, or there is no pair, or more than one.
        SettingsError: what is given is not two topics of images.
    """
    with _opened(path) as reader:
        found = {topic.name: topic for topic in _topics(reader)}
    listed = "; ".join(map(str, found.values())) or "none"
    if given:
        names = [name.strip() for name in given.split(",")]
        if len(names) != 2 or names[0] == names[1] or not set(names) <= found.keys():
            raise SettingsError(
                f"--topics {given}: give two topics of {path}, left first; its image topics: "
                f"{listed}"
            )
        return names[0], names[1]
    pairs = [(name, right) for name in found if (right := _right_of(name)) in found]
    # Rectified images need no rectification, and raw ones lose nothing by compression.
    for better in ("rect", "raw"):
        if len(pairs) > 1 and any(better in left for left, _ in pairs):
            pairs = [pair for pair in pairs if better in pair[0]]
    if len(pairs) > 1 and len(plain := [p for p in pairs if found[p[0]].kind == _IMAGES[0]]) == 1:
        pairs = plain
    if len(pairs) != 1:
        what = "several pairs of cameras" if pairs else "no pair of a left and a right camera"
        raise InputError(f"{path} has {what}: give --topics LEFT,RIGHT; its image topics: {listed}")
    left, right = pairs[0]
    assert right is not None
    return left, right


def _right_of(name: str) -> str | None:
    for left, right in _SIDES:
        if re.search(rf"(?<![a-z]){left}(?![a-z0-9])", name):
            return re.sub(rf"(?<![a-z]){left}(?![a-z0-9])", right, name)
    return None


class BagRecording(Recording):
    """The images of one topic, in the order in which they were recorded.

    The time of an image is the stamp in its header, in ns; where the first is 0, the time at
    which the message was recorded. A message that cannot be decoded is counted and its number
    left out; where the bag cannot be read on, the images behind it are lost.

    Args:
        path: the bag.
        topic: name of the topic.
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

    def __init__(self, path: Path, topic: str, *, max_pixels: int = MAX_PIXELS) -> None:
        self._path, self._topic, self._max_pixels = path, topic, max_pixels
        self._lost, self._ended = 0, ""
        self._going_back = 0
        with contextlib.ExitStack() as opened:
            self._reader = opened.enter_context(_opened(path))
            found = {each.name: each for each in _topics(self._reader)}
            if topic not in found:
                raise InputError(f"{path} has no images on {topic}")
            self._about = found[topic]
            self.expected_images = self._about.messages
            rate = self._about.rate
            self.frame_rate = None if rate is None else Fraction(rate).limit_denominator(1001)
            self.camera_info = _camera_info(self._reader, topic)
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
        except _damage() as error:
            self._ended = str(error).rstrip(".")
            self._lost += max(self._about.messages - count, 1)

    def _grey(self, message: Any) -> Grey:
        """Return the grey levels of a message."""
        name = f"{self._path} {self._topic}"
        if not hasattr(message, "encoding"):
            return grey_of(decode(bytes(message.data), Path(name), self._max_pixels)[0], Path(name))
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
            return grey_of(rows.view(order).astype(np.uint16), Path(name))
        if conversion is None:
            return rows
        pixels: NDArray[np.uint8] = rows
        if bytes_per_pixel > 1:
            pixels = rows.reshape(height, width, bytes_per_pixel)
        return np.asarray(cv2.cvtColor(pixels, conversion), np.uint8)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[AnyReader]:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise InputError(
            f"{path} is a ROS bag, which needs rosbags: pip install 'motionstereo[ros]'"
        ) from None
    try:
        reader = AnyReader([path], default_typestore=get_typestore(Stores.LATEST))
        reader.open()
    except _damage() as error:
        advice = "rosbag reindex makes an index" if "index" in str(error) else "is it whole?"
        raise InputError(
            f"cannot read the bag {path}: {str(error).rstrip('.')}: {advice}"
        ) from None
    try:
        yield reader
    finally:
        reader.close()


def _damage() -> tuple[type[Exception], ...]:
    """Return what rosbags raises of damaged bags; the databases and codecs below it raise more."""
    import sqlite3
    import struct

    from rosbags.highlevel import AnyReaderError
    from rosbags.rosbag1 import ReaderError as Reader1Error
    from rosbags.rosbag2 import ReaderError as Reader2Error

    known = (AnyReaderError, Reader1Error, Reader2Error, sqlite3.Error, struct.error)
    return (*known, OSError, ValueError, LookupError, EOFError, AssertionError, RuntimeError)


def _topics(reader: AnyReader) -> list[Topic]:
    """Return the topics that hold images, by name."""
    found = []
    for name, about in sorted(reader.topics.items()):
        if about.msgtype not in _IMAGES:
            continue
        first = _first(reader, about.connections)
        if first is None:
            continue
        seconds = (reader.end_time - reader.start_time) / 1e9
        raw = about.msgtype == _IMAGES[0]
        found.append(
            Topic(
                name,
                about.msgtype,
                about.msgcount,
                first.encoding if raw else first.format,
                first.width if raw else 0,
                first.height if raw else 0,
                (about.msgcount - 1) / seconds if about.msgcount > 1 and seconds > 0 else None,
            )
        )
    return found


def _first(reader: AnyReader, connections: Sequence[Connection]) -> Any:
    """Return the first message of some connections, None where there is none to be read."""
    try:
        for connection, _, raw in reader.messages(connections=connections):
            return reader.deserialize(raw, connection.msgtype)
    except _damage():
        pass
    return None


def _camera_info(reader: AnyReader, topic: str) -> str | None:
    """Return the calibration that lies beside a topic of images, as JSON."""
    parts = topic.split("/")
    for length in range(len(parts) - 1, 0, -1):  # /cam/image/compressed: /cam/image, then /cam
        name = "/".join([*parts[:length], "camera_info"])
        about = reader.topics.get(name)
        if about is not None and about.msgtype == _CAMERA_INFO:
            info = _first(reader, about.connections)
            if info is None:
                return None
            # ROS 1 writes the names of these in capitals, ROS 2 does not.
            numbers = {
                key: [float(value) for value in getattr(info, key, getattr(info, key.upper(), ()))]
                for key in "dkrp"
            }
            about_lens = {"distortion_model": info.distortion_model} if any(numbers["d"]) else {}
            return json.dumps({"width": info.width, "height": info.height, **about_lens, **numbers})
    return None
