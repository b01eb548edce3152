"""Shards of a batch: no scheduler, any number of processes, any of which may be killed."""

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml
from hypothesis import given, strategies

import motionstereo_cli
from bench.preloads import killer_of
from motionstereo_cli.__main__ import main
from motionstereo_cli.batch import shard as shards
from motionstereo_cli.batch.own_folder import read_status, status_path
from motionstereo_cli.batch.shard import Shard
from motionstereo_cli.errors import SettingsError
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.simulate.write import simulate

FRAMES, COUNT = 6, 12
NAMES = [f"rec{number:02d}" for number in range(COUNT)]


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    """One recording under many names."""
    folder = tmp_path_factory.mktemp("archive")
    settings = SimulateSettings(frames=f"300:{300 + FRAMES}", width=96, height=64, noise_sigma=1.5)
    simulate(folder / "clip", settings)
    rows = [f"clip/left.mp4,clip/right.mp4,clip/rig.yaml,{name}" for name in NAMES]
    (folder / "all.csv").write_text("\n".join(["left,right,rig,out", *rows]) + "\n")
    return folder


def words(archive, out, *more):
    given = ["batch", archive / "all.csv", "-o", out, "--no-check", "--workers", 1]
    return [str(word) for word in (*given, "--save", "steering,depth", *more)]


def started(archive, out, *more, **environment):
    command = [sys.executable, "-m", "motionstereo_cli", *words(archive, out, *more)]
    environment = {**os.environ, **environment}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, **quiet, text=True, env=environment)


def table(out):
    with (out / "batch.csv").open(newline="") as file:
        return {row["name"]: row["status"] for row in csv.DictReader(file)}


def until(condition, seconds=120):
    until_s = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until_s
        time.sleep(0.02)


def contents(folder):
    return {
        path.relative_to(folder): path.read_bytes()
        for path in folder.rglob("*.*")
        if path.name != "run.json"
    }


def test_eight_shards_at_once_some_of_them_killed_then_again(archive, tmp_path):
    out = tmp_path / "out"
    running = [started(archive, out, "--shard", f"{index}/8") for index in range(8)]
    until(lambda: list(out.glob("*/run.json")))
    for process in running[::3]:
        process.kill()
    for process in running:
        _, said = process.communicate(timeout=120)
        assert process.returncode in (0, -signal.SIGKILL), said
        assert "Traceback" not in said
    done = {path: path.stat().st_mtime_ns for path in out.glob("*/run.json")}
    for index in range(1, 9):
        assert main(words(archive, out, "--shard", f"{index}/8")) == 0
    assert done == {path: path.stat().st_mtime_ns for path in done}
    assert table(out) == dict.fromkeys(NAMES, "done")
    assert main(words(archive, out, "--status")) == 0

    clip = [str(archive / "clip" / name) for name in ("left.mp4", "right.mp4")]
    options = ["--rig", str(archive / "clip/rig.yaml"), "--no-check", "--save", "steering,depth"]
    assert main(["run", *clip, *options, "-o", str(tmp_path / "alone")]) == 0
    alone = contents(tmp_path / "alone")
    assert len(alone) > FRAMES
    assert all(contents(out / name) == alone for name in NAMES)
    lines = [
        json.loads(line)
        for path in (out / ".batch/ended").iterdir()
        for line in path.read_text().splitlines()
    ]
    assert {line["name"] for line in lines if line["status"] == "done"} >= {
        path.parent.name for path in out.glob("*/run.json") if path not in done
    }


def test_the_process_of_a_killed_shard_leaves_a_checkpoint_and_ends(archive, tmp_path):
    out = tmp_path / "out"
    process = started(archive, out, "--shard", "0/1")

    def running():
        found = [read_status(out, name) for name in NAMES]
        return [status for status in found if status.status == "running"]

    until(running)
    worker = int(running()[0].worker.rpartition(":")[2])
    process.kill()
    process.wait()

    def gone():
        try:
            os.kill(worker, 0)
        except ProcessLookupError:
            return True
        return False

    until(gone, 30)
    process.stderr.close()
    assert main(words(archive, out, "--shard", "0/1")) == 0
    assert table(out) == dict.fromkeys(NAMES, "done")


def test_what_ends_its_process_is_lost_by_itself(archive, tmp_path):
    (tmp_path / "archive").mkdir()
    for name in ("a", "b", "c"):
        shutil.copytree(archive / "clip", tmp_path / "archive" / name)
    rows = [f"{name}/left.mp4,{name}/right.mp4,{name}" for name in "abc"]
    (tmp_path / "archive/all.csv").write_text("\n".join(["left,right,out", *rows]) + "\n")
    (tmp_path / "site").mkdir()
    (tmp_path / "site/sitecustomize.py").write_text(
        "import sys\nif 'forkserver' in repr(sys.orig_argv):\n"
        + "".join(f"    {line}\n" for line in killer_of("/b/").splitlines())
    )
    out = tmp_path / "out"
    more = {"PYTHONPATH": str(tmp_path / "site")}
    process = started(tmp_path / "archive", out, "--shard", "1/1", **more)
    _, said = process.communicate(timeout=120)
    assert process.returncode == 1
    assert table(out) == {"a": "done", "b": "lost", "c": "done"}
    assert "b: lost: it ended the process that worked on it, twice" in said
    assert "Traceback" not in said
    # Only what is asked for is tried again.
    assert main(words(tmp_path / "archive", out, "--shard", "1/1")) == 1
    assert main(words(tmp_path / "archive", out, "--shard", "1/1", "--retry-failed")) == 0


def test_an_interrupted_shard_goes_on(archive, tmp_path):
    out = tmp_path / "out"
    process = started(archive, out, "--shard", "0/1")
    until(lambda: list(out.glob("*/run.json")))
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=120)
    assert process.returncode == 130, said
    assert "run the same command again to continue" in said
    assert set(table(out).values()) <= {"done", "waiting", "interrupted"}
    assert main(words(archive, out, "--status")) == (table(out) != dict.fromkeys(NAMES, "done"))
    assert main(words(archive, out, "--shard", "0/1")) == 0
    assert table(out) == dict.fromkeys(NAMES, "done")


@given(strategies.text(max_size=9), strategies.integers(1, 40))
def test_each_recording_is_in_one_shard_however_they_are_counted(name, count):
    for first in (0, 1):
        all_of_them = [Shard.parse(f"{index}/{count}") for index in range(first, count + first)]
        assert sum(shard.has(name) for shard in all_of_them) == 1


def test_shares_are_about_equal():
    shares = [sum(Shard(i, 4).has(f"day/{n:05d}") for n in range(4000)) for i in range(4)]
    assert max(shares) < 1.1 * min(shares)


@pytest.mark.parametrize(
    "text", ["", "3", "5/4", "-1/4", "1/0", "a/b", "1/2/3", "1.0/4", "\u0661/4"]
)
def test_what_is_no_shard_is_refused(text):
    with pytest.raises(SettingsError, match="give i/N"):
        Shard.parse(text)


def test_what_does_not_go_together_is_said(archive, tmp_path, capsys):
    for more, said in (
        (["--shard", "0/2", "--scheduler", "tcp://127.0.0.1:9"], "leave --scheduler out"),
        (["--shard", "0/2", "--pieces", "2"], "leave --pieces out"),
        (["--detach"], "--detach needs --scheduler"),
    ):
        assert main(words(archive, tmp_path / "out", *more)) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert main(words(archive, tmp_path / "out", "--status")) == 1
    assert f"{COUNT} recordings: {COUNT} waiting" in capsys.readouterr().err


def test_shards_with_other_versions_are_refused(archive, tmp_path, capsys, monkeypatch):
    out = tmp_path / "out"
    half = ["--shard", "0/2"]
    assert main(words(archive, out, *half)) == 0
    path = out / ".batch/builds.json"
    told = json.loads(path.read_text())
    told["builds"]["numpy"] = "1.0"
    path.write_text(json.dumps(told))
    capsys.readouterr()
    assert main(words(archive, out, "--shard", "1/2")) == 1
    assert "numpy is 1.0, and not " in capsys.readouterr().err
    assert sorted(set(table(out).values())) == ["done", "waiting"]
    path.unlink()
    assert main(words(archive, out, "--shard", "1/2")) == 0


def test_a_shard_is_one_process_and_a_batch_is_alone(archive, tmp_path, capsys):
    out = tmp_path / "out"
    with shards.locked(out, shared=True), shards.locked(out / ".batch/shards/0-of-2"):
        (out / ".batch/shards/0-of-2").rmdir()
    with shards.locked(out, shared=True):
        assert main(words(archive, out)) == 1
        assert "is being written by another run" in capsys.readouterr().err
    with shards.locked(out):
        assert main(words(archive, out, "--shard", "0/2")) == 1
    assert not status_path(out, NAMES[0]).exists()


def recipes():
    """The blocks of code of the page of batches that have shards, by what runs them."""
    page = Path(motionstereo_cli.__file__).parent / "docs/batches.md"
    blocks = re.findall(r"^```\w*\n(.*?)^```$", page.read_text(), re.DOTALL | re.MULTILINE)
    xargs, slurm, job = (
        next(block for block in blocks if word in block and "--shard" in block)
        for word in ("xargs", "#SBATCH", "apiVersion")
    )
    (container,) = yaml.safe_load(job)["spec"]["template"]["spec"]["containers"]
    shell, option, kubernetes = container["command"]
    assert (shell, option) == ("sh", "-c")
    return {"xargs": xargs, "SLURM": slurm, "Kubernetes": kubernetes, "job": yaml.safe_load(job)}


VARIABLES = {
    "xargs": [{}],
    "SLURM": [
        {"SLURM_ARRAY_TASK_ID": str(index), "SLURM_ARRAY_TASK_COUNT": "64"} for index in range(64)
    ],
    "Kubernetes": [{"JOB_COMPLETION_INDEX": str(index)} for index in range(64)],
}


@pytest.mark.parametrize("how", VARIABLES)
def test_the_recipes_of_the_page_reach_each_recording_once(archive, tmp_path, how):
    """A program in the place of the command notes the share; the command knows what it means."""
    (tmp_path / "motionstereo").write_text(f'#!/bin/sh\necho "$@" >> {tmp_path}/calls\n')
    (tmp_path / "motionstereo").chmod(0o755)
    path = f"{tmp_path}:{os.environ['PATH']}"
    for variables in VARIABLES[how]:
        environment = {**os.environ, **variables, "PATH": path}
        subprocess.run(["sh", "-c", recipes()[how]], env=environment, check=True)
    calls = (tmp_path / "calls").read_text().splitlines()
    assert all(call.startswith("batch recordings.csv -o results --shard ") for call in calls)
    shares = [Shard.parse(call.rpartition(" ")[2]) for call in calls]
    for name in NAMES:
        assert sum(share.has(name) for share in shares) == 1
    spec = recipes()["job"]["spec"]
    assert (spec["completionMode"], spec["completions"]) == ("Indexed", 64)
