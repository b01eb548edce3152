"""Hostile use: names swapped, records changed, inputs offered as outputs, kills at each change.

Every trial has a folder of its own with files of a user in it. What counts is that none of them is
lost, that no command hangs, takes over 1 GB or ends for a reason that nobody foresaw, and that the
same command works after a kill.

Which names a command touches is seen in a run of it that nobody disturbs: each is then taken by a
link, a FIFO, a folder, a device or a file of others.

Commands run in forks of this process, which has everything loaded, and one of 20 as the installed
command. With TMPDIR in memory (/dev/shm) a trial takes a third of the time, as nothing waits for
the disk.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import random
import shutil
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from bench.children import Ended, fork
from bench.clips import Clip
from bench.damage import flipped
from motionstereo_cli.__main__ import main
from motionstereo_cli.files.folders import spread

_PATIENCE_S = 60.0
_MAX_BYTES = 1 << 30
_SAVE = "steering,objects,charge,charge-png,disparity"

#: The command as it is installed, and how many trials there are for each that runs it so.
_INSTALLED = str(Path(sys.executable).with_name("motionstereo"))
_INSTALLED_EVERY = 20

_PAIR = "left.mp4 right.mp4 --rig rig.yaml"
_SHORT = f"run {_PAIR} --end 3 --no-check"
_MORE = "poses,map,rgbd,bag,points,own-charge,depth,depth-mkv,sigma,steering-jsonl,preview"
_DRIVE = "drive {} --world plan.toml --max-frames 3 --width 64"
_PLAN = """about = "A room."
[robot]
start = [0, 0]
[[walls]]
points = [[-3, -2], [4, -2], [4, 3], [-3, 3]]
closed = true
[[boxes]]
at = [2, 0.5]
size = [0.8, 0.5]
height_m = 0.5
"""
_CONFIG = """end = "3"
check = false
save = ["steering", "objects"]
rig = "rig.yaml"
disparity = "golden/disparity"
"""
_CLIP = f"{_PAIR} --end 9 --no-check --checkpoint-frames 3"

#: Where a batch keeps what is of the recording a.
_A = spread("a")
#: What a batch needs names for, beside those of its recordings.
_BATCH_NAMES = (
    *("many2", "many2/batch.csv", "many2/.batch", "many2/.batch/batch.json", "many2/a"),
    *("many2/.batch/status", "many2/.batch/logs", f"many2/.batch/logs/{_A}/a.log", "many2/a.log"),
    *(f"many2/.batch/status/{_A}/a.json", "many2/a/run.json", "many2/a/depth", "m.csv", "left.mp4"),
)
#: Folders of results that a command may change, whatever lies there under the names of its files.
_RESULTS = {
    "overwrite": "golden/",
    "resume": "begun/",
    "complete": "golden/",
    "report": "golden/report.html",
    "simulate again": "old/",
    "more again": "all/",
    "drive again": "driven/",
}

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


#: Commands, by what they do: their arguments, and the files that a user names for them to replace.
_WORK: dict[str, tuple[str, tuple[str, ...]]] = {
    "run": (f"run {_CLIP} --save {_SAVE},report -o out --csv table.csv", ()),
    "overwrite": (f"run {_CLIP} --save {_SAVE} -o golden --overwrite", ()),
    "resume": (f"run {_CLIP} --save {_SAVE} -o begun --csv begun.csv --resume", ()),
    "complete": (f"run {_CLIP} --save {_SAVE} -o golden --resume", ()),
    "report": ("report golden", ()),
    "page": ("report golden2 -o page.html", ()),
    "reports": ("report many -o pages.html", ()),
    "compare": (
        "compare golden golden2 --json c.json --junit c.xml --picture c.png",
        ("c.json", "c.xml", "c.png"),
    ),
    "evaluate": (
        "evaluate golden golden2 --csv e.csv --json e.json --picture 3 -o e.png",
        ("e.csv", "e.json", "e.png"),
    ),
    "figure": ("figure left.mp4 right.mp4 --frames 2,5 -o f.png", ("f.png",)),
    "rig": ("rig rig.yaml -o new.yaml", ("new.yaml",)),
    "info": ("info left.mp4 right.mp4", ()),
    "check": (f"check {_PAIR} --write c.toml", ("c.toml",)),
    "simulate": ("simulate sim --frames 3 --width 64 --height 48", ()),
    "simulate again": ("simulate old --frames 3 --width 64 --height 48 --overwrite", ()),
    "more": (f"{_SHORT} --save {_MORE} -o more", ()),
    "more again": (f"{_SHORT} --save {_MORE} -o all --overwrite", ()),
    "configured": ("run left.mp4 right.mp4 --config run.toml -o configured", ()),
    "drive": (_DRIVE.format("drive"), ()),
    "drive again": (f"{_DRIVE.format('driven')} --overwrite", ()),
    "paths": ("evaluate all/poses.txt all/poses.txt --json p.json", ("p.json",)),
    "status": ("batch m.csv -o many --no-check --status", ("many/batch.csv",)),
    "shard": ("batch m.csv -o many2 --no-check --shard 0/1", ()),
}
#: Those that have no results of an earlier run: after a kill they need --overwrite.
_NEW = ("run", "simulate", "more", "configured", "drive")
_AGAIN = ("simulate", "more", "drive")
#: Of a cluster of processes, which takes seconds to begin: one trial in so many.
_BATCH = "batch m.csv -o many2 --workers 1 --pieces 1 --no-check"
_BATCH_EVERY = 25

#: What takes a name, each from the place of the trial and the name.
_OBSTACLES: dict[str, Callable[[Path, Path], object]] = {
    "a link to a file": lambda place, name: name.symlink_to(place / "precious/000003.png"),
    "a link to a folder": lambda place, name: name.symlink_to(place / "precious"),
    "a link to nothing": lambda place, name: name.symlink_to(place / "precious/new"),
    "a circle": lambda _, name: name.symlink_to(name.name),
    "a device": lambda _, name: name.symlink_to("/dev/zero"),
    "a FIFO": lambda _, name: os.mkfifo(name),
    "a folder": lambda _, name: name.mkdir(),
    "a file of others": lambda _, name: name.write_bytes(b"mine"),
    "nothing in it": lambda _, name: name.write_bytes(b""),
}

#: What takes the place of a value in a record.
_VALUES: tuple[Any, ...] = (
    *(None, True, -1, 0, 1, 10**9, 10**30, 0.5, float("inf"), float("nan"), "", "x", "0/0"),
    *("\0", "\ud800", "../precious/000003.png", "/etc/passwd", "a" * 100_000),
    *([], [1], ["x"], {}, {"a": 1}, [[[[]]]]),
)
#: Records, and what reads them.
_RECORDS = {
    "golden/run.json": ("report", "compare", "evaluate", "complete", "overwrite", "configured"),
    "golden/steering.csv": ("report", "compare", "evaluate", "complete", "overwrite"),
    "golden/objects.csv": ("report", "compare", "evaluate", "complete", "overwrite"),
    "golden2/run.json": ("page", "compare", "evaluate"),
    "begun/run.json.part": ("resume",),
    "begun/run.checkpoint": ("resume",),
    "many/batch.csv": ("reports", "status"),
    f"many/.batch/status/{_A}/a.json": ("reports", "status"),
    "many/.batch/batch.json": ("reports", "status"),
    "many/a/run.json": ("reports", "status"),
    "old/poses.txt": ("simulate again",),
    "all/run.json": ("more again",),
    "all/poses.txt": ("paths",),
    "driven/drive.json": ("drive again",),
    "run.toml": ("configured",),
    "plan.toml": ("drive",),
    "m.csv": ("status", "shard"),
    "rig.yaml": ("rig", "more", "check"),
}


#: What tells the names that a command touches.
Touched = Callable[[str], list[str]]


def hostile(clip: Clip, folder: Path, trials: Sequence[int], seed: int) -> tuple[str, list[str]]:
    """Try it; each of ``trials`` is a number that tells what.

    Returns:
        what was found, and what was lost, a line each.
    """
    lost: list[str] = []
    kinds = (_swapped, _changed, _killed_anywhere, _swapped, _changed, _planted, _offered, _killed)
    made = folder / "made"
    _make(clip, made)
    touched = functools.cache(functools.partial(_touched, made, folder))
    for number in tqdm(trials, desc="hostile", unit="trial", disable=None):
        chance = random.Random(f"{seed} {number}")
        place = folder / "trial"
        shutil.rmtree(place, ignore_errors=True)
        shutil.copytree(made, place, symlinks=True)
        kind = kinds[number % len(kinds)]
        lost += [f"trial {number}, {kind.__name__[1:]}: {e}" for e in kind(place, chance, touched)]
    return f"{len(lost)} lost in {len(trials)} trials", lost


def _touched(made: Path, folder: Path, what: str) -> list[str]:
    """Return the names that a command touches where nobody disturbs it."""
    command, _ = _WORK[what]
    place, log = folder / "clean", folder / "touched"
    shutil.copytree(made, place)
    ended = _in(place, command.split(), functools.partial(_watched, place, log))
    if ended.exit_code not in (0, 4):
        raise RuntimeError(f"{command}: {ended.said}")
    noted = log.read_text().split("\0")
    shutil.rmtree(place)
    names = {name for name in noted if name and ".motionstereo-" not in name}
    # Those that commands look for before they make them.
    return sorted({*names, *(f"{name}.part" for name in names)})


def _watched(place: Path, log: Path) -> None:
    """Have this process note each name below a place that it hands to the system."""
    notes = log.open("w")

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open" or event.startswith("os."):
            for each in arguments[:2]:
                if isinstance(each, str | os.PathLike):
                    name = os.path.relpath(os.fspath(each), place)
                    if not name.startswith(".."):
                        notes.write(f"{name}\0")
                        notes.flush()

    sys.addaudithook(hook)


def _in(
    place: Path,
    args: Sequence[str],
    prepare: Callable[[], object] = lambda: None,
    *,
    installed: bool = False,
) -> Ended:
    def child() -> int:
        os.chdir(place)
        if installed:
            os.execv(_INSTALLED, [_INSTALLED, *args])
        prepare()
        return main(args)

    return fork(child, seconds=_PATIENCE_S)


def _faults_of(command: str, ended: Ended) -> Iterator[str]:
    if ended.killed:
        yield f"{command} hangs"
    if ended.crashed or ended.exit_code not in (0, 1, 2, 3, 4):
        yield f"{command}: exit code {ended.exit_code}: {ended.said[-300:]}"
    if ended.rss_bytes > _MAX_BYTES:
        yield f"{command} takes {ended.rss_bytes >> 20} MB"


def _missed(place: Path, before: dict[str, str]) -> Iterator[str]:
    after = _all_sums(place)
    yield from (f"{name} is lost" for name in sorted(before) if after.get(name) != before[name])


def _all_sums(place: Path) -> dict[str, str]:
    return {
        str(path.relative_to(place)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(place.rglob("*"))
        if path.is_file() and not path.is_symlink()
    }


def _swapped(place: Path, chance: random.Random, touched: Touched) -> Iterator[str]:
    """Have something else take a name that a command touches."""
    what = chance.choice(list(_WORK))
    command, replaced = _WORK[what]
    if chance.randrange(_BATCH_EVERY) == 0:
        command, replaced, names = _BATCH, (), list(_BATCH_NAMES)
    else:
        names = touched(what)
    name = place / chance.choice(names)
    obstacle = chance.choice(list(_OBSTACLES))
    (place / "away").mkdir()
    if os.path.lexists(name):
        name.rename(place / "away" / "it")
    above = name.parent
    if not above.is_dir():
        while not above.parent.is_dir():
            above = above.parent
        if os.path.lexists(above):
            return
        name.parent.mkdir(parents=True)
    _OBSTACLES[obstacle](place, name)
    known, own = str(name.relative_to(place)), _RESULTS.get(what, "\0")
    before = {
        each: content
        for each, content in _all_sums(place).items()
        if each not in replaced and not each.startswith(own)
    }
    ended = _in(place, command.split(), installed=chance.randrange(_INSTALLED_EVERY) == 0)
    shown = f"{obstacle} as {known}, {command}"
    yield from _faults_of(shown, ended)
    yield from (f"{shown}: {each}" for each in _missed(place, before))


def _changed(place: Path, chance: random.Random, _: Touched) -> Iterator[str]:
    """Change a value of a record, and give it to those that read it."""
    record = place / chance.choice([each for each in _RECORDS if (place / each).exists()])
    shown = str(record.relative_to(place))
    if record.suffix in (".json", ".part") and record.name != "steering.csv.part":
        said = json.loads(record.read_bytes())
        changed = f"{shown} {_change(said, chance)}"
        record.write_text(json.dumps(said))
    elif record.suffix == ".csv":
        rows = [line.split(",") for line in record.read_text().splitlines()]
        row = chance.choice(rows)
        place_in_row = chance.randrange(len(row))
        row[place_in_row] = str(chance.choice(_VALUES))
        changed = f"{shown} cell {place_in_row} = {row[place_in_row][:40]!r}"
        record.write_text("\n".join(map(",".join, rows)) + "\n", errors="replace")
    else:
        record.write_bytes(flipped(record.read_bytes(), chance))
        changed = f"{shown} flipped"
    folder = shown.partition("/")[0] + "/"
    before = {name: s for name, s in _all_sums(place).items() if not name.startswith(folder)}
    what = chance.choice(_RECORDS[shown])
    command, replaced = _WORK[what]
    if folder == "many/" and chance.randrange(_BATCH_EVERY) == 0:
        command = _BATCH.replace("many2", "many")
    ended = _in(place, command.split(), installed=chance.randrange(_INSTALLED_EVERY) == 0)
    yield from _faults_of(f"{changed}, {command}", ended)
    for name in replaced:
        before.pop(name, None)
    yield from (f"{changed}, {command}: {each}" for each in _missed(place, before))


def _change(said: Any, chance: random.Random) -> str:
    """Change a value somewhere in a record, and return where and to what."""
    path = []
    while True:
        keys = list(said) if isinstance(said, dict) else list(range(len(said)))
        key = chance.choice(keys)
        path.append(str(key))
        inner = said[key]
        if not (isinstance(inner, dict | list) and inner) or chance.random() < 0.2:
            break
        said = inner
    if chance.random() < 0.15:
        del said[key]
        return f"{'.'.join(path)} gone"
    said[key] = chance.choice(_VALUES)
    return f"{'.'.join(path)} = {str(said[key])[:40]!r}"


def _killed_anywhere(place: Path, chance: random.Random, _: Touched) -> Iterator[str]:
    """Kill a command before it changes the disk; then the same has to work."""
    unkilled = ("report", "page", "reports", "status", "shard")  # the last has processes of its own
    what = chance.choice([each for each in _WORK if each not in unkilled])
    command, replaced = _WORK[what]
    outs = (
        *("out", "golden/", "begun", "table.csv", "sim", "old", "more", "all/", "configured"),
        *("drive/", "driven/"),
    )
    before = {
        name: s
        for name, s in _all_sums(place).items()
        if name not in replaced and not name.startswith(outs)
    }
    _in(place, command.split(), _killing(chance.randrange(60)))
    again = command.split()
    if what in _NEW:
        again.append("--overwrite")
    ended = _in(place, again)
    if ended.exit_code not in (0, 3, 4):
        yield f"{command} killed: then {ended.exit_code}: {ended.said[-300:]}"
    yield from _faults_of(command, ended)
    yield from (f"{command} killed: {each}" for each in _missed(place, before))


def _make(clip: Clip, made: Path) -> None:
    """Make what a user has: recordings, a rig, results, and a file that is precious."""
    made.mkdir()
    for path, name in zip((*clip.paths, clip.rig_file), ("left", "right", "rig"), strict=True):
        shutil.copy(path, made / (name + path.suffix))
    (made / "precious").mkdir()
    for number in range(30):
        (made / f"precious/{number:06d}.png").write_bytes(b"mine")
    for name in ("left", "right"):
        shutil.copy(made / f"{name}.mp4", made / "precious")
    (made / "m.csv").write_text("left,right,out,rig\nleft.mp4,right.mp4,a,rig.yaml\n")
    (made / "plan.toml").write_text(_PLAN)
    (made / "run.toml").write_text(_CONFIG)
    for command in (
        *(f"run {_CLIP} --save {_SAVE} -o {name}" for name in ("golden", "golden2")),
        _BATCH.replace("many2", "many"),
        *(_WORK[f"{each} again"][0].replace(" --overwrite", "") for each in _AGAIN),
    ):
        ended = _in(made, command.split())
        if ended.exit_code:
            raise RuntimeError(f"{command}: {ended.said}")
    for calls in range(60, 400, 20):  # until it was far enough to have a checkpoint
        shutil.rmtree(made / "begun", ignore_errors=True)
        _in(made, _WORK["resume"][0].split(), _killing(calls))
        if (made / "begun/run.checkpoint").exists():
            break


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


def _gone(place: Path, before: dict[str, str]) -> Iterator[str]:
    after = _sums(place)
    yield from (f"{name} is lost" for name in sorted(before) if after.get(name) != before[name])


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


def _planted(place: Path, chance: random.Random, _: Touched) -> Iterator[str]:
    """Kill a run, plant links at random names, and go on."""
    out, before = place / "out", _sums(place)
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
    yield from _gone(place, before)


def _offered(place: Path, chance: random.Random, _: Touched) -> Iterator[str]:
    """Offer a command one of its inputs as its output."""
    (command, targets), before = chance.choice(_COMMANDS), _sums(place)
    known = {name: place / name for name in ("golden", "golden2", "out")}
    known |= {"left": place / "left.mp4", "right": place / "right.mp4", "rig": place / "rig.yaml"}
    target = place / chance.choice(targets)
    if chance.random() < 0.3:  # under another name
        link = place / "link"
        link.symlink_to(target)
        target = link
    if _called([*(each.format(**known) for each in command), str(target)]) != 1:
        yield f"{command[0]} takes its input {target.name} as its output"
    yield from _gone(place, before)


def _killed(place: Path, chance: random.Random, _: Touched) -> Iterator[str]:
    """Kill a run, or the replacing of one, before a random change; then the same has to work."""
    out, before = place / "out", _sums(place)
    option = chance.choice(["--resume", "--overwrite"])
    if option == "--overwrite":
        _called(_run(place, out))
    _called([*_run(place, out), option], _killing(chance.randrange(120)))
    if _called([*_run(place, out), option]):
        yield f"{option} no longer works"
    elif len(list((out / "charge-png").iterdir())) != 9 or list(out.glob("*.part")):
        yield f"{option} leaves something else than 9 images"
    yield from _gone(place, before)
