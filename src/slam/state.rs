//! The state of an engine as plain data, to go on from later.
//!
//! Parameters are no part of it: whoever goes on has made an engine with the same ones.

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::gmapping::state::GMappingState;
use super::hector::state::HectorState;
use super::known_poses::KnownPosesState;
use super::pose::Pose2;

/// Twice as far as odometry is believed in, m; and as many radians, that nothing overflows.
const FURTHEST: f64 = 2e7;

/// Of variances, weights and scores.
const LARGEST: f64 = 1e9;

/// All that an engine knows.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum EngineState {
    /// Of the particle filter.
    GMapping(Box<GMappingState>),
    /// Of Hector.
    Hector(Box<HectorState>),
    /// Of mapping along given poses.
    KnownPoses(Box<KnownPosesState>),
}

/// Why no engine can go on from a state.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum StateError {
    /// It is of another engine.
    #[error("it is the state of another engine")]
    OtherEngine,
    /// A number is NaN, or larger than any robot's.
    #[error("{0} is no number, or larger than any robot's")]
    OutOfRange(&'static str),
    /// An index leads to nothing, or two parts do not fit together.
    #[error("its {0} do not fit together")]
    Unsound(&'static str),
    /// There are more or fewer of something than the parameters say.
    #[error("it has {found} {what}, and {expected} are configured")]
    Number {
        /// Of what.
        what: &'static str,
        /// How many the state has.
        found: usize,
        /// How many the engine has.
        expected: usize,
    },
}

/// An error unless `fits` holds of the parts.
///
/// # Errors
/// Names the parts.
#[expect(clippy::fn_params_excessive_bools, reason = "it is a condition, as of an assertion")]
pub fn ensure(fits: bool, parts: &'static str) -> Result<(), StateError> {
    if fits { Ok(()) } else { Err(StateError::Unsound(parts)) }
}

/// An error unless all poses are such that a robot can have them.
pub(super) fn ensure_poses(
    mut poses: impl Iterator<Item = Pose2>,
    what: &'static str,
) -> Result<(), StateError> {
    let possible = |pose: Pose2| {
        pose.is_finite() && pose.position().norm() <= FURTHEST && pose.theta.abs() <= FURTHEST
    };
    if poses.all(possible) { Ok(()) } else { Err(StateError::OutOfRange(what)) }
}

/// An error unless all figures are such that an engine can have them.
pub(super) fn ensure_figures(
    mut figures: impl Iterator<Item = f64>,
    what: &'static str,
) -> Result<(), StateError> {
    let possible = |figure: f64| figure.abs() <= LARGEST;
    if figures.all(possible) { Ok(()) } else { Err(StateError::OutOfRange(what)) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pose_that_no_robot_has_is_none() {
        let check = |x, theta| ensure_poses([Pose2::new(x, 0.0, theta)].into_iter(), "the pose");
        assert_eq!(check(-1e7, 7.0), Ok(()));
        let refused = Err(StateError::OutOfRange("the pose"));
        // An angle that is wrapped by turns may overflow.
        for (x, theta) in [(0.0, 1e306), (0.0, f64::NAN), (1e9, 0.0), (f64::INFINITY, 0.0)] {
            assert_eq!(check(x, theta), refused, "{x} {theta}");
        }
    }
}
