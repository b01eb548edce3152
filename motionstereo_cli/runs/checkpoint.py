"""What a run leaves, so that another process can go on after its own is gone."""

from __future__ import annotations

import hashlib
import importlib
import io
import json
import pickle
import re
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, fields
from pathlib import Path
from types import NoneType
from typing import Any, BinaryIO

import numpy as np

from motionstereo_cli.errors import OutputError
from motionstereo_cli.files.atomic import write_whole
from motionstereo_cli.files.reading import open_regular
from motionstereo_cli.method.memory import Memory, Sighting
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.pipeline import State, TrackingState
from motionstereo_cli.robot.alignment import Keyframe
from motionstereo_cli.robot.course import Course
from motionstereo_cli.robot.fused_map import Grid, Voxels
from motionstereo_cli.robot.guide import ImageHeading, MapCourse
from motionstereo_cli.robot.local_map import LocalMap
from motionstereo_cli.robot.mapper import Surroundings
from motionstereo_cli.robot.objects import Observation, Region, Track
from motionstereo_cli.robot.odometry import Odometry, TravelledPath
from motionstereo_cli.robot.tracker import Tracks
from motionstereo_cli.runs.open_outputs import Totals
from motionstereo_cli.sinks.sink import Sink
from motionstereo_cli.types import Pose

#: What may stand in a checkpoint besides plain values and NumPy's arrays: the classes of what is
#: kept from frame to frame. They are stored by these names, wherever they are defined.
STATE_TYPES: tuple[type, ...] = (
    *(
        State,
        TrackingState,
        Memory,
        ImageHeading,
        MapCourse,
        Course,
        LocalMap,
        Tracks,
        Track,
        Observation,
        Region,
        Odometry,
        Keyframe,
        TravelledPath,
        Sighting,
    ),
    *(Surroundings, Grid, Voxels, Pose, Totals),
)
_NAMED = {each.__qualname__: each for each in STATE_TYPES}
_OF_NUMPY = {"ndarray", "dtype", "scalar", "_reconstruct", "_frombuffer"}
_HEAD = b"motionstereo checkpoint 5"

#: Arrays by what annotations call them; all others may be of any kind of number.
_ARRAYS = {"Grey": "uint8", "Real": "float32"}
_PLAIN: dict[str, Any] = {
    "int": (int, np.integer),
    "float": (int, float, np.integer, np.floating),
    "bool": (bool, np.bool_),
    "str": str,
    "None": NoneType,
    "tuple": tuple,
    "Any": object,
}


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """Where a run stood after some frame.

    Attributes:
        state: all that is kept from frame to frame.
        totals: sums over the frames so far.
        sinks: the checkpoint of each output.
    """

    state: State
    totals: Totals
    sinks: Mapping[str, Any]


def write_checkpoint(
    path: Path,
    identity: Mapping[str, Any],
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
    content = pickle.dumps((_digest(identity), pickle.dumps((state, totals)), made))
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
    path: Path, identity: Mapping[str, Any], check: Callable[[State], object] = bool
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
        run, moment, sinks = loads(content)
        if run != _digest(identity):
            raise ValueError("it is of another run")
        state, totals = loads(moment)
        marks = {name: loads(mark) for name, mark in sinks.items()}
        for value in (state, totals, *marks.values()):
            check_kinds(value)
        if not (isinstance(state, State) and isinstance(totals, Totals)):
            raise ValueError("it holds no state of a run")
        if not 0 < totals.frames == int(frames):
            raise ValueError(f"it says {totals.frames} frames")
        check(state)
    except Exception as error:  # damaged pickles raise anything
        raise OutputError(
            f"{path} is no checkpoint that can be used ({error}): give --overwrite to start again"
        ) from error
    return Checkpoint(state, totals, marks)


def _digest(identity: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()


def check_kinds(value: Any) -> None:
    """Make sure that what came out of a checkpoint holds what its classes say.

    Raises:
        ValueError: something is of another kind.
    """
    if isinstance(value, STATE_TYPES):
        for each in fields(value):  # type: ignore[arg-type]
            inner = getattr(value, each.name)
            if not _fits(inner, str(each.type)):
                kind = type(inner).__name__
                raise ValueError(f"{type(value).__name__}.{each.name} is of the kind {kind}")
            check_kinds(inner)
    elif isinstance(value, tuple):
        for inner in value:
            check_kinds(inner)
    elif isinstance(value, np.ndarray):
        if value.dtype.kind not in "biuf":
            raise ValueError(f"an array holds {value.dtype}")
    elif not isinstance(value, bool | int | float | str | NoneType | np.generic):
        raise ValueError(f"it holds something of the kind {type(value).__name__}")


def _fits(value: Any, annotation: str) -> bool:
    while "[" in annotation:
        annotation = re.sub(r"\[[^\[\]]*\]", "", annotation)
    for name in annotation.split("|"):
        kind = _PLAIN.get(name.strip()) or _NAMED.get(name.strip())
        if kind is None:
            dtype = _ARRAYS.get(name.strip())
            fits = isinstance(value, np.ndarray) and (dtype is None or value.dtype == dtype)
        else:
            fits = isinstance(value, kind)
        if fits:
            return True
    return False


def check_state(state: State, settings: Settings, width: int, height: int) -> None:
    """Make sure that a state is one of a run with these settings and views of this size.

    Raises:
        ValueError: it is not.
    """
    for memory in (state.right, state.left):
        if memory is None:
            raise ValueError("a camera remembers nothing")
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


def check_same(out: Path, identity: Mapping[str, Any], found: Mapping[str, Any]) -> None:
    """Make sure that a run is the one that ``out`` was begun by.

    Raises:
        OutputError: it is not.
    """
    # As JSON has them: tuples are lists there.
    wanted, there = json.loads(json.dumps([identity, {key: found.get(key) for key in identity}]))
    if difference := _difference(wanted, there):
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


def loads(content: bytes) -> Any:
    """Return what was pickled, if it is of the kind that checkpoints hold.

    Raises:
        Exception: of any kind, for what is damaged or of another kind.
    """
    return Reader(io.BytesIO(content)).load()


class Reader(pickle.Unpickler):
    """Reads what was pickled, if it is of the kind that checkpoints hold.

    Args:
        file: where it is.
        more: further classes that may stand in it.
    """

    def __init__(self, file: BinaryIO, more: Sequence[type] = ()) -> None:
        super().__init__(file)
        self._named = _NAMED | {each.__qualname__: each for each in more}

    def find_class(self, module: str, name: str) -> Any:
        """Return a class or function that may be used."""
        package = module.partition(".")[0]
        if package == "motionstereo_cli" and name in self._named:
            return self._named[name]
        if package == "numpy" and name in _OF_NUMPY:
            return getattr(importlib.import_module(module), name)
        raise pickle.UnpicklingError(f"it holds {module}.{name}")
