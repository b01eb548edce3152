"""What a run warns of is said, kept in its record, and shown, however the run is done."""

import csv
import dataclasses
import html
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from recordings import encode
from recordings import folder as images_in
from test_resume import KILLED

from motionstereo_cli.__main__ import main
from motionstereo_cli.batch.pieces import join_pieces, pieces_of, run_piece
from motionstereo_cli.batch.status import format_statuses
from motionstereo_cli.batch.work import _ended
from motionstereo_cli.check import offset
from motionstereo_cli.check.findings import RULES, CheckReport, Drift
from motionstereo_cli.check.mounting import Mounting
from motionstereo_cli.check.shortfall import without_heading
from motionstereo_cli.commands.batch import plan_of
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.report.batch_page import batch_page
from motionstereo_cli.report.run_page import run_page
from motionstereo_cli.robot import odometer
from motionstereo_cli.runs import run as runs
from motionstereo_cli.runs.disparity_range import RANGE
from motionstereo_cli.runs.plan import AUTO_POSES, RunPlan
from motionstereo_cli.runs.run import Watcher, run
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.simulate.write import simulate
from motionstereo_cli.sinks.records import Status
from motionstereo_cli.sinks.settings import OutputSettings

FRAMES = 23


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    """Good recordings, ``a``; of noise, ``b``; of a small card before nothing, ``card``.

    And recordings of nothing and of few of 16 bits, and files beside.
    """
    folder = tmp_path_factory.mktemp("clips")
    simulate(folder / "a", SimulateSettings(frames=f"300:{300 + FRAMES}", width=96, height=64))
    (folder / "b").mkdir()
    (folder / "card").mkdir()
    texture = np.random.default_rng(2).integers(60, 200, (20, 20), np.uint8)
    blank = [np.full((48, 64), 90, np.uint8)] * 3
    for seed, side in enumerate(("left", "right")):
        noise = np.random.default_rng(seed).integers(0, 255, (FRAMES, 64, 96), np.uint8)
        encode(folder / f"b/{side}.mp4", list(noise), "libx264", "yuv420p")
        encode(folder / f"blank_{side}.mkv", blank, "ffv1", "gray", 2)
        card = np.full((FRAMES, 64, 96), 90, np.uint8)
        for at, image in enumerate(card, 10):
            image[20:40, at + 8 * (1 - seed) :][:, :20] = texture
        encode(folder / f"card/{side}.mkv", list(card), "ffv1", "gray")
        images_in(folder / f"dark_{side}", [image.astype(np.uint16) for image in noise], ".png")
    images_in(folder / "maps", [np.full((48, 64), 512, np.uint16)] * 3, ".png")
    poses = "".join(f"{t} 0 0 {0.1 * t} 0 0 0 1\n" for t in range(200))
    (folder / "long.txt").write_text(poses)
    rig = (folder / "a/rig.yaml").read_text()
    focal = next(line for line in rig.splitlines() if line.startswith("focal_px"))
    (folder / "far.yaml").write_text(rig.replace(focal, "focal_px: 4000"))
    return folder


def pair(folder, order=("left", "right")):
    return [str(next(folder.glob(f"{side}.m*"))) for side in order]


def given(clips, code):
    """Return the arguments of a run that warns of ``code``."""
    a, rig = pair(clips / "a"), ["--rig", str(clips / "a/rig.yaml")]
    blank = [str(clips / f"blank_{side}.mkv") for side in ("left", "right")]
    return {
        "recording": [str(clips / f"dark_{side}") for side in ("left", "right")],
        "calibration": [*a, "--rig", str(clips / "far.yaml")],
        "poses": [*a, *rig, "--poses", str(clips / "long.txt")],
        "range": [*blank, "--max-disparity", "auto"],
        "sync-offset": [*a, "--sync-offset", "auto"],
        "disparity-offset": [*a, *rig, "--poses", "auto"],
        "disparity": [*blank, "--disparity", str(clips / "maps")],
        "swapped": pair(clips / "a", ("right", "left")),
        "unmatched": pair(clips / "b"),
        "at-limit": [*a, "--max-disparity", "4"],
        "unmoved": [*blank, "--no-check"],  # which says the same, as far as it sees
        "no-heading": pair(clips / "card"),
        "lost-poses": [*pair(clips / "b"), *rig, "--poses", "auto"],
    }[code]


CODES = (
    *("recording", "calibration", "poses", "range", "sync-offset", "disparity-offset"),
    *("disparity", "swapped", "unmatched", "at-limit", "unmoved", "no-heading"),
    "lost-poses",
)
#: What a check found, so that nearly all of its rules apply; the others do not apply beside these.
FOUND = CheckReport(
    64,
    frames=9,
    matches=9,
    misaligned_px=3.0,
    misaligned_p90_px=4.0,
    shifted_px=3.0,
    turned_deg=0.2,
    disparity_low_px=-9.0,
    disparity_high_px=90.0,
    advised_max_disparity=96,
    given_offset_px=-9.0,
    behind=0.5,
    put_behind=0.9,
    negative=0.3,
    beyond=0.3,
    grey_difference=20.0,
    brightest=20,
    alike=0.1,
    moving=0.1,
    repeated_left=5,
    repeated_right=5,
    first_repeated_left=1,
    first_repeated_right=1,
    ahead_frames=2.0,
    step_frames=2,
    drift=Drift(0.0, 0, 2.0, 8),
    disparity_offset_px=0.7,
)
FOUND_ELSE = (
    dataclasses.replace(FOUND, mounted=Mounting("the right view is turned", {})),
    CheckReport(64, frames=1),
    dataclasses.replace(FOUND, behind=1.0),
)


def test_each_code_has_a_recording_here_that_gives_it():
    package = Path(runs.__file__).parent.parent
    code = r'warned?(?:\.warn|\.say)[(,]\s*(?:"([a-z-]+)"|RANGE)'
    texts = [path.read_text() for path in package.rglob("*.py")]
    given = {found or RANGE for text in texts for found in re.findall(code, text)}
    assert given == set(CODES) - {"swapped"}
    found = {each.name for report in (FOUND, *FOUND_ELSE) for each in report.findings}
    assert found == {rule.name for rule in RULES}


@pytest.mark.parametrize("found", [FOUND, *FOUND_ELSE], ids=lambda found: found.findings[0].name)
def test_each_finding_of_a_check_reaches_all_who_read(clips, tmp_path, monkeypatch, found):
    def watched(frames, _, hear, **known):
        hear(found.findings)
        return frames

    monkeypatch.setattr(runs, "watched", watched)
    out = tmp_path / "batch/o"
    assert main(["run", *pair(clips / "a"), "--save", "steering", "-o", str(out)]) == 0
    said = json.loads((out / "run.json").read_text())["warnings"]
    texts = [each.text for each in found.findings]
    assert [(each["code"], each["text"]) for each in said] == [
        (each.name, each.text) for each in found.findings
    ]
    pages = (run_page(out, out / "report.html"), page_of_a_batch_with(clips, out, tmp_path))
    for page in map(html.unescape, pages):
        assert all(text[1:] in page for text in texts)  # a sentence begins with a capital


def page_of_a_batch_with(clips, out, folder):
    """Return the page of a batch whose one recording is a complete run."""
    report = run(plan_of([*pair(clips / "a"), "--save", "steering", "-o", str(out), "--resume"]))
    status = _ended(Status(out.name, "running"), report)
    (folder / "batch/batch.csv").write_bytes(format_statuses([status]))
    return batch_page(folder / "batch", folder / "batch/report.html")


@pytest.mark.parametrize("code", CODES)
def test_each_warning_is_said_recorded_and_on_the_page(clips, tmp_path, capsys, monkeypatch, code):
    # How these two are measured has tests of its own.
    monkeypatch.setattr(odometer, "disparity_offset_px", lambda *_: 0.7)
    if code == "sync-offset":
        monkeypatch.setattr(offset, "with_offset", unsure_offset)
    out = tmp_path / "o"
    assert main(["run", *given(clips, code), "--save", "steering", "-o", str(out)]) == 0
    said = [
        line.removeprefix("warning: ")
        for line in capsys.readouterr().err.splitlines()
        if line.startswith("warning: ")
    ]
    found = json.loads((out / "run.json").read_text())["warnings"]
    assert [each["text"] for each in found] == said
    assert code in [each["code"] for each in found]
    assert all(each["numbers"] for each in found if each["code"] in CODES[7:])
    page = run_page(out, out / "report.html")
    assert "What to know" in page
    assert "Nothing was wrong" not in page
    assert page.count("<li>") >= len(said)


def unsure_offset(left, right, settings, say, prepare):
    say("note", "it is measured")
    say("warning", "other offsets explain it nearly as well")
    return settings.__class__()


def test_check_and_run_say_the_same(clips, tmp_path, capsys):
    swapped = pair(clips / "a", ("right", "left"))
    assert main(["check", *swapped, "--json"]) == 1
    findings = json.loads(capsys.readouterr().out)["findings"]
    assert main(["run", *swapped, "--save", "steering", "-o", str(tmp_path / "o")]) == 0
    found = json.loads((tmp_path / "o/run.json").read_text())["warnings"]
    assert found[0]["code"] == findings[0]["name"] == "swapped"
    assert found[0]["text"].partition(":")[0] == findings[0]["text"].partition(":")[0]
    assert found[0]["numbers"].keys() == findings[0]["numbers"].keys()


def test_good_input_has_nothing_to_know(clips, tmp_path):
    assert main(["run", *pair(clips / "a"), "--save", "steering", "-o", str(tmp_path / "o")]) == 0
    assert json.loads((tmp_path / "o/run.json").read_text())["warnings"] == []
    page = run_page(tmp_path / "o", tmp_path / "o/report.html")
    assert "Nothing was wrong" in page
    assert "What to know" not in page


def record_of(out):
    return {**json.loads((out / "run.json").read_text()), "timing": None, "options": None}


@pytest.mark.parametrize(
    "code", ["range", "swapped", "unmatched", "at-limit", "no-heading", "lost-poses"]
)
def test_the_record_is_the_same_however_the_run_is_done(clips, tmp_path, code):
    words = given(clips, code)
    auto = "--max-disparity" in words and "auto" in words
    settings = Settings(max_disparity=0 if auto else 4 if code == "at-limit" else 64)
    rig = {"rig": (clips / "a/rig.yaml",), "poses": AUTO_POSES} if code == "lost-poses" else {}

    def plan(name, **more):
        output = OutputSettings(checkpoint_frames=1 if auto else 5)
        return RunPlan(
            *(words[0], words[1], tmp_path / name),
            save=("steering",),
            settings=settings,
            output_settings=output,
            **rig,
            **more,
        )

    run(plan("whole", jobs=1))
    whole = record_of(tmp_path / "whole")
    assert code in [each["code"] for each in whole["warnings"]]
    run(plan("jobs", jobs=3))
    assert record_of(tmp_path / "jobs") == whole

    command = [*words, "--save", "steering", "-o", str(tmp_path / "killed")]
    command += ["--checkpoint-frames", "1" if auto else "5"]
    # Before a frame, and when all of them are done and in a checkpoint.
    when = "2" if auto else "12"
    script = [sys.executable, "-c", KILLED, when, "run", *command]
    assert subprocess.run(script, capture_output=True, check=False).returncode == -9
    assert main(["run", *command, "--resume"]) == 0
    assert record_of(tmp_path / "killed") == whole

    parts = plan("parts")
    pieces = pieces_of(parts, 3)
    assert len(pieces) > 1
    for piece in pieces:
        run_piece(parts, piece, tmp_path / "pieces", Watcher())
    join_pieces(parts, pieces, tmp_path / "pieces", Watcher())
    assert record_of(tmp_path / "parts") == whole


def test_a_batch_has_the_warnings_in_its_table_and_on_its_page(clips, tmp_path):
    rows = ["left,right,out", ",".join([*pair(clips / "a", ("right", "left")), "swapped"])]
    rows.append(",".join([*pair(clips / "a"), "good"]))
    (tmp_path / "all.csv").write_text("\n".join(rows) + "\n")
    out = tmp_path / "out"
    batch = ["batch", str(tmp_path / "all.csv"), "-o", str(out), "--save", "steering"]
    assert main([*batch, "--workers", "1"]) == 0
    table = {row["name"]: row for row in csv.DictReader((out / "batch.csv").open())}
    assert (table["good"]["warnings"], table["good"]["said"]) == ("0", "")
    said = json.loads((out / "swapped/run.json").read_text())["warnings"]
    assert table["swapped"]["warnings"] == str(len(said))
    assert table["swapped"]["said"] == "; ".join(each["text"] for each in said)
    know = run_page(out / "swapped", out / "swapped/report.html").partition("What to know")[2]
    assert know.partition("</ul>")[0].count("<li>") == len(said)
    page = batch_page(out, out / "report.html")
    assert page.index("left and right are swapped") < page.index('data-sort="good"')


def test_warnings_of_earlier_versions_are_read(clips, tmp_path):
    out: Path = tmp_path / "o"
    assert main(["run", *pair(clips / "a"), "--save", "steering", "-o", str(out)]) == 0
    record = json.loads((out / "run.json").read_text())
    (out / "run.json").write_text(json.dumps({**record, "warnings": ["left.mp4 is dark"]}))
    assert "<li>left.mp4 is dark.</li>" in run_page(out, out / "report.html")


def test_frames_without_own_motion_are_counted_and_the_first_are_named(clips, tmp_path):
    out: Path = tmp_path / "o"
    words = given(clips, "lost-poses")
    assert main(["run", *words, "--save", "odometry", "-o", str(out)]) == 0
    with (out / "odometry.csv").open(newline="") as file:
        lost = [int(row["frame"]) for row in csv.DictReader(file) if row["lost"] == "1"]
    said = {each["code"]: each for each in json.loads((out / "run.json").read_text())["warnings"]}
    numbers = said["lost-poses"]["numbers"]
    assert (numbers["lost"], numbers["frames"], numbers["first_lost"]) == (
        *(len(lost), FRAMES, lost[0]),
    )
    last = numbers["last_of_first"]
    assert set(range(lost[0], last + 1)) <= set(lost)
    assert last + 1 not in lost
    assert f"in {len(lost)} of {FRAMES} frames (first in {lost[0]}" in said["lost-poses"]["text"]


@pytest.mark.parametrize(
    ("matched", "why"),
    [(0.9, "one level surface fills the view"), (0.01, "too little was matched")],
)
def test_a_view_without_a_heading_is_explained(matched, why):
    said = without_heading(0.98, matched)
    assert said is not None
    assert "in 98% of the frames" in said
    assert why in said
    assert without_heading(0.4, matched) is None
