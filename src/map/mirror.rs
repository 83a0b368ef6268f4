//! Someone else's map, followed tile by tile: always one version as a whole, whatever is lost on
//! the way.

use std::collections::BTreeMap;
use std::sync::Arc;

use bytes::Bytes;

use super::tiles::{Entry, Head, Message, TileError, TileIndex};
use crate::slam::grid::occupancy::OccupancyGrid;
use crate::slam::pose::{Point2, Stamp};

/// One version of a map, whole.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct MirroredMap {
    head: Head,
    tiles: BTreeMap<TileIndex, Tile>,
}

/// A tile whose cells have been read once and gave its hash.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Tile {
    hash: u64,
    /// Compressed: a mirror that nobody looks at takes little memory.
    data: Bytes,
}

impl MirroredMap {
    /// Which daemon's life the version is of.
    #[must_use]
    pub const fn run(&self) -> u64 {
        self.head.run
    }

    /// Grows within a run when the map was corrected or begun anew.
    #[must_use]
    pub const fn epoch(&self) -> u64 {
        self.head.epoch
    }

    /// Grows within a run with every change; 0 for the map before the first one.
    #[must_use]
    pub const fn version(&self) -> u64 {
        self.head.version
    }

    /// Of the last scan in it.
    #[must_use]
    pub const fn stamp(&self) -> Stamp {
        Stamp(self.head.stamp_ns)
    }

    /// How many tiles have a known cell.
    #[must_use]
    pub fn tiles(&self) -> usize {
        self.tiles.len()
    }

    /// Size, place and version.
    #[must_use]
    pub const fn head(&self) -> Head {
        self.head
    }

    /// The tiles with a known cell, as they are sent on, with the version of the whole.
    pub fn entries(&self) -> impl Iterator<Item = Entry> + '_ {
        self.tiles.iter().map(|(index, tile)| Entry {
            index: *index,
            version: self.head.version,
            hash: tile.hash,
            data: tile.data.clone(),
        })
    }

    /// The map cell by cell, as the daemon has it; without cells before the first scan.
    #[must_use]
    pub fn grid(&self) -> OccupancyGrid {
        let Head { extent, resolution, side, .. } = self.head;
        let (width, height) = (extent.width as usize, extent.height as usize);
        let mut cells = vec![-1; width * height];
        for (index, tile) in &self.tiles {
            let entry =
                Entry { index: *index, version: 0, hash: tile.hash, data: tile.data.clone() };
            let read = entry.cells(side).expect("they were read when they came");
            let first =
                |tile: i32, start: i32| i64::from(tile) * i64::from(side) - i64::from(start);
            let (left, bottom) = (first(index.tx, extent.ix), first(index.ty, extent.iy));
            for (y, row) in (bottom..).zip(read.chunks_exact(side.into())) {
                let (from, to) = (left.max(0), (left + i64::from(side)).min(width as i64));
                if from < to && (0..height as i64).contains(&y) {
                    let start = y as usize * width;
                    cells[start + from as usize..start + to as usize]
                        .copy_from_slice(&row[(from - left) as usize..(to - left) as usize]);
                }
            }
        }
        let corner = |i: i32| f64::from(i) * resolution;
        let origin = Point2::new(corner(extent.ix), corner(extent.iy));
        OccupancyGrid { resolution, width, height, origin, cells }
    }
}

/// What a message did.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Progress {
    /// The mirror has the newest version that it knows of.
    Newest,
    /// More messages of this version are on their way.
    Underway,
    /// Something was lost: it must be asked for.
    Missing,
}

/// Puts tiles together.
///
/// What is held is always one version as a whole: new tiles wait until, together with those that
/// stay, they give the hash of a version.
#[derive(Debug)]
pub struct Mirror {
    held: Arc<MirroredMap>,
    newest: Option<Head>,
    /// Tiles that are newer than those held, of the run of `newest`.
    waiting: BTreeMap<TileIndex, Entry>,
}

impl Default for Mirror {
    fn default() -> Self {
        Self::new()
    }
}

impl Mirror {
    /// Without a map.
    #[must_use]
    pub fn new() -> Self {
        Self { held: Arc::default(), newest: None, waiting: BTreeMap::new() }
    }

    /// The last version that was whole.
    #[must_use]
    pub const fn map(&self) -> &Arc<MirroredMap> {
        &self.held
    }

    /// The newest version that was heard of; `None` before anything was.
    #[must_use]
    pub fn newest_version(&self) -> Option<u64> {
        self.newest.map(|head| head.version)
    }

    /// Whether the map is of the newest version that was heard of.
    #[must_use]
    pub fn is_newest(&self) -> bool {
        self.newest.is_some_and(|newest| self.is_of(&newest))
    }

    fn is_of(&self, head: &Head) -> bool {
        (self.held.head.run, self.held.head.version) == (head.run, head.version)
    }

    /// What to ask the daemon's `slam/tiles` for, to get what is missing.
    #[must_use]
    pub fn question(&self) -> String {
        match (self.held.version(), self.held.run()) {
            (0, _) => "since=0".to_owned(),
            (version, run) => format!("since={version};run={run:016x}"),
        }
    }

    /// Takes a message that was published.
    ///
    /// # Errors
    /// When it cannot be read; nothing has changed then.
    pub fn take(&mut self, bytes: &[u8]) -> Result<Progress, TileError> {
        let message = Message::decode(bytes)?;
        let head = message.head;
        let entries = self.checked(message.entries, head)?;
        self.hear(head);
        self.wait_for(entries);
        let newest = self.newest.unwrap_or(head);
        let merged = self.merged(&newest, &self.waiting);
        if let Some(map) = merged {
            self.hold(map);
        }
        Ok(if self.is_newest() {
            Progress::Newest
        } else if u32::from(message.part) + 1 < u32::from(message.parts)
            && head.version == newest.version
        {
            Progress::Underway
        } else {
            Progress::Missing
        })
    }

    /// Takes all messages that came in reply to [`Self::question`]; returns whether they gave a
    /// version as a whole, which need not be the newest any more.
    ///
    /// # Errors
    /// When one cannot be read; nothing has changed then.
    pub fn take_reply<B: AsRef<[u8]>>(&mut self, messages: &[B]) -> Result<bool, TileError> {
        let mut head = None;
        let mut tiles = BTreeMap::new();
        for bytes in messages {
            let message = Message::decode(bytes.as_ref())?;
            head = Some(message.head);
            let entries = self.checked(message.entries, message.head)?;
            tiles.extend(entries.into_iter().map(|entry| (entry.index, entry)));
        }
        let Some(head) = head else { return Ok(false) };
        self.hear(head);
        let is_older = self.held.run() == head.run && head.version < self.held.version();
        let merged = if is_older { None } else { self.merged(&head, &tiles) };
        let is_whole = merged.is_some() || self.is_of(&head);
        if let Some(map) = merged {
            self.hold(map);
        } else {
            self.wait_for(tiles.into_values().collect());
        }
        let newest = self.newest.unwrap_or(head);
        if let Some(map) = self.merged(&newest, &self.waiting) {
            self.hold(map);
        }
        Ok(is_whole || self.is_newest())
    }

    /// Entries that say something, each read once.
    fn checked(&self, entries: Vec<Entry>, head: Head) -> Result<Vec<Entry>, TileError> {
        let tells = |entry: &Entry| entry.hash == 0 || !entry.data.is_empty();
        let mut told: Vec<Entry> = entries.into_iter().filter(tells).collect();
        for entry in &mut told {
            match self.held.tiles.get(&entry.index) {
                Some(held) if held.hash == entry.hash && self.held.head.side == head.side => {
                    entry.data = held.data.clone();
                }
                _ if entry.hash == 0 => {}
                _ => drop(entry.cells(head.side)?),
            }
        }
        Ok(told)
    }

    fn hear(&mut self, head: Head) {
        match &self.newest {
            Some(newest) if newest.run == head.run && newest.version >= head.version => {}
            Some(newest) if newest.run == head.run => self.newest = Some(head),
            _ => {
                // Nothing of another run goes with it.
                self.waiting.clear();
                self.newest = Some(head);
            }
        }
    }

    fn wait_for(&mut self, entries: Vec<Entry>) {
        let Some(newest) = self.newest else { return };
        let known = if self.held.run() == newest.run { self.held.version() } else { 0 };
        for entry in entries {
            let waiting = self.waiting.get(&entry.index).map_or(0, |waiting| waiting.version);
            if entry.version > known && entry.version >= waiting {
                self.waiting.insert(entry.index, entry);
            }
        }
    }

    /// The map of `head`, if these tiles over those that are held give its hash.
    fn merged(&self, head: &Head, tiles: &BTreeMap<TileIndex, Entry>) -> Option<MirroredMap> {
        if self.is_of(head) {
            return None;
        }
        let nothing = BTreeMap::new();
        let continues = self.held.run() == head.run && self.held.head.side == head.side;
        let (base, base_head) = if continues {
            (&self.held.tiles, self.held.head)
        } else {
            (&nothing, Head::default())
        };
        let (mut hash, mut count) = (base_head.hash, i64::from(base_head.tiles));
        for (index, entry) in tiles {
            let before = base.get(index).map_or(0, |tile| tile.hash);
            hash ^= before ^ entry.hash;
            count += i64::from(entry.hash != 0) - i64::from(before != 0);
        }
        if (hash, count) != (head.hash, i64::from(head.tiles)) {
            return None;
        }
        let mut merged = base.clone();
        for (index, Entry { hash, data, .. }) in tiles {
            if *hash == 0 {
                merged.remove(index);
            } else {
                merged.insert(*index, Tile { hash: *hash, data: data.clone() });
            }
        }
        Some(MirroredMap { head: *head, tiles: merged })
    }

    fn hold(&mut self, map: MirroredMap) {
        self.waiting.retain(|_, entry| entry.version > map.version());
        self.held = Arc::new(map);
    }
}

#[cfg(test)]
mod tests;
