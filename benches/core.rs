//! What the steps of one processed scan take: `cargo bench`.
//!
//! Inputs are the scans of a simulated tour of a building, those that the motion gate lets
//! through. Steps of a single particle are timed on the scan after [`LEARNED`] scans have made its
//! map; whole scans are timed one after the other while the robot drives on.

use std::fmt;

use divan::{Bencher, black_box};
use gmapd::sim::lidar::Lidar;
use gmapd::sim::{Place, Scenario, Simulation};
use gmapd::slam::engine::Sweep as Taken;
use gmapd::slam::gmapping::prepared_scan::PreparedScan;
use gmapd::slam::gmapping::resampling::{effective_sample_size, normalize, systematic};
use gmapd::slam::gmapping::scan_matcher::FieldMatcher;
use gmapd::slam::gmapping::{GMapping, Parameters, ScanReading};
use gmapd::slam::grid::likelihood_field::LikelihoodField;
use gmapd::slam::grid::occupancy::OccupancyMap;
use gmapd::slam::hector::{self, Hector};
use gmapd::slam::motion_gate::MotionGate;
use gmapd::slam::odometry::Motion;
use gmapd::slam::pose::Pose2;
use gmapd::slam::scan::{LaserMount, Scan};

/// Processed scans before timing begins.
const LEARNED: usize = 100;
/// Whole scans that are timed.
const TIMED: u32 = 100;

fn main() {
    divan::main();
}

/// Particles and beams.
#[derive(Debug, Clone, Copy)]
struct Size {
    particles: usize,
    beams: usize,
}

impl Size {
    const fn new(particles: usize, beams: usize) -> Self {
        Self { particles, beams }
    }
}

impl fmt::Display for Size {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{} x {}", self.particles, self.beams)
    }
}

const SIZES: [Size; 4] =
    [Size::new(30, 180), Size::new(30, 360), Size::new(30, 1080), Size::new(100, 180)];
const BEAMS: [usize; 3] = [180, 360, 1080];

/// A sweep where the motion gate opened.
struct Sweep {
    scan: Scan,
    odom_from_base: Pose2,
    world_from_base: Pose2,
}

/// The first sweeps of a tour of a building that a filter processes.
fn sweeps(beams: usize, count: usize) -> (LaserMount, Vec<Sweep>) {
    let scenario = Scenario { beams, ..Scenario::new(Place::Building, 1) };
    let simulation = Simulation::new(&scenario).expect("enough beams");
    // Casting rays is nearly all of the work: two beams will do where the gate stays closed.
    let lidar = Lidar::full_circle(2).expect("enough beams");
    let blind = Simulation { lidar, ..simulation.clone() };
    let gate = MotionGate::default();
    let mut motion = Motion::default();
    let mut last: Option<Pose2> = None;
    let mut sweeps = Vec::new();
    for (index, reading) in blind.readings().enumerate() {
        let odom_from_base = reading.odom_from_base;
        if let Some(before) = last.replace(odom_from_base) {
            motion.extend(before.between(odom_from_base));
        }
        if gate.opens(&motion, (index > 0).then_some(0.0)) {
            motion = Motion::default();
            let world_from_base = reading.world_from_base;
            sweeps.push(Sweep { scan: simulation.scan(index), odom_from_base, world_from_base });
        }
        if sweeps.len() == count {
            break;
        }
    }
    (simulation.lidar.mount, sweeps)
}

/// What a particle that has seen [`LEARNED`] scans at their true poses has to do with one more.
struct Learned {
    matcher: FieldMatcher,
    field: LikelihoodField,
    occupancy: OccupancyMap,
    next: PreparedScan,
    world_from_base: Pose2,
}

fn learned(beams: usize) -> Learned {
    let parameters = Parameters::default();
    let (mount, sweeps) = sweeps(beams, LEARNED + 1);
    let matcher = FieldMatcher::new(parameters.matcher, parameters.resolution);
    let mut field = LikelihoodField::new();
    let mut occupancy = OccupancyMap::new(parameters.resolution);
    let prepare = |sweep: &Sweep| {
        let Sweep { scan, odom_from_base, .. } = sweep;
        let reading = ScanReading { scan, mount: &mount, odom_from_base: *odom_from_base };
        PreparedScan::new(&reading, &parameters)
    };
    for sweep in &sweeps[..LEARNED] {
        let scan = prepare(sweep);
        matcher.register(&mut field, &scan, sweep.world_from_base);
        occupancy.add(&scan.outline, sweep.world_from_base);
    }
    let next = &sweeps[LEARNED];
    let world_from_base = next.world_from_base;
    Learned { matcher, field, occupancy, next: prepare(next), world_from_base }
}

/// One particle's scan matched, from 10 cm and 3 degrees beside the truth.
#[divan::bench(args = BEAMS)]
fn match_scan(bencher: Bencher<'_, '_>, beams: usize) {
    let Learned { matcher, field, next, world_from_base, .. } = learned(beams);
    let start = world_from_base * Pose2::new(0.08, -0.06, 0.05);
    bencher.bench_local(|| matcher.run(black_box(&field), black_box(&next), black_box(start)));
}

/// One particle's map takes the scan; tiles are shared with another particle before.
#[divan::bench(args = BEAMS)]
fn register_scan(bencher: Bencher<'_, '_>, beams: usize) {
    let Learned { matcher, field, next, world_from_base, .. } = learned(beams);
    bencher
        .with_inputs(|| field.clone())
        .bench_local_refs(|field| matcher.register(field, black_box(&next), world_from_base));
}

/// Weights, effective sample size, ancestors, and the copies of their maps.
#[divan::bench(args = [30, 100, 500])]
fn resample(bencher: Bencher<'_, '_>, particles: usize) {
    let field = learned(180).field;
    let log_weights: Vec<f64> = (0..particles).map(|i| -0.05 * (i % 37) as f64).collect();
    bencher.bench_local(|| {
        let weights = normalize(black_box(&log_weights));
        let ancestors = systematic(&weights, 0.5);
        let maps: Vec<LikelihoodField> = ancestors.iter().map(|_| field.clone()).collect();
        (effective_sample_size(&weights), maps)
    });
}

/// The output map takes the scan and gives it back, which is what a change of the best particle
/// costs for each scan that differs.
#[divan::bench(args = BEAMS)]
fn output_map_add_and_remove(bencher: Bencher<'_, '_>, beams: usize) {
    let Learned { mut occupancy, next, world_from_base, .. } = learned(beams);
    bencher.bench_local(|| {
        occupancy.add(black_box(&next.outline), world_from_base);
        occupancy.remove(black_box(&next.outline), world_from_base);
    });
}

/// A whole processed scan on one thread.
#[divan::bench(args = SIZES, sample_count = TIMED, sample_size = 1)]
fn add_scan(bencher: Bencher<'_, '_>, size: Size) {
    let (mount, sweeps) = sweeps(size.beams, LEARNED + TIMED as usize);
    let gate = MotionGate { linear_update: 0.0, ..MotionGate::default() };
    let parameters = Parameters { particles: size.particles, gate, ..Parameters::default() };
    let mut filter = GMapping::new(parameters, 1, 1).expect("no thread is started");
    let mut add = |Sweep { scan, odom_from_base, .. }: &Sweep| {
        let reading = ScanReading { scan, mount: &mount, odom_from_base: *odom_from_base };
        filter.add_scan(&reading, &mut |_| ())
    };
    let mut sweeps = sweeps.iter();
    for sweep in sweeps.by_ref().take(LEARNED) {
        add(sweep);
    }
    bencher
        .with_inputs(|| sweeps.next().expect("as many scans as samples"))
        .bench_local_values(&mut add);
}

/// The sweeps of the first seconds of the tour, ten a second.
fn steady(beams: usize, count: usize) -> (LaserMount, Vec<Sweep>) {
    let scenario = Scenario { beams, ..Scenario::new(Place::Building, 1) };
    let simulation = Simulation::new(&scenario).expect("enough beams");
    let sweeps = simulation.readings().take(count).map(|reading| Sweep {
        scan: reading.scan,
        odom_from_base: reading.odom_from_base,
        world_from_base: reading.world_from_base,
    });
    (simulation.lidar.mount, sweeps.collect())
}

/// Hector's whole work on scan after scan at 10 Hz and 0.8 m/s: all are matched, and with
/// hector_mapping's thresholds about every sixth enters the maps.
#[divan::bench(args = [360, 1080], sample_count = 20, sample_size = 1)]
fn hector_thirty_scans(bencher: Bencher<'_, '_>, beams: usize) {
    hector_scans(bencher, beams, hector::Parameters::default());
}

/// The same with every scan entering the maps.
#[divan::bench(args = [360, 1080], sample_count = 20, sample_size = 1)]
fn hector_thirty_scans_all_entering(bencher: Bencher<'_, '_>, beams: usize) {
    let parameters = hector::Parameters { update_distance: 0.0, ..hector::Parameters::default() };
    hector_scans(bencher, beams, parameters);
}

fn hector_scans(bencher: Bencher<'_, '_>, beams: usize, parameters: hector::Parameters) {
    let (mount, sweeps) = steady(beams, LEARNED + 20 * 30);
    let mut engine = Hector::new(parameters);
    let mut add = |Sweep { scan, odom_from_base, .. }: &Sweep| {
        let taken = Taken { scan, mount: &mount, odom_from_base: Some(*odom_from_base) };
        engine.add_scan(&taken, &mut |_| ())
    };
    let (first, rest) = sweeps.split_at(LEARNED);
    for sweep in first {
        add(sweep);
    }
    let mut thirties = rest.chunks_exact(30);
    bencher
        .with_inputs(|| thirties.next().expect("as many scans as samples take"))
        .bench_local_values(|sweeps| sweeps.iter().map(&mut add).last());
}
