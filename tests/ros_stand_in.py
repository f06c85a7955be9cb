"""A stand-in for the Python packages of ROS 2: messages of the real definitions (rosbags), a node without a network.

A topic's messages are given to the callbacks of its subscriptions at once; published messages are kept, and serialized
as ROS 2 does, which fails where a field has a wrong type or is missing.
"""

from __future__ import annotations

import sys
from functools import partial
from types import ModuleType

import numpy as np
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_HUMBLE)
MESSAGES = (
    "sensor_msgs/Image", "nav_msgs/Odometry", "geometry_msgs/PoseWithCovarianceStamped",
    "geometry_msgs/TransformStamped", "geometry_msgs/PoseStamped", "nav_msgs/Path",
)  # fmt: skip


def empty_message(kind, **given):
    """A message of a `kind` such as "std_msgs/msg/Header" with the default values of its fields, as rclpy makes it.

    `given` are the values of some of them.
    """
    return STORE.types[kind](**{name: _empty_field(field) for name, field in STORE.fielddefs[kind][1]} | given)


def _empty_field(field):
    """The default value of a field: BASE, NAME, ARRAY or SEQUENCE."""
    form, of = field
    if form.name == "NAME":
        return empty_message(of)
    if form.name == "BASE":
        return "" if of[0] == "string" else 0.0 if of[0].startswith("float") else 0
    element, count = of
    if element[0].name == "NAME":
        return [empty_message(element[1]) for _ in range(count)]
    return np.zeros(count, element[1][0])


class Logger:
    def __init__(self):
        self.lines = []

    def info(self, text):
        self.lines.append(("info", text))

    def warning(self, text):
        self.lines.append(("warning", text))

    def error(self, text):
        self.lines.append(("error", text))


class Publisher:
    def __init__(self):
        self.messages = []

    def publish(self, message):
        if hasattr(message, "pose"):
            covariance = message.pose.covariance
            assert len(covariance) == 36 and all(isinstance(one, float) for one in covariance)  # rclpy asserts this
            message.pose.covariance = np.array(covariance)
        STORE.serialize_cdr(message, message.__msgtype__)
        self.messages.append(message)


class TransformBroadcaster:
    """As of tf2_ros; the node keeps what was sent."""

    def __init__(self, node):
        self.messages = node.transforms = []

    def sendTransform(self, message):
        STORE.serialize_cdr(message, message.__msgtype__)
        self.messages.append(message)


class Parameter:
    def __init__(self, value):
        self.value = value


class Node:
    overrides = ()  # pairs of name and value of parameters, as `--ros-args -p` gives them

    def __init__(self, name):
        self.name, self.callbacks, self.publishers, self.logger = name, {}, {}, Logger()

    def declare_parameter(self, name, value):
        return Parameter(dict(self.overrides).get(name, value))

    def create_publisher(self, kind, topic, qos):
        assert kind is not None and qos is not None
        return self.publishers.setdefault(topic, Publisher())

    def create_subscription(self, kind, topic, callback, qos):
        assert kind is not None and qos is not None
        self.callbacks[topic] = callback

    def get_logger(self):
        return self.logger


def install(monkeypatch, **parameters):
    """Put the packages into `sys.modules` for one test; `parameters` override those that a node declares."""
    node = type("Node", (Node,), {"overrides": tuple(parameters.items())})
    parts = {
        "rclpy": {"init": lambda: None, "spin": lambda node: None},
        "rclpy.node": {"Node": node},
        "tf2_ros": {"TransformBroadcaster": TransformBroadcaster},
        "rclpy.qos": {"qos_profile_sensor_data": object()},
    }
    for kind in MESSAGES:
        package, _, name = kind.partition("/")
        make = staticmethod(partial(empty_message, f"{package}/msg/{name}"))
        parts[package] = {}
        parts.setdefault(f"{package}.msg", {})[name] = make
    for name, values in parts.items():
        module = ModuleType(name)
        vars(module).update(values)
        monkeypatch.setitem(sys.modules, name, module)


def stamped(message, time_s_ns):
    """The `message` with the time of its header [ns]."""
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(int(time_s_ns), 10**9)
    return message


def image_message(stamp_ns, pixels):
    """A sensor_msgs/Image in mono16."""
    message = stamped(empty_message("sensor_msgs/msg/Image"), stamp_ns)
    message.height, message.width = pixels.shape
    message.encoding, message.step, message.data = "mono16", 2 * pixels.shape[1], pixels.astype("<u2").tobytes()
    message.data = np.frombuffer(message.data, np.uint8)
    return message


def odometry_message(stamp_ns, position_m, quat_xyzw):
    """A nav_msgs/Odometry."""
    message = stamped(empty_message("nav_msgs/msg/Odometry"), stamp_ns)
    pose = message.pose.pose
    pose.position.x, pose.position.y, pose.position.z = map(float, position_m)
    pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = map(float, quat_xyzw)
    return message
