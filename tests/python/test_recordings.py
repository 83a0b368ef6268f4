"""Recordings: gmapd reads what other programs write, and they read what gmapd writes."""

import json
import re
import signal
import subprocess
import threading

import pytest
import robot as rb
from conftest import GMAPD, until
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", rb.TF))
STEPS = 24


def messages():
    """Topic, type, time of recording in nanoseconds, and CDR."""
    mount = rb.transforms(100.0, "base_link", "laser", (0.1, 0.0, 0.0))
    yield "/tf_static", rb.TF, 99_000_000_000, rb.to_cdr(rb.TF, mount)
    for seconds, pose in rb.route(STEPS):
        time = round(seconds * 1e9)
        odometry, scan = rb.odometry(seconds, pose), rb.scan(seconds, pose, "laser")
        yield "/odom", rb.ODOMETRY, time + 10_000_000, rb.to_cdr(rb.ODOMETRY, odometry)
        yield "/scan", rb.SCAN, time + 20_000_000, rb.to_cdr(rb.SCAN, scan)


def replay(path, *arguments):
    command = [GMAPD, "replay", str(path), "--json", "--set", "linearUpdate=0.1", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "at byte" not in done.stderr, done.stderr
    return json.loads(done.stdout)


def write_bag(path, compression):
    bag = BagWriter(path)
    if compression:
        bag.set_compression(compression)
    with bag:
        connections = {}
        for topic, kind, time, data in messages():
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, kind, typestore=ROS1)
            bag.write(connections[topic], time, rb.ROS.cdr_to_ros1(data, kind))


def write_mcap(path, compression):
    with path.open("wb") as out:
        writer = McapWriter(out, chunk_size=20_000, compression=compression)
        writer.start("ros2", "test")
        channels = {}
        for topic, kind, time, data in messages():
            if topic not in channels:
                text = rb.ROS.generate_msgdef(kind, ros_version=2)[0].encode()
                schema = writer.register_schema(kind, "ros2msg", text)
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic], time, data, time)
        writer.finish()


def write_folder(path, mode):
    folder = FolderWriter(path, version=9, storage_plugin=StoragePlugin.MCAP)
    if mode:
        folder.set_compression(mode, CompressionFormat.ZSTD)
    with folder:
        connections = {}
        for topic, kind, time, data in messages():
            if topic not in connections:
                connections[topic] = folder.add_connection(topic, kind, typestore=rb.ROS)
            folder.write(connections[topic], time, data)


def test_every_format_and_compression_gives_the_same_map(tmp_path):
    paths = []
    for compression in (None, *BagWriter.CompressionFormat):
        paths.append(tmp_path / f"{compression}.bag")
        write_bag(paths[-1], compression)
    for compression in (CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD):
        paths.append(tmp_path / f"{compression}.mcap")
        write_mcap(paths[-1], compression)
    for mode in (None, CompressionMode.STORAGE):
        paths.append(tmp_path / f"folder{mode}")
        write_folder(paths[-1], mode)
    summaries = [replay(path) for path in paths]
    for path, summary in zip(paths, summaries, strict=True):
        counts = summary["readings"]
        assert counts["processed"] == STEPS and counts["refused"] == 0, (path, counts)
        assert summary["sha256"] == summaries[0]["sha256"], path


@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_a_compression_that_is_not_read_is_named(tmp_path, mode):
    write_folder(tmp_path / "folder", mode)
    command = [GMAPD, "replay", str(tmp_path / "folder")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert mode.name.lower() in done.stderr and "ros2 bag convert" in done.stderr, done.stderr


def test_bags_cut_off_anywhere_are_read_as_far_as_they_go(tmp_path):
    for compression in BagWriter.CompressionFormat:
        whole, cut = tmp_path / f"{compression}.bag", tmp_path / "cut.bag"
        write_bag(whole, compression)
        data = whole.read_bytes()
        for part in range(1, 20):
            cut.write_bytes(data[: len(data) * part // 20])
            command = [GMAPD, "replay", str(cut), "--json"]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            # Without a scan there is nothing to map, and without the index nothing is missing.
            assert done.returncode in (0, 1) and "panicked" not in done.stderr, done.stderr
            if not re.search(r"at byte \d+: ", done.stderr):
                assert json.loads(done.stdout)["readings"]["total"] == STEPS, done.stderr


def test_other_programs_read_what_is_recorded(start, tmp_path):
    daemon, client = start(settings=[f"record={tmp_path / 'inside.mcap'}", "linearUpdate=0.1"])
    client.feed(rb.route(STEPS), lambda kind, message: (rb.to_cdr(kind, message), None))
    # As a robot without ROS sends it.
    client.feed((seconds + STEPS, pose) for seconds, pose in rb.route(STEPS))
    until(lambda: client.status()["map"], "a map")
    assert daemon.stop(signal.SIGTERM) == 0
    path = tmp_path / "inside.mcap"
    with AnyReader([path]) as reader:
        kinds = {connection.topic: connection.msgtype for connection in reader.connections}
        assert kinds["/robot01/scan"] == rb.SCAN and kinds["/robot01/odom"] == rb.ODOMETRY
        assert kinds["/robot01/map"] == "nav_msgs/msg/OccupancyGrid"
        assert {"/robot01/pose", "/robot01/path", "/robot01/tf"} <= kinds.keys()
        read = {topic: [] for topic in kinds}
        for connection, _, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            read[connection.topic].append(message)
    assert len(read["/robot01/scan"]) == len(read["/robot01/odom"]) == 2 * STEPS
    grid = read["/robot01/map"][-1]
    assert len(grid.data) == grid.info.width * grid.info.height > 0
    with path.open("rb") as file:
        mcap = make_reader(file, decoder_factories=[DecoderFactory()])
        assert mcap.get_header().profile == "ros2"
        decoded = {topic: 0 for topic in kinds}
        for schema, channel, message, content in mcap.iter_decoded_messages():
            decoded[channel.topic] += 1
            if channel.topic == "/robot01/scan":
                assert message.publish_time == content.header.stamp.sec * 10**9
                assert len(content.ranges) == rb.BEAMS
    assert decoded == {topic: len(contents) for topic, contents in read.items()}


def test_schemas_are_those_of_ros(start, tmp_path):
    """Every type that can be recorded has the fields that its ROS package gives it."""
    daemon, client = start(settings=[f"record={tmp_path / 'run.mcap'}"])
    client.feed(rb.route(STEPS), lambda kind, message: (rb.to_cdr(kind, message), None))
    client.put("tf_static", rb.to_cdr(rb.TF, rb.transforms(1.0, "base_link", "x", (0, 0, 0))))
    assert daemon.stop() == 0
    with (tmp_path / "run.mcap").open("rb") as file:
        schemas = make_reader(file).get_summary().schemas.values()
    assert len(schemas) >= 6, [schema.name for schema in schemas]

    def fields(text):
        """Each definition's fields, without comments and constants."""
        definitions = {}
        for part in re.split(r"=+\n", text):
            lines = [line.split("#")[0].strip() for line in part.splitlines()]
            name = next((line[5:] for line in lines if line.startswith("MSG: ")), "")
            plain = [line for line in lines if line and not line.startswith("MSG:")]
            definitions[name] = [line for line in plain if "=" not in line]
        return definitions

    for schema in schemas:
        assert schema.encoding == "ros2msg"
        expected, _ = rb.ROS.generate_msgdef(schema.name, ros_version=2)
        assert fields(schema.data.decode()) == fields(expected), schema.name


def test_a_robot_is_recorded_from_beside(start, tmp_path):
    daemon, client = start()
    endpoint = daemon.process.args[daemon.process.args.index("--listen") + 1]
    path = tmp_path / "beside.mcap"
    command = [GMAPD, "record", "robot01", "-o", str(path), "-e", endpoint]
    recorder = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        assert "recording robot01" in recorder.stderr.readline()
        threading.Thread(target=recorder.stderr.read, daemon=True).start()
        client.feed(rb.route(STEPS))
        recorder.send_signal(signal.SIGTERM)
        assert recorder.wait(30) == 0
    finally:
        recorder.kill()
        recorder.wait()
    assert not path.with_name("beside.mcap.part").exists()
    with AnyReader([path]) as reader:
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
    assert counts["/robot01/scan"] == STEPS
