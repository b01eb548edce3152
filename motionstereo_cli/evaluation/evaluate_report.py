"""The report of an evaluation as CSV, JSON and a table, and a picture of the errors."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, fields

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.evaluation.evaluate import BAD_PX, FramePair, Report, Score
from motionstereo_cli.evaluation.numbers import cell, known
from motionstereo_cli.files.lettering import LIGHT, colour_key


def format_csv(report: Report) -> str:
    """Return the scores as RFC 4180 CSV, but with LF: one row for each frame, then one for all."""
    rows = [",".join(item.name for item in fields(Score))]
    for score in (*report.frames, report.overall):
        frame, *values = asdict(score).values()
        rows.append(",".join(["overall" if frame is None else str(frame), *map(cell, values)]))
    return "\n".join(rows) + "\n"


def format_json(report: Report) -> str:
    """Return the report as JSON; null = none."""
    content = {
        "overall": known(report.overall),
        "frames": [known(score) for score in report.frames],
        "only_out": report.only_out,
        "only_truth": report.only_truth,
    }
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def format_table(report: Report) -> str:
    """Return a table of all frames together and of the worst frame."""
    worst = report.worst
    rows = [("", f"{len(report.frames)} frames", f"worst: {worst.frame}")]
    for item in fields(Score)[1:]:
        overall, frame = (getattr(score, item.name) for score in (report.overall, worst))
        rows.append((item.name, _shown(overall), _shown(frame)))
    return "".join(f"{name:<13}{overall:>14}{frame:>14}\n" for name, overall, frame in rows)


_STEPS_BGR = (
    ("within 0.5 px", (149, 54, 49)),
    ("within 1 px", (209, 173, 116)),
    ("within 2 px", (144, 224, 254)),
    ("within 3 px", (67, 109, 244)),
    ("over 3 px", (38, 0, 165)),
)


_UNKNOWN_BGR = (0, 0, 0)


_NO_TRUTH_BGR = (64, 64, 64)


#: Narrower pictures are widened for their legend.
_MIN_WIDTH_PX = 120


def draw_errors(pair: FramePair) -> NDArray[np.uint8]:
    """Return a picture of the errors of the disparity, with a legend below.

    Blue is right and red is wrong, in steps of :data:`BAD_PX`; black = no result, dark grey
    = no truth or masked out.

    Returns:
        (height + legend, width, 3) uint8 BGR; widened where the legend needs it.
    """
    error_px = np.abs(pair.found_px - pair.truth_px)
    palette = np.array([bgr for _, bgr in _STEPS_BGR], np.uint8)
    picture = palette[np.searchsorted(BAD_PX, np.nan_to_num(error_px))]
    picture[np.isnan(pair.found_px)] = _UNKNOWN_BGR
    picture[np.isnan(pair.truth_px)] = _NO_TRUTH_BGR

    entries = (*_STEPS_BGR, ("unknown", _UNKNOWN_BGR), ("no truth", _NO_TRUTH_BGR))
    width = max(picture.shape[1], _MIN_WIDTH_PX)
    key = colour_key(width, [((r, g, b), text) for text, (b, g, r) in entries], LIGHT)
    widened = np.pad(picture, ((0, 0), (0, width - picture.shape[1]), (0, 0)), constant_values=255)
    return np.vstack([widened, key[..., ::-1]])


def _shown(value: float) -> str:
    if math.isnan(value):
        return "-"
    return str(value) if isinstance(value, int) else f"{value:.4f}"
