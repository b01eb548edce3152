"""What a run leaves, so that another process can go on after its own is gone."""

from __future__ import annotations

import importlib
import io
import json
import pickle
from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from motionstereo_cli.errors import OutputError
from motionstereo_cli.files.atomic import write_whole
from motionstereo_cli.sinks import Sink

#: What may stand in a checkpoint besides plain values: of this package what holds state, and
#: NumPy's arrays. Nothing that could do harm, whoever wrote the file.
_OUR_MODULES = (
    "motionstereo_cli.memory",
    "motionstereo_cli.pipeline",
    "motionstereo_cli.batch.run",
    "motionstereo_cli.robot.",
    "motionstereo_cli.settings",
    "motionstereo_cli.types",
)
_OF_NUMPY = {"ndarray", "dtype", "scalar", "_reconstruct", "_frombuffer"}


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """Where a run stood after some frame.

    Attributes:
        state: all that is kept from frame to frame.
        totals: sums over the frames so far.
        sinks: the checkpoint of each output.
        identity: what makes it this run and no other, as ``run.json`` has it.
    """

    state: Any
    totals: Any
    sinks: Mapping[str, Any]
    identity: Mapping[str, Any] = field(default_factory=dict)


def write_checkpoint(
    path: Path,
    identity: Mapping[str, Any],
    state: Any,
    totals: Any,
    sinks: Mapping[str, Sink],
) -> None:
    """Write a checkpoint in the place of the one before, once all outputs have made theirs.

    Raises:
        OutputError: it, or what the outputs have so far, cannot be written.
    """
    marks = {name: sink.checkpoint() for name, sink in sinks.items()}
    made = {name: mark.result() for name, mark in marks.items() if isinstance(mark, Future)}
    content = pickle.dumps((identity, pickle.dumps((state, totals)), made))
    write_whole(path, content, durable=True)


def read_checkpoint(path: Path) -> Checkpoint | None:
    """Return a checkpoint, None where there is none.

    Raises:
        OutputError: the file is no checkpoint of this version.
    """
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise OutputError(f"cannot read {path}: {error.strerror}") from error
    try:
        identity, moment, sinks = loads(content)
        state, totals = loads(moment)
        marks = {name: loads(mark) for name, mark in sinks.items()}
    except Exception as error:  # damaged pickles raise anything
        raise OutputError(
            f"{path} is no checkpoint that can be used ({error}): give --overwrite to begin anew"
        ) from error
    return Checkpoint(state, totals, marks, identity)


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
        ours = module.startswith(_OUR_MODULES) and "." not in name
        numpys = module.partition(".")[0] == "numpy" and name in _OF_NUMPY
        if ours or numpys:
            found = getattr(importlib.import_module(module), name)
            if numpys or (isinstance(found, type) and found.__module__ == module):
                return found
        raise pickle.UnpicklingError(f"it holds {module}.{name}")
