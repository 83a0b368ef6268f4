//! Everything the filter can be told; what belongs to one part of it is described there.

use super::super::grid::occupancy::OccupiedThreshold;
use super::super::motion_gate::MotionGate;
use super::super::odometry::{JumpGuard, MotionNoise};
use super::super::pose::Pose2;
use super::resampling::Weighting;
use super::scan_matcher::MatcherParameters;

/// The filter's parameters; the defaults are slam_gmapping's where it has them.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameters {
    /// Number of hypotheses, at least 1.
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

/// The occupancy map that is handed out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MapParameters {
    /// `occ_thresh` and `occ_min_visits`: when a cell is occupied.
    pub occupied_threshold: OccupiedThreshold,
    /// Whether a beam without return marks free space out to `maxUrange`.
    pub free_on_no_return: bool,
}

impl Default for MapParameters {
    fn default() -> Self {
        Self { occupied_threshold: OccupiedThreshold::of_share(0.25), free_on_no_return: false }
    }
}
