//! Starting from a saved map: where the first scan was taken, and maps that stay as they are.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use gmapd::config::Config;
use gmapd::map;
use gmapd::sim::lidar::Lidar;
use gmapd::sim::shape::Segment;
use gmapd::sim::world::World;
use gmapd::slam::engine::{Engine, Sweep};
use gmapd::slam::grid::occupancy::{OccupancyGrid, ScanOutline};
use gmapd::slam::known_map::{KnownMap, Mode};
use gmapd::slam::outline::{BeamLimits, outline};
use gmapd::slam::pose::{Point2, Pose2, wrap_angle};
use gmapd::slam::search::NotLocalized;
use gmapd::slam::update::{ScanUpdate, SkipReason};
use gmapd::starting;

#[expect(dead_code, reason = "what is for the particle filter is not used here")]
mod support;

use support::{Shot, full_circle, room, route, shots};

/// Of the engines that start from a map, with cells of 5 cm.
const ENGINES: [&str; 2] = ["engine=gmapping", "engine=hector"];

const CORNER: Point2 = Point2 { x: -2.0, y: -3.0 };

/// A folder that is gone at the end.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let name = format!("gmapd-localization-{}-{name}", std::process::id());
        let path = std::env::temp_dir().join(name);
        std::fs::create_dir_all(&path).expect("a folder can be made");
        Self(path)
    }

    /// Saves a map and tells where.
    fn save(&self, name: &str, grid: &OccupancyGrid) -> PathBuf {
        let (image, yaml) = (format!("{name}.pgm"), self.0.join(format!("{name}.yaml")));
        std::fs::write(self.0.join(&image), map::pgm(grid)).expect("it can be written");
        std::fs::write(&yaml, map::yaml(grid, &image)).expect("it can be written");
        yaml
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        std::fs::remove_dir_all(&self.0).ok();
    }
}

fn config(overrides: &[&str]) -> Config {
    let common =
        ["particles=8", "linearUpdate=0.1", "map_resolution=0.05", "free_on_no_return=true"];
    let all: Vec<String> = common.iter().chain(overrides).map(|&text| text.to_owned()).collect();
    Config::load(None, &all).expect("it is a configuration")
}

/// An engine that starts from the map, as a program would make it.
fn on_map(yaml: &Path, overrides: &[&str]) -> Engine {
    let map = format!("map={}", yaml.display());
    let overrides: Vec<&str> = overrides.iter().copied().chain([map.as_str()]).collect();
    starting::engine(&config(&overrides), 1).expect("the map is one")
}

fn lidar() -> Lidar {
    Lidar { range_noise_std: 0.01, ..full_circle(360) }
}

fn add(engine: &mut Engine, lidar: &Lidar, shot: &Shot) -> ScanUpdate {
    let odom_from_base = Some(shot.odom_from_base);
    let sweep = Sweep { scan: &shot.scan, mount: &lidar.mount, odom_from_base };
    engine.add_scan(&sweep, &mut |_| ())
}

/// The same drive with an odometry frame of its own, which slips by 2 %.
fn with_own_odometry(shots: Vec<Shot>, odom_from_map: Pose2) -> Vec<Shot> {
    let slip = |pose: Pose2| Pose2::new(1.02 * pose.x, 1.02 * pose.y, pose.theta);
    let moved = |shot: Shot| {
        let odom_from_base = odom_from_map * slip(shot.odom_from_base);
        Shot { odom_from_base, ..shot }
    };
    shots.into_iter().map(moved).collect()
}

/// Distance, m, and angle, rad, between two poses.
fn apart(a: Pose2, b: Pose2) -> (f64, f64) {
    ((a.x - b.x).hypot(a.y - b.y), wrap_angle(a.theta - b.theta).abs())
}

/// Maps the room from a drive whose odometry is the truth, so that `map` is the world.
fn mapped(engine: &str) -> OccupancyGrid {
    let lidar = lidar();
    let mut engine = starting::engine(&config(&[engine]), 1).expect("it needs no map");
    for shot in shots(&room(CORNER), &lidar, &route(CORNER)) {
        add(&mut engine, &lidar, &shot);
    }
    engine.occupancy_grid().expect("scans were processed")
}

/// A second drive: the other way, beginning somewhere else.
fn second_drive() -> (Vec<Shot>, Vec<Pose2>) {
    let mut poses = route(CORNER);
    poses.reverse();
    let there = poses.into_iter().skip(3);
    let poses: Vec<Pose2> =
        there.map(|pose| Pose2::new(pose.x, pose.y, wrap_angle(pose.theta + 2.5))).collect();
    let shots = shots(&room(CORNER), &lidar(), &poses);
    (with_own_odometry(shots, Pose2::new(7.0, -1.0, 1.3)), poses)
}

#[test]
fn a_second_session_goes_on_in_the_frame_of_the_first() {
    let folder = Folder::new("second");
    for engine in ENGINES {
        let yaml = folder.save("room", &mapped(engine));
        let (shots, truth) = second_drive();
        let Pose2 { x, y, theta } = truth[0];
        // As an operator would point at it.
        let given = format!("initial_pose=[{}, {}, {}]", x + 0.15, y - 0.1, theta + 0.08);
        for pose in [given.as_str(), "initial_pose=search"] {
            let mut mapping = on_map(&yaml, &[engine, pose]);
            for (index, (shot, truth)) in shots.iter().zip(&truth).enumerate() {
                let update = add(&mut mapping, &lidar(), shot);
                assert!(matches!(update, ScanUpdate::Processed(_)), "{engine} {pose} {index}");
                let (metres, radians) = apart(mapping.pose_in_map(), *truth);
                assert!(metres < 0.1, "{engine} {pose} {index}: {metres} m");
                assert!(radians < 0.05, "{engine} {pose} {index}: {radians} rad");
            }
            assert_eq!(mapping.path().len(), shots.len());
        }
    }
}

#[test]
fn a_map_stays_as_it_is_over_a_whole_drive() {
    let folder = Folder::new("frozen");
    for engine in ENGINES {
        let grid = mapped(engine);
        let yaml = folder.save("room", &grid);
        let (shots, truth) = second_drive();
        let mut localizing = on_map(&yaml, &[engine, "mode=localization"]);
        let before = localizing.occupancy().clone();
        assert_eq!(localizing.occupancy_grid().as_ref(), Some(&grid), "{engine}");
        let mut worst = 0.0_f64;
        for (shot, truth) in shots.iter().zip(&truth) {
            let ScanUpdate::Processed(report) = add(&mut localizing, &lidar(), shot) else {
                panic!("{engine}: it is processed")
            };
            assert!(!report.registered, "{engine}");
            worst = worst.max(apart(localizing.pose_in_map(), *truth).0);
            let changed = localizing.occupancy().counts().tiles_not_shared_with(before.counts());
            assert_eq!(changed, [], "{engine}: no tile is even written");
        }
        assert!(worst < 0.05, "{engine}: {worst} m");
        assert_eq!(localizing.occupancy_grid(), Some(grid), "{engine}");
        assert_eq!(localizing.path().len(), shots.len(), "{engine}");
        assert_eq!(localizing.map_corrections(), 0, "{engine}");
    }
}

#[test]
fn particles_that_localize_share_one_map() {
    let folder = Folder::new("shared");
    let yaml = folder.save("room", &mapped(ENGINES[0]));
    let mut localizing = on_map(&yaml, &["mode=localization"]);
    for shot in &second_drive().0 {
        add(&mut localizing, &lidar(), shot);
    }
    let tiles = localizing.tiles();
    assert_eq!(tiles.referenced, 8 * tiles.distinct);
}

#[test]
fn a_map_is_frozen_and_thawed_on_the_way() {
    for name in ENGINES {
        let lidar = lidar();
        let mut engine = starting::engine(&config(&[name]), 1).expect("it needs no map");
        let shots = shots(&room(CORNER), &lidar, &route(CORNER));
        let third = shots.len() / 3;
        for shot in &shots[..third] {
            add(&mut engine, &lidar, shot);
        }
        engine.set_mode(Mode::Localization);
        let frozen = engine.occupancy_grid();
        for shot in &shots[third..2 * third] {
            assert!(matches!(add(&mut engine, &lidar, shot), ScanUpdate::Processed(_)), "{name}");
        }
        assert_eq!(engine.occupancy_grid(), frozen, "{name}");
        engine.set_mode(Mode::Mapping);
        for shot in &shots[2 * third..] {
            add(&mut engine, &lidar, shot);
        }
        assert_ne!(engine.occupancy_grid(), frozen, "{name}");
        assert_eq!(engine.path().len(), shots.len(), "{name}");
        let truth = route(CORNER)[shots.len() - 1];
        assert!(apart(engine.pose_in_map(), truth).0 < 0.05, "{name}");
    }
}

/// A wall from one point to another, m.
type Wall = ((f64, f64), (f64, f64));

/// A map with walls, all else within `size` free.
fn drawn(walls: &[Wall], size: (f64, f64)) -> (OccupancyGrid, World) {
    const CELL: f64 = 0.05;
    let cells = |metres: f64| (metres / CELL).round() as usize;
    let (width, height) = (cells(size.0), cells(size.1));
    let mut grid = OccupancyGrid {
        resolution: CELL,
        width,
        height,
        origin: Point2::new(0.0, 0.0),
        cells: vec![0; width * height],
    };
    let mut segments = Vec::new();
    for &((x0, y0), (x1, y1)) in walls {
        segments.push(Segment::new(Point2::new(x0, y0), Point2::new(x1, y1)));
        for step in 0..=1000 {
            let share = f64::from(step) / 1000.0;
            let at = |from: f64, to: f64, most: usize| {
                (((from + share * (to - from)) / CELL) as usize).min(most - 1)
            };
            grid.cells[at(y0, y1, height) * width + at(x0, x1, width)] = 100;
        }
    }
    (grid, World::new(segments, Vec::new()))
}

fn outline_of(world: &World, pose: Pose2) -> ScanOutline {
    let lidar = lidar();
    let shot = shots(world, &lidar, &[pose]).remove(0);
    let limits = BeamLimits {
        max_range: None,
        max_usable_range: None,
        free_on_no_return: true,
        furthest: 100.0,
    };
    outline(&shot.scan, &lidar.mount, &limits)
}

fn known(grid: OccupancyGrid) -> KnownMap {
    KnownMap::new(grid, config(&[]).occupied_threshold())
}

#[test]
fn the_search_finds_poses_all_over_the_room_whatever_the_threads() {
    let known = known(mapped(ENGINES[0]));
    let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().expect("threads start");
    let world = room(CORNER);
    for index in 0..12 {
        let turn = f64::from(index) * 2.39;
        let (x, y) = (f64::from(index % 4) * 0.61 + 2.2, f64::from(index / 4) * 0.9 + 2.3);
        let truth = Pose2::new(CORNER.x + x, CORNER.y + y, wrap_angle(turn));
        let outline = outline_of(&world, truth);
        let place = known.find(&outline, None).unwrap_or_else(|error| panic!("{truth:?}: {error}"));
        let (metres, radians) = apart(place.pose_in_map, truth);
        assert!(metres < 0.1 && radians < 0.05, "{truth:?}: {place:?}");
        assert_eq!(known.find(&outline, Some(&pool)), Ok(place));
    }
}

#[test]
fn places_that_look_alike_are_told_and_none_is_taken() {
    let rectangle = [
        ((0.5, 0.5), (6.5, 0.5)),
        ((6.5, 0.5), (6.5, 4.5)),
        ((6.5, 4.5), (0.5, 4.5)),
        ((0.5, 4.5), (0.5, 0.5)),
    ];
    let (grid, world) = drawn(&rectangle, (7.0, 5.0));
    let found = known(grid).find(&outline_of(&world, Pose2::new(2.0, 2.0, 0.3)), None);
    let Err(NotLocalized::Ambiguous { best, other }) = found else { panic!("{found:?}") };
    let opposite = apart(best.pose_in_map, other.pose_in_map);
    assert!((opposite.1 - std::f64::consts::PI).abs() < 0.1, "half a turn: {opposite:?}");
}

#[test]
fn a_map_without_obstacles_or_of_another_place_fits_nowhere() {
    let outline = outline_of(&room(CORNER), route(CORNER)[3]);
    let (empty, _) = drawn(&[], (7.0, 5.0));
    let found = known(empty).find(&outline, None);
    assert_eq!(found, Err(NotLocalized::FitsNowhere { best: None }));
    let other = [((0.5, 0.5), (20.0, 9.0)), ((3.0, 15.0), (9.0, 19.0))];
    let (other, _) = drawn(&other, (22.0, 20.0));
    let found = known(other).find(&outline, None);
    assert!(matches!(found, Err(NotLocalized::FitsNowhere { .. })), "{found:?}");
    let nothing = known(mapped(ENGINES[0])).find(&ScanOutline::default(), None);
    assert_eq!(nothing, Err(NotLocalized::FewPoints { points: 0 }));
}

#[test]
fn after_a_refusal_the_next_scan_tries_again_and_a_pose_ends_the_search() {
    let folder = Folder::new("again");
    for engine in ENGINES {
        let yaml = folder.save("room", &mapped(engine));
        let lidar = lidar();
        let (right, truth) = second_drive();
        let nowhere = World::new(
            vec![Segment::new(Point2::new(-9.0, 2.0), Point2::new(9.0, 4.0))],
            Vec::new(),
        );
        let wrong = shots(&nowhere, &lidar, &truth[..1]).remove(0);
        let not_localized = ScanUpdate::Skipped(SkipReason::NotLocalized);
        let mut searching = on_map(&yaml, &[engine]);
        assert_eq!(add(&mut searching, &lidar, &wrong), not_localized);
        assert!(searching.obstacle().is_some() && !searching.has_begun());
        let update = add(&mut searching, &lidar, &right[0]);
        assert!(matches!(update, ScanUpdate::Processed(_)), "{engine}: {update:?}");
        assert!(searching.obstacle().is_none());
        assert!(apart(searching.pose_in_map(), truth[0]).0 < 0.1, "{engine}");

        let mut told = on_map(&yaml, &[engine]);
        add(&mut told, &lidar, &wrong);
        told.set_pose(truth[0]);
        assert!(matches!(add(&mut told, &lidar, &wrong), ScanUpdate::Processed(_)), "{engine}");

        searching.reset(None);
        assert!(!searching.has_begun() && searching.path().is_empty());
        assert_eq!(add(&mut searching, &lidar, &wrong), not_localized, "{engine}");
    }
}

#[test]
fn a_robot_whose_place_is_searched_for_goes_on_in_the_map_so_far() {
    for name in ENGINES {
        let lidar = lidar();
        let mut engine = starting::engine(&config(&[name]), 1).expect("it needs no map");
        for shot in shots(&room(CORNER), &lidar, &route(CORNER)) {
            add(&mut engine, &lidar, &shot);
        }
        let (before, map) = (engine.path().len(), engine.occupancy_grid());
        engine.search_pose();
        assert!(engine.is_searching() && engine.has_begun(), "{name}");

        let (drive, truth) = second_drive();
        let nowhere = vec![Segment::new(Point2::new(-9.0, 2.0), Point2::new(9.0, 4.0))];
        let wrong = shots(&World::new(nowhere, Vec::new()), &lidar, &truth[..1]).remove(0);
        for _ in 0..2 {
            let wrong = Shot { odom_from_base: drive[0].odom_from_base, ..wrong.clone() };
            let update = add(&mut engine, &lidar, &wrong);
            assert_eq!(update, ScanUpdate::Skipped(SkipReason::NotLocalized), "{name}");
            assert!(engine.obstacle().is_some() && engine.occupancy_grid() == map, "{name}");
        }
        for (index, (shot, truth)) in drive.iter().zip(&truth).enumerate() {
            let update = add(&mut engine, &lidar, shot);
            assert!(matches!(update, ScanUpdate::Processed(_)), "{name} {index}: {update:?}");
            let (metres, radians) = apart(engine.pose_in_map(), *truth);
            assert!(metres < 0.1 && radians < 0.05, "{name} {index}: {metres} m, {radians} rad");
        }
        assert!(!engine.is_searching() && engine.obstacle().is_none(), "{name}");
        assert_eq!(engine.path().len(), before + drive.len(), "{name}");

        engine.search_pose();
        engine.set_pose(truth[0]);
        assert!(!engine.is_searching(), "{name}: a pose ends the search");
        engine.search_pose();
        engine.reset(None);
        assert!(!engine.is_searching(), "{name}: so does a reset");
    }
}

fn gmapd(arguments: &[&str]) -> Output {
    let program = Command::new(env!("CARGO_BIN_EXE_gmapd")).args(arguments).output();
    program.expect("the program runs")
}

/// What the program says as it fails, with exit code 1.
fn complaint(arguments: &[&str]) -> String {
    let output = gmapd(arguments);
    assert_eq!(output.status.code(), Some(1), "{arguments:?}");
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn a_replay_localizes_in_the_map_of_another_and_leaves_it_as_it_is() {
    let folder = Folder::new("replay");
    let [log, first, second] =
        ["drive.log", "first", "second"].map(|name| folder.0.join(name).display().to_string());
    let done = |arguments: &[&str]| {
        let output = gmapd(arguments);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    };
    done(&["simulate", "--seed", "5", "--out", &log]);
    let replay = ["replay", &log, "--set", "particles=4", "--out"];
    done(&[&replay[..], &[&first]].concat());
    let map = format!("{first}/map.yaml");
    let frozen = [&second, "--map", &map, "--initial-pose", "search", "--mode", "localization"];
    done(&[&replay[..], &frozen].concat());
    let image = |folder: &str| std::fs::read(format!("{folder}/map.pgm")).expect("it is written");
    assert!(image(&first) == image(&second), "the map stays as it is");
    let summary = |folder: &str| -> serde_json::Value {
        let text = std::fs::read(format!("{folder}/summary.json")).expect("it is written");
        serde_json::from_slice(&text).expect("it is JSON")
    };
    let processed = |folder| summary(folder)["readings"]["processed"].as_u64();
    assert!(processed(&second) > Some(400), "{:?}", processed(&second));
    let poses = |folder: &str| -> Vec<Vec<f64>> {
        let text = std::fs::read_to_string(format!("{folder}/trajectory.tum")).expect("written");
        let line =
            |line: &str| line.split(' ').map(|word| word.parse().expect("a number")).collect();
        text.lines().filter(|text| !text.starts_with('#')).map(line).collect()
    };
    let (mapped, localized) = (poses(&first), poses(&second));
    assert_eq!(mapped.len(), localized.len());
    for (a, b) in mapped.iter().zip(&localized) {
        let metres = (a[1] - b[1]).hypot(a[2] - b[2]);
        assert!(metres < 0.15, "at {}: {metres} m from where it was mapped", a[0]);
    }
}

#[test]
fn maps_that_cannot_be_used_are_told_with_file_and_key() {
    let folder = Folder::new("errors");
    let (grid, _) = drawn(&[], (2.0, 2.0));
    let good = folder.save("good", &grid);
    let coarse = folder.save("coarse", &OccupancyGrid { resolution: 0.1, ..grid });
    let (bad, missing) = (folder.0.join("bad.yaml"), folder.0.join("missing.yaml"));
    std::fs::write(&bad, "image: [\n").expect("it can be written");
    let log = folder.0.join("none.log");
    std::fs::write(&log, "").expect("it can be written");
    let log = log.display().to_string();
    let [good, coarse, bad, missing] =
        [good, coarse, bad, missing].map(|path| path.display().to_string());
    for (set, parts) in [
        (&["--map", &coarse][..], ["map: ", "resolution is 0.1", "delta is 0.05", &coarse]),
        (&["--map", &missing], ["map: ", "cannot read", "", &missing]),
        (&["--map", &bad], ["map: ", "", "", &bad]),
        (&["--mode", "localization"], ["mode", "localization", "a map", "--map"]),
        (&["--initial-pose", "search"], ["initial_pose", "search", "a map", "--map"]),
        (&["--map", &good, "--initial-pose", "here"], ["initial_pose", "here", "[x, y, yaw]", ""]),
        (&["--map", &good, "--mode", "other"], ["mode", "other", "localization", ""]),
        (&["--map", &good, "--engine", "known_poses"], ["map", "known_poses", "", ""]),
    ] {
        let replay = [&["replay", &log][..], set].concat();
        let run = [&["run", "--no-multicast"][..1], set].concat();
        for arguments in [replay, run] {
            let complaint = complaint(&arguments);
            assert!(parts.iter().all(|part| complaint.contains(part)), "{parts:?}: {complaint}");
        }
    }
}
