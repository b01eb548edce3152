"""Tables for plots: thinned to the resolution of a screen, extremes kept."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Iterable, Mapping
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


class PlottedTracks(NamedTuple):
    """The objects of a page.

    Attributes:
        shown: those to show, see :func:`tracks`.
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

    Returns:
        For each object, in the order of their first frames: ``id``; its first ``frame``; ``spans``,
        each with its begin, its end, its urgency (0 contact soon, 1 later, 2 hardly or unknown) and
        what it was then (0 not moving by itself or unknown, 1 moving by itself, 2 a shadow); the
        least ``contact`` in s, ``nearest`` in m, each with its ``contact_frame`` or
        ``nearest_frame``, and most ``closing`` in m/s; in how many
        ``frames`` it was, in how many of these it is ``known`` whether it moved by itself, in how
        many it did (``own``), and in how many it was marked as a ``shadow``; its mean
        ``confidence``, and its greatest ``speed`` over ground in m/s with its ``sigma``, and its
        ``direction`` in rad then; None if unknown.

    Raises:
        ValueError: a row is damaged, or there are too many.
    """
    found: dict[int, dict[str, Any]] = {}
    count = 0
    for row in rows:
        frame = int(row["frame"])
        if frame not in x_of:
            continue
        number = int(_number(row, "id") or 0)
        contact, depth, closing = (
            _number(row, name) for name in ("time_to_contact_s", "depth_m", "closing_mps")
        )
        level = 2 if contact is None or contact > LATER_S else 1 if contact > SOON_S else 0
        is_shadow = row.get("shadow") == "1"
        kind = level, 2 if is_shadow else int(row.get("by_itself") == "1")
        begin, end = x_of[frame], x_of[frame] + frame_x
        track = found.setdefault(
            number,
            {"id": number, "frame": frame, "spans": []}
            | dict.fromkeys(("frames", "known", "own", "shadow"), 0)
            | dict.fromkeys(("contact", "nearest", "closing", "speed", "confidence"))
            | dict.fromkeys(("contact_frame", "nearest_frame", "sigma", "direction")),
        )
        spans = track["spans"]
        if spans and (*spans[-1][2:],) == kind and begin - spans[-1][1] < frame_x:
            spans[-1][1] = end
        else:
            spans.append([begin, end, *kind])
            count += 1
            if count > MAX_SPANS:
                raise ValueError(
                    f"objects come more than {MAX_SPANS} times, the limit of a page: make pages of "
                    "parts of the recording, run with --start and --end"
                )
        for name, value in (("contact", contact), ("nearest", depth)):
            if value is not None and (track[name] is None or value < track[name]):
                track[name], track[f"{name}_frame"] = value, frame
        track["closing"] = _most(track["closing"], closing)
        track["frames"] += 1
        track["known"] += bool(row.get("by_itself"))
        track["own"] += kind[1] == 1
        track["shadow"] += is_shadow
        speed = _number(row, "over_ground_mps")
        if speed is not None and (track["speed"] is None or speed > track["speed"]):
            track["speed"], track["sigma"] = speed, _number(row, "sigma_mps")
            track["direction"] = _number(row, "direction_rad")
        if (sure := _number(row, "confidence")) is not None:
            mean = track["confidence"] or 0.0
            track["confidence"] = mean + (sure - mean) / track["frames"]
    lasting = [track for track in found.values() if track["frames"] >= MIN_ROWS]
    shown = sorted(lasting, key=_urgency)[:MAX_OBJECTS]
    shown = sorted(shown, key=lambda track: (track["spans"][0][0], track["id"]))
    return PlottedTracks(shown, len(lasting), len(found) - len(lasting))


def _number(row: Mapping[str, str], name: str) -> float | None:
    if not row.get(name):
        return None
    with contextlib.suppress(ValueError):
        if math.isfinite(value := float(row[name])):
            return value
    wrong = f"{name} of frame {row['frame']} is {shortened(row[name])}"
    raise ValueError(f"{wrong} and no number: write it again")


def _urgency(track: Mapping[str, Any]) -> tuple[float, float]:
    """Sort by least time to contact, then by longest presence."""
    stayed = sum(end - begin for begin, end, *_ in track["spans"])
    return np.inf if track["contact"] is None else track["contact"], -stayed


def _most(one: float | None, other: float | None) -> float | None:
    return max((each for each in (one, other) if each is not None), default=None)
