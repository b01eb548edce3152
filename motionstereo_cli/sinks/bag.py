"""Results as a ROS 2 bag (MCAP), which RViz and Foxglove open."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from motionstereo_cli.errors import OutputError
from motionstereo_cli.files.atomic import Temporary, open_new, remove_own, reported, write_whole
from motionstereo_cli.files.encode import encode_jpeg, encode_png
from motionstereo_cli.files.reading import open_regular
from motionstereo_cli.files.records import restored
from motionstereo_cli.files.segments import Segments
from motionstereo_cli.robot.mapper import camera_points
from motionstereo_cli.sinks.images import depth_png, known_depth_m

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.sinks.sink import RunContext
    from motionstereo_cli.types import FrameImages, MovingObject, Pose, Rig, Step

#: Frames of REP 105: the world of the poses, and the middle of the rig: x forward, y left, z up.
WORLD_FRAME = "map"
CAMERA_FRAME = "camera_link"

#: Foxglove's layout that shows all topics.
LAYOUT = "layout.json"

_FLOAT = "std_msgs/msg/Float32"
#: Type of the messages of each topic.
TOPICS = {
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/path": "nav_msgs/msg/Path",
    "/view/image_rect/compressed": "sensor_msgs/msg/CompressedImage",
    "/view/camera_info": "sensor_msgs/msg/CameraInfo",
    "/depth/image_rect": "sensor_msgs/msg/Image",
    "/depth/camera_info": "sensor_msgs/msg/CameraInfo",
    "/disparity": "stereo_msgs/msg/DisparityImage",
    "/charge/compressed": "sensor_msgs/msg/CompressedImage",
    "/points": "sensor_msgs/msg/PointCloud2",
    "/steering": "geometry_msgs/msg/PoseStamped",
    "/objects": "visualization_msgs/msg/MarkerArray",
    "/plot/heading_rad": _FLOAT,
    "/plot/depth_ahead_m": _FLOAT,
    "/plot/nearest_m": _FLOAT,
    "/plot/charged": _FLOAT,
    "/plot/matched": _FLOAT,
}
#: ROS keeps the last message of these for readers that come later: as rosbag2 writes the quality of
#: service of a publisher that is reliable (1) and transient local (1).
_NEVER = "{sec: 9223372036, nsec: 854775807}"
_LATCHED = {
    "offered_qos_profiles": "- {history: 1, depth: 1, reliability: 1, durability: 1, "
    f"deadline: {_NEVER}, lifespan: {_NEVER}, liveliness: 1, "
    f"liveliness_lease_duration: {_NEVER}, avoid_ros_namespace_conventions: false}}\n"
}
_LATCHED_TOPICS = {"/tf_static", "/path"}

_CUBE, _TEXT = 1, 9
_DELETE_ALL = 3
_MM_PER_M = 1000
_JPEG_QUALITY = 90
#: A point as RViz takes it: the colour is 0xRRGGBB in the bytes of a float32.
_POINT = np.dtype([*((n, "<f4") for n in "xyz"), *((n, "u1") for n in "bgr"), ("", "u1")])
_FLOAT32 = 7
#: Points of a frame, at most about so many.
_MAX_POINTS = 20_000
#: The path has fewer poses: every second one is dropped when it gets longer.
_MAX_PATH = 4096
#: Directions of the optical frame in the rig's: qx, qy, qz, qw.
_OPTICAL = (-0.5, 0.5, -0.5, 0.5)
#: Red, green and blue of objects that move by themselves, that do not, and that may.
_COLOURS = {True: (1.0, 0.1, 0.1), False: (0.6, 0.6, 0.6), None: (1.0, 0.5, 0.0)}


class BagFile:
    """All results of a run as messages with the stamps of the input.

    Each checkpoint begins a new segment. At the end the messages are copied into one file in order,
    so that it does not depend on where a run was interrupted.

    Args:
        path: final name.
        stream: the run's context; it has a rig.
        since: continue from this checkpoint: the complete segments.

    Raises:
        OutputError: rosbags is missing, the file cannot be written, or a segment was changed.
    """

    def __init__(self, path: Path, stream: RunContext, since: tuple[str, ...] = ()) -> None:
        assert stream.rig is not None
        self._path, self._stream = path, stream
        self._segments = Segments(path, restored(since or (), tuple[str, ...]))
        self._messages = _Messages(stream.rig, stream)
        self._writer: _Writer | None = None

    def write(self, step: Step) -> None:
        """Append the messages of a frame."""
        stamp_ns = round(step.time.pts * self._stream.time_base * 10**9)
        if self._writer is None:
            path = self._segments.next
            with reported(path):
                file = os.fdopen(open_new(path), "wb")
            self._writer = _Writer(path, file, self._messages.types)
            if not self._segments.sums:
                message = self._messages.packed(self._messages.camera_in_rig(stamp_ns))
                self._writer.add("/tf_static", message, stamp_ns)
        for topic, message in self._messages.of(step, stamp_ns):
            self._writer.add(topic, self._messages.packed(message), stamp_ns)

    def checkpoint(self) -> tuple[str, ...]:
        """End the segment."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None
            self._segments.end()
        return self._segments.sums

    def close(self) -> None:
        """Join the segments under the final name."""
        self.checkpoint()
        from mcap.reader import make_reader

        poses, spacing, found, begin_ns = [], 1, 0, 0
        with reported(self._path), Temporary(self._path) as joined:
            writer = _Writer(self._path, joined.content, self._messages.types)
            for segment in self._segments.paths:
                with open_regular(segment) as file:
                    messages = make_reader(file).iter_messages(log_time_order=False)
                    for _, channel, message in messages:
                        writer.add(channel.topic, message.data, message.log_time)
                        if channel.topic == "/tf_static":
                            begin_ns = message.log_time
                        elif channel.topic == "/tf":
                            if found % spacing == 0:
                                poses.append(message.data)
                            found += 1
                            if len(poses) == _MAX_PATH:
                                poses, spacing = poses[::2], 2 * spacing
            if poses:  # all of it from the beginning on
                path = self._messages.packed(self._messages.path(poses, begin_ns))
                writer.add("/path", path, begin_ns)
            writer.finish()
            layout = resources.files("motionstereo_cli") / "sinks" / LAYOUT
            write_whole(self._path.with_name(LAYOUT), layout.read_bytes())
            joined.place(durable=True)

    def abandon(self, *, keep: bool) -> None:
        """End early: complete the segment or, without ``keep``, remove all."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None
            if not keep:
                remove_own(self._segments.next)
        if not keep:
            self._segments.remove()


class _Writer:
    """An MCAP file being written."""

    def __init__(self, path: Path, file: BinaryIO, types: Any) -> None:
        from mcap.writer import Writer

        self._path, self._file = path, file
        with reported(path):
            self._writer = Writer(file)
            self._writer.start(profile="ros2", library="motionstereo")
            self._channels = {}
            for topic, kind in TOPICS.items():
                text = types.generate_msgdef(kind, ros_version=2)[0]
                schema = self._writer.register_schema(kind, "ros2msg", text.encode())
                latched = _LATCHED if topic in _LATCHED_TOPICS else {}
                self._channels[topic] = self._writer.register_channel(topic, "cdr", schema, latched)

    def add(self, topic: str, data: bytes, stamp_ns: int) -> None:
        with reported(self._path):
            self._writer.add_message(self._channels[topic], stamp_ns, data, stamp_ns)

    def finish(self) -> None:
        with reported(self._path):
            self._writer.finish()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        self.finish()
        with reported(self._path):
            self._file.close()


class _Messages:
    """Makes the messages of a frame."""

    def __init__(self, rig: Rig, stream: RunContext) -> None:
        try:
            import mcap  # noqa: F401
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            raise OutputError("--save bag needs rosbags: pip install 'motionstereo[ros]'") from None
        self.types = get_typestore(Stores.ROS2_HUMBLE)
        self._rig, self._stream = rig, stream
        self._cx = rig.cx_of(stream.settings.reference)
        self._optical = stream.optical_frame

    def packed(self, message: Any) -> bytes:
        """Return a message in its serialised form."""
        return bytes(self.types.serialize_cdr(message, message.__msgtype__))

    def of(self, step: Step, stamp_ns: int) -> Iterator[tuple[str, Any]]:
        """Yield the messages of a frame by topic."""
        images = step.images
        assert images is not None
        optical = self._header(stamp_ns, self._optical)
        if step.pose is not None:
            yield "/tf", self._rig_in_world(step.pose, stamp_ns)
        yield "/view/image_rect/compressed", self._view(optical, images)
        yield "/view/camera_info", self._camera_info(optical)
        depth_mm = depth_png(images.disparity_px, self._rig, _MM_PER_M)
        yield "/depth/image_rect", self._image(optical, depth_mm, "16UC1")
        yield "/depth/camera_info", self._camera_info(optical)
        yield "/disparity", self._disparity(optical, images)
        yield (
            "/charge/compressed",
            self._make(
                "sensor_msgs/msg/CompressedImage",
                header=optical,
                format="mono8; png compressed",
                data=np.frombuffer(encode_png(images.charge), np.uint8),
            ),
        )
        yield "/points", self._points(optical, images)
        if step.steering.steer_rad is not None:
            header = self._header(stamp_ns, CAMERA_FRAME)
            yield "/steering", self._heading(header, step.steering.steer_rad)
        yield "/objects", self._objects(optical, step.objects)
        steering = step.steering
        plots = {
            "heading_rad": steering.steer_rad,
            "depth_ahead_m": steering.depth_m,
            "nearest_m": steering.nearest_m,
            "charged": step.charged,
            "matched": step.matched,
        }
        for name, value in plots.items():
            if value is not None:
                yield f"/plot/{name}", self._make(_FLOAT, data=float(value))

    def camera_in_rig(self, stamp_ns: int) -> Any:
        """Return where the reference camera sits in the rig, as a message of /tf_static."""
        left_m = self._rig.left_of_middle_m(self._stream.settings.reference)
        pose = self._pose((0, left_m, 0), _OPTICAL)
        return self._transform(stamp_ns, CAMERA_FRAME, self._optical, pose)

    def path(self, poses: Sequence[bytes], stamp_ns: int) -> Any:
        """Return the poses of messages of /tf as one path."""
        stamped = []
        for data in poses:
            message: Any = self.types.deserialize_cdr(data, TOPICS["/tf"])
            at = message.transforms[0]
            pose = self._make(
                "geometry_msgs/msg/Pose",
                position=self._make(
                    "geometry_msgs/msg/Point",
                    **{axis: getattr(at.transform.translation, axis) for axis in "xyz"},
                ),
                orientation=at.transform.rotation,
            )
            stamped.append(self._make("geometry_msgs/msg/PoseStamped", header=at.header, pose=pose))
        header = self._header(stamp_ns, WORLD_FRAME)
        return self._make("nav_msgs/msg/Path", header=header, poses=stamped)

    def _rig_in_world(self, at: Pose, stamp_ns: int) -> Any:
        pose = self._pose((at.x_m, at.y_m, at.z_m), (at.qx, at.qy, at.qz, at.qw))
        return self._transform(stamp_ns, WORLD_FRAME, CAMERA_FRAME, pose)

    def _transform(self, stamp_ns: int, parent: str, child: str, pose: Any) -> Any:
        place = {axis: getattr(pose.position, axis) for axis in "xyz"}
        transform = self._make(
            "geometry_msgs/msg/Transform",
            translation=self._make("geometry_msgs/msg/Vector3", **place),
            rotation=pose.orientation,
        )
        stamped = self._make(
            "geometry_msgs/msg/TransformStamped",
            header=self._header(stamp_ns, parent),
            child_frame_id=child,
            transform=transform,
        )
        return self._make("tf2_msgs/msg/TFMessage", transforms=[stamped])

    def _points(self, header: Any, images: FrameImages) -> Any:
        """Return the depth of some rows and columns as points with the colour of the view."""
        depth_m = known_depth_m(images)
        step = math.ceil(math.sqrt(depth_m.size / _MAX_POINTS))
        chosen = np.zeros(depth_m.shape, np.bool_)
        chosen[step // 2 :: step, step // 2 :: step] = True
        camera = self._stream.settings.reference
        points_m, look = camera_points(depth_m, images.look, chosen, camera, self._rig)
        table = np.zeros(len(points_m), _POINT)
        for axis, name in enumerate("xyz"):
            table[name] = points_m[:, axis]
        rgb = np.broadcast_to(look.T, (3, len(look)))
        for name, channel in zip("rgb", rgb, strict=True):
            table[name] = channel
        fields = [
            self._make("sensor_msgs/msg/PointField", name=n, offset=at, datatype=_FLOAT32, count=1)
            for n, at in (("x", 0), ("y", 4), ("z", 8), ("rgb", 12))
        ]
        return self._make(
            "sensor_msgs/msg/PointCloud2",
            header=header,
            height=1,
            width=len(table),
            fields=fields,
            is_bigendian=False,
            point_step=_POINT.itemsize,
            row_step=table.nbytes,
            data=table.view(np.uint8),
            is_dense=True,
        )

    def _view(self, header: Any, images: FrameImages) -> Any:
        """Return the reference view as a JPEG image, in colour if it has colours."""
        return self._make(
            "sensor_msgs/msg/CompressedImage",
            header=header,
            format="jpeg",
            data=np.frombuffer(encode_jpeg(images.look, _JPEG_QUALITY), np.uint8),
        )

    def _make(self, kind: str, **fields: Any) -> Any:
        return self.types.types[kind](**fields)

    def _header(self, stamp_ns: int, frame_id: str) -> Any:
        seconds, nanoseconds = divmod(stamp_ns, 10**9)
        time = self._make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        return self._make("std_msgs/msg/Header", stamp=time, frame_id=frame_id)

    def _image(self, header: Any, image: NDArray[Any], encoding: str) -> Any:
        rows = np.ascontiguousarray(image).view(np.uint8)
        return self._make(
            "sensor_msgs/msg/Image",
            header=header,
            height=image.shape[0],
            width=image.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=rows.shape[1],
            data=rows.reshape(-1),
        )

    def _region(self, width: int = 0, height: int = 0) -> Any:
        return self._make(
            "sensor_msgs/msg/RegionOfInterest",
            x_offset=0,
            y_offset=0,
            height=height,
            width=width,
            do_rectify=False,
        )

    def _camera_info(self, header: Any) -> Any:
        rig = self._rig
        fx, fy, cx, cy = rig.focal_px, rig.fy_px, self._cx, rig.cy
        return self._make(
            "sensor_msgs/msg/CameraInfo",
            header=header,
            height=rig.height,
            width=rig.width,
            distortion_model="plumb_bob",
            d=np.zeros(5),
            k=np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0]),
            r=np.eye(3).reshape(-1),
            p=np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1.0, 0]),
            binning_x=0,
            binning_y=0,
            roi=self._region(),
        )

    def _disparity(self, header: Any, images: FrameImages) -> Any:
        """Return the disparity for ROS: depth = f T / disparity; unknown below the minimum."""
        rig, doffs = self._rig, self._rig.doffs
        values = np.nan_to_num(images.disparity_px + np.float32(doffs), nan=doffs - 1)
        return self._make(
            "stereo_msgs/msg/DisparityImage",
            header=header,
            image=self._image(header, values.astype(np.float32), "32FC1"),
            f=rig.focal_px,
            t=rig.baseline_m,
            valid_window=self._region(rig.width, rig.height),
            min_disparity=doffs,
            max_disparity=doffs + self._stream.settings.max_disparity,
            delta_d=1 / 256,
        )

    def _pose(
        self, place: Sequence[float] = (0, 0, 0), quaternion: Sequence[float] = (0, 0, 0, 1)
    ) -> Any:
        x, y, z = map(float, place)
        qx, qy, qz, qw = map(float, quaternion)
        return self._make(
            "geometry_msgs/msg/Pose",
            position=self._make("geometry_msgs/msg/Point", x=x, y=y, z=z),
            orientation=self._make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
        )

    def _heading(self, header: Any, steer_rad: float) -> Any:
        pose = self._pose(quaternion=(0, 0, math.sin(steer_rad / 2), math.cos(steer_rad / 2)))
        return self._make("geometry_msgs/msg/PoseStamped", header=header, pose=pose)

    def _objects(self, header: Any, objects: Sequence[MovingObject]) -> Any:
        """Return a marker that deletes the previous ones, and markers for each object.

        A cube, and above what moves by itself its number, speed and time to contact.
        """
        markers = [self._marker(header, 0, action=_DELETE_ALL)]
        for item in objects:
            if item.depth_m is not None:
                m_per_px = item.depth_m / self._rig.focal_px
                m_per_row = item.depth_m / self._rig.fy_px
                right_m = (item.x + item.width / 2 - self._cx) * m_per_px
                down_m = (item.y + item.height / 2 - self._rig.cy) * m_per_row
                high_m = item.height * m_per_row
                place = right_m, down_m, item.depth_m
                moves = False if item.shadow else item.by_itself
                colour = _COLOURS[moves]
                size = (item.width * m_per_px, high_m, 0.1)
                markers.append(self._marker(header, item.id, place, size, colour))
                if moves:
                    over = (right_m, down_m - high_m / 2, item.depth_m)
                    text = _words_of(item)
                    markers.append(
                        self._marker(header, item.id, over, (0, 0, high_m / 6), colour, text)
                    )
        return self._make("visualization_msgs/msg/MarkerArray", markers=markers)

    def _marker(
        self,
        header: Any,
        number: int,
        place: Sequence[float] = (0, 0, 0),
        size: Sequence[float] = (0, 0, 0),
        colour: Sequence[float] = _COLOURS[None],
        text: str = "",
        action: int = 0,
    ) -> Any:
        x, y, z = map(float, size)
        r, g, b = colour
        nothing = self._make("builtin_interfaces/msg/Duration", sec=0, nanosec=0)
        time = self._make("builtin_interfaces/msg/Time", sec=0, nanosec=0)
        return self._make(
            "visualization_msgs/msg/Marker",
            header=header,
            ns="texts" if text else "objects",
            id=number,
            type=_TEXT if text else _CUBE,
            action=action,
            pose=self._pose(place),
            scale=self._make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
            color=self._make("std_msgs/msg/ColorRGBA", r=r, g=g, b=b, a=1.0 if text else 0.5),
            lifetime=nothing,
            frame_locked=False,
            points=[],
            colors=[],
            texture_resource="",
            texture=self._make(
                "sensor_msgs/msg/CompressedImage",
                header=self._make("std_msgs/msg/Header", stamp=time, frame_id=""),
                format="",
                data=np.zeros(0, np.uint8),
            ),
            uv_coordinates=[],
            text=text,
            mesh_resource="",
            mesh_file=self._make(
                "visualization_msgs/msg/MeshFile", filename="", data=np.zeros(0, np.uint8)
            ),
            mesh_use_embedded_materials=False,
        )


def _words_of(item: MovingObject) -> str:
    """Return number, speed over ground and time to contact of an object, as far as known."""
    words = [f"#{item.id}"]
    if item.over_ground_mps is not None:
        words.append(f"{item.over_ground_mps:.1f} m/s")
    if item.time_to_contact_s is not None:
        words.append(f"contact in {item.time_to_contact_s:.1f} s")
    return ", ".join(words)
