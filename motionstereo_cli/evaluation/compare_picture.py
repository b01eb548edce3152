"""The picture of a comparison: the two images that differ most, and their difference."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.evaluation.compare import WorstImage, differing
from motionstereo_cli.files.encode import encode_png, remove_signed, signed
from motionstereo_cli.files.lettering import DARK, colour_key, titled
from motionstereo_cli.files.targets import write_output
from motionstereo_cli.sinks.drawing import coloured
from motionstereo_cli.sinks.legend import strip
from motionstereo_cli.sinks.outputs import RECORD
from motionstereo_cli.sinks.read_back import read_record
from motionstereo_cli.sinks.scale import ENDS, DepthScale

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.types import Real

_MIN_WIDTH_PX = 640

# RGB
_SAME, _OFF, _ACTUAL_ONLY, _GOLDEN_ONLY = (
    (90, 90, 90),
    (230, 40, 40),
    (250, 220, 60),
    (60, 190, 230),
)


#: What a picture of a comparison says of itself, so that a later one may remove it.
_PROGRAM = b"motionstereo compare"


def put_picture(
    path: Path, worst: WorstImage | None, golden: Path, inputs: Iterable[Path] = ()
) -> str:
    """Write the picture of a comparison; without a worst image remove that of an earlier one.

    Args:
        path: its PNG file.
        worst, golden: see :func:`draw_worst`.
        inputs: files and folders that are read.

    Returns:
        What was done, in words.

    Raises:
        OutputError: the file is an input, or cannot be written or removed.
    """
    if worst is not None:
        content = encode_png(draw_worst(worst, golden)[..., ::-1])
        write_output(path, signed(content, _PROGRAM), inputs)
        return f"{worst.name} differs most: {path}"
    removed = remove_signed(path, _PROGRAM)
    more = f"; {path} of an earlier comparison was removed" if removed else ""
    return f"no picture: no images differ{more}"


def draw_worst(worst: WorstImage, golden: Path | None = None) -> NDArray[np.uint8]:
    """Return a picture of actual, golden and their difference, with titles, scale and key.

    Depth has the colours of ``depth.mp4``.

    Args:
        worst: the images.
        golden: the folder whose record has the scale of ``depth.mp4``; without a record the scale
            fits the images.

    Returns:
        (height, width, 3) uint8 RGB.
    """
    actual, expected = worst.actual, worst.golden
    is_depth = worst.name.startswith("depth")
    scale = _recorded(golden, is_depth) or _scale_of(np.stack([actual, expected]), is_depth)
    panels = []
    for values in (actual, expected):
        px = np.float32(scale.px_m) / values if is_depth and scale.px_m else values + scale.doffs
        panels.append(coloured(px, replace(scale, doffs=0.0)))
    difference = np.zeros((*actual.shape, 3), np.uint8)
    difference[~np.isnan(actual) & ~np.isnan(expected)] = _SAME
    difference[differing(actual, expected, worst.tolerance)] = _OFF
    difference[~np.isnan(actual) & np.isnan(expected)] = _ACTUAL_ONLY
    difference[np.isnan(actual) & ~np.isnan(expected)] = _GOLDEN_ONLY

    titles = ("Actual", "Golden", f"Difference: {worst.share:.2%}")
    body = titled([*panels, difference], titles, DARK)
    widening = max(_MIN_WIDTH_PX - body.shape[1], 0)
    margin = np.full((len(body), widening, 3), DARK.ground, np.uint8)
    body = titled([np.concatenate([body, margin], axis=1)], [worst.name], DARK)
    entries = (
        (_SAME, "the same"),
        (_OFF, "off"),
        (_ACTUAL_ONLY, "known in actual only"),
        (_GOLDEN_ONLY, "known in golden only"),
        ((0, 0, 0), "unknown in both"),
    )
    width = body.shape[1]
    return np.concatenate([body, strip(width, scale), colour_key(width, entries, DARK)])


def _recorded(golden: Path | None, is_depth: bool) -> DepthScale | None:
    """Return the scale in a run's record, None without one."""
    if golden is not None:
        with contextlib.suppress(InputError, SettingsError):
            record = read_record(golden / RECORD)
            scale, said = DepthScale.recorded(record), record.values("output_settings")
            known = any(said.get(name) for name in ENDS)  # a run that shows no colours has none
            if known and (scale.px_m or not is_depth):
                return scale
    return None


def _scale_of(values: Real, is_depth: bool) -> DepthScale:
    """Return the scale that fits images."""
    known = values[~np.isnan(values)]
    if not len(known):
        return DepthScale(64)
    low, high = np.quantile(known, [0.01, 0.99]).tolist()
    near_px, far_px = (1 / low, 1 / high) if is_depth else (high, max(low, 1e-3))
    return DepthScale(max(near_px, 2 * far_px), far_px, 1.0 if is_depth else None)
