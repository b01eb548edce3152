"""The output folder: where a run may write, and what it may remove there."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from motionstereo_cli.errors import OutputError
from motionstereo_cli.files.atomic import is_segment, part_of, reported, write_whole
from motionstereo_cli.sinks import OUTPUTS, RECORD

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

#: What a run needs to go on after its process is gone; removed when it is complete.
CHECKPOINT = "run.checkpoint"
_PROGRAM = "motionstereo"
_NUMBERED = re.compile(r"(\d{6,})(\.[a-z]+)(\.part)?")


def prepare(
    out: Path, save: Sequence[str], *, overwrite: bool = False, inputs: Iterable[Path] = ()
) -> None:
    """Make the output folder ready for a run.

    With ``overwrite``, exactly the files that a former run wrote are removed, as its record
    has them. A file of anybody else is neither removed nor written over.

    Args:
        out: the folder; made where it is missing.
        save: names of the outputs, from :data:`~motionstereo_cli.sinks.OUTPUTS`.
        overwrite: accept a folder that is not empty.
        inputs: files and folders that the run reads.

    Raises:
        OutputError: the folder is not empty, cannot be written, or holds an input or somebody
            else's file where the run would write.
    """
    with reported(out):
        out.mkdir(parents=True, exist_ok=True)
        if not overwrite and any(out.iterdir()):
            advice = ", or --resume to go on" if part_of(out / RECORD).exists() else ""
            raise OutputError(f"{out} is not empty: give another folder, or --overwrite{advice}")
        former = _written(out)
        paths = [path for name in save for path in OUTPUTS[name].paths]
        present = _present(out, RECORD).union(*(_present(out, path) for path in paths))
        for path in sorted(present - former):
            raise OutputError(f"{path} is not from a former run: move it or give another folder")
        taken = {path.resolve() for path in inputs}
        for path in former.union(out / path for path in paths):
            for place in (path, path.parent):
                if place.resolve() in taken:
                    raise OutputError(f"{place} is an input of this run: give another folder")
        for path in former:
            path.unlink()
        _remove_empty_folders(out)
    write_whole(part_of(out / RECORD), _json(head(save)))


def complete(out: Path, record: Mapping[str, Any]) -> None:
    """Write the record of a run that is done.

    Args:
        out: the folder.
        record: what to say: the :func:`head`, and at least ``counts.written``, the frames.

    Raises:
        OutputError: the record cannot be written.
    """
    # The .part stays what it is until all is on the disk: it says that this folder is ours.
    part = part_of(out / RECORD)
    write_whole(part, _json(record), durable=True)
    with reported(out / RECORD):
        os.replace(part, out / RECORD)
    clear(out)


def clear(out: Path) -> None:
    """Remove what a complete run needs no more: its checkpoint, and the segments of its videos."""
    with reported(out):
        for path in _temporary(out):
            path.unlink(missing_ok=True)


def record_of(out: Path) -> dict[str, Any] | None:
    """Return what a complete run says of itself, None where there is none."""
    return _read_record(out / RECORD)


@contextlib.contextmanager
def locked(out: Path) -> Iterator[None]:
    """Make a folder, and keep other runs out of it until the block is done.

    The lock goes with its process, whatever becomes of that. On systems and disks without such
    locks there is none.

    Raises:
        OutputError: another run is writing there, or the folder cannot be made.
    """
    with reported(out):
        out.mkdir(parents=True, exist_ok=True)
        folder = os.open(out, os.O_RDONLY) if fcntl else -1
    try:
        if fcntl:
            try:
                fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise OutputError(
                    f"{out} is being written by another run: wait for it, or give another folder"
                ) from None
            except OSError:
                pass  # a network disk without locks
        yield
    finally:
        if fcntl:
            os.close(folder)


def tidy(out: Path) -> None:
    """Remove what a run that failed left, if it left nothing of use."""
    with contextlib.suppress(OSError):
        if _written(out) == {part_of(out / RECORD)}:
            part_of(out / RECORD).unlink()
            _remove_empty_folders(out)


def head(save: Sequence[str]) -> dict[str, Any]:
    """Return the beginning of a record: who wrote the folder, and what is in it."""
    outputs = {
        name: {"path": OUTPUTS[name].path.format(0), "what": OUTPUTS[name].what} for name in save
    }
    return {"program": _PROGRAM, "outputs": outputs}


def _json(record: Mapping[str, Any]) -> bytes:
    return json.dumps(record, indent=2, allow_nan=False).encode() + b"\n"


def _written(out: Path) -> set[Path]:
    """Return the files present that former runs wrote, complete or not."""
    written: set[Path] = set()
    for path in (out / RECORD, part_of(out / RECORD)):
        record = _read_record(path)
        if record is None:
            continue
        try:
            names = OUTPUTS.keys() & record["outputs"].keys()
            frames = int(record["counts"]["written"]) if "counts" in record else None
        except (ValueError, LookupError, TypeError, AttributeError):
            continue  # not a record of ours
        written.add(path)
        written |= _temporary(out)
        for target in (path for name in names for path in OUTPUTS[name].paths):
            present = _present(out, target)
            written |= _up_to(frames, present) if "{" in target else present
    return written


def _read_record(path: Path) -> dict[str, Any] | None:
    try:
        record = json.loads(path.read_bytes())
        return record if record["program"] == _PROGRAM else None
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return None  # not a record of ours


def _temporary(out: Path) -> set[Path]:
    """Return the files present that a run needs only until it is complete."""
    checkpoint, videos = out / CHECKPOINT, [Path(save.path) for save in OUTPUTS.values()]
    names = {checkpoint.name, part_of(checkpoint).name, part_of(part_of(out / RECORD)).name}
    return {
        path
        for path in out.iterdir()
        if path.name in names or any(is_segment(path.name, video) for video in videos)
    }


def _present(out: Path, path: str) -> set[Path]:
    """Return what stands where an output would go, complete or not."""
    target = out / path
    if "{" not in path:
        return {place for place in (target, part_of(target)) if os.path.lexists(place)}
    folder = target.parent
    if folder.is_dir():
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


def _remove_empty_folders(out: Path) -> None:
    for save in OUTPUTS.values():
        folder = (out / save.path).parent
        if folder != out:
            with contextlib.suppress(OSError):  # missing, or not empty
                folder.rmdir()
