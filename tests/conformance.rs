//! The edge cases of the semantics (B5) that the mapping core meets; each test names its case.
//!
//! Cases of the daemon are not here, since the core knows neither transforms nor a clock nor a
//! file: odometry later than the scan by more than a timeout, a laser tilted by 3 degrees (both
//! are decided before a scan reaches the core), pause and resume, and a checkpoint in the
//! middle of a resample.

use std::f64::consts::TAU;

use gmapd::sim::building::building;
use gmapd::sim::corridor::straight_corridor;
use gmapd::sim::lidar::Lidar;
use gmapd::sim::world::World;
use gmapd::sim::{Reading, Simulation};
use gmapd::slam::gmapping::{
    GMapping, JumpGuard, JumpPolicy, MatcherKind, OdometryUpdate, Parameters, Particle,
    ScanReading, ScanReport, ScanUpdate, SkipReason,
};
use gmapd::slam::grid::occupancy::OccupancyGrid;
use gmapd::slam::motion_gate::MotionGate;
use gmapd::slam::odometry::MotionNoise;
use gmapd::slam::pose::{Point2, Pose2, Stamp};
use gmapd::slam::scan::{Beam, LaserMount, MountOrientation, ScanGeometry};

mod support;

use support::{Shot, add, filter, full_circle, parameters, room, route, shots};

const CORNER: Point2 = Point2::new(0.0, 0.0);
const NO_NOISE: MotionNoise = MotionNoise {
    translation_from_translation: 0.0,
    translation_from_rotation: 0.0,
    rotation_from_translation: 0.0,
    rotation_from_rotation: 0.0,
};

/// A filter after a drive in which every scan was processed.
fn driven(parameters: &Parameters, lidar: &Lidar, shots: &[Shot]) -> GMapping {
    let mut filter = filter(parameters);
    for shot in shots {
        report(add(&mut filter, lidar, shot));
    }
    filter
}

fn report(update: ScanUpdate) -> ScanReport {
    match update {
        ScanUpdate::Processed(report) => report,
        ScanUpdate::Skipped(reason) => panic!("skipped: {reason:?}"),
    }
}

fn grid(filter: &GMapping) -> OccupancyGrid {
    filter.occupancy_grid().expect("a scan was processed")
}

/// The value of the cell at a point; unknown outside the grid.
fn value_at(grid: &OccupancyGrid, x: f64, y: f64) -> i8 {
    let column = ((x - grid.origin.x) / grid.resolution).floor();
    let row = ((y - grid.origin.y) / grid.resolution).floor();
    if column < 0.0 || row < 0.0 || column >= grid.width as f64 || row >= grid.height as f64 {
        return -1;
    }
    grid.cells[row as usize * grid.width + column as usize]
}

/// Centres and values of the cells that are known.
fn known(grid: &OccupancyGrid) -> impl Iterator<Item = (Point2, i8)> + '_ {
    let center = |i: usize, origin: f64| origin + (i as f64 + 0.5) * grid.resolution;
    grid.cells.iter().enumerate().filter(|(_, value)| **value >= 0).map(move |(i, value)| {
        let (column, row) = (i % grid.width, i / grid.width);
        (Point2::new(center(column, grid.origin.x), center(row, grid.origin.y)), *value)
    })
}

/// The share of cells known to either map that the other, moved by `shift`, holds alike.
fn agreement(a: &OccupancyGrid, b: &OccupancyGrid, shift: Point2) -> f64 {
    let share = |a: &OccupancyGrid, b: &OccupancyGrid, sign: f64| {
        let alike = |(at, value): &(Point2, i8)| {
            value_at(b, at.x + sign * shift.x, at.y + sign * shift.y) == *value
        };
        known(a).filter(alike).count() as f64 / known(a).count() as f64
    };
    share(a, b, 1.0).min(share(b, a, -1.0))
}

/// Asserts that obstacles are where the world has them, and that most of the walls are there.
fn assert_map_of(world: &World, filter: &GMapping) {
    let grid = grid(filter);
    let reach = 2.0 * grid.resolution;
    let occupied: Vec<Point2> =
        known(&grid).filter(|(_, value)| *value == 100).map(|(at, _)| at).collect();
    let misplaced = occupied.iter().filter(|at| world.clearance(**at) > reach).count();
    assert!(misplaced * 100 <= occupied.len(), "{misplaced} of {} misplaced", occupied.len());
    let free = known(&grid).filter(|(_, value)| *value == 0).count() as f64;
    let area = free * grid.resolution * grid.resolution;
    assert!((45.0..70.0).contains(&area), "{area} m2 are free");
}

fn assert_near(found: Pose2, expected: Pose2, [distance, angle]: [f64; 2]) {
    let error = expected.between(found);
    assert!(
        error.position().norm() <= distance && error.theta.abs() <= angle,
        "{found:?} is not {expected:?}"
    );
}

fn assert_path_near(filter: &GMapping, expected: &[Pose2], tolerance: [f64; 2]) {
    let path = filter.path();
    assert_eq!(path.len(), expected.len());
    for ((_, found), expected) in path.iter().zip(expected) {
        assert_near(found, *expected, tolerance);
    }
}

#[test]
fn first_scan_is_processed_without_motion_and_wherever_odometry_is() {
    let world = room(CORNER);
    let lidar = full_circle(360);
    let here = route(CORNER)[0];
    for odom_from_base in [Pose2::IDENTITY, Pose2::new(-70.0, 400.0, 2.0)] {
        let mut shot = shots(&world, &lidar, &[here])[0].clone();
        shot.odom_from_base = odom_from_base;
        let filter = driven(&parameters(), &lidar, &[shot]);
        assert_eq!(filter.pose_in_map(), odom_from_base);
        assert_near(filter.map_from_odom(), Pose2::IDENTITY, [1e-9, 1e-12]);
        assert_eq!(filter.path().len(), 1);
    }
}

#[test]
fn first_scan_with_an_initial_pose_puts_the_base_there() {
    let lidar = full_circle(360);
    let initial = Pose2::new(5.0, -3.0, 1.0);
    let parameters = Parameters { initial_pose: Some(initial), ..parameters() };
    assert_eq!(filter(&parameters).pose_in_map(), initial);
    let filter = driven(&parameters, &lidar, &shots(&room(CORNER), &lidar, &route(CORNER)[..1]));
    assert_eq!(filter.pose_in_map(), initial);
    let odom_from_base = route(CORNER)[0];
    assert_near(filter.map_from_odom() * odom_from_base, initial, [1e-9, 1e-12]);
}

#[test]
fn before_the_first_scan_odometry_only_moves_the_start() {
    let mut filter = filter(&parameters());
    assert_eq!(filter.add_odometry(Pose2::new(1.0, 0.0, 0.0)), OdometryUpdate::Accepted);
    assert_eq!(filter.map_from_odom(), Pose2::IDENTITY);
    let lidar = full_circle(360);
    let shot = &shots(&room(CORNER), &lidar, &route(CORNER)[..1])[0];
    report(add(&mut filter, &lidar, shot));
    assert_eq!(filter.pose_in_map(), shot.odom_from_base);
}

#[test]
fn backwards_stamps_change_nothing_but_the_stamps() {
    let lidar = full_circle(360);
    let forwards = shots(&room(CORNER), &lidar, &route(CORNER));
    let mut backwards = forwards.clone();
    for (index, shot) in backwards.iter_mut().enumerate() {
        shot.scan.stamp = Stamp(5_000_000_000 - index as i64 * 100_000_000);
    }
    let gate = MotionGate { temporal_update: Some(60.0), ..parameters().gate };
    let parameters = Parameters { gate, ..parameters() };
    let [a, b] = [&forwards, &backwards].map(|shots| driven(&parameters, &lidar, shots));
    assert_eq!(grid(&a), grid(&b));
    let poses = |filter: &GMapping| filter.path().iter().map(|(_, pose)| pose).collect::<Vec<_>>();
    assert!(poses(&a) == poses(&b));
    assert!(b.path().iter().is_sorted_by(|a, b| a.0 > b.0));
}

#[test]
fn backwards_stamps_do_not_open_the_temporal_gate() {
    let lidar = full_circle(90);
    let gate = MotionGate { temporal_update: Some(0.4), ..parameters().gate };
    let mut filter = filter(&Parameters { gate, ..parameters() });
    let mut shot = shots(&room(CORNER), &lidar, &route(CORNER)[..1])[0].clone();
    report(add(&mut filter, &lidar, &shot));
    shot.scan.stamp.0 -= 1_000_000_000;
    let update = add(&mut filter, &lidar, &shot);
    assert_eq!(update, ScanUpdate::Skipped(SkipReason::NotMovedEnough));
}

/// A drive on which every fifth beam reads `reading`, and the map it gives.
fn drive_with_every_fifth(reading: f32, parameters: &Parameters) -> GMapping {
    let lidar = full_circle(360);
    let mut shots = shots(&room(CORNER), &lidar, &route(CORNER));
    for range in shots.iter_mut().flat_map(|shot| shot.scan.ranges.iter_mut().step_by(5)) {
        *range = reading;
    }
    driven(parameters, &lidar, &shots)
}

#[test]
fn zero_nan_infinite_negative_and_too_short_ranges_say_nothing() {
    let nan = drive_with_every_fifth(f32::NAN, &parameters());
    assert_map_of(&room(CORNER), &nan);
    // The laser measures from 0.1 m to 20 m.
    for reading in [0.0, -0.0, -1.0, f32::NEG_INFINITY, 0.099, f32::INFINITY, 20.0, f32::MAX] {
        let other = drive_with_every_fifth(reading, &parameters());
        assert_eq!(other.path(), nan.path(), "{reading}");
        assert_eq!(grid(&other), grid(&nan), "{reading}");
    }
}

#[test]
fn each_range_is_a_hit_a_no_return_or_invalid() {
    let geometry = full_circle(4).geometry;
    for range in [f32::NAN, f32::NEG_INFINITY, -1.0, -0.0, 0.0, 0.099] {
        assert_eq!(geometry.classify(range), Beam::Invalid, "{range}");
    }
    for range in [20.0, 20.1, f32::MAX, f32::INFINITY] {
        assert_eq!(geometry.classify(range), Beam::NoReturn, "{range}");
    }
    for range in [0.101, 1.0, 19.999] {
        assert_eq!(geometry.classify(range), Beam::Hit(f64::from(range)), "{range}");
    }
}

#[test]
fn only_no_returns_are_free_space_and_only_if_asked_for() {
    let mut parameters = parameters();
    parameters.map.free_on_no_return = true;
    parameters.max_usable_range = Some(4.0);
    let nothing = drive_with_every_fifth(f32::NAN, &parameters);
    let visits = |filter: &GMapping| -> u64 {
        let tiles = filter.occupancy().counts().tiles();
        tiles.flat_map(|(_, tile)| tile).map(|count| u64::from(count.visits)).sum()
    };
    for reading in [0.0, -1.0, f32::NEG_INFINITY, 0.099] {
        let other = drive_with_every_fifth(reading, &parameters);
        assert_eq!(grid(&other), grid(&nothing), "{reading}");
    }
    for reading in [f32::INFINITY, 20.0] {
        let free = drive_with_every_fifth(reading, &parameters);
        assert_eq!(free.path(), nothing.path(), "{reading}");
        assert!(visits(&free) > visits(&nothing) + visits(&nothing) / 20, "{reading}");
    }
}

#[test]
fn a_range_below_range_min_is_not_a_hit() {
    let lidar = full_circle(360);
    let mut shot = shots(&room(CORNER), &lidar, &route(CORNER)[..1])[0].clone();
    let here = shot.odom_from_base;
    shot.scan.ranges[180] = 0.0999;
    let filter = driven(&parameters(), &lidar, std::slice::from_ref(&shot));
    let in_front = here * Point2::new(0.0999, 0.0);
    assert_eq!(value_at(&grid(&filter), in_front.x, in_front.y), 0);
    shot.scan.ranges[180] = 0.1001;
    let filter = driven(&parameters(), &lidar, &[shot]);
    let in_front = here * Point2::new(0.1001, 0.0);
    assert_eq!(value_at(&grid(&filter), in_front.x, in_front.y), 100);
}

#[test]
fn all_invalid_scan_is_told_and_changes_nothing() {
    let lidar = full_circle(360);
    let shots = shots(&room(CORNER), &lidar, &route(CORNER));
    let mut filter = driven(&parameters(), &lidar, &shots[..8]);
    let state = |filter: &GMapping| {
        (grid(filter), filter.path(), filter.weights(), filter.trajectory_nodes())
    };
    let before = state(&filter);
    for range in [f32::NAN, f32::INFINITY, 0.0] {
        let mut shot = shots[8].clone();
        shot.scan.ranges.fill(range);
        let update = add(&mut filter, &lidar, &shot);
        assert_eq!(update, ScanUpdate::Skipped(SkipReason::NoUsableBeams));
        assert_eq!(state(&filter), before);
    }
    let mut empty = shots[8].clone();
    empty.scan.ranges.clear();
    assert_eq!(add(&mut filter, &lidar, &empty), ScanUpdate::Skipped(SkipReason::NoUsableBeams));
    // The motion so far is not lost: the same scan, whole, is matched where the robot is.
    report(add(&mut filter, &lidar, &shots[8]));
    assert_near(filter.pose_in_map(), shots[8].odom_from_base, [0.03, 0.02]);
}

#[test]
fn beam_count_may_change_from_scan_to_scan() {
    let world = room(CORNER);
    let poses = route(CORNER);
    let lidars = [360, 361, 180, 7].map(full_circle);
    let mut filter = filter(&parameters());
    for (index, pose) in poses.iter().enumerate() {
        // Seven beams are too few to map with, but they must do no harm.
        let lidar = &lidars[if index == 10 { 3 } else { index % 3 }];
        let shot = &shots(&world, lidar, &[*pose])[0];
        assert_eq!(report(add(&mut filter, lidar, shot)).hits, lidar.beams);
    }
    assert_map_of(&world, &filter);
    assert_path_near(&filter, &poses, [0.05, 0.03]);
}

/// Drives through the room with two lasers and compares what comes out.
fn assert_same_map(a: (&Lidar, &[Shot]), b: (&Lidar, &[Shot])) {
    let [a, b] = [a, b].map(|(lidar, shots)| driven(&parameters(), lidar, shots));
    for filter in [&a, &b] {
        assert_map_of(&room(CORNER), filter);
        assert_path_near(filter, &route(CORNER), [0.03, 0.015]);
    }
    let agreement = agreement(&grid(&a), &grid(&b), CORNER);
    assert!(agreement > 0.99, "{agreement} of the cells agree");
}

/// A laser whose beams are the same from left to right as from right to left.
fn symmetric() -> Lidar {
    let geometry = ScanGeometry::new([-3.1, 3.1], 0.02, [0.1, 20.0]).expect("it is valid");
    Lidar { beams: 311, geometry, ..full_circle(311) }
}

/// The same sweeps with the beams in the opposite order, by a laser with this geometry.
///
/// The simulated laser asks the same code as the filter where beams point, so it is not asked.
fn reversed(shots: &[Shot], geometry: ScanGeometry) -> Vec<Shot> {
    let mut shots = shots.to_vec();
    for Shot { scan, .. } in &mut shots {
        scan.ranges.reverse();
        scan.geometry = geometry;
    }
    shots
}

#[test]
fn angle_min_above_angle_max_is_a_clockwise_laser() {
    let lidar = symmetric();
    let shots = shots(&room(CORNER), &lidar, &route(CORNER));
    for increment in [-0.02, 0.02] {
        let geometry = ScanGeometry::new([3.1, -3.1], increment, [0.1, 20.0]);
        let clockwise = reversed(&shots, geometry.expect("it is a clockwise laser"));
        assert_same_map((&lidar, &shots), (&lidar, &clockwise));
    }
}

#[test]
fn upside_down_gives_the_map_of_the_laser_upright() {
    let upright = symmetric();
    let shots = shots(&room(CORNER), &upright, &route(CORNER));
    let mount = LaserMount { orientation: MountOrientation::UpsideDown, ..upright.mount };
    let upside_down = Lidar { mount, ..upright.clone() };
    let seen = reversed(&shots, upright.geometry);
    assert_same_map((&upright, &shots), (&upside_down, &seen));
}

#[test]
fn a_laser_away_from_the_base_maps_the_same_room() {
    let centred = symmetric();
    let base_from_laser = Pose2::new(0.4, -0.25, 2.3);
    let poses = route(CORNER);
    let world_from_laser: Vec<Pose2> = poses.iter().map(|pose| *pose * base_from_laser).collect();
    let mut upright = shots(&room(CORNER), &centred, &world_from_laser);
    upright.iter_mut().zip(&poses).for_each(|(shot, pose)| shot.odom_from_base = *pose);
    let upside_down = reversed(&upright, centred.geometry);
    let [a, b] = [MountOrientation::Upright, MountOrientation::UpsideDown].map(|orientation| {
        Lidar { mount: LaserMount { base_from_laser, orientation }, ..centred.clone() }
    });
    assert_same_map((&a, &upright), (&b, &upside_down));
}

#[test]
fn zero_to_two_pi_maps_alike_with_and_without_the_duplicate_beam() {
    let increment = TAU / 360.0;
    let lidar = |beams: usize| {
        let angles = [0.0, increment * (beams as f64 - 1.0)];
        let geometry = ScanGeometry::new(angles, increment, [0.1, 20.0]);
        Lidar { beams, geometry: geometry.expect("it is valid"), ..full_circle(beams) }
    };
    let [without, with] = [360, 361].map(lidar);
    let seen = |lidar| shots(&room(CORNER), lidar, &route(CORNER));
    assert_same_map((&without, &seen(&without)), (&with, &seen(&with)));
}

#[test]
fn more_than_2047_beams_are_all_used() {
    let world = room(CORNER);
    let poses = &route(CORNER)[..6];
    let lidar = full_circle(4321);
    let mut filter = filter(&parameters());
    for shot in shots(&world, &lidar, poses) {
        assert_eq!(report(add(&mut filter, &lidar, &shot)).hits, 4321);
    }
    assert_path_near(&filter, poses, [0.03, 0.015]);
}

#[test]
fn resolution_need_not_divide_anything() {
    let world = room(CORNER);
    let poses = route(CORNER);
    let lidar = full_circle(360);
    for resolution in [0.03, 0.07] {
        let parameters = Parameters { resolution, ..parameters() };
        let filter = driven(&parameters, &lidar, &shots(&world, &lidar, &poses));
        assert_map_of(&world, &filter);
        assert_path_near(&filter, &poses, [0.06, 0.02]);
        let grid = grid(&filter);
        assert_eq!(grid.resolution, resolution);
        for corner in [grid.origin.x, grid.origin.y] {
            let cells = corner / resolution;
            assert!((cells - cells.round()).abs() < 1e-9, "{corner} is no corner of a cell");
        }
    }
}

#[test]
fn beyond_the_initial_bounds_and_100_km_away_the_map_is_the_same() {
    let lidar = full_circle(360);
    let map_at = |corner| {
        let shots = shots(&room(corner), &lidar, &route(corner));
        let filter = driven(&parameters(), &lidar, &shots);
        assert_map_of(&room(corner), &filter);
        filter
    };
    let home = map_at(CORNER);
    // The original's map begins with 100 m each way: out on each of its four sides, and far off.
    for (x, y) in [(97.0, 0.0), (-104.0, 0.0), (0.0, 97.0), (0.0, -104.0), (1e5, -1e5)] {
        let away = map_at(Point2::new(x, y));
        let agreement = agreement(&grid(&home), &grid(&away), Point2::new(x, y));
        assert!(agreement > 0.995, "({x}, {y}): {agreement}");
        for ((_, there), (_, here)) in away.path().iter().zip(home.path().iter()) {
            let here = Pose2 { x: here.x + x, y: here.y + y, ..here };
            assert_near(there, here, [0.002, 0.001]);
        }
    }
}

/// The drive, with odometry 25 m off from the twelfth scan on.
fn shots_with_jump(lidar: &Lidar) -> Vec<Shot> {
    let mut shots = shots(&room(CORNER), lidar, &route(CORNER));
    for shot in &mut shots[12..] {
        shot.odom_from_base.x += 25.0;
    }
    shots
}

#[test]
fn jump_of_25_m_is_rejected_and_mapping_goes_on() {
    let lidar = full_circle(360);
    let shots = shots_with_jump(&lidar);
    let mut filter = driven(&parameters(), &lidar, &shots[..12]);
    assert_eq!(
        add(&mut filter, &lidar, &shots[12]),
        ScanUpdate::Skipped(SkipReason::NotMovedEnough)
    );
    assert_near(filter.pose_in_map(), route(CORNER)[11], [0.03, 0.015]);
    for shot in &shots[13..] {
        report(add(&mut filter, &lidar, shot));
    }
    assert_map_of(&room(CORNER), &filter);
    assert_near(filter.pose_in_map(), route(CORNER)[23], [0.03, 0.015]);

    let further = Pose2 { x: shots[23].odom_from_base.x + 20.1, ..shots[23].odom_from_base };
    assert_eq!(filter.add_odometry(further), OdometryUpdate::JumpRejected);
    let not_that_far = Pose2 { x: further.x + 19.9, ..further };
    assert_eq!(filter.add_odometry(not_that_far), OdometryUpdate::Accepted);
}

#[test]
fn jump_of_25_m_is_believed_where_the_policy_says_so() {
    let lidar = full_circle(360);
    let shots = shots_with_jump(&lidar);
    let jump = JumpGuard { policy: JumpPolicy::Continue, ..JumpGuard::default() };
    let filter = driven(&Parameters { jump, ..parameters() }, &lidar, &shots[..13]);
    let moved = filter.pose_in_map().x - route(CORNER)[12].x;
    assert!((moved - 25.0).abs() < 2.0, "{moved} m");
}

#[test]
fn odometry_that_is_no_pose_is_ignored() {
    let lidar = full_circle(360);
    let shots = shots(&room(CORNER), &lidar, &route(CORNER));
    let mut filter = driven(&parameters(), &lidar, &shots[..8]);
    let before = filter.pose_in_map();
    for odom_from_base in [
        Pose2::new(f64::NAN, 0.0, 0.0),
        Pose2::new(0.0, 0.0, f64::INFINITY),
        Pose2::new(1e9, 0.0, 0.0),
    ] {
        assert_eq!(filter.add_odometry(odom_from_base), OdometryUpdate::NotUsable);
        let shot = Shot { odom_from_base, ..shots[8].clone() };
        let update = add(&mut filter, &lidar, &shot);
        assert_eq!(update, ScanUpdate::Skipped(SkipReason::BadOdometry));
        assert_eq!(filter.pose_in_map(), before);
    }
    shots[8..].iter().for_each(|shot| {
        report(add(&mut filter, &lidar, shot));
    });
    assert_map_of(&room(CORNER), &filter);
}

/// Scans of a robot that stands still.
fn standing(lidar: &Lidar) -> Vec<Shot> {
    let here = route(CORNER)[6];
    shots(&room(CORNER), lidar, &[here; 40])
}

#[test]
fn standing_still_without_temporal_update_processes_the_first_scan_only() {
    let lidar = full_circle(360);
    let mut filter = filter(&parameters());
    let processed = standing(&lidar)
        .iter()
        .filter(|shot| matches!(add(&mut filter, &lidar, shot), ScanUpdate::Processed(_)))
        .count();
    assert_eq!(processed, 1);
}

#[test]
fn standing_still_with_temporal_update_processes_scans_and_stays_there() {
    let lidar = Lidar { range_noise_std: 0.01, ..full_circle(360) };
    let gate = MotionGate { temporal_update: Some(0.7), ..parameters().gate };
    let mut filter = filter(&Parameters { gate, ..parameters() });
    let shots = standing(&lidar);
    let processed: Vec<bool> = shots
        .iter()
        .map(|shot| matches!(add(&mut filter, &lidar, shot), ScanUpdate::Processed(_)))
        .collect();
    // Scans come every half second, so every second one is more than 0.7 s after the last.
    let every_second: Vec<bool> = (0..shots.len()).map(|index| index % 2 == 0).collect();
    assert_eq!(processed, every_second);
    assert_near(filter.pose_in_map(), shots[0].odom_from_base, [0.02, 0.01]);
}

#[test]
fn resample_with_all_equal_weights_goes_on() {
    let world = room(CORNER);
    let lidar = full_circle(360);
    let mut parameters = parameters();
    // Without noise, and with a matcher that has no covariance to sample from, all particles are
    // the same; a threshold above 1 resamples at every scan.
    parameters.motion_noise = NO_NOISE;
    parameters.matcher.kind = MatcherKind::Compat;
    parameters.weighting.resample_threshold = 1.5;
    let mut filter = filter(&parameters);
    for shot in shots(&world, &lidar, &route(CORNER)) {
        let report = report(add(&mut filter, &lidar, &shot));
        assert!(report.resampled);
        assert!((report.effective_sample_size - 8.0).abs() < 1e-9);
        assert!((report.entropy - 8.0_f64.ln()).abs() < 1e-9);
        assert_eq!(filter.weights(), [0.125; 8]);
    }
    assert_map_of(&world, &filter);
}

#[test]
fn resample_with_one_particle_keeps_it() {
    let world = room(CORNER);
    let lidar = full_circle(360);
    for resample_threshold in [0.5, 1.5] {
        let mut parameters = Parameters { particles: 1, ..parameters() };
        parameters.weighting.resample_threshold = resample_threshold;
        let mut filter = filter(&parameters);
        for shot in shots(&world, &lidar, &route(CORNER)) {
            let report = report(add(&mut filter, &lidar, &shot));
            assert_eq!((report.effective_sample_size, report.entropy.abs()), (1.0, 0.0));
            assert_eq!(filter.weights(), [1.0]);
        }
        assert_map_of(&world, &filter);
        assert_eq!(filter.trajectory_nodes(), 1);
    }
}

#[test]
fn n_may_change_between_runs_and_a_particle_draws_the_same() {
    let lidar = full_circle(360);
    let shots = &shots(&room(CORNER), &lidar, &route(CORNER))[..2];
    let poses = |particles| -> Vec<Pose2> {
        let filter = driven(&Parameters { particles, ..parameters() }, &lidar, shots);
        assert_eq!(filter.particles().len(), particles.max(1));
        filter.particles().iter().map(|particle| particle.pose_in_map()).collect()
    };
    let forty = poses(40);
    for particles in [0, 1, 5, 39] {
        assert_eq!(poses(particles), forty[..particles.max(1)]);
    }
}

#[test]
fn minimum_score_never_met_goes_by_odometry_and_says_so() {
    let lidar = full_circle(360);
    let mut parameters = parameters();
    parameters.matcher.minimum_score = 1e6;
    parameters.motion_noise = NO_NOISE;
    let poses = route(CORNER);
    let mut filter = filter(&parameters);
    for (index, shot) in shots(&room(CORNER), &lidar, &poses).iter().enumerate() {
        let report = report(add(&mut filter, &lidar, shot));
        assert_eq!(report.matched, if index == 0 { 8 } else { 0 });
    }
    assert_path_near(&filter, &poses, [1e-9, 1e-9]);
}

#[test]
fn corridor_without_features_keeps_poses_finite_and_along_it() {
    let site = straight_corridor(60.0);
    let lidar = Lidar::full_circle(180).expect("two beams or more");
    for kind in [MatcherKind::Field, MatcherKind::Compat] {
        let mut parameters = parameters();
        parameters.matcher.kind = kind;
        // Short beams never see the ends, so nothing holds the robot along the corridor.
        parameters.max_usable_range = Some(6.0);
        let mut filter = filter(&parameters);
        let poses: Vec<Pose2> =
            (0..80).map(|i| Pose2::new(10.0 + f64::from(i) * 0.4, 0.0, 0.0)).collect();
        for shot in shots(&site.world, &lidar, &poses) {
            report(add(&mut filter, &lidar, &shot));
            for particle in filter.particles() {
                let pose = particle.pose_in_map();
                let covariance = particle.covariance();
                assert!(pose.is_finite() && covariance.iter().all(|v| v.is_finite()), "{pose:?}");
                // The original's matcher, too, slips by metres where nothing holds it.
                let error = shot.odom_from_base.between(pose);
                assert!(error.x.abs() < 12.0 && error.y.abs() < 1.2, "{kind:?}: {error:?}");
                assert!(error.theta.abs() < 0.1, "{kind:?}: {error:?}");
            }
        }
    }
}

#[test]
fn empty_map_around_the_robot_leaves_it_to_odometry() {
    // The jump is believed: the second scan lies where the map of the first is empty.
    let lidar = full_circle(360);
    for kind in [MatcherKind::Field, MatcherKind::Compat] {
        let jump = JumpGuard { policy: JumpPolicy::Continue, ..JumpGuard::default() };
        let mut parameters = Parameters { jump, motion_noise: NO_NOISE, ..parameters() };
        parameters.matcher.kind = kind;
        let mut shots = shots(&room(CORNER), &lidar, &route(CORNER)[..3]);
        shots[1].odom_from_base.x += 500.0;
        shots[2].odom_from_base.x += 500.0;
        let mut filter = driven(&parameters, &lidar, &shots[..1]);
        let second = report(add(&mut filter, &lidar, &shots[1]));
        assert_eq!((second.matched, second.best_score), (0, 0.0), "{kind:?}");
        assert_near(filter.pose_in_map(), shots[1].odom_from_base, [1e-9, 1e-9]);
        assert_eq!(report(add(&mut filter, &lidar, &shots[2])).matched, 8, "{kind:?}");
        assert_near(filter.pose_in_map(), shots[2].odom_from_base, [0.03, 0.015]);
    }
}

/// Half a minute through a building, with noise everywhere.
fn noisy_readings() -> Vec<Reading> {
    let lidar = Lidar::full_circle(180).expect("two beams or more");
    let simulation = Simulation::through(&building(3, 20.0), 1, lidar, 3);
    simulation.readings().take(400).collect()
}

#[test]
fn two_runs_with_the_same_seed_are_identical_on_any_number_of_threads() {
    let readings = noisy_readings();
    let gate = MotionGate { linear_update: 0.3, ..MotionGate::default() };
    let mut parameters = Parameters { gate, ..Parameters::default() };
    parameters.weighting.resample_threshold = 0.97;
    let run = |seed, threads| {
        let mut filter = GMapping::new(parameters.clone(), seed, threads).expect("threads start");
        let mut resampled = 0;
        for Reading { scan, odom_from_base, .. } in &readings {
            let reading = ScanReading {
                scan,
                mount: &LaserMount::default(),
                odom_from_base: *odom_from_base,
            };
            if let ScanUpdate::Processed(report) = filter.add_scan(&reading, &mut |_| ()) {
                resampled += usize::from(report.resampled);
            }
        }
        assert!(resampled > 1, "{resampled} resamplings");
        (grid(&filter), filter.path(), filter.weights(), filter.particle_tiles())
    };
    let one = run(1, 1);
    for threads in [1, 2, 4] {
        assert_eq!(run(1, threads), one, "{threads} threads");
    }
    assert_ne!(run(2, 1).1, one.1);
}

#[test]
fn a_reset_filter_maps_as_a_new_one_does() {
    let lidar = full_circle(180);
    let shots = shots(&room(CORNER), &lidar, &route(CORNER));
    let mut filter = driven(&parameters(), &lidar, &shots[..15]);
    filter.reset(None);
    assert!(filter.particles().is_empty() && filter.occupancy_grid().is_none());
    for shot in &shots {
        add(&mut filter, &lidar, shot);
    }
    let new = driven(&parameters(), &lidar, &shots);
    assert_eq!(filter.path(), new.path());
    assert_eq!(filter.occupancy_grid(), new.occupancy_grid());

    filter.reset(Some(Pose2::new(7.0, 8.0, 0.5)));
    add(&mut filter, &lidar, &shots[3]);
    assert_near(filter.pose_in_map(), Pose2::new(7.0, 8.0, 0.5), [1e-12, 1e-12]);
}

#[test]
fn a_pose_that_is_set_moves_all_particles_and_keeps_them_apart() {
    let lidar = full_circle(180);
    let shots = shots(&room(CORNER), &lidar, &route(CORNER));
    let mut filter = driven(&parameters(), &lidar, &shots[..10]);
    filter.add_odometry(shots[10].odom_from_base);
    let pose = |particle: &Particle| particle.pose_in_map();
    let best = filter.best().map(pose).unwrap();
    let apart: Vec<Pose2> = filter.particles().iter().map(|p| best.between(pose(p))).collect();
    assert!(apart.iter().any(|pose| pose.position().norm() > 1e-6), "all particles are alike");

    let place = Pose2::new(-3.0, 4.0, 2.0);
    filter.set_pose(place);
    assert_near(filter.pose_in_map(), place, [1e-9, 1e-9]);
    let best = filter.best().map(pose).unwrap();
    for (particle, apart) in filter.particles().iter().zip(apart) {
        assert_near(best.between(pose(particle)), apart, [1e-9, 1e-9]);
    }
}

#[test]
fn a_pose_that_is_set_before_the_first_scan_is_where_the_map_begins() {
    let lidar = full_circle(180);
    let shots = shots(&room(CORNER), &lidar, &route(CORNER));
    let mut filter = filter(&parameters());
    filter.set_pose(Pose2::new(-3.0, 4.0, 2.0));
    add(&mut filter, &lidar, &shots[0]);
    assert_near(filter.pose_in_map(), Pose2::new(-3.0, 4.0, 2.0), [1e-12, 1e-12]);
}
