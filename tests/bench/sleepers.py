"""A cluster whose workers sleep in the place of processing: ``python -m bench.sleepers``.

The workers are spread over processes, as so many in one need minutes to start. The scheduler leaves
its address in a file, once all workers are there, and at the end what it counted.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from msgspec import structs

from motionstereo_cli.batch import work as worker_side
from motionstereo_cli.batch.own_folder import write_status
from motionstereo_cli.batch.task import Task
from motionstereo_cli.batch.work import Pulse
from motionstereo_cli.sinks.records import Status

_FRAME_S, _LOOK_S = 0.1, 0.2
_PER_PROCESS = 25


def _sleeper(seconds: float) -> Callable[..., None]:
    def work(task: Task, tell: Callable[[int], object], stops: Callable[[], bool]) -> None:
        status = Status(task.name, "running", plan=task.plan_hash)
        write_status(task.out, status)
        pulse = Pulse(stops, tell, task.tell_s)
        begin_s = time.monotonic()
        while time.monotonic() < begin_s + seconds:
            time.sleep(min(_FRAME_S, seconds))
            pulse()
        write_status(task.out, structs.replace(status, status="done", frames=5, seconds=seconds))

    return work


async def _workers(address: str, count: int) -> None:
    """Sleep for a scheduler until it has gone."""
    from distributed import Worker

    async with contextlib.AsyncExitStack() as stack:
        workers = [
            await stack.enter_async_context(Worker(address, nthreads=1, dashboard=False))
            for _ in range(count)
        ]
        for worker in workers:
            await worker.finished()


async def _scheduler(file: Path, workers: int, seconds: float) -> None:
    """Run a scheduler, with workers in processes of their own, until SIGTERM."""
    from distributed import Scheduler

    told: list[float] = []
    ended = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, ended.set)
    async with Scheduler(host="127.0.0.1", dashboard=False, dashboard_address=None) as scheduler:
        whole = scheduler.log_event

        def log_event(topic: Any, message: Any) -> Any:
            if topic == "motionstereo-frames":
                told.append(time.monotonic())
            return whole(topic, message)

        scheduler.log_event = log_event
        scheduler.stream_handlers["log_event"] = scheduler.handlers["log_event"] = log_event
        command = [sys.executable, "-m", "bench.sleepers", str(file), "--join", scheduler.address]
        processes = [
            subprocess.Popen(
                [*command, "--seconds", str(seconds), "--workers", str(min(_PER_PROCESS, rest))]
            )
            for rest in range(workers, 0, -_PER_PROCESS)
        ]
        while len(scheduler.workers) < workers and not ended.is_set():
            await asyncio.sleep(_LOOK_S)
        file.write_text(json.dumps({"address": scheduler.address}))
        await ended.wait()
        for process in processes:
            process.kill()
            process.wait()
    counts = [sum(at <= each < at + 1 for each in told) for at in told]
    mean = len(told) / max(told[-1] - told[0], 1.0) if told else 0.0
    file.write_text(
        json.dumps(
            {"told": len(told), "most a second": max(counts, default=0), "mean a second": mean}
        )
    )


def main() -> None:
    """Run until SIGTERM."""
    import dask

    parser = argparse.ArgumentParser()
    parser.add_argument("file", type=Path, help="for the address, and at the end the counts")
    parser.add_argument("--workers", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=1.0)
    parser.add_argument("--join", help="address of a scheduler to work for")
    given = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    quiet = {"logging.distributed": "error", "distributed.worker.profile.enabled": False}
    with dask.config.set(quiet):
        if given.join:
            vars(worker_side)["work"] = _sleeper(given.seconds)
            asyncio.run(_workers(given.join, given.workers))
        else:
            asyncio.run(_scheduler(given.file, given.workers, given.seconds))


if __name__ == "__main__":
    main()
