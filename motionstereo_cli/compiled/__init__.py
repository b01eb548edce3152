"""Loops over pixels: Python files that Cython compiles when the package is installed.

They are built once for every machine and, on 64-bit Linux PCs, once more for processors with
x86-64-v3, with the same results to the bit. With ``MOTIONSTEREO_UNCOMPILED=1`` in the environment
they run as plain Python, a hundred times slower: for tests and debuggers. ``MOTIONSTEREO_LOOPS``
names another folder to load them from, as ``make sanitize`` does.
"""

from __future__ import annotations

import os
import threading
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.errors import InputError

_T = TypeVar("_T")
_Scalar = TypeVar("_Scalar", bound=np.generic)

HERE = Path(__file__).parent

#: Flags of x86-64-v3 in /proc/cpuinfo.
V3_FLAGS = {"avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe"}


def checksum() -> str:
    """Return a checksum of the sources of the loops, which tells whether they were compiled."""
    paths = sorted(path for end in ("py", "pxd", "h") for path in HERE.glob(f"*.{end}"))
    return str(zlib.crc32(b"".join(path.read_bytes() for path in paths)))


def _runs_v3() -> bool:
    try:
        with open("/proc/cpuinfo", encoding="ascii", errors="replace") as file:
            return set(file.read(4096).split()) >= V3_FLAGS
    except OSError:
        return False


def _folders() -> list[str]:
    """Return the folders of the compiled loops; the first that has a loop is used."""
    if elsewhere := os.environ.get("MOTIONSTEREO_LOOPS"):
        return [elsewhere]
    if os.environ.get("MOTIONSTEREO_UNCOMPILED") == "1":
        return [str(HERE)]
    folders = [HERE / "v3"] * _runs_v3() + [HERE / "baseline"]
    built_from = folders[-1] / "checksum"
    if not built_from.exists() or built_from.read_text(encoding="ascii") != checksum():
        raise ImportError(
            f"the loops in {HERE} have changed since they were compiled, or never were: "
            "install the package again, with `make .venv/.ready` or `pip install -e .`"
        )
    return [str(folder) for folder in folders]


__path__ = _folders()


def checked_array(
    array: NDArray[_Scalar], dtype: type[_Scalar], shape: tuple[int, ...] | None = None
) -> NDArray[_Scalar]:
    """Return an image for the loops, contiguous in memory; they do not check indices.

    Args:
        array: (height, width), neither of them 0.
        dtype: its required type.
        shape: its required height and width, None = any.

    Raises:
        InputError: it is anything else.
    """
    array = np.asarray(array)
    if array.ndim != 2 or array.dtype != dtype or 0 in array.shape:
        raise InputError(
            f"an array is {array.dtype} of shape {array.shape}: give a (height, width) image of "
            f"{np.dtype(dtype)}"
        )
    if shape is not None and array.shape != shape:
        raise InputError(f"arrays of shapes {shape} and {array.shape}: give images of one size")
    return np.ascontiguousarray(array)


def checked_number(name: str, value: int, low: int, high: int = 32767) -> int:
    """Return a number for a loop or the size of a workspace, after a check of its range.

    Raises:
        InputError: it is not within ``low`` and ``high``.
    """
    if not low <= value <= high:
        raise InputError(f"{name} is {value}: give {low} to {high}")
    return int(value)


_kept = threading.local()


def reused(make: Callable[..., _T], *sizes: Any) -> _T:
    """Return a workspace, ``make(*sizes)``: the thread's last one if that had the same sizes."""
    workspaces: dict[Any, Any] = _kept.__dict__
    if workspaces.get(make, (None, None))[0] != sizes:
        workspaces[make] = sizes, make(*sizes)
    workspace: _T = workspaces[make][1]
    return workspace
