"""--save bag: what other readers find in it is what the run found."""

import dataclasses
import json
import math
import re
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from taken import taken

from motionstereo_cli.__main__ import main
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.pipeline import process
from motionstereo_cli.rig.pose_forms import rotations
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.simulate.write import simulate
from motionstereo_cli.sinks.bag import TOPICS
from motionstereo_cli.sinks.images import depth_png
from motionstereo_cli.sinks.outputs import OUTPUTS
from motionstereo_cli.sinks.sink import RunContext
from motionstereo_cli.types import MovingObject, Pose, Rig, Steering, StereoFrame

RIG = Rig(width=64, height=48, focal_px=50.0, baseline_m=0.1, cx=31.5, cy=23.5, doffs=2.0)
SETTINGS = Settings(max_disparity=16, speckle_px=0, min_votes=1)
BASE = Fraction(1, 1000)


@pytest.fixture(scope="module")
def results():
    texture = np.random.default_rng(0).integers(0, 256, (48, 120), np.uint8)
    frames = [
        StereoFrame(n, 40 * n, n / 25, texture[:, x : x + 64], texture[:, x + 4 : x + 68])
        for n, x in enumerate(range(0, 24, 2))
    ]
    # A flat scene has no heading.
    steering = Steering("ok", 0.1, 0.2, 3.0, 2.0)
    return [
        dataclasses.replace(result, steering=steering) for result in process(frames, SETTINGS, RIG)
    ]


def messages_of(path):
    """Stamps and messages by topic."""
    found = {topic: [] for topic in TOPICS}
    with AnyReader([path]) as reader:
        for connection, stamp_ns, raw in reader.messages():
            found[connection.topic].append((stamp_ns, reader.deserialize(raw, connection.msgtype)))
    return found


def xyz(vector):
    return (vector.x, vector.y, vector.z)


def written(folder: Path, results, *, checkpoints=()):
    context, since = RunContext(BASE, SETTINGS, RIG), None
    sink = OUTPUTS["bag"].open(folder, context)
    for number, result in enumerate(results):
        if number in checkpoints:
            since = sink.checkpoint()
            sink = OUTPUTS["bag"].open(folder, context, since)
        sink.write(taken("bag", result))
    sink.close()
    return folder / "results.mcap"


def test_both_readers_find_what_the_run_found(results, tmp_path):
    path = written(tmp_path, results)
    with AnyReader([path]) as reader:
        assert {c.topic: c.msgtype for c in reader.connections} == TOPICS
    found = messages_of(path)
    for result, (stamp_ns, depth) in zip(results, found["/depth/image_rect"], strict=True):
        assert stamp_ns == result.frame.pts * 10**6
        assert depth.header.stamp.nanosec == stamp_ns
        assert depth.encoding == "16UC1"
        image = depth.data.view(np.uint16).reshape(48, 64)
        np.testing.assert_array_equal(image, depth_png(result.disparity_px, RIG))
    last, (_, disparity) = results[-1], found["/disparity"][-1]
    values = disparity.image.data.view(np.float32).reshape(48, 64)
    known = ~np.isnan(last.disparity_px)
    assert known.any()
    np.testing.assert_allclose(disparity.f * disparity.t / values[known], last.depth_m[known], 1e-6)
    assert (values[~known] < disparity.min_disparity).all()
    _, charge = found["/charge/compressed"][-1]
    np.testing.assert_array_equal(cv2.imdecode(charge.data, cv2.IMREAD_UNCHANGED), last.charge)
    _, heading = found["/steering"][-1]
    yaw_rad = 2 * np.arctan2(heading.pose.orientation.z, heading.pose.orientation.w)
    assert yaw_rad == pytest.approx(last.steering.steer_rad)
    assert heading.header.frame_id == "camera_link"
    for (_, array), result in zip(found["/objects"], results, strict=True):
        assert len(array.markers) == 1 + len(result.objects)
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert {c.topic for c in summary.channels.values()} == set(TOPICS)
        assert summary.statistics.message_count == sum(map(len, found.values()))


def test_poses_are_a_path_and_transforms(results, tmp_path):
    places = [(0.5 * n, 0.1, 0.0) for n in range(len(results))]
    turn = (0.0, 0.0, math.sin(0.2), math.cos(0.2))
    moved = [
        dataclasses.replace(result, pose=Pose(*place, *turn))
        for result, place in zip(results, places, strict=True)
    ]
    path = written(tmp_path, moved, checkpoints=(5,))
    found = messages_of(path)
    for (stamp_ns, message), place in zip(found["/tf"], places, strict=True):
        (at,) = message.transforms
        assert (at.header.frame_id, at.child_frame_id) == ("map", "camera_link")
        assert at.header.stamp.nanosec == stamp_ns
        assert xyz(at.transform.translation) == pytest.approx(place)
        assert at.transform.rotation.z == pytest.approx(turn[2])
    ((stamp_ns, whole),) = found["/path"]
    assert stamp_ns == found["/tf"][0][0]
    np.testing.assert_allclose([xyz(pose.pose.position) for pose in whole.poses], places)
    ((_, static),) = found["/tf_static"]
    (at,) = static.transforms
    assert (at.header.frame_id, at.child_frame_id) == ("camera_link", "camera_optical_frame")
    # The right camera is half a baseline to the right of the middle; its z is the rig's x.
    assert xyz(at.transform.translation) == pytest.approx((0, -RIG.baseline_m / 2, 0))
    q = at.transform.rotation
    turned = rotations(np.array([[q.x, q.y, q.z, q.w]]))[0]
    np.testing.assert_allclose(turned @ [0, 0, 1], [1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(turned @ [1, 0, 0], [0, -1, 0], atol=1e-9)


def test_a_long_path_is_thinned(results, tmp_path, monkeypatch):
    monkeypatch.setattr("motionstereo_cli.sinks.bag._MAX_PATH", 5)
    moved = [
        dataclasses.replace(result, pose=Pose(n, 0, 0, 0, 0, 0, 1))
        for n, result in enumerate(results)
    ]
    ((_, whole),) = messages_of(written(tmp_path, moved))["/path"]
    assert [pose.pose.position.x for pose in whole.poses] == [0, 4, 8]


def test_view_points_and_numbers(results, tmp_path):
    found = messages_of(written(tmp_path, results))
    last = results[-1]
    _, view = found["/view/image_rect/compressed"][-1]
    shown = cv2.imdecode(view.data, cv2.IMREAD_UNCHANGED)
    assert np.abs(shown.astype(int) - last.frame.right).mean() < 8  # a noisy texture, as JPEG
    _, cloud = found["/points"][-1]
    table = cloud.data.view(np.dtype([("xyz", "<f4", 3), ("bgr", "u1", 3), ("", "u1")]))
    known = ~np.isnan(last.depth_m)
    assert len(table) == cloud.width == known.sum()
    np.testing.assert_allclose(table["xyz"][:, 2], last.depth_m[known], 1e-6)
    np.testing.assert_array_equal(table["bgr"][:, 1], last.frame.right[known])
    assert found["/plot/charged"][-1][1].data == pytest.approx(last.charged)
    assert found["/plot/heading_rad"][-1][1].data == pytest.approx(last.steering.steer_rad)
    layout = json.loads((tmp_path / "layout.json").read_text())
    named = re.findall(r"/[a-z_]+(?:/[a-z_]+)*", json.dumps(layout))
    assert named
    assert set(named) <= set(TOPICS)


def test_what_moves_by_itself_is_told_apart(results, tmp_path):
    about = {"x": 8, "y": 8, "width": 16, "height": 12, "depth_m": 2.0}
    objects = tuple(
        MovingObject(
            id=number,
            **about,
            closing_mps=0.5,
            time_to_contact_s=4.0,
            confidence=0.8,
            velocity_mps=(0.6, 0.8),
            by_itself=by_itself,
            shadow=number == 3,
        )
        for number, by_itself in ((1, True), (2, False), (3, True))
    )
    result = dataclasses.replace(results[-1], objects=objects)
    ((_, array),) = messages_of(written(tmp_path, [result]))["/objects"]
    first, cube, text, other, shadow = array.markers
    assert (first.action, cube.id, other.id, shadow.id) == (3, 1, 2, 3)
    assert text.text == "#1, 1.0 m/s, contact in 4.0 s"
    assert cube.color.r > 2 * cube.color.g
    assert other.color.r == pytest.approx(other.color.g)
    assert shadow.color == other.color


def test_where_a_run_was_interrupted_makes_no_difference(results, tmp_path):
    (tmp_path / "one").mkdir()
    (tmp_path / "other").mkdir()
    whole = written(tmp_path / "one", results, checkpoints=(5, 10)).read_bytes()
    assert written(tmp_path / "other", results, checkpoints=(5, 10)).read_bytes() == whole
    (tmp_path / "third").mkdir()
    assert written(tmp_path / "third", results).read_bytes() == whole


def test_run_writes_a_bag(tmp_path):
    simulate(tmp_path / "clip", SimulateSettings(frames="300:304", width=96, height=64))
    clip = [str(tmp_path / "clip" / name) for name in ("left.mp4", "right.mp4", "rig.yaml")]
    out = tmp_path / "out"
    assert main(["run", *clip[:2], "--rig", clip[2], "--save", "bag", "-o", str(out)]) == 0
    assert sorted(path.name for path in out.iterdir()) == [
        *("layout.json", "results.mcap", "run.json")
    ]
    assert main(["run", *clip[:2], "--save", "bag", "-o", str(tmp_path / "none")]) == 2
