"""What the speed benchmark says: tables, and goals beside what was got."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bench.markdown import table
from bench.timing import Cost, Key

#: Parts in which contestants do the same work.
_RACES = ("matching", "run", "jobs", "startup")

_UNKNOWN = Cost(math.nan)


@dataclass(frozen=True, slots=True)
class Goal:
    """A goal, and what was got.

    Attributes:
        what: what it is about, with the unit unless it is a ratio.
        least: whether the limit is the least that is wanted, or the most.
        limit: the goal.
        got: what was measured.
    """

    what: str
    least: bool
    limit: float
    got: float

    @property
    def reached(self) -> bool:
        """Whether the goal was reached."""
        return self.got >= self.limit if self.least else self.got <= self.limit


def goals(
    medians: Mapping[Key, Cost],
    sizes: Sequence[tuple[int, int]],
    cores: int,
    installed_mb: float = math.nan,
) -> list[Goal]:
    """Return the goals that there are measurements for; times are processor time.

    Args:
        medians: what was measured.
        sizes: widths and heights in px of the growth.
        cores: number of all cores.
        installed_mb: size of an installation.
    """

    def matching(case: str, contestant: str) -> float:
        return medians.get(Key("matching", case, contestant, 1), _UNKNOWN).work_s

    def run(contestant: str, part: str = "run") -> Cost:
        found = (
            c for k, c in medians.items() if k[0::2] == (part, contestant) and k.cores == cores
        )
        return next(found, _UNKNOWN)

    found = []
    trails, corridor = "motionstereo, trails", "corridor, 64 px"
    for case, limit in ((corridor, 0.35), ("cards panning, 64 px", 1)):
        share = matching(case, trails) / matching(case, "StereoBM")
        found.append(Goal(f"trails, {case}: to StereoBM", False, limit, share))
    wide = matching("corridor, 256 px", trails) / matching(corridor, trails)
    found.append(Goal("trails, corridor: 256 px to 64 px", False, 1.1, wide))
    fast, default = run("--preset fast, default outputs"), run("motionstereo, default outputs")
    for what, cost, script, limit in (
        ("--preset fast", fast, "StereoBM", 0.5),
        ("default matcher", default, "StereoSGBM", 0.6),
    ):
        share = cost.work_s / run(f"script, {script}").work_s
        found.append(Goal(f"{what}, default outputs: to the {script} script", False, limit, share))
    share = run("--preset fast, steering").work_s / run("decoding alone").work_s
    found.append(Goal("--preset fast, steering: to decoding alone", False, 4, share))
    busy = (fast.cpu_s or math.nan) / (cores * fast.seconds)
    found.append(Goal("--preset fast: processor time to cores times wall time", True, 0.92, busy))
    found.append(
        Goal(
            "processing: exponent of the growth with pixels", False, 1.05, _exponent(medians, sizes)
        )
    )
    found.append(Goal("--preset fast: peak MB", False, 150, fast.peak_mb or math.nan))
    peaks = {
        int(key.case.split()[0]): cost.peak_mb or math.nan
        for key, cost in medians.items()
        if (key.part, key.contestant) == ("growth", "run")
    }
    if peaks:
        few, many = 500 if 500 in peaks else min(peaks), max(peaks)
        growth = peaks[many] / peaks[few]
        found.append(Goal(f"run: peak MB of {many} frames to {few}", False, 1.05, growth))
    for what, limit_s in (("motionstereo --help", 0.15), ("motionstereo run, 2 frames", 0.5)):
        found.append(Goal(f"{what}: s", False, limit_s, run(what, "startup").work_s))
    found.append(Goal("installed size in MB", False, 350, installed_mb))
    return [goal for goal in found if not math.isnan(goal.got)]


def _exponent(medians: Mapping[Key, Cost], sizes: Sequence[tuple[int, int]]) -> float:
    """Return p where time grows with pixels to the power of p, by least squares of logarithms."""
    keys = [Key("growth", f"{w}x{h}", "processing a frame", 1) for w, h in sizes]
    seconds = [medians.get(key, _UNKNOWN).seconds for key in keys]
    if math.isnan(sum(seconds)):
        return math.nan
    pixels = [width * height for width, height in sizes]
    return float(np.polyfit(np.log(pixels), np.log(seconds), 1)[0])


def format_markdown(
    medians: Mapping[Key, Cost], parts: Mapping[str, str], reached: Sequence[Goal]
) -> str:
    """Return a table for each part, and one of the goals.

    A number of cores has a column of median times, one of processor times where they were
    measured, and, in the parts where contestants do the same work, one of ratios to the first
    contestant of a case: of processor time, or else of time.

    Args:
        medians: what was measured.
        parts: what each part measures, by its name.
        reached: the goals.
    """
    lines = []
    for part, said in parts.items():
        mine = {key: cost for key, cost in medians.items() if key.part == part}
        lines += [f"{part}: {said}", "", _table(mine, speeds=part in _RACES), ""]
    rows = [
        (
            goal.what,
            f"at {'least' if goal.least else 'most'} {goal.limit:g}",
            f"{goal.got:.3g}",
            "reached" if goal.reached else "missed",
        )
        for goal in reached
    ]
    if rows:
        lines.append(table(["goal", "wanted", "got", ""], rows))
    return "\n".join(lines)


def _table(medians: Mapping[Key, Cost], *, speeds: bool) -> str:
    cores = sorted({key.cores for key in medians})
    heads = ["case", "contestant"]
    measured_cpu = any(cost.cpu_s is not None for cost in medians.values())
    for n in cores:
        heads += [f"ms, {n} core{'s' * (n > 1)}", *["processor ms"] * measured_cpu]
        heads += ["first = 1"] * speeds
    measured_mb = any(cost.peak_mb for cost in medians.values())
    heads += ["peak MB"] * measured_mb
    rows = []
    first: dict[str, str] = {}
    for part, case, contestant in dict.fromkeys(key[:3] for key in medians):
        reference = first.setdefault(case, contestant)
        cells, peak_mb = [case, contestant], None
        for n in cores:
            cost = medians.get(Key(part, case, contestant, n), _UNKNOWN)
            cells.append(_number(1000 * cost.seconds))
            if measured_cpu:
                cells.append(_number(1000 * (math.nan if cost.cpu_s is None else cost.cpu_s)))
            if speeds:
                base = medians.get(Key(part, case, reference, n), _UNKNOWN)
                cells.append(_number(cost.work_s / base.work_s))
            peak_mb = cost.peak_mb or peak_mb
        rows.append(cells + [_number(peak_mb or math.nan)] * measured_mb)
    return table(heads, rows)


def _number(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.3g}" if value < 100 else f"{value:.0f}"
