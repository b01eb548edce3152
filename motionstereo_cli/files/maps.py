"""Maps of numbers, such as disparity or depth: one file per image."""

from __future__ import annotations

import hashlib
import io
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from motionstereo_cli.errors import InputError, words_of
from motionstereo_cli.files.reading import MAX_PIXELS, content_up_to, open_regular
from motionstereo_cli.files.stills import DamagedImageError, read_still, shown

if TYPE_CHECKING:
    from numpy.typing import NDArray

SUFFIXES = (".png", ".pfm", ".tif", ".tiff", ".npy")

#: The largest number in an NPY file, and its head, in bytes.
_NPY_ITEM_BYTES, _NPY_HEAD_BYTES = 8, 10_000


class MapFile(NamedTuple):
    """A map as its file has it.

    Attributes:
        values: (height, width), or (height, width, channels) of a coloured image; whole numbers or
            float32, with NaN and inf as they are.
        size_bytes, sha256: size and SHA-256 of the file as it was read.
    """

    values: NDArray[Any]
    size_bytes: int
    sha256: bytes


def read_map(path: Path, max_pixels: int = MAX_PIXELS, within: Path | None = None) -> MapFile:
    """Read PNG, PFM, TIFF or NPY, by the name.

    Args:
        path: the file.
        max_pixels: largest width times height.
        within: see :func:`~motionstereo_cli.files.reading.open_regular`.

    Raises:
        DamagedImageError: it cannot be read.
        InputError: it is too large, or has pixels of a kind that says nothing of numbers.
    """
    if path.suffix.lower() != ".npy":
        still = read_still(path, max_pixels, within)
        return MapFile(still.pixels, still.size_bytes, still.sha256)
    max_bytes = _NPY_ITEM_BYTES * max_pixels + _NPY_HEAD_BYTES
    try:
        with open_regular(path, within) as file:
            content = content_up_to(file, max_bytes)
    except OSError as error:
        raise DamagedImageError(words_of(error)) from error
    if content is None:
        raise InputError(f"{path} is larger than --max-pixels {max_pixels}: is it one map?")
    return MapFile(_npy(content), len(content), hashlib.sha256(content).digest())


def _npy(content: bytes) -> NDArray[Any]:
    """Return the array of an NPY file without dimensions of 1 around its rows and columns."""
    file = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0
        if version != (1, 0):
            read = np.lib.format.read_array_header_2_0
        shape, by_column, dtype = read(file, max_header_size=_NPY_HEAD_BYTES)
    except Exception as error:  # damaged heads raise anything
        raise DamagedImageError(f"its head is not that of an NPY file ({error})") from error
    if dtype.kind not in "iuf" or dtype.itemsize > _NPY_ITEM_BYTES:
        raise DamagedImageError(f"it holds {dtype}, not numbers")
    wanted = math.prod(shape) * dtype.itemsize
    if len(content) - file.tell() != wanted or not wanted:
        raise DamagedImageError(
            f"{len(content) - file.tell()} bytes of values, where {shape} needs {wanted}"
        )
    values = np.frombuffer(content, dtype, offset=file.tell())
    values = values.reshape(shape, order="F" if by_column else "C")
    while values.ndim > 2 and 1 in (values.shape[0], values.shape[-1]):
        values = values[0] if values.shape[0] == 1 else values[..., 0]
    if values.ndim != 2:
        raise DamagedImageError(f"its shape is {shape}, not (height, width)")
    if dtype.kind == "f":
        return np.ascontiguousarray(values, np.float32)
    return np.ascontiguousarray(values, dtype.newbyteorder("="))


def numbered_files(folder: Path, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """Return the files of a folder with one of the suffixes, by frame number, in order.

    That is the number in the file's name or, of several, the one which differs most from file to
    file: 7 of 000007_10.png.

    Raises:
        InputError: there are none, or the frame numbers cannot be told.
    """
    try:
        files = shown(folder.iterdir(), suffixes)
    except OSError as error:
        raise InputError(f"cannot read the folder {folder}: {error.strerror}") from error
    if not files:
        raise InputError(f"{folder} has no {' or '.join(suffixes)} files: check the path")
    # Columns of numbers, as many as the name with the fewest has.
    columns = list(zip(*(re.findall("[0-9]+", file.stem) for file in files), strict=False))
    if not columns:
        raise InputError(f"{folder}: give every file name a frame number, such as 000007.png")
    numbers = [int(digits) for digits in max(columns, key=lambda column: len(set(column)))]
    numbered = dict(sorted(zip(numbers, files, strict=True)))
    if len(numbered) < len(files):
        raise InputError(f"{folder}: several files have the same frame number: keep one of each")
    return numbered
