"""How well moving things are followed: ``python -m bench objects``.

The cards are rendered, encoded as H.264, decoded and followed; what they really do is known.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from bench.markdown import table
from motionstereo_cli.files.video import VideoWriter
from motionstereo_cli.pipeline import process
from motionstereo_cli.simulate.camera import stereo_cameras
from motionstereo_cli.simulate.cards import CARDS, WALL_M, Card, CardState, card_state
from motionstereo_cli.simulate.scenes import SceneFrame, render_scene
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.sources import open_stereo

if TYPE_CHECKING:
    from motionstereo_cli.types import FrameResult, MovingObject

#: A card counts where so much of the image shows it.
_MIN_SHARE = 0.004
#: An object is a card's if their boxes overlap by this (intersection over union) or more and
#: their depths differ by at most this share.
_MIN_OVERLAP = 0.3
_MAX_OFF = 0.1
#: Speeds count once the object has been followed for this many frames, cards move if they are
#: faster than this, and for so long after a card has turned round its old speed is still seen.
_FOLLOWED_FRAMES = 10
_MOVES_MPS = 0.2
_TURNED_S = 0.5

Box = tuple[float, float, float, float]


@dataclass(slots=True)
class Score:
    """What was found of the cards.

    Attributes:
        visible: frames in which a card could be seen, summed over the cards.
        found: of these, those with an object for it.
        switches: how often the object of a card became another one.
        others: rows that are no card's.
        errors: share by which the speed of each card that comes or goes is wrong, a row each.
        wrong_signs: of these, those with the wrong sign.
        wrong_signs_turned: rows with the wrong sign soon after a card has turned round.
        across_mps: speed found of cards that neither come nor go.
        marked: rows of cards that are marked as shadows.
        shadows: rows at the depth of the wall that are no card's, and how many of them are marked.
    """

    visible: int = 0
    found: int = 0
    switches: int = 0
    others: int = 0
    errors: list[float] = field(default_factory=list)
    wrong_signs: int = 0
    wrong_signs_turned: int = 0
    across_mps: list[float] = field(default_factory=list)
    marked: int = 0
    shadows: list[int] = field(default_factory=lambda: [0, 0])

    @property
    def switches_per_100(self) -> float:
        """Switches of an object in 100 frames."""
        return 100 * self.switches / max(self.visible, 1)

    @property
    def error(self) -> float:
        """Median of the errors."""
        return float(np.median(self.errors))


def measure(settings: SimulateSettings) -> Score:
    """Follow the cards of a recording, the camera's poses known, and score what was found."""
    score = Score()
    last: dict[str, int] = {}
    seen: dict[int, int] = {}
    for shot, result in _followed(settings):
        time_s = shot.frame / settings.frame_rate
        left = list(result.objects)
        for thing in left:
            seen[thing.id] = seen.get(thing.id, 0) + 1
        for card, box, depth_m in _visible(shot, settings, time_s):
            score.visible += 1
            found = _of(box, depth_m, left)
            if found is None:
                continue
            left.remove(found)
            score.found += 1
            score.marked += bool(found.shadow)
            score.switches += last.get(card.name, found.id) != found.id
            last[card.name] = found.id
            if found.closing_mps is not None and seen[found.id] >= _FOLLOWED_FRAMES:
                _score_speed(score, card, time_s, found.closing_mps)
        score.others += sum(not thing.shadow for thing in left)
        lying = [each for each in left if abs((each.depth_m or 0) / WALL_M - 1) <= _MAX_OFF]
        score.shadows[0] += len(lying)
        score.shadows[1] += sum(bool(each.shadow) for each in lying)
    return score


def _score_speed(score: Score, card: Card, time_s: float, found_mps: float) -> None:
    true_mps = card_state(card, time_s).closing_m_s
    if abs(true_mps) <= _MOVES_MPS:
        score.across_mps.append(abs(found_mps))
        return
    wrong = found_mps * true_mps <= 0
    if card_state(card, time_s - _TURNED_S).closing_m_s != true_mps:
        score.wrong_signs_turned += wrong
    else:
        score.wrong_signs += wrong
        score.errors.append(abs(found_mps / true_mps - 1))


def _followed(settings: SimulateSettings) -> Iterator[tuple[SceneFrame, FrameResult]]:
    """Yield each frame as it was and what the pipeline makes of its recording."""
    time_base = 1 / Fraction(settings.frame_rate).limit_denominator(1001)
    with tempfile.TemporaryDirectory() as folder:
        left, right = Path(folder, "left.mp4"), Path(folder, "right.mp4")
        videos = [VideoWriter(path, time_base) for path in (left, right)]
        shots = []
        for index, shot in enumerate(render_scene(settings)):
            for video, grey in zip(videos, (shot.left, shot.right), strict=True):
                video.write(grey, index)
            shots.append(shot)
        for video in videos:
            video.close()
        with open_stereo(left, right) as source:
            results = process(
                source, None, settings.rig, lambda frame: shots[frame.index].pose.rig_pose
            )
            yield from zip(shots, results, strict=True)


def _visible(
    shot: SceneFrame, settings: SimulateSettings, time_s: float
) -> Iterator[tuple[Card, Box, float]]:
    """Yield the cards that the right camera sees, with box in px and depth in m."""
    camera = stereo_cameras(settings.rig)[1]
    depth_m = settings.rig.depth_m(shot.disparity_px)
    eye = camera.eye(shot.pose)
    rays = camera.rays(shot.pose, np.arange(settings.width, dtype=np.float64))
    x_m, y_m = (eye[axis] + depth_m * rays[:, axis] for axis in (0, 1))
    for card in CARDS:
        state: CardState = card_state(card, time_s)
        mine = np.abs(x_m - state.x_m) < 0.01
        mine &= np.abs(y_m - state.y_m) <= card.width_m / 2 + 0.01
        if mine.mean() >= _MIN_SHARE:
            rows, columns = np.nonzero(mine)
            corner = float(columns.min()), float(rows.min())
            box = (*corner, float(np.ptp(columns) + 1), float(np.ptp(rows) + 1))
            yield card, box, float(np.median(depth_m[mine]))


def _of(box: Box, depth_m: float, objects: Sequence[MovingObject]) -> MovingObject | None:
    """Return the object that a card is seen as."""
    near = [
        thing
        for thing in objects
        if thing.depth_m is not None and abs(thing.depth_m / depth_m - 1) <= _MAX_OFF
    ]
    best = max(near, key=lambda thing: overlap(box, thing), default=None)
    return best if best is not None and overlap(box, best) >= _MIN_OVERLAP else None


def overlap(box: Box, thing: MovingObject) -> float:
    x, y, width, height = box
    across = min(x + width, thing.x + thing.width) - max(x, thing.x)
    down = min(y + height, thing.y + thing.height) - max(y, thing.y)
    both = max(across, 0) * max(down, 0)
    return both / (width * height + thing.width * thing.height - both)


def format_markdown(scores: dict[str, Score]) -> str:
    """Return the table, a line for each recording."""
    head = ["camera", "closing speed off by (median)", "wrong sign", "so soon after a turn"]
    head += ["speed found of what crosses (median, m/s)", "id switches per object in 100 frames"]
    head += ["cards found", "rows of nothing"]
    head += ["rows of cards marked as shadows", "rows on the wall; marked"]
    lines = []
    for name, score in scores.items():
        rows = len(score.errors)
        off = f"{100 * score.error:.1f} % of {rows}"
        signs = (score.wrong_signs, score.wrong_signs_turned)
        across, switches = f"{np.median(score.across_mps):.3f}", f"{score.switches_per_100:.2f}"
        found = f"{100 * score.found / score.visible:.0f} % of {score.visible}"
        on_wall = "{}; {}".format(*score.shadows)
        lines.append([name, off, *signs, across, switches, found, score.others])
        lines[-1] += [score.marked, on_wall]
    return table(head, lines)


def main(args: Sequence[str] | None = None) -> None:
    """Measure, and print the table as Markdown on standard output."""
    parser = argparse.ArgumentParser(prog="python -m bench objects")
    parser.add_argument("--frames", default="0:300", help="of the cards, at 30 a second")
    parser.add_argument("--noise-sigma", type=float, default=1.5, help="sensor noise, grey levels")
    parser.add_argument("--width", type=int, default=480, help="of the images, 3:2")
    parser.add_argument("--seed", type=int, default=0, help="of the cards' texture")
    parser.add_argument("--shadows", action="store_true", help="the cards cast shadows")
    given = parser.parse_args(args)
    scores = {}
    for name in tqdm(("still", "panning"), unit="recording", disable=None):
        scores[name] = measure(
            SimulateSettings(
                scene="cards",
                frames=given.frames,
                width=given.width,
                height=given.width * 2 // 3,
                noise_sigma=given.noise_sigma,
                seed=given.seed,
                pan=name == "panning",
                shadows=given.shadows,
            )
        )
    print(format_markdown(scores))
