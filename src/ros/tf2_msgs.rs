//! `tf2_msgs`.

use serde::{Deserialize, Serialize};

use super::{Message, TransformStamped};

/// `tf2_msgs/TFMessage`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TfMessage {
    /// Transforms between neighbouring frames.
    pub transforms: Vec<TransformStamped>,
}

impl Message for TfMessage {
    const TYPE: &'static str = "tf2_msgs/msg/TFMessage";
}
