"""How accurate the matchers are on rendered scenes: ``python -m bench accuracy``.

Every matcher sees the same decoded frames and is scored on the same pixels.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from tqdm import tqdm

from bench import depth
from bench.clips import recorded
from bench.markdown import table
from motionstereo_cli.evaluation.evaluate import FramePair, Score, Tally, tally
from motionstereo_cli.method.block_matching import stereo_bm, stereo_sgbm
from motionstereo_cli.method.matching import match
from motionstereo_cli.method.memory import Memory, mirrored, see
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.runs.onnx_model import load_model
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.sinks.read_back import Maps
from motionstereo_cli.sources import open_stereo

if TYPE_CHECKING:
    from motionstereo_cli.types import Grey, Real

#: In this many frames the memories charge; they are not counted.
RUN_IN = 16

SCENES: dict[str, dict[str, Any]] = {
    "corridor straight": {"scene": "corridor", "frames": "250:350"},
    "corridor turn": {"scene": "corridor", "frames": "334:375"},
    "cards": {"scene": "cards", "frames": "0:100"},
    "cards panning": {"scene": "cards", "frames": "0:100", "pan": True},
}
NOISES = (0.0, 1.5, 4.0)

#: Pixels scored, by the default settings' right memory: with charge, and moved in this frame.
PIXELS = ("charged", "moved")

DEFAULT = Settings()
#: Ours, by name; each with memories of its own.
OURS = {
    "motionstereo": DEFAULT,
    "motionstereo, matcher trails": Settings(matcher="trails"),
    "motionstereo, matcher dense": Settings(matcher="dense"),
    "motionstereo, matcher regions": Settings(matcher="regions"),
    "motionstereo, preset paper": Settings.preset("paper"),
}


@dataclass(frozen=True, slots=True)
class Look:
    """What the matchers get to see of a frame.

    Attributes:
        right, left: grey levels.
        memories: (right, left) by the name in :data:`OURS`.
    """

    right: Grey
    left: Grey
    memories: dict[str, tuple[Memory, Memory]]

    @property
    def memory(self) -> Memory:
        """The default settings' right memory."""
        return self.memories["motionstereo"][0]


def _ours(name: str) -> Callable[[Look], Real]:
    return lambda look: match(*look.memories[name], OURS[name])[0]


def _peer(peer: Callable[..., Real], *, filtered: bool) -> Callable[[Look], Real]:
    return lambda look: peer(look.right, look.left, DEFAULT.max_disparity, filtered=filtered)


def _of_memories(peer: Callable[..., Real]) -> Callable[[Look], Real]:
    def find(look: Look) -> Real:
        right, left = look.memories["motionstereo"]
        return peer(right.charge, left.charge, DEFAULT.max_disparity, filtered=True)

    return find


MATCHERS: dict[str, Callable[[Look], Real]] = {
    **{name: _ours(name) for name in OURS},
    "StereoBM": _peer(stereo_bm, filtered=False),
    "StereoBM, filtered": _peer(stereo_bm, filtered=True),
    "StereoBM, filtered, of memories": _of_memories(stereo_bm),
    "StereoSGBM": _peer(stereo_sgbm, filtered=False),
    "StereoSGBM, filtered": _peer(stereo_sgbm, filtered=True),
    "StereoSGBM, filtered, of memories": _of_memories(stereo_sgbm),
}


def add_matcher(name: str) -> None:
    """Score a further matcher of the command line with the others.

    Raises:
        SettingsError: there is none of that name.
        InputError: it cannot be loaded.
    """
    settings = Settings(matcher=name)
    load_model(settings)
    shown = f"motionstereo, matcher {name}"
    OURS[shown] = settings
    MATCHERS[shown] = _ours(shown)


class Cell(NamedTuple):
    """One matcher's score on one scene, noise and kind of pixels."""

    scene: str
    noise_sigma: float
    pixels: str
    matcher: str
    score: Score


def measure(
    scene: str,
    noise_sigma: float,
    *,
    every: int,
    seeds: Sequence[int] = (0,),
    frames: str | None = None,
    width: int = 480,
) -> list[Cell]:
    """Score all matchers on one scene, rendered, encoded as H.264 and decoded again.

    Args:
        scene: name from :data:`SCENES`.
        noise_sigma: standard deviation of the sensor noise in grey levels.
        every: score one frame of so many.
        seeds: of the scene; pixels of all count together.
        frames: other frames than the scene's.
        width: of the images in px; the height is two thirds of it.
    """
    looks = itertools.chain.from_iterable(
        _looks(_recorded(scene, noise_sigma, seed, frames, width), every) for seed in seeds
    )
    return _scored(scene, noise_sigma, looks)


def measure_recording(folder: Path, every: int) -> list[Cell]:
    """Score all matchers on a recording with truth.

    Args:
        folder: as ``simulate`` writes it: ``left`` and ``right``, each an .mp4 or a folder of
            images, and ``disparity`` of the right view, or ``disparity_left`` of the left view.
        every: score one frame of so many.
    """
    return _scored(folder.name, math.nan, _looks_at(folder, every))


def _scored(scene: str, noise_sigma: float, looks: Iterable[tuple[Look, Real]]) -> list[Cell]:
    sums: dict[tuple[str, str], Tally] = {}
    for look, truth_px in looks:
        memory = look.memory
        masks = {"charged": memory.charge > DEFAULT.charge_min, "moved": memory.moved}
        for matcher, find in MATCHERS.items():
            found_px = find(look)
            for pixels, mask in masks.items():
                one = tally(FramePair(found_px, np.where(mask, truth_px, np.float32(np.nan))))
                key = pixels, matcher
                sums[key] = sums[key] + one if key in sums else one
    return [
        Cell(scene, noise_sigma, pixels, matcher, total.score())
        for (pixels, matcher), total in sums.items()
    ]


def _recorded(
    scene: str, noise_sigma: float, seed: int, frames: str | None, width: int
) -> SimulateSettings:
    values = SCENES[scene] | ({} if frames is None else {"frames": frames})
    return SimulateSettings(
        width=width, height=width * 2 // 3, noise_sigma=noise_sigma, seed=seed, **values
    )


def _looks(scene: SimulateSettings, every: int) -> Iterator[tuple[Look, Real]]:
    """Yield the frames to score, with the true disparity of the right view."""
    with tempfile.TemporaryDirectory() as folder:
        left, right = Path(folder, "left.mp4"), Path(folder, "right.mp4")
        shots = enumerate(recorded(scene, left, right))
        truth = {index: shot.disparity_px for index, shot in shots if _is_scored(index, every)}
        with open_stereo(left, right) as source:
            yield from _seen(((frame.right, frame.left) for frame in source), truth)


def _is_scored(index: int, every: int) -> bool:
    return index >= RUN_IN and (index - RUN_IN) % every == 0


def _looks_at(folder: Path, every: int) -> Iterator[tuple[Look, Real]]:
    """Yield the frames to score of a recording.

    In a mirror, the left view is the right one of a rig: so truth of the left view is used.
    """
    left, right = (
        video if (video := folder / f"{side}.mp4").exists() else folder / side
        for side in ("left", "right")
    )
    of_left = not (folder / "disparity").exists()
    maps = Maps(folder / ("disparity_left" if of_left else "disparity"), "disparity")
    numbers = sorted(maps.files)
    first = min(RUN_IN, len(numbers) // 3)  # a short recording has no time to charge
    truth = {number: maps.read(number) for number in numbers[first::every]}
    with open_stereo(left, right) as source:
        if of_left:
            truth = {number: mirrored(one) for number, one in truth.items()}
            yield from _seen(((mirrored(f.left), mirrored(f.right)) for f in source), truth)
        else:
            yield from _seen(((frame.right, frame.left) for frame in source), truth)


def _seen(
    views: Iterable[tuple[Grey, Grey]], truth: Mapping[int, Real]
) -> Iterator[tuple[Look, Real]]:
    """Yield those of the right and left views that have truth, with all memories of them."""
    memories: dict[str, tuple[Memory, Memory]] = {}
    for index, (right, left) in enumerate(views):
        for name, settings in OURS.items():
            before = memories.get(name, (None, None))
            memories[name] = see(before[0], right, settings), see(before[1], left, settings)
        if index in truth:
            yield Look(right, left, dict(memories)), truth[index]


def format_markdown(cells: Sequence[Cell]) -> str:
    """Return one table for each noise: matchers down, scenes and pixels across."""
    scores = {cell[:4]: cell.score for cell in cells}
    scenes, noises, pixels, matchers = (
        list(dict.fromkeys(values)) for values in zip(*scores, strict=True)
    )
    columns = [(scene, kind) for scene in scenes for kind in pixels]
    lines = []
    for noise in noises:
        noisy = "Noise" if math.isnan(noise) else f"Noise sigma {noise:g} grey levels"
        lines.append(f"{noisy}; coverage / bad-1 / median error in px:\n")
        head = ["matcher", *(f"{scene}, {kind}" for scene, kind in columns)]
        rows = [
            [matcher, *(_cell(scores[scene, noise, kind, matcher]) for scene, kind in columns)]
            for matcher in matchers
        ]
        lines += [table(head, rows), ""]
        lines.append(
            "Coverage of what both cameras see / bias in px where the truth is 0 to 1, 1 to 3,"
        )
        lines.append("3 to 10, over 10 px:\n")
        rows = [
            [matcher, *(_more(scores[scene, noise, kind, matcher]) for scene, kind in columns)]
            for matcher in matchers
        ]
        lines += [table(head, rows), ""]
    return "\n".join(lines)


def _cell(score: Score) -> str:
    return f"{score.coverage:.2f} / {score.bad_1:.3f} / {score.median_px:.2f}"


def _more(score: Score) -> str:
    biases = score.bias_0_1_px, score.bias_1_3_px, score.bias_3_10_px, score.bias_10_px
    shown = ("-" if math.isnan(bias) else f"{bias:+.2f}" for bias in biases)
    return " / ".join((f"{score.coverage_seen:.2f}", *shown))


def main(args: Sequence[str] | None = None) -> None:
    """Measure, and print the tables as Markdown on standard output."""
    parser = argparse.ArgumentParser(prog="python -m bench accuracy")
    parser.add_argument("--every", type=int, default=5, help="score one frame of so many")
    parser.add_argument(
        "--recordings",
        type=Path,
        nargs="+",
        metavar="FOLDER",
        help="recordings with truth in place of rendered scenes: left and right (.mp4 or a folder "
        "of images), and disparity (of the right view) or disparity_left, as simulate writes them",
    )
    parser.add_argument(
        "--matchers",
        nargs="+",
        default=[],
        metavar="NAME",
        help="further ones: of installed packages, or onnx:MODEL",
    )
    parser.add_argument("--json", type=Path, help="write all scores there too")
    parser.add_argument("--quick", action="store_true", help="few small scenes: does it run?")
    parser.add_argument(
        "--hard", action="store_true", help="whole runs on many kinds of scenes, harder ones too"
    )
    parser.add_argument(
        "--held-out",
        action="store_true",
        help="the same with seeds that no value was chosen by: measure them only once",
    )
    given = parser.parse_args(args)
    if given.every < 1:
        parser.error("--every: give at least 1")
    for name in given.matchers:
        add_matcher(name)

    if given.hard or given.held_out:
        seeds = depth.HELD_OUT_SEEDS if given.held_out else depth.SEEDS
        depth.main(seeds, given.json, quick=given.quick)
        return
    if given.recordings:
        cells = [cell for each in given.recordings for cell in measure_recording(each, given.every)]
    else:
        cells = _measure_scenes(given.every, quick=given.quick)
    print(format_markdown(cells))
    if given.json is not None:
        rows = [{**cell._asdict(), "score": asdict(cell.score)} for cell in cells]
        given.json.write_text(json.dumps(rows, indent=2) + "\n")


def _measure_scenes(every: int, *, quick: bool) -> list[Cell]:
    runs = [(scene, noise) for noise in NOISES for scene in SCENES]
    size: dict[str, Any] = {"every": every}
    if quick:
        runs = [("corridor straight", 1.5), ("cards", 1.5)]
        size = {"every": 4, "frames": "20", "width": 240}
    cells = []
    with tqdm(runs, unit="recording", disable=None) as bar:
        for scene, noise in bar:
            bar.set_description(f"{scene}, noise {noise:g}")
            cells += measure(scene, noise, **size)
    return cells
