//! The way of the robot: a stamped pose a processed scan.

use std::sync::Arc;

use super::pose::{Pose2, Stamp};

/// The pose of the base in `map` at each processed scan, oldest first; cheap to copy.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Path {
    poses: Arc<Vec<(Stamp, Pose2)>>,
}

impl Path {
    /// How many poses there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.poses.len()
    }

    /// Whether no scan has been processed.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.poses.is_empty()
    }

    /// The poses, oldest first.
    pub fn iter(&self) -> impl DoubleEndedIterator<Item = (Stamp, Pose2)> {
        self.poses.iter().copied()
    }
}

impl FromIterator<(Stamp, Pose2)> for Path {
    fn from_iter<I: IntoIterator<Item = (Stamp, Pose2)>>(poses: I) -> Self {
        Self { poses: Arc::new(poses.into_iter().collect()) }
    }
}
