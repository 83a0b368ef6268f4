"""A robot in a room, for the tests: a laser, odometry without noise, and their messages."""

import json
import math
import struct

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ROS = get_typestore(Stores.ROS2_JAZZY)
UPDATE = "map_msgs/msg/OccupancyGridUpdate"
UPDATE_FIELDS = "std_msgs/Header header\nint32 x\nint32 y\nuint32 width\nuint32 height\nint8[] data"
ROS.register(get_types_from_msg(UPDATE_FIELDS, UPDATE))
SCAN, ODOMETRY = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry"
TF = "tf2_msgs/msg/TFMessage"
BEAMS = 180
RANGE_MAX = 20.0
# Walls from corner to corner: an irregular room with a pillar in it.
ROOM = [(-4, -3), (5, -3), (5, 1), (3.5, 1), (3.5, 3.2), (-4, 3.2)]
PILLAR = [(1, -0.5), (1.6, -0.5), (1.6, 0.2), (1, 0.2)]


def walls():
    for corners in (ROOM, PILLAR):
        for start, end in zip(corners, corners[1:] + corners[:1]):
            yield np.array(start, float), np.array(end, float)


def ranges(x, y, yaw):
    """What a laser at a pose measures, all around, m."""
    angles = yaw - math.pi + np.arange(BEAMS) * (2 * math.pi / BEAMS)
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    nearest = np.full(BEAMS, np.inf)
    for start, end in walls():
        along, to_wall = end - start, start - np.array([x, y])
        cross = directions[:, 0] * along[1] - directions[:, 1] * along[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (to_wall[0] * along[1] - to_wall[1] * along[0]) / cross
            share = (to_wall[0] * directions[:, 1] - to_wall[1] * directions[:, 0]) / cross
        hit = (distance > 0) & (share >= 0) & (share <= 1)
        nearest[hit] = np.minimum(nearest[hit], distance[hit])
    return nearest.astype(np.float32)


def route(steps=24):
    """Stamped poses: round the pillar, a quarter of a metre a step, in seconds, m and rad."""
    for i in range(steps):
        angle = -2.0 + i * 0.125
        yield 100.0 + i, (2 * math.cos(angle), 2 * math.sin(angle), angle + math.pi / 2)


def stamp(seconds):
    nanoseconds = round(seconds * 1e9)
    return {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}


def quaternion(yaw):
    return {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}


def scan(seconds, pose, frame="base_link"):
    return {
        "header": {"stamp": stamp(seconds), "frame_id": frame},
        "angle_min": -math.pi,
        "angle_max": math.pi - 2 * math.pi / BEAMS,
        "angle_increment": 2 * math.pi / BEAMS,
        "time_increment": 0.0,
        "scan_time": 0.1,
        "range_min": 0.05,
        "range_max": RANGE_MAX,
        "ranges": ranges(*pose),
        "intensities": np.zeros(0, np.float32),
    }


def odometry(seconds, pose):
    x, y, yaw = pose
    zero = {"x": 0.0, "y": 0.0, "z": 0.0}
    return {
        "header": {"stamp": stamp(seconds), "frame_id": "odom"},
        "child_frame_id": "base_link",
        "pose": {
            "pose": {"position": {"x": x, "y": y, "z": 0.0}, "orientation": quaternion(yaw)},
            "covariance": np.zeros(36),
        },
        "twist": {"twist": {"linear": zero, "angular": zero}, "covariance": np.zeros(36)},
    }


def transforms(seconds, parent, child, pose):
    x, y, yaw = pose
    return {
        "transforms": [
            {
                "header": {"stamp": stamp(seconds), "frame_id": parent},
                "child_frame_id": child,
                "transform": {
                    "translation": {"x": x, "y": y, "z": 0.0},
                    "rotation": quaternion(yaw),
                },
            }
        ]
    }


def to_json(message):
    """The message as JSON; numbers that JSON does not have become null."""

    def plain(value):
        if isinstance(value, dict):
            return {key: plain(item) for key, item in value.items()}
        if isinstance(value, (list, np.ndarray)):
            return [plain(item) for item in value]
        return float(value) if isinstance(value, np.floating) else value

    return json.dumps(plain(message))


# Which type a field has that is a message itself.
NESTED = {
    "header": "std_msgs/msg/Header",
    "stamp": "builtin_interfaces/msg/Time",
    "position": "geometry_msgs/msg/Point",
    "orientation": "geometry_msgs/msg/Quaternion",
    "linear": "geometry_msgs/msg/Vector3",
    "angular": "geometry_msgs/msg/Vector3",
    "translation": "geometry_msgs/msg/Vector3",
    "rotation": "geometry_msgs/msg/Quaternion",
    "transform": "geometry_msgs/msg/Transform",
    "transforms": "geometry_msgs/msg/TransformStamped",
}


def to_object(kind, message):
    """The message as an object of an independent implementation."""

    def nested(name, value):
        if name in ("pose", "twist"):
            inner = "WithCovariance" if "covariance" in value else ""
            return f"geometry_msgs/msg/{name.capitalize()}{inner}"
        return NESTED[name]

    def build(kind, fields):
        values = {}
        for name, value in fields.items():
            if isinstance(value, dict):
                value = build(nested(name, value), value)
            elif isinstance(value, list):
                value = [build(nested(name, item), item) for item in value]
            values[name] = value
        return ROS.types[kind](**values)

    return build(kind, message)


def to_cdr(kind, message, little_endian=True):
    """The message as an independent implementation writes it."""
    message = to_object(kind, message)
    return bytes(ROS.serialize_cdr(message, kind, little_endian=little_endian))


def definition(kind):
    """The message's definition, with those of all messages in it."""
    return ROS.generate_msgdef(kind, ros_version=2)[0]


def from_cdr(kind, payload):
    return ROS.deserialize_cdr(payload, kind)


def png_size(data):
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    return struct.unpack(">II", data[16:24])


def cells(grid):
    return np.array(grid.data).reshape(grid.info.height, grid.info.width)


def assert_room(grid):
    """The walls are where they are: the map begins where odometry was, so the frames agree."""
    data, info = cells(grid), grid.info

    def value(x, y):
        column = math.floor((x - info.origin.position.x) / info.resolution)
        row = math.floor((y - info.origin.position.y) / info.resolution)
        return data[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2].max()

    assert all(value(x, y) == 100 for x, y in [(-4, 0), (0, -3), (5, -1), (0, 3.2), (1, -0.2)])
    assert all(value(x, y) == 0 for x, y in [(-2, 0), (0, -2), (3, -1), (0, 2)])
