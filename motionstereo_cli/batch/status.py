"""Status of each recording of a batch: a file for each, and one table of all."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from typing import Any

from motionstereo_cli.sinks.records import Status
from motionstereo_cli.sinks.writers import text_cell

#: Statuses of recordings that are not tried again unless asked.
FAILED = ("failed", "lost")
#: Statuses of complete recordings.
DONE = ("done", "damaged")


#: Columns of the table of a batch.
COLUMNS = tuple(name for name in Status.__struct_fields__ if name not in ("plan", "format_version"))


def row_of(status: Status) -> dict[str, Any]:
    """Return a status as a row of the table, by column."""
    return {name: getattr(status, name) for name in COLUMNS}


def format_statuses(statuses: Iterable[Status]) -> bytes:
    """Return the table of a batch: RFC 4180 but for LF, one row per recording; empty = unknown."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    for status in statuses:
        row = row_of(status)
        for name in ("seconds", "charged", "matched"):
            row[name] = "" if row[name] is None else f"{row[name]:.4f}"
        writer.writerow({name: text_cell(each) for name, each in row.items()})
    return text.getvalue().encode()
