"""A share of a batch without a scheduler, as array jobs take it.

Each shard takes the recordings whose names hash to it. Shards of one batch need not know of one
another: they may run at the same time on several machines that share the output folder, or one
after the other, and any of them writes the table of all.
"""

from __future__ import annotations

import contextlib
import hashlib
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from motionstereo_cli.batch.builds import check_builds, own_builds
from motionstereo_cli.batch.ledger import BatchWatcher, Ledger, inputs_of
from motionstereo_cli.batch.own_folder import claim, read_status, shard_path
from motionstereo_cli.batch.task import LOCAL, Storage, Task
from motionstereo_cli.errors import SettingsError
from motionstereo_cli.files.lock import locked
from motionstereo_cli.runs.cores import usable_cores
from motionstereo_cli.runs.interrupts import children_ignoring_interrupts
from motionstereo_cli.runs.plan import RunPlan
from motionstereo_cli.sinks.records import Status

if TYPE_CHECKING:
    from multiprocessing.synchronize import Event

#: A task that ends its process is started this often.
_STARTS = 2

#: In a worker: set when it is to leave a checkpoint and end; and held while it has a task.
_stop: Event | None = None
_busy = threading.Lock()


@dataclass(frozen=True, slots=True)
class Shard:
    """One of so many shares.

    Attributes:
        index: which one, counted from 0 or from 1: ``count`` is the same as 0.
        count: how many there are.
    """

    index: int
    count: int

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Return the shard that ``i/N`` names.

        Raises:
            SettingsError: it names none.
        """
        index, _, count = text.partition("/")
        if text.isascii() and index.isdecimal() and count.isdecimal() and len(text) < 16:
            shard = cls(int(index), int(count))
            if 0 <= shard.index <= shard.count and shard.count > 0:
                return shard
        raise SettingsError(f"--shard cannot be {text!r}: give i/N, with i from 0 to N-1 or 1 to N")

    @property
    def name(self) -> str:
        """Its name for files."""
        return f"{self.index % self.count}-of-{self.count}"

    def has(self, recording: str) -> bool:
        """Return whether a recording belongs to the shard."""
        digest = hashlib.sha256(recording.encode("utf-8", "surrogateescape")).digest()
        return int.from_bytes(digest[:8]) % self.count == self.index % self.count


def run_shard(
    plans: Mapping[str, RunPlan],
    out: Path,
    watcher: BatchWatcher,
    *,
    shard: Shard,
    inputs: Iterable[Path] = (),
    retry_failed: bool = False,
    workers: int | None = None,
    storage: Storage = LOCAL,
) -> list[Status]:
    """Process the recordings of a shard, return their statuses, and write the table of all.

    Args:
        plans: what to do for each recording of the whole batch, by name.
        out: folder of the batch.
        watcher: receives the progress.
        shard: which share.
        inputs: further files that are read, and must not be written to.
        retry_failed: also process recordings that failed or were lost.
        workers: processes; None: as many as cores.
        storage: what does not lie on this machine's disk.

    Raises:
        InputError: another shard ran with other versions.
        OutputError: the folder of the batch cannot be written, or this shard is running.
        KeyboardInterrupt: it was interrupted; the recordings under way have left checkpoints.
    """
    with locked(out, shared=True):
        claim(out, (*inputs, *inputs_of(plans)))
        with locked(shard_path(out, shard.name)):
            ledger = Ledger(plans, out, watcher, f"shard-{shard.name}", storage)
            waiting = [
                name
                for name in plans
                if shard.has(name) and ledger.to_do(name, retry_failed=retry_failed)
            ]
            try:
                if waiting:
                    _process(ledger, waiting, min(workers or usable_cores(), len(waiting)))
            finally:
                ledger.reread()
                ledger.renew(at_once=True)
            return [status for name, status in ledger.known.items() if shard.has(name)]


def _process(ledger: Ledger, names: Iterable[str], workers: int) -> None:
    """Keep worker processes busy with one recording each, until all were tried."""
    waiting = deque(names)
    jobs = max(usable_cores() // workers, 1)
    with contextlib.ExitStack() as stack:
        context: Any = multiprocessing.get_context()
        if "forkserver" in multiprocessing.get_all_start_methods():
            context = multiprocessing.get_context("forkserver")
            context.set_forkserver_preload(["motionstereo_cli.batch.work"])
        stop = context.Event()
        idle = [stack.enter_context(_Worker(context, stop)) for _ in range(workers)]
        check_builds(ledger.out, idle[0].submit(own_builds).result())
        under_way: dict[Future[Any], tuple[_Worker, str, int]] = {}

        def start(worker: _Worker, name: str, trial: int) -> None:
            task = ledger.task_of(name, jobs)
            under_way[worker.submit(_work, task)] = worker, name, trial

        try:
            while waiting or under_way:
                while waiting and idle:
                    start(idle.pop(), waiting.popleft(), 1)
                for future in wait(under_way, return_when=FIRST_COMPLETED).done:
                    worker, name, trial = under_way.pop(future)
                    if isinstance(future.exception(), BrokenProcessPool):
                        worker.restart()
                        if trial < _STARTS:
                            start(worker, name, trial + 1)
                            continue
                    idle.append(worker)
                    _note(ledger, name, future)
        except KeyboardInterrupt:
            stop.set()
            for future, (_, name, _) in under_way.items():
                _note(ledger, name, future)
            raise


def _note(ledger: Ledger, name: str, future: Future[Any]) -> None:
    """Note how a recording's process has ended."""
    if error := future.exception():
        ledger.failed(name, error, died=isinstance(error, BrokenProcessPool))
    else:
        ledger.ended(read_status(ledger.out, name))


class _Worker:
    """A process that does one task at a time, and is started again after it has died."""

    def __init__(self, context: Any, stop: Event) -> None:
        self._context, self._stop = context, stop
        self._pool = self._started()

    def __enter__(self) -> _Worker:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def _started(self) -> ProcessPoolExecutor:
        pool = ProcessPoolExecutor(
            1,
            mp_context=self._context,
            initializer=_prepared,
            initargs=(self._stop, dict(os.environ)),
        )
        with children_ignoring_interrupts():
            pool.submit(int)  # the first task starts the process
        return pool

    def restart(self) -> None:
        """Start a new process in the place of one that has died."""
        self._pool.shutdown(cancel_futures=True)
        self._pool = self._started()

    def submit(self, function: Callable[..., Any], *given: Any) -> Future[Any]:
        """Have the process call a function."""
        return self._pool.submit(function, *given)


def _prepared(stop: Event, environ: Mapping[str, str]) -> None:
    global _stop  # noqa: PLW0603  # an event goes to a process at its start only
    _stop = stop
    os.environ.update(environ)  # the server that forks may be older than the batch
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process after its parent has, with a checkpoint of what it has begun."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    assert _stop is not None
    parent.join()
    _stop.set()
    with _busy:
        os._exit(1)


def _work(task: Task) -> None:
    from motionstereo_cli.batch.work import work

    assert _stop is not None
    with _busy:
        work(task, stops=_stop.is_set)
