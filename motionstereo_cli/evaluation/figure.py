"""The paper's figures 2 and 3: some frames of a stereo stream, stage by stage, on one sheet."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.lettering import Label, fitted, lettered, text_width
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.pipeline import process
from motionstereo_cli.types import FrameResult, StereoFrame

if TYPE_CHECKING:
    from motionstereo_cli.types import Grey, Real

COLUMNS = ("(a) {} image", "(b) bands", "(c) {} memory", "(d) {}, near = bright")

_GAP_PX = 4
_HEAD_PX = 24
_SIDE_PX = 56
_TEXT_PX = 14

#: Brightness of the farthest depth, brighter than the black of unknown.
_FARTHEST = 40


def draw_figure(
    frames: Iterable[StereoFrame],
    numbers: Sequence[int],
    settings: Settings,
    *,
    in_metres: bool = False,
) -> Grey:
    """Return a sheet with one row for each numbered frame, (height, width) uint8.

    The columns are the reference camera's image (the right one's), its bands and permanency
    memory, and depth as brightness, in proportion to disparity, on one scale for the whole sheet.

    Args:
        frames: the stereo stream from its first frame; read up to the last number.
        numbers: numbers of the frames to show, from 0, in the order of the rows.
        settings: parameters of the processing.
        in_metres: whether there is a rig; without one the last column is called disparity.

    Raises:
        InputError: the stream ends before the last of the numbers.
    """
    shown: dict[int, FrameResult] = {}
    last = -1
    for result in process(frames, settings):
        last = result.frame.index
        if last in numbers:
            shown[last] = result
        if last == max(numbers):
            break
    if last < max(numbers):
        raise InputError(f"there is no frame {max(numbers)}: the recording ends with {last}")
    nearest = max(_nearest(result.disparity_px) for result in shown.values())
    return _sheet(
        titles_of(settings.reference, in_metres=in_metres),
        [(str(n), _row(shown[n], settings, nearest)) for n in numbers],
    )


def titles_of(reference: str, *, in_metres: bool) -> list[str]:
    """Return the titles of the columns."""
    names = (reference, "", reference, "depth" if in_metres else "disparity")
    return [title.format(name) for title, name in zip(COLUMNS, names, strict=True)]


def _nearest(disparity_px: Real) -> float:
    """Return the largest disparity, outliers excluded, at least 1 px."""
    known = disparity_px[~np.isnan(disparity_px)]
    return max(1.0, float(np.quantile(known, 0.99))) if len(known) else 1.0


def _row(result: FrameResult, settings: Settings, nearest_px: float) -> Grey:
    depth = _FARTHEST + (255 - _FARTHEST) * np.minimum(result.disparity_px / nearest_px, 1)
    panels = (
        getattr(result.frame, settings.reference),
        (result.bands.astype(np.uint16) - 1) * 255 // (settings.bands - 1),
        result.charge,
        np.nan_to_num(depth),
    )
    return np.hstack([_framed(panel.astype(np.uint8)) for panel in panels])


def _framed(panel: Grey) -> Grey:
    return np.pad(fitted(panel), _GAP_PX // 2, constant_values=255)


def _sheet(titles: Sequence[str], rows: Sequence[tuple[str, Grey]]) -> Grey:
    height, width = rows[0][1].shape
    sheet = np.full((_HEAD_PX + len(rows) * height, _SIDE_PX + width), 255, np.uint8)
    lefts = (_SIDE_PX + column * width // len(titles) for column in range(len(titles)))
    room = (width / len(titles) - 2 * _GAP_PX) / max(text_width(each, _TEXT_PX) for each in titles)
    size_px = int(_TEXT_PX * min(room, 1))
    labels = [
        Label(left + _GAP_PX, _HEAD_PX / 2, title)
        for left, title in zip(lefts, titles, strict=True)
    ]
    for index, (label, row) in enumerate(rows):
        top = _HEAD_PX + index * height
        sheet[top : top + height, _SIDE_PX:] = row
        labels.append(Label(_GAP_PX, top + height / 2, label))
    return lettered(np.stack([sheet] * 3, axis=-1), labels, size_px=size_px, colour=(0, 0, 0))[
        ..., 0
    ]
