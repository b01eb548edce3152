"""Start or join a Dask cluster."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import importlib.util
import json
import logging
import sys
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from motionstereo_cli.batch.builds import builds_here, difference, own_builds
from motionstereo_cli.errors import InputError, words_of
from motionstereo_cli.files.reading import read_bytes
from motionstereo_cli.runs.cores import usable_cores
from motionstereo_cli.runs.interrupts import children_ignoring_interrupts
from motionstereo_cli.types import Say

if TYPE_CHECKING:
    from distributed import Client

#: Timeout for a scheduler's answer, in s.
_ANSWER_S = 10
#: A scheduler's file has a few hundred bytes.
_MAX_FILE_BYTES = 1_000_000
#: Attempts to start processes on this machine.
_STARTS = 3
#: Files that Dask opens in this process, and for each worker; without them it waits for ever.
_FILES, _FILES_OF_A_WORKER = 40, 12
#: Timeout for its workers to connect, in s.
_WORKERS_S = 60

#: Dask's configuration. A task whose worker dies is tried once more. Where forks are safe, workers
#: are forks of one process that has loaded everything: each would take 1.2 s to load otherwise.
_SETTINGS: Mapping[str, object] = {
    "distributed.scheduler.allowed-failures": 1,
    "distributed.admin.low-level-log-length": 20,  # of messages, which hold whole tasks
    "distributed.worker.profile.enabled": False,  # it would sample each thread every 10 ms
    "logging.distributed": "critical",
    "distributed.nanny.pre-spawn-environ.DASK_LOGGING__DISTRIBUTED": "critical",
    "distributed.nanny.pre-spawn-environ.PYTHONWARNINGS": "ignore",
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": None,
    "distributed.nanny.pre-spawn-environ.OPENCV_FOR_THREADS_NUM": 1,
    "distributed.worker.multiprocessing-method": (
        "forkserver" if sys.platform == "linux" else "spawn"
    ),
}


@dataclass(frozen=True, slots=True)
class Cluster:
    """Where a batch is processed.

    Attributes:
        workers: processes on this machine; None = one for each core. Not used with a scheduler.
        scheduler: address of a scheduler, ``tcp://host:port``; None = processes on this machine.
        scheduler_file: file with a scheduler's address, written by it.
        tls: paths of ``ca``, ``cert`` and ``key``, for a scheduler that requires them.
    """

    workers: int | None = None
    scheduler: str | None = None
    scheduler_file: Path | None = None
    tls: Mapping[str, str] = dataclasses.field(default_factory=dict)

    @property
    def local(self) -> bool:
        """Whether the workers are processes on this machine."""
        return self.scheduler is None and self.scheduler_file is None

    def address(self) -> str:
        """Return the address of the scheduler, which is not local.

        Raises:
            InputError: its file is missing, or has none.
        """
        path = self.scheduler_file
        if self.scheduler is not None or path is None:
            return self.scheduler or ""
        if not path.is_file():
            raise InputError(f"there is no file {path}: a scheduler writes it when it is started")
        try:
            found = json.loads(read_bytes(path, "the scheduler file", _MAX_FILE_BYTES))
            return str(found["address"])
        except (ValueError, LookupError, TypeError, RecursionError):
            raise InputError(f"{path} has no address of a scheduler: start it again") from None


def threads_of(client: Client) -> int:
    """Return how many tasks the workers process at a time, at least 1."""
    count: int = sum(client.nthreads().values())
    return max(count, 1)


@contextlib.contextmanager
def client_of(cluster: Cluster, tasks: int, say: Say) -> Iterator[tuple[Client, dict[str, str]]]:
    """Yield a client of a cluster, and the builds that this process and all workers have.

    Args:
        cluster: the cluster; processes on this machine are started, and ended with the block.
        tasks: number of tasks; no more processes than that are started.
        say: called with a kind, ``note``, and a line.

    Raises:
        InputError: Dask is not installed, the scheduler does not answer, or versions differ.
    """
    if not importlib.util.find_spec("distributed"):
        raise InputError("batch needs Dask: pip install 'motionstereo[batch]'")
    import dask
    import distributed  # noqa: F401  # whose defaults would else go with the settings

    for name in ("asyncio", "tornado.application"):  # which print tracebacks, as of too many files
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with dask.config.set(_SETTINGS), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Dask, which users of a batch can do little about
        opened = _started(cluster, tasks, say) if cluster.local else _joined(cluster)
        with opened as client:
            if where := _words_of(client, local=cluster.local):
                say("note", where)
            yield client, _common_builds(client, local=cluster.local)


def _words_of(client: Client, *, local: bool) -> str:
    """Return how many workers a cluster has, and where its dashboard is."""
    words = [] if local else [f"{threads_of(client)} workers"]
    # The dashboard needs a package that Dask does not install.
    if not local or importlib.util.find_spec("bokeh"):
        with contextlib.suppress(KeyError):  # a scheduler without one
            words += [f"dashboard at {link}"] if (link := client.dashboard_link) else []
    return "; ".join(words)


@contextlib.contextmanager
def _started(cluster: Cluster, tasks: int, say: Say) -> Iterator[Client]:
    """Yield a client of processes on this machine."""
    from distributed import Client, LocalCluster
    from distributed.utils import get_mp_context

    get_mp_context().set_forkserver_preload(["distributed", "motionstereo_cli.batch.work"])
    cores = usable_cores()
    workers = min(cluster.workers or cores, tasks)
    if workers > cores:
        say("note", f"{workers} workers share {cores} cores: more than one for each gains nothing")
    _make_room(workers)
    # A free port for Dask's dashboard, so that two batches do not collide.
    options = {"threads_per_worker": 1, "dashboard_address": "127.0.0.1:0"}
    silent = logging.CRITICAL  # it would print tracebacks of processes that do not start
    for trial in range(_STARTS):
        try:
            with children_ignoring_interrupts():
                local = LocalCluster(n_workers=workers, silence_logs=silent, **options)
            break
        except Exception as error:  # such as a process that was killed before it was ready
            if trial == _STARTS - 1:
                raise InputError(
                    f"the processes to work in cannot be started ({words_of(error)}): give fewer "
                    "--workers, or the same command again"
                ) from None
    with local, Client(local) as client:
        yield client


def _make_room(workers: int) -> None:
    """Raise the limit of open files to what so many workers need.

    Raises:
        InputError: that is more than the system allows.
    """
    if not importlib.util.find_spec("resource"):  # as on Windows
        return
    import resource

    needed = _FILES + _FILES_OF_A_WORKER * workers
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    endless = resource.RLIM_INFINITY
    if hard != endless and hard < needed:
        raise InputError(
            f"--workers {workers} need {needed} open files, and the limit is {hard}: give fewer, "
            "or raise it (ulimit -n)"
        )
    if soft != endless and soft < needed:
        resource.setrlimit(resource.RLIMIT_NOFILE, (needed, hard))


@contextlib.contextmanager
def _joined(cluster: Cluster) -> Iterator[Client]:
    """Yield a client of a running scheduler that has workers."""
    from distributed import Client
    from distributed.security import Security

    address = cluster.address()
    security = None
    if cluster.tls:
        files = {
            f"tls_{key}_file" if key == "ca" else f"tls_client_{key}": value
            for key, value in cluster.tls.items()
        }
        security = Security(**files, require_encryption=True)
    try:
        asyncio.run(_shake_hands(address, security))
        joined = Client(address, timeout=_ANSWER_S, security=security)
    except Exception as error:  # the answer may come from something else
        raise InputError(
            f"there is no scheduler at {address} ({words_of(error)}): start it, or check the "
            "address; the same command goes on then"
        ) from None
    with joined as client:
        try:
            client.wait_for_workers(1, timeout=_WORKERS_S)
        except TimeoutError:
            raise InputError(f"the scheduler at {address} has no workers: start some") from None
        yield client


async def _shake_hands(address: str, security: Any) -> None:
    """Check that a server at an address answers: Dask itself would wait for ever."""
    from distributed.comm import connect

    arguments = security.get_connection_args("client") if security else {}
    comm = await asyncio.wait_for(connect(address, timeout=_ANSWER_S, **arguments), 2 * _ANSWER_S)
    await comm.close()


def _common_builds(client: Client, *, local: bool) -> dict[str, str]:
    """Return the builds that all workers have in common, so that their results are the same bytes.

    Processes of this machine have those of this one.

    Raises:
        InputError: a version differs.
    """
    try:
        theirs = client.run(own_builds)
    except Exception as error:
        raise InputError(
            f"the workers cannot run motionstereo: {words_of(error)}: install it there"
        ) from None
    here: dict[str, str] = next(iter(theirs.values())) if local else builds_here()
    for worker, found in theirs.items():
        if said := difference(found, here):
            raise InputError(
                f"{said} on {worker}: install the same versions, so that all give the same results"
            )
    return here
