"""YAML, JSON, XML, INI and .npz files as plain values, read without trust in them.

No reader here creates objects, follows references or opens other files, and all have limits of
depth and size that calibrations stay below.
"""

from __future__ import annotations

import configparser
import io
import json
import re
import xml.etree.ElementTree as ET
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from motionstereo_cli.errors import InputError, words_of

#: Values by name: numbers (float), text, arrays, lists, and mappings again. Names are in lower
#: case without punctuation: cameraMatrix1, camera_matrix_1 and ``camera matrix 1`` are one.
Values = Mapping[str, Any]

#: Limits of depth, of the number of values, and of an array's size.
_MAX_DEPTH, _MAX_VALUES, _MAX_ARRAYS_BYTES = 24, 300_000, 64_000_000

_NUMBER = re.compile(
    r"[-+]?(?:(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?|\.?inf|\.?nan)", re.ASCII | re.IGNORECASE
)

_Loader = getattr(yaml, "CBaseLoader", yaml.BaseLoader)


def read_structure(path: Path, text: str) -> Values:
    """Return the values of a YAML, JSON, XML or INI file.

    Raises:
        InputError: it is none of them, or too deep or too large for a calibration.
    """
    start = text.lstrip()[:1]
    read = {"{": _json, "<": _xml, "[": _ini}.get(start, _yaml)
    if re.match(r"\s*\[\s*[\[{\"\d\]-]", text):  # a list, no section
        read = _json
    try:
        values = read(text)
    except (ValueError, RecursionError, yaml.YAMLError, ET.ParseError, configparser.Error) as error:
        raise InputError(
            f"{path} is not a calibration file that can be read ({_reason(error)}): "
            "check that it is whole YAML, JSON, XML or text"
        ) from None
    return values if isinstance(values, dict) else {}


def _reason(error: Exception) -> str:
    """Return an error's message in one short line."""
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    return words_of(error)


def read_npz(path: Path, content: bytes) -> Values:
    """Return the arrays of an .npz file; those that are neither numbers nor text are left out.

    Raises:
        InputError: it cannot be read.
    """
    found, room = [], _MAX_ARRAYS_BYTES
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            for item in archive.infolist()[: _MAX_DEPTH * _MAX_DEPTH]:
                if item.file_size <= room and item.filename.endswith(".npy"):
                    room -= item.file_size
                    array = _array(archive.read(item))
                    found.append((item.filename.removesuffix(".npy"), array))
        values: Values = _mapping((name, array) for name, array in found if array is not None)
        if not values:
            raise ValueError("it has no arrays of numbers")
        return values
    except (ValueError, OSError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(
            f"{path} cannot be read as .npz ({_reason(error)}): save it again with numpy.savez"
        ) from None


def _array(content: bytes) -> Any:
    try:
        array = np.load(io.BytesIO(content), allow_pickle=False)
    except (ValueError, EOFError, MemoryError):
        return None
    if array.dtype.kind in "fiu":
        return array.astype(np.float64)
    return str(array) if array.dtype.kind == "U" and not array.ndim else None


def _mapping(items: Iterable[tuple[str, Any]]) -> Any:
    """Return values by their plain names; OpenCV's matrices become arrays."""
    values: dict[str, Any] = {}
    for name, value in items:
        key = re.sub(r"[^a-z0-9]", "", name.lower())
        if key in values and not _same(values[key], value):
            raise ValueError(f"{name[:60]} is given twice: keep one")
        values[key] = value
    return _shaped(values) if "data" in values else values


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        return np.array_equal(one, other)
    return bool(one == other)


def _shaped(values: dict[str, Any]) -> Any:
    try:
        # OpenCV 5 writes vectors with "sizes".
        sizes = values.get("sizes") or [values["rows"], values["cols"]]
        shape = [int(size) for size in np.atleast_1d(sizes)]
        return np.array(values["data"], np.float64).reshape(shape)
    except (LookupError, TypeError, ValueError, OverflowError):
        return values


def _scalar(text: str) -> float | str:
    if _NUMBER.fullmatch(text) is None:
        return text
    return float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))


class _Budget:
    """The remaining number of values that a file may have."""

    def __init__(self) -> None:
        self._left = _MAX_VALUES

    def take(self, depth: int, count: int = 1) -> None:
        self._left -= count
        if self._left < 0:
            raise ValueError(f"it has more than {_MAX_VALUES:,} values")
        if depth > _MAX_DEPTH:
            raise ValueError(f"it is nested more than {_MAX_DEPTH} deep")


def _json(text: str) -> Any:
    if text.count(",") + text.count("[") + text.count("{") > _MAX_VALUES:
        raise ValueError(f"it has more than {_MAX_VALUES:,} values")
    words = {True: "true", False: "false"}

    def mapping(items: list[tuple[str, Any]]) -> Any:
        return _mapping(
            (name, words[value] if isinstance(value, bool) else value) for name, value in items
        )

    return json.loads(text, parse_int=float, object_pairs_hook=mapping)


def _yaml(text: str) -> Any:
    # OpenCV's header %YAML:1.0 is not YAML. It is removed, as are document markers.
    text = re.sub(r"^(%YAML.*|---.*|\.\.\.\s*)$", "", text, flags=re.MULTILINE)
    # OpenCV accepts "key:2" and "data:[2]", which are not YAML either.
    text = re.sub(r"^(\s*[A-Za-z][\w.]*):(?=[-+.\d\[])", r"\1: ", text, flags=re.MULTILINE)
    text = re.sub(r"^\t+", lambda tabs: "  " * len(tabs[0]), text, flags=re.MULTILINE)
    budget = _Budget()
    # Event by event, so that nothing here recurses. The root is the first of a list.
    open_nodes: list[tuple[type, list[Any]]] = [(list, [])]
    for event in yaml.parse(text, Loader=_Loader):
        budget.take(len(open_nodes))
        if isinstance(event, yaml.AliasEvent):
            raise ValueError(f"the reference *{event.anchor[:60]} is not followed: write it out")
        if isinstance(event, yaml.ScalarEvent):
            quoted = event.style in ("'", '"')
            open_nodes[-1][1].append(event.value if quoted else _scalar(event.value))
        elif isinstance(event, yaml.SequenceStartEvent):
            open_nodes.append((list, []))
        elif isinstance(event, yaml.MappingStartEvent):
            open_nodes.append((dict, []))
        elif isinstance(event, yaml.CollectionEndEvent):
            kind, items = open_nodes.pop()
            pairs = zip(map(_name, items[::2]), items[1::2], strict=True) if kind is dict else ()
            open_nodes[-1][1].append(_mapping(pairs) if kind is dict else items)
    return next(iter(open_nodes[0][1]), None)


def _name(key: Any) -> str:
    # A lone "y" or "n", or a number, is also a name.
    return f"{key:g}" if isinstance(key, float) else str(key)


def _xml(text: str) -> Any:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("XML with entities is not read")
    budget, depth = _Budget(), 0
    parser: ET.XMLPullParser[Any] = ET.XMLPullParser(("start", "end"))
    root = None
    # In parts, so that parsing of a file that is too deep stops early.
    for place in range(0, len(text), 1000):
        parser.feed(text[place : place + 1000])
        events: Iterable[Any] = parser.read_events()
        for kind, element in events:
            depth += 1 if kind == "start" else -1
            budget.take(depth)
            root = element if root is None else root
    parser.close()
    return None if root is None else _of_element(root, budget)


def _of_element(element: ET.Element, budget: _Budget) -> Any:
    children = list(element)
    if children and all(child.tag == "_" for child in children):
        return [_of_element(child, budget) for child in children]
    if children:
        return _mapping((child.tag, _of_element(child, budget)) for child in children)
    text = (element.text or "").strip()
    if text.startswith('"'):
        return text.strip('"')
    words = text.split(None, _MAX_VALUES)
    budget.take(0, len(words))
    return _scalar(text) if len(words) < 2 else [_scalar(word) for word in words]


def _ini(text: str) -> Any:
    parser = configparser.RawConfigParser(strict=False, inline_comment_prefixes=("#", ";"))
    parser.read_string(text)
    return _mapping(
        (section, _mapping((key, _scalar(value.strip())) for key, value in parser.items(section)))
        for section in parser.sections()
    )
