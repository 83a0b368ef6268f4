//! Laws of Hector's matching and of its maps, and what it makes of corridors and of no odometry.

use gmapd::sim::lidar::Lidar;
use gmapd::sim::{Place, Scenario, Simulation};
use gmapd::slam::engine::Sweep;
use gmapd::slam::grid::footprint::Footprint;
use gmapd::slam::grid::log_odds::{CLAMP, Evidence, LogOdds, LogOddsMap, Probabilities};
use gmapd::slam::hector::correlation::Search;
use gmapd::slam::hector::gauss_newton::Level;
use gmapd::slam::hector::matcher;
use gmapd::slam::hector::prediction::Prediction;
use gmapd::slam::hector::prepared_scan::{Directions, PreparedScan};
use gmapd::slam::hector::pyramid::Pyramid;
use gmapd::slam::hector::{Hector, Parameters};
use gmapd::slam::pose::{Point2, Pose2, Stamp, wrap_angle};
use gmapd::slam::scan::{Scan, ScanGeometry};
use gmapd::slam::update::{ScanReport, ScanUpdate};
use nalgebra::{Matrix3, Vector3};
use proptest::collection::vec;
use proptest::prelude::{any, prop_assert, proptest};
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

#[expect(dead_code, reason = "other tests use the rest")]
mod support;

use support::{full_circle, room, route, shots};

const CORNER: Point2 = Point2::new(0.0, 0.0);

fn evidence() -> Evidence {
    Evidence { free: LogOdds::of_probability(0.4), occupied: LogOdds::of_probability(0.9) }
}

proptest! {
    #[test]
    fn the_update_is_bayes_rule(occupied in vec(any::<bool>(), 0..60)) {
        let table = Probabilities::default();
        let (mut log_odds, mut odds) = (LogOdds::default(), 1.0_f64);
        for hit in occupied {
            let p = if hit { 0.9 } else { 0.4 };
            log_odds = log_odds.and(if hit { evidence().occupied } else { evidence().free });
            odds = (odds * p / (1.0 - p)).clamp((-CLAMP).exp(), CLAMP.exp());
            let expected = odds / (1.0 + odds);
            prop_assert!((f64::from(table.of(log_odds)) - expected).abs() < 2e-3);
            prop_assert!((log_odds.nats() - odds.ln()).abs() < 0.01);
        }
    }

    /// The occupancy is bilinear between centres of cells; there, derivatives are exact.
    #[test]
    fn analytic_gradients_are_numeric_ones(
        column in 0..40_i32,
        row in 0..40_i32,
        fraction in [0.1..0.9_f64, 0.1..0.9_f64],
        theta in -3.0..3.0_f64,
        reach in 0.0..60.0_f64,
    ) {
        let (map, table) = (drawn_map(), Probabilities::default());
        let (sin, cos) = theta.sin_cos();
        // The point lies at a place that is not near the centre line of a cell, cells.
        let at = [f64::from(column) + 0.5 + fraction[0], f64::from(row) + 0.5 + fraction[1]];
        let pose = |x: f64, y: f64, theta: f64| Pose2::new(x * 0.05, y * 0.05, theta);
        let base = [at[0] - cos * reach, at[1] - sin * reach];
        let near = pose(base[0], base[1], theta);
        let level = Level::new(&map, &table, vec![[reach as f32, 0.0]], (near, reach * 0.05 + 1.0));
        let fit = level.fit(near);
        let cost = |x, y, theta| level.fit(pose(x, y, theta)).cost;
        let h = 0.02;
        let turn = h / reach.max(1.0);
        let numeric = Vector3::new(
            (cost(base[0] + h, base[1], theta) - cost(base[0] - h, base[1], theta)) / (h * 0.1),
            (cost(base[0], base[1] + h, theta) - cost(base[0], base[1] - h, theta)) / (h * 0.1),
            (cost(base[0], base[1], theta + turn) - cost(base[0], base[1], theta - turn))
                / (2.0 * turn),
        );
        let analytic = -2.0 * fit.descent;
        for axis in 0..3 {
            let scale = if axis == 2 { reach.max(1.0) } else { 20.0 };
            let error = (analytic[axis] - numeric[axis]).abs() / scale;
            prop_assert!(error < 2e-3, "{analytic} {numeric}");
        }
    }
}

/// A room whose walls are not along the axes, seen once.
fn drawn_map() -> LogOddsMap {
    let mut map = LogOddsMap::new(0.05);
    let parameters = Parameters { min_range: 0.0, ..Parameters::default() };
    let lidar = full_circle(720);
    let ranges = (0..720).map(|i| 0.7 + 0.3 * (f64::from(i) * 0.05).sin() as f32).collect();
    let scan = Scan { stamp: Stamp(0), geometry: lidar.geometry, ranges };
    let scan = Directions::default().prepare(&scan, &lidar.mount, &parameters);
    let mut footprint = Footprint::default();
    map.add(footprint.of(&scan.outline, Pose2::new(1.0, 1.0, 0.3), 0.05), evidence());
    map
}

fn gaussian(rng: &mut ChaCha8Rng) -> f64 {
    let (u, v): (f64, f64) = (rng.random::<f64>().max(1e-12), rng.random());
    (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

fn look(lidar: &Lidar, at: Pose2, parameters: &Parameters, rng: &mut ChaCha8Rng) -> PreparedScan {
    let ranges = lidar.sweep(&room(CORNER), |_| at, 0.0, rng);
    let scan = Scan { stamp: Stamp(0), geometry: lidar.geometry, ranges };
    Directions::default().prepare(&scan, &lidar.mount, parameters)
}

/// The mean of the squared errors, normalized by the covariance, of 500 scans placed from guesses
/// 10 cm and 0.1 rad off (one standard deviation each way), and how many ended near the truth.
fn trials(parameters: &Parameters, noise: f64) -> (f64, u32) {
    let lidar = Lidar { range_noise_std: noise, ..Lidar::full_circle(360).expect("beams") };
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let mut pyramid = Pyramid::new(parameters);
    let (mut sum, mut near) = (0.0, 0);
    for trial in 0..500 {
        if trial % 25 == 0 {
            pyramid = Pyramid::new(parameters);
            for pose in route(CORNER) {
                pyramid.add(&look(&lidar, pose, parameters, &mut rng), pose, |_| ());
            }
        }
        let on_the_way = route(CORNER)[rng.random_range(0..24)];
        let beside = [0.1, 0.1, 0.3].map(|deviation| deviation * gaussian(&mut rng));
        let truth = on_the_way * Pose2::new(beside[0], beside[1], beside[2]);
        let scan = look(&lidar, truth, parameters, &mut rng);
        let [x, y, theta] = [(); 3].map(|()| 0.1 * gaussian(&mut rng));
        let pose_in_map = Pose2::new(truth.x + x, truth.y + y, truth.theta + theta);
        let prediction = Prediction { pose_in_map, covariance: Matrix3::identity() * 0.01 };
        let placed = matcher::place(&pyramid, &scan, &prediction, 1.0);
        let found = placed.pose_in_map;
        let turned = wrap_angle(found.theta - truth.theta);
        let error = Vector3::new(found.x - truth.x, found.y - truth.y, turned);
        let information = placed.covariance.try_inverse().expect("it is positive");
        sum += error.dot(&(information * error));
        near += u32::from(error.xy().norm() < 0.05 && turned.abs() < 0.02);
    }
    (sum / 500.0, near)
}

#[test]
fn displaced_scans_are_recovered_and_the_covariance_is_that_of_the_errors() {
    // 95 % of such means of 500 with three degrees of freedom lie here.
    let bounds = 2.785..3.215;
    for (resolution, noise) in [(0.025, 0.01), (0.05, 0.03)] {
        let parameters = Parameters { resolution, ..Parameters::default() };
        let (mean, near) = trials(&parameters, noise);
        println!("{resolution} m cells, {noise} m noise: mean {mean:.3}, {near} of 500");
        assert!(near >= 498, "{near} of 500 are near the truth");
        assert!(bounds.contains(&mean), "the mean is {mean}");
    }
}

/// Where a scan contradicts the map, the edge of what is known is no better: all that lies beyond
/// scores 0.75, wherever the robot is.
#[test]
fn a_scan_that_contradicts_is_not_moved_to_where_nothing_is_known() {
    let parameters = Parameters { max_range: 3.0, ..Parameters::default() };
    let lidar = full_circle(360);
    let mut directions = Directions::default();
    let mut scan = |range: fn(usize) -> f32| {
        let ranges = (0..360).map(range).collect();
        let scan = Scan { stamp: Stamp(0), geometry: lidar.geometry, ranges };
        directions.prepare(&scan, &lidar.mount, &parameters)
    };
    let nothing_near = scan(|_| 5.0);
    let something_ahead = scan(|beam| if (160..200).contains(&beam) { 2.0 } else { 5.0 });
    let mut pyramid = Pyramid::new(&parameters);
    for _ in 0..20 {
        pyramid.add(&nothing_near, Pose2::IDENTITY, |_| ());
    }
    let here = Prediction::within(Pose2::IDENTITY, [0.05, 0.02]);
    for expected in [0.5, 0.9] {
        let placed = matcher::place(&pyramid, &something_ahead, &here, expected);
        assert_eq!((placed.matched, placed.pose_in_map), (false, Pose2::IDENTITY));
    }
}

fn report(update: ScanUpdate) -> ScanReport {
    match update {
        ScanUpdate::Processed(report) => report,
        ScanUpdate::Skipped(reason) => panic!("skipped: {reason:?}"),
    }
}

/// Whether the engine hears of odometry.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Odometry {
    Used,
    None,
}

/// Where the robot is believed and truly is at the far end of the corridor, and the reports of
/// scans that see neither end.
fn corridor(odometry: Odometry, seed: u64) -> (f64, f64, Vec<ScanReport>) {
    let simulation = Simulation::new(&Scenario::new(Place::Corridor, seed)).expect("beams");
    // Neither end is seen from more than 10 m away.
    let mut hector = Hector::new(Parameters { max_range: 10.0, ..Parameters::default() });
    let (mut far, mut believed, mut amid) = (0.0, 0.0, Vec::new());
    for reading in simulation.readings() {
        let odom_from_base = (odometry == Odometry::Used).then_some(reading.odom_from_base);
        let mount = &simulation.lidar.mount;
        let sweep = Sweep { scan: &reading.scan, mount, odom_from_base };
        let report = report(hector.add_scan(&sweep, &mut |_| ()));
        let x = reading.world_from_base.x;
        if (10.0..46.0).contains(&x) {
            amid.push(report);
        }
        if x > far {
            (far, believed) = (x, hector.pose_in_map().x);
        }
    }
    (far, believed, amid)
}

#[test]
fn along_a_plain_corridor_odometry_decides_and_the_direction_is_told() {
    for seed in [1, 2, 3] {
        let (far, believed, amid) = corridor(Odometry::Used, seed);
        println!("{believed} m of {far} m");
        assert!((believed - far).abs() < 0.01 * far, "seed {seed}: {believed} m of {far} m");
        assert!(amid.len() > 100, "{} scans see neither end", amid.len());
        let weak: Vec<_> = amid.iter().filter_map(|report| report.weak_direction).collect();
        println!("seed {seed}: {} of {} scans leave it open", weak.len(), amid.len());
        assert!(weak.iter().all(|weak| weak.x.abs() > 0.99), "seed {seed}: {weak:?}");
        // Wild ranges may look like a wall across.
        assert!(weak.len() * 100 >= amid.len() * 99, "{} of {}", weak.len(), amid.len());
    }
}

#[test]
fn without_odometry_the_corridors_direction_is_told_all_the_same() {
    let (_, _, amid) = corridor(Odometry::None, 1);
    assert!(amid.len() > 100 && amid.iter().all(|report| report.weak_direction.is_some()));
}

/// Stamps say nothing then of how far the robot may have got.
#[test]
fn without_odometry_backwards_and_repeated_stamps_do_no_harm() {
    let lidar = full_circle(360);
    let mut hector = Hector::new(Parameters::default());
    hector.set_pose(route(CORNER)[0]);
    for (index, mut shot) in (0..).zip(shots(&room(CORNER), &lidar, &route(CORNER))) {
        shot.scan.stamp = Stamp(5_000_000_000 - (index / 2) * 100_000_000);
        let sweep = Sweep { scan: &shot.scan, mount: &lidar.mount, odom_from_base: None };
        report(hector.add_scan(&sweep, &mut |_| ()));
        let error = shot.odom_from_base.between(hector.pose_in_map());
        assert!(error.position().norm() < 0.05 && error.theta.abs() < 0.02, "{index}: {error:?}");
    }
}

/// Whoever points at a map is off by a hand's breadth.
#[test]
fn a_pose_that_is_set_is_doubted_and_two_scans_find_the_true_one() {
    let lidar = full_circle(360);
    let drive = shots(&room(CORNER), &lidar, &route(CORNER));
    for beside in [Pose2::new(0.3, 0.0, 0.2), Pose2::new(0.0, -0.3, -0.2)] {
        let mut hector = Hector::new(Parameters::default());
        for (index, shot) in drive.iter().enumerate().take(14) {
            if index == 12 {
                hector.set_pose(drive[11].odom_from_base * beside);
                let covariance = hector.covariance();
                assert!(covariance[(0, 0)] >= 0.01 && covariance[(2, 2)] >= 0.0025, "{covariance}");
            }
            let odom_from_base = Some(shot.odom_from_base);
            let sweep = Sweep { scan: &shot.scan, mount: &lidar.mount, odom_from_base };
            assert_eq!(report(hector.add_scan(&sweep, &mut |_| ())).matched, 1);
        }
        let error = drive[13].odom_from_base.between(hector.pose_in_map());
        assert!(error.position().norm() < 0.03 && error.theta.abs() < 0.01, "{error:?}");
    }
}

#[test]
fn a_room_leaves_nothing_open_and_is_mapped_without_odometry() {
    let lidar = full_circle(360);
    let mut hector = Hector::new(Parameters::default());
    hector.set_pose(route(CORNER)[0]);
    for shot in shots(&room(CORNER), &lidar, &route(CORNER)) {
        let sweep = Sweep { scan: &shot.scan, mount: &lidar.mount, odom_from_base: None };
        let report = report(hector.add_scan(&sweep, &mut |_| ()));
        assert_eq!(report.weak_direction, None);
        let error = shot.odom_from_base.between(hector.pose_in_map());
        assert!(error.position().norm() < 0.05 && error.theta.abs() < 0.02, "{error:?}");
    }
}

/// Mean squared error of the motion in a second, m² and rad², of a robot that turns while its laser
/// does; without odometry, and with beams that are told to be so far apart in time, s.
fn squared_errors(time_increment: impl Fn(&ScanGeometry) -> f64) -> [f64; 2] {
    let mut simulation = Simulation::new(&Scenario::new(Place::Building, 1)).expect("beams");
    simulation.scan_period_ns = 100_000_000;
    simulation.lidar.sweep_duration_s = 0.1;
    let mount = simulation.lidar.mount;
    let mut hector = Hector::new(Parameters::default());
    let mut poses = Vec::new();
    for mut reading in simulation.readings().take(600) {
        let geometry = &mut reading.scan.geometry;
        *geometry = geometry.with_time_increment(time_increment(geometry));
        let sweep = Sweep { scan: &reading.scan, mount: &mount, odom_from_base: None };
        report(hector.add_scan(&sweep, &mut |_| ()));
        poses.push((reading.world_from_base, hector.pose_in_map()));
    }
    let errors: Vec<Pose2> = poses
        .iter()
        .zip(&poses[10..])
        .map(|(then, now)| then.0.between(now.0).between(then.1.between(now.1)))
        .collect();
    let mean =
        |square: fn(&Pose2) -> f64| errors.iter().map(square).sum::<f64>() / errors.len() as f64;
    [mean(|error| error.position().norm().powi(2)), mean(|error| error.theta.powi(2))]
}

#[test]
fn without_odometry_a_sweep_is_deskewed_by_the_motion_so_far() {
    let raw = squared_errors(|_| 0.0);
    let deskewed = squared_errors(ScanGeometry::time_increment);
    println!("{raw:?} as taken, {deskewed:?} deskewed");
    assert!(deskewed[0] < 0.7 * raw[0] && deskewed[1] < 0.5 * raw[1], "{raw:?} {deskewed:?}");
}

#[test]
fn scans_enter_the_map_only_after_enough_motion_and_move_the_pose_before() {
    let lidar = full_circle(360);
    let mut hector = Hector::new(Parameters::default());
    let registered: Vec<bool> = shots(&room(CORNER), &lidar, &route(CORNER)[..4])
        .iter()
        .map(|shot| {
            let odom_from_base = Some(shot.odom_from_base);
            let sweep = Sweep { scan: &shot.scan, mount: &lidar.mount, odom_from_base };
            report(hector.add_scan(&sweep, &mut |_| ())).registered
        })
        .collect();
    // The robot moves by 0.3 m from scan to scan, and 0.4 m is enough.
    assert_eq!(registered, [true, false, true, false]);
    assert_eq!(hector.path().len(), 4);
}

/// A tour of the room without odometry, ten scans a second, and what comes after it.
fn toured() -> (Hector, Vec<Pose2>, Stamp) {
    let lidar = full_circle(360);
    let mut hector = Hector::new(Parameters::default());
    let poses = route(CORNER);
    hector.set_pose(poses[0]);
    let mut stamp = Stamp(0);
    for shot in shots(&room(CORNER), &lidar, &poses) {
        stamp = shot.scan.stamp;
        let sweep = Sweep { scan: &shot.scan, mount: &lidar.mount, odom_from_base: None };
        report(hector.add_scan(&sweep, &mut |_| ()));
    }
    (hector, poses, stamp)
}

/// The robot stands still, and then was moved by `away`, while a tenth of a second passed.
fn after_a_jolt(away: Pose2) -> (ScanReport, Pose2) {
    let lidar = full_circle(360);
    let (mut hector, poses, start) = toured();
    let stands = *poses.last().expect("the tour has poses");
    let truths = [stands, stands, stands, stands * away];
    let mut last = None;
    for (step, shot) in (1..).zip(shots(&room(CORNER), &lidar, &truths)) {
        let scan = Scan { stamp: Stamp(start.0 + step * 100_000_000), ..shot.scan };
        let sweep = Sweep { scan: &scan, mount: &lidar.mount, odom_from_base: None };
        last = Some(report(hector.add_scan(&sweep, &mut |_| ())));
    }
    (last.expect("four scans"), (stands * away).between(hector.pose_in_map()))
}

#[test]
fn without_odometry_a_jolt_does_not_lose_the_robot() {
    for away in [Pose2::new(0.5, -0.3, 0.7), Pose2::new(-0.4, 0.4, -0.6)] {
        let (report, error) = after_a_jolt(away);
        assert_eq!(report.matched, 1);
        assert!(error.position().norm() < 0.05 && error.theta.abs() < 0.02, "{error:?}");
    }
}

#[test]
fn a_scan_that_fits_nowhere_does_not_enter_the_map() {
    let lidar = full_circle(360);
    let (mut hector, poses, start) = toured();
    let before = hector.occupancy().clone();
    let stands = *poses.last().expect("the tour has poses");
    let [good] = shots(&room(CORNER), &lidar, &[stands]).try_into().expect("one scan");
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    for step in 1..=10 {
        let stamp = Stamp(start.0 + step * 100_000_000);
        let ranges = (0..360).map(|_| rng.random_range(0.5..1.5)).collect();
        let scan = Scan { stamp, geometry: lidar.geometry, ranges };
        let sweep = Sweep { scan: &scan, mount: &lidar.mount, odom_from_base: None };
        let report = report(hector.add_scan(&sweep, &mut |_| ()));
        assert_eq!((report.matched, report.registered), (0, false));
    }
    assert_eq!(hector.occupancy().counts().tiles().count(), before.counts().tiles().count());
    for (key, tile) in before.counts().tiles() {
        assert_eq!(hector.occupancy().counts().tile(key), Some(tile));
    }
    let scan = Scan { stamp: Stamp(start.0 + 1_100_000_000), ..good.scan };
    let sweep = Sweep { scan: &scan, mount: &lidar.mount, odom_from_base: None };
    assert_eq!(report(hector.add_scan(&sweep, &mut |_| ())).matched, 1);
    let error = stands.between(hector.pose_in_map());
    assert!(error.position().norm() < 0.05 && error.theta.abs() < 0.02, "{error:?}");
}

/// What a pose is worth to a search: the scan's probabilities, less the prior's cost.
fn likelihood(search: &Search<'_>, pose: Pose2) -> f64 {
    let [x, y] = search.level.in_window(pose);
    let (sin, cos) = libm::sincos(pose.theta);
    let probability = |&[px, py]: &[f32; 2]| {
        let (px, py) = (f64::from(px), f64::from(py));
        let (column, row) = (x + cos * px - sin * py, y + sin * px + cos * py);
        f64::from(search.level.probability(column.floor() as i32, row.floor() as i32))
    };
    let mean = search.prior.pose_in_map;
    let d = Vector3::new(pose.x - mean.x, pose.y - mean.y, wrap_angle(pose.theta - mean.theta));
    let sum: f64 = search.level.points().iter().map(probability).sum();
    search.gain * sum - 0.5 * d.dot(&(search.prior.information * d))
}

#[test]
fn the_search_finds_what_trying_every_pose_finds() {
    let (parameters, lidar) = (Parameters::default(), full_circle(120));
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let mut pyramid = Pyramid::new(&parameters);
    let poses = route(CORNER);
    for &pose in &poses {
        pyramid.add(&look(&lidar, pose, &parameters, &mut rng), pose, |_| ());
    }
    for truth in [poses[3], poses[14]] {
        let scan = look(&lidar, truth, &parameters, &mut rng);
        let pose_in_map = truth * Pose2::new(0.33, -0.21, 0.17);
        let level = pyramid.levels(&scan, pose_in_map).next().expect("the coarsest");
        let lever = matcher::lever(&scan.hits);
        let deviations = [0.2, 0.1];
        let covariance = Matrix3::from_diagonal(&Vector3::new(0.04, 0.04, 0.01));
        let prior = Prediction { pose_in_map, covariance }.prior().expect("it has an inverse");
        let search = Search { level: &level, prior: &prior, deviations, lever, gain: 1.0 };
        let (cell, angle) = (level.resolution(), level.resolution() / lever);
        let turns = (0.3 / angle) as i32;
        let best = (-turns..=turns)
            .flat_map(|turn| (-6..=6).flat_map(move |y| (-6..=6).map(move |x| (x, y, turn))))
            .map(|(x, y, turn)| {
                let moved = [x, y].map(|cells| f64::from(cells) * cell);
                let theta = wrap_angle(pose_in_map.theta + f64::from(turn) * angle);
                let pose = Pose2::new(pose_in_map.x + moved[0], pose_in_map.y + moved[1], theta);
                likelihood(&search, pose)
            })
            .fold(f64::NEG_INFINITY, f64::max);
        let found = likelihood(&search, search.run());
        assert!((found - best).abs() < 1e-3, "{found} was found, and the best is {best}");
    }
}
