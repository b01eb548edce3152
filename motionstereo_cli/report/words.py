"""A run's record in words: its input, its settings, and the command that repeats it."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from msgspec import UNSET

from motionstereo_cli.params import Param, params
from motionstereo_cli.sinks.outputs import DEFAULT_OUTPUTS
from motionstereo_cli.sinks.records import GROUPS, RunRecord


class Changed(NamedTuple):
    """A setting that differs from its default; ``measured``: by what was measured for it."""

    item: Param
    value: Any
    measured: bool

    @property
    def usual(self) -> str:
        """The default, in the word that stands for it if there is one."""
        words = [word for word, value in self.item.words.items() if value == self.item.default]
        return words[0] if words else f"{self.item.default} {self.item.unit}"

    @property
    def option(self) -> list[str]:
        """The option that sets it on the command line."""
        flag = self.item.flag_for(self.value)
        return [flag] if self.item.kind is bool else [flag, f"{self.value}"]


def changed(record: RunRecord) -> Iterator[Changed]:
    """Yield the settings that differ from the defaults, except what is measured by default."""
    for group, settings in GROUPS.items():
        values = record.values(group)
        for item in params(settings):
            measured = item.name in (record.measured or ())
            if measured and item.default in item.words.values():
                continue
            if item.name in values and values[item.name] != item.default:
                yield Changed(item, values[item.name], measured)


def command(record: RunRecord, folder: str = "") -> str | None:
    """Return the shell command that repeats the run; None if its options are unknown.

    Args:
        record: of the run.
        folder: name of the folder to write to; empty: the default.
    """
    if record.options is UNSET or not record.inputs:
        return None
    inputs = record.inputs.values()
    paths = [each.path for each in inputs]
    if record.values("input_settings").get("swap"):  # the record has them as they were used
        paths.reverse()
    if any(each.topic or each.track for each in inputs):  # topics or tracks of one file
        paths = list(dict.fromkeys(paths))
    words = ["motionstereo", "run", *paths]
    words += record.options
    save = list(record.outputs or ())
    if tuple(save) != DEFAULT_OUTPUTS:
        words += ["--save", ",".join(save)]
    words += [word for each in changed(record) for word in each.option]
    if folder:
        words += ["-o", f"./{folder}" if folder.startswith("-") else folder]
    return shlex.join(words)


def troubles(record: RunRecord) -> Sequence[str]:
    """Return what a run warned of, and what was lost of its input, one sentence each."""
    said = (*(each.text for each in record.warned), *(record.damage or ()))
    return [_sentence(line) for line in said]


def _sentence(line: str) -> str:
    text = line.strip()
    first = text.partition(" ")[0]
    is_path = "/" in first or "." in first
    return (text if is_path else text[:1].upper() + text[1:]) + (
        "" if text.endswith((".", "?", "!")) else "."
    )
