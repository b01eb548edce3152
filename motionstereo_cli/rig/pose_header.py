"""The header of a file of poses: its columns, or the other format that it shows."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

_AS_LINES = "give lines of t x y z qx qy qz qw, in s and m"

#: Patterns near the beginning of other formats, and what to do with these.
_FOREIGN = {
    r"\A\s*[\[{](?s:.*)\"transform_matrix\"": (
        "is a transforms.json of nerfstudio or Instant-NGP: its poses are of OpenGL cameras and of "
        f"no known scale: {_AS_LINES}"
    ),
    r"\A\s*[\[{](?s:.*)\"(ego_pose|rotation)\"": (
        f"is JSON, as nuScenes and Argoverse have their poses: {_AS_LINES} (in nuScenes qw comes "
        "first)"
    ),
    r"\A\s*[\[{]": f"is JSON, which is not read as poses: {_AS_LINES}",
    r"^#.*IMAGE_ID, *QW, *QX|^#.*two lines of data per image": (
        "is COLMAP's images.txt: its poses take the world to a camera, and are of no known scale: "
        f"{_AS_LINES}, as camera to world"
    ),
    r"^(VERTEX_SE3|EDGE_SE3)": f"is a graph of g2o: export its trajectory: {_AS_LINES}",
    r"^(header|pose|- header): *$": (
        "is what rostopic prints: record it with 'rostopic echo -p', which writes a table"
    ),
    r"\A#ROSBAG|\AARROW1|\APAR1|\A\x93NUMPY|\APK\x03\x04|\A\x89MCAP": (
        f"is no text, as a file of poses has to be: {_AS_LINES}"
    ),
    r"^#.*(?<![_a-z])w_RS_S_x": f"is a table of an IMU, not of poses: {_AS_LINES}",
    r"^#.*\bq p v bg ba\b|^#.*q_GtoI": (
        "is a state of OpenVINS, with quaternions in JPL's order and turned the other way: give "
        "what its recorder of poses writes (timestamp tx ty tz qx qy qz qw)"
    ),
}

#: How far into a file they are searched.
BEGINNING = 4096

#: Suffixes of the names of quaternions and positions, in lower case without units.
_QUATERNION = re.compile(r"(?:^|[^a-z])(?:q|quat\w*?|rot\w*?|ori\w*?)(?:[^a-z].*)?([xyzw])$")
_PLACE = re.compile(
    r"^[tp]?([xyz])$|(?:^|[^a-z])(?:t|p|pos\w*?|trans\w*?|loc\w*?)(?:[^a-z].*)?([xyz])$"
)

#: Names of times, the most telling first, with the unit that they imply.
_TIMES = (
    (re.compile(r"header\.stamp$"), "ns"),
    (re.compile(r"^%time$"), "ns"),
    (re.compile(r"(?:^|[^a-z])(time|stamp|t|times|timestamps?)(_kf)?$"), None),
    (re.compile(r"^(time|stamp|timestamp).*$"), None),
)
_SECONDS = re.compile(r"(?:^|[^a-z])sec(s|onds)?$")
_NANOSECONDS = re.compile(r"(?:^|[^a-z])n(ano)?_?sec(s|onds)?$")
_COUNT = re.compile(r"^(frame|image|index|id|number|idx|frame_?(id|number|index|num))$")
_UNIT = re.compile(r"(?:\(|\[|_)\s*(ns|us|ms|s|sec|nsec|nanoseconds|seconds|m)\s*(?:\)|\]|$)")
_UNITS = {"sec": "s", "seconds": "s", "nsec": "ns", "nanoseconds": "ns"}
_ANGLES = re.compile(r"(?:^|[^a-z])(roll|pitch|yaw|heading|r[xyz])(?:[^a-z]|$)")


@dataclass(frozen=True, slots=True)
class Header:
    """The content of a header.

    Attributes:
        columns: of t, x, y, z, qx, qy, qz and qw, and of nsec if the time is in two parts;
            without t if there is no time.
        unit: of the times, None if unknown.
        frame: the frame of the poses, one of --pose-frame's choices.
        separator: between columns, empty for blanks.
        problem: why a table with this header cannot be read, empty if it can.
    """

    columns: Mapping[str, int]
    unit: str | None = None
    frame: str = "robot"
    separator: str = ""
    problem: str = ""


def foreign(text: str) -> str | None:
    """Return which other format a text has, and what to do; None if it may be a table of poses."""
    beginning = text[:BEGINNING]
    found = (
        advice for what, advice in _FOREIGN.items() if re.search(what, beginning, re.MULTILINE)
    )
    return next(found, None)


def read_header(line: str) -> Header | None:
    """Return a line as a header; None if it is not a header of poses."""
    named = line.strip().lstrip("#").strip()
    # Remarks, unlike units, have blanks in them.
    named = re.sub(r"\([^)]*\s[^)]*\)", "", named)
    separator = next((each for each in ",;\t" if each in named), "")
    if not separator:
        named = re.sub(r"\s+(?=[\[(])", "", named)
    names = [name.strip().lower() for name in named.split(separator or None)]
    units = [_UNIT.search(name) for name in names]
    plain = [
        re.sub(r"\[.*?\]|\(.*?\)", "", _UNIT.sub("", name)).strip().replace(" ", "_")
        for name in names
    ]
    columns: dict[str, int] = {}
    for index, name in enumerate(plain):
        key = _key(name)
        if key:
            columns.setdefault(key, index)
    unit = None
    for pattern, implied in _TIMES:
        at = next((n for n, name in enumerate(plain) if pattern.search(name)), None)
        if at is not None and "sec" not in columns:
            columns["t"] = at
            stated = units[at]
            unit = _UNITS.get(stated[1], stated[1]) if stated else implied
            break
    if "sec" in columns and "nsec" in columns:
        columns["t"], unit = columns.pop("sec"), "s"
    elif "t" not in columns and "count" in columns:
        columns["t"], unit = columns["count"], "frames"
    turn = {"qx", "qy", "qz", "qw"}
    if not columns.keys() >= {"x", "y", "z"}:
        return None
    if not columns.keys() >= turn:
        if not turn.isdisjoint(columns) or any(map(_ANGLES.search, plain)):
            problem = f"has angles in place of a quaternion, of an unknown order: {_AS_LINES}"
            return Header(columns, problem=problem)
        return None
    wanted = {"t", "nsec", "x", "y", "z", *turn}
    kept = {key: index for key, index in columns.items() if key in wanted}
    if "t" not in kept:
        unit = "frames"
    return Header(kept, unit, _frame(named, kept), separator)


def _key(name: str) -> str:
    if found := _QUATERNION.search(name):
        return "q" + found[1]
    if found := _PLACE.search(name):
        return str(found[1] or found[2])
    for key, pattern in (("sec", _SECONDS), ("nsec", _NANOSECONDS), ("count", _COUNT)):
        if pattern.search(name):
            return key
    return ""


def _frame(names: str, columns: Mapping[str, int]) -> str:
    """Return the frame of poses with such names."""
    if re.search(r"\bVehicleName\b", names):  # AirSim
        return "ned"
    in_euroc_order = [columns[key] for key in ("x", "y", "z", "qw", "qx", "qy", "qz")]
    euroc = in_euroc_order == list(range(in_euroc_order[0], in_euroc_order[0] + 7))
    return "body" if euroc or re.search(r"[pq]_(RS|WS|WB|GI|WI)", names) else "robot"
