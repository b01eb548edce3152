"""Many recordings, on this machine or a cluster, by Dask.

The state is on disk: a ``run.json`` in the folder of each complete recording, and a status file for
each. Futures only tell when to read it, so a batch whose client or workers were killed continues
from the disk.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import itertools
import json
import math
import os
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec import structs

from motionstereo_cli.batch.cluster import Cluster, client_of, difference_from, threads_of
from motionstereo_cli.batch.own_folder import (
    TABLE,
    claim,
    pieces_path,
    read_status,
    stop_path,
    write_status,
)
from motionstereo_cli.batch.pieces import Piece, behind_damage, pieces_of
from motionstereo_cli.batch.status import DONE, FAILED, format_statuses
from motionstereo_cli.batch.task import work
from motionstereo_cli.errors import InputError, MotionStereoError, OutputError
from motionstereo_cli.files.atomic import remove_own, write_whole
from motionstereo_cli.files.lock import locked
from motionstereo_cli.runs.cores import usable_cores
from motionstereo_cli.runs.disparity_range import Say
from motionstereo_cli.runs.plan import RunPlan
from motionstereo_cli.runs.record import builds
from motionstereo_cli.runs.run import settled
from motionstereo_cli.sinks.outputs import RECORD
from motionstereo_cli.sinks.records import Status

if TYPE_CHECKING:
    from distributed import Client, Future

#: Topic of the workers' progress.
_PROGRESS = "motionstereo-frames"
#: Minimum time between writing the table, in s.
_RENEW_S = 1.0
#: Workers with other builds that are excluded before the batch fails.
_TRIES = 20
#: Minimum time between counting the workers, in s.
_ASK_S = 2.0


@dataclass(frozen=True, slots=True)
class BatchWatcher:
    """Callbacks during a batch.

    Attributes:
        say: called with a kind, ``note`` or ``warning``, and a line.
        frames: called with the number of further frames that are done.
        ended: called with the status of each recording that ended.
    """

    say: Callable[[str, str], object]
    frames: Callable[[int], object]
    ended: Callable[[Status], object]


def run_batch(
    plans: Mapping[str, RunPlan],
    out: Path,
    cluster: Cluster,
    watcher: BatchWatcher,
    *,
    inputs: Iterable[Path] = (),
    retry_failed: bool = False,
    pieces: int | None = None,
) -> list[Status]:
    """Process recordings, and return the status of each, in order.

    Complete recordings are skipped; failed ones are tried again only with ``retry_failed``.

    Args:
        plans: the plan of each recording, by the name of its folder under ``out``.
        out: folder of the batch.
        cluster: where to process.
        watcher: callbacks.
        inputs: further files that are read, and must not be written to.
        retry_failed: try failed and lost ones again.
        pieces: into how many pieces each recording is cut; None: as many as keep all workers busy
            if there are fewer recordings than workers and they can be cut.

    Raises:
        SettingsError: a recording cannot be done in pieces, and pieces were asked for.
        InputError: the cluster cannot be reached, or its versions differ.
        OutputError: the folder of the batch cannot be written.
        KeyboardInterrupt: it was interrupted; unfinished recordings have checkpoints.
    """
    read = [Path(name) for plan in plans.values() for name in plan.inputs]
    with locked(out):
        claim(out, (*inputs, *filter(os.path.exists, read)))
        batch = _Batch(plans, out, watcher)
        waiting = [name for name in plans if batch.to_do(name, retry_failed=retry_failed)]
        if waiting:
            asked = pieces is not None

            def items(workers: int) -> list[Item]:
                count = pieces or math.ceil(workers / len(waiting))
                each = (
                    _items(name, plans[name], count, watcher.say, asked=asked) for name in waiting
                )
                return list(itertools.chain.from_iterable(each))

            # No more processes are started than there are tasks.
            tasks = items(cluster.workers or usable_cores()) if cluster.local else []
            with client_of(cluster, len(tasks), watcher.say) as client:
                threads = threads_of(client)
                jobs = max(usable_cores() // threads, 1) if cluster.local else 1
                batch.process(client, tasks or items(threads), jobs)
        batch.renew(at_once=True)
        return batch.statuses


@dataclass(frozen=True, slots=True)
class Item:
    """A task: process a recording or a piece of one, or join the pieces.

    Attributes:
        name: the recording.
        piece: which piece.
        pieces: all pieces of the recording; empty where it is not cut.
        measured: the settings, and those of the output, with what was measured for all pieces.
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
        try:
            pieces = tuple(pieces_of(plan, count))
            if len(pieces) > 1:
                whole = settled(plan, lambda kind, text: say(kind, f"{name}: {text}")).as_json()
                measured = {group: whole[group] for group in ("settings", "output_settings")}
                return [Item(name, piece, pieces, measured) for piece in pieces]
        except MotionStereoError:
            if asked:
                raise
            # As one task, which reports what is wrong.
    return [Item(name)]


class _Batch:
    """The recordings of a batch, and their states."""

    def __init__(self, plans: Mapping[str, RunPlan], out: Path, watcher: BatchWatcher) -> None:
        self._out, self._watcher, self._given = out, watcher, plans
        self._plans = {name: plan.as_json() for name, plan in plans.items()}
        self._hashes = {name: _hash(plan) for name, plan in self._plans.items()}
        self._known = {name: read_status(out, name, watcher.say) for name in plans}
        self._stop = stop_path(out)
        self._renewed_s = 0.0
        self._tries = 0

    @property
    def statuses(self) -> list[Status]:
        return list(self._known.values())

    def to_do(self, name: str, *, retry_failed: bool) -> bool:
        known = self._known[name]
        same = known.plan == self._hashes[name]
        if same and known.status in DONE and (self._out / name / RECORD).is_file():
            return False
        return retry_failed or not (same and known.status in FAILED)

    def process(self, client: Client, items: Iterable[Item], jobs: int) -> None:
        """Keep each worker busy with one task at a time, until all have ended."""
        from distributed import as_completed

        waiting = deque(items)
        left = Counter(item.name for item in waiting)
        self._known |= {name: Status(name) for name in left}
        client.subscribe_topic(_PROGRESS, lambda event: self._watcher.frames(event[1]))
        remove_own(self._stop)
        ended = as_completed()
        under_way: dict[object, Item] = {}
        room = _Room(client)

        def fill() -> None:
            # No more at a time than there are workers: all tasks that a worker holds are
            # suspects when it dies.
            while waiting and len(under_way) < room.tasks:
                item = waiting.popleft()
                if self._known[item.name].status not in FAILED:
                    if item.piece is not None:
                        self._begin(item.name)
                    future = self._submit(client, item, jobs)
                    under_way[future.key] = item
                    ended.add(future)

        try:
            fill()
            for future in ended:
                item = under_way.pop(future.key)
                if self._left_out(client, future):
                    waiting.appendleft(item)
                    future.release()
                    fill()
                    continue
                left[item.name] -= 1
                if item.piece is None or not self._went_well(item, future):
                    self._note(item.name, future)
                elif not left[item.name]:
                    following = self._following(item)
                    waiting.extendleft(reversed(following))
                    left[item.name] = len(following)
                future.release()
                fill()
        except KeyboardInterrupt:
            write_whole(self._stop, b"")
            for future in ended:  # running tasks write their checkpoints
                self._note(under_way[future.key].name, future)
            raise
        finally:
            remove_own(self._stop)
            with contextlib.suppress(OutputError):
                self.renew(at_once=True)

    def _begin(self, name: str) -> None:
        """Write once that a recording in pieces is running: pieces would contradict each other."""
        if self._known[name].status != "running":
            self._known[name] = Status(name, "running", plan=self._hashes[name])
            self._write(self._known[name])

    def _following(self, item: Item) -> list[Item]:
        """Return the tasks once all pieces of a recording are done: repeat some, or join them."""
        pieces = item.pieces or ()
        if again := behind_damage(pieces_path(self._out, item.name), pieces):
            self._watcher.say(
                "note",
                f"{item.name}: behind damage, {len(again)} of {len(pieces)} pieces are made again "
                "by decoding from the start",
            )
            return [dataclasses.replace(item, piece=piece, seek=False) for piece in again]
        return [dataclasses.replace(item, piece=None)]

    def _left_out(self, client: Client, future: Future) -> bool:
        """Return whether a worker that joined later has other builds; such a worker is closed.

        Raises:
            InputError: there are too many such workers, or it cannot be closed.
        """
        found = future.result() if future.status == "finished" else None
        if found is None:
            return False
        worker, theirs = found
        self._tries += 1
        said = f"{difference_from(theirs)} on {worker}, which joined later"
        if self._tries > _TRIES:
            raise InputError(
                f"{said}: install the same versions, so that all give the same results"
            )
        self._watcher.say("warning", f"{said}: it is left out")
        client.retire_workers([worker])
        return True

    def _went_well(self, item: Item, future: Future) -> bool:
        return future.status == "finished" and read_status(self._out, item.name).status == "running"

    def _submit(self, client: Client, item: Item, jobs: int) -> Future:
        plan = self._plans[item.name]
        # Pieces have what was measured; the joined run warns of what was wrong with it.
        measured = {} if item.piece is None else item.measured
        task = {
            "plan": {**plan, "jobs": plan["jobs"] or jobs, **measured},
            "out": str(self._out),
            "name": item.name,
            "hash": self._hashes[item.name],
            "stop": str(self._stop),
            "piece": item.piece,
            "pieces": item.pieces if item.piece is None else None,
            "seek": item.seek,
            "builds": builds(),
        }
        # Dask keeps statistics for each prefix of keys.
        key = (
            "motionstereo",
            f"{item.name}-{item.piece}-{item.seek}-{os.getpid()}-{self._tries}",
        )
        future: Future = client.submit(_work, task, key=key, pure=False)
        return future

    def _note(self, name: str, future: Future) -> None:
        status = read_status(self._out, name)
        if future.status in ("error", "lost", "cancelled"):
            status = self._unended(name, status, future)
        self._known[name] = status
        self._watcher.ended(status)
        self.renew()

    def _unended(self, name: str, status: Status, future: Future) -> Status:
        """Return the status of a recording whose worker did not write one."""
        from distributed.scheduler import KilledWorker

        error = future.exception() if future.status == "error" else None
        if error is None:
            raise InputError("lost the scheduler: start it, and run the same command again")
        lost = isinstance(error, KilledWorker)
        reason = "its worker died twice" if lost else str(error)
        status = structs.replace(
            status,
            status="lost" if lost else "failed",
            reason=reason.splitlines()[0] if reason else type(error).__name__,
            plan=self._hashes[name],
        )
        self._write(status)
        return status

    def _write(self, status: Status) -> None:
        """Write the status of a recording; if that fails, only the table has it."""
        with contextlib.suppress(OutputError):
            write_status(self._out, status)

    def renew(self, *, at_once: bool = False) -> None:
        """Write the table of all recordings, if it is due."""
        if at_once or time.monotonic() > self._renewed_s + _RENEW_S:
            write_whole(self._out / TABLE, format_statuses(self.statuses))
            self._renewed_s = time.monotonic()


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


def _hash(plan: Mapping[str, Any]) -> str:
    # Speed, and replacing earlier results, do not change the results.
    said = {key: value for key, value in plan.items() if key not in ("jobs", "resume", "overwrite")}
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()[:16]


def _work(task: Mapping[str, Any]) -> tuple[str, dict[str, str]] | None:
    """Process a task in a Dask worker; if its builds differ, return them and do nothing.

    A worker may join at any time, so this is checked for each task.
    """
    from distributed import get_worker

    worker, done = get_worker(), 0
    if builds() != task["builds"]:
        return worker.address, builds()

    def tell(frames: int) -> None:
        nonlocal done
        worker.log_event(_PROGRESS, frames - done)
        done = frames

    work(task, tell)
    return None
