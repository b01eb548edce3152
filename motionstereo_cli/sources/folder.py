"""One camera from a folder of images."""

from __future__ import annotations

import hashlib
import operator
import statistics
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.reading import MAX_PIXELS, open_regular, sha256_of_all
from motionstereo_cli.files.stills import (
    SUFFIXES,
    DamagedImageError,
    Still,
    colours_of,
    grey_of,
    images_in,
    read_still,
    shown,
)
from motionstereo_cli.sources.names import file_numbers, gaps
from motionstereo_cli.sources.recording import Image, StillsRecording, images
from motionstereo_cli.sources.times import timeline

#: Formats of images that are not read.
_PICTURES = frozenset(
    {".gif", ".jp2", ".j2k", ".avif", ".heic", ".heif", ".jxl", ".exr", ".hdr", ".dng", ".raw"}
    | {".cr2", ".nef", ".arw", ".tga", ".pbm", ".pnm", ".pam", ".fits", ".npy", ".svg"}
)


class FolderRecording(StillsRecording):
    """Images of one folder in natural order: frame2 before frame10.

    Colour becomes BT.601 luma, alpha is dropped, 16 bits are scaled to 8, and the orientation in
    the metadata is applied. An image that cannot be read is counted and its number skipped.

    The time stamp of an image is the number in its file name, if the names differ only in one
    number that counts in steps; otherwise its position. It is a time only with ``frame_rate``.
    If there is a ``data.csv`` beside a folder ``data`` (EuRoC) or a ``times.txt`` beside a folder
    ``image_0`` (KITTI), the time stamps are read from it.

    Args:
        path: an existing folder, or a glob pattern for the messages.
        files: the images, if not all of the folder.
        frame_rate: images per second, None = unknown.
        white: level that becomes 255 in images of 16 bits; 0 = 65535.
        max_pixels: largest width times height of an image.

    Raises:
        InputError: there is no readable image; while iterating: an image is too large, or differs
            from the first in size.
    """

    def __init__(
        self,
        path: Path,
        files: Iterable[Path] | None = None,
        frame_rate: Fraction | None = None,
        *,
        white: int = 0,
        max_pixels: int = MAX_PIXELS,
    ) -> None:
        self._path, self._white = path, white
        self._given = list(files) if files is not None else [path]
        self._max_pixels = max_pixels
        self._unreadable: list[str] = []
        self._pages = self._changed = 0
        try:
            found = images_in(path) if files is None else shown(self._given, SUFFIXES)
            times = timeline(path, found, whole=files is None)
        except OSError as error:
            raise InputError(f"cannot read the folder {path}: {error.strerror}") from error
        self._files, self._table, stamps_ns = times.files, times, times.stamps_ns
        self.warnings = (times.note,) if times.note else ()
        #: Size and SHA-256 of each file, once it was read.
        self._sums: list[tuple[int, bytes] | None] = [None] * len(self._files)
        if not self._files:
            others = _others(path) if files is None else ""
            raise InputError(
                f"{path} has no images that are read{others}: put {', '.join(sorted(SUFFIXES))} "
                "files in it"
            )
        self.expected_images = len(self._files)
        self.time_base: Fraction | None = None
        if stamps_ns:
            self._pts, self.time_base, self.stamped = stamps_ns, Fraction(1, 10**9), True
            if len(stamps_ns) > 1:
                # The median, so that lost images do not matter.
                period_ns = statistics.median(map(operator.sub, stamps_ns[1:], stamps_ns[:-1]))
                self.frame_rate = Fraction(10**9) / Fraction(period_ns)
        else:
            numbers = file_numbers([file.stem for file in self._files])
            self.numbered, self.timeless = numbers is not None, True
            self._pts = numbers or list(range(len(self._files)))
            found_gaps = tuple(f"{path}: {gap}" for gap in gaps(self._pts))
            self.warnings += found_gaps
            self.holes = "".join(found_gaps)
            if frame_rate:
                self.frame_rate = frame_rate
                self.time_base = 1 / self.frame_rate
        self.names = [file.stem for file in self._files]
        self._places = _places(self.names)
        self._start(self._read(), path)

    def place_of(self, number: int) -> int:
        """Return the place of an image by its name: a missing file leaves a gap."""
        return self._places[number]

    @property
    def lost(self) -> int:
        """Images that could not be read so far."""
        return len(self._unreadable)

    @property
    def damage(self) -> list[str]:
        """One line for each kind of damage: the number of images, and the first."""
        lines = []
        if self._unreadable:
            count, first = images(self.lost), self._unreadable[0]
            lines = [f"{self._path}: {count} could not be read, the first is {first}"]
        if self._changed:
            lines.append(f"{self._path}: {images(self._changed)} changed while the run went on")
        return lines

    def describe(self) -> dict[str, Any]:
        """Describe the images, as JSON-able values."""
        codecs = sorted({file.suffix.lower()[1:] for file in self._files})
        return self._described(self._path, "images", ", ".join(codecs))

    @property
    def files(self) -> tuple[Path, ...]:
        """The folder or the images given, and the table of times if there is one."""
        return (*self._given, *([self._table.table] if self._table.table else []))

    def fingerprint(self) -> dict[str, Any]:
        """Return the size of all images in bytes, and a SHA-256; reads those not yet decoded.

        It is that of :func:`sha256_of_all`; of decoded images the decoded bytes count. The hash of
        a table of times is ``times_sha256``.
        """
        sums, size = list[tuple[str, str]](), 0
        for index, path in enumerate(self._files):
            if self._sums[index] is None:
                self._sums[index] = _sums_of(path)
            if (known := self._sums[index]) is not None:
                sums.append((known[1].hex(), path.name))
                size += known[0]
        times = {"times_sha256": self._table.sha256} if self._table.table else {}
        return {"bytes": size, "sha256": sha256_of_all(sums), **times}

    def outline(self) -> Sequence[tuple[int, int]]:
        """Return numbers and time stamps of all images."""
        return list(enumerate(self._pts))

    def skip_to(self, number: int) -> bool:
        """Begin with an image; earlier ones are not read."""
        self._images = self._read(number, (self.height, self.width))
        return True

    def _read(self, begin: int = 0, shape: tuple[int, ...] | None = None) -> Iterator[Image]:
        for number, file in enumerate(self._files[begin:], begin):
            pts = self._pts[number]
            try:
                still = read_still(file, self._max_pixels)
            except DamagedImageError:
                self._unreadable.append(file.name)
                continue
            self._note(number, still)
            grey = grey_of(still.pixels, file, self._white)
            if shape is None:
                shape = grey.shape
                self._look_at_first(still, file)
            if grey.shape != shape:
                raise InputError(
                    f"{file} is {grey.shape[1]}x{grey.shape[0]} but the images before it are "
                    f"{shape[1]}x{shape[0]}: make all images of a folder the same size"
                )
            yield Image(number, pts, grey, colours_of(still.pixels))

    def _look_at_first(self, still: Still, file: Path) -> None:
        """Note what the first image and its file tell about all."""
        self._look_at(still.pixels)
        self.stated = still.stated
        if still.pages > 1:
            self.warnings += (
                f"{file} has {still.pages} pages, of which the first is used: split it",
            )

    def _note(self, number: int, still: Still) -> None:
        """Keep an image's hash, and count a change since the fingerprint was read."""
        read, known = (still.size_bytes, still.sha256), self._sums[number]
        self._changed += known is not None and known != read
        self._sums[number] = read


def _others(folder: Path) -> str:
    """Return a note on the other files of a folder without images."""
    found = {file.suffix.lower() for file in folder.iterdir() if not file.name.startswith(".")}
    kinds = sorted(found & _PICTURES)
    return f" (convert its {', '.join(kinds)} files to PNG)" if kinds else ""


def _sums_of(path: Path) -> tuple[int, bytes] | None:
    """Return size and SHA-256 of a file, None if it cannot be read."""
    try:
        with open_regular(path) as file:
            digest = hashlib.file_digest(file, "sha256").digest()
            return file.tell(), digest
    except OSError:
        return None


def _places(names: list[str]) -> Sequence[int]:
    """Return the place of each image in the whole recording, the first one's 0."""
    numbers = file_numbers(names) if len(names) > 1 else None
    if numbers is None:
        return range(len(names))
    step = min(map(operator.sub, numbers[1:], numbers[:-1]))
    return [(number - numbers[0]) // step for number in numbers]
