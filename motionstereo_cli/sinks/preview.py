"""The preview: view, charge and depth side by side."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np

from motionstereo_cli.files.lettering import (
    DARK,
    GAP_PX,
    Label,
    fitted,
    lettered,
    text_width,
    titled,
)
from motionstereo_cli.files.records import restored
from motionstereo_cli.robot.mapper import Mapper, Surroundings
from motionstereo_cli.sinks.drawing import depth_picture, depth_scale, grey_picture
from motionstereo_cli.sinks.legend import strip, time_text
from motionstereo_cli.sinks.map import map_panel
from motionstereo_cli.sinks.videos import ResultMark, ResultVideo

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from motionstereo_cli.sinks.sink import RunContext
    from motionstereo_cli.types import MovingObject, Steering, Step

#: Checkpoint of a preview: that of its video, and the map so far.
_Mark = tuple[ResultMark, Surroundings | None]

#: Titles grow with the panels: width of a panel per height of its letters.
_PX_PER_LETTER = 32

#: Colours of boxes by time to contact in s, RGB.
_URGENT = ((2, (255, 95, 95)), (5, (255, 190, 70)), (math.inf, (110, 215, 255)))

#: Colours of the heading by status, RGB.
_ARROWS = {"ok": (60, 200, 110), "held": (240, 180, 40)}


def preview_picture(
    step: Step, stream: RunContext, mapper: Mapper | None = None
) -> NDArray[np.uint8]:
    """Return view with heading, charge and depth side by side, with titles and scale, RGB.

    Beside them is the map so far, if there is one.
    """
    images = step.images
    assert images is not None
    view = fitted(grey_picture(images.look))
    view = with_movers(view, step.objects, view.shape[1] / images.look.shape[1])
    panels = [
        with_heading(view, step.steering),
        fitted(grey_picture(images.charge)),
        fitted(depth_picture(images, stream)),
    ]
    depth = depth_scale(stream).quantity.capitalize()
    titles = [f"{stream.settings.reference.capitalize()} view, heading", "Charge", depth]
    if mapper is not None:
        panels.append(map_panel(mapper, len(view)))
        titles.append("Map from above, path blue")
    return framed(panels, titles, step, stream)


def framed(
    panels: Sequence[NDArray[np.uint8]],
    titles: Sequence[str],
    step: Step,
    stream: RunContext,
) -> NDArray[np.uint8]:
    """Return view, charge, depth and further panels side by side, RGB.

    Each has a title above; time and heading are below, and the scale is below depth.
    """
    size_px = max(DARK.size_px, panels[0].shape[1] // _PX_PER_LETTER)
    picture = titled(panels, titles, DARK._replace(size_px=size_px))
    widths = [panel.shape[1] + GAP_PX for panel in panels]
    begin, end = sum(widths[:2]), sum(widths[:3]) - GAP_PX
    text = f"{time_text(step.time)}   {heading_text(step.steering)}"
    below = strip(end, depth_scale(stream), text, begin=begin)
    rest = np.full((len(below), picture.shape[1] - end, 3), DARK.ground, np.uint8)
    return np.concatenate([picture, np.concatenate([below, rest], axis=1)])


def with_movers(
    view: NDArray[np.uint8], objects: Sequence[MovingObject], scale: float
) -> NDArray[np.uint8]:
    """Return a view, RGB, with a box around each object that moves by itself, or may do so.

    Shadows have none. Above it are its id, its speed over ground and its time to contact, as far as
    they are known.

    Args:
        view: (height, width, 3) uint8.
        objects: with boxes in px of the view before it was made smaller.
        scale: how many times smaller it is.
    """
    shown = [each for each in objects if each.by_itself is not False and not each.shadow]
    if not shown:
        return view
    picture, labels = view.copy(), []
    height, width = view.shape[:2]
    size_px = max(10, round(width / 45))
    for each in shown:
        left, top = round(each.x * scale), round(each.y * scale)
        right, bottom = (
            round((each.x + each.width) * scale) - 1,
            round((each.y + each.height) * scale) - 1,
        )
        colour = _colour(each.time_to_contact_s)
        cv2.rectangle(picture, (left, top), (right, bottom), colour, max(2, width // 240))
        text = mover_text(each)
        wide = round(text_width(text, size_px)) + 4
        left = max(min(left, width - wide), 0)
        foot = top if top >= size_px + 2 else min(bottom + size_px + 3, height - 1)
        cv2.rectangle(picture, (left, foot - size_px - 2), (left + wide, foot), colour, -1)
        labels.append(Label(left + 2, foot - size_px / 2 - 1, text))
    return lettered(picture, labels, size_px=size_px, colour=(0, 0, 0))


def mover_text(each: MovingObject) -> str:
    """Return id, speed over ground and time to contact of an object in words."""
    words = [f"{each.id}"]
    if each.over_ground_mps is not None:
        words.append(f"{each.over_ground_mps:.1f} m/s")
    if each.time_to_contact_s is not None:
        words.append(f"{each.time_to_contact_s:.1f} s")
    return "  ".join(words)


def _colour(contact_s: float | None) -> tuple[int, int, int]:
    """Return the colour of a time to contact, RGB."""
    return next(colour for limit_s, colour in _URGENT if (contact_s or math.inf) <= limit_s)


def with_heading(view: NDArray[np.uint8], steering: Steering) -> NDArray[np.uint8]:
    """Return a view, RGB, with an arrow from the bottom centre toward the heading."""
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
        return f"{steering.status}: no heading"
    side = "left" if steering.steer >= 0 else "right"
    if steering.steer_rad is None:
        amount = f"{abs(steering.steer):.0%} {side}"
    else:
        amount = f"{abs(math.degrees(steering.steer_rad)):.0f}° {side}"
    ahead = "" if steering.depth_m is None else f", {steering.depth_m:.1f} m ahead"
    return f"{steering.status}: {amount}{ahead}"


class Preview:
    """The preview, with the map so far in a run that makes one.

    Args:
        path, stream: as of :class:`ResultVideo`.
        since: continue from this checkpoint: that of the video, and the map so far.
    """

    def __init__(self, path: Path, stream: RunContext, since: _Mark | None = None) -> None:
        video, known = restored(since, _Mark) if since else (None, None)
        self._mapper: Mapper | None = None
        if stream.with_map and stream.rig is not None:
            self._mapper = Mapper(stream.settings, stream.rig, stream.output.map_cell_m)
            self._mapper.known = known
        self._video = ResultVideo(path, stream, video, image=self._picture)
        self.close, self.abandon = self._video.close, self._video.abandon

    def write(self, step: Step) -> None:
        """Append the picture of a frame."""
        if self._mapper is not None:
            self._mapper.see(step)
        self._video.write(step)

    def checkpoint(self) -> _Mark:
        """End a segment."""
        known = None if self._mapper is None else self._mapper.known
        return self._video.checkpoint(), known

    def _picture(self, step: Step, stream: RunContext) -> NDArray[np.uint8]:
        return preview_picture(step, stream, self._mapper)
