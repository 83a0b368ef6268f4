"""Shows the map of a robot as it grows; or writes it to a picture, with --out.

    pip install eclipse-zenoh numpy matplotlib
    python plot_map.py robot01 --connect tcp/192.168.1.20:7447
"""

import argparse
import json
import sys

import numpy as np
import zenoh

from gmapd_mirror import MapMirror


def arguments():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("robot", help="what the robot's keys begin with, such as robot01")
    parser.add_argument("--connect", metavar="ENDPOINT", help="such as tcp/192.168.1.20:7447")
    parser.add_argument("--out", metavar="FILE", help="write one picture and end")
    parser.add_argument("--seconds", type=float, default=30.0, help="to wait for the first map")
    return parser.parse_args()


def config(endpoint):
    config = zenoh.Config()
    if endpoint:
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    return config


def shades(map):
    """Unknown grey, free white, occupied black."""
    return np.where(map.cells < 0, 0.5, 1.0 - np.maximum(map.cells, 0) / 100.0)


def draw(axes, map):
    height, width = map.cells.shape
    x, y = map.origin
    extent = (x, x + width * map.resolution, y, y + height * map.resolution)
    axes.clear()
    axes.imshow(shades(map), cmap="gray", vmin=0, vmax=1, origin="lower", extent=extent)
    axes.set(title=f"version {map.version}, epoch {map.epoch}", xlabel="x (m)", ylabel="y (m)")


def main():
    options = arguments()
    import matplotlib

    if options.out:
        matplotlib.use("Agg")
    from matplotlib import pyplot

    with zenoh.open(config(options.connect)) as session:
        with MapMirror(session, options.robot) as mirror:
            try:
                map = mirror.wait_for(lambda map: map.version > 0, options.seconds)
            except TimeoutError:
                state = "has no map yet" if mirror.is_alive else "is not on this mesh"
                sys.exit(f"{options.robot} {state} after {options.seconds:g} s {mirror.last_error or ''}")
            figure, axes = pyplot.subplots()
            draw(axes, map)
            if options.out:
                figure.savefig(options.out)
                return
            while pyplot.fignum_exists(figure.number):
                if mirror.map is not map:
                    map = mirror.map
                    draw(axes, map)
                pyplot.pause(0.2)


if __name__ == "__main__":
    main()
