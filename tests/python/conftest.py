"""The daemon as a process, and clients of it, over Zenoh on loopback."""

import json
import os
import signal
import socket
import subprocess
import threading
import time

import pytest
import robot as rb
import zenoh

GMAPD = os.environ.get("GMAPD", "target/debug/gmapd")
PATIENCE = 30.0  # seconds to wait for what must come
SETTINGS = {
    "scouting/multicast/enabled": "false",
    "scouting/gossip/enabled": "false",
    "connect/timeout_ms": "30000",
}


def free_endpoint():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def open_session(mode, **endpoints):
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps(mode))
    for key, value in SETTINGS.items():
        config.insert_json5(key, value)
    for kind, endpoint in endpoints.items():
        config.insert_json5(f"{kind}/endpoints", json.dumps([endpoint]))
    return zenoh.open(config)


def until(condition, what):
    """Waits until a condition holds and returns what it gives."""
    end = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert time.monotonic() < end, f"waited {PATIENCE} s for {what}"
        time.sleep(0.02)
    return found


class Daemon:
    """`gmapd run` with a directory of its own."""

    def __init__(self, directory, *arguments, prefix="robot01", settings=()):
        self.directory, self.prefix = directory, prefix
        zenoh_file = directory / "zenoh.json5"
        zenoh_file.write_text("{scouting: {multicast: {enabled: false}, gossip: {enabled: false}}}")
        settings = [f"save_directory={directory / 'maps'}", *settings]
        command = [GMAPD, "run", "--prefix", prefix, "--zenoh", str(zenoh_file), *arguments]
        command += [word for setting in settings for word in ("--set", setting)]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        self.log = []
        self.reader = threading.Thread(target=lambda: self.log.extend(self.process.stderr))
        self.reader.start()

    def stop(self, signal_number=signal.SIGTERM):
        self.process.send_signal(signal_number)
        code = self.process.wait(PATIENCE)
        self.reader.join()
        return code


class Client:
    """A session that feeds the daemon and asks it."""

    def __init__(self, session, prefix="robot01"):
        self.session, self.prefix = session, prefix

    def key(self, name):
        return f"{self.prefix}/{name}" if self.prefix else name

    def replies(self, selector, **options):
        return list(self.session.get(self.key(selector), timeout=PATIENCE, **options))

    def ask(self, selector, **options):
        """The one reply's sample."""
        (reply,) = self.replies(selector, **options)
        assert reply.ok, reply.err.payload.to_string()
        return reply.ok

    def error(self, selector, **options):
        """The one error's sentence."""
        (reply,) = self.replies(selector, **options)
        assert reply.err, reply.ok.payload.to_bytes()[:100]
        return reply.err.payload.to_string()

    def json(self, selector, **options):
        sample = self.ask(selector, **options)
        assert str(sample.encoding).startswith("application/json"), sample.encoding
        return json.loads(sample.payload.to_string())

    def status(self):
        return self.json("slam/status")

    def alive(self):
        tokens = self.session.liveliness().get(self.key("slam/alive"), timeout=PATIENCE)
        return any(token.ok for token in tokens)

    def put(self, name, payload, encoding=None):
        options = {"encoding": encoding} if encoding else {}
        self.session.put(
            self.key(name), payload, congestion_control=zenoh.CongestionControl.BLOCK, **options
        )

    def feed(self, readings, encode=None):
        """Publishes odometry and scans, and waits until each scan has its verdict."""
        encode = encode or (lambda kind, message: (rb.to_json(message), "application/json"))
        before = sum(self.status()["scans"].values())
        count = 0
        for seconds, pose in readings:
            self.put("odom", *encode(rb.ODOMETRY, rb.odometry(seconds, pose)))
            self.put("scan", *encode(rb.SCAN, rb.scan(seconds, pose)))
            count += 1
            if count % 8 == 0:
                self.wait_for_verdicts(before + count)
        self.wait_for_verdicts(before + count)

    def wait_for_verdicts(self, total):
        def verdicts():
            return sum(self.status()["scans"].values()) >= total

        until(verdicts, f"{total} verdicts: {self.status()}")


@pytest.fixture
def start(tmp_path):
    """Starts daemons that end with the test; gives daemon and client, joined directly."""
    daemons, sessions = [], []

    def start(prefix="robot01", settings=(), endpoint=None):
        endpoint = endpoint or free_endpoint()
        directory = tmp_path / f"daemon{len(daemons)}"
        directory.mkdir()
        daemon = Daemon(directory, "--listen", endpoint, prefix=prefix, settings=settings)
        daemons.append(daemon)
        sessions.append(open_session("client", connect=endpoint))
        client = Client(sessions[-1], prefix)
        until(client.alive, "the daemon")
        return daemon, client

    yield start
    for session in sessions:
        session.close()
    for daemon in daemons:
        if daemon.process.poll() is None:
            daemon.process.kill()
        daemon.process.wait()
        daemon.reader.join()


@pytest.fixture
def mapped(start):
    """A daemon that has mapped the room, and a client."""
    daemon, client = start()
    client.feed(rb.route())
    until(lambda: (client.status()["map"] or {}).get("scans", 0) > 3, "a map")
    return daemon, client
