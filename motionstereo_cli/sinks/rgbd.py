"""Views, depth and poses in the layout of TUM RGB-D, for programs that fuse them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from motionstereo_cli.files.atomic import part_of, remove_own, write_whole
from motionstereo_cli.rig.pose_forms import quaternions
from motionstereo_cli.rig.poses import format_pose
from motionstereo_cli.sinks.images import DEPTH_PER_M
from motionstereo_cli.sinks.poses_table import optical_matrix
from motionstereo_cli.sinks.writers import TableFile, TableMark
from motionstereo_cli.types import Pose, Step

if TYPE_CHECKING:
    from motionstereo_cli.sinks.sink import RunContext

_HEADS = {
    "associations.txt": "",
    "rgb.txt": "# time_s file",
    "depth.txt": f"# time_s file ({DEPTH_PER_M} units per m, 0 = unknown)",
    "groundtruth.txt": "# time_s x_m y_m z_m qx qy qz qw (camera: x right, y down, z forward)",
}
TABLES = tuple(_HEADS)
INTRINSICS = "intrinsics.json"


class RgbdTables:
    """The tables of such a recording: a line for each frame that has a pose.

    Args:
        path: final name of the first of :data:`TABLES`; the others lie beside it.
        stream: what is known of the run; it has a rig.
        since: continue from this checkpoint: those of the tables.
    """

    def __init__(
        self, path: Path, stream: RunContext, since: list[TableMark] | None = None
    ) -> None:
        assert stream.rig is not None
        self._rig, self._camera = stream.rig, stream.settings.reference
        self._intrinsics = path.with_name(INTRINSICS)
        marks: Sequence[TableMark | None] = since or [None] * len(TABLES)
        self._tables = [
            TableFile(path.with_name(name), head, mark)
            for (name, head), mark in zip(_HEADS.items(), marks, strict=True)
        ]

    def write(self, step: Step) -> None:
        """Append the lines of a frame."""
        if step.place is None:
            return
        time = step.time
        time_s = time.clock_s
        shown, depth = (f"{time_s:.6f} {name}/{time.index:06d}.png" for name in ("rgb", "depth"))
        matrix = optical_matrix(step.place, self._rig.left_of_middle_m(self._camera))
        turn = quaternions(matrix[None, :3, :3])[0]
        pose = Pose(*matrix[:3, 3].tolist(), *turn.tolist())
        lines = f"{shown} {depth}", shown, depth, format_pose(time_s, pose).rstrip("\n")
        for table, line in zip(self._tables, lines, strict=True):
            table.add([line])

    def checkpoint(self) -> list[TableMark]:
        """Make sure that all so far is on the disk."""
        return [table.checkpoint() for table in self._tables]

    def close(self) -> None:
        """Complete the tables, and write the intrinsics as Open3D reads them."""
        rig = self._rig
        columns = [rig.focal_px, 0, 0, 0, rig.fy_px, 0, rig.cx_of(self._camera), rig.cy, 1]
        content: dict[str, Any] = {
            **{"width": rig.width, "height": rig.height},
            "intrinsic_matrix": columns,
        }
        write_whole(self._intrinsics, json.dumps(content, indent=2).encode() + b"\n")
        for table in self._tables:
            table.close()

    def abandon(self, *, keep: bool) -> None:
        """Leave the tables under their ``.part`` names or, without ``keep``, remove them."""
        for table in self._tables:
            table.abandon(keep=keep)
        if not keep:
            remove_own(part_of(self._intrinsics))
