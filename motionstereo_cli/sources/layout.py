"""The views in a decoded image: split, stretch, crop and scale them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from motionstereo_cli.errors import InputError

if TYPE_CHECKING:
    from motionstereo_cli.sources.settings import Box
    from motionstereo_cli.types import Grey


def view_size(width: int, height: int, layout: str, name: str) -> tuple[int, int]:
    """Return width and height in px of each view in images of a size.

    Raises:
        InputError: the images cannot be halved.
    """
    across, along = layout.startswith("side-by-side"), layout.startswith("top-bottom")
    if (across and width % 2) or (along and height % 2):
        what = f"{width} px wide" if across else f"{height} px high"
        raise InputError(f"{name} is {what}: --layout {layout} needs an even number")
    if layout.endswith("-half"):
        return width, height
    return (width // 2 if across else width), (height // 2 if along else height)


def split(image: Grey, layout: str) -> tuple[Grey, ...]:
    """Return the views in an image, (height, width) uint8: one, or left and right (top, bottom).

    Squeezed views are stretched to square pixels again, linearly. Side by side, that doubles the
    disparity in px, which then fits the focal length before squeezing.
    """
    height, width = image.shape[:2]
    if layout.startswith("side-by-side"):
        halves: tuple[Grey, ...] = image[:, : width // 2], image[:, width // 2 :]
    elif layout.startswith("top-bottom"):
        halves = image[: height // 2], image[height // 2 :]
    else:
        return (image,)
    if layout.endswith("-half"):
        return tuple(resized(half, width, height) for half in halves)
    return halves


def turned(view: Grey, clockwise: int, *, mirrored: bool) -> Grey:
    """Return a view, (height, width) uint8, mirrored left to right if asked, and turned clockwise.

    Args:
        view: the view.
        clockwise: by how many degrees, a multiple of 90.
        mirrored: whether it is mirrored before.
    """
    straight = view[:, ::-1] if mirrored else view
    return np.rot90(straight, -clockwise // 90)


def cut(view: Grey, box: Box, width: int, height: int) -> Grey:
    """Return a part of a view, (height, width) uint8, scaled to a size in px; C-contiguous."""
    part = view[box.y : box.y + box.height, box.x : box.x + box.width]
    return np.ascontiguousarray(resized(part, width, height))


def resized(view: Grey, width: int, height: int) -> Grey:
    """Return a view, (height, width) uint8, scaled to a size in px.

    It is scaled by averages to smaller sizes, linearly to larger ones.
    """
    if view.shape[:2] == (height, width):
        return view
    shrinks = width <= view.shape[1] and height <= view.shape[0]
    how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(view, (width, height), interpolation=how), np.uint8)
