"""The command from outside: exit codes, one line on stderr, and what it leaves on disk."""

from __future__ import annotations

import csv
import io
import itertools
import json
import os
import pty
import re
import shutil
import subprocess
import sys
import termios
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import click
import cv2
import numpy as np
import pytest

from motionstereo_cli.__main__ import main
from motionstereo_cli.commands import cli
from motionstereo_cli.commands.messages import say
from motionstereo_cli.commands.options import settings_options
from motionstereo_cli.commands.progress import foretelling
from motionstereo_cli.errors import OutputError
from motionstereo_cli.files.video import VideoWriter
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.params import param, params
from motionstereo_cli.runs.plan import RunPlan
from motionstereo_cli.runs.run import run as run_library
from motionstereo_cli.sinks.objects_table import ObjectsFile
from motionstereo_cli.sinks.outputs import OUTPUTS

COMMAND = [sys.executable, "-m", "motionstereo_cli"]
#: Outputs that need poses as well.
NEED_MORE = {"map"}
FRAMES = 12
WIDTH = 96
HEIGHT = 64
DISPARITY = 6
RIG = "width: 96\nheight: 64\nfocal_px: 80\nbaseline_m: 0.1\ncx: 47.5\ncy: 31.5\n"


def recorded(folder: Path, side_px: int = 0) -> Path:
    """Write left.mp4, right.mp4 and rig.yaml: bars that move 2 px a frame; return the folder.

    ``side_px`` columns are twice as near: one flat surface that fills the view has no heading.
    """
    columns = np.arange(WIDTH + DISPARITY + 2 * FRAMES)
    levels = np.random.default_rng(5).integers(0, 256, len(columns) // 9 + 1)
    scene = np.broadcast_to(levels[columns // 9], (HEIGHT, len(columns))).astype(np.uint8)
    for side, shift in (("left", 0), ("right", DISPARITY)):
        video = VideoWriter(folder / f"{side}.mp4", Fraction(1, 50))
        begin = 0 if side == "right" else 2 * DISPARITY
        for index in range(FRAMES):
            start = 2 * index + shift
            view = np.ascontiguousarray(scene[:, start : start + WIDTH])
            view[:, begin : begin + side_px] = scene[:, 2 * index : 2 * index + side_px]
            video.write(view, index)
        video.close()
    (folder / "rig.yaml").write_text(RIG)
    return folder


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording of a flat surface."""
    return recorded(tmp_path_factory.mktemp("recording"))


@pytest.fixture
def run_args(recording: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """Arguments of a run, in an empty current folder."""
    monkeypatch.chdir(tmp_path)
    return ["run", str(recording / "left.mp4"), str(recording / "right.mp4")]


@pytest.fixture
def rig(recording: Path) -> list[str]:
    return ["--rig", str(recording / "rig.yaml")]


def called(*args: str) -> subprocess.CompletedProcess[str]:
    """Run the command in a process of its own."""
    return subprocess.run([*COMMAND, *args], capture_output=True, text=True, check=False)


def names(out: Path) -> set[str]:
    return {str(path.relative_to(out)) for path in out.rglob("*") if not path.is_dir()}


def images(folder: str, count: int = FRAMES) -> set[str]:
    return {f"{folder}/{index:06d}.png" for index in range(count)}


# A run that goes well.


def test_run_writes_what_the_contract_says(run_args, tmp_path_factory):
    recording = recorded(tmp_path_factory.mktemp("room"), side_px=WIDTH // 3)
    views = [str(recording / name) for name in ("left.mp4", "right.mp4")]
    done = called(run_args[0], *views, "--rig", str(recording / "rig.yaml"), "-o", "out")
    assert (done.returncode, done.stdout) == (0, "")
    said = [line for line in done.stderr.splitlines() if "compiling" not in line]
    assert [line.split(":")[0] for line in said] == ["note", "note"]
    assert "note: 12 frames in " in done.stderr
    assert done.stderr.endswith(
        "note: results in out: steering.csv, depth/, charge.mp4, depth.mp4, run.json\n"
    )
    out = Path("out")
    streams = {"steering.csv", "charge.mp4", "depth.mp4", "run.json"}
    assert names(out) == streams | images("depth")

    rows = list(csv.DictReader((out / "steering.csv").open()))
    assert [row["frame"] for row in rows] == [str(index) for index in range(FRAMES)]
    assert [float(row["time_s"]) for row in rows] == [index / 50 for index in range(FRAMES)]
    assert rows[0]["status"] == "blind"
    assert rows[-1]["status"] == "ok"
    depth_mm = cv2.imread(str(out / "depth/000011.png"), cv2.IMREAD_UNCHANGED)
    assert depth_mm.shape == (HEIGHT, WIDTH)
    assert np.median(depth_mm[depth_mm > 0]) == pytest.approx(80 * 0.1 / DISPARITY * 1000, rel=0.05)

    record = json.loads((out / "run.json").read_text())
    assert record["counts"]["written"] == FRAMES
    assert record["rig"]["focal_px"] == 80
    assert record["settings"]["bands"] == 8
    assert record["outputs"]["depth"]["path"] == "depth/000000.png"
    assert record["inputs"]["left"]["bytes"] == (recording / "left.mp4").stat().st_size
    assert len(record["inputs"]["right"]["sha256"]) == 64
    assert Fraction(record["time_base"]) > 0
    assert record["damage"] == []


def test_one_frame_is_no_frames(run_args, capsys):
    assert main([*run_args, "--end", "1", "--save", "steering"]) == 0
    said = capsys.readouterr().err
    assert "note: 1 frame in " in said
    assert "warning: one frame shows no motion" in said


def test_without_a_rig_disparity_takes_the_place_of_depth(run_args, capsys):
    assert main(run_args) == 0
    assert "disparity takes the place of depth" in capsys.readouterr().err
    assert images("disparity") <= names(Path("motionstereo_out"))
    assert not Path("motionstereo_out/depth").exists()
    assert json.loads(Path("motionstereo_out/run.json").read_text())["rig"] is None


def test_save_picks(run_args, rig):
    assert main([*run_args, *rig, "--save", "charge,disparity", "--save", "steering"]) == 0
    streams = {"steering.csv", "charge.mp4", "run.json"}
    assert names(Path("motionstereo_out")) == streams | images("disparity")


def test_the_table_on_stdout_is_the_same_and_nothing_is_written(run_args, rig):
    done = called(*run_args, *rig, "-o", "-")
    assert done.returncode == 0
    assert not list(Path().iterdir())
    assert main([*run_args, *rig, "--save", "steering"]) == 0
    assert done.stdout == Path("motionstereo_out/steering.csv").read_text()


@pytest.mark.parametrize("table_format", ["csv", "jsonl"])
def test_the_table_streams_beside_the_files(run_args, rig, table_format):
    options = ["--csv", "-", "--steering-format", table_format, "--save", "steering,depth"]
    done = called(*run_args, *rig, *options, "-o", "out")
    assert done.returncode == 0
    table = f"steering.{table_format}"
    assert names(Path("out")) == {table, "run.json"} | images("depth")
    assert done.stdout == Path("out", table).read_text()
    assert done.stdout.count("\n") == FRAMES + (table_format == "csv")
    alone = called(*run_args, *rig, "-o", "-", "--steering-format", table_format)
    assert alone.stdout == done.stdout


def test_the_table_goes_to_a_file_of_any_name(run_args, rig, recording, capsys):
    args = [*run_args, *rig, "--save", "steering", "--csv", "mine.csv"]
    assert main(args) == 0
    text = Path("mine.csv").read_text()
    assert text == Path("motionstereo_out/steering.csv").read_text()
    for taken, out, said in (
        ("mine.csv", "other", "mine.csv is there already"),
        (str(recording / "left.mp4"), "other", "is an input"),
        ("motionstereo_out/steering.csv", "motionstereo_out", "is in the output folder"),
    ):
        assert main([*args[:-1], taken, "-o", out]) == 1
        assert said in capsys.readouterr().err
    assert Path("mine.csv").read_text() == text
    assert main([*args, "--overwrite"]) == 0


def test_every_output_can_be_had_at_once(run_args, rig):
    """But for those that need more than a rig."""
    wanted = [name for name in OUTPUTS if name not in NEED_MORE]
    assert main([*run_args, *rig, "--save", ",".join(wanted)]) == 0
    out = Path("motionstereo_out")
    for name in wanted:
        paths = [out / OUTPUTS[name].path.format(index) for index in range(FRAMES)]
        assert all(path.is_file() for path in paths), name
    assert not list(out.rglob("*.png.part"))
    outputs = json.loads((out / "run.json").read_text())["outputs"]
    assert set(outputs) == set(wanted)


def test_the_same_run_gives_the_same_bytes_but_for_the_timing(run_args, rig):
    for out in ("one", "two"):
        assert main([*run_args, *rig, "-o", out]) == 0
    assert names(Path("one")) == names(Path("two"))
    for name in names(Path("one")) - {"run.json"}:
        assert Path("one", name).read_bytes() == Path("two", name).read_bytes(), name
    one, two = (json.loads(Path(out, "run.json").read_text()) for out in ("one", "two"))
    assert one | {"timing": None} == two | {"timing": None}


# Damage, interruption, closed pipes.


def test_a_shorter_side_ends_the_run_with_a_warning_and_exit_code_3(run_args, capsys):
    short = VideoWriter(Path("short.mp4"), Fraction(1, 50))
    for index in range(5):
        short.write(np.full((HEIGHT, WIDTH), 20 * index, np.uint8), index)
    short.close()
    assert main([*run_args[:2], "short.mp4"]) == 3
    lines = capsys.readouterr().err.splitlines()
    assert any(line.startswith("warning: ") and "left.mp4" in line for line in lines)
    record = json.loads(Path("motionstereo_out/run.json").read_text())
    assert record["counts"]["written"] == 5
    # The flat images of the short side find no partner, which is said as well, and why.
    warnings = [line for line in lines if line.startswith("warning: ")]
    assert warnings[0].startswith("warning: only ")
    assert "of what moved lately was matched; the left view is 40 grey levels" in warnings[0]
    assert [f"warning: {line}" for line in record["damage"]] == warnings[1:]


CUT_AT_FRAME_7 = """
import os, signal, sys
import motionstereo_cli.runs.run as library
from motionstereo_cli.__main__ import main

whole = library.steps

def cut(*args, **options):
    for frame, step, state in whole(*args, **options):
        if frame.index == 7:
            os.kill(os.getpid(), signal.Signals[sys.argv[1]])
        yield frame, step, state

library.steps = cut
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.exit(main(sys.argv[2:]))
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_an_interrupted_run_keeps_what_is_complete(run_args, rig, name):
    args = [sys.executable, "-c", CUT_AT_FRAME_7, name, *run_args, *rig, "-o", "out"]
    done = subprocess.run(args, capture_output=True, text=True, check=False)
    assert done.returncode == 130
    assert done.stderr.splitlines()[-1].startswith("error: interrupted after 7 frames")
    parts = {"steering.csv.part", "charge.0000.mp4.part", "depth.0000.mp4.part", "run.json.part"}
    assert names(Path("out")) == parts | images("depth", 7)
    assert Path("out/steering.csv.part").read_text().count("\n") == 1 + 7
    with av.open("out/charge.0000.mp4.part") as video:
        assert len(list(video.decode(video=0))) == 7
    # And --overwrite knows what was left.
    assert main([*run_args, "-o", "out", "--overwrite", "--save", "steering"]) == 0
    assert names(Path("out")) == {"steering.csv", "run.json"}


@pytest.mark.parametrize("option", ["--out", "--csv"])
def test_a_closed_pipe_ends_quietly_unless_there_are_files(run_args, rig, option):
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "wb") as pipe:
        done = subprocess.run(
            [*COMMAND, *run_args, *rig, option, "-"],
            stdout=pipe,
            stderr=subprocess.PIPE,
            check=False,
        )
    if option == "--out":  # the reader has seen enough
        assert (done.returncode, done.stderr) == (0, b"")
    else:
        assert done.returncode == 1
        assert b"error: the reader of the steering table closed it before" in done.stderr
    assert not names(Path())


class Head(io.BytesIO):
    """A pipe whose reader goes after five lines, as head -5 does."""

    def write(self, line: bytes, /) -> int:
        if self.getvalue().count(b"\n") == 5:
            raise BrokenPipeError
        return super().write(line)


def test_a_reader_that_has_seen_enough_leaves_what_is_complete(run_args, recording):
    with pytest.raises(OutputError, match="closed it before the run was done"):
        run_library(RunPlan(*run_args[1:], Path("out"), table=Path("-")), stdout=Head())
    assert {"run.json.part", "steering.csv.part", "charge.0000.mp4.part"} <= names(Path("out"))
    assert images("disparity", 4) <= names(Path("out"))
    assert "run.json" not in names(Path("out"))


def test_a_full_disk_behind_stdout_is_one_line(run_args):
    with Path("/dev/full").open("wb") as full:
        done = subprocess.run(
            [*COMMAND, *run_args, "-o", "-"], stdout=full, stderr=subprocess.PIPE, check=False
        )
    assert done.returncode == 1
    assert done.stderr == b"error: cannot write the steering table: No space left on device\n"


@pytest.mark.parametrize(
    ("to", "said"), [(">/dev/full", "error: No space left on device\n"), (">&-", "")]
)
def test_help_that_cannot_be_printed(to, said):
    args = ["sh", "-c", f'"$@" {to}', "sh", *COMMAND, "help", "run"]
    done = subprocess.run(args, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (int(bool(said)), said)


def test_an_output_that_fails_midway_is_named_and_nothing_is_lost(run_args, monkeypatch, capsys):
    def full(path: Path, content: bytes) -> None:
        if path.name == "000004.png":
            raise OutputError(f"cannot write {path}: No space left on device")
        path.write_bytes(content)

    with monkeypatch.context() as disk:
        disk.setattr("motionstereo_cli.sinks.writers.write_whole", full)
        assert main(run_args) == 1
    out = Path("motionstereo_out")
    lines = capsys.readouterr().err.splitlines()
    assert lines[-2].startswith(f"error: cannot write {out}/disparity/000004.png: No space left")
    assert lines[-1].startswith(f"note: what was done is in {out}: with --resume")
    assert images("disparity", 4) <= names(out)
    assert all(name.endswith(".part") for name in names(out) - images("disparity", 4))
    assert main([*run_args, "--resume"]) == 0
    videos = {"charge.mp4", "depth.mp4"}
    assert names(out) == {"steering.csv", "run.json"} | videos | images("disparity")


@pytest.mark.parametrize("command", [["run"], ["check"], ["figure", "--frames", "9"]])
def test_every_command_says_that_the_input_was_damaged(run_args, command, capsys):
    noise = np.random.default_rng(1).integers(0, 256, (64, 200), np.uint8)
    for side, shift in (("left", 0), ("right", 6)):
        Path(side).mkdir()
        for n in range(12):
            image = noise[:, n + shift : n + shift + 96]
            cv2.imwrite(f"{side}/{n}.png", cv2.GaussianBlur(image, (0, 0), 2))
    Path("left/5.png").write_text("junk")
    assert main([*command, "left", "right"]) == 3
    assert "warning: left: 1 image could not be read" in capsys.readouterr().err


# Bad input: one line, the right exit code, nothing written.


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--bands", "1"], "--bands cannot be '1': give 2 to 256"),
        (["--charge-leak", "0"], "--charge-leak cannot be '0'"),
        (["--blur-px", "nan"], "--blur-px cannot be 'nan'"),
        (["--max-disparity", "-4"], "--max-disparity cannot be '-4'"),
        (["--max-disparity", "many"], "give a whole number in px"),
        (["--grey-min", "200", "--grey-max", "100"], "--grey-min 200 is not below"),
        (["--matcher", "census"], "choose trails | dense | regions"),
        (["--preset", "paper2"], "paper2"),
        (["--save", "steering,dept"], "--save knows no 'dept' (did you mean 'depth'?)"),
        (["--save", ""], "choose from steering, "),
        (["--save", "charge", "-o", "-"], "-o - writes only the steering table"),
        (["--save", "depth-mkv"], "--save depth-mkv needs --rig"),
        (["--csv", "-", "-o", "-"], "-o - writes only the steering table"),
        (["--near-m", "2"], "--near-m and --far-m need --rig"),
        (["--near-m", "2", "--far-m", "1"], "--near-m 2 is not below --far-m 1"),
        (["--depth-scale", "0"], "--depth-scale cannot be '0'"),
        (["--colours", "rainbow"], "choose plasma | turbo"),
        (["--reference", "middle"], "choose right | left"),
        (["--speed", "9"], "--speed"),
        (["--config", "none.toml"], "none.toml"),
    ],
)
def test_nonsense_options(run_args, capsys, options, said):
    assert main([*run_args, *options]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("error: ")
    assert captured.err.count("\n") == 1
    assert said in captured.err
    assert not list(Path().iterdir())


def test_bad_input_from_outside(run_args):
    """In a process of its own: exit code and stderr as a shell sees them."""
    done = called("run", "none.mp4", run_args[2])
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert "none.mp4" in done.stderr
    assert called(*run_args, "--bands", "1").returncode == 2


def test_a_rig_of_another_size(run_args, capsys):
    Path("rig.yaml").write_text(RIG.replace("96", "640"))
    assert main([*run_args, "--rig", "rig.yaml"]) == 1
    assert "the rig is for 640x64 but the recordings are 96x64" in capsys.readouterr().err
    assert names(Path()) == {"rig.yaml"}


def test_a_folder_with_something_in_it(run_args, capsys):
    Path("out").mkdir()
    Path("out/notes.txt").touch()
    assert main([*run_args, "-o", "out"]) == 1
    assert "error: out is not empty" in capsys.readouterr().err
    assert names(Path("out")) == {"notes.txt"}


@pytest.mark.parametrize("option", [[], ["--resume"]])
def test_resume_is_not_advised_where_nothing_was_begun(run_args, capsys, option):
    Path("out").mkdir()
    Path("out/run.json.part").write_text("mine")
    assert main([*run_args, "-o", "out", *option]) == 1
    assert capsys.readouterr().err.endswith("is not empty: give another folder, or --overwrite\n")
    assert Path("out/run.json.part").read_text() == "mine"


@pytest.mark.parametrize("out", ["file", "file/out", "/proc/motionstereo"])
def test_a_folder_that_cannot_be_written(run_args, capsys, out):
    Path("file").touch()
    assert main([*run_args, "-o", out]) == 1
    assert f"error: cannot write {out}: " in capsys.readouterr().err
    assert names(Path()) == {"file"}


def test_overwrite_keeps_the_files_of_strangers_and_the_input(recording, tmp_path):
    shutil.copytree(recording, tmp_path / "out")
    out = tmp_path / "out"
    (out / "notes.txt").write_text("mine")
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    args = ["run", str(out / "left.mp4"), str(out / "right.mp4"), "-o", str(out), "--overwrite"]
    assert main(args) == 0
    assert main([*args, "--save", "steering"]) == 0
    assert names(out) == {*before, "steering.csv", "run.json"}
    assert before == {name: (out / name).read_bytes() for name in before}


def test_an_interrupt_before_the_first_frame_says_what_to_do(run_args, monkeypatch, capsys):
    def interrupted(*args: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("motionstereo_cli.runs.run.open_stereo", interrupted)
    assert main(run_args) == 130
    said = capsys.readouterr().err
    assert said == "error: interrupted\nnote: no frame was reached: give the same command again\n"


def test_an_unexpected_error_is_one_line_unless_debugging(run_args, monkeypatch, capsys):
    def broken(*args: object, **options: object) -> None:
        raise ZeroDivisionError("by nought")

    monkeypatch.setattr("motionstereo_cli.runs.run.steps", broken)
    assert main([*run_args, "--save", "steering"]) == 1
    assert capsys.readouterr().err == "error: internal: ZeroDivisionError: by nought\n"
    monkeypatch.setenv("MOTIONSTEREO_DEBUG", "1")
    assert main([*run_args, "--save", "steering"]) == 1
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["run", "info", "check", "figure"])
def test_a_pattern_without_quotes_is_one_short_line(command, capsys):
    names = [f"left{number:06d}.png" for number in range(60)]
    frames = ["--frames", "1"] if command == "figure" else []
    assert main([command, *frames, *names, "--scale", "0.5"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: 60 inputs are too many: give LEFT and RIGHT, and put patterns")
    assert len(said) < 120


# Presets and the configuration file.


def settings_used(args: list[str]) -> dict[str, object]:
    assert main([*args, "--save", "steering", "--overwrite"]) == 0
    settings = json.loads(Path("motionstereo_out/run.json").read_text())["settings"]
    assert isinstance(settings, dict)
    return settings


def test_the_command_line_wins_over_the_file_and_the_file_over_the_preset(run_args):
    Path("my.toml").write_text('preset = "paper"\nbands = 12\ncharge-leak = 8\nmatch_on = "charge"')
    used = settings_used([*run_args, "--config", "my.toml", "--bands", "16"])
    assert (used["bands"], used["charge_leak"]) == (16, 8)
    assert (used["blur_px"], used["min_jump"], used["match_on"]) == (0, 0, "charge")
    used = settings_used([*run_args, "--config", "my.toml", "--preset", "default"])
    assert (used["bands"], used["blur_px"]) == (12, 1.0)


def test_the_file_may_hold_every_kind_of_option(run_args, recording):
    Path("my.toml").write_text(
        f'out = "here"\nsave = ["charge", "depth"]\nrig = "{recording / "rig.yaml"}"\n'
        'overwrite = true\nblur-px = 2\ncsv = "table.csv"\nnear-m = 1.0'
    )
    assert main([*run_args, "--config", "my.toml"]) == 0
    assert names(Path("here")) == {"charge.mp4", "run.json"} | images("depth")
    assert Path("table.csv").read_text().count("\n") == 1 + FRAMES
    Path("my.toml").write_text('out = "here"\nsave = "steering"\noverwrite = true')
    assert main([*run_args, "--config", "my.toml"]) == 0
    assert names(Path("here")) == {"steering.csv", "run.json"}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("band = 4", "my.toml: unknown key 'band' (did you mean 'bands'?)"),
        ("config = 'x'", "my.toml: unknown key 'config'"),
        ("bands = 1979-05-27", "my.toml: bands cannot be datetime.date"),
        ("out = 07:32:00", "my.toml: out cannot be datetime.time"),
        ("overwrite = 1979-05-27T07:32:00Z", "my.toml: overwrite cannot be"),
        ("[bands]\nn = 8", "my.toml: bands cannot be {'n': 8}"),
        ("save = [['depth']]", "my.toml: save cannot be [['depth']]"),
        ("save = {a = 1}", "my.toml: save cannot be {'a': 1}"),
        (f"bands = {'9' * 4000}", "my.toml: bands cannot be so large a number"),
        (f"bands = {'9' * 5000}", "my.toml: cannot be read as TOML"),
        ("jobs = inf", "my.toml: jobs cannot be inf"),
        ("jobs = nan", "my.toml: jobs cannot be nan"),
        ("charge-leak = nan", "my.toml: charge-leak cannot be nan"),
        ('csv = "a\\u0000b"', "my.toml: csv cannot be"),
        ("bands = " + "[" * 5000, "my.toml: cannot be read as TOML"),
        ("# " + "x" * 1_000_000, "my.toml is larger than 1000000 bytes"),
        ("max-disparty = 9", "my.toml: unknown key 'max-disparty' (did you mean 'max-disparity'?)"),
        ("with_check = false", "my.toml: unknown key 'with_check'"),
        ("bands = 1", "my.toml: --bands cannot be 1: give 2 to 256"),
        ("bands = 2.5", "my.toml: --bands cannot be 2.5: give a whole number"),
        ("blur-px = nan", "my.toml: blur-px cannot be nan: give text, a finite number"),
        ("overwrite = 'perhaps'", "my.toml: "),
        ("out = 3", "my.toml: out cannot be 3: give text"),
        ("[bands]", "my.toml: bands cannot be {}"),
        ("save = 'nothing'", "--save knows no 'nothing'"),
        ("bands", "my.toml: cannot be read as TOML"),
    ],
)
def test_a_bad_file_is_pointed_at(run_args, capsys, text, said):
    Path("my.toml").write_text(text)
    assert main([*run_args, "--config", "my.toml"]) == 2
    assert f"error: {said}" in capsys.readouterr().err
    assert names(Path()) == {"my.toml"}


def test_the_key_of_an_option_is_its_name(recording, tmp_path, capsys):
    sides = [str(recording / f"{side}.mp4") for side in ("left", "right")]
    config = tmp_path / "my.toml"
    config.write_text("json = true\nmax-disparity = 32\nend = 5", encoding="utf-8-sig")
    assert main(["check", *sides, "--config", str(config)]) in (0, 1)
    assert json.loads(capsys.readouterr().out)["frames"] == 5
    config.write_text("json = true\nend = 5")
    assert main(["info", *sides, "--config", str(config)]) == 0
    assert json.loads(capsys.readouterr().out)["delivered"]["frames"] == 5
    config.write_text(f'check = false\nend = 1\nout = "{tmp_path / "out"}"\nsave = "steering"')
    assert main(["run", *sides, "--config", str(config)]) == 0
    assert "warning" not in capsys.readouterr().err
    config.write_text('csv = "-"')
    folder = tmp_path / "disparity"
    folder.mkdir()
    cv2.imwrite(str(folder / "000000.png"), np.full((4, 6), 512, np.uint16))
    assert main(["evaluate", str(folder), str(folder), "--config", str(config)]) == 0
    assert capsys.readouterr().out.startswith("frame,")


@dataclass(frozen=True)
class Switches:
    """Parameters with a switch, which run has not."""

    wet: bool = param(True, "Rain.")
    speed: float = param(1.5, "Speed.", unit="m/s", low=0)
    steps: int = param(3, "Steps.", low=-2_000_000_000, high=1_000_000)


@pytest.mark.parametrize(
    ("args", "expected"),
    [
        ([], {}),
        (["--no-wet"], {"wet": False}),
        (["--wet", "--speed", "0"], {"wet": True, "speed": 0.0}),
    ],
)
def test_settings_are_made_of_what_was_given_alone(args, expected):
    received = []

    @click.command()
    @settings_options(Switches)
    def command(settings: Switches) -> None:
        received.append(settings)

    command.main(args, standalone_mode=False)
    assert received == [Switches(**expected)]
    texts = [option.help for option in command.params if isinstance(option, click.Option)]
    assert texts[1:] == [
        "Rain.  [default: on]",
        "Speed.  [m/s; at least 0; default: 1.5]",
        "Steps.  [-2,000,000,000 to 1,000,000; default: 3]",
    ]


@dataclass(frozen=True)
class Renamed:
    """A parameter that had another name."""

    min_jump: int = param(6, "Jump.", old="least_jump")


@pytest.mark.parametrize(
    ("args", "config", "expected"),
    [
        ([], "", {}),
        (["--least-jump", "3"], "", {"min_jump": 3}),
        (["--min-jump", "4", "--least-jump", "3"], "", {"min_jump": 4}),
        ([], "least_jump = 5", {"min_jump": 5}),
        (["--min-jump", "4"], "least-jump = 5", {"min_jump": 4}),
    ],
)
def test_a_former_name_is_understood_and_not_shown(args, config, expected, tmp_path):
    received = []
    (tmp_path / "config.toml").write_text(config)

    @click.command()
    @settings_options(Renamed)
    def command(settings: Renamed) -> None:
        received.append(settings)

    command.main([*args, "--config", str(tmp_path / "config.toml")], standalone_mode=False)
    assert received == [Renamed(**expected)]
    assert "least" not in command.get_help(click.Context(command))


# Help and start-up.


def commands() -> list[tuple[str, click.Command]]:
    return sorted(cli.commands.items())


@pytest.mark.parametrize(("name", "command"), commands())
def test_every_command_and_option_has_help(name, command, capsys):
    assert command.help
    for option in command.params:
        if isinstance(option, click.Option) and not option.hidden:
            assert option.help, option.name
    assert main([name, "--help"]) == 0
    said = capsys.readouterr().out
    assert f"motionstereo {name}" in said
    has_it = any(option.name == "max_disparity" for option in command.params)
    assert ("max-disparity" in said) == has_it, "no example is of another command"
    for option in re.split(r"\n  -", said):
        assert not ("<=x<=" in option and re.search(r"\d to \d", option)), "a range, twice"


def test_run_has_an_option_for_each_setting():
    options = {option.name for option in cli.commands["run"].params}
    assert {item.name for item in params(Settings)} <= options


def test_no_arguments_show_the_help(capsys):
    assert main([]) == 0
    assert "run" in capsys.readouterr().out


@pytest.mark.parametrize("args", [["--version"], ["run", "--help"]])
def test_help_and_version_load_nothing_heavy(args):
    script = (
        "import sys\nfrom motionstereo_cli.__main__ import main\n"
        f"code = main({args})\n"
        "heavy = {'numpy', 'cv2', 'av', 'imageio', 'tqdm'} & sys.modules.keys()\n"
        "sys.exit(f'loaded {heavy}' if heavy else code)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_progress_shows_on_a_terminal_alone(run_args):
    terminal, stderr = pty.openpty()
    termios.tcsetwinsize(stderr, (24, 100))
    done = subprocess.run(
        [*COMMAND, *run_args, "--save", "steering"], stderr=stderr, stdout=stderr, check=False
    )
    os.close(stderr)
    shown = os.read(terminal, 100_000).decode()
    os.close(terminal)
    assert done.returncode == 0
    assert f"{FRAMES}/{FRAMES}" in shown
    assert "frame/s" in shown
    done = called(*run_args, "--save", "steering", "--overwrite")
    assert f"{FRAMES}/{FRAMES}" not in done.stderr


@pytest.mark.parametrize(
    ("args", "line"),
    [
        (
            ["drive", "--max-frames", "2"],
            r"frame 0: x -?\d+\.\d m, y -?\d+\.\d m, facing -?\d+°; .+; "
            r"\d\.\d\d laps, 0\.0 m driven, nearest pass \d\.\d\d m",
        ),
        (
            ["simulate", "--scene", "street", "--frames", "2"],
            r"frame 0: x .+ m, y .+ m, facing \d+°; nearest \d+\.\d m; moving by themselves: \d+",
        ),
    ],
    ids=lambda value: value[0],
)
def test_on_a_terminal_it_is_said_what_is_drawn(args, line, tmp_path, monkeypatch, capsys):
    name, *more = args
    given = [*more, "--width", "64", "--height", "48", "--overwrite"]
    said = []
    for on_terminal, option in ((False, []), (True, []), (True, ["--quiet"])):
        monkeypatch.setattr("sys.stderr.isatty", lambda on_terminal=on_terminal: on_terminal)
        assert main([name, str(tmp_path / "out"), *given, *option]) == 0
        said.append(
            re.findall(f"^note: {line}$", capsys.readouterr().err.replace("\r", "\n"), re.M)
        )
    assert [len(each) for each in said] == [0, 1, 0]


class Bar:
    """A progress bar that only takes its calls."""

    def update(self):
        pass

    say = staticmethod(say)


@pytest.mark.parametrize(
    ("frames", "frame_s", "wanted"),
    [
        (20, 0.1, ""),
        (100, 0.2, "note: about 100 frames, which take about 20 s\n"),
        (10_000, 0.2, "note: about 10000 frames, which take about 33 minutes\n"),
        (100_000, 0.2, "note: about 100000 frames, which take about 5.6 hours\n"),
    ],
)
def test_long_work_says_soon_how_long_it_takes(frames, frame_s, wanted, monkeypatch, capsys):
    clock = itertools.count()
    monkeypatch.setattr("time.perf_counter", lambda: frame_s * next(clock))
    advance = foretelling(frames, Bar())
    for _ in range(10):
        advance()
    assert capsys.readouterr().err == wanted


def test_a_file_that_begins_with_a_dash_is_told_from_an_option(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "-left.mp4").touch()
    assert main(["run", "-left.mp4", "right.mp4"]) == 2
    assert "write ./-left.mp4" in capsys.readouterr().err


def test_a_dry_run_checks_all_and_writes_nothing(run_args, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main([*run_args, "--dry-run", "-o", "out"]) == 0
    said = capsys.readouterr().err
    assert "a dry run: " in said
    assert (
        "frames would be processed, and the results written into out: steering.csv, disparity/"
        in said
    )
    assert main([*run_args, "--dry-run", "--rig", "none.yaml"]) == 1
    assert main([*run_args, "--dry-run", "--start", "10000"]) == 1
    assert not list(tmp_path.iterdir())
    assert main([*run_args, "--save", "steering", "-o", "out"]) == 0
    written = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert main([*run_args, "--dry-run", "-o", "out"]) == 1
    assert "out is not empty" in capsys.readouterr().err
    assert main([*run_args, "--dry-run", "-o", "out", "--overwrite"]) == 0
    assert main([*run_args, "--dry-run", "-o", "out", "--save", "steering", "--resume"]) == 0
    assert main([*run_args, "--dry-run", "-o", "out", "--resume", "--bands", "5"]) == 1
    after = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert after == written


def test_a_dry_run_of_a_batch_names_those_that_would_fail(run_args, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    left, right = run_args[1:3]
    Path("table.csv").write_text(f"left,right,out\n{left},{right},good\n{left},text.mp4,bad\n")
    Path("text.mp4").write_text("no video")
    assert main(["batch", "table.csv", "--dry-run", "-o", "results"]) == 1
    said = capsys.readouterr().err
    assert "note: good: a dry run: " in said
    assert "error: bad: " in said
    assert "1 of 2 recordings would fail" in said
    assert not Path("results").exists()


def test_quiet_and_verbose(run_args, tmp_path, capsys):
    given = [*run_args, "--save", "steering", "--checkpoint-frames", "3", "-o"]
    assert main([*given, str(tmp_path / "a"), "--quiet"]) == 0
    assert "note: " not in capsys.readouterr().err
    assert main([*given, str(tmp_path / "b"), "--verbose"]) == 0
    said = capsys.readouterr().err
    assert "detail: settings: Settings(" in said
    assert "detail: checkpoint after 3 frames" in said
    assert main([*given, str(tmp_path / "c")]) == 0
    assert "detail: " not in capsys.readouterr().err
    assert main([*given, str(tmp_path / "d"), "--quiet", "--verbose"]) == 2
    tables = {(tmp_path / name / "steering.csv").read_bytes() for name in "abc"}
    assert len(tables) == 1


def test_a_run_from_python_logs_what_the_command_says(run_args, tmp_path, caplog):
    plan = RunPlan(*run_args[1:3], tmp_path / "out")
    with caplog.at_level("DEBUG", logger="motionstereo"):
        run_library(plan)
    levels = {record.levelname for record in caplog.records}
    assert {"DEBUG", "INFO"} <= levels
    assert "depth in m needs --rig: disparity takes the place of depth" in caplog.messages


@pytest.mark.parametrize(
    ("option", "said"),
    [("--max-disparty", "Did you mean '--max-disparity'?"), ("--baseline-m", "--baseline-m'.")],
)
def test_only_options_that_are_alike_are_suggested(run_args, capsys, option, said):
    assert main([*run_args, option, "3"]) == 2
    assert "near-m" not in (text := capsys.readouterr().err)
    assert said in text


def test_the_summary_says_how_much_of_the_image_has_depth(run_args, tmp_path, capsys):
    assert main([*run_args, "-o", str(tmp_path / "o")]) == 0
    said = capsys.readouterr().err
    assert re.search(r"disparity for \d+% of the image \(\d+% moved lately\)", said)


@pytest.mark.parametrize(
    ("ids", "said"),
    [
        ("", "no moving objects found"),
        ("4", "1 moving object found"),
        ("474", "2 moving objects found"),
        ("45", "2 moving objects found, 1 marked as shadow"),
    ],
)
def test_the_summary_says_how_many_objects_were_found(
    run_args, tmp_path, monkeypatch, capsys, ids, said
):
    def write(self, step):
        n = step.time.index
        self.add(f"{n},{each},1,1,9,9,,,,0.50,,,,,{int(each == '5')}" for each in ids[n : n + 1])

    monkeypatch.setattr(ObjectsFile, "write", write)
    assert main([*run_args, "-o", str(tmp_path / "o"), "--save", "objects"]) == 0
    assert f"note: {said}\n" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "prints"),
    [
        ("check left.mp4 right.mp4 --end 20", True),
        ("info left.mp4 right.mp4", True),
        ("rig rig.yaml -o OUT/rig.yaml", False),
        ("figure left.mp4 right.mp4 --frames 1 -o OUT/sheet.png", False),
        ("compare golden OUT/golden", True),
        ("evaluate golden OUT/golden", True),
        ("report golden -o OUT/page.html", False),
    ],
)
def test_quiet_commands_print_only_what_is_asked_for(tmp_path, capsys, monkeypatch, words, prints):
    monkeypatch.chdir(Path(__file__).parent.parent / "sample_data")
    shutil.copytree("golden", tmp_path / "golden")
    assert main([*words.replace("OUT", str(tmp_path)).split(), "--quiet"]) == 0
    said = capsys.readouterr()
    assert (bool(said.out), said.err) == (prints, "")
