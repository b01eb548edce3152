"""From settings to frames: what the cameras of a rig record, with the exact truth."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from motionstereo_cli.simulate.camera import Pose, World, stereo_cameras
from motionstereo_cli.simulate.cards import Cards, pan_pose
from motionstereo_cli.simulate.corridor import Corridor
from motionstereo_cli.simulate.settings import SimulateSettings

if TYPE_CHECKING:
    from motionstereo_cli.types import Grey, Real


class SceneFrame(NamedTuple):
    """One moment of a scene.

    Attributes:
        frame: number of the frame in the scene; its time is frame / frame_rate.
        left, right: (height, width) uint8 grey levels, with the sensor's noise.
        disparity_px: (height, width) float32 exact disparity of every pixel centre of the right
            view: focal_px * baseline_m / depth.
        pose: where the rig's middle is.
    """

    frame: int
    left: Grey
    right: Grey
    disparity_px: Real
    pose: Pose


def render_scene(settings: SimulateSettings) -> Iterator[SceneFrame]:
    """Yield the frames of ``settings.frame_range``.

    A frame depends on its number and the settings, not on which others are rendered.
    """
    rig = settings.rig
    cameras = stereo_cameras(rig)
    world: World
    if settings.scene == "corridor":
        corridor = Corridor(settings.corridor_width_m, settings.corridor_length_m, settings.seed)
        world = corridor
    else:
        world = Cards(rig.focal_px, settings.seed)
    for frame in settings.frame_range:
        time_s = frame / settings.frame_rate
        if settings.scene == "corridor":
            pose = corridor.path(frame)
        else:
            pose = pan_pose(time_s) if settings.pan else Pose(0.0, 0.0, 0.0)
        left, right = (world.render(pose, camera, time_s) for camera in cameras)
        yield SceneFrame(
            frame=frame,
            left=exposed(left.grey, settings.noise_sigma, (settings.seed, 1, frame, 0)),
            right=exposed(right.grey, settings.noise_sigma, (settings.seed, 1, frame, 1)),
            disparity_px=rig.focal_px * rig.baseline_m / right.depth_m,
            pose=pose,
        )


def exposed(grey: Real, noise_sigma: float, seed: tuple[int, ...]) -> Grey:
    """Return an image with the sensor's noise, which ``seed`` alone decides on, rounded."""
    if noise_sigma:
        noise = np.random.default_rng(seed).standard_normal(grey.shape, np.float32)
        grey = grey + np.float32(noise_sigma) * noise
    return np.rint(grey).clip(0, 255).astype(np.uint8)
