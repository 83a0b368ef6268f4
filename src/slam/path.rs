//! The way of the robot: a stamped pose a processed scan.

use std::sync::Arc;

use serde::ser::SerializeSeq as _;
use serde::{Deserialize, Serialize, Serializer};

use super::pose::{Pose2, Stamp};
use super::state::{StateError, ensure_poses};

/// Poses that copies of a path share as one.
const CHUNK: usize = 256;

/// The pose of the base in `map` at each processed scan, oldest first.
///
/// A copy shares all but the last poses with its original, so that it costs little however long
/// the way is.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(try_from = "Vec<(Stamp, Pose2)>")]
pub struct Path {
    chunks: Vec<Arc<[(Stamp, Pose2)]>>,
    /// Fewer than a chunk.
    last: Vec<(Stamp, Pose2)>,
}

impl Path {
    /// How many poses there are.
    #[must_use]
    pub const fn len(&self) -> usize {
        self.chunks.len() * CHUNK + self.last.len()
    }

    /// Whether no scan has been processed.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The poses, oldest first.
    pub fn iter(&self) -> impl DoubleEndedIterator<Item = (Stamp, Pose2)> {
        self.chunks.iter().flat_map(|chunk| chunk.iter()).chain(&self.last).copied()
    }

    /// The newest poses, as many as `count`, and of the older ones, evenly, no more than that: each
    /// second, fourth, eighth and so on.
    pub fn excerpt(&self, count: usize) -> impl Iterator<Item = (Stamp, Pose2)> {
        let older = self.len().saturating_sub(count);
        let stride = older.div_ceil(count).next_power_of_two();
        let chosen = move |index: usize| index >= older || index.is_multiple_of(stride);
        self.iter().enumerate().filter(move |(index, _)| chosen(*index)).map(|(_, pose)| pose)
    }

    /// Adds the pose at the next scan.
    pub fn push(&mut self, stamp: Stamp, pose_in_map: Pose2) {
        self.last.push((stamp, pose_in_map));
        if self.last.len() == CHUNK {
            self.chunks.push(self.last.drain(..).collect());
        }
    }
}

impl Serialize for Path {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut poses = serializer.serialize_seq(Some(self.len()))?;
        self.iter().try_for_each(|pose| poses.serialize_element(&pose))?;
        poses.end()
    }
}

impl TryFrom<Vec<(Stamp, Pose2)>> for Path {
    type Error = StateError;

    fn try_from(poses: Vec<(Stamp, Pose2)>) -> Result<Self, StateError> {
        ensure_poses(poses.iter().map(|(_, pose)| *pose), "a pose of the path")?;
        Ok(poses.into_iter().collect())
    }
}

impl FromIterator<(Stamp, Pose2)> for Path {
    fn from_iter<I: IntoIterator<Item = (Stamp, Pose2)>>(poses: I) -> Self {
        let mut path = Self::default();
        poses.into_iter().for_each(|(stamp, pose_in_map)| path.push(stamp, pose_in_map));
        path
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pose(i: usize) -> (Stamp, Pose2) {
        (Stamp(i as i64), Pose2::new(i as f64, 0.0, 0.0))
    }

    #[test]
    fn an_excerpt_has_the_newest_poses_and_a_few_of_the_older_ones() {
        let excerpt = |length: usize| {
            let path: Path = (0..length).map(pose).collect();
            path.excerpt(3).map(|(stamp, _)| stamp.0).collect::<Vec<_>>()
        };
        assert!(excerpt(0).is_empty());
        assert_eq!(excerpt(6), [0, 1, 2, 3, 4, 5]);
        assert_eq!(excerpt(7), [0, 2, 4, 5, 6]);
        assert_eq!(excerpt(9), [0, 2, 4, 6, 7, 8]);
        assert_eq!(excerpt(10), [0, 4, 7, 8, 9]);
        assert!((0..100).all(|length| excerpt(length).len() <= 6));
    }

    #[test]
    fn poses_stay_in_order_and_copies_do_not_follow() {
        let mut path = Path::default();
        let mut copies = Vec::new();
        for i in 0..3 * CHUNK {
            copies.push(path.clone());
            let (stamp, pose_in_map) = pose(i);
            path.push(stamp, pose_in_map);
        }
        for (length, copy) in copies.iter().enumerate().step_by(97) {
            assert_eq!((copy.len(), copy.is_empty()), (length, length == 0));
            assert!(copy.iter().eq((0..length).map(pose)));
        }
        assert!(path.iter().rev().eq((0..3 * CHUNK).rev().map(pose)));
    }
}
