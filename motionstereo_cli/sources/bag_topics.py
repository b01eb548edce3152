"""What is in a ROS bag: ROS 1 (.bag), or ROS 2 (.db3, .mcap, or a folder of them).

Read by rosbags, which needs no ROS.
"""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.sources.recording import images

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

SUFFIXES = frozenset({".bag", ".db3", ".mcap"})

#: Types of messages that hold an image, and that of a calibration.
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"

#: What the left camera is called in the names of topics, and the right one in its place.
_SIDES = (("left", "right"), ("infra1", "infra2"), ("cam0", "cam1"), ("camera0", "camera1"))


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
    with opened_bag(path) as reader:
        found = {topic.name: topic for topic in image_topics(reader)}
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


@contextlib.contextmanager
def opened_bag(path: Path) -> Iterator[AnyReader]:
    """Open a bag for reading.

    Raises:
        InputError: it cannot be read, or rosbags is not installed.
    """
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
    except bag_damage() as error:
        advice = "rosbag reindex makes an index" if "index" in str(error) else "is it whole?"
        raise InputError(
            f"cannot read the bag {path}: {str(error).rstrip('.')}: {advice}"
        ) from None
    try:
        yield reader
    finally:
        reader.close()


def bag_damage() -> tuple[type[Exception], ...]:
    """Return what rosbags raises of damaged bags; the databases and codecs below it raise more."""
    import sqlite3
    import struct

    from rosbags.highlevel import AnyReaderError
    from rosbags.rosbag1 import ReaderError as Reader1Error
    from rosbags.rosbag2 import ReaderError as Reader2Error

    known = (AnyReaderError, Reader1Error, Reader2Error, sqlite3.Error, struct.error)
    return (*known, OSError, ValueError, LookupError, EOFError, AssertionError, RuntimeError)


def image_topics(reader: AnyReader) -> list[Topic]:
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
    except bag_damage():
        pass
    return None


def camera_info_of(reader: AnyReader, topic: str) -> str | None:
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
