"""The table of moving objects."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from motionstereo_cli.sinks.writers import TableFile, TableMark, cell
from motionstereo_cli.types import FrameResult, MovingObject

if TYPE_CHECKING:
    from motionstereo_cli.sinks import RunContext

HEADER = "frame,id,x,y,width,height,depth_m,closing_mps,time_to_contact_s,confidence"


def object_row(frame: int, thing: MovingObject) -> str:
    """Return one row of the table, without its line end.

    Lengths, speeds and times have 3 decimals, confidence has 2. An empty cell is unknown.
    """
    return ",".join(
        [
            *(str(frame), str(thing.id)),
            *(str(thing.x), str(thing.y), str(thing.width), str(thing.height)),
            cell(thing.depth_m, 3),
            cell(thing.closing_mps, 3),
            cell(thing.time_to_contact_s, 3),
            cell(thing.confidence, 2),
        ]
    )


class ObjectsFile(TableFile):
    """The table of moving objects as a file: a row for each object of each frame."""

    def write(self, result: FrameResult) -> None:
        """Append the rows of a frame."""
        self.add(object_row(result.frame.index, thing) for thing in result.objects)


def objects_file(path: Path, _: RunContext, since: TableMark | None = None) -> ObjectsFile:
    """Return a sink for the table of moving objects."""
    return ObjectsFile(path, HEADER, since)
