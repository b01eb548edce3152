"""The cores and the memory that this process may use."""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import gc
import math
import os
import sys

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.reading import read_text

#: A container's quota: processor time and its period in us; cgroups version 2 has one file,
#: version 1 two.
_QUOTAS = (
    ("/sys/fs/cgroup/cpu.max",),
    ("/sys/fs/cgroup/cpu/cpu.cfs_quota_us", "/sys/fs/cgroup/cpu/cpu.cfs_period_us"),
)

#: Options of glibc's malloc. Arrays of up to 16 MB (M_MMAP_THRESHOLD) are taken from memory that is
#: kept, of which 64 MB may lie idle (M_TRIM_THRESHOLD), in two pools for all threads (M_ARENA_MAX).
_MALLOC = {-3: 1 << 24, -1: 1 << 26, -8: 2}


#: What threads and their stacks, the encoders, and the arrays of a small frame need.
_LEAST_BYTES = 160_000_000
#: Memory of all frames in flight by default, and of a pixel of each: memories of both views,
#: disparity, depth, and the workspace of a thread.
_IN_FLIGHT_BYTES, _BYTES_PER_PX = 1 << 30, 110


def usable_cores() -> int:
    """Return how many cores this process may use: by its affinity, and by a container's quota."""
    try:
        cores = len(os.sched_getaffinity(0))
    except AttributeError:  # not on this system
        cores = os.cpu_count() or 1
    for paths in _QUOTAS:
        with contextlib.suppress(InputError, ValueError):  # none, which is "max" or -1
            quota, period = (
                int(word) for path in paths for word in read_text(path, "a quota", 1000).split()
            )
            if quota > 0:
                return max(1, min(cores, math.ceil(quota / period)))
    return cores


def frames_at_once(width: int, height: int) -> int:
    """Return how many frames of a size in px are matched at the same time, limited by memory."""
    return max(1, min(usable_cores(), _IN_FLIGHT_BYTES // (_BYTES_PER_PX * width * height)))


def check_memory() -> None:
    """Check that a limit on this process's memory leaves enough for the work.

    Close to a limit (``ulimit -v``), libraries end the process without a word.

    Raises:
        MemoryError: it leaves too little.
    """
    try:
        import resource

        limit, _ = resource.getrlimit(resource.RLIMIT_AS)
        pages = int(read_text("/proc/self/statm", "a count", 1000).split()[0])
        taken = pages * resource.getpagesize()
    except (ImportError, InputError, ValueError, LookupError):
        return  # not on this system
    if limit != resource.RLIM_INFINITY and limit - taken < _LEAST_BYTES:
        raise MemoryError


def prepare() -> None:
    """Set the libraries' defaults; called before OpenCV and OpenBLAS load.

    Each stays in one thread. Frames are processed side by side anyway; idle threads of these
    libraries would spin and waste processor time.

    Freed memory is kept: each frame needs arrays of the same sizes again, and memory that is new
    from the system costs a page fault for every page. At the end nothing is collected: the process
    gives all of it back anyway.
    """
    atexit.unregister(gc.freeze)  # once, however often this is called
    atexit.register(gc.freeze)
    for name in ("OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
        os.environ.setdefault(name, "1")
    if sys.platform == "linux":
        libc = ctypes.CDLL(None)
        for option, value in _MALLOC.items() if hasattr(libc, "mallopt") else ():  # not musl
            libc.mallopt(option, value)
