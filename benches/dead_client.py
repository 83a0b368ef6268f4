#!/usr/bin/env python3
"""What a client that takes all that the daemon sends, and reads slowly or not at all, costs the
filter and the others.

    benches/dead_client.py GMAPD [--rounds 4] [--seconds 10] [--out FILE.json]

Needs eclipse-zenoh. A daemon maps a simulated drive at fifty times real time; a client asks it
again and again for the map, the pose and what changed, and takes the poses that it sends. Beside
it a process of its own takes all that the daemon sends: in some rounds none does, in some it
waits after each message, and in some it is stopped as a laptop whose lid is closed. The order of
these turns round each time.

Ends with 1 when the filter or a client took more than 1.10 times as long as alone.
"""

import argparse
import json
import pathlib
import signal
import statistics
import subprocess
import sys
import tempfile
import time

from soak import session, status_of

# What the daemon sends. What the robot sends it may send with Block, and then Zenoh itself waits for
# whoever does not read.
KEYS = [
    "map", "map_metadata", "map_updates", "slam/tiles", "slam/verdict", "path", "pose",
    "particlecloud", "entropy", "diagnostics",
]  # fmt: skip

MOST = 1.10
# Beside nobody, one that waits so long after each message, s, and one that does not read at all.
BESIDE = {"alone": None, "with a slow client": 0.1, "with a dead client": 0.0}

TAKES_ALL = """
import sys; sys.path.insert(0, {folder!r})
import time
from soak import session
taker = session("client", connect={endpoint!r})
for key in {keys}:
    taker.declare_subscriber(f"soak/{{key}}", lambda sample: time.sleep({delay}))
print("taking", flush=True)
sys.stdin.read()
"""


def cpu_seconds(pid):
    """Of the filter's threads."""
    ticks = 0
    for task in pathlib.Path(f"/proc/{pid}/task").iterdir():
        name, _, rest = (task / "stat").read_text().partition(") ")
        if name.partition("(")[2].startswith(("mapper", "particles")):
            ticks += sum(int(field) for field in rest.split()[11:13])
    return ticks / 100


def ask(client, selector):
    start = time.perf_counter()
    replies = list(client.get(selector, timeout=10.0))
    spent = 1000 * (time.perf_counter() - start)
    assert replies and all(reply.ok for reply in replies), f"{replies} after {spent} ms"
    return spent


def measure(daemon, client, seconds):
    """Medians of a round, ms."""
    processed = lambda: status_of(client)["scans"]["processed"]
    arrivals = []
    poses = client.declare_subscriber("soak/pose", lambda _: arrivals.append(time.perf_counter()))
    times = {"map": [], "pose": [], "slam/tiles?want=none": []}
    scans, cpu = processed(), cpu_seconds(daemon.pid)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        for selector, spent in times.items():
            spent.append(ask(client, f"soak/{selector}"))
        time.sleep(0.05)
    spent = 1000 * (cpu_seconds(daemon.pid) - cpu)
    poses.undeclare()
    gaps = [1000 * (b - a) for a, b in zip(arrivals, arrivals[1:])]
    map_ms, pose_ms, tiles_ms = (statistics.median(spent) for spent in times.values())
    return {
        "filter_ms": spent / max(1, processed() - scans),
        "map_ms": map_ms,
        "pose_ms": pose_ms,
        "tiles_ms": tiles_ms,
        "between_poses_ms": statistics.median(gaps),
    }


def beside(delay, endpoint):
    """A process that takes all and waits so long after each message; 0 stops it altogether."""
    folder = str(pathlib.Path(__file__).resolve().parent)
    text = TAKES_ALL.format(folder=folder, endpoint=endpoint, keys=KEYS, delay=delay)
    taker = subprocess.Popen(
        [sys.executable, "-c", text], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    taker.stdout.readline()
    if delay == 0:
        taker.send_signal(signal.SIGSTOP)
    return taker


def run(options, directory):
    gmapd, log = str(options.gmapd.resolve()), pathlib.Path(directory) / "sim.log"
    # A lap takes ten seconds.
    laps = str(2 + round((3 * options.rounds + 1) * options.seconds / 8))
    simulate = [gmapd, "simulate", "--laps", laps, "--beams", "360", "--out", str(log)]
    subprocess.run(simulate, check=True, stdout=subprocess.DEVNULL)
    daemon = subprocess.Popen(
        [gmapd, "run", "--prefix", "soak", "-l", "tcp/127.0.0.1:0"], stderr=subprocess.PIPE, text=True
    )
    line = next(line for line in daemon.stderr if "tcp/127.0.0.1:" in line)
    endpoint = "tcp/127.0.0.1:" + line.partition("tcp/127.0.0.1:")[2].split()[0].strip(",")
    client = session("client", connect=endpoint)
    play = [gmapd, "play", str(log), "--prefix", "soak", "--rate", "50", "-e", endpoint]
    player = subprocess.Popen(play, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    rounds = {name: [] for name in BESIDE}
    try:
        while not status_of(client)["scans"]["processed"]:
            time.sleep(0.1)
        measure(daemon, client, options.seconds)
        for number in range(options.rounds):
            order = list(BESIDE)[:: 1 if number % 2 == 0 else -1]
            for name in order:
                taker = None if BESIDE[name] is None else beside(BESIDE[name], endpoint)
                rounds[name].append(measure(daemon, client, options.seconds))
                print(name, json.dumps(rounds[name][-1]), flush=True)
                if taker:
                    taker.kill()
                    taker.wait()
    finally:
        player.kill()
        daemon.terminate()
        daemon.wait(20)
        client.close()
    return rounds


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("gmapd", type=pathlib.Path)
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=10)
    parser.add_argument("--machine", default="", help="what it runs on, for the file")
    parser.add_argument("--out", type=pathlib.Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        rounds = run(options, directory)
    median = {
        name: {key: statistics.median(r[key] for r in of) for key in of[0]}
        for name, of in rounds.items()
    }
    alone = median.pop("alone")
    ratio = {
        name: {key: round(value / alone[key], 3) for key, value in of.items()}
        for name, of in median.items()
    }
    result = {"machine": options.machine, "median": {"alone": alone, **median}, "ratio": ratio}
    print(json.dumps(result, indent=1))
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps({"rounds": rounds, **result}, indent=1) + "\n")
    sys.exit(any(value > MOST for of in ratio.values() for value in of.values()))


if __name__ == "__main__":
    main()
