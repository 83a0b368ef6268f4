"""Follows the map of a robot that gmapd maps, tile by tile.

Needs eclipse-zenoh and numpy, and nothing else:

    import zenoh
    from gmapd_mirror import MapMirror

    with zenoh.open(zenoh.Config()) as session, MapMirror(session, "robot01") as mirror:
        map = mirror.wait_for(lambda map: map.version > 0)
        print(map.version, map.resolution, map.origin, map.cells.shape)

Whoever neither closes the session nor uses `with` waits for ever at the end of the program: Zenoh's
threads keep it.

What is held is always one version as a whole, never a mixture of two. What was lost on the way is
asked for. `docs/mesh.md` of gmapd describes the messages.
"""

import hashlib
import math
import queue
import struct
import threading
import zlib
from typing import NamedTuple

import numpy as np
import zenoh

HEAD = struct.Struct("<4sHHQQQqdiiIIQIHH")
ENTRY = struct.Struct("<iiQQH")
LARGEST_SIDE = 256
LARGEST_MAP = 1 << 30
# Messages that wait to be read; more are lost, and asked for.
WAITING = 256
# A whole map through a slow network takes its time, s.
LONGEST_ANSWER = 60.0


class Head(NamedTuple):
    """What a whole map is."""

    magic: bytes
    part: int
    parts: int
    run: int
    epoch: int
    version: int
    stamp_ns: int
    resolution: float
    ix: int
    iy: int
    width: int
    height: int
    hash: int
    tiles: int
    side: int
    entries: int


class Entry(NamedTuple):
    """A tile in a message: hash 0 and no cells if nothing of it is known."""

    index: tuple
    version: int
    hash: int
    cells: object


class Map(NamedTuple):
    """One version of a map."""

    run: int
    """Of the daemon's life: versions of different runs have nothing to do with each other."""
    epoch: int
    """Grows when the map was corrected or begun anew, and not when it only grew."""
    version: int
    """Grows with every change; 0 before the first scan."""
    stamp_ns: int
    """Of the last scan in it."""
    resolution: float
    """Metres a cell."""
    origin: tuple
    """The lower-left corner of the first cell in `map`, m."""
    cells: np.ndarray
    """Rows from the lowest y, int8: -1 unknown, 0 free, 100 occupied."""

    def content_hash(self):
        """The `sha256` of the attachment that gmapd gives a map with."""
        height, width = self.cells.shape
        head = struct.pack("<QQddd", width, height, self.resolution, *self.origin)
        return hashlib.sha256(head + self.cells.tobytes()).hexdigest()


class Mirror:
    """Puts tiles together; knows nothing of the mesh."""

    NEWEST, UNDERWAY, MISSING = "newest", "underway", "missing"

    def __init__(self):
        self.head = None
        """Of the version that is held."""
        self.newest = None
        """The newest head that was heard of."""
        self._tiles = {}
        self._waiting = {}
        self._map = None

    def question(self):
        """What to ask slam/tiles for, to get what is missing."""
        if self.head is None or self.head.version == 0:
            return "since=0"
        return f"since={self.head.version};run={self.head.run:016x}"

    @property
    def is_newest(self):
        return self.newest is not None and self._is_held(self.newest)

    def map(self):
        """The last version that was whole; None before the first one."""
        if self._map is None and self.head is not None:
            self._map = self._draw()
        return self._map

    def take(self, message):
        """Takes a message that was published; ValueError if it cannot be read."""
        head, entries = self._read(message)
        self._hear(head)
        self._wait_for(entries.values())
        self._merge(self.newest, self._waiting)
        if self.is_newest:
            return self.NEWEST
        more = head.part + 1 < head.parts and head.version == self.newest.version
        return self.UNDERWAY if more else self.MISSING

    def take_reply(self, messages):
        """Takes all that came in reply to the question; whether it gave a whole version."""
        head, tiles = None, {}
        for message in messages:
            head, entries = self._read(message)
            tiles.update(entries)
        if head is None:
            return False
        self._hear(head)
        older = self._continues(head) and head.version < self.head.version
        if not older and not self._merge(head, tiles):
            self._wait_for(tiles.values())
        whole = self._is_held(head)
        self._merge(self.newest, self._waiting)
        return whole or self.is_newest

    def _is_held(self, head):
        held = self.head
        return held is not None and (held.run, held.version) == (head.run, head.version)

    def _continues(self, head):
        held = self.head
        return held is not None and (held.run, held.side) == (head.run, head.side)

    def _read(self, message):
        if len(message) < HEAD.size:
            raise ValueError(f"a message of {len(message)} bytes has no head")
        head = Head(*HEAD.unpack_from(message))
        if head.magic != b"GMT1":
            raise ValueError(f"the message begins with {head.magic!r}, and not with GMT1")
        if not 1 <= head.side <= LARGEST_SIDE or head.width * head.height > LARGEST_MAP:
            raise ValueError(f"no map is like this: {head}")
        if not (math.isfinite(head.resolution) and head.resolution > 0):
            raise ValueError(f"no map has cells of {head.resolution} m")
        entries, at = {}, HEAD.size
        for _ in range(head.entries):
            if at + ENTRY.size > len(message):
                raise ValueError("the message ends within a tile")
            tx, ty, version, tile_hash, length = ENTRY.unpack_from(message, at)
            at += ENTRY.size
            data = message[at : at + length]
            at += length
            if len(data) != length:
                raise ValueError("the message ends within a tile")
            # Without data and with a hash, a tile is only told of.
            if data or tile_hash == 0:
                cells = self._cells(head, (tx, ty), tile_hash, data) if tile_hash else None
                entries[tx, ty] = Entry((tx, ty), version, tile_hash, cells)
        if at != len(message):
            raise ValueError(f"{len(message) - at} bytes are left at the end of the message")
        return head, entries

    def _cells(self, head, index, tile_hash, data):
        held = self._tiles.get(index)
        if held and held.hash == tile_hash and self._continues(head):
            return held.cells
        count = head.side**2
        inflate = zlib.decompressobj(wbits=-15)
        try:
            cells = inflate.decompress(data, count + 1)
        except zlib.error as error:
            raise ValueError(f"the cells of tile {index} cannot be read") from error
        digest = hashlib.sha256(struct.pack("<ii", *index) + cells).digest()
        if len(cells) != count or max(1, int.from_bytes(digest[:8], "little")) != tile_hash:
            raise ValueError(f"the cells of tile {index} are others than its hash says")
        return np.frombuffer(cells, np.int8).reshape(head.side, head.side)

    def _hear(self, head):
        if self.newest is None or self.newest.run != head.run:
            # Nothing of another run goes with it.
            self._waiting.clear()
            self.newest = head
        elif head.version > self.newest.version:
            self.newest = head

    def _wait_for(self, entries):
        known = self.head.version if self.head and self.head.run == self.newest.run else 0
        for entry in entries:
            waiting = self._waiting.get(entry.index)
            if entry.version > known and (not waiting or entry.version >= waiting.version):
                self._waiting[entry.index] = entry

    def _merge(self, head, tiles):
        """Holds the map of `head`, if these tiles over those that are held give its hash."""
        if self._is_held(head):
            return False
        base = self._tiles if self._continues(head) else {}
        found, count = (self.head.hash, self.head.tiles) if base else (0, 0)
        for index, entry in tiles.items():
            before = base[index].hash if index in base else 0
            found ^= before ^ entry.hash
            count += (entry.hash != 0) - (before != 0)
        if (found, count) != (head.hash, head.tiles):
            return False
        merged = {**base, **tiles}
        self._tiles = {index: entry for index, entry in merged.items() if entry.hash}
        self.head, self._map = head, None
        waiting = self._waiting.items()
        self._waiting = {index: e for index, e in waiting if e.version > head.version}
        return True

    def _draw(self):
        head = self.head
        cells = np.full((head.height, head.width), -1, np.int8)
        for (tx, ty), entry in self._tiles.items():
            left, bottom = tx * head.side - head.ix, ty * head.side - head.iy
            x0, x1 = max(left, 0), min(left + head.side, head.width)
            y0, y1 = max(bottom, 0), min(bottom + head.side, head.height)
            if x0 < x1 and y0 < y1:
                part = entry.cells[y0 - bottom : y1 - bottom, x0 - left : x1 - left]
                cells[y0:y1, x0:x1] = part
        cells.flags.writeable = False
        origin = (head.ix * head.resolution, head.iy * head.resolution)
        about = (head.run, head.epoch, head.version, head.stamp_ns, head.resolution)
        return Map(*about, origin, cells)


class MapMirror:
    """Follows the map of one robot over a session, until it is closed."""

    def __init__(self, session, robot):
        prefix = f"{robot.strip('/')}/" if robot.strip("/") else ""
        self._key = f"{prefix}slam/tiles"
        self._session = session
        self._mirror = Mirror()
        self._map = None
        self._changed = threading.Condition()
        self._news = queue.SimpleQueue()
        self._asked = None
        self.is_alive = False
        """Whether the daemon is there."""
        self.repairs = 0
        """How often something had to be asked for, the first time included."""
        self.rejected = 0
        """Messages that could not be read."""
        self.last_error = None
        """What the daemon said when it refused the last question, or what went wrong here; None
        since all is well."""
        self._follower = threading.Thread(target=self._follow, name="gmapd-mirror", daemon=True)
        self._follower.start()
        self._tiles = session.declare_subscriber(self._key, self._on_message)
        self._life = session.liveliness().declare_subscriber(
            f"{prefix}slam/alive", self._on_life, history=True
        )

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def close(self):
        self._tiles.undeclare()
        self._life.undeclare()
        self._news.put(("end", None))
        self._follower.join()

    @property
    def map(self):
        """The last version that came as a whole; None before the first one."""
        with self._changed:
            return self._map

    @property
    def newest_version(self):
        """The newest version that was heard of; None before anything was."""
        newest = self._mirror.newest
        return newest.version if newest else None

    def wait_for(self, wanted, timeout=None):
        """Waits for a map that is as wanted, and returns it; TimeoutError if none comes in time."""
        with self._changed:
            found = self._changed.wait_for(lambda: self._map and wanted(self._map), timeout)
            if not found:
                raise TimeoutError(f"no such map came in {timeout} s")
            return self._map

    # Zenoh's threads are never held up: what does not fit is lost, and asked for later.

    def _on_message(self, sample):
        if self._news.qsize() < WAITING:
            self._news.put(("message", sample.payload.to_bytes()))

    def _on_life(self, sample):
        self._news.put(("life", sample.kind == zenoh.SampleKind.PUT))

    def _follow(self):
        while True:
            kind, what = self._news.get()
            if kind == "end":
                return
            try:
                getattr(self, f"_take_{kind}")(what)
                self._show()
            except ValueError:
                self.rejected += 1
            except Exception as error:  # noqa: BLE001: who waits for a map is told, and may wait on
                self.last_error = f"{type(error).__name__}: {error}"

    def _show(self):
        if (head := self._mirror.head) and (self._map is None or not self._is_shown(head)):
            map = self._mirror.map()
            with self._changed:
                self._map = map
                self._changed.notify_all()

    def _is_shown(self, head):
        return (self._map.run, self._map.version) == (head.run, head.version)

    def _take_message(self, message):
        if self._mirror.take(message) == Mirror.MISSING and self._asked is None:
            self._ask()

    def _take_life(self, is_alive):
        self.is_alive = is_alive
        # Who comes (back) may be another daemon, or have gone on meanwhile.
        if is_alive:
            self._ask()

    def _take_reply(self, reply):
        number, messages, refusal = reply
        if number != self._asked:
            return
        self._asked, self.last_error = None, refusal
        # Newer tiles were lost while this came; otherwise the next digest is waited for.
        if self._mirror.take_reply(messages) and not self._mirror.is_newest:
            self._ask()

    def _ask(self):
        """Asks for what is missing. What was asked for before may be on a way that is no more."""
        self.repairs += 1
        self._asked = number = self.repairs
        selector = f"{self._key}?{self._mirror.question()}"

        def ask():
            messages, refusal = [], None
            try:
                replies = self._session.get(
                    selector,
                    # All replies have the same key.
                    consolidation=zenoh.ConsolidationMode.NONE,
                    timeout=LONGEST_ANSWER,
                )
                for reply in replies:
                    if reply.ok:
                        messages.append(reply.ok.payload.to_bytes())
                    else:
                        refusal = reply.err.payload.to_string()
            except zenoh.ZError as error:
                refusal = str(error)
            self._news.put(("reply", (number, messages, refusal)))

        threading.Thread(target=ask, name="gmapd-mirror-ask", daemon=True).start()
