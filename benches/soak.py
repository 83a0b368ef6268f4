#!/usr/bin/env python3
"""An hour of simulated driving at ten times real time: does anything grow?

    benches/soak.py GMAPD [--seconds 3600] [--rate 10] [--particles 100] [--out FILE.json]

Plays laps of one building to a daemon with a map that somebody takes, and looks at the daemon
once every 60 seconds of driving: its memory, what a scan takes, how many maps it published.
The first lap builds the map; from the second on all should stay as they are.
"""

import argparse
import json
import pathlib
import socket
import statistics
import subprocess
import tempfile
import time


def free_endpoint():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def resident_bytes(pid):
    for line in pathlib.Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) * 1024
    return 0


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("gmapd", type=pathlib.Path)
    parser.add_argument("--seconds", type=float, default=3600)
    parser.add_argument("--rate", type=float, default=10)
    parser.add_argument("--particles", type=int, default=100)
    parser.add_argument("--out", type=pathlib.Path)
    options = parser.parse_args()
    gmapd, endpoint = str(options.gmapd.resolve()), free_endpoint()
    with tempfile.TemporaryDirectory() as directory:
        log = pathlib.Path(directory) / "sim.log"
        laps = max(2, round(options.seconds / 450) + 1)
        simulate = [gmapd, "simulate", "--laps", str(laps), "--out", str(log)]
        subprocess.run(simulate, check=True, stdout=subprocess.DEVNULL)
        run = [gmapd, "run", "--prefix", "soak", "--listen", endpoint]
        run += ["--set", f"particles={options.particles}"]
        daemon = subprocess.Popen(run, stderr=subprocess.DEVNULL)
        play = [gmapd, "play", str(log), "--prefix", "soak", "--rate", str(options.rate), "-e", endpoint]
        ask = [gmapd, "get", "-e", endpoint, "soak", "status", "--json"]
        while subprocess.run(ask, capture_output=True).returncode:
            time.sleep(0.1)
        player = subprocess.Popen(play, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        rows, start, step = [], time.monotonic(), 60 / options.rate
        while player.poll() is None and (time.monotonic() - start) * options.rate < options.seconds:
            time.sleep(step)
            status = json.loads(subprocess.run(ask, capture_output=True, check=True).stdout)
            scan = status["milliseconds_per_scan"] or {}
            row = {
                "driven_s": round((time.monotonic() - start) * options.rate),
                "resident_mb": round(resident_bytes(daemon.pid) / 1e6, 1),
                "ms_p50": scan.get("p50"),
                "ms_p99": scan.get("p99"),
                "scans": status["scans"]["processed"],
                "lost": status["scans"]["overload"] + status["scans"]["no_odometry"],
                "map_version": (status["map"] or {}).get("version"),
                "map_m2": (status["map"] or {}).get("known_area_m2"),
            }
            rows.append(row)
            print(json.dumps(row), flush=True)
        player.kill()
        daemon.terminate()
        assert daemon.wait(10) == 0, "the daemon did not end well"
    third = len(rows) // 3
    summary = {
        name: [round(statistics.mean(r[name] for r in part), 3) for part in (rows[third : 2 * third], rows[2 * third :])]
        for name in ("resident_mb", "ms_p50", "ms_p99")
    }
    print("middle third, last third:", json.dumps(summary))
    if options.out:
        options.out.write_text(json.dumps({"rows": rows, "summary": summary}, indent=1) + "\n")


if __name__ == "__main__":
    main()
