"""The output folder: what may be written and removed there, and how it becomes complete."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from motionstereo_cli.batch.checkpoint import check_same, read_checkpoint, write_checkpoint
from motionstereo_cli.batch.sinks import Sinks
from motionstereo_cli.errors import OutputError
from motionstereo_cli.files.atomic import is_segment, part_of, remove, reported, write_whole
from motionstereo_cli.files.lock import LOCK, locked
from motionstereo_cli.sinks import OUTPUTS, RECORD

#: What a run needs to go on after its process is gone; removed when it is complete.
CHECKPOINT = "run.checkpoint"

_NUMBERED = re.compile(r"(\d{6,})(\.[a-z]+)(\.part)?")


def _json(record: Mapping[str, Any]) -> bytes:
    return json.dumps(record, indent=2, allow_nan=False).encode() + b"\n"


@dataclass(frozen=True, slots=True)
class FolderKind:
    """What a command leaves in its output folder.

    Attributes:
        program: how its record says who wrote it.
        record: name of the record, which is written last and removed last.
        outputs: the files of each output by its name; ``{:06d}`` is the number of a frame.
        keeps: what was done is kept when it ends early, for another process to go on.
        format: makes a record.
        parse: returns what a record says: ``program``, ``outputs`` (by name; all if missing) and,
            where it is complete, ``counts.written``, the number of frames.
    """

    program: str
    record: str
    outputs: Mapping[str, tuple[str, ...]]
    keeps: bool = False
    format: Callable[[Mapping[str, Any]], bytes] = _json
    parse: Callable[[bytes], Any] = json.loads


RUN = FolderKind(
    "motionstereo", RECORD, {name: each.paths for name, each in OUTPUTS.items()}, keeps=True
)


class RunFolder(Sinks):
    """The output folder of a command, from its first file to its last.

    Entering the block locks the folder, and prepares it or finds where to go on. The record is
    written last, by :meth:`complete`: where it stands, everything beside it is complete. When the
    block ends before that, the outputs are abandoned: what was done is kept, or nothing is left.

    Args:
        path: the folder; made where it is missing.
        outputs: names of what is to be written, from ``kind``.
        kind: whose folder it is.
        identity: the :func:`head` of the record and all that the results follow from, as JSON-able
            values. With ``resume`` it has to be the same as before. None: who wrote it, no more.
        frames: how many images of a kind there will be; others in their folders do not matter.
            None: none of others may be there.
        overwrite: replace what an earlier run wrote; other files are never touched.
        resume: go on where the same run was ended, or begin if it has not yet.
        inputs: files and folders that must not be written to.

    Raises:
        BusyError: another run is writing there.
        OutputError: the folder cannot be written, is not empty, or is of another run.
    """

    def __init__(
        self,
        path: Path,
        outputs: Sequence[str],
        kind: FolderKind = RUN,
        *,
        identity: Mapping[str, Any] | None = None,
        frames: int | None = None,
        overwrite: bool = False,
        resume: bool = False,
        inputs: Iterable[Path] = (),
    ) -> None:
        super().__init__()
        self.path = path
        self._outputs = outputs
        self._kind = kind
        self._identity = identity or {"program": kind.program}
        self._frames = frames
        self._overwrite = overwrite
        self._resume = resume
        self._inputs = tuple(inputs)
        self._lock = contextlib.ExitStack()

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as held:
            held.enter_context(locked(self.path))
            self._begin()
            self._lock = held.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        with self._lock:
            if self.finished is None:
                self._keep = self._keep and self._kind.keeps
                super().__exit__(kind, error, traceback)
                if not self._complete:
                    tidy(self.path, self._kind)

    def checkpoint(self) -> None:
        """Leave what another process needs to go on after this frame.

        Raises:
            OutputError: it, or what the outputs have so far, cannot be written.
        """
        assert self.state is not None
        path = self.path / CHECKPOINT
        write_checkpoint(path, self._identity, self.state, self.totals, self._sinks)

    def complete(self, record: Mapping[str, Any]) -> None:
        """Write the record, after the outputs were closed.

        Args:
            record: what it says besides the identity.

        Raises:
            OutputError: it cannot be written.
        """
        complete(self.path, {**self._identity, **record}, self._kind)
        super().complete(record)

    def _begin(self) -> None:
        overwrite = self._overwrite
        if self._resume:
            if finished := record_of(self.path, self._kind):
                check_same(self.path, self._identity, finished)
                clear(self.path, self._kind)
                self.finished = finished
                return
            if begun := _read_record(part_of(self.path / self._kind.record), self._kind):
                check_same(self.path, self._identity, begun)
                overwrite = True
                if since := read_checkpoint(self.path / CHECKPOINT, self._identity):
                    self.state, self.totals = since.state, since.totals
                    self._marks, self._keep = since.sinks, True
                    return
        prepare(
            *(self.path, self._outputs, self._kind),
            identity=self._identity,
            frames=self._frames,
            overwrite=overwrite,
            inputs=self._inputs,
        )


def prepare(
    out: Path,
    outputs: Sequence[str],
    kind: FolderKind = RUN,
    *,
    identity: Mapping[str, Any] | None = None,
    frames: int | None = None,
    overwrite: bool = False,
    inputs: Iterable[Path] = (),
) -> None:
    """Make the output folder ready.

    With ``overwrite``, exactly the files that an earlier run wrote are removed, as its record
    has them. A file of anybody else is neither removed nor written over. Killed in between, the
    folder still says whose the rest is.

    Args:
        out: the folder; made where it is missing.
        outputs: names of the outputs.
        kind: whose folder it is.
        identity: what the record says while it is incomplete; who wrote it if None.
        frames: see :class:`RunFolder`.
        overwrite: accept a folder that is not empty.
        inputs: files and folders that are read.

    Raises:
        OutputError: the folder is not empty, cannot be written, or holds an input or someone
            else's file where something would be written.
    """
    record, part = out / kind.record, part_of(out / kind.record)
    with reported(out):
        out.mkdir(parents=True, exist_ok=True)
        if not overwrite and any(path.name != LOCK for path in out.iterdir()):
            advice = ", or --resume to go on" if kind is RUN and part.exists() else ""
            raise OutputError(f"{out} is not empty: give another folder, or --overwrite{advice}")
        former = _written(out, kind)
        paths = [path for name in outputs for path in kind.outputs[name]]
        present = _present(out, kind.record)
        for target in paths:
            there = _present(out, target)
            numbered = "{" in target and frames is not None and (out / target).parent not in there
            present |= _up_to(frames, there) if numbered else there
        for path in sorted(present - former):
            raise OutputError(f"{path} is not from an earlier run: move it or give another folder")
        taken = {path.resolve() for path in inputs}
        for path in former.union(out / path for path in paths):
            for place in (path, path.parent):
                if place.resolve() in taken:
                    raise OutputError(f"{place} is an input of this run: give another folder")
        if record in former:  # no longer complete, and still ours
            os.replace(record, part)
        # From the last image to the first: of a run that was cut off, those up to a gap are its.
        remove(out, sorted(former - {record, part}, reverse=True))
        _remove_empty_folders(out, kind)
    begun = identity or (head(outputs) if kind is RUN else {"program": kind.program})
    write_whole(part, kind.format(begun))


def complete(out: Path, record: Mapping[str, Any], kind: FolderKind = RUN) -> None:
    """Write the record of a run that is done.

    Args:
        out: the folder.
        record: what to say: the :func:`head`, and at least ``counts.written``, the frames.
        kind: whose folder it is.

    Raises:
        OutputError: the record cannot be written.
    """
    # The .part stays what it is until all is on the disk: it says that this folder is ours.
    part = part_of(out / kind.record)
    write_whole(part, kind.format(record), durable=True)
    with reported(out / kind.record):
        os.replace(part, out / kind.record)
    clear(out, kind)


def clear(out: Path, kind: FolderKind = RUN) -> None:
    """Remove what a complete run needs no more: its checkpoint, and the segments of its videos."""
    with reported(out):
        remove(out, sorted(_temporary(out, kind)))


def record_of(out: Path, kind: FolderKind = RUN) -> dict[str, Any] | None:
    """Return what a complete run says of itself, None where there is none."""
    return _read_record(out / kind.record, kind)


def tidy(out: Path, kind: FolderKind = RUN) -> None:
    """Remove what a run that failed left, if it left nothing of use."""
    part = part_of(out / kind.record)
    with contextlib.suppress(OSError):
        written = _written(out, kind)
        if written == {part} or not kind.keeps:
            remove(out, [*sorted(written - {part}, reverse=True), part])
            _remove_empty_folders(out, kind)


def head(save: Sequence[str]) -> dict[str, Any]:
    """Return the beginning of a run's record: who wrote the folder, and what is in it."""
    outputs = {
        name: {"path": OUTPUTS[name].path.format(0), "what": OUTPUTS[name].what} for name in save
    }
    return {"program": RUN.program, "outputs": outputs}


def _written(out: Path, kind: FolderKind) -> set[Path]:
    """Return the files present that earlier runs wrote, complete or not."""
    written: set[Path] = set()
    for path in (out / kind.record, part_of(out / kind.record)):
        record = _read_record(path, kind)
        if record is None:
            continue
        try:
            names = kind.outputs.keys() & record.get("outputs", kind.outputs).keys()
            frames = int(record["counts"]["written"]) if "counts" in record else None
        except (ValueError, LookupError, TypeError, AttributeError):
            continue  # not a record of ours
        written.add(path)
        written |= _temporary(out, kind)
        for target in (path for name in names for path in kind.outputs[name]):
            present = _present(out, target)
            written |= _up_to(frames, present) if "{" in target else present
    return written


def _read_record(path: Path, kind: FolderKind) -> dict[str, Any] | None:
    try:
        if not path.is_file() or path.is_symlink():
            return None
        record = kind.parse(path.read_bytes())
        return record if record["program"] == kind.program else None
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return None  # not a record of ours


def _temporary(out: Path, kind: FolderKind) -> set[Path]:
    """Return the files present that a run needs only until it is complete."""
    checkpoint = out / CHECKPOINT
    names = {checkpoint.name, part_of(checkpoint).name, part_of(part_of(out / kind.record)).name}
    videos = [Path(path) for paths in kind.outputs.values() for path in paths]
    return {
        path
        for path in out.iterdir()
        if path.name in names or any(is_segment(path.name, video) for video in videos)
    }


def _present(out: Path, path: str) -> set[Path]:
    """Return what stands where an output would go, complete or not; a linked folder as such."""
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


def _up_to(frames: int | None, present: set[Path]) -> set[Path]:
    """Return the images of the first frames; of all up to the first gap if frames is None."""
    matches = {path: _NUMBERED.fullmatch(path.name) for path in present}
    numbers = {path: int(match[1]) for path, match in matches.items() if match}
    if frames is None:  # the run was cut off
        found = set(numbers.values())
        frames = next(number for number in itertools.count() if number not in found)
    return {path for path, number in numbers.items() if number < frames}


def _remove_empty_folders(out: Path, kind: FolderKind) -> None:
    for paths in kind.outputs.values():
        folder = (out / paths[0]).parent
        if folder != out:
            with contextlib.suppress(OSError):  # missing, not empty, or a link
                folder.rmdir()
