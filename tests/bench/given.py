"""What ``--disparity`` costs beyond reading the maps, against ``--preset fast``: ``bench given``.

Processor time of runs in processes that have loaded everything, alternated, the least of several.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from bench.children import call, fork, warm_up
from motionstereo_cli.files.maps import read_map
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.simulate.write import simulate

_TIMES, _PATIENCE_S = 5, 300.0


def measured(frames: int = 100, width: int = 640, height: int = 480) -> dict[str, float]:
    """Return processor times in s, by what was done, and ``ratio``."""
    settings = SimulateSettings(
        frames=f"300:{300 + frames}", width=width, height=height, noise_sigma=1.5
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        clip = folder / "clip"
        simulate(clip, settings)
        maps = clip / "disparity"
        run = ["run", str(clip / "left.mp4"), str(clip / "right.mp4"), "--rig"]
        run += [str(clip / "rig.yaml"), "--jobs", "1"]
        run += ["--save", "steering", "--no-check", "--overwrite", "-o", str(folder / "out")]
        ways = {"given": [*run, "--disparity", str(maps)], "fast": [*run, "--preset", "fast"]}
        for command in ways.values():
            warm_up([*command, "--end", "2"])

        def reading() -> int:
            for path in sorted(maps.iterdir()):
                read_map(path)
            return 0

        found: dict[str, list[float]] = {}
        for _ in range(_TIMES):
            for way, command in ways.items():
                ended = call(command, seconds=_PATIENCE_S)
                if ended.exit_code:
                    raise RuntimeError(ended.said)
                found.setdefault(way, []).append(ended.cpu_s)
            ended = fork(reading, seconds=_PATIENCE_S)
            found.setdefault("reading", []).append(ended.cpu_s)
    least = {way: min(times) for way, times in found.items()}
    return least | {"ratio": (least["given"] - least["reading"]) / least["fast"]}


def main(args: Sequence[str] | None = None) -> None:
    """Measure, and print the figures."""
    parser = argparse.ArgumentParser(prog="python -m bench given", description=__doc__)
    parser.add_argument("--frames", type=int, default=100)
    given = parser.parse_args(args)
    for name, figure in measured(given.frames).items():
        print(f"{name}: {figure:.2f}", file=sys.stdout)
