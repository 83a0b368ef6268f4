//! The edge cases of inputs (B5) that every engine has to bear; `tests/conformance.rs` has those of
//! GMapping alone.

use gmapd::sim::lidar::Lidar;
use gmapd::slam::engine::{Engine, EngineParameters, Sweep};
use gmapd::slam::gmapping::Parameters;
use gmapd::slam::hector;
use gmapd::slam::known_poses::{self, MapExtent};
use gmapd::slam::outline::{BeamLimits, FURTHEST_CELL};
use gmapd::slam::pose::{Point2, Pose2, Stamp};
use gmapd::slam::scan::{LaserMount, MountOrientation, ScanGeometry};
use gmapd::slam::update::{OdometryUpdate, ScanReport, ScanUpdate, SkipReason};

#[expect(dead_code, reason = "other tests use the rest")]
mod support;

use support::{Shot, full_circle, parameters, room, route, shots};

const CORNER: Point2 = Point2::new(0.0, 0.0);

/// Every engine, and its name.
fn engines() -> [(&'static str, EngineParameters); 3] {
    engines_with_cells(0.05)
}

/// The same with cells of `resolution` metres.
fn engines_with_cells(resolution: f64) -> [(&'static str, EngineParameters); 3] {
    let gmapping = Parameters { resolution, ..parameters() };
    let hector = hector::Parameters { resolution, ..hector::Parameters::default() };
    [
        ("gmapping", EngineParameters::GMapping(gmapping.clone(), 1)),
        ("hector", EngineParameters::Hector(hector)),
        ("known_poses", EngineParameters::KnownPoses(known_poses(&gmapping))),
    ]
}

fn known_poses(gmapping: &Parameters) -> known_poses::Parameters {
    known_poses::Parameters {
        resolution: gmapping.resolution,
        limits: BeamLimits {
            max_range: gmapping.max_range,
            max_usable_range: gmapping.max_usable_range,
            free_on_no_return: gmapping.map.free_on_no_return,
            furthest: FURTHEST_CELL * gmapping.resolution,
        },
        extent: MapExtent::AllScans,
        occupied_threshold: gmapping.map.occupied_threshold,
    }
}

/// Whether what comes as odometry is the pose in `map` already.
const fn is_told_poses(engine: &Engine) -> bool {
    matches!(engine, Engine::KnownPoses(_))
}

fn each_engine(check: impl Fn(&mut Engine)) {
    for (name, parameters) in engines() {
        println!("{name}");
        check(&mut Engine::new(parameters, 1).expect("no thread is started"));
    }
}

fn add(engine: &mut Engine, mount: &LaserMount, shot: &Shot) -> ScanUpdate {
    let Shot { scan, odom_from_base } = shot;
    let sweep = Sweep { scan, mount, odom_from_base: Some(*odom_from_base) };
    engine.add_scan(&sweep, &mut |_| ())
}

fn report(update: ScanUpdate) -> ScanReport {
    match update {
        ScanUpdate::Processed(report) => report,
        ScanUpdate::Skipped(reason) => panic!("skipped: {reason:?}"),
    }
}

fn drive(engine: &mut Engine, lidar: &Lidar, shots: &[Shot]) {
    for shot in shots {
        report(add(engine, &lidar.mount, shot));
    }
}

fn seen(lidar: &Lidar) -> Vec<Shot> {
    shots(&room(CORNER), lidar, &route(CORNER))
}

/// The path is the drive through the room at `corner`, and the map is that of the room.
fn assert_mapped(engine: &mut Engine, corner: Point2) {
    let path = engine.path();
    assert_eq!(path.len(), route(corner).len());
    for ((_, found), expected) in path.iter().zip(route(corner)) {
        let error = expected.between(found);
        let near = error.position().norm() < 0.05 && error.theta.abs() < 0.03;
        assert!(near, "{found:?} is not {expected:?}");
    }
    let grid = engine.occupancy_grid().expect("scans were processed");
    let world = room(corner);
    let (mut misplaced, mut occupied, mut free) = (0, 0, 0);
    for (index, value) in grid.cells.iter().enumerate() {
        let centre = |i: usize| (i as f64 + 0.5) * grid.resolution;
        let at = Point2::new(
            grid.origin.x + centre(index % grid.width),
            grid.origin.y + centre(index / grid.width),
        );
        free += usize::from(*value == 0);
        if *value == 100 {
            occupied += 1;
            misplaced += usize::from(world.clearance(at) > 2.0 * grid.resolution);
        }
    }
    assert!(misplaced * 50 <= occupied, "{misplaced} of {occupied} misplaced");
    let area = free as f64 * grid.resolution * grid.resolution;
    assert!((45.0..70.0).contains(&area), "{area} m2 are free");
}

#[test]
fn first_scan_is_processed_wherever_odometry_is_and_at_the_initial_pose() {
    let lidar = full_circle(360);
    let shot = &seen(&lidar)[0];
    each_engine(|engine| {
        report(add(engine, &lidar.mount, shot));
        assert_eq!(engine.pose_in_map(), shot.odom_from_base);
        assert_eq!(engine.hypotheses()[0], shot.odom_from_base);
        let initial = Pose2::new(5.0, -3.0, 1.0);
        engine.reset(Some(initial));
        assert!(!engine.has_begun() && engine.occupancy_grid().is_none());
        report(add(engine, &lidar.mount, shot));
        let begins = if is_told_poses(engine) { shot.odom_from_base } else { initial };
        assert_eq!(engine.pose_in_map(), begins);
    });
}

#[test]
fn a_scan_without_odometry_is_mapped_or_refused() {
    let lidar = full_circle(360);
    let Shot { scan, .. } = &seen(&lidar)[0];
    let sweep = Sweep { scan, mount: &lidar.mount, odom_from_base: None };
    each_engine(|engine| {
        let update = engine.add_scan(&sweep, &mut |_| ());
        if !matches!(engine, Engine::Hector(_)) {
            assert_eq!(update, ScanUpdate::Skipped(SkipReason::BadOdometry));
        } else {
            report(update);
            assert_eq!(engine.map_from_odom(), Pose2::IDENTITY);
        }
    });
}

#[test]
fn a_drive_is_mapped_and_twice_the_same() {
    let lidar = full_circle(360);
    let shots = seen(&lidar);
    for (name, parameters) in engines() {
        println!("{name}");
        let [mut a, mut b] = [parameters.clone(), parameters]
            .map(|parameters| Engine::new(parameters, 1).expect("no thread is started"));
        drive(&mut a, &lidar, &shots);
        drive(&mut b, &lidar, &shots);
        assert_mapped(&mut a, CORNER);
        assert_eq!(a.occupancy_grid(), b.occupancy_grid());
        assert_eq!(a.path(), b.path());
    }
}

#[test]
fn backwards_and_repeated_stamps_do_no_harm() {
    let lidar = full_circle(360);
    let mut shots = seen(&lidar);
    for (index, shot) in shots.iter_mut().enumerate() {
        shot.scan.stamp = Stamp(5_000_000_000 - (index as i64 / 2) * 100_000_000);
    }
    each_engine(|engine| {
        drive(engine, &lidar, &shots);
        assert_mapped(engine, CORNER);
    });
}

#[test]
fn zero_nan_infinite_negative_and_too_short_ranges_say_nothing() {
    let lidar = full_circle(360);
    let with = |reading: f32| {
        let mut shots = seen(&lidar);
        for range in shots.iter_mut().flat_map(|shot| shot.scan.ranges.iter_mut().step_by(5)) {
            *range = reading;
        }
        shots
    };
    for (name, parameters) in engines() {
        println!("{name}");
        let mapped = |reading| {
            let mut engine = Engine::new(parameters.clone(), 1).expect("no thread is started");
            drive(&mut engine, &lidar, &with(reading));
            assert_mapped(&mut engine, CORNER);
            engine.occupancy_grid()
        };
        let nan = mapped(f32::NAN);
        for reading in [0.0, -1.0, f32::NEG_INFINITY, 0.099, f32::INFINITY, 20.0, f32::MAX] {
            assert_eq!(mapped(reading), nan, "{reading}");
        }
    }
}

#[test]
fn an_all_invalid_or_empty_scan_is_told_and_changes_nothing() {
    let lidar = full_circle(360);
    let shots = seen(&lidar);
    each_engine(|engine| {
        let mut nothing = shots[8].clone();
        nothing.scan.ranges.fill(f32::NAN);
        let none = ScanUpdate::Skipped(SkipReason::NoUsableBeams);
        assert_eq!(add(engine, &lidar.mount, &nothing), none);
        drive(engine, &lidar, &shots[..8]);
        let before = (engine.occupancy_grid(), engine.path());
        assert_eq!(add(engine, &lidar.mount, &nothing), none);
        nothing.scan.ranges.clear();
        assert_eq!(add(engine, &lidar.mount, &nothing), none);
        assert_eq!((engine.occupancy_grid(), engine.path()), before);
        // The motion so far is not lost.
        drive(engine, &lidar, &shots[8..]);
        assert_mapped(engine, CORNER);
    });
}

#[test]
fn beam_counts_may_change_and_be_more_than_2047() {
    let lidars = [360, 361, 180, 2500, 7].map(full_circle);
    each_engine(|engine| {
        for (index, pose) in route(CORNER).iter().enumerate() {
            let lidar = &lidars[if index == 10 { 4 } else { index % 4 }];
            let shot = &shots(&room(CORNER), lidar, &[*pose])[0];
            assert_eq!(report(add(engine, &lidar.mount, shot)).hits, lidar.beams);
        }
        assert_mapped(engine, CORNER);
    });
}

#[test]
fn clockwise_and_upside_down_lasers_map_the_same_room() {
    let geometry = |angles| ScanGeometry::new(angles, 0.02, [0.1, 20.0]).expect("it is valid");
    let lidar = Lidar { beams: 311, geometry: geometry([-3.1, 3.1]), ..full_circle(311) };
    let reversed = |geometry: ScanGeometry| {
        let mut shots = seen(&lidar);
        for Shot { scan, .. } in &mut shots {
            scan.ranges.reverse();
            scan.geometry = geometry;
        }
        shots
    };
    let mount = LaserMount { orientation: MountOrientation::UpsideDown, ..lidar.mount };
    let upside_down = Lidar { mount, ..lidar.clone() };
    each_engine(|engine| {
        drive(engine, &lidar, &reversed(geometry([3.1, -3.1])));
        assert_mapped(engine, CORNER);
        engine.reset(None);
        drive(engine, &upside_down, &reversed(lidar.geometry));
        assert_mapped(engine, CORNER);
    });
}

#[test]
fn a_full_turn_is_mapped_with_and_without_its_first_beam_twice() {
    let once = full_circle(360);
    let geometry = |last: f64| {
        let increment = std::f64::consts::TAU / 360.0;
        ScanGeometry::new([0.0, last * increment], increment, [0.1, 20.0]).expect("it is valid")
    };
    for beams in [360, 361] {
        let lidar = Lidar { beams, geometry: geometry(beams as f64 - 1.0), ..once.clone() };
        each_engine(|engine| {
            drive(engine, &lidar, &seen(&lidar));
            assert_mapped(engine, CORNER);
        });
    }
}

#[test]
fn cells_that_divide_no_length_map_the_same_room() {
    let lidar = full_circle(360);
    for (name, parameters) in engines_with_cells(0.0437) {
        println!("{name}");
        let mut engine = Engine::new(parameters, 1).expect("no thread is started");
        drive(&mut engine, &lidar, &seen(&lidar));
        assert_mapped(&mut engine, CORNER);
    }
}

#[test]
fn an_engine_after_a_reset_is_as_a_new_one() {
    let lidar = full_circle(360);
    let shots = seen(&lidar);
    for (name, parameters) in engines() {
        println!("{name}");
        let [mut new, mut used] = [parameters.clone(), parameters]
            .map(|parameters| Engine::new(parameters, 1).expect("no thread is started"));
        drive(&mut used, &lidar, &shots[6..15]);
        used.reset(None);
        for engine in [&mut new, &mut used] {
            drive(engine, &lidar, &shots);
        }
        assert_eq!(new.state(), used.state());
        assert_eq!(new.occupancy_grid(), used.occupancy_grid());
    }
}

#[test]
fn far_away_and_on_each_side_of_the_origin_the_map_is_the_same() {
    let lidar = full_circle(360);
    for (x, y) in [(-104.0, 0.0), (104.0, 0.0), (0.0, 97.0), (0.0, -97.0), (1e5, -1e5)] {
        let corner = Point2::new(x, y);
        let shots = shots(&room(corner), &lidar, &route(corner));
        each_engine(|engine| {
            drive(engine, &lidar, &shots);
            assert_mapped(engine, corner);
        });
    }
}

#[test]
fn odometry_that_is_no_number_is_refused_and_a_jump_is_rejected() {
    let lidar = full_circle(360);
    let mut shots = seen(&lidar);
    for shot in &mut shots[12..] {
        shot.odom_from_base.x += 25.0;
    }
    each_engine(|engine| {
        drive(engine, &lidar, &shots[..12]);
        let mut bad = shots[12].clone();
        bad.odom_from_base.y = f64::NAN;
        let refused = ScanUpdate::Skipped(SkipReason::BadOdometry);
        assert_eq!(add(engine, &lidar.mount, &bad), refused);
        let at = shots[12].odom_from_base;
        if is_told_poses(engine) {
            // A pose that is known may jump: a loop was closed.
            assert_eq!(engine.add_odometry(at), OdometryUpdate::Accepted);
            drive(engine, &lidar, &shots[12..]);
            assert_eq!(engine.pose_in_map(), shots[23].odom_from_base);
            return;
        }
        assert_eq!(engine.add_odometry(at), OdometryUpdate::JumpRejected);
        for shot in &shots[12..] {
            add(engine, &lidar.mount, shot);
        }
        let error = route(CORNER)[23].between(engine.pose_in_map());
        assert!(error.position().norm() < 0.05, "{error:?}");
    });
}

#[test]
fn a_robot_that_stands_still_does_not_wander() {
    let lidar = full_circle(360);
    let shot = &seen(&lidar)[0];
    each_engine(|engine| {
        for index in 0..50 {
            let mut shot = shot.clone();
            shot.scan.stamp = Stamp(1_000_000_000 + index * 100_000_000);
            add(engine, &lidar.mount, &shot);
        }
        let error = shot.odom_from_base.between(engine.pose_in_map());
        assert!(error.position().norm() < 0.01 && error.theta.abs() < 0.005, "{error:?}");
    });
}
