"""Images encoded as PNG, JPEG, PFM or TIFF."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from zlib_ng import zlib_ng

from motionstereo_cli.compiled.pictures import up_filtered_8, up_filtered_16
from motionstereo_cli.errors import OutputError
from motionstereo_cli.files.atomic import reported
from motionstereo_cli.files.reading import open_regular

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from motionstereo_cli.types import Real


_SUB = cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB

#: Of zlib-ng, whose bytes are the same with all instruction sets of a processor. Only runs of equal
#: bytes are looked for: every second row of depth is nearly like the one above, and the rest of it
#: is noise. ISA-L (isal) is faster, but without SSE4 it gives other bytes.
_PACKED = 1, zlib_ng.DEFLATED, zlib_ng.MAX_WBITS, zlib_ng.DEF_MEM_LEVEL, zlib_ng.Z_RLE


#: Bytes of a PNG file up to the end of its header.
_HEAD_BYTES = 33


def encode_png(image: NDArray[np.uint8] | NDArray[np.uint16]) -> bytes:
    """Return a uint8 or uint16 image, grey or BGR, as a PNG file.

    Each pixel is stored as its difference to the one above (filter Up), and packed in a way that
    takes little time. Colours are packed by OpenCV.

    Raises:
        OutputError: the image cannot be encoded.
    """
    if image.ndim == 3:
        return _encoded(".png", image, cv2.IMWRITE_PNG_COMPRESSION, 1, *_SUB)
    height, width = image.shape
    rows = np.empty((height, image.itemsize * width + 1), np.uint8)
    filtered = up_filtered_8 if image.dtype == np.uint8 else up_filtered_16
    filtered(np.ascontiguousarray(image), rows)
    header = struct.pack(">IIBBBBB", width, height, 8 * image.itemsize, 0, 0, 0, 0)
    packer = zlib_ng.compressobj(*_PACKED)
    content = packer.compress(rows.data) + packer.flush()
    chunks = (b"IHDR", header), (b"IDAT", content), (b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(kind, each) for kind, each in chunks)


def signed(png: bytes, program: bytes) -> bytes:
    """Return a PNG file with a text that says which program wrote it."""
    return png[:_HEAD_BYTES] + _chunk(b"tEXt", b"Software\0" + program) + png[_HEAD_BYTES:]


def remove_signed(path: Path, program: bytes) -> bool:
    """Remove a file if it is a PNG that :func:`signed` made, and return whether it was.

    Raises:
        OutputError: it cannot be read or removed.
    """
    if path.is_symlink() or not path.is_file():
        return False
    text = signed(b"\0" * _HEAD_BYTES, program)[_HEAD_BYTES:]
    with reported(path):
        with open_regular(path) as file:
            ours = file.read(_HEAD_BYTES + len(text))[_HEAD_BYTES:] == text
        if ours:
            path.unlink()
    return ours


def _chunk(kind: bytes, content: bytes) -> bytes:
    check = zlib_ng.crc32(content, zlib_ng.crc32(kind))
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", check)


def encode_jpeg(image: NDArray[np.uint8], quality: int) -> bytes:
    """Return an image, grey or RGB, as a JPEG file.

    Args:
        image: (height, width) or (height, width, 3) uint8.
        quality: 0 to 100.

    Raises:
        OutputError: the image cannot be encoded.
    """
    bgr = image if image.ndim == 2 else image[:, :, ::-1]
    return _encoded(".jpg", bgr, cv2.IMWRITE_JPEG_QUALITY, quality)


def encode_pfm(image: Real) -> bytes:
    """Return a (height, width) float32 image as a PFM file, as Middlebury has it.

    Little-endian, the lowest row first, inf where the image has NaN.

    Raises:
        OutputError: the image cannot be encoded.
    """
    return _encoded(".pfm", np.where(np.isnan(image), np.float32(np.inf), image))


def encode_tiff(image: Real) -> bytes:
    """Return a (height, width) float32 image as a TIFF file, uncompressed: all readers take it.

    Raises:
        OutputError: the image cannot be encoded.
    """
    return _encoded(".tiff", image, cv2.IMWRITE_TIFF_COMPRESSION, 1)


def _encoded(suffix: str, image: NDArray[Any], *how: int) -> bytes:
    done, content = cv2.imencode(suffix, image, how)
    if not done:
        raise OutputError(f"cannot encode an image of {image.shape} as {suffix}: try another size")
    return content.tobytes()
