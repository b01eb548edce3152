"""--save bag: what other readers find in it is what the run found."""

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
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.simulate.write import simulate
from motionstereo_cli.sinks.bag import TOPICS
from motionstereo_cli.sinks.images import depth_png
from motionstereo_cli.sinks.outputs import OUTPUTS
from motionstereo_cli.sinks.sink import RunContext
from motionstereo_cli.types import Rig, StereoFrame

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
    return list(process(frames, SETTINGS, RIG))


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
        found = {topic: [] for topic in TOPICS}
        for connection, stamp_ns, raw in reader.messages():
            found[connection.topic].append((stamp_ns, reader.deserialize(raw, connection.msgtype)))
    for result, (stamp_ns, depth) in zip(results, found["/depth/image_rect"], strict=True):
        assert stamp_ns == result.frame.pts * 10**6
        assert depth.header.stamp.nanosec == stamp_ns
        assert depth.encoding == "16UC1"
        image = depth.data.view(np.uint16).reshape(48, 64)
        np.testing.assert_array_equal(image, depth_png(result.depth_m))
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
    assert sorted(path.name for path in out.iterdir()) == ["results.mcap", "run.json"]
    assert main(["run", *clip[:2], "--save", "bag", "-o", str(tmp_path / "none")]) == 2
