"""Images, one file per frame: PNG, PFM or TIFF."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from motionstereo_cli.compiled import checked_array
from motionstereo_cli.compiled import pictures as loops
from motionstereo_cli.files.encode import encode_pfm, encode_png, encode_tiff
from motionstereo_cli.sinks.writers import FilesMark, NumberedFiles
from motionstereo_cli.types import FrameImages

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.sinks.sink import RunContext
    from motionstereo_cli.types import Real, Rig

_Pixel = TypeVar("_Pixel", bound=np.generic)

_UINT16_MAX = 65535
#: Units per m of a depth image as TUM RGB-D has it: 65535 of them are 13.1 m.
DEPTH_PER_M = 5000
#: Units per px of a 16-bit disparity image, as in KITTI.
DISPARITY_PER_PX = 256


def depth_png(disparity_px: Real, rig: Rig | None, per_m: int = 1000) -> NDArray[np.uint16]:
    """Return depth in units of 1 / ``per_m`` m; 0 = unknown or over 65535 units.

    The default is mm, as in REP 118.

    Args:
        disparity_px: (height, width) float32, NaN = unknown.
        rig: the camera, which there is where an output needs it.
        per_m: units per metre.

    Returns:
        (height, width) uint16; a known depth that rounds to 0 is 1.
    """
    assert rig is not None
    disparity_px = checked_array(disparity_px, np.float32)
    result = np.empty(disparity_px.shape, np.uint16)
    row = np.empty(disparity_px.shape[1], np.float32)
    units = (per_m, _UINT16_MAX / per_m)
    loops.depth_uint16(disparity_px, rig.doffs, rig.focal_baseline, *units, row, result)
    return result


def disparity_png(disparity_px: Real) -> NDArray[np.uint16]:
    """Return disparity in 1/256 px, as in KITTI; 0 = unknown or over 65535/256 px.

    Args:
        disparity_px: (height, width) float32, NaN = unknown.

    Returns:
        (height, width) uint16; a known disparity that rounds to 0 is 1.
    """
    values = checked_array(disparity_px, np.float32)
    result = np.empty(values.shape, np.uint16)
    loops.to_uint16(values, DISPARITY_PER_PX, _UINT16_MAX / DISPARITY_PER_PX, result)
    return result


def confidence_png(confidence: Real) -> NDArray[np.uint8]:
    """Return confidence in 1/255; 0 = no disparity, a chance below 1/255 is stored as 1.

    Args:
        confidence: (height, width) float32 0..1, NaN = unknown.

    Returns:
        (height, width) uint8.
    """
    return np.nan_to_num(np.maximum(np.rint(confidence * 255), 1)).astype(np.uint8)


def motion_png(motion: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return 255 where something moved and 0 elsewhere, (height, width) uint8."""
    return motion.astype(np.uint8) * np.uint8(255)


def asked_for(image: NDArray[_Pixel] | None) -> NDArray[_Pixel]:
    """Return an image of a frame that is there because an output needs it."""
    assert image is not None
    return image


def known_depth_m(images: FrameImages) -> Real:
    """Return the depth of a frame, which is there because the run has a rig."""
    return asked_for(images.depth_m)


_ENCODE: dict[str, Callable[[Any], bytes]] = {
    ".png": encode_png,
    ".pfm": encode_pfm,
    ".tiff": encode_tiff,
}


class NumberedImages(NumberedFiles):
    """Image files, one per frame.

    Args:
        path: see :class:`~motionstereo_cli.sinks.writers.NumberedFiles`; its suffix is the
            format: uint8 and uint16 images go to .png, float32 ones to .pfm and .tiff.
        stream: the run's context.
        since: continue from this checkpoint.
        image: makes the (height, width) image from the images of a frame.
    """

    def __init__(
        self,
        path: Path,
        stream: RunContext,
        since: FilesMark | None = None,
        *,
        image: Callable[[FrameImages, RunContext], NDArray[Any]],
    ) -> None:
        super().__init__(path, since)
        self._stream = stream
        self._image = image
        self._encode = _ENCODE[path.suffix]

    def write(self, images: FrameImages) -> None:
        """Write the image of a frame."""
        self.add(images.time.index, self._encode(self._image(images, self._stream)))


def _depth_sigma_m(images: FrameImages, stream: RunContext) -> Real:
    """Return the standard deviation of depth in m: of Z = f B / d it is Z^2 / (f B) times d's."""
    assert stream.rig is not None
    per_px = known_depth_m(images) ** 2 / np.float32(stream.rig.focal_baseline)
    return per_px * asked_for(images.sigma_px)


# The sinks by their names in OUTPUTS; each takes the path and the stream.


def _images(image: Callable[[FrameImages, RunContext], NDArray[Any]]) -> partial[NumberedImages]:
    return partial(NumberedImages, image=image)


depth = _images(
    lambda images, stream: depth_png(images.disparity_px, stream.rig, stream.output.depth_scale)
)
rgbd_depth = _images(lambda images, stream: depth_png(images.disparity_px, stream.rig, DEPTH_PER_M))
rgbd_view = _images(
    lambda images, _: images.look[..., ::-1] if images.look.ndim == 3 else images.look
)
depth_m = _images(lambda images, _: known_depth_m(images))
disparity = _images(lambda images, _: disparity_png(images.disparity_px))
disparity_px = _images(lambda images, _: images.disparity_px)
age = _images(lambda images, _: asked_for(images.age_frames))
confidence = _images(lambda images, _: confidence_png(asked_for(images.confidence)))
sigma = _images(lambda images, _: asked_for(images.sigma_px))
depth_sigma = _images(_depth_sigma_m)
occlusion = _images(lambda images, _: asked_for(images.occlusion))
bands = _images(lambda images, _: asked_for(images.bands))
motion = _images(lambda images, _: motion_png(asked_for(images.motion)))
charge = _images(lambda images, _: images.charge)
own_charge = _images(lambda images, _: asked_for(images.own_charge))
