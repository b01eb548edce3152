"""Recordings of cameras with two lenses for the tests: SVO2, and boxes of MP4."""

from __future__ import annotations

import base64
import json
import struct
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from mcap.writer import CompressionType, Writer
from recordings import Images

SERIAL = 40735594
FPS = 30
BEGIN_NS = 5_145_757_361_000


def svo2(path: Path, images: Images, codec: str = "h264", compression: str = "none") -> Path:
    """Write images, (height, width) uint8 luma of both views side by side, as a ZED would."""
    height, width = images[0].shape
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1, compression=CompressionType[compression.upper()])
        writer.start(profile="", library="libmcap stereolabs")
        schema = writer.register_schema("sl_type", "jsonschema", b"{}")
        header, footer = (
            writer.register_channel(name, "json", schema) for name in ("svo_header", "svo_footer")
        )
        views = writer.register_channel(
            f"Camera_SN{SERIAL}/side_by_side", "zed_sdk_encoded", schema
        )
        head = struct.pack("<4I", width // 2, height, SERIAL, FPS).ljust(128, b"\0")
        text = json.dumps({"header": base64.b64encode(head).decode(), "version": "2.0.5"})
        writer.add_message(header, BEGIN_NS, text.encode(), BEGIN_NS)
        messages = _strips(images) if codec == "jpeg" else _stream(images, codec)
        for number, content in enumerate(messages):
            writer.add_message(views, stamp_ns(number), content, stamp_ns(number))
        writer.add_message(footer, stamp_ns(len(images)), b"{}", stamp_ns(len(images)))
        writer.finish()
    return path


def stamp_ns(number: int) -> int:
    return BEGIN_NS + number * 10**9 // FPS


def _strips(images: Images) -> list[bytes]:
    made = []
    for number, image in enumerate(images):
        samples = np.full((*image.shape, 2), 128, np.uint8)
        samples[..., 0] = image
        parts = [
            cv2.imencode(".jpg", part, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
            for part in np.split(samples.reshape(len(image), -1), 4)
        ]
        head = struct.pack("<2I4Q", number, number + 1, *map(len, parts))
        made.append(head + b"".join(parts))
    return made


def _stream(images: Images, codec: str) -> list[bytes]:
    height, width = images[0].shape
    coder: Any = av.CodecContext.create({"h264": "libx264", "h265": "libx265"}[codec], "w")
    coder.width, coder.height, coder.pix_fmt = width, height, "yuv420p"
    coder.time_base, coder.framerate = Fraction(1, FPS), Fraction(FPS)
    coder.gop_size, coder.max_b_frames = 4, 0
    coder.options = {"tune": "zerolatency", "crf": "1", "x265-params": "log-level=none"}
    packets = []
    for number, image in enumerate(images):
        planes = np.full((height * 3 // 2, width), 128, np.uint8)
        planes[:height] = image
        frame = av.VideoFrame.from_ndarray(planes, "yuv420p")
        frame.pts, frame.time_base = number, Fraction(1, FPS)
        packets += coder.encode(frame)
    packets += coder.encode(None)
    made = []
    for packet in packets:
        content = bytes(packet)
        footer = bytearray(56)
        struct.pack_into("<Q", footer, 24, stamp_ns(packet.pts))
        head = struct.pack("<2I", 4 + len(content) + len(footer), len(content))
        made.append(head + content + bytes(footer))
    return made


#: The boxes around the description of a video track, and the bytes before its own boxes.
_AROUND = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd", b"avc1")
_BEFORE = {b"stsd": 8, b"avc1": 78}


def box(kind: bytes, content: bytes = b"") -> bytes:
    return struct.pack(">I", 8 + len(content)) + kind + content


def with_boxes(path: Path, boxes: bytes) -> Path:
    """Append boxes to the description of the H.264 track of an MP4 whose index is at its end."""
    content = bytearray(path.read_bytes())
    begin, end = 0, len(content)
    for kind in _AROUND:
        while content[begin + 4 : begin + 8] != kind:
            begin += int.from_bytes(content[begin : begin + 4])
        size = int.from_bytes(content[begin : begin + 4])
        content[begin : begin + 4] = (size + len(boxes)).to_bytes(4)
        end = begin + size
        begin += 8 + _BEFORE.get(kind, 0)
    content[end:end] = boxes
    path.write_bytes(content)
    return path


def vr180(degrees: int = 180) -> bytes:
    """Boxes of two equirectangular views side by side, each spanning an angle across."""
    edge = int((1 - degrees / 360) / 2 * 2**32)
    equirectangular = box(b"equi", struct.pack(">5I", 0, 0, 0, edge, edge))
    head = box(b"svhd", bytes(4) + b"test\0")
    projection = box(b"proj", box(b"prhd", bytes(16)) + equirectangular)
    return box(b"st3d", bytes(4) + b"\2") + box(b"sv3d", head + projection)
