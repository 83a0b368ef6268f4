//! 2D laser mapping for robots on a Zenoh mesh.

pub mod clock;
pub mod files;
pub mod logs;
pub mod map;
pub mod slam;
