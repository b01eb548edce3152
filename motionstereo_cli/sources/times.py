"""Times of images in tables beside their folder."""

from __future__ import annotations

import hashlib
import itertools
import re
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.reading import as_text, read_bytes
from motionstereo_cli.sources.names import MAX_STAMP, natural_key, stamps_in

#: Beside a folder ``data``: the images' time stamps in ns and names, as in EuRoC.
_EUROC = "data.csv"

#: Beside KITTI's folders ``image_0`` and the like: the time of each image in s, a line each; and
#: beside the folders ``data`` of its raw recordings, and ``data_rect`` of KITTI-360, a date each.
_KITTI, _KITTI_RAW = "times.txt", "timestamps.txt"

#: Larger than the times of ten hours.
_MAX_BYTES = 32_000_000

_NS = 1_000_000_000


class Timeline(NamedTuple):
    """A folder's images in order.

    Attributes:
        files: the images.
        stamps_ns: time of each in ns, rising; empty if unknown.
        table: the file with the times.
        sha256: of that file, as hexadecimal digits.
        note: what to check in that file, empty if nothing.
    """

    files: list[Path]
    stamps_ns: Sequence[int] = ()
    table: Path | None = None
    sha256: str = ""
    note: str = ""


def timeline(path: Path, images: Iterable[Path], *, whole: bool) -> Timeline:
    """Return images in order, with the times from a table beside their folder.

    Args:
        path: the folder.
        images: the images in it.
        whole: they are all of the folder's images, so that tables apply to them.

    Raises:
        InputError: a table cannot be read or does not fit the images.
    """
    files = sorted(images, key=lambda file: natural_key(str(file)))
    beside = path.parent
    named = Timeline(files, stamps_in([file.stem for file in files]))
    if not whole:
        return named
    if path.name == "data" and (beside / _EUROC).exists():
        return _euroc(beside / _EUROC, path)
    if path.name.startswith("image_") and (beside / _KITTI).exists():
        return _by_number(beside / _KITTI, files, _seconds, "a time in s")
    if path.name in ("data", "data_rect") and (beside / _KITTI_RAW).exists():
        return _by_number(beside / _KITTI_RAW, files, _date, "a date and time")
    return named


def _euroc(table: Path, folder: Path) -> Timeline:
    """Return the images that a EuRoC camera's table lists, in the order of time."""
    content = read_bytes(table, "the time stamps", _MAX_BYTES)
    rows = []
    for number, line in enumerate(as_text(content).splitlines(), 1):
        stamp, comma, name = (part.strip() for part in line.partition(","))
        if not line.strip() or stamp.startswith("#"):
            continue
        named = comma and Path(name).name == name
        if not (named and re.fullmatch("[0-9]{1,19}", stamp) and int(stamp) <= MAX_STAMP):
            raise InputError(f"{table}, line {number}: give 'time stamp in ns,file name'")
        rows.append((int(stamp), folder / name))
    rows.sort()
    for (before, _), (after, _) in itertools.pairwise(rows):
        if before == after:
            raise InputError(f"{table} has the time stamp {after} twice: keep one line for it")
    stamps = [stamp for stamp, _ in rows]
    return Timeline([file for _, file in rows], stamps, table, _sha256(content))


def _by_number(table: Path, files: list[Path], parse: Callable[[str], int], form: str) -> Timeline:
    """Return images whose numbers are the lines of a table, from 0."""
    content = read_bytes(table, "the times", _MAX_BYTES)
    try:
        lines = as_text(content).splitlines()
        stamps_ns = [parse(lines[int(file.stem)]) for file in files]
    except (ValueError, OverflowError, IndexError):
        raise InputError(
            f"{table} does not fit the images in {files[0].parent}: give {form} a line, the "
            "first for 000000, or take it away"
        ) from None
    if any(after <= before for before, after in itertools.pairwise(stamps_ns)):
        raise InputError(f"{table}: the times do not rise: mend it, or take it away")
    if not files:
        return Timeline(files, [], table, _sha256(content))
    count, last = len(as_text(content).rstrip().splitlines()), int(files[-1].stem)
    note = (
        f"{table} has {count} times, but the last image is {files[-1].name}: the time of line n is "
        "taken for the image of number n, from 0. See that the images are not renumbered"
    )
    return Timeline(files, stamps_ns, table, _sha256(content), note if count > last + 1 else "")


def _seconds(line: str) -> int:
    return _stamp(round(float(line) * _NS))


def _date(line: str) -> int:
    """Return ``2011-09-26 13:02:25.964389445`` in ns since 1970."""
    whole, _, fraction = line.strip().partition(".")
    moment = datetime.fromisoformat(whole).replace(tzinfo=UTC)
    return _stamp(int(moment.timestamp()) * _NS + int(f"{fraction:0<9.9}"))


def _stamp(stamp_ns: int) -> int:
    if not 0 <= stamp_ns <= MAX_STAMP:
        raise ValueError
    return stamp_ns


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
