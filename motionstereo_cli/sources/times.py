"""What file names, and tables beside a folder, tell of the images' order, numbers and times."""

from __future__ import annotations

import hashlib
import itertools
import operator
import re
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.reading import MAX_TABLE_BYTES, as_text, read_bytes

#: Beside a folder ``data``: the images' time stamps in ns and names, as EuRoC lays them.
_EUROC = "data.csv"

#: Beside KITTI's folders ``image_0`` and the like: the time of each image in s, a line each; and
#: beside the folders ``data`` of its raw recordings, and ``data_rect`` of KITTI-360, a date each.
_KITTI, _KITTI_RAW = "times.txt", "timestamps.txt"

#: The largest time stamp and number: FFmpeg and NumPy hold 64 bits with a sign.
_MAX_STAMP = 2**63 - 1

_NS = 1_000_000_000

#: A name that is a time since 1970, from 2001 to 2100: in s with decimals; in ms, us or ns.
_NAME_STAMP = re.compile(
    r"(\D*)(?:([1-3]\d{9})[._](\d{3}|\d{6}|\d{9})|([1-3](?:\d{12}|\d{15}|\d{18})))(\D*)", re.ASCII
)


class Timeline(NamedTuple):
    """A folder's images in order.

    Attributes:
        files: the images.
        stamps_ns: time of each in ns, rising; empty where nothing tells it.
        table: the file that told it.
        sha256: of that file, as hexadecimal digits.
    """

    files: list[Path]
    stamps_ns: Sequence[int] = ()
    table: Path | None = None
    sha256: str = ""


def timeline(path: Path, images: Iterable[Path], *, whole: bool) -> Timeline:
    """Return images in order, with the times that a table beside their folder tells.

    Args:
        path: the folder.
        images: the images in it.
        whole: they are all that the folder has, so that tables concern them.

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


def natural_key(name: str) -> list[tuple[int, str]]:
    """Return a sort key that counts digits as numbers: frame2 comes before frame10."""
    parts = re.split(r"([0-9]+)", name)
    return [(int(part), "") if i % 2 else (0, part) for i, part in enumerate(parts)]


def file_numbers(stems: list[str]) -> list[int] | None:
    """Return the number in each of a folder's file names without suffix, given in order.

    None unless the names differ only in that number and count in steps of one size, gaps
    allowed: time stamps, several numbers and words tell nothing.
    """
    split = [re.split(r"([0-9]+)", stem) for stem in stems]
    if len({len(parts) for parts in split}) > 1:
        return None
    columns = [
        [parts[i] if i % 2 == 0 else int(parts[i]) for parts in split] for i in range(len(split[0]))
    ]
    varying = [(i, column) for i, column in enumerate(columns) if len(set(column)) > 1]
    if len(varying) != 1 or varying[0][0] % 2 == 0:
        return None
    numbers = [int(number) for number in varying[0][1]]
    if max(numbers) > _MAX_STAMP:
        return None
    steps = list(map(operator.sub, numbers[1:], numbers[:-1]))
    least = min(steps)
    return numbers if least > 0 and not any(step % least for step in steps) else None


def stamps_in(stems: list[str]) -> list[int]:
    """Return the time stamps in ns that names without suffix are, as cameras' drivers name images.

    Those are seconds since 1970 with a decimal point, or whole ms, us or ns since then, in what
    is but for that the same in all names. None where one is not, or they do not rise.
    """
    found = [_NAME_STAMP.fullmatch(stem) for stem in stems]
    if not all(found) or len({(each[1], each[5]) for each in found if each}) != 1:
        return []
    stamps = [_stamp_of(each) for each in found if each]
    rising = all(before < after for before, after in itertools.pairwise(stamps))
    return stamps if rising and len(stamps) > 1 else []


def _stamp_of(found: re.Match[str]) -> int:
    if found[3]:
        return int(found[2]) * _NS + int(f"{found[3]:0<9.9}")
    return int(found[4].ljust(19, "0"))


def gaps(numbers: list[int]) -> list[str]:
    """Return a line that names the gaps in a numbering, if there are any."""
    steps = list(map(operator.sub, numbers[1:], numbers[:-1]))
    pairs = zip(itertools.pairwise(numbers), steps, strict=True)
    gaps = [f"{before} and {after}" for (before, after), step in pairs if step > min(steps)]
    if not gaps:
        return []
    more = f" and in {len(gaps) - 1} other places" if len(gaps) > 1 else ""
    return [f"numbers are missing between {gaps[0]}{more}: check that no images are lost"]


def _euroc(table: Path, folder: Path) -> Timeline:
    """Return the images that a EuRoC camera's table lists, in the order of time."""
    content = read_bytes(table, "the time stamps", MAX_TABLE_BYTES)
    rows = []
    for number, line in enumerate(as_text(content).splitlines(), 1):
        stamp, comma, name = (part.strip() for part in line.partition(","))
        if not line.strip() or stamp.startswith("#"):
            continue
        named = comma and Path(name).name == name
        if not (named and re.fullmatch("[0-9]{1,19}", stamp) and int(stamp) <= _MAX_STAMP):
            raise InputError(f"{table}, line {number}: give 'time stamp in ns,file name'")
        rows.append((int(stamp), folder / name))
    rows.sort()
    for (before, _), (after, _) in itertools.pairwise(rows):
        if before == after:
            raise InputError(f"{table} has the time stamp {after} twice: keep one line for it")
    stamps = [stamp for stamp, _ in rows]
    return Timeline([file for _, file in rows], stamps, table, _sha256(content))


def _by_number(table: Path, files: list[Path], parse: Callable[[str], int], form: str) -> Timeline:
    """Return images whose numbers are those of a table's lines, from 0."""
    content = read_bytes(table, "the times", MAX_TABLE_BYTES)
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
    return Timeline(files, stamps_ns, table, _sha256(content))


def _seconds(line: str) -> int:
    return _stamp(round(float(line) * _NS))


def _date(line: str) -> int:
    """Return ``2011-09-26 13:02:25.964389445`` in ns since 1970."""
    whole, _, fraction = line.strip().partition(".")
    moment = datetime.fromisoformat(whole).replace(tzinfo=UTC)
    return _stamp(int(moment.timestamp()) * _NS + int(f"{fraction:0<9.9}"))


def _stamp(stamp_ns: int) -> int:
    if not 0 <= stamp_ns <= _MAX_STAMP:
        raise ValueError
    return stamp_ns


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
