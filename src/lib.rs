//! 2D laser mapping for robots on a Zenoh mesh.

pub mod slam;
