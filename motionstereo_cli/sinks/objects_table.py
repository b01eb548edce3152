"""The table of moving objects."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from motionstereo_cli.sinks.writers import TableFile, TableMark, cell
from motionstereo_cli.types import MovingObject, Step

if TYPE_CHECKING:
    from motionstereo_cli.sinks.sink import RunContext

HEADER = (
    "frame,id,x,y,width,height,depth_m,closing_mps,time_to_contact_s,confidence,"
    "over_ground_mps,direction_rad,sigma_mps,by_itself,shadow"
)


def object_row(frame: int, item: MovingObject) -> str:
    """Return one row of the table, without its line end.

    Lengths, speeds and times have 3 decimals, confidence has 2. An empty cell is unknown.
    """
    return ",".join(
        [
            *(str(frame), str(item.id)),
            *(str(item.x), str(item.y), str(item.width), str(item.height)),
            cell(item.depth_m, 3),
            cell(item.closing_mps, 3),
            cell(item.time_to_contact_s, 3),
            cell(item.confidence, 2),
            cell(item.over_ground_mps, 3),
            cell(item.direction_rad, 3),
            cell(item.sigma_mps, 3),
            *("" if is_so is None else str(int(is_so)) for is_so in (item.by_itself, item.shadow)),
        ]
    )


class ObjectsFile(TableFile):
    """The table of moving objects as a file: a row for each object of each frame."""

    def __init__(self, path: Path, _: RunContext, since: TableMark | None = None) -> None:
        super().__init__(path, HEADER, since)

    def write(self, step: Step) -> None:
        """Append the rows of a frame."""
        self.add(object_row(step.time.index, item) for item in step.objects)
