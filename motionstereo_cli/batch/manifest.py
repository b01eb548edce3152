"""The recordings of a batch: a manifest, or patterns that match them."""

from __future__ import annotations

import csv
import dataclasses
import functools
import glob
import io
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from motionstereo_cli.batch.own_folder import OWN, TABLE
from motionstereo_cli.errors import InputError, MotionStereoError
from motionstereo_cli.files.reading import MAX_RECORD_BYTES, as_text, read_text
from motionstereo_cli.files.store import FIRST_PATIENCE_S, Store, address_of
from motionstereo_cli.params import near_match
from motionstereo_cli.report import PAGE
from motionstereo_cli.rig.settings import NO_RIG
from motionstereo_cli.runs.plan import RunPlan

#: Columns that are not options of ``run``.
_OWN = ("left", "right", "out")
_NEEDED = ("left", "out")
#: Names in the folder of a batch that cannot be a recording's.
_RESERVED = (OWN, TABLE, PAGE)
#: Separator of two calibration files in a cell.
_BETWEEN = ";"
#: Values of a cell for an option that is a flag.
_FLAGS = {"yes": True, "true": True, "on": True, "1": True} | {
    "no": False,
    "false": False,
    "off": False,
    "0": False,
}


@dataclass(frozen=True, slots=True)
class ManifestRow:
    """A recording of a batch.

    Attributes:
        name: its folder under that of the batch.
        options: those of ``run``, without the folder.
        inputs: LEFT, and RIGHT if there is one.
        place: where it is in the manifest, for messages.
        wrong: its mistakes; a row without a name has nothing else.
    """

    name: str
    options: tuple[str, ...]
    inputs: tuple[str, ...]
    place: str
    wrong: tuple[str, ...] = ()


def _text_of(path: str | Path) -> str:
    address = address_of(path)
    if address is None:
        return read_text(path, "the manifest", MAX_RECORD_BYTES)
    content = Store(address, FIRST_PATIENCE_S).read("", MAX_RECORD_BYTES)
    if content is None:
        raise InputError(f"there is no manifest {address}")
    return as_text(content)


def _beside(manifest: str | Path, name: str) -> str:
    """Return a path or an address that is relative to that of a manifest."""
    above = address_of(manifest)
    if address := address_of(name):
        return address
    if above is None or Path(name).is_absolute():
        return str(Path(manifest).parent / name)
    return f"{above.rpartition('/')[0]}/{name}"


def read_manifest(
    path: str | Path, options: Mapping[str, bool], files: Collection[str]
) -> list[ManifestRow]:
    """Read a manifest: CSV with a header, one row per recording, paths relative to the manifest.

    Args:
        path: the file.
        options: the options of ``run`` by name, without dashes, and whether they are flags.
        files: those of them that are paths.

    Returns:
        The recordings, and rows without a name for those that cannot be understood.

    Raises:
        InputError: the table cannot be read.
    """
    text = _text_of(path)
    lines = csv.reader(io.StringIO(text, newline=""))
    try:
        rows = list(lines)
    except csv.Error as error:
        raise InputError(f"{path} line {lines.line_num}: {error}: check the table") from None
    header = [name.strip().replace("_", "-") for name in rows[0]] if rows else []
    entries = [ManifestRow("", (), (), f"{path} line 1", tuple(_wrong_columns(header, options)))]
    for number, cells in enumerate(rows[1:], 2):
        if not any(cell.strip() for cell in cells):
            continue
        place = f"{path} line {number}"
        if any("\0" in cell for cell in cells):
            entries.append(ManifestRow("", (), (), place, ("a cell has a NUL",)))
            continue
        if len(cells) != len(header):
            wrong = f"{len(cells)} cells and not {len(header)}"
            entries.append(ManifestRow("", (), (), place, (wrong,)))
            continue
        row = {name: cell.strip() for name, cell in zip(header, cells, strict=True)}
        entries.append(_entry(row, place, path, options, files))
    if len(entries) == 1 and not entries[0].wrong:
        raise InputError(f"{path} names no recording: give a row for each")
    return entries if entries[0].wrong else entries[1:]


def _wrong_columns(header: Sequence[str], options: Collection[str]) -> Iterator[str]:
    if len(header) == 1 and ({";", "\t"} & set(header[0])):
        yield "columns are separated by commas only"
        return
    known = [*_OWN, *options]
    for name in _NEEDED:
        if name not in header:
            yield f"there is no column {name}"
    for name in dict.fromkeys(header):
        if name not in known:
            yield f"run has no option {name!r}{near_match(name, known)}"
        if header.count(name) > 1:
            yield f"column {name!r} comes twice"


def _entry(
    row: Mapping[str, str],
    place: str,
    manifest: str | Path,
    options: Mapping[str, bool],
    files: Collection[str],
) -> ManifestRow:
    arguments: list[str] = []
    empty = [name for name in _NEEDED if row.get(name) == ""]
    wrong = [f"{' and '.join(empty)} cannot be empty"] if empty else []
    for name, cell in row.items():
        if name not in options or not cell:
            continue
        if options[name]:
            if cell.lower() not in _FLAGS:
                wrong.append(f"{name} cannot be {cell!r}: give yes or no")
                continue
            arguments.append(f"--{name}" if _FLAGS[cell.lower()] else f"--no-{name}")
            continue
        values = cell.split(_BETWEEN) if name == "rig" else [cell]
        for value in values:
            shown = value.strip()
            is_file = name in files and Path(shown) != NO_RIG
            arguments += [f"--{name}", _beside(manifest, shown) if is_file else shown]
    inputs = [_beside(manifest, row[name]) for name in ("left", "right") if row.get(name)]
    # Where a column is missing, that is said of the header.
    whole = all(row.get(name) for name in _NEEDED)
    name = str(PurePosixPath(row["out"])) if whole else ""
    return ManifestRow(name, tuple(arguments), tuple(inputs), place, tuple(wrong))


def matched(left: str, right: str | None) -> list[ManifestRow]:
    """Return the recordings that patterns match, paired by what the wildcards stand for.

    ``archive/*/left.mp4`` and ``archive/*/right.mp4`` give one recording for each folder that has
    both, named after the folder.

    Raises:
        InputError: nothing matches, or one side has no partner; its notes say which.
    """
    sides = [_found(pattern) for pattern in (left, right) if pattern is not None]
    wrong = [
        f"{path} has no partner: nothing matches {pattern} there"
        for mine, other, pattern in ((sides[0], sides[-1], right), (sides[-1], sides[0], left))
        for name, path in mine.items()
        if name not in other
    ]
    if not sides[0]:
        raise InputError(f"nothing matches {left}")
    if wrong and not (glob.has_magic(left) or glob.has_magic(str(right))):
        wrong = [f"{left} and {right} are no patterns: for one recording of two files, use run"]
    _refuse(left, list(dict.fromkeys(wrong)))
    return [
        ManifestRow(name, (), tuple(side[name] for side in sides), sides[0][name])
        for name in sides[0]
    ]


def _found(pattern: str) -> dict[str, str]:
    """Return the paths that match by what the wildcards stand for."""
    start = len(os.path.commonpath([pattern.partition("*")[0] + "x", pattern]))
    found = {}
    for path in sorted(glob.glob(pattern, recursive=True)):
        parts, wild = Path(path).parts, Path(pattern).parts
        different = [part for part, each in zip(parts, wild, strict=False) if glob.has_magic(each)]
        name = "/".join(different) if len(parts) == len(wild) else path[start:].strip("/")
        # The suffix does not tell recordings apart.
        found[name if glob.has_magic(Path(pattern).parent.as_posix()) else _stem(name or path)] = (
            path
        )
    return found


def _stem(path: str) -> str:
    # That of "." is the name of the folder.
    return Path(os.path.abspath(path)).stem


def plans(
    entries: Iterable[ManifestRow], out: Path, plan_of: Callable[[Sequence[str]], RunPlan]
) -> dict[str, RunPlan]:
    """Return the plan of each recording, by name.

    Args:
        entries: the recordings.
        out: folder of the batch.
        plan_of: makes a plan from arguments of ``run``.

    Raises:
        InputError: rows have mistakes, names are used twice or are nested, an option cannot be
            used, or a path does not exist; its notes list all that is wrong.
    """
    found: dict[str, RunPlan] = {}
    names = _Names()
    wrong: list[tuple[str, str]] = []
    # Most rows have the same options, and parsing them is slow.
    with_options = functools.cache(lambda options: plan_of(("--resume", *options, "--", "left")))
    for entry in entries:
        wrong += [(entry.place, text) for text in entry.wrong]
        if not entry.name:
            continue
        if problem := names.add(entry.name, entry.place):
            wrong.append((entry.place, problem))
            continue
        left, *rest = entry.inputs
        try:
            plan = dataclasses.replace(
                with_options(entry.options),
                left=left,
                right=rest[0] if rest else None,
                out=out / entry.name,
            )
        except MotionStereoError as error:
            wrong.append((entry.place, str(error)))
            continue
        missing = [path for path in plan.inputs if not _there(path)]
        wrong += [(entry.place, f"there is no {path}") for path in missing]
        found[entry.name] = plan
    _refuse("the batch", _once(wrong))
    if not found:
        raise InputError(
            "the batch has no recordings: give a manifest, or patterns that match them"
        )
    return found


def _once(wrong: Iterable[tuple[str, str]]) -> list[str]:
    """Return mistakes as lines, each once, from their places and texts."""
    places: dict[str, list[str]] = {}
    for place, text in wrong:
        places.setdefault(text, []).append(place)
    return [
        f"{first}{f' and {len(more)} more' if more else ''}: {text}"
        for text, (first, *more) in places.items()
    ]


def _there(path: str) -> bool:
    # What a store has is seen when it is fetched.
    return bool(address_of(path)) or os.path.exists(path) or bool(glob.glob(path))


class _Names:
    """Folders of recordings: each is used once, and none is inside another."""

    def __init__(self) -> None:
        self._places: dict[PurePosixPath, str] = {}
        self._above: dict[PurePosixPath, str] = {}

    def add(self, name: str, place: str) -> str:
        """Add a name, and return what is wrong with it, empty if nothing."""
        path = PurePosixPath(name)
        if not path.parts or path.is_absolute() or ".." in path.parts:
            return f"out {name!r} is outside the folder of the batch"
        if path.parts[0] in _RESERVED:
            return f"out {name!r} is reserved for the batch"
        if path in self._places:
            return f"out {name} is that of {self._places[path]}"
        nested = (self._places[each] for each in path.parents if each in self._places)
        if other := self._above.get(path) or next(nested, ""):
            return f"out {name} and that of {other} are nested"
        self._places[path] = place
        self._above |= dict.fromkeys(path.parents, place)
        return ""


def _refuse(what: object, wrong: Sequence[str]) -> None:
    if not wrong:
        return
    count = "one mistake" if len(wrong) == 1 else f"{len(wrong)} mistakes"
    error = InputError(f"{what} has {count}, nothing was started: {wrong[0]}")
    for line in wrong[1:]:
        error.add_note(line)
    raise error
