"""The topics of a ROS bag: ROS 1 (.bag), or ROS 2 (.db3, .mcap, or a folder of them).

Bags are read by rosbags, which needs no ROS.
"""

from __future__ import annotations

import contextlib
import glob
import itertools
import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from motionstereo_cli.errors import InputError, SettingsError, is_damage, words_of
from motionstereo_cli.files.bounded import bound_rosbags
from motionstereo_cli.files.reading import MAX_CALIBRATION_BYTES, read_text
from motionstereo_cli.sources.names import natural_key, right_of
from motionstereo_cli.sources.recording import images

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

SUFFIXES = frozenset({".bag", ".db3", ".mcap"})

#: Types of messages with an image, and that with a calibration.
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"


#: Parts of a bag go on after one another within this time.
_MAX_BETWEEN_PARTS_NS = 2 * 10**9


class Topic(NamedTuple):
    """A topic of images.

    Attributes:
        name: its name.
        kind: type of its messages.
        messages: their number.
        encoding: of the first one's pixels.
        width, height: size of the first one in px; 0 for a compressed one.
        rate: mean messages per second; None for a single message.
        frame_id: frame of the first one.
    """

    name: str
    kind: str
    messages: int
    encoding: str
    width: int
    height: int
    rate: float | None
    frame_id: str

    def __str__(self) -> str:
        """Return the topic in words."""
        size = f"{self.width}x{self.height} px, " if self.width else ""
        rate = f", {self.rate:.3g} per second" if self.rate else ""
        return f"{self.name} ({size}{self.encoding}, {images(self.messages)}{rate})"


def bags_in(name: str | Path) -> tuple[Path, ...]:
    """Return the ROS bag of a name, or the parts of a split one; nothing if it is not a bag.

    Parts are in one folder, or have names of one pattern; they are in natural order. A bag of ROS 2
    is a folder with ``metadata.yaml``.
    """
    path = Path(name)
    if path.is_dir() and (path / "metadata.yaml").is_file():
        return (path,)
    found = (
        path.iterdir()
        if path.is_dir()
        else [path]
        if path.exists()
        else map(Path, glob.glob(str(name)))
    )
    files = [each for each in found if not each.name.startswith(".")]
    parts = [each for each in files if each.suffix.lower() in SUFFIXES and each.is_file()]
    if not parts or (len(parts) < len(files) and not path.is_dir()):
        return ()
    return tuple(sorted(parts, key=lambda part: natural_key(part.name)))


def name_of(files: Sequence[Path]) -> str:
    """Return the name of a bag, or of the parts of one, for messages."""
    if len(files) == 1:
        return str(files[0])
    return f"{files[0]} (and {len(files) - 1} more)"


def stereo_topics(files: Sequence[Path], given: str = "") -> tuple[str, str]:
    """Return the topics of the left and the right camera.

    Args:
        files: the bag, or the parts of one that was split.
        given: both, as ``/left/image_raw,/right/image_raw``; if empty, found by name.

    Raises:
        InputError: the bag cannot be read, or there is no pair, or more than one.
        SettingsError: ``given`` is not two topics of images.
    """
    path = name_of(files)
    with opened_bag(files) as reader:
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
    pairs = [(name, right) for name in found if (right := right_of(name)) in found]
    # Rectified images are preferred, then uncompressed ones.
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


def image_topics_of(files: Sequence[Path]) -> list[Topic]:
    """Return the topics of images in a bag, or in the parts of one.

    Raises:
        InputError: the bag cannot be read.
    """
    with opened_bag(files) as reader:
        return image_topics(reader)


@contextlib.contextmanager
def opened_bag(files: Sequence[Path], damage: list[str] | None = None) -> Iterator[AnyReader]:
    """Open a bag, or the parts of one, for reading as one.

    Args:
        files: the bag, or its parts; of these, those that cannot be read are left out.
        damage: takes a line for each part that is left out.

    Raises:
        InputError: nothing can be read, or rosbags is not installed.
    """
    reader: AnyReader | None = None
    files = _storages(files)
    try:
        reader = _open(files)
    except InputError:
        if len(files) == 1:
            raise
        readable = []
        for file in files:
            try:
                _open([file]).close()
                readable.append(file)
            except InputError as error:
                if damage is not None:
                    damage.append(f"{file} is left out: {error}")
        if not readable or len(readable) == len(files):
            raise
        reader = _open(readable)
    try:
        yield reader
    finally:
        reader.close()


#: In metadata.yaml: a file of messages, and that these are compressed one by one.
_STORAGE = re.compile(r"^\s*-\s*[\"']?(?:[^\s\"']*/)?([^\s/\"']+\.(?:db3|mcap))[\"']?\s*$", re.M)
_COMPRESSED = re.compile(r"^\s*compression_mode:\s*[\"']?(message|file)", re.M | re.I)


def _storages(files: Sequence[Path]) -> Sequence[Path]:
    """Return the files of a ROS 2 bag that was split, so that damage in one does not end it all.

    Its folder stays as it is where that is needed to decompress messages.
    """
    if len(files) != 1 or not files[0].is_dir():
        return files
    try:
        metadata = read_text(files[0] / "metadata.yaml", "the metadata", MAX_CALIBRATION_BYTES)
    except InputError:
        return files
    names = dict.fromkeys(_STORAGE.findall(metadata))
    if len(names) < 2 or _COMPRESSED.search(metadata):
        return files
    return [files[0] / name for name in names]


def _open(files: Sequence[Path]) -> AnyReader:
    path = name_of(files)
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise InputError(
            f"{path} is a ROS bag, which needs rosbags: pip install 'motionstereo[ros]'"
        ) from None
    try:
        bound_rosbags()
        reader = AnyReader(list(files), default_typestore=get_typestore(Stores.LATEST))
        reader.open()
    except Exception as error:
        if not is_damage(error):
            raise
        said = words_of(error)
        raise InputError(f"cannot read the bag {path}: {said}: {_mending(files, said)}") from None
    return reader


def _mending(files: Sequence[Path], said: str) -> str:
    """Return what saves the readable part of a bag that is damaged."""
    kinds = {file.suffix.lower() for file in files}
    with contextlib.suppress(OSError):
        kinds |= {each.suffix for file in files if file.is_dir() for each in file.iterdir()}
    if "metadata" in said:
        return "move metadata.yaml elsewhere: the other files in the folder are read without it"
    if "index" in said:
        return "rosbag reindex makes an index"
    if ".mcap" in kinds:
        return "is it whole? `mcap recover IN.mcap -o OUT.mcap` saves what can be read"
    if ".db3" in kinds:
        return "is it whole? `sqlite3 IN.db3 .recover | sqlite3 OUT.db3` saves what can be read"
    return "is it whole?"


def missing_parts(files: Sequence[Path], reader: AnyReader) -> list[str]:
    """Return a line for each place at which parts of a bag seem to be missing.

    Their names tell it, which end in _0, _1, ...; or else a gap in the times of their messages.
    """
    if len(files) < 2:
        return []
    found = [re.fullmatch(r"(.*)_(\d+)", file.stem) for file in files]
    if all(found) and len({each[1] for each in found if each}) == 1:
        numbers = [int(each[2]) for each in found if each]
        lines = []
        if numbers[0] > 0:
            lines.append(f"the parts before {files[0].name} are not there")
        for file, before, after in zip(files[1:], numbers, numbers[1:], strict=False):
            if after > before + 1:
                lines.append(f"{after - before - 1} parts before {file.name} are not there")
        return lines
    parts: list[tuple[Any, Any]] = list(zip(reader.readers, reader.paths, strict=True))
    spans = sorted(
        (part.start_time, part.end_time, path.name) for part, path in parts if part.message_count
    )
    return [
        f"{(begin - end) / 1e9:.1f} s are missing before {name}"
        for (_, end, _), (begin, _, name) in itertools.pairwise(spans)
        if begin - end > _MAX_BETWEEN_PARTS_NS
    ]


def by_part(reader: AnyReader, connections: Sequence[Connection]) -> list[list[Connection]]:
    """Return connections by the part of a bag that has them, where parts follow one another.

    So what is damaged in one does not end the others. All are together where parts overlap.
    """
    found = []
    readers: list[Any] = list(reader.readers)
    for part in readers:
        owners = {id(each.owner) for each in part.connections}
        if own := [each for each in connections if id(each.owner) in owners]:
            found.append((part.start_time, part.end_time, own))
    found.sort(key=lambda part: part[:2])
    if any(begin < end for (_, end, _), (begin, _, _) in itertools.pairwise(found)):
        return [list(connections)]
    return [own for _, _, own in found]


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
                first.header.frame_id.lstrip("/"),
            )
        )
    return found


def _first(reader: AnyReader, connections: Sequence[Connection]) -> Any:
    """Return the first message of some connections, None if none can be read."""
    for part in by_part(reader, connections):
        try:
            for connection, _, raw in reader.messages(connections=part):
                return reader.deserialize(raw, connection.msgtype)
        except Exception as error:
            if not is_damage(error):
                raise
    return None


def camera_info_of(reader: AnyReader, topic: str, size: tuple[int, int]) -> str | None:
    """Return the calibration that belongs to a topic of images, as JSON.

    It is that of the sensor's full images, adapted to the recorded ones if these are a region or
    binned.

    Args:
        reader: the bag.
        topic: name of the topic.
        size: width and height of the images recorded, in px.
    """
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
            stated = {"width": info.width, "height": info.height, **about_lens, **numbers}
            return json.dumps(_as_recorded(stated, info, size))
    return None


def _as_recorded(stated: dict[str, Any], info: Any, size: tuple[int, int]) -> dict[str, Any]:
    """Return a calibration of the sensor's full images for a region of them, with binned pixels.

    A pixel's centre has whole coordinates, so x becomes (x - offset + 0.5) / n - 0.5.
    """
    across, down = max(info.binning_x, 1), max(info.binning_y, 1)
    region = info.roi
    width, height = region.width or info.width, region.height or info.height
    if size == (info.width, info.height) or size != (width // across, height // down):
        return stated
    adapted: dict[str, Any] = {"width": size[0], "height": size[1]}
    for key, columns in (("k", 3), ("p", 4)):
        values = list(stated[key])
        for row, offset, step in ((0, region.x_offset, across), (1, region.y_offset, down)):
            begin = row * columns
            values[begin : begin + columns] = [
                value / step for value in values[begin : begin + columns]
            ]
            values[begin + 2] = (stated[key][begin + 2] - offset + 0.5) / step - 0.5
        adapted[key] = values
    return stated | adapted
