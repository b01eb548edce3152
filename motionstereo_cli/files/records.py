"""Typed records: one definition writes, reads and checks them.

Records are JSON; those with arrays are npz files that hold the rest as JSON.
Types and ranges are those of the fields' annotations, which msgspec checks.
"""

from __future__ import annotations

import io
import json
import math
import re
from pathlib import Path
from typing import Any, NoReturn, TypeVar, get_args

import msgspec
import numpy as np

from motionstereo_cli.errors import InputError, words_of
from motionstereo_cli.files.reading import MAX_RECORD_BYTES, read_bytes

#: The version of all records. Readers skip unknown fields, so it grows only when the meaning
#: of a field changes.
FORMAT_VERSION = 1

#: Where the JSON is in an npz file.
_JSON = "record"

#: The longest part of a message that is quoted.
_MAX_QUOTED = 200

_T = TypeVar("_T")


class Record(msgspec.Struct, kw_only=True, frozen=True):
    """A JSON object as a file. Fields that are not set are not written.

    Attributes:
        format_version: :data:`FORMAT_VERSION` of the program that wrote it.
    """

    format_version: int = FORMAT_VERSION


def read_json(path: Path, within: Path | None = None) -> Any:
    """Return what a JSON file holds.

    Args:
        path: the file.
        within: see :func:`~motionstereo_cli.files.reading.open_regular`.

    Raises:
        InputError: it cannot be read, or is not JSON.
    """
    return parse_json(read_bytes(path, "the record", MAX_RECORD_BYTES, within), path)


def parse_json(content: bytes, name: object) -> Any:
    """Parse JSON; numbers have to be finite, and text has to be encodable.

    Args:
        content: the JSON.
        name: what messages call it.

    Raises:
        InputError: it is not JSON.
    """
    try:
        value = json.loads(content, parse_constant=_no_number, parse_float=_finite)
        # File names that are not UTF-8 have surrogates of their own.
        json.dumps(value, ensure_ascii=False).encode("utf-8", "surrogateescape")
    except (ValueError, RecursionError) as error:
        reason = "nested too deeply" if isinstance(error, RecursionError) else error
        raise InputError(f"{name} cannot be read: not JSON ({reason}): write it again") from error
    return value


def _finite(text: str) -> float:
    number = float(text)
    return number if math.isfinite(number) else _no_number(text)


def _no_number(text: str) -> NoReturn:
    raise ValueError(f"{text[:20]} is not a number")


def typed(value: Any, kind: type[_T], name: object, *, strict: bool = True) -> _T:
    """Return JSON-able values as a record.

    Args:
        value: the values.
        kind: the class of the record.
        name: what messages call it.
        strict: False reads numbers from text.

    Raises:
        InputError: a field is missing, or its value is of the wrong type or out of range; or a
            later version wrote it in another format.
    """
    try:
        record = msgspec.convert(value, kind, strict=strict)
    except (msgspec.ValidationError, OverflowError) as error:
        raise InputError(f"{name} is damaged: {in_words(error)}: write it again") from error
    if isinstance(record, Record) and record.format_version > FORMAT_VERSION:
        raise InputError(
            f"{name} has format_version {record.format_version}, "
            "which only later versions of motionstereo read: use one"
        )
    return record


def in_words(error: Exception, whole: str = "the record") -> str:
    """Return what is wrong with a field and where it is; both may quote the file.

    Args:
        error: of msgspec.
        whole: what messages call all of it.
    """
    what, _, place = str(error).replace("`", "").partition(" - at $")
    where = place.strip(".")[:_MAX_QUOTED] or whole
    return f"{where}: {what[:1].lower()}{what[1:_MAX_QUOTED]}"


def encode(record: Record) -> bytes:
    """Return a record as JSON."""
    return json.dumps(builtins_of(record), indent=2, allow_nan=False).encode() + b"\n"


def builtins_of(record: object) -> Any:
    """Return a record as JSON-able values, without fields that are not set."""
    return msgspec.to_builtins(record)


def pack(value: object) -> bytes:
    """Return dataclasses, tuples, dicts, plain values and arrays in them as an npz file."""
    arrays: dict[str, Any] = {}

    def apart(each: Any) -> Any:
        if isinstance(each, np.generic):
            return each.item()
        if not isinstance(each, np.ndarray):
            raise NotImplementedError(type(each))
        arrays[name := f"array{len(arrays)}"] = each
        return {_JSON: name}

    text = json.dumps(msgspec.to_builtins(value, enc_hook=apart))
    arrays[_JSON] = np.frombuffer(text.encode(), np.uint8)
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def unpack(content: bytes, kind: type[_T]) -> _T:
    """Return what :func:`pack` packed.

    Args:
        content: the npz file.
        kind: its type; values of fields of type Any are dicts and lists, see
            :func:`restored`.

    Raises:
        ValueError: it is damaged, or something else.
    """
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            if sum(each.file_size for each in arrays.zip.infolist()) > len(content):
                raise ValueError("it is compressed")

            def whole(each: dict[str, Any]) -> Any:
                return arrays[each[_JSON]] if each.keys() == {_JSON} else each

            value = json.loads(arrays[_JSON].tobytes(), object_hook=whole)
    except Exception as error:  # damaged archives raise anything
        raise ValueError(f"it cannot be read: {words_of(error)}") from error
    found: _T = restored(value, kind)
    return found


def restored(value: Any, kind: Any) -> Any:
    """Return values of :func:`unpack` as a dataclass or tuple.

    Raises:
        ValueError: they are of another kind.
    """
    try:
        return msgspec.convert(value, kind, dec_hook=_array)
    except msgspec.ValidationError as error:
        raise ValueError(in_words(error)) from error


def _array(kind: Any, value: Any) -> Any:
    """Return an array, if its dtype is of the annotated kind."""
    wanted = get_args(get_args(kind)[1])[0]
    if not isinstance(value, np.ndarray):
        raise ValueError(f"expected an array, got {type(value).__name__}")
    if value.dtype.type not in (get_args(wanted) or (wanted,)):
        raise ValueError(f"an array holds {re.sub('[^a-z0-9]', '', value.dtype.name)}")
    return value
