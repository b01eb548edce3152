"""Grey levels of decoded video images."""

from __future__ import annotations

from typing import TYPE_CHECKING

import av
import cv2
import numpy as np
from av.video.reformatter import ColorRange

from motionstereo_cli.compiled import pictures as loops

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.types import Grey

#: Differences of red, green and blue up to this are rounding.
_GREY_SPREAD = 6


def is_full_range(frame: av.VideoFrame) -> bool:
    """Return whether luma spans 0..255 rather than 16..235.

    By the stream's flag; without one, YUV is limited range, all else full.
    """
    if frame.color_range in (ColorRange.JPEG, ColorRange.MPEG):
        return frame.color_range == ColorRange.JPEG
    name = frame.format.name
    return frame.format.is_rgb or name.startswith(("gray", "yuvj", "ya", "pal", "mono"))


def bits_of(frame: av.VideoFrame) -> int:
    """Return the number of bits of an image's levels."""
    return max(int(component.bits) for component in frame.format.components)


def brightest(frame: av.VideoFrame) -> int:
    """Return the largest level in an image, in its own bits."""
    return int(_deep(frame).max()) * ((1 << bits_of(frame)) - 1) // 65535


def grey_levels(frame: av.VideoFrame, white: int = 0) -> Grey:
    """Return the grey levels of a decoded frame, (height, width) uint8 0..255.

    An 8-bit luma plane is used directly, expanded if it is limited range. Other YUV is
    converted by FFmpeg's scaler, RGB by BT.601 in full range.

    Args:
        frame: the frame.
        white: level that becomes 255, in the stream's own bits; 0 = the largest.
    """
    if white:
        scale = ((1 << bits_of(frame)) - 1) / (257 * white)
        return np.asarray(cv2.convertScaleAbs(_deep(frame), alpha=scale), np.uint8)
    form, full = frame.format, is_full_range(frame)
    if form.is_rgb or form.has_palette:
        rgb = frame.to_ndarray(format="rgb24")
        return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)
    plane_is_luma = form.is_planar or len(form.components) == 1
    if not (plane_is_luma and form.components[0].is_luma and form.components[0].bits == 8):
        frame = _reformatted(frame, "gray")
        full = True
    plane = frame.planes[0]
    rows = np.frombuffer(memoryview(plane), np.uint8).reshape(
        -1, plane.line_size
    )  # rows are padded
    luma = rows[: frame.height]
    if full:
        return np.ascontiguousarray(luma[:, : frame.width])
    return full_range(luma, frame.width)


def full_range(luma: Grey, width: int) -> Grey:
    """Return grey levels 0..255, 255 / 219 (luma - 16), rounded and limited.

    Args:
        luma: rows of at least that width, uint8; 16..235 is black to white.
        width: of the result in px.
    """
    grey = np.empty((len(luma), width), np.uint8)
    loops.full_range(luma, grey)
    return grey


def colours(frame: av.VideoFrame) -> NDArray[np.uint8]:
    """Return the colours of a decoded frame, (height, width, 3) uint8 RGB."""
    return np.asarray(_reformatted(frame, "rgb24").to_ndarray(), np.uint8)


def has_colour(frame: av.VideoFrame) -> bool:
    """Return whether the colours of a frame are more than grey."""
    form = frame.format
    if len(form.components) < 3 and not form.has_palette:
        return False
    rgb = colours(frame)[::4, ::4].astype(np.int16)
    return bool(np.ptp(rgb, axis=2).max(initial=0) > _GREY_SPREAD)


def _deep(frame: av.VideoFrame) -> np.ndarray[tuple[int, ...], np.dtype[np.uint16]]:
    """Return the luma in full range, 0..65535."""
    return np.asarray(_reformatted(frame, "gray16le").to_ndarray(), np.uint16)


def _reformatted(frame: av.VideoFrame, form: str) -> av.VideoFrame:
    source = ColorRange.JPEG if is_full_range(frame) else ColorRange.MPEG
    # One thread: a pool for each frame costs more than it gains, and breaks after a fork.
    return frame.reformat(
        format=form, src_color_range=source, dst_color_range=ColorRange.JPEG, threads=1
    )
