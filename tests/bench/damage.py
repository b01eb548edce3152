"""Damaging recordings and calibration files, and what plain decoders see of it."""

from __future__ import annotations

import random
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import av
from PIL import Image

if TYPE_CHECKING:
    from motionstereo_cli.types import Grey


def flipped(content: bytes, chance: random.Random) -> bytes:
    """Return a content with up to 20 bits flipped."""
    spoilt = bytearray(content)
    for _ in range(chance.choice((1, 5, 20))):
        spoilt[chance.randrange(len(spoilt))] ^= 1 << chance.randrange(8)
    return bytes(spoilt)


def cut(content: bytes, chance: random.Random) -> bytes:
    """Return the beginning of a content."""
    return content[: chance.randrange(len(content))]


def zeroed(content: bytes, chance: random.Random) -> bytes:
    """Return a content in which a block is zero."""
    start, size = _block(content, chance)
    return content[:start] + bytes(size) + content[start + size :]


def swapped(content: bytes, chance: random.Random) -> bytes:
    """Return a content with two blocks exchanged."""
    size = min(_block(content, chance)[1], len(content) // 2)
    one = chance.randrange(len(content) - 2 * size + 1)
    other = chance.randrange(one + size, len(content) - size + 1)
    spoilt = bytearray(content)
    spoilt[one : one + size] = content[other : other + size]
    spoilt[other : other + size] = content[one : one + size]
    return bytes(spoilt)


def _block(content: bytes, chance: random.Random) -> tuple[int, int]:
    size = min(chance.choice((16, 512, 4096)), len(content))
    return chance.randrange(len(content) - size + 1), size


#: All kinds of damage by name.
DAMAGES: dict[str, Callable[[bytes, random.Random], bytes]] = {
    "bit flips": flipped,
    "cut": cut,
    "zeroed block": zeroed,
    "swapped blocks": swapped,
}


def encoded(path: Path, images: list[Grey], codec: str, pixel_format: str) -> None:
    """Write images as a video at 30 per second, with a key frame every ten."""
    height, width = images[0].shape
    with av.open(str(path), "w", options={"fflags": "+bitexact"}) as container:
        stream: Any = container.add_stream(codec, rate=30)
        stream.width, stream.height, stream.pix_fmt = width, height, pixel_format
        stream.codec_context.gop_size = 10
        stream.codec_context.thread_count = 1
        for index, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, "gray").reformat(format=pixel_format)
            frame.pts, frame.time_base = index, Fraction(1, 30)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def seen_in_video(path: Path, count: int) -> bool:
    """Return whether FFmpeg sees damage, decoding in one thread: errors, marks, or lost images."""
    av.logging.set_level(None)
    images, clean = 0, True
    try:
        with av.open(str(path), metadata_errors="replace") as container:
            stream = container.streams.video[0]
            if stream.codec_context is None:  # of an unknown kind
                return True
            stream.codec_context.thread_count = 1
            for packet in container.demux(stream):
                try:
                    for frame in packet.decode():
                        images += 1
                        clean &= not frame.is_corrupt
                except av.FFmpegError:
                    clean = False
    except (av.FFmpegError, OSError, LookupError):
        return True
    return images < count or not clean


def seen_in_image(path: Path) -> bool:
    """Return whether Pillow sees damage: it cannot read the image."""
    try:
        with Image.open(path) as image:
            image.load()
    except Exception:  # it raises of many kinds
        return True
    return False
