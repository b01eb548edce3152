"""What is reached of what is aimed at: ``python -m bench goals``, or ``make goals``.

The rows stand in ``goals.toml``. Each measurement is made once, for all rows that need it.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import tempfile
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from bench import batch, depth, drive, given, house, objects, own_motion, speed
from bench import map as maps
from bench.markdown import table
from motionstereo_cli.simulate.settings import DriveSettings, SimulateSettings
from motionstereo_cli.sinks.settings import OutputSettings

GOALS = Path(__file__).with_name("goals.toml")


@dataclass(frozen=True, slots=True)
class Goal:
    """A row of ``goals.toml``.

    Attributes:
        part: theme that it belongs to; PART chooses by it.
        what: what it is about, with the unit.
        measure: measurement that gives it, a name in :data:`MEASURES`.
        key: which of its figures.
        now: the figure when the row was written, as text; empty where there was none.
        goal: the limit.
        per: figure that the first is divided by; empty for none.
        least: whether the goal is the least that is wanted, or the most.
    """

    part: str
    what: str
    measure: str
    key: str
    now: str
    goal: float
    per: str = ""
    least: bool = False

    def got(self, figures: Mapping[str, float]) -> float:
        """Return the figure; NaN where it was not measured."""
        found = figures.get(self.key, math.nan)
        return found / figures.get(self.per, math.nan) if self.per else found

    def reached(self, got: float) -> bool:
        """Return whether a figure is within the goal."""
        return got >= self.goal if self.least else got <= self.goal


def read_goals(path: Path = GOALS) -> list[Goal]:
    """Return the rows of a file.

    Raises:
        TypeError: a row has a field that there is not, or lacks one.
    """
    return [Goal(**row) for row in tomllib.loads(path.read_text(encoding="utf-8"))["goals"]]


def _of_house(_: Sequence[Goal], quick: bool) -> dict[str, float]:
    return house.measured()


def _of_sanitizers(_: Sequence[Goal], quick: bool) -> dict[str, float]:
    """1 where a test fails on checked loops: what is found ends the process that found it."""
    done = subprocess.run(["make", "sanitize"], capture_output=True, check=False)
    return {"failed": float(done.returncode != 0)}


def _of_accuracy(_: Sequence[Goal], quick: bool) -> dict[str, float]:
    """Figures by kind of scene, pixels, contestant and measure, on held-out seeds."""
    kinds, width = (["layers"], 160) if quick else (list(depth.KINDS), 480)
    measured = depth.measure(kinds, depth.HELD_OUT_SEEDS, width=width)
    return {
        f"{kind} | {key}": value
        for kind, figures in tqdm(measured, "depth", len(kinds) + 1, unit="kind", disable=None)
        for key, value in figures.items()
    }


def _of_speed(rows: Sequence[Goal], quick: bool) -> dict[str, float]:
    """Times in s, peak memory and share of the cores, by part, case where several, contestant."""
    named = dict.fromkeys(row.key.partition(" | ")[0] for row in rows)
    parts = [name for name in named if name in speed.PARTS] or ["startup"]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "speed.json")
        speed.main(
            ["--parts", ",".join(parts), "--json", str(path), *(["--quick"] if quick else [])]
        )
        report = json.loads(path.read_text())
    figures = {"installed MB": float(sum(report["installed_mb"].values()))}
    for row in report["rows"]:
        case = [] if row["part"] == "startup" else [row["case"]]
        name = " | ".join([row["part"], *case, row["contestant"]])
        figures[f"{name} | s"] = row["seconds"]
        figures[f"{name} | cpu s"] = row["cpu_s"] or math.nan
        figures[f"{name} | peak MB"] = row["peak_mb"] or math.nan
        busy = (row["cpu_s"] or math.nan) / (row["cores"] * row["seconds"])
        figures[f"{name} | cores busy"] = busy
    return figures


def _of_objects(_: Sequence[Goal], quick: bool) -> dict[str, float]:
    figures = {}
    for name in ("still", "panning"):
        frames, width = ("0:30", 160) if quick else ("0:300", 480)
        score = objects.measure(
            SimulateSettings(
                scene="cards",
                frames=frames,
                width=width,
                height=width * 2 // 3,
                noise_sigma=1.5,
                pan=name == "panning",
            )
        )
        count = int(frames.partition(":")[2])
        figures[f"{name} | found"] = score.found / max(score.visible, 1)
        figures[f"{name} | other rows a frame"] = score.others / count
        figures[f"{name} | switches in 100 frames"] = score.switches_per_100
        figures[f"{name} | speed error"] = score.error if score.errors else math.nan
    return figures


def _of_drive(_: Sequence[Goal], quick: bool) -> dict[str, float]:
    """By walkers in each of five worlds, and one lap."""
    seeds, laps = (1, 0.02) if quick else (5, 1.0)
    figures: dict[str, float] = {}
    for walkers in (0, 2):
        rows = [
            drive.drive_once("motionstereo", DriveSettings(seed=seed, laps=laps, walkers=walkers))
            for seed in range(seeds)
        ]
        touched = sum(row["ended"].startswith("touched") for row in rows)
        figures[f"{walkers} walkers | touched"] = touched
        figures[f"{walkers} walkers | finished"] = sum(
            row["ended"] == "laps done" for row in rows
        ) / len(rows)
    return figures


def _of_map(_: Sequence[Goal], quick: bool) -> dict[str, float]:
    """Means over three worlds, by walkers in each."""
    seeds, laps = (1, 0.02) if quick else (3, 1.0)
    figures = {}
    for walkers in (0, 2):
        scores = [
            maps.score(
                DriveSettings(seed=seed, laps=laps, walkers=walkers), OutputSettings().map_cell_m
            )
            for seed in range(seeds)
        ]
        for name in ("true_cells", "wall_cells", "found_wall", "true_points"):
            values = [getattr(score, name) for score in scores]
            figures[f"{walkers} walkers | {name}"] = sum(values) / len(values)
    return figures


def _of_street_map(_: Sequence[Goal], quick: bool) -> dict[str, float]:
    """Means over three streets, of which one winds."""
    seeds, frames = ((0,), 4) if quick else ((0, 1, 2), 50)
    scores = [asdict(maps.street_score(seed, maps.OBSTACLE_M, frames)) for seed in seeds]
    return {name: float(np.mean([score[name] for score in scores])) for name in scores[0]}


def _of_own_motion(_: Sequence[Goal], quick: bool) -> dict[str, float]:
    """Shares found and false rows a frame over held-out streets; drift in % of their worst."""
    size: dict[str, object] = {"frames": "6", "width": 160, "height": 120} if quick else {}
    names = [name for name in own_motion.SCENES if name.startswith("held-out street")]
    scores = [own_motion.measure(own_motion.SCENES[name] | size) for name in names]
    sums = {size: np.sum([getattr(s, size) for s in scores], axis=0) for size in ("large", "small")}
    return {
        **{f"streets | {size} found": found / max(all_, 1) for size, (found, all_) in sums.items()},
        "streets | false rows a frame": float(np.mean([score.false for score in scores])),
        "streets | drift": max(score.path.drift_percent for score in scores),
    }


def _of_walkers(_: Sequence[Goal], quick: bool) -> dict[str, float]:
    """Of held-out drives past walkers: the share found, and false rows a frame."""
    seeds, frames = (own_motion.WALKER_SEEDS[:1], 3) if quick else (own_motion.WALKER_SEEDS, 200)
    scores = [own_motion.measure_walkers(seed, frames) for seed in seeds]
    return {
        "found": sum(s.found for s in scores) / max(sum(s.walking for s in scores), 1),
        "false rows a frame": sum(s.false for s in scores) / sum(s.frames for s in scores),
    }


def _of_paths(_: Sequence[Goal], quick: bool) -> dict[str, float]:
    """Of drives of a held-out seed: means over those that tell, and the share of wrong motions."""
    settings = [each for kind in own_motion.drives([9]).values() for each in kind]
    if quick:
        settings = [replace(each, max_frames=3) for each in settings[:2]]
    scores = [own_motion.measure_drive(each) for each in tqdm(settings, "paths", disable=None)]
    frames, lost, wrong = np.sum([[s.frames, s.lost, s.wrong] for s in scores], axis=0)
    return {
        "drift": own_motion.mean([score.path.drift_percent for score in scores]),
        "drift without lost frames": own_motion.mean([s.known.drift_percent for s in scores]),
        "lost": lost / frames,
        "wrong": wrong / frames,
    }


def _of_batch(_: Sequence[Goal], quick: bool) -> dict[str, float]:
    """Figures of the trials with many recordings, by their keys."""
    size = batch.QUICK if quick else batch.FULL
    return {row.key: row.figure for row in batch.measured(("shards", "sleepers"), size) if row.key}


def _of_given(_: Sequence[Goal], quick: bool) -> dict[str, float]:
    return given.measured(*((6, 96, 64) if quick else ()))


#: By name: rows that want it, and whether it is only to be tried, to figures by key.
MEASURES: dict[str, Callable[[Sequence[Goal], bool], dict[str, float]]] = {
    "house": _of_house,
    "sanitizers": _of_sanitizers,
    "accuracy": _of_accuracy,
    "speed": _of_speed,
    "objects": _of_objects,
    "drive": _of_drive,
    "map": _of_map,
    "street_map": _of_street_map,
    "own_motion": _of_own_motion,
    "walkers": _of_walkers,
    "paths": _of_paths,
    "batch": _of_batch,
    "given": _of_given,
}


def main(args: Sequence[str] | None = None) -> None:
    """Measure, print a table on standard output, and write the JSON."""
    goals = read_goals()
    parts = list(dict.fromkeys(goal.part for goal in goals))
    parser = argparse.ArgumentParser(prog="python -m bench goals")
    parser.add_argument("--part", choices=parts, help="only these rows [all]")
    parser.add_argument("--json", type=Path, default=Path("out/goals.json"), help="[%(default)s]")
    parser.add_argument("--quick", action="store_true", help="tiny and once: does it run?")
    given = parser.parse_args(args)
    goals = [goal for goal in goals if given.part in (None, goal.part)]

    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else math.nan
    figures: dict[str, dict[str, float]] = {}
    failed: dict[str, str] = {}
    for name in dict.fromkeys(goal.measure for goal in goals):
        try:
            figures[name] = MEASURES[name]([g for g in goals if g.measure == name], given.quick)
        except (Exception, SystemExit) as error:  # what others give is still worth showing
            failed[name] = f"{type(error).__name__}: {error}"
    rows, report = [], []
    for goal in goals:
        got = goal.got(figures.get(goal.measure, {}))
        said = "reached" if goal.reached(got) else "short"
        if math.isnan(got):
            said = failed.get(goal.measure, "not measured")
        limit = f"{'at least' if goal.least else 'at most'} {goal.goal:,.4g}"
        rows.append([goal.part, goal.what, goal.now or "-", f"{got:,.4g}", limit, said])
        report.append({**asdict(goal), "got": None if math.isnan(got) else got, "said": said})
    print(table(["part", "what", "when it was written", "now", "goal", ""], rows))
    print(f"\nLoad of the machine at the start: {load:.1f} on {os.cpu_count()} cores.")
    given.json.parent.mkdir(parents=True, exist_ok=True)
    summary = {"load_at_start": load, "machine": speed.machine(), "goals": report}
    given.json.write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
