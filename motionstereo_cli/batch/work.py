"""Do one task of a batch, in the process of a worker."""

from __future__ import annotations

import os
import random
import socket
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path

from msgspec import structs

from motionstereo_cli.batch.own_folder import open_log_of, pieces_path, write_status
from motionstereo_cli.batch.pieces import Piece, join_pieces, run_piece
from motionstereo_cli.batch.stored import at_hand, put_back, put_status
from motionstereo_cli.batch.task import Task
from motionstereo_cli.errors import BusyError, MotionStereoError, shortage
from motionstereo_cli.files.folders import check_no_links
from motionstereo_cli.runs.cores import prepare
from motionstereo_cli.runs.plan import RunPlan
from motionstereo_cli.runs.record import RunReport
from motionstereo_cli.runs.run import Watcher, run
from motionstereo_cli.sinks.records import Status

#: Time between two checks whether to stop, in s.
LOOK_S = 0.5
#: How long a killed process may keep its lock on a folder, in s, until its children end.
_BUSY_S = 60.0


def work(
    task: Task,
    tell: Callable[[int], object] = lambda frames: None,
    stops: Callable[[], bool] = lambda: False,
) -> None:
    """Process a recording as ``run --resume`` does, or a piece of it.

    The status file tells its outcome. A piece writes it only if it failed: the coordinator has
    written that its recording is running.

    Args:
        task: what to do.
        tell: called at intervals with the number of frames done.
        stops: called at intervals; whether to leave a checkpoint and end.
    """
    worker = f"{socket.gethostname()}:{os.getpid()}"
    status = Status(task.name, "running", worker=worker, plan=task.plan_hash)
    if stops():
        return
    prepare()
    if task.piece is None:
        write_status(task.out, status)
    with open_log_of(task.out, task.name) as lines:

        def say(kind: str, text: str) -> None:
            print(f"{kind}: {text}", file=lines, flush=True)

        started_s = time.monotonic()
        try:
            whole = RunPlan.of_json(task.plan)
            home = pieces_path(task.out, task.name)
            for path in (task.folder, home):
                check_no_links(path, task.out)
            # The frames were counted when the pieces were made.
            tells = tell if task.pieces is None else lambda _: None
            pulse = Pulse(stops, tells, task.tell_s)
            watcher = Watcher(say, progress=pulse)
            with at_hand(whole, task) as plan:
                if task.piece is not None:
                    run_piece(plan, task.piece, home, watcher, seek=task.seek)
                    return
                report = _run(plan, task.pieces, home, watcher)
            if not report.interrupted:
                put_back(task)
            status = _ended(status, report)
            for line in report.damage:
                say("warning", line)
        except KeyboardInterrupt:  # within a piece, which then starts again
            status = structs.replace(status, status="interrupted")
        except MotionStereoError as error:
            status = structs.replace(status, status="failed", reason=str(error))
        except Exception as error:
            say("error", traceback.format_exc())
            reason = shortage(error) or f"internal: {type(error).__name__}: {error}"
            status = structs.replace(status, status="failed", reason=reason)
        seconds = status.seconds or time.monotonic() - started_s
        status = structs.replace(status, seconds=seconds)
        say("note" if not status.reason else "error", f"{status.status} {status.reason}".strip())
    write_status(task.out, status)
    put_status(task)


def _run(plan: RunPlan, pieces: Sequence[Piece] | None, home: Path, watcher: Watcher) -> RunReport:
    until_s = time.monotonic() + _BUSY_S
    while True:
        try:
            if pieces is None:
                return run(plan, watcher)
            return join_pieces(plan, pieces, home, watcher)
        except BusyError:
            if time.monotonic() > until_s:
                raise
            time.sleep(LOOK_S)


def _ended(status: Status, report: RunReport) -> Status:
    how = "interrupted" if report.interrupted else "damaged" if report.damage else "done"
    return structs.replace(
        status,
        status=how,
        frames=report.frames,
        seconds=report.wall_s,
        charged=report.charged,
        matched=report.matched,
        damage=len(report.damage),
        warnings=len(report.warnings),
        said="; ".join((*report.damage, *(each.text for each in report.warnings))),
    )


class Pulse:
    """Called after each frame: reports progress, and ends the run when asked to.

    Args:
        stops: whether to end.
        tell: called with the number of frames done.
        tell_s: minimum time between two calls of it, in s.
    """

    def __init__(
        self, stops: Callable[[], bool], tell: Callable[[int], object], tell_s: float
    ) -> None:
        self._stops, self._tell, self._tell_s = stops, tell, tell_s
        self._frames, self._look_at_s = 0, 0.0
        # Workers that begin together do not report together.
        self._tell_at_s = time.monotonic() + random.uniform(0, tell_s)

    def __call__(self) -> None:
        """Count a frame.

        Raises:
            KeyboardInterrupt: the run is to end.
        """
        self._frames += 1
        now_s = time.monotonic()
        if now_s < self._look_at_s:
            return
        self._look_at_s = now_s + LOOK_S
        if now_s >= self._tell_at_s:
            self._tell_at_s = now_s + self._tell_s
            self._tell(self._frames)
        if self._stops():
            raise KeyboardInterrupt
