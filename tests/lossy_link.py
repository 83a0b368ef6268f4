#!/usr/bin/env python3
"""A program behind a link that loses and delays packets, as bad Wi-Fi does.

    lossy_link.py PORT LOSS DELAY_S COMMAND...

Runs COMMAND in a network of its own, as root. There tcp/10.77.0.1:7447 leads to PORT of this
machine's loopback, over a link between two TUN devices that loses that share of the packets.
Prints how many it lost and carried, a line for each lost one. Exits with 77 if it may not do that.
"""

import collections
import ctypes
import fcntl
import os
import random
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time

CLONE_NEWNET = 0x40000000
TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x400454CA, 0x1, 0x1000
PR_SET_PDEATHSIG = 1
NEAR, FAR = "10.77.0.1", "10.77.0.2"

libc = ctypes.CDLL(None, use_errno=True)


def call(function, *arguments):
    if function(*arguments) != 0:
        raise OSError(ctypes.get_errno(), f"{function.__name__}: not allowed")


def end(own, other):
    """A network of its own for this thread, with a TUN device that leads out of it."""
    call(libc.unshare, CLONE_NEWNET)
    device = os.open("/dev/net/tun", os.O_RDWR)
    fcntl.ioctl(device, TUNSETIFF, struct.pack("16sH", b"lossy", IFF_TUN | IFF_NO_PI))
    for words in ("link set lo up", f"addr add {own} peer {other} dev lossy", "link set lossy up"):
        subprocess.run(["ip", *words.split()], check=True)
    return device, os.open("/proc/self/ns/net", os.O_RDONLY)


def carry(devices, loss, delay):
    """From each device to the other, in order."""
    chance, waiting, carried, lost = random.Random(7), collections.deque(), 0, 0
    while True:
        patience = max(0.0, waiting[0][0] - time.monotonic()) if waiting else None
        for device in select.select(devices, [], [], patience)[0]:
            packet = os.read(device, 65536)
            if chance.random() < loss:
                lost += 1
                print(lost, carried, flush=True)
                continue
            carried += 1
            waiting.append((time.monotonic() + delay, devices[device == devices[0]], packet))
        while waiting and waiting[0][0] <= time.monotonic():
            _, device, packet = waiting.popleft()
            os.write(device, packet)


def copy(source, target):
    try:
        while data := source.recv(65536):
            target.sendall(data)
    except OSError:
        pass
    for side in (source, target):
        try:
            side.shutdown(socket.SHUT_RDWR)
        except OSError:
            pass


def accept(listener, port):
    while True:
        near = listener.accept()[0]
        try:
            far = socket.create_connection(("127.0.0.1", port))
        except OSError:
            near.close()
            continue
        for both in ((near, far), (far, near)):
            threading.Thread(target=copy, args=both, daemon=True).start()


def main():
    port, loss, delay, command = int(sys.argv[1]), float(sys.argv[2]), float(sys.argv[3]), sys.argv[4:]
    here = os.open("/proc/self/ns/net", os.O_RDONLY)
    try:
        far, network = end(FAR, NEAR)
        near, _ = end(NEAR, FAR)
    except (OSError, subprocess.CalledProcessError) as error:
        print(f"there is no network of its own: {error}", file=sys.stderr)
        sys.exit(77)
    listener = socket.create_server((NEAR, 7447))
    call(libc.setns, here, CLONE_NEWNET)

    def enter():
        call(libc.prctl, PR_SET_PDEATHSIG, signal.SIGKILL)
        call(libc.setns, network, CLONE_NEWNET)

    # The link is there before the program looks for it.
    threading.Thread(target=carry, args=([near, far], loss, delay), daemon=True).start()
    threading.Thread(target=accept, args=(listener, port), daemon=True).start()
    sys.exit(subprocess.run(command, preexec_fn=enter, stdout=subprocess.DEVNULL).returncode)


if __name__ == "__main__":
    main()
