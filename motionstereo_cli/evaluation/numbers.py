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


def format_csv(report: Any) -> str:
    """Return a dataclass of numbers as CSV: a header and a row; empty = NaN, unknown."""
    values = dataclasses.asdict(report)
    row = ("" if math.isnan(value) else f"{value:.7g}" for value in values.values())
    return ",".join(values) + "\n" + ",".join(row) + "\n"


def format_json(report: Any) -> str:
    """Return a dataclass of numbers as JSON; null = NaN, unknown."""
    values = dataclasses.asdict(report)
    known = {name: None if math.isnan(value) else value for name, value in values.items()}
    return json.dumps(known, indent=2) + "\n"
