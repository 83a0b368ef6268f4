//! Mapping along known poses: the map agrees with the world, and each scan enters whole.

use std::collections::BTreeSet;

use gmapd::config::Config;
use gmapd::sim::lidar::Lidar;
use gmapd::sim::{Place, Scenario, Simulation};
use gmapd::slam::engine::{Engine, Sweep};
use gmapd::slam::grid::Cell;
use gmapd::slam::grid::occupancy::OccupancyGrid;
use gmapd::slam::pose::{Point2, Pose2, Stamp};
use gmapd::slam::scan::{LaserMount, Scan};
use gmapd::slam::update::{ScanUpdate, SkipReason};

#[expect(dead_code, reason = "what is for the particle filter is not used here")]
mod support;

use support::{Shot, full_circle, room, route, shots};

const MOUNT: LaserMount = LaserMount {
    base_from_laser: Pose2::IDENTITY,
    orientation: gmapd::slam::scan::MountOrientation::Upright,
};

fn engine(overrides: &[&str]) -> Engine {
    let mut all = vec!["engine=known_poses".to_owned()];
    all.extend(overrides.iter().map(|text| (*text).to_owned()));
    let config = Config::load(None, &all).expect("it is valid");
    Engine::new(config.engine_parameters(), 1).expect("it needs no thread")
}

fn add(engine: &mut Engine, scan: &Scan, map_from_base: Pose2) -> ScanUpdate {
    let sweep = Sweep { scan, mount: &MOUNT, odom_from_base: Some(map_from_base) };
    engine.add_scan(&sweep, &mut |_| ())
}

/// Cells of the grid with this value, counted from the origin of `map`.
fn cells(grid: &OccupancyGrid, value: i8) -> BTreeSet<Cell> {
    let first = Cell::containing(
        Point2::new(grid.origin.x + 0.5 * grid.resolution, grid.origin.y + 0.5 * grid.resolution),
        grid.resolution,
    );
    let with_value = grid.cells.iter().enumerate().filter(|(_, cell)| **cell == value);
    let cell = |i: usize| {
        Cell::new(first.ix + (i % grid.width) as i32, first.iy + (i / grid.width) as i32)
    };
    with_value.map(|(i, _)| cell(i)).collect()
}

/// The share of `these` that have one of `those` within one cell.
fn share_near(these: &BTreeSet<Cell>, those: &BTreeSet<Cell>) -> f64 {
    let near = |cell: &&Cell| {
        (-1..=1).any(|dy| (-1..=1).any(|dx| those.contains(&Cell::new(cell.ix + dx, cell.iy + dy))))
    };
    these.iter().filter(near).count() as f64 / these.len() as f64
}

/// The cells of the surfaces that a laser without errors sees.
fn surfaces(simulation: &Simulation, resolution: f64) -> BTreeSet<Cell> {
    let mut exact = simulation.clone();
    let lidar = Lidar { range_noise_std: 0.0, outlier_rate: 0.0, ..simulation.lidar.clone() };
    exact.lidar = lidar;
    let mut cells = BTreeSet::new();
    for reading in exact.readings() {
        let geometry = &reading.scan.geometry;
        for (index, range) in reading.scan.ranges.iter().enumerate().filter(|(_, r)| r.is_finite())
        {
            let end = reading.world_from_base
                * MOUNT.point_in_base(geometry.angle(index), f64::from(*range));
            cells.insert(Cell::containing(end, resolution));
        }
    }
    cells
}

fn building() -> Simulation {
    Simulation::new(&Scenario::new(Place::Building, 1)).expect("it is valid")
}

fn mapped(simulation: &Simulation, overrides: &[&str]) -> Engine {
    let mut engine = engine(overrides);
    for reading in simulation.readings() {
        let update = add(&mut engine, &reading.scan, reading.world_from_base);
        assert!(matches!(update, ScanUpdate::Processed(_)), "{update:?}");
    }
    assert_eq!(engine.path().len(), simulation.scan_count());
    engine
}

/// Ranges are off by 1 cm.
#[test]
fn the_map_of_a_building_agrees_with_the_truth() {
    let mut simulation = building();
    simulation.lidar.outlier_rate = 0.0;
    let truth = surfaces(&simulation, 0.05);
    let grid = mapped(&simulation, &[]).occupancy_grid().expect("scans were processed");
    let occupied = cells(&grid, 100);
    let (precision, recall) = (share_near(&occupied, &truth), share_near(&truth, &occupied));
    eprintln!("{} cells: precision {precision:.4}, recall {recall:.4}", occupied.len());
    assert!(precision >= 0.99, "{precision}");
    assert!(recall >= 0.99, "{recall}");
}

/// Ranges that are anything put obstacles behind walls, where no other beam gets to contradict
/// them. Nothing that is known of the world is lost with them.
#[test]
fn wild_ranges_leave_nothing() {
    let simulation = building();
    assert!(simulation.lidar.outlier_rate > 0.0);
    let truth = surfaces(&simulation, 0.05);
    let judged = |overrides: &[&str]| {
        let grid = mapped(&simulation, overrides).occupancy_grid().expect("it was mapped");
        let occupied = cells(&grid, 100);
        let judged = (share_near(&occupied, &truth), share_near(&truth, &occupied));
        eprintln!("precision {:.4}, recall {:.4}", judged.0, judged.1);
        (judged, cells(&grid, 0))
    };
    let ((precision, recall), free) = judged(&[]);
    assert!(precision >= 0.99, "{precision}");
    assert!(recall >= 0.99, "{recall}");
    // What few scans call occupied is unknown, and never free.
    let ((careless, _), careless_free) = judged(&["occ_min_visits=1"]);
    assert!(careless < 0.9, "{careless}");
    assert_eq!(free, careless_free);
}

fn drive() -> Vec<Shot> {
    let corner = Point2::new(0.0, 0.0);
    shots(&room(corner), &full_circle(360), &route(corner))
}

#[test]
fn a_map_of_the_newest_scan_is_that_of_the_scan_alone() {
    let drive = drive();
    let mut all = engine(&["map_of=newest_scan"]);
    for shot in &drive {
        add(&mut all, &shot.scan, shot.odom_from_base);
    }
    let last = drive.last().expect("it has scans");
    let mut alone = engine(&["occ_min_visits=1"]);
    add(&mut alone, &last.scan, last.odom_from_base);
    assert_eq!(all.occupancy_grid(), alone.occupancy_grid());
    assert_eq!(all.path().len(), drive.len());
}

/// A robot that stands still, and one that jumps across the world, map every scan.
#[test]
fn no_scan_is_held_back() {
    let shot = drive().remove(0);
    let mut engine = engine(&[]);
    for x in [0.0, 0.0, 0.0, 500.0, 100_000.0, 0.0] {
        let pose = Pose2::new(x, 0.0, 0.0) * shot.odom_from_base;
        assert!(matches!(add(&mut engine, &shot.scan, pose), ScanUpdate::Processed(_)));
        assert_eq!(engine.pose_in_map(), pose);
    }
    assert_eq!(engine.path().len(), 6);
}

#[test]
fn poses_and_scans_that_say_nothing_are_skipped_and_leave_no_trace() {
    let shot = drive().remove(0);
    let mut engine = engine(&[]);
    let nowhere = Pose2::new(f64::NAN, 0.0, 0.0);
    let update = add(&mut engine, &shot.scan, nowhere);
    assert_eq!(update, ScanUpdate::Skipped(SkipReason::BadOdometry));
    let blind = Scan { ranges: vec![f32::NAN; 360], ..shot.scan.clone() };
    let update = add(&mut engine, &blind, shot.odom_from_base);
    assert_eq!(update, ScanUpdate::Skipped(SkipReason::NoUsableBeams));
    let without = Sweep { scan: &shot.scan, mount: &MOUNT, odom_from_base: None };
    let update = engine.add_scan(&without, &mut |_| ());
    assert_eq!(update, ScanUpdate::Skipped(SkipReason::BadOdometry));
    assert!(!engine.has_begun() && engine.occupancy_grid().is_none());
}

/// No obstacle in reach is news too.
#[test]
fn a_scan_without_an_obstacle_frees_what_it_saw() {
    let shot = drive().remove(0);
    let mut engine = engine(&["maxUrange=5.0", "free_on_no_return=true"]);
    let empty = Scan { ranges: vec![f32::INFINITY; 360], ..shot.scan };
    assert!(matches!(add(&mut engine, &empty, Pose2::IDENTITY), ScanUpdate::Processed(_)));
    let grid = engine.occupancy_grid().expect("something is known");
    let area = cells(&grid, 0).len() as f64 * 0.05 * 0.05;
    assert!((area - 25.0 * std::f64::consts::PI).abs() < 0.5, "{area} m²");
}

/// Of the edge cases of the semantics (B5), those about the beams.
#[test]
fn any_beams_are_taken_as_they_are() {
    let shot = drive().remove(0);
    let mut engine = engine(&[]);
    let ranges = |count| Scan { ranges: vec![2.0; count], ..shot.scan.clone() };
    for (processed, count) in (1..).zip([360, 1, 2, 361, 3000, 359]) {
        let update = add(&mut engine, &ranges(count), shot.odom_from_base);
        assert!(matches!(update, ScanUpdate::Processed(_)), "{count} beams: {update:?}");
        assert_eq!(engine.path().len(), processed);
    }
    let mut odd = ranges(360);
    odd.ranges[..6].copy_from_slice(&[0.0, -1.0, f32::NAN, f32::NEG_INFINITY, 0.05, f32::INFINITY]);
    let update = add(&mut engine, &odd, shot.odom_from_base);
    let ScanUpdate::Processed(report) = update else { panic!("{update:?}") };
    assert_eq!(report.hits, 354);
    let none = add(&mut engine, &ranges(0), shot.odom_from_base);
    assert_eq!(none, ScanUpdate::Skipped(SkipReason::NoUsableBeams));
}

/// Stamps that step back and repeat are no concern of a map along given poses, and the same input
/// gives the same map.
#[test]
fn the_order_of_scans_counts_and_not_their_stamps() {
    let drive = drive();
    let mapped = |stamp: fn(usize) -> i64| {
        let mut engine = engine(&[]);
        for (index, shot) in drive.iter().enumerate() {
            let scan = Scan { stamp: Stamp(stamp(index)), ..shot.scan.clone() };
            add(&mut engine, &scan, shot.odom_from_base);
        }
        engine.occupancy_grid()
    };
    assert_eq!(mapped(|index| index as i64), mapped(|index| -(index as i64) / 2));
}

#[test]
fn a_reset_forgets_the_map_and_a_set_pose_moves_nothing() {
    let shot = drive().remove(0);
    let mut engine = engine(&[]);
    add(&mut engine, &shot.scan, shot.odom_from_base);
    engine.set_pose(Pose2::new(9.0, 9.0, 9.0));
    assert_eq!(engine.pose_in_map(), shot.odom_from_base);
    engine.reset(None);
    assert!(!engine.has_begun() && engine.occupancy_grid().is_none());
}
