use std::collections::BTreeMap;

use proptest::prelude::{any, prop_assert, prop_assert_eq, proptest};

use super::super::tiles::{Extent, compress, tile_hash};
use super::*;

const SIDE: u16 = 4;

/// A map of tiles of one value each, as a daemon has it.
#[derive(Debug, Clone)]
struct World {
    head: Head,
    /// Value and version; no value for tiles that are gone.
    tiles: BTreeMap<TileIndex, (Option<i8>, u64)>,
}

impl World {
    fn new(run: u64) -> Self {
        let head = Head { run, resolution: 0.5, side: SIDE, ..Head::default() };
        Self { head, tiles: BTreeMap::new() }
    }

    /// A new version in which these tiles have these values.
    fn change(&mut self, changes: &[(i32, Option<i8>)]) {
        self.head.version += 1;
        for &(tx, value) in changes {
            self.tiles.insert(TileIndex { ty: 0, tx }, (value, self.head.version));
        }
        let known: Vec<Entry> = self.since(0).into_iter().filter(|entry| entry.hash != 0).collect();
        self.head.hash = known.iter().fold(0, |hash, entry| hash ^ entry.hash);
        self.head.tiles = known.len() as u32;
        let extents = known.iter().map(|entry| Extent {
            ix: entry.index.tx * i32::from(SIDE),
            iy: 0,
            width: SIDE.into(),
            height: SIDE.into(),
        });
        self.head.extent = extents.fold(Extent::default(), Extent::union);
    }

    fn since(&self, version: u64) -> Vec<Entry> {
        let changed = self.tiles.iter().filter(|(_, (_, of))| *of > version);
        changed
            .map(|(index, (value, of))| {
                let cells = [value.unwrap_or(-1); 16];
                let hash = value.map_or(0, |_| tile_hash(*index, &cells));
                let data = value.map_or_else(Bytes::new, |_| compress(&cells));
                Entry { index: *index, version: *of, hash, data }
            })
            .collect()
    }

    /// One message a tile.
    fn messages_since(&self, version: u64) -> Vec<Bytes> {
        let entries: Vec<Entry> = self.since(version);
        let parts = entries.len().max(1) as u16;
        let mut chunks: Vec<Vec<Entry>> = entries.into_iter().map(|entry| vec![entry]).collect();
        if chunks.is_empty() {
            chunks.push(Vec::new());
        }
        let numbered = (0..).zip(chunks);
        numbered
            .map(|(part, entries)| Message { head: self.head, part, parts, entries }.encode())
            .collect()
    }

    /// The value of each column of tiles of a mirrored map.
    fn of(map: &MirroredMap) -> BTreeMap<i32, i8> {
        let (grid, head) = (map.grid(), map.head);
        let column = |x: usize| (head.extent.ix + x as i32).div_euclid(SIDE.into());
        let cells = (0..grid.width).map(|x| (column(x), grid.cells[x]));
        cells.filter(|(_, cell)| *cell >= 0).collect()
    }

    fn values(&self) -> BTreeMap<i32, i8> {
        let known = self.tiles.iter().filter_map(|(index, (value, _))| Some((index.tx, (*value)?)));
        known.collect()
    }
}

fn version_of(mirror: &Mirror) -> u64 {
    mirror.map().version()
}

#[test]
fn a_version_is_held_when_its_last_tile_has_come() {
    let mut world = World::new(1);
    world.change(&[(0, Some(0)), (1, Some(100)), (-3, Some(0))]);
    let mut mirror = Mirror::new();
    let messages = world.messages_since(0);
    assert_eq!(mirror.take(&messages[0]), Ok(Progress::Underway));
    assert_eq!(mirror.take(&messages[1]), Ok(Progress::Underway));
    assert_eq!((version_of(&mirror), mirror.is_newest()), (0, false));
    assert_eq!(mirror.take(&messages[2]), Ok(Progress::Newest));
    assert_eq!(World::of(mirror.map()), world.values());
    assert_eq!(mirror.map().grid().origin, Point2::new(-6.0, 0.0));
    assert_eq!(mirror.take(&messages[2]), Ok(Progress::Newest), "once more does no harm");
}

#[test]
fn what_is_lost_is_noticed_and_repaired_by_the_answer() {
    let mut world = World::new(0xab);
    world.change(&[(0, Some(0)), (1, Some(100))]);
    let mut mirror = Mirror::new();
    assert_eq!(mirror.question(), "since=0");
    assert_eq!(mirror.take_reply(&world.messages_since(0)), Ok(true));
    world.change(&[(0, Some(100)), (2, Some(0)), (3, Some(0))]);
    let messages = world.messages_since(1);
    assert_eq!(mirror.take(&messages[0]), Ok(Progress::Underway));
    assert_eq!(mirror.take(&messages[2]), Ok(Progress::Missing));
    assert_eq!((version_of(&mirror), mirror.newest_version()), (1, Some(2)));
    assert_eq!(mirror.question(), "since=1;run=00000000000000ab");
    assert_eq!(mirror.take_reply(&messages), Ok(true));
    assert_eq!(World::of(mirror.map()), world.values());
}

#[test]
fn a_digest_tells_that_something_was_missed() {
    let mut world = World::new(1);
    world.change(&[(0, Some(0))]);
    let mut mirror = Mirror::new();
    mirror.take_reply(&world.messages_since(0)).unwrap();
    let digest = |world: &World| Message::pack(world.head, []).remove(0);
    assert_eq!(mirror.take(&digest(&world)), Ok(Progress::Newest));
    world.change(&[(0, Some(100))]);
    assert_eq!(mirror.take(&digest(&world)), Ok(Progress::Missing));
    world.change(&[]);
    let mut mirror = Mirror::new();
    assert_eq!(mirror.take(&digest(&world)), Ok(Progress::Missing));
}

#[test]
fn a_reply_is_whole_even_if_newer_tiles_come_before_it() {
    let mut world = World::new(1);
    world.change(&[(0, Some(0)), (1, Some(0))]);
    let reply = world.messages_since(0);
    let mut mirror = Mirror::new();
    world.change(&[(0, Some(100)), (2, Some(0))]);
    mirror.take(&world.messages_since(1)[0]).unwrap();
    assert_eq!(mirror.take_reply(&reply), Ok(true));
    assert_eq!((version_of(&mirror), mirror.is_newest()), (1, false));
    // Of the newer version one tile has come already, and the other makes it whole.
    assert_eq!(mirror.take(&world.messages_since(1)[1]), Ok(Progress::Newest));
    assert_eq!(World::of(mirror.map()), world.values());
}

#[test]
fn another_run_begins_from_nothing_and_until_then_the_old_map_is_held() {
    let mut world = World::new(1);
    world.change(&[(0, Some(0)), (1, Some(0))]);
    let mut mirror = Mirror::new();
    mirror.take_reply(&world.messages_since(0)).unwrap();
    let mut other = World::new(2);
    other.change(&[(1, Some(100)), (5, Some(0))]);
    let messages = other.messages_since(0);
    assert_eq!(mirror.take(&messages[0]), Ok(Progress::Underway));
    assert_eq!((mirror.map().run(), World::of(mirror.map())), (1, world.values()));
    assert_eq!(mirror.take(&messages[1]), Ok(Progress::Newest));
    assert_eq!((mirror.map().run(), World::of(mirror.map())), (2, other.values()));
}

#[test]
fn messages_that_cannot_be_read_change_nothing() {
    let mut world = World::new(1);
    world.change(&[(0, Some(0)), (1, Some(0))]);
    let messages = world.messages_since(0);
    let mut mirror = Mirror::new();
    let mut broken = messages[0].to_vec();
    let last = broken.len() - 1;
    broken[last] ^= 0x55;
    assert!(mirror.take(&broken).is_err());
    assert!(mirror.take(b"GMT1").is_err());
    assert_eq!(mirror.newest_version(), None);
    assert!(mirror.take_reply(&[Bytes::from(broken), messages[1].clone()]).is_err());
    assert_eq!(mirror.newest_version(), None);
}

proptest! {
    /// Whatever is lost, comes twice or comes late: what is held was a version as a whole.
    #[test]
    fn versions_are_never_mixed(
        versions in proptest::collection::vec(
            (proptest::collection::vec((0..6_i32, proptest::option::of(0..3_i8)), 0..5), any::<bool>()),
            1..12,
        ),
        fates in proptest::collection::vec(0..4_u8, 80),
    ) {
        let mut world = World::new(1);
        let mut history = BTreeMap::from([((0, 0), BTreeMap::new())]);
        let mut mirror = Mirror::new();
        let mut late = Vec::new();
        let mut fates = fates.into_iter().cycle();
        for (changes, restarts) in versions {
            if restarts && world.head.version > 4 {
                world = World::new(world.head.run + 1);
            }
            let before = world.head.version;
            world.change(&changes);
            history.insert((world.head.run, world.head.version), world.values());
            let mut messages = world.messages_since(before);
            messages.append(&mut late);
            for message in messages {
                match fates.next() {
                    Some(0) => {}
                    Some(1) => late.push(message),
                    Some(2) => {
                        mirror.take(&message).unwrap();
                        mirror.take(&message).unwrap();
                    }
                    _ => drop(mirror.take(&message).unwrap()),
                }
                let map = mirror.map();
                prop_assert_eq!(&World::of(map), &history[&(map.run(), map.version())]);
            }
        }
        let asked = mirror.question();
        let known = if mirror.map().run() == world.head.run { version_of(&mirror) } else { 0 };
        let begins = format!("since={}", version_of(&mirror));
        prop_assert!(asked.starts_with(&begins));
        // A late message of a run that is over may be the last that was heard.
        prop_assert!(mirror.take_reply(&world.messages_since(known)).unwrap());
        prop_assert_eq!(World::of(mirror.map()), world.values());
        prop_assert!(mirror.is_newest());
    }
}
