"""Floor plans that a robot drives in: their files, what stands in them, and drives."""

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from bench import drive as bench
from motionstereo_cli.__main__ import main
from motionstereo_cli.commands import cli
from motionstereo_cli.errors import OutputError
from motionstereo_cli.robot.mapper import Floor
from motionstereo_cli.simulate.camera import EYE_HEIGHT_M, FloorPose, stereo_cameras
from motionstereo_cli.simulate.drive import drive
from motionstereo_cli.simulate.drive_plan import Plan, plan_sheet
from motionstereo_cli.simulate.drive_world import MAX_FORWARD_M, Command, PlanWorld, world_of
from motionstereo_cli.simulate.floor_plan import plan_names, prisms, read_plan
from motionstereo_cli.simulate.plan_scene import Outlines, PlanScene
from motionstereo_cli.simulate.settings import DriveSettings
from motionstereo_cli.simulate.truth import moving_objects

PLAN = """
about = "A room with one of each."

[robot]
start = [0, 0]
heading_deg = 20

[[walls]]
points = [[-3, -2], [4, -2], [4, 3], [-3, 3]]
closed = true

[[doors]]
at = [4, 0.4]
width_m = 1.2

[[boxes]]
at = [2, 0.5]
size = [0.8, 0.5]
height_m = 0.5
turned_deg = 25

[[boxes]]
at = [2.2, -0.8]
size = [0.5, 0.5]
bottom_m = 1.5
height_m = 1.7

[[poles]]
at = [[1.5, 1.4]]
diameter_m = 0.2
"""
SMALL = {"width": 64, "height": 48, "noise_sigma": 0}


def world(tmp_path, text=PLAN, **settings):
    path = tmp_path / "plan.toml"
    path.write_text(text)
    return world_of(DriveSettings(**{"world": str(path), **SMALL, **settings}))


@pytest.mark.parametrize("name", plan_names())
def test_plans_that_come_with_the_program_are_whole_and_told(name):
    one = PlanWorld(DriveSettings(world=name, **SMALL))
    assert one.ended is None
    assert one.nearest_pass_m > 0.1
    assert read_plan(name).about.endswith(".")
    docs = Path(bench.__file__).parents[2] / "motionstereo_cli" / "docs" / "robot.md"
    assert f"`{name}`" in docs.read_text(encoding="utf-8")


def test_the_plan_in_the_docs_is_one(tmp_path):
    docs = Path(bench.__file__).parents[2] / "motionstereo_cli" / "docs" / "robot.md"
    text = docs.read_text(encoding="utf-8").partition("```toml\n")[2].partition("```")[0]
    assert world(tmp_path, text).goal == (4.5, 0)


WRONG = [
    ("about", "abuot", "abuot is unknown (did you mean 'about'?)"),
    ("about", "name", "name is unknown: choose from about, robot, ceiling_m, walls, doors, boxes"),
    ("heading_deg", "colour", "robot.colour is unknown: choose from start, heading_deg, goal"),
    ("height_m = 0.5", 'height_m = "low"', "boxes[0].height_m: expected float, got str"),
    ("height_m = 0.5", "height_m = -1", "boxes[0].height_m: expected float >= 0.0"),
    ("height_m = 0.5", "height_m = nan", "boxes[0].height_m: nan is no place, length or angle"),
    ("start = [0, 0]", "start = [nan, 0]", "robot.start[0]: nan is no place"),
    ("heading_deg = 20", "heading_deg = -inf", "robot.heading_deg: -inf is no place"),
    ("height_m = 0.5", "height = 0.5", "boxes[0].height is unknown (did you mean 'height_m'?)"),
    ("height_m = 0.5", "paint = 'red'", "boxes[0].paint: invalid enum value 'red': choose from d"),
    ("1.5\nheight_m = 1.7", "4\nheight_m = 5", "boxes[1].bottom_m is not below the ceiling"),
    ("start = [0, 0]", "start = [-8, 0]", "robot.start -8,0 lies outside of all that stands: give"),
    (
        "heading_deg = 20",
        "goal = [50, 50]",
        "the goal 50,50 lies outside of all that stands: give x",
    ),
    ("bottom_m = 1.5", "bottom_m = 1.8", "boxes[1].bottom_m is not below its top"),
    ("at = [4, 0.4]", "at = [3, 0.4]", "doors[0].at: there is no wall"),
    ("width_m = 1.2", "width_m = 9", "doors[0].width_m: the wall at it is shorter"),
    (
        "start = [0, 0]",
        "start = [2, 0.5]",
        "robot.start: boxes[0] is nearer than the robot's radius",
    ),
    ("heading_deg = 20", "goal = [2, 0.5]", "the goal 2,0.5 lies in boxes[0]: give one that"),
    ("heading_deg = 20", "goal = [1, -2]", "the goal 1,-2 lies in walls[0]"),
    ("heading_deg = 20", "goal = [1.5, 1.4]", "the goal 1.5,1.4 lies in poles[0]"),
    ("heading_deg = 20", "goal = [0.3, 0]", "the goal 0.3,0 is within 0.5 m of the start: give"),
    ("start = [0, 0]", "start = [0, 0, 0]", "robot.start: expected array of length 2"),
    ("heading_deg = 20", "latency_frames = 1.5", "robot.latency_frames: expected int, got float"),
    ("[4, 3], [-3, 3]", "[4, 3], [4, 3]", "walls[0].points: two follow one another"),
    ("[robot]", "[robot", "cannot be read as TOML"),
    ("start = [0, 0]", "", "robot: object missing required field start"),
]


@pytest.mark.parametrize(("part", "other", "words"), WRONG, ids=[words for *_, words in WRONG])
def test_errors_of_a_plan_name_their_place_in_one_line(tmp_path, capsys, part, other, words):
    path = tmp_path / "plan.toml"
    assert part in PLAN
    path.write_text(PLAN.replace(part, other, 1))
    assert main(["drive", str(tmp_path / "out"), "--world", str(path)]) == 1
    told = capsys.readouterr().err.strip()
    assert words in told
    assert str(path) in told
    assert "\n" not in told
    assert not (tmp_path / "out").exists()


def test_a_plan_may_begin_with_a_byte_order_mark(tmp_path):
    path = tmp_path / "plan.toml"
    path.write_bytes(b"\xef\xbb\xbf" + PLAN.encode())
    assert read_plan(str(path)).about == "A room with one of each."


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty: give about, [robot] with start, and what stands"),
        (b"about = 'x'", "the plan: object missing required field robot"),
        (b"\xff\xfe", "cannot be read as TOML: it is not text in UTF-8"),
    ],
)
def test_a_file_that_is_no_plan_is_named(tmp_path, capsys, content, words):
    path = tmp_path / "plan.toml"
    path.write_bytes(content)
    assert main(["drive", str(tmp_path / "out"), "--world", str(path)]) == 1
    assert f"{path}" in (told := capsys.readouterr().err)
    assert words in told


def test_the_plan_shows_what_hangs_so_low_that_it_is_kept_clear_of(tmp_path):
    sheets, kinds = [], []
    for bottom_m in (0.5, 1.5, 2.2):
        one = world(tmp_path, PLAN.replace("1.5\nheight_m = 1.7", f"{bottom_m}\nheight_m = 2.4"))
        nothing = Floor(*np.zeros((2, 1, 1), np.bool_), 0.0, 0.0, 1.0)
        sheets.append(plan_sheet(Plan(one).draw(nothing), one))
        kinds.append([kind for _, kind in one.outlines()].count("hangs"))
    assert kinds == [0, 1, 0]
    shown = [(sheet == (205, 190, 235)).all(axis=-1).sum() for sheet in sheets]
    assert shown[1] > 200
    assert shown[0] == shown[2] == 0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--world", "low-boxs"], "did you mean 'low-boxes'"),
        (["--world", "low-boxes", "--walkers", "2"], "--walkers has no effect without"),
        (["--world", "low-boxes", "--laps", "2"], "--laps has no effect without --world corridor"),
        (["--scene", "street", "--pan"], "no effect without --scene cards or layers: leave it out"),
        (["--scene", "cards", "--corridor-width-m", "4"], "without --scene corridor"),
    ],
)
def test_options_that_do_not_fit_are_refused(tmp_path, capsys, options, words):
    command = "simulate" if "--scene" in options else "drive"
    assert main([command, str(tmp_path / "out"), *options]) == 2
    assert words in capsys.readouterr().err


def slow_depth(pieces, ceiling_m, eye, direction):
    """Return the depth at which a ray, one metre ahead long, first meets anything."""
    nearest = [((ceiling_m if direction[2] > 0 else 0) - eye[2]) / direction[2]]
    for piece in pieces:
        # A convex prism is where all its half-spaces are: the ray is inside between two depths.
        low, high = 0.0, math.inf
        corners = piece.corners_m
        planes = [
            (np.array([b[1] - a[1], a[0] - b[0], 0.0]), np.array([*a, 0.0]))
            for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)
        ]
        planes.append((np.array([0, 0, 1.0]), np.array([0, 0, piece.top_m])))
        planes.append((np.array([0, 0, -1.0]), np.array([0, 0, piece.bottom_m])))
        for outward, at in planes:
            slope, off = outward @ direction, outward @ (at - eye)
            if slope > 0:
                high = min(high, off / slope)
            elif slope < 0:
                low = max(low, off / slope)
            elif off < 0:
                low = math.inf
        if low < high:
            nearest.append(low)
    return min(nearest)


def test_cameras_see_each_piece_at_its_depth(tmp_path):
    one = world(tmp_path)
    shot = one.shot()
    pieces, rig = prisms(one.plan), one.settings.rig
    camera, pose = stereo_cameras(rig)[1], one.robot
    eye = np.array([*camera.eye(pose), EYE_HEIGHT_M])
    depth = np.empty((rig.height, rig.width))
    for row in range(rig.height):
        up = camera.upward(np.array([row], float))[0]
        for column, ray in enumerate(camera.rays(pose, np.arange(rig.width, dtype=float))):
            depth[row, column] = slow_depth(pieces, one.plan.ceiling_m, eye, np.array([*ray, up]))
    near = depth < 40  # where the floor has not ended
    with np.errstate(divide="ignore"):
        found = rig.depth_m(shot.disparity_px)
    np.testing.assert_allclose(found[near], depth[near], rtol=1e-4)
    assert (found[~near] > 40).all()
    assert near.mean() > 0.9
    grey = shot.frame.right
    assert len(np.unique(grey)) > 20  # it is painted
    again = PlanScene(pieces, one.plan.ceiling_m, 1).render(pose, camera).grey
    assert (again != grey).mean() > 0.2  # otherwise for another seed


def test_distances_are_those_to_the_outlines(tmp_path):
    pieces = prisms(world(tmp_path).plan)
    outlines = Outlines(pieces)
    rng = np.random.default_rng(0)
    share = np.linspace(0, 1, 400)[:, None]
    for place in rng.uniform(-4, 5, (50, 2)):
        away = {}
        for piece in pieces:
            for a, b in zip(piece.corners_m, np.roll(piece.corners_m, -1, axis=0), strict=True):
                ways = np.hypot(*(a + share * (b - a) - place).T)
                away[piece.name] = min(away.get(piece.name, math.inf), ways.min())
        found_m, name = outlines.nearest(*place)
        assert abs(found_m) == pytest.approx(min(away.values()), abs=0.02)
        assert found_m <= 0 or away[name] == pytest.approx(found_m, abs=0.02)
    assert outlines.nearest(2, 0.5)[0] < -0.2
    assert outlines.nearest(2, 0.5)[1] == "boxes[0]"


def test_a_door_is_a_way_through_and_a_lintel_is_over_it(tmp_path):
    plan = world(tmp_path).plan
    at_door = [p for p in prisms(plan) if p.name == "walls[0]" and p.bottom_m > 0]
    assert [(p.bottom_m, p.top_m) for p in at_door] == [(2.05, plan.ceiling_m)]
    low = Outlines([p for p in prisms(plan) if p.bottom_m == 0])
    assert low.nearest(4, 0.4)[0] == pytest.approx(0.6)


@pytest.mark.parametrize(
    ("start", "what"),
    [((0.9, 0.0), "boxes[0]"), ((1.5, 0.8), "poles[0]"), ((2.2, -1.2), "walls[0]")],
)
def test_a_touch_ends_the_drive_and_is_named(tmp_path, start, what):
    one = world(tmp_path)
    one.robot = FloorPose(*start, math.atan2(0.5 - start[1], 1.1) if what == "boxes[0]" else 0.0)
    if what != "boxes[0]":
        one.robot = FloorPose(*start, math.pi / 2 if what == "poles[0]" else 0.0)
    while one.ended is None:
        one.act(Command(MAX_FORWARD_M, 0.0))
    assert one.ended == f"touched {what}"


def test_it_drives_over_what_is_flat_and_under_what_hangs(tmp_path):
    text = PLAN.replace("height_m = 0.5", "height_m = 0.08")
    for start, end in (((1.0, 0.5), 3.0), ((1.0, -0.8), 3.2)):
        one = world(tmp_path, text)
        one.robot = FloorPose(*start, 0.0)
        while one.robot.x_m < end:
            one.act(Command(MAX_FORWARD_M, 0.0))
            assert one.ended is None


def test_latency_speed_and_drift_are_those_of_the_plan(tmp_path):
    extra = "heading_deg = 0\nspeed_m_s = 3.2\nlatency_frames = 2\ndrift = 0.1"
    one = world(tmp_path, PLAN.replace("heading_deg = 20", extra))
    moved = []
    for forward_m in (0.05, 0.1, 0.0, 0.0, 0.0):
        before = one.robot.x_m
        one.act(Command(forward_m, 0.0))
        moved.append(one.robot.x_m - before)
    assert moved == pytest.approx([0, 0, 0.1, 0.2, 0])
    off = one.believed.x_m - one.robot.x_m
    assert 0 < abs(off) < 0.1
    assert one.shot().pose.x_m == pytest.approx(one.believed.x_m, abs=1e-5)
    straight = world(tmp_path)
    straight.act(Command(0.1, 0.0))
    assert straight.believed == straight.robot


@pytest.mark.parametrize(("speed_mps", "contact_s"), [(1, 50), (0.5, None), (-1, None)])
def test_no_true_time_to_contact_is_over_a_minute(speed_mps, contact_s):
    (thing,) = moving_objects(
        np.ones((2, 3), np.uint8),
        np.full((2, 3), 50, np.float32),
        0.0,
        lambda _: FloorPose(0.0, 0.0, 0.0),
        lambda time_s: {1: (50 - speed_mps * time_s, 0.0)},
    )
    assert thing.closing_mps == pytest.approx(speed_mps)
    assert thing.time_to_contact_s == (contact_s and pytest.approx(contact_s))


def test_a_goal_that_is_reached_ends_the_drive(tmp_path):
    one = world(tmp_path, PLAN.replace("heading_deg = 20", "heading_deg = 180\ngoal = [-2, 0]"))
    while one.ended is None:
        one.act(Command(MAX_FORWARD_M, 0.0))
    assert one.ended == "goal reached"
    assert one.to_goal_m < 0.6
    assert one.robot.x_m == pytest.approx(-1.5, abs=MAX_FORWARD_M)


def test_a_goal_on_the_command_line_comes_before_that_of_the_plan(tmp_path, capsys):
    path = tmp_path / "plan.toml"
    path.write_text(PLAN.replace("heading_deg = 20", "heading_deg = 180\ngoal = [-2, 0]"))
    size = ["--width", "64", "--height", "48"]
    goal = ["--goal", "0.3,-0.2", "--max-frames", "3"]
    assert main(["drive", str(tmp_path / "out"), "--world", str(path), *size, *goal]) == 1
    assert "the goal 0.3,-0.2 is within 0.5 m of the start" in capsys.readouterr().err
    far = ["--goal", "-2,0", "--max-frames", "1", "--overwrite"]
    assert main(["drive", str(tmp_path / "out"), "--world", str(path), *size, *far]) == 0
    assert re.search(
        r"out of frames after 1 frames .*: \d\.\d m from the goal, ", capsys.readouterr().err
    )
    for wrong in ("4", "1,x", "1,inf", "1,2,3"):
        assert main(["drive", str(tmp_path / "no"), "--goal", wrong]) == 2
        assert f"--goal cannot be '{wrong}': give X,Y in m" in capsys.readouterr().err


def test_a_drive_in_a_plan_writes_what_one_in_the_corridor_does(tmp_path):
    path, out = tmp_path / "plan.toml", tmp_path / "out"
    path.write_text(PLAN.replace("heading_deg = 20", "frames = 12\ngoal = [3, 2]"))
    given = ["drive", out, "--world", path, "--width", "160", "--height", "120"]
    done = CliRunner().invoke(cli, [str(each) for each in given])
    assert done.exit_code == 0, done.output
    assert "out of frames after 12 frames" in done.stderr
    assert "laps" not in done.stderr
    record = json.loads((out / "drive.json").read_text())
    assert record["world"]["plan"]["boxes"][0]["height_m"] == 0.5
    recordings = [out / "left.mkv", out / "right.mkv", "--rig", out / "rig.yaml"]
    poses = ["--poses", out / "poses.txt", "--goal", "3,2", "--save", "steering", "--no-check"]
    run = ["run", *recordings, *poses, "-o", tmp_path / "run"]
    assert CliRunner().invoke(cli, [str(each) for each in run]).exit_code == 0
    steered = (tmp_path / "run" / "steering.csv").read_bytes()
    assert steered == (out / "steering.csv").read_bytes()


def test_the_table_of_plans_says_how_drives_ended(tmp_path, capsys):
    path = tmp_path / "plan.toml"
    path.write_text(PLAN.replace("heading_deg = 20", "frames = 2"))
    rows = ["--rows", str(tmp_path / "rows.csv"), "--seeds", "1", "--depths", "true depth"]
    bench.main(["--worlds", str(path), *rows])
    table = capsys.readouterr().out.splitlines()
    assert table[0] == "| world | true depth |"
    assert table[2].startswith(f"| {path} | 0.")
    assert table[3].endswith("touched in 0 of 1 |")


@pytest.mark.parametrize("name", ["left.mkv", "steering.csv", "plan.png", "drive.json"])
def test_a_file_that_somebody_puts_there_during_a_drive_stays(tmp_path, name):
    out = tmp_path / "out"

    def put(_):
        (out / name).write_text("mine")
        (out / "map.png").write_text("mine, too")

    driven = world(tmp_path, PLAN, max_frames=2)
    with pytest.raises(OutputError, match=f"({name}|map.png) is not from this run: move it"):
        drive(out, driven, progress=put)
    assert {path.name: path.read_text() for path in out.iterdir() if path.suffix} == {
        name: "mine",
        "map.png": "mine, too",
    }
