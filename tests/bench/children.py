"""Running the command in children of this process, which may crash, hang, be killed or run dry.

A child is a fork: it has all modules loaded, so that thousands of runs take minutes. Call
:func:`warm_up` first, and start no threads before.
"""

from __future__ import annotations

import contextlib
import os
import resource
import select
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2

from motionstereo_cli.__main__ import main


@dataclass(frozen=True, slots=True)
class Ended:
    """How a child ended.

    Attributes:
        exit_code: its exit code; negative = the number of the signal that ended it.
        said: what it wrote to standard error.
        wall_s, cpu_s: what it took.
        rss_bytes: the most memory that it held.
        killed: it was ended from here: because it was to be, or it took too long.
    """

    exit_code: int
    said: str
    wall_s: float
    cpu_s: float
    killed: bool
    rss_bytes: int = 0

    @property
    def errors(self) -> list[str]:
        """Its lines of error."""
        return [line for line in self.said.splitlines() if line.startswith("error: ")]

    @property
    def crashed(self) -> bool:
        """Whether it ended for a reason that nobody foresaw."""
        return "Traceback" in self.said or "internal: " in self.said


def warm_up(args: Sequence[str]) -> None:
    """Run the command here, so that children find everything loaded and compiled.

    Raises:
        RuntimeError: it failed.
    """
    cv2.setNumThreads(1)  # a pool of threads would not live on in a fork
    handler = signal.getsignal(signal.SIGTERM)
    exit_code = main(args)
    signal.signal(signal.SIGTERM, handler)
    if exit_code:
        raise RuntimeError(f"motionstereo {' '.join(args)}: exit code {exit_code}")


def call(
    args: Sequence[str],
    *,
    seconds: float,
    largest_file_bytes: int | None = None,
) -> Ended:
    """Run the command in a child.

    Args:
        args: its arguments.
        seconds: after so long it is killed, as by ``kill -9``.
        largest_file_bytes: no file it writes may grow larger, as if the disk were full.
    """

    def child() -> int:
        if largest_file_bytes is not None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file_bytes, largest_file_bytes))
        return main(args)

    return fork(child, seconds=seconds)


def fork(child: Callable[[], int], *, seconds: float) -> Ended:
    """Run a function in a child; what it returns is the child's exit code."""
    reads, writes = os.pipe()
    started_s = time.monotonic()
    pid = os.fork()
    if not pid:
        _be_child(child, writes)
    os.close(writes)
    said, killed = b"", False
    while True:
        left_s = started_s + seconds - time.monotonic()
        if not killed and left_s <= 0:
            os.kill(pid, signal.SIGKILL)
            killed = True
        if select.select([reads], [], [], None if killed else left_s)[0]:
            piece = os.read(reads, 1 << 16)
            if not piece:
                break
            said += piece
    os.close(reads)
    _, status, usage = os.wait4(pid, 0)
    return Ended(
        os.waitstatus_to_exitcode(status),
        said.decode(errors="replace"),
        time.monotonic() - started_s,
        usage.ru_utime + usage.ru_stime,
        killed,
        usage.ru_maxrss * 1024,
    )


def _be_child(child: Callable[[], int], writes: int) -> None:
    exit_code = 70
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(writes, 2)
        os.close(writes)
        sys.stdout = os.fdopen(1, "w", closefd=False)
        sys.stderr = os.fdopen(2, "w", closefd=False)
        exit_code = child()
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(BaseException):
            sys.stderr.flush()
        os._exit(exit_code)
