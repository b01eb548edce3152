"""What the paper says of frames of its corridor, on the rendered one: figures 2 and 3."""

import numpy as np
import pytest

from motionstereo_cli.method.settings import Settings
from motionstereo_cli.pipeline import process
from motionstereo_cli.simulate.scenes import render_scene
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.types import StereoFrame

#: Frames that a heading takes to settle.
BEFORE = 5


@pytest.mark.parametrize(
    ("frame", "end_m", "turns"),
    [
        (265, 17.6, False),
        (280, 15.2, False),
        (300, 12.0, False),
        (350, 4.0, None),
        (370, 20.1, True),
        (380, 19.2, False),
    ],
)
def test_the_end_of_the_corridor_is_seen_where_it_is(frame, end_m, turns):
    """The end comes nearer, its wall turns away, and the next side of the square opens."""
    scene = SimulateSettings(frames=f"{frame - BEFORE}:{frame + 1}", noise_sigma=1.5)
    shots = list(render_scene(scene))
    views = [StereoFrame(i, i, None, shot.left, shot.right) for i, shot in enumerate(shots)]
    *_, last = process(views, Settings(depth_of="all"), scene.rig, with_objects=False)
    truth_m = scene.rig.depth_m(shots[-1].disparity_px)
    end = np.abs(truth_m / end_m - 1) < 0.03
    assert end.sum() > 1000
    found_m = last.depth_m[end]
    assert (~np.isnan(found_m)).mean() > 0.95
    assert np.nanmedian(found_m) == pytest.approx(end_m, rel=0.11)
    if turns is None:  # the wall fills the view
        assert last.steering.status == "blind"
    else:
        assert (last.steering.steer > 0.2) == turns
        assert abs(last.steering.steer) < 0.1 or turns
