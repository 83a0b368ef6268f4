//! What the transforms say: where the laser sits, and where odometry believes the base is.

use std::collections::VecDeque;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::convert::{self, ConvertError};
use crate::slam::pose::{Pose2, Stamp};
use crate::slam::scan::LaserMount;
use crate::slam::state::{StateError, ensure};
use crate::tf::{Kind, RefusedTransform, TfBuffer, TfCounts, TfError, Transform};
use crate::timeline::Missing;

/// How much of the past is kept.
const KEEP: Duration = Duration::from_secs(10);

/// Stamps at which a part of the way from odometry to the base is known, and another not yet.
const MOST_UNRESOLVED: usize = 256;

/// The frames' names.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FrameNames {
    /// The robot.
    pub base: String,
    /// Where odometry began.
    pub odom: String,
}

/// Why it is not known how a laser sits.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum MountError {
    /// The scan does not say which laser it is from.
    #[error(
        "the scan's frame_id is empty, so nobody knows where on `{base}` its laser sits; fill in \
         frame_id and publish its transform on {tf_static}, or set laser in the configuration"
    )]
    NoFrame {
        /// The base's frame.
        base: String,
        /// The key of static transforms.
        tf_static: String,
    },
    /// No transform leads there.
    #[error(
        "where the laser `{laser}` sits on `{base}` is not known: {reason}; publish the transform \
         on {tf_static}, or set laser in the configuration"
    )]
    Unknown {
        /// The scan's frame.
        laser: String,
        /// The base's frame.
        base: String,
        /// What is missing.
        reason: Box<TfError>,
        /// The key of static transforms.
        tf_static: String,
    },
    /// The laser does not scan parallel to the floor.
    #[error("`{laser}` cannot be used: {reason}")]
    Tilted {
        /// The scan's frame.
        laser: String,
        /// By how much.
        reason: ConvertError,
    },
}

/// The transforms of the robot.
#[derive(Debug)]
pub struct Frames {
    names: FrameNames,
    /// How the laser sits, if the configuration says so.
    configured: Option<LaserMount>,
    /// The key of static transforms, for messages.
    tf_static: String,
    buffer: TfBuffer,
    unresolved: VecDeque<Stamp>,
}

/// The transforms as plain data.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FramesState {
    buffer: TfBuffer,
    unresolved: VecDeque<Stamp>,
}

impl FramesState {
    /// Looks whether all parts fit together.
    ///
    /// # Errors
    /// When frames hang in a ring, or there are more than are kept.
    pub fn check(&self) -> Result<(), StateError> {
        let few = self.unresolved.len() <= MOST_UNRESOLVED;
        ensure(few && self.buffer.is_sound(), "transforms")
    }
}

impl Frames {
    /// The transforms as plain data.
    #[must_use]
    pub fn state(&self) -> FramesState {
        FramesState { buffer: self.buffer.clone(), unresolved: self.unresolved.clone() }
    }

    /// Goes on from a state.
    pub fn resume(&mut self, FramesState { buffer, unresolved }: FramesState) {
        (self.buffer, self.unresolved) = (buffer, unresolved);
    }

    /// No transform yet; `configured` overrides what transforms will say of the laser.
    #[must_use]
    pub const fn new(names: FrameNames, configured: Option<LaserMount>, tf_static: String) -> Self {
        let buffer = TfBuffer::new(KEEP);
        Self { names, configured, tf_static, buffer, unresolved: VecDeque::new() }
    }

    /// Takes a transform.
    ///
    /// # Errors
    /// When it does not fit in with the others.
    pub fn insert(&mut self, transform: &Transform, kind: Kind) -> Result<(), RefusedTransform> {
        self.buffer.insert(transform, kind)?;
        let FrameNames { base, odom } = &self.names;
        let on_the_way = || self.buffer.is_between(&transform.child, odom, base);
        if kind == Kind::Dynamic && !self.unresolved.contains(&transform.stamp) && on_the_way() {
            self.unresolved.push_back(transform.stamp);
            if self.unresolved.len() > MOST_UNRESOLVED {
                self.unresolved.pop_front();
            }
        }
        Ok(())
    }

    /// The base in `odom` at the stamps of transforms, each once and as soon as it is known.
    pub fn new_odometry(&mut self) -> Vec<(Stamp, Result<Pose2, ConvertError>)> {
        let mut known = Vec::new();
        let FrameNames { base, odom } = &self.names;
        let buffer = &self.buffer;
        self.unresolved.retain(|&stamp| {
            match buffer.target_from_source(odom, base, stamp) {
                Ok(odom_from_base) => known.push((stamp, convert::base_pose(&odom_from_base))),
                // One part of the way is known later than another.
                Err(TfError::Missing { missing: Missing::TooNew(_), .. }) => return true,
                Err(_) => {}
            }
            false
        });
        known
    }

    /// How the laser sits that took a scan.
    ///
    /// # Errors
    /// When that is not known, or the laser is tilted.
    pub fn mount(&self, laser: &str, stamp: Stamp) -> Result<LaserMount, MountError> {
        if let Some(mount) = self.configured {
            return Ok(mount);
        }
        let FrameNames { base, .. } = &self.names;
        let laser = laser.strip_prefix('/').unwrap_or(laser);
        if laser.is_empty() {
            let (base, tf_static) = (base.clone(), self.tf_static.clone());
            return Err(MountError::NoFrame { base, tf_static });
        }
        if laser == base.strip_prefix('/').unwrap_or(base) {
            return Ok(LaserMount::default());
        }
        let base_from_laser =
            self.buffer.target_from_source(base, laser, stamp).map_err(|reason| {
                MountError::Unknown {
                    laser: laser.to_owned(),
                    base: base.clone(),
                    reason: Box::new(reason),
                    tf_static: self.tf_static.clone(),
                }
            })?;
        convert::laser_mount(&base_from_laser)
            .map_err(|reason| MountError::Tilted { laser: laser.to_owned(), reason })
    }

    /// What became of the transforms so far.
    #[must_use]
    pub fn counts(&self) -> TfCounts {
        self.buffer.counts()
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

    use super::*;

    fn frames() -> Frames {
        let names = FrameNames { base: "base_link".to_owned(), odom: "odom".to_owned() };
        Frames::new(names, None, "robot01/tf_static".to_owned())
    }

    fn at(parent: &str, child: &str, stamp: i64, x: f64) -> Transform {
        Transform {
            parent: parent.to_owned(),
            child: child.to_owned(),
            stamp: Stamp(stamp),
            parent_from_child: Isometry3::translation(x, 0.0, 0.0),
        }
    }

    #[test]
    fn odometry_is_told_once_when_the_whole_way_is_known() {
        let mut frames = frames();
        let mut told = |transform: &Transform| {
            frames.insert(transform, Kind::Dynamic).unwrap();
            let odometry = frames.new_odometry();
            odometry.into_iter().map(|(stamp, pose)| (stamp.0, pose.unwrap().x)).collect()
        };
        let none: [(i64, f64); 0] = [];
        let mut check = |transform: Transform, expected: &[(i64, f64)]| {
            let odometry: Vec<(i64, f64)> = told(&transform);
            assert_eq!(odometry, expected);
        };
        check(at("odom", "foot", 10, 1.0), &none);
        check(at("foot", "base_link", 10, 0.5), &[(10, 1.5)]);
        check(at("odom", "foot", 20, 2.0), &none);
        check(at("odom", "foot", 30, 3.0), &none);
        check(at("base_link", "wheel", 25, 0.1), &none);
        check(at("foot", "base_link", 30, 0.5), &[(20, 2.5), (30, 3.5)]);
    }

    #[test]
    fn a_laser_sits_where_transforms_say_or_the_configuration_or_on_the_base() {
        let mut frames = frames();
        frames.insert(&at("base_link", "laser", 0, 0.2), Kind::Static).unwrap();
        let x = |frames: &Frames, laser| frames.mount(laser, Stamp(5)).unwrap().base_from_laser.x;
        assert_eq!(x(&frames, "laser"), 0.2);
        assert_eq!(x(&frames, "/laser"), 0.2);
        assert_eq!(x(&frames, "base_link"), 0.0);
        let base_from_laser = Pose2::new(0.7, 0.0, 0.0);
        frames.configured = Some(LaserMount { base_from_laser, ..LaserMount::default() });
        assert_eq!(x(&frames, "laser"), 0.7);
        assert_eq!(x(&frames, "nobody"), 0.7);
    }

    #[test]
    fn an_unknown_or_tilted_laser_is_named_with_the_remedies() {
        let mut frames = frames();
        let error = |frames: &Frames, laser| frames.mount(laser, Stamp(5)).unwrap_err().to_string();
        assert_eq!(
            error(&frames, "laser"),
            "where the laser `laser` sits on `base_link` is not known: no transform names the \
             frame `base_link`; publish the transform on robot01/tf_static, or set laser in the \
             configuration"
        );
        assert!(error(&frames, "").contains("frame_id is empty"));
        let tilt = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), 0.1);
        let parent_from_child = Isometry3::from_parts(Translation3::identity(), tilt);
        let tilted = Transform { parent_from_child, ..at("base_link", "laser", 0, 0.0) };
        frames.insert(&tilted, Kind::Static).unwrap();
        assert_eq!(
            error(&frames, "laser"),
            "`laser` cannot be used: the laser is tilted by 5.73 degrees against the plane; \
             mapping allows 2.56"
        );
    }
}
