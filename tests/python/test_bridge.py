"""Robots and base stations with ROS 2 on DDS, behind real bridges: run by `bridge/test`."""

import math
import os
import pathlib
import subprocess

import pytest

BRIDGE = os.environ.get("GMAPD_BRIDGE")
if not BRIDGE:
    pytest.skip("GMAPD_BRIDGE names no bridge", allow_module_level=True)
LOOPBACK = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface address='127.0.0.1'/>"
    "</Interfaces></General></Domain></CycloneDDS>"
)
os.environ.update(CYCLONEDDS_URI=LOOPBACK, ROS_DISTRO="jazzy")

import dds  # noqa: E402
import robot as rb  # noqa: E402
from conftest import Client, Daemon, free_endpoint, open_session, until  # noqa: E402
from cyclonedds.idl._support import Endianness  # noqa: E402

CONFIGURATIONS = pathlib.Path(__file__).parents[2] / "bridge"
MAP, PATH = "nav_msgs/msg/OccupancyGrid", "nav_msgs/msg/Path"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
# The laser looks back from behind the base's centre.
MOUNT = (-0.2, 0.1, math.pi)
# Domains beside those of anybody else on the machine, and of other runs.
FIRST_DOMAIN = 20 + os.getpid() % 80
OUTPUTS = {
    "/map": MAP,
    "/map_metadata": "nav_msgs/msg/MapMetaData",
    "/map_updates": rb.UPDATE,
    "/pose": POSE,
    "/particlecloud": "geometry_msgs/msg/PoseArray",
    "/path": PATH,
    "/entropy": "std_msgs/msg/Float64",
    "/tf": rb.TF,
}


def dds_name(kind):
    package, group, name = kind.split("/")
    return f"{package}::{group}::dds_::{name}_"


# A line is a message's type, byte order and bytes as `rosbags` writes them.
GOLDEN = [
    pytest.param(kind, order, bytes.fromhex(digits), id=f"{kind}-{order}")
    for kind, order, digits in map(
        str.split, (CONFIGURATIONS.parent / "src/ros/golden/messages.txt").read_text().splitlines()
    )
    if "/msg/" in kind
]


@pytest.mark.parametrize(("kind", "order", "golden"), GOLDEN)
def test_cyclonedds_reads_and_writes_the_golden_bytes(kind, order, golden):
    message = dds.message(kind).deserialize(golden)
    endianness = Endianness[order.capitalize()]
    assert message.serialize(endianness=endianness, use_version_2=False) == golden


class Rig:
    """Starts bridges, daemons and sessions that end with the test."""

    def __init__(self, directory):
        self.directory = directory
        self.processes, self.daemons, self.sessions = [], [], []

    def bridge(self, side, domain, *arguments):
        config = CONFIGURATIONS / f"{side}.json5"
        command = [BRIDGE, "--config", config, "--domain", str(domain), *arguments]
        log = open(self.directory / f"{side}{len(self.processes)}.log", "w")
        self.processes.append(subprocess.Popen(command, stdout=log, stderr=log))

    def daemon(self, endpoint, prefix="robot01", settings=()):
        directory = self.directory / f"daemon{len(self.daemons)}"
        directory.mkdir()
        daemon = Daemon(directory, "--connect", endpoint, prefix=prefix, settings=settings)
        self.daemons.append(daemon)
        return daemon

    def client(self, endpoint, prefix="robot01"):
        self.sessions.append(open_session("client", connect=endpoint))
        client = Client(self.sessions[-1], prefix)
        until(client.alive, "the daemon")
        return client

    def stop(self):
        for session in self.sessions:
            session.close()
        for daemon in self.daemons:
            daemon.process.kill()
            daemon.process.wait()
            daemon.reader.join()
        for process in self.processes:
            process.terminate()
        assert [process.wait(20) for process in self.processes] == [0] * len(self.processes)


@pytest.fixture
def rig(tmp_path):
    rig = Rig(tmp_path)
    yield rig
    rig.stop()
    for log in sorted(tmp_path.glob("*.log")):
        print(f"--- {log.name}\n{log.read_text()[-4000:]}")


class Robot:
    """Its drivers: laser, odometry, and where the laser sits."""

    def __init__(self, domain):
        self.node = dds.Node(domain, "drivers")
        self.scans = self.node.publisher("/scan", rb.SCAN, dds.SENSOR)
        self.odometry = self.node.publisher("/odom", rb.ODOMETRY)
        self.static = self.node.publisher("/tf_static", rb.TF, dds.LATCHED)
        self.static.publish(rb.transforms(0, "base_link", "laser", MOUNT))

    def drive(self, client):
        until(lambda: self.scans.is_matched() and self.odometry.is_matched(), "the bridge to read")
        until(lambda: client.status()["inputs"]["tf_static"]["received"], "the laser's place")
        for number, (seconds, (x, y, yaw)) in enumerate(rb.route(), start=1):
            cosine, sine = math.cos(yaw), math.sin(yaw)
            laser = (
                x + cosine * MOUNT[0] - sine * MOUNT[1],
                y + sine * MOUNT[0] + cosine * MOUNT[1],
                yaw + MOUNT[2],
            )
            self.odometry.publish(rb.odometry(seconds, (x, y, yaw)))
            self.scans.publish(rb.scan(seconds, laser, "laser"))
            client.wait_for_verdicts(number)
        processed = client.status()["scans"]["processed"]
        assert processed > 3, client.status()
        until(lambda: client.status()["map"]["scans"] == processed, "the last map")
        return processed


def latest(subscription, what):
    return until(subscription.take, what)[-1]


def test_topics_and_services_are_there_before_anybody_uses_them(rig):
    endpoint = free_endpoint()
    rig.bridge("robot", FIRST_DOMAIN, "--namespace", "/robot01", "--listen", endpoint)
    rig.daemon(endpoint)
    node = dds.Node(FIRST_DOMAIN, "rviz")
    written = {(f"rt{name}", dds_name(kind)) for name, kind in OUTPUTS.items()}
    seen = set()
    until(lambda: seen.update(node.written_by_others()) or written <= seen, f"topics, not {seen}")
    seen = set()
    request = ("rq/dynamic_mapRequest", dds_name("nav_msgs/srv/GetMap_Request"))
    until(lambda: seen.update(node.read_by_others()) or request in seen, f"service, not {seen}")


@pytest.mark.parametrize("prefix", ["robot01", ""])
def test_a_ros_robot_is_mapped_and_sees_its_map(rig, prefix):
    endpoint = free_endpoint()
    namespace = ["--namespace", f"/{prefix}"] if prefix else []
    rig.bridge("robot", FIRST_DOMAIN, *namespace, "--listen", endpoint)
    robot = Robot(FIRST_DOMAIN)
    rig.daemon(endpoint, prefix, ["map_update_interval=0"])
    client = rig.client(endpoint, prefix)

    early = {name: robot.node.subscription(name, kind) for name, kind in OUTPUTS.items()}
    service = dds.GetMap(robot.node, "/dynamic_map")
    until(service.is_matched, "the service")
    service.ask()
    (empty,) = until(service.take, "the map before there is one")
    assert (empty.info.width, empty.info.height) == (0, 0)

    processed = robot.drive(client)
    for name in ["/map_metadata", "/particlecloud", "/entropy"]:
        latest(early[name], name)
    x, y, _ = list(rb.route())[-1][1]

    def is_there():
        places = [message.pose.pose.position for message in early["/pose"].take()]
        return any(math.hypot(place.x - x, place.y - y) < 0.1 for place in places)

    until(is_there, "the pose at the end of the route")
    (transform,) = latest(early["/tf"], "transforms").transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "odom")

    # RViz and nav2 come late, and there is nothing new to be told.
    for _ in range(2):
        node = dds.Node(FIRST_DOMAIN, "rviz")
        grid = latest(node.subscription("/map", MAP, dds.LATCHED), "the map for who is late")
        rb.assert_room(grid)
        path = latest(node.subscription("/path", PATH, dds.LATCHED), "the path for who is late")
        assert len(path.poses) == processed

    service.ask()
    (answered,) = until(service.take, "the map")
    assert list(answered.data) == list(grid.data)
    direct = rb.from_cdr(MAP, client.ask("map").payload.to_bytes())
    assert list(answered.data) == list(direct.data)


def test_a_base_station_sees_the_robot_under_its_name(rig):
    robot_side, base_side = free_endpoint(), free_endpoint()
    rig.bridge("base", FIRST_DOMAIN + 1, "--listen", base_side)
    rig.bridge(
        "robot", FIRST_DOMAIN, "-n", "/robot01", "--listen", robot_side, "--connect", base_side
    )
    robot = Robot(FIRST_DOMAIN)
    rig.daemon(robot_side, settings=["map_update_interval=0"])
    robot.drive(rig.client(robot_side))

    rviz = dds.Node(FIRST_DOMAIN + 1, "rviz")
    rb.assert_room(latest(rviz.subscription("/robot01/map", MAP, dds.LATCHED), "the robot's map"))
    service = dds.GetMap(rviz, "/robot01/dynamic_map")
    until(service.is_matched, "the robot's service")
    service.ask()
    rb.assert_room(until(service.take, "the robot's map as asked for")[0])


def test_a_bridge_that_comes_last_or_comes_back_finds_everything(rig):
    """The daemon listens here, and does not notice."""
    endpoint = free_endpoint()
    directory = rig.directory / "daemon"
    directory.mkdir()
    rig.daemons.append(Daemon(directory, "--listen", endpoint, settings=["map_update_interval=0"]))
    client = rig.client(endpoint)
    robot = Robot(FIRST_DOMAIN)
    arguments = ["--namespace", "/robot01", "--connect", endpoint, "--listen", free_endpoint()]
    rig.bridge("robot", FIRST_DOMAIN, *arguments)
    robot.drive(client)
    last = rig.processes.pop()
    last.kill()
    last.wait()
    rig.bridge("robot", FIRST_DOMAIN, *arguments)
    rviz = dds.Node(FIRST_DOMAIN, "rviz")
    rb.assert_room(latest(rviz.subscription("/map", MAP, dds.LATCHED), "the map"))
