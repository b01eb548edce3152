"""A file that is written in segments, so that another process can continue it."""

from __future__ import annotations

from pathlib import Path

from motionstereo_cli.errors import OutputError
from motionstereo_cli.files.atomic import remove_own, reported, segment_of, sync
from motionstereo_cli.files.reading import sha256_of


class Segments:
    """The segments of a file, beside its final name.

    Args:
        path: final name of the file.
        sums: SHA-256 of each segment that is complete.

    Attributes:
        sums: the same, of the segments so far.

    Raises:
        OutputError: a segment is missing or was changed.
    """

    def __init__(self, path: Path, sums: tuple[str, ...] = ()) -> None:
        self._path = path
        self.sums = sums
        for segment, known in zip(self.paths, sums, strict=True):
            _check(segment, known)

    @property
    def paths(self) -> list[Path]:
        """The segments that are complete."""
        return [segment_of(self._path, number) for number in range(len(self.sums))]

    @property
    def next(self) -> Path:
        """The segment that comes next."""
        return segment_of(self._path, len(self.sums))

    def end(self) -> None:
        """Count the next segment, already written, as complete, and sync it to disk.

        Raises:
            OutputError: it cannot be read.
        """
        sync(self.next)
        with reported(self.next):
            self.sums = (*self.sums, sha256_of(self.next))

    def remove(self) -> None:
        """Remove all that are complete."""
        for segment in self.paths:
            remove_own(segment)


def _check(segment: Path, known: str) -> None:
    """Make sure that a segment is what a checkpoint says."""
    try:
        found = None if segment.is_symlink() else sha256_of(segment)
    except OSError as error:
        raise OutputError(
            f"{segment} is missing ({error.strerror}): --resume cannot go on without it, give "
            "--overwrite"
        ) from error
    if found != known:
        raise OutputError(f"{segment} was cut or changed: --resume cannot go on, give --overwrite")
