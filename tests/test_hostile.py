"""Nothing of the user's is destroyed, followed or taken for something else."""

import bz2
import contextlib
import dataclasses
import errno
import fcntl
import io
import json
import os
import pickle
import shutil
import stat
import subprocess
import sys
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import motionstereo_cli.runs.run as run_module
from motionstereo_cli.__main__ import main
from motionstereo_cli.batch.own_folder import log_path
from motionstereo_cli.errors import BusyError, OutputError, SettingsError
from motionstereo_cli.files import bounded, targets
from motionstereo_cli.files.atomic import is_left_over, write_whole
from motionstereo_cli.files.lock import locked
from motionstereo_cli.files.records import pack, unpack
from motionstereo_cli.method.memory import Memory
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.pipeline import State
from motionstereo_cli.runs.checkpoint import (
    check_state,
    read_checkpoint,
    write_checkpoint,
)
from motionstereo_cli.runs.folder_files import CHECKPOINT
from motionstereo_cli.runs.open_outputs import Totals
from motionstereo_cli.runs.plan import RunPlan
from motionstereo_cli.runs.run import run
from motionstereo_cli.sinks import writers
from motionstereo_cli.sinks.writers import cell_text, text_cell

FRAMES, HEIGHT, WIDTH = 9, 32, 48
RIG = f"width: {WIDTH}\nheight: {HEIGHT}\nfocal_px: 40\nbaseline_m: 0.1\ncx: 23.5\ncy: 15.5\n"


@pytest.fixture
def recording(tmp_path, monkeypatch):
    """Folders left and right of moving bars and a rig.yaml, in the current folder."""
    monkeypatch.chdir(tmp_path)
    noise = np.random.default_rng(0).integers(0, 256, (1, WIDTH + 40)).astype(np.uint8)
    for side, shift in (("left", 0), ("right", 4)):
        Path(side).mkdir()
        for n in range(FRAMES):
            image = np.repeat(noise[:, 2 * n + shift : 2 * n + shift + WIDTH], HEIGHT, axis=0)
            assert cv2.imwrite(f"{side}/{n:04d}.png", np.ascontiguousarray(image))
    Path("rig.yaml").write_text(RIG)
    return tmp_path


def contents(folder):
    return {path: path.read_bytes() for path in sorted(Path(folder).rglob("*")) if path.is_file()}


def ran(*options):
    return main(["run", "left", "right", "--no-check", "--checkpoint-frames", "3", *options])


@contextlib.contextmanager
def ending_at(frame, monkeypatch):
    """Have runs end as if the disk were full before a frame."""
    whole = run_module.steps

    def until(*args, **options):
        for each, step, state in whole(*args, **options):
            if each.index == frame:
                raise OutputError("the disk is full")
            yield each, step, state

    with monkeypatch.context() as patch:
        patch.setattr(run_module, "steps", until)
        yield


# Inputs.


@pytest.mark.parametrize(
    ("command", "target"),
    [
        (["figure", "left", "right", "--frames", "4", "-o"], "left/0004.png"),
        (["figure", "left", "right", "--frames", "4", "-o"], "right/new.png"),
        (["figure", "left", "right", "--frames", "4", "--config", "c.toml", "-o"], "c.toml"),
        (["rig", "rig.yaml", "-o"], "rig.yaml"),
        (["rig", "rig.yaml", "-o"], "link.yaml"),
        (["compare", "g", "h", "--json"], "h/run.json"),
        (["compare", "g", "h", "--junit"], "h/run.json"),
        (["evaluate", "g", "h", "--csv"], "h/depth/000002.png"),
        (["evaluate", "g", "h", "--picture", "1", "-o"], "g/depth/000002.png"),
        (["run", "left", "right", "--rig", "rig.yaml", "-o", "o", "--csv"], "rig.yaml"),
        (["run", "left", "right", "--overwrite", "-o"], "left/out"),
        (["run", "g/depth/*.png", "h/depth/*.png", "--overwrite", "-o"], "g"),
    ],
)
def test_no_command_writes_to_its_input(recording, capsys, command, target):
    Path("c.toml").write_text("bands = 8\n")
    os.link("rig.yaml", "link.yaml")
    for out in ("g", "h"):
        assert ran("--rig", "rig.yaml", "--save", "depth", "-o", out) == 0
    before = contents(".")
    capsys.readouterr()
    overwrite = ["--overwrite"] if "--csv" in command and command[0] == "run" else []
    assert main([*command, target, *overwrite]) == 1
    assert "an input of this run: give another" in capsys.readouterr().err
    assert {path: before.get(path) for path in contents(".")} == before


def test_the_current_folder_is_a_place_for_results(recording, monkeypatch, capsys):
    Path("here").mkdir()
    monkeypatch.chdir("here")
    command = ["run", "../left", "../right", "--no-check", "--save", "steering", "-o", "."]
    assert main([*command, "--dry-run"]) == 0
    assert main(command) == 0
    assert {path.name for path in Path().iterdir()} == {"steering.csv", "run.json"}
    assert main([*command, "--overwrite"]) == 0
    assert main(["run", "../left", "../right", "-o", "/", "--overwrite", "--dry-run"]) in {0, 1}
    assert "internal" not in capsys.readouterr().err


def test_fifos_and_devices_are_written_into(recording, monkeypatch, capsys):
    os.mkfifo("fifo")
    got = []
    reader = threading.Thread(target=lambda: got.append(Path("fifo").read_bytes()))
    reader.start()
    assert main(["rig", "rig.yaml", "-o", "fifo"]) == 0
    reader.join()
    assert b"focal_px: 40.0" in got[0]
    Path("null").symlink_to(os.devnull)
    for _ in range(2):
        assert ran("-o", "o", "--overwrite", "--save", "steering", "--csv", "null") == 0
    assert Path("null").is_symlink()
    assert stat.S_ISFIFO(Path("fifo").stat().st_mode)
    monkeypatch.setattr(targets, "_PATIENCE_S", 0.1)
    assert main(["rig", "rig.yaml", "-o", "fifo"]) == 1
    assert "no program reads this FIFO" in capsys.readouterr().err
    with pytest.raises(SettingsError, match="cannot go on with a table in null"):
        RunPlan("left", "right", table="null", resume=True)


# Other runs.


def test_another_run_without_a_checkpoint_stays(recording, monkeypatch, capsys):
    with ending_at(2, monkeypatch):
        assert ran("-o", "out", "--save", "charge-png") == 1
    assert not Path("out", CHECKPOINT).exists()
    before = contents("out")
    options = ["-o", "out", "--save", "charge-png", "--resume"]
    assert ran(*options, "--bands", "9") == 1
    assert main(["run", "right", "left", "--no-check", *options]) == 1
    said = capsys.readouterr().err
    assert "out is of another run, with --bands" in said
    assert "out is of another run, with inputs.left." in said
    assert contents("out") == before
    assert ran(*options) == 0


def test_a_table_is_of_one_run(recording, monkeypatch, capsys):
    """However its name is given; and one of another run is neither continued nor cut."""
    options = ["-o", "out", "--save", "charge-png"]
    with ending_at(5, monkeypatch):
        assert ran(*options, "--csv", "t.csv") == 1
    begun = Path("out/table.part").read_bytes()
    Path("t.csv").write_text("frame\nmine\n" * 99)
    for option in ("--resume", "--overwrite"):
        assert ran(*options, "--csv", "t.csv", option) == 1
        assert "t.csv was not written by an earlier run" in capsys.readouterr().err
    assert Path("t.csv").read_text() == "frame\nmine\n" * 99
    Path("t.csv").unlink()
    Path("out/table.part").write_bytes(begun.replace(b"0,0", b"0,1", 1))
    assert ran(*options, "--csv", "t.csv", "--resume") == 1
    assert "table.part was cut or changed" in capsys.readouterr().err
    Path("out/table.part").write_bytes(begun)
    assert ran(*options, "--csv", str(Path("t.csv").absolute()), "--resume") == 0
    whole = Path("t.csv").read_text()
    assert whole.count("\n") == 1 + FRAMES
    for option in ("--resume", "--overwrite"):
        assert ran(*options, "--csv", "t.csv", option) == 0
        assert Path("t.csv").read_text() == whole
    assert ran("-o", "other", "--save", "charge-png", "--csv", "t.csv", "--overwrite") == 1
    assert "t.csv was not written by an earlier run into other" in capsys.readouterr().err
    Path("t.csv").write_text(whole + "mine\n")
    assert ran(*options, "--csv", "t.csv", "--overwrite") == 1
    assert Path("t.csv").read_text() == whole + "mine\n"
    Path("t.csv").unlink()
    assert ran(*options, "--csv", "t.csv", "--resume") == 1
    assert "t.csv is no longer what the run wrote" in capsys.readouterr().err


def test_part_files_of_others_stay(recording, capsys):
    """Neither a browser's download nor an input is in the way of what is being written."""
    Path("sheet.png.part").write_text("mine")
    assert main(["figure", "left", "right", "--frames", "4", "-o", "sheet.png"]) == 0
    assert Path("sheet.png.part").read_text() == "mine"
    Path("rig.yaml").rename("r.yaml.part")
    assert main(["rig", "r.yaml.part", "-o", "r.yaml"]) == 1
    assert "r.yaml is an input of this run" in capsys.readouterr().err
    assert Path("r.yaml.part").read_text() == RIG
    assert not [path for path in Path().iterdir() if is_left_over(path)]


def test_a_circle_of_links_is_not_replaced(recording, capsys):
    Path("one").symlink_to("other")
    Path("other").symlink_to("one")
    assert main(["figure", "left", "right", "--frames", "4", "-o", "one"]) == 1
    assert "cannot write one: Too many levels of symbolic links" in capsys.readouterr().err
    assert Path("one").is_symlink()


@pytest.mark.parametrize(
    "record",
    ['{"program": "motionstereo"}', '{"program": "motionstereo", "outputs": {}}', "{", "[1]"],
)
@pytest.mark.parametrize("name", ["run.json", "run.json.part"])
def test_a_record_that_lists_nothing_owns_nothing(recording, record, name):
    Path("out/depth").mkdir(parents=True)
    Path("out", name).write_text(record)
    for file in ("depth/000000.png", "steering.csv", "charge.0000.mp4.part", "run.checkpoint"):
        Path("out", file).write_text("mine")
    before = contents("out")
    assert ran("-o", "out", "--overwrite", "--save", "steering,charge") == 1
    assert contents("out") == before


def test_what_a_kill_left_is_known_and_goes(recording):
    assert ran("-o", "out", "--save", "charge-png") == 0
    left = Path("out/charge-png/.motionstereo-0123456789abcdef.part")
    left.write_text("half")
    Path("out/charge-png/.motionstereo-mine.part").write_text("mine")
    assert ran("-o", "out", "--save", "charge-png", "--overwrite") == 0
    assert not left.exists()
    assert Path("out/charge-png/.motionstereo-mine.part").exists()


# Results that others may have changed.


@pytest.mark.parametrize("name", ["steering.csv", "run.json"])
@pytest.mark.parametrize("kind", ["FIFO", "link", "folder"])
def test_compare_reads_regular_files_of_its_folders_only(recording, capsys, name, kind):
    for out in ("g", "h"):
        assert ran("-o", out, "--save", "steering") == 0
    path = Path("h", name)
    path.rename("elsewhere")
    if kind == "FIFO":
        os.mkfifo(path)
    elif kind == "link":
        path.symlink_to(recording / "elsewhere")
    else:
        path.mkdir()
    capsys.readouterr()
    for pair in (("g", "h"), ("h", "g")):
        assert main(["compare", *pair]) == 1
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert f"h/{name}" in said


def test_a_report_opens_nothing_that_a_record_names(recording, monkeypatch):
    assert ran("-o", "out", "--save", "steering,charge") == 0
    video = Path("out/charge.mp4").read_bytes()
    Path("private.mp4").write_bytes(video)
    record = json.loads(Path("out/run.json").read_text())
    record["inputs"]["right"] |= {"kind": "video", "path": str(recording / "private.mp4")}
    Path("out/run.json").write_text(json.dumps(record))
    assert main(["report", "out", "-o", "r.html"]) == 0
    assert Path("r.html").read_text().count("data:image/jpeg") == 1  # the charge
    Path("out/seg.mp4").write_bytes(video)
    Path("out/charge.mp4").write_text("ffconcat version 1.0\nfile seg.mp4\n")
    assert main(["report", "out", "-o", "r.html"]) == 0
    assert "data:image/jpeg" not in Path("r.html").read_text()
    Path("out/charge.mp4").unlink()
    Path("out/charge.mp4").symlink_to(recording / "private.mp4")
    assert main(["report", "out", "-o", "r.html"]) == 0
    assert "data:image/jpeg" not in Path("r.html").read_text()


# The folder of a batch.


@pytest.fixture
def batch(recording):
    Path("m.csv").write_text("left,right,out\nleft,right,a\n")
    Path("o").mkdir()
    return ["batch", "m.csv", "-o", "o", "--pieces", "1", "--workers", "1", "--no-check"]


@pytest.mark.parametrize(
    ("name", "said"),
    [("batch.csv", "batch.csv is not from an earlier batch"), (".batch/x", ".batch is not from")],
)
def test_a_batch_takes_no_names_of_others(batch, capsys, name, said):
    Path("o", name).parent.mkdir(exist_ok=True)
    Path("o", name).write_text("mine")
    assert main(batch) == 1
    assert said in capsys.readouterr().err
    assert contents("o") == {Path("o", name): b"mine"}


def test_a_batch_writes_to_no_manifest_and_through_no_link(batch, recording, capsys):
    Path("m.csv").rename("batch.csv")
    manifest = Path("batch.csv").read_bytes()
    assert main(["batch", "batch.csv", "-o", "."]) == 1
    assert "batch.csv is an input" in capsys.readouterr().err
    assert Path("batch.csv").read_bytes() == manifest
    Path("batch.csv").rename("m.csv")
    Path("else").mkdir()
    Path("o/a").symlink_to(recording / "else")
    Path("o/a.log").symlink_to(recording / "else/new.txt")
    assert main(batch) == 1
    assert "o/a is a link to elsewhere" in capsys.readouterr().err
    Path("o/a").unlink()
    log = log_path(Path("o"), "a")
    log.unlink()
    os.mkfifo(log)
    assert main([*batch, "--retry-failed"]) == 1
    assert str(log) in capsys.readouterr().err
    assert not list(Path("else").iterdir())


def test_cells_are_no_formulas():
    for text in ("=1+1", "+1", "-1", "@x", "\t=1"):
        assert text_cell(text) == f"'{text}"
        assert cell_text(text_cell(text)) == text
    for text in ("a=b", "", "'quoted'"):
        assert cell_text(text_cell(text)) == text_cell(text) == text


# Memory.


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (MemoryError(), "out of memory"),
        (ImportError("x.so: failed to map segment from shared object"), "out of memory"),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), "out of memory"),
        (RuntimeError("can't start new thread"), "no more threads"),
    ],
)
def test_a_lack_of_memory_or_threads_has_its_own_line(recording, monkeypatch, capsys, error, said):
    def failing(*_, **__):
        raise error

    monkeypatch.setattr(run_module, "open_stereo", failing)
    assert ran("-o", "out") == 1
    assert said in capsys.readouterr().err


def test_compressed_content_has_a_limit(monkeypatch):
    monkeypatch.setattr(bounded, "MAX_CONTENT_BYTES", 2000)
    content = bz2.compress(bytes(1000))
    assert bounded.decompressed(bz2.BZ2Decompressor(), content) == bytes(1000)
    with pytest.raises(ValueError, match="is larger"):
        bounded.decompressed(bz2.BZ2Decompressor(), bz2.compress(bytes(1_000_000)))
    with pytest.raises(ValueError, match="is cut off"):
        bounded.decompressed(bz2.BZ2Decompressor(), content[:-9])
    capped = bounded._Capped(io.BytesIO(bytes(3000)), 2000)
    assert capped.read(2000) == bytes(2000)
    with pytest.raises(ValueError, match="is too large"):
        capped.read()


#: Commands, a file that is larger than the limit of its kind, and where that limit stands.
LARGE = [
    (
        ["run", "left", "right", "--rig", "big.yaml"],
        "big.yaml",
        "rig.formats.MAX_CALIBRATION_BYTES",
    ),
    (["rig", "big.yaml"], "big.yaml", "rig.formats.MAX_CALIBRATION_BYTES"),
    (["rig", "maps.yml"], "maps.yml", "rig.formats.MAX_MAPS_BYTES"),
    (["run", "kitti"], "kitti/times.txt", "sources.times._MAX_BYTES"),
    (
        ["run", "left", "right", "--config", "big.toml"],
        "big.toml",
        "commands.options._MAX_CONFIG_BYTES",
    ),
    (
        ["run", "left", "right", "--matcher", "onnx:big.onnx"],
        "big.onnx",
        "runs.onnx_model._MAX_BYTES",
    ),
    (["report", "b"], "b/batch.csv", "report.batch_page._MAX_BYTES"),
    (["batch", "big.csv", "-o", "b"], "big.csv", "batch.manifest.MAX_RECORD_BYTES"),
    (["report", "out"], "out/run.json", "files.records.MAX_RECORD_BYTES"),
    (["evaluate", "big.csv", "big.csv"], "big.csv", "evaluation.objects.MAX_RESULT_BYTES"),
]


@pytest.mark.parametrize(("command", "name", "limit"), LARGE, ids=lambda value: str(value)[-40:])
def test_files_that_are_too_large_are_named(recording, monkeypatch, capsys, command, name, limit):
    assert ran("-o", "out", "--save", "steering,depth", "--rig", "rig.yaml") == 0
    monkeypatch.setattr(f"motionstereo_cli.{limit}", 10_000)
    Path("b").mkdir()
    for number, side in enumerate(("left", "right")):
        shutil.copytree(side, f"kitti/image_{number}")
    if name == "big.csv":
        Path(name).write_text("frame,id,x,y,width,height\n")
    if name == "maps.yml":
        Path(name).write_text("stereoMapL_x: !!opencv-matrix\n")
    with Path(name).open("a") as file:
        file.write(" " * 10_001)
    capsys.readouterr()
    assert main(command) in {1, 2}
    assert f"{name} is larger than 10000 bytes" in "".join(capsys.readouterr())


#: What the tables of a run may have at most on a page, and what is said of more.
LONG = {
    "files.reading.MAX_LINE_BYTES": "a line of more than 3 bytes",
    "report.run_folder.MAX_FRAMES": "out/steering.csv has more than 3 frames",
    "report.series.MAX_SPANS": "out/objects.csv: objects come more than 3 times",
}


@pytest.mark.parametrize(("limit", "said"), LONG.items(), ids=LONG)
def test_tables_of_a_run_have_no_size_but_a_page_has(recording, monkeypatch, capsys, limit, said):
    assert ran("-o", "out", "--save", "steering,objects", "--rig", "rig.yaml") == 0
    head = Path("out/objects.csv").read_text().splitlines()[0]
    rows = [f"{n},{n}" + "," * (head.count(",") - 1) for n in range(5)]
    Path("out/objects.csv").write_text("\n".join([head, *rows, ""]))
    shutil.copytree("out", "same")
    assert main(["report", "out"]) == 0
    monkeypatch.setattr(f"motionstereo_cli.{limit}", 3)
    capsys.readouterr()
    assert main(["report", "out"]) == 1
    assert said in capsys.readouterr().err
    # To compare them takes no memory; a line that is too long is a difference.
    assert main(["compare", "out", "same"]) == (4 if "LINE" in limit else 0)


def test_a_still_image_has_a_number_of_pages(recording, monkeypatch, capsys):
    monkeypatch.setattr("motionstereo_cli.files.stills.MAX_PAGES", 3)
    grey = np.zeros((8, 8), np.uint8)
    for count in (3, 4):
        assert cv2.imwritemulti("pages.tiff", [grey] * count)
        assert main(["run", "pages.tiff", "right", "-o", "pages"]) in {1, 2}
        error = capsys.readouterr().err
        assert ("pages.tiff has more than 3 images" in error) == (count == 4)


# Links.


def test_overwrite_removes_nothing_behind_a_link(recording, capsys):
    assert ran("-o", "real", "--save", "charge-png") == 0
    Path("out").symlink_to("real")  # to a larger disk, say
    assert ran("-o", "out", "--save", "charge-png", "--overwrite") == 0
    Path("real/charge-png").rename("photos")
    Path("real/charge-png").symlink_to(recording / "photos")
    before = contents("photos")
    for options in ((), ("--csv", "t.csv")):
        assert ran("-o", "out", "--save", "charge-png", "--overwrite", *options) == 1
    assert "out/charge-png is a link" in capsys.readouterr().err
    assert contents("photos") == before


@pytest.mark.parametrize("frame", [2, 5])
def test_no_planted_link_is_written_through(recording, monkeypatch, frame):
    """Neither where a run starts again nor where it goes on from a checkpoint."""
    options = ["-o", "out", "--save", "steering,charge-png,charge", "--csv", "t.csv"]
    with ending_at(frame, monkeypatch):
        assert ran(*options) == 1
    Path("victim").write_text("precious")
    names = ["run.checkpoint.part", "run.json.part.part", "steering.csv", "charge.mp4"]
    names += ["charge-png/000005.png", "charge.mp4.part"]
    for name in (*names, "charge.0001.mp4.part"):
        Path("out", name).unlink(missing_ok=True)
        Path("out", name).symlink_to(recording / "victim")
    assert ran(*options, "--resume") == 1  # final names, which the run had not yet given
    for name in ("steering.csv", "charge.mp4"):
        Path("out", name).unlink()
    # Without a checkpoint it starts again, and an image that it had not written is not its own.
    assert ran(*options, "--resume") == (1 if frame == 2 else 0)
    assert Path("victim").read_text() == "precious"
    if frame == 5:
        planted = {path.name for path in Path("out").rglob("*") if path.is_symlink()}
        assert planted == {"run.checkpoint.part", "run.json.part.part"}  # names of nobody
    Path("t.csv").unlink(missing_ok=True)
    Path("t.csv").symlink_to(recording / "victim")
    assert ran(*options, "--overwrite") == 1
    assert Path("t.csv").is_symlink()
    assert Path("victim").read_text() == "precious"


@pytest.mark.parametrize("moment", ["between two files", "within a file"])
def test_a_folder_that_becomes_a_link_ends_the_run(recording, monkeypatch, capsys, moment):
    Path("photos").mkdir()
    link = Path("out/charge-png")
    written = 0

    def plant():
        link.rename("away")
        link.symlink_to(recording / "photos")

    def write(path, content):
        nonlocal written
        written += path.parent == link
        if moment == "within a file" and written == 3:
            plant()
            (recording / "photos").rmdir()  # what is opened through the link is not there
        whole(path, content)
        if moment == "between two files" and written == 3:
            plant()

    whole = writers.write_whole
    monkeypatch.setattr(writers, "write_whole", write)
    assert ran("-o", "out", "--save", "charge-png") == 1
    assert "charge-png has become a link" in capsys.readouterr().err
    assert not Path("photos").exists() or not contents("photos")


# Deletion that is cut short, and what goes on.


@pytest.mark.parametrize("after", [0, 1, 5, FRAMES])
def test_overwrite_may_be_killed_at_any_moment(recording, monkeypatch, after):
    options = ["-o", "out", "--save", "charge-png,steering"]
    assert ran(*options) == 0
    removed = 0

    def unlink(*args, **kwargs):
        nonlocal removed
        if removed == after:
            raise SystemExit
        removed += 1
        real(*args, **kwargs)

    real = os.unlink
    with monkeypatch.context() as patch:
        patch.setattr(os, "unlink", unlink)
        patch.setattr(os, "supports_dir_fd", {*os.supports_dir_fd, unlink})
        with pytest.raises(SystemExit):
            ran(*options, "--overwrite")
    again = "--resume" if after % 2 else "--overwrite"
    assert ran(*options, again) == 0
    assert ran(*options, "--resume") == 0
    assert len(list(Path("out/charge-png").iterdir())) == FRAMES


def spoil_image(out):
    (out / "charge-png/000001.png").write_bytes((out / "charge-png/000002.png").read_bytes())


def lose_image(out):
    (out / "charge-png/000001.png").unlink()


def cut_segment(out):
    os.truncate(out / "charge.0000.mp4.part", 300)


def change_table(out):
    path = out / "steering.csv.part"
    path.write_bytes(path.read_bytes().replace(b"0,0", b"0,1", 1))


@pytest.mark.parametrize("spoil", [spoil_image, lose_image, cut_segment, change_table])
def test_resume_builds_on_nothing_that_was_changed(recording, monkeypatch, capsys, spoil):
    options = ["-o", "out", "--save", "steering,charge,charge-png"]
    with ending_at(5, monkeypatch):
        assert ran(*options) == 1
    spoil(Path("out"))
    assert ran(*options, "--resume") == 1
    assert "give --overwrite" in capsys.readouterr().err
    assert ran(*options, "--overwrite") == 0


@pytest.mark.parametrize("name", ["charge-png/000003.png", "steering.csv", "charge.mp4"])
def test_complete_is_only_what_is_whole(recording, capsys, name):
    options = ["-o", "out", "--save", "steering,charge,charge-png", "--resume"]
    assert ran(*options) == 0
    os.truncate(Path("out", name), 20)
    assert ran(*options) == 1
    assert "is no longer what the run wrote" in capsys.readouterr().err


def test_a_checkpoint_with_a_flipped_bit_is_none(recording, monkeypatch, capsys):
    with ending_at(5, monkeypatch):
        assert ran("-o", "out", "--save", "steering") == 1
    path = Path("out", CHECKPOINT)
    whole = path.read_bytes()
    for place in np.random.default_rng(0).integers(0, len(whole), 12):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
        assert ran("-o", "out", "--save", "steering", "--resume") == 1
        assert "no checkpoint that can be used" in capsys.readouterr().err


def memory(**changes):
    grey = np.zeros((HEIGHT, WIDTH), np.uint8)
    return dataclasses.replace(Memory(grey, grey, grey + 1, grey > 0, grey), **changes)


@pytest.mark.parametrize(
    "changes",
    [
        {"charge": np.zeros((HEIGHT, WIDTH + 1), np.uint8)},
        {"charge": np.zeros((HEIGHT, WIDTH), np.float64)},
        {"charge": "none"},
        {"bands": np.full((HEIGHT, WIDTH), 9, np.uint8)},
        {"moved": np.full((HEIGHT, WIDTH), None)},
    ],
)
def test_a_crafted_state_is_refused(tmp_path, changes):
    def check(state):
        check_state(state, Settings(), WIDTH, HEIGHT)

    path = tmp_path / CHECKPOINT
    write_checkpoint(path, {}, State(memory(), memory()), Totals(3, 0.5, 0.5), {})
    assert read_checkpoint(path, {}, check).totals == Totals(3, 0.5, 0.5)
    with pytest.raises(OutputError, match="of another run"):
        read_checkpoint(path, {"bands": 9}, check)
    write_checkpoint(path, {}, State(memory(), memory(**changes)), Totals(3), {})
    with pytest.raises(OutputError, match="no checkpoint that can be used"):
        read_checkpoint(path, {}, check)


@dataclasses.dataclass
class Nest:
    plain: tuple[int, str, None, tuple[float, float]]
    array: NDArray[np.uint8]
    inner: "Nest | None" = None


def test_kinds_are_checked_all_the_way_down():
    good = Nest((1, "a", None, (2.0, np.float32(1))), np.arange(3, dtype=np.uint8))
    found = unpack(pack(dataclasses.replace(good, inner=good)), Nest)
    assert found.inner.plain == good.plain
    assert found.inner.array.tolist() == [0, 1, 2]
    for wrong, words in (
        ({"plain": (1, "a", None, (2.0,))}, "plain"),
        ({"plain": (1, 2, None, (2.0, 1.0))}, "plain"),
        ({"array": np.zeros(3)}, "float64"),
        ({"array": (1, 2)}, "array"),
        ({"array": np.array([None])}, "cannot be read"),
        ({"inner": {}}, "missing required field plain"),
    ):
        with pytest.raises(ValueError, match=words):
            unpack(pack(dataclasses.replace(good, inner=dataclasses.replace(good, **wrong))), Nest)


# Names, sizes, streams.


@pytest.mark.skipif(sys.platform != "linux", reason="names are bytes on Linux only")
def test_names_that_are_not_utf8(recording):
    for side in ("left", "right"):
        for path in Path(side).iterdir():
            os.rename(path, os.path.join(os.fsencode(side), b"caf\xe9_" + os.fsencode(path.name)))
        os.rename(side, os.fsencode(side) + b"\xe9")
    args = [os.fsdecode(b"left\xe9"), os.fsdecode(b"right\xe9"), "--checkpoint-frames", "3"]
    out = os.fsdecode(b"out\xe9")
    for _ in range(2):
        assert main(["run", *args, "--no-check", "-o", out, "--save", "charge", "--resume"]) == 0
    assert json.loads(Path(out, "run.json").read_text("utf-8"))["inputs"]["left"]["path"]


@pytest.mark.parametrize("stderr", ["gone", "full", "closed"])
def test_a_message_that_nobody_reads_ends_no_run(recording, stderr):
    # Too little texture moves for the check: there is something to say.
    command = [sys.executable, "-m", "motionstereo_cli", "run", "left", "right", "-o", "out"]
    command += ["--save", "steering"]
    if stderr == "closed":
        done = subprocess.run(["sh", "-c", '"$@" 2>&-', "sh", *command], check=False)
    elif stderr == "full":
        with Path("/dev/full").open("w") as full:
            done = subprocess.run(command, stderr=full, check=False)
    else:
        reads, writes = os.pipe()
        os.close(reads)
        done = subprocess.run(command, stderr=writes, check=False)
        os.close(writes)
    assert done.returncode == 0
    assert Path("out/run.json").exists()


# Locks and disks.


def test_two_runs_in_one_folder_are_told_apart_without_fcntl(tmp_path):
    code = (
        "import sys; sys.modules['fcntl'] = None\n"
        "from pathlib import Path\n"
        "from motionstereo_cli.errors import BusyError\n"
        "from motionstereo_cli.files.lock import locked\n"
        "out = Path(sys.argv[1])\n"
        "for _ in range(2):\n"
        "    with locked(out):\n"
        "        try:\n"
        "            with locked(out): print('both')\n"
        "        except BusyError as error: print(error)\n"
        "print(list(out.iterdir()))\n"
    )
    out = tmp_path / "out"
    command = [sys.executable, "-c", code, str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    said = f"{out} is being written by another run: wait for it, or give another folder\n"
    assert done.stdout == 2 * said + "[]\n", done.stderr


def test_a_lock_has_an_error_of_its_own(tmp_path):
    with locked(tmp_path), pytest.raises(BusyError), locked(tmp_path):
        pass


def test_files_are_open_for_writing_when_they_are_synced(recording, monkeypatch):
    """Windows refuses others."""

    def fsync(file):
        number = file if isinstance(file, int) else file.fileno()
        if fcntl.fcntl(number, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))

    monkeypatch.setattr(os, "fsync", fsync)
    plan = RunPlan(
        "left", "right", "out", rig=("rig.yaml",), save=("steering", "charge", "charge-png")
    )
    assert run(pickle.loads(pickle.dumps(plan))).frames == FRAMES


def test_a_write_that_fails_leaves_what_was_there(tmp_path, monkeypatch):
    path = tmp_path / "a"
    path.write_text("old")
    monkeypatch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(OSError(28, "full")))
    with pytest.raises(OutputError, match="full"):
        write_whole(path, b"new")
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("a", "old")]
