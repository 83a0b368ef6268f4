//! Trajectories and relations as text files.

use std::fmt::Write as _;
use std::io;
use std::path::{Path, PathBuf};

use thiserror::Error;

use super::{Relation, StampedPose};
use crate::slam;
use crate::slam::pose::{Pose2, Stamp};

/// Bytes a line of TUM's format hardly ever exceeds.
const USUAL_LINE: usize = 100;

/// Why a text file cannot be used.
#[derive(Debug, Error)]
pub enum TextError {
    /// The file cannot be read.
    #[error("cannot read {}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// A line has another number of fields than its kind.
    #[error("{}:{line}: has {found} fields where {expected} are needed", path.display())]
    FieldCount {
        /// The file.
        path: PathBuf,
        /// Its line, from 1.
        line: usize,
        /// How many there should be, and of what.
        expected: &'static str,
        /// How many there are.
        found: usize,
    },
    /// A field is not a finite number.
    #[error("{}:{line}: {text:?} is not a finite number", path.display())]
    NotANumber {
        /// The file.
        path: PathBuf,
        /// Its line, from 1.
        line: usize,
        /// The field.
        text: String,
    },
    /// There is not one line of data.
    #[error("{} holds no data", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
    },
}

/// The trajectory in TUM's format, one `stamp tx ty tz qx qy qz qw` a line.
///
/// Stamps have six decimals: a float of seconds holds no more of today's date.
#[must_use]
pub fn tum(trajectory: &[StampedPose]) -> String {
    let mut text = String::with_capacity(trajectory.len() * USUAL_LINE);
    for StampedPose { stamp, pose } in trajectory {
        write_tum_line(&mut text, *stamp, *pose);
    }
    text
}

/// The path in TUM's format, as [`tum`] writes trajectories.
#[must_use]
pub fn tum_of_path(path: &slam::path::Path) -> String {
    let mut text = String::with_capacity(path.len() * USUAL_LINE);
    for (stamp, pose_in_map) in path.iter() {
        write_tum_line(&mut text, stamp, pose_in_map);
    }
    text
}

fn write_tum_line(text: &mut String, stamp: Stamp, pose: Pose2) {
    let (sin, cos) = libm::sincos(pose.theta / 2.0);
    let microseconds = (i128::from(stamp.0) + 500).div_euclid(1000);
    let (seconds, fraction) =
        (microseconds.div_euclid(1_000_000), microseconds.rem_euclid(1_000_000));
    let Pose2 { x, y, .. } = pose;
    writeln!(text, "{seconds}.{fraction:06} {x:.9} {y:.9} 0 0 0 {sin:.9} {cos:.9}").ok();
}

/// Reads a trajectory: TUM's format, or `stamp x y theta`.
///
/// # Errors
/// When the file cannot be read or a line is neither.
pub fn read_trajectory(path: &Path) -> Result<Vec<StampedPose>, TextError> {
    parse_trajectory(path, &read(path)?)
}

/// Reads relations: `stamp stamp x y z roll pitch yaw`.
///
/// # Errors
/// When the file cannot be read or a line is not one.
pub fn read_relations(path: &Path) -> Result<Vec<Relation>, TextError> {
    parse_relations(path, &read(path)?)
}

/// The trajectory in the text of a file; `path` is for messages.
///
/// # Errors
/// When a line is neither `stamp tx ty tz qx qy qz qw` nor `stamp x y theta`, or there is none.
pub fn parse_trajectory(path: &Path, text: &str) -> Result<Vec<StampedPose>, TextError> {
    parse_lines(path, text, |line, numbers| match *numbers {
        [seconds, x, y, theta] => {
            Ok(StampedPose { stamp: Stamp::from_seconds(seconds), pose: Pose2::new(x, y, theta) })
        }
        [seconds, x, y, _, qx, qy, qz, qw] => {
            let theta = libm::atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz));
            Ok(StampedPose { stamp: Stamp::from_seconds(seconds), pose: Pose2::new(x, y, theta) })
        }
        _ => Err(TextError::FieldCount {
            path: path.to_owned(),
            line,
            expected: "8 (TUM) or 4 (stamp x y theta)",
            found: numbers.len(),
        }),
    })
}

/// The relations in the text of a file; `path` is for messages.
///
/// # Errors
/// When a line does not have eight numbers, or there is no line.
pub fn parse_relations(path: &Path, text: &str) -> Result<Vec<Relation>, TextError> {
    parse_lines(path, text, |line, numbers| match *numbers {
        [from, to, x, y, _, _, _, yaw] => Ok(Relation {
            line,
            from: Stamp::from_seconds(from),
            to: Stamp::from_seconds(to),
            pose: Pose2::new(x, y, yaw),
        }),
        _ => Err(TextError::FieldCount {
            path: path.to_owned(),
            line,
            expected: "8 (stamp stamp x y z roll pitch yaw)",
            found: numbers.len(),
        }),
    })
}

fn read(path: &Path) -> Result<String, TextError> {
    std::fs::read_to_string(path)
        .map_err(|source| TextError::Read { path: path.to_owned(), source })
}

/// Lines that are empty or begin with `#` hold no data.
fn parse_lines<T>(
    path: &Path,
    text: &str,
    parse: impl Fn(usize, &[f64]) -> Result<T, TextError>,
) -> Result<Vec<T>, TextError> {
    let mut parsed = Vec::new();
    for (index, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let numbers = numbers(path, index + 1, line)?;
        parsed.push(parse(index + 1, &numbers)?);
    }
    if parsed.is_empty() { Err(TextError::Empty { path: path.to_owned() }) } else { Ok(parsed) }
}

fn numbers(path: &Path, line: usize, text: &str) -> Result<Vec<f64>, TextError> {
    let number = |text: &str| match text.parse::<f64>() {
        Ok(number) if number.is_finite() => Ok(number),
        _ => Err(TextError::NotANumber { path: path.to_owned(), line, text: text.to_owned() }),
    };
    text.split_ascii_whitespace().map(number).collect()
}
