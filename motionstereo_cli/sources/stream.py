"""What every stream of images from one camera offers, wherever the images come from."""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from motionstereo_cli.errors import InputError

if TYPE_CHECKING:
    from motionstereo_cli.types import Grey


class Image(NamedTuple):
    """One image of one camera.

    Attributes:
        number: place in the recording, from 0; places of lost images are left out.
        pts: presentation time stamp in units of the stream's time base.
        grey: (height, width) uint8 grey levels 0..255; not to be written to.
    """

    number: int
    pts: int
    grey: Grey


class Stream(ABC):
    """Images of one camera, all of one size; to be iterated once.

    Attributes:
        width, height: size in px of the images as delivered.
        time_base: seconds per unit of pts, None where images have no time.
        expected_images: how many places the recording seems to have, None where nobody knows.
    """

    width: int
    height: int
    time_base: Fraction | None
    expected_images: int | None

    def __iter__(self) -> Iterator[Image]:
        return self._images

    def _start(self, images: Iterator[Image], path: Path) -> None:
        """Take the images to deliver, and the size from the first.

        Raises:
            InputError: there is none.
        """
        first = next(images, None)
        if first is None:
            raise InputError(f"{path}: none of its images can be decoded: check that it is whole")
        self.height, self.width = first.grey.shape
        self._images = itertools.chain([first], images)

    @property
    @abstractmethod
    def damaged(self) -> int:
        """Images found corrupt or lost so far."""

    @property
    @abstractmethod
    def damage(self) -> list[str]:
        """The same in words, one line for each kind of damage."""

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """Return what the recording is, as JSON-able values; reads all of it for its SHA-256."""

    @abstractmethod
    def close(self) -> None:
        """Give back what is open."""


def images(count: int) -> str:
    """Return ``count`` images in words."""
    return "1 image" if count == 1 else f"{count} images"
