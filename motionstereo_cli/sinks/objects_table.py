"""The table of moving objects."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from motionstereo_cli.sinks.writers import TableFile, TableMark, cell
from motionstereo_cli.types import MovingObject, Step

if TYPE_CHECKING:
    from motionstereo_cli.sinks.sink import RunContext

#: Columns: whole numbers, real ones with their decimals, and what is so or not.
_WHOLE = ("id", "x", "y", "width", "height")
_REAL = {
    **{"depth_m": 3, "closing_mps": 3, "time_to_contact_s": 3, "confidence": 2},
    **{"over_ground_mps": 3, "direction_rad": 3, "sigma_mps": 3},
}
_FLAGS = ("by_itself", "shadow")
HEADER = ",".join(("frame", *_WHOLE, *_REAL, *_FLAGS))


def object_row(frame: int, item: MovingObject) -> str:
    """Return one row of the table, without its line end; an empty cell is unknown."""
    flags = (getattr(item, name) for name in _FLAGS)
    return ",".join(
        [
            *(str(frame), *(str(getattr(item, name)) for name in _WHOLE)),
            *(cell(getattr(item, name), decimals) for name, decimals in _REAL.items()),
            *("" if flag is None else str(int(flag)) for flag in flags),
        ]
    )


class ObjectsFile(TableFile):
    """The table of moving objects as a file: a row for each object of each frame."""

    def __init__(self, path: Path, _: RunContext, since: TableMark | None = None) -> None:
        super().__init__(path, HEADER, since)

    def write(self, step: Step) -> None:
        """Append the rows of a frame."""
        self.add(object_row(step.time.index, item) for item in step.objects)
