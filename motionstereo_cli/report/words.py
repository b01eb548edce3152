"""A run's record in words: its input, its settings, and the command that repeats it."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from msgspec import UNSET

from motionstereo_cli.params import Param, params
from motionstereo_cli.sinks.outputs import DEFAULT_OUTPUTS
from motionstereo_cli.sinks.records import GROUPS, RunRecord


class Changed(NamedTuple):
    """A setting that differs from its default."""

    item: Param
    value: Any

    @property
    def usual(self) -> str:
        """The default, in the word that stands for it if there is one."""
        words = [word for word, value in self.item.words.items() if value == self.item.default]
        return words[0] if words else f"{self.item.default} {self.item.unit}"

    @property
    def option(self) -> list[str]:
        """The option that sets it on the command line."""
        if self.item.kind is bool:
            no = "" if self.value else "no-"
            return [f"--{no}{self.item.flag.removeprefix('--')}"]
        return [self.item.flag, f"{self.value}"]


def changed(record: RunRecord) -> Iterator[Changed]:
    """Yield the settings of a run that differ from the defaults."""
    for group, settings in GROUPS.items():
        values = record.values(group)
        for item in params(settings):
            if item.name in values and values[item.name] != item.default:
                yield Changed(item, values[item.name])


def command(record: RunRecord) -> str | None:
    """Return the shell command that repeats the run; None if its options are unknown."""
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
    return shlex.join(words)


def troubles(record: RunRecord, shares: Mapping[str, float]) -> Sequence[str]:
    """Return what was warned of, what was lost, and what stands out, one sentence each.

    Args:
        record: of the run.
        shares: of the frames that have each status.
    """
    said = (*(each.text for each in record.warned), *(record.damage or ()))
    lines = [_sentence(line) for line in said]
    found = record.shares
    if found and found.charged > 0.05 and found.matched < 0.1 * found.charged:
        lines.append(
            f"{found.charged:.1%} of the image moved, and {found.matched:.1%} was matched: "
            "motionstereo check tells whether the two views fit together."
        )
    elif found and found.charged < 0.01:
        lines.append(
            f"Next to nothing moved ({found.charged:.1%} of the image): this method sees what "
            "moves, or what a moving camera passes."
        )
    if (blind := shares.get("blind", 0)) > 0.5:
        why = (
            "one level surface fills the view, as a floor does from above, or a wall, so that "
            "there is nowhere to steer to. Depth and objects are found all the same."
            if found and found.matched > 0.05
            else "too little was matched to see a way."
        )
        lines.append(f"No heading is given in {blind:.0%} of the frames (status blind): {why}")
    return lines


def _sentence(line: str) -> str:
    text = line.strip()
    first = text.partition(" ")[0]
    is_path = "/" in first or "." in first
    return (text if is_path else text[:1].upper() + text[1:]) + (
        "" if text.endswith((".", "?", "!")) else "."
    )
