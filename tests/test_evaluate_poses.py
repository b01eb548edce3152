"""Poses against the truth: numbers worked out by hand."""

import json

import cv2
import numpy as np
import pytest

from motionstereo_cli.__main__ import main
from motionstereo_cli.evaluation.poses import compare


def circle(count=200, radius_m=20.0):
    """Poses (n, 4, 4) along a part of a circle, ahead along x."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for number, angle in enumerate(np.linspace(0, 3, count)):
        poses[number, :3, :3] = cv2.Rodrigues(np.array([0, 0, angle]))[0]
        poses[number, :2, 3] = radius_m * np.sin(angle), radius_m * (1 - np.cos(angle))
    return poses


def test_the_same_path_elsewhere_is_no_error():
    true = circle()
    moved = np.eye(4)
    moved[:3, :3], moved[:3, 3] = cv2.Rodrigues(np.array([0.1, -0.2, 1.0]))[0], (3, -4, 5)
    report = compare(moved @ true, true)
    assert report.poses == 200
    assert report.way_m == pytest.approx(60, rel=1e-3)
    for value in (report.drift_percent, report.ate_m, report.step_m, report.end_m):
        assert value == pytest.approx(0, abs=1e-9)
    assert report.drift_deg_per_m == pytest.approx(0, abs=1e-5)


def test_a_path_that_is_two_percent_too_long_drifts_by_two_percent():
    true = np.tile(np.eye(4), (301, 1, 1))
    true[:, 0, 3] = np.arange(301) * 0.5
    found = true.copy()
    found[:, 0, 3] *= 1.02
    report = compare(found, true)
    assert report.drift_percent == pytest.approx(2, rel=1e-6)
    assert report.step_m == pytest.approx(0.01)
    assert report.end_m == pytest.approx(3)
    # Of an even error along a line of 150 m: 3 m over the square root of 12.
    assert report.ate_m == pytest.approx(3 / np.sqrt(12), rel=0.01)


def test_drift_can_leave_out_where_the_rig_is_lost():
    true = np.tile(np.eye(4), (301, 1, 1))
    true[:, 0, 3] = np.arange(301) * 0.5
    found, lost = true.copy(), np.zeros(301, bool)
    found[100:, 1, 3] += 2
    assert compare(found, true, lost).drift_percent > 1
    lost[100] = True
    assert compare(found, true, lost).drift_percent == pytest.approx(0, abs=1e-9)


def test_a_turn_that_is_too_small_is_told_per_metre():
    true = np.tile(np.eye(4), (101, 1, 1))
    true[:, 0, 3] = np.arange(101) * 0.2
    found = true.copy()
    for number in range(101):
        found[number, :3, :3] = cv2.Rodrigues(np.array([0, 0, np.radians(0.01 * number)]))[0]
    report = compare(found, true)
    assert report.drift_deg_per_m == pytest.approx(0.05, rel=1e-2)
    assert report.step_deg == pytest.approx(0.01, rel=1e-3)


@pytest.mark.parametrize("form", ["tum", "kitti"])
def test_the_command_compares_files(tmp_path, capsys, form):
    for name, scale in (("found", 1.01), ("true", 1.0)):
        rows = []
        for number in range(60):
            x = number * 0.2 * scale
            tum = f"{number / 10} {x} 0 0 0 0 0 1"
            rows.append(tum if form == "tum" else f"1 0 0 {x} 0 1 0 0 0 0 1 0")
        (tmp_path / f"{name}.txt").write_text("\n".join(rows) + "\n")
    files = [str(tmp_path / f"{name}.txt") for name in ("found", "true")]
    assert main(["evaluate", *files, "--json", "-"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["poses"] == 60
    assert report["drift_percent"] == pytest.approx(1, rel=1e-3)
    assert main(["evaluate", *files]) == 0
    assert "drift_percent" in capsys.readouterr().out
    assert main(["evaluate", *files, "--csv", "-"]) == 0
    head, row = capsys.readouterr().out.splitlines()
    assert dict(zip(head.split(","), row.split(","), strict=True))["poses"] == "60"


def test_poses_without_truth_are_counted_and_said(tmp_path, capsys):
    for name, count in (("found", 9), ("true", 5)):
        rows = [f"{number} {number} 0 0 0 0 0 1\n" for number in range(count)]
        (tmp_path / f"{name}.txt").write_text("".join(rows))
    files = [str(tmp_path / f"{name}.txt") for name in ("found", "true")]
    assert main(["evaluate", *files, "--json", "-"]) == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["without_truth"] == 4
    assert "4 poses of OUT have no true one" in said.err


def test_what_is_unknown_is_a_dash_and_says_why(tmp_path, capsys):
    path = tmp_path / "short.txt"
    path.write_text("".join(f"{n} {n / 10} 0 0 0 0 0 1\n" for n in range(5)))
    assert main(["evaluate", str(path), str(path)]) == 0
    said = capsys.readouterr()
    assert "nan" not in said.out
    assert ["drift_percent", "-"] in [line.split() for line in said.out.splitlines()]
    assert "drift_percent, drift_deg_per_m: unknown, as the true path is shorter" in said.err


def test_poses_of_another_time_are_said(tmp_path, capsys):
    for name, start in (("found", 0), ("true", 100)):
        rows = [f"{start + number} {number} 0 0 0 0 0 1\n" for number in range(5)]
        (tmp_path / f"{name}.txt").write_text("".join(rows))
    assert main(["evaluate", str(tmp_path / "found.txt"), str(tmp_path / "true.txt")]) == 1
    assert "fewer than two poses" in capsys.readouterr().err
