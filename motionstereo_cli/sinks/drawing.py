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


def coloured(disparity_px: Real, scale: DepthScale, view: Grey | None = None) -> NDArray[np.uint8]:
    """Return depth in colour, (height, width, 3) uint8 RGB; grey = unknown.

    In turbo red is near, in most others what is bright. The scale is the logarithm of the
    disparity, the same for every frame: equal steps of colour are equal ratios of depth, so that
    far and near both show contrast. For the arguments see :func:`depth_levels`.
    """
    levels = depth_levels(disparity_px, scale, view)
    return cv2.applyColorMap(levels, palette(scale.colours)).astype(np.uint8, copy=False)


def depth_levels(
    disparity_px: Real, scale: DepthScale, view: Grey | None = None
) -> NDArray[np.uint8]:
    """Return which colour of the palette each disparity has; where it is unknown, a grey of it.

    Args:
        disparity_px: (height, width) float32, without doffs; NaN = unknown.
        scale: the scale of the colours.
        view: what shows through where disparity is unknown, (height, width) uint8; one grey if
            None.

    Returns:
        (height, width) uint8.
    """
    disparity_px = checked_array(disparity_px, np.float32)
    if view is None:
        view = np.full(disparity_px.shape, 128, np.uint8)
    per_px, table = _level_table(scale)
    levels = np.empty(disparity_px.shape, np.uint8)
    view = checked_array(view, np.uint8, disparity_px.shape)
    entry = np.empty(disparity_px.shape[1], np.int32)
    levels_of(disparity_px, scale.doffs, per_px, table, view, entry, levels)
    return levels


@functools.lru_cache(maxsize=8)
def _level_table(scale: DepthScale) -> tuple[float, NDArray[np.uint8]]:
    """Return the entries per px, and the level of each disparity from 0 px on and of each grey."""
    per_px = min(_LEVELS_PER_PX, _MAX_LEVELS / scale.near_px)
    disparity_px = np.arange(math.ceil(scale.near_px * per_px) + 1) / per_px
    nearness = np.log(np.maximum(disparity_px / scale.far_px, 1))
    step = (255 - FARTHEST) / math.log(scale.near_px / scale.far_px)
    levels = np.minimum(FARTHEST + nearness * step, 255)
    greys = np.arange(256) * FARTHEST >> 8
    return per_px, np.concatenate([levels, greys]).astype(np.uint8)


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
    """Return depth in colour, the view in grey where it is unknown, (height, width, 3) RGB."""
    return coloured(images.disparity_px, depth_scale(stream), images.view)
