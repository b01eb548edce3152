"""``--progress jsonl``: what a program that watches a command reads."""

import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from recordings import encode, folder, scene

from motionstereo_cli.__main__ import main

KEYS = {"kind", "frame", "frames", "seconds", "eta"}
MORE = {
    "begin": set(),
    "progress": set(),
    "end": {"status", "exit_code"},
    **{kind: {"text"} for kind in ("note", "warning", "error")},
    "recording": {"recording"},
}


@pytest.fixture(scope="module")
def sides(tmp_path_factory):
    made = tmp_path_factory.mktemp("sides")
    return [str(folder(made / side, scene(), ".png")) for side in ("left", "right")]


def events_in(text):
    events = [json.loads(line) for line in text.splitlines()]
    for event in events:
        assert event.keys() == KEYS | MORE[event["kind"]]
    assert [event["kind"] for event in events].index("end") == len(events) - 1
    assert [event["frame"] for event in events] == sorted(event["frame"] for event in events)
    return events


def test_a_process_tells_how_far_it_is(sides, tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "motionstereo_cli", "run", *sides, "--progress", "jsonl"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    events = events_in(done.stderr)
    assert {"begin", "progress", "warning", "note"} <= {event["kind"] for event in events}
    assert events[-1]["status"] == "done"
    assert events[-1]["frame"] == events[-1]["frames"] == 12
    assert events[-1]["eta"] == 0


@pytest.mark.parametrize(
    ("more", "status", "code", "text"),
    [
        (["--rig", "nope.yaml"], "failed", 1, "nope.yaml"),
        (["--poses", "p.txt"], "usage", 2, "--rig"),
        (["--grey-min", "256"], "usage", 2, ""),
    ],
)
def test_the_end_is_told_with_the_reason(sides, tmp_path, capsys, more, status, code, text):
    out = ["-o", str(tmp_path / "o"), "--progress", "jsonl"]
    assert main(["run", *sides, *out, *more]) == code
    said = capsys.readouterr().err
    if text:
        *_, error, end = events_in(said)
        assert (error["kind"], end["status"], end["exit_code"]) == ("error", status, code)
        assert text in error["text"]
    else:  # an option out of its range ends it before it can tell
        assert said.startswith("error: --grey-min")
    assert main(["info", str(tmp_path / "nothing")]) == 1
    assert capsys.readouterr().err.startswith("error: there is no")


def test_lines_go_to_a_file_and_words_stay(sides, tmp_path, capsys):
    told, out = tmp_path / "told.jsonl", tmp_path / "o"
    given = ["run", *sides, "-o", str(out), "--overwrite", "--save", "steering"]
    given += ["--progress", "jsonl", "--progress-file", str(told)]
    for _ in range(2):  # the lines of an earlier command are replaced
        assert main(given) == 0
        assert "results in" in capsys.readouterr().err
        assert events_in(told.read_text())[-1]["status"] == "done"
    image = next((tmp_path.parent / sides[0]).iterdir())
    content = image.read_bytes()
    assert main([*given[:-1], str(image)]) == 1
    assert image.read_bytes() == content
    assert main(["run", *sides, "--progress-file", "x"]) == 2


def test_damage_and_simulations_are_told(sides, tmp_path, capsys):
    short = encode(tmp_path / "short.mkv", scene(count=9), "ffv1", "gray", 2)
    other = encode(tmp_path / "other.mkv", scene(count=12), "ffv1", "gray", 2)
    out = str(tmp_path / "o")
    assert main(["run", str(short), str(other), "-o", out, "--progress", "jsonl"]) == 3
    events = events_in(capsys.readouterr().err)
    assert events[-1]["status"] == "damaged"
    assert any("longer than the other" in event.get("text", "") for event in events)
    small = ["--frames", "0:3", "--width", "64", "--height", "48", "--progress", "jsonl"]
    assert main(["simulate", str(tmp_path / "s"), *small]) == 0
    assert events_in(capsys.readouterr().err)[-1]["frame"] == 3


@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_an_interrupt_is_told(tmp_path):
    images = [np.full((480, 640), 20 * (n % 12), np.uint8) for n in range(150)]
    left = encode(tmp_path / "l.mkv", images, "ffv1", "gray", 2)
    right = encode(tmp_path / "r.mkv", images, "ffv1", "gray", 2)
    command = [sys.executable, "-m", "motionstereo_cli", "run", left, right]
    with subprocess.Popen(
        [*command, "--progress", "jsonl"], cwd=tmp_path, stderr=subprocess.PIPE, text=True
    ) as process:
        said = ""
        for line in process.stderr:
            said += line
            if json.loads(line)["kind"] == "progress":
                process.send_signal(signal.SIGINT)
                break
        said += process.stderr.read()
    assert process.returncode == 130
    assert events_in(said)[-1]["status"] == "interrupted"
