"""Tables and numbered files, which have their final names only when they are complete."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import math
import os
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from io import BufferedRandom, BufferedWriter
from pathlib import Path

from motionstereo_cli.errors import OutputError
from motionstereo_cli.files.atomic import (
    check_free,
    name_part,
    open_again,
    open_new,
    part_of,
    remove_own,
    reported,
    sync,
    unname,
    write_whole,
)
from motionstereo_cli.files.folders import make_folder
from motionstereo_cli.files.reading import open_regular, sha256_of
from motionstereo_cli.files.records import restored


def cell(value: float | None, decimals: int) -> str:
    """Return a number as a cell of a table, empty = unknown; it never needs quotes."""
    if value is None or not math.isfinite(value):
        return ""
    return f"{value:z.{decimals}f}"  # z: no -0.0000


#: First characters that a spreadsheet takes for a formula.
_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def text_cell(text: object) -> str:
    """Return a text as a cell; a spreadsheet's formula gets the prefix '."""
    shown = str(text)
    return f"'{shown}" if shown.startswith(_FORMULA) else shown


def cell_text(shown: str) -> str:
    """Return the text of a cell that :func:`text_cell` made."""
    return shown[1:] if shown.startswith("'") and shown[1:].startswith(_FORMULA) else shown


#: Checkpoint of a table: its size in bytes, and their SHA-256.
TableMark = tuple[int, str]
#: Checkpoint of numbered files: their number, and a SHA-256 of all of them.
FilesMark = tuple[int, str]

_PIECE_BYTES = 1 << 20


class TableFile:
    """A table as a file that gets its name when it is complete: RFC 4180, with LF.

    Args:
        path: final name.
        header: names of the columns; none if empty.
        since: continue from this checkpoint of an earlier table.

    Raises:
        OutputError: the file cannot be written, or is not what the checkpoint says.
    """

    def __init__(self, path: Path, header: str, since: TableMark | None = None) -> None:
        self._path = path
        self._file: BufferedWriter | BufferedRandom
        with reported(path):
            if since is None:
                self._sums = hashlib.sha256()
                self._file = os.fdopen(open_new(part_of(path)), "wb")
            else:
                since = restored(since, TableMark)
                self._sums = _checked(path, since)
                self._file = os.fdopen(open_again(part_of(path)), "r+b")
                self._file.truncate(since[0])
                self._file.seek(since[0])
        if header and since is None:
            self.add([header])

    def add(self, lines: Iterable[str]) -> None:
        """Append lines, given without line ends, and flush them."""
        content = "".join(f"{line}\n" for line in lines).encode("ascii")
        self._sums.update(content)
        with reported(self._path):
            self._file.write(content)
            self._file.flush()

    def checkpoint(self) -> TableMark:
        """Make sure that all so far is on the disk."""
        with reported(self._path):
            os.fsync(self._file.fileno())
            return self._file.tell(), self._sums.hexdigest()

    def end(self) -> None:
        """Complete the table, which keeps its ``.part`` name."""
        with reported(self._path):
            self._file.close()

    def close(self) -> None:
        """Complete the table and give it its name."""
        self.end()
        with reported(self._path):
            name_part(self._path)

    def abandon(self, *, keep: bool) -> None:
        """Leave the table under its ``.part`` name or, without ``keep``, remove it."""
        with contextlib.suppress(OSError):  # a failed write is tried again
            self._file.close()
        if not keep:
            remove_own(part_of(self._path))


def _checked(path: Path, since: TableMark) -> hashlib._Hash:
    """Truncate the ``.part`` of a table to its checkpoint, and return its hash so far.

    The table may be complete already, while another output of the run is not.
    """
    for place in (part_of(path), path):
        with contextlib.suppress(FileNotFoundError):
            if place.is_symlink():
                continue
            sums, left = hashlib.sha256(), since[0]
            with open_regular(place) as file:
                while left and (piece := file.read(min(left, _PIECE_BYTES))):
                    sums.update(piece)
                    left -= len(piece)
            if not left and sums.hexdigest() == since[1]:
                if place == path:
                    unname(path)
                return sums
    raise OutputError(
        f"{part_of(path)} was cut or changed: --resume cannot go on, give --overwrite"
    )


class NumberedFiles:
    """Files of one kind, one per frame, each written atomically.

    Args:
        path: their path; ``{:06d}`` in its name is the number of the frame.
        since: continue from this checkpoint of earlier files.

    Raises:
        OutputError: the folder cannot be made or a file not written, or the files are not what
            the checkpoint says.
    """

    def __init__(self, path: Path, since: FilesMark | None = None) -> None:
        self._path = path
        self._unsynced: list[Path] = []
        self._mark: FilesMark = (0, "")
        self._kept = 0  # files of an earlier process have lower numbers; they are written again
        make_folder(path.parent)
        if since is not None:
            self._check(restored(since, FilesMark))
            numbers = itertools.count(self._mark[0])
            self._kept = next(n for n in numbers if not os.path.lexists(self._named(n)))

    def add(self, number: int, content: bytes) -> None:
        """Write the file of a frame."""
        self._check_folder()
        path = self._named(number)
        if number >= self._kept:
            check_free(path)
        with self._link_told():
            write_whole(path, content)
        self._unsynced.append(path)
        self._count(hashlib.sha256(content).digest())

    def checkpoint(self) -> Callable[[], FilesMark]:
        """Return a function that makes sure that all so far is on the disk.

        Of many files that takes long: it may be called while others are added.
        """
        unsynced, self._unsynced = self._unsynced, []
        return partial(self._synced, unsynced, self._mark)

    def close(self) -> None:
        """Do nothing: every file is complete."""

    def abandon(self, *, keep: bool) -> None:
        """Do nothing: every file is complete."""

    def _synced(self, paths: Iterable[Path], mark: FilesMark) -> FilesMark:
        with self._link_told():
            for path in paths:
                sync(path)
        return mark

    @contextlib.contextmanager
    def _link_told(self) -> Iterator[None]:
        """Report a link in place of the folder, rather than that a file is not there."""
        try:
            yield
        except OutputError:
            self._check_folder()
            raise

    def _check_folder(self) -> None:
        folder = self._path.parent
        if folder.is_symlink():
            raise OutputError(f"{folder} has become a link: the results would go elsewhere")

    def _named(self, number: int) -> Path:
        return self._path.with_name(self._path.name.format(number))

    def _count(self, digest: bytes) -> None:
        count, sums = self._mark
        chained = hashlib.sha256(sums.encode() + digest)
        self._mark = (count + 1, chained.hexdigest())

    def _check(self, since: FilesMark) -> None:
        for number in range(since[0]):
            path = self._named(number)
            try:
                self._count(bytes.fromhex(sha256_of(path)))
            except OSError as error:
                raise OutputError(
                    f"{path} cannot be read ({error.strerror}): --resume cannot go on without "
                    "it, give --overwrite"
                ) from error
        if self._mark != since:
            raise OutputError(
                f"{self._path.parent} has a file that was changed: --resume cannot go on, give "
                "--overwrite"
            )
