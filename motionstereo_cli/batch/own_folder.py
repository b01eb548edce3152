"""The folder in which a batch keeps its own files, beside the folders of its recordings."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import TextIO

from msgspec import structs

from motionstereo_cli import __version__
from motionstereo_cli.batch.status import COLUMNS
from motionstereo_cli.errors import InputError, OutputError
from motionstereo_cli.files.atomic import is_left_over, open_log, reported, write_whole
from motionstereo_cli.files.folders import check_no_links, make_folder, spread
from motionstereo_cli.files.reading import MAX_LINE_BYTES, read_head, real
from motionstereo_cli.files.records import Record, encode, read_json, typed
from motionstereo_cli.files.targets import check_targets
from motionstereo_cli.sinks.records import Status
from motionstereo_cli.types import Say

#: The table of all recordings.
TABLE = "batch.csv"
#: The folder, and the file that marks it as a batch's.
OWN = ".batch"
_MARK, _PROGRAM = "batch.json", "motionstereo batch"
_BUILDS = "builds.json"


class BatchMark(Record, frozen=True):
    """``batch.json``, which marks the folder as a batch's."""

    program: str
    version: str


def status_path(out: Path, name: str) -> Path:
    """Return the status file of a recording of the batch into ``out``."""
    return out / OWN / "status" / spread(name) / f"{name}.json"


def log_path(out: Path, name: str) -> Path:
    """Return the log of a recording."""
    return out / OWN / "logs" / spread(name) / f"{name}.log"


def pieces_path(out: Path, name: str) -> Path:
    """Return the folder of a recording's pieces."""
    return out / OWN / "pieces" / name


def ended_path(out: Path, name: str) -> Path:
    """Return the file with a line of JSON for each recording that a process has seen end."""
    return out / OWN / "ended" / f"{name}.jsonl"


def shard_path(out: Path, name: str) -> Path:
    """Return the folder that a running shard locks."""
    return out / OWN / "shards" / name


def builds_path(out: Path) -> Path:
    """Return the record of the builds with which a batch began."""
    return out / OWN / _BUILDS


def write_status(out: Path, status: Status) -> None:
    """Write the status of a recording, atomically; the last writer wins.

    Raises:
        OutputError: it cannot be written.
    """
    path = status_path(out, status.name)
    make_folder(path.parent, out)
    write_whole(path, encode(status))


def read_status(out: Path, name: str, say: Say | None = None) -> Status:
    """Return the status of a recording; one that is missing or damaged counts as waiting.

    Args:
        out: the folder of the batch.
        name: the recording.
        say: called with a kind and a line if it is damaged.
    """
    path = status_path(out, name)
    if not os.path.lexists(path):  # False, too, of a name that is too long
        return Status(name)
    try:
        return structs.replace(typed(read_json(path), Status, path), name=name)
    except InputError as error:
        if say is not None:
            say("warning", f"{error}; {name} counts as waiting")
        return Status(name)


def open_log_of(out: Path, name: str) -> TextIO:
    """Open the log of a recording for appending.

    Raises:
        OutputError: it cannot be written.
    """
    path = log_path(out, name)
    make_folder(path.parent, out)
    with reported(path):
        return os.fdopen(open_log(path), "a", encoding="utf-8")


def claim(out: Path, inputs: Iterable[Path]) -> None:
    """Mark the folder of a batch as its own, or check that it is.

    Args:
        out: the folder, which exists.
        inputs: files and folders that are read.

    Raises:
        OutputError: an input or a foreign file has a name that the batch needs.
    """
    own, table = out / OWN, out / TABLE
    taken = dict.fromkeys(inputs)
    check_targets((table, own), taken)
    place = os.path.join(real(own), "")
    for path in taken:
        if os.path.realpath(path).startswith(place):
            raise OutputError(f"{path}, an input, is in {own}: give another folder")
    check_no_links(own / _MARK, out)
    check_no_links(table, out)
    had_table = os.path.lexists(table)  # before another shard may write it
    with reported(own):
        begun = os.path.lexists(own)
        fresh = not begun or all(is_left_over(path) for path in own.iterdir())
    if not fresh and not _is_marked(own / _MARK):
        raise OutputError(f"{own} is not from an earlier batch: move it, or give another folder")
    if had_table and (fresh or not _is_table(table)):
        raise OutputError(f"{table} is not from an earlier batch: move it, or give another folder")
    if fresh:
        make_folder(own)
        write_whole(own / _MARK, encode(BatchMark(_PROGRAM, __version__)), durable=True)


def _is_marked(path: Path) -> bool:
    try:
        return typed(read_json(path), BatchMark, path).program == _PROGRAM
    except InputError:
        return False


def _is_table(path: Path) -> bool:
    content = read_head(path, MAX_LINE_BYTES)
    columns = content.partition(b"\n")[0].decode("utf-8", "replace").split(",")
    return columns[:2] == list(COLUMNS[:2]) and set(columns) <= set(
        COLUMNS
    )  # older tables have fewer columns
