"""The machine that this process runs on: its cores and its memory."""

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

#: glibc's parameters (malloc.h), and sizes in bytes up to which freed memory is kept.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_KEPT_BYTES, _KEPT_BLOCK_BYTES = 1 << 28, 1 << 25


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
    """Make this process ready to work on frame after frame.

    To be called before NumPy and OpenCV load. Memory that a frame has left is kept for the next
    one: to give it back to the system and get it again, page by page, took a tenth of a run. These
    libraries stay in one thread each, as frames are worked on side by side anyway: theirs would
    wait, busily, for the next call.
    """
    for name in ("OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
        os.environ.setdefault(name, "1")
    import ctypes

    with contextlib.suppress(AttributeError, OSError, TypeError):  # not glibc
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_M_MMAP_THRESHOLD, _KEPT_BLOCK_BYTES)
        mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)
