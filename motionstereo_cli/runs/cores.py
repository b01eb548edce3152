"""The cores that this process may use."""

from __future__ import annotations

import contextlib
import math
import os
from pathlib import Path

#: Processor time and the time that it is for, in us, of the group of processes that a container
#: is: version 2 in one file, version 1 in two.
_QUOTAS = (
    ("/sys/fs/cgroup/cpu.max",),
    ("/sys/fs/cgroup/cpu/cpu.cfs_quota_us", "/sys/fs/cgroup/cpu/cpu.cfs_period_us"),
)


def usable_cores() -> int:
    """Return how many cores this process may use: by its affinity, and by a container's quota."""
    try:
        cores = len(os.sched_getaffinity(0))
    except AttributeError:  # not on this system
        cores = os.cpu_count() or 1
    for paths in _QUOTAS:
        with contextlib.suppress(OSError, ValueError):  # none, which is "max" or -1
            quota, period = (
                int(word) for path in paths for word in Path(path).read_text("ascii").split()
            )
            if quota > 0:
                return max(1, min(cores, math.ceil(quota / period)))
    return cores


def prepare() -> None:
    """Have OpenCV and OpenBLAS stay in one thread each, before they load.

    Frames are worked on side by side anyway. The threads of these libraries would wait for their
    next call, and take processor time for it.
    """
    for name in ("OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
        os.environ.setdefault(name, "1")
