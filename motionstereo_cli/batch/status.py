"""What became of each recording of a batch: a file beside its folder, and one table of all."""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from motionstereo_cli.sinks.writers import text_cell

#: Statuses in which a recording is not tried again without being asked to.
FAILED = ("failed", "lost")
#: Those in which there is nothing left to do.
DONE = ("done", "damaged")


@dataclass(frozen=True, slots=True)
class Status:
    """What became of a recording.

    Attributes:
        name: its folder under that of the batch.
        status: ``done``; ``damaged``: done, but the input was; ``failed``; ``lost``: it ended the
            process that worked on it; ``interrupted``; ``running``; ``waiting``.
        frames: frames processed.
        seconds: how long that took, in s.
        charged, matched: mean shares of the image, 0..1, with charge and with a disparity.
        damage: lines that say what was lost of the input.
        reason: why it failed, in one line.
        worker: where it was processed.
        plan: hash of what was to be done.
    """

    name: str
    status: str = "waiting"
    frames: int = 0
    seconds: float = 0.0
    charged: float | None = None
    matched: float | None = None
    damage: int = 0
    reason: str = ""
    worker: str = ""
    plan: str = ""

    def row(self) -> dict[str, Any]:
        """Return it as a row of the table, by column."""
        return {key: value for key, value in dataclasses.asdict(self).items() if key != "plan"}


COLUMNS = tuple(item.name for item in dataclasses.fields(Status) if item.name != "plan")


def format_statuses(statuses: Iterable[Status]) -> bytes:
    """Return the table of a batch: RFC 4180 but for LF, a row a recording; empty = unknown."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    for status in statuses:
        row = status.row()
        for name in ("seconds", "charged", "matched"):
            row[name] = "" if row[name] is None else f"{row[name]:.4f}"
        writer.writerow({name: text_cell(each) for name, each in row.items()})
    return text.getvalue().encode()
