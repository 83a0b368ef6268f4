#!/usr/bin/env python3
"""GetMap through the bridge on a map of 4000 x 4000 cells: latency and memory.

    benches/bridge.py GMAPD GMAPD_BRIDGE [--calls 10] [--out FILE.json]

Needs what `bridge/requirements.txt` names (`bridge/test` installs it in `target/bridge-venv`).
One scan of 100 m makes the map; a ROS 2 node on DDS, played by CycloneDDS, calls
`/dynamic_map` again and again, and a Zenoh client asks the daemon itself beside it.
"""

import argparse
import json
import math
import os
import pathlib
import statistics
import sys
import tempfile
import time

import numpy as np

TESTS = pathlib.Path(__file__).resolve().parent.parent / "tests/python"
DOMAIN = 20 + os.getpid() % 80


def peak_bytes(process):
    for line in pathlib.Path(f"/proc/{process.pid}/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024
    raise RuntimeError("the kernel tells no peak memory")


def timed(calls, ask):
    times = []
    for _ in range(calls):
        start = time.perf_counter()
        ask()
        times.append(1000 * (time.perf_counter() - start))
    return {"median_ms": statistics.median(times), "max_ms": max(times)}


def far_scan(rb):
    """What a laser in the middle of a hall of 199.9 m sees."""
    angles = -math.pi + 2 * math.pi / 720 * np.arange(720)
    ranges = 99.95 / np.maximum(np.abs(np.cos(angles)), np.abs(np.sin(angles)))
    increment = {"angle_max": angles[-1], "angle_increment": 2 * math.pi / 720}
    reach = {"range_max": 150.0, "ranges": ranges.astype(np.float32)}
    return {**rb.scan(0.0, (0.0, 0.0, 0.0)), **increment, **reach}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("gmapd", type=pathlib.Path)
    parser.add_argument("bridge", type=pathlib.Path)
    parser.add_argument("--calls", type=int, default=10)
    parser.add_argument("--out", type=pathlib.Path)
    options = parser.parse_args()
    os.environ.update(GMAPD=str(options.gmapd.resolve()), GMAPD_BRIDGE=str(options.bridge.resolve()))
    sys.path.insert(0, str(TESTS))
    import dds
    import robot as rb
    import test_bridge
    from conftest import free_endpoint, until

    with tempfile.TemporaryDirectory() as directory:
        rig = test_bridge.Rig(pathlib.Path(directory))
        try:
            endpoint = free_endpoint()
            rig.bridge("robot", DOMAIN, "--namespace", "/robot01", "--listen", endpoint)
            settings = ["maxUrange=150", "map_update_interval=0", "particles=1"]
            daemon = rig.daemon(endpoint, settings=settings)
            client = rig.client(endpoint)
            origin = (0.0, 0.0, 0.0)
            client.put("odom", rb.to_json(rb.odometry(0.0, origin)), "application/json")
            client.put("scan", rb.to_json(far_scan(rb)), "application/json")
            until(lambda: client.status()["map"], "the map")
            before = [peak_bytes(process) for process in (daemon.process, *rig.processes)]
            service = dds.GetMap(dds.Node(DOMAIN, "bench"), "/dynamic_map")
            until(service.is_matched, "the service")

            def get_map():
                service.ask()
                return until(lambda: service.replies.take(N=1), "the map")[0].map

            grid = get_map()
            plain = grid.serialize(use_version_2=False)
            info = grid.info
            report = {
                "cells": [info.width, info.height],
                "through_the_bridge": timed(options.calls, get_map),
                "of_which_python_decodes": timed(options.calls, lambda: type(grid).deserialize(plain)),
                "from_the_daemon": timed(options.calls, lambda: client.ask("map")),
            }
            for name, process, first in zip(
                ("daemon", "bridge"), (daemon.process, *rig.processes), before, strict=True
            ):
                peak = {"before": first / 1e6, "peak": peak_bytes(process) / 1e6}
                report[f"{name}_megabytes"] = peak
        finally:
            rig.stop()
    text = json.dumps(report, indent=1)
    print(text)
    if options.out:
        options.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
