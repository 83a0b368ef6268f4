#!/usr/bin/env python3
"""Four hours of simulated driving with faults: does anything grow?

    benches/soak.py GMAPD [--hours 4] [--rate 100] [--particles 30] [--out FILE.json]

Needs eclipse-zenoh. Plays laps of one building to a daemon at many times real time. At each
look at it something is done to it as well: messages that are none, queries and commands, clients
that come and go, and a network that is cut while the robot stands. Each look is a row: memory,
open files, what a scan takes, how many links ended. After the first tenth all should stay as it is.
"""

import argparse
import itertools
import json
import pathlib
import random
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time

import zenoh

SELECTORS = [
    "map", "map?format=png", "map?format=json", "map?format=text", "map?bbox=0,0,9,9;res=0.2",
    "map?bbox=0,0,9,9;layers=hits,visits", "map?bbox=9,9,0,0", "map?format=mp3", "slam/tiles",
    "slam/tiles?want=0:0", "dynamic_map", "pose?at=3", "path?format=tum", "particlecloud",
    "slam/status", "slam/cmd/initial_pose", "slam/cmd/save?name=../x", "slam/cmd/pause",
]  # fmt: skip


class Wire(threading.Thread):
    """A port that leads to another, until it is cut."""

    def __init__(self, port):
        super().__init__(daemon=True)
        self.port, self.pairs, self.whole = port, [], True
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self.listener.getsockname()[1]}"
        self.start()

    def run(self):
        while True:
            near, _ = self.listener.accept()
            try:
                far = socket.create_connection(("127.0.0.1", self.port)) if self.whole else None
            except OSError:
                far = None
            if far is None:
                near.close()
                continue
            self.pairs = [(near, far)]
            for ends in ((near, far), (far, near)):
                threading.Thread(target=self.carry, args=ends, daemon=True).start()

    @staticmethod
    def carry(source, target):
        try:
            while data := source.recv(65536):
                target.sendall(data)
        except OSError:
            pass
        finally:
            source.close()
            target.close()

    def cut(self):
        self.whole = False
        for end in itertools.chain(*self.pairs):
            try:
                end.shutdown(socket.SHUT_RDWR)
            except OSError:
                pass


def session(mode, **endpoints):
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps(mode))
    config.insert_json5("scouting/multicast/enabled", "false")
    for kind, endpoint in endpoints.items():
        config.insert_json5(f"{kind}/endpoints", json.dumps([endpoint]))
    return zenoh.open(config)


def memory(pid):
    """What a process has in memory, MB: all of it, and what is not pages of its program file."""
    lines = pathlib.Path(f"/proc/{pid}/status").read_text().splitlines()
    kib = dict(line.split()[:2] for line in lines if line.startswith(("VmRSS", "RssAnon")))
    return [round(int(kib[of]) * 1024 / 1e6, 1) for of in ("VmRSS:", "RssAnon:")]


def ask(client, selector):
    return [reply for reply in client.get(f"soak/{selector}", timeout=10.0)]


def status_of(client):
    while not (replies := [r for r in ask(client, "slam/status") if r.ok]):
        time.sleep(0.1)
    return json.loads(replies[0].ok.payload.to_bytes())


class Faults:
    def __init__(self, endpoint, wire, player):
        self.endpoint, self.wire, self.player = endpoint, wire, player
        self.chance = random.Random(1)

    def garbage(self, client):
        for key in ("scan", "odom", "tf", "tf_static"):
            for _ in range(50):
                client.put(f"soak/{key}", self.chance.randbytes(self.chance.randrange(3000)))

    def queries(self, client):
        for selector in SELECTORS:
            ask(client, selector)
        ask(client, "slam/cmd/resume")

    def visitors(self, _):
        for _ in range(5):
            visitor = session("client", connect=self.endpoint)
            visitor.declare_subscriber("soak/**", lambda sample: None)
            ask(visitor, "map")
            visitor.close()

    def outage(self, _):
        self.player.send_signal(signal.SIGSTOP)
        time.sleep(0.5)
        self.wire.cut()
        time.sleep(0.5)
        self.wire.whole = True
        time.sleep(3)
        self.player.send_signal(signal.SIGCONT)


def row(process, status, driven):
    scan = status["milliseconds_per_scan"] or {}
    resident, anonymous = memory(process.pid)
    return {
        "driven_s": driven,
        "resident_mb": resident,
        "anonymous_mb": anonymous,
        "open_files": len(list(pathlib.Path(f"/proc/{process.pid}/fd").iterdir())),
        "ms_p50": scan.get("p50"),
        "ms_p99": scan.get("p99"),
        "scans": status["scans"]["processed"],
        "lost": status["scans"]["overload"] + status["scans"]["no_odometry"],
        "rejected": sum(of["rejected"] for of in status["inputs"].values()),
        "links_ended": status["links"]["ended"],
        "map_m2": (status["map"] or {}).get("known_area_m2"),
    }


def soak(options, directory):
    gmapd = str(options.gmapd.resolve())
    log = pathlib.Path(directory) / "sim.log"
    laps = max(2, round(options.hours * 8) + 1)
    simulate = [gmapd, "simulate", "--laps", str(laps), "--beams", "180", "--outlier-rate", "0", "--out", str(log)]
    subprocess.run(simulate, check=True, stdout=subprocess.DEVNULL)
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    endpoint = f"tcp/127.0.0.1:{port}"
    router = session("router", listen=endpoint)
    client, wire = session("client", connect=endpoint), Wire(port)
    run = [gmapd, "run", "--prefix", "soak", "-e", wire.endpoint]
    run += ["--set", f"particles={options.particles}", "--set", f"save_directory={directory}"]
    daemon = subprocess.Popen(run, stderr=subprocess.DEVNULL)
    status_of(client)
    play = [gmapd, "play", str(log), "--prefix", "soak", "--rate", str(options.rate), "-e", endpoint]
    player = subprocess.Popen(play, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    faults = Faults(endpoint, wire, player)
    doings = itertools.cycle([faults.garbage, faults.queries, faults.visitors, faults.outage])
    rows, start, step = [], time.monotonic(), options.hours * 3600 / options.rate / options.looks
    while player.poll() is None and len(rows) < options.looks:
        time.sleep(step)
        next(doings)(client)
        rows.append(row(daemon, status_of(client), round((time.monotonic() - start) * options.rate)))
        print(json.dumps(rows[-1]), flush=True)
    player.kill()
    daemon.terminate()
    assert daemon.wait(10) == 0, "the daemon did not end well"
    client.close()
    router.close()
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("gmapd", type=pathlib.Path)
    parser.add_argument("--hours", type=float, default=4)
    parser.add_argument("--rate", type=float, default=100)
    parser.add_argument("--particles", type=int, default=30)
    parser.add_argument("--looks", type=int, default=60)
    parser.add_argument("--out", type=pathlib.Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        rows = soak(options, directory)
    rows = [r for r in rows if r["ms_p50"] is not None]
    tenth = max(1, len(rows) // 10)
    parts = {"after the first tenth": rows[tenth : 2 * tenth], "in the last": rows[-tenth:]}
    summary = {
        when: {name: round(statistics.mean(r[name] for r in part), 3) for name in rows[0]}
        for when, part in parts.items()
    }
    before, after = (part["anonymous_mb"] for part in summary.values())
    growth = after / before - 1
    print(json.dumps(summary, indent=1), f"\nmemory grew by {100 * growth:.1f} %")
    if options.out:
        options.out.write_text(json.dumps({"rows": rows, "summary": summary}, indent=1) + "\n")
    sys.exit(growth >= 0.05)


if __name__ == "__main__":
    main()
