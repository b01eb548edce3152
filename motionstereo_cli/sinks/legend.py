"""The strip below a picture of depth: its scale and the time."""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING

import numpy as np

from motionstereo_cli.files.lettering import DARK, Label, lettered, text_width
from motionstereo_cli.sinks.sink import EPOCH_S

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.sinks.scale import DepthScale
    from motionstereo_cli.types import FrameTime

#: Minimum height of a strip in px, and the picture's width per px of its height: of a whole strip,
#: and of the last one of several panels.
_MIN_HEIGHT_PX, _WIDTH_PER_PX, _PANEL_PER_PX = 28, 36, 18

#: What the colour of what is unknown is called, and the share of the scale's width it may take.
_UNKNOWN, _UNKNOWN_SHARE = "unknown", 0.3

#: Share of the width that the text has; the scale has the rest.
_TEXT_SHARE = 0.3


def strip(
    width: int, scale: DepthScale, text: str = "", *, begin: int | None = None
) -> NDArray[np.uint8]:
    """Return a strip with a text at its left and the scale of depth at its right.

    Args:
        width: of the strip in px.
        scale: the scale.
        text: such as the time.
        begin: where the scale begins in px; after the text if None.

    Returns:
        (height, width, 3) uint8 RGB; the height is even and follows from the width and ``begin``.
    """
    tall = width / _WIDTH_PER_PX if begin is None else (width - begin) / _PANEL_PER_PX
    begin = round(_TEXT_SHARE * width) if begin is None else begin
    ruler = _ruler(width, scale, begin, max(_MIN_HEIGHT_PX, 2 * round(tall / 2)))
    if not text:
        return ruler
    height, size_px = len(ruler), _letters(len(ruler)) + 1
    label = Label(height // 4, height / 2, text)
    end = min(math.ceil(label.x + text_width(text, size_px)) + size_px, width)
    shown = ruler.copy()
    shown[:, :end] = lettered(np.ascontiguousarray(ruler[:, :end]), [label], size_px=size_px)
    return shown


def time_text(time: FrameTime) -> str:
    """Return the time of a frame in words or, if the source has no times, its number.

    Times since an epoch, as of camera clocks, are shown as time of day.
    """
    if time.time_s is None:
        return f"frame {time.index}"
    if time.time_s <= EPOCH_S:
        return f"{time.time_s:.2f} s"
    minutes, seconds = divmod(round(time.time_s, 2) % 86_400, 60)
    return f"{minutes // 60:02.0f}:{minutes % 60:02.0f}:{seconds:05.2f}"


@functools.lru_cache(maxsize=8)
def _ruler(width: int, scale: DepthScale, begin: int, height: int) -> NDArray[np.uint8]:
    size_px, margin = _letters(height), height // 3
    left, right = begin + margin, max(width - margin, begin + margin + 2)
    image = np.full((height, width, 3), DARK.ground, np.uint8)
    top, bottom = round(0.16 * height), round(0.42 * height)
    labels: list[Label] = []
    box_px = bottom - top
    unknown_px = round(text_width(_UNKNOWN, size_px)) + box_px + 2 * margin
    if unknown_px < _UNKNOWN_SHARE * (width - begin):
        right -= unknown_px
        box = right + margin
        image[top:bottom, box : box + box_px] = scale.unknown
        labels.append(Label(box + box_px + margin / 2, (top + bottom) / 2, _UNKNOWN))
    places = np.linspace(0, 1, right - left)
    ramp = np.array([scale.colour(place) for place in places], np.uint8)
    image[top:bottom, left:right] = ramp[: max(width - left, 0)]
    free_from, first = float(begin), True
    for tick in scale.ticks():
        unit = f" {scale.unit}" if first else ""
        middle = left + scale.place(tick) * (right - left - 1)
        half = text_width(f"{tick:g}{unit}", size_px) / 2
        if middle - half >= free_from and middle + half <= width:
            first = False
            labels.append(Label(middle, 0.74 * height, f"{tick:g}{unit}", "mm"))
            image[bottom : bottom + 2, round(middle)] = 200
            free_from = middle + half + size_px / 2
    return lettered(image, labels, size_px=size_px, colour=(200, 200, 205))


def _letters(height: int) -> int:
    return max(round(0.4 * height), 6)
