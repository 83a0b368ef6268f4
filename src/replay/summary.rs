//! What is told about a replay when it has ended.

use std::collections::BTreeMap;

use serde::Serialize;

use super::{Outcome, ScanTimes, Times, Verdict, phase_index};
use crate::clock::{Elapsed, peak_resident_memory};
use crate::config::{Config, EngineKind, RawConfig};
use crate::logs::LogStatistics;
use crate::slam::grid::tile_map::TileCounts;
use crate::slam::update::{OdometryUpdate, Phase};
use crate::statistics::Spread;

/// The figures of a replay; `summary.json` is this.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// Version of the program.
    pub version: &'static str,
    /// Whether it was built without optimisation, which makes its times meaningless.
    pub debug_build: bool,
    /// Seed of the random numbers.
    pub seed: u64,
    /// Threads the filter used.
    pub threads: usize,
    /// Which system mapped.
    pub engine: EngineKind,
    /// Number of hypotheses.
    pub particles: usize,
    /// Readings by verdict.
    pub readings: Counts,
    /// Lines of the log by their first word.
    pub lines_by_keyword: BTreeMap<String, u64>,
    /// How often particles were drawn anew.
    pub resamples: u64,
    /// Processed scans that left a direction open, where the engine looks for it.
    pub weak_directions: u64,
    /// Effective sample sizes of processed scans; `null` when there are none.
    pub effective_sample_size: Option<SampleSizes>,
    /// Time and memory.
    pub timing: Timing,
    /// Memory of the particles' maps at the end.
    pub tiles: Tiles,
    /// SHA-256 of what was computed, whether or not it was written.
    pub sha256: Hashes,
    /// Every key of the configuration with the value that held.
    pub configuration: RawConfig,
}

impl Summary {
    /// Gathers the figures of a replay that took `elapsed`.
    #[must_use]
    pub fn new(run: &Run<'_>, outcome: &Outcome, sha256: Hashes) -> Self {
        let mut readings = outcome.counts;
        readings.malformed = run.log.malformed;
        Self {
            version: env!("CARGO_PKG_VERSION"),
            debug_build: cfg!(debug_assertions),
            seed: run.config.raw.seed,
            threads: run.threads,
            engine: run.config.raw.engine,
            particles: match run.config.raw.engine {
                EngineKind::Gmapping => run.config.raw.particles,
                EngineKind::Hector | EngineKind::KnownPoses => 1,
            },
            readings,
            lines_by_keyword: run.log.lines_by_keyword.clone(),
            resamples: outcome.resamples,
            weak_directions: outcome.weak,
            effective_sample_size: SampleSizes::of(&outcome.sample_sizes),
            timing: Timing::new(run, &outcome.times),
            tiles: outcome.tiles,
            sha256,
            configuration: run.config.raw.clone(),
        }
    }
}

/// What a summary is about.
#[derive(Debug)]
pub struct Run<'a> {
    /// How it was configured.
    pub config: &'a Config,
    /// Threads the filter used.
    pub threads: usize,
    /// What the log holds.
    pub log: &'a LogStatistics,
    /// What the readings took, from the first to the last.
    pub elapsed: Elapsed,
}

/// Readings by what became of them.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Counts {
    /// All readings that could be read.
    pub total: u64,
    /// Scans in the map.
    pub processed: u64,
    /// Scans after too little motion.
    pub not_moved_enough: u64,
    /// Scans passed over by `throttle_scans`.
    pub throttled: u64,
    /// Scans without a hit within `maxUrange`.
    pub no_usable_beams: u64,
    /// Readings whose odometry is not finite.
    pub bad_odometry: u64,
    /// Scans whose place in the known map cannot be told.
    pub not_localized: u64,
    /// Scans whose angles or limits are lost in a message.
    pub bad_geometry: u64,
    /// Readings without a scan.
    pub odometry_only: u64,
    /// Readings, whatever became of them, whose odometry step was rejected as a jump.
    pub jump_rejected: u64,
    /// Scans of a recording without odometry or mount, late or twice; not among `total`.
    pub refused: u64,
    /// Lines or messages that could not be read; not among `total`.
    pub malformed: u64,
}

impl Counts {
    pub(super) const fn add(&mut self, verdict: Verdict, step: OdometryUpdate) {
        let count = match verdict {
            Verdict::Processed => &mut self.processed,
            Verdict::NotMovedEnough => &mut self.not_moved_enough,
            Verdict::Throttled => &mut self.throttled,
            Verdict::NoUsableBeams => &mut self.no_usable_beams,
            Verdict::BadOdometry => &mut self.bad_odometry,
            Verdict::NotLocalized => &mut self.not_localized,
            Verdict::BadGeometry => &mut self.bad_geometry,
            Verdict::OdometryOnly => &mut self.odometry_only,
        };
        *count += 1;
        self.total += 1;
        if matches!(step, OdometryUpdate::JumpRejected) {
            self.jump_rejected += 1;
        }
    }
}

/// Effective sample sizes of processed scans, before resampling.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SampleSizes {
    /// Smallest.
    pub min: f64,
    /// Mean.
    pub mean: f64,
}

impl SampleSizes {
    fn of(sizes: &[f64]) -> Option<Self> {
        let min = sizes.iter().copied().reduce(f64::min)?;
        Some(Self { min, mean: sizes.iter().sum::<f64>() / sizes.len() as f64 })
    }
}

/// Time and memory.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Timing {
    /// Seconds of log between the earliest and the latest stamp.
    pub log_s: f64,
    /// Seconds all readings took, reading the file included.
    pub wall_s: f64,
    /// Seconds of all processors together.
    pub cpu_s: f64,
    /// Seconds of log a second.
    pub real_time_factor: f64,
    /// The most memory that was resident, bytes; `null` where the system does not say.
    pub peak_memory_bytes: Option<u64>,
    /// Milliseconds a processed scan; `null` when there are none.
    pub scan: Option<PhaseTimes>,
    /// Milliseconds of each phase of a processed scan; `null` when there are none.
    pub phases: Option<PhaseSplit>,
}

impl Timing {
    fn new(run: &Run<'_>, times: &ScanTimes) -> Self {
        let wall_s = run.elapsed.wall.as_secs_f64();
        Self {
            log_s: run.log.duration(),
            wall_s,
            cpu_s: run.elapsed.cpu.as_secs_f64(),
            real_time_factor: run.log.duration() / wall_s.max(1e-9),
            peak_memory_bytes: peak_resident_memory(),
            scan: PhaseTimes::of(&times.total),
            phases: PhaseSplit::of(times),
        }
    }
}

/// Milliseconds of each phase of a processed scan.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PhaseSplit {
    /// Scan matching and weighting of all particles.
    #[serde(rename = "match")]
    pub matching: PhaseTimes,
    /// Normalisation, resampling and the trajectory tree.
    pub resample: PhaseTimes,
    /// The scan enters each particle's map.
    pub register: PhaseTimes,
    /// The scan enters the output map.
    pub map: PhaseTimes,
}

impl PhaseSplit {
    fn of(times: &ScanTimes) -> Option<Self> {
        let of = |phase| PhaseTimes::of(&times.phases[phase_index(phase)]);
        Some(Self {
            matching: of(Phase::Match)?,
            resample: of(Phase::Resample)?,
            register: of(Phase::Register)?,
            map: of(Phase::Map)?,
        })
    }
}

/// Milliseconds of one thing done once a processed scan.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PhaseTimes {
    /// Of all processors together.
    pub cpu_ms: Spread,
    /// That passed.
    pub wall_ms: Spread,
}

impl PhaseTimes {
    fn of(times: &Times) -> Option<Self> {
        Some(Self { cpu_ms: Spread::of(&times.cpu_ms)?, wall_ms: Spread::of(&times.wall_ms)? })
    }
}

/// Tiles of the particles' maps, which share those that are equal.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Tiles {
    /// References to tiles, summed over the particles.
    pub referenced: usize,
    /// Tiles in memory.
    pub distinct: usize,
    /// Bytes of the tiles in memory.
    pub bytes: usize,
}

impl From<TileCounts> for Tiles {
    fn from(counts: TileCounts) -> Self {
        let TileCounts { referenced, distinct, bytes } = counts;
        Self { referenced, distinct, bytes }
    }
}

/// SHA-256 of what a replay computes, in hexadecimal digits.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct Hashes {
    /// Of `map.pgm`; `null` without a map.
    #[serde(rename = "map.pgm")]
    pub map: Option<String>,
    /// Of `trajectory.tum`.
    #[serde(rename = "trajectory.tum")]
    pub trajectory: String,
    /// Of the poses at processed scans, as the daemon answers `path?format=tum`.
    #[serde(rename = "path.tum")]
    pub path: String,
}
