//! 2D laser mapping for robots on a Zenoh mesh.

pub mod sim;
pub mod slam;

pub mod config;
pub mod evaluation;
pub mod files;
pub mod logs;
pub mod map;

pub mod clock;
pub mod replay;
pub mod statistics;
