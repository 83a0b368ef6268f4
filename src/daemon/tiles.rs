//! The map as versioned tiles: which of them a version changes, and what is sent of them.

pub mod publishing;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, PoisonError};

use bytes::Bytes;
use sha2::{Digest as _, Sha256};
use tokio::sync::watch;

use super::snapshot::{MapVersion, Snapshot};
use crate::map::tiles::{
    Entry, Extent, Head, Message, TILE_CELLS, TILE_SIDE, TileIndex, compress, tile_hash,
};
use crate::slam::grid::tile_map::{TILE_SIZE, TileKey};

/// Tiles of the counts along the side of a tile that is sent.
const PER_SIDE: i32 = (TILE_SIDE / TILE_SIZE) as i32;

/// A run of the daemon: no other has the same number, wherever and whenever it is.
#[must_use]
pub fn run_number(session: &str, started_ns: i64) -> u64 {
    let digest = Sha256::new().chain_update(session).chain_update(started_ns.to_le_bytes());
    let mut first = [0; 8];
    first.copy_from_slice(&digest.finalize()[..8]);
    u64::from_le_bytes(first)
}

/// Which tiles are asked for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum TilesQuestion {
    /// Those that changed after a version; after version 0 all.
    Since {
        /// The version that the asker has.
        version: u64,
        /// The run that it is of; this one if it is not told.
        run: Option<u64>,
    },
    /// These, and the hashes of all.
    Want(Vec<TileIndex>),
}

/// The newest version of the map as tiles.
#[derive(Debug)]
pub struct TileSet {
    head: Head,
    /// Those that lost all their known cells are kept without data, so that it can be told.
    tiles: BTreeMap<TileIndex, Held>,
    /// The version that the tiles are of: what it does not share with the next one has changed.
    map: Option<Arc<MapVersion>>,
}

/// A tile, ready to be sent.
#[derive(Debug)]
struct Held {
    version: u64,
    hash: u64,
    data: Bytes,
    /// Where its known cells are.
    extent: Extent,
}

impl TileSet {
    /// Before the first map.
    #[must_use]
    pub fn new(run: u64, resolution: f64) -> Self {
        let head = Head { run, resolution, side: TILE_SIDE as u16, ..Head::default() };
        Self { head, tiles: BTreeMap::new(), map: None }
    }

    /// What the map is.
    #[must_use]
    pub const fn head(&self) -> &Head {
        &self.head
    }

    /// Takes the newest version, or that there is none any more.
    ///
    /// It looks at those tiles only that were written since the last one.
    pub fn update(&mut self, map: Option<&Arc<MapVersion>>) {
        let Some(map) = map else { return self.forget() };
        if map.version <= self.head.version {
            return;
        }
        for index in self.touched(map) {
            self.renew(index, map);
        }
        self.head = Head {
            epoch: map.epoch,
            version: map.version,
            stamp_ns: map.stamp.0,
            resolution: map.occupancy.resolution(),
            ..self.head
        };
        self.measure();
        self.map = Some(map.clone());
    }

    /// The daemon numbers the reset, which nobody sees otherwise, as a version of its own.
    fn forget(&mut self) {
        if self.map.take().is_none() {
            return;
        }
        self.head.version += 1;
        self.head.epoch += 1;
        let version = self.head.version;
        for held in self.tiles.values_mut().filter(|held| held.hash != 0) {
            *held = Held::unknown(version);
        }
        self.head.hash = 0;
        self.measure();
    }

    fn touched(&self, map: &MapVersion) -> BTreeSet<TileIndex> {
        let counts = map.occupancy.counts();
        let same_rule =
            |before: &&Arc<MapVersion>| before.occupied_threshold == map.occupied_threshold;
        match self.map.as_ref().filter(same_rule) {
            Some(before) => {
                let written = counts.tiles_not_shared_with(before.occupancy.counts());
                written.into_iter().map(index_of).collect()
            }
            None => {
                let all = counts.tiles().map(|(key, _)| index_of(key));
                all.chain(self.tiles.keys().copied()).collect()
            }
        }
    }

    fn renew(&mut self, index: TileIndex, map: &MapVersion) {
        let (cells, extent) = draw(index, map);
        let known = extent.width > 0;
        let hash = if known { tile_hash(index, &cells) } else { 0 };
        let before = self.tiles.get(&index).map_or(0, |held| held.hash);
        if before == hash {
            return;
        }
        self.head.hash ^= before ^ hash;
        let held = if known {
            Held { version: map.version, hash, data: compress(&cells), extent }
        } else {
            Held::unknown(map.version)
        };
        self.tiles.insert(index, held);
    }

    fn measure(&mut self) {
        let known = self.tiles.values().filter(|held| held.hash != 0);
        self.head.tiles = known.clone().count() as u32;
        self.head.extent = known.fold(Extent::default(), |extent, held| extent.union(held.extent));
    }

    /// The tiles that changed after this version, those that are gone included.
    #[must_use]
    pub fn since(&self, version: u64) -> Vec<Bytes> {
        // Who has nothing need not forget anything.
        let changed = |held: &Held| held.version > version && (held.hash != 0 || version > 0);
        let changed = self.tiles.iter().filter(|(_, held)| changed(held));
        Message::pack(self.head, changed.map(|(index, held)| held.entry(*index)))
    }

    /// The answer to a question.
    #[must_use]
    pub fn answer(&self, question: &TilesQuestion) -> Vec<Bytes> {
        match question {
            TilesQuestion::Since { version, run } => {
                self.since(if run.is_none_or(|run| run == self.head.run) { *version } else { 0 })
            }
            TilesQuestion::Want(wanted) => self.wanted(wanted),
        }
    }

    fn wanted(&self, wanted: &[TileIndex]) -> Vec<Bytes> {
        let known = self.tiles.iter().filter(|(_, held)| held.hash != 0);
        let entries = known.map(|(index, held)| {
            let entry = held.entry(*index);
            if wanted.contains(index) { entry } else { Entry { data: Bytes::new(), ..entry } }
        });
        Message::pack(self.head, entries)
    }
}

/// What tells which map is the newest.
#[must_use]
pub fn digest(head: Head) -> Vec<Bytes> {
    Message::pack(head, [])
}

impl Held {
    fn unknown(version: u64) -> Self {
        Self { version, hash: 0, data: Bytes::new(), extent: Extent::default() }
    }

    fn entry(&self, index: TileIndex) -> Entry {
        Entry { index, version: self.version, hash: self.hash, data: self.data.clone() }
    }
}

/// The tile that is sent which holds this tile of the counts.
const fn index_of(key: TileKey) -> TileIndex {
    TileIndex { ty: key.ty.div_euclid(PER_SIDE), tx: key.tx.div_euclid(PER_SIDE) }
}

/// The cells of a tile, and where those are that are known.
fn draw(index: TileIndex, map: &MapVersion) -> (Vec<i8>, Extent) {
    let mut cells = vec![-1; TILE_CELLS];
    let mut known = Extent::default();
    let first = TileKey { ty: index.ty * PER_SIDE, tx: index.tx * PER_SIDE };
    let last = TileKey { ty: first.ty + PER_SIDE - 1, tx: first.tx + PER_SIDE - 1 };
    for (key, counts) in map.occupancy.counts().tiles_between(first, last) {
        let column = (key.tx - first.tx) as usize * TILE_SIZE;
        let row = (key.ty - first.ty) as usize * TILE_SIZE;
        for (i, counts) in counts.chunks_exact(TILE_SIZE).enumerate() {
            let start = (row + i) * TILE_SIDE + column;
            let cells = &mut cells[start..start + TILE_SIZE];
            for (cell, count) in cells.iter_mut().zip(counts) {
                *cell = count.occupancy(map.occupied_threshold);
            }
            known = known.union(known_part(cells, key, i));
        }
    }
    (cells, known)
}

/// From the first to the last known cell of a row of a tile of the counts.
fn known_part(cells: &[i8], key: TileKey, row: usize) -> Extent {
    let is_known = |cell: &i8| *cell >= 0;
    let Some(first) = cells.iter().position(is_known) else { return Extent::default() };
    let last = cells.iter().rposition(is_known).unwrap_or(first);
    let corner = key.first_cell();
    Extent {
        ix: corner.ix + first as i32,
        iy: corner.iy + row as i32,
        width: (last - first) as u32 + 1,
        height: 1,
    }
}

/// The tiles of the newest snapshot, for all who publish and answer.
#[derive(Debug)]
pub(super) struct TileStore {
    snapshots: watch::Receiver<Arc<Snapshot>>,
    first: Head,
    tiles: Mutex<TileSet>,
}

impl TileStore {
    pub(super) const fn new(tiles: TileSet, snapshots: watch::Receiver<Arc<Snapshot>>) -> Self {
        Self { snapshots, first: *tiles.head(), tiles: Mutex::new(tiles) }
    }

    /// What the tiles began with.
    const fn first(&self) -> Head {
        self.first
    }

    /// Brings the tiles up to date, and takes something from them. It may take milliseconds.
    pub(super) fn newest<T>(&self, take: impl FnOnce(&TileSet) -> T) -> T {
        let mut tiles = self.tiles.lock().unwrap_or_else(PoisonError::into_inner);
        // Looked up only now, so that nobody brings an older one after a newer one.
        let snapshot = self.snapshots.borrow().clone();
        tiles.update(snapshot.map.as_ref());
        take(&tiles)
    }
}

#[cfg(test)]
mod tests;
