"""What a batch costs and what it survives: ``python -m bench batch``.

Every trial starts the command as users do, in processes of its own. Processor time is that of the
command and of all its children.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import ctypes
import dataclasses
import filecmp
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TextIO

from bench.clips import Clip, rendered, repeated
from bench.markdown import table
from bench.preloads import killer_of
from motionstereo_cli.batch.pieces import Piece, join_pieces, run_piece
from motionstereo_cli.runs.plan import RunPlan
from motionstereo_cli.runs.run import Watcher
from motionstereo_cli.simulate.settings import SimulateSettings

WORKERS, _SHARDS = 2, 4
_COMMAND = (sys.executable, "-m", "motionstereo_cli")
_PATIENCE_S = 600.0
_PR_SET_CHILD_SUBREAPER = 36


@dataclass(frozen=True, slots=True)
class Size:
    """How much is tried.

    Attributes:
        clips, clip_frames: recordings side by side, and frames of each.
        tiny: recordings of 5 tiny frames.
        good: good recordings among bad ones.
        long_frames: frames of the recording that is cut.
        pieces: into how many pieces.
        join_frames: frames of the recording whose joining is timed.
        rows, sleepers: recordings that nobody processes, and workers that sleep instead.
    """

    clips: int
    clip_frames: int
    tiny: int
    good: int
    long_frames: int
    pieces: tuple[int, ...]
    join_frames: int
    rows: int
    sleepers: int


FULL = Size(24, 50, 1000, 17, 2000, (2, 4, 8), 500, 10_000, 200)
QUICK = Size(4, 20, 30, 5, 200, (4,), 100, 200, 20)


class Row(NamedTuple):
    """A row of the table; a ``figure`` has a ``key``, by which goals refer to it."""

    trial: str
    found: str
    goal: str
    key: str = ""
    figure: float = math.nan


@dataclass(frozen=True, slots=True)
class Cost:
    """What a command took, with all its children, in s; and the memory of the first process, MB."""

    wall_s: float
    cpu_s: float
    rss_mb: tuple[float, ...] = ()


class Started:
    """A command that runs, in a session of its own.

    Args:
        command: its words.
        text: what it reads from standard input.
        environment: added to this one's.
        said: where its standard error goes; None: nowhere.
    """

    def __init__(
        self,
        command: Sequence[object],
        text: str = "",
        environment: Mapping[str, str] | None = None,
        said: TextIO | None = None,
    ) -> None:
        self._begin_s = time.perf_counter()
        with tempfile.TemporaryFile("w+") as given:
            given.write(text)
            given.seek(0)
            self._process = subprocess.Popen(
                list(map(str, command)),
                stdin=given,
                stdout=subprocess.DEVNULL,
                stderr=said or subprocess.DEVNULL,
                # Installed, it is compiled to bytecode once.
                env={**os.environ, "PYTHONDONTWRITEBYTECODE": "", **(environment or {})},
                start_new_session=True,
            )
        self.pid = self._process.pid
        self._rss: list[float] = []

    def watch(self, *, orphans: bool = True) -> Cost:
        """Wait for its end, and look at its memory meanwhile; ``orphans``: with its children."""
        while True:
            pid, status, usage = os.wait4(self.pid, os.WNOHANG)
            if pid:
                break
            with contextlib.suppress(OSError, LookupError):
                text = Path(f"/proc/{self.pid}/statm").read_text()
                self._rss.append(int(text.split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6)
            time.sleep(0.02)
        self._process.returncode = os.waitstatus_to_exitcode(status)
        wall_s = time.perf_counter() - self._begin_s
        own_s = usage.ru_utime + usage.ru_stime
        return Cost(wall_s, own_s + (_orphans_s() if orphans else 0.0), tuple(self._rss))

    def kill(self) -> None:
        """End it as ``kill -9`` does, and it only."""
        os.kill(self.pid, signal.SIGKILL)
        self._process.wait()


def _adopt() -> None:
    """Have orphans of children become children of this process, so that their time is known."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def _orphans_s() -> float:
    """Wait for all children that are left, and return their processor time in s."""
    total_s = 0.0
    with contextlib.suppress(ChildProcessError):
        while True:
            _, _, usage = os.wait4(-1, 0)
            total_s += usage.ru_utime + usage.ru_stime
    return total_s


def _batch(manifest: Path, out: Path, *more: object) -> list[object]:
    return [*_COMMAND, "batch", manifest, "-o", out, "--workers", WORKERS, *more]


def _manifest(path: Path, rows: Sequence[tuple[Path, Path, Path, str]]) -> Path:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([("left", "right", "rig", "out"), *rows])
    return path


def _statuses(out: Path) -> Iterator[dict[str, str]]:
    for path in sorted((out / ".batch/status").rglob("*.json")):
        with contextlib.suppress(ValueError, OSError):
            yield json.loads(path.read_text())


def side_by_side(clip: Clip, size: Size, folder: Path) -> Iterator[Row]:
    """Compare a batch with as many processes of ``run``."""
    names = [f"clip{number:02d}" for number in range(size.clips)]
    rows = [(*clip.paths, clip.rig_file, name) for name in names]
    manifest = _manifest(folder / "clips.csv", rows)
    mine = Started(_batch(manifest, folder / "batch")).watch()
    words = "\n".join(
        f"{clip.paths[0]} {clip.paths[1]} --rig {clip.rig_file} -o {folder / 'runs' / name}"
        for name in names
    )
    xargs = ["xargs", "-P", WORKERS, "-L", 1, *_COMMAND, "run"]
    theirs = Started(xargs, words).watch()
    what = f"{size.clips} clips of {size.clip_frames} frames, against xargs -P{WORKERS}"
    share = mine.cpu_s / theirs.cpu_s
    yield Row(
        f"{what}: processor time",
        f"{mine.cpu_s:.1f} s to {theirs.cpu_s:.1f} s: {share:.2f}",
        "0.65",
    )
    share = mine.wall_s / theirs.wall_s
    yield Row(
        f"{what}: time", f"{mine.wall_s:.1f} s to {theirs.wall_s:.1f} s: {share:.2f}", "below 1"
    )


def many(clip: Clip, size: Size, folder: Path) -> Iterator[Row]:
    """Measure what a task costs besides its frames."""
    rows = [(*clip.paths, clip.rig_file, f"{number:04d}") for number in range(size.tiny)]
    manifest = _manifest(folder / "tiny.csv", rows)
    out = folder / "tiny"
    options = ["--save", "steering", "--no-check"]
    alone = Started(_batch(_manifest(folder / "one.csv", rows[:1]), folder / "one", *options))
    begin_s = alone.watch().wall_s
    cost = Started(_batch(manifest, out, *options)).watch()
    frames_s = sum(float(status["seconds"]) for status in _statuses(out))
    each_ms = 1000 * ((cost.wall_s - begin_s) * WORKERS - frames_s) / size.tiny
    what = f"{size.tiny} recordings of {clip.count} frames"
    yield Row(f"{what}: overhead of a task", f"{each_ms:.0f} ms of a worker", "50 ms")
    parts = [cost.rss_mb[round(share * (len(cost.rss_mb) - 1))] for share in (0.2, 0.5, 0.95)]
    shown = ", ".join(f"{each:.0f}" for each in parts)
    yield Row(f"{what}: client and scheduler, after 20, 50, 95 %", f"{shown} MB", "flat")


def shards(clip: Clip, size: Size, folder: Path) -> Iterator[Row]:
    """Compare shards without a scheduler with one batch of as many workers."""
    names = [f"{n % 100:02d}/{n:05d}" for n in range(size.tiny)]
    manifest = _manifest(folder / "s.csv", [(*clip.paths, clip.rig_file, name) for name in names])
    options = ("--save", "steering", "--no-check")
    share = (*_COMMAND, "batch", manifest, "-o", folder / "shares", "--workers", 1, *options)
    xargs = ("xargs", "-P", _SHARDS, "-I{}", *share, "--shard", f"{{}}/{_SHARDS}")
    mine = Started(xargs, "".join(f"{index}\n" for index in range(_SHARDS))).watch()
    whole = (*_COMMAND, "batch", manifest, "-o", folder / "one", "--workers", _SHARDS, *options)
    theirs = Started(whole).watch()
    same = sum(_same(folder / "one" / name, folder / "shares" / name) for name in names)
    for what, one, other in (
        ("processor time", mine.cpu_s, theirs.cpu_s),
        ("time", mine.wall_s, theirs.wall_s),
    ):
        yield Row(
            f"{size.tiny} recordings in {_SHARDS} shards, against a batch of {_SHARDS} workers: "
            f"{what}",
            f"{one:.1f} s to {other:.1f} s: {one / other:.2f}, {same} with the same bytes",
            "1.0, the same bytes",
            f"shards, {what}",
            one / other,
        )


def sleepers(clip: Clip, size: Size, folder: Path) -> Iterator[Row]:
    """Measure the client and the scheduler of many workers, which sleep."""
    for count, seconds, what in (
        (size.rows, 1.0, "client"),
        (2 * size.sleepers, 10.0, "messages"),
    ):
        rows = [(*clip.paths, clip.rig_file, f"{n % 100:02d}/{n:05d}") for n in range(count)]
        manifest = _manifest(folder / f"{what}.csv", rows)
        file = folder / f"{what}.json"
        words = (sys.executable, "-m", "bench.sleepers", file, "--workers", size.sleepers)
        cluster = subprocess.Popen([*map(str, words), "--seconds", str(seconds)])
        until_s = time.monotonic() + _PATIENCE_S
        while not file.exists() and cluster.poll() is None and time.monotonic() < until_s:
            time.sleep(0.1)
        out, options = folder / what, ("--save", "steering", "--scheduler-file", file)
        client = Started([*_COMMAND, "batch", manifest, "-o", out, *options], said=sys.stderr)
        cost = client.watch(orphans=False)
        cluster.terminate()
        cluster.wait()
        found = json.loads(file.read_text())
        whole = f"{count} rows, {size.sleepers} workers that sleep {seconds:g} s"
        if what == "client":
            each_ms, rss_mb = 1000 * cost.cpu_s / count, max(cost.rss_mb)
            share = cost.cpu_s / cost.wall_s
            yield Row(
                f"{whole}: client, a recording",
                f"{each_ms:.2f} ms ({share:.2f} core)",
                "1 ms",
                "client, ms",
                each_ms,
            )
            yield Row(
                f"{whole}: memory of the client", f"{rss_mb:.0f} MB", "100 MB", "client, MB", rss_mb
            )
            done = sum(status["status"] == "done" for status in _statuses(out))
            yield Row(f"{whole}: done", str(done), str(count), "not done", count - done)
        else:
            shown = f"{found['mean a second']:.0f}, at most {found['most a second']}"
            yield Row(
                f"{whole}: messages a second", shown, "50", "messages", found["most a second"]
            )


def hard(clip: Clip, size: Size, folder: Path) -> Iterator[Row]:
    """Kill what works on a batch, and see what becomes of it."""
    (folder / "killer").mkdir()
    for path in clip.paths:
        (folder / "killer" / path.name).write_bytes(path.read_bytes())
    corrupt = folder / "corrupt.mp4"
    corrupt.write_bytes(b"no video")
    rows = [(*clip.paths, clip.rig_file, f"good{number:02d}") for number in range(size.good)]
    rows.insert(2, (corrupt, clip.paths[1], clip.rig_file, "corrupt0"))
    rows.insert(4, (folder / "killer/left.mp4", clip.paths[1], clip.rig_file, "killer"))
    rows.append((corrupt, clip.paths[1], clip.rig_file, "corrupt1"))
    manifest, out = _manifest(folder / "hard.csv", rows), folder / "hard"
    preload = folder / "killer.py"
    preload.write_text(killer_of("killer"))
    environment = {"DASK_DISTRIBUTED__WORKER__PRELOAD": str(preload)}
    begun = Started(_batch(manifest, out), environment=environment)
    _wait_for(out, size.good // 4)
    os.kill(_worker(out), signal.SIGKILL)
    _wait_for(out, size.good // 2)
    begun.kill()
    before = {path: path.stat().st_mtime_ns for path in out.glob("*/run.json")}
    Started(_batch(manifest, out), environment=environment).watch()
    counts = Counter(status["status"] for status in _statuses(out))
    said = ", ".join(f"{count} {name}" for name, count in sorted(counts.items()))
    what = f"{len(rows)} recordings, a worker and then the client killed"
    yield Row(f"{what}: what became of them", said, f"{size.good} done, 2 failed, 1 lost")
    reasons = sum(bool(s["reason"]) for s in _statuses(out) if s["status"] in ("failed", "lost"))
    yield Row(f"{what}: with a reason", f"{reasons} of 3", "3 of 3")
    again = sum(path.stat().st_mtime_ns != time_ns for path, time_ns in before.items())
    yield Row(f"{what}: of {len(before)} that were done, done again", str(again), "0")
    whole = folder / "whole"
    Started([*_COMMAND, "run", *clip.paths, "--rig", clip.rig_file, "-o", whole]).watch()
    same = sum(_same(whole, out / name) for *_, name in rows if name.startswith("good"))
    yield Row(f"{what}: with the bytes of run", f"{same} of {size.good}", f"{size.good}")


def _wait_for(out: Path, done: int) -> None:
    """Wait until so many recordings are done.

    Raises:
        RuntimeError: that takes too long.
    """
    until_s = time.monotonic() + _PATIENCE_S
    while len(list(out.glob("good*/run.json"))) < done:
        if time.monotonic() > until_s:
            raise RuntimeError(f"{out}: {done} recordings are not done after {_PATIENCE_S:.0f} s")
        time.sleep(0.02)


def _worker(out: Path) -> int:
    """Return the process that works on a good recording just now."""
    until_s = time.monotonic() + _PATIENCE_S
    while time.monotonic() < until_s:
        for status in _statuses(out):
            if status["status"] == "running" and status["name"].startswith("good"):
                return int(status["worker"].rpartition(":")[2])
        time.sleep(0.01)
    raise RuntimeError(f"{out}: no recording is worked on")


def _same(one: Path, other: Path) -> bool:
    """Return whether two folders have the same files, but for what run.json says of time."""
    names, there = (
        sorted(str(path.relative_to(each)) for path in each.rglob("*.*") if path.name != "run.json")
        for each in (one, other)
    )
    return names == there and not any(filecmp.cmpfiles(one, other, names, shallow=False)[1:])


def cut(clip: Clip, size: Size, folder: Path) -> Iterator[Row]:
    """Compare one recording in pieces with one run."""
    whole = folder / "long"
    inputs = [*clip.paths, "--rig", clip.rig_file]
    alone = Started([*_COMMAND, "run", *inputs, "--jobs", 1, "-o", whole]).watch()
    manifest = _manifest(folder / "long.csv", [(*clip.paths, clip.rig_file, "long")])
    for count in size.pieces:
        out = folder / f"pieces{count}"
        cost = Started(_batch(manifest, out, "--pieces", count)).watch()
        bytes_ = "the same bytes" if _same(whole, out / "long") else "OTHER BYTES"
        yield Row(
            f"{size.long_frames} frames in {count} pieces, against run --jobs 1: time",
            f"{cost.wall_s:.1f} s to {alone.wall_s:.1f} s: {cost.wall_s / alone.wall_s:.2f}, "
            f"{bytes_}",
            "0.60, the same bytes",
        )


def joining(clip: Clip, size: Size, folder: Path) -> Iterator[Row]:
    """Measure what is done in order, for each frame, and what that means for many workers."""
    left, right = map(str, clip.paths)
    plan = RunPlan(left, right, folder / "joined", (clip.rig_file,), resume=True, jobs=1)
    pieces = [Piece(0, None)]
    begin_s = time.perf_counter()
    home = folder / "pieces"
    run_piece(plan, pieces[0], home, Watcher())
    made_s = time.perf_counter()
    join_pieces(plan, pieces, home, Watcher())
    join_ms, piece_ms = (
        1000 * seconds / size.join_frames
        for seconds in (time.perf_counter() - made_s, made_s - begin_s)
    )
    yield Row(
        "joining, for a frame",
        f"{join_ms:.2f} ms, {piece_ms:.1f} ms in a piece: the limit at {piece_ms / join_ms:.0f} "
        "workers",
        "50 workers",
    )


def _clip(folder: Path, frames: int, width: int = 320, height: int = 240) -> Clip:
    settings = SimulateSettings(
        frames=f"300:{300 + frames}", width=width, height=height, noise_sigma=1.5
    )
    return rendered(folder, settings)


def _long(folder: Path, frames: int) -> Clip:
    settings = SimulateSettings(frames="300:351", width=320, height=240, noise_sigma=1.5)
    short = rendered(folder.with_name(f"{folder.name}0"), settings, back=True)
    return repeated(short, folder, frames // short.count)


def measured(names: Sequence[str], size: Size) -> Iterator[Row]:
    """Yield the rows of some trials."""
    _adopt()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        trials = {
            "clips": lambda: side_by_side(_clip(folder / "c", size.clip_frames), size, folder),
            "tiny": lambda: many(_clip(folder / "t", 5, 64, 48), size, folder),
            "hard": lambda: hard(_clip(folder / "h", size.clip_frames), size, folder),
            "shards": lambda: shards(_clip(folder / "d", 5, 64, 48), size, folder),
            "sleepers": lambda: sleepers(_clip(folder / "s", 5, 64, 48), size, folder),
            "pieces": lambda: cut(_long(folder / "p", size.long_frames), size, folder),
            "join": lambda: joining(_long(folder / "j", size.join_frames), size, folder),
        }
        for wanted in names:
            yield from trials[wanted]()


def main(args: list[str]) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="bench batch", description=__doc__)
    parser.add_argument("--rows", type=int, help="recordings of the trial sleepers")
    parser.add_argument("--sleepers", type=int, help="workers of the trial sleepers")
    parser.add_argument("--quick", action="store_true", help="small sizes, in about a minute")
    parser.add_argument(
        "--trials", default="clips,tiny,shards,sleepers,hard,pieces,join", help="which, by name"
    )
    given = parser.parse_args(args)
    size = QUICK if given.quick else FULL
    size = dataclasses.replace(
        size, rows=given.rows or size.rows, sleepers=given.sleepers or size.sleepers
    )
    rows = []
    for row in measured(given.trials.split(","), size):
        print("  ".join(row[:3]), file=sys.stderr, flush=True)
        rows.append(row[:3])
    print(table(("trial", "found", "goal"), rows))
    return 0
