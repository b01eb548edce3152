"""The path of the rig from above, with the map and movers."""

from __future__ import annotations

import math
import re
from array import array
from collections import defaultdict
from typing import TYPE_CHECKING, Any

import numpy as np

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.reading import MAX_RESULT_BYTES, read_text
from motionstereo_cli.report.pictures import encoded
from motionstereo_cli.report.run_folder import Results, SteeringTable
from motionstereo_cli.sinks.outputs import OUTPUTS
from motionstereo_cli.sinks.read_back import numbering_in
from motionstereo_cli.types import Pose

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Reals = NDArray[np.float64]

#: Points of the path and of each thing at most; px of the map; margin around all in m.
_MAX_POINTS, _MAP_PX, _MARGIN_M = 2000, 1000, 1.0
#: Width and height in px that the picture has at most.
_SHOWN_PX = 460, 620
#: Times that differ by less are of one frame.
_SAME_S = 1e-3


def trajectory(run: Results, steering: SteeringTable | None) -> dict[str, Any] | None:
    """Return the path for the page, None if the run has no readable poses.

    x points up in the picture and y to the left, as seen by the robot at its start.
    """
    poses = _poses(run)
    if poses is None:
        return None
    path = poses[:, 1:3]
    things = _things(run, steering, poses)
    floor = _floor(run)
    shown = [path, *things.values()]
    if floor is not None:
        shown.append(np.array([[floor["x"], floor["y"]], [floor["right"], floor["top"]]]))
    places = np.concatenate(shown)
    low, high = places.min(axis=0) - _MARGIN_M, places.max(axis=0) + _MARGIN_M
    steps_m = np.hypot(*np.diff(path, axis=0).T)
    across_m, along_m = high[1] - low[1], high[0] - low[0]
    bar_m = 10 ** math.floor(math.log10(max(across_m, along_m) / 3))
    lost = None if steering is None else len(steering) - len(poses)
    return {
        "box": f"{-high[1]:.2f} {-high[0]:.2f} {across_m:.2f} {along_m:.2f}",
        "width_px": round(min(_SHOWN_PX[0], _SHOWN_PX[1] * across_m / along_m)),
        "stroke": max(across_m, along_m) / 250,
        "path": _line(path),
        "start": _at(path[0]),
        "end": _at(path[-1]),
        "things": [{"id": name, "line": _line(each)} for name, each in things.items()],
        "floor": floor,
        "bar_m": f"{bar_m:g}",
        "bar": 100 * bar_m / across_m,
        "length_m": float(steps_m.sum()),
        "apart_m": float(np.hypot(*(path[-1] - path[0]))),
        "lost": max(lost or 0, 0),
    }


def _poses(run: Results) -> Reals | None:
    """Return time and place of each pose and its quaternion, (n, 8); None without any."""
    path = run.path / OUTPUTS["poses"].path
    if not (run.has("poses") and path.is_file()):
        return None
    try:
        lines = read_text(path, "the poses", MAX_RESULT_BYTES, within=run.path).splitlines()
        rows = [line.split() for line in lines if line and not line.startswith("#")]
        poses = np.array(rows, np.float64)
    except (InputError, ValueError):
        return None
    whole = poses.ndim == 2 and poses.shape[1] == 8 and len(poses) > 1
    return poses if whole and np.isfinite(poses).all() else None


def _things(run: Results, steering: SteeringTable | None, poses: Reals) -> dict[str, Reals]:
    """Return where each thing that moved by itself was, (n, 2) m, by its number."""
    rig, rows = run.record.camera, run.objects()
    if rig is None or rows is None or steering is None:
        return {}
    frames = steering.frames.tolist()
    places = map(numbering_in(run.path).of, frames)
    time_of = dict(zip(frames, steering.time_s.tolist() if steering.timed else places, strict=True))
    cx_px = rig.cx_of(run.reference)
    found: dict[str, array[float]] = defaultdict(lambda: array("d"))
    for row in rows:
        try:
            time_s, depth_m = time_of[int(row["frame"])], float(row["depth_m"])
            middle = float(row["x"]) + float(row["width"]) / 2
            moves = row["by_itself"] == "1" and row.get("shadow") != "1"
        except (KeyError, ValueError):
            continue
        index = min(int(np.searchsorted(poses[:, 0], time_s - _SAME_S)), len(poses) - 1)
        if not moves or abs(poses[index, 0] - time_s) > _SAME_S or not math.isfinite(middle):
            continue
        pose = Pose(*poses[index, 1:].tolist())
        left_m = (cx_px - middle) / rig.focal_px * depth_m
        x_m, y_m = rig.camera_on_floor(pose, run.reference)
        cos, sin = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
        place = x_m + cos * depth_m - sin * left_m, y_m + sin * depth_m + cos * left_m
        if all(map(math.isfinite, place)):
            found[row["id"]].extend(place)
    return {name: np.reshape(places, (-1, 2)) for name, places in found.items() if len(places) > 2}


def _floor(run: Results) -> dict[str, Any] | None:
    """Return the picture of the map and where it lies, m; None without one that can be read."""
    image = run.map()
    if image is None:
        return None
    try:
        text = read_text(run.path / "map.yaml", "the map", MAX_RESULT_BYTES, within=run.path)
    except InputError:
        return None
    cell = re.search(r"^resolution: *([0-9.eE+-]+)", text, re.MULTILINE)
    origin = re.search(r"^origin: *\[([^,\]]+),([^,\]]+),", text, re.MULTILINE)
    if cell is None or origin is None:
        return None
    try:
        cell_m, x, y = float(cell[1]), float(origin[1]), float(origin[2])
    except ValueError:
        return None
    height, width = image.shape
    # The map has x to the right and y upward; here x is upward and y to the left.
    turned = np.ascontiguousarray(np.rot90(image))
    return {
        "uri": encoded(turned, _MAP_PX, ".png").uri,
        "x": x,
        "y": y,
        "right": x + width * cell_m,
        "top": y + height * cell_m,
        "wide": height * cell_m,
        "high": width * cell_m,
    }


def _line(places: Reals) -> str:
    """Return places (n, 2) in m as points of a line in the picture."""
    step = -(-len(places) // _MAX_POINTS)
    return " ".join(f"{-y:.3f},{-x:.3f}" for x, y in places[::step].tolist())


def _at(place: Reals) -> tuple[float, float]:
    return round(float(-place[1]), 3), round(float(-place[0]), 3)
