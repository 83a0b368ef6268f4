//! 2D laser mapping for robots on a Zenoh mesh.

pub mod logs;
pub mod sim;
pub mod slam;
