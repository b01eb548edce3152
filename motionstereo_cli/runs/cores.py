"""The cores and the memory that this process may use, and how it uses them."""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import sys

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.reading import read_text

#: Processor time and the time that it is for, in us, of the group of processes that a container
#: is: version 2 in one file, version 1 in two.
_QUOTAS = (
    ("/sys/fs/cgroup/cpu.max",),
    ("/sys/fs/cgroup/cpu/cpu.cfs_quota_us", "/sys/fs/cgroup/cpu/cpu.cfs_period_us"),
)

#: Options of glibc's malloc. Arrays of up to 16 MB (M_MMAP_THRESHOLD) are taken from memory that is
#: kept, of which 64 MB may lie idle (M_TRIM_THRESHOLD), in two pools for all threads (M_ARENA_MAX).
_MALLOC = {-3: 1 << 24, -1: 1 << 26, -8: 2}


#: Threads and their stacks, the encoders, and the arrays of a small frame take so much.
_LEAST_BYTES = 160_000_000


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


def check_memory() -> None:
    """Make sure that a limit on this process's memory leaves some for the work.

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
    """Make the libraries' defaults fit the work; called before OpenCV and OpenBLAS load.

    They stay in one thread each. Frames are worked on side by side anyway: the threads of these
    libraries would wait for their next call, and take processor time for it.

    Memory that is freed is kept. Each frame needs the arrays of the last one again; taken from
    the system anew, every page of them costs an interrupt.
    """
    for name in ("OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
        os.environ.setdefault(name, "1")
    if sys.platform == "linux":
        libc = ctypes.CDLL(None)
        for option, value in _MALLOC.items() if hasattr(libc, "mallopt") else ():  # not musl
            libc.mallopt(option, value)
