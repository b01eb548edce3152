"""A cluster whose workers sleep in the place of processing: ``python -m bench.sleepers``.

It leaves its address in a file, and there as well how many reports of progress the scheduler got.
"""

from __future__ import annotations

import argparse
import json
import signal
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from motionstereo_cli.batch import task
from motionstereo_cli.batch.own_folder import write_status
from motionstereo_cli.batch.task import Pulse
from motionstereo_cli.sinks.records import Status

_FRAME_S = 0.1


def _sleeper(seconds: float) -> Callable[..., None]:
    def work(
        given: Mapping[str, Any], tell: Callable[[int], object], stops: Callable[[], bool]
    ) -> None:
        out, name = Path(given["out"]), given["name"]
        write_status(out, Status(name, "running", plan=given["hash"]))
        pulse = Pulse(stops, tell, given["tell_s"])
        begin_s = time.monotonic()
        while time.monotonic() < begin_s + seconds:
            time.sleep(min(_FRAME_S, seconds))
            pulse()
        write_status(out, Status(name, "done", frames=5, seconds=seconds, plan=given["hash"]))

    return work


def main() -> None:
    """Run until SIGTERM."""
    from distributed import LocalCluster, Scheduler

    parser = argparse.ArgumentParser()
    parser.add_argument("file", type=Path, help="for the address, and at the end the count")
    parser.add_argument("--workers", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=1.0)
    given = parser.parse_args()
    vars(task)["work"] = _sleeper(given.seconds)
    told: list[float] = []
    whole = Scheduler.log_event

    def log_event(self: Any, topic: Any, message: Any) -> Any:
        if topic == "motionstereo-frames":
            told.append(time.monotonic())
        return whole(self, topic, message)

    Scheduler.log_event = log_event
    ended = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    options = {"processes": False, "protocol": "tcp://", "host": "127.0.0.1"}
    with LocalCluster(
        n_workers=given.workers, threads_per_worker=1, dashboard_address=None, **options
    ) as cluster:
        cluster.scheduler.handlers["log_event"] = cluster.scheduler.log_event
        given.file.write_text(json.dumps({"address": cluster.scheduler_address}))
        ended.wait()
    most = max((sum(at <= each < at + 1 for each in told) for at in told), default=0)
    given.file.write_text(json.dumps({"told": len(told), "most a second": most}))


if __name__ == "__main__":
    main()
