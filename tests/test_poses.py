"""Trajectories in the TUM format, and `run --poses`."""

import math
import re

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from motionstereo_cli.__main__ import main
from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.evaluation.poses import evaluate_poses
from motionstereo_cli.rig.pose_forms import quaternions, read_pose_table, rotations
from motionstereo_cli.rig.poses import HEAD, as_written, format_pose, read_poses
from motionstereo_cli.rig.settings import PoseSettings
from motionstereo_cli.sources.opening import open_stereo
from motionstereo_cli.types import Pose, Rig, StereoFrame

RIG = Rig(640, 480, 500.0, 0.2, 320.0, 240.0)


def yawed(yaw_rad, x_m=0.0, y_m=0.0):
    return Pose(x_m, y_m, 1.2, 0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2))


def written(tmp_path, *lines):
    path = tmp_path / "poses.txt"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@given(st.floats(-math.pi, math.pi), st.floats(-1000, 1000))
def test_a_pose_reads_back_as_written(yaw_rad, x_m):
    pose = as_written(yawed(yaw_rad, x_m))
    assert pose == as_written(pose)
    assert pose.x_m == pytest.approx(x_m, abs=1e-6)
    assert math.remainder(pose.yaw_rad - yaw_rad, math.tau) == pytest.approx(0, abs=1e-8)


def test_at_its_own_times_a_trajectory_gives_its_poses_exactly(tmp_path):
    poses = [as_written(yawed(0.1 * n, 0.3 * n)) for n in range(4)]
    lines = [format_pose(n / 30, pose).strip() for n, pose in enumerate(poses)]
    trajectory = read_poses(written(tmp_path, HEAD.strip(), "", *lines))
    assert [trajectory.at(time_s) for time_s in trajectory.time_s] == poses


def test_between_its_times_it_runs_straight_and_turns_the_short_way(tmp_path):
    low, high = yawed(math.radians(170)), yawed(math.radians(-170), 2.0, 4.0)
    flipped = Pose(high.x_m, high.y_m, high.z_m, -high.qx, -high.qy, -high.qz, -high.qw)
    lines = (format_pose(1, low).strip(), format_pose(2, flipped).strip())
    pose = read_poses(written(tmp_path, *lines)).at(1.5)
    assert (pose.x_m, pose.y_m, pose.z_m) == pytest.approx((1, 2, 1.2))
    assert abs(pose.yaw_rad) == pytest.approx(math.pi)


def test_a_frame_outside_the_trajectory_is_an_error_that_names_both_or_lost(tmp_path):
    lines = [format_pose(t, yawed(0)).strip() for t in (1, 2)]
    trajectory = read_poses(written(tmp_path, *lines))
    assert trajectory.at(2.01) == trajectory.at(2)  # containers round their times
    assert trajectory.at(2.1) is None
    with pytest.raises(InputError, match=r"0\.900 s.* 1\.000 to 2\.000 s"):
        trajectory.at(0.9)


def test_a_frame_without_time_has_no_pose(tmp_path):
    trajectory = read_poses(written(tmp_path, "0 0 0 0 0 0 0 1"))
    frame = StereoFrame(0, 0, None, np.zeros((2, 2), np.uint8), np.zeros((2, 2), np.uint8))
    with pytest.raises(InputError, match="do not say when"):
        trajectory.of(frame)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["# only talk"], "has no poses"),
        (["0 0 0 0 0 0 0 1", "", "1 0 0 0 0 0 0"], "line 3: .* is not a pose"),
        (["0 0 0 0 0 0 0 1", "1 x 0 0 0 0 0 1"], "line 2: .* is not a pose"),
        (["0 0 0 0 0 0 0 1", "1 nan 0 0 0 0 0 1"], "line 2: .* is not a pose"),
        (["0 0 0 0 0 0 0 2"], "line 1: .* is not a pose"),
        (["1 0 0 0 0 0 0 1", "0.5 0 0 0 0 0 0 1"], "line 2: time 0.5 does not come after 1"),
    ],
)
def test_what_is_no_trajectory_is_named_with_its_line(tmp_path, lines, words):
    with pytest.raises(InputError, match=words):
        read_poses(written(tmp_path, *lines))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match="nowhere"):
        read_poses(tmp_path / "nowhere")


# Forms, frames and units.

#: Optical axes (x right, y down, z forward) in the robot's (x forward, y left, z up).
ROBOT_FROM_OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def turn_of(yaw_rad):
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])


def drive(count=6):
    """A robot that goes forward and turns left: its poses as matrices (4, 4)."""
    poses = []
    for number in range(count):
        pose = np.eye(4)
        pose[:3, :3] = turn_of(0.1 * number)
        pose[:3, 3] = [0.3 * number, 0.02 * number**2, 0.0]
        poses.append(pose)
    return poses


def left_optical(pose):
    """The pose of the left camera's optical frame, for a robot's pose, in its z-up world."""
    left = np.eye(4)
    left[:3, :3] = ROBOT_FROM_OPTICAL
    left[:3, 3] = [0, RIG.baseline_m / 2, 0]
    return pose @ left


def words(*parts):
    return " ".join(repr(float(number)) for part in parts for number in np.ravel(part))


def tum(time_s, pose):
    return words(time_s, pose[:3, 3], quaternions(pose[None, :3, :3])[0])


def euroc(time_ns, pose, *rest):
    x, y, z, w = quaternions(pose[None, :3, :3])[0]
    numbers = words(pose[:3, 3], (w, x, y, z), rest).split()
    return ",".join([str(time_ns), *numbers])


def assert_drives(trajectory, count=6):
    for number, wanted in enumerate(drive(count)):
        pose = trajectory.poses[number]
        assert pose[:3] == pytest.approx(wanted[:3, 3], abs=1e-9)
        assert rotations(pose[None, 3:])[0] == pytest.approx(wanted[:3, :3], abs=1e-9)


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_matrices_and_quaternions_say_the_same(quaternion):
    matrix = rotations(np.array([quaternion]))
    assert matrix[0] @ matrix[0].T == pytest.approx(np.eye(3), abs=1e-12)
    assert rotations(quaternions(matrix)) == pytest.approx(matrix, abs=1e-9)


def test_kitti_has_matrices_of_the_left_optical_frame_by_number(tmp_path):
    poses = [left_optical(pose) for pose in drive()]
    world = np.linalg.inv(left_optical(np.eye(4)))  # the first pose is one
    path = written(tmp_path, *(words((world @ pose)[:3]) for pose in poses))
    trajectory = read_poses(path, None, RIG)
    assert trajectory.by_number
    # Its world is that of the first left camera: the robot's middle begins half a baseline right.
    shifted = trajectory.poses[:, :3] + [0, RIG.baseline_m / 2, 0]
    assert shifted == pytest.approx(np.array([pose[:3, 3] for pose in drive()]), abs=1e-9)
    grey = np.zeros((2, 2), np.uint8)
    frame = StereoFrame(0, 3, None, grey, grey, number=3)  # the first that --start 3 leaves
    assert trajectory.of(frame) == Pose(*trajectory.poses[3])
    with pytest.raises(InputError, match="need the rig"):
        read_poses(path)


@pytest.mark.parametrize("separator", [" ", ",", ", ", "\t", ";"])
def test_optical_poses_in_a_world_with_z_up(tmp_path, separator):
    lines = [
        tum(n / 10, left_optical(pose)).replace(" ", separator) for n, pose in enumerate(drive())
    ]
    trajectory = read_poses(written(tmp_path, *lines), PoseSettings(pose_frame="optical-z-up"), RIG)
    assert_drives(trajectory)


BODY_FROM_LEFT = np.eye(4)
BODY_FROM_LEFT[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
BODY_FROM_LEFT[:3, 3] = [0.1, -0.2, 0.05]
EUROC_HEAD = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], "
    "q_RS_z [], v_RS_R_x [m s^-1], v_RS_R_y [m s^-1]"
)


@pytest.mark.parametrize("head", [EUROC_HEAD, "# no names"])
def test_euroc_has_poses_of_a_body_in_ns(tmp_path, head):
    bodies = [left_optical(pose) @ np.linalg.inv(BODY_FROM_LEFT) for pose in drive()]
    begin_ns = 1_403_636_579_763_555_584
    lines = [euroc(begin_ns + n * 10**8, body, 7.0, 8.0) for n, body in enumerate(bodies)]
    path = written(tmp_path, head, *lines)
    trajectory = read_poses(path, None, RIG, BODY_FROM_LEFT)
    assert_drives(trajectory)
    assert np.diff(trajectory.time_s) == pytest.approx(0.1, abs=1e-6)
    with pytest.raises(InputError, match=r"where the left camera sits .*--pose-frame"):
        read_poses(path, None, RIG)
    offset = PoseSettings(pose_time_offset=-begin_ns / 1e9)
    assert read_poses(path, offset, RIG, BODY_FROM_LEFT).time_s[2] == pytest.approx(0.2, abs=1e-6)


def test_columns_are_those_that_the_header_names(tmp_path):
    lines = []
    for n, pose in enumerate(drive()):
        x, y, z, w = quaternions(pose[None, :3, :3])[0]
        lines.append(words(n, (w, x, y, z), pose[:3, 3]).replace(" ", ","))
    head = "time,qw,qx,qy,qz,tx,ty,tz"
    assert_drives(read_poses(written(tmp_path, head, *lines)))


@pytest.mark.parametrize(
    ("unit", "per_s"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9), ("s", 1), ("frames", 10)]
)
def test_unit_of_time(tmp_path, unit, per_s):
    lines = [tum(n / 10 * per_s, pose) for n, pose in enumerate(drive(30))]
    path = written(tmp_path, *lines)
    right = read_poses(path, PoseSettings(pose_time_unit=unit))
    span = (0, 29) if unit == "frames" else (0, 2.9)
    right.check_covers(*span)
    assert_drives(right, 30)
    if unit in ("ms", "us", "ns"):
        with pytest.raises(InputError, match=f"likely in {unit}: give --pose-time-unit {unit}"):
            read_poses(path).check_covers(0, 2.9)
        # Said explicitly, it is believed.
        read_poses(path, PoseSettings(pose_time_unit="s")).check_covers(0, 2.9)


@pytest.mark.parametrize(("unit", "per_s"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_a_time_since_1970_shows_its_unit(tmp_path, unit, per_s):
    lines = [tum(round((1.7e9 + n / 10) * per_s), pose) for n, pose in enumerate(drive())]
    assert read_poses(written(tmp_path, *lines)).time_s[0] == pytest.approx(1.7e9), unit


def test_poses_faster_than_any_camera_are_refused(tmp_path):
    lines = [words(n / 10, (300 * n, 0, 0), (0, 0, 0, 1)) for n in range(30)]  # mm
    with pytest.raises(InputError, match="move at 3000 m/s: places have to be in m"):
        read_poses(written(tmp_path, *lines)).check_covers(0, 2.9)


@pytest.mark.parametrize(
    ("span", "complaint"),
    [
        ((0, 60), r"goes on to about 60\.000 s: .*--end 2\.900s"),
        ((-5, 2), r"begins at -5\.000 s"),
        (
            (1e9, 1e9 + 2),
            r"begins at 1000000000\.000 s.* --pose-time-offset .*\(1000000000\.000000 if",
        ),
        ((None, None), "do not say when"),
    ],
)
def test_what_poses_do_not_cover_is_said(tmp_path, span, complaint):
    trajectory = read_poses(written(tmp_path, *(tum(n / 10, p) for n, p in enumerate(drive(30)))))
    with pytest.raises(InputError, match=complaint):
        trajectory.check_covers(*span)
    trajectory.check_covers(0, 2.9)
    trajectory.check_covers(0.5, None)


def test_gaps_are_said(tmp_path):
    lines = [tum(n / 10, pose) for n, pose in enumerate(drive(60))]
    trajectory = read_poses(written(tmp_path, *lines[:20], *lines[45:]))
    (said,) = trajectory.check_covers(0, 5.9)
    assert "1 gap, the longest from 1.900 to 4.500 s: the rig is lost there" in said
    assert [trajectory.at(t) is None for t in (1.9, 1.95, 4.4, 4.5)] == [False, True, True, False]
    short = read_poses(written(tmp_path, *lines[:20], *lines[29:]))
    assert short.at(2.5).x_m == pytest.approx(7.5)
    assert trajectory.check_covers(0, 1.5) == trajectory.check_covers(4.6, 5.9) == ()


@pytest.mark.parametrize("form", ["tum", "kitti", "numbered"])
def test_frames_after_the_last_pose_are_lost_and_said_so(tmp_path, form):
    drove = [pose[:3] for pose in drive(60)]
    if form == "kitti":
        lost = [words(np.full(12, math.nan))]
        lines = [*map(words, drove[:20]), *25 * lost, *map(words, drove[45:55]), *5 * lost]
    else:
        settings = PoseSettings(pose_time_unit="frames" if form == "numbered" else "auto")
        each = [tum(n / (1 if form == "numbered" else 10), p) for n, p in enumerate(drive(60))]
        lines = [*each[:20], *each[45:55]]
    path = written(tmp_path, *lines)
    trajectory = read_poses(path, None, RIG) if form == "kitti" else read_poses(path, settings)
    per_s = 10 if form == "tum" else 1
    said = trajectory.check_covers(0, 59 / per_s)
    assert any("goes on to about" in each and "after them the rig is lost" in each for each in said)
    assert any("1 gap" in each for each in said)
    where = [trajectory.at(n / per_s) for n in range(60)]
    known = {*range(20), *range(45, 55)}
    assert {n for n, pose in enumerate(where) if pose is not None} == known
    # --end counts from the beginning of the recording.
    end = "5.400s" if form == "tum" else "55"
    for first in (0, 20):
        with pytest.raises(InputError, match=f"--end {end}$"):
            trajectory.check_covers(first / per_s, 200 / per_s, None, 0)


def test_a_unit_that_would_cover_the_recording_is_named(tmp_path):
    lines = [tum(17e11 + 100 * n, pose) for n, pose in enumerate(drive())]
    trajectory = read_poses(written(tmp_path, *lines), PoseSettings(pose_time_unit="s"))
    with pytest.raises(InputError, match="begins at"):
        trajectory.check_covers(1.7e9, 1.7e9 + 0.4)
    lines = [tum(5000 + 0.5 * n, pose) for n, pose in enumerate(drive())]
    with pytest.raises(InputError, match="or --pose-time-unit ms, which fits"):
        read_poses(written(tmp_path, *lines)).check_covers(5.0, 5.002)


def test_poses_of_too_few_images_are_said(tmp_path):
    path = written(tmp_path, *(words(np.eye(4)[:3]) for _ in range(5)))
    trajectory = read_poses(path, None, RIG)
    trajectory.check_covers(0, 4)
    with pytest.raises(InputError, match=r"frame 0 to 4, .* about frame 9: .*--end 5"):
        trajectory.check_covers(0, 9)


@pytest.mark.parametrize(
    "line", ["1 0 0 0 0 1 0 0 0 0 -1 0", "2 0 0 0 0 2 0 0 0 0 2 0", "1 0 0 0 0 1 0 0 0 0 1"]
)
def test_matrices_that_are_no_poses_are_named(tmp_path, line):
    lines = [words(np.eye(4)[:3]), line]
    with pytest.raises(InputError, match=r"line 2: .* is not a pose: give 12 numbers"):
        read_poses(written(tmp_path, *lines), None, RIG)


def test_pose_settings_are_checked():
    with pytest.raises(SettingsError, match="--pose-time-unit cannot be 'h'"):
        PoseSettings(pose_time_unit="h")
    with pytest.raises(SettingsError, match="--pose-time-offset"):
        PoseSettings(pose_time_offset=math.nan)


def test_run_says_before_the_first_frame_what_does_not_fit(tmp_path, capsys):
    scene = tmp_path / "scene"
    size = ["--width", "64", "--height", "48", "--frames", "250:262"]
    assert main(["simulate", str(scene), *size]) == 0
    lines = (scene / "poses.txt").read_text().splitlines()
    poses = [line for line in lines if not line.startswith("#")]
    tables = {
        "ms": [f"{1000 * float(t)} {rest}" for t, rest in (p.split(" ", 1) for p in poses)],
        "half": poses[:6],
    }
    command = ["run", str(scene / "left.mp4"), str(scene / "right.mp4")]
    command += ["--rig", str(scene / "rig.yaml"), "--save", "steering", "-o", str(tmp_path / "o")]
    for name, lines in tables.items():
        path = tmp_path / f"{name}.txt"
        path.write_text("\n".join(lines))
        assert main([*command, "--poses", str(path)]) == 1
        assert {"ms": "give --pose-time-unit ms", "half": "--end"}[name] in capsys.readouterr().err
        assert not (tmp_path / "o").exists()
    assert main([*command, "--poses", str(tmp_path / "ms.txt"), "--pose-time-unit", "ms"]) == 0


def test_a_run_goes_on_where_the_poses_have_a_gap_or_end(tmp_path, capsys):
    """Its own poses, of a recording in which it was lost, can be given back to it."""
    scene, out = tmp_path / "scene", tmp_path / "out"
    size = ["--width", "64", "--height", "48", "--frames", "250:296", "--lossless"]
    assert main(["simulate", str(scene), *size]) == 0
    command = ["run", str(scene / "left.mkv"), str(scene / "right.mkv"), "--rig"]
    command += [str(scene / "rig.yaml"), "--save", "steering,map,objects,poses,poses-kitti"]
    lines = [each for each in (scene / "poses.txt").read_text().splitlines() if each[0] != "#"]
    times = [float(line.split()[0]) for line in lines]
    # 30 frames a second: a gap is longer than 1 s.
    kept = [line for n, line in enumerate(lines) if n < 3 or n == 36]
    poses = tmp_path / "kept.txt"
    poses.write_text("\n".join(kept))
    assert main([*command, "-o", str(out), "--poses", str(poses)]) == 0
    told = capsys.readouterr().err
    assert "1 gap" in told
    assert "after them the rig is lost" in told
    located = [n for n in range(46) if n < 3 or n == 36]
    written_s = [
        float(each.split()[0]) for each in (out / "poses.txt").read_text().splitlines()[1:]
    ]
    assert written_s == pytest.approx([times[n] for n in located], abs=1e-3)
    rows = (out / "poses-kitti.txt").read_text().splitlines()
    assert [n for n, row in enumerate(rows) if "nan" not in row] == located
    status = [row.split(",")[3] for row in (out / "steering.csv").read_text().splitlines()[1:]]
    assert {status[n] for n in range(46) if n not in located} <= {"held", "blind"}
    again = [*command, "-o", str(tmp_path / "again"), "--poses", str(out / "poses.txt")]
    assert main(again) == 0
    for name in ("steering.csv", "objects.csv", "map.png"):
        assert (tmp_path / "again" / name).read_bytes() == (out / name).read_bytes(), name


@pytest.mark.parametrize(
    "chosen", [["--every", "2"], ["--start", "3"], ["--start", "2", "--every", "3"]]
)
def test_poses_of_chosen_frames_can_be_given_back(tmp_path, chosen):
    scene, numbered = tmp_path / "scene", ["--pose-time-unit", "frames"]
    size = ["--width", "64", "--height", "48", "--frames", "12", "--lossless"]
    assert main(["simulate", str(scene), *size]) == 0
    for name in ("left", "right"):
        (scene / name).mkdir()
    with open_stereo(scene / "left.mkv", scene / "right.mkv") as source:
        for frame in source:
            for name, view in (("left", frame.left), ("right", frame.right)):
                cv2.imwrite(str(scene / name / f"{frame.index:03d}.png"), view)
    lines = [each for each in (scene / "poses.txt").read_text().splitlines() if each[0] != "#"]
    numbers = [f"{n} {line.partition(' ')[2]}" for n, line in enumerate(lines)]
    (tmp_path / "poses.txt").write_text("\n".join(numbers))
    command = ["run", str(scene / "left"), str(scene / "right"), "--rig", str(scene / "rig.yaml")]
    command += [*chosen, "--save", "steering,poses,poses-kitti", "--no-check"]
    given = ["--poses", str(tmp_path / "poses.txt"), *numbered]
    assert main([*command, *given, "-o", str(tmp_path / "out")]) == 0
    for name in ("poses", "poses-kitti"):
        given = ["--poses", str(tmp_path / "out" / f"{name}.txt")]
        assert main([*command, *given, "-o", str(tmp_path / name)]) == 0
        one, other = (np.loadtxt(tmp_path / out / "poses-kitti.txt") for out in ("out", name))
        assert np.allclose(one, other, atol=1e-5, equal_nan=True)
        assert (
            np.isfinite(one).all(axis=1).sum()
            == len((tmp_path / name / "poses.txt").read_text().splitlines()) - 1
        )
    # Those of the whole recording have other frames in between, but the same images.
    whole = [each for each in command if each not in chosen]
    given = ["--poses", str(tmp_path / "poses.txt"), *numbered]
    assert main([*whole, *given, "-o", str(tmp_path / "whole")]) == 0
    for name in ("poses.txt", "poses-kitti.txt"):
        report = evaluate_poses(tmp_path / "out" / name, tmp_path / "whole" / name)
        assert report.poses == np.isfinite(one).all(axis=1).sum()
        assert report.ate_m < 1e-4


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("{t} {x} 0 1 0 0 0 1", ""),
        ("{t} 0 0 {x} 0 0 0.7 0.7", "moves up or down"),  # optical, its first pose is 0
        ("{t} {x} 0 1 -0.5 0.5 -0.5 0.5", "not upright"),  # optical, z up
        ("{t} {x} 0 1 1 0 0 0", "not upright"),  # qw first
        ("{t} 0 0 0.1 0 0 0 1", ""),
    ],
)
def test_poses_that_no_robot_has_are_named(tmp_path, line, said):
    rows = (line.format(t=n / 10, x=n / 5).replace("0.7 0.7", "0.6 0.8") for n in range(12))
    warned = " ".join(read_poses(written(tmp_path, *rows)).check_covers(0.0, 1.0))
    assert (said in warned) if said else not warned
    assert not said or "--pose-frame" in warned


# Forms of other programs: columns by their header, and what is taken for granted is said.

ROSTOPIC = (
    "%time,field.header.seq,field.header.stamp,field.header.frame_id,field.child_frame_id,"
    "field.pose.pose.position.x,field.pose.pose.position.y,field.pose.pose.position.z,"
    "field.pose.pose.orientation.x,field.pose.pose.orientation.y,field.pose.pose.orientation.z,"
    "field.pose.pose.orientation.w,field.pose.covariance0,field.twist.twist.linear.x"
)
OKVIS = (
    "timestamp, p_WS_W_x, p_WS_W_y, p_WS_W_z, q_WS_x, q_WS_y, q_WS_z, q_WS_w, v_WS_W_x, v_WS_W_y"
)
MAPLAB = (
    "vertex index, timestamp [ns], position x [m], position y [m], position z [m], quaternion x, "
    "quaternion y, quaternion z, quaternion w, velocity x [m/s]"
)
AIRSIM = "VehicleName\tTimeStamp\tPOS_X\tPOS_Y\tPOS_Z\tQ_W\tQ_X\tQ_Y\tQ_Z\tImageFile"


@pytest.mark.parametrize(
    ("header", "line", "frame"),
    [
        (HEAD.strip(), "{s} {p} {xyz} {w}", "robot"),
        ("#timestamp x y z qx qy qz qw id", "{s} {p} {xyz} {w} {n}", "robot"),
        ("# id timestamp tx ty tz qx qy qz qw", "{n} {s} {p} {xyz} {w}", "robot"),
        ("# timestamp [ns] tx ty tz qw qx qy qz", "{ns} {p} {w} {xyz}", "body"),
        ("#counter, sec, nsec, x, y, z, qx, qy, qz, qw", "{n},{sec},{nsec},{p},{xyz},{w}", "robot"),
        ("#timestamp_kf,x,y,z,qw,qx,qy,qz,vx,vy,vz", "{ns},{p},{w},{xyz},9,9,9", "body"),
        ("Time,qw,qx,qy,qz,vx,x,y,z", "{s},{w},{xyz},9,{p}", "robot"),
        ("# timestamp(s) tx ty tz qx qy qz qw Pr11 Pr12", "{s} {p} {xyz} {w}", "robot"),
        (ROSTOPIC, "{ns},{n},{ns},odom,base_link,{p},{xyz},{w},0.1,7", "robot"),
        (OKVIS, "{ns}, {p}, {xyz}, {w}, 9, 9", "body"),
        (MAPLAB, "{n}, {ns}, {p}, {xyz}, {w}, 9", "robot"),
        (AIRSIM, "Drone\t{ms}\t{p}\t{w}\t{xyz}\timg_{n}.png", "ned"),
        ("frame,x,y,z,qx,qy,qz,qw", "{n},{p},{xyz},{w}", "robot"),
    ],
)
def test_columns_are_told_by_every_header(tmp_path, header, line, frame):
    lines = []
    begin_s = 1.7e9
    for n, pose in enumerate(drive()):
        place, (x, y, z, w) = pose[:3, 3], quaternions(pose[None, :3, :3])[0]
        time_s, sep = begin_s + n / 10, next((each for each in ",\t" if each in line), " ")
        parts = {
            **{"n": n, "s": repr(time_s), "ms": round(time_s * 1e3), "ns": round(time_s * 1e9)},
            **{"sec": int(time_s), "nsec": round(time_s % 1 * 1e9), "w": repr(float(w))},
            "p": sep.join(repr(float(each)) for each in place),
            "xyz": sep.join(repr(float(each)) for each in (x, y, z)),
        }
        lines.append(line.format(**parts))
    table = read_pose_table(written(tmp_path, header, *lines))
    assert (table.frame, table.notes) == (frame, ())
    trajectory = read_poses(tmp_path / "poses.txt", PoseSettings(pose_frame="robot"))
    assert_drives(trajectory)
    wanted = range(6) if header.startswith("frame") else begin_s + np.arange(6) / 10
    assert trajectory.time_s == pytest.approx(np.array(wanted), abs=1e-6)
    assert trajectory.by_number == header.startswith("frame")


#: Directions of x forward, y left, z up in x forward, y right, z down.
FLIPPED = np.diag([1.0, -1, -1, 1])


def test_tartanair_has_seven_columns_of_a_camera_with_z_down(tmp_path):
    at_left = np.eye(4)
    at_left[1, 3] = RIG.baseline_m / 2
    lines = []
    for pose in drive():
        ned = FLIPPED @ pose @ at_left @ FLIPPED
        lines.append(words(ned[:3, 3], quaternions(ned[None, :3, :3])[0]))
    trajectory = read_poses(written(tmp_path, *lines), None, RIG)
    assert trajectory.by_number
    assert_drives(trajectory)
    assert "TartanAir" in trajectory.notes[0]


@pytest.mark.parametrize("rows", [3, 4])
@pytest.mark.parametrize("first", ["", "number", "ns"])
def test_matrices_do_not_say_what_they_are_of(tmp_path, rows, first):
    before = {"": lambda _: (), "number": lambda n: (n,), "ns": lambda n: (1.7e18 + n * 1e8,)}
    lines = [words(before[first](n), left_optical(p)[:rows]) for n, p in enumerate(drive())]
    path = written(tmp_path, *lines)
    settings = PoseSettings(pose_frame="optical-z-up")
    trajectory = read_poses(path, settings, RIG)
    assert_drives(trajectory)
    assert trajectory.by_number == (first != "ns")
    if rows == 3 and not first:  # KITTI's
        return
    with pytest.raises(InputError, match=r"do not say|does not say .*--pose-frame optical"):
        read_poses(path, None, RIG)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("{t} {x} 0 1 0 0 {s} {c}", ""),  # TUM's
        ("{t},{x},0,1,0,0,{s},{c}", "t x y z qx qy qz qw; a first line"),
        ("{t} {x} 0 1 0 0 {s} {c} 7", "9 columns and no header: they are taken for t x y z qx"),
        ("{ns} {x} 0 1 {c} 0 0 {s}", "taken for t x y z qw qx qy qz; a first line"),
        ("{ns},{x},0,1,{c},0,0,{s},0,0,0,", "11 columns .* t x y z qw qx qy qz and others"),
        ("{t} {x} {y} 1 {c} 0 0 {s}", "qw is likely the first"),
    ],
)
def test_the_order_of_a_quaternion_is_not_guessed_in_silence(tmp_path, line, said):
    rows = []
    for n in range(30):
        yaw = n / 10
        parts = {
            "t": n / 10,
            "ns": int(17e17 + n * 1e8),
            "x": math.sin(yaw),
            "y": 1 - math.cos(yaw),
        }
        rows.append(line.format(**parts, s=math.sin(yaw / 2), c=math.cos(yaw / 2)))
    notes = " ".join(read_pose_table(written(tmp_path, *rows)).notes)
    assert re.search(said, notes) if said else not notes


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"camera_model": "OPENCV", "frames": [{"transform_matrix": [[1]]}]}', "nerfstudio"),
        ('[{"token": "a", "rotation": [1, 0, 0, 0], "timestamp": 1}]', "nuScenes"),
        ("# Image list with two lines of data per image:\n1 1 0 0 0 0 0 0 1 a.png\n", "COLMAP"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n", "g2o"),
        ("header: \n  seq: 1\npose: \n", "rostopic echo -p"),
        ("# timestamp(s) q p v bg ba cam_imu_dt num_cam\n1 0 0 0 1 0 0 0\n", "OpenVINS"),
        ("time,x,y,z,roll,pitch,yaw\n0,0,0,0,0,0,0\n", "angles in place of a quaternion"),
        ("#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1]\n1,0,0,0,0,0,0\n", "an IMU"),
        ("# t x y z qx qy qz qw\n0 0 0 0 0 0 1\n", "fewer than the header names"),
    ],
)
def test_other_forms_are_named(tmp_path, text, said):
    path = tmp_path / "other"
    path.write_text(text)
    with pytest.raises(InputError, match=said):
        read_poses(path, None, RIG)


def test_a_time_that_is_there_twice_is_said(tmp_path):
    lines = [tum(n / 10, pose) for n, pose in enumerate(drive())]
    trajectory = read_poses(written(tmp_path, *lines[:3], lines[2], *lines[3:]))
    assert_drives(trajectory)
    assert "has 1 pose with the time of the one before" in trajectory.check_covers(0, 0.5)[0]


def test_more_poses_than_images_are_said(tmp_path):
    path = written(tmp_path, *(words(np.eye(4)[:3]) for _ in range(60)))
    trajectory = read_poses(path, None, RIG)
    assert trajectory.check_covers(0, 59, 59) == trajectory.check_covers(0, 19, 58) == ()
    (said,) = trajectory.check_covers(0, 19, 19)
    assert "60 poses for 20 images: the pose of number n is taken for image n" in said


@pytest.mark.parametrize(("begin_s", "warned"), [(0.0, True), (1.7e9, False)])
def test_poses_of_a_longer_recording_are_said(tmp_path, begin_s, warned):
    lines = [tum(begin_s + n / 10, pose) for n, pose in enumerate(drive(60))]
    trajectory = read_poses(written(tmp_path, *lines))
    said = trajectory.check_covers(begin_s, begin_s + 2, begin_s + 2)
    assert any("3.9 s after the recording ends" in line for line in said) == warned
    assert trajectory.check_covers(begin_s, begin_s + 2, begin_s + 5.5) == ()
