//! How far a trajectory is from the truth.
//!
//! Three measures: the relation metric of Kümmerle et al. ("On measuring the accuracy of SLAM
//! algorithms", Autonomous Robots 27, 2009) for recorded logs, whose truth is known only between
//! pairs of poses, the absolute trajectory error for simulations, and the agreement of scans with
//! those of earlier visits where no truth is known at all.

mod absolute;
mod relations;
mod revisit;
mod text;

use thiserror::Error;

pub use absolute::{Alignment, absolute_errors};
pub use relations::{ErrorStatistics, Relation, RelationReport, Skipped, relation_errors};
pub use revisit::{RevisitAgreement, revisit_agreement};
pub use text::{
    TextError, parse_relations, parse_trajectory, read_relations, read_trajectory, tum, tum_of_path,
};

use crate::slam::pose::{Pose2, Stamp};

/// A pose at a time, in the frame its context says.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StampedPose {
    /// When.
    pub stamp: Stamp,
    /// Where.
    pub pose: Pose2,
}

/// Why trajectories cannot be compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum EvaluationError {
    /// Pairs are formed by order, so both need as many poses.
    #[error("the trajectories have {estimate} and {truth} poses; as many are needed of both")]
    Lengths {
        /// Poses of the estimate.
        estimate: usize,
        /// Poses of the truth.
        truth: usize,
    },
    /// There is nothing to compare.
    #[error("the trajectories have no poses")]
    Empty,
}

#[cfg(test)]
mod tests;
