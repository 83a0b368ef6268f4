//! What is wrong with a robot's scans, odometry and transforms, told from watching them a while.
//!
//! No clock is read and nobody is asked: [`Watch`] takes what arrived, [`Watch::report`] says what
//! it means.

mod finding;
mod motion;
mod report;
#[cfg(test)]
mod tests;
mod turn;
mod watch;

pub use finding::Finding;
pub use report::Report;
pub use turn::laser_turn;
pub use watch::{FrameNames, Input, Keys, Watch};
