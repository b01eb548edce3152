"""The speed benchmark: everybody does the same work, and it reports what it promises."""

import json
import sys
import time

import av
import cv2
import pytest

from bench import speed
from bench.clips import first_frames, rendered, repeated
from bench.speed_report import format_markdown, goals
from bench.timing import Cost, Key, core_count, installed_mb, on_cores, python
from motionstereo_cli import pipeline
from motionstereo_cli.__main__ import main
from motionstereo_cli.robot.guide import ImageGuide
from motionstereo_cli.simulate.settings import SimulateSettings


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    settings = SimulateSettings(width=64, height=48, frames="250:254")
    return rendered(tmp_path_factory.mktemp("bench") / "clip", settings, back=True)


def test_a_clip_goes_there_and_back(clip):
    frames = clip.frames(100)
    assert len(frames) == clip.count == 6  # 0 1 2 3 2 1
    brightness = [frame.right.astype(float) for frame in frames]
    assert abs(brightness[1] - brightness[5]).mean() < abs(brightness[1] - brightness[3]).mean()


def test_a_clip_put_end_to_end_shows_the_same_again(clip, tmp_path):
    longer = repeated(clip, tmp_path / "longer", 3)
    once, frames = clip.frames(100), first_frames(*longer.paths, 100)
    assert len(frames) == longer.count == 18
    for index, frame in enumerate(frames):
        assert (frame.left == once[index % 6].left).all()
        assert (frame.right == once[index % 6].right).all()
        assert frame.time_s == pytest.approx(index / 30, abs=1e-4)


def test_the_clock_sees_the_steps_and_leaves_no_trace(clip):
    before = dict(vars(pipeline)), pipeline.see, ImageGuide.steer
    with speed.stage_clock() as seconds:
        assert sum(1 for _ in pipeline.process(clip.frames(100))) == 6
    assert (dict(vars(pipeline)), pipeline.see, ImageGuide.steer) == before
    for step in (
        "see",
        "match",
        "Tracker.follow",
        "ImageGuide.steer",
        "bands.blur",
        "trails.match_trails",
    ):
        assert seconds[step] > 0
    assert seconds["trails.match_trails"] < seconds["match"]


def test_a_child_is_timed_and_weighed():
    wait_s, array_mb = 0.2, 50
    ballast = b"1" * 200_000_000  # what this process holds is not the child's
    cost = python("-c", f"import time; x = b'1' * {array_mb}_000_000; time.sleep({wait_s})")
    assert len(ballast) > 1e6 * cost.peak_mb > 1e6 * array_mb
    assert cost.seconds > wait_s


def test_a_child_that_fails_is_no_measurement():
    with pytest.raises(RuntimeError, match="no such thing"):
        python("-c", "raise SystemExit('no such thing')")


@pytest.mark.skipif(sys.platform != "linux", reason="no other system has affinity")
def test_one_core_holds_for_children_too():
    before = core_count()
    with on_cores(1):
        assert core_count() == 1
        python("-c", "import os; assert len(os.sched_getaffinity(0)) == 1")
    assert core_count() == before


def test_the_script_writes_what_a_run_writes(clip, tmp_path):
    rig = clip.rig
    for matcher in ([], ["--sgbm", "--videos"]):
        given = *clip.paths, tmp_path, str(rig.focal_px), str(rig.baseline_m), *matcher
        python(speed.script.__file__, *given, "--disparities", "16")
        for index in range(clip.count):
            path = tmp_path / "depth" / f"{index:06d}.png"
            depth_mm = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            assert (depth_mm.dtype, depth_mm.shape) == ("uint16", (48, 64))
            path.unlink()
        assert len((tmp_path / "steering.csv").read_text().splitlines()) == 1 + clip.count
    for name in ("view", "depth"):
        with av.open(str(tmp_path / f"{name}.mp4")) as video:
            assert sum(1 for _ in video.decode(video=0)) == clip.count


SIZES = ((100, 100), (200, 200), (400, 400))
MEDIANS = {
    Key("matching", "corridor, 64 px", "StereoBM", 1): Cost(0.020, cpu_s=0.010),
    Key("matching", "corridor, 64 px", "motionstereo, trails", 1): Cost(0.003, cpu_s=0.004),
    Key("matching", "corridor, 64 px", "StereoBM", 2): Cost(0.005),
    Key("matching", "corridor, 256 px", "motionstereo, trails", 1): Cost(0.005),
    Key("run", "20 frames", "script, StereoBM", 1): Cost(9.0),
    Key("run", "20 frames", "script, StereoBM", 2): Cost(6.0, cpu_s=10.0),
    Key("run", "20 frames", "--preset fast, default outputs", 2): Cost(4.0, 120.0, 6.0),
    # Four times the pixels, 4 ** 1.5 = 8 times the time.
    Key("growth", "100x100", "processing a frame", 1): Cost(0.001),
    Key("growth", "200x200", "processing a frame", 1): Cost(0.008),
    Key("growth", "400x400", "processing a frame", 1): Cost(0.064),
    Key("growth", "100 frames", "run", 2): Cost(1.0, 90.0),
    Key("growth", "500 frames", "run", 2): Cost(3.0, 100.0),
    Key("growth", "9000 frames", "run", 2): Cost(50.0, 104.0),
}


def test_goals_are_ratios_of_what_was_measured():
    found = {goal.what: goal for goal in goals(MEDIANS, SIZES, cores=2, installed_mb=300)}
    expected = {
        "trails, corridor, 64 px: to StereoBM": (0.4, False),
        "trails, corridor: 256 px to 64 px": (1.25, False),
        "--preset fast, default outputs: to the StereoBM script": (0.6, False),
        "--preset fast: processor time to cores times wall time": (0.75, False),
        "--preset fast: peak MB": (120, True),
        "processing: exponent of the growth with pixels": (1.5, False),
        "run: peak MB of 9000 frames to 500": (1.04, True),
        "installed size in MB": (300, True),
    }
    assert {what: goal.reached for what, goal in found.items()} == {
        what: reached for what, (_, reached) in expected.items()
    }
    for what, (got, _) in expected.items():
        assert found[what].got == pytest.approx(got)


def test_tables_show_ratios_to_the_first_contestant():
    lines = format_markdown(MEDIANS, {"matching": "x", "run": "y"}, []).splitlines()
    heads = "ms, 1 core | processor ms | first = 1 | ms, 2 cores | processor ms | first = 1"
    assert f"| case | contestant | {heads} |" in lines
    assert "| corridor, 64 px | motionstereo, trails | 3 | 4 | 0.4 |  |  |  |" in lines
    ours = "| 20 frames | --preset fast, default outputs |"
    assert f"{ours}  |  |  | 4000 | 6000 | 0.6 | 120 |" in lines


def test_an_installation_is_as_large_as_all_that_it_needs():
    sizes = installed_mb("motionstereo")
    assert {"numpy", "av"} <= sizes.keys()
    assert 10 < sizes["numpy"] < sum(sizes.values())
    assert 0.1 < sizes["motionstereo"] < 100


@pytest.fixture
def ours_within(monkeypatch):
    """Lets our own commands run in this process: a test has no time for their start-up."""

    def run(*arguments):
        if arguments[:2] != ("-m", "motionstereo_cli"):
            return python(*arguments)
        started_s = time.perf_counter()
        assert main([str(argument) for argument in arguments[2:]]) == 0
        return Cost(time.perf_counter() - started_s, 100.0, 1.0)

    monkeypatch.setattr(speed, "python", run)


def test_the_bench_runs_and_reports(tmp_path, capsys, ours_within):
    parts = ["stages", "matching", "run", "growth"]
    speed.main(
        ["--quick", "--parts", ",".join(parts), "--json", str(tmp_path / "new" / "bench.json")]
    )
    printed = capsys.readouterr().out
    report = json.loads((tmp_path / "new" / "bench.json").read_text())
    rows = report["rows"]
    assert list(dict.fromkeys(row["part"] for row in rows)) == parts
    assert all(row["seconds"] > 0 and len(row["samples_s"]) == 1 for row in rows)
    assert all(row["peak_mb"] > 20 for row in rows if row["part"] == "run")
    by_case = {(row["case"], row["contestant"]) for row in rows}
    assert {("corridor, 96 px", "StereoSGBM"), ("cards panning, 64 px", "StereoBM")} <= by_case
    assert {("160x120", "processing a frame"), ("40 frames", "run")} <= by_case
    for row in rows:
        assert f"| {row['case']} | {row['contestant']} |" in printed
    assert {goal["what"] for goal in report["goals"]} >= {
        "trails, corridor, 64 px: to StereoBM",
        "--preset fast, steering: to decoding alone",
        "run: peak MB of 40 frames to 20",
    }
    assert all(f"| {goal['what']} |" in printed for goal in report["goals"])


@pytest.mark.parametrize(
    "wrong", [["--parts", "stages,nothing"], ["--rounds", "0"], ["--left", "left.mp4"]]
)
def test_wrong_use_is_said(wrong, capsys):
    with pytest.raises(SystemExit) as end:
        speed.main(wrong)
    assert end.value.code == 2
    assert f"error: {wrong[0]}" in capsys.readouterr().err


def test_a_recording_too_short_to_charge_is_said_and_the_rest_is_kept(tmp_path, clip, capsys):
    left, right = map(str, clip.paths)
    out = tmp_path / "bench.json"
    given = ["--quick", "--parts", "matching,stages", "--left", left, "--right", right]
    with pytest.raises(SystemExit, match=r"error: matching: .* more than 16 frames"):
        speed.main([*given, "--json", str(out)])
    assert {row["part"] for row in json.loads(out.read_text())["rows"]} == {"stages"}


def test_a_recording_that_cannot_be_read_is_said_in_one_line(tmp_path):
    missing = str(tmp_path / "missing.mp4")
    given = ["--quick", "--parts", "matching", "--left", missing, "--right", missing]
    with pytest.raises(SystemExit, match=r"error: matching: .*missing\.mp4"):
        speed.main([*given, "--json", str(tmp_path / "bench.json")])
