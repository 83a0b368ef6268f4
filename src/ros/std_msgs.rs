//! `std_msgs` and `builtin_interfaces`.

use serde::{Deserialize, Serialize};

use super::Message;

/// `builtin_interfaces/Time`: when something happened, by the clock of the sender.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Time {
    /// Whole seconds.
    pub sec: i32,
    /// Nanoseconds since then, below a thousand million.
    pub nanosec: u32,
}

/// `std_msgs/Header`.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Header {
    /// When the data were taken.
    pub stamp: Time,
    /// The frame the data are in; may be left out in JSON.
    #[serde(default)]
    pub frame_id: String,
}

/// `std_msgs/Float64`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Float64 {
    /// The number.
    pub data: f64,
}

impl Message for Float64 {
    const TYPE: &'static str = "std_msgs/msg/Float64";
}
