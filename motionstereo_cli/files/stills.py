"""Reading still images: the one place that opens and decodes them."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import io
import itertools
import logging
import os
import re
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator
from io import BufferedReader
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np
from PIL import Image as Pillow
from PIL import ImageOps

from motionstereo_cli.errors import InputError, is_damage, words_of
from motionstereo_cli.files.reading import MAX_PIXELS, content_up_to, open_regular

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.types import Grey

#: Suffixes of images; all other files are skipped. The last two hold both views
#: in one file: as two images, and side by side.
SUFFIXES = frozenset(
    {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".webp", ".mpo", ".jps"}
)

#: The formats that are read, whatever a file's name. Pillow decodes these itself; it would start a
#: program for others, such as EPS.
_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "PPM", "WEBP")

#: Formats that may hold several images of one kind; a JPEG may hold a thumbnail.
_PAGED = ("TIFF", "PNG", "WEBP")

#: Modes of Pillow that are used unchanged, and those that are converted to RGB.
_PLAIN_MODES = {"1", "L", "LA", "RGB", "RGBA", "I", "F", "I;16", "I;16B", "I;16L", "I;16N"}
_RGB_MODES = {"P", "PA", "La", "RGBa", "RGBX", "CMYK", "YCbCr"}

#: Limit of images in a TIFF: the position of each takes memory.
MAX_PAGES = 10_000

#: No image takes more bytes in a file: 16 bits of four colours twice over, and its notes.
_MAX_BYTES_PER_PIXEL, _NOTES_BYTES = 16, 16_000_000

#: Where a JPS says how its views lie: in an APP3 segment, a length and four bytes from the last on.
_JPS_MARK = b"_JPSJPS_"
_JPS_LAYOUTS = {2: "side-by-side", 3: "top-bottom"}
_JPS_LEFT_FIRST = 4

#: Magic, width, height and scale of a PFM, and the one white space behind them, which is two
#: characters where a program wrote the head as text on Windows.
_PFM_HEAD = re.compile(rb"(P[fF])\s+(\d{1,9})\s+(\d{1,9})\s+([-+.\deE]{1,32})(\r\n|\s)")

# Pillow warns of large images, which are refused here, and of notes in images that do not matter.
# It also prints some faults of a file, which it raises as well.
warnings.filterwarnings("ignore", module=r"PIL\.")
logging.getLogger("PIL").addHandler(logging.NullHandler())


class Stated(NamedTuple):
    """The layout of both views that a recording states, and whether the right one is first."""

    layout: str
    swapped: bool


class DamagedImageError(Exception):
    """An image that cannot be read; the text says why."""


class Still(NamedTuple):
    """A decoded image.

    Attributes:
        pixels: (height, width) or (height, width, channels: grey+alpha, RGB or RGBA); bool,
            uint8, uint16, or float32 with NaN and inf as they are. The orientation in its metadata
            is applied.
        pages: images in the file, where it is a TIFF, PNG or WebP; the first is read.
        size_bytes, sha256: size and SHA-256 of the file as it was read.
        stated: how it says that it holds both views, None if it does not.
    """

    pixels: NDArray[Any]
    pages: int
    size_bytes: int
    sha256: bytes
    stated: Stated | None = None


def images_in(folder: Path) -> list[Path]:
    """Return a folder's images, in no order.

    Raises:
        OSError: the folder cannot be read.
    """
    return shown(folder.iterdir(), SUFFIXES)


def shown(files: Iterable[Path], suffixes: Collection[str]) -> list[Path]:
    """Return those of some files that have one of some suffixes, and are not hidden.

    macOS leaves a ``._frame0.png`` beside each ``frame0.png``; it is not an image.
    """
    return [
        file for file in files if file.suffix.lower() in suffixes and not file.name.startswith(".")
    ]


def _content_of(path: Path, max_pixels: int, within: Path | None) -> bytes:
    """Return the content of an image's file, which is not read if it has too many bytes.

    Raises:
        DamagedImageError: it cannot be read, or is larger than what its head says can be.
        InputError: it is larger than ``max_pixels`` can be.
    """
    try:
        with open_regular(path, within) as file:
            size, pixels = os.fstat(file.fileno()).st_size, max_pixels
            if _NOTES_BYTES < size <= _max_bytes(max_pixels):
                pixels = _count_of(file, path)
            content = content_up_to(file, _max_bytes(min(pixels, max_pixels)))
    except OSError as error:
        raise DamagedImageError(words_of(error)) from error
    if content is not None:
        return content
    if pixels < max_pixels:
        raise DamagedImageError(f"it has {size} bytes, more than an image of {pixels} px")
    raise _too_large(path, f" ({size} bytes or more)", max_pixels)


def _max_bytes(pixels: int) -> int:
    return _MAX_BYTES_PER_PIXEL * pixels + _NOTES_BYTES


def _count_of(file: BufferedReader, path: Path) -> int:
    """Return how many pixels all images in a file have, by its head.

    Raises:
        DamagedImageError: that cannot be read, or is of another format.
        InputError: it has too many images.
    """
    try:
        if path.suffix.lower() == ".pfm":
            head = _PFM_HEAD.match(file.read(256))
            return int(head[2]) * int(head[3]) if head else 0
        with Pillow.open(file, formats=_FORMATS) as image:
            return image.width * image.height * _pages_of(image, path)
    except Exception as error:
        if not is_damage(error):
            raise
        raise DamagedImageError(words_of(error)) from error
    finally:
        file.seek(0)


def read_still(path: Path, max_pixels: int = MAX_PIXELS, within: Path | None = None) -> Still:
    """Read an image from a regular file: PNG, JPEG, TIFF, BMP, PPM, WebP, or PFM by its name.

    Raises:
        DamagedImageError: it cannot be read, or is of another format.
        InputError: it is too large, or has pixels of a kind that says nothing of grey levels.
    """
    content = _content_of(path, max_pixels, within)
    stated = None
    if path.suffix.lower() == ".pfm":
        pixels, pages = _pfm(content, path, max_pixels), 1
    else:
        pixels, pages = decode(content, path, max_pixels)
    if path.suffix.lower() == ".mpo":
        pixels = _beside(pixels, decode(content, path, max_pixels, page=1)[0])
        stated = Stated("side-by-side", swapped=False)
    elif path.suffix.lower() == ".jps":
        stated = _stated_in(content)
    return Still(pixels, pages, len(content), hashlib.sha256(content).digest(), stated)


def _beside(left: NDArray[Any], right: NDArray[Any]) -> NDArray[Any]:
    if left.shape != right.shape:
        raise DamagedImageError("its two images differ in size")
    return np.hstack([left, right])


def _stated_in(jps: bytes) -> Stated:
    """Return what a JPS says; where it says nothing, its views are crossed."""
    found = jps.find(_JPS_MARK)
    descriptor = jps[found + 10 : found + 14] if found >= 0 else b""
    if len(descriptor) < 4:
        return Stated("side-by-side", swapped=True)
    _, flags, how, _ = descriptor
    return Stated(_JPS_LAYOUTS.get(how, "side-by-side"), swapped=not flags & _JPS_LEFT_FIRST)


def grey_of(pixels: NDArray[Any], path: Path, white: int = 0) -> Grey:
    """Return the grey levels of a decoded image, (height, width) uint8: BT.601 luma of colour.

    Args:
        pixels: as in :class:`Still`.
        path: what to call it in messages.
        white: level that becomes 255 where there are 16 bits; 0 = 65535.

    Raises:
        InputError: its pixels are floats.
    """
    if pixels.dtype == np.bool_:
        pixels = pixels * np.uint8(255)
    elif pixels.dtype == np.uint16:
        pixels = np.asarray(cv2.convertScaleAbs(pixels, alpha=255 / (white or 65535)), np.uint8)
    elif pixels.dtype != np.uint8:
        raise InputError(f"{path} has {pixels.dtype} pixels: give 8-bit or 16-bit images")
    if pixels.ndim == 2:
        return pixels
    if pixels.shape[2] < 3:  # grey with alpha
        return np.ascontiguousarray(pixels[:, :, 0])
    rgb = np.ascontiguousarray(pixels[:, :, :3])
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)


def pixel_format(pixels: NDArray[Any]) -> str:
    """Return the kind of pixels, which are as in :class:`Still`, in words: ``grey 8 bit``."""
    channels = {1: "grey", 2: "grey+alpha", 3: "rgb", 4: "rgba"}
    count = 1 if pixels.ndim == 2 else pixels.shape[2]
    bits = {"bool": 1, "uint8": 8}.get(pixels.dtype.name, 16)
    return f"{channels[count]} {bits} bit"


def decode(
    content: bytes, path: Path, max_pixels: int = MAX_PIXELS, page: int = 0
) -> tuple[NDArray[Any], int]:
    """Return the pixels of an encoded image, as :class:`Still` has them, and its pages.

    Args:
        content: PNG, JPEG, TIFF, BMP, PPM or WebP.
        path: what to call it in messages.
        max_pixels: largest width times height.
        page: which image, where there are several.

    Raises:
        DamagedImageError: it cannot be read, or is of another format.
        InputError: it is too large, or has pixels of a kind that says nothing of grey levels.
    """
    try:
        with Pillow.open(io.BytesIO(content), formats=_FORMATS) as image:
            if image.width * image.height > max_pixels:
                raise _too_large(path, f" ({image.width}x{image.height} px)", max_pixels)
            pages = _pages_of(image, path)
            if page or pages > 1:
                image.seek(page)
            return _decoded(image, path), pages
    except Pillow.DecompressionBombError:
        raise _too_large(path, "", max_pixels) from None
    except Exception as error:
        if not is_damage(error):
            raise
        raise DamagedImageError(words_of(error)) from error


def _decoded(image: Pillow.Image, path: Path) -> NDArray[Any]:
    """Return the pixels of an open image, as :class:`Still` has them.

    Raises:
        InputError: it has pixels of a kind that says nothing of grey levels.
    """
    mode, turned = _as_read(image.mode, path), ImageOps.exif_transpose(image)
    return _native(np.asarray(turned.convert(mode) if mode else turned), path)


def page_count(path: Path) -> int:
    """Return how many images a TIFF, PNG or WebP holds; 1 for what cannot be read."""
    try:
        with open_regular(path) as file, Pillow.open(file, formats=_PAGED) as image:
            return _pages_of(image, path)
    except Exception as error:
        if not is_damage(error):
            raise
        return 1


def _pages_of(image: Pillow.Image, path: Path) -> int:
    """Return how many images a file has.

    Raises:
        InputError: more than anybody has in one file.
    """
    count = 1
    if image.format in ("PNG", "WEBP"):
        count = getattr(image, "n_frames", 1)
    elif image.format == "TIFF":
        _quiet_libtiff()
        with contextlib.suppress(EOFError):
            for count in range(1, MAX_PAGES + 2):
                image.seek(count)
    if count > MAX_PAGES:
        raise InputError(
            f"{path} has more than {MAX_PAGES} images: give a video, or a file of each"
        )
    return count


@functools.cache
def _quiet_libtiff() -> None:
    """Have libtiff write nothing to standard error; Pillow raises what it says."""
    home = Path(Pillow.__file__).parent
    for library in (*home.parent.glob("pillow.libs/libtiff*"), *home.glob(".dylibs/libtiff*")):
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(str(library)).TIFFSetErrorHandler(None)


def pages_from(path: Path, begin: int, max_pixels: int = MAX_PIXELS) -> Iterator[NDArray[Any]]:
    """Yield the images of a file that holds several, each as :class:`Still` has it.

    Args:
        path: a file of which :func:`page_count` says so, which tells its format.
        begin: number of the first.
        max_pixels: largest width times height.

    Raises:
        DamagedImageError: the next one cannot be read.
        InputError: it is too large, or has pixels of a kind that says nothing of grey levels.
    """
    import imageio.v3 as iio

    try:
        with open_regular(path) as file, iio.imopen(file, "r", plugin="pillow") as opened:
            for page in itertools.count(begin):
                try:
                    about = opened.metadata(index=page)
                except EOFError:
                    return
                width, height = about["shape"]
                if width * height > max_pixels:
                    raise _too_large(path, f" ({width}x{height} px)", max_pixels)
                how: dict[str, Any] = {"mode": _as_read(about["mode"], path), "rotate": True}
                yield _native(opened.read(index=page, **how), path)
    except Exception as error:
        if not is_damage(error):
            raise
        raise DamagedImageError(words_of(error)) from error


def _as_read(mode: str, path: Path) -> str | None:
    """Return the mode to convert to, None where pixels are read as they are."""
    if mode not in _PLAIN_MODES | _RGB_MODES:
        raise InputError(f"{path} has {mode} pixels: convert it to grey or RGB, 8 or 16 bits")
    return "RGB" if mode in _RGB_MODES else None


def _native(pixels: NDArray[Any], path: Path) -> NDArray[Any]:
    """Return pixels in the byte order of this machine; whole numbers as 16 bits."""
    if pixels.dtype.kind == "i":  # Pillow reads 16-bit PGM as int32
        if pixels.min(initial=0) < 0 or pixels.max(initial=0) > 65535:
            raise InputError(f"{path} has 32-bit pixels: convert it to 8 or 16 bits")
        return pixels.astype(np.uint16)
    return pixels.astype(pixels.dtype.newbyteorder("="), copy=False)


def _pfm(content: bytes, path: Path, max_pixels: int) -> NDArray[np.float32]:
    """Return the values of a PFM as they are, from the top row down.

    Of the scale only the sign counts; it tells the byte order: Middlebury's files have
    others than 1 and mean the values as they stand, as do its own programs.
    """
    head = _PFM_HEAD.match(content[:256])
    scale = _number(head[4]) if head else 0
    if head is None or not scale:
        raise DamagedImageError("its head is not that of a PFM")
    channels, width, height = 3 if head[1] == b"PF" else 1, int(head[2]), int(head[3])
    if not 0 < width * height <= max_pixels:
        raise _too_large(path, f" ({width}x{height} px)", max_pixels)
    wanted = 4 * channels * width * height
    starts = {head.end(), head.end() - len(head[5]) + 1}  # the first value may begin with \n
    starts = {start for start in starts if len(content) - start == wanted}
    if not starts:
        raise DamagedImageError(
            f"{len(content) - head.end()} bytes of values, where {width}x{height} px need {wanted}"
        )
    order = "<f4" if scale < 0 else ">f4"
    values = np.frombuffer(content, order, offset=starts.pop()).astype(np.float32)
    shape = (height, width) if channels == 1 else (height, width, channels)
    return np.ascontiguousarray(values.reshape(shape)[::-1])


def _number(text: bytes) -> float:
    try:
        return float(text)
    except ValueError:
        return 0.0


def _too_large(path: Path, size: str, max_pixels: int) -> InputError:
    return InputError(
        f"{path} is larger than --max-pixels {max_pixels}{size}: "
        "raise it if the image is to be trusted"
    )


def colours_of(pixels: NDArray[Any]) -> Callable[[], NDArray[np.uint8]] | None:
    """Return what makes (height, width, 3) uint8 RGB of a still's pixels; None where it is grey."""
    if pixels.ndim < 3 or pixels.shape[2] < 3 or pixels.dtype not in (np.uint8, np.uint16):
        return None

    def colours() -> NDArray[np.uint8]:
        shown = pixels[:, :, :3]
        return np.asarray(shown >> 8 if shown.dtype == np.uint16 else shown, np.uint8)

    return colours
