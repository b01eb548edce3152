"""Reports that are a few numbers, in the forms that ``evaluate`` gives."""

from __future__ import annotations

import dataclasses
import json
import math
from typing import Any


def ratio(part: float, whole: int) -> float:
    """Return a part of a whole, NaN where that is 0."""
    return part / whole if whole else math.nan


def format_table(report: Any) -> str:
    """Return a dataclass of numbers for people: a line for each."""
    values = dataclasses.asdict(report).items()
    shown = ((name, "-" if math.isnan(value) else f"{value:.5g}") for name, value in values)
    return "".join(f"{name:24}{value:>12}\n" for name, value in shown)


def cell(value: float) -> str:
    """Return a number as a cell of CSV; empty = NaN, unknown."""
    return "" if math.isnan(value) else f"{value:.7g}"


def known(report: Any) -> dict[str, Any]:
    """Return a dataclass as JSON-able values, with None in the place of NaN, unknown."""
    values = dataclasses.asdict(report).items()
    return {name: None if _is_nan(value) else value for name, value in values}


def format_csv(report: Any) -> str:
    """Return a dataclass of numbers as CSV: a header and a row."""
    values = dataclasses.asdict(report)
    return ",".join(values) + "\n" + ",".join(map(cell, values.values())) + "\n"


def format_json(report: Any) -> str:
    """Return a dataclass of numbers as JSON; null = NaN, unknown."""
    return json.dumps(known(report), indent=2) + "\n"


def _is_nan(value: object) -> bool:
    return isinstance(value, float) and math.isnan(value)
