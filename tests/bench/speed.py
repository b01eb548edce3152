"""How fast, against what people would pick instead: ``python -m bench speed``.

Contestants see the same frames and take turns, round by round: whatever else the machine does, it
does to all of them. Tables and JSON give medians over the rounds.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import os
import platform
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from tqdm import tqdm

from bench import decode, script
from bench.accuracy import RUN_IN
from bench.clips import Clip, first_frames, rendered, repeated
from bench.speed_report import format_markdown, goals
from bench.timing import Cost, Samples, core_count, installed_mb, on_cores, python
from motionstereo_cli import pipeline
from motionstereo_cli.errors import MotionStereoError
from motionstereo_cli.method import matching, memory
from motionstereo_cli.method.block_matching import bm_matcher, sgbm_matcher
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.robot.guide import ImageGuide
from motionstereo_cli.robot.tracker import Tracker
from motionstereo_cli.runs.record import versions
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.sinks.outputs import DEFAULT_OUTPUTS

if TYPE_CHECKING:
    from motionstereo_cli.types import Grey, Rig, StereoFrame

NOISE_SIGMA = 1.5  # grey levels

#: What ``--preset fast`` is.
FAST = Settings(matcher="trails")
BASELINE_M = 0.12  # at the width of the plan

#: Frames used where frames are timed by themselves: the run-in is not timed.
FRAMES = RUN_IN + 6

#: What a run is called that nobody has set anything for.
DEFAULT = "motionstereo, default outputs"


@dataclass(frozen=True, slots=True)
class Plan:
    """How large the benchmark is.

    Attributes:
        width, height: size of the images in px, where it is not the subject.
        corridor: frames rendered, to be shown there and back.
        long_times: how often that is repeated in the run on several cores.
        sizes: widths and heights in px of the growth.
        ranges: disparities in px, of the matching and of the growth.
        lengths: numbers of frames of the growth.
        large: scenes, widths, heights and ranges in px of whole runs with the default matcher.
    """

    width: int = 640
    height: int = 480
    corridor: str = "250:325"
    long_times: int = 2
    sizes: tuple[tuple[int, int], ...] = (
        (320, 240),
        (640, 480),
        (1280, 720),
        (1920, 1080),
        (3840, 2160),
    )
    ranges: tuple[tuple[int, ...], tuple[int, ...]] = (64, 128, 256), (32, 64, 128, 256, 512)
    lengths: tuple[int, ...] = (100, 500, 10_000)
    large: tuple[tuple[str, int, int, int], ...] = (
        ("corridor", 1920, 1080, 256),
        ("street", 1920, 1080, 256),
        ("corridor", 3840, 2160, 512),
    )


QUICK = Plan(
    width=160,
    height=120,
    corridor="250:262",
    long_times=1,
    sizes=((80, 60), (160, 120)),
    ranges=((64, 96), (16, 32)),
    lengths=(20, 40),
    large=(("corridor", 160, 120, 32),),
)


class Bench:
    """The recordings, and what was measured on them.

    Args:
        folder: an empty folder for recordings and results.
        plan: how large everything is.
        rounds: how often everything is measured.
        recording: left and right video of one more recording to match.
    """

    def __init__(
        self, folder: Path, plan: Plan, rounds: int, recording: tuple[Path, Path] | None
    ) -> None:
        self.folder = folder
        self.plan = plan
        self.rounds = rounds
        self.recording = recording
        self.samples = Samples()
        self.all_cores = core_count()
        self._clips: dict[str, Clip] = {}

    def clip(self, name: str, *, back: bool = False, **scene: Any) -> Clip:
        """Return a rendered recording, made when its name first comes up."""
        if name not in self._clips:
            plan = self.plan
            size = {"width": plan.width, "height": plan.height, "baseline_m": BASELINE_M}
            settings = SimulateSettings(**size | {"noise_sigma": NOISE_SIGMA} | scene)
            self._clips[name] = rendered(self.folder / name, settings, back=back)
        return self._clips[name]

    @property
    def corridor(self) -> Clip:
        """The paper's corridor."""
        return self.clip("corridor", frames=self.plan.corridor, back=True)

    @functools.cached_property
    def long(self) -> Clip:
        """The corridor over and over, for what includes start-up."""
        return repeated(self.corridor, self.folder / "long", self.plan.long_times)

    @property
    def cards(self) -> Clip:
        """Fine texture, all of it in motion."""
        return self.clip("cards", scene="cards", pan=True, frames=str(FRAMES), back=True)

    @functools.cached_property
    def long_cards(self) -> Clip:
        """Cards over and over, about as long as the corridor."""
        times = -(-self.long.count // self.cards.count)
        return repeated(self.cards, self.folder / "long_cards", times)

    def turns(self) -> Iterator[int]:
        """Yield the number of cores to use: one, then all, in each round."""
        for _ in range(self.rounds):
            for cores in dict.fromkeys((1, self.all_cores)):
                with on_cores(cores):
                    yield cores


@contextlib.contextmanager
def stage_clock() -> Iterator[dict[str, float]]:
    """Clock what the pipeline calls: its stages and its own larger steps, in s by name.

    So stages are timed in their place, on what they get there. The larger steps contain stages:
    the times are not to be added up.
    """
    seconds: defaultdict[str, float] = defaultdict(float)

    def clocked(name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any, **options: Any) -> Any:
            started_s = time.perf_counter()
            result = call(*args, **options)
            seconds[name] += time.perf_counter() - started_s
            return result

        return timed

    steps: list[tuple[Any, str, str]] = [
        (pipeline, "see", "see"),
        (pipeline, "match", "match"),
        (Tracker, "regions", "Tracker.regions"),
        (Tracker, "follow", "Tracker.follow"),
        (ImageGuide, "profile", "ImageGuide.profile"),
        (ImageGuide, "steer", "ImageGuide.steer"),
    ]
    # Where they are looked up.
    looked_up = {
        memory: ("blur", "bands", "motion", "permanency", "accumulate", "match_keys"),
        matching: (
            *("match_trails", "balanced", "match_dense", "residual"),
            *("without_speckles", "filled", "confidence"),
        ),
        pipeline: ("depth_of",),
    }
    for owner, names in looked_up.items():
        for name in names:
            module = getattr(owner, name).__module__.rpartition(".")[2]
            steps.append((owner, name, f"{module}.{name}"))
    calls = [getattr(owner, name) for owner, name, _ in steps]
    try:
        for (owner, name, shown), call in zip(steps, calls, strict=True):
            setattr(owner, name, clocked(shown, call))
        yield seconds
    finally:
        for (owner, name, _), call in zip(steps, calls, strict=True):
            setattr(owner, name, call)


def processing_s(frames: Sequence[StereoFrame], settings: Settings, rig: Rig) -> dict[str, float]:
    """Return the s per frame of processing, after the run-in: all of it, then by step."""
    with stage_clock() as clock:
        results = pipeline.process(frames, settings, rig)
        for _ in islice(results, RUN_IN):
            pass
        clock.clear()
        started_s = time.perf_counter()
        count = sum(1 for _ in results)
        total_s = time.perf_counter() - started_s
    return {name: s / count for name, s in {"processing": total_s, **clock}.items()}


def bench_stages(bench: Bench) -> None:
    """Time each stage in the processing of a frame, both views together."""
    cases = {
        f"{name}{preset}": (clip.frames(FRAMES), settings, clip.rig)
        for name, clip in (("corridor", bench.corridor), ("cards panning", bench.cards))
        for preset, settings in (("", Settings()), (", fast", FAST))
    }
    for case in cases.values():
        processing_s(*case)  # warm-up
    for cores in bench.turns():
        for name, case in cases.items():
            for stage, seconds in processing_s(*case).items():
                bench.samples.add("stages", name, stage, cores, Cost(seconds))


@dataclass(frozen=True, slots=True)
class Look:
    """One moment, ready to be matched.

    Attributes:
        right, left: our memories.
        mirrored: right and left view mirrored, by which cv2 matches the right one.
    """

    right: memory.Memory
    left: memory.Memory
    mirrored: tuple[Grey, Grey]


def looks(frames: Sequence[StereoFrame], settings: Settings) -> list[Look]:
    """Return the moments after the run-in."""
    right = left = None
    found = []
    for number, frame in enumerate(frames):
        right = memory.see(right, frame.right, settings)
        left = memory.see(left, frame.left, settings)
        if number >= RUN_IN:
            mirrored = _mirrored(frame.right), _mirrored(frame.left)
            found.append(Look(right, left, mirrored))
    return found


def _mirrored(view: Grey) -> Grey:
    return np.ascontiguousarray(view[:, ::-1])


def matching_costs(seen: Sequence[Look], max_disparity: int) -> dict[str, Cost]:
    """Return what matching costs per frame, by contestant.

    Of cv2 ``compute`` alone is timed. Making the matcher, mirroring the views, mirroring the
    disparities back and turning them into px are not, nor does cv2 clean its result: all in its
    favour.
    """
    peers = {
        "StereoBM": bm_matcher,
        "StereoSGBM": sgbm_matcher,
        "StereoSGBM, 3-way": _three_way_matcher,
    }
    calls: dict[str, Callable[[Look], object]] = {}
    for name, make in peers.items():
        calls[name] = functools.partial(_compute, make(max_disparity))
    for name, matcher in (("motionstereo, trails", "trails"), ("motionstereo, dense", "dense")):
        calls[name] = functools.partial(
            _match, Settings(matcher=matcher, max_disparity=max_disparity)
        )
    found = {}
    for name, call in calls.items():
        started_s, cpu_s = time.perf_counter(), time.process_time()
        for look in seen:
            call(look)
        cost_s = time.perf_counter() - started_s, time.process_time() - cpu_s
        found[name] = Cost(cost_s[0] / len(seen), cpu_s=cost_s[1] / len(seen))
    return found


def _three_way_matcher(max_disparity: int) -> cv2.StereoMatcher:
    matcher: Any = sgbm_matcher(max_disparity)
    matcher.setMode(cv2.STEREO_SGBM_MODE_SGBM_3WAY)
    return matcher  # type: ignore[no-any-return]


def _compute(matcher: cv2.StereoMatcher, look: Look) -> None:
    matcher.compute(*look.mirrored)


def _match(settings: Settings, look: Look) -> None:
    matching.match(look.right, look.left, settings, with_confidence=False)


def bench_matching(bench: Bench) -> None:
    """Time matching alone, a frame, from what is prepared to a disparity image."""
    recordings = [
        (f"corridor, {px} px", bench.corridor.frames(FRAMES), px) for px in bench.plan.ranges[0]
    ]
    recordings.append(("cards panning, 64 px", bench.cards.frames(FRAMES), 64))
    if bench.recording:
        recordings.append(("recording given, 64 px", first_frames(*bench.recording, FRAMES), 64))
    cases = {}
    for name, frames, px in recordings:
        cases[name] = looks(frames, Settings()), px
        if not cases[name][0]:
            raise RuntimeError(f"the {name} needs more than {RUN_IN} frames: give a longer one")
        matching_costs(*cases[name])  # warm-up
    for cores in bench.turns():
        for name, case in cases.items():
            for contestant, cost in matching_costs(*case).items():
                bench.samples.add("matching", name, contestant, cores, cost)


def run_command(clip: Clip, out: Path, *options: str | Path) -> list[str | Path]:
    """Return the arguments that make Python run motionstereo on a recording."""
    given = (*clip.paths, "--rig", clip.rig_file, "--out", out, "--overwrite", *options)
    return ["-m", "motionstereo_cli", "run", *given]


def bench_run(bench: Bench) -> None:
    """Time the whole run, from two files to the results, start-up and all."""
    clip, out = bench.long, bench.folder / "run_out"
    plain = _script(bench, clip)
    fast, poses = ("--preset", "fast"), ("--poses", "auto")
    objects = "--save", ",".join([*DEFAULT_OUTPUTS, "objects"])
    contestants: dict[tuple[str, str], list[str | Path]] = {
        ("corridor", "script, StereoBM"): plain,
        ("corridor", "script, StereoBM, two videos"): [*plain, "--videos"],
        ("corridor", "decoding alone"): [decode.__file__, *clip.paths],
        ("corridor", "--preset fast, default outputs"): run_command(clip, out, *fast),
        ("corridor", "--preset fast, the script's"): run_command(
            clip, out, *fast, "--save", "steering,depth"
        ),
        ("corridor", "--preset fast, steering"): run_command(
            clip, out, *fast, "--save", "steering"
        ),
        ("corridor", "script, StereoSGBM"): [*plain, "--sgbm"],
        ("corridor", DEFAULT): run_command(clip, out),
        ("corridor", "motionstereo, wide range"): run_command(
            clip, out, "--max-disparity", str(bench.plan.ranges[0][-1])
        ),
        ("corridor", "motionstereo, poses found"): run_command(clip, out, *poses),
        ("corridor", "motionstereo, poses and objects"): run_command(clip, out, *poses, *objects),
        ("cards panning", "script, StereoSGBM"): [*_script(bench, bench.long_cards), "--sgbm"],
        ("cards panning", DEFAULT): run_command(bench.long_cards, out),
    }
    python(*contestants["corridor", DEFAULT])  # warm-up
    for _ in range(bench.rounds):
        for (case, name), arguments in contestants.items():
            bench.samples.add("run", case, name, bench.all_cores, python(*arguments))


def _script(bench: Bench, clip: Clip) -> list[str | Path]:
    rig = str(clip.rig.focal_px), str(clip.rig.baseline_m)
    return [script.__file__, *clip.paths, bench.folder / "script_out", *rig]


def bench_jobs(bench: Bench) -> None:
    """Time the run of a longer video with --jobs 1 and 2, and compare the bytes."""
    clip = bench.long
    outs = {jobs: bench.folder / f"jobs_{jobs}" for jobs in (1, 2)}
    for _ in range(bench.rounds):
        for jobs, out in outs.items():
            cost = python(*run_command(clip, out, "--preset", "fast", "--jobs", str(jobs)))
            case = f"{clip.count} frames"
            bench.samples.add("jobs", case, f"--jobs {jobs}", bench.all_cores, cost)
    if contents(outs[1]) != contents(outs[2]):
        raise RuntimeError("--jobs 2 gives other bytes than --jobs 1")


def contents(out: Path) -> dict[Path, bytes]:
    """Return the bytes of all results of a run but run.json, by their names."""
    files = (path for path in out.rglob("*") if path.is_file() and path.name != "run.json")
    return {path.relative_to(out): path.read_bytes() for path in files}


def bench_growth(bench: Bench) -> None:
    """Measure how time and memory grow with pixels, disparities and frames."""
    plan, out = bench.plan, bench.folder / "growth_out"
    cases = {}
    for width, height in plan.sizes:
        # The baseline shrinks as the images grow, so that disparities in px stay the same.
        clip = bench.clip(
            f"{width}x{height}",
            width=width,
            height=height,
            baseline_m=BASELINE_M * plan.width / width,
            frames=f"250:{250 + FRAMES}",
        )
        cases[f"{width}x{height}"] = clip, FAST
    sizes = list(cases.items())
    for px in plan.ranges[1]:
        cases[f"{px} px"] = bench.corridor, Settings(matcher="trails", max_disparity=px)
    for _ in range(bench.rounds):
        with on_cores(1):
            for name, (clip, settings) in cases.items():
                seconds = processing_s(clip.frames(FRAMES), settings, clip.rig)["processing"]
                bench.samples.add("growth", name, "processing a frame", 1, Cost(seconds))
    for name, (clip, _) in sizes:
        cost = python(*run_command(clip, out, "--preset", "fast", "--no-check"))
        bench.samples.add("growth", name, f"run of {FRAMES} frames", bench.all_cores, cost)

    times = -(-max(plan.lengths) // bench.corridor.count)
    longest = repeated(bench.corridor, bench.folder / "longest", times)
    for count in plan.lengths:
        options = "--preset", "fast", "--save", "steering,charge", "--end", str(count)
        cost = python(*run_command(longest, out, *options))
        bench.samples.add("growth", f"{count} frames", "run", bench.all_cores, cost)


def bench_large(bench: Bench) -> None:
    """Time whole default runs on the images of today's cameras, a frame, without the start."""
    out = bench.folder / "large_out"
    for scene, width, height, px in bench.plan.large:
        case = f"{scene}, {width}x{height}, {px} px"
        frames = f"250:{250 + FRAMES}" if scene == "corridor" else str(FRAMES)
        clip = bench.clip(case, scene=scene, width=width, height=height, frames=frames)
        run = run_command(clip, out, "--max-disparity", str(px), "--no-check")
        for _ in range(bench.rounds):
            few, all_ = python(*run, "--end", str(FRAMES // 2)), python(*run)
            more = FRAMES - FRAMES // 2
            cost = Cost(
                (all_.seconds - few.seconds) / more,
                all_.peak_mb,
                ((all_.cpu_s or 0) - (few.cpu_s or 0)) / more,
            )
            bench.samples.add("large", case, "motionstereo, a frame", bench.all_cores, cost)


def bench_startup(bench: Bench) -> None:
    """Time what it takes to begin."""
    two = run_command(bench.corridor, bench.folder / "two_out", "--end", "2", "--preset", "fast")
    contestants: dict[str, list[str | Path]] = {
        "python -c pass": ["-c", "pass"],
        "motionstereo --help": ["-m", "motionstereo_cli", "--help"],
        "motionstereo run, 2 frames": two,
    }
    for arguments in contestants.values():
        python(*arguments)  # warm-up
    for _ in range(3 * bench.rounds):
        for name, arguments in contestants.items():
            bench.samples.add("startup", "start to exit", name, bench.all_cores, python(*arguments))


PARTS: dict[str, Callable[[Bench], None]] = {
    "stages": bench_stages,
    "matching": bench_matching,
    "run": bench_run,
    "jobs": bench_jobs,
    "growth": bench_growth,
    "large": bench_large,
    "startup": bench_startup,
}


def machine() -> dict[str, Any]:
    """Return what the figures depend on besides the code."""
    return {
        "cores": core_count(),
        "processor": platform.processor() or platform.machine(),
        "load_at_start": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "versions": versions(),
    }


def main(args: Sequence[str] | None = None) -> None:
    """Measure, print the tables as Markdown on standard output, and write the JSON."""
    parser = argparse.ArgumentParser(prog="python -m bench speed")
    parser.add_argument(
        "--parts", default=",".join(PARTS), help="comma list of what to measure [%(default)s]"
    )
    parser.add_argument("--rounds", type=int, default=3, help="how often [%(default)s]")
    parser.add_argument("--left", type=Path, help="left video of one more recording to match")
    parser.add_argument("--right", type=Path, help="its right video")
    parser.add_argument("--json", type=Path, default=Path("out/bench.json"), help="[%(default)s]")
    parser.add_argument("--quick", action="store_true", help="tiny and once: does it run?")
    given = parser.parse_args(args)
    parts = given.parts.split(",")
    if unknown := set(parts) - set(PARTS):
        parser.error(f"--parts: no {', '.join(sorted(unknown))}: choose from {', '.join(PARTS)}")
    if given.rounds < 1:
        parser.error("--rounds: give at least 1")
    if (given.left is None) != (given.right is None):
        parser.error("--left and --right: give both")

    recording = (given.left, given.right) if given.left else None
    plan, rounds = (QUICK, 1) if given.quick else (Plan(), given.rounds)
    report: dict[str, Any] = {"machine": machine(), "rounds": rounds}
    failure = None
    with tempfile.TemporaryDirectory() as folder, tqdm(parts, unit="part", disable=None) as bar:
        bench = Bench(Path(folder), plan, rounds, recording)
        for part in bar:
            bar.set_description(part)
            try:
                PARTS[part](bench)
            except (MotionStereoError, RuntimeError) as error:
                failure = f"error: {part}: {error}"  # what the others gave is still worth showing
            except KeyboardInterrupt:
                failure = f"error: {part}: interrupted"
                break
    medians = bench.samples.medians()
    size_mb = installed_mb("motionstereo")
    reached = goals(medians, plan.sizes, bench.all_cores, sum(size_mb.values()))
    print(format_markdown(medians, {part: PARTS[part].__doc__ or "" for part in parts}, reached))
    report["rows"] = [
        {**key._asdict(), **asdict(cost), "samples_s": bench.samples.seconds(key)}
        for key, cost in medians.items()
    ]
    report["installed_mb"] = size_mb
    report["goals"] = [{**asdict(goal), "reached": goal.reached} for goal in reached]
    given.json.parent.mkdir(parents=True, exist_ok=True)
    given.json.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    if failure is not None:
        sys.exit(failure)
