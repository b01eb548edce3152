"""Spatial video (MV-HEVC): a stream that holds the views of both eyes, each coded by itself."""

from __future__ import annotations

import json
import math
from contextlib import ExitStack, closing
from pathlib import Path

import av

from motionstereo_cli.errors import InputError
from motionstereo_cli.sources.container import ALL_VIEWS, Container
from motionstereo_cli.sources.settings import InputSettings
from motionstereo_cli.sources.stereo3d import said_by, view_id
from motionstereo_cli.sources.video import VideoRecording

#: Within this many images each view comes at least once.
_PROBED_IMAGES = 60


def both_views(path: Path | str, settings: InputSettings, track: int) -> list[VideoRecording]:
    """Open the left and the right view of spatial video, each as a recording of its own.

    The file says which view is whose. Where it says the distance between the cameras and the angle
    that an image spans, that makes the calibration.

    Raises:
        InputError: the file cannot be decoded, or only one view is in it.
    """
    eyes = eyes_in(path, settings, track)
    with ExitStack() as opened:
        views = []
        for eye in ("left", "right"):
            view = VideoRecording(
                path,
                rate=settings.rate,
                track=track,
                white=settings.white,
                max_pixels=settings.max_pixels,
                allow_network=settings.allow_network,
                view=eyes[eye],
            )
            opened.enter_context(closing(view))
            view.name = f"{path} ({eye} view)"
            views.append(view)
        said = views[0].said
        if said.baseline_m and 0 < said.width_deg < 180:
            for view, offset_m in zip(views, (0.0, said.baseline_m), strict=True):
                view.camera_info = _camera_info(view, said.width_deg, offset_m)
                view.rectified = True
            views[0].calibration_note = (
                f"{path} says that the cameras are {1000 * said.baseline_m:.4g} mm apart and see "
                f"{said.width_deg:.4g} degrees: depth follows from these nominal values"
            )
        opened.pop_all()
    return views


def eyes_in(path: Path | str, settings: InputSettings, track: int) -> dict[str, int]:
    """Return which view is that of the left and of the right eye."""
    container = Container(
        path,
        max_pixels=settings.max_pixels,
        allow_network=settings.allow_network,
        track=track,
        view=ALL_VIEWS,
    )
    eyes: dict[str, int] = {}
    with closing(container):
        try:
            frames = container.source.decode(container.stream)
            for frame, _ in zip(frames, range(_PROBED_IMAGES), strict=False):
                view = view_id(frame)
                if view is not None and view not in eyes.values():
                    eyes[said_by(frame, None).eye or f"view {view}"] = view
                if len(eyes) == 2:
                    break
        except (av.FFmpegError, OSError):
            pass  # what came before tells, or too little came
    if set(eyes) != {"left", "right"}:
        raise InputError(
            f"{path} is spatial video (MV-HEVC), of which "
            + (
                f"only one view can be decoded ({', '.join(eyes) or 'none'}): another program may "
                "have lost the other one: give the original file"
                if len(eyes) < 2
                else "it is not said which view is left: convert it to views side by side"
            )
        )
    return eyes


def _camera_info(view: VideoRecording, width_deg: float, offset_m: float) -> str:
    """Return ``sensor_msgs/CameraInfo`` as JSON for a camera this far right of the left one."""
    focal_px = view.width / 2 / math.tan(math.radians(width_deg / 2))
    middle = (view.width - 1) / 2, (view.height - 1) / 2
    k = [focal_px, 0.0, middle[0], 0.0, focal_px, middle[1], 0.0, 0.0, 1.0]
    p = [*k[:3], -focal_px * offset_m, *k[3:6], 0.0, *k[6:], 0.0]
    r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    return json.dumps(
        {"width": view.width, "height": view.height, "d": [0.0] * 5, "k": k, "r": r, "p": p}
    )
