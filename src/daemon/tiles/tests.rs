use proptest::prelude::{any, prop_assert, prop_assert_eq, proptest};

use super::*;
use crate::convert;
use crate::map::mirror::{Mirror, Progress};
use crate::ros;
use crate::sim::lidar::Lidar;
use crate::sim::{Simulation, building};
use crate::slam::gmapping::{GMapping, MatcherParameters, Parameters, ScanReading, ScanUpdate};
use crate::slam::grid::occupancy::{
    BeamEnd, BeamEndKind, OccupancyGrid, OccupancyMap, OccupiedThreshold, ScanOutline,
};
use crate::slam::motion_gate::MotionGate;
use crate::slam::path::Path;
use crate::slam::pose::{Point2, Pose2, Stamp};

/// A robot that sees walls at some distance all around, except behind it.
fn scan(range: f32) -> ScanOutline {
    let end = |i: i32| {
        let (sin, cos) = (i as f32 * 0.1).sin_cos();
        BeamEnd { point: [range * cos, range * sin], kind: BeamEndKind::Hit }
    };
    let ends = (-25..=25).map(end).collect();
    ScanOutline { sensor: Point2::new(0.0, 0.0), ends, angle_increment: 0.1 }
}

fn version(number: u64, occupancy: &OccupancyMap) -> Arc<MapVersion> {
    Arc::new(MapVersion {
        version: number,
        epoch: 1,
        stamp: Stamp(number as i64),
        occupancy: occupancy.clone(),
        occupied_threshold: OccupiedThreshold::of_share(0.25),
        path: Path::default(),
    })
}

fn grid(map: &MapVersion) -> Option<OccupancyGrid> {
    map.occupancy.to_grid(map.occupied_threshold)
}

fn entries(messages: &[Bytes]) -> Vec<Entry> {
    let decoded = messages.iter().map(|bytes| Message::decode(bytes).unwrap());
    decoded.flat_map(|message| message.entries).collect()
}

proptest! {
    /// What is told of changes is what is told of the whole, and gives the map cell by cell,
    /// however scans are entered and taken out.
    #[test]
    fn changes_add_up_to_the_map(
        steps in proptest::collection::vec(
            (-20.0..20.0_f64, -20.0..20.0_f64, 0.5..8.0_f32, any::<bool>()), 1..12,
        ),
    ) {
        let mut occupancy = OccupancyMap::new(0.05);
        let mut tiles = TileSet::new(7, 0.05);
        let mut mirror = Mirror::new();
        let mut entered = Vec::new();
        for (number, (x, y, range, takes_out)) in (1..).zip(steps) {
            if takes_out && let Some((outline, pose)) = entered.pop() {
                occupancy.remove(&outline, pose);
            } else {
                let (outline, pose) = (scan(range), Pose2::new(x, y, x));
                occupancy.add(&outline, pose);
                entered.push((outline, pose));
            }
            let map = version(number, &occupancy);
            let before = tiles.head().version;
            tiles.update(Some(&map));
            for message in tiles.since(before) {
                mirror.take(&message).unwrap();
            }
            prop_assert_eq!(mirror.map().version(), number);
            let mirrored = mirror.map().grid();
            match grid(&map) {
                Some(grid) => prop_assert_eq!(mirrored, grid),
                None => prop_assert!(mirrored.cells.is_empty()),
            }

            let mut anew = TileSet::new(7, 0.05);
            anew.update(Some(&map));
            prop_assert_eq!(anew.head(), tiles.head());
        }
    }
}

proptest! {
    /// Whatever is lost, of what is published and of what is answered: after the last loss, one
    /// digest and one answer give the daemon's map.
    #[test]
    fn after_the_last_loss_a_digest_and_an_answer_give_the_map(
        steps in proptest::collection::vec(
            (-20.0..20.0_f64, -20.0..20.0_f64, 0.5..8.0_f32, 0..5_u8), 1..12,
        ),
        losses in proptest::collection::vec(proptest::bool::weighted(0.3), 60),
    ) {
        let mut occupancy = OccupancyMap::new(0.05);
        let mut tiles = TileSet::new(7, 0.05);
        let mut mirror = Mirror::new();
        let mut losses = losses.into_iter().cycle();
        let mut newest = None;
        for (number, (x, y, range, what)) in (1..).zip(steps) {
            let before = tiles.head().version;
            if what == 0 {
                occupancy = OccupancyMap::new(0.05);
                newest = None;
            } else {
                occupancy.add(&scan(range), Pose2::new(x, y, x));
                newest = Some(version(2 * number, &occupancy));
            }
            tiles.update(newest.as_ref());
            let published = tiles.since(before).into_iter().chain(digest(*tiles.head()));
            for message in published {
                let arrives = losses.next() == Some(false);
                let missing = arrives && mirror.take(&message).unwrap() == Progress::Missing;
                if missing && losses.next() == Some(false) {
                    mirror.take_reply(&answer(&tiles, &mirror)).unwrap();
                }
            }
        }

        if mirror.take(&digest(*tiles.head())[0]).unwrap() == Progress::Missing {
            prop_assert!(mirror.take_reply(&answer(&tiles, &mirror)).unwrap());
        }
        prop_assert!(mirror.is_newest());
        prop_assert_eq!(mirror.map().head(), *tiles.head());
        match newest.as_deref().and_then(grid) {
            Some(grid) => prop_assert_eq!(mirror.map().grid(), grid),
            None => prop_assert!(mirror.map().grid().cells.is_empty()),
        }
    }
}

/// What the daemon answers to the mirror's question.
fn answer(tiles: &TileSet, mirror: &Mirror) -> Vec<Bytes> {
    let (version, run) = (mirror.map().version(), mirror.map().run());
    tiles.answer(&TilesQuestion::Since { version, run: Some(run) })
}

/// The versions of the map, some metres apart, of a drive through a small building. Where no match
/// has the `minimum_score`, particles are guesses, and the best one changes often.
fn drive(minimum_score: f64) -> Vec<Arc<MapVersion>> {
    let lidar = Lidar::full_circle(180).unwrap();
    let simulation = Simulation::through(&building::building(3, 30.0), 1, lidar, 3);
    let gate = MotionGate { linear_update: 0.5, ..MotionGate::default() };
    let matcher = MatcherParameters { minimum_score, ..MatcherParameters::default() };
    let parameters = Parameters { particles: 12, gate, matcher, ..Parameters::default() };
    let threshold = parameters.map.occupied_threshold;
    let mut filter = GMapping::new(parameters, 3, 1).unwrap();
    let mut versions = Vec::new();
    let mut processed = 0;
    for reading in simulation.readings() {
        let (scan, mount) = (&reading.scan, &simulation.lidar.mount);
        let reading = ScanReading { scan, mount, odom_from_base: reading.odom_from_base };
        if !matches!(filter.add_scan(&reading, &mut |_| ()), ScanUpdate::Processed(_)) {
            continue;
        }
        processed += 1;
        if processed % 8 == 0 {
            versions.push(Arc::new(MapVersion {
                version: processed / 8,
                epoch: 1 + filter.map_corrections(),
                stamp: scan.stamp,
                occupancy: filter.occupancy().clone(),
                occupied_threshold: threshold,
                path: filter.path(),
            }));
        }
    }
    versions
}

fn size(messages: &[Bytes]) -> usize {
    messages.iter().map(Bytes::len).sum()
}

#[test]
fn tiles_take_three_hundredths_of_whole_maps_at_most() {
    /// Seconds between two versions, in which nothing else is told.
    const DIGESTS: usize = 4;
    let mut set = TileSet::new(1, 0.05);
    let (mut tiles, mut whole) = (0, 0);
    for version in drive(0.0) {
        let before = set.head().version;
        set.update(Some(&version));
        tiles += size(&set.since(before)) + DIGESTS * size(&digest(*set.head()));
        let map = convert::occupancy_grid(ros::Header::default(), &grid(&version).unwrap());
        whole += ros::cdr(&map).len();
    }
    assert!(tiles > 0 && tiles * 100 < 3 * whole, "{tiles} of {whole} bytes");
}

#[test]
fn a_change_of_the_best_particle_is_an_epoch_and_no_mirror_mixes_two() {
    let versions = drive(f64::INFINITY);
    let first = versions.first().unwrap().epoch;
    assert!(versions.last().unwrap().epoch > first + 2, "the best particle changed");
    let mut set = TileSet::new(1, 0.05);
    let mut mirror = Mirror::new();
    let mut history = BTreeMap::from([((0, 0), mirror.map().grid())]);
    // Every third message is lost; what is missing is asked for at every fifth.
    let mut number = 0;
    for version in versions {
        let before = set.head().version;
        set.update(Some(&version));
        assert_eq!(set.head().epoch, version.epoch);
        history.insert((version.epoch, version.version), grid(&version).unwrap());
        for message in set.since(before).into_iter().chain(digest(*set.head())) {
            number += 1;
            let missing = number % 3 != 0 && mirror.take(&message).unwrap() == Progress::Missing;
            if missing && number % 5 == 0 {
                mirror.take_reply(&answer(&set, &mirror)).unwrap();
            }
            let map = mirror.map();
            assert_eq!(map.grid(), history[&(map.epoch(), map.version())]);
        }
    }
    mirror.take_reply(&answer(&set, &mirror)).unwrap();
    assert_eq!(mirror.map().head(), *set.head());
}

#[test]
fn only_what_changed_is_told() {
    let mut occupancy = OccupancyMap::new(0.05);
    for x in 0..10 {
        occupancy.add(&scan(3.0), Pose2::new(f64::from(x) * 8.0, 0.0, 0.0));
    }
    let mut tiles = TileSet::new(1, 0.05);
    tiles.update(Some(&version(1, &occupancy)));
    let all = entries(&tiles.since(0)).len();
    assert!(all > 10 && all == tiles.head().tiles as usize);

    occupancy.add(&scan(1.0), Pose2::new(0.1, 0.1, 1.0));
    tiles.update(Some(&version(2, &occupancy)));
    let changed = entries(&tiles.since(1));
    assert!(!changed.is_empty() && changed.len() <= 4, "{}", changed.len());
    assert!(changed.iter().all(|entry| entry.version == 2));

    // Seen once more and nothing new: counts differ, and no cell.
    occupancy.add(&scan(1.0), Pose2::new(0.1, 0.1, 1.0));
    tiles.update(Some(&version(3, &occupancy)));
    assert_eq!((entries(&tiles.since(2)).len(), tiles.head().version), (0, 3));
    assert_eq!(tiles.since(2), digest(*tiles.head()));
}

#[test]
fn an_older_version_changes_nothing() {
    let mut occupancy = OccupancyMap::new(0.05);
    let empty = version(1, &occupancy);
    occupancy.add(&scan(3.0), Pose2::IDENTITY);
    let mut tiles = TileSet::new(1, 0.05);
    tiles.update(Some(&version(2, &occupancy)));
    let before = *tiles.head();
    tiles.update(Some(&empty));
    assert_eq!(*tiles.head(), before);
}

#[test]
fn a_reset_takes_all_tiles_away_and_is_an_epoch() {
    let mut occupancy = OccupancyMap::new(0.05);
    occupancy.add(&scan(3.0), Pose2::IDENTITY);
    let mut tiles = TileSet::new(1, 0.05);
    tiles.update(None);
    assert_eq!((tiles.head().version, tiles.head().epoch), (0, 0), "there was nothing");
    tiles.update(Some(&version(4, &occupancy)));
    let known = entries(&tiles.since(0)).len();
    tiles.update(None);
    tiles.update(None);
    let head = *tiles.head();
    assert_eq!((head.version, head.epoch, head.hash, head.tiles), (5, 2, 0, 0));
    assert_eq!(head.extent, Extent::default());
    let gone = entries(&tiles.since(4));
    assert_eq!(gone.len(), known);
    assert!(gone.iter().all(|entry| entry.hash == 0 && entry.version == 5));
    assert!(entries(&tiles.since(0)).is_empty(), "who has nothing is told of nothing");
}

#[test]
fn questions_are_about_this_run_and_name_tiles() {
    let mut occupancy = OccupancyMap::new(0.05);
    occupancy.add(&scan(6.0), Pose2::IDENTITY);
    let mut tiles = TileSet::new(9, 0.05);
    tiles.update(Some(&version(3, &occupancy)));
    let count = |question: TilesQuestion| entries(&tiles.answer(&question)).len();
    let all = tiles.head().tiles as usize;
    assert_eq!(count(TilesQuestion::Since { version: 3, run: None }), 0);
    assert_eq!(count(TilesQuestion::Since { version: 3, run: Some(9) }), 0);
    assert_eq!(count(TilesQuestion::Since { version: 3, run: Some(8) }), all);

    let index = *tiles.tiles.keys().next().unwrap();
    let told = entries(&tiles.answer(&TilesQuestion::Want(vec![index])));
    assert_eq!(told.len(), all, "all hashes are told");
    let with_cells: Vec<&Entry> = told.iter().filter(|entry| !entry.data.is_empty()).collect();
    assert_eq!(with_cells.iter().map(|entry| entry.index).collect::<Vec<_>>(), [index]);
    assert!(with_cells[0].cells(TILE_SIDE as u16).is_ok());
}

#[test]
fn runs_have_numbers_of_their_own() {
    let numbers = [run_number("a", 1), run_number("a", 2), run_number("b", 1)];
    assert!(numbers[0] != numbers[1] && numbers[0] != numbers[2] && numbers[1] != numbers[2]);
    assert_eq!(run_number("a", 1), numbers[0]);
}
