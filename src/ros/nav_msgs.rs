//! `nav_msgs`.

use serde::{Deserialize, Serialize};

use super::{
    Header, Int8Array, Message, Pose, PoseStamped, PoseWithCovariance, Time, TwistWithCovariance,
};

/// `nav_msgs/Odometry`; in JSON the child frame, the covariances and the twist may be left out.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Odometry {
    /// When, and the odometry's frame.
    pub header: Header,
    /// The frame of the robot's base.
    #[serde(default)]
    pub child_frame_id: String,
    /// The base in the odometry's frame.
    pub pose: PoseWithCovariance,
    /// The speed, in the base's frame.
    #[serde(default)]
    pub twist: TwistWithCovariance,
}

impl Message for Odometry {
    const TYPE: &'static str = "nav_msgs/msg/Odometry";
}

/// `nav_msgs/MapMetaData`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MapMetaData {
    /// When the map was made.
    pub map_load_time: Time,
    /// Metres a cell.
    pub resolution: f32,
    /// Cells a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// The lower-left corner of the first cell.
    pub origin: Pose,
}

impl Message for MapMetaData {
    const TYPE: &'static str = "nav_msgs/msg/MapMetaData";
}

/// `nav_msgs/OccupancyGrid`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OccupancyGrid {
    /// When, and the map's frame.
    pub header: Header,
    /// Size and place.
    pub info: MapMetaData,
    /// Row by row from the lowest y: -1 unknown, 0 free to 100 occupied.
    pub data: Int8Array,
}

impl Message for OccupancyGrid {
    const TYPE: &'static str = "nav_msgs/msg/OccupancyGrid";
}

/// `nav_msgs/Path`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Path {
    /// When, and in which frame.
    pub header: Header,
    /// The way, earliest first.
    pub poses: Vec<PoseStamped>,
}

impl Message for Path {
    const TYPE: &'static str = "nav_msgs/msg/Path";
}

/// The request of `nav_msgs/srv/GetMap`, which has no fields: ROS 2 fills empty structs with one
/// byte.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GetMapRequest {
    /// Says nothing.
    #[serde(default)]
    pub structure_needs_at_least_one_member: u8,
}

impl Message for GetMapRequest {
    const TYPE: &'static str = "nav_msgs/srv/GetMap_Request";
}

/// The response of `nav_msgs/srv/GetMap`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GetMapResponse {
    /// The map; without cells while there is none.
    pub map: OccupancyGrid,
}

impl Message for GetMapResponse {
    const TYPE: &'static str = "nav_msgs/srv/GetMap_Response";
}
