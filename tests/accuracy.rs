//! How accurate the maps are: bounds that hold with a margin and that a regression breaks.
//!
//! Simulated runs are compared with the truth. Recorded logs are replayed where they are: in
//! `../shared/data` beside the project, or where the environment variable `GMAPD_LOGS` says.

use std::path::PathBuf;

use gmapd::config::Config;
use gmapd::evaluation::{
    Alignment, StampedPose, absolute_errors, read_relations, relation_errors, revisit_agreement,
};
use gmapd::given_poses::GivenPoses;
use gmapd::logs::Reading;
use gmapd::logs::carmen::CarmenLog;
use gmapd::replay::{Outcome, Replay, Verdict};
use gmapd::sim::{Place, Scenario, Simulation};
use gmapd::slam::gmapping::prepared_scan::PreparedScan;
use gmapd::slam::gmapping::{GMapping, ScanReading, ScanUpdate};
use gmapd::slam::grid::occupancy::BeamEndKind;
use gmapd::slam::pose::{Point2, Pose2};
use gmapd::slam::scan::Beam;

/// The true pose and the one the filter ends up with, at each processed scan.
struct Drive {
    truth: Vec<StampedPose>,
    estimate: Vec<StampedPose>,
}

fn drive(simulation: &Simulation, particles: usize, seed: u64) -> Drive {
    let config = Config::load(None, &[format!("particles={particles}")]).expect("it is valid");
    let mut filter = GMapping::new(config.parameters(), seed, 1).expect("it needs no thread");
    let mut truth = Vec::new();
    for reading in simulation.readings() {
        let scan = ScanReading {
            scan: &reading.scan,
            mount: &simulation.lidar.mount,
            odom_from_base: reading.odom_from_base,
        };
        if let ScanUpdate::Processed(_) = filter.add_scan(&scan, &mut |_| ()) {
            truth.push(StampedPose { stamp: reading.stamp, pose: reading.world_from_base });
        }
    }
    let path = filter.path();
    Drive {
        truth,
        estimate: path.iter().map(|(stamp, pose)| StampedPose { stamp, pose }).collect(),
    }
}

impl Drive {
    /// Mean distance from the truth, m.
    fn absolute_error(&self) -> f64 {
        let errors = absolute_errors(&self.estimate, &self.truth, Alignment::None);
        errors.expect("there is a pose for each")[0].mean
    }

    /// Mean error of the motion from one processed scan to the next, m.
    fn step_error(&self) -> f64 {
        let steps = self.estimate.windows(2).zip(self.truth.windows(2));
        let error = |(found, truth): (&[StampedPose], &[StampedPose])| {
            let [found, truth] = [found, truth].map(|pair| pair[0].pose.between(pair[1].pose));
            truth.between(found).position().norm()
        };
        steps.map(error).sum::<f64>() / (self.truth.len() - 1) as f64
    }

    /// Distance of the last pose from the truth, m.
    fn final_error(&self) -> f64 {
        let last = |poses: &[StampedPose]| poses.last().expect("scans were processed").pose;
        last(&self.truth).between(last(&self.estimate)).position().norm()
    }
}

#[test]
fn a_building_is_mapped_to_a_few_centimetres() {
    let seeds = [1, 2, 3];
    let drives = seeds.map(|seed| {
        let scenario = Scenario::new(Place::Building, seed);
        drive(&Simulation::new(&scenario).expect("it is valid"), 30, seed)
    });
    let mean = |of: fn(&Drive) -> f64| drives.iter().map(of).sum::<f64>() / drives.len() as f64;
    let (absolute, step) = (mean(Drive::absolute_error), mean(Drive::step_error));
    eprintln!("building: {absolute:.4} m absolute, {step:.4} m a step");
    assert!(absolute < 0.05, "{absolute} m");
    assert!(step < 0.008, "{step} m");
}

#[test]
fn a_ring_of_260_m_closes_with_twice_the_noise_of_odometry() {
    for seed in [1, 2, 3] {
        let scenario = Scenario::new(Place::Ring, seed);
        let mut simulation = Simulation::new(&scenario).expect("it is valid");
        simulation.odometry.factor = 2.0;
        let drive = drive(&simulation, 100, seed);
        eprintln!("ring {seed}: {:.3} m at the end", drive.final_error());
        assert!(drive.final_error() < 0.2, "seed {seed}: {} m", drive.final_error());
    }
}

/// The path of a recorded log, if the logs are here.
fn recorded(name: &str) -> Option<PathBuf> {
    let beside = concat!(env!("CARGO_MANIFEST_DIR"), "/../shared/data");
    let directory = std::env::var_os("GMAPD_LOGS").map_or_else(|| beside.into(), PathBuf::from);
    let path = directory.join(name);
    if path.exists() {
        return Some(path);
    }
    eprintln!("NOT RUN: no recorded log {}", path.display());
    None
}

fn config(overrides: &[&str]) -> Config {
    let overrides: Vec<String> = overrides.iter().map(|text| (*text).to_owned()).collect();
    Config::load(None, &overrides).expect("the overrides are valid")
}

fn replay(log: &CarmenLog, config: &Config) -> Outcome {
    let mut replay = Replay::new(config, 1).expect("it needs no thread");
    for reading in log.readings().expect("it opened before") {
        replay.add(&reading.expect("it can be read to its end"));
    }
    replay.finish()
}

#[test]
fn intel_is_as_accurate_as_the_original_or_better() {
    let (Some(log), Some(relations)) =
        (recorded("intel/intel.log"), recorded("intel/intel.relations"))
    else {
        return;
    };
    let log = CarmenLog::open(&log).expect("it is a log");
    let relations = read_relations(&relations).expect("they are relations");
    let errors = ["seed=1", "seed=2", "seed=3"].map(|seed| {
        let outcome = replay(&log, &config(&["particles=30", "maxUrange=40", seed]));
        let report = relation_errors(&outcome.trajectory, &relations);
        assert_eq!((report.used, report.skipped.len()), (2984, 0));
        let mean = [report.translation_m, report.rotation_deg].map(|s| s.expect("some used").mean);
        eprintln!("intel {seed}: {:.4} m, {:.3} degrees", mean[0], mean[1]);
        mean
    });
    let mean = |axis: usize| errors.iter().map(|mean| mean[axis]).sum::<f64>() / 3.0;
    assert!(mean(0) <= 0.039, "{} m", mean(0));
    assert!(mean(1) <= 1.84, "{} degrees", mean(1));
}

/// Published for scan matching with odometry on this log: 0.220 m.
#[test]
fn hector_maps_intel_with_odometry_and_without() {
    let Some(relations) = recorded("intel/intel.relations") else { return };
    let relations = read_relations(&relations).expect("they are relations");
    // The stamps of the log of every scan are interpolated, so that not all relations find theirs.
    for (log, odometry, cell, least_used) in [
        ("intel/intel.log", "odometry_source=auto", 0.05, 2984),
        ("intel/intel-all-scans.log", "odometry_source=none", 0.05, 1000),
        ("intel/intel-all-scans.log", "odometry_source=none", 0.025, 1000),
    ] {
        let Some(log) = recorded(log) else { return };
        let log = CarmenLog::open(&log).expect("it is a log");
        let cell = format!("map_resolution={cell}");
        let overrides = ["engine=hector", &cell, "maxUrange=40", odometry];
        let outcome = replay(&log, &config(&overrides));
        let report = relation_errors(&outcome.trajectory, &relations);
        assert!(report.used >= least_used, "{} relations", report.used);
        let error = report.translation_m.expect("some used").mean;
        eprintln!("intel, {odometry}, {cell}: {error:.4} m");
        assert!(error < 0.22, "{odometry}, {cell}: {error} m");
    }
}

/// With the cells that it has if nobody says otherwise. Where a scan contradicts the map, it is the
/// start pose that decides what is taken for a match, so there are several, each of which puts the
/// cells elsewhere.
#[test]
fn hector_maps_intel_in_fine_cells_from_any_pose() {
    let (Some(log), Some(relations)) =
        (recorded("intel/intel.log"), recorded("intel/intel.relations"))
    else {
        return;
    };
    let relations = read_relations(&relations).expect("they are relations");
    let log = CarmenLog::open(&log).expect("it is a log");
    for step in (0..60).step_by(5).map(f64::from) {
        let [x, y, theta] = [0.0031 * step, -0.0017 * step, 0.02 * step];
        let start = format!("initial_pose=[{x}, {y}, {theta}]");
        let outcome = replay(&log, &config(&["engine=hector", &start]));
        let report = relation_errors(&outcome.trajectory, &relations);
        assert_eq!(report.used, 2984);
        let error = report.translation_m.expect("some used").mean;
        eprintln!("intel in cells of 2.5 cm, {start}: {error:.4} m");
        assert!(error < 0.1, "{start}: {error} m");
    }
}

/// Mean and worst difference of the motion in 20 scans, about two seconds, from odometry's, m.
fn motion_errors(log: &CarmenLog, config: &Config) -> [f64; 2] {
    let mut replay = Replay::new(config, 1).expect("it needs no thread");
    let mut odometry = Vec::new();
    for reading in log.readings().expect("it opened before") {
        let reading = reading.expect("it can be read to its end");
        if replay.add(&reading) == Verdict::Processed {
            odometry.push(reading.odom_from_base);
        }
    }
    let path: Vec<Pose2> = replay.finish().path.iter().map(|(_, pose)| pose).collect();
    assert!(path.len() == odometry.len() && path.len() > 700, "{} scans", path.len());
    let found = path.iter().zip(&path[20..]).map(|(a, b)| a.between(*b));
    let expected = odometry.iter().zip(&odometry[20..]).map(|(a, b)| a.between(*b));
    let errors: Vec<f64> =
        found.zip(expected).map(|(a, b)| b.between(a).position().norm()).collect();
    let mean = errors.iter().sum::<f64>() / errors.len() as f64;
    [mean, errors.into_iter().fold(0.0, f64::max)]
}

/// A laser that sees 4 m, ten times a second. Odometry errs too.
#[test]
fn hector_follows_tinyslams_robot_with_odometry_and_without() {
    let Some(log) = recorded("tinyslam/exp1.log") else { return };
    let log = CarmenLog::open(&log).expect("it is a log");
    for odometry in ["odometry_source=auto", "odometry_source=none"] {
        let [mean, worst] = motion_errors(&log, &config(&["engine=hector", odometry]));
        eprintln!("tinyslam, {odometry}: {mean:.3} m in 20 scans, {worst:.3} m at worst");
        assert!(mean < 0.2 && worst < 0.6, "{odometry}: {mean} m, {worst} m");
    }
}

/// The share of the hits of Intel's scans that lie within a cell of an occupied one, in the map
/// along the poses.
fn share_on_walls(log: &CarmenLog, pose: impl Fn(&Reading) -> Pose2) -> f64 {
    let config = config(&["engine=known_poses", "maxUrange=40"]);
    let mut replay = Replay::new(&config, 1).expect("it needs no thread");
    let mut hits = Vec::new();
    for reading in log.readings().expect("it opened before") {
        let mut reading = reading.expect("it can be read to its end");
        reading.odom_from_base = pose(&reading);
        let Some(scan) = &reading.scan else { continue };
        assert_eq!(replay.add(&reading), Verdict::Processed);
        for (index, range) in scan.ranges.iter().enumerate() {
            if let Beam::Hit(range) = scan.geometry.classify(*range) {
                let end = scan.point_in_base(&reading.mount, index, range);
                hits.push(reading.odom_from_base * end);
            }
        }
    }
    let map = replay.finish().map.expect("scans were processed");
    let is_occupied = |x: f64, y: f64| {
        let (column, row) = (x.floor(), y.floor());
        let inside = column >= 0.0 && row >= 0.0 && column < map.width as f64;
        let index = row as usize * map.width + column as usize;
        inside && map.cells.get(index) == Some(&100)
    };
    let near_wall = |end: &&Point2| {
        let [x, y] = [end.x - map.origin.x, end.y - map.origin.y].map(|v| v / map.resolution);
        let near = [-1.0, 0.0, 1.0];
        near.iter().any(|dy| near.iter().any(|dx| is_occupied(x + dx, y + dy)))
    };
    hits.iter().filter(near_wall).count() as f64 / hits.len() as f64
}

/// Along right poses, scans agree on where walls are; along raw odometry, one scan's wall is
/// another's free space.
#[test]
fn intel_along_published_poses_is_a_map_of_walls() {
    let (Some(log), Some(poses)) =
        (recorded("intel/intel.log"), recorded("intel/gmapping-published.txt"))
    else {
        return;
    };
    let log = CarmenLog::open(&log).expect("it is a log");
    let poses = GivenPoses::read(&poses).expect("it is a trajectory");
    let along_reference =
        share_on_walls(&log, |reading| poses.at(reading.stamp).expect("it is of this log"));
    let along_odometry = share_on_walls(&log, |reading| reading.odom_from_base);
    eprintln!("on walls: {along_reference:.3} along poses, {along_odometry:.3} along odometry");
    assert!(along_reference > 0.95, "{along_reference}");
    assert!(along_odometry < 0.5, "{along_odometry}");
}

/// The poses and the hits in the base frame of the processed scans of a log.
fn scans_along_path(log: &CarmenLog, config: &Config) -> (Vec<Pose2>, Vec<Vec<Point2>>) {
    let parameters = config.parameters();
    let mut filter =
        GMapping::new(parameters.clone(), config.raw.seed, 1).expect("it needs no thread");
    let mut hits = Vec::new();
    for reading in log.readings().expect("it opened before") {
        let reading = reading.expect("it can be read to its end");
        filter.add_odometry(reading.odom_from_base);
        let Some(scan) = &reading.scan else { continue };
        let reading =
            ScanReading { scan, mount: &reading.mount, odom_from_base: reading.odom_from_base };
        if let ScanUpdate::Processed(_) = filter.add_scan(&reading, &mut |_| ()) {
            let ends = PreparedScan::new(&reading, &parameters).outline.ends.into_iter();
            let ends = ends.filter(|end| end.kind == BeamEndKind::Hit);
            let point = |[x, y]: [f32; 2]| Point2::new(f64::from(x), f64::from(y));
            hits.push(ends.map(|end| point(end.point)).collect());
        }
    }
    (filter.path().iter().map(|(_, pose)| pose).collect(), hits)
}

#[test]
fn aces_closes_its_loops() {
    let Some(log) = recorded("aces/aces.log") else { return };
    let log = CarmenLog::open(&log).expect("it is a log");
    let agreement = |overrides: &[&str]| {
        let (path, hits) = scans_along_path(&log, &config(overrides));
        let found = revisit_agreement(&path, &hits).expect("it comes back to where it was");
        eprintln!("aces {overrides:?}: {found:?}");
        found
    };
    for seed in ["seed=1", "seed=2", "seed=3"] {
        let found = agreement(&["particles=100", "maxUrange=40", seed]);
        assert!(found.share >= 0.9 && found.revisits >= 30, "{seed}: {found:?}");
    }
    // By odometry alone it does not close them, and the measure tells.
    let open = agreement(&["particles=1", "maxUrange=40", "minimumScore=1e9"]);
    assert!(open.share < 0.75, "{open:?}");
}

/// Replays a log and returns how many of its scans were processed; every reading has a verdict.
fn processed(log: &CarmenLog, config: &Config) -> u64 {
    let mut replay = Replay::new(config, 1).expect("it needs no thread");
    let (mut with_scan, mut processed, mut passed_over, mut without) = (0, 0, 0, 0);
    for reading in log.readings().expect("it opened before") {
        let reading = reading.expect("it can be read to its end");
        with_scan += u64::from(reading.scan.is_some());
        match replay.add(&reading) {
            Verdict::Processed => processed += 1,
            Verdict::NotMovedEnough | Verdict::NoUsableBeams => passed_over += 1,
            Verdict::OdometryOnly => without += 1,
            verdict @ (Verdict::Throttled
            | Verdict::BadOdometry
            | Verdict::BadGeometry
            | Verdict::NotLocalized) => panic!("{verdict:?}"),
        }
    }
    let statistics = log.statistics();
    assert_eq!((statistics.malformed, statistics.scans), (0, with_scan));
    assert_eq!(processed + passed_over, with_scan);
    assert_eq!(statistics.readings, with_scan + without);
    let outcome = replay.finish();
    assert_eq!(outcome.counts.processed, processed);
    assert_eq!(outcome.trajectory.len() as u64, statistics.readings);
    assert!(outcome.trajectory.iter().all(|at| at.pose.is_finite()));
    assert!(outcome.map.is_some());
    processed
}

#[test]
fn tinyslam_runs_through_with_every_scan_accounted_for() {
    let Some(log) = recorded("tinyslam/exp1.log") else { return };
    let log = CarmenLog::open(&log).expect("it is a log");
    let processed = processed(&log, &config(&["particles=30", "maxUrange=5.6"]));
    assert!(processed > 30, "{processed}");
}

#[test]
fn sena_runs_through_with_every_scan_accounted_for() {
    let Some(log) = recorded("sena/sena.log") else { return };
    let log = CarmenLog::open(&log).expect("it is a log");
    let processed = processed(&log, &config(&["particles=30", "maxUrange=40"]));
    assert!(processed > 50, "{processed}");
}
