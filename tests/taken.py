"""What sinks take, made of results, and a folder for what they write."""

from pathlib import Path

from motionstereo_cli.robot.mapper import camera_points
from motionstereo_cli.runs.folder import RunFolder
from motionstereo_cli.runs.folder_files import head
from motionstereo_cli.sinks.outputs import OUTPUTS
from motionstereo_cli.types import FrameImages, FrameResult, Rig, Step


def step_of(result: FrameResult, rig: Rig | None = None, reference: str = "right") -> Step:
    """The step of a result, with images and, where there is a rig, with points."""
    names = "charge", "disparity_px", "bands", "motion", "age_frames", "confidence", "depth_m"
    images = {name: getattr(result, name) for name in names}
    view, points = getattr(result.frame, reference), None
    if rig is not None and result.depth_m is not None:
        points = camera_points(result.depth_m, view, result.motion, reference, rig)
    return Step(
        time=result.frame.time,
        steering=result.steering,
        objects=result.objects,
        pose=result.pose,
        charged=result.charged,
        matched=result.matched,
        points=points,
        images=FrameImages(result.frame.time, view, **images),
    )


def taken(name: str, result: FrameResult, reference: str = "right") -> FrameImages | Step:
    """What the sink of an output takes of a result."""
    step = step_of(result, reference=reference)
    return step.images if OUTPUTS[name].takes == "images" else step


def prepared(out: Path, save: tuple[str, ...], **how) -> RunFolder:
    """The folder of a run, ready for its outputs."""
    folder = RunFolder(out, save, identity=head(save), **how)
    folder.prepare()
    return folder
