"""What becomes of runs that go wrong: ``python -m bench torture``.

Damaged input, kill -9, full disks, other threads and settings of the system, and a long run. The
trials are drawn from a seed, so that each can be had again.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from resource import getpagesize
from typing import Any

import av
import cv2
import numpy as np
from tqdm import tqdm

from bench.children import Ended, call, fork, warm_up
from bench.clips import Clip, rendered, repeated
from bench.damage import DAMAGES, encoded, seen_in_image, seen_in_video
from bench.hostile import hostile
from bench.markdown import table
from motionstereo_cli.runs.plan import RunPlan
from motionstereo_cli.runs.run import Watcher, run
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.sinks.outputs import OUTPUTS

#: A child that runs for so long hangs, whatever else the machine does.
_PATIENCE_S = 60.0

#: Beyond this many times the processor time of an undamaged input, a damaged one is slow; the
#: seconds are for the clock's coarseness.
_SLOW = 3.0
_SLOW_S = 0.1

#: All outputs that can be had without poses.
_SAVES = [name for name, save in OUTPUTS.items() if not save.needs_poses]
_ALL_SAVES = ",".join(_SAVES)


@dataclass(slots=True)
class Verdict:
    """What a part found.

    Attributes:
        part: its name.
        trials: how many there were, in words.
        goal: what has to hold.
        found: what does.
        failures: what does not, a line each.
    """

    part: str
    trials: str
    goal: str
    found: str = ""
    failures: list[str] = field(default_factory=list)


def render(folder: Path, frames: int = 30, width: int = 160) -> Clip:
    """Render a short clip with noise, of cards before a wall."""
    settings = SimulateSettings(
        scene="cards",
        frames=str(frames),
        width=width,
        height=width * 3 // 4,
        focal_px=width * 0.87,
        noise_sigma=1.5,
    )
    return rendered(folder, settings)


# Damaged input.


@dataclass(frozen=True, slots=True)
class _Sample:
    """An undamaged input.

    Attributes:
        kind: what it is.
        args: inputs of the run, ``{}`` for what is damaged.
        path: the file, or folder of files.
        seen: whether a plain decoder sees the damage in a file.
        cpu_s: processor time of a run.
    """

    kind: str
    args: tuple[str, ...]
    path: Path
    seen: Callable[[Path], bool]
    cpu_s: float = 0.0


_VIDEOS = {
    "MP4, H.264": ("h264.mp4", "libx264", "yuv420p"),
    "MKV, H.264": ("h264.mkv", "libx264", "yuv420p"),
    "MKV, FFV1": ("ffv1.mkv", "ffv1", "gray"),
    "AVI, MPEG-4": ("mpeg4.avi", "mpeg4", "yuv420p"),
    "AVI, MJPEG": ("mjpeg.avi", "mjpeg", "yuvj420p"),
}


def _samples(clip: Clip, folder: Path) -> list[_Sample]:
    frames = clip.frames(clip.count)
    right = str(clip.paths[1])
    samples = []
    for kind, (name, codec, pixel_format) in _VIDEOS.items():
        encoded(folder / name, [frame.left for frame in frames], codec, pixel_format)

        def seen(path: Path) -> bool:
            return seen_in_video(path, clip.count)

        samples.append(_Sample(kind, ("{}", right), folder / name, seen))
    images = folder / "images"
    images.mkdir()
    for frame in frames:
        if not cv2.imwrite(str(images / f"{frame.index:06d}.png"), frame.left):
            raise OSError(f"cannot write {images}")
    samples.append(_Sample("PNG folder", ("{}", right), images, seen_in_image))
    rig, both = clip.rig, (str(clip.paths[0]), right, "--rig", "{}")
    opencv = folder / "opencv.yml"
    matrix = np.array([[rig.focal_px, 0, rig.cx], [0, rig.focal_px, rig.cy], [0, 0, 1]])
    lens, none = np.array([-0.02, 0.01, 0, 0, 0]), np.array([0.0, 0, 0, 0, 0])
    storage = cv2.FileStorage(str(opencv), cv2.FILE_STORAGE_WRITE)
    values: dict[str, Any] = {
        **{"image_width": rig.width, "image_height": rig.height, "R": np.eye(3)},
        **{"M1": matrix, "D1": lens, "M2": matrix, "D2": none},
        "T": np.array([-rig.baseline_m, 0, 0]),
    }
    for name, value in values.items():
        storage.write(name, value)
    storage.release()
    kitti = folder / "calib.txt"
    row = f"{rig.focal_px} 0 {rig.cx} {{}} 0 {rig.focal_px} {rig.cy} 0 0 0 1 0"
    kitti.write_text(f"P0: {row.format(0)}\nP1: {row.format(-rig.focal_px * rig.baseline_m)}\n")
    # A reader of text cannot tell a wrong number from a right one.
    for kind, path in (("rig.yaml", clip.rig_file), ("OpenCV YAML", opencv), ("KITTI", kitti)):
        samples.append(_Sample(f"calibration, {kind}", both, path, lambda _: False))
    return samples


def damaged(clip: Clip, folder: Path, trials: Sequence[int], seed: int) -> Verdict:
    """Run on damaged input; each of ``trials`` is a number that tells which."""
    verdict = Verdict(
        "damaged input",
        f"{len(trials)}: {', '.join(DAMAGES)}; {', '.join(_VIDEOS)}, PNG folders, calibration",
        "no traceback, no signal, not over 3x the undamaged processor time; what a plain decoder "
        "sees is reported",
    )
    out = folder / "out"
    samples = []
    for sample in _samples(clip, folder):
        clean = [_run_on(sample, sample.path, out) for _ in range(3)]
        for each in clean:
            if each.exit_code:
                raise RuntimeError(f"{sample.kind}: exit code {each.exit_code}: {each.said}")
        cpu_s = sorted(each.cpu_s for each in clean)[1]
        samples.append(_Sample(sample.kind, sample.args, sample.path, sample.seen, cpu_s))
    exits: Counter[int] = Counter()
    seen_count, slowest = 0, 0.0
    for number in tqdm(trials, desc="damaged", unit="input", disable=None):
        sample = samples[number % len(samples)]
        chance = random.Random(f"{seed} {number}")
        damage = list(DAMAGES)[number // len(samples) % len(DAMAGES)]
        spoilt, victim = _spoil(sample.path, folder / "spoilt", damage, chance)
        seen = sample.seen(victim)
        ended = _run_on(sample, spoilt, out)
        exits[ended.exit_code] += 1
        seen_count += seen
        slowest = max(slowest, ended.cpu_s / sample.cpu_s)
        faults = list(_faults(ended, sample.cpu_s, seen=seen, out=out))
        verdict.failures += [f"trial {number}, {sample.kind}, {damage}: {f}" for f in faults]
    codes = ", ".join(f"{code}: {n}" for code, n in sorted(exits.items()))
    verdict.found = (
        f"exit codes {codes}; {seen_count} seen by a plain decoder; "
        f"at most {slowest:.1f}x the processor time"
    )
    return verdict


def _spoil(path: Path, folder: Path, damage: str, chance: random.Random) -> tuple[Path, Path]:
    """Copy a file, or a folder of files, into a new folder, and damage the file, or one of them.

    Returns:
        the copy, and the damaged file.
    """
    shutil.rmtree(folder, ignore_errors=True)
    if path.is_dir():
        copy = Path(shutil.copytree(path, folder))
        victim = chance.choice(sorted(copy.iterdir()))
    else:
        folder.mkdir()
        copy = victim = Path(shutil.copy(path, folder))
    victim.write_bytes(DAMAGES[damage](victim.read_bytes(), chance))
    return copy, victim


def _run_on(sample: _Sample, target: Path, out: Path) -> Ended:
    shutil.rmtree(out, ignore_errors=True)
    given = [each.format(target) for each in sample.args]
    options = ["--save", "steering,charge", "--no-check", "--jobs", "1", "-o", str(out)]
    return call(["run", *given, *options], seconds=_PATIENCE_S)


def _faults(ended: Ended, clean_cpu_s: float, *, seen: bool, out: Path) -> Iterator[str]:
    if ended.killed:
        yield f"hung for {_PATIENCE_S:.0f} s"
    elif ended.exit_code not in (0, 1, 3):
        yield f"exit code {ended.exit_code}: {ended.said[-300:]}"
    elif ended.exit_code == 1 and len(ended.errors) != 1:
        yield f"exit code 1 with {len(ended.errors)} lines of error: {ended.said[-300:]}"
    elif ended.exit_code == 0 and seen:
        yield "damage went unsaid"
    elif (out / "run.json").exists() != (ended.exit_code in (0, 3)):
        yield f"run.json does not go with exit code {ended.exit_code}"
    if ended.crashed:
        yield ended.said[-300:]
    if ended.cpu_s > _SLOW * clean_cpu_s + _SLOW_S:
        yield f"took {ended.cpu_s:.1f} s, {ended.cpu_s / clean_cpu_s:.1f} times the undamaged"


# The same run, however it comes about.


def digest(out: Path) -> dict[str, str]:
    """Return a hash for each file in a folder: of the images of videos, of run.json but for times.

    Raises:
        OSError, ValueError, LookupError: a video or run.json is not whole.
    """
    hashes = {}
    for path in sorted(path for path in out.rglob("*") if path.is_file()):
        if path.name == "run.json":
            record = json.loads(path.read_bytes())
            del record["timing"]
            content = json.dumps(record).encode()
        elif path.suffix in (".mp4", ".mkv"):
            content = _images(path)
        else:
            content = path.read_bytes()
        hashes[str(path.relative_to(out))] = hashlib.sha256(content).hexdigest()
    return hashes


def _images(path: Path) -> bytes:
    sums = hashlib.sha256()
    with av.open(str(path)) as container:
        for frame in container.decode(video=0):
            sums.update(f"{frame.pts} {frame.time_base} {frame.is_corrupt}".encode())
            sums.update(frame.to_ndarray().tobytes())
    return sums.digest()


def _difference(found: dict[str, str], expected: dict[str, str]) -> str:
    """Return which files differ, nothing if none does."""
    names = [n for n in sorted({*found, *expected}) if found.get(n) != expected.get(n)]
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(names[:3]) + more


def killed(clip: Clip, folder: Path, trials: Sequence[int], seed: int) -> Verdict:
    """Kill runs at random moments, and have them go on."""
    every = clip.count // 3
    verdict = Verdict(
        "kill -9, then --resume",
        f"{len(trials)} random moments",
        "all outputs as those of an undisturbed run; at most one checkpoint interval done again",
    )
    out = folder / "out"
    command = [
        *("run", *map(str, clip.paths), "--rig", str(clip.rig_file), "--save"),
        *(_ALL_SAVES, "--jobs", "2", "--checkpoint-frames", str(every)),
        *("--no-check", "--resume", "-o", str(out)),
    ]
    whole = call(command, seconds=_PATIENCE_S)
    if whole.exit_code:
        raise RuntimeError(whole.said)
    expected = digest(out)
    identical, resumed_runs, most_again = 0, 0, 0
    for number in tqdm(trials, desc="killed", unit="kill", disable=None):
        shutil.rmtree(out)
        chance = random.Random(f"{seed} {number}")
        call(command, seconds=chance.uniform(0, whole.wall_s))
        done = _rows(out)
        again = call(command, seconds=_PATIENCE_S)
        before = re.search(r"(\d+) of them before", again.said)
        resumed = int(before[1]) if before else clip.count if "already" in again.said else 0
        resumed_runs += resumed > 0
        most_again = max(most_again, done - resumed)
        difference = _difference(digest(out), expected)
        if again.exit_code or difference:
            verdict.failures.append(
                f"trial {number}: exit code {again.exit_code}, {difference} {again.said[-300:]}"
            )
        else:
            identical += 1
        if done - resumed > every:
            verdict.failures.append(
                f"trial {number}: {done - resumed} frames were done again, an interval is {every}"
            )
    verdict.found = (
        f"{identical} of {len(trials)} identical, {resumed_runs} of them from a checkpoint; at "
        f"most {most_again} frames again (an interval is {every})"
    )
    return verdict


def _rows(out: Path) -> int:
    """Return for how many frames a run wrote a row before it was ended."""
    for name in ("steering.csv", "steering.csv.part"):
        if (out / name).exists():
            content = (out / name).read_bytes()
            return max(content.count(b"\n") - 1, 0)
    return 0


def full(clip: Clip, folder: Path, trials: Sequence[int], seed: int) -> Verdict:
    """Let files grow up to a limit alone, as if the disk were full, and then have runs go on."""
    verdict = Verdict(
        "disk full (file-size limit)",
        f"{len(trials)} points, every kind of output",
        "exit code 1, one line with the path, nothing incomplete under a final name; --resume "
        "with room gives the same outputs",
    )
    out = folder / "out"
    base = ["run", *map(str, clip.paths), "--rig", str(clip.rig_file), "--no-check"]
    base += ["--checkpoint-frames", str(max(2, clip.count // 6)), "-o", str(out)]
    good = 0
    for number in tqdm(trials, desc="disk", unit="disk", disable=None):
        shutil.rmtree(out, ignore_errors=True)
        chance = random.Random(f"{seed} {number}")
        name = _SAVES[number % len(_SAVES)]
        command = [*base, "--save", name]
        if call(command, seconds=_PATIENCE_S).exit_code:
            raise RuntimeError(f"--save {name} fails without a limit")
        expected = digest(out)
        largest = max(path.stat().st_size for path in out.rglob("*") if path.is_file())
        shutil.rmtree(out)
        limit = chance.randrange(largest)
        ended = call(command, seconds=_PATIENCE_S, largest_file_bytes=limit)
        faults = list(_disk_faults(ended, out, expected))
        again = call([*command, "--resume"], seconds=_PATIENCE_S)
        if again.exit_code:
            faults.append(f"--resume: exit code {again.exit_code}, {again.said[-300:]}")
        elif difference := _difference(digest(out), expected):
            faults.append(f"--resume: {difference} differ")
        good += not faults
        verdict.failures += [f"trial {number}, {name} with {limit} bytes: {f}" for f in faults]
    verdict.found = f"{good} of {len(trials)}"
    return verdict


def _disk_faults(ended: Ended, out: Path, expected: dict[str, str]) -> Iterator[str]:
    if ended.exit_code != 1 or len(ended.errors) != 1 or str(out) not in ended.errors[0]:
        yield f"exit code {ended.exit_code}: {ended.said[-300:]}"
    if ended.crashed:
        yield ended.said[-300:]
    for path in sorted(path for path in out.rglob("*") if path.is_file()):
        name = str(path.relative_to(out))
        if name in expected and digest_of(path) != expected[name]:
            yield f"{name} is incomplete"


def digest_of(path: Path) -> str | None:
    """Return the hash of one file as :func:`digest` has it, None where it cannot be read."""
    with tempfile.TemporaryDirectory() as folder:
        shutil.copy(path, folder)
        try:
            return next(iter(digest(Path(folder)).values()))
        except (OSError, ValueError, LookupError):
            return None


def repeat(clip: Clip, folder: Path, trials: Sequence[int], seed: int) -> Verdict:
    """Run the same with other threads, jobs, hash seeds, time zones and languages."""
    verdict = Verdict(
        "repeated runs",
        f"{len(trials)}: cv2 and OpenMP threads 1, 2, 4, --jobs 1, 2; hash seed, time zone, locale",
        "one hash of all outputs",
    )
    hashes: Counter[str] = Counter()
    for number in tqdm(trials, desc="repeat", unit="run", disable=None):
        chance = random.Random(f"{seed} {number}")
        threads, jobs = (1, 2, 4)[number % 3], (1, 2)[number % 2]
        environment = os.environ | {
            **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), str(threads)),
            "OPENCV_FOR_THREADS_NUM": str(threads),
            "PYTHONHASHSEED": str(chance.randrange(2**32)),
            "TZ": chance.choice(("UTC", "Asia/Kathmandu", "America/St_Johns")),
            "LC_ALL": chance.choice(("C", "C.UTF-8", "de_DE.UTF-8", "tr_TR.UTF-8")),
        }
        out = folder / "out"
        shutil.rmtree(out, ignore_errors=True)
        done = subprocess.run(
            [
                *(sys.executable, "-m", "motionstereo_cli", "run", *map(str, clip.paths)),
                *("--rig", str(clip.rig_file), "--save", _ALL_SAVES),
                *("--jobs", str(jobs), "-o", str(out)),
            ],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            verdict.failures.append(f"trial {number}: {done.stderr[-300:]}")
            continue
        hashes[json.dumps(digest(out))] += 1
    if len(hashes) > 1:
        usual = json.loads(hashes.most_common(1)[0][0])
        for other, count in hashes.most_common()[1:]:
            files = _difference(json.loads(other), usual)
            verdict.failures.append(f"{count} runs differ from the others in {files}")
    verdict.found = f"{len(hashes)} hash{'es' if len(hashes) > 1 else ''}"
    return verdict


# A long run.

_EARLY_FRAMES = 500
_MAX_GROWTH = 0.05
_LONG_PATIENCE_S = 3600.0


def long(clip: Clip, folder: Path, frames: int) -> Verdict:
    """Run through many frames and watch memory, files and threads."""
    verdict = Verdict(
        "long run",
        f"{frames} frames of {clip.rig.width}x{clip.rig.height}, steering alone",
        "resident memory after frame 500 grows under 5 %; no file and no thread left over",
    )
    longer = repeated(clip, folder / "long", -(-frames // clip.count))
    report = folder / "long.json"

    def child() -> int:
        report.write_text(json.dumps(_watched(clip, longer, folder)))
        return 0

    ended = fork(child, seconds=_LONG_PATIENCE_S)
    if ended.exit_code:
        verdict.failures.append(f"exit code {ended.exit_code}: {ended.said[-300:]}")
        return verdict
    found = json.loads(report.read_text())
    growth = found["peak_bytes"] / found["early_bytes"] - 1
    verdict.found = (
        f"{found['early_bytes'] / 1e6:.1f} MB, then at most {growth:+.1%}; {found['files']} files "
        f"and {found['threads']} threads more than before; {found['frames']} frames in "
        f"{ended.wall_s:.0f} s"
    )
    if growth >= _MAX_GROWTH:
        verdict.failures.append(f"memory grew by {growth:.1%}")
    if found["files"] > 0 or found["threads"] > 0:
        verdict.failures.append(f"{found['files']} files, {found['threads']} threads left over")
    if found["frames"] < frames:
        verdict.failures.append(f"{found['frames']} frames came of {frames}")
    return verdict


def _watched(short: Clip, longer: Clip, folder: Path) -> dict[str, int]:
    """Return resident memory after frame 500 and its maximum later, and what a run leaves open."""
    seen, sizes = 0, []

    def note() -> None:
        nonlocal seen
        seen += 1
        if seen % _EARLY_FRAMES == 0:
            sizes.append(int(Path("/proc/self/statm").read_text().split()[1]) * getpagesize())

    _steered(short, folder / "short_out", lambda: None)  # libraries keep threads of their own
    files, threads = (len(os.listdir(f"/proc/self/{kind}")) for kind in ("fd", "task"))
    frames = _steered(longer, folder / "long_out", note)
    return {
        "frames": frames,
        "early_bytes": sizes[0],
        "peak_bytes": max(sizes),
        "files": len(os.listdir("/proc/self/fd")) - files,
        "threads": len(os.listdir("/proc/self/task")) - threads,
    }


def _steered(clip: Clip, out: Path, progress: Callable[[], object]) -> int:
    left, right = map(str, clip.paths)
    plan = RunPlan(left, right, out, rig=(clip.rig_file,), save=("steering",))
    return run(plan, Watcher(progress=progress)).frames


# All of it.

#: The parts, each with its number of trials: frames for the last.
PARTS = {
    "damaged": 1000,
    "kill": 100,
    "disk": 50,
    "repeat": 50,
    "hostile": 1000,
    "long": 100_000,
}


def torture(trials: Mapping[str, int], *, first: int = 0, seed: int = 0) -> list[Verdict]:
    """Return what some of the parts found.

    Args:
        trials: how many of which part, as in :data:`PARTS`.
        first: number of the first trial, to have one again.
        seed: what the trials are drawn from.
    """
    verdicts = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        clip = render(folder / "clip")
        warm_up(
            [
                *("run", *map(str, clip.paths), "--rig", str(clip.rig_file), "--jobs", "1"),
                *("--save", _ALL_SAVES, "-o", str(folder / "warm_up")),
            ]
        )
        for part, count in trials.items():
            place = folder / part
            place.mkdir()
            numbers = range(first, first + count)
            match part:
                case "damaged":
                    verdicts.append(damaged(clip, place, numbers, seed))
                case "kill":
                    verdicts.append(killed(clip, place, numbers, seed))
                case "disk":
                    verdicts.append(full(clip, place, numbers, seed))
                case "repeat":
                    verdicts.append(repeat(clip, place, numbers, seed))
                case "hostile":
                    found, lost = hostile(clip, place, numbers, seed)
                    what = (
                        f"{count}, every command: names swapped for links, FIFOs, folders, devices "
                        "and files of others; values of records changed; inputs as outputs; kills"
                    )
                    goal = (
                        "no file of the user's is lost; no hang, no `internal:`, under 1 GB; the "
                        "same command works after a kill"
                    )
                    verdicts.append(Verdict("hostile use", what, goal, found, lost))
                case _:
                    verdicts.append(long(clip, place, count))
    return verdicts


def format_markdown(verdicts: Sequence[Verdict]) -> str:
    """Return the table, a line for each part."""
    rows = [
        (
            *(each.part, each.trials, each.goal, each.found),
            f"no: {len(each.failures)}" if each.failures else "yes",
        )
        for each in verdicts
    ]
    return table(["part", "trials", "goal", "found", "met"], rows)


def main(args: Sequence[str] | None = None) -> int:
    """Try everything, print the table as Markdown; 1 if a goal is missed, otherwise 0."""
    parser = argparse.ArgumentParser(prog="python -m bench torture")
    parser.add_argument("--parts", default=",".join(PARTS), help="which, as a comma list")
    parser.add_argument("--trials", type=int, help="how many of each (frames of the long run)")
    parser.add_argument("--first", type=int, default=0, help="number of the first trial")
    parser.add_argument("--seed", type=int, default=0, help="what the trials are drawn from")
    given = parser.parse_args(args)
    parts = given.parts.split(",")
    if not set(parts) <= PARTS.keys():
        parser.error(f"--parts knows {', '.join(PARTS)}")
    trials = {part: given.trials or PARTS[part] for part in parts}
    verdicts = torture(trials, first=given.first, seed=given.seed)
    print(format_markdown(verdicts))
    for verdict in verdicts:
        for failure in verdict.failures:
            print(f"{verdict.part}: {failure}", file=sys.stderr)
    return int(any(verdict.failures for verdict in verdicts))
