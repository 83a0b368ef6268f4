"""A mirror in Python has the daemon's map, byte for byte, whatever is lost on the way."""

import hashlib
import json
import math
import random
import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path

import pytest
import robot as rb
import zenoh
from conftest import PATIENCE, free_endpoint, open_session, until

SOURCES = Path(__file__).parent.parent.parent / "bridge" / "python"
sys.path.append(str(SOURCES))
from gmapd_mirror import ENTRY, HEAD, MapMirror, Mirror  # noqa: E402


# How often the daemon tells which version is the newest, s.
DIGEST_PERIOD = 1.0


def same_map(client, map):
    label = json.loads(client.ask("map").attachment.to_bytes())
    return label["version"] == map.version and label["sha256"] == map.content_hash()


def until_same(client, mirror):
    until(lambda: mirror.map and same_map(client, mirror.map), "the daemon's map")


def test_the_mirror_has_the_daemons_map(mapped):
    _, client = mapped
    with MapMirror(client.session, "robot01") as mirror:
        map = mirror.wait_for(lambda map: map.version > 0, PATIENCE)
        until_same(client, mirror)
        assert mirror.is_alive and mirror.newest_version >= map.version
        assert mirror.repairs == 1 and mirror.rejected == 0
        assert set(map.cells.flat) == {-1, 0, 100}


def test_the_mirror_follows_resets_and_new_maps(start):
    _, client = start(settings=["map_update_interval=0"])
    with MapMirror(client.session, "robot01") as mirror:
        client.feed(rb.route())
        until_same(client, mirror)
        epoch = mirror.map.epoch
        client.ask("slam/cmd/reset")
        empty = mirror.wait_for(lambda map: map.epoch > epoch, PATIENCE)
        assert empty.cells.size == 0
        client.feed((seconds + 100, pose) for seconds, pose in rb.route())
        until_same(client, mirror)
        assert mirror.map.epoch > epoch and mirror.map.cells.size > 0


def test_after_thirty_percent_were_lost_the_mirror_is_right_within_a_digest_period(start):
    """Between two sessions that do not know each other, messages are forwarded, most of them."""
    _, client = start(settings=["map_update_interval=0"])
    endpoint = free_endpoint()
    far_side = open_session("peer", listen=endpoint)
    far = open_session("client", connect=endpoint)
    chance = random.Random(3)
    share, lost = 0.3, 0

    def forward(sample):
        nonlocal lost
        if chance.random() < share:
            lost += 1
        else:
            far_side.put(sample.key_expr, sample.payload)

    def answer(query):
        selector = f"robot01/slam/tiles?{query.parameters}"
        none = zenoh.ConsolidationMode.NONE
        for reply in client.session.get(selector, consolidation=none):
            query.reply("robot01/slam/tiles", reply.ok.payload)
        query.drop()

    client.session.declare_subscriber("robot01/slam/tiles", forward)
    far_side.declare_queryable("robot01/slam/tiles", answer)
    token = far_side.liveliness().declare_token("robot01/slam/alive")
    with MapMirror(far, "robot01") as mirror:
        client.feed(rb.route())
        assert lost > 0, "something was lost"
        share = 0
        end = time.monotonic()
        until_same(client, mirror)
        assert time.monotonic() - end < DIGEST_PERIOD + 1
    token.undeclare()
    far.close()
    far_side.close()


def message(version, tiles, run=1, known=None, part=0, parts=1):
    """Tiles of two by two cells, each of one value."""

    def entry(index, value):
        if value is None:
            return ENTRY.pack(*index, version, 0, 0)
        cells = bytes([value] * 4)
        deflate = zlib.compressobj(wbits=-15)
        data = deflate.compress(cells) + deflate.flush()
        return ENTRY.pack(*index, version, tile_hash(index, value), len(data)) + data

    known = tiles if known is None else known
    whole = 0
    for index, value in known.items():
        whole ^= tile_hash(index, value)
    head = HEAD.pack(
        b"GMT1", part, parts, run, 1, version, 0, 0.5, 0, 0, 8, 2, whole, len(known), 2, len(tiles)
    )
    return head + b"".join(entry(index, value) for index, value in tiles.items())


def tile_hash(index, value):
    digest = hashlib.sha256(struct.pack("<ii", *index) + bytes([value] * 4)).digest()
    return int.from_bytes(digest[:8], "little")


def test_a_version_is_held_as_a_whole_or_not_at_all():
    mirror = Mirror()
    assert mirror.question() == "since=0"
    first = {(0, 0): 100, (1, 0): 0}
    assert mirror.take(message(1, {(0, 0): 100}, known=first, parts=2)) == Mirror.UNDERWAY
    assert mirror.map() is None
    assert mirror.take(message(1, {(1, 0): 0}, known=first, part=1, parts=2)) == Mirror.NEWEST
    assert mirror.map().cells.tolist() == [[100, 100, 0, 0, -1, -1, -1, -1]] * 2
    second = {(0, 0): 0, (3, 0): 100}
    assert mirror.take(message(2, {(3, 0): 100}, known=second)) == Mirror.MISSING
    assert mirror.map().version == 1
    assert mirror.question() == "since=1;run=0000000000000001"
    assert mirror.take_reply([message(2, {(0, 0): 0, (1, 0): None, (3, 0): 100}, known=second)])
    assert mirror.map().cells.tolist() == [[0, 0, -1, -1, -1, -1, 100, 100]] * 2


def test_what_cannot_be_read_changes_nothing():
    mirror = Mirror()
    good = message(1, {(0, 0): 100})
    for broken in [b"", good[:50], good[:-1], good + b"x", b"GMT2" + good[4:], good[:-1] + b"\xff"]:
        with pytest.raises(ValueError):
            mirror.take(broken)
    assert mirror.newest is None and mirror.map() is None
    assert mirror.take(good) == Mirror.NEWEST


def test_a_resolution_that_no_map_has_is_refused():
    good = message(1, {(0, 0): 100})
    for resolution in [0.0, -0.05, math.nan, math.inf]:
        with pytest.raises(ValueError, match="cells of"):
            Mirror().take(good[:40] + struct.pack("<d", resolution) + good[48:])


def test_what_goes_wrong_is_told_and_the_mirror_goes_on(mapped):
    _, client = mapped
    with MapMirror(client.session, "robot01") as mirror:
        until_same(client, mirror)
        take = mirror._mirror.take

        def fail(message):
            mirror._mirror.take = take
            raise MemoryError("too large")

        mirror._mirror.take = fail
        # The next digest fails, and the one after it is read.
        until(lambda: mirror.last_error, "the error")
        assert mirror.last_error == "MemoryError: too large"
        version = mirror.map.version
        client.feed((seconds + 100, pose) for seconds, pose in rb.route())
        until_same(client, mirror)
        assert mirror.map.version > version


def test_the_example_writes_a_picture(mapped, tmp_path):
    daemon, _ = mapped
    endpoint = next(word for word in daemon.process.args if word.startswith("tcp/"))
    picture = tmp_path / "map.png"
    command = [sys.executable, SOURCES / "plot_map.py", "robot01"]
    options = ["--connect", endpoint, "--out", picture]
    subprocess.run([*command, *options], check=True, timeout=PATIENCE)
    assert picture.read_bytes().startswith(b"\x89PNG")
