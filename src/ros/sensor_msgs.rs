//! `sensor_msgs`.

use serde::{Deserialize, Serialize};

use super::{Header, Message, fields};

/// `sensor_msgs/LaserScan`: one sweep of a planar laser.
///
/// In JSON `time_increment`, `scan_time`, `intensities` and the frame may be left out, and
/// `range_max`, `ranges` and `intensities` take `null` and `"nan"` for NaN, `"inf"` and `"-inf"`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LaserScan {
    /// When the first beam was taken, and the laser's frame.
    pub header: Header,
    /// Direction of the first beam, rad.
    pub angle_min: f32,
    /// Direction of the last beam, rad.
    pub angle_max: f32,
    /// Angle from beam to beam, rad.
    pub angle_increment: f32,
    /// Seconds from beam to beam.
    #[serde(default)]
    pub time_increment: f32,
    /// Seconds from sweep to sweep.
    #[serde(default)]
    pub scan_time: f32,
    /// Shortest range that is measured, m.
    pub range_min: f32,
    /// Longest range that is measured, m.
    #[serde(with = "fields::float")]
    pub range_max: f32,
    /// One range a beam, m.
    #[serde(with = "fields::floats")]
    pub ranges: Vec<f32>,
    /// One strength of the echo a beam, or none at all.
    #[serde(default, with = "fields::floats")]
    pub intensities: Vec<f32>,
}

impl Message for LaserScan {
    const TYPE: &'static str = "sensor_msgs/msg/LaserScan";
}
