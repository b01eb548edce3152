"""Many recordings, on this machine or a cluster, by Dask.

The state is on disk: a ``run.json`` in the folder of each complete recording, and a status file for
each. Futures only tell when to read it, so a batch whose client or workers were killed continues
from the disk.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import math
import time
from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from motionstereo_cli.batch.builds import difference, own_builds
from motionstereo_cli.batch.cluster import Cluster, client_of, threads_of
from motionstereo_cli.batch.ledger import BatchWatcher, Ledger, inputs_of
from motionstereo_cli.batch.own_folder import claim, pieces_path, read_status
from motionstereo_cli.batch.status import FAILED
from motionstereo_cli.batch.task import LOCAL, Storage, Task
from motionstereo_cli.errors import InputError, MotionStereoError, OutputError
from motionstereo_cli.files.lock import locked
from motionstereo_cli.runs.cores import usable_cores
from motionstereo_cli.runs.plan import RunPlan
from motionstereo_cli.sinks.records import Status

if TYPE_CHECKING:
    from distributed import Client, Future

    from motionstereo_cli.batch.pieces import Piece
    from motionstereo_cli.types import Say

#: Topic of the workers' progress.
_PROGRESS = "motionstereo-frames"
#: Mean number of reports of progress a second, of all workers, and minimum time between two of one.
_TOLD_PER_S, _TELL_S = 25, 0.5
#: Between two looks at what has ended, time for so many workers a second, and maximum time in s:
#: with many workers, more end at once, which costs little more than one.
_GATHERED_PER_S, _MAX_PAUSE_S = 2000.0, 0.2
#: Workers with other builds that are excluded before the batch fails.
_TRIES = 20
#: Minimum time between counting the workers, in s.
_ASK_S = 2.0


def run_batch(
    plans: Mapping[str, RunPlan],
    out: Path,
    watcher: BatchWatcher,
    *,
    cluster: Cluster,
    inputs: Iterable[Path] = (),
    retry_failed: bool = False,
    pieces: int | None = None,
    detach: bool = False,
    storage: Storage = LOCAL,
) -> list[Status]:
    """Process recordings, and return the status of each, in order.

    Complete recordings are skipped; failed ones are tried again only with ``retry_failed``.

    Args:
        plans: the plan of each recording, by the name of its folder under ``out``.
        out: folder of the batch.
        watcher: callbacks.
        cluster: where to process.
        inputs: further files that are read, and must not be written to.
        retry_failed: try failed and lost ones again.
        pieces: into how many pieces each recording is cut; None: as many as keep all workers busy
            if there are fewer recordings than workers and they can be cut.
        detach: leave the tasks to the scheduler and return; recordings are not cut.
        storage: what does not lie on this machine's disk.

    Raises:
        SettingsError: a recording cannot be done in pieces, and pieces were asked for.
        InputError: the cluster cannot be reached, or its versions differ.
        OutputError: the folder of the batch cannot be written.
        KeyboardInterrupt: it was interrupted; unfinished recordings have checkpoints.
    """
    with locked(out):
        claim(out, (*inputs, *inputs_of(plans)))
        ledger = Ledger(plans, out, watcher, "batch", storage)
        waiting = [name for name in plans if ledger.to_do(name, retry_failed=retry_failed)]
        if waiting:
            pieces = 1 if detach else pieces
            asked = pieces is not None

            def items(workers: int) -> list[Item]:
                count = pieces or math.ceil(workers / len(waiting))
                each = (
                    _items(name, plans[name], count, watcher.say, asked=asked) for name in waiting
                )
                return list(itertools.chain.from_iterable(each))

            # No more processes are started than there are tasks.
            tasks = items(cluster.workers or usable_cores()) if cluster.local else []
            with client_of(cluster, len(tasks), watcher.say) as (client, builds):
                threads = threads_of(client)
                jobs = max(usable_cores() // threads, 1) if cluster.local else 1
                batch = _Batch(client, ledger, jobs, builds)
                if detach:
                    batch.leave(tasks or items(threads))
                else:
                    batch.process(tasks or items(threads))
        ledger.renew(at_once=True)
        return ledger.statuses


@dataclass(frozen=True, slots=True)
class Item:
    """A task: process a recording or a piece of one, or join the pieces.

    Attributes:
        name: the recording.
        piece: which piece.
        pieces: all pieces of the recording; empty where it is not cut.
        measured: the settings, and those of the output, with what was measured for all pieces,
            and the names of that.
        seek: whether the piece may begin by seeking.
    """

    name: str
    piece: Piece | None = None
    pieces: tuple[Piece, ...] | None = None
    measured: Mapping[str, Any] = field(default_factory=dict)
    seek: bool = True


def _items(name: str, plan: RunPlan, count: int, say: Say, *, asked: bool) -> list[Item]:
    """Return the tasks of a recording that can start at once."""
    if count > 1:
        from motionstereo_cli.batch.pieces import pieces_of
        from motionstereo_cli.runs.opening import settled

        try:
            pieces = tuple(pieces_of(plan, count))
            if len(pieces) > 1:
                whole = settled(plan, lambda kind, text: say(kind, f"{name}: {text}")).as_json()
                found = ("settings", "output_settings", "measured")
                measured = {name: whole[name] for name in found}
                return [Item(name, piece, pieces, measured) for piece in pieces]
        except MotionStereoError:
            if asked:
                raise
            # As one task, which reports what is wrong.
    return [Item(name)]


class _Batch:
    """The tasks of a batch on the workers of a cluster.

    Args:
        client: of the cluster.
        ledger: the statuses.
        jobs: frames that a task matches at a time.
        builds: of all workers.
    """

    def __init__(self, client: Client, ledger: Ledger, jobs: int, builds: dict[str, str]) -> None:
        self._client, self._ledger, self._jobs, self._builds = client, ledger, jobs, builds
        self._room = _Room(client)
        self._tries = 0

    def leave(self, items: Iterable[Item]) -> None:
        """Give all tasks to the scheduler, which keeps them when this client has gone."""
        from distributed import fire_and_forget

        fire_and_forget(self._submit(list(items)))

    def process(self, items: Iterable[Item]) -> None:
        """Keep each worker busy with one task at a time, until all have ended."""
        from distributed import as_completed

        waiting = deque(items)
        left = Counter(item.name for item in waiting)
        known, client = self._ledger.known, self._client
        known |= {name: Status(name) for name in left}
        client.subscribe_topic(_PROGRESS, lambda event: self._ledger.watcher.frames(event[1]))
        ended = as_completed()
        under_way: dict[object, Item] = {}

        def fill() -> None:
            # No more at a time than there are workers: all tasks that a worker holds are
            # suspects when it dies.
            items: list[Item] = []
            while waiting and len(under_way) + len(items) < self._room.tasks:
                item = waiting.popleft()
                if known[item.name].status not in FAILED:
                    if item.piece is not None:
                        self._ledger.begin(item.name)
                    items.append(item)
            for item, future in zip(items, self._submit(items), strict=True):
                under_way[future.key] = item
                ended.add(future)

        try:
            fill()
            for futures in ended.batches():
                for future in futures:
                    item = under_way.pop(future.key)
                    if self._left_out(future):
                        waiting.appendleft(item)
                        continue
                    left[item.name] -= 1
                    if item.piece is None or not self._went_well(item, future):
                        self._note(item.name, future)
                    elif not left[item.name]:
                        following = self._following(item)
                        waiting.extendleft(reversed(following))
                        left[item.name] = len(following)
                # Each call from this thread would wake that of the connection.
                self._client.loop.add_callback(_release, futures)
                fill()
                time.sleep(min(self._room.tasks / _GATHERED_PER_S, _MAX_PAUSE_S))
        except KeyboardInterrupt:
            client.run(_stop, str(self._ledger.out), time.time(), on_error="ignore")
            for future in ended:  # running tasks write their checkpoints
                self._note(under_way.pop(future.key).name, future)
            for item in under_way.values():  # they had ended, and the interrupt came before them
                known[item.name] = read_status(self._ledger.out, item.name)
            raise
        finally:
            with contextlib.suppress(OutputError):
                self._ledger.renew(at_once=True)

    def _following(self, item: Item) -> list[Item]:
        """Return the tasks once all pieces of a recording are done: repeat some, or join them."""
        from motionstereo_cli.batch.pieces import behind_damage

        pieces = item.pieces or ()
        if again := behind_damage(pieces_path(self._ledger.out, item.name), pieces):
            self._ledger.watcher.say(
                "note",
                f"{item.name}: behind damage, {len(again)} of {len(pieces)} pieces are made again "
                "by decoding from the start",
            )
            return [dataclasses.replace(item, piece=piece, seek=False) for piece in again]
        return [dataclasses.replace(item, piece=None)]

    def _left_out(self, future: Future) -> bool:
        """Return whether a worker that joined later has other builds; such a worker is closed.

        Raises:
            InputError: there are too many such workers, or it cannot be closed.
        """
        error = future.exception() if future.status == "error" else None
        if not isinstance(error, OtherBuildsError):
            return False
        worker, theirs = error.args
        self._tries += 1
        said = f"{difference(theirs, self._builds)} on {worker}, which joined later"
        if self._tries > _TRIES:
            raise InputError(
                f"{said}: install the same versions, so that all give the same results"
            )
        self._ledger.watcher.say("warning", f"{said}: it is left out")
        self._client.retire_workers([worker])
        return True

    def _went_well(self, item: Item, future: Future) -> bool:
        if future.status != "finished":
            return False
        return read_status(self._ledger.out, item.name).status == "running"

    def _submit(self, items: Sequence[Item]) -> list[Future]:
        """Give tasks to the scheduler, in one message."""
        if not items:
            return []
        tasks = [self._task(item) for item in items]
        # Dask keeps statistics for each prefix of keys. What an earlier client has left on the
        # scheduler has the same key, and is not done twice.
        keys = [
            ("motionstereo", f"{i.name}-{i.piece}-{i.seek}-{task.plan_hash}-{self._tries}")
            for i, task in zip(items, tasks, strict=True)
        ]
        futures: list[Future] = self._client.map(
            _work, tasks, key=keys, pure=False, builds=self._builds
        )
        return futures

    def _task(self, item: Item) -> Task:
        task = self._ledger.task_of(item.name, self._jobs)
        # Pieces have what was measured; the joined run warns of what was wrong with it.
        measured = {} if item.piece is None else item.measured
        return dataclasses.replace(
            task,
            plan={**task.plan, **measured},
            piece=item.piece,
            pieces=item.pieces if item.piece is None else None,
            seek=item.seek,
            tell_s=max(_TELL_S, self._room.tasks / _TOLD_PER_S),
            submitted_s=time.time(),
        )

    def _note(self, name: str, future: Future) -> None:
        """Note how the worker of a recording has ended."""
        if future.status == "finished":
            self._ledger.ended(read_status(self._ledger.out, name))
            return
        from distributed.scheduler import KilledWorker

        error = future.exception() if future.status == "error" else None
        if error is None:
            raise InputError("lost the scheduler: start it, and run the same command again")
        self._ledger.failed(name, error, died=isinstance(error, KilledWorker))


def _release(futures: Iterable[Future]) -> None:
    for future in futures:
        future.release()


class _Room:
    """The number of tasks that the workers process at a time, cached because asking is slow."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._tasks, self._asked_s = 0, -math.inf

    @property
    def tasks(self) -> int:
        if time.monotonic() > self._asked_s + _ASK_S:
            self._tasks, self._asked_s = threads_of(self._client), time.monotonic()
        return self._tasks


#: In a worker: when the tasks of a batch that were submitted before were to end, by its folder.
_stopped: dict[str, float] = {}


def _stop(out: str, submitted_s: float) -> None:
    """Ask the tasks of a batch in this worker to leave a checkpoint and end."""
    _stopped[out] = submitted_s


class OtherBuildsError(Exception):
    """A worker has other builds than its batch; the arguments are its address and its builds."""


def _work(task: Task, builds: Mapping[str, str]) -> None:
    """Process a task in a Dask worker.

    Args:
        task: what to do.
        builds: of the batch.

    Raises:
        OtherBuildsError: its own builds differ. This is checked for each task, as a worker may join
            at any time. An error reaches the client by itself; a result would have to be fetched.
    """
    from distributed import get_worker

    from motionstereo_cli.batch.work import work

    worker, done = get_worker(), 0
    if own_builds() != builds:
        raise OtherBuildsError(worker.address, own_builds())

    def tell(frames: int) -> None:
        nonlocal done
        worker.log_event(_PROGRESS, frames - done)
        done = frames

    def stops() -> bool:
        return bool(_stopped.get(str(task.out), 0.0) >= task.submitted_s)

    work(task, tell, stops)
