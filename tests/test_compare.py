"""The comparison of two runs: it finds every kind of difference, and no other."""

import json
import math
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.evaluation.compare import (
    Compared,
    CompareReport,
    WorstImage,
    compare,
)
from motionstereo_cli.evaluation.compare_picture import draw_worst
from motionstereo_cli.evaluation.compare_report import format_json, format_junit, format_table
from motionstereo_cli.evaluation.settings import CompareSettings
from motionstereo_cli.sinks.read_back import Table

STEERING = """\
frame,pts,time_s,status,steer,steer_rad,depth_m,nearest_m,charged,matched
0,0,0.000000,blind,,,,,0.0000,0.0000
1,512,0.033333,ok,-0.3597,-0.2038,7.010,2.905,0.1253,0.1147
2,1024,0.066667,ok,-0.3603,-0.2042,6.657,2.817,0.1958,0.1858
3,1536,0.100000,held,-0.3603,-0.2042,6.657,2.817,0.1900,0.1800
"""
RIG = {"width": 20, "height": 10, "focal_px": 278.4, "baseline_m": 0.12, "cx": 9.5, "cy": 4.5}
RECORD = {
    "program": "motionstereo",
    "outputs": {"steering": {"path": "steering.csv", "what": "rows"}},
    "versions": {"motionstereo": "0.1.0", "numpy": "2.0.0"},
    "settings": {"bands": 8, "blur_px": 1.0, "matcher": "trails"},
    "inputs": {"left": {"path": "here/left.mp4", "sha256": "12"}},
    "rig": RIG,
    "counts": {"written": 4, "left": {"damaged": 0}},
    "timing": {"wall_s": 1.5},
}
SHAPE = (10, 20)  # a share of 0.01 is 2 pixels


def png(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def record(folder, **changes):
    (folder / "run.json").write_text(json.dumps({**RECORD, **changes}))


def written(folder):
    """Write what a run of four frames does."""
    folder.mkdir()
    (folder / "steering.csv").write_text(STEERING)
    for frame in range(4):
        depth_mm = np.full(SHAPE, 2000, np.uint16)
        depth_mm[0] = 0
        png(folder / f"depth/{frame:06d}.png", depth_mm)
        png(folder / f"disparity/{frame:06d}.png", np.full(SHAPE, 20 * 256, np.uint16))
    (folder / "charge.mp4").write_bytes(b"video")
    (folder / "map.ply").write_bytes(b"points")
    png(folder / "map.png", np.full(SHAPE, 254, np.uint8))
    (folder / "map.yaml").write_text("image: map.png\nresolution: 0.1\norigin: [-1.5, 2.0, 0]\n")
    png(folder / "map-sheet.png", np.full((*SHAPE, 3), 254, np.uint8))
    record(folder)
    return folder


@pytest.fixture
def sides(tmp_path):
    """An actual and a golden run that are the same."""
    return written(tmp_path / "actual"), written(tmp_path / "golden")


def test_other_files_that_were_read_are_named(sides):
    actual, golden = sides
    rig = {"path": "rig.yaml", "sha256": "aa"}
    record(actual, files=[rig, {"path": "robot/poses.txt", "sha256": "bb"}])
    record(golden, files=[{"path": "old.txt", "sha256": "cc"}, rig | {"path": "elsewhere.yaml"}])
    report = compare(actual, golden)
    assert not report.differs
    notes = [note for note in report.notes if " read " in note]
    assert [note.partition(",")[0] for note in notes] == [
        "actual read 'robot/poses.txt'",
        "golden read 'old.txt'",
    ]


def edited(name, old, new):
    def edit(folder):
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new))

    return edit


def painted(name, value, pixels, row=5):
    """Set some pixels of one row to a value."""

    def paint(folder):
        image = cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED)
        image[row, :pixels] = value
        png(folder / name, image)

    return paint


def columns(change):
    def edit(folder):
        rows = [line.split(",") for line in STEERING.splitlines()]
        (folder / "steering.csv").write_text("".join(",".join(change(r)) + "\n" for r in rows))

    return edit


def both(*edits):
    def edit(folder):
        for each in edits:
            each(folder)

    return edit


def found(report):
    return {(output.name, what) for output in report.outputs for what in output.differences}


# Every kind of difference.

#: What is done to ACTUAL; where that shows, what differs, in how many places, first and worst
#: frame, and words about it.
DIFFERENCES = {
    "number": (
        both(edited("steering.csv", "7.010", "7.350"), edited("steering.csv", "6.657", "9.000")),
        ("steering.csv", "depth_m", 3, 1, 2, "9.000, golden 6.657 (tolerance 0.3)"),
    ),
    "text": (
        edited("steering.csv", "held", "ok"),
        ("steering.csv", "status", 1, 3, 3, "'ok', golden 'held'"),
    ),
    "number without tolerance": (
        edited("steering.csv", ",512,", ",513,"),
        ("steering.csv", "pts", 1, 1, 1, "513, golden 512"),
    ),
    "known and unknown": (
        edited("steering.csv", "7.010", ""),
        ("steering.csv", "depth_m", 1, 1, 1, "unknown, golden 7.010"),
    ),
    "not finite": (
        edited("steering.csv", "7.010", "nan"),
        ("steering.csv", "depth_m", 1, 1, 1, "'nan', golden 7.010"),
    ),
    "row missing": (
        edited("steering.csv", STEERING.splitlines()[2] + "\n", ""),
        ("steering.csv", "rows", 1, 1, 1, "missing"),
    ),
    "row too many": (
        edited("steering.csv", "0.1900,0.1800\n", "0.1900,0.1800\n4,2048,,,,,,,,\n"),
        ("steering.csv", "rows", 1, 4, 4, "not in golden"),
    ),
    "column missing": (
        columns(lambda row: row[:7] + row[8:]),
        ("steering.csv", "nearest_m", 1, None, None, "the column is missing"),
    ),
    "column too many": (
        columns(lambda row: [*row, "new" if row[0] == "frame" else "7"]),
        ("steering.csv", "new", 1, None, None, "the column is not in golden"),
    ),
    "columns reordered": (
        columns(lambda row: [row[1], row[0], *row[2:]]),
        ("steering.csv", "columns", 1, None, None, "in another order"),
    ),
    "image too many": (
        lambda folder: shutil.copy(folder / "depth/000001.png", folder / "depth/000009.png"),
        ("depth/", "frames", 1, 9, 9, "not in golden"),
    ),
    "setting too many": (
        lambda folder: record(folder, settings={**RECORD["settings"], "new": 1}),
        ("run.json", "settings.new", 1, None, None, "1, not in golden"),
    ),
    "table missing": (
        lambda folder: (folder / "steering.csv").unlink(),
        ("steering.csv", "files", 1, None, None, "No such file"),
    ),
    "table cut off": (
        edited("steering.csv", ",0.1900,0.1800\n", ""),
        ("steering.csv", "files", 1, None, None, "row 5 has 8 cells and not 10"),
    ),
    "depth off": (
        both(painted("depth/000001.png", 2101, 3), painted("depth/000003.png", 1899, 4)),
        ("depth/", "pixels", 2, 1, 3, "2.00% are over 100 mm off or known in only one"),
    ),
    "depth unknown": (
        painted("depth/000002.png", 0, 3),
        ("depth/", "pixels", 1, 2, 2, "1.50%"),
    ),
    "depth known": (
        painted("depth/000002.png", 2000, 3, row=0),
        ("depth/", "pixels", 1, 2, 2, "1.50%"),
    ),
    "disparity off": (
        painted("disparity/000001.png", 20 * 256 + 65, 3),
        ("disparity/", "pixels", 1, 1, 1, "over 0.25 px off"),
    ),
    "image missing": (
        both(*(lambda f, n=n: (f / f"depth/00000{n}.png").unlink() for n in (1, 2))),
        ("depth/", "frames", 2, 1, 1, "missing"),
    ),
    "image cut off": (
        lambda folder: (folder / "depth/000002.png").write_bytes(
            (folder / "depth/000002.png").read_bytes()[:60]
        ),
        ("depth/", "files", 1, 2, 2, "000002.png cannot be read as an image"),
    ),
    "image of another kind": (
        lambda folder: png(folder / "depth/000002.png", np.ones(SHAPE, np.uint8)),
        ("depth/", "files", 1, 2, 2, "is not a 16-bit grey PNG"),
    ),
    "image of another size": (
        lambda folder: png(folder / "depth/000003.png", np.ones((5, 4), np.uint16)),
        ("depth/", "size", 1, 3, 3, "4x5, golden 20x10"),
    ),
    "images missing": (
        lambda folder: shutil.rmtree(folder / "disparity"),
        ("disparity/", "files", 1, None, None, "No such file"),
    ),
    "setting": (
        lambda folder: record(folder, settings={**RECORD["settings"], "bands": 9}),
        ("run.json", "--bands", 1, None, None, "9, golden 8"),
    ),
    "setting missing": (
        lambda folder: record(folder, settings={"bands": 8, "blur_px": 1.0}),
        ("run.json", "--matcher", 1, None, None, "missing, golden 'trails'"),
    ),
    "rig": (
        lambda folder: record(folder, rig={**RIG, "focal_px": 278.5}),
        ("run.json", "rig.focal_px", 1, None, None, "278.5, golden 278.4"),
    ),
    "rig not expected": (
        both(
            lambda folder: record(folder, rig=RIG),
            lambda folder: record(folder.parent / "golden", rig=None),
        ),
        ("run.json", "rig", 1, None, None, "given, golden None"),
    ),
    "frames lost": (
        lambda folder: record(folder, counts={"written": 4, "left": {"damaged": 1}}),
        ("run.json", "counts.left.damaged", 1, None, None, "1, golden 0"),
    ),
    "record unreadable": (
        lambda folder: (folder / "run.json").write_text('{"settings": '),
        ("run.json", "files", 1, None, None, "run.json cannot be read"),
    ),
    "video missing": (
        lambda folder: (folder / "charge.mp4").unlink(),
        ("charge.mp4", "files", 1, None, None, "charge.mp4 is missing"),
    ),
    "map black": (
        painted("map.png", 0, 3),
        ("map.png", "cells", 1, None, None, "1.50% differ (tolerance 1.00%)"),
    ),
    "map of another size": (
        lambda folder: png(folder / "map.png", np.full((10, 21), 254, np.uint8)),
        ("map.png", "size", 1, None, None, "21x10, golden 20x10"),
    ),
    "map missing": (
        lambda folder: (folder / "map.png").unlink(),
        ("map.png", "files", 1, None, None, "map.png"),
    ),
    "map elsewhere": (
        edited("map.yaml", "-1.5", "-1.4"),
        ("map.yaml", "origin.0", 1, None, None, "-1.4, golden -1.5"),
    ),
    "map's place missing": (
        lambda folder: (folder / "map.yaml").unlink(),
        ("map.yaml", "files", 1, None, None, "map.yaml"),
    ),
    "map's sheet missing": (
        lambda folder: (folder / "map-sheet.png").unlink(),
        ("map-sheet.png", "files", 1, None, None, "map-sheet.png is missing"),
    ),
}


@pytest.mark.parametrize(("spoil", "expected"), DIFFERENCES.values(), ids=DIFFERENCES)
def test_each_kind_of_difference_is_found_and_nothing_else(sides, spoil, expected):
    actual, golden = sides
    spoil(actual)
    report = compare(actual, golden)
    name, what, count, first, worst, words = expected
    assert report.differs
    if what != "files" or name != "run.json":  # the maps ask an unreadable run.json for the rig
        assert found(report) == {(name, what)}
    (output,) = (output for output in report.outputs if output.name == name)
    difference = output.differences[what]
    assert (difference.count, difference.first_frame, difference.worst_frame) == (
        count,
        first,
        worst,
    )
    assert words in difference.found


def test_a_run_does_not_differ_from_itself(sides):
    report = compare(*sides)
    assert not report.differs
    assert [(output.name, output.compared) for output in report.outputs] == [
        ("steering.csv", 4),
        ("depth/", 4),
        ("disparity/", 4),
        ("charge.mp4", 1),
        ("map.ply", 1),
        ("map.png", 200),
        ("map.yaml", 5),
        ("map-sheet.png", 1),
        ("run.json", 11),
    ]
    assert report.notes == tuple(
        f"{name} must exist; its content is not compared"
        for name in ("charge.mp4", "map.ply", "map-sheet.png")
    )
    assert format_table(report).startswith("no difference in steering.csv (4 rows), depth/ (4 ")


@pytest.mark.parametrize(
    "harmless",
    [
        edited("steering.csv", "7.010", "7.310"),  # of exactly the tolerance
        edited("steering.csv", "0.033333", "0.033334"),
        edited("steering.csv", "-0.3603", "-0.36030"),
        painted("depth/000001.png", 2101, 2),  # of exactly the share
        painted("depth/000001.png", 2100, 20),
        painted("disparity/000001.png", 20 * 256 + 64, 20),
        lambda folder: record(folder, rig={**RIG, "focal_px": 278.4 * (1 + 1e-9)}),
        lambda folder: record(folder, timing={"wall_s": 9}, warnings=["dark"], program="other"),
    ],
)
def test_within_the_tolerance_there_is_no_difference(sides, harmless):
    actual, golden = sides
    harmless(actual)
    assert not found(compare(actual, golden))


def test_only_what_golden_has_is_compared(sides):
    actual, golden = sides
    for name in ("depth/000000.png", "depth/000001.png", "depth/000003.png", "run.json"):
        (golden / name).unlink()
    maps = ("map.ply", "map.png", "map.yaml", "map-sheet.png")
    for name in ("disparity", "charge.mp4", *maps):
        shutil.rmtree(golden / name) if (golden / name).is_dir() else (golden / name).unlink()
    (golden / "notes.txt").write_text("none of ours")
    assert [(o.name, o.compared) for o in compare(actual, golden).outputs] == [
        ("steering.csv", 4),
        ("depth/", 1),
    ]
    assert not compare(actual, golden).differs


def test_of_nothing_there_is_no_comparison(sides, tmp_path):
    empty = tmp_path / "empty"
    empty.mkdir()
    (empty / "run.json").write_text("{}")
    with pytest.raises(InputError, match="empty has nothing that run writes"):
        compare(sides[0], empty)


def test_versions_and_inputs_are_noted_and_do_not_count(sides):
    actual, golden = sides
    record(
        actual,
        versions={"motionstereo": "0.1.0", "numpy": "3.0.0"},
        inputs={"left": {"path": "there/left.mp4", "sha256": "34"}},
    )
    report = compare(actual, golden)
    assert not report.differs
    assert report.notes[3:] == (
        "versions.numpy is '3.0.0', golden '2.0.0'",
        "inputs.left.sha256 is 34, golden 12",
    )


def test_tolerances_can_be_chosen(sides):
    actual, golden = sides
    edited("steering.csv", ",1024,", ",1025,")(actual)
    painted("depth/000001.png", 2200, 20)(actual)
    painted("disparity/000001.png", 21 * 256, 20)(actual)
    assert len(found(compare(actual, golden))) == 3
    loose = CompareSettings(tolerance_px=1, tolerance_mm=200)
    assert not found(compare(actual, golden, loose, tolerances={"pts": 1}))
    shares = CompareSettings(max_differing=0.1)
    assert not found(compare(actual, golden, shares, tolerances={"pts": 1}))
    assert ("steering.csv", "depth_m") not in found(compare(actual, golden))
    edited("steering.csv", "7.010", "7.011")(actual)
    assert ("steering.csv", "depth_m") in found(compare(actual, golden, tolerances={"depth_m": 0}))


def test_a_tolerance_for_a_column_that_no_table_has_is_refused(sides):
    with pytest.raises(SettingsError, match=r"no table .* has a column 'ster': .* steer,"):
        compare(*sides, tolerances={"ster": 0.1})


def test_pfm_images_are_compared_in_px(sides):
    actual, golden = sides
    for folder, value in ((actual, 20.3), (golden, 20.0)):
        shutil.rmtree(folder / "disparity")
        image = np.full(SHAPE, value, np.float32)
        image[:, 5] = np.inf
        png(folder / "disparity/000000.pfm", image)
    assert found(compare(actual, golden)) == {("disparity/", "pixels")}
    assert not found(compare(actual, golden, CompareSettings(tolerance_px=0.3)))


# Tables with several rows a frame.


def test_rows_are_told_apart_by_frame_and_id(tmp_path):
    path = tmp_path / "objects.csv"
    path.write_text("frame,id,x\n3,1,10\n3,2,20\n4,1,11\n")
    table = Table(path)
    assert table.columns == ("frame", "id", "x")
    shown = [
        (frame, {key: row["x"] for key, row in rows.items()}) for frame, rows in table.by_frame()
    ]
    assert shown == [(3, {"1": "10", "2": "20"}), (4, {"1": "11"})]


def test_objects_are_compared_by_frame_and_id(sides):
    actual, golden = sides
    head = "frame,id,x,y,width,height,depth_m,closing_mps,time_to_contact_s,confidence\n"
    rows = ["1,1,10,5,4,8,2.0,0.50,4.0,0.9\n", "1,2,50,5,4,8,3.0,,,0.5\n"]
    (golden / "objects.csv").write_text(head + "".join(rows))
    (actual / "objects.csv").write_text(head + "".join(reversed(rows)))
    assert not compare(actual, golden).differs
    (actual / "objects.csv").write_text(head + rows[0].replace("0.50", "0.80") + rows[1])
    (output,) = (o for o in compare(actual, golden).outputs if o.name == "objects.csv")
    assert output.differences["closing_mps"].worst == pytest.approx(0.3)
    (actual / "objects.csv").write_text(head + "".join(rows) + "2,2,52,5,4,8,3.0,,,0.5\n")
    (output,) = (o for o in compare(actual, golden).outputs if o.name == "objects.csv")
    assert output.differences["rows"].found == "not in golden"
    assert output.differences["rows"].first_frame == 2


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "its first line has to name each column"),
        ("time,x\n1,2\n", "its first line has to name each column"),
        ("frame,x,x\n1,2,3\n", "its first line has to name each column"),
        ("frame,x\n1,2\n1,3\n", "frame 1 comes twice"),
        ("frame,id,x\n1,5,2\n1,5,3\n", "frame 1 comes twice"),
        ("frame,x\n2,2\n1,3\n", "frame 1 comes after frame 2"),
        ("frame,x\none,2\n", "row 2: 'one' is no frame number"),
        ("frame,x\n" + "9" * 9999 + ",2\n", r"row 2: '9+\.\.\. is no frame number"),
        ("frame,x\n1\n", "row 2 has 1 cells and not 2"),
        ('frame,x\n1,"2\n', "cannot read the table .*unexpected end of data"),
        ("frame,x\n1," + "2" * 70_000 + "\n", "a line of more than 65536 bytes"),
        ('frame,x\n1,"' + "\n2" * 100_000 + '"\n', "field larger than field limit"),
    ],
)
def test_what_is_no_table_is_named(tmp_path, text, words):
    path = tmp_path / "steering.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=words) as refused:
        list(Table(path).by_frame())
    assert len(str(refused.value).splitlines()) == 1
    assert len(str(refused.value)) < 400


# Reports.


def test_the_table_names_first_and_worst(sides):
    actual, golden = sides
    DIFFERENCES["number"][0](actual)
    lines = format_table(compare(actual, golden)).splitlines()
    assert re.fullmatch(r"output +what +count +first +worst +found", lines[0])
    assert re.fullmatch(r"steering.csv +depth_m +3 +1 +2 +9.000, golden 6.657 .*", lines[1])
    assert len(lines) == 2


def test_json_has_all_and_no_infinity(sides):
    actual, golden = sides
    DIFFERENCES["number"][0](actual)
    DIFFERENCES["text"][0](actual)
    content = json.loads(format_json(compare(actual, golden)), parse_constant=pytest.fail)
    assert content["differs"] is True
    steering = content["outputs"][0]
    assert (steering["name"], steering["unit"], steering["compared"]) == ("steering.csv", "rows", 4)
    depth, status = steering["differences"]
    assert (status["what"], status["worst"]) == ("status", None)
    assert (depth["what"], depth["count"], depth["first_frame"]) == ("depth_m", 3, 1)
    assert depth["worst"] == pytest.approx(9 - 6.657)


def test_junit_has_a_case_for_each_output_and_counts_failures(sides):
    actual, golden = sides
    for spoil in ("number", "text", "setting"):
        DIFFERENCES[spoil][0](actual)
    suite = ET.fromstring(format_junit(compare(actual, golden)))
    assert (suite.tag, suite.get("tests"), suite.get("failures")) == ("testsuite", "9", "2")
    cases = {case.get("name"): case.find("failure") for case in suite.iter("testcase")}
    assert [name for name, failure in cases.items() if failure is not None] == [
        "steering.csv",
        "run.json",
    ]
    assert cases["steering.csv"].get("message") == "differs in depth_m, status"
    assert "9.000, golden 6.657" in cases["steering.csv"].text


def test_what_cannot_be_compared_leaves_nothing_of_an_earlier_comparison(sides, tmp_path):
    actual = sides[0]
    painted("depth/000001.png", 5000, 3)(actual)
    files = ["--json", "d.json", "--junit", "d.xml", "--picture", "d.png"]
    assert called("actual", "golden", *files, cwd=tmp_path).returncode == 4
    shutil.rmtree(actual)
    assert called("actual", "golden", *files, cwd=tmp_path).returncode == 1
    suite = ET.fromstring((tmp_path / "d.xml").read_text())
    assert (suite.get("failures"), suite.get("errors")) == ("0", "1")
    assert "actual" in suite.find("testcase/error").get("message")
    assert "actual" in json.loads((tmp_path / "d.json").read_text())["error"]
    assert not (tmp_path / "d.png").exists()


@given(st.text(), st.text())
def test_junit_is_xml_whatever_the_values(what, words):
    output = Compared("run.json", "values")
    output.differ(what, words)
    suite = ET.fromstring(format_junit(CompareReport((output,), (), None)))
    assert suite.find("testcase/failure") is not None


def test_the_worst_image_is_the_one_with_the_most_pixels_off(sides):
    actual, golden = sides
    painted("depth/000001.png", 5000, 3)(actual)
    painted("disparity/000002.png", 0, 4)(actual)
    worst = compare(actual, golden).worst_image
    assert (worst.name, worst.share) == ("disparity/ frame 2", 0.02)


def test_the_picture_shows_actual_golden_and_difference():
    actual = np.full((30, 300), 2.0, np.float32)
    golden = actual.copy()
    actual[:10, :100], golden[:10, :100] = math.nan, 3
    actual[10:20, 100:], golden[10:20, 100:] = 4, math.nan
    actual[20:, :50] = 2.2
    actual[20:, 50:99] = golden[20:, 50:99] = math.nan
    picture = draw_worst(WorstImage("depth/ frame 3", actual, golden, 0.1, 0.4))[..., ::-1]
    assert picture.dtype == np.uint8
    first, second, third = (picture[52:82, n * 304 : n * 304 + 300] for n in range(3))

    def colours(panel, *pixels):
        return [tuple(int(level) for level in panel[pixel]) for pixel in pixels]

    alone, added, off, unknown, same = (5, 5), (15, 200), (25, 5), (25, 60), (5, 200)
    [grey] = set(colours(first, alone, unknown) + colours(second, added, unknown))
    assert len(set(grey)) == 1
    assert colours(first, same) == colours(second, same)
    near, far = colours(first, same, added)
    assert near[2] > near[0]  # 2 m is yellow, 4 m blue
    assert far[0] > far[2]
    shown = colours(third, alone, added, off, unknown, same)
    assert len(set(shown)) == 5
    assert shown[3] == (0, 0, 0)
    assert shown[2][2] > 200 > shown[2][0]  # off is red


def test_a_picture_without_any_depth_can_be_drawn():
    nothing = np.full((4, 4), math.nan, np.float32)
    assert draw_worst(WorstImage("depth/ frame 0", nothing, nothing, 0.1, 0.0)).size


# The command.


def called(*args, cwd):
    command = [sys.executable, "-m", "motionstereo_cli", "compare", *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=cwd)


def test_the_command_exits_with_4_and_writes_what_is_asked_for(sides, tmp_path):
    painted("depth/000001.png", 3000, 20)(sides[0])
    files = ["--json", "d.json", "--junit", "d.xml", "--picture", "d.png"]
    done = called("actual", "golden", *files, cwd=tmp_path)
    assert done.returncode == 4, done.stderr
    assert re.search(r"^depth/ +pixels +1 +1 +1 +10.00% ", done.stdout, re.MULTILINE)
    assert "note: depth/ frame 1 differs most: d.png" in done.stderr
    assert json.loads((tmp_path / "d.json").read_text())["differs"] is True
    assert ET.parse(tmp_path / "d.xml").getroot().get("failures") == "1"
    assert cv2.imread(str(tmp_path / "d.png")).shape[0] > SHAPE[0]


def test_the_command_exits_with_0_where_nothing_differs(sides, tmp_path):
    options = ["--json", "-", "--max-differing", "0", "--picture", "d.png"]
    done = called("actual", "golden", *options, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["differs"] is False
    assert "note: no picture: no images differ\n" in done.stderr
    assert not (tmp_path / "d.png").exists()


def test_a_picture_of_an_earlier_comparison_is_removed_and_no_other_file(sides, tmp_path):
    picture = tmp_path / "d.png"
    painted("depth/000001.png", 3000, 20)(sides[0])
    assert called("actual", "golden", "--picture", "d.png", cwd=tmp_path).returncode == 4
    ours = picture.read_bytes()
    painted("depth/000001.png", 2000, 20)(sides[0])
    done = called("actual", "golden", "--picture", "d.png", cwd=tmp_path)
    assert done.returncode == 0
    assert "no images differ; d.png of an earlier comparison was removed" in done.stderr
    assert not picture.exists()

    (tmp_path / "ours.png").write_bytes(ours)
    for foreign in (b"", b"text", ours[:33] + ours[-12:], sides[0].joinpath("run.json")):
        if isinstance(foreign, bytes):
            picture.write_bytes(foreign)
        else:
            picture.unlink()
            picture.symlink_to(tmp_path / "ours.png")
        done = called("actual", "golden", "--picture", "d.png", cwd=tmp_path)
        assert "note: no picture: no images differ\n" in done.stderr
        assert picture.exists()


def test_what_was_measured_in_both_runs_is_no_chosen_setting(sides):
    ends = {"near_m": 1.0, "far_m": 10.0}
    for folder, near_m, far_m in ((sides[0], 1.2, 10.0), (sides[1], 1.0, 10.0)):
        ends = {"near_m": near_m, "far_m": far_m}
        record(folder, output_settings=ends, measured=["far_m", "near_m"])
    report = compare(*sides)
    assert found(report) == set()
    assert "--near-m was measured: 1.2, golden 1.0" in report.notes
    record(sides[0], output_settings={**ends, "near_m": 1.2}, measured=["far_m"])
    assert found(compare(*sides)) == {("run.json", "--near-m")}


def test_tolerances_come_from_the_command_line_and_the_configuration(sides, tmp_path):
    edited("steering.csv", "7.010", "7.610")(sides[0])
    edited("steering.csv", "2.905", "3.505")(sides[0])
    given_here = ("--tolerance", "nearest_m=0.6")
    assert called("actual", "golden", *given_here, cwd=tmp_path).returncode == 4
    (tmp_path / "c.toml").write_text('tolerance = ["nearest_m=0.6", "depth_m=0.6"]\n')
    done = called("actual", "golden", "--config", "c.toml", cwd=tmp_path)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize(
    ("args", "code", "words"),
    [
        (["nowhere", "golden"], 1, "nowhere has no run.json"),
        (["golden/depth", "golden"], 1, "golden/depth has no run.json"),
        (["actual", "nowhere"], 1, "nowhere has nothing that run writes"),
        (["actual", "actual/../actual"], 1, "are the same folder"),
        (["actual", "golden", "--tolerance", "steer"], 2, "give COLUMN=VALUE"),
        (["actual", "golden", "--tolerance", "steer=-1"], 2, "give COLUMN=VALUE"),
        (["actual", "golden", "--tolerance", "steer=inf"], 2, "give COLUMN=VALUE"),
        (["actual", "golden", "--max-differing", "2"], 2, "--max-differing cannot be"),
        (["actual", "golden", "--junit", "nowhere/d.xml"], 1, "cannot write nowhere/d.xml"),
    ],
)
def test_the_command_fails_in_one_line(sides, tmp_path, args, code, words):
    done = called(*args, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (code, "")
    assert words in done.stderr
    assert done.stderr.splitlines()[-1].startswith("error: ")
    assert "Traceback" not in done.stderr


# The sample's own.


def test_the_golden_sample_is_small():
    golden = Path(__file__).parent.parent / "sample_data" / "golden"
    assert sum(path.stat().st_size for path in golden.rglob("*") if path.is_file()) < 1_500_000
