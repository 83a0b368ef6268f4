//! Where the frames of a robot are to one another, and were a moment ago.
//!
//! Frames hang in trees: each has one parent at most. No clock is read and memory is bounded,
//! whatever arrives.

use std::collections::BTreeMap;
use std::time::Duration;

use nalgebra::{Isometry3, Quaternion, UnitQuaternion};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::slam::pose::Stamp;
use crate::timeline::{Interpolate, Missing, Timeline, TimelineCounts};

/// Robots have tens of frames; senders of nonsense are refused more.
const MOST_FRAMES: usize = 256;

/// Ten seconds at 200 Hz.
const MOST_SAMPLES: usize = 2000;

/// Bytes of a frame's name.
const LONGEST_NAME: usize = 256;

/// Below this angle between two rotations, rad, the chord serves as the arc.
const SMALL_ANGLE: f64 = 1e-6;

/// Where a frame is in its parent.
#[derive(Debug, Clone, PartialEq)]
pub struct Transform {
    /// The frame the other hangs from.
    pub parent: String,
    /// The frame that hangs.
    pub child: String,
    /// When it was there; a static transform is at any time.
    pub stamp: Stamp,
    /// Maps coordinates in the child to coordinates in the parent.
    pub parent_from_child: Isometry3<f64>,
}

/// Whether a transform holds from now on for ever or at its stamp.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// From `tf_static`.
    Static,
    /// From `tf`.
    Dynamic,
}

/// Why a transform is not taken.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum RefusedTransform {
    /// The frames would hang in a ring.
    #[error("`{child}` cannot hang from `{parent}`: that one hangs from `{child}` already")]
    Cycle {
        /// The parent.
        parent: String,
        /// The child.
        child: String,
    },
    /// A frame has no name or far too long a one.
    #[error("a frame's name has {0} bytes; 1 to {LONGEST_NAME} are possible")]
    Name(usize),
    /// There are as many frames as are kept.
    #[error("no room for `{0}`: {MOST_FRAMES} frames are known already")]
    TooManyFrames(String),
}

/// Why one frame's place in another is not known.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum TfError {
    /// Nobody has told of the frame.
    #[error("no transform names the frame `{0}`")]
    UnknownFrame(String),
    /// Both are known, but nothing leads from one to the other.
    #[error(
        "`{target}` and `{source_frame}` are not connected: the one hangs from `{target_root}`, \
         the other from `{source_root}`"
    )]
    Disconnected {
        /// The frame asked for.
        target: String,
        /// The frame to be found in it.
        source_frame: String,
        /// Where the chain of the first ends.
        target_root: String,
        /// Where the chain of the second ends.
        source_root: String,
    },
    /// One link of the chain is not known at that time.
    #[error("where `{child}` is in `{parent}` is not known at that time: {missing}")]
    Missing {
        /// The parent.
        parent: String,
        /// The child.
        child: String,
        /// By how much.
        missing: Missing,
    },
}

/// What became of the transforms that were not simply the newest.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct TfCounts {
    /// Not taken: see [`RefusedTransform`].
    pub refused: u64,
    /// How often a frame came to hang from another parent, or from static became dynamic or back:
    /// its past is forgotten then.
    pub moved: u64,
    /// Of all dynamic frames.
    pub samples: TimelineCounts,
}

/// The frames of a robot over the last seconds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TfBuffer {
    /// By child.
    links: BTreeMap<String, Link>,
    keep: Duration,
    refused: u64,
    moved: u64,
    /// Of the links that were replaced.
    past: TimelineCounts,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Link {
    parent: String,
    place: Place,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
enum Place {
    Static(Isometry3<f64>),
    Dynamic(Timeline<Isometry3<f64>>),
}

impl Link {
    const fn kind(&self) -> Kind {
        match self.place {
            Place::Static(_) => Kind::Static,
            Place::Dynamic(_) => Kind::Dynamic,
        }
    }

    fn counts(&self) -> TimelineCounts {
        match &self.place {
            Place::Static(_) => TimelineCounts::default(),
            Place::Dynamic(timeline) => timeline.counts(),
        }
    }

    fn parent_from_child(&self, stamp: Stamp) -> Result<Isometry3<f64>, Missing> {
        match &self.place {
            Place::Static(place) => Ok(*place),
            Place::Dynamic(timeline) => timeline.at(stamp),
        }
    }
}

impl TfBuffer {
    /// Keeps of each frame the places of the time `keep` before its newest.
    #[must_use]
    pub const fn new(keep: Duration) -> Self {
        Self {
            links: BTreeMap::new(),
            keep,
            refused: 0,
            moved: 0,
            past: TimelineCounts {
                duplicates: 0,
                reordered: 0,
                stale: 0,
                crowded_out: 0,
                restarts: 0,
            },
        }
    }

    /// Whether it is such as inserting makes it; of one that was read, nobody knows.
    #[must_use]
    pub fn is_sound(&self) -> bool {
        let named = |name: &String| !name.is_empty() && name.len() <= LONGEST_NAME;
        let ends = |frame: &String| self.chain(frame).nth(self.links.len() + 1).is_none();
        let usable = |place: &Place| match place {
            Place::Static(place) => place.to_homogeneous().iter().all(|n| n.is_finite()),
            Place::Dynamic(timeline) => timeline.is_sound(),
        };
        self.links.len() <= MOST_FRAMES
            && self.links.keys().all(|name| named(name) && ends(name))
            && self.links.values().all(|link| named(&link.parent) && usable(&link.place))
    }

    /// Takes a transform. The latest message decides what a frame hangs from.
    ///
    /// # Errors
    /// When it does not fit in with the others; it is counted, and nothing changes.
    pub fn insert(&mut self, transform: &Transform, kind: Kind) -> Result<(), RefusedTransform> {
        let inserted = self.try_insert(transform, kind);
        self.refused += u64::from(inserted.is_err());
        inserted
    }

    fn try_insert(&mut self, transform: &Transform, kind: Kind) -> Result<(), RefusedTransform> {
        let parent = without_slash(&transform.parent);
        let child = without_slash(&transform.child);
        let known = self.links.get(child);
        if known.is_none_or(|link| link.parent != parent || link.kind() != kind) {
            self.hang(parent, child, kind)?;
        }
        if let Some(link) = self.links.get_mut(child) {
            match &mut link.place {
                Place::Static(place) => *place = transform.parent_from_child,
                Place::Dynamic(timeline) => {
                    timeline.insert(transform.stamp, transform.parent_from_child);
                }
            }
        }
        Ok(())
    }

    /// Makes a new link from `child` to `parent`, in the place of one there may be.
    fn hang(&mut self, parent: &str, child: &str, kind: Kind) -> Result<(), RefusedTransform> {
        for name in [parent, child] {
            if name.is_empty() || name.len() > LONGEST_NAME {
                return Err(RefusedTransform::Name(name.len()));
            }
        }
        if self.chain(parent).any(|ancestor| ancestor == child) {
            let (parent, child) = (parent.to_owned(), child.to_owned());
            return Err(RefusedTransform::Cycle { parent, child });
        }
        if self.links.len() >= MOST_FRAMES && !self.links.contains_key(child) {
            return Err(RefusedTransform::TooManyFrames(child.to_owned()));
        }
        let place = match kind {
            Kind::Static => Place::Static(Isometry3::identity()),
            Kind::Dynamic => Place::Dynamic(Timeline::new(self.keep, MOST_SAMPLES)),
        };
        let link = Link { parent: parent.to_owned(), place };
        if let Some(replaced) = self.links.insert(child.to_owned(), link) {
            self.moved += 1;
            self.past = sum(self.past, replaced.counts());
        }
        Ok(())
    }

    /// Where `source` is in `target` at a stamp: maps coordinates in `source` to `target`.
    ///
    /// # Errors
    /// When a frame or its place at that time is not known; the error says by how much.
    pub fn target_from_source(
        &self,
        target: &str,
        source: &str,
        stamp: Stamp,
    ) -> Result<Isometry3<f64>, TfError> {
        let (target, source) = (without_slash(target), without_slash(source));
        for frame in [target, source] {
            if !self.knows(frame) {
                return Err(TfError::UnknownFrame(frame.to_owned()));
            }
        }
        let shared = self
            .chain(source)
            .find(|ancestor| self.chain(target).any(|other| other == *ancestor))
            .ok_or_else(|| self.disconnected(target, source))?;
        let shared_from_target = self.ancestor_from_frame(shared, target, stamp)?;
        let shared_from_source = self.ancestor_from_frame(shared, source, stamp)?;
        Ok(shared_from_target.inv_mul(&shared_from_source))
    }

    /// Whether where `frame` is in its parent tells part of the way between two other frames.
    #[must_use]
    pub fn is_between(&self, frame: &str, target: &str, source: &str) -> bool {
        let frame = without_slash(frame);
        let hangs = |from| self.chain(without_slash(from)).any(|ancestor| ancestor == frame);
        self.links.contains_key(frame) && hangs(source) != hangs(target)
    }

    /// The frames that transforms have named, in the order of the alphabet.
    #[must_use]
    pub fn frames(&self) -> Vec<&str> {
        let parents = self.links.values().map(|link| link.parent.as_str());
        let mut frames: Vec<&str> = self.links.keys().map(String::as_str).chain(parents).collect();
        frames.sort_unstable();
        frames.dedup();
        frames
    }

    /// What became of the transforms so far.
    #[must_use]
    pub fn counts(&self) -> TfCounts {
        let samples = self.links.values().map(Link::counts).fold(self.past, sum);
        TfCounts { refused: self.refused, moved: self.moved, samples }
    }

    fn knows(&self, frame: &str) -> bool {
        self.links.contains_key(frame) || self.links.values().any(|link| link.parent == frame)
    }

    /// The frame and all it hangs from, up to the root. It ends, for rings are refused.
    fn chain<'a>(&'a self, frame: &'a str) -> impl Iterator<Item = &'a str> {
        std::iter::successors(Some(frame), |&frame| {
            self.links.get(frame).map(|link| link.parent.as_str())
        })
    }

    fn ancestor_from_frame(
        &self,
        ancestor: &str,
        frame: &str,
        stamp: Stamp,
    ) -> Result<Isometry3<f64>, TfError> {
        let mut ancestor_from_frame = Isometry3::identity();
        for child in self.chain(frame).take_while(|&child| child != ancestor) {
            let Some(link) = self.links.get(child) else { break };
            let parent_from_child = link.parent_from_child(stamp).map_err(|missing| {
                let (parent, child) = (link.parent.clone(), child.to_owned());
                TfError::Missing { parent, child, missing }
            })?;
            ancestor_from_frame = parent_from_child * ancestor_from_frame;
        }
        Ok(ancestor_from_frame)
    }

    fn disconnected(&self, target: &str, source: &str) -> TfError {
        let root = |frame| self.chain(frame).last().unwrap_or_default().to_owned();
        TfError::Disconnected {
            target: target.to_owned(),
            source_frame: source.to_owned(),
            target_root: root(target),
            source_root: root(source),
        }
    }
}

/// ROS 1 wrote `/odom` for `odom`, and some senders still do.
fn without_slash(frame: &str) -> &str {
    frame.strip_prefix('/').unwrap_or(frame)
}

const fn sum(a: TimelineCounts, b: TimelineCounts) -> TimelineCounts {
    TimelineCounts {
        duplicates: a.duplicates + b.duplicates,
        reordered: a.reordered + b.reordered,
        stale: a.stale + b.stale,
        crowded_out: a.crowded_out + b.crowded_out,
        restarts: a.restarts + b.restarts,
    }
}

impl Interpolate for Isometry3<f64> {
    /// Straight ahead, and turning evenly the shorter way round.
    fn interpolate(&self, later: &Self, fraction: f64) -> Self {
        let translation = self.translation.vector.lerp(&later.translation.vector, fraction);
        Self::from_parts(translation.into(), slerp(&self.rotation, &later.rotation, fraction))
    }
}

/// Spherical interpolation, with sines that are the same on every machine.
fn slerp(
    earlier: &UnitQuaternion<f64>,
    later: &UnitQuaternion<f64>,
    fraction: f64,
) -> UnitQuaternion<f64> {
    let (a, b) = (earlier.quaternion(), later.quaternion());
    let cosine = a.dot(b);
    // q and -q are the same rotation: take the nearer one.
    let b = if cosine < 0.0 { -b } else { *b };
    let angle = libm::acos(cosine.abs().min(1.0));
    let weights = if angle < SMALL_ANGLE {
        [1.0 - fraction, fraction]
    } else {
        let sine = libm::sin(angle);
        [libm::sin((1.0 - fraction) * angle) / sine, libm::sin(fraction * angle) / sine]
    };
    let between: Quaternion<f64> = a * weights[0] + b * weights[1];
    UnitQuaternion::new_normalize(between)
}

#[cfg(test)]
mod tests {
    use nalgebra::{Translation3, Vector3};
    use proptest::prelude::{Strategy, prop_assert, proptest};

    use super::*;

    const MILLISECOND: i64 = 1_000_000;

    fn stamp(milliseconds: i64) -> Stamp {
        Stamp(milliseconds * MILLISECOND)
    }

    fn place(x: f64, yaw: f64) -> Isometry3<f64> {
        let rotation = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw);
        Isometry3::from_parts(Translation3::new(x, 0.0, 0.0), rotation)
    }

    fn transform(parent: &str, child: &str, at: i64, place: Isometry3<f64>) -> Transform {
        Transform {
            parent: parent.to_owned(),
            child: child.to_owned(),
            stamp: stamp(at),
            parent_from_child: place,
        }
    }

    fn near(a: &Isometry3<f64>, b: &Isometry3<f64>) -> bool {
        (a.translation.vector - b.translation.vector).norm() < 1e-9
            && a.rotation.angle_to(&b.rotation) < 1e-6
    }

    /// odom > base > {laser, camera}: the base drives 1 m/s, the sensors are fixed.
    fn robot() -> TfBuffer {
        let mut buffer = TfBuffer::new(Duration::from_secs(10));
        for at in [0, 100, 200] {
            let base = transform("odom", "base", at, place(at as f64 / 1000.0, 0.0));
            buffer.insert(&base, Kind::Dynamic).unwrap();
        }
        buffer.insert(&transform("base", "laser", 0, place(0.5, 3.0)), Kind::Static).unwrap();
        buffer.insert(&transform("base", "camera", 0, place(-0.5, 0.0)), Kind::Static).unwrap();
        buffer
    }

    #[test]
    fn a_chain_is_composed_at_its_stamp() {
        let odom_from_laser = robot().target_from_source("odom", "laser", stamp(150)).unwrap();
        assert!(near(&odom_from_laser, &place(0.65, 3.0)), "{odom_from_laser}");
    }

    #[test]
    fn branches_meet_at_the_shared_ancestor_and_need_nothing_above_it() {
        let camera_from_laser =
            robot().target_from_source("camera", "laser", stamp(99_999)).unwrap();
        assert!(near(&camera_from_laser, &place(1.0, 3.0)), "{camera_from_laser}");
        let same = robot().target_from_source("base", "base", stamp(99_999)).unwrap();
        assert_eq!(same, Isometry3::identity());
    }

    #[test]
    fn a_leading_slash_is_no_part_of_a_name() {
        let mut buffer = robot();
        buffer.insert(&transform("/odom", "/base", 300, place(0.3, 0.0)), Kind::Dynamic).unwrap();
        assert!(buffer.target_from_source("/odom", "base", stamp(250)).is_ok());
        assert_eq!(buffer.frames(), ["base", "camera", "laser", "odom"]);
    }

    #[test]
    fn errors_say_what_is_missing_and_by_how_much() {
        let mut buffer = robot();
        let error = |buffer: &TfBuffer, target, source, at| {
            buffer.target_from_source(target, source, stamp(at)).unwrap_err().to_string()
        };
        assert_eq!(
            error(&buffer, "odom", "laser", 233),
            "where `base` is in `odom` is not known at that time: the newest sample is 33.000 ms \
             too old"
        );
        assert_eq!(
            error(&buffer, "laser", "odom", -5),
            "where `base` is in `odom` is not known at that time: the oldest sample is 5.000 ms \
             too new"
        );
        assert_eq!(error(&buffer, "map", "laser", 0), "no transform names the frame `map`");
        buffer.insert(&transform("map", "door", 0, place(0.0, 0.0)), Kind::Static).unwrap();
        assert_eq!(
            error(&buffer, "door", "laser", 0),
            "`door` and `laser` are not connected: the one hangs from `map`, the other from `odom`"
        );
    }

    #[test]
    fn rings_are_refused() {
        let mut buffer = robot();
        let error = buffer.insert(&transform("laser", "odom", 0, place(0.0, 0.0)), Kind::Static);
        assert_eq!(
            error.unwrap_err().to_string(),
            "`odom` cannot hang from `laser`: that one hangs from `odom` already"
        );
        let own = buffer.insert(&transform("base", "base", 0, place(0.0, 0.0)), Kind::Dynamic);
        assert!(matches!(own, Err(RefusedTransform::Cycle { .. })));
        assert_eq!(buffer.counts().refused, 2);
        assert!(buffer.target_from_source("odom", "laser", stamp(0)).is_ok());
    }

    #[test]
    fn the_latest_message_decides_what_a_frame_hangs_from() {
        let mut buffer = robot();
        buffer.insert(&transform("base", "laser", 1, place(0.7, 0.0)), Kind::Static).unwrap();
        assert_eq!(buffer.counts().moved, 0);
        buffer.insert(&transform("camera", "laser", 1, place(0.1, 0.0)), Kind::Static).unwrap();
        let base_from_laser = buffer.target_from_source("base", "laser", stamp(0)).unwrap();
        assert!(near(&base_from_laser, &place(-0.4, 0.0)), "{base_from_laser}");

        buffer.insert(&transform("odom", "base", 0, place(9.0, 0.0)), Kind::Dynamic).unwrap();
        buffer.insert(&transform("odom", "base", 0, place(9.0, 0.0)), Kind::Static).unwrap();
        let odom_from_base = buffer.target_from_source("odom", "base", stamp(99_999)).unwrap();
        assert!(near(&odom_from_base, &place(9.0, 0.0)));
        let counts = buffer.counts();
        assert_eq!((counts.moved, counts.samples.duplicates), (2, 1));
    }

    #[test]
    fn frames_and_their_names_are_bounded() {
        let mut buffer = TfBuffer::new(Duration::from_secs(10));
        let mut hang_from = |parent: &str, child: &str| {
            buffer.insert(&transform(parent, child, 0, place(0.0, 0.0)), Kind::Dynamic)
        };
        hang_from("map", "base").unwrap();
        let mut hang = |child: &str| hang_from("base", child);
        for index in 1..MOST_FRAMES {
            hang(&format!("frame{index}")).unwrap();
        }
        let error = hang("one_more").unwrap_err();
        assert_eq!(error.to_string(), "no room for `one_more`: 256 frames are known already");
        hang("frame1").unwrap();
        assert_eq!(hang("").unwrap_err(), RefusedTransform::Name(0));
        let error = hang(&"x".repeat(257)).unwrap_err();
        assert_eq!(error.to_string(), "a frame's name has 257 bytes; 1 to 256 are possible");
        hang_from("frame1", "frame2").unwrap();
        assert_eq!(buffer.counts().refused, 3);
    }

    #[test]
    fn a_link_is_between_two_frames_or_it_is_not() {
        let mut buffer = TfBuffer::new(Duration::from_secs(10));
        for (parent, child) in [("odom", "foot"), ("foot", "base"), ("base", "laser")] {
            buffer.insert(&transform(parent, child, 0, place(0.3, 0.0)), Kind::Dynamic).unwrap();
        }
        let between = |frame| buffer.is_between(frame, "/odom", "base");
        assert!(between("base") && between("/foot"));
        assert!(!between("laser") && !between("odom") && !between("nobody"));
        assert!(buffer.is_between("laser", "laser", "foot"));
    }

    fn rotations() -> impl Strategy<Value = UnitQuaternion<f64>> {
        proptest::array::uniform4(-1.0..1.0_f64)
            .prop_filter("too short to normalise", |q| q.iter().map(|c| c * c).sum::<f64>() > 0.01)
            .prop_map(|[x, y, z, w]| UnitQuaternion::new_normalize(Quaternion::new(w, x, y, z)))
    }

    proptest! {
        #[test]
        fn slerp_turns_evenly(a in rotations(), b in rotations(), fraction in 0.0..1.0_f64) {
            let whole = a.angle_to(&b);
            let between = slerp(&a, &b, fraction);
            prop_assert!((a.angle_to(&between) - fraction * whole).abs() < 1e-6);
            prop_assert!((between.angle_to(&b) - (1.0 - fraction) * whole).abs() < 1e-6);
            prop_assert!((between.norm() - 1.0).abs() < 1e-12);
            prop_assert!(slerp(&a, &b, 0.0).angle_to(&a) < 1e-6);
            prop_assert!(slerp(&a, &b, 1.0).angle_to(&b) < 1e-6);
        }

        /// Small turns, as between two messages, where the sines cancel.
        #[test]
        fn slerp_is_exact_for_small_turns(a in rotations(), turn in 1e-9..1e-4_f64) {
            let b = a * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), turn);
            let half = a * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), turn / 2.0);
            let difference = slerp(&a, &b, 0.5).quaternion() - half.quaternion();
            prop_assert!(difference.norm() < 1e-12, "{}", difference.norm());
        }

        #[test]
        fn there_and_back_is_the_identity(at in 0..200_i64, yaw in -3.0..3.0_f64) {
            let mut buffer = robot();
            buffer.insert(&transform("base", "arm", 0, place(0.3, yaw)), Kind::Static).unwrap();
            let odom_from_arm = buffer.target_from_source("odom", "arm", stamp(at)).unwrap();
            let arm_from_odom = buffer.target_from_source("arm", "odom", stamp(at)).unwrap();
            prop_assert!(near(&(odom_from_arm * arm_from_odom), &Isometry3::identity()));
        }
    }
}
