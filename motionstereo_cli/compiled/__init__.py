"""Loops over pixels: Python files that Cython compiles when the package is installed.

They are built once for every machine and, on 64-bit Linux PCs, once more for processors of the
last ten years (x86-64-v3), with the same results to the bit. With ``MOTIONSTEREO_UNCOMPILED=1`` in
the environment they run as plain Python, a hundred times slower: for tests and for debuggers.
"""

from __future__ import annotations

import os
import threading
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

_T = TypeVar("_T")

HERE = Path(__file__).parent

#: What /proc/cpuinfo calls the instructions of x86-64-v3.
V3_FLAGS = {"avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe"}


def checksum() -> str:
    """Return what tells whether the loops have changed since they were compiled."""
    return str(zlib.crc32(b"".join(path.read_bytes() for path in sorted(HERE.glob("*.py")))))


def _runs_v3() -> bool:
    try:
        with open("/proc/cpuinfo", encoding="ascii", errors="replace") as file:
            return set(file.read(4096).split()) >= V3_FLAGS
    except OSError:
        return False


def _folders() -> list[str]:
    """Return where the loops are: the first that has one is taken."""
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

_kept = threading.local()


def reused(make: Callable[..., _T], *sizes: Any) -> _T:
    """Return a workspace, ``make(*sizes)``: the thread's last one if that had the same sizes."""
    workspaces: dict[Any, Any] = _kept.__dict__
    if workspaces.get(make, (None, None))[0] != sizes:
        workspaces[make] = sizes, make(*sizes)
    workspace: _T = workspaces[make][1]
    return workspace
