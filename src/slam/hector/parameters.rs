//! Everything Hector can be told.

use super::super::odometry::{JumpGuard, MotionNoise};
use super::super::pose::Pose2;

/// Hector's parameters; the defaults are those of hector_mapping where it has them.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameters {
    /// `throttle_scans`: every n-th scan is looked at.
    pub throttle_scans: usize,
    /// `map_resolution`: metres a cell of the finest map.
    pub resolution: f64,
    /// `map_multi_res_levels`: how many maps, each with cells twice as large as the one before.
    pub levels: usize,
    /// `update_factor_free`: how likely a cell that a beam passed is occupied, below 0.5.
    pub free_probability: f64,
    /// `update_factor_occupied`: how likely a cell that a beam ended in is occupied, above 0.5.
    pub occupied_probability: f64,
    /// `map_update_distance_thresh`, m: a scan enters the map when the robot is further than this
    /// from where it was at the last that did, ...
    pub update_distance: f64,
    /// `map_update_angle_thresh`, rad: ... or turned by more than this.
    pub update_angle: f64,
    /// `laser_min_dist`, m: shorter readings say nothing.
    pub min_range: f64,
    /// `laser_max_dist`, m: longer readings are not matched, and free space ends there.
    pub max_range: f64,
    /// Whether a beam without return marks free space out to `laser_max_dist`.
    pub free_on_no_return: bool,
    /// Where the base is in `map` at the first scan; `None` makes `map` and `odom` coincide there,
    /// or has it at the origin without odometry.
    pub initial_pose: Option<Pose2>,
    /// How far odometry is trusted.
    pub motion_noise: MotionNoise,
    /// The guard against odometry jumps.
    pub jump: JumpGuard,
}

impl Default for Parameters {
    fn default() -> Self {
        Self {
            throttle_scans: 1,
            resolution: 0.025,
            levels: 3,
            free_probability: 0.4,
            occupied_probability: 0.9,
            update_distance: 0.4,
            update_angle: 0.9,
            min_range: 0.4,
            max_range: 30.0,
            free_on_no_return: false,
            initial_pose: None,
            motion_noise: MotionNoise::default(),
            jump: JumpGuard::default(),
        }
    }
}
