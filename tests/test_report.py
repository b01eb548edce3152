"""The report: what the page says is what the run wrote."""

import csv
import html
import itertools
import json
import re
import shlex
import shutil

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from motionstereo_cli.__main__ import main
from motionstereo_cli.report.run_page import _TICK_ROOM, _ticks, run_page
from motionstereo_cli.report.series import kept_rows, tracks
from motionstereo_cli.sinks.legend import time_text
from motionstereo_cli.sinks.scale import DepthScale
from motionstereo_cli.sinks.steering_table import HEADER
from motionstereo_cli.types import FrameTime

SAVED = "steering,depth,charge,depth-video,objects"
NASTY = "</script><script>alert(1)<b>&amp;"


@pytest.fixture(scope="session")
def recording(tmp_path_factory):
    """A small recording in a folder whose name would be markup."""
    scene = tmp_path_factory.mktemp("report") / NASTY.replace("/", "")
    size = ["--width", "96", "--height", "64", "--frames", "24"]
    assert main(["simulate", str(scene), "--scene", "cards", *size]) == 0
    return scene


@pytest.fixture(scope="session")
def run(recording):
    out = recording.parent / "out"
    views = [str(recording / f"{side}.mp4") for side in ("left", "right")]
    given = ["--rig", str(recording / "rig.yaml"), "--max-disparity", "24", "--save", SAVED]
    assert main(["run", *views, "-o", str(out), *given]) == 0
    return out


@pytest.fixture
def copy(run, tmp_path):
    return shutil.copytree(run, tmp_path / "copy")


def page_of(out):
    assert main(["report", str(out)]) == 0
    return (out / "report.html").read_text(encoding="utf-8")


def data_in(page):
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    return json.loads(found[1])


def rows_of(table):
    with table.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_the_plots_have_every_value_of_the_table(copy):
    data, rows = data_in(page_of(copy))["run"], rows_of(copy / "steering.csv")
    assert [data["statuses"][code] for code in data["status"]] == [row["status"] for row in rows]
    assert data["x"] == [float(row["time_s"]) for row in rows]
    for name, values in data["series"].items():
        assert values == [float(row[name]) if row[name] else None for row in rows]


def test_nothing_comes_from_elsewhere(copy):
    page = page_of(copy)
    assert re.findall(r'(?:src|href)="(?!data:|#)([^"]*)"', page)[1:] == ["charge.mp4", "depth.mp4"]
    # The recording lies elsewhere: it is not opened, whatever the record says.
    assert page.count('poster="data:image/jpeg;base64,') == 2


def test_names_are_text(copy):
    page = page_of(copy)
    assert page.count("<script") == 4
    assert "alert(1)<b>" not in page
    assert "alert(1)" in html.unescape(page)


def test_the_command_gives_the_same_again(copy, tmp_path):
    shown = re.search(r'<code id="command">(.*?)</code>', page_of(copy), re.DOTALL)[1]
    words = shlex.split(html.unescape(shown))
    assert words[0] == "motionstereo"
    assert main([*words[1:], "-o", str(tmp_path / "again")]) == 0
    table = (tmp_path / "again" / "steering.csv").read_bytes()
    assert table == (copy / "steering.csv").read_bytes()


def test_settings_and_troubles_are_in_words(copy):
    record = json.loads((copy / "run.json").read_text())
    record["damage"] = ["left.mp4: 3 images lost"]
    record["measured"] = ["near_m", "max_disparity"]
    (copy / "run.json").write_text(json.dumps(record))
    page = page_of(copy)
    assert "<li>left.mp4: 3 images lost.</li>" in page
    assert re.search(r"--max-disparity</code></td><td>24 px \(measured\)</td><td>64 px", page)
    assert "--near-m" not in page


def test_an_interrupted_run_is_shown_as_far_as_it_came(copy):
    record = json.loads((copy / "run.json").read_text())
    head = {name: record[name] for name in ("program", "outputs")}
    (copy / "run.json.part").write_text(json.dumps(head))
    (copy / "run.json").unlink()
    table = (copy / "steering.csv").read_bytes()
    rows = table.count(b"\n")
    (copy / "steering.csv.part").write_bytes(table[:-5])
    (copy / "steering.csv").unlink()
    (copy / "depth.mp4").rename(copy / "depth.0000.mp4.part")
    page = page_of(copy)
    assert "This run was ended" in page
    assert len(data_in(page)["run"]["x"]) == rows - 2
    assert page.count("data:image/jpeg") == 2
    assert "Run it again" not in page


def test_a_run_without_most_outputs_says_what_is_missing(copy):
    for name in ("steering.csv", "objects.csv", "charge.mp4", "depth.mp4"):
        (copy / name).unlink()
    shutil.rmtree(copy / "depth")
    page = page_of(copy)
    assert "There is no steering table" in page
    assert "No depth is known here" in page
    assert page.count("not saved") == 2
    assert data_in(page)["run"] == {}


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("12,z,40,20,12,12,4,,,0.5,,,,1,", "id of frame 12 is 'z' and no number"),
        ("12,7,40,20,12,12,4..1,,,0.5,,,,1,", "depth_m of frame 12 is '4..1' and no number"),
        ("12,7,40,20,12,12,4,,,0.5,q,,,1,", "over_ground_mps of frame 12 is 'q' and no number"),
    ],
)
def test_a_wrong_cell_of_objects_is_named(copy, capsys, row, said):
    header = (copy / "objects.csv").read_text().splitlines()[0]
    (copy / "objects.csv").write_text(f"{header}\n{row}\n")
    assert main(["report", str(copy)]) == 1
    assert f"objects.csv: {said}: write it again" in capsys.readouterr().err


@pytest.mark.parametrize("content", [None, b"[]", b"{", b'{"program": "other"}'])
def test_a_folder_that_no_run_wrote_is_one_line(tmp_path, capsys, content):
    if content:
        (tmp_path / "run.json").write_bytes(content)
    assert main(["report", str(tmp_path)]) == 1
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "report.html").exists()


def test_a_damaged_table_is_one_line(copy, capsys):
    text = (copy / "steering.csv").read_text()
    (copy / "steering.csv").write_text(text.replace(",ok,", ",ok,x", 1))
    assert main(["report", str(copy)]) == 1
    assert "steering" in capsys.readouterr().err


def test_only_a_report_is_replaced(copy, capsys):
    record = (copy / "run.json").read_bytes()
    assert main(["report", str(copy), "-o", str(copy / "run.json")]) == 1
    assert "is not a report" in capsys.readouterr().err
    assert (copy / "run.json").read_bytes() == record


def test_ten_minutes_stay_under_three_megabytes(copy):
    count = 18_000
    numbers = np.random.default_rng(0).random((count, HEADER.count(",") - 3))
    with (copy / "steering.csv").open("w") as file:
        file.write(HEADER + "\n")
        for index, row in enumerate(numbers):
            values = ",".join(f"{value:.4f}" for value in row)
            file.write(f"{index},{index * 512},{index / 30:.6f},ok,{values}\n")
    page = page_of(copy)
    assert len(page.encode()) < 3_000_000
    assert len(data_in(page)["run"]["x"]) == count


@given(st.integers(0, 2**32), st.integers(40, 300), st.floats(0, 1))
def test_thinned_rows_keep_every_extreme_and_every_status(seed, count, unknown):
    random = np.random.default_rng(seed)
    series = random.normal(size=(2, count))
    series[random.random((2, count)) < unknown] = np.nan
    codes = random.integers(0, 3, count)
    kept = kept_rows(series, codes, most=36)
    assert len(kept) <= 36 + 2
    assert (np.diff(kept) > 0).all()
    assert set(codes[kept]) == set(codes)
    for each in series:
        if not np.isnan(each).all():
            assert np.nanmin(each[kept]) == np.nanmin(each)
            assert np.nanmax(each[kept]) == np.nanmax(each)
        assert np.isnan(each[kept]).any() == np.isnan(each).any()


def test_objects_are_bars_by_their_time_to_contact():
    contacts = {0: "9", 1: "4", 2: "1.5", 4: ""}
    rows = [
        {"id": "7", "frame": str(frame), "time_to_contact_s": text, "depth_m": "2",
         "closing_mps": ""}
        for frame, text in contacts.items()
    ]  # fmt: skip
    shown, total, brief = tracks(
        [*rows, {**rows[0], "id": "8"}], {frame: frame / 10 for frame in range(5)}, 0.1
    )
    assert (total, brief) == (1, 1)
    assert [span[2] for span in shown[0]["spans"]] == [2, 1, 0, 2]
    assert shown[0]["spans"][2][:2] == pytest.approx([0.2, 0.3])
    assert (shown[0]["contact"], shown[0]["nearest"], shown[0]["closing"]) == (1.5, 2.0, None)
    assert (shown[0]["contact_frame"], shown[0]["nearest_frame"]) == (2, 0)


@pytest.mark.parametrize(("by_itself", "told"), [("", True), ("0", False), ("1", False)])
def test_the_page_says_where_the_rigs_own_motion_is_unknown(copy, by_itself, told):
    header = (copy / "objects.csv").read_text().splitlines()[0]
    rows = [f"{n},7,40,20,12,12,4.000,,,0.50,,,,{by_itself}," for n in range(12, 20)]
    (copy / "objects.csv").write_text("\n".join([header, *rows]) + "\n")
    page = run_page(copy, copy / "report.html")
    assert (
        "The rig's own motion is unknown: if the camera moves" in " ".join(page.split())
    ) == told


def test_the_page_has_the_greatest_speed_over_ground_with_sigma_and_direction(copy):
    header = (copy / "objects.csv").read_text().splitlines()[0]
    speeds = {n: f"{n - 8}.0,{0.1 * n:.1f},0.25" for n in range(12, 20)}
    rows = [f"{n},7,40,20,12,12,4.000,,,0.50,{each},1,0" for n, each in speeds.items()]
    (copy / "objects.csv").write_text("\n".join([header, *rows]) + "\n")
    page = run_page(copy, copy / "report.html")
    assert "<td>11.00 ± 0.25</td>" in page
    assert "in direction, ° to the left" in page
    assert "<td>109</td>" in page  # 1.9 rad


def test_the_page_says_why_speeds_are_unknown_without_times(copy):
    path = copy / "objects.csv"
    header = path.read_text().splitlines()[0]
    rows = [f"{n},7,40,20,12,12,4.000,,,0.50,,,,," for n in range(12, 20)]
    path.write_text("\n".join([header, *rows]) + "\n")
    table = rows_of(copy / "steering.csv")
    lines = [",".join(table[0]), *(",".join((row | {"time_s": ""}).values()) for row in table)]
    (copy / "steering.csv").write_text("\n".join(lines) + "\n")
    page = " ".join(run_page(copy, copy / "report.html").split())
    assert "speeds are unknown, give <code>--frame-rate</code>" in page
    assert "own motion is unknown" not in page


def test_the_histogram_counts_known_pixels(copy):
    import cv2

    for path in (copy / "depth").iterdir():
        cv2.imwrite(str(path), np.where(np.eye(64, 96) > 0, 1000, 0).astype(np.uint16))
    page = run_page(copy, copy / "report.html")
    median = float(re.search(r"Histogram of depth: median ([\d.]+) m", page)[1])
    assert median == pytest.approx(1, rel=0.05)
    assert page.count("100.0%</title>") == 1


def test_what_is_far_nearer_than_the_rest_is_not_piled_up_at_the_end(copy):
    import cv2

    depth_mm = np.full((64, 96), 2000, np.uint16)
    depth_mm[:, 48:], depth_mm[0, :40] = 4000, 10
    for path in (copy / "depth").iterdir():
        cv2.imwrite(str(path), depth_mm)
    page = run_page(copy, copy / "report.html")
    shares = [float(share) for share in re.findall(r"m: ([\d.]+)%</title>", page)]
    assert shares[0] == shares[-1] == 0
    assert sorted(shares)[-2:] == pytest.approx([49.3, 50], abs=0.1)
    assert "0.7 % lie beyond its ends" in page


BATCH = """\
name,status,frames,seconds,charged,matched,damage,warnings,said,reason,worker
../out,done,24,1.5,0.5,0.4,0,0,,,1
good,done,24,1.5,0.5,0.4,0,1,rows do not agree,,1
bad <i>,failed,,,,,0,0,,left.mp4: cannot be read,2
torn,damaged,20,1.0,0.5,0.25,1,0,left.mp4: 3 images lost,,1
gone,lost,3,,,,,,,,2
"""


@pytest.fixture
def batch(run, tmp_path):
    out = tmp_path / "batch"
    shutil.copytree(run, out / "good")
    shutil.copytree(run, tmp_path / "out")
    (out / "good" / "report.html").write_text("<p>")
    (out / "torn").mkdir()
    (out / "batch.csv").write_text(BATCH)
    (out / ".batch/logs/00").mkdir(parents=True)
    (out / ".batch/logs/00/torn.log").write_text("warning: 3 images lost\n")
    return out


def test_a_batch_has_a_row_for_each_recording_failures_first(batch):
    page = page_of(batch)
    found = re.findall(r'<tr data-status="(\w+)">(.*?)</tr>', page, re.DOTALL)
    assert [status for status, _ in found] == ["failed", "lost", "damaged", "done", "done"]
    failed, lost, torn, good, outside = (row for _, row in found)
    assert "bad &lt;i&gt;" in failed
    assert "left.mp4: cannot be read" in failed
    assert "<a" not in failed + lost + outside
    assert 'href="torn"' in torn
    assert 'left.mp4: 3 images lost <a href=".batch/logs/00/torn.log">log</a>' in torn
    assert '<td class="reason">rows do not agree</td>' in good
    assert '<td class="reason"></td>' in outside + lost
    assert 'href="good/report.html"' in good
    assert "data:image/jpeg" in good
    points = re.search(r'polyline points="([^"]*)"', good)[1].split()
    rows = rows_of(batch / "good" / "steering.csv")
    assert len(points) == sum(bool(row["steer"]) for row in rows)
    assert "3 of 5 not as they should be, 1 with warnings" in page


def test_a_batch_that_was_interrupted_says_that_the_same_command_goes_on(tmp_path):
    rows = "a,done\nb,interrupted\nc,waiting\nd,waiting\n"
    (tmp_path / "batch.csv").write_text("name,status\n" + rows)
    page = page_of(tmp_path)
    found = re.findall(r'<tr data-status="(\w+)">(.*?)</tr>', page, re.DOTALL)
    assert [status for status, _ in found] == ["interrupted", "waiting", "waiting", "done"]
    assert all(f'"dot {status}"' in row for status, row in found)
    assert "Not complete, 3 not finished" in page
    assert "not as they should be" not in page
    assert "3 of 4 recordings are not finished: the same" in page


@pytest.mark.parametrize("content", ["", "a,b\n1,2\n", "name\nx\n"])
def test_a_batch_table_of_another_kind_is_one_line(tmp_path, capsys, content):
    (tmp_path / "batch.csv").write_text(content)
    assert main(["report", str(tmp_path)]) == 1
    assert "has no columns name and status" in capsys.readouterr().err


def test_a_batch_with_few_columns_is_shown(tmp_path):
    (tmp_path / "batch.csv").write_text("name,status\nx,new kind\n")
    assert "new kind" in page_of(tmp_path)


# The page as an output of the run.


@pytest.fixture(scope="session")
def with_page(recording):
    out = recording.parent / "with page"
    views = [str(recording / f"{side}.mp4") for side in ("left", "right")]
    given = ["-o", str(out), "--rig", str(recording / "rig.yaml"), "--save", "report"]
    assert main(["run", *views, *given]) == 0
    return out


def test_a_run_writes_the_page_that_the_command_writes(with_page):
    page = (with_page / "report.html").read_text(encoding="utf-8")
    assert page_of(with_page) == page
    assert re.findall(r'<video src="([^"]*)"', page) == ["view.mp4", "charge.mp4", "depth.mp4"]
    assert data_in(page)["objects"] is not None
    assert "Histogram of depth" in page


def test_a_new_run_takes_the_page_of_the_old_one_away(copy, recording):
    page_of(copy)
    views = [str(recording / f"{side}.mp4") for side in ("left", "right")]
    again = ["run", *views, "-o", str(copy), "--save", "steering", "--overwrite"]
    assert main(again) == 0
    assert {path.name for path in copy.iterdir()} == {"run.json", "steering.csv"}


def test_a_page_of_somebody_else_stays(copy, recording, capsys):
    (copy / "report.html").write_text("mine")
    views = [str(recording / f"{side}.mp4") for side in ("left", "right")]
    assert main(["run", *views, "-o", str(copy), "--save", "report", "--overwrite"]) == 1
    assert "report.html is not from" in capsys.readouterr().err
    assert (copy / "report.html").read_text() == "mine"
    assert (copy / "run.json").exists()


def test_without_times_frames_are_counted(copy):
    text = (copy / "steering.csv").read_text()
    (copy / "steering.csv").write_text(re.sub(r"^(\d+,\d+),[\d.]+", r"\1,", text, flags=re.M))
    page = page_of(copy)
    data = data_in(page)["run"]
    assert not data["timed"]
    assert data["x"][5] / data["frameS"] == pytest.approx(5)
    assert "seen from frame" in page


def test_times_since_an_epoch_count_from_0_and_the_start_is_said_once(copy):
    before = page_of(copy)
    table = (copy / "steering.csv").read_text()
    moved = re.sub(
        r"^(\d+,\d+),([\d.]+)",
        lambda found: f"{found[1]},{float(found[2]) + 1_317_000_000:.6f}",
        table,
        flags=re.MULTILINE,
    )
    (copy / "steering.csv").write_text(moved)
    page = page_of(copy)
    one, other = (data_in(each)["run"]["x"] for each in (before, page))
    assert other == pytest.approx(one, abs=1e-6)
    assert page.count("begins 2011-09-26 01:20:00 UTC") == 1
    assert "begins 20" not in before
    assert "1317000" not in page


@pytest.mark.parametrize(
    ("time_s", "text"),
    [(None, "frame 7"), (3.456, "3.46 s"), (1_317_000_002.58, "01:20:02.58")],
)
def test_the_time_in_a_picture_is_short(time_s, text):
    assert time_text(FrameTime(7, 0, time_s)) == text


def test_without_a_rig_the_page_speaks_of_disparity_in_px(recording, tmp_path):
    views = [str(recording / f"{side}.mp4") for side in ("left", "right")]
    assert main(["run", *views, "-o", str(tmp_path / "o"), "--end", "8"]) == 0
    page = page_of(tmp_path / "o")
    assert "<b>Disparity, px</b>" in page
    assert "Scale of the disparity colours: " in page
    assert "How near things were, in px of disparity" in page
    assert "Disparity known" in page
    assert "Depth known" not in page
    assert "Histogram of disparity: median " in page
    assert "<b>Depth" not in page


def with_way(copy):
    """Give a run a path of 3 m to the left and then ahead, a map, and an object that moved."""
    record = json.loads((copy / "run.json").read_text())
    outputs = record["outputs"]
    outputs |= {"poses": outputs["steering"] | {"path": "poses.txt"}}
    outputs |= {"map": outputs["steering"] | {"path": "map.ply"}}
    (copy / "run.json").write_text(json.dumps(record))
    times = [row["time_s"] for row in rows_of(copy / "steering.csv")]
    lines = [
        f"{time} {max(n - 10, 0) * 0.1:.2f} {min(n, 10) * 0.2:.2f} 0 0 0 0 1"
        for n, time in enumerate(times)
        if n != 5
    ]
    (copy / "poses.txt").write_text("\n".join(["# TUM", *lines]) + "\n")
    rows = [f"{n},7,40,20,12,12,4.000,,,0.50,1.000,0.000,0.100,1," for n in (12, 13, 14)]
    header = (copy / "objects.csv").read_text().splitlines()[0]
    (copy / "objects.csv").write_text("\n".join([header, *rows]) + "\n")
    image = np.full((40, 20), 254, np.uint8)
    image[0, 0] = 0
    cv2.imwrite(str(copy / "map.png"), image)
    (copy / "map.yaml").write_text("image: map.png\nresolution: 0.1\norigin: [-1.0, -2.0, 0]\n")


def test_the_way_is_drawn_from_above_with_the_map_and_what_moved(copy):
    with_way(copy)
    page = page_of(copy)
    path, mover = (
        [tuple(map(float, each.split(","))) for each in found.split()]
        for found in (
            re.search(r'class="path" points="([^"]*)"', page)[1],
            re.search(r'class="mover" points="([^"]*)"', page)[1],
        )
    )
    assert len(path) == 23
    assert path[0] == (0, 0)
    assert path[-1] == pytest.approx((-2, -1.3))  # left is left, ahead is up
    # 4 m ahead of where the camera was.
    assert [y for _, y in mover] == pytest.approx([-4.2, -4.3, -4.4], abs=0.01)
    assert "3.3 m of path, its ends 2.4 m apart; in 1 frame the rig was lost" in page
    floor = re.search(r'<image [^>]*x="([^"]*)" y="([^"]*)" width="([^"]*)" height="([^"]*)"', page)
    assert [float(each) for each in floor.groups()] == pytest.approx([-2, -1, 4, 2])


def test_an_empty_map_is_said_to_be_empty(copy):
    with_way(copy)
    (copy / "poses.txt").unlink()
    assert "Map from above" in page_of(copy)
    cv2.imwrite(str(copy / "map.png"), np.full((3, 4), 205, np.uint8))
    page = page_of(copy)
    assert "The map is empty" in page
    assert "occupied</span>" not in page


@pytest.mark.parametrize("damage", ["poses.txt", "map.yaml", "map.png"])
def test_a_damaged_way_or_map_is_left_out(copy, damage):
    with_way(copy)
    (copy / damage).write_text("nonsense\n")
    page = page_of(copy)
    assert ('id="the-path"' in page) == (damage != "poses.txt")
    assert "<image " not in page


def test_the_page_names_strict_where_that_may_have_ended_the_run(run, tmp_path):
    for strict in (False, True):
        folder = tmp_path / f"{strict}"
        shutil.copytree(run, folder)
        said = json.loads((folder / "run.json").read_text())
        said["input_settings"]["strict"] = strict
        (folder / "run.json").unlink()
        del said["counts"]
        (folder / "run.json.part").write_text(json.dumps(said))
        page = run_page(folder, folder / "page.html")
        assert "<code>--resume</code>" in page
        assert ("<code>--strict</code>" in page) == strict


def test_what_moves_by_itself_is_said_of_each_object():
    rows = [
        {
            "id": "1",
            "frame": f"{n}",
            "time_to_contact_s": "",
            "depth_m": "2",
            "closing_mps": "",
            "by_itself": own,
            "over_ground_mps": speed,
            "confidence": sure,
            "shadow": shadow,
        }
        for n, (own, speed, sure, shadow) in enumerate(
            [
                ("", "", "0.2", ""),
                ("1", "0.2", "0.4", "1"),
                ("1", "1.4", "0.6", "0"),
                ("1", "1.2", "0.8", "0"),
            ]
        )
    ]
    [track] = tracks(rows, {n: n / 10 for n in range(4)}, 0.1).shown
    assert (track["own"], track["known"], track["frames"], track["speed"]) == (2, 3, 4, 1.4)
    assert track["shadow"] == 1
    assert track["confidence"] == pytest.approx(0.5)
    assert track["spans"] == [
        pytest.approx(span) for span in ([0, 0.1, 2, 0], [0.1, 0.2, 2, 2], [0.2, 0.4, 2, 1])
    ]


@given(near=st.floats(0.01, 50), ratio=st.floats(2, 1e4), px_m=st.sampled_from([None, 40.0]))
def test_ticks_of_a_scale_keep_apart_on_the_narrowest_screen(near, ratio, px_m):
    near_px = px_m / near if px_m else near * ratio
    ticks = _ticks(DepthScale(near_px, near_px / ratio, px_m, "plasma"))
    begins = [
        (place - len(text) * _TICK_ROOM * shift / 100, len(text) * _TICK_ROOM)
        for text, place, shift in ticks
    ]
    for (begin, wide), (following, _) in itertools.pairwise(begins):
        assert begin + wide < following
    assert ticks
