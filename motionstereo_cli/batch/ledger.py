"""The statuses of a batch: what is to be done, and what has become of each recording.

The statuses on disk are authoritative: a status file for each recording, and a ``run.json`` where
it is done. Each recording that ends also appends a line of JSON to a file of the process that gives
out the work, and the table of all is written at intervals that grow with its size.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from msgspec import structs

from motionstereo_cli.batch.own_folder import TABLE, claim, ended_path, read_status, write_status
from motionstereo_cli.batch.status import DONE, FAILED, format_statuses, row_of
from motionstereo_cli.batch.task import LOCAL, Storage, Task
from motionstereo_cli.errors import OutputError, words_of
from motionstereo_cli.files.atomic import open_log, reported, write_whole
from motionstereo_cli.files.folders import make_folder
from motionstereo_cli.runs.plan import RunPlan
from motionstereo_cli.sinks.outputs import RECORD
from motionstereo_cli.sinks.records import Status
from motionstereo_cli.types import Say

#: Minimum time between two writes of the table, in s, and its maximum share of the time.
_RENEW_S, _RENEW_SHARE = 1.0, 0.02


@dataclass(frozen=True, slots=True)
class BatchWatcher:
    """Receives the progress of a batch.

    Attributes:
        say: called with a kind, ``note`` or ``warning``, and a line.
        frames: called with the number of further frames that are done.
        ended: called with the status of each recording that has ended.
    """

    say: Say
    frames: Callable[[int], object]
    ended: Callable[[Status], object]


class Ledger:
    """The statuses of the recordings of a batch.

    Args:
        plans: what to do for each recording, by its name.
        out: folder of the batch.
        watcher: receives the progress.
        log: name of the file of JSON lines.
        storage: what does not lie on this machine's disk.
    """

    def __init__(
        self,
        plans: Mapping[str, RunPlan],
        out: Path,
        watcher: BatchWatcher,
        log: str,
        storage: Storage = LOCAL,
    ) -> None:
        self.storage = storage
        self.out, self.watcher, self.plans = out, watcher, plans
        self.known = {name: read_status(out, name, watcher.say) for name in plans}
        self._log = log
        self._due_s = 0.0

    @property
    def statuses(self) -> list[Status]:
        """The statuses, in the order of the plans."""
        return list(self.known.values())

    def task_of(self, name: str, jobs: int) -> Task:
        """Return the task of a whole recording.

        Args:
            name: the recording.
            jobs: frames that are matched at a time, if its plan does not say.
        """
        plan = self.plans[name].as_json()
        said = {**plan, "jobs": plan["jobs"] or jobs}
        return Task(said, _hash(plan), self.out, name, self.storage)

    def _hash_of(self, name: str) -> str:
        return _hash(self.plans[name].as_json())

    def to_do(self, name: str, *, retry_failed: bool) -> bool:
        """Return whether a recording is to be processed."""
        known = self.known[name]
        if known.status == "waiting":
            return True
        same = known.plan == self._hash_of(name)
        # To a store, the status goes after the results.
        kept = self.storage.address is not None or (self.out / name / RECORD).is_file()
        if same and known.status in DONE and kept:
            return False
        return retry_failed or not (same and known.status in FAILED)

    def begin(self, name: str) -> None:
        """Note once that a recording in pieces is running: its pieces do not."""
        if self.known[name].status != "running":
            self.write(Status(name, "running", plan=self._hash_of(name)))

    def write(self, status: Status) -> None:
        """Write a status; where that fails, only the table has it."""
        self.known[status.name] = status
        with contextlib.suppress(OutputError):
            write_status(self.out, status)

    def ended(self, status: Status) -> None:
        """Note that a recording has ended."""
        self.known[status.name] = status
        with contextlib.suppress(OutputError):
            self._append(status)
        self.watcher.ended(status)
        self.renew()

    def failed(self, name: str, error: BaseException, *, died: bool) -> None:
        """Note that a recording has ended without a status of its own.

        Args:
            name: the recording.
            error: why.
            died: whether that ended its process, however often it was tried.
        """
        reason = "it ended the process that worked on it, twice" if died else words_of(error)
        status = read_status(self.out, name)
        how, plan = "lost" if died else "failed", self._hash_of(name)
        status = structs.replace(status, status=how, reason=reason, plan=plan)
        self.write(status)
        self.ended(status)

    def _append(self, status: Status) -> None:
        path = ended_path(self.out, self._log)
        make_folder(path.parent, self.out)
        with reported(path), os.fdopen(open_log(path), "a", encoding="utf-8") as lines:
            lines.write(json.dumps(row_of(status)) + "\n")

    def reread(self) -> None:
        """Read the statuses that other processes have written."""
        self.known = {name: read_status(self.out, name) for name in self.plans}

    def renew(self, *, at_once: bool = False) -> None:
        """Write the table of all recordings, if it is due."""
        begin_s = time.monotonic()
        if at_once or begin_s > self._due_s:
            write_whole(self.out / TABLE, format_statuses(self.statuses))
            ended_s = time.monotonic()
            self._due_s = ended_s + max(_RENEW_S, (ended_s - begin_s) / _RENEW_SHARE)


def inputs_of(plans: Mapping[str, RunPlan]) -> list[Path]:
    """Return the files and folders on this machine that recordings are read from, each once."""
    names = {name for plan in plans.values() for name in plan.inputs}
    return [Path(name) for name in sorted(names) if os.path.exists(name)]


def statuses_of(plans: Mapping[str, RunPlan], out: Path, watcher: BatchWatcher) -> list[Status]:
    """Return the status of each recording of a batch as the disk has it, and write the table.

    Raises:
        OutputError: the folder is not that of a batch, or cannot be written.
    """
    make_folder(out, out)
    claim(out, ())
    ledger = Ledger(plans, out, watcher, "batch")
    ledger.renew(at_once=True)
    return ledger.statuses


def _hash(plan: Mapping[str, Any]) -> str:
    # What does not change the results: speed, what is replaced, and where a batch is worked on.
    other = ("jobs", "resume", "overwrite", "out")
    said = {key: value for key, value in plan.items() if key not in other}
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()[:16]
