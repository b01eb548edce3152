"""What a run leaves, so that another process can go on after its own is gone."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from motionstereo_cli.errors import OutputError
from motionstereo_cli.files.atomic import write_whole
from motionstereo_cli.files.reading import open_regular
from motionstereo_cli.files.records import builtins_of, pack, restored, unpack
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.pipeline import State
from motionstereo_cli.robot.guide import ImageHeading, MapCourse
from motionstereo_cli.runs.open_outputs import Totals
from motionstereo_cli.sinks.records import FolderRecord
from motionstereo_cli.sinks.sink import Sink

_HEAD = b"motionstereo checkpoint 6"

#: What a guide knows is of one of these.
_GUIDED = {kind.__name__: kind for kind in (ImageHeading, MapCourse)}


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """Where a run stood after some frame.

    Attributes:
        run: hash of what makes it this run and no other.
        state: all that is kept from frame to frame.
        guided: which class the guide's part of the state is of.
        totals: sums over the frames so far.
        sinks: the checkpoint of each output.
    """

    run: str
    state: State
    guided: str
    totals: Totals
    sinks: dict[str, Any]


def write_checkpoint(
    path: Path,
    identity: FolderRecord,
    state: State,
    totals: Totals,
    sinks: Mapping[str, Sink[Any]],
) -> None:
    """Write a checkpoint in the place of the one before, once all outputs have made theirs.

    Args:
        path: where to.
        identity: what makes it this run and no other, as the record has it.
        state, totals: see :class:`Checkpoint`.
        sinks: the outputs.

    Raises:
        OutputError: it, or what the outputs have so far, cannot be written.
    """
    marks = {name: sink.checkpoint() for name, sink in sinks.items()}
    made = {name: mark.result() for name, mark in marks.items() if isinstance(mark, Future)}
    guided = type(state.tracking.guided).__name__
    content = pack(Checkpoint(_digest(identity), state, guided, totals, made))
    head = f" {totals.frames} {hashlib.sha256(content).hexdigest()}\n".encode()
    write_whole(path, _HEAD + head + content, durable=True)


def frames_of(path: Path) -> int:
    """Return after how many frames a checkpoint was made, 0 where there is none."""
    try:
        with open_regular(path) as file:
            return int(file.read(200).removeprefix(_HEAD).split()[0])
    except (OSError, ValueError, LookupError):
        return 0


def read_checkpoint(
    path: Path, identity: FolderRecord, check: Callable[[State], object] = bool
) -> Checkpoint | None:
    """Return a checkpoint, None where there is none.

    Args:
        path: where it is.
        identity: that of the run which is to go on.
        check: raises a ValueError for a state that cannot be of this run.

    Raises:
        OutputError: the file is no checkpoint of this version and this run, or was changed.
    """
    try:
        with open_regular(path) as file:
            head, content = file.readline(200), file.read()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise OutputError(f"cannot read {path}: {error.strerror}") from error
    try:
        frames, checksum = head.removeprefix(_HEAD).decode().split()
        if not head.startswith(_HEAD) or hashlib.sha256(content).hexdigest() != checksum:
            raise ValueError("its checksum is wrong")
        found = unpack(content, Checkpoint)
        if found.run != _digest(identity):
            raise ValueError("it is of another run")
        if not 0 < found.totals.frames == int(frames):
            raise ValueError(f"it says {found.totals.frames} frames")
        state = with_guided(found.state, found.guided)
        check(state)
    except ValueError as error:
        raise OutputError(
            f"{path} is no checkpoint that can be used ({error}): give --overwrite to start again"
        ) from error
    return dataclasses.replace(found, state=state)


def with_guided(state: State, kind: str) -> State:
    """Return a state with what the guide knows as one of its classes.

    Raises:
        ValueError: it is not.
    """
    tracking = state.tracking
    if tracking.guided is not None:
        if kind not in _GUIDED:
            raise ValueError(f"there is no guide with {kind[:60]!r}")
        guided = restored(tracking.guided, _GUIDED[kind])
        state = dataclasses.replace(state, tracking=dataclasses.replace(tracking, guided=guided))
    return state


def _digest(identity: FolderRecord) -> str:
    return hashlib.sha256(json.dumps(_followed(identity), sort_keys=True).encode()).hexdigest()


def _followed(identity: FolderRecord) -> dict[str, Any]:
    """Return what results follow from; what was warned of is no part of it."""
    return {key: each for key, each in builtins_of(identity).items() if key != "warnings"}


def check_state(state: State, settings: Settings, width: int, height: int) -> None:
    """Make sure that a state is one of a run with these settings and views of this size.

    Raises:
        ValueError: it is not.
    """
    for memory in (state.right, state.left):
        if memory is None:
            raise ValueError("a memory is missing")
        limits = {
            "grey": (0, 255),
            "contrast": (0, 255),
            "bands": (1, settings.bands),
            "moved": (0, 1),
            "charge": (settings.charge_min, settings.charge_max),
        }
        for name, (low, high) in limits.items():
            values = getattr(memory, name)
            if values.shape != (height, width):
                raise ValueError(f"its {name} is {values.shape} large, not {(height, width)}")
            if values.min() < low or values.max() > high:
                raise ValueError(f"its {name} is not in {low}..{high}")
    for sighting in state.recent:
        for values in (sighting.disparity_px, sighting.grey):
            if values.shape != (height, width):
                raise ValueError(f"an earlier frame is {values.shape} large")


def check_same(out: Path, identity: FolderRecord, found: FolderRecord) -> None:
    """Make sure that a run is the one that ``out`` was begun by.

    Raises:
        OutputError: it is not.
    """
    wanted, there = _followed(identity), builtins_of(found)
    if difference := _difference(wanted, {key: there.get(key) for key in wanted}):
        raise OutputError(
            f"{out} is of another run, {difference}: "
            "give the same input and options, or --overwrite to start again"
        )


#: What options give, where the record has another word for it.
_IN_WORDS = {"table": "a table by --csv", "files": "the files of --rig and --poses"}


def _difference(wanted: Any, there: Any, name: str = "") -> str:
    """Return the first difference of two JSON values; where files lie makes none."""
    if wanted is None or there is None:
        what = _IN_WORDS.get(name.partition(".")[0], name)
        return "" if wanted is there else f"with{'out' if there is None else ''} {what}"
    if isinstance(wanted, list) and isinstance(there, list):
        wanted, there = (dict(enumerate(each)) for each in (wanted, there))
    if isinstance(wanted, dict) and isinstance(there, dict):
        for key in sorted(wanted.keys() | there.keys()):
            where = f"{name}.{key}" if name else str(key)
            found = _difference(wanted.get(key), there.get(key), where)
            if found and key != "path":
                return found
        return ""
    return "" if wanted == there else f"with {name} {there!s:.16}, not {wanted!s:.16}"
