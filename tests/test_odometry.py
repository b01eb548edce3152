"""Own motion from two videos, against exact poses of rendered scenes."""

import csv
import itertools
import json
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from motionstereo_cli import read_poses, read_rig
from motionstereo_cli.__main__ import main
from motionstereo_cli.errors import SettingsError
from motionstereo_cli.pipeline import process
from motionstereo_cli.rig.pose_forms import rotations
from motionstereo_cli.rig.settings import PoseSettings
from motionstereo_cli.robot.alignment import (
    LEVELS,
    Keyframe,
    Lens,
    align,
    keyframe,
    mismatch,
    nearness_of,
    pyramid,
)
from motionstereo_cli.robot.odometry import (
    BLOCK_FRAMES,
    ViewPair,
    setting_out,
    step,
    travelled,
)
from motionstereo_cli.simulate.scenes import render_scene
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.simulate.write import simulate
from motionstereo_cli.sinks.outputs import OUTPUTS
from motionstereo_cli.sources.settings import InputSettings
from motionstereo_cli.types import Fix, FrameTime, Pose, Steering, Step, StereoFrame

RANGE_PX = 48
#: Axes of the right camera in the rig's.
ROBOT_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def lens_of(rig, error_px=0.0):
    focal = rig.focal_px, rig.fy_px
    return Lens(focal, rig.cx_of("right"), rig.cx + error_px, rig.cy, rig.baseline_m)


def of_right_camera(pose, rig):
    """A pose of the rig as the matrix (4, 4) of its right camera."""
    turn = rotations(np.array([[pose.qx, pose.qy, pose.qz, pose.qw]]))[0]
    place = np.array([pose.x_m, pose.y_m, pose.z_m]) + turn @ [0, -rig.baseline_m / 2, 0]
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn @ ROBOT_FROM_OPTICAL, place
    return matrix


def motions(pairs, lens, first=0, *, with_error=False):
    state, last, found = None, None, []
    for number, pair in enumerate(pairs, first):
        state, motion = step(state, last, pair, number, lens, RANGE_PX, with_error=with_error)
        found.append(motion)
        last = pair
    return found


def path_of(found):
    path, poses = setting_out(), []
    for motion in found:
        path = travelled(path, motion)
        poses.append(path.pose)
    return path, poses


def scene(**given):
    settings = SimulateSettings(**{"width": 320, "height": 240, "noise_sigma": 1.5, **given})
    shots = list(render_scene(settings))
    pairs = [ViewPair(shot.right, shot.left) for shot in shots]
    return settings.rig, pairs, [of_right_camera(s.pose.rig_pose, settings.rig) for s in shots]


@pytest.fixture(scope="module")
def street():
    return scene(scene="street", frames="20", seed=7, street_winding_deg=25)


def drift(poses, true):
    """Distance by which the end is missed, as a share of the way, and the turn in degrees."""
    way = sum(np.linalg.norm((b - a)[:3, 3]) for a, b in itertools.pairwise(true))
    ends = [np.linalg.inv(each[0]) @ each[-1] for each in (poses, true)]
    off = np.linalg.inv(ends[1]) @ ends[0]
    cos = (np.trace(off[:3, :3]) - 1) / 2
    return np.linalg.norm(off[:3, 3]) / way, np.degrees(np.arccos(min(cos, 1)))


def crossed(pairs, width, disparity_px):
    """Views with a textured wall before them that moves by a px a frame."""
    paint = cv2.GaussianBlur(np.random.default_rng(0).standard_normal((210, width)), (0, 0), 3)
    paint = (paint / paint.std() * 40 + 120).clip(0, 255).astype(np.uint8)
    result = []
    for number, pair in enumerate(pairs):
        views = [view.copy() for view in pair]
        for view, x in zip(views, (20 + number, 20 + number + disparity_px), strict=True):
            view[30:, x : x + width] = paint
        result.append(ViewPair(*views))
    return result


class TestPath:
    @pytest.mark.parametrize(
        ("given", "share", "degrees"),
        [
            ({"scene": "corridor", "frames": "90:130", "seed": 2}, 0.015, 1.2),
            ({"scene": "street", "frames": "12", "seed": 11, "flicker": 0.1}, 0.03, 0.3),
        ],
    )
    def test_ends_where_the_rig_is(self, given, share, degrees):
        rig, pairs, true = scene(**given)
        path, poses = path_of(motions(pairs, lens_of(rig)))
        off, turned = drift(poses, true)
        assert path.lost == 0
        assert off < share
        assert turned < degrees

    def test_is_not_drawn_away_by_what_fills_a_quarter_of_the_view(self, street):
        rig, pairs, true = street
        before_it = crossed(pairs[:16], 100, 24)
        path, poses = path_of(motions(before_it, lens_of(rig)))
        assert path.lost == 0
        assert drift(poses, true[:16])[0] < 0.03

    def test_of_a_street_is_good_to_half_a_percent(self, street):
        rig, pairs, true = street
        _, poses = path_of(motions(pairs, lens_of(rig)))
        off, turned = drift(poses, true)
        assert off < 0.005
        assert turned < 0.2

    def test_of_a_still_camera_does_not_move_at_all_whatever_crosses(self):
        rig, pairs, _ = scene(scene="cards", frames="16", seed=3)
        path, _ = path_of(motions(pairs, lens_of(rig)))
        assert np.array_equal(path.pose, np.eye(4))

    def test_a_slow_camera_is_not_a_still_one(self):
        rig, pairs, true = scene(
            scene="street", frames="12", seed=4, street_speed_m_s=0.2, noise_sigma=2
        )
        _, poses = path_of(motions(pairs, lens_of(rig)))
        assert drift(poses, true)[0] < 0.1

    def test_says_how_sure_it_is(self, street):
        rig, pairs, true = street
        path, poses = path_of(motions(pairs, lens_of(rig)))
        off = np.linalg.inv(poses[0]) @ poses[-1] - np.linalg.inv(true[0]) @ true[-1]
        sigma = np.sqrt(np.trace(path.covariance[:3, :3]))
        assert np.linalg.norm(off[:3, 3]) < 4 * sigma < 2


class TestMotion:
    def test_depends_on_the_frames_since_the_last_keyframe_only(self, street):
        rig, pairs, _ = street
        lens = lens_of(rig)
        whole, part = motions(pairs, lens), motions(pairs[5:], lens, first=5)
        for one, other in zip(whole[BLOCK_FRAMES + 1 :], part[BLOCK_FRAMES - 4 :], strict=True):
            assert np.array_equal(one.before_from_now, other.before_from_now)
            assert np.array_equal(one.per_error, other.per_error)
            assert np.array_equal(one.evidence, other.evidence)

    def test_is_unknown_before_a_blank_wall_and_known_again_behind_it(self, street):
        rig, pairs, true = street
        blank = np.full_like(pairs[0].right, 120)
        shown = [*pairs[:4], ViewPair(blank, blank), ViewPair(blank, blank), *pairs[4:8]]
        found = motions(shown, lens_of(rig))
        assert [motion is None for motion in found] == [False] * 4 + [True] * 3 + [False] * 3
        assert path_of(found[:6])[0].lost == 2
        for number in (7, 8, 9):
            wanted = np.linalg.inv(true[number - 3]) @ true[number - 2]
            assert np.allclose(found[number].before_from_now, wanted, atol=0.03)

    def test_is_doubtful_where_another_agrees_nearly_as_well(self, street, monkeypatch):
        rig, pairs, _ = street
        lens = lens_of(rig)
        state = None
        for number in range(3):
            last = pairs[max(number - 1, 0)] if number else None
            state, motion = step(state, last, pairs[number], number, lens, RANGE_PX)
        assert not motion.vague
        for turn_rad, vague in ((0.005, False), (0.02, True)):
            turn = np.eye(4)
            turn[:3, :3] = cv2.Rodrigues(np.array([0.0, turn_rad, 0.0]))[0]
            scores = iter([0.5, 0.45, *[0.1] * 20])  # the first two are near

            def found(*args, turn=turn, scores=scores, **options):
                aligned, score = align(*args, **options), next(scores)
                there = aligned.motion if score != 0.45 else turn @ aligned.motion
                return replace(aligned, score=score, motion=there)

            monkeypatch.setattr("motionstereo_cli.robot.odometry.align", found)
            assert step(state, pairs[2], pairs[3], 3, lens, RANGE_PX)[1].vague == vague

    def test_a_vague_motion_goes_into_the_path_and_is_said_to_be_lost(self, street):
        rig, pairs, _ = street
        found = motions(pairs[:4], lens_of(rig))
        assert not any(motion.vague for motion in found)
        path, _ = path_of(found[:3])
        sure = travelled(path, found[3])
        vague = travelled(path, replace(found[3], vague=True))
        assert (sure.lost, vague.lost) == (0, 1)
        np.testing.assert_allclose(vague.pose, sure.pose, atol=1e-3)
        assert vague.covariance.trace() > sure.covariance.trace() + 0.1
        assert travelled(vague, found[3]).lost == 0

    def test_where_the_rig_is_lost_it_goes_on_and_then_slows_down(self):
        turning = np.eye(4)
        turning[:3, :3] = cv2.Rodrigues(np.array([0.1, 0.2, 0.0]))[0]
        path = replace(setting_out(), last=turning)
        for _ in range(16):
            path = travelled(path, None)
        np.testing.assert_allclose(path.last, turning, atol=1e-12)
        path = replace(path, pose=np.eye(4))
        for _ in range(60):
            path = travelled(path, None)
        turned = np.linalg.norm(cv2.Rodrigues(path.pose[:3, :3])[0])
        assert turned == pytest.approx(4 * np.hypot(0.1, 0.2), rel=1e-3)
        np.testing.assert_allclose(path.last, np.eye(4), atol=1e-5)

    def test_a_vague_motion_counts_as_far_as_it_is_sure(self, street):
        rig, pairs, _ = street
        found = motions(pairs[:4], lens_of(rig))
        path, _ = path_of(found[:3])
        slower, unsure = travelled(path, None), np.eye(6) * 1e4
        off = replace(found[3], before_from_now=np.eye(4), covariance=unsure, vague=True)
        np.testing.assert_allclose(travelled(path, off).pose, slower.pose, atol=1e-4)

    def test_points_of_now_tell_it_where_those_of_the_keyframe_are_hidden(self, street):
        rig, pairs, true = street
        lens, other = lens_of(rig), pairs[9]
        hidden, _ = step(
            None,
            None,
            ViewPair(other.right[::-1].copy(), other.left[::-1].copy()),
            0,
            lens,
            RANGE_PX,
        )
        after, motion = step(hidden, pairs[3], pairs[4], 4, lens, RANGE_PX)
        assert motion is not None
        wanted = np.linalg.inv(true[3]) @ true[4]
        assert np.allclose(motion.before_from_now, wanted, atol=0.03)
        assert np.array_equal(after.motion, np.eye(4))

    def test_of_a_blank_recording_is_unknown(self):
        blank = np.full((60, 80), 90, np.uint8)
        lens = Lens((70.0, 70.0), 39.5, 39.5, 29.5, 0.1)
        assert motions([ViewPair(blank, blank)] * 3, lens)[1:] == [None, None]

    def test_a_jump_to_another_place_is_no_motion(self, street):
        rig, pairs, _ = street
        other = scene(scene="corridor", frames="3", seed=1)[1]
        assert motions([*pairs[:3], *other], lens_of(rig))[3] is None


class TestRun:
    """``--poses auto`` from files, beside what the scene says."""

    @pytest.fixture(scope="class")
    @staticmethod
    def recording(tmp_path_factory):
        folder = tmp_path_factory.mktemp("street") / "street"
        settings = SimulateSettings(
            scene="street", frames="14", width=320, height=240, seed=5, noise_sigma=1
        )
        simulate(folder, settings)
        return folder

    @staticmethod
    def run(recording, out, *options, rig="rig.yaml"):
        given = [recording / "left.mp4", recording / "right.mp4", "--rig", recording / rig]
        assert main(["run", *map(str, given), "-o", str(out), *options]) == 0
        return out

    @staticmethod
    def matrices(path, rig):
        return [of_right_camera(Pose(*each), rig) for each in read_poses(path).poses.tolist()]

    def test_poses_are_those_of_the_rig(self, recording, tmp_path):
        save = "poses,poses-kitti,odometry,steering"
        out = self.run(recording, tmp_path / "out", "--poses", "auto", "--save", save)
        rig = read_rig(recording / "rig.yaml")
        true = self.matrices(recording / "poses.txt", rig)
        found = self.matrices(out / "poses.txt", rig)
        off, turned = drift(found, true)
        assert off < 0.01
        assert turned < 0.3
        # The same as the left camera's, in KITTI's form.
        settings = PoseSettings(pose_frame="optical")
        kitti = read_poses(out / "poses-kitti.txt", settings, rig)
        steps = [self.steps(each.poses, rig) for each in (kitti, read_poses(out / "poses.txt"))]
        assert np.allclose(*steps, atol=1e-5)
        with (out / "odometry.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        assert [row["lost"] for row in rows] == ["0"] * 14
        assert 0 < float(rows[5]["sigma_m"]) < float(rows[-1]["sigma_m"]) < 0.5
        assert {row["disparity_offset_px"] for row in rows} == {"0.000"}

    @staticmethod
    def steps(poses, rig):
        matrices = [of_right_camera(Pose(*each), rig) for each in poses.tolist()]
        return [np.linalg.inv(a) @ b for a, b in itertools.pairwise(matrices)]

    def test_what_needs_poses_finds_them_and_says_so(self, recording, tmp_path, capsys):
        out = self.run(recording, tmp_path / "out", "--save", "map,steering")
        assert "map: the rig's own motion is found" in capsys.readouterr().err
        assert (out / "map.ply").exists()
        plain = self.run(recording, tmp_path / "plain", "--save", "steering")
        steering = [(each / "steering.csv").read_bytes() for each in (out, plain)]
        assert steering[0] == steering[1]  # the guidance has poses only where they are asked for

    def test_given_poses_do_not_tell_what_moves_by_itself(self, recording, tmp_path, capsys):
        poses, tables = ("--poses", str(recording / "poses.txt")), []
        for number, save in enumerate(("map", "own-charge", "odometry")):
            out = self.run(recording, tmp_path / save, *poses, "--save", f"{save},steering")
            said = capsys.readouterr().err
            sought = f"{save}: the rig's own motion is found, to tell what moves by itself" in said
            assert sought == (number < 2)
            assert "poses" not in json.loads((out / "run.json").read_text())
            tables.append((out / "steering.csv").read_bytes())
        assert tables[0] == tables[1] == tables[2]

    def test_a_wrong_offset_is_said_measured_and_mended(self, recording, tmp_path, capsys):
        text = (recording / "rig.yaml").read_text().replace("doffs: 0.0", "doffs: 1.0")
        (recording / "off.yaml").write_text(text)
        save = ["--save", "poses,depth", "--poses", "auto"]
        left = self.run(recording, tmp_path / "left", *save, rig="off.yaml")
        said = re.search("disparities are (.*?) px too large", capsys.readouterr().err)
        assert float(said[1]) == pytest.approx(1, abs=0.06)
        save += ["--disparity-offset", "auto"]
        mended = self.run(recording, tmp_path / "mended", *save, rig="off.yaml")
        said = re.search("--disparity-offset (.*?):", capsys.readouterr().err)
        assert float(said[1]) == pytest.approx(-1, abs=0.06)
        rig = read_rig(recording / "rig.yaml")
        true = self.matrices(recording / "poses.txt", rig)
        for out in (left, mended):
            assert drift(self.matrices(out / "poses.txt", rig), true)[0] < 0.01
        right = self.run(recording, tmp_path / "right", *save)
        depths = [
            cv2.imread(str(out / "depth/000010.png"), -1).astype(float)
            for out in (left, mended, right)
        ]
        known = np.logical_and.reduce([each > 0 for each in depths])
        off, healed = (np.abs(each[known] / depths[2][known] - 1).mean() for each in depths[:2])
        assert healed < 0.02
        assert off > 0.05

    @pytest.mark.parametrize("wrong", [True, False])
    def test_check_reports_the_offset(self, recording, tmp_path, capsys, wrong):
        text = (recording / "rig.yaml").read_text()
        (tmp_path / "rig.yaml").write_text(
            text.replace("doffs: 0.0", "doffs: 1.0") if wrong else text
        )
        views = [str(recording / f"{side}.mp4") for side in ("left", "right")]
        advice = tmp_path / "advice.toml"
        given = ["--rig", str(tmp_path / "rig.yaml"), "--json", "--write", str(advice)]
        assert main(["check", *views, *given]) == 0
        report = json.loads(capsys.readouterr().out)
        assert report["disparity_offset_px"] == pytest.approx(-1 if wrong else 0, abs=0.06)
        named = "disparity-offset" in [finding["name"] for finding in report["findings"]]
        assert named == wrong
        assert ('disparity-offset = "auto"' in advice.read_text()) == wrong

    def test_an_offset_is_a_number_or_auto(self):
        with pytest.raises(SettingsError, match="--disparity-offset cannot be 'much'"):
            InputSettings(disparity_offset="much")

    def test_options_without_effect_and_a_mistyped_auto_are_said(self, recording, tmp_path, capsys):
        idle = ["--map-cell-m", "0.1", "--pose-time-unit", "ms", "--depth-scale", "256"]
        idle += ["--no-legend"]
        out = ["--save", "steering,depth", "--poses", "auto"]
        self.run(recording, tmp_path / "out", *out, *idle)
        said = capsys.readouterr().err
        assert "--map-cell-m has no effect without --save map" in said
        assert "note: --no-legend has no effect without --save depth-video" in said
        assert "--pose-time-unit has no effect without --poses FILE" in said
        assert "--depth-scale" not in said
        given = [recording / "left.mp4", recording / "right.mp4", "--rig", recording / "rig.yaml"]
        assert main(["run", *map(str, given), "--poses", "Aut", "-o", str(tmp_path / "no")]) == 2
        assert (
            "--poses Aut: there is no such file (did you mean 'auto'?)" in capsys.readouterr().err
        )

    def test_needs_a_rig(self, recording, tmp_path, capsys):
        given = [str(recording / "left.mp4"), str(recording / "right.mp4"), "--poses", "auto"]
        assert main(["run", *given, "-o", str(tmp_path / "out")]) == 2
        assert "--poses need --rig" in capsys.readouterr().err

    def test_frames_that_are_lost_have_no_line(self, tmp_path):
        pose, fix = Pose(1, 2, 3, 0, 0, 0, 1), Fix(False, 0.1, 0.01, 0.0, 0.9)
        steering = Steering("blind", None, None, None, None)
        for timed, words in ((True, "# time_s 0.000000 0.200000"), (False, "# frame 7 9")):
            sink = OUTPUTS["poses"].open(tmp_path, None)
            for index, lost in enumerate([False, True, False]):
                time = FrameTime(index, index, index / 10 if timed else None, 7 + index)
                each = replace(fix, lost=lost)
                sink.write(Step(time, steering, (), pose, 0.0, 0.0, fix=each))
            sink.close()
            head, *lines = (tmp_path / "poses.txt").read_text().splitlines()
            assert (
                " ".join([head[: head.index(" x_m")], *(each.split()[0] for each in lines)])
                == words
            )
            assert read_poses(tmp_path / "poses.txt").by_number != timed

    def test_from_python(self, street):
        rig, pairs, true = street
        frames = [
            StereoFrame(index, index, index / 10, pair.left, pair.right)
            for index, pair in enumerate(pairs[:9])
        ]
        results = list(process(frames, None, rig, "auto", with_objects=False, extras=()))
        found = [of_right_camera(result.pose, rig) for result in results]
        assert drift(found, true[:9])[0] < 0.01
        assert not any(result.fix.lost for result in results)


def with_error(pairs, rig, error_px):
    """The same views with disparities that are too small by an error as an alignment has it."""
    y, x = np.mgrid[: rig.height, : rig.width].astype(np.float32)
    constant, right, down = error_px
    by_px = constant + right * (x - rig.cx) / rig.focal_px + down * (y - rig.cy) / rig.fy_px
    place = np.float32(x + by_px), y
    return [
        ViewPair(pair.right, cv2.remap(pair.left, *place, cv2.INTER_CUBIC, borderMode=1))
        for pair in pairs
    ]


class TestErrorOfDisparity:
    @pytest.mark.parametrize("constant_px", [0.0, 0.3, 1.2, -0.6])
    def test_constant_is_measured(self, street, constant_px):
        rig, pairs, _ = street
        path, _ = path_of(motions(pairs, lens_of(rig, constant_px), with_error=True))
        assert path.error_px == pytest.approx([constant_px, 0, 0], abs=0.1)

    @pytest.mark.parametrize("error_px", [(0.1, 0.8, 0.0), (0.0, 0.0, -1.0), (0.2, -0.4, 0.6)])
    def test_slopes_are_measured(self, street, error_px):
        """As different focal lengths and a rotation about the optical axis cause them."""
        rig, pairs, _ = street
        path, _ = path_of(motions(with_error(pairs, rig, error_px), lens_of(rig)))
        assert path.error_px == pytest.approx(error_px, abs=0.25)

    @pytest.mark.parametrize("error_px", [(0.2, 0.0, 0.0), (0.1, 0.2, 0.6)])
    def test_that_is_small_is_made_good_by_the_path(self, street, error_px):
        rig, pairs, true = street
        found = motions(with_error(pairs, rig, error_px), lens_of(rig))
        uncorrected = [np.eye(4)]
        for motion in found[1:]:
            uncorrected.append(uncorrected[-1] @ motion.before_from_now)
        assert drift(path_of(found)[1], true)[0] < 0.6 * drift(uncorrected, true)[0]


def moved(points, motion, lens):
    """Where points of the right camera are seen in both views after a motion, one by one."""
    seen = []
    for x, y, nearness, _ in points.astype(float):
        depth_m = lens.focal_px[0] * lens.baseline_m / nearness
        X, Y, Z = motion[:3, :3] @ (x * depth_m, y * depth_m, depth_m) + motion[:3, 3]
        seen.append(
            (
                lens.focal_px[0] * X / Z + lens.right_cx_px,
                lens.focal_px[0] * (X + lens.baseline_m) / Z + lens.left_cx_px,
                lens.focal_px[1] * Y / Z + lens.cy_px,
            )
        )
    return np.array(seen)


class TestAlignment:
    LENS = Lens((150.0, 140.0), 81.0, 78.5, 59.0, 0.2)

    @staticmethod
    def hills(x, y):
        """A smooth grey without repetition."""
        return 120 + 40 * np.sin(x / 7 + np.sin(y / 19)) + 30 * np.sin(y / 9 + x / 31)

    def test_finds_the_motion_that_views_were_made_with(self):
        """Views of now are painted so that each point looks as it did before: the slow way."""
        rng = np.random.default_rng(1)
        motion = np.eye(4)
        motion[:3, 3] = 0.02, -0.01, -0.05
        motion[:3, :3] = rotations(np.array([[0.004, -0.01, 0.003, 1.0]]))[0]
        at = np.stack([rng.uniform(15, 145, 500), rng.uniform(15, 105, 500)], axis=1)
        rays = (at - [self.LENS.right_cx_px, self.LENS.cy_px]) / self.LENS.focal_px
        near = rng.uniform(4, 12, 500)
        points = np.column_stack([rays, near, np.full(500, 0.05)]).astype(np.float32)
        seen = moved(points, motion, self.LENS)
        # Grey between two views is made to agree at a point's places in both, by a grey of the
        # right view that is also the left one's where that point is.
        y, x = np.mgrid[:120, :160].astype(float)
        right = [self.hills(x * 2**k, y * 2**k)[: 120 >> k, : 160 >> k] for k in range(LEVELS)]
        right = [np.ascontiguousarray(level, np.float32) for level in right]
        flat = [np.full_like(level, 128) for level in right]
        grey = np.stack([self.hills(seen[:, 0], seen[:, 2])] * LEVELS).astype(np.float32)
        key = Keyframe(points, grey, np.array([1.0, 0.0, 1.0, 0.0]))
        found = align(key, right, flat, self.LENS, np.eye(4))
        assert np.allclose(found.motion, motion, atol=2e-3)
        assert found.score > 0.9
        for px in (-4, 0, 6):  # starts that turn by other angles mismatch more
            turns = [[0, np.sin((px + off) / 150 / 2), 0, 1] for off in (-6, -2, 0, 3, 6)]
            starts = np.tile(np.eye(4), (5, 1, 1))
            starts[:, :3, :3] = rotations(np.array(turns))
            costs = mismatch(key, right, self.LENS, starts @ motion, near=True)
            assert np.argmin(costs) == {-4: 3, 0: 2, 6: 0}[px]

    def test_measures_what_the_right_view_is_displaced_by(self):
        y, x = np.mgrid[:60, :120].astype(float)
        right = self.hills(x * 3, y * 3).astype(np.float32)
        left = self.hills((x - 6.3) * 3, y * 3).astype(np.float32)
        places = np.array([[40, 30], [55, 20], [80, 41], [3, 30]], np.int32)
        lens = Lens((100.0, 100.0), 61.5, 60.0, 30.0, 0.1)
        found = nearness_of(right, left, places, lens, 20)
        assert found[:3, 0] == pytest.approx(6.3 + 1.5, abs=0.1)
        assert np.isnan(found[3]).all()  # at the border

    def test_too_few_points_are_none(self):
        lens = Lens((100.0, 100.0), 40.0, 40.0, 30.0, 0.1)
        levels = pyramid(np.full((60, 80), 77, np.uint8))
        assert keyframe(levels, levels, lens, 16) is None
