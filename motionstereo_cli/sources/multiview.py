"""Spatial video (MV-HEVC): one stream with the views of both eyes."""

from __future__ import annotations

import json
import math
from contextlib import closing
from pathlib import Path

import av

from motionstereo_cli.errors import InputError
from motionstereo_cli.sources.container import ALL_VIEWS, Container
from motionstereo_cli.sources.recording import Recording
from motionstereo_cli.sources.settings import InputSettings
from motionstereo_cli.sources.stereo3d import view_id, view_metadata

#: Number of images among which each view occurs.
_PROBED_IMAGES = 60


def eyes_in(path: Path | str, settings: InputSettings, track: int) -> dict[str, int]:
    """Return which view of a multiview stream is that of the ``left`` and of the ``right`` eye.

    Raises:
        InputError: one cannot be decoded, or the stream does not say.
    """
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
                    eyes[view_metadata(frame, None).eye or f"view {view}"] = view
                if len(eyes) == 2:
                    break
        except (av.FFmpegError, OSError):
            pass  # decided by the images so far, or there are too few
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


def add_nominal_rig(path: str, left: Recording, right: Recording) -> None:
    """Give both views a calibration from the camera data in the file.

    Without the distance of the cameras and their angle of view they get none.
    """
    metadata = left.metadata
    if not (metadata.baseline_m and 0 < metadata.width_deg < 180):
        return
    for view, offset_m in ((left, 0.0), (right, metadata.baseline_m)):
        view.camera_info = _camera_info(view, metadata.width_deg, offset_m)
        view.rectified = True
    left.calibration_note = (
        f"{path} says that the cameras are {1000 * metadata.baseline_m:.4g} mm apart and see "
        f"{metadata.width_deg:.4g} degrees: depth follows from these nominal values"
    )


def _camera_info(view: Recording, width_deg: float, offset_m: float) -> str:
    """Return ``sensor_msgs/CameraInfo`` as JSON for a camera this far right of the left one."""
    focal_px = view.width / 2 / math.tan(math.radians(width_deg / 2))
    middle = (view.width - 1) / 2, (view.height - 1) / 2
    k = [focal_px, 0.0, middle[0], 0.0, focal_px, middle[1], 0.0, 0.0, 1.0]
    p = [*k[:3], -focal_px * offset_m, *k[3:6], 0.0, *k[6:], 0.0]
    r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    return json.dumps(
        {"width": view.width, "height": view.height, "d": [0.0] * 5, "k": k, "r": r, "p": p}
    )
