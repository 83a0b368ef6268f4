"""A ROS 2 node on rmw_zenoh, by an independent implementation of its conventions."""

import json
import signal
import struct
import subprocess

import pytest
import robot as rb
import zenoh.ext
import zenoh_ros2_sdk as ros2
from conftest import GMAPD, free_endpoint, until
from mcap.reader import make_reader
from zenoh_ros2_sdk.qos import QosDurability, QosProfile, QosReliability

DOMAIN = 7
MAP, PATH = "nav_msgs/msg/OccupancyGrid", "nav_msgs/msg/Path"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
GET_MAP = "nav_msgs/srv/GetMap"
GET_MAP_HASH = "RIHS01_c8ae77c9995b3554b5ba80e4d4d443f970ac65143102a1d893ec24fc07b31147"
TOPICS = {
    "/scan": rb.SCAN,
    "/odom": rb.ODOMETRY,
    "/tf": rb.TF,
    "/tf_static": rb.TF,
    "/map": MAP,
    "/map_metadata": "nav_msgs/msg/MapMetaData",
    "/map_updates": rb.UPDATE,
    "/path": PATH,
    "/pose": POSE,
    "/entropy": "std_msgs/msg/Float64",
    "/particlecloud": "geometry_msgs/msg/PoseArray",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}
LATCHED = QosProfile(durability=QosDurability.TRANSIENT_LOCAL, history_depth=1)
SENSOR = QosProfile(reliability=QosReliability.BEST_EFFORT, history_depth=5)


class Node:
    """Endpoints in one domain, on the SDK's one session."""

    def __init__(self, endpoint):
        address, port = endpoint.removeprefix("tcp/").split(":")
        self.mesh = {"domain_id": DOMAIN, "router_ip": address, "router_port": int(port)}

    def close(self):
        # The SDK never closes its session, and the interpreter waits for the session's threads.
        ros2.ZenohSession.get_instance().session.close()

    def typed(self, kind):
        return {**self.mesh, "msg_definition": rb.definition(kind), "type_hash": type_hash(kind)}

    def publisher(self, topic, qos):
        kind = TOPICS[topic]
        return ros2.ROS2Publisher(topic, kind, qos=qos, **self.typed(kind))

    def subscribe(self, topic, qos=None):
        """The messages that come on a topic, as they come."""
        kind, messages = TOPICS[topic], []
        ros2.ROS2Subscriber(topic, kind, messages.append, qos=qos, **self.typed(kind))
        return messages

    def get_map(self):
        client = ros2.ROS2ServiceClient(
            "/dynamic_map",
            GET_MAP,
            request_definition="uint8 structure_needs_at_least_one_member\n",
            response_definition=f"nav_msgs/OccupancyGrid map\n{'=' * 80}\n"
            f"MSG: nav_msgs/OccupancyGrid\n{rb.definition(MAP)}",
            type_hash=GET_MAP_HASH,
            **self.mesh,
        )
        response = client.call(structure_needs_at_least_one_member=0)
        client.close()
        return response.map


def rmw_subscription(session, name, kind):
    """The samples that a transient-local subscription of rmw_zenoh hears."""
    samples = []
    zenoh.ext.declare_advanced_subscriber(
        session,
        rmw_key(name, kind),
        samples.append,
        history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
        recovery=zenoh.ext.RecoveryConfig(heartbeat=True),
        subscriber_detection=True,
    )
    return samples


def type_hash(kind):
    return rb.ROS.hash_rihs01(kind)


def publish(publisher, kind, message):
    fields = vars(rb.to_object(kind, message))
    publisher.publish(**{name: fields[name] for name in message})


def rmw_key(name, kind):
    package, _, name_of_type = kind.split("/")
    return f"{DOMAIN}/{name}/{package}::msg::dds_::{name_of_type}_/{type_hash(kind)}"


def drive(node, client):
    """Publishes odometry and scans, at the pace at which they are mapped."""
    odometry, scan = node.publisher("/odom", None), node.publisher("/scan", SENSOR)
    inputs = client.status()["inputs"]
    assert inputs["scan"]["key"] == "7/scan/sensor_msgs::msg::dds_::LaserScan_/*", inputs
    for number, (seconds, pose) in enumerate(rb.route(), start=1):
        publish(odometry, rb.ODOMETRY, rb.odometry(seconds, pose))
        publish(scan, rb.SCAN, rb.scan(seconds, pose))
        client.wait_for_verdicts(number)


@pytest.fixture
def endpoint():
    return free_endpoint()


@pytest.fixture
def node(endpoint):
    node = Node(endpoint)
    yield node
    node.close()


def test_a_node_feeds_the_daemon_and_is_served_by_it(start, endpoint, node):
    settings = ["interop=rmw_zenoh", f"ros_domain_id={DOMAIN}", "map_update_interval=0"]
    _, client = start(prefix="", settings=settings, endpoint=endpoint)

    empty = node.get_map()
    assert (empty.info.width, empty.info.height) == (0, 0)

    topics = until(lambda: ros2.get_topic_names_and_types(**node.mesh), "the topics")
    assert dict(topics) == {topic: [kind] for topic, kind in TOPICS.items()}
    for topic, kind in TOPICS.items():
        info = ros2.get_topic_info(topic, verbose=True, **node.mesh)
        endpoints = info.publishers + info.subscribers
        assert {end.type_hash for end in endpoints} == {type_hash(kind)}, topic
        assert {(end.node_namespace, end.node_name) for end in endpoints} == {("/", "gmapd")}
    assert [name for name, _ in ros2.get_service_names_and_types(**node.mesh)] == [
        "/dynamic_map"
    ]

    poses, transforms = node.subscribe("/pose"), node.subscribe("/tf")
    drive(node, client)
    processed = client.status()["scans"]["processed"]
    assert processed > 3
    until(lambda: client.status()["map"]["scans"] == processed, "the last map")
    until(lambda: poses, "poses")
    (transform,) = until(lambda: transforms, "transforms")[-1].transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "odom")

    # The first makes the daemon put the map, the second finds it kept.
    for _ in range(2):
        maps = node.subscribe("/map", LATCHED)
        rb.assert_room(until(lambda: maps, "the map")[-1])
    heard = rmw_subscription(client.session, "map", MAP)
    (sample,) = until(lambda: heard, "the map that was kept")
    sequence, _, length = struct.unpack("<qqB", sample.attachment.to_bytes()[:17])
    assert (sequence > 0, length, len(sample.attachment)) == (True, 16, 33)
    paths = node.subscribe("/path", LATCHED)
    assert len(until(lambda: paths, "the path")[-1].poses) == processed

    answered = node.get_map()
    rb.assert_room(answered)
    assert list(answered.data) == list(maps[-1].data)
    # What a ROS 2 node sees is what everybody is told.
    direct = rb.from_cdr(MAP, client.ask("map").payload.to_bytes())
    assert list(answered.data) == list(direct.data)


def test_recordings_have_the_names_that_ros_knows(start, tmp_path, endpoint):
    inside, beside = tmp_path / "inside.mcap", tmp_path / "beside.mcap"
    settings = ["interop=rmw_zenoh", f"ros_domain_id={DOMAIN}", f"record={inside}"]
    daemon, client = start(prefix="", settings=settings, endpoint=endpoint)
    command = [GMAPD, "record", "-e", endpoint, "-o", str(beside)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as recorder:
        assert "recording" in recorder.stderr.readline()
        for number, (seconds, pose) in enumerate(rb.route(), start=1):
            client.put(rmw_key("odom", rb.ODOMETRY), rb.to_cdr(rb.ODOMETRY, rb.odometry(seconds, pose)))
            client.put(rmw_key("scan", rb.SCAN), rb.to_cdr(rb.SCAN, rb.scan(seconds, pose)))
            client.wait_for_verdicts(number)
        status = client.status()
        assert daemon.stop() == 0
        recorder.send_signal(signal.SIGINT)
        assert recorder.wait(30) == 0

    for path in (inside, beside):
        with path.open("rb") as file:
            channels = make_reader(file).get_summary().channels.values()
        assert {"/scan", "/odom", "/pose", "/tf"} <= {channel.topic for channel in channels}
        done = subprocess.run([GMAPD, "replay", path, "--json"], capture_output=True, check=True)
        assert json.loads(done.stdout)["readings"]["processed"] == status["scans"]["processed"]
