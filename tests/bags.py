"""ROS bags for tests, written by rosbags from given images."""

from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

STORES = {".bag": Stores.ROS1_NOETIC, ".db3": Stores.ROS2_HUMBLE, ".mcap": Stores.ROS2_HUMBLE}


class Bag:
    """A bag being written; topics are made when first used."""

    def __init__(self, path: Path, kind: str):
        self.kind, self.frame_id = kind, "camera"
        self.types = get_typestore(STORES[kind])
        if kind == ".bag":
            self.writer = Writer1(path)
        else:
            plugin = StoragePlugin.MCAP if kind == ".mcap" else StoragePlugin.SQLITE3
            self.writer = Writer2(path, version=8, storage_plugin=plugin)
        self.connections = {}

    def __enter__(self):
        self.writer.open()
        return self

    def __exit__(self, *_):
        self.writer.close()

    def of(self, name):
        return self.types.types[f"sensor_msgs/msg/{name}"]

    def header(self, stamp_ns):
        time = self.types.types["builtin_interfaces/msg/Time"](
            sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9
        )
        header = self.types.types["std_msgs/msg/Header"]
        more = {"seq": 0} if self.kind == ".bag" else {}
        return header(stamp=time, frame_id=self.frame_id, **more)

    def write(self, topic, message, recorded_ns):
        kind = message.__msgtype__
        if topic not in self.connections:
            more = {"typestore": self.types}
            self.connections[topic] = self.writer.add_connection(topic, kind, **more)
        pack = self.types.serialize_ros1 if self.kind == ".bag" else self.types.serialize_cdr
        self.writer.write(self.connections[topic], recorded_ns, pack(message, kind))

    def image(
        self,
        topic,
        pixels,
        stamp_ns,
        encoding="mono8",
        *,
        recorded_ns=None,
        padding=0,
        behind=(),
    ):
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
        rows = np.pad(rows, ((0, 0), (0, padding)))
        message = self.of("Image")(
            header=self.header(stamp_ns),
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=rows.shape[1],
            data=np.append(rows.reshape(-1), np.asarray(behind, np.uint8)),
        )
        self.write(topic, message, stamp_ns if recorded_ns is None else recorded_ns)

    def compressed(self, topic, content, stamp_ns, format="jpeg"):
        data = np.frombuffer(content, np.uint8)
        message = self.of("CompressedImage")(header=self.header(stamp_ns), format=format, data=data)
        self.write(topic, message, stamp_ns)

    def camera_info(self, topic, rig, stamp_ns, *, right, region=(0, 0, 0, 0), binning=(0, 0)):
        shift = -rig.focal_px * rig.baseline_m if right else 0.0
        cx = rig.cx_of("right" if right else "left")
        f, cy = rig.focal_px, rig.cy
        fields = {
            "d": np.zeros(5),
            "k": np.array([f, 0, cx, 0, f, cy, 0, 0, 1.0]),
            "r": np.eye(3).reshape(-1),
            "p": np.array([f, 0, cx, shift, 0, f, cy, 0, 0, 0, 1.0, 0]),
        }
        if self.kind == ".bag":
            fields = {key.upper(): value for key, value in fields.items()}
        x, y, width, height = region
        roi = self.of("RegionOfInterest")(x, y, height, width, False)
        message = self.of("CameraInfo")(
            header=self.header(stamp_ns),
            height=rig.height,
            width=rig.width,
            distortion_model="plumb_bob",
            binning_x=binning[0],
            binning_y=binning[1],
            roi=roi,
            **fields,
        )
        self.write(topic, message, stamp_ns)
