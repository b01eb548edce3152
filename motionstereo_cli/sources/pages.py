"""One camera from a file of several still images: pages of a TIFF, frames of a PNG or WebP."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.reading import MAX_PIXELS, sha256_of
from motionstereo_cli.files.stills import (
    DamagedImageError,
    colours_of,
    grey_of,
    page_count,
    pages_from,
)
from motionstereo_cli.sources.recording import Image, StillsRecording, images


class PagesRecording(StillsRecording):
    """Images of one file in order; they have times only with ``frame_rate``.

    After a page that cannot be read, all others are lost.

    Args:
        path: the file.
        frame_rate: images per second, None = unknown.
        white: level that becomes 255 in images of 16 bits; 0 = 65535.
        max_pixels: largest width times height of an image.

    Raises:
        InputError: no image can be read; while iterating: one is too large, or differs from the
            first in size.
    """

    timeless = True

    def __init__(
        self,
        path: Path,
        frame_rate: Fraction | None = None,
        *,
        white: int = 0,
        max_pixels: int = MAX_PIXELS,
    ) -> None:
        self._path, self._white, self._max_pixels = path, white, max_pixels
        self._ended = ""
        self._lost = 0
        self.expected_images = self._count = page_count(path)
        self.frame_rate, self.time_base = frame_rate, 1 / frame_rate if frame_rate else None
        self._start(self._read(), path)

    @property
    def lost(self) -> int:
        """The image that could not be read, and all after it."""
        return self._lost

    @property
    def damage(self) -> list[str]:
        """A line that tells where reading ended."""
        if not self._ended:
            return []
        return [f"{self._path}: {images(self._lost)} could not be read: {self._ended}"]

    def describe(self) -> dict[str, Any]:
        """Describe the images, as JSON-able values."""
        return self._described(self._path, "pages", self._path.suffix.lower()[1:])

    @property
    def files(self) -> tuple[Path, ...]:
        """The file."""
        return (self._path,)

    def fingerprint(self) -> dict[str, Any]:
        """Return the size of the file in bytes, and its SHA-256."""
        return {"bytes": self._path.stat().st_size, "sha256": sha256_of(self._path)}

    def outline(self) -> Sequence[tuple[int, int]]:
        """Return the numbers of all pages, twice."""
        return [(number, number) for number in range(self._count)]

    def skip_to(self, number: int) -> bool:
        """Begin with a page; earlier ones are not decoded."""
        self._images = self._read(number, (self.height, self.width))
        return True

    def _read(self, begin: int = 0, shape: tuple[int, ...] | None = None) -> Iterator[Image]:
        number, pages = begin, pages_from(self._path, begin, self._max_pixels)
        try:
            for pixels in pages:
                grey = grey_of(pixels, self._path, self._white)
                if shape is None:
                    shape = grey.shape
                    self._look_at(pixels)
                if grey.shape != shape:
                    raise InputError(
                        f"{self._path}: page {number} is {grey.shape[1]}x{grey.shape[0]} but those "
                        f"before it are {shape[1]}x{shape[0]}: give pages of one size"
                    )
                yield Image(number, number, grey, colours_of(pixels))
                number += 1
        except DamagedImageError as error:
            self._ended, self._lost = str(error), self._count - number
