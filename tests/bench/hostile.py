"""Hostile use: links planted, inputs offered as outputs, kills at each change of the disk.

Every trial has a folder of its own with files of a user in it. What counts is that none of them is
lost, and that the same command works after a kill.
"""

from __future__ import annotations

import hashlib
import os
import random
import shutil
import signal
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from bench.children import fork
from bench.clips import Clip
from motionstereo_cli.__main__ import main

_PATIENCE_S = 60.0
_SAVE = "steering,charge,charge-png,disparity"

#: What a command calls to change what is on the disk; a kill comes before one of these calls.
_CHANGES = ("unlink", "replace", "fsync", "open", "rmdir", "mkdir")

#: The arguments of each command, without its output; then names that it must not write to.
_COMMANDS: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...] = (
    (("figure", "{left}", "{right}", "--frames", "2", "-o"), ("left.mp4", "right.mp4")),
    (("rig", "{rig}", "-o"), ("rig.yaml",)),
    (("compare", "{golden}", "{golden2}", "--json"), ("golden/run.json", "golden2/steering.csv")),
    (("compare", "{golden}", "{golden2}", "--junit"), ("golden/run.json", "golden2/run.json")),
    (("evaluate", "{golden}", "{golden2}", "--csv"), ("golden/disparity/000001.png",)),
    (("evaluate", "{golden}", "{golden2}", "--json"), ("golden2/disparity/new.json",)),
    (("run", "{left}", "{right}", "--overwrite", "-o", "{out}", "--csv"), ("right.mp4",)),
    (("run", "{golden}/charge-png", "{golden2}/charge-png", "--overwrite", "-o"), ("golden",)),
    (("run", "{golden}/charge-png/*.png", "{right}", "--overwrite", "-o"), ("golden",)),
)


def hostile(clip: Clip, folder: Path, trials: Sequence[int], seed: int) -> tuple[str, list[str]]:
    """Try it; each of ``trials`` is a number that tells what.

    Returns:
        what was found, and what was lost, a line each.
    """
    lost: list[str] = []
    kinds = (_planted, _offered, _killed)
    made = folder / "made"
    _make(clip, made)
    for number in trials:
        chance = random.Random(f"{seed} {number}")
        place = folder / "trial"
        shutil.rmtree(place, ignore_errors=True)
        shutil.copytree(made, place)
        kind = kinds[number % len(kinds)]
        before = _sums(place)
        for fault in kind(place, chance):
            lost.append(f"trial {number}, {kind.__name__[1:]}: {fault}")
        after = _sums(place)
        for name in sorted(before):
            if after.get(name) != before[name]:
                lost.append(f"trial {number}, {kind.__name__[1:]}: {name} is lost")
    return f"{len(lost)} lost in {len(trials)} trials", lost


def _make(clip: Clip, made: Path) -> None:
    """Make what a user has: recordings, a rig, results, and a file that is precious."""
    made.mkdir()
    for path, name in zip((*clip.paths, clip.rig_file), ("left", "right", "rig"), strict=True):
        shutil.copy(path, made / (name + path.suffix))
    (made / "precious").mkdir()
    for number in range(30):
        (made / f"precious/{number:06d}.png").write_bytes(b"mine")
    for name in ("golden", "golden2"):
        if _called(_run(made, made / name)):
            raise RuntimeError("the run to begin with fails")


def _run(place: Path, out: Path) -> list[str]:
    given = [str(place / "left.mp4"), str(place / "right.mp4"), "--end", "9", "--no-check"]
    return ["run", *given, "--save", _SAVE, "--checkpoint-frames", "3", "-o", str(out)]


def _called(args: Sequence[str], prepare: Callable[[], object] = lambda: None) -> int:
    def child() -> int:
        prepare()
        return main(args)

    return fork(child, seconds=_PATIENCE_S).exit_code


def _sums(place: Path) -> dict[str, str]:
    """Return a hash of each file of the user's: of all but what runs wrote into ``out``."""
    return {
        str(path.relative_to(place)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(place.rglob("*"))
        if path.is_file() and path.relative_to(place).parts[0] != "out"
    }


def _killing(calls: int) -> Callable[[], None]:
    """Return what has a process killed before it changes the disk once more than so often."""

    def prepare() -> None:
        left = calls

        def wrapped(change: Callable[..., Any], *, writes_only: bool) -> Callable[..., Any]:
            def call(*args: Any, **options: Any) -> Any:
                nonlocal left
                if not writes_only or (len(args) > 1 and args[1] & (os.O_WRONLY | os.O_RDWR)):
                    if left == 0:
                        os.kill(os.getpid(), signal.SIGKILL)
                    left -= 1
                return change(*args, **options)

            if change in os.supports_dir_fd:
                os.supports_dir_fd.add(call)
            return call

        for name in _CHANGES:
            setattr(os, name, wrapped(getattr(os, name), writes_only=name == "open"))

    return prepare


def _planted(place: Path, chance: random.Random) -> Iterator[str]:
    """Kill a run, plant links at random names, and go on."""
    out = place / "out"
    _called(_run(place, out), _killing(chance.randrange(10, 90)))
    names = ["steering.csv", "charge.mp4", "run.json", "run.checkpoint", "run.json.part"]
    names += ["charge.0000.mp4", "charge.0001.mp4", "run.lock", "charge-png", "disparity"]
    names += [f"{kind}/{n:06d}.png" for kind in ("charge-png", "disparity") for n in range(9)]
    for name in chance.sample([*names, *(f"{name}.part" for name in names)], 4):
        path = out / name
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif path.parent.is_dir() and not path.parent.is_symlink():
            path.unlink(missing_ok=True)
        else:
            continue
        target = place / ("precious" if "." not in name else "precious/000003.png")
        path.symlink_to(target)
    for option in chance.sample(["--resume", "--overwrite"], 2):
        if _called([*_run(place, out), option]) not in (0, 1):
            yield f"{option} ends in another way than done or refused"


def _offered(place: Path, chance: random.Random) -> Iterator[str]:
    """Offer a command one of its inputs as its output."""
    command, targets = chance.choice(_COMMANDS)
    known = {name: place / name for name in ("golden", "golden2", "out")}
    known |= {"left": place / "left.mp4", "right": place / "right.mp4", "rig": place / "rig.yaml"}
    target = place / chance.choice(targets)
    if chance.random() < 0.3:  # under another name
        link = place / "link"
        link.symlink_to(target)
        target = link
    if _called([*(each.format(**known) for each in command), str(target)]) != 1:
        yield f"{command[0]} takes its input {target.name} as its output"


def _killed(place: Path, chance: random.Random) -> Iterator[str]:
    """Kill a run, or the replacing of one, before a random change; then the same has to work."""
    out = place / "out"
    option = chance.choice(["--resume", "--overwrite"])
    if option == "--overwrite":
        _called(_run(place, out))
    _called([*_run(place, out), option], _killing(chance.randrange(120)))
    if _called([*_run(place, out), option]):
        yield f"{option} no longer works"
    elif len(list((out / "charge-png").iterdir())) != 9 or list(out.glob("*.part")):
        yield f"{option} leaves something else than 9 images"
