#!/usr/bin/env python3
"""What a client that takes all that the daemon sends and stops reading costs the filter and the others.

    benches/dead_client.py GMAPD [--rounds 4] [--seconds 10] [--out FILE.json]

Needs eclipse-zenoh. A daemon maps a simulated drive at fifty times real time; a client asks it
for the map again and again. In every other round a process of its own, which takes all
that the daemon sends, is stopped as a laptop whose lid is closed.
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

TAKES_ALL = """
import sys; sys.path.insert(0, {folder!r})
from soak import session
taker = session("client", connect={endpoint!r})
for key in {keys}:
    taker.declare_subscriber(f"soak/{{key}}", lambda sample: None)
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


def measure(daemon, client, seconds):
    processed = lambda: status_of(client)["scans"]["processed"]
    scans, cpu, times = processed(), cpu_seconds(daemon.pid), []
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        start = time.perf_counter()
        replies = list(client.get("soak/map", timeout=10.0))
        assert [bool(reply.ok) for reply in replies] == [True], f"{replies} after {time.perf_counter() - start} s"
        times.append(1000 * (time.perf_counter() - start))
        time.sleep(0.05)
    spent = 1000 * (cpu_seconds(daemon.pid) - cpu)
    return {"filter_ms": spent / max(1, processed() - scans), "map_ms": statistics.median(times)}


def run(options, directory):
    gmapd, log = str(options.gmapd.resolve()), pathlib.Path(directory) / "sim.log"
    simulate = [gmapd, "simulate", "--laps", "12", "--beams", "360", "--out", str(log)]
    subprocess.run(simulate, check=True, stdout=subprocess.DEVNULL)
    daemon = subprocess.Popen(
        [gmapd, "run", "--prefix", "soak", "-l", "tcp/127.0.0.1:0"], stderr=subprocess.PIPE, text=True
    )
    line = next(line for line in daemon.stderr if "tcp/127.0.0.1:" in line)
    endpoint = "tcp/127.0.0.1:" + line.partition("tcp/127.0.0.1:")[2].split()[0].strip(",")
    client = session("client", connect=endpoint)
    play = [gmapd, "play", str(log), "--prefix", "soak", "--rate", "50", "-e", endpoint]
    player = subprocess.Popen(play, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    folder = str(pathlib.Path(__file__).resolve().parent)
    taker = [sys.executable, "-c", TAKES_ALL.format(folder=folder, endpoint=endpoint, keys=KEYS)]
    rounds = {"alone": [], "with a dead client": []}
    measure(daemon, client, options.seconds)
    for number in range(2 * options.rounds):
        dead = None
        if number % 2:
            dead = subprocess.Popen(taker, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
            dead.stdout.readline()
            dead.send_signal(signal.SIGSTOP)
        name = list(rounds)[number % 2]
        rounds[name].append(measure(daemon, client, options.seconds))
        print(name, json.dumps(rounds[name][-1]), flush=True)
        if dead:
            dead.kill()
            dead.wait()
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
    parser.add_argument("--out", type=pathlib.Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        rounds = run(options, directory)
    median = {
        name: {key: statistics.median(r[key] for r in of) for key in of[0]}
        for name, of in rounds.items()
    }
    alone, dead = median.values()
    ratio = {key: round(dead[key] / alone[key], 3) for key in alone}
    print(json.dumps({"median": median, "ratio": ratio}, indent=1))
    if options.out:
        text = json.dumps({"rounds": rounds, "median": median, "ratio": ratio}, indent=1)
        options.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
