"""Depth, charge and views of a frame as pictures."""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING

import cv2
import numpy as np

from motionstereo_cli.compiled import checked_array
from motionstereo_cli.compiled.pictures import levels_of
from motionstereo_cli.files.video import table_of
from motionstereo_cli.sinks.scale import FARTHEST, DepthScale, palette

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.sinks.sink import RunContext
    from motionstereo_cli.types import FrameImages, Grey, Real

#: Colour steps per px of disparity, and their maximum number.
_LEVELS_PER_PX = 256
_MAX_LEVELS = 1 << 20


def depth_colours(
    disparity_px: Real, near_px: float, far_px: float = 1.0, colours: str = "turbo"
) -> NDArray[np.uint8]:
    """Return depth in colour, black = unknown; in turbo, red = near and blue = far.

    The scale is the logarithm of the disparity, the same for every frame: equal steps of colour
    are equal ratios of depth, so that far and near both show contrast, and no rig is needed.

    Args:
        disparity_px: (height, width) float32, doffs added if there is one; NaN = unknown.
        near_px: disparity of the nearest colour in px.
        far_px: disparity of the farthest colour in px, above 0; ``near_px`` counts as at least
            twice as much.
        colours: name of an OpenCV colour map.

    Returns:
        (height, width, 3) uint8 RGB.
    """
    scale = DepthScale(max(near_px, 2 * far_px), far_px, None, colours)
    levels, _ = depth_levels(disparity_px, scale)
    return cv2.applyColorMap(levels, palette(colours)).astype(np.uint8, copy=False)


def depth_levels(disparity_px: Real, scale: DepthScale) -> tuple[NDArray[np.uint8], bool]:
    """Return the palette index of each disparity, 0 = unknown, and whether any is known.

    Args:
        disparity_px: (height, width) float32, without doffs; NaN = unknown.
        scale: the scale of the colours.

    Returns:
        (height, width) uint8; True where a disparity is known.
    """
    disparity_px = checked_array(disparity_px, np.float32)
    per_px, table = _level_table(scale)
    levels = np.empty(disparity_px.shape, np.uint8)
    known = levels_of(disparity_px, scale.doffs, per_px, table, levels)
    return levels, bool(known)


@functools.lru_cache(maxsize=8)
def _level_table(scale: DepthScale) -> tuple[float, NDArray[np.uint8]]:
    """Return the number of entries per px, and the level of each disparity from 0 px on."""
    per_px = min(_LEVELS_PER_PX, _MAX_LEVELS / scale.near_px)
    disparity_px = np.arange(math.ceil(scale.near_px * per_px) + 1) / per_px
    nearness = np.log(np.maximum(disparity_px / scale.far_px, 1))
    step = (255 - FARTHEST) / math.log(scale.near_px / scale.far_px)
    return per_px, np.minimum(FARTHEST + nearness * step, 255).astype(np.uint8)


@functools.lru_cache(maxsize=8)
def colour_table(colours: str) -> NDArray[np.uint8]:
    """Return the palette of a colour map as the table of an indexed picture."""
    return table_of(palette(colours))


def depth_scale(stream: RunContext) -> DepthScale:
    """Return the scale of the depth colours of a run."""
    return DepthScale.of(stream.settings, stream.output, stream.rig)


def grey_picture(grey: Grey) -> NDArray[np.uint8]:
    """Return grey levels, (height, width) uint8, as RGB; what is RGB stays as it is."""
    if grey.ndim == 3:
        return grey
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB), np.uint8)


def depth_picture(images: FrameImages, stream: RunContext) -> NDArray[np.uint8]:
    """Return depth in colour, (height, width, 3) uint8 RGB.

    If nothing is known, as at the beginning of a recording, it is the reference view, darkened:
    players show the first picture as a poster, and a black one is of no use.
    """
    if np.isnan(images.disparity_px).all():
        return grey_picture(images.view // np.uint8(3))
    scale = depth_scale(stream)
    return depth_colours(
        images.disparity_px + np.float32(scale.doffs), scale.near_px, scale.far_px, scale.colours
    )
