"""Batches whose recordings or results lie in an object store.

Recordings are fetched to this machine's disk, processed there, and the results put back whole, with
``run.json`` last. Statuses lie in the store as well, so that shards on machines that share no disk
make one batch.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from motionstereo_cli.batch.own_folder import OWN, TABLE, claim, log_path, status_path
from motionstereo_cli.errors import OutputError
from motionstereo_cli.files.atomic import write_whole
from motionstereo_cli.files.folders import make_folder, remove_tree
from motionstereo_cli.files.reading import read_bytes
from motionstereo_cli.files.store import FIRST_PATIENCE_S, Store, address_of
from motionstereo_cli.sinks.outputs import RECORD

if TYPE_CHECKING:
    from motionstereo_cli.batch.task import Task
    from motionstereo_cli.runs.plan import RunPlan

#: What all shards have in common, the mark of a batch first.
_COMMON = ("batch.json", "builds.json")
_MAX_RECORD_BYTES = 16_000_000


@contextlib.contextmanager
def kept(out: str | Path, scratch: Path | None) -> Iterator[tuple[Path, str | None]]:
    """Yield the folder to work in, and the address of its store if it is to be kept in one.

    Args:
        out: a folder of this machine, or the address of one in a store.
        scratch: the folder to work in for a store; None: one among the temporary files.

    Raises:
        InputError: the store cannot be read.
        OutputError: the folder in the store is not that of a batch, or cannot be written.
    """
    address = address_of(out)
    if address is None:
        yield Path(out), None
        return
    name = hashlib.sha256(address.encode()).hexdigest()[:16]
    place = scratch or Path(tempfile.gettempdir(), f"motionstereo-{name}")
    _begin(address, place)
    try:
        yield place, address
    finally:
        if (place / TABLE).is_file():
            _finish(address, place)


def _begin(address: str, out: Path) -> None:
    """Bring the statuses of a batch from its store, or begin a new batch there.

    Args:
        address: of the store's folder.
        out: the working folder.

    Raises:
        InputError: the store cannot be read.
        OutputError: the folder in the store is not that of a batch, or cannot be written.
    """
    first, store = Store(address, FIRST_PATIENCE_S), Store(address)
    own = first.files(OWN)
    if not own and store.files():
        raise OutputError(f"{address} is not from an earlier batch: give another folder")
    make_folder(out, out)
    for name in own:
        if name.startswith("status/") or (name in _COMMON and not (out / OWN / name).exists()):
            store.fetch((out / OWN / name).parent, out, _MAX_RECORD_BYTES, f"{OWN}/{name}")
    claim(out, ())
    if _COMMON[0] not in own:  # before anything else is there: another shard may begin as well
        first.put([(out / OWN / _COMMON[0], f"{OWN}/{_COMMON[0]}")])


def _finish(address: str, out: Path) -> None:
    """Put the table of a batch into its store.

    Raises:
        OutputError: the store does not take it.
    """
    common = [name for name in _COMMON if (out / OWN / name).is_file()]
    Store(address).put([(out / TABLE, TABLE), *((out / OWN / n, f"{OWN}/{n}") for n in common)])


@contextlib.contextmanager
def at_hand(plan: RunPlan, task: Task) -> Iterator[RunPlan]:
    """Yield a plan whose inputs are on this machine's disk; what was fetched is removed after it.

    Args:
        plan: its inputs may be addresses.
        task: whose plan it is.

    Raises:
        InputError: an input cannot be fetched.
    """
    home = task.out / OWN / "fetched" / task.name
    left = task.storage.fetch_bytes
    known: dict[str, str] = {}

    def local(name: str | Path) -> str:
        nonlocal left
        address = address_of(name)
        if address is None:
            return str(name)
        path = Store(address).fetch(home / str(len(known)), task.out, left)
        left -= sum(each.stat().st_size for each in (path, *path.rglob("*")) if each.is_file())
        known[str(path)] = address
        return str(path)

    try:
        fetched = dataclasses.replace(
            plan,
            left=local(plan.left),
            right=None if plan.right is None else local(plan.right),
            rig=tuple(Path(local(path)) for path in plan.rig),
            poses=None if plan.poses is None else Path(local(plan.poses)),
            disparity=None if plan.disparity is None else Path(local(plan.disparity)),
        )
        yield fetched
        if known and plan.folder is not None:
            _with_addresses(plan.folder / RECORD, known)
    finally:
        remove_tree(home, task.out)


def _with_addresses(path: Path, known: Mapping[str, str]) -> None:
    """Put addresses in the place of what was fetched from them, in a record."""
    if path.is_file():
        text = read_bytes(path, "the record", _MAX_RECORD_BYTES).decode()
        for fetched, address in known.items():
            text = text.replace(json.dumps(fetched), json.dumps(address))
        write_whole(path, text.encode())


def put_back(task: Task) -> None:
    """Put the results of a recording that is done into its store, and remove them here.

    What lies there of an earlier run is complete until its ``run.json`` is removed, and the new one
    when its own is there.

    Raises:
        OutputError: the store does not take them.
    """
    if task.storage.address is None:
        return
    name, folder, store = task.name, task.folder, Store(task.storage.address)
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    files.sort(key=lambda path: path == folder / RECORD)
    new = [(path, f"{name}/{path.relative_to(folder).as_posix()}") for path in files]
    before = [f"{name}/{each}" for each in store.files(name)]
    store.remove([each for each in before if each == f"{name}/{RECORD}"])
    store.remove([each for each in before if each not in {at for _, at in new}])
    store.put(new)
    remove_tree(folder, task.out)


def put_status(task: Task) -> None:
    """Put the status and the log of a recording into its store.

    Raises:
        OutputError: the store does not take them.
    """
    if task.storage.address is not None:
        paths = [log_path(task.out, task.name), status_path(task.out, task.name)]
        named = [(path, path.relative_to(task.out).as_posix()) for path in paths]
        Store(task.storage.address).put(named)
