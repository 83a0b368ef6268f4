//! What the wheels say: the pose in `odom`, gathered between processed scans.

use serde::{Deserialize, Serialize};

use super::pose::Pose2;

/// Standard deviations of the odometry, per metre and per radian of motion.
///
/// The four names are slam_gmapping's; `srt` and `str` mean what its code does with them, which
/// its documentation describes the other way round.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct MotionNoise {
    /// `srr`: metres of translation noise per metre travelled.
    pub translation_from_translation: f64,
    /// `str`: metres of translation noise per radian turned.
    pub translation_from_rotation: f64,
    /// `srt`: radians of rotation noise per metre travelled.
    pub rotation_from_translation: f64,
    /// `stt`: radians of rotation noise per radian turned.
    pub rotation_from_rotation: f64,
}

impl Default for MotionNoise {
    fn default() -> Self {
        Self {
            translation_from_translation: 0.1,
            translation_from_rotation: 0.1,
            rotation_from_translation: 0.2,
            rotation_from_rotation: 0.2,
        }
    }
}

/// The pose of the base in the odometry frame at a scan or an odometry message.
pub type OdomFromBase = Pose2;
