"""The files of commands in their output folders."""

from __future__ import annotations

import hashlib
import itertools
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.atomic import is_left_over, is_segment, part_of
from motionstereo_cli.files.folders import remove_empty
from motionstereo_cli.files.reading import (
    MAX_RECORD_BYTES,
    open_regular,
    read_bytes,
    sha256_of_all,
)
from motionstereo_cli.files.records import encode, parse_json, typed
from motionstereo_cli.report import PAGE, is_report
from motionstereo_cli.runs.checkpoint import frames_of
from motionstereo_cli.sinks.outputs import OUTPUTS, RECORD
from motionstereo_cli.sinks.records import FolderRecord, OutputRecord, RunRecord, SumRecord

#: The checkpoint; removed when the run is complete.
CHECKPOINT = "run.checkpoint"

#: There while outputs get or have their final names, until the run is complete.
NAMING = "run.naming"

#: The steering table for another place, until it is complete.
TABLE = "table"

_NUMBERED = re.compile(r"(\d{6,})(\.[a-z]+)")


@dataclass(frozen=True, slots=True)
class FolderKind:
    """The files of a command in its output folder.

    Attributes:
        program: the program's name in its record.
        record: name of the record, which is written last and removed last.
        outputs: the files of each output by its name; ``{:06d}`` is the number of a frame.
        keeps: results are kept when it ends early, so that another process can continue.
        kind: class of its record.
        format: writes a record.
        parse: reads a record that is no JSON.
    """

    program: str
    record: str
    outputs: Mapping[str, tuple[str, ...]]
    keeps: bool = False
    kind: type[FolderRecord] = FolderRecord
    format: Callable[[Any], bytes] = encode
    parse: Callable[[bytes], FolderRecord] | None = None


RUN = FolderKind(
    "motionstereo",
    RECORD,
    {name: each.paths for name, each in OUTPUTS.items()},
    keeps=True,
    kind=RunRecord,
)


def head(save: Sequence[str]) -> RunRecord:
    """Return the first fields of a run's record: who wrote the folder, and what is in it."""
    rows = {name: OUTPUTS[name] for name in save}
    outputs = {name: OutputRecord(row.path.format(0), row.what) for name, row in rows.items()}
    return RunRecord(program=RUN.program, outputs=outputs)


def written(out: Path, kind: FolderKind) -> set[Path]:
    """Return the existing files that the records of earlier runs list, complete or not."""
    written: set[Path] = set()
    for path in (out / kind.record, part_of(out / kind.record)):
        try:
            record = read_record(path, kind)
        except InputError:  # a damaged record allows no removal
            continue
        if record is None:
            continue
        if not record.outputs:
            continue  # it lists nothing
        names = [name for name in kind.outputs if name in record.outputs]
        frames = record.counts.written if record.counts else None
        first = record.first or 0
        at_least = frames_of(out / CHECKPOINT)
        # Until then, a stream has no more than its .part name.
        named = path.name == kind.record or os.path.lexists(out / NAMING)
        written.add(path)
        written |= temporary(out, kind, names)
        for target in (path for name in names for path in kind.outputs[name]):
            present = present_of(out, target)
            if not named:
                present.discard(out / target)
            written |= up_to(frames, present, at_least, first) if "{" in target else present
        if kind is RUN and is_report(out / PAGE):
            written.add(out / PAGE)  # of the command report
    return written


def read_record(path: Path, kind: FolderKind) -> FolderRecord | None:
    """Return a record, None if there is none of this kind.

    Raises:
        InputError: it is damaged.
    """
    try:
        if path.is_symlink():
            return None
        content = read_bytes(path, "the record", MAX_RECORD_BYTES)
        said = kind.parse(content) if kind.parse else parse_json(content, path)
    except (InputError, ValueError):
        return None  # not a record of this program
    if isinstance(said, FolderRecord):
        return said
    ours = isinstance(said, dict) and said.get("program") == kind.program
    return typed(said, kind.kind, path) if ours else None


def temporary(out: Path, kind: FolderKind, outputs: Iterable[str]) -> set[Path]:
    """Return the existing files that a run needs only until it is complete.

    Leftovers of a kill are among them, wherever they are in the folder.
    """
    paths = [path for name in outputs for path in kind.outputs[name]]
    streams = [Path(path) for path in paths if "{" not in path]
    names = {CHECKPOINT, NAMING, *(part_of(path).name for path in (out / TABLE, *streams))}
    folders = {(out / path).parent for path in paths} - {out}
    return {
        path
        for path in out.iterdir()
        if path.name in names or any(is_segment(path.name, stream) for stream in streams)
    } | {
        path
        for folder in (out, *folders)
        if folder.is_dir() and (folder == out or not folder.is_symlink())
        for path in folder.iterdir()
        if is_left_over(path)
    }


def present_of(out: Path, path: str) -> set[Path]:
    """Return the existing files of an output, complete or not; of a linked folder the link."""
    target = out / path
    if "{" not in path:
        return {place for place in (target, part_of(target)) if os.path.lexists(place)}
    folder = target.parent
    if folder.is_dir() and not folder.is_symlink():
        return {
            place
            for place in folder.iterdir()
            if (match := _NUMBERED.fullmatch(place.name)) and match[2] == target.suffix
        }
    return {folder} if os.path.lexists(folder) else set()


def up_to(frames: int | None, present: set[Path], at_least: int = 0, first: int = 0) -> set[Path]:
    """Return the images of some frames; if None, of ``at_least`` and all after it up to a gap."""
    matches = {path: _NUMBERED.fullmatch(path.name) for path in present}
    numbers = {path: int(match[1]) for path, match in matches.items() if match}
    if frames is None:  # the run was cut off
        found = set(numbers.values())
        stop = next(number for number in itertools.count(first + at_least) if number not in found)
        frames = stop - first
    return {path for path, number in numbers.items() if first <= number < first + frames}


def remove_empty_folders(out: Path, kind: FolderKind) -> None:
    """Remove folders of numbered files that are empty."""
    for paths in kind.outputs.values():
        for folder in (out / paths[0]).parents:
            if folder == out:
                break
            remove_empty(folder)


def sums_of(out: Path, paths: Sequence[str], frames: int) -> SumRecord:
    """Return size and SHA-256 of an output; for several files see :func:`sha256_of_all`.

    Raises:
        OSError: a file cannot be read.
    """
    size, sums = 0, list[tuple[str, str]]()
    for path in paths:
        for number in range(frames if "{" in path else 1):
            file = out / path.format(number)
            with open_regular(file) as content:
                sums.append((hashlib.file_digest(content, "sha256").hexdigest(), file.name))
                size += content.tell()
    alone = len(paths) == 1 and "{" not in paths[0]
    return SumRecord(size, sums[0][0] if alone else sha256_of_all(sums))
