"""What a run leaves, so that another process can go on after its own is gone."""

from __future__ import annotations

import hashlib
import importlib
import io
import json
import pickle
from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from motionstereo_cli.batch.totals import Totals
from motionstereo_cli.errors import OutputError
from motionstereo_cli.files.atomic import write_whole
from motionstereo_cli.memory import Memory
from motionstereo_cli.pipeline import State
from motionstereo_cli.robot.fused_map import Grid, Voxels
from motionstereo_cli.robot.guide import ImageHeading, MapCourse
from motionstereo_cli.robot.heading import Course
from motionstereo_cli.robot.local_map import LocalMap
from motionstereo_cli.robot.mapper import Surroundings
from motionstereo_cli.robot.objects import Observation, Region, Track
from motionstereo_cli.robot.tracker import Tracks
from motionstereo_cli.sinks import Sink
from motionstereo_cli.types import Pose

#: What may stand in a checkpoint besides plain values and NumPy's arrays: the classes of what is
#: kept from frame to frame. They are stored by these names, wherever they are defined.
STATE_TYPES: tuple[type, ...] = (
    *(State, Memory, ImageHeading, MapCourse, Course, LocalMap, Tracks, Track, Observation, Region),
    *(Surroundings, Grid, Voxels, Pose, Totals),
)
_NAMED = {each.__qualname__: each for each in STATE_TYPES}
_OF_NUMPY = {"ndarray", "dtype", "scalar", "_reconstruct", "_frombuffer"}
_HEAD = b"motionstereo checkpoint 2\n"


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
    path: Path, identity: Mapping[str, Any], state: State, totals: Totals, sinks: Mapping[str, Sink]
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
    checksum = hashlib.sha256(content).hexdigest().encode()
    write_whole(path, _HEAD + checksum + b"\n" + content, durable=True)


def read_checkpoint(path: Path, identity: Mapping[str, Any]) -> Checkpoint | None:
    """Return a checkpoint, None where there is none.

    Args:
        path: where it is.
        identity: that of the run which is to go on.

    Raises:
        OutputError: the file is no checkpoint of this version and this run, or was changed.
    """
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise OutputError(f"cannot read {path}: {error.strerror}") from error
    try:
        checksum, body = content[len(_HEAD) :].split(b"\n", 1)
        if not content.startswith(_HEAD) or hashlib.sha256(body).hexdigest().encode() != checksum:
            raise ValueError("its checksum is wrong")
        run, moment, sinks = loads(body)
        if run != _digest(identity):
            raise ValueError("it is of another run")
        state, totals = loads(moment)
        marks = {name: loads(mark) for name, mark in sinks.items()}
    except Exception as error:  # damaged pickles raise anything
        raise OutputError(
            f"{path} is no checkpoint that can be used ({error}): give --overwrite to begin anew"
        ) from error
    return Checkpoint(state, totals, marks)


def _digest(identity: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()


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
            "give the same input and options, or --overwrite to begin anew"
        )


def _difference(wanted: Any, there: Any, name: str = "") -> str:
    """Return the first difference of two JSON values; where files lie makes none."""
    if wanted is None or there is None:
        return "" if wanted is there else f"with{'out' if there is None else ''} {name}"
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
    return _Reader(io.BytesIO(content)).load()


class _Reader(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        package = module.partition(".")[0]
        if package == "motionstereo_cli" and name in _NAMED:
            return _NAMED[name]
        if package == "numpy" and name in _OF_NUMPY:
            return getattr(importlib.import_module(module), name)
        raise pickle.UnpicklingError(f"it holds {module}.{name}")
