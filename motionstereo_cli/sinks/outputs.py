"""The table of outputs: path, content and sink of each.

A sink's module is imported when its output is requested.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from motionstereo_cli.errors import SettingsError
from motionstereo_cli.files.folders import make_folder
from motionstereo_cli.method.settings import OCCLUSION

if TYPE_CHECKING:
    from pathlib import Path

    from motionstereo_cli.sinks.records import RunRecord
    from motionstereo_cli.sinks.sink import RunContext, Sink

Kind = Literal["disparity", "depth", "table", "other"]
Input = Literal["images", "step"]


@dataclass(frozen=True, slots=True)
class Output:
    """An output that ``--save`` can request.

    Attributes:
        path: its path under the output folder; ``{:06d}`` is the number of the frame.
        what: what it holds, with units.
        sink: module and class (or function) of the sink, made from its path, the run's context
            and a checkpoint.
        takes: what its sink takes of each frame: its ``images``, which depend on single frames, or
            its ``step``, which is sequential; None: it has no sink.
        shows_images: the steps that it takes include images.
        shows_colours: it shows the colours of the reference view.
        shows_scale: it shows depth in colours of the run's scale.
        extras: the :data:`motionstereo_cli.pipeline.EXTRAS` that it needs.
        needs_rig: it needs a rig.
        needs_poses: it needs poses; if none are given, they are found from the recording.
        needs_objects: it needs moving objects.
        needs_movers: with a rig, it needs movers, and so the rig's own motion.
        needs_points: the steps that it takes include points.
        beside: further files that come with it.
        brings: other outputs that come with it, because it is made from them.
        finish: module and function that make it from the folder and the record, after all other
            outputs are complete.
        without_rig: the output that replaces it without a rig.
        max_view_px: largest longer side of views that can be written.
        kind: what its files hold for readers: images of disparity or of depth, a table, or other.
    """

    path: str
    what: str
    sink: str = ""
    takes: Input | None = "images"
    shows_images: bool = False
    shows_colours: bool = False
    shows_scale: bool = False
    extras: tuple[str, ...] = ()
    needs_rig: bool = False
    needs_poses: bool = False
    needs_objects: bool = False
    needs_movers: bool = False
    needs_points: bool = False
    beside: tuple[str, ...] = ()
    brings: tuple[str, ...] = ()
    finish: str = ""
    without_rig: str = ""
    max_view_px: float = math.inf
    kind: Kind = "other"

    @property
    def paths(self) -> tuple[str, ...]:
        """All its files, in the form of ``path``."""
        return (self.path, *self.beside)

    @property
    def is_video(self) -> bool:
        """Whether it is a video."""
        return self.path.endswith((".mp4", ".mkv"))

    @property
    def shown(self) -> str:
        """The path as told to users: a folder for numbered files."""
        return self.path.partition("{")[0]

    def open(self, out: Path, stream: RunContext, since: object = None) -> Sink[Any]:
        """Return the output's sink for a run into the folder ``out``.

        Args:
            out: the folder.
            stream: the run's context.
            since: continue from this checkpoint of the same output in the same folder.

        Raises:
            OutputError: the output cannot be written, or is not what the checkpoint says.
        """
        make_folder((out / self.path).parent, out)
        sink: Sink[Any] = _named(f"sinks.{self.sink}")(out / self.path, stream, since)
        return sink

    def complete(self, out: Path, record: RunRecord) -> None:
        """Make the output from the other outputs, if it is such an output.

        Args:
            out: the folder, in which the others are complete.
            record: the run's record.

        Raises:
            OutputError: it cannot be written.
        """
        if self.finish:
            _named(self.finish)(out, out / self.path, record)


def _named(name: str) -> Callable[..., Any]:
    module, _, function = name.rpartition(".")
    found: Callable[..., Any] = getattr(
        importlib.import_module(f"motionstereo_cli.{module}"), function
    )
    return found


#: Largest side of H.264 images in px, with room for the scale below depth.
MAX_VIDEO_PX = 16_384 - 128

#: The record of a run. Written last; until then its ``.part`` lists what is being written.
RECORD = "run.json"

#: The map's floor plane, and the place and scale of that picture.
MAP_PICTURE, MAP_PLACE = "map.png", "map.yaml"

#: Names follow one scheme: PNG images have the bare name of their content, other formats add a
#: suffix, and -video is a video to look at. Only for the charge the bare name is the video.
_DEPTH = ("depth_m",)

OUTPUTS = {
    "steering": Output(
        "steering.csv",
        "one row for each frame; time_s in s, steer -1..1 and steer_rad in rad with positive = "
        "left, depth_m and nearest_m in m, charged and matched as shares of the image, "
        "risk_s in s until contact in the way steered; empty = unknown",
        "steering_table.SteeringFile",
        kind="table",
        takes="step",
    ),
    "steering-jsonl": Output(
        "steering.jsonl",
        "the same as JSON lines, one object for each frame; null = unknown",
        "steering_table.SteeringFile",
        takes="step",
    ),
    "objects": Output(
        "objects.csv",
        "a row for each moving object of each frame: box in px of the reference view, depth_m in "
        "m, closing_mps in m/s with positive = approaching, time_to_contact_s in s, confidence "
        "0..1; over_ground_mps and sigma_mps in m/s, direction_rad in the world, by_itself 0 or 1, "
        "shadow 0 or 1 = as deep as what lies beside it; "
        "empty = unknown",
        "objects_table.ObjectsFile",
        kind="table",
        takes="step",
        needs_objects=True,
        needs_movers=True,
    ),
    "depth": Output(
        "depth/{:06d}.png",
        "uint16 depth in mm (or --depth-scale units per m), reference view; "
        "0 = unknown or over 65535 units",
        "images.depth",
        needs_rig=True,
        kind="depth",
        without_rig="disparity",
    ),
    "depth-pfm": Output(
        "depth-pfm/{:06d}.pfm",
        "float32 depth in m, reference view; inf = unknown",
        "images.depth_m",
        needs_rig=True,
        kind="depth",
        extras=_DEPTH,
        without_rig="disparity-pfm",
    ),
    "depth-tiff": Output(
        "depth-tiff/{:06d}.tiff",
        "float32 depth in m, reference view; NaN = unknown",
        "images.depth_m",
        needs_rig=True,
        kind="depth",
        extras=_DEPTH,
    ),
    "depth-mkv": Output(
        "depth.mkv",
        "lossless video (FFV1, gray16le) of the images of depth; times in whole ms",
        "videos.depth_lossless",
        needs_rig=True,
    ),
    "depth-video": Output(
        "depth.mp4",
        "depth in colour (--colours; by default near = yellow, far = violet), the reference view "
        "in grey = unknown; logarithmic scale from near_m to far_m or, without a rig, near_px to "
        "far_px (output_settings); below it (legend) a strip with that scale and the time",
        "videos.depth",
        shows_scale=True,
        max_view_px=MAX_VIDEO_PX,
    ),
    "disparity": Output(
        "disparity/{:06d}.png",
        "uint16 disparity in 1/256 px, reference view; 0 = unknown, a known 0 is stored as 1",
        "images.disparity",
        kind="disparity",
    ),
    "disparity-pfm": Output(
        "disparity-pfm/{:06d}.pfm",
        "float32 disparity in px, reference view; inf = unknown",
        "images.disparity_px",
        kind="disparity",
    ),
    "age": Output(
        "age/{:06d}.png",
        "uint8 frames since something moved there, reference view; 255 = forgotten",
        "images.age",
        extras=("age_frames",),
    ),
    "confidence": Output(
        "confidence/{:06d}.png",
        "uint8 chance that the disparity is right within 1 px, in 1/255, reference view; "
        "0 = no disparity",
        "images.confidence",
        extras=("confidence",),
    ),
    "sigma": Output(
        "sigma/{:06d}.pfm",
        "float32 standard deviation of the disparity in px, reference view; inf = unknown",
        "images.sigma",
        extras=("sigma_px",),
    ),
    "depth-sigma": Output(
        "depth-sigma/{:06d}.pfm",
        "float32 standard deviation of the depth in m, reference view; inf = unknown",
        "images.depth_sigma",
        needs_rig=True,
        extras=("sigma_px", "depth_m"),
    ),
    "occlusion": Output(
        "occlusion/{:06d}.png",
        "uint8 why the disparity is unknown, reference view; "
        + ", ".join(f"{code} = {what}" for code, what in OCCLUSION.items()),
        "images.occlusion",
        extras=("occlusion",),
    ),
    "bands": Output(
        "bands/{:06d}.png",
        "grey-level bands 1..n, reference view; uint8, or uint16 for 256 bands",
        "images.bands",
    ),
    "bands-video": Output(
        "bands.mp4",
        "grey-level bands, reference view; 1..n as black..white",
        "videos.bands",
        max_view_px=MAX_VIDEO_PX,
    ),
    "motion": Output(
        "motion/{:06d}.png",
        "uint8, reference view; 255 = the band has just changed, 0 = it has not",
        "images.motion",
    ),
    "motion-video": Output(
        "motion.mp4", "the images of motion as video", "videos.motion", max_view_px=MAX_VIDEO_PX
    ),
    "view-video": Output(
        "view.mp4",
        "the reference view as it was processed, in colour where it has any",
        "videos.view",
        shows_colours=True,
        max_view_px=MAX_VIDEO_PX,
    ),
    "preview": Output(
        "preview.mp4",
        "to show to others: reference view with the heading as an arrow and what moves "
        "by itself in boxes (id, speed over ground, time to contact), charge and depth beside "
        "each other, with scale and time, and the map so far if it is saved too; panels of at most "
        "640 px",
        "preview.Preview",
        shows_colours=True,
        takes="step",
        shows_images=True,
        shows_scale=True,
        needs_objects=True,
        needs_movers=True,
    ),
    "report": Output(
        "report.html",
        "all of it as one page for a browser; it brings the outputs that it shows",
        brings=("steering", "objects", "depth", "view-video", "charge", "depth-video"),
        takes=None,
        finish="report.run_page.write_page",
    ),
    "charge": Output(
        "charge.mp4",
        "permanency memory of the reference view, charge as grey",
        "videos.charge",
        max_view_px=MAX_VIDEO_PX,
    ),
    "charge-png": Output(
        "charge-png/{:06d}.png",
        "uint8 permanency memory of the reference view, the charge itself",
        "images.charge",
    ),
    "own-charge": Output(
        "own-charge.mp4",
        "permanency memory, as grey, of what moves by itself, whatever the rig does: change of the "
        "reference view that the rig's own motion does not explain; all change where the rig "
        "stands still",
        "videos.own_charge",
        needs_rig=True,
        needs_movers=True,
        max_view_px=MAX_VIDEO_PX,
    ),
    "own-charge-png": Output(
        "own-charge-png/{:06d}.png",
        "uint8 permanency memory of what moves by itself, the charge itself",
        "images.own_charge",
        needs_rig=True,
        needs_movers=True,
    ),
    "points": Output(
        "points/{:06d}.ply",
        "all that has a depth as points, x right, y down, z forward of the reference camera "
        "in m, with the colour of the reference view",
        "points.NumberedClouds",
        shows_colours=True,
        needs_rig=True,
        extras=_DEPTH,
    ),
    "bag": Output(
        "results.mcap",
        "ROS 2 bag with the stamps of the input: the view (JPEG) and depth (16UC1, mm) with "
        "camera_info, DisparityImage (32FC1, px), charge (PNG), some 20,000 points of each frame, "
        "steering (PoseStamped in camera_link, REP 103), objects (MarkerArray), numbers to plot, "
        "and with poses /tf and the path in map; images, points and objects in the optical frame "
        "of the input or camera_optical_frame, placed by /tf_static; layout.json shows all of it "
        "in Foxglove",
        "bag.BagFile",
        needs_rig=True,
        needs_objects=True,
        needs_movers=True,
        takes="step",
        extras=_DEPTH,
        shows_images=True,
        shows_colours=True,
        beside=("layout.json",),
    ),
    "poses": Output(
        "poses.txt",
        "where the rig was, TUM form: time_s x_m y_m z_m qx qy qz qw of the point halfway between "
        "the cameras, x forward, y left, z up, in the world of --poses or, where they are found "
        "from the recording, of the first frame; frames where the rig was lost are left out; "
        "place of the image in the recording, from 0, in place of the time where it has none",
        "poses_table.TumFile",
        takes="step",
        needs_rig=True,
        needs_poses=True,
    ),
    "poses-kitti": Output(
        "poses-kitti.txt",
        "the same in KITTI's form, a row for each image of the recording up to the last one that "
        "is used: the first three rows of the matrix that takes places in the left camera, x "
        "right, y down, z forward, to those in its first frame; where the rig was lost, the "
        "likeliest motion is taken, or else its last one goes on; NaN for images that are not "
        "used, and where given poses have a gap",
        "poses_table.KittiFile",
        takes="step",
        needs_rig=True,
        needs_poses=True,
    ),
    "odometry": Output(
        "odometry.csv",
        "how far to believe in poses that were found from the recording, a row for each frame: "
        "lost 0 or 1; sigma_m in m and sigma_rad in rad, standard deviations of place and turn "
        "by errors that frames do not share; disparity_offset_px, by which disparities "
        "are too small; agreeing, the share of points whose grey agrees; empty = poses were given",
        "poses_table.OdometryFile",
        kind="table",
        takes="step",
        needs_rig=True,
        needs_poses=True,
    ),
    "rgbd": Output(
        "rgbd/associations.txt",
        "with rgbd-view and rgbd-depth, which come with it, the layout of TUM RGB-D for programs "
        "that fuse such recordings: lines of time_s, view, time_s, depth, for each frame whose "
        "pose is known; the same apart in rgb.txt and depth.txt; groundtruth.txt, where the "
        "reference camera was, TUM form, x right, y down, z forward; intrinsics.json, as Open3D "
        "has it",
        "rgbd.RgbdTables",
        takes="step",
        needs_rig=True,
        needs_poses=True,
        beside=(
            *("rgbd/rgb.txt", "rgbd/depth.txt", "rgbd/groundtruth.txt"),
            "rgbd/intrinsics.json",
        ),
        brings=("rgbd-view", "rgbd-depth"),
    ),
    "rgbd-view": Output(
        "rgbd/rgb/{:06d}.png",
        "uint8 reference view as it was processed, in colour where it has any",
        "images.rgbd_view",
        shows_colours=True,
    ),
    "rgbd-depth": Output(
        "rgbd/depth/{:06d}.png",
        "uint16 depth in 1/5000 m, reference view; 0 = unknown or over 13.1 m",
        "images.rgbd_depth",
        needs_rig=True,
    ),
    "map": Output(
        "map.ply",
        "what moved in the image, but not by itself, fused over all frames: points in the world of "
        "the poses in m, with the colour of the reference view; map.png from above, 0 = occupied, "
        "254 = free, 205 = unknown, its place and scale in map.yaml as ROS's map_server has it; "
        "map-sheet.png, the same to look at, with the path of the rig, the meaning of its colours "
        "and a scale",
        "map.MapFiles",
        shows_colours=True,
        needs_rig=True,
        needs_poses=True,
        beside=(MAP_PICTURE, MAP_PLACE, "map-sheet.png"),
        takes="step",
        extras=_DEPTH,
        needs_movers=True,
        needs_points=True,
    ),
}

DEFAULT_OUTPUTS = ("steering", "depth", "charge", "depth-video")


def available(save: Sequence[str], *, rig: bool, steering_format: str = "csv") -> tuple[str, ...]:
    """Return the outputs to write, each once, with those that they need.

    Without a rig, disparity takes the place of depth.

    Raises:
        SettingsError: an output without such a substitute needs a rig.
    """
    instead = {
        name: row.without_rig for name, row in OUTPUTS.items() if row.without_rig and not rig
    }
    if steering_format != "csv":
        instead = instead | {"steering": f"steering-{steering_format}"}
    wanted = [each for name in save for each in (*OUTPUTS[name].brings, name)]
    names = tuple(dict.fromkeys(instead.get(name, name) for name in wanted))
    for name in names:
        if OUTPUTS[name].needs_rig and not rig:
            raise SettingsError(f"--save {name} needs --rig: without it nothing is in metres")
    return names


def check_video_size(save: Sequence[str], width: int, height: int) -> None:
    """Check that the videos among some outputs can hold views of a size in px.

    Raises:
        SettingsError: they cannot.
    """
    too_wide = [name for name in save if max(width, height) > OUTPUTS[name].max_view_px]
    if too_wide:
        raise SettingsError(
            f"views of {width}x{height} px are too large for {', '.join(too_wide)}: H.264 takes up "
            "to 16,384 px a side, so leave them out of --save, or give a smaller --scale"
        )
