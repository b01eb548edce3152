"""Batches: the manifest is checked whole, workers are real processes, the truth is on the disk."""

import csv
import dataclasses
import json
import re
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import av
import numpy as np
import pytest
from recordings import encode, remux

from bench.preloads import killer_of
from motionstereo_cli.__main__ import main
from motionstereo_cli.batch.manifest import matched, plans, read_manifest
from motionstereo_cli.batch.own_folder import log_path, read_status, status_path, write_status
from motionstereo_cli.batch.pieces import Piece, behind_damage, join_pieces, pieces_of, run_piece
from motionstereo_cli.batch.status import COLUMNS, Status, format_statuses
from motionstereo_cli.batch.task import Task
from motionstereo_cli.batch.work import work
from motionstereo_cli.commands.batch import plan_of
from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.files.atomic import write_whole
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.runs.plan import RunPlan
from motionstereo_cli.runs.run import Watcher, run
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.simulate.write import simulate
from motionstereo_cli.sinks.outputs import OUTPUTS

pytest.importorskip("distributed")

FRAMES = 6
OPTIONS = {"rig": False, "max-disparity": False, "check": True, "preset": False}


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording")
    settings = SimulateSettings(frames=f"300:{300 + FRAMES}", width=96, height=64, noise_sigma=1.5)
    simulate(folder / "clip", settings)
    return folder / "clip"


@pytest.fixture(scope="module")
def archive(tmp_path_factory, recording):
    """Three good recordings, and one whose left video is text."""
    folder = tmp_path_factory.mktemp("archive")
    for name in ("a", "b", "c", "bad"):
        (folder / name).mkdir()
        for side in ("left.mp4", "right.mp4", "rig.yaml"):
            shutil.copy(recording / side, folder / name / side)
    (folder / "bad/left.mp4").write_text("no video")
    rows = [
        f"{name}/left.mp4,{name}/right.mp4,{name}/rig.yaml,day/{name}"
        for name in ("a", "b", "c", "bad")
    ]
    (folder / "all.csv").write_text("left,right,rig,out\n" + "\n".join(rows) + "\n")
    return folder


def batched(*arguments):
    return main(["batch", *map(str, arguments), "--workers", "2", "--no-check"])


def table(out):
    with (out / "batch.csv").open(newline="") as file:
        return {row["name"]: row for row in csv.DictReader(file)}


def manifest(tmp_path, text):
    path = tmp_path / "all.csv"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("text", "lines"),
    [
        ("left,right\na,b\na,\n", ["line 1: there is no column out"]),
        ("left,out,speed\na,b,1\n", ["line 1: run has no option 'speed'"]),
        ("left,out\na\n,x\n", ["line 2: 1 cells and not 2", "line 3: left cannot be empty"]),
        ("left;out\na;b\n", ["line 1: columns are separated by commas only"]),
        ("left,out,max-disparty\na,b,1\n", ["(did you mean 'max-disparity'?)"]),
        ("left,out,check\na,b,maybe\n", ["line 2: check cannot be 'maybe': give yes or no"]),
        ("", ["there is no column left", "there is no column out"]),
        (
            "left,out,speed,check,max-disparity\na,a,1,perhaps,many\na,b,1,no,many\nb,a,,,\n",
            [
                *("line 1: run has no option 'speed'", "line 2: check cannot be 'perhaps'"),
                "line 2 and 1 more: --max-disparity cannot be 'many'",
                "line 4: out a is that of",
            ],
        ),
    ],
)
def test_all_that_is_wrong_with_a_manifest_is_said_at_once_with_its_line(tmp_path, text, lines):
    (tmp_path / "a").touch()
    with pytest.raises(InputError) as refused:
        plans(read_manifest(manifest(tmp_path, text), OPTIONS, {"rig"}), tmp_path / "out", plan_of)
    first, *more = [str(refused.value), *getattr(refused.value, "__notes__", [])]
    said = [first.partition("nothing was started: ")[2], *more]
    assert len(said) == len(lines)
    for line, found in zip(lines, said, strict=True):
        assert line in found


def test_a_manifest_without_recordings_is_refused(tmp_path):
    with pytest.raises(InputError, match="names no recording"):
        read_manifest(manifest(tmp_path, "left,out\n"), OPTIONS, set())


def test_paths_are_relative_to_the_manifest_and_cells_are_options(tmp_path):
    path = manifest(
        tmp_path,
        "left,right,out,rig,max_disparity,check\n"
        "l.mp4,r.mp4,one,k1.yaml; k2.yaml,96,no\n"
        "both.mp4,,two,,,\n",
    )
    one, two = read_manifest(path, OPTIONS, {"rig"})
    assert one.options == (
        *("--rig", str(tmp_path / "k1.yaml"), "--rig", str(tmp_path / "k2.yaml")),
        *("--max-disparity", "96", "--no-check"),
    )
    assert one.inputs == (str(tmp_path / "l.mp4"), str(tmp_path / "r.mp4"))
    assert (two.options, two.inputs) == ((), (str(tmp_path / "both.mp4"),))


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ("left,out\nx,a\nx,a\n", "line 3: out a is that of"),
        ("left,out\nx,a\nx,a/b\n", "line 3: out a/b and that of"),
        ("left,out\nx,a/b/c\nx,a\n", "line 3: out a and that of"),
        ("left,out\nx,../a\n", "is outside the folder"),
        ("left,out,max-disparity\nx,a,none\n", "line 2: --max-disparity cannot be 'none'"),
        ("left,out\nmissing.mp4,a\n", "line 2: there is no"),
    ],
)
def test_a_batch_is_refused_whole(tmp_path, rows, said):
    (tmp_path / "x").touch()
    entries = read_manifest(manifest(tmp_path, rows), OPTIONS, set())
    with pytest.raises(InputError) as refused:
        plans(entries, tmp_path / "out", plan_of)
    assert said in "\n".join([str(refused.value), *getattr(refused.value, "__notes__", [])])
    assert not (tmp_path / "out").exists()


def test_patterns_pair_what_differs(archive):
    found = matched(str(archive / "*/left.mp4"), str(archive / "*/right.mp4"))
    assert [entry.name for entry in found] == ["a", "b", "bad", "c"]
    assert found[0].inputs == (str(archive / "a/left.mp4"), str(archive / "a/right.mp4"))
    with pytest.raises(InputError, match="no partner"):
        matched(str(archive / "*/left.mp4"), str(archive / "[ab]/right.mp4"))
    with pytest.raises(InputError, match="nothing matches"):
        matched(str(archive / "*/none.mp4"), None)
    assert [entry.name for entry in matched(str(archive / "a/left.mp4"), None)] == ["left"]
    assert main(["batch", "a.mp4", "b.mp4", "c.mp4"]) == 2  # as a shell makes of patterns
    with pytest.raises(InputError, match="are no patterns: for one recording of two"):
        matched(str(archive / "a/left.mp4"), str(archive / "a/right.mp4"))


def test_a_folder_has_its_name_however_it_is_given(archive, monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(archive / "a")
    for given in (".", "../a", str(archive / "a"), "../b/.."):
        assert [entry.name for entry in matched(given, None)] == [
            "a" if "b" not in given else archive.name
        ]
    assert main(["batch", "/", "-o", str(tmp_path / "x")]) == 1
    assert "the batch has no recordings: give a manifest" in capsys.readouterr().err
    assert main(["batch", ".", "-o", str(tmp_path / "x"), "--end", "3"]) in (0, 3)
    assert (tmp_path / "x" / "a" / "run.json").is_file()


def test_its_help_has_the_options_of_run_that_it_takes(capsys):
    assert main(["batch", "--help-all"]) == 0
    listed = re.sub(r"\s+", "", capsys.readouterr().out.partition("explains them:")[2])
    assert "--max-disparity" in listed
    assert main(["run", "--help-all"]) == 0
    explained = capsys.readouterr().out
    names = re.findall(r"--[a-z-]+[a-z]", listed.partition("Examples")[0])
    assert [name for name in names if name not in explained] == []
    assert "--overwrite" not in names


def test_a_plan_survives_the_way_to_another_process():
    plan = plan_of(
        ["a.mp4", "b.mp4", "--rig", "r.yaml", "--max-disparity", "96", "--save", "depth"]
    )
    there = RunPlan.of_json(json.loads(json.dumps(plan.as_json())))
    assert there == plan
    assert there.settings == Settings(max_disparity=96)


def test_a_status_is_read_as_it_was_written_and_a_broken_one_is_waiting(tmp_path):
    status = Status("day/a", "failed", 3, 1.5, 0.25, None, reason='a "reason", with commas')
    write_status(tmp_path, status)
    assert read_status(tmp_path, "day/a") == status
    rows = list(csv.DictReader(format_statuses([status]).decode().splitlines()))
    assert list(rows[0]) == list(COLUMNS)
    assert rows[0]["reason"] == status.reason
    status_path(tmp_path, "day/a").write_text("{")
    assert read_status(tmp_path, "day/a").status == "waiting"


def test_good_recordings_are_done_as_run_does_them_and_bad_ones_named(archive, tmp_path, capsys):
    out = tmp_path / "out"
    assert batched(archive / "all.csv", "-o", out, "--json", "--progress", "jsonl") == 1
    said = capsys.readouterr()
    *told, end = [json.loads(line) for line in said.err.splitlines()]
    ended = [event["recording"]["name"] for event in told if event["kind"] == "recording"]
    assert sorted(ended) == ["day/a", "day/b", "day/bad", "day/c"]
    assert (end["kind"], end["status"]) == ("end", "failed")
    lines = [json.loads(line) for line in said.out.splitlines()]
    assert {line["name"] for line in lines} == {"day/a", "day/b", "day/c", "day/bad"}
    rows = table(out)
    assert [rows[f"day/{name}"]["status"] for name in "abc"] == ["done"] * 3
    assert rows["day/bad"]["status"] == "failed"
    assert "left.mp4" in rows["day/bad"]["reason"]
    assert rows["day/a"]["frames"] == str(FRAMES)
    alone = tmp_path / "alone"
    clip = archive / "a"
    assert (
        main(
            [
                "run",
                str(clip / "left.mp4"),
                str(clip / "right.mp4"),
                "--no-check",
                "--rig",
                str(clip / "rig.yaml"),
                "-o",
                str(alone),
            ]
        )
        == 0
    )
    for file in alone.rglob("*"):
        if file.is_file() and file.name != "run.json":
            assert file.read_bytes() == (out / "day/a" / file.relative_to(alone)).read_bytes()
    assert "failed" in log_path(out, "day/bad").read_text()

    # The same again does nothing; what failed is only tried again where that is asked for.
    before = {path: path.stat().st_mtime_ns for path in (out / ".batch/status").rglob("*.json")}
    assert batched(archive / "all.csv", "-o", out) == 1
    assert before == {path: path.stat().st_mtime_ns for path in before}
    assert "--retry-failed tries what failed" in capsys.readouterr().err
    assert batched(archive / "all.csv", "-o", out, "--overwrite") == 2
    assert "remove its folder in OUT" in capsys.readouterr().err
    assert batched(archive / "all.csv", "-o", out, "--retry-failed") == 1
    assert "--retry-failed tries" not in capsys.readouterr().err
    changed = [path.name for path in before if before[path] != path.stat().st_mtime_ns]
    assert changed == ["bad.json"]


def piecemeal(given, tmp_path, count):
    """Do a run whole and in pieces, and return which pieces were made again."""
    whole, parts = (
        plan_of(
            [*given, "-o", str(tmp_path / name / "out"), "--csv", str(tmp_path / name / "t.csv")]
        )
        for name in ("whole", "parts")
    )
    for name in ("whole", "parts"):
        (tmp_path / name).mkdir()
    run(whole)
    pieces, home = pieces_of(parts, count), tmp_path / "pieces"
    assert len(pieces) == count
    for piece in reversed(pieces):
        run_piece(parts, piece, home, Watcher())
    again = behind_damage(home, pieces)
    for piece in again:
        run_piece(parts, piece, home, Watcher(), seek=False)
    assert behind_damage(home, pieces) == []
    join_pieces(parts, pieces, home, Watcher())
    one, other = (
        {
            str(path.relative_to(tmp_path / name)): path.read_bytes()
            for path in (tmp_path / name).rglob("*.*")
        }
        for name in ("whole", "parts")
    )
    assert one.keys() == other.keys()
    assert [name for name in one if one[name] != other[name]] == ["out/run.json"]
    one, other = (json.loads(each["out/run.json"]) for each in (one, other))
    assert {**one, "timing": None} == {**other, "timing": None}
    return [pieces.index(piece) for piece in again]


@pytest.fixture(scope="module")
def long_clip(tmp_path_factory):
    """45 frames with a key frame every 10, in which a seek can begin."""
    folder = tmp_path_factory.mktemp("long") / "clip"
    settings = SimulateSettings(frames="300:345", width=96, height=64, noise_sigma=1.5)
    simulate(folder, settings)
    for side in ("left.mp4", "right.mp4"):
        with av.open(str(folder / side)) as video:
            images = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
        # In colour, which some outputs show.
        tinted = [(image * (1.0, 0.8, 0.6)).astype(np.uint8) for image in images]
        options = {"g": "10", "bf": "2"}
        encode(folder / side, tinted, "libx264", "yuv420p", options=options, rgb=True)
    return folder


def options_of(clip):
    given = [str(clip / "left.mp4"), str(clip / "right.mp4"), "--rig", str(clip / "rig.yaml")]
    return [*given, "--checkpoint-frames", "10", "--no-check"]


@pytest.mark.parametrize(
    ("count", "frames", "save", "poses"),
    [
        (2, 45, ",".join(OUTPUTS), "poses.txt"),
        (2, 31, ",".join(OUTPUTS), "auto"),
        (5, 45, "steering,objects,disparity,depth-video,map", "poses.txt"),
        (5, 44, "steering,objects,poses,poses-kitti,odometry,map", "auto"),
        (5, 45, "steering,objects,disparity,map", "disparity"),
    ],
)
def test_pieces_give_the_bytes_of_one_run(long_clip, tmp_path, count, frames, save, poses):
    """Every output, in permanency mode; a run-in that is too short shows."""
    options = ["--poses", poses if poses == "auto" else str(long_clip / poses)]
    if poses == "disparity":
        options = ["--disparity", str(long_clip / poses), "--poses", "auto"]
    given = [*options_of(long_clip), *options, "--save", save, "--end", str(frames)]
    assert piecemeal(given, tmp_path, count) == []


@pytest.mark.parametrize(
    ("lost", "again"),
    [
        # The packet of an image that nothing is built on, or of one that others are built on.
        ({4}, [3, 4]),  # the second and the third begin at the first frame, too
        ({22, 30}, [3, 4]),
    ],
)
def test_pieces_of_damaged_recordings_give_the_bytes_of_one_run(long_clip, tmp_path, lost, again):
    clip = tmp_path / "clip"
    shutil.copytree(long_clip, clip)
    remux(
        *(long_clip / "left.mp4", clip / "left.mp4"),
        lambda number, packet: b"no image" if number in lost else packet,
    )
    given = [*options_of(clip), "--save", "steering,disparity,charge"]
    assert piecemeal(given, tmp_path, 5) == again
    assert json.loads((tmp_path / "whole/out/run.json").read_text())["damage"]


def test_a_piece_says_what_became_of_it_only_if_it_failed(long_clip, tmp_path):
    plan = plan_of([*options_of(long_clip), "--save", "steering", "-o", str(tmp_path / "a")])
    task = Task(plan.as_json(), "h", tmp_path, "a", piece=Piece(0, 10))
    work(task)
    assert read_status(tmp_path, "a").status == "waiting"
    missing = {**task.plan, "left": str(tmp_path / "none.mp4")}
    work(dataclasses.replace(task, piece=Piece(10, None), plan=missing))
    assert read_status(tmp_path, "a").status == "failed"
    work(dataclasses.replace(task, piece=Piece(20, None)))  # it began later: the failure stays
    assert read_status(tmp_path, "a").status == "failed"


def test_processes_that_write_a_file_at_the_same_time_do_not_take_each_others_part(tmp_path):
    def write(number):
        for _ in range(200):
            write_whole(tmp_path / "file", str(number).encode())

    with ThreadPoolExecutor() as threads:
        list(threads.map(write, range(4)))
    assert (tmp_path / "file").read_bytes() in (b"0", b"1", b"2", b"3")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_pieces_keep_to_what_is_chosen(long_clip, tmp_path):
    given = [*options_of(long_clip), "--save", "steering,disparity"]
    given += ["--start", "3", "--end", "40", "--every", "2", "--checkpoint-frames", "5"]
    assert piecemeal(given, tmp_path, 2) == []


def test_what_cannot_be_done_in_pieces_is_said(recording):
    clip = [str(recording / "left.mp4"), str(recording / "right.mp4")]
    with pytest.raises(SettingsError, match="never forgets"):
        pieces_of(plan_of([*clip, "--charge-mode", "general"]), 2)


def test_what_ends_its_worker_is_lost_by_itself(archive, tmp_path, monkeypatch):
    (tmp_path / "killer.py").write_text(killer_of("/b/"))
    monkeypatch.setenv("DASK_DISTRIBUTED__WORKER__PRELOAD", str(tmp_path / "killer.py"))
    out = tmp_path / "out"
    command = [sys.executable, "-m", "motionstereo_cli", "batch", "--workers", "2", "--no-check"]
    command += [str(archive / "*/left.mp4"), str(archive / "*/right.mp4"), "-o", str(out)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=180, check=False)
    assert ended.returncode == 1, ended.stderr
    rows = table(out)
    assert {name: row["status"] for name, row in rows.items()} == {
        "a": "done",
        "b": "lost",
        "bad": "failed",
        "c": "done",
    }
    assert "it ended the process that worked on it, twice" in rows["b"]["reason"]
    assert "Traceback" not in ended.stderr


@pytest.mark.parametrize("ended_by", [signal.SIGINT, signal.SIGKILL], ids=["Ctrl-C", "killed"])
def test_a_batch_that_was_ended_goes_on(archive, tmp_path, ended_by):
    out = tmp_path / "out"
    command = [sys.executable, "-m", "motionstereo_cli", "batch", "--workers", "1", "--no-check"]
    command += [str(archive / "all.csv"), "-o", str(out)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    until_s = time.monotonic() + 120
    while not list(out.glob("day/*/run.json")) and time.monotonic() < until_s:
        time.sleep(0.05)
    process.send_signal(ended_by)
    _, said = process.communicate(timeout=120)  # workers end too, and with them their output
    assert process.returncode == (130 if ended_by == signal.SIGINT else -signal.SIGKILL), said
    assert ("run the same command again to continue" in said) == (ended_by == signal.SIGINT)
    done = {path: path.stat().st_mtime_ns for path in out.glob("day/*/run.json")}
    assert batched(archive / "all.csv", "-o", out) == 1
    assert done == {path: path.stat().st_mtime_ns for path in done}
    assert sorted(path.parent.name for path in out.glob("day/*/run.json")) == ["a", "b", "c"]


@pytest.fixture(scope="module")
def by_hand(tmp_path_factory):
    """The file of a scheduler with a worker, separate processes that meet over TCP."""
    folder = tmp_path_factory.mktemp("cluster")
    file = folder / "scheduler.json"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    programs = {
        "dask_scheduler": ("--host", "127.0.0.1", "--port", "0"),
        "dask_worker": ("--nthreads", "1", "--local-directory", folder),
    }
    started = []
    for program, options in programs.items():
        command = [sys.executable, "-m", f"distributed.cli.{program}", "--no-dashboard"]
        given = [*options, "--scheduler-file", file]
        started.append(subprocess.Popen([*command, *map(str, given)], **quiet))
    until_s = time.monotonic() + 60
    while not file.exists() and time.monotonic() < until_s:
        time.sleep(0.1)
    yield file
    for process in reversed(started):
        process.terminate()
        process.wait(timeout=30)


def by_scheduler(file, archive, out, *more):
    given = [archive / "[ab]/left.mp4", archive / "[ab]/right.mp4", "-o", out]
    given += ["--scheduler-file", file, "--no-check", *more]
    return main(["batch", *map(str, given)])


def test_a_scheduler_and_workers_by_hand(archive, by_hand, tmp_path):
    """They share each recording."""
    out = tmp_path / "out"
    assert by_scheduler(by_hand, archive, out, "--pieces", 2, "--checkpoint-frames", 3) == 0
    assert [row["status"] for row in table(out).values()] == ["done", "done"]
    assert [row["frames"] for row in table(out).values()] == [str(FRAMES)] * 2
    assert not list((out / ".batch/pieces").iterdir())


def test_the_client_may_leave_and_come_back(archive, by_hand, tmp_path, capsys):
    out = tmp_path / "out"
    assert by_scheduler(by_hand, archive, out, "--detach") == 0
    assert "the scheduler has the work" in capsys.readouterr().err
    assert by_scheduler(by_hand, archive, out) == 0
    assert [row["status"] for row in table(out).values()] == ["done", "done"]


def test_what_a_client_has_left_is_done_without_it(archive, by_hand, tmp_path):
    out = tmp_path / "out"
    assert by_scheduler(by_hand, archive, out, "--detach") == 0
    until_s = time.monotonic() + 60
    while by_scheduler(by_hand, archive, out, "--status") and time.monotonic() < until_s:
        time.sleep(0.1)
    assert by_scheduler(by_hand, archive, out) == 0
    assert [row["status"] for row in table(out).values()] == ["done", "done"]
    logs = (out / ".batch/logs").rglob("*.log")
    assert [path.read_text().count("note: done") for path in logs] == [1, 1]


@pytest.mark.parametrize("shard", [False, True])
def test_a_limit_of_open_files_is_named_and_ends_nothing_in_a_wait(archive, tmp_path, shard):
    resource = pytest.importorskip("resource")
    command = [sys.executable, "-m", "motionstereo_cli", "batch", "good.csv"]
    command += ["-o", str(tmp_path / "out"), "--workers", "2", *(["--shard", "0/1"] * shard)]

    def few() -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (20, 20))

    (archive / "good.csv").write_text("left,right,out\na/left.mp4,a/right.mp4,a\n")
    done = subprocess.run(
        command,
        check=False,
        cwd=archive,
        preexec_fn=few,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 1
    first, *more = done.stderr.splitlines()
    assert first.startswith("error: ")
    assert "ulimit -n" in first or (shard and "Too many open files" in first)
    assert all(line.startswith("note: ") for line in more)


def test_without_a_scheduler_there_is_one_line(archive, tmp_path, capsys):
    arguments = [str(archive / "all.csv"), "-o", str(tmp_path / "out")]
    assert main(["batch", *arguments, "--scheduler", "tcp://127.0.0.1:9"]) == 1
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error:")]
    assert len(errors) == 1
    assert "there is no scheduler at tcp://127.0.0.1:9" in errors[0]
    assert main(["batch", *arguments, "--scheduler-file", str(tmp_path / "none.json")]) == 1
    assert "there is no file" in capsys.readouterr().err
