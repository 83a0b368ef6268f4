#!/usr/bin/env python3
"""Measure `gmapd replay` on recorded and simulated logs and write a dated report.

    benches/report.py DATA [--out DIR] [--gmapd FILE] [--callgrind] [--quick]

DATA holds intel/intel.log, intel/intel.relations, aces/aces.log, tinyslam/exp1.log and
sena/sena.log; those that are missing are left out. Without --out the report is written to
benches/runs/<date>, which must not be there yet. Needs nothing beyond Python's standard library.
"""

import argparse
import dataclasses
import datetime
import itertools
import json
import os
import pathlib
import platform
import re
import shutil
import subprocess
import sys
import tempfile

ROOT = pathlib.Path(__file__).resolve().parent.parent
PHASES = ["match", "resample", "register", "map"]
PARTICLES = [30, 100, 500]
THREADS = [1, 2]
# In place of a number of particles; it has one thread.
HECTOR = "Hector"


@dataclasses.dataclass
class Log:
    """A log to replay, and what belongs to it."""

    name: str
    path: pathlib.Path
    settings: list
    relations: pathlib.Path | None = None


def main():
    arguments = parse_arguments()
    date = datetime.date.today().isoformat()
    out = arguments.out or ROOT / "benches" / "runs" / date
    if out.exists():
        sys.exit(f"{out} is already there")
    gmapd = arguments.gmapd or build()
    with tempfile.TemporaryDirectory() as scratch:
        scratch = pathlib.Path(scratch)
        logs = recorded_logs(arguments.data) + simulated_logs(gmapd, scratch)
        sizes = (PARTICLES[:1], THREADS[:1]) if arguments.quick else (PARTICLES, THREADS)
        runs = []
        for log in logs:
            for particles, threads in [(HECTOR, 1), *itertools.product(*sizes)]:
                runs.append(measure(gmapd, log, particles, threads, scratch))
                tell(runs[-1])
        instructions = count_instructions(gmapd, logs[0], scratch) if arguments.callgrind else None
    out.mkdir(parents=True)
    raw = {"date": date, "machine": machine(), "commit": commit(), "runs": runs,
           "instructions": instructions}
    (out / "runs.json").write_text(json.dumps(raw, indent=1) + "\n")
    (out / "README.md").write_text(report(raw))
    print(f"wrote {out}/README.md and runs.json", file=sys.stderr)


def parse_arguments():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=pathlib.Path, help="directory of the recorded logs")
    parser.add_argument("--out", type=pathlib.Path, help="directory to make for the report")
    parser.add_argument("--gmapd", type=pathlib.Path, help="program to measure; built if not given")
    parser.add_argument("--callgrind", action="store_true", help="count instructions (valgrind)")
    parser.add_argument("--quick", action="store_true", help="Hector, and 30 particles on one thread")
    return parser.parse_args()


def build():
    subprocess.run(["cargo", "build", "--release", "--locked"], cwd=ROOT, check=True)
    target = os.environ.get("CARGO_TARGET_DIR", ROOT / "target")
    return pathlib.Path(target) / "release" / "gmapd"


def recorded_logs(data):
    logs = [
        Log("intel", data / "intel/intel.log", ["maxUrange=40"], data / "intel/intel.relations"),
        Log("ACES", data / "aces/aces.log", ["maxUrange=40"]),
        Log("tinySLAM", data / "tinyslam/exp1.log", ["maxUrange=4"]),
        Log("sena", data / "sena/sena.log", []),
    ]
    for log in logs:
        if not log.path.exists():
            print(f"left out: {log.path} is not there", file=sys.stderr)
    return [log for log in logs if log.path.exists()]


def simulated_logs(gmapd, scratch):
    logs = []
    for beams in [360, 1080]:
        path = scratch / f"simulated-{beams}.log"
        run([gmapd, "simulate", "--beams", beams, "--out", path])
        logs.append(Log(f"simulated, {beams} beams", path, []))
    return logs


def run(command):
    """Runs a command and returns what it prints; its complaints are shown if it fails."""
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True)
    if done.returncode != 0:
        sys.exit(f"{' '.join(map(str, command))} failed:\n{done.stderr}")
    return done.stdout


def replay_command(gmapd, log, particles, threads):
    if particles == HECTOR:
        return [gmapd, "replay", log.path, "--engine", "hector", "--json"]
    settings = [f"particles={particles}", *log.settings]
    options = [word for setting in settings for word in ("--set", setting)]
    return [gmapd, "replay", log.path, *options, "--threads", threads, "--json"]


def measure(gmapd, log, particles, threads, scratch):
    out = scratch / "out"
    shutil.rmtree(out, ignore_errors=True)
    command = replay_command(gmapd, log, particles, threads)
    summary = json.loads(run([*command, "--out", out]))
    if summary["debug_build"]:
        sys.exit("a debug build measures nothing")
    return {
        "log": log.name,
        "settings": [] if particles == HECTOR else log.settings,
        "particles": particles,
        "threads": threads,
        "accuracy": accuracy(gmapd, out / "trajectory.tum", log.relations),
        "readings": summary["readings"],
        "resamples": summary["resamples"],
        "timing": summary["timing"],
        "tiles": summary["tiles"],
        "sha256": summary["sha256"],
    }


def accuracy(gmapd, trajectory, relations):
    """Mean errors over known relations; `None` for a log without."""
    if relations is None or not relations.exists():
        return None
    found = json.loads(run([gmapd, "evaluate", trajectory, relations, "--json"]))
    return {"translation_m": found["translation_m"], "rotation_deg": found["rotation_deg"],
            "used": found["used"]}


def count_instructions(gmapd, log, scratch):
    """Instructions a processed scan with 30 particles on one thread, by callgrind."""
    if shutil.which("valgrind") is None:
        print("left out: valgrind is not installed", file=sys.stderr)
        return None
    file = scratch / "callgrind.out"
    # Collection is on while the filter takes a scan, whether or not it is processed.
    toggle = "--toggle-collect=*GMapping*add_scan*"
    tool = ["valgrind", "--tool=callgrind", toggle, f"--callgrind-out-file={file}"]
    summary = json.loads(run([*tool, *replay_command(gmapd, log, 30, 1)]))
    totals = re.search(r"^(?:totals|summary): (\d+)", file.read_text(), re.MULTILINE)
    total = int(totals.group(1)) if totals else 0
    if total == 0:
        print("left out: callgrind did not find add_scan", file=sys.stderr)
        return None
    processed = summary["readings"]["processed"]
    return {"log": log.name, "particles": 30, "total": total, "processed": processed,
            "per_processed_scan": round(total / processed)}


def machine():
    cpu = platform.processor() or platform.machine()
    try:
        names = re.findall(r"^model name\s*: (.*)$", pathlib.Path("/proc/cpuinfo").read_text(), re.M)
        cpu = names[0] if names else cpu
    except OSError:
        pass
    load = os.getloadavg()[0]
    rustc = run(["rustc", "--version"]).strip() if shutil.which("rustc") else "rustc unknown"
    return f"{cpu}, {os.cpu_count()} logical processors, load {load:.1f} at the end, {rustc}"


def commit():
    try:
        described = run(["git", "-C", ROOT, "describe", "--always", "--dirty", "--abbrev=12"])
    except FileNotFoundError:
        return "unknown"
    return described.strip()


def tell(measured):
    scan, particles = measured["timing"]["scan"]["cpu_ms"], measured["particles"]
    engine = HECTOR if particles == HECTOR else f"{particles} particles"
    print(f"{measured['log']}: {engine}, {measured['threads']} threads: "
          f"{scan['mean']:.3f} ms a scan", file=sys.stderr)


def report(raw):
    runs = raw["runs"]
    parts = [
        f"# Measurements of {raw['date']}\n",
        f"- Machine: {raw['machine']}.",
        f"- Commit: `{raw['commit']}`.",
        f"- Command: `benches/report.py DATA{command_options(raw)}`, which runs "
        "`gmapd replay LOG --set particles=N --threads T --json` with slam_gmapping's defaults "
        "and the settings named below, seed 1, and `gmapd replay LOG --engine hector --json` with "
        "Hector's defaults.",
        "- Raw figures: `runs.json`.\n",
        "Settings: " + "; ".join(settings(runs)) + ".\n",
        "## Accuracy and cost\n",
        "CPU and wall are milliseconds a processed scan, the whole of the filter and the output "
        "map; CPU is that of all threads together. Hector processes every scan, GMapping those "
        "after a way or a turn.",
        "Error is the mean over the log's relations, where it has any.\n",
        table(["log", "particles", "threads", "error m", "error degrees", "CPU mean", "p50", "p99",
               "wall mean", "times real time", "peak MB", "tiles MB", "resampled"],
              [cost_row(measured) for measured in runs]),
        "## Where the time goes\n",
        "CPU milliseconds a processed scan: mean, and p99 in brackets.\n",
        table(["log", "particles", "threads", "processed", *PHASES],
              [phase_row(measured) for measured in runs]),
    ]
    if raw["instructions"]:
        counted = raw["instructions"]
        parts += ["## Instructions\n",
                  f"{counted['log']}, {counted['particles']} particles, one thread: "
                  f"{counted['per_processed_scan'] / 1e6:.2f} million instructions a processed "
                  "scan (callgrind, `GMapping::add_scan` and what it calls).\n"]
    parts += ["## Same results on any number of threads\n", same_results(runs) + "\n"]
    return "\n".join(parts)


def command_options(raw):
    found = {run["particles"] for run in raw["runs"]}
    options = "" if found == {HECTOR, *PARTICLES} else " --quick"
    return options + (" --callgrind" if raw["instructions"] else "")


def settings(runs):
    found = {run["log"]: " ".join(run["settings"]) or "none" for run in runs}
    return [f"{log}: `{text}`" if text != "none" else f"{log}: none" for log, text in found.items()]


def cost_row(measured):
    timing, found = measured["timing"], measured["accuracy"]
    cpu, wall = timing["scan"]["cpu_ms"], timing["scan"]["wall_ms"]
    errors = ["", ""]
    if found and found["translation_m"]:
        errors = [f"{found['translation_m']['mean']:.4f}", f"{found['rotation_deg']['mean']:.3f}"]
    peak = timing["peak_memory_bytes"]
    return [measured["log"], measured["particles"], measured["threads"], *errors,
            f"{cpu['mean']:.3f}", f"{cpu['p50']:.3f}", f"{cpu['p99']:.3f}", f"{wall['mean']:.3f}",
            f"{timing['real_time_factor']:.0f}", f"{peak / 1e6:.1f}" if peak else "",
            f"{measured['tiles']['bytes'] / 1e6:.1f}", measured["resamples"]]


def phase_row(measured):
    phases = measured["timing"]["phases"]
    spreads = [phases[phase]["cpu_ms"] for phase in PHASES]
    return [measured["log"], measured["particles"], measured["threads"],
            measured["readings"]["processed"],
            *[f"{spread['mean']:.3f} ({spread['p99']:.3f})" for spread in spreads]]


def same_results(runs):
    threads = sorted({measured["threads"] for measured in runs})
    if len(threads) == 1:
        return "Not measured: all runs had the same number of threads."
    hashes = {}
    for measured in (run for run in runs if run["particles"] != HECTOR):
        key = (measured["log"], measured["particles"])
        hashes.setdefault(key, set()).add(json.dumps(measured["sha256"], sort_keys=True))
    differing = [f"{log} with {count} particles" for (log, count), found in hashes.items()
                 if len(found) > 1]
    if differing:
        return "**Map or trajectory differ for " + ", ".join(differing) + ".**"
    numbers = " and ".join(map(str, threads))
    return f"Map and trajectory have the same SHA-256 with {numbers} threads, in all {len(hashes)} cases."


def table(head, rows):
    rule = ["---" if column == 0 else "---:" for column in range(len(head))]
    lines = [head, rule, *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines) + "\n"


if __name__ == "__main__":
    main()
