"""What a robot, a base station and a stranger see of the daemon."""

import hashlib
import json
import math
import signal

import numpy as np
import pytest
import robot as rb
import zenoh
import zenoh.ext
from conftest import Client, Daemon, free_endpoint, open_session, until

MAP, PATH = "nav_msgs/msg/OccupancyGrid", "nav_msgs/msg/Path"
METADATA = "nav_msgs/msg/MapMetaData"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
CLOUD, ENTROPY = "geometry_msgs/msg/PoseArray", "std_msgs/msg/Float64"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"


def big_endian(kind, message):
    return rb.to_cdr(kind, message, little_endian=False), None


def little_endian(kind, message):
    return rb.to_cdr(kind, message), None


@pytest.mark.parametrize("encode", [little_endian, big_endian, None])
def test_a_room_is_mapped_from_cdr_of_both_orders_and_from_json(start, encode):
    _, client = start()
    client.feed(rb.route(), encode)
    status = client.status()
    assert status["scans"]["processed"] > 3
    assert sum(status["scans"].values()) == 24
    until(lambda: client.status()["map"]["scans"] == status["scans"]["processed"], "the last map")
    sample = client.ask("map")
    assert str(sample.encoding) == f"application/cdr;{MAP}"
    rb.assert_room(rb.from_cdr(MAP, sample.payload.to_bytes()))


def test_odometry_may_come_as_a_transform_and_the_mount_as_a_static_one(start):
    _, client = start()
    mount = (0.3, -0.1, math.pi / 2)
    client.put("tf_static", rb.to_json(rb.transforms(0, "base_link", "laser", mount)))
    for count, (seconds, (x, y, yaw)) in enumerate(rb.route(), 1):
        cosine, sine = math.cos(yaw), math.sin(yaw)
        laser = (
            x + cosine * mount[0] - sine * mount[1],
            y + sine * mount[0] + cosine * mount[1],
            yaw + mount[2],
        )
        client.put("tf", rb.to_json(rb.transforms(seconds, "odom", "base_link", (x, y, yaw))))
        client.put("scan", rb.to_json(rb.scan(seconds, laser, frame="laser")))
        client.wait_for_verdicts(count)
    processed = client.status()["scans"]["processed"]
    assert processed > 3
    until(lambda: client.status()["map"]["scans"] == processed, "the last map")
    rb.assert_room(rb.from_cdr(MAP, client.ask("map").payload.to_bytes()))


def test_the_map_comes_in_every_format(mapped):
    _, client = mapped
    sample = client.ask("map?format=cdr")
    grid = rb.from_cdr(MAP, sample.payload.to_bytes())
    attachment = json.loads(sample.attachment.to_string())
    assert attachment["version"] == client.status()["map"]["version"]
    assert attachment["stamp"]["sec"] == grid.header.stamp.sec

    as_json = client.json("map?format=json")
    assert (as_json["width"], as_json["height"]) == (grid.info.width, grid.info.height)
    png = client.ask("map?format=png")
    assert str(png.encoding) == "image/png" and min(rb.png_size(png.payload.to_bytes())) > 100
    pgm = client.ask("map?format=pgm").payload.to_bytes()
    assert pgm.startswith(b"P5") and set(pgm[-grid.info.width * grid.info.height :]) <= {0, 205, 254}
    yaml = client.ask("map?format=yaml").payload.to_string()
    assert "resolution: 0.05" in yaml and "origin:" in yaml
    text = client.ask("map?format=text;cols=60").payload.to_string()
    *drawing, legend = text.splitlines()
    assert len(drawing) > 5 and max(map(len, drawing)) <= 60 and "robot" in legend

    metadata = rb.from_cdr(METADATA, client.ask("map_metadata?format=cdr").payload.to_bytes())
    assert (metadata.width, metadata.height) == (grid.info.width, grid.info.height)


def test_pose_path_cloud_and_entropy_are_answered_as_cdr_and_json(mapped):
    _, client = mapped
    readings = list(rb.route())
    x, y, yaw = readings[-1][1]
    pose = rb.from_cdr(POSE, client.ask("pose?format=cdr").payload.to_bytes())
    assert pose.header.frame_id == "map"
    place = pose.pose.pose.position
    assert math.hypot(place.x - x, place.y - y) < 0.1
    assert client.json("pose")["pose"]["pose"]["position"]["x"] == place.x

    path = rb.from_cdr(PATH, client.ask("path?format=cdr").payload.to_bytes())
    assert len(path.poses) == client.status()["map"]["scans"] == len(client.json("path")["poses"])
    cloud = rb.from_cdr(CLOUD, client.ask("particlecloud?format=cdr").payload.to_bytes())
    assert len(cloud.poses) == client.status()["filter"]["particles"]
    entropy = rb.from_cdr(ENTROPY, client.ask("entropy?format=cdr").payload.to_bytes())
    assert 0 <= entropy.data <= math.log(len(cloud.poses)) + 1e-9

    first, second = path.poses[0].header.stamp, path.poses[1].header.stamp
    middle = (first.sec + second.sec) / 2
    between = client.json(f"pose?at={middle}")["pose"]["pose"]["position"]
    ends = [(p.pose.position.x, p.pose.position.y) for p in path.poses[:2]]
    assert between["x"] == pytest.approx((ends[0][0] + ends[1][0]) / 2, abs=1e-6)
    assert "100" in client.error("pose?at=5")


def test_wrong_selectors_are_told_what_is_allowed(mapped):
    _, client = mapped
    for selector, words in {
        "map?format=jpeg": ["jpeg", "png", "cdr"],
        "map?fromat=png": ["fromat", "format"],
        "map?format=text;cols=many": ["cols", "many"],
        "pose?at=yesterday": ["at", "yesterday"],
        "path?format=png": ["png", "cdr", "json"],
        "slam/status?verbose=1": ["verbose"],
        "slam/cmd/reset?x=1": ["y"],
        "slam/cmd/save?name=../secrets": ["name"],
        "slam/cmd/initial_pose?x=nan;y=0;yaw=0": ["x", "nan"],
    }.items():
        sentence = client.error(selector)
        assert all(word.lower() in sentence.lower() for word in words), f"{selector}: {sentence}"


def test_get_map_is_answered_as_bridges_ask_it(start):
    _, client = start()
    for request in (b"\0\1\0\0\0", b"\0\1\0\0\0\0\0\0", b"\0\1\0\0"):
        sample = client.ask("dynamic_map", payload=request)
        empty = rb.from_cdr(MAP, sample.payload.to_bytes())
        assert (empty.info.width, empty.info.height, len(empty.data)) == (0, 0, 0)
    client.feed(rb.route())
    until(lambda: client.status()["map"], "a map")
    answer = client.ask("dynamic_map", payload=b"\0\1\0\0\0").payload.to_bytes()
    assert rb.from_cdr(MAP, answer).info.width > 0


def test_before_the_first_map_grids_are_empty_and_pictures_refused(start):
    _, client = start()
    assert rb.from_cdr(MAP, client.ask("map").payload.to_bytes()).info.width == 0
    assert client.json("map?format=json")["width"] == 0
    assert "no map" in client.error("map?format=png").lower()
    status = client.status()
    assert status["state"] == "waiting_for_scans" and client.key("scan") in status["detail"]


def test_subscribers_get_every_output_and_late_ones_the_last_map(start):
    _, client = start()
    kinds = {
        "map_metadata": METADATA, "pose": POSE, "particlecloud": CLOUD, "path": PATH,
        "entropy": ENTROPY, "diagnostics": DIAGNOSTICS, "tf": rb.TF, "map": MAP,
    }
    heard = {name: [] for name in kinds}
    subscribers = [
        client.session.declare_subscriber(client.key(name), heard[name].append) for name in kinds
    ]
    client.feed(rb.route())
    until(lambda: all(heard.values()), f"all outputs: { {k: len(v) for k, v in heard.items()} }")

    def decoded(name):
        return [rb.from_cdr(kinds[name], sample.payload.to_bytes()) for sample in heard[name]]

    own = [m for m in decoded("tf") if m.transforms[0].header.frame_id == "map"]
    assert own and own[0].transforms[0].child_frame_id == "odom"
    assert all(pose.header.frame_id == "map" for pose in decoded("pose"))
    assert all(grid.info.resolution == pytest.approx(0.05) for grid in decoded("map"))
    assert all(d.status[0].values for d in decoded("diagnostics"))
    for subscriber in subscribers:
        subscriber.undeclare()

    late = []
    zenoh.ext.declare_advanced_subscriber(
        client.session,
        client.key("map"),
        late.append,
        history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
    )
    until(lambda: late, "the last map for a late subscriber")
    assert rb.from_cdr(MAP, late[0].payload.to_bytes()).info.width > 0


def test_commands_say_what_they_did(mapped):
    _, client = mapped
    assert client.json("slam/cmd/pause")["changed"]
    assert not client.json("slam/cmd/pause")["changed"]
    assert client.status()["state"] == "paused"
    later = [(seconds + 100, pose) for seconds, pose in rb.route()]
    client.feed(later[:3])
    assert client.status()["scans"]["paused"] == 3
    assert client.json("slam/cmd/resume")["changed"]
    assert not client.json("slam/cmd/resume")["changed"]

    assert client.json("slam/cmd/reset?x=10;y=20;yaw=1")["changed"]
    assert client.status()["map"] is None
    client.feed(later[3:4])
    place = client.json("pose")["pose"]["pose"]["position"]
    assert (place["x"], place["y"]) == pytest.approx((10, 20))
    client.json("slam/cmd/initial_pose?x=11;y=20;yaw=1")
    moved = until(
        lambda: client.json("pose")["pose"]["pose"]["position"]["x"] > 10.5, "the moved pose"
    )
    assert moved


def test_saving_writes_map_server_files_in_the_directory_and_nowhere_else(mapped):
    daemon, client = mapped
    client.json("slam/cmd/save?name=room")
    maps = daemon.directory / "maps"
    assert {"room.pgm", "room.yaml", "room.png"} <= {path.name for path in maps.iterdir()}
    assert "image: room.pgm" in (maps / "room.yaml").read_text()
    assert (maps / "room.pgm").read_bytes() == client.ask("map?format=pgm").payload.to_bytes()
    before = sorted(daemon.directory.rglob("*"))
    for name in ["../room2", "/tmp/room2", "a/b", "", ".hidden", "x" * 300, ".."]:
        client.error(f"slam/cmd/save?name={name}")
    assert sorted(daemon.directory.rglob("*")) == before


@pytest.mark.parametrize("name", ["scan", "odom", "tf", "tf_static"])
def test_bad_bytes_are_counted_and_told_and_mapping_goes_on(mapped, name):
    _, client = mapped
    good = rb.to_cdr(rb.SCAN, rb.scan(1.0, (0, 0, 0)))
    huge = good[:12] + b"\xf0\xff\xff\xff" + good[16:]
    bad = [b"", b"\0", b"\0\1\0\0", b"nonsense", b'{"header": 5}', b"{" * 5000, huge, bytes(70000)]
    before = client.status()["inputs"][name]["rejected"]
    for payload in bad:
        client.put(name, payload)
    after = lambda: client.status()["inputs"][name]
    until(lambda: after()["rejected"] >= before + len(bad) - 1, f"rejections: {after()}")
    assert after()["last_rejection"]
    processed = client.status()["scans"]["processed"]
    client.feed([(seconds + 1000, pose) for seconds, pose in rb.route()])
    assert client.status()["scans"]["processed"] > processed


def test_without_odometry_the_status_says_so(start):
    _, client = start(settings=["odometry_timeout_s=0.05"])
    for count, (seconds, pose) in enumerate(list(rb.route())[:3], 1):
        client.put("scan", rb.to_json(rb.scan(seconds, pose)))
        client.wait_for_verdicts(count)
    status = client.status()
    assert status["scans"]["no_odometry"] == 3 and status["state"] == "waiting_for_odometry"
    assert client.key("odom") in status["detail"]


def test_a_tilted_laser_is_refused_with_its_tilt(start):
    _, client = start()
    message = rb.transforms(0, "base_link", "laser", (0, 0, 0))
    half = math.radians(20) / 2
    message["transforms"][0]["transform"]["rotation"].update(x=math.sin(half), w=math.cos(half))
    client.put("tf_static", rb.to_json(message))
    seconds, pose = next(rb.route())
    client.put("odom", rb.to_json(rb.odometry(seconds, pose)))
    client.put("scan", rb.to_json(rb.scan(seconds, pose, frame="laser")))
    client.wait_for_verdicts(1)
    status = client.status()
    assert status["scans"]["tilted_mount"] == 1
    assert "20" in status["last_details"]["tilted_mount"]


def test_through_a_router_that_dies_and_returns(tmp_path):
    endpoint = free_endpoint()
    router = open_session("router", listen=endpoint)
    daemon = Daemon(tmp_path, "--connect", endpoint, prefix="site/robot01")
    try:
        client = Client(open_session("client", connect=endpoint), "site/robot01")
        until(client.alive, "the daemon behind the router")
        client.feed(list(rb.route())[:8])
        router.close()
        until(lambda: not client.alive(), "the loss of the router")
        router = open_session("router", listen=endpoint)
        until(client.alive, "the daemon behind the new router")
        processed = client.status()["scans"]["processed"]
        client.feed(list(rb.route())[8:])
        assert client.status()["scans"]["processed"] > processed
        client.session.close()
        assert daemon.stop() == 0
    finally:
        daemon.process.kill()
        router.close()


def test_a_daemon_that_restarts_is_heard_again(tmp_path):
    endpoint = free_endpoint()
    with open_session("router", listen=endpoint) as router:
        client = Client(router)
        maps = []
        zenoh.ext.declare_advanced_subscriber(
            router,
            client.key("map"),
            maps.append,
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
        )
        for number in (1, 2):
            (tmp_path / str(number)).mkdir()
            daemon = Daemon(tmp_path / str(number), "--connect", endpoint)
            try:
                until(client.alive, "the daemon")
                before = len(maps)
                client.feed(rb.route())
                until(lambda: len(maps) > before, "its map")
                assert daemon.stop(signal.SIGINT) == 0
                until(lambda: not client.alive(), "its token to vanish")
            finally:
                daemon.process.kill()


def test_a_client_that_never_reads_holds_nobody_up(start):
    daemon, client = start()
    endpoint = next(word for word in daemon.process.args if word.startswith("tcp/"))
    # The handler is a queue of one sample that nobody empties: Zenoh's thread there stands still.
    deaf = open_session("client", connect=endpoint)
    queue = zenoh.handlers.FifoChannel(1)
    kept = [deaf.declare_subscriber(client.key(name), queue) for name in ("map", "pose", "path")]
    for lap in range(4):
        client.feed([(seconds + 100 * lap, pose) for seconds, pose in rb.route()])
    assert client.status()["scans"]["processed"] > 12
    for subscriber in kept:
        while subscriber.try_recv():
            pass
    deaf.close()


def test_same_input_gives_the_same_map(start):
    hashes = set()
    for _ in range(2):
        _, client = start(settings=["particles=12"])
        client.feed(rb.route())
        processed = client.status()["scans"]["processed"]
        until(lambda: client.status()["map"]["scans"] == processed, "the last map")
        hashes.add(hashlib.sha256(client.ask("map").payload.to_bytes()).hexdigest())
    assert len(hashes) == 1
