//! Poses of a file, to map along.

use std::path::Path;

use thiserror::Error;

use crate::evaluation::{StampedPose, TextError, read_trajectory};
use crate::slam::pose::{Pose2, Stamp};
use crate::timeline::Interpolate as _;

/// A trajectory that somebody else found, in the order of its stamps.
#[derive(Debug, Clone, PartialEq)]
pub struct GivenPoses {
    /// At least one.
    poses: Vec<StampedPose>,
}

/// A stamp before the first pose or after the last.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum NoPose {
    /// The first pose is newer.
    #[error("no pose is given for it: the first is {:.1} ms newer", .0 * 1e3)]
    Before(f64),
    /// The last pose is older.
    #[error("no pose is given for it: the last is {:.1} ms older", .0 * 1e3)]
    After(f64),
}

impl GivenPoses {
    /// Reads a trajectory: TUM's format, or `stamp x y theta`.
    ///
    /// # Errors
    /// When the file cannot be read or a line is neither.
    pub fn read(path: &Path) -> Result<Self, TextError> {
        Ok(Self::new(read_trajectory(path)?))
    }

    /// Poses in any order; of those with one stamp, the first is meant.
    fn new(mut poses: Vec<StampedPose>) -> Self {
        poses.sort_by_key(|pose| pose.stamp);
        poses.dedup_by_key(|pose| pose.stamp);
        Self { poses }
    }

    /// The pose at a stamp, on the straight way between the poses before and after it.
    ///
    /// Text has six decimals, so a pose within a microsecond is that pose.
    ///
    /// # Errors
    /// When the stamp is before the first pose or after the last.
    pub fn at(&self, stamp: Stamp) -> Result<Pose2, NoPose> {
        let next = self.poses.partition_point(|pose| pose.stamp < stamp);
        let near = |pose: &&StampedPose| pose.stamp.seconds_since(stamp).abs() < 1e-6;
        let (earlier, later) = (next.checked_sub(1).map(|i| self.poses[i]), self.poses.get(next));
        if let Some(pose) = later.filter(near).or(earlier.as_ref().filter(near)) {
            return Ok(pose.pose);
        }
        match (earlier, later) {
            (Some(earlier), Some(later)) => {
                let whole = later.stamp.seconds_since(earlier.stamp);
                let part = stamp.seconds_since(earlier.stamp);
                Ok(earlier.pose.interpolate(&later.pose, part / whole))
            }
            (Some(last), None) => Err(NoPose::After(stamp.seconds_since(last.stamp))),
            (None, Some(first)) => Err(NoPose::Before(first.stamp.seconds_since(stamp))),
            (None, None) => Err(NoPose::After(f64::INFINITY)),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;

    fn given() -> GivenPoses {
        let pose = |seconds, x, theta| StampedPose {
            stamp: Stamp::from_seconds(seconds),
            pose: Pose2::new(x, 0.0, theta),
        };
        GivenPoses::new(vec![pose(11.0, 2.0, -PI + 0.1), pose(10.0, 1.0, PI - 0.1)])
    }

    #[test]
    fn between_two_poses_it_is_on_the_way() {
        let pose = given().at(Stamp::from_seconds(10.25)).unwrap();
        assert!((pose.x - 1.25).abs() < 1e-9 && (pose.theta - (PI - 0.05)).abs() < 1e-9);
        assert_eq!(given().at(Stamp(11_000_000_400)).unwrap().x, 2.0);
    }

    #[test]
    fn outside_it_is_told_by_how_much() {
        let error = given().at(Stamp::from_seconds(9.8)).unwrap_err();
        assert_eq!(error.to_string(), "no pose is given for it: the first is 200.0 ms newer");
        let error = given().at(Stamp::from_seconds(11.5)).unwrap_err();
        assert_eq!(error.to_string(), "no pose is given for it: the last is 500.0 ms older");
    }
}
