"""Files of poses in the forms of TUM, EuRoC and KITTI, as tables."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.reading import MAX_TABLE_BYTES, read_text

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Reals = NDArray[np.float64]

#: Numbers are smaller than this, so that differences of them stay finite.
_LARGEST = 1e100

#: How far the length of a quaternion may be from 1, and a rotation matrix times its transpose from
#: the identity: files keep few decimals.
_LENGTH_ERROR = 0.01

#: Columns of t x y z qx qy qz qw, as TUM and as EuRoC have them.
_TUM, _EUROC = (0, 1, 2, 3, 4, 5, 6, 7), (0, 1, 2, 3, 5, 6, 7, 4)

#: Times since 1970 that are larger are in ns, us, ms: in s they would be 3,000 years and more.
_SINCE_1970 = {"ns": 1e17, "us": 1e14, "ms": 1e11}


@dataclass(frozen=True, slots=True)
class PoseTable:
    """What a file of poses holds.

    Attributes:
        form: ``TUM``, ``EuRoC`` or ``KITTI``.
        unit: unit of the times: s, ms, us, ns, or ``frames``; a guess by form and size.
        times: (n,) float64, rising; numbers from 0 in KITTI's form, which has none.
        places: (n, 3) float64 m.
        turns: (n, 4) float64 unit quaternions qx, qy, qz, qw.
    """

    form: str
    unit: str
    times: Reals
    places: Reals
    turns: Reals


def read_pose_table(path: str | Path) -> PoseTable:
    """Read a file of poses; empty lines and lines that begin with # are skipped.

    Numbers are separated by spaces or commas. A line is ``t x y z qx qy qz qw`` (TUM), ``t x y z
    qw qx qy qz`` and whatever follows (EuRoC: told by a header that names the columns, by more
    than 8 columns, or by times in ns), or the three rows of a matrix [R t] (KITTI).

    Raises:
        InputError: the file cannot be read, holds no pose, or a line (which is named) is not a
            pose that comes after the one before.
    """
    rows: list[list[float]] = []
    header: dict[str, int] | None = None
    form = ""
    order: tuple[int, ...] = _TUM
    for number, line in enumerate(read_text(path, "the poses", MAX_TABLE_BYTES).splitlines(), 1):
        words = [word for word in re.split(r"[\s,;]+", line.strip()) if word]
        if not words:
            continue
        if line.lstrip().startswith("#") or (not rows and words[0][:1].isalpha()):
            header = header or _header(line)
            continue
        row = _numbers(words)
        if not rows and row is not None:
            form, order = _form(row, header)
        pose = None if row is None else _pose(row, form, order, len(rows))
        if pose is None:
            wanted = (
                "12 numbers, the rows of [R t]"
                if form == "KITTI"
                else f"t x y z {'qw qx qy qz' if order == _EUROC else 'qx qy qz qw'}, "
                "in s and m and with a unit quaternion"
            )
            raise InputError(
                f"{path} line {number}: {line.strip()[:60]!r} is not a pose: give {wanted}"
            )
        if rows and pose[0] <= rows[-1][0]:
            raise InputError(
                f"{path} line {number}: time {pose[0]:.12g} does not come after "
                f"{rows[-1][0]:.12g}: sort the poses by time"
            )
        rows.append(pose)
    if not rows:
        raise InputError(f"{path} has no poses: give lines of t x y z qx qy qz qw")
    table = np.array(rows)
    unit = "frames" if form == "KITTI" else _unit(form, table[0, 0])
    if form == "KITTI":
        matrices = table[:, 1:].reshape(-1, 3, 4)
        return PoseTable(
            form, unit, table[:, 0], matrices[:, :, 3], quaternions(matrices[:, :, :3])
        )
    return PoseTable(form, unit, table[:, 0], table[:, 1:4], table[:, 4:])


def quaternions(rotations: Reals) -> Reals:
    """Return rotation matrices (n, 3, 3) as unit quaternions qx, qy, qz, qw with qw >= 0, (n, 4).

    Bar-Itzhack (2000): the eigenvector of the largest eigenvalue of a symmetric 4x4 matrix, which
    is also right where the matrix is a rotation except for rounding.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.moveaxis(rotations, 0, 2)
    symmetric = np.stack(
        [
            np.stack([xx - yy - zz, xy + yx, xz + zx, zy - yz], axis=-1),
            np.stack([xy + yx, yy - xx - zz, yz + zy, xz - zx], axis=-1),
            np.stack([xz + zx, yz + zy, zz - xx - yy, yx - xy], axis=-1),
            np.stack([zy - yz, xz - zx, yx - xy, xx + yy + zz], axis=-1),
        ],
        axis=1,
    )
    found = np.linalg.eigh(symmetric)[1][:, :, -1]
    return np.where(found[:, 3:] < 0, -found, found)


def rotations(turns: Reals) -> Reals:
    """Return quaternions qx, qy, qz, qw (n, 4), of any length, as matrices (n, 3, 3)."""
    x, y, z, w = (turns / np.linalg.norm(turns, axis=1, keepdims=True)).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=1)


def _header(line: str) -> dict[str, int] | None:
    """Return the columns of t x y z qx qy qz qw by a header; None where it does not name all."""
    columns: dict[str, int] = {}
    names = line.strip().lstrip("#").split("," if "," in line else None)
    for index, name in enumerate(names):
        plain = re.sub(r"\[.*?\]|\(.*?\)", "", name).strip().lower()
        axis = plain[-1:]
        if not index or plain.startswith(("t ", "time", "stamp")):
            key = "t"
        elif axis in "xyzw" and re.search("q|rot|ori", plain):
            key = "q" + axis
        else:
            key = axis
        columns.setdefault(key, index)
    wanted = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
    return {key: columns[key] for key in wanted} if columns.keys() >= set(wanted) else None


def _form(row: Sequence[float], header: dict[str, int] | None) -> tuple[str, tuple[int, ...]]:
    """Return the form of a file by its first row, and the columns of t x y z qx qy qz qw."""
    if len(row) == 12:
        return "KITTI", ()
    if header is not None and max(header.values()) < len(row):
        order = tuple(header.values())
        return "EuRoC" if order == _EUROC else "TUM", order
    in_ns = len(row) == 8 and row[0] > _SINCE_1970["ns"] and float(row[0]).is_integer()
    # ORB-SLAM3 writes TUM's order with times in ns: the larger part of a turn is qw.
    if len(row) > 8 or (in_ns and abs(row[4]) > abs(row[7])):
        return "EuRoC", _EUROC
    return "TUM", _TUM


def _unit(form: str, time: float) -> str:
    if form == "EuRoC":
        return "ns"
    return next((unit for unit, least in _SINCE_1970.items() if abs(time) > least), "s")


def _numbers(words: Sequence[str]) -> list[float] | None:
    try:
        row = [float(word) for word in words]
    except ValueError:
        return None
    return row if all(abs(number) < _LARGEST for number in row) else None


def _pose(row: Sequence[float], form: str, order: Sequence[int], number: int) -> list[float] | None:
    """Return a row as time and what follows; None where it is no pose."""
    if form == "KITTI":
        if len(row) != 12:
            return None
        matrix = np.reshape(row, (3, 4))[:, :3]
        off = np.abs(matrix @ matrix.T - np.eye(3)).max()
        right_handed = np.linalg.det(matrix) > 0
        return [float(number), *row] if off <= _LENGTH_ERROR and right_handed else None
    if len(row) <= max(order) or (form == "TUM" and len(row) != 8):
        return None
    pose = [row[index] for index in order]
    return pose if abs(math.hypot(*pose[4:]) - 1) <= _LENGTH_ERROR else None
