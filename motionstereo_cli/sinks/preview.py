"""The video to send to somebody: view, charge and depth beside each other."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np

from motionstereo_cli.files.lettering import Label, lettered
from motionstereo_cli.sinks.legend import strip, time_text
from motionstereo_cli.sinks.previews import (
    depth_picture,
    depth_scale,
    grey_picture,
    reference_view,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.sinks import RunContext
    from motionstereo_cli.types import FrameResult, Steering

#: Panels wider than this are made smaller.
_MAX_WIDTH_PX = 640
_GAP_PX = 4
_HEAD_PX = 26
_GROUND = (24, 24, 27)

#: Colours of the heading by status, RGB.
_ARROWS = {"ok": (60, 200, 110), "held": (240, 180, 40)}


def preview_picture(result: FrameResult, stream: RunContext) -> NDArray[np.uint8]:
    """Return view with heading, charge and depth beside each other, with titles and scale, RGB."""
    reference = stream.settings.reference
    view = _small(grey_picture(reference_view(result, stream)))
    panels = [
        with_heading(view, result.steering),
        _small(grey_picture(result.charge)),
        _small(depth_picture(result, stream)),
    ]
    titles = (f"{reference.capitalize()} view, heading", "Charge", "Depth")
    picture = side_by_side(panels, titles)
    text = f"{time_text(result.frame)}   {heading_text(result.steering)}"
    begin = picture.shape[1] - panels[-1].shape[1]
    return np.concatenate(
        [picture, strip(picture.shape[1], depth_scale(stream), text, begin=begin)]
    )


def side_by_side(panels: list[NDArray[np.uint8]], titles: tuple[str, ...]) -> NDArray[np.uint8]:
    """Return RGB images of one height beside each other, below their titles."""
    gap = np.full((len(panels[0]), _GAP_PX, 3), _GROUND, np.uint8)
    row = [part for panel in panels for part in (gap, panel)][1:]
    body = np.concatenate(row, axis=1)
    head = np.full((_HEAD_PX, body.shape[1], 3), _GROUND, np.uint8)
    begins = np.cumsum([0, *(panel.shape[1] + _GAP_PX for panel in panels[:-1])])
    labels = [
        Label(float(x) + 8, _HEAD_PX / 2, title) for x, title in zip(begins, titles, strict=True)
    ]
    return np.concatenate([lettered(head, labels, size_px=13), body])


def with_heading(view: NDArray[np.uint8], steering: Steering) -> NDArray[np.uint8]:
    """Return a view, RGB, with an arrow from below its middle to where the heading points."""
    if steering.steer is None or steering.status not in _ARROWS:
        return view
    height, width = view.shape[:2]
    foot = width // 2, round(0.95 * height)
    tip = round(width * (1 - steering.steer) / 2), round(0.62 * height)
    thick = max(2, round(width / 160))
    picture = view.copy()
    for colour, wider in (((0, 0, 0), 2), (_ARROWS[steering.status], 0)):
        cv2.arrowedLine(picture, foot, tip, colour, thick + wider, cv2.LINE_AA, tipLength=0.15)
    return picture


def heading_text(steering: Steering) -> str:
    """Return a heading in words."""
    if steering.steer is None:
        return steering.status
    side = "left" if steering.steer >= 0 else "right"
    if steering.steer_rad is None:
        amount = f"{abs(steering.steer):.0%} {side}"
    else:
        amount = f"{abs(math.degrees(steering.steer_rad)):.0f}° {side}"
    ahead = "" if steering.depth_m is None else f", {steering.depth_m:.1f} m ahead"
    return f"{steering.status}: {amount}{ahead}"


def _small(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = image.shape[:2]
    if width > _MAX_WIDTH_PX:
        size = _MAX_WIDTH_PX, round(height * _MAX_WIDTH_PX / width)
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return image
