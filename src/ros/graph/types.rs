//! Every type that travels, with the hash by which ROS 2 knows its fields (REP-2016).

use super::super::{
    DiagnosticArray, Float64, LaserScan, MapMetaData, Message as _, OccupancyGrid,
    OccupancyGridUpdate, Odometry, Path, PoseArray, PoseWithCovarianceStamped, TfMessage,
};

/// A type of message or service.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WireType {
    /// The ROS 2 name, such as `sensor_msgs/msg/LaserScan`.
    pub name: &'static str,
    /// The hash, the same for every distribution since it was introduced.
    pub hash: &'static str,
}

/// `diagnostic_msgs/msg/DiagnosticArray`.
pub const DIAGNOSTIC_ARRAY: WireType = WireType {
    name: DiagnosticArray::TYPE,
    hash: "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
};
/// `std_msgs/msg/Float64`.
pub const FLOAT64: WireType = WireType {
    name: Float64::TYPE,
    hash: "RIHS01_705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a",
};
/// `nav_msgs/srv/GetMap`.
pub const GET_MAP: WireType = WireType {
    name: "nav_msgs/srv/GetMap",
    hash: "RIHS01_c8ae77c9995b3554b5ba80e4d4d443f970ac65143102a1d893ec24fc07b31147",
};
/// `sensor_msgs/msg/LaserScan`.
pub const LASER_SCAN: WireType = WireType {
    name: LaserScan::TYPE,
    hash: "RIHS01_64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828",
};
/// `nav_msgs/msg/MapMetaData`.
pub const MAP_META_DATA: WireType = WireType {
    name: MapMetaData::TYPE,
    hash: "RIHS01_2772d4b2000ef2b35dbaeb80fd3946c1369f817fb4f75677d916d27c17d763c8",
};
/// `nav_msgs/msg/OccupancyGrid`.
pub const OCCUPANCY_GRID: WireType = WireType {
    name: OccupancyGrid::TYPE,
    hash: "RIHS01_8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7",
};
/// `map_msgs/msg/OccupancyGridUpdate`.
pub const OCCUPANCY_GRID_UPDATE: WireType = WireType {
    name: OccupancyGridUpdate::TYPE,
    hash: "RIHS01_c4095b0be2e4363f8978a1570e0293ee093436f1e1c61d99b48502ac317025e8",
};
/// `nav_msgs/msg/Odometry`.
pub const ODOMETRY: WireType = WireType {
    name: Odometry::TYPE,
    hash: "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
};
/// `nav_msgs/msg/Path`.
pub const PATH: WireType = WireType {
    name: Path::TYPE,
    hash: "RIHS01_1957a5bb3cee5da65c4e52e52b65a93df227efce4c20f8458b36e73066ca334b",
};
/// `geometry_msgs/msg/PoseArray`.
pub const POSE_ARRAY: WireType = WireType {
    name: PoseArray::TYPE,
    hash: "RIHS01_af0cc36d190e104d546d168d6b39df04fa4b4ccecf59cb4c9ed328d3d5004aa0",
};
/// `geometry_msgs/msg/PoseWithCovarianceStamped`.
pub const POSE_WITH_COVARIANCE_STAMPED: WireType = WireType {
    name: PoseWithCovarianceStamped::TYPE,
    hash: "RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
};
/// `tf2_msgs/msg/TFMessage`.
pub const TF_MESSAGE: WireType = WireType {
    name: TfMessage::TYPE,
    hash: "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
};

#[cfg(test)]
mod tests;
