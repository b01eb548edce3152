"""What the presets make of the same frames, as a picture: ``python -m bench presets OUT.jpg``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from motionstereo_cli.files.lettering import DARK, titled
from motionstereo_cli.method.matching import match
from motionstereo_cli.method.memory import see
from motionstereo_cli.method.settings import PRESETS, Settings
from motionstereo_cli.simulate.scenes import render_scene
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.sinks.drawing import coloured
from motionstereo_cli.sinks.scale import DepthScale

if TYPE_CHECKING:
    from numpy.typing import NDArray

#: In so many frames the memories charge; the last one is shown.
_FRAMES = "0:20"
SCENES: dict[str, dict[str, Any]] = {
    "street": {"scene": "street", "seed": 1},
    "layers, left camera brighter": {"scene": "layers", "left_gain": 1.05, "left_offset": 6},
}
_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 80)


def sheet(width: int = 324) -> NDArray[np.uint8]:
    """Return a row of panels for each scene: image, truth, and each preset, RGB."""
    rows = []
    for title, values in SCENES.items():
        settings = SimulateSettings(
            width=width, height=width * 2 // 3, noise_sigma=1.5, frames=_FRAMES, **values
        )
        shots = list(render_scene(settings))
        found = {"truth": shots[-1].disparity_px}
        for name in PRESETS:
            s, right, left = Settings.preset(name), None, None
            for shot in shots:
                right, left = see(right, shot.right, s), see(left, shot.left, s)
            assert right is not None
            assert left is not None
            found[name] = match(right, left, s)[0]
        panels = [np.repeat(shots[-1].right[..., None], 3, axis=2)]
        panels += [coloured(px, DepthScale(Settings().max_disparity)) for px in found.values()]
        rows.append(titled(panels, (title, *found), DARK))
    return np.concatenate(rows)


def main(args: Sequence[str] | None = None) -> None:
    """Draw, and write the picture."""
    parser = argparse.ArgumentParser(prog="python -m bench presets")
    parser.add_argument("out", type=Path)
    given = parser.parse_args(args)
    if not cv2.imwrite(str(given.out), cv2.cvtColor(sheet(), cv2.COLOR_RGB2BGR), _JPEG):
        parser.error(f"cannot write {given.out}")
