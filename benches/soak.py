#!/usr/bin/env python3
"""Four hours of simulated driving with faults: does anything grow?

    benches/soak.py GMAPD [--hours 4] [--rate 60] [--particles 30] [--out FILE.json]

Needs eclipse-zenoh. Plays laps of one building at many times real time to a daemon that keeps its
state and records. At each look at it something is done to it as well: messages that are none,
queries and commands, clients that come and go, and a network that is cut while the robot stands.
Each look is a row: memory since the last one, open files, what a scan takes, how many links ended.

After the first tenth all should stay as it is. What is judged are the medians of whole cycles of
these four doings, by a line through them (the median of all slopes between two cycles): memory may
grow by 5 % of what it was, what a scan takes by 10 %, and open files not at all.
"""

import argparse
import datetime
import hashlib
import itertools
import json
import os
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

# By how much each may grow from the first tenth to the end, as a share of what it was then.
LIMITS = {"anonymous_mb": 0.05, "open_files": 0.0, "ms_p50": 0.10, "cpu_ms": 0.10}

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


class Memory(threading.Thread):
    """Looks ten times a second at what a process has in memory, without its program file's pages:
    with each scan, map and checkpoint it goes up and down by a third."""

    def __init__(self, pid):
        super().__init__(daemon=True)
        self.status, self.megabytes, self.lock = pathlib.Path(f"/proc/{pid}/status"), [], threading.Lock()
        self.start()

    def run(self):
        try:
            while True:
                lines = self.status.read_text().splitlines()
                kib = next((line.split()[1] for line in lines if line.startswith("RssAnon:")), 0)
                with self.lock:
                    self.megabytes.append(int(kib) * 1024 / 1e6)
                time.sleep(0.1)
        except OSError:
            pass

    def take(self):
        """Median and maximum since the last time."""
        with self.lock:
            taken, self.megabytes = self.megabytes, []
        return round(statistics.median(taken), 2), round(max(taken), 1)


def cpu_seconds(pid):
    fields = pathlib.Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Drive:
    """How far the daemon has come, by the stamps of the scans that it had a verdict on."""

    def __init__(self, client):
        self.first = self.last = None
        self.subscriber = client.declare_subscriber("soak/slam/verdict", self.take)

    def take(self, sample):
        stamp = json.loads(sample.payload.to_bytes())["stamp"]
        if stamp is not None:
            self.first = stamp if self.first is None else self.first
            self.last = max(stamp, self.last or stamp)

    def seconds(self):
        return 0.0 if self.last is None else (self.last - self.first) / 1e9


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


def row(process, memory, status, driven, doing):
    scan = status["milliseconds_per_scan"] or {}
    median, most = memory.take()
    return {
        "driven_s": round(driven, 1),
        "after": doing,
        "anonymous_mb": median,
        "most_anonymous_mb": most,
        "open_files": len(list(pathlib.Path(f"/proc/{process.pid}/fd").iterdir())),
        "ms_p50": scan.get("p50"),
        "ms_p99": scan.get("p99"),
        "cpu_s": cpu_seconds(process.pid),
        "scans": status["scans"]["processed"],
        "verdicts": sum(status["scans"].values()),
        "lost": status["scans"]["overload"] + status["scans"]["no_odometry"],
        "rejected": sum(of["rejected"] for of in status["inputs"].values()),
        "links_ended": status["links"]["ended"],
        "checkpoints": status["checkpoint"]["written"],
        "checkpoint_error": status["checkpoint"]["error"],
        "map_m2": (status["map"] or {}).get("known_area_m2"),
    }


def daemon_of(options, directory, endpoint):
    run = [str(options.gmapd.resolve()), "run", "--prefix", "soak", "-e", endpoint]
    run += ["--state", f"{directory}/state", "--set", f"record={directory}/run.mcap"]
    run += ["--set", f"particles={options.particles}", "--set", f"save_directory={directory}"]
    return subprocess.Popen(run, stderr=subprocess.DEVNULL)


def log_of(options, directory):
    """A little more than is driven: a lap takes nearly ten minutes."""
    log, laps = f"{directory}/sim.log", max(2, round(options.hours * 7))
    words = ["simulate", "--laps", str(laps), "--beams", "180", "--outlier-rate", "0", "--out", log]
    subprocess.run([str(options.gmapd.resolve()), *words], check=True, stdout=subprocess.DEVNULL)
    return log


def soak(options, directory):
    log = log_of(options, directory)
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    endpoint = f"tcp/127.0.0.1:{port}"
    router = session("router", listen=endpoint)
    client, wire = session("client", connect=endpoint), Wire(port)
    drive, daemon = Drive(client), daemon_of(options, directory, wire.endpoint)
    memory = Memory(daemon.pid)
    status_of(client)
    play = [str(options.gmapd.resolve()), "play", log, "--prefix", "soak", "--rate", str(options.rate)]
    player = subprocess.Popen([*play, "-e", endpoint], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    faults = Faults(endpoint, wire, player)
    doings = itertools.cycle([faults.garbage, faults.queries, faults.visitors, faults.outage])
    rows, step = [], options.hours * 3600 / options.rate / options.looks
    while player.poll() is None and drive.seconds() < options.hours * 3600:
        time.sleep(step)
        doing = next(doings)
        doing(client)
        rows.append(row(daemon, memory, status_of(client), drive.seconds(), doing.__name__))
        print(json.dumps(rows[-1]), flush=True)
    player.kill()
    daemon.terminate()
    assert daemon.wait(10) == 0, "the daemon did not end well"
    client.close()
    router.close()
    return rows


def cycles_of(rows, hours):
    """The median row of each whole cycle after the first tenth, with what a scan took in it."""
    cycles = []
    for before, cycle in itertools.pairwise([rows[i : i + 4] for i in range(0, len(rows) - 3, 4)]):
        if cycle[0]["driven_s"] < hours * 360:
            continue
        names = ("driven_s", "anonymous_mb", "open_files", "ms_p50")
        medians = {name: statistics.median(r[name] for r in cycle) for name in names}
        spent, scans = (cycle[-1][name] - before[-1][name] for name in ("cpu_s", "verdicts"))
        cycles.append({**medians, "cpu_ms": 1e3 * spent / max(1, scans)})
    return cycles


def growth(cycles, name):
    """From the first cycle to the last, by the line through them, as a share of where it begins."""
    points = [(cycle["driven_s"], cycle[name]) for cycle in cycles]
    pairs = itertools.combinations(points, 2)
    slope = statistics.median((b[1] - a[1]) / (b[0] - a[0]) for a, b in pairs)
    begin = statistics.median(value - slope * (driven - points[0][0]) for driven, value in points)
    return slope * (points[-1][0] - points[0][0]) / begin


def head(options):
    cpus = [line for line in pathlib.Path("/proc/cpuinfo").read_text().splitlines() if "model name" in line]
    git = ["git", "-C", str(pathlib.Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    commit = options.commit or subprocess.run(git, capture_output=True, text=True).stdout.strip()
    return {
        "date": datetime.date.today().isoformat(),
        "commit": commit,
        "program_sha256": hashlib.sha256(options.gmapd.read_bytes()).hexdigest(),
        "machine": f"{cpus[0].partition(':')[2].strip()}, {len(cpus)} virtual cores",
        "particles": options.particles,
        "hours": options.hours,
        "rate": options.rate,
        "load_average_before": os.getloadavg()[2],
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("gmapd", type=pathlib.Path)
    parser.add_argument("--hours", type=float, default=4)
    parser.add_argument("--rate", type=float, default=60)
    parser.add_argument("--particles", type=int, default=30)
    parser.add_argument("--looks", type=int, default=80, help="looks if nothing held the robot up")
    parser.add_argument("--commit", help="of the program; that of this script unless given")
    parser.add_argument("--out", type=pathlib.Path)
    options = parser.parse_args()
    result = {"head": head(options)}
    with tempfile.TemporaryDirectory() as directory:
        rows = soak(options, directory)
    rows = [r for r in rows if r["ms_p50"] is not None]
    cycles = cycles_of(rows, options.hours)
    assert len(cycles) >= 3, "too short to judge"
    grown = {name: round(growth(cycles, name), 4) for name in LIMITS}
    whole = rows[-1]["driven_s"] >= 0.99 * options.hours * 3600
    failed = [name for name, most in LIMITS.items() if grown[name] > most]
    failed += [] if whole else ["driven_s"]
    failed += ["checkpoint_error"] if any(r["checkpoint_error"] for r in rows) else []
    result |= {"growth": grown, "limits": LIMITS, "failed": failed, "cycles": cycles, "rows": rows}
    print(json.dumps({name: result[name] for name in ("head", "growth", "failed")}, indent=1))
    if options.out:
        options.out.write_text(json.dumps(result, indent=1) + "\n")
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
