"""The page of a batch: one row for each recording, failures first."""

from __future__ import annotations

import contextlib
import csv
import io
import itertools
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.folders import spread
from motionstereo_cli.files.reading import read_text, real
from motionstereo_cli.files.records import typed
from motionstereo_cli.report import PAGE
from motionstereo_cli.report.pictures import Picture, address_of, poster
from motionstereo_cli.report.render import render
from motionstereo_cli.report.run_folder import Results, SteeringTable, read_results
from motionstereo_cli.report.series import kept_rows
from motionstereo_cli.sinks.records import Status
from motionstereo_cli.sinks.writers import cell_text

#: The table of a batch, in its output folder.
TABLE = "batch.csv"

#: The logs of its recordings, by name.
LOGS = ".batch/logs"

#: The statuses of a recording, worst first; unknown ones come before these.
STATUSES = ("failed", "lost", "damaged", "interrupted", "running", "waiting", "done")

#: Those of recordings that the same command goes on with.
OPEN = ("interrupted", "running", "waiting")

_MAX_BYTES = 64_000_000

#: Limit of recordings on a page, which takes a minute with so many.
_MAX_ROWS = 100_000

#: Maximum number of recordings with a picture and a plot; more would make the page too large.
_MAX_PICTURES = 400
_POSTER_PX, _PLOT_ROWS = 144, 160


@dataclass(frozen=True, slots=True)
class RecordingRow:
    """A row of the page.

    Attributes:
        status: its row of the table.
        rank: 0 for the worst status.
        wrong: why it failed, what was lost, and the warnings, in words; empty if nothing.
        address: of its own page or its folder; None if neither exists.
        log: address of its log; None if there is none.
        poster: a frame of its reference view.
        plot: its heading over time as points of a polyline in a box of 100 by 20; empty if unknown.
    """

    status: Status
    rank: int
    wrong: str
    address: str | None
    log: str | None
    poster: Picture | None
    plot: str


def batch_page(out: Path, page: Path) -> str:
    """Return the page of a batch, self-contained HTML.

    Args:
        out: the folder, with ``batch.csv`` and, by their names, the folders of the runs.
        page: path of the page; the addresses of the runs' pages are relative to it.

    Raises:
        InputError: the table cannot be read.
    """
    rows = sorted(_rows(out / TABLE), key=lambda row: (_rank(row.status), not row.warnings))
    recordings = [
        _recording(out, row, page, with_picture=index < _MAX_PICTURES)
        for index, row in enumerate(rows)
    ]
    counts = Counter(row.status for row in rows)
    return render(
        "batch.html",
        ("theme.js", "table.js"),
        name=real(out).name,
        recordings=recordings,
        counts=sorted(counts.items(), key=lambda item: _rank(item[0])),
        bad=sum(row.status != "done" and row.status not in OPEN for row in rows),
        unfinished=sum(row.status in OPEN for row in rows),
        warned=sum(bool(each.status.warnings) for each in recordings),
        frames=sum(each.status.frames for each in recordings),
        seconds=sum(each.status.seconds for each in recordings),
        statuses=STATUSES,
    )


def _rows(path: Path) -> list[Status]:
    try:
        text = read_text(path, "the table", _MAX_BYTES, within=path.parent)
        table = csv.DictReader(io.StringIO(text, newline=""), restval="")
        if not {"name", "status"} <= set(table.fieldnames or ()):
            raise InputError(f"{path} has no columns name and status: give a folder of batch")
        # An empty cell is unknown.
        rows = [
            {name: cell_text(cell) for name, cell in row.items() if name and cell}
            for row in itertools.islice(table, _MAX_ROWS + 1)
        ]
    except (OSError, csv.Error) as error:
        raise InputError(f"cannot read {path}: {error}") from error
    if len(rows) > _MAX_ROWS:
        raise InputError(
            f"{path} has more than {_MAX_ROWS} recordings, the limit of a page: process them in "
            "several batches"
        )
    return [
        typed(row, Status, f"{path} row {number}", strict=False)
        for number, row in enumerate(rows, 2)
    ]


def _rank(status: str) -> int:
    return STATUSES.index(status) if status in STATUSES else -1


def _recording(out: Path, row: Status, page: Path, *, with_picture: bool) -> RecordingRow:
    folder = out / row.name
    address, picture, plot = None, None, ""
    if _is_folder_in(out, folder):
        own = folder / PAGE
        address = address_of(own if own.is_file() else folder, page)
        if with_picture:
            with contextlib.suppress(InputError):  # a run that failed early has no results
                picture, plot = _shown(read_results(folder))
    log = out / LOGS / spread(row.name) / f"{row.name}.log"
    shown = address_of(log, page) if _lies_in(out, log) else None
    wrong = "; ".join(filter(None, (row.reason, row.said)))
    return RecordingRow(row, _rank(row.status), wrong, address, shown, picture, plot)


def _is_folder_in(out: Path, folder: Path) -> bool:
    """Return whether there is a folder, which no link leads out of ``out`` to."""
    return _lies_in(out, folder) and folder.is_dir()


def _lies_in(out: Path, path: Path) -> bool:
    try:
        return real(path).is_relative_to(real(out)) and path.exists()
    except (OSError, ValueError, RuntimeError):  # too long, a NUL, a circle of links
        return False


def _shown(run: Results) -> tuple[Picture | None, str]:
    """Return a frame of a run's view, and its heading over time."""
    steering = run.steering()
    if not steering:
        return None, ""
    when_s = float(steering.places[steering.best])
    view, _ = run.view()
    videos = [view, run.video("depth-video"), run.video("charge")]
    pictures = (poster(each, run.path, when_s, max_width=_POSTER_PX) for each in videos if each)
    return next(filter(None, pictures), None), _polyline(steering)


def _polyline(steering: SteeringTable) -> str:
    heading = steering.series["steer"]
    kept = kept_rows([heading], np.zeros(len(heading), np.int64), most=_PLOT_ROWS)
    known = kept[~np.isnan(heading[kept])]
    x = 100 * known / max(len(heading) - 1, 1)
    y = 10 - 9.5 * np.clip(heading[known], -1, 1)
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x.tolist(), y.tolist(), strict=True))
