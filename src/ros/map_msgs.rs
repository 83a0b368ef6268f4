//! `map_msgs`.

use serde::{Deserialize, Serialize};

use super::{Header, Int8Array, Message};

/// `map_msgs/OccupancyGridUpdate`: other values for a rectangle of cells of the last map.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OccupancyGridUpdate {
    /// When, and the map's frame.
    pub header: Header,
    /// The first column in the map.
    pub x: i32,
    /// The first row in the map.
    pub y: i32,
    /// Cells a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Row by row from the lowest y, as in the map.
    pub data: Int8Array,
}

impl Message for OccupancyGridUpdate {
    const TYPE: &'static str = "map_msgs/msg/OccupancyGridUpdate";
}
