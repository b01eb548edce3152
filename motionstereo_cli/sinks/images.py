"""Depth, disparity, age and confidence as PNG, one file a frame."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from motionstereo_cli.errors import OutputError
from motionstereo_cli.sinks.files import reported, write_whole
from motionstereo_cli.types import FrameResult

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.sinks import Stream
    from motionstereo_cli.types import Real

_UINT16_MAX = 65535
_DEPTH_PER_M = 1000
_DISPARITY_PER_PX = 256


def depth_png(depth_m: Real) -> NDArray[np.uint16]:
    """Return depth in mm as REP 118 has it; 0 = unknown or over 65.535 m.

    Args:
        depth_m: (height, width) float32, NaN = unknown.

    Returns:
        (height, width) uint16; a known depth that rounds to 0 is 1.
    """
    return _to_uint16(depth_m, _DEPTH_PER_M)


def disparity_png(disparity_px: Real) -> NDArray[np.uint16]:
    """Return disparity in 1/256 px as KITTI has it; 0 = unknown or over 65535/256 px.

    Args:
        disparity_px: (height, width) float32, NaN = unknown.

    Returns:
        (height, width) uint16; a known disparity that rounds to 0 is 1.
    """
    return _to_uint16(disparity_px, _DISPARITY_PER_PX)


def confidence_png(confidence: Real) -> NDArray[np.uint8]:
    """Return confidence in 1/255; 0 = no disparity, a chance below 1/255 is stored as 1.

    Args:
        confidence: (height, width) float32 0..1, NaN = unknown.

    Returns:
        (height, width) uint8.
    """
    return np.nan_to_num(np.maximum(np.rint(confidence * 255), 1)).astype(np.uint8)


def _to_uint16(values: Real, per_unit: int) -> NDArray[np.uint16]:
    # NaN is neither above nor below anything, so it is not known.
    known = (values >= 0) & (values <= np.float32(_UINT16_MAX / per_unit))
    scaled = np.rint(np.where(known, values, 0) * np.float32(per_unit))
    return np.where(known, np.maximum(scaled, 1), 0).astype(np.uint16)


def encode_png(image: NDArray[np.uint8] | NDArray[np.uint16]) -> bytes:
    """Return a uint8 or uint16 image, grey or BGR, as a PNG file.

    The fastest compression level: others take longer for a few per cent.

    Raises:
        OutputError: the image cannot be encoded.
    """
    done, png = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise OutputError(f"cannot encode an image of {image.shape} as PNG: try another size")
    return png.tobytes()


class NumberedImages:
    """8-bit or 16-bit PNG files, one a frame, each written whole.

    Args:
        path: where they go; ``{:06d}`` in its name is the number of the frame.
        image: makes the (height, width) uint8 or uint16 image of a result.

    Raises:
        OutputError: the folder cannot be made or a file not written.
    """

    def __init__(
        self, path: Path, image: Callable[[FrameResult], NDArray[np.uint8] | NDArray[np.uint16]]
    ) -> None:
        self._path = path
        self._image = image
        with reported(path.parent):
            path.parent.mkdir(exist_ok=True)

    def write(self, result: FrameResult) -> None:
        """Write the image of a frame."""
        path = self._path.with_name(self._path.name.format(result.frame.index))
        write_whole(path, encode_png(self._image(result)))

    def close(self) -> None:
        """Do nothing: every image is complete."""

    def abandon(self, *, keep: bool) -> None:
        """Do nothing: every image is complete."""


def depth_images(path: Path, _: Stream) -> NumberedImages:
    """Return a sink for depth in mm; the results must have one."""

    def image(result: FrameResult) -> NDArray[np.uint16]:
        assert result.depth_m is not None
        return depth_png(result.depth_m)

    return NumberedImages(path, image)


def disparity_images(path: Path, _: Stream) -> NumberedImages:
    """Return a sink for disparity in 1/256 px."""
    return NumberedImages(path, lambda result: disparity_png(result.disparity_px))


def age_images(path: Path, _: Stream) -> NumberedImages:
    """Return a sink for frames since motion; 255 = forgotten."""
    return NumberedImages(path, lambda result: result.age_frames)


def confidence_images(path: Path, _: Stream) -> NumberedImages:
    """Return a sink for confidence in 1/255; 0 = no disparity."""
    return NumberedImages(path, lambda result: confidence_png(result.confidence))
