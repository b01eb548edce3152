"""Calibrations that lie in the folder of a recording of images."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from test_calibration import KITTI, SIZE, euroc_files

from motionstereo_cli import open_stereo, read_rig, rectify_source
from motionstereo_cli.__main__ import main
from motionstereo_cli.errors import InputError
from motionstereo_cli.rig.settings import NO_RIG

NUMBERS = "300 0 159 0 0 300 120 0 0 0 1 0\n300 0 159 -36 0 300 120 0 0 0 1 0\n"
STEREODEMO = {"width": 320, "height": 240, "fx": 300, "fy": 300, "cx0": 159, "cx1": 159, "cy": 120}


def images(folder: Path, left: str, right: str, count: int = 3) -> Path:
    for side in (left, right):
        (folder / side).mkdir(parents=True)
        for number in range(count):
            grey = np.full(SIZE[::-1], 40 * number, np.uint8)
            assert cv2.imwrite(str(folder / side / f"{number:06d}.png"), grey)
    return folder


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("calib.txt", NUMBERS),
        ("calib.txt", "P0: " + NUMBERS.splitlines()[0] + "\nP1: " + NUMBERS.splitlines()[1] + "\n"),
        ("K.txt", "300 0 159 0 300 120 0 0 1\n0.12\n"),
        ("stereodemo_calibration.json", json.dumps({**STEREODEMO, "baseline_meters": 0.12})),
    ],
)
@pytest.mark.parametrize("times", [False, True])
@pytest.mark.parametrize("sides", [("image_0", "image_1"), ("left", "right")])
def test_a_file_beside_the_images_is_found(
    tmp_path: Path, name: str, text: str, sides: tuple[str, str], times: bool
) -> None:
    images(tmp_path, *sides)
    if times:
        (tmp_path / "times.txt").write_text("0.0\n0.1\n0.2\n")
    (tmp_path / name).write_text(text)
    with open_stereo(tmp_path / sides[0], tmp_path / sides[1]) as source:
        found = rectify_source(source, [])
        assert found is not None
        assert found.rig.baseline_m == pytest.approx(0.12)
        assert found.found == (tmp_path / name,)
        assert f"the calibration is that of {tmp_path / name}" in found.notes[0]
        assert rectify_source(source, [NO_RIG]) is None
        given = rectify_source(source, [tmp_path / name])
        assert given is not None
        assert given.notes == ()


def test_sensors_of_euroc_are_found(tmp_path: Path) -> None:
    images(tmp_path, "mav0/cam0/data", "mav0/cam1/data")
    for file, camera in zip(euroc_files(tmp_path), ("cam0", "cam1"), strict=True):
        file.rename(tmp_path / "mav0" / camera / "sensor.yaml")
    with open_stereo(tmp_path) as source:
        found = rectify_source(source, [])
        assert found is not None
        assert found.kind == "EuRoC"
        assert found.maps is not None


def test_of_raw_kitti_that_of_the_day_is_found(tmp_path: Path) -> None:
    drive = images(tmp_path / "drive", "image_02/data", "image_03/data")
    rows = NUMBERS.splitlines()
    (tmp_path / "calib_cam_to_cam.txt").write_text(
        f"P_rect_02: {rows[0]}\nP_rect_03: {rows[1]}\nS_rect_02: 320 240\n"
    )
    with open_stereo(drive / "image_02/data", drive / "image_03/data") as source:
        found = rectify_source(source, [])
    assert found is not None
    assert found.rig.baseline_m == pytest.approx(0.12)


def test_a_file_that_does_not_fit_is_named_with_the_way_out(tmp_path: Path) -> None:
    images(tmp_path, "image_0", "image_1")
    (tmp_path / "calib.txt").write_text("P0: 1 2 3\nP1: 4\n")
    with (
        open_stereo(tmp_path) as source,
        pytest.raises(InputError, match=r"found beside the recording: give another .*--rig none"),
    ):
        rectify_source(source, [])


def test_nothing_is_found_beside_videos_and_without_files(tmp_path: Path) -> None:
    images(tmp_path, "left", "right")
    with open_stereo(tmp_path / "left", tmp_path / "right") as source:
        assert rectify_source(source, []) is None


def test_run_says_which_calibration_it_takes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    images(tmp_path / "in", "image_0", "image_1")
    (tmp_path / "in" / "calib.txt").write_text(NUMBERS)
    out = tmp_path / "out"
    assert main(["run", str(tmp_path / "in"), "--save", "depth", "-o", str(out)]) == 0
    assert "note: the calibration is that of" in capsys.readouterr().err
    record = json.loads((out / "run.json").read_text())
    assert record["rig"]["baseline_m"] == pytest.approx(0.12)
    assert any(each["path"].endswith("calib.txt") for each in record["files"])
    again = ["run", str(tmp_path / "in"), "--rig", "none", "--save", "depth", "--overwrite"]
    assert main([*again, "-o", str(out)]) == 0
    assert "depth in m needs --rig" in capsys.readouterr().err
    assert json.loads((out / "run.json").read_text())["rig"] is None


@pytest.mark.parametrize("text", [NUMBERS, KITTI, "cam0:\n  intrinsics: [1]\n"])
def test_read_rig_says_what_reads_other_formats(tmp_path: Path, text: str) -> None:
    path = tmp_path / "calib.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=r"no rig.yaml: rectify_source\(source, \[path\]\)"):
        read_rig(path)


def test_the_cameras_of_the_images_count_beside_a_table_of_times(tmp_path: Path) -> None:
    images(tmp_path, "image_2", "image_3")
    (tmp_path / "times.txt").write_text("0.0\n0.1\n0.2\n")
    rows = [f"300 0 159 {shift} 0 300 120 0 0 0 1 0" for shift in (0, -36, 0, -90)]
    text = "".join(f"P{number}: {row}\n" for number, row in enumerate(rows))
    (tmp_path / "calib.txt").write_text(text)
    with open_stereo(tmp_path / "image_2", tmp_path / "image_3") as source:
        found = rectify_source(source, [tmp_path / "calib.txt"])
        assert found is not None
        assert found.rig.baseline_m == pytest.approx(0.3)


def test_empty_folders_with_times_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for side in ("image_0", "image_1"):
        (tmp_path / side).mkdir()
    (tmp_path / "times.txt").write_text("0.0\n")
    assert main(["info", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert "internal" not in said
    assert len(said.splitlines()) == 1
