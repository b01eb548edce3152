"""A run that was ended, by whatever, goes on: its results are those of one that was not."""

import csv
import io
import json
import os
import pickle
import re
import signal
import subprocess
import sys
import threading
import time
from fractions import Fraction

import av
import numpy as np
import pytest

from motionstereo_cli.__main__ import main
from motionstereo_cli.errors import OutputError
from motionstereo_cli.files.atomic import part_of
from motionstereo_cli.files.lock import locked
from motionstereo_cli.files.records import pack, unpack
from motionstereo_cli.files.video import SegmentedVideo, VideoWriter
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.pipeline import State, process
from motionstereo_cli.runs import run as library
from motionstereo_cli.runs.checkpoint import read_checkpoint, with_guided
from motionstereo_cli.runs.folder_files import CHECKPOINT
from motionstereo_cli.runs.interrupts import finishing
from motionstereo_cli.sinks import writers
from motionstereo_cli.sinks.outputs import OUTPUTS
from motionstereo_cli.sinks.writers import TableFile
from motionstereo_cli.types import Pose, Rig, StereoFrame

FRAMES = 23
WIDTH = 96
HEIGHT = 64
EVERY = 5
RIG = Rig(width=WIDTH, height=HEIGHT, focal_px=80.0, baseline_m=0.1, cx=47.5, cy=31.5)

#: Runs the command and kills its own process: before a frame, or before the step that is named.
KILLED = """
import os, signal, sys
import motionstereo_cli.runs.folder as folder
import motionstereo_cli.runs.run as library
from motionstereo_cli.__main__ import main

when = sys.argv[1]

def kill(*args, **options):
    os.kill(os.getpid(), signal.SIGKILL)

whole = library.steps

def until(*args, **options):
    for frame, step, state in whole(*args, **options):
        if str(frame.index) == when:
            kill()
        yield frame, step, state

library.steps = until
if when == "complete":
    folder.name_part = kill
if when == "clear":
    folder.RunFolder._clear = kill
sys.exit(main(sys.argv[2:]))
"""


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Bars that pass by, the poses of a rig that moves along them, and what sees them."""
    folder = tmp_path_factory.mktemp("recording")
    columns = np.arange(WIDTH + 6 + 2 * FRAMES)
    levels = np.random.default_rng(5).integers(0, 256, len(columns) // 9 + 1)
    scene = np.broadcast_to(levels[columns // 9], (HEIGHT, len(columns))).astype(np.uint8)
    for side, shift in (("left", 0), ("right", 6)):
        video = VideoWriter(folder / f"{side}.mp4", Fraction(1, 50))
        for index in range(FRAMES):
            start = 2 * index + shift
            video.write(np.ascontiguousarray(scene[:, start : start + WIDTH]), index)
        video.close()
    (folder / "rig.yaml").write_text(
        f"width: {WIDTH}\nheight: {HEIGHT}\nfocal_px: 80\nbaseline_m: 0.1\ncx: 47.5\ncy: 31.5\n"
    )
    (folder / "poses.txt").write_text(
        "".join(f"{n / 50} 0 {-n / 30} 1 0 0 0 1\n" for n in range(FRAMES))
    )
    return folder


@pytest.fixture(scope="module")
def command(recording):
    """A run with every output."""
    return [
        *("run", str(recording / "left.mp4"), str(recording / "right.mp4")),
        *("--rig", str(recording / "rig.yaml"), "--poses", str(recording / "poses.txt")),
        *("--save", ",".join(OUTPUTS), "--checkpoint-frames", str(EVERY), "--no-check"),
    ]


@pytest.fixture(scope="module")
def undisturbed(command, tmp_path_factory):
    # Of the same name as the others, because the report is called by it.
    out = tmp_path_factory.mktemp("undisturbed") / "out"
    assert main([*command, "-o", str(out), "--csv", str(out.parent / "table.csv")]) == 0
    return out


def contents(out):
    """All files by name; of run.json all but the times."""
    found = {str(path.relative_to(out)): path.read_bytes() for path in out.rglob("*.*")}
    record = json.loads(found.pop("run.json"))
    assert record.pop("timing")
    return found | {"run.json": record}


@pytest.mark.parametrize(
    ("when", "before"),
    # The checkpoint is written beside the stream: a kill just after may find the one before it.
    [
        *(("3", {0}), ("5", {0, 5}), ("14", {5, 10}), ("22", {15, 20})),
        *(("complete", {20}), ("clear", {FRAMES})),
    ],
)
def test_a_killed_run_goes_on(command, undisturbed, tmp_path, capsys, monkeypatch, when, before):
    """Also when it is killed between giving the outputs their names."""
    out, table = tmp_path / "out", tmp_path / "table.csv"
    args = [*command, "-o", str(out), "--csv", str(table)]
    killed = subprocess.run([sys.executable, "-c", KILLED, when, *args], check=False)
    assert killed.returncode == -signal.SIGKILL
    assert (out / "run.json").exists() == (when == "clear")
    if when == "clear":
        monkeypatch.delattr("motionstereo_cli.runs.run.steps")  # nothing is left to do
    assert main([*args, "--resume"]) == 0
    assert contents(out) == contents(undisturbed)
    assert table.read_bytes() == (undisturbed.parent / "table.csv").read_bytes()
    said = capsys.readouterr().err
    assert ("is complete already" in said) == (when == "clear")
    assert ("frames per second" in said) == (when != "clear")
    found = re.search(rf"{FRAMES} frames, (\d+) of them before, in ", said)
    resumed = FRAMES if when == "clear" else int(found[1]) if found else 0
    assert resumed in before


def test_frames_go_on_while_a_checkpoint_waits_for_the_disk(recording, tmp_path, monkeypatch):
    written, sync, write_whole = threading.Event(), writers.sync, writers.write_whole

    def after_a_later_image(path):
        assert written.wait(30)
        sync(path)

    def write(path, content):
        write_whole(path, content)
        if path.name == f"{EVERY + 2:06d}.png":
            written.set()

    monkeypatch.setattr(writers, "sync", after_a_later_image)
    monkeypatch.setattr(writers, "write_whole", write)
    views = [str(recording / "left.mp4"), str(recording / "right.mp4")]
    options = ["--save", "charge-png", "--checkpoint-frames", str(EVERY), "--no-check"]
    assert main(["run", *views, *options, "-o", str(tmp_path / "out")]) == 0


def test_a_killed_run_that_finds_its_poses_goes_on(command, tmp_path):
    """The odometry is in the checkpoint, between keyframes too."""
    at = command.index("--poses")
    given = [*command[: at + 1], "auto", *command[at + 2 :]]
    assert main([*given, "-o", str(tmp_path / "whole" / "out")]) == 0
    args = [*given, "-o", str(tmp_path / "out")]
    killed = subprocess.run([sys.executable, "-c", KILLED, "14", *args], check=False)
    assert killed.returncode == -signal.SIGKILL
    assert main([*args, "--resume", "--jobs", "3"]) == 0
    assert contents(tmp_path / "out") == contents(tmp_path / "whole" / "out")


def test_the_videos_are_whole_and_in_time(undisturbed):
    with av.open(str(undisturbed / "depth.mp4")) as video:
        stamps = [frame.pts * frame.time_base for frame in video.decode(video=0)]
    assert stamps == [Fraction(n, 50) for n in range(FRAMES)]


def test_an_interrupted_run_goes_on(command, undisturbed, tmp_path):
    """The frame at hand is finished: the table and the images have the same frames."""
    out = tmp_path / "out"
    args = [sys.executable, "-m", "motionstereo_cli", *command, "-o", str(out)]
    args += ["--csv", str(tmp_path / "table.csv")]
    with subprocess.Popen([*args, "--jobs", "2"], stderr=subprocess.PIPE) as run:
        while not (out / "depth" / "000006.png").exists():
            time.sleep(0.005)
        run.send_signal(signal.SIGTERM)
        said = run.stderr.read().decode()
    if run.returncode == 130:  # or it was faster
        assert "--resume goes on from there" in said.splitlines()[-1]
        with part_of(out / "steering.csv").open(newline="") as file:
            rows = len(list(csv.DictReader(file)))
        assert f"interrupted after {rows} frames" in said
        assert len(list((out / "depth").glob("*.png"))) == rows
    assert subprocess.run([*args, "--resume"], check=False).returncode == 0
    assert contents(out) == contents(undisturbed)


@pytest.fixture
def half_done(command, tmp_path):
    """The arguments of a run that was killed half-way."""
    args = [*command, "-o", str(tmp_path / "out")]
    killed = subprocess.run([sys.executable, "-c", KILLED, "14", *args], check=False)
    assert killed.returncode == -signal.SIGKILL
    return args


def test_another_run_is_not_taken_for_this_one(half_done, recording, tmp_path, capsys):
    def said(args):
        assert main([*args, "--resume"]) == 1
        return capsys.readouterr().err

    assert "with --bands 8, not 9: give the same" in said([*half_done, "--bands", "9"])
    swapped = [half_done[0], half_done[2], half_done[1], *half_done[3:]]
    assert "with inputs.left." in said(swapped)
    (tmp_path / "poses.txt").write_text((recording / "poses.txt").read_text() + "9 0 0 0 0 0 0 1\n")
    poses = half_done.index("--poses") + 1
    others = [*half_done[:poses], str(tmp_path / "poses.txt"), *half_done[poses + 1 :]]
    assert "with files.1.sha256 " in said(others)
    fewer = [*half_done[: half_done.index("--save")], *half_done[half_done.index("--save") + 2 :]]
    assert "is of another run, with outputs.age: give" in said(fewer)
    assert "without a table by --csv" in said([*half_done, "--csv", str(tmp_path / "new.csv")])
    assert main(half_done) == 1
    assert (
        "is not empty: give another folder, or --overwrite, or --resume" in capsys.readouterr().err
    )
    assert main([*half_done, "--resume", "--overwrite"]) == 2
    assert main([*half_done, "--resume"]) == 0
    assert "with --bands 8, not 9" in said([*half_done, "--bands", "9"])


def test_what_is_missing_or_cut_is_named(half_done, tmp_path, capsys):
    out = tmp_path / "out"
    (out / "charge.0000.mp4.part").unlink()
    assert main([*half_done, "--resume"]) == 1
    assert "charge.0000.mp4.part is missing" in capsys.readouterr().err
    with part_of(out / "steering.csv").open("r+b") as file:
        file.truncate(100)
    assert main([*half_done, "--resume"]) == 1
    assert "steering.csv.part was cut" in capsys.readouterr().err


@pytest.mark.parametrize("checkpoint", [True, False])
def test_the_page_of_the_interrupted_run_is_not_removed_silently(
    command, tmp_path, capsys, checkpoint
):
    out = tmp_path / "out"
    save = command.index("--save") + 1
    args = [*command[:save], "steering", *command[save + 1 :], "-o", str(out)]
    subprocess.run([sys.executable, "-c", KILLED, "14", *args], check=False)
    assert main(["report", str(out)]) == 0
    if not checkpoint:
        (out / CHECKPOINT).unlink()
    assert (out / "report.html").exists()
    capsys.readouterr()
    assert main([*args, "--resume"]) == 0
    assert f"note: {out}/report.html of the interrupted run was removed" in capsys.readouterr().err
    assert not (out / "report.html").exists()
    # A complete run's page stays.
    assert main(["report", str(out)]) == 0
    assert main([*args, "--resume"]) == 0
    assert (out / "report.html").exists()


def test_the_table_of_somebody_else_is_not_taken_for_ours(command, tmp_path, capsys):
    (tmp_path / "table.csv").write_text("mine")
    args = ["-o", str(tmp_path / "out"), "--csv", str(tmp_path / "table.csv"), "--resume"]
    assert main([*command, *args]) == 1
    assert "table.csv is there already" in capsys.readouterr().err
    assert (tmp_path / "table.csv").read_text() == "mine"


@pytest.mark.parametrize("checkpoint", [True, False])
@pytest.mark.parametrize("name", ["steering.csv", "map.yaml", "depth/000900.png"])
def test_a_file_that_somebody_put_there_before_resume_stays(
    half_done, tmp_path, capsys, name, checkpoint
):
    out = tmp_path / "out"
    (out / name).write_text("mine")
    if not checkpoint:
        (out / CHECKPOINT).unlink()
    before = {path: path.read_bytes() for path in out.rglob("*.*")}
    assert main([*half_done, "--resume"]) == 1
    assert f"{name} is not from an earlier run: move it" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in out.rglob("*.*")} == before


@pytest.mark.parametrize("name", ["steering.csv", "charge.mp4", "map.png", "depth/000020.png"])
def test_a_file_that_somebody_puts_there_during_a_run_stays(
    command, undisturbed, tmp_path, capsys, monkeypatch, name
):
    out, whole = tmp_path / "out", library.steps

    def disturbed(*args, **options):
        for each in whole(*args, **options):
            if each[0].index == 14:
                (out / name).write_text("mine")
            yield each

    monkeypatch.setattr(library, "steps", disturbed)
    args = [*command, "-o", str(out), "--csv", str(tmp_path / "table.csv")]
    assert main(args) == 1
    monkeypatch.undo()
    assert f"{name} is not from this run: move it" in capsys.readouterr().err
    assert (out / name).read_text() == "mine"
    assert part_of(out / "steering.csv").exists()
    (out / name).unlink()
    assert main([*args, "--resume"]) == 0
    assert contents(out) == contents(undisturbed)


def test_overwrite_removes_what_a_killed_run_left(half_done, tmp_path):
    assert main([*half_done, "--overwrite", "--save", "steering"]) == 0
    left = {str(path.relative_to(tmp_path)) for path in (tmp_path / "out").rglob("*")}
    assert "out/run.checkpoint" not in left
    assert not [name for name in left if name.endswith(".part")]


class Harm:
    """Creates a file when it is unpickled."""

    def __init__(self, path):
        self._path = path

    def __reduce__(self):
        return os.mkdir, (str(self._path),)


@pytest.mark.parametrize("kind", ["harmful", "cut", "other"])
def test_a_checkpoint_is_data(half_done, tmp_path, capsys, kind):
    path = tmp_path / "out" / CHECKPOINT
    content = {
        "harmful": pickle.dumps(Harm(tmp_path / "harm")),
        "cut": path.read_bytes()[:-100],
        "other": b"depth",
    }[kind]
    path.write_bytes(content)
    assert main([*half_done, "--resume"]) == 1
    assert f"{CHECKPOINT} is no checkpoint that can be used" in capsys.readouterr().err
    assert not (tmp_path / "harm").exists()


def test_a_checkpoint_holds_no_objects():
    objects = io.BytesIO()
    np.savez(objects, record=np.array([Harm("harm")], dtype=object))
    with pytest.raises(ValueError, match="cannot be read"):
        unpack(objects.getvalue(), State)
    assert unpack(pack(State()), State) == State()


def test_two_runs_into_one_folder(command, tmp_path, capsys):
    out = tmp_path / "out"
    with locked(out):
        assert main([*command, "-o", str(out)]) == 1
        assert f"{out} is being written by another run" in capsys.readouterr().err
        assert not list(out.iterdir())
    with locked(out):
        pass


@pytest.mark.parametrize("mode", ["permanency", "general"])
def test_the_state_is_all_there_is(mode):
    """Going on from a stored state gives what going on gives."""
    settings = Settings(charge_mode=mode, max_disparity=16, speckle_px=0, min_votes=1)
    rng = np.random.default_rng(3)
    images = rng.integers(0, 256, (12, 40, 66), np.uint8)
    frames = [
        StereoFrame(n, n, n / 25, image[:, 6:].copy(), np.roll(image[:, :60], n, axis=0).copy())
        for n, image in enumerate(images)
    ]
    rig = Rig(width=60, height=40, focal_px=50.0, baseline_m=0.1, cx=29.5, cy=19.5)

    def pose_of(frame):
        return Pose(frame.index / 10, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0)

    whole = list(process(frames, settings, rig, pose_of))
    for result in process(frames, settings, rig, pose_of, jobs=3):
        if result.frame.index == 6:
            break
    guided = type(result.state.tracking.guided).__name__
    later = with_guided(unpack(pack(result.state), State), guided)
    rest = list(process(frames[7:], settings, rig, pose_of, state=later, jobs=2))
    assert len(rest) == 5
    for one, other in zip(whole[7:], rest, strict=True):
        assert one.steering == other.steering
        assert one.objects == other.objects
        for name in ("charge", "bands", "motion", "age_frames", "disparity_px", "confidence"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_a_table_goes_on_where_it_was(tmp_path):
    path = tmp_path / "table.csv"
    table = TableFile(path, "n")
    table.add(["1"])
    mark = table.checkpoint()
    table.add(["2", "3"])
    table.close()
    again = TableFile(path, "n", mark)
    again.add(["4"])
    again.close()
    assert path.read_text() == "n\n1\n4\n"
    path.write_text("n\n")
    with pytest.raises(OutputError, match="was cut"):
        TableFile(path, "n", mark)


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
def test_a_video_goes_on_where_it_was(tmp_path, suffix):
    images = np.random.default_rng(0).integers(0, 256, (9, 32, 48), np.uint8)
    stamps = [7, 8, 8, 11, 20, 21, 22, 40, 41]  # the second 8 becomes 9

    def decoded(path):
        with av.open(str(path)) as video:
            return [(f.pts * f.time_base, f.to_ndarray()) for f in video.decode(video=0)]

    def write(video, first, last):
        for n in range(first, last):
            if n in (3, 6):
                mark = video.checkpoint()
            video.write(images[n], stamps[n])
        return mark

    whole, cut = (SegmentedVideo(tmp_path / f"{n}{suffix}", Fraction(1, 50)) for n in "ab")
    write(whole, 0, 9)
    whole.close()
    mark = write(cut, 0, 8)
    del cut
    again = SegmentedVideo(tmp_path / f"b{suffix}", Fraction(1, 50), mark)
    for n in range(6, 9):
        again.write(images[n], stamps[n])
    again.close()
    one, other = (decoded(tmp_path / f"{name}{suffix}") for name in "ab")
    assert [time_s for time_s, _ in one] == [
        Fraction(n, 50) for n in (7, 8, 9, 11, 20, 21, 22, 40, 41)
    ]
    assert [time_s for time_s, _ in one] == [time_s for time_s, _ in other]
    for (_, image), (_, same) in zip(one, other, strict=True):
        np.testing.assert_array_equal(image, same)


def interrupted(times, done):
    with finishing():
        for _ in range(times):
            signal.raise_signal(signal.SIGINT)
            done.append("in the block")
    done.append("after it")


@pytest.mark.parametrize("times", [1, 2])
def test_an_interrupt_waits_for_the_block_unless_the_user_insists(times):
    done = []
    with pytest.raises(KeyboardInterrupt):
        interrupted(times, done)
    assert done == ["in the block"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_interrupts_are_of_no_concern_to_other_threads():
    done = []

    def work():
        with finishing():
            done.append(1)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert done == [1]


def test_there_may_be_no_checkpoint(tmp_path):
    assert read_checkpoint(tmp_path / CHECKPOINT, {}) is None
