"""The output folder: what may be written and removed there, and how it is completed."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Sequence, Set
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from msgspec import structs

from motionstereo_cli.errors import InputError, OutputError, TakenError
from motionstereo_cli.files.atomic import (
    check_free,
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
    NAMING,
    RUN,
    TABLE,
    FolderKind,
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
        table: a further steering table, elsewhere.
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
        self._record, self._part = path / kind.record, part_of(path / kind.record)
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

    def __exit__(self, *raised: object) -> None:
        with self._lock:
            self._thread.shutdown()
            if self.finished is None:
                self._keep = self._keep and self._kind.keeps
                super().__exit__()
                if not self._complete:
                    self._tidy({each.path for each in raised if isinstance(each, TakenError)})

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
        self.begin_naming()
        super().close()

    def begin_naming(self) -> None:
        """Make sure that the final names of streams are free; from now on they are the run's.

        Raises:
            OutputError: another file has one, or the folder cannot be written.
        """
        paths = [path for name in self._outputs for path in self._kind.outputs[name]]
        finals = {self.path / path for path in (*paths, self._kind.record) if "{" not in path}
        for path in sorted(finals - written(self.path, self._kind)):
            check_free(path)
        write_whole(self.path / NAMING, b"")

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
        # The .part stays until all is on disk: it marks the folder as this program's.
        write_whole(self._part, self._kind.format(record), durable=True)
        with reported(self._record):
            name_part(self._record)
        self._clear(record)
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
        if self._resume and (
            begun := record_of(self.path, self._kind) or read_record(self._part, self._kind)
        ):
            check_same(self.path, self._identity, begun)
            self._overwrite = True
        self._former_files()

    def _begin(self) -> None:
        if self._resume:
            if finished := record_of(self.path, self._kind):
                check_same(self.path, self._identity, finished)
                self._check_sums(finished)
                self._clear(finished)
                self.finished = finished
                return
            if begun := read_record(self._part, self._kind):
                check_same(self.path, self._identity, begun)
                self._overwrite = True
                self.resumed = True
                if since := read_checkpoint(self.path / CHECKPOINT, self._identity, self._check):
                    self.state, self.totals = since.state, since.totals
                    self._marks, self._keep = since.sinks, True
                    self._former_files()
                    return
        self.prepare()

    def prepare(self) -> None:
        """Make the folder ready for a new run.

        With ``overwrite``, exactly the files that the record of an earlier run lists are removed.
        Other files are neither removed nor overwritten. After a kill in between, the record still
        lists the remaining ones.

        Raises:
            OutputError: the folder is not empty, cannot be written, or holds an input or someone
                else's file where something would be written.
        """
        make_folder(self.path, self.path)
        former = self._former_files()
        with reported(self.path):
            if self._table is not None and os.path.lexists(self._table):
                remove(self._table.parent, [self._table])
            naming = self.path / NAMING
            if self._record in former:  # incomplete from now on, and still this program's
                write_whole(naming, b"")
                unname(self._record)
            # From the last image to the first: of an interrupted run, the images up to a gap count.
            kept = {self._record, self._part, naming}
            remove(self.path, [*sorted(former - kept, reverse=True), naming])
            remove_empty_folders(self.path, self._kind)
        write_whole(self._part, self._kind.format(self._identity))

    def _former_files(self) -> set[Path]:
        """Return the files of an earlier run, once it is sure that the folder can be made ready.

        Raises:
            OutputError: as of :meth:`prepare`.
        """
        out, kind = self.path, self._kind
        with reported(out):
            if not self._overwrite and not all(
                path.name == LOCK or is_left_over(path) for path in out.iterdir()
            ):
                begun = kind is RUN and read_record(self._part, kind)
                advice = ", or --resume to go on" if begun else ""
                raise OutputError(
                    f"{out} is not empty: give another folder, or --overwrite{advice}"
                )
            former = written(out, kind) | {path for path in out.iterdir() if is_left_over(path)}
            self._check_table()
            paths = [path for name in self._outputs for path in kind.outputs[name]]
            present = present_of(out, kind.record) | temporary(out, kind, self._outputs)
            for target in paths:
                there = present_of(out, target)
                counted = self._frames is not None and (out / target).parent not in there
                present |= up_to(self._frames, there) if "{" in target and counted else there
            for path in sorted(present - former):
                if path.is_symlink():
                    raise OutputError(f"{path} is a link: remove it or give another folder")
                raise OutputError(
                    f"{path} is not from an earlier run: move it or give another folder"
                )
            taken = {real(path) for path in self._inputs}
            for path in former.union(out / path for path in paths):
                for place in (path, path.parent):
                    if real(place) in taken:
                        raise OutputError(f"{place} is an input of this run: give another folder")
        return former

    def _check_table(self) -> None:
        """Make sure that where the table is to be, there is none but of an earlier run into here.

        It is identified by its path, which is in the record, and by its content: the hash in the
        record or, if the run ended before writing one, the partial table in the folder.

        Raises:
            OutputError: another file is there, or it must not be overwritten.
        """
        table, out = self._table, self.path
        if table is None or not os.path.lexists(table):
            return
        if not self._overwrite:
            raise OutputError(f"{table} is there already: give another name, or --overwrite")
        found = sum_of(table)
        known = {sum_of(part_of(out / TABLE))} - {None}
        for path in (self._record, self._part):
            with contextlib.suppress(InputError, LookupError, ValueError, OSError):
                record = read_record(path, self._kind)
                if not (isinstance(record, RunRecord) and record.table and record.sums):
                    continue
                if real(out / record.table) == real(table):
                    known.add(record.sums[TABLE].sha256)
        if found is None or found not in known:
            raise OutputError(
                f"{table} was not written by an earlier run into {out}, or was changed: move it, "
                "or give another name"
            )

    def _clear(self, record: FolderRecord) -> None:
        """Remove what a complete run no longer needs: its checkpoint, and segments of videos."""
        names = self._kind.outputs.keys() & set(record.outputs or ())
        with reported(self.path):
            remove(self.path, sorted(temporary(self.path, self._kind, names)))

    def _tidy(self, foreign: Set[Path]) -> None:
        """Remove what a failed run left, if none of it is of use, but no files of others."""
        with contextlib.suppress(OSError):
            if not self._kind.keeps or written(self.path, self._kind) == {self._part}:
                _remove_all(self.path, self._kind, foreign)


def record_of(out: Path, kind: FolderKind = RUN) -> FolderRecord | None:
    """Return the record of a complete run, None if there is none.

    Raises:
        InputError: it is damaged.
    """
    return read_record(out / kind.record, kind)


def discard(out: Path, kind: FolderKind) -> None:
    """Remove what a run wrote, complete or not, and its folder if that is then empty.

    Raises:
        OutputError: a file cannot be removed.
    """
    if out.is_dir() and not out.is_symlink():
        with reported(out):
            _remove_all(out, kind)
            remove_empty(out)


def _remove_all(out: Path, kind: FolderKind, foreign: Set[Path] = frozenset()) -> None:
    """Remove what records list, except files of others, and the records last."""
    found = written(out, kind) - foreign
    last = (out / NAMING, out / kind.record, part_of(out / kind.record))
    records = [path for path in last if path in found]
    remove(out, [*sorted(found.difference(records), reverse=True), *records])
    remove_empty_folders(out, kind)
