"""Text in pictures."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

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


@functools.cache
def _font(size_px: int) -> FreeTypeFont | ImageFont:
    from PIL import ImageFont

    return ImageFont.load_default(size_px)
