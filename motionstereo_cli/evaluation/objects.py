"""Objects against the truth: found or not, false ones, changes of identity, and errors of speed.

Measures are those of CLEAR MOT: Bernardin and Stiefelhagen, "Evaluating Multiple Object Tracking
Performance" (2008). Files are tables of ``run`` and ``simulate``, or labels of KITTI's tracking
benchmark.
"""

from __future__ import annotations

import math
import os
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from motionstereo_cli.errors import InputError
from motionstereo_cli.evaluation.numbers import ratio
from motionstereo_cli.evaluation.settings import EvaluateSettings
from motionstereo_cli.files.reading import MAX_RESULT_BYTES, open_regular, read_text
from motionstereo_cli.robot.assignment import assignment
from motionstereo_cli.sinks.outputs import RECORD
from motionstereo_cli.sinks.read_back import Table, numbering_in, read_record, shortened
from motionstereo_cli.sinks.records import Counts

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Reals = NDArray[np.float64]

#: Columns that a table of objects has at least.
_COLUMNS = ("frame", "id", "x", "y", "width", "height")
#: Of a line of KITTI's tracking labels: fields, and of a result one more, its score.
_KITTI_FIELDS = (17, 18)
#: What it calls places where objects are not labelled.
_NOT_LABELLED = "DontCare"
#: A row that lies in such a place by this share of its box is not judged.
_INSIDE = 0.5


@dataclass(frozen=True, slots=True)
class ObjectBox:
    """An object in a frame.

    Attributes:
        frame: its number.
        id: which object it is.
        left, top, right, bottom: its box in px; right and bottom are just outside.
        depth_m, closing_mps, time_to_contact_s: as
            :class:`~motionstereo_cli.types.MovingObject` has them; NaN where unknown.
        over_ground_mps: speed over ground; NaN likewise.
        counts: False where it is not labelled or, in a truth, stands; what is found there is not
            judged.
    """

    frame: int
    id: str
    left: float
    top: float
    right: float
    bottom: float
    depth_m: float = math.nan
    closing_mps: float = math.nan
    time_to_contact_s: float = math.nan
    over_ground_mps: float = math.nan
    counts: bool = True


@dataclass(frozen=True, slots=True)
class ObjectReport:
    """What was measured. Shares, means and medians of nothing are NaN.

    Attributes:
        NOTHING: why a number is NaN.
        frames: those of the run that found them or, where its ``run.json`` does not lie beside the
            file, from the first one that either side has a row in to the last.
        true_boxes: rows of the truth that count.
        found: share of these that have a row.
        false_rows: rows that are no true object's, nor lie in or match a box that does not count.
        false_rows_a_frame: the same, a frame.
        switches: how often the id found for a true object became another one.
        mota: 1 - (missed + false + switches) / true boxes: multiple object tracking accuracy.
        motp: mean overlap of the boxes of what was found (intersection over union): precision.
        depth_error: median error of the depth as a share of the true one.
        closing_error_mps: median error of the closing speed.
        over_ground_error_mps: median error of the speed over ground, whose world may be another.
        contact_error: median error of the time to contact, as a share of the true one.
        with_speed: rows found whose closing speed is known on both sides.
    """

    NOTHING: ClassVar[str] = "both sides have no such number, or nothing was found"

    frames: int
    true_boxes: int
    found: float
    false_rows: int
    false_rows_a_frame: float
    switches: int
    mota: float
    motp: float
    depth_error: float
    closing_error_mps: float
    over_ground_error_mps: float
    contact_error: float
    with_speed: int


def is_objects(path: Path) -> bool:
    """Return whether a file's first line is one of objects, in either form.

    Raises:
        InputError: the file cannot be read.
    """
    line = _first_line(path)
    return _lacking(line) == [] or _is_label(line.split())


def _first_line(path: Path) -> str:
    try:
        with open_regular(path) as file:
            return file.readline(4096).decode(errors="replace").strip("\ufeff \r\n")
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error


def _lacking(line: str) -> list[str]:
    """Return the columns that a table of objects with this first line lacks."""
    columns = line.split(",")
    return [name for name in _COLUMNS if name not in columns]


def evaluate_objects(
    found: Path, true: Path, settings: EvaluateSettings | None = None
) -> ObjectReport:
    """Compare two files of objects of the same recording in the same view.

    Where a run.json lies beside what was found, only the frames that it had are compared.

    Raises:
        InputError: a file cannot be read as one, or neither has a row.
    """
    settings = settings or EvaluateSettings()
    mine, theirs = (read_objects(path, settings) for path in (found, true))
    record = found.parent / RECORD
    counts = read_record(record).counts if record.is_file() else None
    if not isinstance(counts, Counts):
        return compare(mine, theirs, settings)
    numbering = numbering_in(found.parent)
    seen = {numbering.of(frame) for frame in range(counts.written)}
    theirs = [box for box in theirs if box.frame in seen]
    return compare(mine, theirs, settings, counts.written)


def read_objects(path: Path, settings: EvaluateSettings) -> list[ObjectBox]:
    """Return the rows of a table of objects, or of KITTI's tracking labels.

    Frames of a run are numbered as the images of its recording are.

    Raises:
        InputError: it is neither, or a row cannot be understood.
    """
    if not is_objects(path):
        lacking = _lacking(_first_line(path))
        why = f", as it lacks {', '.join(lacking)}" if len(lacking) < len(_COLUMNS) else ""
        raise InputError(
            f"{path} has no objects{why}: give a table with the columns {', '.join(_COLUMNS)}, "
            "or labels of KITTI's tracking benchmark"
        )
    with open_regular(path) as file:
        is_table = b"," in file.readline(4096)
        if file.seek(0, os.SEEK_END) > MAX_RESULT_BYTES:
            raise InputError(
                f"{path} is larger than {MAX_RESULT_BYTES} bytes, the limit of tables of objects: "
                "evaluate parts of the recording, run with --start and --end"
            )
    if not is_table:
        return list(_of_labels(path, settings.label_rate))
    numbering = numbering_in(path.parent)
    return [replace(box, frame=numbering.of(box.frame)) for box in _of_table(path)]


#: Largest number of a frame and largest side of a box that are taken for true.
_MAX_FRAME, _MAX_PX = 10**9, 10**6


def _of_table(path: Path) -> Iterator[ObjectBox]:
    seen: set[tuple[int, str]] = set()
    for frame, row in Table(path):
        if not 0 <= frame <= _MAX_FRAME:
            raise InputError(f"{path}: {frame} is no frame of a recording: write it again")
        name = row.get("id", "")
        if (frame, name) in seen:
            raise InputError(f"{path}: object {name} comes twice in frame {frame}")
        seen.add((frame, name))
        for column in ("shadow", "by_itself"):
            if row.get(column, "") not in ("", "0", "1"):
                said = shortened(row[column])
                raise InputError(
                    f"{path}, frame {frame}: {column} is {said}: give 0, 1, or nothing"
                )
        if row.get("shadow") == "1":  # it says that this is no object
            continue

        def number(column: str, row: dict[str, str] = row, frame: int = frame) -> float:
            cell = row.get(column, "")
            if not cell:
                return math.nan
            try:
                value = float(cell)
            except ValueError:
                value = math.nan
            if not math.isfinite(value):
                raise InputError(
                    f"{path}, frame {frame}: {column} is {shortened(cell)}: give a number"
                )
            return value

        x, y, width, height = (number(column) for column in ("x", "y", "width", "height"))
        if not (math.isfinite(x + y) and 0 < width <= _MAX_PX and 0 < height <= _MAX_PX):
            raise InputError(
                f"{path}, frame {frame}: an object has no box: give x, y, width, height"
            )
        depth_m = number("depth_m")
        if depth_m < 0:
            raise InputError(f"{path}, frame {frame}: depth_m is {depth_m:g}: give 0 or more")
        yield ObjectBox(
            *(frame, name, x, y, x + width, y + height),
            *(depth_m, number("closing_mps"), number("time_to_contact_s")),
            number("over_ground_mps"),
            row.get("by_itself") != "0",
        )


def _is_label(fields: Sequence[str]) -> bool:
    if len(fields) not in _KITTI_FIELDS or not fields[2][:1].isalpha():
        return False
    try:
        return all(math.isfinite(float(each)) for each in (*fields[:2], *fields[3:]))
    except ValueError:
        return False


def _of_labels(path: Path, rate: float) -> Iterator[ObjectBox]:
    """Yield the rows of KITTI's labels; closing speeds follow from depths, a row before and after.

    Fields: frame, id, type, truncated, occluded, alpha, box (4), size (3), place (3), turn, score.
    """
    tracks: dict[str, dict[int, ObjectBox]] = defaultdict(dict)
    for at, line in enumerate(read_text(path, "the labels", MAX_RESULT_BYTES).splitlines(), 1):
        fields = line.split()
        if not fields:
            continue
        if not _is_label(fields):
            raise InputError(f"{path} line {at}: {shortened(line)} is no label of KITTI's tracking")
        left, top, right, bottom = map(float, fields[6:10])
        box = ObjectBox(int(float(fields[0])), fields[1], left, top, right, bottom)
        if fields[2] == _NOT_LABELLED:
            yield replace(box, counts=False)
            continue
        if box.frame in tracks[box.id]:
            raise InputError(f"{path} line {at}: object {box.id} comes twice in its frame")
        tracks[box.id][box.frame] = replace(box, depth_m=float(fields[15]))
    for track in tracks.values():
        for frame, box in track.items():
            first, last = (track.get(frame + step, box) for step in (-1, 1))
            closing = math.nan
            if last is not first:
                closing = (first.depth_m - last.depth_m) / (last.frame - first.frame) * rate
            contact = box.depth_m / closing if closing > 0 else math.nan
            yield replace(box, closing_mps=closing, time_to_contact_s=contact)


@dataclass(slots=True)
class _Sums:
    """What is counted frame by frame."""

    true: int = 0
    false: int = 0
    switches: int = 0
    overlaps: list[float] = field(default_factory=list)
    pairs: list[tuple[ObjectBox, ObjectBox]] = field(default_factory=list)


def compare(
    found: Iterable[ObjectBox],
    true: Iterable[ObjectBox],
    settings: EvaluateSettings | None = None,
    frames: int | None = None,
) -> ObjectReport:
    """Compare objects, each side in any order; see :class:`ObjectReport`.

    Args:
        found, true: the two sides.
        settings: what counts; the defaults if None.
        frames: how many there were; None if unknown.

    Raises:
        InputError: neither side has an object.
    """
    settings = settings or EvaluateSettings()
    least = settings.min_box_px
    mine, theirs = _by_frame(found), _by_frame(true)
    sums, last = _Sums(), dict[str, str]()
    for frame in sorted(mine.keys() | theirs.keys()):
        _judge(sums, last, mine.get(frame, []), theirs.get(frame, []), settings.min_overlap, least)
    numbers = mine.keys() | theirs.keys()
    if not numbers:
        raise InputError("neither file has an object: nothing can be compared")
    frames = frames or max(numbers) - min(numbers) + 1
    missed = sums.true - len(sums.pairs)
    depth, true_depth = _both(sums.pairs, "depth_m")
    closing, true_closing = _both(sums.pairs, "closing_mps")
    contact, true_contact = _both(sums.pairs, "time_to_contact_s")
    speed, true_speed = _both(sums.pairs, "over_ground_mps")
    return ObjectReport(
        frames=frames,
        true_boxes=sums.true,
        found=ratio(len(sums.pairs), sums.true),
        false_rows=sums.false,
        false_rows_a_frame=sums.false / frames,
        switches=sums.switches,
        mota=1 - ratio(missed + sums.false + sums.switches, sums.true),
        motp=float(np.mean(sums.overlaps)) if sums.overlaps else math.nan,
        depth_error=_median(np.abs(depth - true_depth) / true_depth),
        closing_error_mps=_median(np.abs(closing - true_closing)),
        over_ground_error_mps=_median(np.abs(speed - true_speed)),
        contact_error=_median(np.abs(contact - true_contact) / true_contact),
        with_speed=len(closing),
    )


def _judge(
    sums: _Sums,
    last: dict[str, str],
    found: Sequence[ObjectBox],
    true: Sequence[ObjectBox],
    min_overlap: float,
    min_box_px: float,
) -> None:
    """Add a frame to the sums; ``last`` has the id that was last found for each true object."""
    common, area, true_area = _areas(found, true)
    overlap = common / (area[:, None] + true_area - common)
    counts = np.array([box.counts for box in true], np.bool_) & (true_area >= min_box_px)
    sums.true += int(np.count_nonzero(counts))
    close = (overlap >= min_overlap) & counts
    # What was an object's before stays its, as long as their boxes overlap.
    same = np.array([[last.get(t.id) == f.id for t in true] for f in found]).reshape(close.shape)
    worth = np.where(close, overlap + 2.0 * same, 0.0)
    pairs = assignment(-worth) if worth.any() else []
    taken = {row: column for row, column in pairs if close[row, column]}
    for row, column in taken.items():
        sums.pairs.append((found[row], true[column]))
        sums.overlaps.append(float(overlap[row, column]))
        before = last.get(true[column].id, found[row].id)
        sums.switches += before != found[row].id
        last[true[column].id] = found[row].id
    excused = ((common > _INSIDE * area[:, None]) | (overlap >= min_overlap)) & ~counts
    sums.false += sum(row not in taken and not excused[row].any() for row in range(len(found)))


def _by_frame(boxes: Iterable[ObjectBox]) -> dict[int, list[ObjectBox]]:
    frames: dict[int, list[ObjectBox]] = defaultdict(list)
    for box in boxes:
        frames[box.frame].append(box)
    return frames


def _areas(found: Sequence[ObjectBox], true: Sequence[ObjectBox]) -> tuple[Reals, Reals, Reals]:
    """Return common areas (found, true), and those of either side."""
    one, other = (
        np.array([(b.left, b.top, b.right, b.bottom) for b in side], np.float64).reshape(-1, 4)
        for side in (found, true)
    )
    low = np.maximum(one[:, None, :2], other[None, :, :2])
    high = np.minimum(one[:, None, 2:], other[None, :, 2:])
    sizes = [np.prod(side[:, 2:] - side[:, :2], axis=1) for side in (one, other)]
    return np.prod(np.maximum(high - low, 0), axis=2), sizes[0], sizes[1]


def _both(pairs: Sequence[tuple[ObjectBox, ObjectBox]], name: str) -> tuple[Reals, Reals]:
    """Return a value of both sides, where both know it, (n,) each."""
    values = np.array([[getattr(box, name) for box in pair] for pair in pairs], np.float64)
    values = values.reshape(-1, 2)
    one, other = values[np.isfinite(values).all(axis=1)].T
    return one, other


def _median(values: Reals) -> float:
    return float(np.median(values)) if values.size else math.nan
