"""evaluate of objects, against what is known by construction."""

import dataclasses
import json
import math

import pytest

from motionstereo_cli.__main__ import main
from motionstereo_cli.errors import InputError
from motionstereo_cli.evaluation.objects import ObjectBox, compare, evaluate_objects, read_objects
from motionstereo_cli.evaluation.settings import EvaluateSettings
from motionstereo_cli.sinks.objects_table import HEADER


def box(frame, name="1", left=10.0, **others):
    return ObjectBox(frame, name, left, 20.0, left + 40, 60.0, **others)


def test_a_file_is_all_of_itself():
    boxes = [box(n, depth_m=5.0, closing_mps=1.0, over_ground_mps=2.0) for n in range(10)]
    report = compare(boxes, boxes)
    assert (report.found, report.false_rows, report.switches) == (1, 0, 0)
    assert (report.mota, report.motp) == (1, 1)
    assert (report.depth_error, report.closing_error_mps, report.over_ground_error_mps) == (0, 0, 0)
    assert math.isnan(report.contact_error)


def test_what_stands_in_the_truth_is_not_judged(tmp_path):
    rows = {n: f"{n},1,10,20,40,40,2.0,,,1.00,1.0,,,{int(n != 2)},\n" for n in range(4)}
    truth, found = tmp_path / "truth.csv", tmp_path / "found.csv"
    truth.write_text(f"{HEADER}\n{''.join(rows.values())}")
    for kept in ((0, 1, 2, 3), (0, 1, 3)):
        found.write_text(f"{HEADER}\n{''.join(rows[n] for n in kept)}")
        report = evaluate_objects(found, truth)
        assert (report.true_boxes, report.found, report.false_rows) == (3, 1, 0)


def test_misses_false_rows_and_switches_are_counted():
    true = [box(n) for n in range(10)]
    # Another id from frame 4 on, nothing in frame 7, a row elsewhere in frame 8.
    found = [box(n, "a" if n < 4 else "b") for n in range(10) if n != 7] + [box(8, "c", 300.0)]
    report = compare(found, true)
    assert report.true_boxes == 10
    assert report.found == pytest.approx(0.9)
    assert (report.false_rows, report.switches) == (1, 1)
    assert report.false_rows_a_frame == pytest.approx(0.1)
    assert report.mota == pytest.approx(1 - 3 / 10)


def test_an_object_keeps_its_row_where_another_overlaps_more():
    true = [box(0), box(1)]
    found = [box(0, "mine"), box(1, "mine", 14.0), box(1, "other", 11.0)]
    report = compare(found, true)
    assert (report.switches, report.false_rows) == (0, 1)


def test_two_objects_and_two_rows_are_paired_as_all_together_overlap_most():
    true = [box(0, "1", 0.0), box(0, "2", 20.0)]
    found = [box(0, "a", 12.0), box(0, "b", 30.0)]
    assert compare(found, true, EvaluateSettings(min_overlap=0.1)).found == 1


def test_errors_of_speed_are_medians_of_what_both_sides_know():
    true = [box(n, closing_mps=2.0, over_ground_mps=3.0, depth_m=10.0) for n in range(3)]
    found = [
        box(0, closing_mps=2.5, over_ground_mps=3.4, depth_m=11.0),
        box(1, closing_mps=1.9, over_ground_mps=2.8, depth_m=10.0),
        box(2),
    ]
    report = compare(found, true)
    assert report.with_speed == 2
    assert report.closing_error_mps == pytest.approx(0.3)
    assert report.over_ground_error_mps == pytest.approx(0.3)
    assert report.depth_error == pytest.approx(0.05)


def test_small_boxes_and_rows_in_them_do_not_count():
    small = ObjectBox(0, "2", 100.0, 100.0, 110.0, 110.0)
    report = compare(
        [box(0), dataclasses.replace(small, id="b")],
        [box(0), small],
        EvaluateSettings(min_box_px=200),
    )
    assert (report.true_boxes, report.false_rows) == (1, 0)


@pytest.mark.parametrize(("least", "false_rows"), [(0, 0), (1000, 0), (3000, 0)])
def test_a_row_that_is_found_is_not_false_where_its_true_box_is_too_small(least, false_rows):
    # Of the row, 45 % lie in the box, which it overlaps by 45 %.
    true = ObjectBox(0, "1", 10.0, 20.0, 50.0, 38.0)
    report = compare(
        [box(0)], [true, box(0, "2", 300.0)], EvaluateSettings(min_box_px=least, min_overlap=0.4)
    )
    assert report.false_rows == false_rows


def test_where_nothing_moves_rows_are_false():
    report = compare([box(3)], [], None, 50)
    assert report.false_rows_a_frame == pytest.approx(0.02)
    assert math.isnan(report.found)
    assert math.isnan(report.mota)


LABEL = "{} {} Car 0 0 -1.5 {} 20 {} 60 1.5 1.6 4 0.1 1.5 {} 0"


def labels(path, count=5, extra=()):
    lines = [LABEL.format(n, 7, 10, 50, 20 - n) for n in range(count)]
    path.write_text("\n".join([*lines, *extra]) + "\n")
    return path


def test_kitti_labels_are_read_with_their_closing_speed(tmp_path):
    boxes = read_objects(labels(tmp_path / "0000.txt"), EvaluateSettings())
    assert [each.frame for each in boxes] == [0, 1, 2, 3, 4]
    assert {each.id for each in boxes} == {"7"}
    assert [each.depth_m for each in boxes] == [20, 19, 18, 17, 16]
    assert [each.closing_mps for each in boxes] == pytest.approx([10] * 5)
    assert boxes[0].time_to_contact_s == pytest.approx(2)


def test_rows_where_nothing_is_labelled_are_not_judged(tmp_path):
    places = ["0 -1 DontCare -1 -1 -10 300 0 600 400 -1 -1 -1 -1000 -1000 -1000 -10"]
    true = read_objects(labels(tmp_path / "0000.txt", extra=places), EvaluateSettings())
    report = compare([box(0), box(0, "2", 350.0), box(1, "2", 350.0)], true)
    assert report.true_boxes == 5
    assert report.false_rows == 1


@pytest.mark.parametrize("form", ["--json", "--csv", None])
def test_the_command_compares_a_table_with_labels(tmp_path, capsys, form):
    rows = [f"{n},3,10,20,40,40,{20.5 - n},,2.000,1.00,,,,,0" for n in range(1, 5)]
    rows += [f"{n},4,10,20,40,40,2.0,,2.000,1.00,,,,,1" for n in range(1, 5)]  # a shadow
    (tmp_path / "objects.csv").write_text("\n".join([HEADER, *rows]) + "\n")
    files = [str(tmp_path / "objects.csv"), str(labels(tmp_path / "0000.txt"))]
    assert main(["evaluate", *files, *([form, "-"] if form else [])]) == 0
    out = capsys.readouterr().out
    if form == "--json":
        report = json.loads(out)
        assert report["found"] == pytest.approx(0.8)
        assert report["false_rows"] == 0
        assert report["over_ground_error_mps"] is None
        assert 0.02 < report["depth_error"] < 0.04
    elif form == "--csv":
        head, row = out.splitlines()
        assert dict(zip(head.split(","), row.split(","), strict=True))["true_boxes"] == "5"
    else:
        assert "found" in out


def test_a_run_that_began_later_is_compared_from_there(tmp_path):
    (tmp_path / "objects.csv").write_text(f"{HEADER}\n0,3,10,20,40,40,17.0,,,1.00,,,,,0\n")
    record = {"input_settings": {"start": "3", "every": 2}, "counts": {"written": 1}}
    (tmp_path / "run.json").write_text(json.dumps(record))
    report = evaluate_objects(tmp_path / "objects.csv", labels(tmp_path / "0000.txt"))
    assert (report.true_boxes, report.found, report.frames) == (1, 1, 1)
    assert report.depth_error == 0


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("0 1 Car 0 0 -1 10 20 50 60 1 1 1 0 0 5 0\n1 1 Car nonsense\n", "line 2"),
        ("0 1 Car 0 0 -1 10 20 50 60 1 1 1 0 0 5 0\n" * 2, "comes twice"),
        ("frame,id,x,y,width,height\n0,1,5,5,x,4\n", "width"),
        ("frame,id,x,y,width,height\n0,1,5,5,0,4\n", "no box"),
        (f"{HEADER}\n{10**20},3,10,20,40,40,17.0,,,1.00,,,,,\n", "is no frame of a recording"),
        (f"{HEADER}\n0,3,10,20,1e30,40,17.0,,,1.00,,,,,\n", "no box"),
        (f"{HEADER}\n0,3,10,20,40,40,-4,,,1.00,,,,,\n", "depth_m is -4: give 0 or more"),
        (f"{HEADER}\n0,3,10,20,40,40,nan,,,1.00,,,,,\n", "depth_m is 'nan': give a number"),
        (f"{HEADER}\n0,3,10,20,40,40,17.0,inf,,1.00,,,,,\n", "closing_mps is 'inf': give a number"),
        (f"{HEADER}\n0,3,10,20,40,40,17.0,,,1.00,,,,7,\n", "by_itself is '7': give 0, 1, or"),
        (f"{HEADER}\n0,3,10,20,40,40,17.0,,,1.00,,,,,yes\n", "shadow is 'yes': give 0, 1,"),
        (f"{HEADER}\n0,3,10,20,40,40,17.0,,,1.00,,,,,-0.5\n", "frame 0: shadow is '-0.5'"),
        (f"{HEADER}\n-1,3,10,20,40,40,17.0,,,1.00,,,,,0\n", "-1 is no frame"),
        ("something else\n", "has no objects: give"),
        ("", "has no objects: give"),
        ("frame,id,x,y,depth_m\n0,1,5,5,3\n", "has no objects, as it lacks width, height: give"),
        (f"{HEADER}\n", "neither file"),
    ],
)
def test_what_is_no_file_of_objects_is_said(tmp_path, capsys, content, said):
    good, bad = tmp_path / "good.csv", tmp_path / "bad.txt"
    good.write_text(f"{HEADER}\n" + ("" if "neither" in said else "0,1,1,1,5,5,,,,,,,,,\n"))
    bad.write_text(content)
    for sides in ((good, bad), (bad, good)):
        assert main(["evaluate", *map(str, sides)]) == 1
        assert said in capsys.readouterr().err


def test_an_unreadable_file_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="cannot read"):
        read_objects(tmp_path / "missing.csv", EvaluateSettings())
