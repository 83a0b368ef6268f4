//! GMapping: a Rao-Blackwellized particle filter over trajectories and maps
//! (Grisetti, Stachniss, Burgard, IEEE T-RO 23(1), 2007).

use super::motion_gate::MotionGate;
use super::odometry::MotionNoise;
use super::pose::{Pose2, Stamp};
use super::scan::{LaserMount, Scan};

/// Everything the filter can be told, grouped by the part that uses it.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameters {
    /// Number of hypotheses; slam_gmapping's default is 30.
    pub particles: usize,
    /// `throttle_scans`: every n-th scan is looked at.
    pub throttle_scans: usize,
    /// `delta`: metres a cell.
    pub resolution: f64,
    /// `maxRange`, m: readings strictly above are discarded; `None` takes the sensor's own limit.
    pub max_range: Option<f64>,
    /// `maxUrange`, m: readings above are not matched, and free space ends there.
    pub max_usable_range: Option<f64>,
    /// Where the base is in `map` at the first scan; `None` makes `map` and `odom` coincide there.
    pub initial_pose: Option<Pose2>,
    /// Odometry noise.
    pub motion_noise: MotionNoise,
    /// Which scans are processed.
    pub gate: MotionGate,
    /// The guard against odometry jumps.
    pub jump: JumpGuard,
    /// Scan matching.
    pub matcher: MatcherParameters,
    /// Weights and resampling.
    pub weighting: Weighting,
    /// The map that is handed out.
    pub map: MapParameters,
}

impl Default for Parameters {
    fn default() -> Self {
        Self {
            particles: 30,
            throttle_scans: 1,
            resolution: 0.05,
            max_range: None,
            max_usable_range: None,
            initial_pose: None,
            motion_noise: MotionNoise::default(),
            gate: MotionGate::default(),
            jump: JumpGuard::default(),
            matcher: MatcherParameters::default(),
            weighting: Weighting::default(),
            map: MapParameters::default(),
        }
    }
}

/// What happens when odometry moves further between two readings than a robot can.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JumpGuard {
    /// Metres between two successive odometry readings that count as a jump.
    pub max_step: f64,
    /// What then happens.
    pub policy: JumpPolicy,
}

impl Default for JumpGuard {
    fn default() -> Self {
        Self { max_step: 20.0, policy: JumpPolicy::Reject }
    }
}

/// What to do with a reading that jumped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum JumpPolicy {
    /// The jump is taken out: the robot is believed not to have moved meanwhile.
    Reject,
    /// The jump is believed, as the original did after printing a banner.
    Continue,
}

/// The scan matcher's settings.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MatcherParameters {
    /// Which matcher runs.
    pub kind: MatcherKind,
    /// `lstep`, m: first step of the hill climb.
    pub linear_step: f64,
    /// `astep`, rad: first step of the hill climb.
    pub angular_step: f64,
    /// `iterations`: how often the compat matcher halves its steps.
    pub iterations: u32,
    /// `sigma`: the compat matcher's score is exp(-d^2 / sigma).
    pub sigma: f64,
    /// `kernelSize`, cells: the compat matcher looks this far around an endpoint.
    pub kernel_size: u32,
    /// `lsigma`: the compat log likelihood of a beam is -d^2 / lsigma.
    pub likelihood_sigma: f64,
    /// `lskip`: this many beams are passed over between two that are matched.
    pub beam_skip: usize,
    /// `minimumScore`: a match counts only above this score.
    pub minimum_score: f64,
    /// Standard deviation of the likelihood field around each hit, m.
    pub field_sigma: f64,
}

impl Default for MatcherParameters {
    fn default() -> Self {
        Self {
            kind: MatcherKind::Field,
            linear_step: 0.05,
            angular_step: 0.05,
            iterations: 5,
            sigma: 0.05,
            kernel_size: 1,
            likelihood_sigma: 0.075,
            beam_skip: 0,
            minimum_score: 0.0,
            field_sigma: 0.06,
        }
    }
}

/// Which scan matcher runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MatcherKind {
    /// A cached likelihood field, a coarse climb and a Gauss-Newton polish.
    Field,
    /// The original's objective and schedule: slow, and the reference for tests.
    Compat,
}

/// How weights are formed and when particles are drawn anew.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Weighting {
    /// `ogain`: the larger, the flatter the weights.
    pub gain: f64,
    /// Whether weights are flattened with the number of particles, as the original does.
    pub smoothing: WeightSmoothing,
    /// `resampleThreshold`: resample below this fraction of N effective particles.
    pub resample_threshold: f64,
}

impl Default for Weighting {
    fn default() -> Self {
        Self { gain: 3.0, smoothing: WeightSmoothing::Fixed, resample_threshold: 0.5 }
    }
}

/// How log likelihoods become weights.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WeightSmoothing {
    /// The same for any number of particles.
    Fixed,
    /// Divided by `ogain * N`: the original's rule.
    PerParticle,
}

/// The occupancy map that is handed out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MapParameters {
    /// `occ_thresh`: a cell is occupied when hits / visits is above this.
    pub occupied_threshold: f64,
    /// Whether a beam without return marks free space out to `maxUrange`.
    pub free_on_no_return: bool,
}

impl Default for MapParameters {
    fn default() -> Self {
        Self { occupied_threshold: 0.25, free_on_no_return: false }
    }
}

/// A scan with all that is needed to use it.
#[derive(Debug, Clone, Copy)]
pub struct ScanReading<'a> {
    /// The sweep.
    pub scan: &'a Scan,
    /// How the laser sits on the robot.
    pub mount: &'a LaserMount,
    /// Where odometry says the base was when the sweep was taken.
    pub odom_from_base: Pose2,
}

/// What became of a scan.
#[derive(Debug, Clone, PartialEq)]
pub enum ScanUpdate {
    /// It is in the map.
    Processed(ScanReport),
    /// It is not, for this reason.
    Skipped(SkipReason),
}

/// Figures about a processed scan.
#[derive(Debug, Clone, PartialEq)]
pub struct ScanReport {
    /// 1 / Σ wᵢ² before resampling, between 1 and the number of particles.
    pub effective_sample_size: f64,
    /// Whether particles were drawn anew.
    pub resampled: bool,
    /// Particles whose scan match was accepted.
    pub matched: usize,
}

/// Why a scan was not processed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum SkipReason {
    /// Not the n-th scan that `throttle_scans` asks for.
    Throttled,
    /// The motion gate is closed.
    NotMovedEnough,
    /// No beam is a hit within `maxUrange`.
    NoUsableBeams,
    /// The odometry pose is not finite.
    BadOdometry,
}

/// The parts of processing a scan, in order; reported when each ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Phase {
    /// Scan matching and weighting of all particles.
    Match,
    /// Normalisation, resampling and the trajectory tree.
    Resample,
    /// The scan enters each particle's map.
    Register,
    /// The scan enters the output map.
    Map,
}

/// The filter.
#[derive(Debug)]
pub struct GMapping {
    parameters: Parameters,
}

impl GMapping {
    /// A filter with no scan yet. `threads` of 1 runs everything on the caller's thread.
    #[must_use]
    pub fn new(parameters: Parameters, _seed: u64, _threads: usize) -> Self {
        Self { parameters }
    }

    /// Takes an odometry reading between scans; returns whether the jump guard rejected its step.
    pub fn add_odometry(&mut self, _odom_from_base: Pose2) -> bool {
        false
    }

    /// Takes a scan; `on_phase` is called as each phase of processing ends.
    pub fn add_scan(
        &mut self,
        _reading: &ScanReading<'_>,
        _on_phase: &mut dyn FnMut(Phase),
    ) -> ScanUpdate {
        let _ = &self.parameters;
        ScanUpdate::Skipped(SkipReason::NoUsableBeams)
    }

    /// The best particle's pose of the base in `map` at its last processed scan, with odometry since.
    #[must_use]
    pub fn pose_in_map(&self) -> Pose2 {
        Pose2::IDENTITY
    }

    /// The pose of each processed scan as the best particle sees it now, oldest first.
    #[must_use]
    pub fn path(&self) -> Vec<(Stamp, Pose2)> {
        Vec::new()
    }

    /// The map of the best particle, cropped to what is known; `None` before the first scan.
    #[must_use]
    pub fn occupancy_grid(&self) -> Option<OccupancyGrid> {
        None
    }
}

/// A map as `nav_msgs/OccupancyGrid` means it.
#[derive(Debug, Clone, PartialEq)]
pub struct OccupancyGrid {
    /// Metres a cell.
    pub resolution: f64,
    /// Cells a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// The lower-left corner of cell (0, 0) in `map`, m.
    pub origin: super::pose::Point2,
    /// Row by row from the lowest y: -1 unknown, 0 free, 100 occupied.
    pub cells: Vec<i8>,
}
