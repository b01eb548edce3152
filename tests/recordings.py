"""Recordings for the tests of sources: whole, remuxed and damaged."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from numpy.typing import NDArray

Images = list[NDArray[np.uint8]]
LIMITED = 1
FULL = 2
COUNT = 12


def scene(width: int = 64, height: int = 48, count: int = COUNT) -> Images:
    """Images with all grey levels, whose upper left corner tells their number."""
    ramp = np.broadcast_to(np.linspace(0, 255, width).astype(np.uint8), (height, width))
    images = [ramp.copy() for _ in range(count)]
    for number, image in enumerate(images):
        image[:16, :16] = 20 * (number % 13)
    return images


def number_in(grey: NDArray[np.uint8]) -> int:
    return round(float(grey[2:14, 2:14].mean()) / 20)


def encode(
    path: Path,
    images: Images,
    codec: str,
    pixel_format: str,
    color_range: int = 0,
    *,
    options: dict[str, str] | None = None,
    pts: list[int] | None = None,
    degrees: int = 0,
    rgb: bool = False,
) -> Path:
    """Encode images at 30 per second; the range is left untagged where 0."""
    height, width = images[0].shape[:2]
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream(codec, rate=30)
        stream.width, stream.height, stream.pix_fmt = width, height, pixel_format
        stream.options = options or {}
        stream.codec_context.color_range = color_range
        if degrees:
            stream.set_display_rotation(degrees)
        for index, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, "rgb24" if rgb else "gray")
            if frame.format.name != pixel_format:
                frame = frame.reformat(
                    format=pixel_format,
                    src_color_range=FULL,
                    dst_color_range=color_range or LIMITED,
                )
            frame.pts = pts[index] if pts else index
            frame.time_base = Fraction(1, 30)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def folder(path: Path, images: Images, suffix: str, name: str = "frame{}") -> Path:
    path.mkdir()
    for index, image in enumerate(images):
        assert cv2.imwrite(str(path / f"{name.format(index)}{suffix}"), image)
    return path


def remux(source: Path, target: Path, change: Callable[[int, bytes], bytes | None]) -> Path:
    """Copy a video packet by packet: changed, or left out where ``change`` returns None."""
    with (
        av.open(str(source)) as old,
        av.open(str(target), "w", options={"movflags": "faststart"}) as new,
    ):
        stream = new.add_stream_from_template(old.streams.video[0])
        packets = (packet for packet in old.demux(video=0) if packet.size)
        for index, packet in enumerate(packets):
            content = change(index, bytes(packet))
            if content is not None:
                copy = av.Packet(content)
                copy.pts, copy.dts, copy.time_base = packet.pts, packet.dts, packet.time_base
                copy.duration, copy.is_keyframe = packet.duration, packet.is_keyframe
                copy.stream = stream
                new.mux(copy)
    return target


def cut(source: Path, target: Path, share: float) -> Path:
    content = source.read_bytes()
    target.write_bytes(content[: int(len(content) * share)])
    return target
