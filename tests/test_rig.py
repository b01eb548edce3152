import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motionstereo_cli.errors import InputError
from motionstereo_cli.rig import format_rig, read_rig, write_rig
from motionstereo_cli.types import Rig

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
