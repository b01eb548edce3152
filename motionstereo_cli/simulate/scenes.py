"""Render scenes: the images of both cameras of a rig, with exact truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from motionstereo_cli.simulate.camera import FloorPose, SceneCamera, View, World, stereo_cameras
from motionstereo_cli.simulate.cards import Cards, pan_pose
from motionstereo_cli.simulate.corridor import Corridor
from motionstereo_cli.simulate.layers import Layers
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.simulate.street import Street
from motionstereo_cli.simulate.truth import Places, moving_objects
from motionstereo_cli.types import MovingObject

if TYPE_CHECKING:
    from motionstereo_cli.types import Grey, Real


class SceneFrame(NamedTuple):
    """One moment of a scene.

    Attributes:
        frame: number of the frame in the scene; its time is frame / frame_rate.
        left, right: (height, width) uint8 grey levels, with the sensor's noise.
        disparity_px: (height, width) float32 exact disparity of every pixel centre of the right
            view: rig.disparity_px of the depth.
        pose: where the rig's middle is.
        mover: (height, width) uint8 number of what moves by itself in the right view, 0 = nothing;
            None where the scene does not say.
        objects: the same as objects, with their true speeds.
    """

    frame: int
    left: Grey
    right: Grey
    disparity_px: Real
    pose: FloorPose
    mover: Grey | None = None
    objects: tuple[MovingObject, ...] = ()


class _Scene(NamedTuple):
    """A world, and what moves in it.

    Attributes:
        world: the world.
        pose: where the rig is at a fractional frame number, for a frame duration in s.
        places: where what moves by itself is at a time in s; None where the scene does not say.
    """

    world: World
    pose: Callable[[float, float], FloorPose]
    places: Places | None = None


def _corridor(settings: SimulateSettings) -> _Scene:
    corridor = Corridor(settings.corridor_width_m, settings.corridor_length_m, settings.seed)
    return _Scene(corridor, lambda frame, _: corridor.path(frame))


def _standing(world: World, settings: SimulateSettings, places: Places | None = None) -> _Scene:
    def pose(frame: float, frame_s: float) -> FloorPose:
        return pan_pose(frame * frame_s) if settings.pan else FloorPose(0.0, 0.0, 0.0)

    return _Scene(world, pose, places)


def _cards(settings: SimulateSettings) -> _Scene:
    cards = Cards(settings.rig.focal_px, settings.seed, shadows=settings.shadows)
    return _standing(cards, settings, cards.places)


def _layers(settings: SimulateSettings) -> _Scene:
    return _standing(Layers(stereo_cameras(settings.rig)[1], settings.seed), settings)


def _street(settings: SimulateSettings) -> _Scene:
    length_m = settings.frame_range.stop / settings.frame_rate * settings.street_speed_m_s
    street = Street(
        length_m,
        settings.street_speed_m_s,
        math.radians(settings.street_winding_deg),
        settings.seed,
    )
    return _Scene(street, lambda frame, frame_s: street.path(frame * frame_s), street.places)


_SCENES: dict[str, Callable[[SimulateSettings], _Scene]] = {
    "corridor": _corridor,
    "cards": _cards,
    "layers": _layers,
    "street": _street,
}

#: Moments of an open shutter that are averaged.
_MOMENTS = 7
#: Phase of a flickering lamp from frame to frame, in cycles; its light rolls over the rows.
_FLICKER_CYCLES = 0.37


def render_scene(settings: SimulateSettings) -> Iterator[SceneFrame]:
    """Yield the frames of ``settings.frame_range``.

    A frame depends on its number and the settings, not on which others are rendered.
    """
    rig = settings.rig
    cameras = stereo_cameras(rig)
    scene = _SCENES[settings.scene](settings)
    frame_s = 1 / settings.frame_rate
    moments = np.linspace(-0.5, 0.5, _MOMENTS) * settings.shutter

    def view(camera: SceneCamera, moment: float) -> View:
        return scene.world.render(scene.pose(moment, frame_s), camera, moment * frame_s)

    for frame in settings.frame_range:
        views = [view(camera, frame) for camera in cameras]
        greys = [one.grey for one in views]
        if settings.shutter:
            greys = [
                np.mean([view(camera, frame + moment).grey for moment in moments], axis=0)
                for camera in cameras
            ]
        if settings.flicker:
            turn = _FLICKER_CYCLES * frame + np.arange(rig.height)[:, None] / rig.height
            light = (1 + settings.flicker * np.sin(math.tau * turn)).astype(np.float32)
            greys = [light * grey for grey in greys]
        greys[0] = np.float32(settings.left_gain) * greys[0] + np.float32(settings.left_offset)
        left, right = (
            _compressed(
                exposed(grey, settings.noise_sigma, (settings.seed, 1, frame, side)),
                settings.jpeg_quality,
            )
            for side, grey in enumerate(greys)
        )
        mover, objects = views[1].mover, tuple[MovingObject, ...]()
        if mover is not None and scene.places is not None:
            objects = tuple(
                moving_objects(
                    *(mover, views[1].depth_m, frame * frame_s),
                    lambda time_s: scene.pose(time_s / frame_s, frame_s),
                    scene.places,
                )
            )
        yield SceneFrame(
            frame=frame,
            left=left,
            right=right,
            disparity_px=rig.disparity_px(views[1].depth_m),
            pose=scene.pose(frame, frame_s),
            mover=mover,
            objects=objects,
        )


def _compressed(grey: Grey, quality: int) -> Grey:
    """Return an image after JPEG compression of a quality; unchanged for quality 0."""
    if not quality:
        return grey
    _, data = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)  # type: ignore[return-value]


def exposed(grey: Real, noise_sigma: float, seed: tuple[int, ...]) -> Grey:
    """Return an image with the sensor's noise, rounded; the noise depends only on ``seed``."""
    if noise_sigma:
        noise = np.random.default_rng(seed).standard_normal(grey.shape, np.float32)
        grey = grey + np.float32(noise_sigma) * noise
    return np.rint(grey).clip(0, 255).astype(np.uint8)
