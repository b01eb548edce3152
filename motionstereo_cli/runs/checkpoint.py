"""Checkpoints: what another process needs to resume a run."""

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
from motionstereo_cli.files.reading import content_up_to, open_regular
from motionstereo_cli.files.records import builtins_of, pack, restored, unpack
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.pipeline import State
from motionstereo_cli.robot.guide import ImageHeading, MapCourse
from motionstereo_cli.runs.open_outputs import Totals
from motionstereo_cli.sinks.records import FolderRecord, option_of

_HEAD = b"motionstereo checkpoint 7"

#: Larger than the state of a run with images of 64 million px.
_MAX_BYTES = 1_000_000_000

#: The classes of a guide's state.
_GUIDED = {kind.__name__: kind for kind in (ImageHeading, MapCourse)}


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """The state of a run after some frame.

    Attributes:
        run: hash of the run's identity.
        state: all that is kept from frame to frame.
        guided: the class of the guide's state.
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
    marks: Mapping[str, Any],
) -> None:
    """Replace the checkpoint, once all outputs have made theirs.

    Args:
        path: its file.
        identity: the run's identity, as in the record.
        state, totals: see :class:`Checkpoint`.
        marks: the checkpoint of each output, or its future, or that of a function that returns it.

    Raises:
        OutputError: the checkpoint or an output cannot be written.
    """
    made = {name: mark.result() for name, mark in marks.items() if isinstance(mark, Future)}
    made = {name: mark() if callable(mark) else mark for name, mark in made.items()}
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
        identity: that of the run to resume.
        check: raises a ValueError for a state that does not fit this run.

    Raises:
        OutputError: the file is not a checkpoint of this version and run, or was changed.
    """
    try:
        with open_regular(path) as file:
            whole = content_up_to(file, _MAX_BYTES)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise OutputError(f"cannot read {path}: {error.strerror}") from error
    if whole is None:
        raise OutputError(f"{path} is larger than {_MAX_BYTES} bytes: give --overwrite")
    head, _, content = whole.partition(b"\n")
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
    """Return a state with the guide's part restored as its class.

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
    """Return what results depend on; warnings and how a value was found are no part of it."""
    said = builtins_of(identity)
    return {key: each for key, each in said.items() if key not in ("warnings", "measured")}


def check_state(state: State, settings: Settings, width: int, height: int) -> None:
    """Check that a state fits these settings and views of this size.

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
        for values in (sighting.parts, sighting.grey):
            if values.shape != (height, width):
                raise ValueError(f"an earlier frame is {values.shape} large")


def check_same(out: Path, identity: FolderRecord, found: FolderRecord) -> None:
    """Check that a run is the one that ``out`` belongs to.

    Raises:
        OutputError: it is not.
    """
    wanted, there = _followed(identity), builtins_of(found)
    if difference := _difference(wanted, {key: there.get(key) for key in wanted}):
        raise OutputError(
            f"{out} is of another run, {difference}: "
            "give the same input and options; to start again, remove the folder or give --overwrite"
        )


#: Names of options, where the record has another name.
_IN_WORDS = {"table": "a table by --csv", "files": "the files of --rig and --poses"}


def _difference(wanted: Any, there: Any, name: str = "") -> str:
    """Return the first difference of two JSON values; the folders of files do not count."""
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
    if wanted == there:
        return ""
    before, now = (f"{value!s:.16}" or "not given" for value in (there, wanted))
    return f"with {option_of(name)} {before}, not {now}"
