//! A map as tiles, each with a version and a hash: how they are written.
//!
//! A message has a head, which says what the whole map is, and some of its tiles. Whoever holds
//! tiles whose hashes give that of the head has that map, however they came.
//! `docs/mesh.md` has the bytes.

use std::io::{Read as _, Write as _};

use byteorder::{ByteOrder as _, LittleEndian};
use bytes::Bytes;
use flate2::Compression;
use flate2::read::DeflateDecoder;
use flate2::write::DeflateEncoder;
use sha2::{Digest as _, Sha256};
use thiserror::Error;

/// Cells along the side of a tile.
pub const TILE_SIDE: usize = 64;
/// Cells in a tile.
pub const TILE_CELLS: usize = TILE_SIDE * TILE_SIDE;

/// A message is not larger, so that it fits a batch of Zenoh's as a whole and is never in pieces.
pub const LARGEST_MESSAGE: usize = 60_000;

const MAGIC: &[u8; 4] = b"GMT1";
const HEAD: usize = 80;
const ENTRY: usize = 26;

/// Tiles of other writers have at most as many cells along the side.
const LARGEST_SIDE: u16 = 256;

/// A map of another writer has at most as many cells, known ones and those between them.
const LARGEST_MAP: u64 = 1 << 30;

/// Which tile: cells divided by the cells along a side, rounded down; rows order first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TileIndex {
    /// Row of tiles.
    pub ty: i32,
    /// Column of tiles.
    pub tx: i32,
}

/// A rectangle of cells in the grid without bounds whose cell (0, 0) begins at the origin of `map`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Extent {
    /// Its first column.
    pub ix: i32,
    /// Its first row.
    pub iy: i32,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

impl Extent {
    /// The smallest rectangle that holds both.
    #[must_use]
    pub fn union(self, other: Self) -> Self {
        if self.width == 0 || self.height == 0 {
            return other;
        }
        if other.width == 0 || other.height == 0 {
            return self;
        }
        let join = |a: i32, a_size: u32, b: i32, b_size: u32| {
            let first = a.min(b);
            let end = (i64::from(a) + i64::from(a_size)).max(i64::from(b) + i64::from(b_size));
            (first, (end - i64::from(first)) as u32)
        };
        let (ix, width) = join(self.ix, self.width, other.ix, other.width);
        let (iy, height) = join(self.iy, self.height, other.iy, other.height);
        Self { ix, iy, width, height }
    }
}

/// What a whole map is.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Head {
    /// Of the daemon's life: versions of different runs have nothing to do with each other.
    pub run: u64,
    /// Grows when the map is corrected or begun anew, and not when it only grows.
    pub epoch: u64,
    /// Grows with every change, over resets too; 0 before the first scan.
    pub version: u64,
    /// Of the last scan in it, ns.
    pub stamp_ns: i64,
    /// Metres a cell.
    pub resolution: f64,
    /// The cells that are known, and those between them.
    pub extent: Extent,
    /// Exclusive or of the hashes of all tiles.
    pub hash: u64,
    /// How many tiles have a known cell.
    pub tiles: u32,
    /// Cells along the side of a tile.
    pub side: u16,
}

/// A tile in a message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Entry {
    /// Which.
    pub index: TileIndex,
    /// The version of the map with which it became what it is.
    pub version: u64,
    /// [`tile_hash`] of its cells; 0 for a tile without a known cell.
    pub hash: u64,
    /// Its cells, compressed; empty for a tile without a known cell, and where only hashes are
    /// told.
    pub data: Bytes,
}

/// What is sent at once: some tiles of a map.
#[derive(Debug, Clone, PartialEq)]
pub struct Message {
    /// The map.
    pub head: Head,
    /// Which of several messages that belong together, from 0.
    pub part: u16,
    /// How many these are.
    pub parts: u16,
    /// Some of its tiles.
    pub entries: Vec<Entry>,
}

/// Why bytes are no message of tiles.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum TileError {
    /// They end too soon.
    #[error("the message ends after {0} bytes, within something")]
    Short(usize),
    /// They are something else, or of another version.
    #[error("the message begins with {0:02x?}, and not with GMT1")]
    Magic([u8; 4]),
    /// There is more than the message says.
    #[error("{0} bytes are left at the end of the message")]
    Long(usize),
    /// Tiles of a size that is not taken.
    #[error("tiles of {0} by {0} cells are not from 1 to {LARGEST_SIDE} wide")]
    Side(u16),
    /// No map is that large.
    #[error("a map of {} by {} cells has more than {LARGEST_MAP}", .0.width, .0.height)]
    Extent(Extent),
    /// The resolution is no length.
    #[error("cells of {0} m")]
    Resolution(String),
    /// The cells cannot be had, or are not those of the hash.
    #[error("the cells of tile ({}, {}) cannot be read", .0.tx, .0.ty)]
    Cells(TileIndex),
}

/// The first eight bytes, read as a little-endian number, of SHA-256 over column and row of the
/// tile (32-bit integers, little endian) and one byte a cell; never 0, which is no tile.
#[must_use]
pub fn tile_hash(index: TileIndex, cells: &[i8]) -> u64 {
    let mut hash = Sha256::new();
    hash.update(index.tx.to_le_bytes());
    hash.update(index.ty.to_le_bytes());
    hash.update(octets(cells));
    LittleEndian::read_u64(&hash.finalize()).max(1)
}

/// The cells of a tile, row by row from the lowest y, as an entry carries them: deflated, without
/// the header of zlib.
#[must_use]
pub fn compress(cells: &[i8]) -> Bytes {
    let mut encoder = DeflateEncoder::new(Vec::new(), Compression::default());
    let written = encoder.write_all(&octets(cells)).and_then(|()| encoder.finish());
    written.expect("memory takes every write").into()
}

fn octets(cells: &[i8]) -> Vec<u8> {
    cells.iter().map(|&cell| cell as u8).collect()
}

impl Entry {
    /// Its cells, row by row from the lowest y.
    ///
    /// # Errors
    /// When they cannot be read, or do not give the hash.
    pub fn cells(&self, side: u16) -> Result<Vec<i8>, TileError> {
        let broken = TileError::Cells(self.index);
        let count = usize::from(side) * usize::from(side);
        let mut octets = Vec::with_capacity(count);
        // One more than there may be, so that more than that is noticed.
        let mut decoder = DeflateDecoder::new(self.data.as_ref()).take(count as u64 + 1);
        if decoder.read_to_end(&mut octets).is_err() || octets.len() != count {
            return Err(broken);
        }
        let cells: Vec<i8> = octets.into_iter().map(|octet| octet as i8).collect();
        if tile_hash(self.index, &cells) == self.hash { Ok(cells) } else { Err(broken) }
    }

    const fn size(&self) -> usize {
        ENTRY + self.data.len()
    }
}

impl Message {
    /// As it is sent.
    #[must_use]
    pub fn encode(&self) -> Bytes {
        let size = HEAD + self.entries.iter().map(Entry::size).sum::<usize>();
        let mut bytes = Vec::with_capacity(size);
        let Head { extent, .. } = self.head;
        bytes.extend_from_slice(MAGIC);
        bytes.extend_from_slice(&self.part.to_le_bytes());
        bytes.extend_from_slice(&self.parts.to_le_bytes());
        for number in [self.head.run, self.head.epoch, self.head.version] {
            bytes.extend_from_slice(&number.to_le_bytes());
        }
        bytes.extend_from_slice(&self.head.stamp_ns.to_le_bytes());
        bytes.extend_from_slice(&self.head.resolution.to_le_bytes());
        bytes.extend_from_slice(&extent.ix.to_le_bytes());
        bytes.extend_from_slice(&extent.iy.to_le_bytes());
        bytes.extend_from_slice(&extent.width.to_le_bytes());
        bytes.extend_from_slice(&extent.height.to_le_bytes());
        bytes.extend_from_slice(&self.head.hash.to_le_bytes());
        bytes.extend_from_slice(&self.head.tiles.to_le_bytes());
        bytes.extend_from_slice(&self.head.side.to_le_bytes());
        bytes.extend_from_slice(&(self.entries.len() as u16).to_le_bytes());
        for entry in &self.entries {
            bytes.extend_from_slice(&entry.index.tx.to_le_bytes());
            bytes.extend_from_slice(&entry.index.ty.to_le_bytes());
            bytes.extend_from_slice(&entry.version.to_le_bytes());
            bytes.extend_from_slice(&entry.hash.to_le_bytes());
            bytes.extend_from_slice(&(entry.data.len() as u16).to_le_bytes());
            bytes.extend_from_slice(&entry.data);
        }
        bytes.into()
    }

    /// From what was sent.
    ///
    /// # Errors
    /// When it is no such message.
    pub fn decode(bytes: &[u8]) -> Result<Self, TileError> {
        let mut reader = Reader { bytes, at: 0 };
        let magic: [u8; 4] = reader.take()?;
        if &magic != MAGIC {
            return Err(TileError::Magic(magic));
        }
        let (part, parts) = (reader.u16()?, reader.u16()?);
        let (head, count) = (reader.head()?, reader.u16()?);
        let entries = (0..count).map(|_| reader.entry()).collect::<Result<_, _>>()?;
        match bytes.len() - reader.at {
            0 => Ok(Self { head, part, parts, entries }),
            left => Err(TileError::Long(left)),
        }
    }

    /// Tiles in as many messages as they need; one that has only a head where there are none.
    #[must_use]
    pub fn pack(head: Head, entries: impl IntoIterator<Item = Entry>) -> Vec<Bytes> {
        let mut messages = vec![Vec::new()];
        let mut size = HEAD;
        for entry in entries {
            if size + entry.size() > LARGEST_MESSAGE {
                messages.push(Vec::new());
                size = HEAD;
            }
            size += entry.size();
            messages.last_mut().expect("there is one").push(entry);
        }
        let parts = messages.len() as u16;
        let packed = (0..).zip(messages);
        packed.map(|(part, entries)| Self { head, part, parts, entries }.encode()).collect()
    }
}

struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl Reader<'_> {
    fn slice(&mut self, length: usize) -> Result<&[u8], TileError> {
        let from = self.at;
        let taken = self.bytes.get(from..from + length);
        self.at += length;
        taken.ok_or(TileError::Short(self.bytes.len()))
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N], TileError> {
        let mut taken = [0; N];
        taken.copy_from_slice(self.slice(N)?);
        Ok(taken)
    }

    fn u16(&mut self) -> Result<u16, TileError> {
        self.take().map(u16::from_le_bytes)
    }

    fn u32(&mut self) -> Result<u32, TileError> {
        self.take().map(u32::from_le_bytes)
    }

    fn i32(&mut self) -> Result<i32, TileError> {
        self.take().map(i32::from_le_bytes)
    }

    fn u64(&mut self) -> Result<u64, TileError> {
        self.take().map(u64::from_le_bytes)
    }

    fn head(&mut self) -> Result<Head, TileError> {
        let head = Head {
            run: self.u64()?,
            epoch: self.u64()?,
            version: self.u64()?,
            stamp_ns: self.take().map(i64::from_le_bytes)?,
            resolution: self.take().map(f64::from_le_bytes)?,
            extent: Extent {
                ix: self.i32()?,
                iy: self.i32()?,
                width: self.u32()?,
                height: self.u32()?,
            },
            hash: self.u64()?,
            tiles: self.u32()?,
            side: self.u16()?,
        };
        if !(1..=LARGEST_SIDE).contains(&head.side) {
            return Err(TileError::Side(head.side));
        }
        let cells = u64::from(head.extent.width) * u64::from(head.extent.height);
        if cells > LARGEST_MAP {
            return Err(TileError::Extent(head.extent));
        }
        if !head.resolution.is_finite() || head.resolution <= 0.0 {
            return Err(TileError::Resolution(head.resolution.to_string()));
        }
        Ok(head)
    }

    fn entry(&mut self) -> Result<Entry, TileError> {
        let (tx, ty) = (self.i32()?, self.i32()?);
        let (version, hash) = (self.u64()?, self.u64()?);
        let length = usize::from(self.u16()?);
        let data = Bytes::copy_from_slice(self.slice(length)?);
        Ok(Entry { index: TileIndex { ty, tx }, version, hash, data })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::{any, prop_assert, prop_assert_eq, proptest};
    use rand::{Rng as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    const SIDE: u16 = 16;

    fn head() -> Head {
        Head {
            run: 0x0102_0304_0506_0708,
            epoch: 2,
            version: 9,
            stamp_ns: -5,
            resolution: 0.05,
            extent: Extent { ix: -3, iy: 4, width: 50, height: 60 },
            hash: 77,
            tiles: 3,
            side: SIDE,
        }
    }

    fn entry(tx: i32, cells: &[i8]) -> Entry {
        let index = TileIndex { ty: -2, tx };
        Entry { index, version: 8, hash: tile_hash(index, cells), data: compress(cells) }
    }

    fn cells(seed: u8) -> Vec<i8> {
        let known = [-1, 0, 100];
        let cell = |i: usize| known[(i * i + usize::from(seed)) % 7 % 3];
        (0..usize::from(SIDE) * usize::from(SIDE)).map(cell).collect()
    }

    proptest! {
        #[test]
        fn messages_read_back(seeds in proptest::collection::vec(any::<u8>(), 0..20)) {
            let entries: Vec<Entry> =
                (0..).zip(&seeds).map(|(tx, seed)| entry(tx, &cells(*seed))).collect();
            let packed = Message::pack(head(), entries.clone());
            prop_assert_eq!(packed.len(), 1);
            let message = Message::decode(&packed[0]).unwrap();
            prop_assert_eq!((message.head, message.part, message.parts), (head(), 0, 1));
            for (entry, seed) in message.entries.iter().zip(&seeds) {
                prop_assert_eq!(entry.cells(SIDE).unwrap(), cells(*seed));
            }
            prop_assert_eq!(message.entries, entries);
        }

        #[test]
        fn damaged_messages_are_errors_or_other_messages(
            at in any::<proptest::sample::Index>(), bit in 0..8_u8, cut in any::<bool>(),
        ) {
            let good = Message::pack(head(), [entry(0, &cells(1)), entry(1, &cells(2))]).remove(0);
            let mut bytes = good.to_vec();
            let at = at.index(bytes.len());
            if cut {
                bytes.truncate(at);
                prop_assert!(Message::decode(&bytes).is_err());
            } else {
                bytes[at] ^= 1 << bit;
                let Ok(message) = Message::decode(&bytes) else { return Ok(()) };
                // A tile that can be read is the one that was sent, or is told to be of another
                // version.
                for (index, entry) in message.entries.iter().enumerate() {
                    if let Ok(read) = entry.cells(SIDE) {
                        prop_assert_eq!(read, cells(index as u8 + 1));
                    }
                }
            }
        }
    }

    #[test]
    fn what_does_not_fit_goes_into_another_message() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let noise: Vec<i8> = (0..TILE_CELLS).map(|_| rng.random()).collect();
        let data = compress(&noise);
        assert!(data.len() + HEAD + ENTRY < LARGEST_MESSAGE, "a tile fits whatever it holds");
        let entries = (0..40).map(|tx| {
            let index = TileIndex { ty: 0, tx };
            Entry { index, version: 1, hash: tile_hash(index, &noise), data: data.clone() }
        });
        let packed = Message::pack(Head { side: TILE_SIDE as u16, ..head() }, entries);
        let messages: Vec<Message> =
            packed.iter().map(|bytes| Message::decode(bytes).unwrap()).collect();
        assert!(packed.len() > 2 && packed.iter().all(|bytes| bytes.len() <= LARGEST_MESSAGE));
        assert!(messages.iter().all(|message| usize::from(message.parts) == packed.len()));
        let columns = messages.iter().flat_map(|message| &message.entries).map(|e| e.index.tx);
        assert_eq!(columns.collect::<Vec<_>>(), (0..40).collect::<Vec<_>>());
    }

    #[test]
    fn a_head_alone_is_a_message_of_eighty_bytes() {
        let packed = Message::pack(head(), []);
        assert_eq!((packed.len(), packed[0].len()), (1, HEAD));
        let message = Message::decode(&packed[0]).unwrap();
        assert_eq!((message.head, message.entries.len()), (head(), 0));
    }

    #[test]
    fn errors_say_what_is_wrong() {
        let good = Message::pack(head(), []).remove(0);
        let changed = |at: usize, bytes: &[u8]| {
            let mut message = good.to_vec();
            message[at..at + bytes.len()].copy_from_slice(bytes);
            Message::decode(&message).unwrap_err().to_string()
        };
        assert_eq!(
            changed(0, b"GMT2"),
            "the message begins with [47, 4d, 54, 32], and not with GMT1"
        );
        assert_eq!(changed(76, &[0, 0]), "tiles of 0 by 0 cells are not from 1 to 256 wide");
        assert_eq!(
            changed(56, &[255; 8]),
            "a map of 4294967295 by 4294967295 cells has more than 1073741824"
        );
        assert_eq!(changed(40, &f64::NAN.to_le_bytes()), "cells of NaN m");
        let mut long = good.to_vec();
        long.push(0);
        assert_eq!(Message::decode(&long), Err(TileError::Long(1)));
        let mut bomb = entry(0, &cells(1));
        bomb.data = compress(&vec![0; 1 << 20]);
        assert_eq!(bomb.cells(SIDE), Err(TileError::Cells(bomb.index)));
    }

    /// Made with Python: `int.from_bytes(hashlib.sha256(struct.pack("<ii", -1, 2) +
    /// bytes([255, 0, 100, 0])).digest()[:8], "little")`.
    #[test]
    fn the_hash_is_that_of_the_documented_bytes() {
        let index = TileIndex { ty: 2, tx: -1 };
        assert_eq!(tile_hash(index, &[-1, 0, 100, 0]), HASH);
    }

    const HASH: u64 = 3972285109614391221;

    #[test]
    fn extents_join_and_empty_ones_do_not_count() {
        let a = Extent { ix: -5, iy: 2, width: 3, height: 4 };
        let b = Extent { ix: 7, iy: -1, width: 1, height: 1 };
        assert_eq!(a.union(b), Extent { ix: -5, iy: -1, width: 13, height: 7 });
        assert_eq!(Extent::default().union(a), a);
        assert_eq!(a.union(Extent { ix: 99, iy: 99, width: 0, height: 0 }), a);
    }
}
