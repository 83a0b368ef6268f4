"""Writes messages.txt: one line a message and byte order, as `rosbags` 0.11.9 encodes it.

    pip install rosbags==0.11.9
    python make.py > messages.txt

`src/ros/tests.rs` builds the same messages and compares.
"""

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

store = get_typestore(Stores.ROS2_JAZZY)
for name, text in {
    "nav_msgs/msg/GetMap_Request": "uint8 structure_needs_at_least_one_member",
    "nav_msgs/msg/GetMap_Response": "nav_msgs/OccupancyGrid map",
    "map_msgs/msg/OccupancyGridUpdate": "std_msgs/Header header\nint32 x\nint32 y\n"
    "uint32 width\nuint32 height\nint8[] data",
}.items():
    store.register(get_types_from_msg(text, name))
T = {name.split("/")[-1]: kind for name, kind in store.types.items() if "/msg/" in name}


def f(kind, *values):
    return np.array(values, dtype=kind)


def time(sec, nanosec):
    return store.types["builtin_interfaces/msg/Time"](sec, nanosec)


def header(sec, nanosec, frame_id):
    return T["Header"](time(sec, nanosec), frame_id)


def pose(x, y, z, w):
    return T["Pose"](T["Point"](x, y, 0.25), T["Quaternion"](0.0, 0.0, z, w))


def transform(sec, parent, child):
    return T["TransformStamped"](
        header(sec, 7, parent),
        child,
        T["Transform"](T["Vector3"](1.0, -2.0, 0.5), T["Quaternion"](0.0, 0.0, 0.6, 0.8)),
    )


covariance = f("float64", *range(36))
info = T["MapMetaData"](time(5, 6), 0.05, 3, 2, pose(-1.5, 2.5, 0.0, 1.0))
grid = T["OccupancyGrid"](header(-1, 2, "map"), info, f("int8", -1, 0, 100, 0, -1, 100))
twist = T["Twist"](T["Vector3"](0.1, 0.2, 0.3), T["Vector3"](0.4, 0.5, 0.6))
messages = {
    "sensor_msgs/msg/LaserScan": T["LaserScan"](
        header(1700000000, 250000000, "laser"), -0.5, 0.5, 0.25, 0.0, 0.1, 0.05, 30.0,
        f("float32", 1, 1.5, 2, np.inf, 2.5), f("float32"),
    ),
    "nav_msgs/msg/Odometry": T["Odometry"](
        header(10, 20, "odom"), "base_link",
        T["PoseWithCovariance"](pose(1.0, 2.0, 0.6, 0.8), covariance),
        T["TwistWithCovariance"](twist, covariance),
    ),
    "tf2_msgs/msg/TFMessage": T["TFMessage"](
        [transform(1, "odom", "base_link"), transform(-2, "base", "l")]
    ),
    "nav_msgs/msg/OccupancyGrid": grid,
    "nav_msgs/msg/MapMetaData": info,
    "map_msgs/msg/OccupancyGridUpdate": T["OccupancyGridUpdate"](
        header(3, 4, "map"), 1, -2, 2, 3, f("int8", -1, 0, 100, 0, -1, 100)
    ),
    "geometry_msgs/msg/PoseStamped": T["PoseStamped"](header(3, 4, "map"), pose(1.0, 2.0, 0.0, 1.0)),
    "geometry_msgs/msg/PoseWithCovarianceStamped": T["PoseWithCovarianceStamped"](
        header(3, 4, "map"), T["PoseWithCovariance"](pose(1.0, 2.0, 0.0, 1.0), covariance)
    ),
    "geometry_msgs/msg/PoseArray": T["PoseArray"](
        header(3, 4, "map"), [pose(1.0, 2.0, 0.0, 1.0), pose(3.0, 4.0, 0.6, 0.8)]
    ),
    "nav_msgs/msg/Path": T["Path"](
        header(3, 4, "map"),
        [
            T["PoseStamped"](header(3, 4, "map"), pose(1.0, 2.0, 0.0, 1.0)),
            T["PoseStamped"](header(5, 6, ""), pose(3.0, 4.0, 0.6, 0.8)),
        ],
    ),
    "std_msgs/msg/Float64": T["Float64"](1.25),
    "diagnostic_msgs/msg/DiagnosticArray": T["DiagnosticArray"](
        header(3, 4, ""),
        [T["DiagnosticStatus"](2, "gmapd", "no scans", "robot01", [T["KeyValue"]("age", "3.5 s")])],
    ),
    "nav_msgs/msg/GetMap_Request": T["GetMap_Request"](0),
    "nav_msgs/msg/GetMap_Response": T["GetMap_Response"](grid),
}
for name, message in messages.items():
    wire_name = name.replace("msg/GetMap", "srv/GetMap")
    for order, little in (("little", True), ("big", False)):
        print(wire_name, order, bytes(store.serialize_cdr(message, name, little_endian=little)).hex())
