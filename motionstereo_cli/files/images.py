"""Images encoded as PNG, PFM or TIFF."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from motionstereo_cli.errors import OutputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.types import Real


def encode_png(image: NDArray[np.uint8] | NDArray[np.uint16]) -> bytes:
    """Return a uint8 or uint16 image, grey or BGR, as a PNG file.

    The fastest compression level, and the difference to the left pixel in every row: what takes
    longer saves a few per cent.

    Raises:
        OutputError: the image cannot be encoded.
    """
    how = (cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB)
    return _encoded(".png", image, *how)


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
