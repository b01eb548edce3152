"""ZED's SVO2 recordings: both views side by side, coded, as messages of an MCAP file.

A message of H.264 or H.265 holds two uint32 (bytes that follow; bytes of the stream), the stream
(Annex B), and a footer with the time in ns. One of JPEG holds two uint32, the sizes of its strips
as uint64, and the strips: grey images that, one below the other, are the YUYV samples of both
views.
"""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import functools
import itertools
import json
import re
import struct
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO

import av
import numpy as np

from motionstereo_cli.errors import InputError, is_damage, words_of
from motionstereo_cli.files.bounded import bound_rosbags
from motionstereo_cli.files.reading import MAX_PIXELS, HeldFile, open_regular
from motionstereo_cli.files.stills import DamagedImageError, Stated, decode
from motionstereo_cli.sources.luma import colours, grey_levels, has_colour
from motionstereo_cli.sources.names import MAX_STAMP
from motionstereo_cli.sources.recording import Image, Recording, images

#: The topic of the header, and the limit of plausible images per second.
_HEADER, _FASTEST = "svo_header", 1000

_TOPIC = re.compile(r"Camera_SN(\d+)/side_by_side")

#: Offset of the time in ns in the footer of a stream, and the footer's minimum length.
_TIME_AT = 24

#: First bytes of a strip of JPEG, and the maximum number of strips.
_JPEG, _MOST_STRIPS = b"\xff\xd8", 32

#: Maximum size of a record, in bytes.
_MOST_BYTES = 1 << 28

#: First bytes of streams: kinds of units in H.265 (parameter sets) and H.264 (parameter sets,
#: delimiter) with which an independent image can begin.
_HEVC_BEGINS, _H264_BEGINS = range(32, 36), (7, 8, 9)


class SvoRecording(Recording):
    """The images of a ZED's SVO2 recording, each with both views side by side.

    A recording that was cut off is read up to the cut. Times are those of the camera, in ns. It has
    no calibration, but the camera's serial number, which is the name of the file that has it.

    Args:
        path: the recording.
        max_pixels: largest width times height of an image.

    Raises:
        InputError: it is not such a recording, none of its images can be decoded, or mcap is not
            installed; while iterating: an image is too large.
    """

    stamped = True
    time_base = Fraction(1, 10**9)
    stated = Stated("side-by-side", swapped=False)

    def __init__(self, path: Path, *, max_pixels: int = MAX_PIXELS) -> None:
        self._path, self._max_pixels = path, max_pixels
        self._lost = self._flawed = 0
        self._ended = self._serial = self._codec = self._pixel_format = ""
        with contextlib.ExitStack() as opened:
            try:
                self._held = HeldFile(path)
                opened.callback(self._held.close)
                file = opened.enter_context(open_regular(path))
            except OSError as error:
                raise InputError(f"cannot read {path}: {error.strerror}") from error
            self.expected_images, self.frame_rate = self._counted(file)
            self._start(self._read(file), path)
            self._opened = opened.pop_all()
        self.calibration_note = (
            f"{path} is of the ZED with the serial number {self._serial}: its calibration is "
            f"SN{self._serial}.conf, which ZED's programs keep in /usr/local/zed/settings: give "
            "that to --rig"
        )

    @property
    def lost(self) -> int:
        """Images that could not be decoded so far."""
        return self._lost

    @property
    def flawed(self) -> int:
        """Images decoded with errors so far."""
        return self._flawed

    @property
    def damage(self) -> list[str]:
        """One line for each kind of damage."""
        found = {
            "could not be decoded": self._lost,
            "decoded with errors, or after errors and before a key frame": self._flawed,
        }
        lines = [f"{self._path}: {images(count)} {what}" for what, count in found.items() if count]
        if self._ended:
            lines.append(f"{self._path}: reading stopped early: {self._ended}")
        if self._held.changed:
            lines.append(f"{self._path} was written to while the run went on")
        return lines

    def describe(self) -> dict[str, Any]:
        """Describe the recording, as JSON-able values."""
        said = self._described(self._path, "svo2", self._codec, levels="limited")
        return said | {"serial_number": self._serial}

    @property
    def files(self) -> tuple[Path, ...]:
        """The file."""
        return (self._path,)

    def fingerprint(self) -> dict[str, Any]:
        """Return the size of the file in bytes, and its SHA-256."""
        return {"bytes": self._held.size_bytes, "sha256": self._held.sha256()}

    def close(self) -> None:
        """Close the file."""
        self._opened.close()

    def _counted(self, file: BinaryIO) -> tuple[int | None, Fraction | None]:
        """Return the number of images and the mean rate in the summary; None if it is cut off."""
        try:
            from mcap.reader import make_reader
        except ImportError:
            raise InputError(
                f"{self._path} is an SVO2, which needs mcap: pip install 'motionstereo[ros]'"
            ) from None
        try:
            summary = make_reader(file).get_summary()
        except Exception as error:
            if not is_damage(error):
                raise
            return None, None
        if summary is None or summary.statistics is None:
            return None, None
        told = summary.statistics
        counts = [
            told.channel_message_counts.get(key, 0)
            for key, channel in summary.channels.items()
            if _TOPIC.fullmatch(channel.topic)
        ]
        span_ns = told.message_end_time - told.message_start_time
        if not counts or counts[0] < 2 or span_ns <= 0:
            return counts[0] if counts else None, None
        # All topics together begin and end near the first and the last image.
        rate = Fraction((counts[0] - 1) * 10**9, span_ns)
        return counts[0], rate.limit_denominator(1001)

    def _messages(self, file: BinaryIO) -> Iterator[tuple[int, bytes]]:
        """Yield time and content of the messages with images, as far as the file can be read."""
        from mcap.exceptions import EndOfFile
        from mcap.records import Channel, DataEnd, Message

        wanted: int | None = None
        header: int | None = None
        file.seek(0)
        try:
            for part in _records_in(file):
                if isinstance(part, DataEnd):
                    return
                if isinstance(part, Channel):
                    found = _TOPIC.fullmatch(part.topic)
                    if found and self._serial in ("", found[1]):
                        wanted, self._serial = part.id, found[1]
                    elif part.topic == _HEADER:
                        header = part.id
                elif isinstance(part, Message) and part.channel_id == header:
                    self.frame_rate = self.frame_rate or _rate_in(part.data)
                elif isinstance(part, Message) and part.channel_id == wanted:
                    yield part.log_time, part.data
        except EndOfFile:
            pass
        except Exception as error:
            if not is_damage(error):
                raise
            if file.tell() < self._held.size_bytes:
                self._ended = words_of(error)
                return
        self._ended = "it is cut off"

    def _read(self, file: BinaryIO) -> Iterator[Image]:
        decoder: Any = None
        numbers: dict[int, int] = {}
        torn = False
        shape: tuple[int, ...] | None = None

        def made(frame: av.VideoFrame, number: int, time_ns: int) -> Image | None:
            nonlocal shape
            grey = grey_levels(frame)
            if shape is None:
                shape, self._pixel_format = grey.shape, frame.format.name
                self._coloured = has_colour(frame)
            if grey.shape != shape:
                self._lost += 1
                return None
            colour = functools.partial(colours, frame) if self._coloured else None
            return Image(number, time_ns, grey, colour)

        def decoded(packet: av.Packet[Any] | None) -> Iterator[Image]:
            nonlocal torn
            for frame in decoder.decode(packet):
                torn = torn and not frame.key_frame
                image = made(frame, numbers.pop(frame.pts, 0), frame.pts)
                if image is not None:
                    self._flawed += torn or frame.is_corrupt
                    torn = torn or frame.is_corrupt
                    yield image

        for number, (recorded_ns, content) in enumerate(self._messages(file)):
            try:
                strips = _strips_of(content)
                if strips:
                    _check_time(recorded_ns)
                    self._codec = "jpeg"
                    image = made(self._of_strips(strips), number, recorded_ns)
                    if image is not None:
                        yield image
                    continue
                stream, time_ns = _stream_of(content, recorded_ns)
                decoder = decoder or self._decoder(stream)
                if decoder is None:  # it begins between key frames
                    self._lost += 1
                    continue
                _check_time(time_ns)
                packet = av.Packet(stream)
                packet.pts = packet.dts = time_ns
                numbers[time_ns] = number
                yield from decoded(packet)
            except Exception as error:
                if not is_damage(error):
                    raise
                self._lost, torn = self._lost + 1, True
        if decoder is not None:
            with contextlib.suppress(av.FFmpegError):
                yield from decoded(None)

    def _decoder(self, stream: bytes) -> Any:
        self._codec = _codec_of(stream)
        if not self._codec:
            return None
        decoder = av.CodecContext.create(self._codec, "r")
        decoder.thread_count = 1
        decoder.options = {"max_pixels": str(2 * self._max_pixels)}  # coded images have a margin
        return decoder

    def _of_strips(self, strips: list[bytes]) -> av.VideoFrame:
        """Return an image from its strips."""
        parts = [decode(strip, self._path, 4 * self._max_pixels)[0] for strip in strips]
        if any(part.ndim != 2 or part.shape[1] != parts[0].shape[1] for part in parts):
            raise DamagedImageError("its strips do not fit")
        samples = np.vstack(parts)
        if samples.shape[1] % 4 or samples.size // 2 > self._max_pixels:
            raise DamagedImageError("its strips do not make two views")
        return av.VideoFrame.from_ndarray(samples.reshape(len(samples), -1, 2), "yuyv422")


def _rate_in(header: bytes) -> Fraction | None:
    """Return the images per second in a header: the fourth uint32 of its values."""
    try:
        values = struct.unpack_from("<4I", base64.b64decode(json.loads(header)["header"]))
    except Exception as error:
        if not is_damage(error):
            raise
        return None
    return Fraction(values[3]) if 0 < values[3] <= _FASTEST else None


def _records_in(file: BinaryIO) -> Iterator[Any]:
    """Yield the records of an MCAP, and those in its chunks, as far as it can be read.

    mcap's own readers need the summary, and lose all if the end is missing.
    """
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader, breakup_chunk

    for record in StreamReader(file, emit_chunks=True, record_size_limit=_MOST_BYTES).records:
        if isinstance(record, Chunk):
            yield from breakup_chunk(_plain(record))
        else:
            yield record


def _plain(chunk: Any) -> Any:
    """Return a chunk of an MCAP decompressed, with a cap, which mcap does not have."""
    if not chunk.compression:
        return chunk
    try:
        from rosbags.rosbag2.storage_mcap import DECOMPRESSORS
    except ImportError:
        raise ValueError("it is compressed, which needs rosbags") from None
    bound_rosbags()
    content = DECOMPRESSORS[chunk.compression](chunk.data, chunk.uncompressed_size)
    return dataclasses.replace(chunk, compression="", data=content)


def _strips_of(content: bytes) -> list[bytes]:
    """Return the JPEG images of a message, nothing if it is a stream."""
    for count in range(1, _MOST_STRIPS + 1):
        at = 8 + 8 * count
        if content[at : at + 2] != _JPEG:
            continue
        sizes = struct.unpack_from(f"<{count}Q", content, 8)
        if sum(sizes) == len(content) - at:
            ends = np.cumsum([at, *sizes]).tolist()
            return [content[a:b] for a, b in itertools.pairwise(ends)]
    return []


def _check_time(time_ns: int) -> None:
    if not 0 <= time_ns <= MAX_STAMP:
        raise DamagedImageError("its time is out of range")


def _stream_of(content: bytes, recorded_ns: int) -> tuple[bytes, int]:
    """Return the coded image of a message, and its time in ns."""
    following, size = struct.unpack_from("<II", content)
    if following + 4 != len(content) or size + 8 > len(content):
        raise DamagedImageError("its message is not one of SVO2")
    footer = content[8 + size :]
    time_ns = recorded_ns
    if len(footer) >= _TIME_AT + 8:
        time_ns = int(struct.unpack_from("<Q", footer, _TIME_AT)[0]) or recorded_ns
    return content[8 : 8 + size], time_ns


def _codec_of(stream: bytes) -> str:
    """Return FFmpeg's name for the codec of a stream that begins with a key frame, else ''."""
    at = stream.find(b"\0\0\1") + 3
    if at < 3 or at + 1 >= len(stream):
        return ""
    if stream[at] >> 1 & 63 in _HEVC_BEGINS and stream[at + 1] & 7:
        return "hevc"
    return "h264" if stream[at] & 31 in _H264_BEGINS else ""
