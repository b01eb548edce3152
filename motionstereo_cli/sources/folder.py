"""One camera from a folder of images."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import imageio.v3 as iio
import numpy as np

from motionstereo_cli.errors import InputError
from motionstereo_cli.sources.stream import Image, Stream, images

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.types import Grey

#: Files with these suffixes are images; all others are passed over.
SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".webp"})


class FolderStream(Stream):
    """The images of a folder in natural order: frame2 before frame10.

    Colour becomes BT.601 luma, alpha is dropped, 16 bits are scaled to 8, and the orientation
    that a camera noted is obeyed. The time stamp is the number of the file: images have no time.
    An image that cannot be read is counted and its number left out.

    Args:
        path: an existing folder.

    Raises:
        InputError: the folder has no readable image; while iterating: an image differs from the
            first in size.
    """

    time_base = None

    def __init__(self, path: Path) -> None:
        self._path = path
        self._unreadable: list[str] = []
        try:
            self._files = sorted(
                (file for file in path.iterdir() if file.suffix.lower() in SUFFIXES),
                key=lambda file: natural_key(file.name),
            )
        except OSError as error:
            raise InputError(f"cannot read the folder {path}: {error.strerror}") from error
        if not self._files:
            raise InputError(f"{path} has no images: put {', '.join(sorted(SUFFIXES))} files in it")
        self.expected_images = len(self._files)
        self._start(self._read(), path)

    def close(self) -> None:
        """Do nothing: no file stays open."""

    @property
    def damaged(self) -> int:
        """Images that could not be read so far."""
        return len(self._unreadable)

    @property
    def damage(self) -> list[str]:
        """One line that counts the unreadable images and names the first."""
        if not self._unreadable:
            return []
        count, first = images(self.damaged), self._unreadable[0]
        return [f"{self._path}: {count} could not be read, the first is {first}"]

    def describe(self) -> dict[str, Any]:
        """Return what the folder holds, as JSON-able values.

        ``sha256`` is that of the text which ``sha256sum`` prints for the images by bare name,
        in natural order.
        """
        sums = hashlib.sha256()
        for path in self._files:
            with path.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            sums.update(f"{digest}  {path.name}\n".encode())
        return {
            "path": str(self._path),
            "kind": "folder",
            "codec": ", ".join(sorted({file.suffix.lower()[1:] for file in self._files})),
            "pixel_format": self._pixel_format,
            "range": "full",
            "width": self.width,
            "height": self.height,
            "frame_rate": None,
            "bytes": sum(file.stat().st_size for file in self._files),
            "sha256": sums.hexdigest(),
        }

    def _read(self) -> Iterator[Image]:
        shape: tuple[int, ...] | None = None
        for number, file in enumerate(self._files):
            try:
                # Pillow by name: otherwise imageio tries its video plugins on damaged files.
                pixels = iio.imread(file, plugin="pillow", index=0, rotate=True)
            except (OSError, ValueError, SyntaxError):  # Pillow raises all three on damage
                self._unreadable.append(file.name)
                continue
            grey = _grey(pixels, file)
            if shape is None:
                shape = grey.shape
                self._pixel_format = _pixel_format(pixels)
            if grey.shape != shape:
                raise InputError(
                    f"{file} is {grey.shape[1]}x{grey.shape[0]} but the images before it are "
                    f"{shape[1]}x{shape[0]}: make all images of a folder the same size"
                )
            yield Image(number, number, grey)


def natural_key(name: str) -> list[tuple[int, str]]:
    """Return a sort key that counts digits as numbers: frame2 comes before frame10."""
    parts = re.split(r"([0-9]+)", name)
    return [(int(part), "") if i % 2 else (0, part) for i, part in enumerate(parts)]


def _grey(pixels: NDArray[Any], file: Path) -> Grey:
    if pixels.dtype == np.bool_:
        pixels = pixels * np.uint8(255)
    elif pixels.dtype in (np.uint16, np.int32):  # Pillow reads 16-bit PGM as int32
        pixels = ((pixels.astype(np.uint32) + 128) // 257).astype(np.uint8)
    elif pixels.dtype != np.uint8:
        raise InputError(f"{file} has {pixels.dtype} pixels: give 8-bit or 16-bit images")
    if pixels.ndim == 2:
        return pixels
    if pixels.shape[2] < 3:  # grey with alpha
        return np.ascontiguousarray(pixels[:, :, 0])
    rgb = np.ascontiguousarray(pixels[:, :, :3])
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)


def _pixel_format(pixels: NDArray[Any]) -> str:
    channels = {1: "grey", 2: "grey+alpha", 3: "rgb", 4: "rgba"}
    count = 1 if pixels.ndim == 2 else pixels.shape[2]
    bits = {"bool": 1, "uint8": 8}.get(pixels.dtype.name, 16)
    return f"{channels[count]} {bits} bit"
