//! Memory does not grow with the length of a run: after ten laps it is that of the second.
//!
//! A pose for each processed scan is kept for good, since the path is handed out whole.

use std::alloc::System;
use std::sync::Mutex;

use gmapd::sim::Simulation;
use gmapd::sim::building::building;
use gmapd::sim::lidar::Lidar;
use gmapd::slam::gmapping::{GMapping, Parameters, ScanReading};
use gmapd::slam::grid::tile_map::TileCounts;
use stats_alloc::{INSTRUMENTED_SYSTEM, Region, StatsAlloc};

#[global_allocator]
static MEMORY: &StatsAlloc<System> = &INSTRUMENTED_SYSTEM;

/// What a settled pose of the path may cost: itself and its stamp.
const BYTES_A_POSE: usize = 40;

/// Poses that a particle may have to itself.
const MOST_DISPUTED: usize = 502;

/// How big a filter is.
#[derive(Debug, Clone, Copy)]
struct Size {
    /// Tiles of each particle's map, summed up: how many of them are shared depends on how long
    /// ago particles were drawn anew.
    tiles: usize,
    output_tiles: usize,
    nodes: usize,
    poses: usize,
    /// Everything on the heap.
    bytes: usize,
}

impl Size {
    fn of(filter: &GMapping, region: &Region<'_, System>) -> Self {
        let memory = region.change();
        let poses = filter.path().len();
        Self {
            tiles: filter.particle_tiles().referenced,
            output_tiles: TileCounts::of(std::iter::once(filter.occupancy().counts())).distinct,
            nodes: filter.trajectory_nodes(),
            poses,
            bytes: memory.bytes_allocated - memory.bytes_deallocated,
        }
    }
}

/// Sizes at the end of each of ten laps of a building.
fn laps(particles: usize) -> Vec<Size> {
    let lidar = Lidar::full_circle(180).expect("two beams or more");
    // Readings of nothing would draw ever more of what is not there.
    let lidar = Lidar { outlier_rate: 0.0, ..lidar };
    let site = building(2, 20.0);
    let mut simulation = Simulation::through(&site, 10, lidar, 2);
    simulation.scan_period_ns = 500_000_000;
    let scans_a_lap = simulation.scan_count().div_ceil(10);

    let region = Region::new(MEMORY);
    let parameters = Parameters { particles, ..Parameters::default() };
    let mut filter = GMapping::new(parameters, 1, 1).expect("it needs no thread");
    let mut sizes = Vec::new();
    for (index, reading) in simulation.readings().enumerate() {
        let scan = ScanReading {
            scan: &reading.scan,
            mount: &simulation.lidar.mount,
            odom_from_base: reading.odom_from_base,
        };
        filter.add_scan(&scan, &mut |_| ());
        drop(reading);
        if (index + 1).is_multiple_of(scans_a_lap) {
            sizes.push(Size::of(&filter, &region));
        }
    }
    sizes.push(Size::of(&filter, &region));
    sizes
}

/// Asserts that a measure at the end of the tenth lap is within a tenth of that of the second.
fn assert_flat(name: &str, [second, tenth]: [usize; 2]) {
    assert!(tenth <= second + second / 10, "{name}: {second} grew to {tenth}");
}

/// Bytes are those of the whole process, so tests take turns.
static TURN: Mutex<()> = Mutex::new(());

#[test]
fn ten_laps_take_no_more_tiles_than_two() {
    let _turn = TURN.lock();
    for particles in [1, 15] {
        let sizes = laps(particles);
        let ends = [sizes[1], sizes[9]];
        assert_flat("tiles of the particles", ends.map(|size| size.tiles));
        assert_flat("tiles of the output map", ends.map(|size| size.output_tiles));
    }
}

#[test]
fn ten_laps_take_no_more_bytes_than_two() {
    let _turn = TURN.lock();
    for particles in [1, 15, 30] {
        let sizes = laps(particles);
        let path = (sizes[9].poses - sizes[1].poses) * BYTES_A_POSE;
        assert_flat("bytes beside the path", [sizes[1].bytes, sizes[9].bytes - path]);
        assert!(sizes[9].nodes <= particles * MOST_DISPUTED, "{} nodes", sizes[9].nodes);
    }
}
