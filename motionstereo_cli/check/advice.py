"""The options of ``run`` that a check advises, as a configuration file."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from motionstereo_cli.errors import OutputError
from motionstereo_cli.rig.settings import RigSettings
from motionstereo_cli.sources.settings import InputSettings

if TYPE_CHECKING:
    from motionstereo_cli.check.findings import CheckReport

#: Findings after which disparities are others than those measured.
_CHANGE_DISPARITY = {"turned", "drifting", "out-of-step", "misaligned", "swapped"}


class Advice(NamedTuple):
    """A value for an option of ``run``, by the name of its parameter, and why."""

    name: str
    value: Any
    why: str


def advised(
    report: CheckReport,
    given: InputSettings,
    frame_rate: Fraction | None = None,
    likely_white: int = 0,
) -> list[Advice]:
    """Return what mends the findings that options can mend, and the range of disparities.

    Args:
        report: what was found.
        given: how the input was read.
        frame_rate: pairs of images per second; None where images have no times.
        likely_white: level that seems to be white, 0 = that of the images' bits.
    """
    why = {finding.name: finding.text for finding in report.findings}
    found: list[Advice] = []
    if report.mounted is not None:
        turns = _turned(given, report.mounted.options)
        found += [Advice(name, value, report.mounted.text) for name, value in turns.items()]
    if likely_white:
        found.append(Advice("white", likely_white, "the images use a small part of their bits"))
    if "drifting" in why and frame_rate:
        half_period_s = round(float(1 / (2 * frame_rate)), 6)
        found.append(Advice("sync_tolerance", half_period_s, why["drifting"]))
    elif "out-of-step" in why:
        offset = (given.offset or 0) - report.step_frames
        found.append(Advice("sync_offset", offset, why["out-of-step"]))
    if "swapped" in why:
        found.append(Advice("swap", not given.swap, why["swapped"]))
    if "disparity-offset" in why:
        found.append(Advice("disparity_offset", "auto", why["disparity-offset"]))
    if why.keys() & _CHANGE_DISPARITY:
        measured = "to be measured when the rest is mended"
        found.append(Advice("max_disparity", "auto", measured))
    elif report.advised_max_disparity is not None:
        measured = (
            f"disparities of {report.disparity_low_px:.1f} to {report.disparity_high_px:.1f} px "
            f"were measured in {report.matches} matches"
        )
        found.append(Advice("max_disparity", report.advised_max_disparity, measured))
    return found


def _turned(given: InputSettings, more: Any) -> dict[str, Any]:
    """Return the given turns combined with further ones; a view is mirrored first, then turned."""
    found: dict[str, Any] = {}
    for side, (degrees, mirrored) in zip(("left", "right"), given.turns, strict=True):
        again, further = more.get(f"mirror_{side}", False), more.get(f"rotate_{side}", 0)
        if again:
            found[f"mirror_{side}"] = not mirrored
        total = (further + (-degrees if again else degrees)) % 360
        if total != degrees:
            found[f"rotate_{side}"] = total
    return found


def as_toml(
    head: Sequence[str],
    given: Iterable[InputSettings | RigSettings],
    rig: Iterable[Path],
    advice: Iterable[Advice],
) -> bytes:
    """Return a configuration of ``run``: what was given, and what is advised.

    Args:
        head: lines that say what it is.
        given: how the input and the calibration were read; what is not the default is repeated.
        rig: the calibration files that were given.
        advice: what is advised; it wins.

    Raises:
        OutputError: the name of a calibration file is no text.
    """
    advice = list(advice)
    values: dict[str, Any] = {
        field.name: value
        for settings in given
        for field in dataclasses.fields(settings)
        if (value := getattr(settings, field.name)) != field.default
    }
    values |= {"rig": [str(path) for path in rig]} if rig else {}
    for each in advice:
        values.pop(each.name, None)
    lines = [f"# {line}" for line in head]
    if values:
        lines += ["", "# as given to check", *(_line(*each) for each in values.items())]
    for each in advice:
        lines += ["", f"# {each.why}", _line(each.name, each.value)]
    try:
        return "".join(f"{line}\n" for line in lines).encode()
    except UnicodeEncodeError:
        raise OutputError(
            "a configuration cannot hold the name of a file that is no text"
        ) from None


def _line(name: str, value: Any) -> str:
    # What JSON writes is TOML, but for a character that TOML wants escaped.
    text = json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return f"{name.replace('_', '-')} = {text}"
