"""How accurate the matchers are on rendered scenes: ``python -m bench accuracy``.

Every matcher sees the same decoded frames and is scored on the same pixels.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from tqdm import tqdm

from bench.markdown import table
from bench.peers import stereo_bm, stereo_sgbm
from motionstereo_cli.analysis.evaluate import FramePair, Score, Tally, tally
from motionstereo_cli.files.video import VideoWriter
from motionstereo_cli.memory import Memory, see
from motionstereo_cli.pipeline import match
from motionstereo_cli.settings import Settings
from motionstereo_cli.simulate.scenes import render_scene
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.sources import open_stereo

if TYPE_CHECKING:
    from numpy.typing import NDArray

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
PAPER = Settings.preset("paper")
REGIONS = Settings(matcher="regions")


@dataclass(frozen=True, slots=True)
class Look:
    """What the matchers get to see of a frame: greys, and each settings' (right, left) memory."""

    right: Grey
    left: Grey
    default: tuple[Memory, Memory]
    paper: tuple[Memory, Memory]


def _ours(memories: tuple[Memory, Memory], settings: Settings) -> Real:
    right, left = memories
    return match(right, left, settings)[0]


def _of_memories(peer: Callable[..., Real], look: Look) -> Real:
    right, left = look.default
    return peer(right.charge, left.charge, DEFAULT.max_disparity, filtered=True)


MATCHERS: dict[str, Callable[[Look], Real]] = {
    "motionstereo": lambda look: _ours(look.default, DEFAULT),
    "motionstereo, preset paper": lambda look: _ours(look.paper, PAPER),
    "motionstereo, matcher regions": lambda look: _ours(look.default, REGIONS),
    "StereoBM": lambda look: stereo_bm(look.right, look.left, DEFAULT.max_disparity),
    "StereoBM, filtered": lambda look: stereo_bm(
        look.right, look.left, DEFAULT.max_disparity, filtered=True
    ),
    "StereoBM, filtered, of memories": lambda look: _of_memories(stereo_bm, look),
    "StereoSGBM": lambda look: stereo_sgbm(look.right, look.left, DEFAULT.max_disparity),
    "StereoSGBM, filtered": lambda look: stereo_sgbm(
        look.right, look.left, DEFAULT.max_disparity, filtered=True
    ),
    "StereoSGBM, filtered, of memories": lambda look: _of_memories(stereo_sgbm, look),
}


class Cell(NamedTuple):
    """One matcher's score on one scene, noise and kind of pixels."""

    scene: str
    noise_sigma: float
    pixels: str
    matcher: str
    score: Score


def measure(
    scene: str, noise_sigma: float, *, every: int, frames: str | None = None, width: int = 480
) -> list[Cell]:
    """Score all matchers on one scene, rendered, encoded as H.264 and decoded again.

    Args:
        scene: name from :data:`SCENES`.
        noise_sigma: standard deviation of the sensor noise in grey levels.
        every: score one frame of so many.
        frames: other frames than the scene's.
        width: of the images in px; the height is two thirds of it.
    """
    values = SCENES[scene] | ({} if frames is None else {"frames": frames})
    settings = SimulateSettings(
        width=width, height=width * 2 // 3, noise_sigma=noise_sigma, **values
    )
    sums: dict[tuple[str, str], Tally] = {}
    for look, truth_px in _looks(settings, every):
        memory = look.default[0]
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


def _looks(scene: SimulateSettings, every: int) -> Iterator[tuple[Look, Real]]:
    """Yield the frames to score, with the true disparity of the right view."""
    memories: dict[Settings, tuple[Memory, Memory]] = {}
    with tempfile.TemporaryDirectory() as folder:
        left, right = Path(folder, "left.mp4"), Path(folder, "right.mp4")
        truth = _record(scene, left, right, every)
        with open_stereo(left, right) as source:
            for frame in source:
                for settings in (DEFAULT, PAPER):
                    before = memories.get(settings, (None, None))
                    memories[settings] = (
                        see(before[0], frame.right, settings),
                        see(before[1], frame.left, settings),
                    )
                if frame.index in truth:
                    both = memories[DEFAULT], memories[PAPER]
                    yield Look(frame.right, frame.left, *both), truth[frame.index]


def _record(
    settings: SimulateSettings, left: Path, right: Path, every: int
) -> dict[int, NDArray[np.float32]]:
    """Write the videos and return the truth of the frames to score, by number from 0."""
    truth = {}
    videos = [VideoWriter(path, Fraction(1, 30)) for path in (left, right)]
    for index, shot in enumerate(render_scene(settings)):
        for video, grey in zip(videos, (shot.left, shot.right), strict=True):
            video.write(grey, index)
        if index >= RUN_IN and (index - RUN_IN) % every == 0:
            truth[index] = shot.disparity_px
    for video in videos:
        video.close()
    return truth


def format_markdown(cells: Sequence[Cell]) -> str:
    """Return one table for each noise: matchers down, scenes and pixels across."""
    scores = {cell[:4]: cell.score for cell in cells}
    scenes, noises, pixels, matchers = (
        list(dict.fromkeys(values)) for values in zip(*scores, strict=True)
    )
    columns = [(scene, kind) for scene in scenes for kind in pixels]
    lines = []
    for noise in noises:
        lines.append(f"Noise sigma {noise:g} grey levels; coverage / bad-1 / median error in px:\n")
        head = ["matcher", *(f"{scene}, {kind}" for scene, kind in columns)]
        rows = [
            [matcher, *(_cell(scores[scene, noise, kind, matcher]) for scene, kind in columns)]
            for matcher in matchers
        ]
        lines += [table(head, rows), ""]
    return "\n".join(lines)


def _cell(score: Score) -> str:
    return f"{score.coverage:.2f} / {score.bad_1:.3f} / {score.median_px:.2f}"


def main(args: Sequence[str] | None = None) -> None:
    """Measure, and print the tables as Markdown on standard output."""
    parser = argparse.ArgumentParser(prog="python -m bench accuracy")
    parser.add_argument("--every", type=int, default=5, help="score one frame of so many")
    parser.add_argument("--json", type=Path, help="write all scores there too")
    parser.add_argument("--quick", action="store_true", help="two small scenes: does it run?")
    given = parser.parse_args(args)
    if given.every < 1:
        parser.error("--every: give at least 1")

    runs = [(scene, noise) for noise in NOISES for scene in SCENES]
    size: dict[str, Any] = {"every": given.every}
    if given.quick:
        runs = [("corridor straight", 1.5), ("cards", 1.5)]
        size = {"every": 4, "frames": "20", "width": 240}
    cells: list[Cell] = []
    with tqdm(runs, unit="recording", disable=None) as bar:
        for scene, noise in bar:
            bar.set_description(f"{scene}, noise {noise:g}")
            cells += measure(scene, noise, **size)
    print(format_markdown(cells))
    if given.json is not None:
        rows = [{**cell._asdict(), "score": asdict(cell.score)} for cell in cells]
        given.json.write_text(json.dumps(rows, indent=2) + "\n")
