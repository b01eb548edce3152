"""Measuring time fairly: samples by contestant, a set number of cores, and child processes."""

from __future__ import annotations

import contextlib
import json
import os
import statistics
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import cv2
from packaging.requirements import Requirement

import motionstereo_cli


class Key(NamedTuple):
    """What was measured: a part of the benchmark, a case in it, a contestant, on how many cores."""

    part: str
    case: str
    contestant: str
    cores: int


@dataclass(frozen=True, slots=True)
class Cost:
    """What one measurement, or the median of several, came to.

    Attributes:
        seconds: wall time.
        peak_mb: largest resident memory of the process in MB (1e6 bytes); None where several
            contestants shared one.
        cpu_s: processor time of all threads together; None where it was not measured.
    """

    seconds: float
    peak_mb: float | None = None
    cpu_s: float | None = None

    @property
    def work_s(self) -> float:
        """Processor time, which suffers least from other programs, or else wall time."""
        return self.seconds if self.cpu_s is None else self.cpu_s


class Samples:
    """All measurements, in the order in which their keys came up first."""

    def __init__(self) -> None:
        self._costs: defaultdict[Key, list[Cost]] = defaultdict(list)

    def add(self, part: str, case: str, contestant: str, cores: int, cost: Cost) -> None:
        """Take in one measurement."""
        self._costs[Key(part, case, contestant, cores)].append(cost)

    def seconds(self, key: Key) -> list[float]:
        """Return all measured times of one contestant."""
        return [cost.seconds for cost in self._costs[key]]

    def medians(self) -> dict[Key, Cost]:
        """Return the median times of each contestant, and the largest peak of its memory."""
        return {
            key: Cost(
                statistics.median(cost.seconds for cost in costs),
                max((cost.peak_mb for cost in costs if cost.peak_mb is not None), default=None),
                _median_or_none([cost.cpu_s for cost in costs if cost.cpu_s is not None]),
            )
            for key, costs in self._costs.items()
        }


def _median_or_none(values: Sequence[float]) -> float | None:
    return statistics.median(values) if values else None


@contextlib.contextmanager
def on_cores(cores: int) -> Iterator[None]:
    """Let this process, all its threads, and the children it starts use so many cores.

    Where the system knows no affinity (it is not Linux), cv2 and the libraries that read the
    environment are held to as many threads.
    """
    names = [f"{name}_NUM_THREADS" for name in ("OMP", "OPENBLAS")]
    environment = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, str(cores)))
    cv2_threads = cv2.getNumThreads()
    cv2.setNumThreads(cores)
    allowed = _affinity()
    _set_affinity(sorted(allowed)[:cores])
    try:
        yield
    finally:
        _set_affinity(allowed)
        cv2.setNumThreads(cv2_threads)
        for name, value in environment.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def core_count() -> int:
    """Return how many cores this process may use."""
    return len(_affinity()) or os.cpu_count() or 1


if sys.platform == "linux":

    def _affinity() -> Sequence[int]:
        return sorted(os.sched_getaffinity(0))

    def _set_affinity(cores: Sequence[int]) -> None:
        for thread in os.listdir("/proc/self/task"):
            with contextlib.suppress(ProcessLookupError):  # it has just ended
                os.sched_setaffinity(int(thread), cores)

else:

    def _affinity() -> Sequence[int]:
        return ()

    def _set_affinity(cores: Sequence[int]) -> None:
        pass


#: A new process is charged with the memory of the one that started it, so a small one starts it.
_LAUNCHER = """
import json, os, sys, time
started = time.perf_counter()
child = os.posix_spawn(sys.argv[1], sys.argv[1:], os.environ)
_, status, usage = os.wait4(child, 0)
seconds = time.perf_counter() - started
cpu_s = usage.ru_utime + usage.ru_stime
code = os.waitstatus_to_exitcode(status)
print(json.dumps([seconds, cpu_s, usage.ru_maxrss, code]), file=sys.stderr)
"""


def python(*arguments: str | Path) -> Cost:
    """Run Python with some arguments to its end, and return what it cost from start to exit.

    Raises:
        RuntimeError: it failed.
    """
    done = subprocess.run(
        [sys.executable, "-ISc", _LAUNCHER, sys.executable, *map(str, arguments)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        check=True,
        # An installation has its modules compiled, and so has this once it has run.
        env={k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"},
    )
    said, _, report = done.stderr.rstrip("\n").rpartition("\n")
    seconds, cpu_s, peak, exit_code = json.loads(report)
    if exit_code:
        raise RuntimeError(f"python {' '.join(map(str, arguments))}: {said or exit_code}")
    peak_mb = peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6
    return Cost(seconds, peak_mb, cpu_s)


def installed_mb(name: str) -> dict[str, float]:
    """Return the size in MB of a distribution and of all that it needs, by name."""
    sizes: dict[str, float] = {}
    waiting = [name]
    while waiting:
        each = waiting.pop()
        if each in sizes:
            continue
        try:
            found = metadata.distribution(each)
        except metadata.PackageNotFoundError:
            continue  # not needed on this system
        files = [Path(str(file.locate())) for file in found.files or []]
        if each == name:  # its files may lie elsewhere
            files = list(Path(motionstereo_cli.__file__).parent.rglob("*"))
        sizes[each] = sum(file.stat().st_size for file in files if file.is_file()) / 1e6
        needs = [Requirement(need) for need in found.requires or []]
        # Not what extras need, or other systems.
        waiting += [n.name for n in needs if n.marker is None or n.marker.evaluate({"extra": ""})]
    return sizes
