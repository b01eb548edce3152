"""The output folder: what may be written and removed there, and how it is completed."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from msgspec import structs

from motionstereo_cli.errors import InputError, OutputError
from motionstereo_cli.files.atomic import (
    is_left_over,
    name_part,
    part_of,
    reported,
    unname,
    write_whole,
)
from motionstereo_cli.files.folders import make_folder, remove, remove_empty
from motionstereo_cli.files.lock import LOCK, locked
from motionstereo_cli.files.reading import real
from motionstereo_cli.files.targets import sum_of
from motionstereo_cli.runs.checkpoint import (
    check_same,
    read_checkpoint,
    write_checkpoint,
)
from motionstereo_cli.runs.folder_files import (
    CHECKPOINT,
    RUN,
    TABLE,
    FolderKind,
    head,
    present_of,
    read_record,
    remove_empty_folders,
    sums_of,
    temporary,
    up_to,
    written,
)
from motionstereo_cli.runs.open_outputs import Sinks
from motionstereo_cli.sinks.outputs import OUTPUTS
from motionstereo_cli.sinks.records import FolderRecord, RunRecord

if TYPE_CHECKING:
    from motionstereo_cli.pipeline import State


class RunFolder(Sinks):
    """The output folder of a command, from its first file to its last.

    Entering the block locks the folder, and prepares it or finds its checkpoint. The record is
    written last, by :meth:`complete`: if it exists, everything beside it is complete. When the
    block ends before that, the outputs are abandoned: what was done is kept, or nothing is left.

    Args:
        path: the folder; created if missing.
        outputs: names of what is to be written, from ``kind``.
        kind: the command whose folder it is.
        identity: the :func:`head` of the record and all that the results depend on. With
            ``resume`` it has to be the same as before. None: only who wrote it.
        frames: how many numbered files there will be; files of others with higher numbers do
            not matter. None: there may be no files of others.
        overwrite: replace what an earlier run wrote; other files are never touched.
        resume: continue where the same run ended, or begin it.
        inputs: files and folders that must not be written to.
        table: a further steering table, elsewhere; see :func:`check_table`.
        check: raises a ValueError for a state that does not fit this run.

    Raises:
        BusyError: another run is writing there.
        OutputError: the folder cannot be written, is not empty, or belongs to another run.
    """

    def __init__(
        self,
        path: Path,
        outputs: Sequence[str],
        kind: FolderKind = RUN,
        *,
        identity: FolderRecord | None = None,
        frames: int | None = None,
        overwrite: bool = False,
        resume: bool = False,
        inputs: Iterable[Path] = (),
        table: Path | None = None,
        check: Callable[[State], object] = bool,
    ) -> None:
        super().__init__()
        self.path = path
        self._outputs = outputs
        self._kind = kind
        self._identity = identity or kind.kind(program=kind.program, outputs=tuple(outputs))
        self._frames = frames
        self._overwrite = overwrite
        self._resume = resume
        self._inputs = tuple(inputs)
        self._table = table
        self._check = check
        self._lock = contextlib.ExitStack()
        self._thread = ThreadPoolExecutor(1, "checkpoint")
        self._checkpoint: Future[None] | None = None

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
            self._thread.shutdown()
            if self.finished is None:
                self._keep = self._keep and self._kind.keeps
                super().__exit__(kind, error, traceback)
                if not self._complete:
                    tidy(self.path, self._kind)

    def checkpoint(self) -> None:
        """Begin to write what another process needs to continue after this frame.

        It is written in a thread, while frames go on; until it is complete, the one before counts.

        Raises:
            OutputError: the one before, or an output, cannot be written.
        """
        assert self.state is not None
        self._end_checkpoint()
        marks = {name: sink.checkpoint() for name, sink in self._sinks.items()}
        begun = (self.path / CHECKPOINT, self._identity, self.state, self.totals, marks)
        self._checkpoint = self._thread.submit(write_checkpoint, *begun)

    def close(self) -> None:
        """Complete the outputs, see :meth:`Sinks.close`."""
        self._end_checkpoint()
        super().close()

    def _end_checkpoint(self) -> None:
        """Wait for the checkpoint that is being written."""
        begun, self._checkpoint = self._checkpoint, None
        if begun is not None:
            begun.result()

    def complete(self, **outcome: Any) -> FolderRecord:
        """Write the record, after the outputs were closed, and return it.

        Args:
            outcome: the outcome, by the fields of the record that are not in the identity.

        Raises:
            OutputError: it cannot be written.
        """
        record = structs.replace(self._identity, **outcome)
        if isinstance(record, RunRecord) and record.counts:
            for name in self._outputs:
                OUTPUTS[name].complete(self.path, record)
            with reported(self.path):
                sums = {
                    name: sums_of(self.path, self._kind.outputs[name], record.counts.written)
                    for name in self._outputs
                    if not OUTPUTS[name].finish  # outputs made of other outputs are made again
                }
            if self._table is not None:
                sums[TABLE] = sums_of(self._table.parent, [self._table.name], 1)
            record = structs.replace(record, sums=sums)
        complete(self.path, record, self._kind)
        super().complete()
        return record

    def _check_sums(self, finished: FolderRecord) -> None:
        """Check that the files of a complete run are unchanged."""
        if not isinstance(finished, RunRecord) or not finished.counts:
            return
        for name, sums in (finished.sums or {}).items():
            folder, paths, shown = self.path, self._kind.outputs.get(name, ()), name
            if name == TABLE:
                if self._table is None:
                    continue
                folder, paths, shown = self._table.parent, (self._table.name,), str(self._table)
            try:
                same = sums == sums_of(folder, paths, finished.counts.written)
            except OSError:
                same = False
            if not same:
                raise OutputError(
                    f"{self.path} is complete, but {shown} is no longer what the run wrote: "
                    "give --overwrite to start again"
                )

    def check(self) -> None:
        """Make sure that the block can be entered, without writing anything.

        Raises:
            OutputError: the folder cannot be written, is not empty, or is of another run.
        """
        if not os.path.lexists(self.path):
            above = next(each for each in self.path.absolute().parents if os.path.lexists(each))
            if not (above.is_dir() and os.access(above, os.W_OK)):
                raise OutputError(f"cannot write {self.path}: {above} cannot be written to")
            return
        overwrite, record = self._overwrite, self.path / self._kind.record
        if self._resume and (
            begun := record_of(self.path, self._kind) or read_record(part_of(record), self._kind)
        ):
            check_same(self.path, self._identity, begun)
            overwrite = True
        check_free(
            *(self.path, self._outputs, self._kind),
            frames=self._frames,
            overwrite=overwrite,
            inputs=self._inputs,
            table=self._table,
        )

    def _begin(self) -> None:
        overwrite = self._overwrite
        if self._resume:
            if finished := record_of(self.path, self._kind):
                check_same(self.path, self._identity, finished)
                self._check_sums(finished)
                clear(self.path, finished, self._kind)
                self.finished = finished
                return
            if begun := read_record(part_of(self.path / self._kind.record), self._kind):
                check_same(self.path, self._identity, begun)
                overwrite = True
                self.resumed = True
                if since := read_checkpoint(self.path / CHECKPOINT, self._identity, self._check):
                    self.state, self.totals = since.state, since.totals
                    self._marks, self._keep = since.sinks, True
                    if self._table is not None:
                        _is_former(self._table, self.path, self._kind, overwrite=True)
                    return
        prepare(
            *(self.path, self._outputs, self._kind),
            identity=self._identity,
            frames=self._frames,
            overwrite=overwrite,
            inputs=self._inputs,
            table=self._table,
        )


def prepare(
    out: Path,
    outputs: Sequence[str],
    kind: FolderKind = RUN,
    *,
    identity: FolderRecord | None = None,
    frames: int | None = None,
    overwrite: bool = False,
    inputs: Iterable[Path] = (),
    table: Path | None = None,
) -> None:
    """Make the output folder ready.

    With ``overwrite``, exactly the files that the record of an earlier run lists are removed. Other
    files are neither removed nor overwritten. After a kill in between, the record still lists
    the remaining ones.

    Args:
        out: the folder; made where it is missing.
        outputs: names of the outputs.
        kind: whose folder it is.
        identity: what the record says while the run is incomplete; if None, only who wrote it.
        frames: see :class:`RunFolder`.
        overwrite: accept a folder that is not empty.
        inputs: files and folders that are read.
        table: see :class:`RunFolder`.

    Raises:
        OutputError: the folder is not empty, cannot be written, or holds an input or someone
            else's file where something would be written.
    """
    make_folder(out, out)
    record, part = out / kind.record, part_of(out / kind.record)
    former, former_table = check_free(
        *(out, outputs, kind), frames=frames, overwrite=overwrite, inputs=inputs, table=table
    )
    with reported(out):
        if former_table and table is not None:
            remove(table.parent, [table])
        if record in former:  # incomplete from now on, and still this program's
            unname(record)
        # From the last image to the first: of an interrupted run, the images up to a gap count.
        remove(out, sorted(former - {record, part}, reverse=True))
        remove_empty_folders(out, kind)
    begun = identity or head(outputs)
    write_whole(part, kind.format(begun))


def check_free(
    out: Path,
    outputs: Sequence[str],
    kind: FolderKind = RUN,
    *,
    frames: int | None = None,
    overwrite: bool = False,
    inputs: Iterable[Path] = (),
    table: Path | None = None,
) -> tuple[set[Path], bool]:
    """Make sure that an existing folder can be made ready; for the arguments see :func:`prepare`.

    Returns:
        The files of an earlier run, and whether the table is one of them.

    Raises:
        OutputError: as of :func:`prepare`.
    """
    part = part_of(out / kind.record)
    with reported(out):
        if not overwrite and not all(
            path.name == LOCK or is_left_over(path) for path in out.iterdir()
        ):
            advice = ", or --resume to go on" if kind is RUN and part.exists() else ""
            raise OutputError(f"{out} is not empty: give another folder, or --overwrite{advice}")
        former = written(out, kind) | {path for path in out.iterdir() if is_left_over(path)}
        former_table = table is not None and _is_former(table, out, kind, overwrite=overwrite)
        paths = [path for name in outputs for path in kind.outputs[name]]
        present = present_of(out, kind.record) | temporary(out, kind, outputs)
        for target in paths:
            there = present_of(out, target)
            numbered = "{" in target and frames is not None and (out / target).parent not in there
            present |= up_to(frames, there) if numbered else there
        for path in sorted(present - former):
            if path.is_symlink():
                raise OutputError(f"{path} is a link: remove it or give another folder")
            raise OutputError(f"{path} is not from an earlier run: move it or give another folder")
        taken = {real(path) for path in inputs}
        for path in former.union(out / path for path in paths):
            for place in (path, path.parent):
                if real(place) in taken:
                    raise OutputError(f"{place} is an input of this run: give another folder")
    return former, former_table


def complete(out: Path, record: FolderRecord, kind: FolderKind = RUN) -> None:
    """Write the record of a run that is done.

    Args:
        out: the folder.
        record: the record.
        kind: the command whose folder it is.

    Raises:
        OutputError: the record cannot be written.
    """
    # The .part stays until all is on disk: it marks the folder as this program's.
    part = part_of(out / kind.record)
    write_whole(part, kind.format(record), durable=True)
    with reported(out / kind.record):
        name_part(out / kind.record)
    clear(out, record, kind)


def clear(out: Path, record: FolderRecord, kind: FolderKind = RUN) -> None:
    """Remove what a complete run no longer needs: its checkpoint, and segments of its videos."""
    with reported(out):
        remove(out, sorted(temporary(out, kind, kind.outputs.keys() & set(record.outputs or ()))))


def _is_former(table: Path, out: Path, kind: FolderKind, *, overwrite: bool) -> bool:
    """Return whether a table exists that an earlier run into the same folder wrote.

    It is identified by its path, which is in the record, and by its content: the hash in the record
    or, if the run ended before writing one, the partial table in the folder.

    Raises:
        OutputError: another file is there, or it must not be overwritten.
    """
    if not os.path.lexists(table):
        return False
    if not overwrite:
        raise OutputError(f"{table} is there already: give another name, or --overwrite")
    found = sum_of(table)
    known = {sum_of(part_of(out / TABLE))} - {None}
    for path in (out / kind.record, part_of(out / kind.record)):
        with contextlib.suppress(InputError, LookupError, ValueError, OSError):
            record = read_record(path, kind)
            if not (isinstance(record, RunRecord) and record.table and record.sums):
                continue
            if real(out / record.table) == real(table):
                known.add(record.sums[TABLE].sha256)
    if found is None or found not in known:
        raise OutputError(
            f"{table} was not written by an earlier run into {out}, or was changed: move it, or "
            "give another name"
        )
    return True


def record_of(out: Path, kind: FolderKind = RUN) -> FolderRecord | None:
    """Return the record of a complete run, None if there is none.

    Raises:
        InputError: it is damaged.
    """
    return read_record(out / kind.record, kind)


def tidy(out: Path, kind: FolderKind = RUN) -> None:
    """Remove what a failed run left, if none of it is of use."""
    part = part_of(out / kind.record)
    with contextlib.suppress(OSError):
        if not kind.keeps or written(out, kind) == {part}:
            _remove_all(out, kind)


def discard(out: Path, kind: FolderKind) -> None:
    """Remove what a run wrote, complete or not, and its folder if that is then empty.

    Raises:
        OutputError: a file cannot be removed.
    """
    if out.is_dir() and not out.is_symlink():
        with reported(out):
            _remove_all(out, kind)
            remove_empty(out)


def _remove_all(out: Path, kind: FolderKind) -> None:
    """Remove what records list, and these last."""
    found = written(out, kind)
    records = [path for path in (out / kind.record, part_of(out / kind.record)) if path in found]
    remove(out, [*sorted(found.difference(records), reverse=True), *records])
    remove_empty_folders(out, kind)
