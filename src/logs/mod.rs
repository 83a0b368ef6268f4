//! Recorded input, in the order it was recorded.
//!
//! A log is a sequence of [`Reading`]s; recordings of ROS messages ([`recording`]) are made into
//! one by [`crate::recorded`]. Its order, and not its stamps, says what came first:
//! recordings exist whose stamps repeat and step back.

mod bag;
pub mod carmen;
pub mod carmen_writer;
mod cursor;
mod lines;
mod mcap;
pub mod mcap_writer;
pub mod recording;
mod ros1;
mod schemas;
mod source;

use std::collections::BTreeMap;
use std::path::PathBuf;

use thiserror::Error;

use crate::slam::pose::{Pose2, Stamp};
use crate::slam::scan::{LaserMount, Scan};

pub use lines::LineError;
pub use source::{Damage, Fault};

/// What a log says at one moment: where odometry believes the base is, and perhaps a sweep.
#[derive(Debug, Clone, PartialEq)]
pub struct Reading {
    /// Line of the log, from 1.
    pub line: u64,
    /// When it was taken.
    pub stamp: Stamp,
    /// Odometry's pose of the base, from the same line as the sweep.
    pub odom_from_base: Pose2,
    /// The sweep; `None` where the log has odometry only.
    pub scan: Option<Scan>,
    /// How the laser sits on the robot; the default where there is no sweep.
    pub mount: LaserMount,
}

/// What a log holds.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct LogStatistics {
    /// All lines.
    pub lines: u64,
    /// Lines by their first word, used or not; malformed ones are among them.
    pub lines_by_keyword: BTreeMap<String, u64>,
    /// Lines of a kind that is used which could not be read.
    pub malformed: u64,
    /// The first of the malformed lines.
    pub first_malformed: Vec<MalformedLine>,
    /// Usable readings.
    pub readings: u64,
    /// Usable readings with a sweep.
    pub scans: u64,
    /// Earliest and latest stamp.
    pub stamps: Option<(Stamp, Stamp)>,
}

impl LogStatistics {
    /// Seconds between the earliest and the latest stamp.
    #[must_use]
    pub fn duration(&self) -> f64 {
        self.stamps.map_or(0.0, |(first, last)| last.seconds_since(first))
    }
}

/// A line that was passed over, and why.
#[derive(Debug, Clone, PartialEq)]
pub struct MalformedLine {
    /// Line of the log, from 1.
    pub line: u64,
    /// What is wrong with it.
    pub reason: LineError,
}

/// Why a log cannot be read.
#[derive(Debug, Error)]
pub enum LogError {
    /// The file does not open.
    #[error("cannot open the log {}", path.display())]
    Open {
        /// The log.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// Reading stopped on an error.
    #[error("cannot read {} after line {line}", path.display())]
    Read {
        /// The log.
        path: PathBuf,
        /// The last line that was read.
        line: u64,
        /// What the system or the decompressor says.
        source: std::io::Error,
    },
    /// Nothing in it is usable.
    #[error(
        "{} holds no usable FLASER, ROBOTLASER1 or ODOM line ({lines} lines, {malformed} malformed)",
        path.display()
    )]
    NoReadings {
        /// The log.
        path: PathBuf,
        /// How many lines it has.
        lines: u64,
        /// How many of them are of a usable kind but malformed.
        malformed: u64,
    },
}
