"""Results as a ROS 2 bag (MCAP), which RViz and Foxglove open."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from motionstereo_cli.errors import OutputError
from motionstereo_cli.files.atomic import Temporary, open_new, remove_own, reported
from motionstereo_cli.files.encode import encode_png
from motionstereo_cli.files.reading import open_regular
from motionstereo_cli.files.records import restored
from motionstereo_cli.files.segments import Segments
from motionstereo_cli.sinks.images import depth_png, known_depth_m

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.sinks.sink import RunContext
    from motionstereo_cli.types import FrameImages, MovingObject, Rig, Step

#: Frames of REP 103 and 105: x right, y down, z forward; and x forward, y left, z up.
OPTICAL_FRAME = "camera_optical_frame"
CAMERA_FRAME = "camera_link"

#: Type of the messages of each topic.
TOPICS = {
    "/depth/image_rect": "sensor_msgs/msg/Image",
    "/depth/camera_info": "sensor_msgs/msg/CameraInfo",
    "/disparity": "stereo_msgs/msg/DisparityImage",
    "/charge/compressed": "sensor_msgs/msg/CompressedImage",
    "/steering": "geometry_msgs/msg/PoseStamped",
    "/objects": "visualization_msgs/msg/MarkerArray",
}

_CUBE = 1
_DELETE_ALL = 3
_MM_PER_M = 1000


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
        if self._writer is None:
            path = self._segments.next
            with reported(path):
                file = os.fdopen(open_new(path), "wb")
            self._writer = _Writer(path, file, self._messages.types)
        stamp_ns = round(step.time.pts * self._stream.time_base * 10**9)
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

        with reported(self._path):
            joined = Temporary(self._path)
            try:
                writer = _Writer(self._path, joined.content, self._messages.types)
                for segment in self._segments.paths:
                    with open_regular(segment) as file:
                        messages = make_reader(file).iter_messages(log_time_order=False)
                        for _, channel, message in messages:
                            writer.add(channel.topic, message.data, message.log_time)
                writer.finish()
                joined.place(durable=True)
            finally:
                joined.discard()

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
                self._channels[topic] = self._writer.register_channel(topic, "cdr", schema)

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

    def packed(self, message: Any) -> bytes:
        """Return a message in its serialised form."""
        return bytes(self.types.serialize_cdr(message, message.__msgtype__))

    def of(self, step: Step, stamp_ns: int) -> Iterator[tuple[str, Any]]:
        """Yield the messages of a frame by topic."""
        images = step.images
        assert images is not None
        optical = self._header(stamp_ns, OPTICAL_FRAME)
        depth_mm = depth_png(known_depth_m(images), _MM_PER_M)
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
        if step.steering.steer_rad is not None:
            header = self._header(stamp_ns, CAMERA_FRAME)
            yield "/steering", self._heading(header, step.steering.steer_rad)
        yield "/objects", self._objects(optical, step.objects)

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

    def _pose(self, place: Sequence[float] = (0, 0, 0), yaw_rad: float = 0.0) -> Any:
        x, y, z = map(float, place)
        return self._make(
            "geometry_msgs/msg/Pose",
            position=self._make("geometry_msgs/msg/Point", x=x, y=y, z=z),
            orientation=self._make(
                "geometry_msgs/msg/Quaternion",
                x=0.0,
                y=0.0,
                z=math.sin(yaw_rad / 2),
                w=math.cos(yaw_rad / 2),
            ),
        )

    def _heading(self, header: Any, steer_rad: float) -> Any:
        pose = self._pose(yaw_rad=steer_rad)
        return self._make("geometry_msgs/msg/PoseStamped", header=header, pose=pose)

    def _objects(self, header: Any, objects: Sequence[MovingObject]) -> Any:
        """Return a marker that deletes the previous cubes, and a cube for each object."""
        markers = [self._marker(header, 0, _DELETE_ALL, (0, 0, 0), (0, 0, 0))]
        for item in objects:
            if item.depth_m is not None:
                m_per_px = item.depth_m / self._rig.focal_px
                m_per_row = item.depth_m / self._rig.fy_px
                right_m = (item.x + item.width / 2 - self._cx) * m_per_px
                down_m = (item.y + item.height / 2 - self._rig.cy) * m_per_row
                size = (item.width * m_per_px, item.height * m_per_row, 0.1)
                markers.append(
                    self._marker(header, item.id, 0, (right_m, down_m, item.depth_m), size)
                )
        return self._make("visualization_msgs/msg/MarkerArray", markers=markers)

    def _marker(
        self,
        header: Any,
        number: int,
        action: int,
        place: Sequence[float],
        size: Sequence[float],
    ) -> Any:
        x, y, z = map(float, size)
        nothing = self._make("builtin_interfaces/msg/Duration", sec=0, nanosec=0)
        time = self._make("builtin_interfaces/msg/Time", sec=0, nanosec=0)
        return self._make(
            "visualization_msgs/msg/Marker",
            header=header,
            ns="objects",
            id=number,
            type=_CUBE,
            action=action,
            pose=self._pose(place),
            scale=self._make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
            color=self._make("std_msgs/msg/ColorRGBA", r=1.0, g=0.5, b=0.0, a=0.5),
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
            text="",
            mesh_resource="",
            mesh_file=self._make(
                "visualization_msgs/msg/MeshFile", filename="", data=np.zeros(0, np.uint8)
            ),
            mesh_use_embedded_materials=False,
        )
