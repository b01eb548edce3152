"""A short version of make torture, and whether it would notice."""

from __future__ import annotations

import os
import random
import subprocess
import sys
from pathlib import Path

import pytest
from recordings import cut, encode, folder, scene

from bench.children import Ended
from bench.damage import DAMAGES, seen_in_image, seen_in_video
from bench.torture import Verdict, _difference, _faults, format_markdown

#: In a process of its own: children are forks, which threads of other tests would not survive.
SHORT = """
import sys
from bench.torture import format_markdown, torture
trials = {"damaged": 4, "repeat": 1, "kill": 1, "disk": 1, "hostile": 2}
verdicts = torture(trials, seed=int(sys.argv[1]))
print(format_markdown(verdicts))
failures = [failure for verdict in verdicts for failure in verdict.failures]
# How many frames are done again depends on the disk: that is for make torture to say.
failures = [failure for failure in failures if "frames were done again" not in failure]
print(*failures, sep="\\n")
sys.exit(bool(failures))
"""


#: Where files are in memory, nothing waits for the disk.
MEMORY = {"TMPDIR": "/dev/shm"} if os.path.isdir("/dev/shm") else {}


def test_a_short_torture() -> None:
    done = subprocess.run(
        [sys.executable, "-c", SHORT, "1"],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)} | MEMORY,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr[-3000:]
    assert done.stdout.count("\n| ") == 6


@pytest.mark.parametrize("damage", DAMAGES)
def test_damage_changes_something_and_can_be_had_again(damage: str) -> None:
    content = random.Random(0).randbytes(10_000)
    for seed in range(20):
        spoilt = DAMAGES[damage](content, random.Random(seed))
        assert spoilt != content
        assert spoilt == DAMAGES[damage](content, random.Random(seed))
        assert len(spoilt) == len(content) or damage == "cut"


def test_plain_decoders_see_cuts(tmp_path: Path) -> None:
    video = encode(tmp_path / "whole.mkv", scene(), "libx264", "yuv420p")
    assert not seen_in_video(video, len(scene()))
    assert seen_in_video(cut(video, tmp_path / "cut.mkv", 0.5), len(scene()))
    image = folder(tmp_path / "images", scene(count=1), ".png") / "frame0.png"
    assert not seen_in_image(image)
    assert seen_in_image(cut(image, tmp_path / "cut.png", 0.5))


def ended(exit_code: int, said: str = "", cpu_s: float = 1.0, *, killed: bool = False) -> Ended:
    return Ended(exit_code, said, cpu_s, cpu_s, killed)


@pytest.mark.parametrize(
    ("child", "seen", "fault"),
    [
        (ended(3, "warning: 1 image"), True, None),
        (ended(1, "error: no video\n"), True, None),
        (ended(0), False, None),
        (ended(0), True, "unsaid"),
        (ended(-11), True, "exit code -11"),
        (ended(2, "error: wrong\n"), True, "exit code 2"),
        (ended(1), True, "0 lines of error"),
        (ended(1, "error: a\nerror: b\n"), True, "2 lines of error"),
        (ended(-9, killed=True), True, "hung"),
        (ended(1, "error: internal: ValueError\n"), True, "internal"),
        (ended(3, "Traceback (most recent call last)"), True, "Traceback"),
        (ended(3, cpu_s=3.2), True, "3.2 times"),
    ],
)
def test_what_counts_as_a_fault(
    tmp_path: Path, child: Ended, seen: bool, fault: str | None
) -> None:
    if child.exit_code in (0, 3):
        (tmp_path / "run.json").touch()
    faults = list(_faults(child, 1.0, seen=seen, out=tmp_path))
    assert [fault in each for each in faults] == ([True] if fault else [])


def test_a_record_has_to_go_with_the_exit_code(tmp_path: Path) -> None:
    assert list(_faults(ended(3), 1.0, seen=True, out=tmp_path))
    (tmp_path / "run.json").touch()
    assert list(_faults(ended(1, "error: a\n"), 1.0, seen=True, out=tmp_path))


def test_differences_are_named() -> None:
    one = {"a": "1", "b": "2", "c": "3"}
    assert _difference(one, dict(one)) == ""
    assert _difference(one, {"a": "1", "b": "x", "d": "4"}) == "b, c, d"


def test_the_table_says_what_is_missed() -> None:
    verdicts = [Verdict("p", "1", "g", "f"), Verdict("q", "2", "g", "f", ["it fell over"])]
    lines = format_markdown(verdicts).splitlines()
    assert [line.rpartition("| ")[0].endswith("| f ") for line in lines[2:]] == [True, True]
    assert [line.split(" | ")[-1] for line in lines[2:]] == ["yes |", "no: 1 |"]
