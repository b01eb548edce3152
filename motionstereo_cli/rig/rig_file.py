"""Rig files, motionstereo's own.

A rig file has one ``key: value`` line for each attribute of :class:`~motionstereo_cli.types.Rig`
(``doffs`` and ``focal_y_px`` are optional) and ``#`` comments. This is a subset of YAML, and of
what OpenCV writes. It is read line by line, so that errors name the line.
"""

from __future__ import annotations

import math
import re
from dataclasses import MISSING, fields
from pathlib import Path

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.atomic import write_whole
from motionstereo_cli.files.reading import MAX_CALIBRATION_BYTES, read_text
from motionstereo_cli.types import Rig

_WHOLE = frozenset({"width", "height"})
_POSITIVE = frozenset({"width", "height", "focal_px", "baseline_m", "focal_y_px"})


def read_rig(path: str | Path) -> Rig:
    """Read a rig file.

    Raises:
        InputError: the file cannot be read or has another format, or a value is missing, unknown,
            given twice, not a finite number, or not positive where it must be.
    """
    text = read_text(path, "the rig", MAX_CALIBRATION_BYTES)
    if text.strip() and not re.search(r"^(focal_px|baseline_m|width)\s*:", text, re.MULTILINE):
        raise InputError(
            f"{path} is no rig.yaml: rectify_source(source, [path]) reads calibrations of other "
            f"formats, and 'motionstereo rig {path} -o rig.yaml' makes a rig.yaml of it"
        )
    return parse_rig(path, text)


def parse_rig(path: str | Path, text: str) -> Rig:
    """Parse the text of a rig file, as :func:`read_rig` does; the path is for messages."""
    keys = [item.name for item in fields(Rig)]
    values: dict[str, float] = {}
    for line in text.splitlines():
        content = line.partition("#")[0].strip()
        if not content or content.startswith(("%YAML", "---", "...")):
            continue
        key, colon, value = (part.strip() for part in content.partition(":"))
        if not colon:
            raise InputError(f"{path}: {content[:60]!r} is not a 'key: value' line")
        if key not in keys:
            raise InputError(f"{path}: unknown key {key[:60]!r}: the keys are {', '.join(keys)}")
        if key in values:
            raise InputError(f"{path}: {key} is given twice: keep one")
        values[key] = _number(path, key, value)
    for item in fields(Rig):
        if item.default is MISSING and item.name not in values:
            raise InputError(f"{path}: {item.name} is missing: add a line '{item.name}: value'")
    return Rig(**{key: int(n) if key in _WHOLE else n for key, n in values.items()})  # type: ignore[arg-type]


def rig_values(rig: Rig) -> dict[str, float]:
    """Return the values of a rig by their keys, without those that are None."""
    values = {item.name: getattr(rig, item.name) for item in fields(Rig)}
    return {key: value for key, value in values.items() if value is not None}


def format_rig(rig: Rig) -> str:
    """Return a rig as the text of a rig file; reading it gives the same rig exactly."""
    return "".join(f"{key}: {value!r}\n" for key, value in rig_values(rig).items())


def write_rig(path: Path, rig: Rig) -> None:
    """Write a rig file.

    Raises:
        OutputError: the file cannot be written.
    """
    write_whole(path, format_rig(rig).encode())


def _number(path: str | Path, key: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    wanted = "a positive " if key in _POSITIVE else "a finite "
    wanted += "whole number" if key in _WHOLE else "number"
    if not (
        math.isfinite(value)
        and (value > 0 or key not in _POSITIVE)
        and (value.is_integer() or key not in _WHOLE)
    ):
        raise InputError(f"{path}: {key} cannot be {text[:60]!r}: give {wanted}")
    return value
