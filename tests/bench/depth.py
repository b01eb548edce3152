"""How good disparity is as a run gives it: ``python -m bench accuracy --hard`` and ``--held-out``.

Clips of each kind of scene are rendered, encoded and decoded, and run through the whole pipeline,
the average in time included. All contestants are scored on the same pixels of the last frames.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from bench.clips import recorded
from bench.markdown import table
from motionstereo_cli.evaluation.evaluate import FramePair, Tally, tally
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.pipeline import process
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.sources import open_stereo

if TYPE_CHECKING:
    from numpy.typing import NDArray

#: Seeds to choose values by, and seeds that no value is chosen by.
SEEDS, HELD_OUT_SEEDS = (0, 1, 2), (101, 102, 103)

#: Frames of a clip, of which the last ones are scored: by then memories and averages are full.
FRAMES, SCORED = 26, 3

NOISE = 1.5

_CORRIDOR: dict[str, Any] = {"scene": "corridor"}
_LAYERS: dict[str, Any] = {"scene": "layers"}
_PANNING = _LAYERS | {"pan": True}
_STREET: dict[str, Any] = {"scene": "street"}

#: By kind of scene: first frame and values of each clip; the clips have a seed each.
KINDS: dict[str, Sequence[tuple[int, dict[str, Any]]]] = {
    "corridor": [
        (250, _CORRIDOR),
        (20, _CORRIDOR | {"corridor_width_m": 2.5, "corridor_length_m": 16.0}),
        (140, _CORRIDOR | {"corridor_width_m": 3.5}),
    ],
    "turn": [(334, _CORRIDOR), (212, _CORRIDOR)],
    "wide turn": [(84, _CORRIDOR | {"corridor_width_m": 4.8})],
    "cards": [(10, {"scene": "cards"}), (40, {"scene": "cards"})],
    "cards panning": [(frame, {"scene": "cards", "pan": True}) for frame in (10, 40)],
    "layers": [(frame, _LAYERS) for frame in (0, 10, 20)],
    "layers panning": [(frame, _PANNING) for frame in (0, 10, 20)],
    "left camera brighter": [(10, _PANNING | {"left_gain": 1.1, "left_offset": 8})],
    "flickering light": [(10, _PANNING | {"flicker": 0.1})],
    "motion blur": [(10, _PANNING | {"shutter": 0.8})],
    "JPEG quality 30": [(10, _PANNING | {"jpeg_quality": 30})],
    "H.264 crf 32": [(frame, _PANNING | {"crf": 32}) for frame in (0, 10, 20)],
    "street": [
        (0, _STREET),
        (10, _STREET),
        (0, _STREET | {"street_winding_deg": 35.0}),
        (10, _STREET | {"street_winding_deg": 35.0}),
    ],
}
#: Stands for all clips together, each with the same weight.
MEAN = "mean"

#: By name; ours is the first.
CONTESTANTS = {
    "motionstereo": Settings(),
    "StereoSGBM": Settings(matcher="sgbm"),
    "StereoBM": Settings(matcher="bm"),
    "preset fast": Settings.preset("fast"),
    "preset paper": Settings.preset("paper"),
}
OURS = "motionstereo"

#: Pixels scored, by the default's memory: with charge, and moved in this frame.
PIXELS = ("charged", "moved")

#: Measures besides those of ``evaluate``: shares of the errors within one and two sigma, of the
#: values at the limit of the range, and of each tenth of a px among the fractions of disparities.
SIGMA = ("sigma_1", "sigma_2")
LIMIT = "at_limit"
FRACTIONS = tuple(f"fraction_0_{tenth}" for tenth in range(10))
EXTRAS = (*SIGMA, LIMIT, *FRACTIONS)

#: So near to the limit of the range, in px, a value is at the limit.
_AT_LIMIT_PX = 0.5


class Found(NamedTuple):
    """What a contestant found in a frame, and what is to be scored, (height, width) each.

    Attributes:
        disparity_px: float32, NaN = unknown.
        sigma_px: its standard deviation as promised, likewise.
        masks: pixels by name, see :data:`PIXELS`, bool.
    """

    disparity_px: NDArray[np.float32]
    sigma_px: NDArray[np.float32]
    masks: dict[str, NDArray[np.bool_]]


def measure(
    kinds: Sequence[str], seeds: Sequence[int], *, width: int = 480
) -> Iterator[tuple[str, dict[str, float]]]:
    """Yield, for each kind of scene, ``pixels | contestant | measure`` and its figure.

    Args:
        kinds: names in :data:`KINDS`; the last one yielded is :data:`MEAN`.
        seeds: of the clips, in turn.
        width: of the images in px; the height is two thirds of it.
    """
    sums: list[dict[str, float]] = []
    for kind in kinds:
        clips = [
            _score(_settings(first, values, seeds[index % len(seeds)], width))
            for index, (first, values) in enumerate(KINDS[kind])
        ]
        sums += clips
        yield kind, _mean(clips)
    yield MEAN, _mean(sums)


def _settings(first: int, values: Mapping[str, Any], seed: int, width: int) -> SimulateSettings:
    size: dict[str, Any] = {"width": width, "height": width * 2 // 3, "noise_sigma": NOISE}
    return SimulateSettings(**size, seed=seed, frames=f"{first}:{first + FRAMES}", **values)


def _mean(clips: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return the mean of each figure over the clips that have it."""
    result = {}
    for key in clips[0]:
        known = [clip[key] for clip in clips if not math.isnan(clip[key])]
        result[key] = sum(known) / len(known) if known else math.nan
    return result


def _score(scene: SimulateSettings) -> dict[str, float]:
    with TemporaryDirectory() as folder:
        left, right = Path(folder, "left.mp4"), Path(folder, "right.mp4")
        truth = [shot.disparity_px for shot in recorded(scene, left, right)][-SCORED:]
        figures: dict[str, float] = {}
        masks: list[dict[str, NDArray[np.bool_]]] = []
        for name, settings in CONTESTANTS.items():
            found = list(_found(left, right, settings))[-SCORED:]
            masks = masks or [each.masks for each in found]
            for pixels in PIXELS:
                chosen = [each[pixels] for each in masks]
                for measure_name, value in _figures(found, truth, chosen, settings).items():
                    figures[f"{pixels} | {name} | {measure_name}"] = value
    return figures


def _found(left: Path, right: Path, settings: Settings) -> Iterator[Found]:
    with open_stereo(left, right) as source:
        for result in process(source, settings, with_objects=False, extras={"sigma_px"}):
            assert result.sigma_px is not None
            masks = {"charged": result.charge > settings.charge_min, "moved": result.motion}
            yield Found(result.disparity_px, result.sigma_px, masks)


def _figures(
    found: Sequence[Found],
    truth: Sequence[NDArray[np.float32]],
    masks: Sequence[NDArray[np.bool_]],
    settings: Settings,
) -> dict[str, float]:
    """Return the figures of one contestant on one kind of pixels."""
    total: Tally | None = None
    before: FramePair | None = None
    errors, sigmas, values = [], [], []
    for one, truth_px, mask in zip(found, truth, masks, strict=True):
        pair = FramePair(one.disparity_px, np.where(mask, truth_px, np.float32(np.nan)))
        sums = tally(pair, before)
        total, before = sums if total is None else total + sums, pair
        known = mask & ~np.isnan(one.disparity_px)
        errors.append(np.abs(one.disparity_px - truth_px)[known])
        sigmas.append(one.sigma_px[known])
        values.append(one.disparity_px[known])
    assert total is not None
    score = asdict(total.score())
    figures = {name: float(value) for name, value in score.items() if value is not None}
    error_px, sigma_px, value_px = (np.concatenate(each) for each in (errors, sigmas, values))
    stated = ~np.isnan(sigma_px)
    for name, times in zip(SIGMA, (1, 2), strict=True):
        figures[name] = _share(error_px[stated] <= times * sigma_px[stated])
    figures[LIMIT] = _share(value_px > settings.max_disparity - _AT_LIMIT_PX)
    tenths = np.floor(value_px * 10).astype(int) % 10
    figures |= {name: _share(tenths == tenth) for tenth, name in enumerate(FRACTIONS)}
    return figures


def _share(mask: NDArray[np.bool_]) -> float:
    return float(mask.mean()) if mask.size else math.nan


def main(seeds: Sequence[int], path: Path | None, *, quick: bool) -> None:
    """Measure, and print tables as Markdown, each row as soon as it is known.

    Args:
        seeds: of the clips.
        path: of a JSON file that gets all figures; None for none.
        quick: only one small kind: does it run?
    """
    kinds = ["layers"] if quick else list(KINDS)
    figures = {}
    head = ["scene", *(f"{name}: charged; moved" for name in CONTESTANTS)]
    print("Coverage / share wrong by over 1 px, of the last frames of each clip:\n")
    print(table(head, []), flush=True)
    for kind, found in measure(kinds, seeds, width=160 if quick else 480):
        figures[kind] = found
        cells = ["; ".join(_pair(found, pixels, name) for pixels in PIXELS) for name in CONTESTANTS]
        print(_row(kind, cells), flush=True)
    print(f"\nMore of {OURS}, charged pixels; in brackets that of StereoSGBM:\n")
    print(table(["scene", *_DETAILS], []))
    for kind, found in figures.items():
        print(_row(kind, [show(found) for show in _DETAILS.values()]))
    shares = (f"{figures[MEAN][f'charged | {OURS} | {name}']:.3f}" for name in FRACTIONS)
    print("\nFractions of disparities by tenths of a px, 0.1 each if none is preferred:")
    print(*shares)
    if path is not None:
        path.write_text(json.dumps(figures, indent=2) + "\n")


def _row(kind: str, cells: Sequence[str]) -> str:
    return table([kind, *cells], []).partition("\n")[0]


def _pair(found: Mapping[str, float], pixels: str, name: str) -> str:
    coverage, bad = (found[f"{pixels} | {name} | {each}"] for each in ("coverage", "bad_1"))
    return f"{coverage:.3f} / {bad:.3f}"


Shown = Callable[[Mapping[str, float]], str]


def _of(measure_name: str, contestant: str = OURS, pixels: str = "charged") -> Shown:
    return lambda found: f"{found[f'{pixels} | {contestant} | {measure_name}']:.3f}"


def _both(measure_name: str) -> Shown:
    ours, other = _of(measure_name), _of(measure_name, "StereoSGBM")
    return lambda found: f"{ours(found)} ({other(found)})"


_DETAILS: dict[str, Shown] = {
    "wrong by over 0.5 px": _of("bad_0_5"),
    "the same, moved": _of("bad_0_5", pixels="moved"),
    "coverage of what both see": _of("coverage_seen"),
    "bias at 0 to 1 px": _of("bias_0_1_px"),
    "1 to 3 px": _of("bias_1_3_px"),
    "3 to 10 px": _of("bias_3_10_px"),
    "over 10 px": _of("bias_10_px"),
    "within one sigma": _of("sigma_1"),
    "within two": _of("sigma_2"),
    "still: median step in px": _both("flicker_px"),
    "TEPE over 1 px": _both("tepe_1"),
    "at the limit": _both(LIMIT),
}
