"""Records: what is written is read back, and what is damaged is one line that names the field."""

import json
import shutil
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motionstereo_cli.__main__ import main
from motionstereo_cli.batch.own_folder import read_status, status_path, write_status
from motionstereo_cli.errors import InputError
from motionstereo_cli.files.records import builtins_of, encode, parse_json, read_json, typed
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.simulate.write import simulate
from motionstereo_cli.sinks.records import RunRecord, Status

#: Changes of a record, and what the message names.
DAMAGES = {
    'r["inputs"]["left"] = None': "inputs",
    'r["inputs"]["left"]["frame_rate"] = "0/0"': "frame_rate",
    'r["inputs"]["left"]["width"] = 1e999': "not JSON",
    'del r["inputs"]["right"]["path"]': "path",
    'r["rig"]["baseline_m"] = -1': "rig.baseline_m",
    'r["rig"]["baseline_m"] = None': "rig.baseline_m",
    'r["rig"]["height"] = 0': "rig.height",
    'r["rig"] = {"f": 1}': "rig",
    'r["warnings"] = 3': "warnings",
    'r["damage"] = 3': "damage",
    'r["options"] = [1]': "options[0]",
    'r["shares"]["charged"] = "x"': "shares.charged",
    'r["shares"]["charged"] = 1.5': "shares.charged",
    'r["outputs"] = 3': "outputs",
    'r["outputs"]["depth"] = 1': "outputs",
    'r["settings"]["reference"] = [1]': "settings",
    'r["settings"]["reference"] = "up"': "settings.reference",
    'r["settings"]["bands"] = 1': "settings.bands",
    'r["output_settings"]["map_cell_m"] = "x"': "output_settings.map_cell_m",
    'r["input_settings"]["scale"] = -1': "input_settings.scale",
    'r["counts"]["written"] = "x"': "counts.written",
    'r["counts"]["written"] = 10**30': "counts.written",
    'r["counts"] = {}': "counts",
    'r["sums"] = [1]': "sums",
    'r["sums"]["zz"] = {}': "sums",
    'r["time_base"] = "1/0"': "time_base",
    'r["grey"] = "\\ud800"': "not JSON",
    'r["format_version"] = 2': "format_version 2",
}


@pytest.fixture(scope="module")
def complete(tmp_path_factory):
    """A recording, and the folder of a complete run."""
    folder = tmp_path_factory.mktemp("complete")
    simulate(folder / "s", SimulateSettings(width=64, height=48, frames="250:254"))
    assert main(["run", *args_of(folder), "-o", str(folder / "g"), "--no-check"]) == 0
    return folder


def args_of(folder):
    views = [str(folder / f"s/{side}.mp4") for side in ("left", "right")]
    rig = str(folder / "s/rig.yaml")
    return [*views, "--rig", rig, "--max-disparity", "16", "--save", "steering,depth"]


def damaged(complete, change, out):
    shutil.copytree(complete / "g", out)
    record = json.loads((out / "run.json").read_text())
    exec(change, {"r": record})
    (out / "run.json").write_text(json.dumps(record))


def test_a_record_says_what_it_said(complete):
    path = complete / "g/run.json"
    record = typed(read_json(path), RunRecord, path)
    assert encode(record) == path.read_bytes()
    assert builtins_of(record) == json.loads(path.read_bytes())
    assert record.camera.width == 64


@pytest.mark.parametrize(("change", "named"), DAMAGES.items(), ids=DAMAGES)
def test_a_damaged_record_is_one_line_that_names_the_field(
    complete, tmp_path, capsys, change, named
):
    out = tmp_path / "w"
    damaged(complete, change, out)
    assert main(["report", str(out), "-o", str(tmp_path / "r.html")]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert f"{out / 'run.json'} " in said
    assert named in said
    assert "internal" not in said


@pytest.mark.parametrize("change", [*DAMAGES, 'del r["shares"]', 'del r["counts"]', "r.clear()"])
@pytest.mark.parametrize("command", ["resume", "overwrite", "compare", "evaluate"])
def test_no_command_fails_with_an_internal_error(complete, tmp_path, capsys, change, command):
    out = tmp_path / "w"
    damaged(complete, change, out)
    args = {
        "resume": ["run", *args_of(complete), "--no-check", "-o", str(out), "--resume"],
        "overwrite": ["run", *args_of(complete), "--no-check", "-o", str(out), "--overwrite"],
        "compare": ["compare", str(out), str(complete / "g")],
        "evaluate": ["evaluate", str(out), str(complete / "g")],
    }[command]
    main(args)
    said = capsys.readouterr().err
    assert "internal" not in said
    assert "Traceback" not in said


def test_as_many_frames_as_a_record_says_are_not_looked_for(complete, tmp_path, capsys):
    out = tmp_path / "w"
    damaged(complete, 'r["counts"]["written"] = 10**9', out)
    again = ["run", *args_of(complete), "--no-check", "-o", str(out), "--resume"]
    assert main(again) == 1
    assert "is no longer what the run wrote" in capsys.readouterr().err


def test_fields_of_later_versions_are_skipped(complete, tmp_path):
    out = tmp_path / "w"
    damaged(complete, 'r["new"] = r["rig"]["new"] = r["settings"]["new"] = 1', out)
    assert main(["report", str(out), "-o", str(tmp_path / "r.html")]) == 0


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    ),
    st.sampled_from(RunRecord.__struct_fields__),
)
def test_any_value_in_any_field_is_read_or_one_line(value, name):
    content = json.dumps({name: value}).encode()
    try:
        found = typed(parse_json(content, "it"), RunRecord, "it")
    except InputError as error:
        message = str(error)
    else:
        message = "it is good"
        assert typed(builtins_of(found), RunRecord, "it") == found
    assert message.startswith("it ")
    assert "\n" not in message


@pytest.mark.parametrize(
    "content", [b"", b"[", b"[]", b"null", b"[" * 5000, b"\xff", b'{"program": 1e999}', b"NaN"]
)
def test_what_is_no_record_is_one_line(content):
    with pytest.raises(InputError, match=r"^it (cannot be read|is damaged)"):
        typed(parse_json(content, "it"), RunRecord, "it")


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"seconds": "y"}, "seconds"),
        ({"frames": -1}, "frames"),
        ({"charged": 2}, "charged"),
        ({"reason": "\ud800"}, "not JSON"),
        ({"plan": None}, "plan"),
    ],
)
def test_a_damaged_status_is_told_and_counts_as_waiting(tmp_path, change, named):
    write_status(tmp_path, Status("a", "done", 3, 1.0))
    path = status_path(tmp_path, "a")
    said = []
    assert read_status(tmp_path, "a", lambda *line: said.append(line)).status == "done"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    assert read_status(tmp_path, "a", lambda *line: said.append(line)) == Status("a")
    [(kind, text)] = said
    assert kind == "warning"
    assert str(path) in text
    assert named in text


def test_a_name_that_is_too_long_ends_no_batch(tmp_path):
    assert read_status(tmp_path, "n" * 300) == Status("n" * 300)


@pytest.mark.parametrize(
    "row", ["a,done,inf,1", "a,done,1,nan", "a\0b,done,1,1", "a,done,x,1", ",done,1,1"]
)
def test_a_damaged_row_of_a_batch_is_one_line(tmp_path, capsys, row):
    table = Path(tmp_path, "batch.csv")
    table.write_text(f"name,status,frames,seconds\n{row}\n")
    assert main(["report", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert f"{table} row 2" in said
