"""Text in pictures: titles, colour keys, scale bars."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from PIL.ImageFont import FreeTypeFont, ImageFont


class Label(NamedTuple):
    """A line of text in a picture.

    Attributes:
        x, y: its place in px.
        text: what it says.
        anchor: which point of it is there, as Pillow has it: ``lm`` is left and middle.
    """

    x: float
    y: float
    text: str
    anchor: str = "lm"


class Style(NamedTuple):
    """How captions look: size of the letters in px, colours of letters and background, RGB."""

    size_px: int
    ink: tuple[int, int, int]
    ground: tuple[int, int, int]


#: Captions of pictures that are mostly dark, and of those that are mostly light.
DARK = Style(13, (235, 235, 235), (24, 24, 27))
LIGHT = Style(14, (30, 34, 40), (255, 255, 255))

#: Between pictures side by side, in px.
GAP_PX = 4

#: A panel is at least so wide that its title can be read, and its longer side at most so long, px.
_MIN_PANEL_PX, MAX_PANEL_PX = 240, 640
#: The smallest letters that can be read, in px.
_MIN_LETTERS_PX = 9


def lettered(
    image: NDArray[np.uint8],
    labels: Iterable[Label],
    *,
    size_px: int,
    colour: tuple[int, int, int] = (235, 235, 235),
) -> NDArray[np.uint8]:
    """Return an RGB image, (height, width, 3) uint8, with text in it.

    Args:
        image: the image.
        labels: what to write.
        size_px: size of the letters.
        colour: theirs, RGB.
    """
    from PIL import Image, ImageDraw

    picture = Image.fromarray(image)
    pen = ImageDraw.Draw(picture)
    for label in labels:
        place = label.x, label.y
        pen.text(place, label.text, fill=colour, font=_font(size_px), anchor=label.anchor)
    return np.asarray(picture, np.uint8)


def text_width(text: str, size_px: int) -> float:
    """Return how wide a line of text is in px."""
    return float(_font(size_px).getlength(text))


def fitted(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a picture, grey or RGB, as large as a panel: enlarged by a whole number, or shrunk."""
    height, width = picture.shape[:2]
    longer = max(height, width)
    if longer > MAX_PANEL_PX:
        size = (max(round(side * MAX_PANEL_PX / longer), 1) for side in (width, height))
        return np.asarray(cv2.resize(picture, tuple(size), interpolation=cv2.INTER_AREA), np.uint8)
    times = max(1, min(-(-_MIN_PANEL_PX // width), MAX_PANEL_PX // longer))
    return picture.repeat(times, 0).repeat(times, 1)


def titled(
    panels: Sequence[NDArray[np.uint8]], titles: Sequence[str], style: Style
) -> NDArray[np.uint8]:
    """Return RGB images of one height side by side, each below its title.

    A title that is wider than its image has smaller letters, and is cut off if these would be too
    small to read.
    """
    columns = []
    for panel, title in zip(panels, titles, strict=True):
        head = np.full((2 * style.size_px, panel.shape[1], 3), style.ground, np.uint8)
        room = (panel.shape[1] - style.size_px) / text_width(title, style.size_px)
        size_px = min(style.size_px, max(int(style.size_px * room), _MIN_LETTERS_PX))
        label = Label(size_px / 2, style.size_px, title)
        head = lettered(head, [label], size_px=size_px, colour=style.ink)
        columns.append(np.concatenate([head, panel]))
    gap = np.full((len(columns[0]), GAP_PX, 3), style.ground, np.uint8)
    return np.concatenate([part for each in columns for part in (gap, each)][1:], axis=1)


def colour_key(
    width: int, entries: Iterable[tuple[tuple[int, int, int], str]], style: Style
) -> NDArray[np.uint8]:
    """Return rows, RGB, that say what each colour means.

    Args:
        width: of the rows in px.
        entries: colour, RGB, and meaning.
        style: of the text.
    """
    size = style.size_px
    x, y = size / 2, float(size)
    boxes, labels = [], []
    for colour, text in entries:
        room = 1.5 * size + text_width(text, size)
        if x > size and x + room > width:
            x, y = size / 2, y + 1.6 * size
        boxes.append((round(x), round(y - size / 2), colour))
        labels.append(Label(x + 1.4 * size, y, text))
        x += room + 1.5 * size
    rows = np.full((2 * round((y + size) / 2), width, 3), style.ground, np.uint8)
    for left, top, colour in boxes:
        rows[top : top + size, left : left + size] = style.ink
        rows[top + 1 : top + size - 1, left + 1 : left + size - 1] = colour
    return lettered(rows, labels, size_px=size, colour=style.ink)


def length_bar(width: int, px_per_m: float, style: Style) -> NDArray[np.uint8]:
    """Return a row, RGB, with a bar of a round length in m, at most a third of the width long."""
    size = style.size_px
    length_m = max(
        (step * 10.0**decade for decade in range(-3, 5) for step in (1, 2, 5)),
        key=lambda each: each if each * px_per_m <= width / 3 else 1e-9 / each,
    )
    row = np.full((2 * size, width, 3), style.ground, np.uint8)
    left, right = size // 2, min(size // 2 + max(round(length_m * px_per_m), 1), width)
    row[size : size + 2, left:right] = style.ink
    for end in (left, right - 1):
        row[size - 3 : size + 5, end : end + 1] = style.ink
    label = Label(right + size / 2, size + 1, f"{length_m:g} m")
    return lettered(row, [label], size_px=size, colour=style.ink)


@functools.cache
def _font(size_px: int) -> FreeTypeFont | ImageFont:
    from PIL import ImageFont

    return ImageFont.load_default(size_px)
