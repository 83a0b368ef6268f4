//! The pure core: no files, clocks, logging, async or global state.
//!
//! Stamps and odometry come in as values, randomness from a seed and counters, so the same input
//! gives the same bytes on any machine and any number of threads.

pub mod deskew;
pub mod engine;
pub mod gmapping;
pub mod grid;
pub mod hector;
pub mod known_poses;
pub mod motion_gate;
pub mod odometry;
pub mod outline;
pub mod path;
pub mod pose;
pub mod scan;
pub mod state;
pub mod update;
