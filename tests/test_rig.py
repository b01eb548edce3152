import math
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from motionstereo_cli.errors import InputError
from motionstereo_cli.rig import format_rig, read_rig, write_rig
from motionstereo_cli.robot.guide import view_of
from motionstereo_cli.robot.local_map import profile
from motionstereo_cli.robot.points import points
from motionstereo_cli.types import Pose, Rig

VALUES = {
    "width": "640",
    "height": "400",
    "focal_px": "478.6872",
    "baseline_m": "0.073808",
    "cx": "322.6715",
    "cy": "202.6716",
}


def rig_file(folder: Path, **changes: str | None) -> Path:
    """A rig file with some values replaced, or left out where None."""
    path = folder / "rig.yaml"
    values = {key: value for key, value in {**VALUES, **changes}.items() if value is not None}
    path.write_text("".join(f"{key}: {value}\n" for key, value in values.items()))
    return path


def test_plain_file(tmp_path: Path) -> None:
    expected = Rig(640, 400, 478.6872, 0.073808, 322.6715, 202.6716, 0.0)
    assert read_rig(rig_file(tmp_path)) == expected


def test_optional_doffs(tmp_path: Path) -> None:
    assert read_rig(rig_file(tmp_path, doffs="-3.5")).doffs == -3.5


def test_what_opencv_writes_and_what_editors_add(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_bytes(
        b"\xef\xbb\xbf%YAML:1.0\r\n---\r\n# our rig\r\n\r\nwidth: 640 # px\r\nheight:400\r\n"
        b"focal_px: 5.e+02\r\nbaseline_m:\t0.1\r\ncx: 0.\r\ncy: -1\r\n...\r\n"
    )
    assert read_rig(path) == Rig(640, 400, 500.0, 0.1, 0.0, -1.0)


@pytest.mark.parametrize("key", VALUES)
def test_missing_key_is_named(tmp_path: Path, key: str) -> None:
    path = rig_file(tmp_path, **{key: None})
    with pytest.raises(InputError, match=re.escape(f"{path}: {key} is missing")):
        read_rig(path)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *[(key, bad) for key in [*VALUES, "doffs"] for bad in ("nan", "inf", "wide", "", "6,5")],
        *[
            (key, bad)
            for key in ("width", "height", "focal_px", "baseline_m")
            for bad in ["0", "-1"]
        ],
        ("width", "640.5"),
        ("height", "1e400"),
    ],
)
def test_senseless_value_is_named(tmp_path: Path, key: str, value: str) -> None:
    path = rig_file(tmp_path, **{key: value})
    with pytest.raises(InputError, match=re.escape(f"{path}: {key} cannot be {value!r}")):
        read_rig(path)


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("focus: 3", "unknown key 'focus'"),
        ("width: 641", "width is given twice"),
        ("width 640", "'width 640' is not a 'key: value' line"),
    ],
)
def test_stray_line_is_named(tmp_path: Path, line: str, complaint: str) -> None:
    path = rig_file(tmp_path)
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(InputError, match=re.escape(f"{path}: {complaint}")):
        read_rig(path)


@pytest.mark.parametrize("content", [b"", b"\xff\xfe\x00\x01" * 99], ids=["empty", "binary"])
def test_not_a_rig(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "rig.yaml"
    path.write_bytes(content)
    with pytest.raises(InputError, match=re.escape(str(path))):
        read_rig(path)


def test_unreadable_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"cannot read the rig .*No such file"):
        read_rig(tmp_path / "none.yaml")
    with pytest.raises(InputError, match="cannot read the rig"):
        read_rig(tmp_path)


finite = st.floats(allow_nan=False, allow_infinity=False)
positive = st.floats(min_value=0, exclude_min=True, allow_infinity=False)
sizes = st.integers(1, 100_000)


@given(rig=st.builds(Rig, sizes, sizes, positive, positive, finite, finite, finite))
def test_written_rig_reads_back_exactly(tmp_path_factory: pytest.TempPathFactory, rig: Rig) -> None:
    path = tmp_path_factory.getbasetemp() / "rig.yaml"
    write_rig(path, rig)
    assert path.read_text() == format_rig(rig)
    assert read_rig(path) == rig


# Geometry.

RIG = Rig(640, 480, 500.0, 0.2, 310.0, 240.0, -3.5, focal_y_px=550.0)


def test_disparity_and_depth_are_inverse() -> None:
    assert RIG.nearness_px(23.5) == 20
    assert RIG.depth_m(23.5) == 500 * 0.2 / 20
    assert RIG.disparity_px(RIG.depth_m(23.5)) == pytest.approx(23.5)
    disparity = np.array([4.5, 23.5, np.nan], np.float32)
    depth = RIG.depth_m(disparity)
    assert depth.dtype == RIG.disparity_px(depth).dtype == np.float32
    np.testing.assert_array_equal(depth, [100, 5, np.nan])


def test_cameras_stand_left_and_right_of_the_middle() -> None:
    north = Pose(1.0, 2.0, 0.5, 0.0, 0.0, math.sin(math.pi / 4), math.cos(math.pi / 4))
    assert RIG.camera_on_floor(north, "left") == pytest.approx((0.9, 2.0))
    assert RIG.camera_on_floor(north, "right") == pytest.approx((1.1, 2.0))
    assert RIG.left_of_middle_m("right") == -RIG.left_of_middle_m("left") == -0.1


def test_points_and_heights_use_the_focal_length_along_y() -> None:
    depth_m = np.full((1, 1), 11.0, np.float32)
    found = points(
        depth_m, depth_m > 0, focal_px=(RIG.focal_px, RIG.fy_px), cx_px=-50.0, cy_px=-50.0
    )
    np.testing.assert_allclose(found, [[50 * 11 / 500, 50 * 11 / 550, 11]])
    # 11 m ahead, 60 rows up: 1.2 m with fy, 1.32 m with fx.
    near = np.full((480, 640), np.nan, np.float32)
    near[180, :] = RIG.focal_baseline / 11
    view = view_of(RIG, "left", (0.0, 0.0), 0.0)
    for above_m, seen in ((1.25, True), (1.15, False)):
        found = profile(
            near, ~np.isnan(near), view, bearings=8, below_m=1.0, above_m=above_m
        ).near_px
        assert np.isfinite(found).any() == seen
