"""Files of poses in the formats of other programs, as tables.

Columns are those that a header names. Without a header the number of columns determines the
format, and assumptions are given as notes.
"""

from __future__ import annotations

import array
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.reading import as_text, read_head, read_lines
from motionstereo_cli.rig.pose_header import BEGINNING, Header, foreign, read_header

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Reals = NDArray[np.float64]

#: Limit of poses, which keeps them in some hundred MB: 9 hours at 30 in a second.
_MAX_POSES = 1_000_000

#: Limit of numbers, so that their differences are finite.
_LARGEST = 1e100

#: Tolerance of a quaternion's length, and of a rotation matrix times its transpose: files have few
#: decimals.
_LENGTH_ERROR = 0.01

#: The columns that a pose with a quaternion needs, beside its time.
_PLACE, _TURN = ("x", "y", "z"), ("qx", "qy", "qz", "qw")

#: Larger times since 1970 are in ns, us, ms: in s they would be 3,000 years and more.
_SINCE_1970 = {"ns": 1e17, "us": 1e14, "ms": 1e11}

#: Numbers of columns of matrices, and whether a time or number precedes the matrix.
_MATRICES = {12: False, 13: True, 16: False, 17: True}

#: A robot mostly moves in one direction in its own frame. An order of qx qy qz qw for which this
#: holds by so much more is the likelier one.
_STEADIER = 0.25

_HOW_TO_NAME = "a first line like '# t x y z qw qx qy qz' says which column is which"


@dataclass(frozen=True, slots=True)
class PoseTable:
    """The poses of a file.

    Attributes:
        frame: the frame of the poses, one of --pose-frame's choices, by the format of the file;
            None if that does not tell.
        unit: unit of the times: s, ms, us, ns, or ``frames``; by header, format and size.
        times: (n,) float64, rising; numbers from 0 if the file has none.
        places: (n, 3) float64 m.
        turns: (n, 4) float64 unit quaternions qx, qy, qz, qw.
        notes: what was assumed, one line each.
    """

    frame: str | None
    unit: str
    times: Reals
    places: Reals
    turns: Reals
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _Form:
    """The format of a file's rows.

    Attributes:
        columns: of t, x, y, z, qx, qy, qz, qw, and nsec if the time is in two parts.
        matrix: first column of a matrix [R t] in place of x to qw; None if there is none.
        wanted: the content that a line has to have, for messages.
        frame, unit: as in :class:`PoseTable`; unit is None if the size of the times tells.
        notes: as in :class:`PoseTable`.
        guessed: whether the order of the quaternion is a guess.
    """

    columns: Mapping[str, int]
    wanted: str
    matrix: int | None = None
    frame: str | None = "robot"
    unit: str | None = None
    notes: tuple[str, ...] = ()
    guessed: bool = False


def read_pose_table(path: str | Path) -> PoseTable:
    """Read a file of poses; empty lines and lines that begin with # are skipped.

    Numbers are separated by spaces, commas, tabs or semicolons. Where a header names time, x, y, z,
    qx, qy, qz and qw, these are the columns. Otherwise a line is ``t x y z qx qy qz qw`` (TUM),
    the same without t (TartanAir), ``t x y z qw qx qy qz`` and further columns if times are in
    ns (EuRoC), or a matrix: the three rows of [R t] (KITTI) or four, with or without a time or a
    number before them.

    Raises:
        InputError: the file cannot be read, has no poses, has a format that is not read (which is
            named), or a line (which is named) is not a pose, or earlier than the one before.
    """
    if (other := foreign(as_text(read_head(path, BEGINNING)))) is not None:
        raise InputError(f"{path} {other}")
    rows, row = array.array("d"), list[float]()
    header: Header | None = None
    form: _Form | None = None
    count = repeated = lost = 0
    lines = (line for each in read_lines(path, "the poses") for line in each.splitlines())
    for number, line in enumerate(lines, 1):
        words = _words(line, header)
        if not words:
            continue
        if form is None and len(words) == 12 and _is_lost(words):
            lost += 1
            continue
        if line.lstrip()[:1] in "#%" or (not count and words[0][:1].isalpha() and form is None):
            found = read_header(line)
            header = found if header is None or header.problem else header
            # A row may begin with a name, as AirSim's do.
            if header is found or line.lstrip()[:1] in "#%":
                continue
        form = form or _form(path, number, line, words, header)
        if form.matrix is not None and _is_lost(words[form.matrix :]):
            lost += 1
            continue
        last, row = row, _row(words, form, count + lost)
        if not row:
            raise InputError(
                f"{path} line {number}: {line.strip()[:60]!r} is not a pose: give {form.wanted}"
            )
        if last and row[0] < last[0]:
            raise InputError(
                f"{path} line {number}: time {row[0]:.12g} does not come after "
                f"{last[0]:.12g}: sort the poses by time"
            )
        if last and row[0] == last[0]:
            repeated += 1
            continue
        if count == _MAX_POSES:
            raise InputError(
                f"{path} has more than {_MAX_POSES} poses: give those of the recording alone"
            )
        rows.extend(row)
        count += 1
    if not count or form is None:
        raise InputError(f"{path} has no poses: give lines of t x y z qx qy qz qw")
    return _table(str(path), np.reshape(rows, (count, -1)), form, repeated)


def _table(path: str, rows: Reals, form: _Form, repeated: int) -> PoseTable:
    times, notes = rows[:, 0], form.notes
    if repeated:
        notes += (
            f"{path} has {repeated} pose{'s' if repeated > 1 else ''} with the time of the one "
            "before: the first of each time is taken",
        )
    unit = form.unit or next((u for u, least in _SINCE_1970.items() if times[0] > least), "s")
    if form.unit is None and form.frame == "body" and (times == np.rint(times)).all():
        unit = "ns"  # as EuRoC has them, also from 0
    if form.matrix is not None:
        matrices = rows[:, 1:].reshape(-1, 3, 4)
        places, turns = matrices[:, :, 3], quaternions(matrices[:, :, :3])
    else:
        places, turns = rows[:, 1:4], rows[:, 4:]
        if form.guessed:
            notes += _likelier_order(path, places, turns, form.wanted)
    return PoseTable(form.frame, unit, times, places, turns, notes)


def _words(line: str, header: Header | None) -> list[str]:
    """Return the columns of a line; empty ones count if the header is separated by commas."""
    if header is not None and header.separator and header.separator in line:
        return [word.strip() for word in line.strip().split(header.separator)]
    return [word for word in re.split(r"[\s,;]+", line.strip()) if word]


def _form(
    path: str | Path, number: int, line: str, words: Sequence[str], header: Header | None
) -> _Form:
    """Return the format of a file by its header, or by its first row.

    Raises:
        InputError: there is no such format.
    """
    where = f"{path} line {number}: {line.strip()[:60]!r}"
    if header is not None and header.problem:
        raise InputError(f"{path} {header.problem}")
    if header is not None:
        if max(header.columns.values()) >= len(words):
            raise InputError(
                f"{where} has {len(words)} columns, fewer than the header names: correct the header"
            )
        order = sorted(header.columns, key=lambda key: header.columns[key])
        wanted = f"{' '.join(order)}, as the header says, with a unit quaternion"
        return _Form(header.columns, wanted, None, header.frame, header.unit)
    row = _numbers(words)
    if row is None or len(row) < 7:
        raise InputError(
            f"{where} is not a pose: give t x y z qx qy qz qw, in s and m and with a unit "
            "quaternion, or 12 numbers, the rows of [R t]"
        )
    if len(row) in _MATRICES and (found := _matrix_form(str(path), row)) is not None:
        return found
    return _quaternion_form(str(path), row, "," in line)


def _matrix_form(path: str, row: Sequence[float]) -> _Form | None:
    """Return the format of a row with a matrix [R t]; None if it has none."""
    timed = _MATRICES[len(row)]
    if len(row) != 12 and not _is_rigid(row[timed:]):
        return None
    first = "the time or number of an image and " if timed else ""
    wanted = f"{first}{len(row) - timed} numbers, the rows of [R t]"
    columns = {"t": 0} if timed else {}
    unit = None if timed and not _is_count(row[0]) else "frames"
    frame = "optical" if len(row) == 12 else None
    notes = tuple[str, ...]()
    if timed and unit == "frames":
        notes = (
            f"{path}: the first of {len(row)} columns is taken for the number of the image, from "
            "0: if it is a time, give --pose-time-unit",
        )
    return _Form(columns, wanted, int(timed), frame, unit, notes)


def _quaternion_form(path: str, row: Sequence[float], commas: bool) -> _Form:
    """Return the format of a row without a header, with a note on the assumptions."""
    count = len(row)
    if count == 7:
        return _Form(
            _columns(0, "xyzw"),
            "x y z qx qy qz qw, in m and with a unit quaternion",
            None,
            "ned",
            "frames",
            (
                f"{path} has 7 columns and no header: they are taken for TartanAir's x y z qx qy "
                "qz qw, line n for image n, of the left camera in --pose-frame ned; "
                f"{_HOW_TO_NAME}",
            ),
            guessed=True,
        )
    in_ns = row[0] > _SINCE_1970["ns"] and float(row[0]).is_integer()
    # ORB-SLAM3 writes TUM's order with times in ns: the larger part of a turn is qw.
    first = in_ns and (count > 8 or abs(row[4]) > abs(row[7]))
    order = "qw qx qy qz" if first else "qx qy qz qw"
    notes = tuple[str, ...]()
    if in_ns or commas or count > 8:
        notes = (
            f"{path} has {count} columns and no header: they are taken for t x y z {order}"
            f"{' and others' if count > 8 else ''}; {_HOW_TO_NAME}",
        )
    return _Form(
        {"t": 0, **_columns(1, "wxyz" if first else "xyzw")},
        f"t x y z {order}, in s and m and with a unit quaternion",
        None,
        "body" if first else "robot",
        "ns" if in_ns else None,
        notes,
        guessed=True,
    )


def _columns(first: int, order: str) -> dict[str, int]:
    places = {axis: first + index for index, axis in enumerate(_PLACE)}
    return places | {"q" + axis: first + 3 + index for index, axis in enumerate(order)}


def _likelier_order(path: str, places: Reals, turns: Reals, wanted: str) -> tuple[str, ...]:
    """Return a note if a robot moves more steadily with qw at the other end."""
    qw_first = wanted.startswith("t x y z qw")
    others = turns[:, [3, 0, 1, 2]] if qw_first else turns[:, [1, 2, 3, 0]]
    if _steadiness(places, others) < _steadiness(places, turns) + _STEADIER:
        return ()
    return (
        f"{path}: by how the poses move, qw is likely the {'last' if qw_first else 'first'} of the "
        f"four numbers of a quaternion: {_HOW_TO_NAME}",
    )


def _steadiness(places: Reals, turns: Reals) -> float:
    """Return how similar the directions of motion are in the frames of the poses: 0..1."""
    steps = np.diff(places, axis=0)
    length = float(np.linalg.norm(steps, axis=1).sum())
    if not length:
        return 0.0
    seen = np.einsum("nji,nj->ni", rotations(turns[:-1]), steps)
    return float(np.linalg.norm(seen.sum(axis=0))) / length


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


def _row(words: Sequence[str], form: _Form, count: int) -> list[float]:
    """Return a row as time and pose; empty if it is not a pose."""
    columns = form.columns
    if form.matrix is not None:
        row = _numbers(words)
        if row is None or len(row) not in _MATRICES or not _is_rigid(row[form.matrix :]):
            return []
        return [row[0] if "t" in columns else float(count), *row[form.matrix :][:12]]
    if len(words) <= max(columns.values()):
        return []
    row = _numbers([words[columns[key]] for key in (*_PLACE, *_TURN)])
    times = _numbers([words[columns[key]] for key in ("t", "nsec") if key in columns])
    if row is None or times is None or abs(np.linalg.norm(row[3:]) - 1) > _LENGTH_ERROR:
        return []
    time = times[0] + sum(times[1:]) * 1e-9 if times else float(count)
    return [time, *row]


def _is_lost(words: Sequence[str]) -> bool:
    """Return whether a matrix is nothing but NaN: the form of KITTI has no other word for it."""
    return bool(words) and all(word.lower() == "nan" for word in words)


def _is_rigid(numbers: Sequence[float]) -> bool:
    """Return whether 12 or 16 numbers are the rows of a rotation and a place."""
    if len(numbers) not in (12, 16) or (len(numbers) == 16 and list(numbers[12:]) != [0, 0, 0, 1]):
        return False
    matrix = np.reshape(numbers[:12], (3, 4))[:, :3]
    off = np.abs(matrix @ matrix.T - np.eye(3)).max()
    return bool(off <= _LENGTH_ERROR and np.linalg.det(matrix) > 0)


def _is_count(number: float) -> bool:
    return float(number).is_integer() and 0 <= number < 1e7


def _numbers(words: Sequence[str]) -> list[float] | None:
    try:
        row = [float(word) for word in words]
    except ValueError:
        return None
    return row if all(abs(number) < _LARGEST for number in row) else None
