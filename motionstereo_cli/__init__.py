"""Depth and steering from what moves in two stereo videos."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from motionstereo_cli.errors import MotionStereoError
    from motionstereo_cli.method.matching import register_matcher
    from motionstereo_cli.method.settings import Settings
    from motionstereo_cli.pipeline import process
    from motionstereo_cli.rig.calibration import rectify_source
    from motionstereo_cli.rig.poses import read_poses
    from motionstereo_cli.rig.rig_file import read_rig
    from motionstereo_cli.rig.settings import PoseSettings, RigSettings
    from motionstereo_cli.runs.plan import RunPlan
    from motionstereo_cli.runs.run import run
    from motionstereo_cli.sources.opening import open_stereo
    from motionstereo_cli.sources.settings import InputSettings, adapted_rig
    from motionstereo_cli.types import FrameResult, MovingObject, Pose, Rig, Steering, StereoFrame

__version__ = "0.1.0"

__all__ = [
    "FrameResult",
    "InputSettings",
    "MotionStereoError",
    "MovingObject",
    "Pose",
    "PoseSettings",
    "Rig",
    "RigSettings",
    "RunPlan",
    "Settings",
    "Steering",
    "StereoFrame",
    "adapted_rig",
    "open_stereo",
    "process",
    "read_poses",
    "read_rig",
    "rectify_source",
    "register_matcher",
    "run",
]

_MODULES = {
    "errors": ("MotionStereoError",),
    "pipeline": ("process",),
    "rig.calibration": ("rectify_source",),
    "rig.poses": ("read_poses",),
    "rig.rig_file": ("read_rig",),
    "rig.settings": ("PoseSettings", "RigSettings"),
    "method.matching": ("register_matcher",),
    "method.settings": ("Settings",),
    "runs.plan": ("RunPlan",),
    "runs.run": ("run",),
    "sources.settings": ("InputSettings", "adapted_rig"),
    "sources.opening": ("open_stereo",),
    "types": ("FrameResult", "MovingObject", "Pose", "Rig", "Steering", "StereoFrame"),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import names on demand, so that the program starts quickly."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
