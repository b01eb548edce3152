"""Tables for plots: thinned to the resolution of a screen, extremes kept."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from motionstereo_cli.report.run_folder import FRAME_S, SteeringTable
from motionstereo_cli.sinks.read_back import shortened

if TYPE_CHECKING:
    from numpy.typing import NDArray

#: Maximum number of rows that are plotted without thinning: ten minutes at 30 frames a second.
MAX_ROWS = 20_000

#: Limits of time to contact in s between the colours of objects: soon, later, hardly.
SOON_S, LATER_S = 2.0, 5.0

#: Maximum number of objects on a page: those with the least time to contact.
MAX_OBJECTS = 24

#: An object with fewer rows was seen for too short a time to know how it moves: not on the page.
MIN_ROWS = 4

#: Times that objects are there, from a frame to another, that a page counts at most.
MAX_SPANS = 500_000


def kept_rows(
    series: Iterable[NDArray[np.float64]], codes: NDArray[np.int64], most: int = MAX_ROWS
) -> NDArray[np.intp]:
    """Return the numbers of the rows to plot, at most ``most`` if possible.

    The rows are divided evenly. Each part keeps the least, the greatest and the first unknown
    value of each series, and the first row of each code.

    Args:
        series: (n,) each; NaN = unknown.
        codes: (n,) categories from 0, each of which must stay visible.
        most: number of rows from which on they are thinned.
    """
    count = len(codes)
    if count <= most:
        return np.arange(count)
    columns = [np.asarray(values) for values in series]
    kinds = int(codes.max()) + 1
    parts = max(1, most // (3 * len(columns) + kinds))
    bounds = np.linspace(0, count, parts + 1).astype(np.intp)
    kept = {0, count - 1}
    for first, after in itertools.pairwise(bounds.tolist()):
        for values in columns:
            part = values[first:after]
            unknown = np.isnan(part)
            if unknown.any():
                kept.add(first + int(unknown.argmax()))
            if not unknown.all():
                kept.add(first + int(np.nanargmin(part)))
                kept.add(first + int(np.nanargmax(part)))
        kept.update((first + np.unique(codes[first:after], return_index=True)[1]).tolist())
    return np.array(sorted(kept), np.intp)


def plotted(steering: SteeringTable) -> dict[str, Any]:
    """Return the steering table for the plots, as JSON-able values."""
    names = list(dict.fromkeys(("ok", "held", "blind", *steering.status)))
    codes = np.array([names.index(status) for status in steering.status])
    kept = np.union1d(kept_rows(steering.series.values(), codes), [steering.best])
    return {
        "timed": steering.timed,
        "frameS": FRAME_S,
        "x": steering.places[kept].tolist(),
        "frame": None if len(kept) == len(steering) else steering.frames[kept].tolist(),
        "firstFrame": int(steering.frames[0]),
        "begin": int(np.searchsorted(kept, steering.best)),
        "statuses": names,
        "status": codes[kept].tolist(),
        "series": {name: _known(values[kept]) for name, values in steering.series.items()},
    }


def _known(values: NDArray[np.float64]) -> list[float | None]:
    return [None if np.isnan(value) else value for value in values.tolist()]


@dataclass
class PlottedTrack:
    """An object of a page; what is None is unknown.

    Attributes:
        id: its number.
        frame: its first frame.
        spans: each with its begin, its end, its urgency (0 contact soon, 1 later, 2 hardly or
            unknown) and what it was then (0 not moving by itself or unknown, 1 moving by itself, 2
            a shadow); begin and end are an x of the plots.
        frames: in how many frames it was.
        known, own, shadow: in how many of these it is known whether it moved by itself, in how many
            it did, and in how many it was marked as a shadow.
        contact, nearest: its least time to contact in s, and its least depth in m.
        closing: its greatest closing speed in m/s.
        speed, sigma, direction: its greatest speed over ground in m/s with its standard deviation,
            and its direction in rad then.
        confidence: its mean confidence, 0..1.
        contact_frame, nearest_frame: the frames of ``contact`` and ``nearest``.
    """

    id: int
    frame: int
    spans: list[list[float]] = field(default_factory=list)
    frames: int = 0
    known: int = 0
    own: int = 0
    shadow: int = 0
    contact: float | None = None
    nearest: float | None = None
    closing: float | None = None
    speed: float | None = None
    confidence: float | None = None
    contact_frame: int | None = None
    nearest_frame: int | None = None
    sigma: float | None = None
    direction: float | None = None

    def add(self, row: Mapping[str, str], begin: float, lasts: float) -> None:
        """Take in its row of a frame, which begins at an x of the plots and lasts so long there.

        Raises:
            ValueError: the row is damaged.
        """
        frame = int(row["frame"])
        contact, depth = _number(row, "time_to_contact_s"), _number(row, "depth_m")
        level = 2 if contact is None or contact > LATER_S else 1 if contact > SOON_S else 0
        kind = 2 if row.get("shadow") == "1" else int(row.get("by_itself") == "1")
        last = self.spans[-1] if self.spans else None
        if last and last[2:] == [level, kind] and begin - last[1] < lasts:
            last[1] = begin + lasts
        else:
            self.spans.append([begin, begin + lasts, level, kind])
        if contact is not None and (self.contact is None or contact < self.contact):
            self.contact, self.contact_frame = contact, frame
        if depth is not None and (self.nearest is None or depth < self.nearest):
            self.nearest, self.nearest_frame = depth, frame
        closing = _number(row, "closing_mps")
        if closing is not None and (self.closing is None or closing > self.closing):
            self.closing = closing
        speed = _number(row, "over_ground_mps")
        if speed is not None and (self.speed is None or speed > self.speed):
            self.speed, self.sigma = speed, _number(row, "sigma_mps")
            self.direction = _number(row, "direction_rad")
        self.frames += 1
        self.known += bool(row.get("by_itself"))
        self.own += kind == 1
        self.shadow += kind == 2
        if (sure := _number(row, "confidence")) is not None:
            mean = self.confidence or 0.0
            self.confidence = mean + (sure - mean) / self.frames

    @property
    def urgency(self) -> tuple[float, float]:
        """Sorts by least time to contact, then by longest presence."""
        stayed = sum(end - begin for begin, end, *_ in self.spans)
        return np.inf if self.contact is None else self.contact, -stayed


class PlottedTracks(NamedTuple):
    """The objects of a page.

    Attributes:
        shown: those to show, in the order of their first frames: :class:`PlottedTrack` as dicts.
        total: how many were seen long enough to know how they move.
        brief: how many were not.
    """

    shown: list[dict[str, Any]]
    total: int
    brief: int


def tracks(
    rows: Iterable[Mapping[str, str]], x_of: Mapping[int, float], frame_x: float
) -> PlottedTracks:
    """Return the objects to show, and how many there are.

    Args:
        rows: the table of moving objects.
        x_of: the x of each frame in the plots.
        frame_x: the duration of a frame there.

    Raises:
        ValueError: a row is damaged, or there are too many.
    """
    found: dict[int, PlottedTrack] = {}
    count = 0
    for row in rows:
        frame = int(row["frame"])
        if frame not in x_of:
            continue
        number = int(_number(row, "id") or 0)
        track = found.setdefault(number, PlottedTrack(number, frame))
        count -= len(track.spans)
        track.add(row, x_of[frame], frame_x)
        count += len(track.spans)
        if count > MAX_SPANS:
            raise ValueError(
                f"objects come more than {MAX_SPANS} times, the limit of a page: make pages of "
                "parts of the recording, run with --start and --end"
            )
    lasting = [track for track in found.values() if track.frames >= MIN_ROWS]
    shown = sorted(lasting, key=lambda track: track.urgency)[:MAX_OBJECTS]
    shown = sorted(shown, key=lambda track: (track.spans[0][0], track.id))
    return PlottedTracks([vars(track) for track in shown], len(lasting), len(found) - len(lasting))


def _number(row: Mapping[str, str], name: str) -> float | None:
    if not row.get(name):
        return None
    with contextlib.suppress(ValueError):
        if math.isfinite(value := float(row[name])):
            return value
    wrong = f"{name} of frame {row['frame']} is {shortened(row[name])}"
    raise ValueError(f"{wrong} and no number: write it again")
