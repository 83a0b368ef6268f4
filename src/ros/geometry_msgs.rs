//! `geometry_msgs`.
//!
//! In JSON what a robot in the plane has no use for may be left out: z of positions, x and y of
//! quaternions, covariances and twists.

use serde::{Deserialize, Serialize};

use super::{Covariance, Header, Message};

/// `geometry_msgs/Point`, m.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Point {
    /// Along x.
    pub x: f64,
    /// Along y.
    pub y: f64,
    /// Along z.
    #[serde(default)]
    pub z: f64,
}

/// `geometry_msgs/Vector3`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Vector3 {
    /// Along x.
    pub x: f64,
    /// Along y.
    pub y: f64,
    /// Along z.
    #[serde(default)]
    pub z: f64,
}

/// `geometry_msgs/Quaternion`; the default is the one that ROS senders forget to fill in, zero.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Quaternion {
    /// The part of i.
    #[serde(default)]
    pub x: f64,
    /// The part of j.
    #[serde(default)]
    pub y: f64,
    /// The part of k.
    pub z: f64,
    /// The real part.
    pub w: f64,
}

/// `geometry_msgs/Pose`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Pose {
    /// Where.
    pub position: Point,
    /// Turned how.
    pub orientation: Quaternion,
}

/// `geometry_msgs/PoseStamped`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PoseStamped {
    /// When, and in which frame.
    pub header: Header,
    /// The pose.
    pub pose: Pose,
}

impl Message for PoseStamped {
    const TYPE: &'static str = "geometry_msgs/msg/PoseStamped";
}

/// `geometry_msgs/PoseWithCovariance`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PoseWithCovariance {
    /// The pose.
    pub pose: Pose,
    /// Of x, y, z and the turns about x, y, z.
    #[serde(default)]
    pub covariance: Covariance,
}

/// `geometry_msgs/PoseWithCovarianceStamped`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PoseWithCovarianceStamped {
    /// When, and in which frame.
    pub header: Header,
    /// The pose and how sure it is.
    pub pose: PoseWithCovariance,
}

impl Message for PoseWithCovarianceStamped {
    const TYPE: &'static str = "geometry_msgs/msg/PoseWithCovarianceStamped";
}

/// `geometry_msgs/PoseArray`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PoseArray {
    /// When, and in which frame.
    pub header: Header,
    /// The poses.
    pub poses: Vec<Pose>,
}

impl Message for PoseArray {
    const TYPE: &'static str = "geometry_msgs/msg/PoseArray";
}

/// `geometry_msgs/Twist`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Twist {
    /// Speed, m/s.
    pub linear: Vector3,
    /// Rate of turn, rad/s.
    pub angular: Vector3,
}

/// `geometry_msgs/TwistWithCovariance`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TwistWithCovariance {
    /// The speeds.
    pub twist: Twist,
    /// Of the speeds along and about x, y, z.
    #[serde(default)]
    pub covariance: Covariance,
}

/// `geometry_msgs/Transform`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Transform {
    /// The child's origin in the parent, m.
    pub translation: Vector3,
    /// How the child is turned in the parent.
    pub rotation: Quaternion,
}

/// `geometry_msgs/TransformStamped`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TransformStamped {
    /// When, and the parent frame.
    pub header: Header,
    /// The child frame.
    pub child_frame_id: String,
    /// Maps coordinates in the child to coordinates in the parent.
    pub transform: Transform,
}
