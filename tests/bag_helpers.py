"""ROS bags of all formats, written with rosbags."""

from __future__ import annotations

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

from startrack.frames import parse_utc

FORMATS = ("ros1.bag", "ros2.db3", "ros2.mcap", "ros2-folder")
STAMP = parse_utc("2030-05-01T12:00:00.250000Z")
STAMP_NS = int(STAMP.timestamp()) * 10**9 + 250_000_000


class Messages:
    """Makes messages of ROS 1 or ROS 2."""

    def __init__(self, ros1):
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        self.ros1 = ros1

    def make(self, kind, **fields):
        package, name = kind.split("/")
        return self.store.types[f"{package}/msg/{name}"](**fields)

    def header(self, stamp_ns, frame="odom"):
        stamp = self.make("builtin_interfaces/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        first = {"seq": 0} if self.ros1 else {}
        return self.make("std_msgs/Header", **first, stamp=stamp, frame_id=frame)

    def odometry(self, stamp_ns, pose, child="base_link"):
        x, y, z, *q = map(float, pose)
        at = self.make("geometry_msgs/Point", x=x, y=y, z=z)
        turn = self.make("geometry_msgs/Quaternion", x=q[0], y=q[1], z=q[2], w=q[3])
        zero = self.make("geometry_msgs/Vector3", x=0.0, y=0.0, z=0.0)
        return self.make(
            "nav_msgs/Odometry",
            header=self.header(stamp_ns),
            child_frame_id=child,
            pose=self.make(
                "geometry_msgs/PoseWithCovariance",
                pose=self.make("geometry_msgs/Pose", position=at, orientation=turn),
                covariance=np.zeros(36),
            ),
            twist=self.make(
                "geometry_msgs/TwistWithCovariance",
                twist=self.make("geometry_msgs/Twist", linear=zero, angular=zero),
                covariance=np.zeros(36),
            ),
        )

    def image(self, stamp_ns, pixels, encoding, *, big_endian=False, padding=0, **changes):
        stored = pixels.astype(pixels.dtype.newbyteorder(">" if big_endian else "<"))
        rows = np.pad(stored.view(np.uint8).reshape(len(pixels), -1), ((0, 0), (0, padding)))
        fields = {
            "header": self.header(stamp_ns), "height": pixels.shape[0], "width": pixels.shape[1],
            "encoding": encoding, "is_bigendian": int(big_endian), "step": rows.shape[1], "data": rows.ravel(),
        }  # fmt: skip
        return self.make("sensor_msgs/Image", **{**fields, **changes})

    def compressed(self, stamp_ns, data, form):
        data = np.frombuffer(data, np.uint8)
        return self.make("sensor_msgs/CompressedImage", header=self.header(stamp_ns), format=form, data=data)

    def serialize(self, message):
        write = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        return write(message, message.__msgtype__)


def write_bag(folder, form, topics, log_step_ns=1):
    """Write a bag in one of FORMATS with `topics(messages)`: pairs of topic and message; return its path.

    The messages are recorded `log_step_ns` after each other.
    """
    messages = Messages(form == "ros1.bag")
    path = folder / form.partition(".")[0]
    if messages.ros1:
        path = folder / form
        writer = rosbag1.Writer(path)
    else:
        plugin = rosbag2.StoragePlugin.MCAP if "mcap" in form else rosbag2.StoragePlugin.SQLITE3
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    with writer:
        connections = {}
        for number, (topic, message) in enumerate(topics(messages)):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=messages.store)
            writer.write(connections[topic], STAMP_NS + log_step_ns * number, messages.serialize(message))
    return path if form in ("ros1.bag", "ros2-folder") else next(path.glob(f"*.{form.partition('.')[2]}"))
