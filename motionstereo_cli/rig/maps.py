"""Remap tables, as cv2.initUndistortRectifyMap makes them: where each rectified pixel was recorded.

They hold floats, x and y (CV_32FC1), or fixed-point numbers (CV_16SC2 and CV_16UC1): whole x and y,
and 32nds of both in one number, x + 32 y.
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from motionstereo_cli.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.rig.cameras import Maps
    from motionstereo_cli.rig.structure import Values

#: Names of remap tables: stereoMapL_x, Left_Stereo_Map_x, leftMapX, map1x, mapx1, map1.
NAME = r"(\w*stereo_?map\w*|\w*map_?[lr12]?_?[xy]_?[lr12]?|map_?[12])"

#: A text file of remap tables, by its beginning; texts of such tables are large.
_BEGINS = re.compile(rf"^\s*<{NAME}[ >]|^{NAME}:", re.MULTILINE | re.IGNORECASE)
MAX_MAPS_BYTES = 64_000_000

#: A matrix of OpenCV in XML or YAML: its name, size, channels, and its numbers.
_MATRIX = re.compile(
    r"<?\b(?P<name>\w+)(?: type_id=\"opencv-matrix\">|: *!!opencv-matrix)\s*"
    r"<?rows[>:]\s*(?P<rows>\d{1,5})\D+?<?cols[>:]\s*(?P<cols>\d{1,5})\D[^\"<]*?"
    r"<?dt[>:]\s*\"?(?P<channels>2?)[wsfd]\"?\s*(?:</dt>)?\s*<?data[>:]\s*\[?(?P<data>[^<\]]*)"
)

#: What the tables of the left and of the right camera are called, first and second.
_NAMES = (
    ("leftmapx", "leftmapy", "rightmapx", "rightmapy"),
    ("map1x", "map1y", "map2x", "map2y"),
    ("mapx1", "mapy1", "mapx2", "mapy2"),
    ("mapxl", "mapyl", "mapxr", "mapyr"),
    ("mapleftx", "maplefty", "maprightx", "maprighty"),
    ("stereomaplx", "stereomaply", "stereomaprx", "stereomapry"),
    ("leftstereomapx", "leftstereomapy", "rightstereomapx", "rightstereomapy"),
    ("map11", "map12", "map21", "map22"),
)


def begins_maps(text: str) -> bool:
    """Return whether a text that begins so holds remap tables."""
    return _BEGINS.search(text) is not None


def parse_maps(path: Path, text: str) -> Values:
    """Return the matrices of a text of remap tables by their plain names.

    Raises:
        InputError: one is not whole.
    """
    found: dict[str, Any] = {}
    for each in _MATRIX.finditer(text):
        numbers = _numbers(each["data"])
        shape = (int(each["rows"]), int(each["cols"]), 2)[: 3 if each["channels"] else 2]
        if numbers.size != np.prod(shape):
            raise InputError(
                f"{path}: {each['name'][:60]} has {numbers.size} numbers and not "
                f"{np.prod(shape)}: check that the file is whole"
            )
        found[re.sub(r"[^a-z0-9]", "", each["name"].lower())] = numbers.reshape(shape)
    return found


def _numbers(text: str) -> NDArray[np.float32]:
    """Return the numbers of a text, up to what is none, without a string for each."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        return np.fromstring(text.replace(",", " "), np.float32, sep=" ")


def maps_in(values: Values) -> tuple[Maps, Maps] | None:
    """Return the remap tables in a file; None if it has none of a form that is known."""
    for names in _NAMES:
        tables = [np.asarray(values.get(name, ()), object) for name in names]
        shape = tables[0].shape[:2]
        if len(shape) == 2 and all(each.shape[:2] == shape and each.size for each in tables):
            left, right = (_floats(*tables[at : at + 2]) for at in (0, 2))
            if left is not None and right is not None:
                return left, right
    return None


def _floats(first: Any, second: Any) -> Maps | None:
    """Return x and y of the tables of one camera; None where they are neither."""
    try:
        one, other = (np.asarray(each, np.float32) for each in (first, second))
    except (TypeError, ValueError):
        return None
    if one.ndim == other.ndim == 2:
        return one, other
    if one.ndim == 3 and one.shape[2] == 2 and other.ndim == 2:
        parts = np.clip(np.nan_to_num(other), 0, 1023).astype(np.int64)
        fractions = (np.asarray(part / 32, np.float32) for part in (parts % 32, parts // 32))
        x, y = (one[..., axis] + fraction for axis, fraction in enumerate(fractions))
        return x, y
    return None
