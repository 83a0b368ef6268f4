//! ROS 2 messages and their bytes: CDR as DDS, its bridges and `rmw_zenoh` carry it, and JSON of
//! the same fields for robots without ROS.
//!
//! Knows nothing of mapping and of sessions; [`crate::convert`] is where these types meet the
//! core's.

mod decode;
mod diagnostic_msgs;
mod encode;
mod field_path;
mod fields;
mod geometry_msgs;
pub mod graph;
mod map_msgs;
mod nav_msgs;
mod sensor_msgs;
mod std_msgs;
#[cfg(test)]
mod tests;
mod tf2_msgs;

pub use decode::{DecodeError, decode, decode_pose};
pub use diagnostic_msgs::{DiagnosticArray, DiagnosticStatus, KeyValue};
pub use encode::{cdr, json};
pub use fields::{Covariance, Int8Array};
pub use geometry_msgs::{
    Point, Pose, PoseArray, PoseStamped, PoseWithCovariance, PoseWithCovarianceStamped, Quaternion,
    Transform, TransformStamped, Twist, TwistWithCovariance, Vector3,
};
pub use map_msgs::OccupancyGridUpdate;
pub use nav_msgs::{GetMapRequest, GetMapResponse, MapMetaData, OccupancyGrid, Odometry, Path};
pub use sensor_msgs::LaserScan;
pub use std_msgs::{Float64, Header, Time};
pub use tf2_msgs::TfMessage;

/// A message that travels alone: the content of a sample, a request or a response.
pub trait Message: serde::Serialize + serde::de::DeserializeOwned {
    /// The ROS 2 name of the type, such as `sensor_msgs/msg/LaserScan`.
    const TYPE: &'static str;
}
