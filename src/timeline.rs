//! Stamped samples of something that moves, and its value between them.
//!
//! No clock is read: "old" means long before the newest sample. Memory is bounded whatever
//! arrives.

use std::collections::VecDeque;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::slam::pose::{Pose2, Stamp, wrap_angle};

/// A sample may come this much after a newer one and is sorted in, ns.
///
/// What comes later still is from a clock that was set back, or of no use any more.
const MOST_REORDERING: i64 = 500_000_000;

/// Something with values between two of its values.
pub trait Interpolate: Clone {
    /// The value at `fraction` of the way from `self`, which is 0, to `later`, which is 1.
    #[must_use]
    fn interpolate(&self, later: &Self, fraction: f64) -> Self;
}

impl Interpolate for Pose2 {
    /// Straight ahead, and the shorter way round.
    fn interpolate(&self, later: &Self, fraction: f64) -> Self {
        let turn = wrap_angle(later.theta - self.theta);
        Self::new(
            self.x + fraction * (later.x - self.x),
            self.y + fraction * (later.y - self.y),
            wrap_angle(self.theta + fraction * turn),
        )
    }
}

/// Poses of the base as odometry tells them.
pub type OdometryBuffer = Timeline<Pose2>;

/// The samples of the last seconds, in the order of their stamps.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Timeline<T> {
    samples: VecDeque<(Stamp, T)>,
    /// The last sample, if it came too late: one more such, and the clock was set back.
    suspect: Option<(Stamp, T)>,
    /// Nanoseconds from the oldest sample to the newest.
    keep: i64,
    most_samples: usize,
    counts: TimelineCounts,
}

/// What became of the samples that were not simply the newest.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct TimelineCounts {
    /// Dropped: there was one with the same stamp.
    pub duplicates: u64,
    /// Kept: came after a newer one.
    pub reordered: u64,
    /// Dropped: came too long after newer ones.
    pub stale: u64,
    /// Dropped to make room, although young enough to keep.
    pub crowded_out: u64,
    /// How often all samples were forgotten because the clock was set back.
    pub restarts: u64,
}

/// Why there is no value at a stamp.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum Missing {
    /// There are no samples at all.
    #[error("there is no sample yet")]
    Empty,
    /// The oldest sample is from after the stamp.
    #[error("the oldest sample is {:.3} ms too new", milliseconds(*.0))]
    TooOld(Duration),
    /// The newest sample is from before the stamp: the right one may still come.
    #[error("the newest sample is {:.3} ms too old", milliseconds(*.0))]
    TooNew(Duration),
}

fn milliseconds(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1e3
}

impl<T: Interpolate> Timeline<T> {
    /// Keeps the samples of the time `keep` before the newest, and never more than `most_samples`.
    #[must_use]
    pub fn new(keep: Duration, most_samples: usize) -> Self {
        Self {
            samples: VecDeque::new(),
            suspect: None,
            keep: i64::try_from(keep.as_nanos()).unwrap_or(i64::MAX),
            most_samples,
            counts: TimelineCounts::default(),
        }
    }

    /// Takes a sample; those with the stamp of an earlier one and those that are late are counted.
    pub fn insert(&mut self, stamp: Stamp, value: T) {
        let newest = self.newest().unwrap_or(stamp);
        if newest.0.saturating_sub(stamp.0) > MOST_REORDERING {
            self.suspect_clock(stamp, value);
            return;
        }
        self.suspect = None;
        let position = self.samples.partition_point(|(other, _)| *other < stamp);
        if self.samples.get(position).is_some_and(|(other, _)| *other == stamp) {
            self.counts.duplicates += 1;
            return;
        }
        self.counts.reordered += u64::from(position < self.samples.len());
        self.samples.insert(position, (stamp, value));
        self.forget_old();
    }

    /// Two late samples in succession, in order, are not late: the clock was set back.
    fn suspect_clock(&mut self, stamp: Stamp, value: T) {
        match self.suspect.take() {
            Some((first, value)) if stamp == first => {
                self.counts.duplicates += 1;
                self.suspect = Some((stamp, value));
            }
            Some(first) if stamp > first.0 && stamp.0.saturating_sub(first.0.0) <= self.keep => {
                self.counts.stale -= 1;
                self.counts.restarts += 1;
                self.samples = VecDeque::from([first, (stamp, value)]);
                self.forget_old();
            }
            _ => {
                self.counts.stale += 1;
                self.suspect = Some((stamp, value));
            }
        }
    }

    fn forget_old(&mut self) {
        let Some(newest) = self.newest() else { return };
        let keep = self.keep;
        while self.oldest().is_some_and(|oldest| newest.0.saturating_sub(oldest.0) > keep) {
            self.samples.pop_front();
        }
        while self.samples.len() > self.most_samples {
            self.samples.pop_front();
            self.counts.crowded_out += 1;
        }
    }

    /// Forgets all samples: what comes next has nothing to do with them.
    pub fn clear(&mut self) {
        self.samples.clear();
        self.suspect = None;
    }

    /// Whether it is such as inserting makes it; of one that was read, nobody knows.
    #[must_use]
    pub fn is_sound(&self) -> bool {
        self.samples.iter().is_sorted_by(|a, b| a.0 < b.0)
            && self.samples.len() <= self.most_samples
            && (self.suspect.is_none() || self.counts.stale > 0)
    }

    /// Whether a sample with this stamp would come too long after newer ones.
    #[must_use]
    pub fn is_too_late(&self, stamp: Stamp) -> bool {
        self.newest().is_some_and(|newest| newest.0.saturating_sub(stamp.0) > MOST_REORDERING)
    }

    /// Counts a sample that came before already and is not looked at.
    pub fn count_duplicate(&mut self) {
        self.counts.duplicates += 1;
    }

    /// The value at a stamp, between the samples before and after it.
    ///
    /// At the stamp of a sample it is that sample, bit by bit.
    ///
    /// # Errors
    /// When the stamp is not between two samples.
    pub fn at(&self, stamp: Stamp) -> Result<T, Missing> {
        let position = self.samples.partition_point(|(other, _)| *other < stamp);
        let Some((after, later)) = self.samples.get(position) else {
            return Err(self.newest().map_or(Missing::Empty, |newest| {
                Missing::TooNew(Duration::from_nanos(stamp.0.abs_diff(newest.0)))
            }));
        };
        if *after == stamp {
            return Ok(later.clone());
        }
        let before = position.checked_sub(1).and_then(|position| self.samples.get(position));
        let Some((before, earlier)) = before else {
            return Err(Missing::TooOld(Duration::from_nanos(after.0.abs_diff(stamp.0))));
        };
        let fraction = stamp.seconds_since(*before) / after.seconds_since(*before);
        Ok(earlier.interpolate(later, fraction))
    }

    /// The stamp of the first sample at or after a stamp.
    #[must_use]
    pub fn next(&self, stamp: Stamp) -> Option<Stamp> {
        let position = self.samples.partition_point(|(other, _)| *other < stamp);
        self.samples.get(position).map(|(stamp, _)| *stamp)
    }

    /// The samples after one stamp, or from the oldest on, and up to another, which is included.
    pub fn between(&self, after: Option<Stamp>, until: Stamp) -> impl Iterator<Item = &(Stamp, T)> {
        let from = after.map_or(0, |after| self.samples.partition_point(|(s, _)| *s <= after));
        let to = self.samples.partition_point(|(s, _)| *s <= until);
        self.samples.range(from..to.max(from))
    }

    /// The stamp of the oldest sample.
    #[must_use]
    pub fn oldest(&self) -> Option<Stamp> {
        self.samples.front().map(|(stamp, _)| *stamp)
    }

    /// The stamp of the newest sample.
    #[must_use]
    pub fn newest(&self) -> Option<Stamp> {
        self.samples.back().map(|(stamp, _)| *stamp)
    }

    /// How many samples are kept.
    #[must_use]
    pub fn len(&self) -> usize {
        self.samples.len()
    }

    /// Whether no sample is kept.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.samples.is_empty()
    }

    /// What became of the samples so far.
    #[must_use]
    pub const fn counts(&self) -> TimelineCounts {
        self.counts
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use proptest::collection::vec;
    use proptest::prelude::{any, prop_assert, prop_assert_eq, proptest};

    use super::*;

    const SECOND: i64 = 1_000_000_000;

    fn buffer() -> OdometryBuffer {
        Timeline::new(Duration::from_secs(10), 100)
    }

    fn milliseconds(stamp: i64) -> Stamp {
        Stamp(1_700_000_000 * SECOND + stamp * 1_000_000)
    }

    fn pose(x: f64) -> Pose2 {
        Pose2::new(x, 2.0 * x, 0.0)
    }

    fn filled(stamps: &[i64]) -> OdometryBuffer {
        let mut buffer = buffer();
        for &stamp in stamps {
            buffer.insert(milliseconds(stamp), pose(stamp as f64));
        }
        buffer
    }

    #[test]
    fn between_samples_the_pose_is_on_the_way() {
        let buffer = filled(&[0, 100, 200]);
        assert_eq!(buffer.at(milliseconds(25)), Ok(pose(25.0)));
        assert_eq!(buffer.at(milliseconds(100)), Ok(pose(100.0)));
        assert_eq!(buffer.at(milliseconds(175)), Ok(pose(175.0)));
    }

    #[test]
    fn turns_take_the_shorter_way() {
        let (earlier, later) = (Pose2::new(0.0, 0.0, PI - 0.1), Pose2::new(0.0, 0.0, -PI + 0.3));
        let theta = earlier.interpolate(&later, 0.25).theta;
        assert!((theta - PI).abs() < 1e-12, "{theta}");
        let theta = later.interpolate(&earlier, 0.25).theta;
        assert!((theta - (-PI + 0.2)).abs() < 1e-12, "{theta}");
    }

    #[test]
    fn a_stretch_begins_after_one_stamp_and_ends_with_another() {
        let buffer = filled(&[0, 100, 200, 300]);
        let stretch = |after: Option<i64>, until: i64| -> Vec<f64> {
            let samples = buffer.between(after.map(milliseconds), milliseconds(until));
            samples.map(|(_, pose)| pose.x).collect()
        };
        assert_eq!(stretch(None, 100), [0.0, 100.0]);
        assert_eq!(stretch(Some(100), 250), [200.0]);
        assert_eq!(stretch(Some(50), 300), [100.0, 200.0, 300.0]);
        assert_eq!(stretch(Some(300), 100), [0.0; 0]);
        assert_eq!(buffer.next(milliseconds(100)), Some(milliseconds(100)));
        assert_eq!(buffer.next(milliseconds(101)), Some(milliseconds(200)));
        assert_eq!(buffer.next(milliseconds(301)), None);
    }

    #[test]
    fn errors_tell_by_how_much_a_sample_is_missing() {
        let buffer = filled(&[0, 100]);
        let error = buffer.at(milliseconds(-20)).unwrap_err();
        assert_eq!(error.to_string(), "the oldest sample is 20.000 ms too new");
        let error = buffer.at(milliseconds(133)).unwrap_err();
        assert_eq!(error.to_string(), "the newest sample is 33.000 ms too old");
        assert_eq!(error, Missing::TooNew(Duration::from_millis(33)));
        assert_eq!(super::tests::buffer().at(milliseconds(0)), Err(Missing::Empty));
    }

    #[test]
    fn samples_that_overtook_each_other_are_sorted() {
        let buffer = filled(&[0, 200, 100, 300]);
        assert_eq!(buffer.at(milliseconds(150)), Ok(pose(150.0)));
        assert_eq!(buffer.counts(), TimelineCounts { reordered: 1, ..TimelineCounts::default() });
    }

    #[test]
    fn of_two_samples_with_one_stamp_the_first_is_kept() {
        let mut buffer = filled(&[0, 100]);
        buffer.insert(milliseconds(0), pose(7.0));
        buffer.insert(milliseconds(100), pose(7.0));
        assert_eq!(buffer.at(milliseconds(100)), Ok(pose(100.0)));
        assert_eq!(buffer.counts(), TimelineCounts { duplicates: 2, ..TimelineCounts::default() });
    }

    #[test]
    fn old_samples_are_forgotten() {
        let buffer = filled(&[0, 5_000, 10_000, 12_000]);
        assert_eq!((buffer.oldest(), buffer.len()), (Some(milliseconds(5_000)), 3));
        assert_eq!(buffer.counts(), TimelineCounts::default());
    }

    #[test]
    fn one_late_sample_is_dropped_and_two_restart_the_buffer() {
        let mut buffer = filled(&[0, 1_000, 2_000, 1_000 - 1, 2_100]);
        assert_eq!(buffer.counts(), TimelineCounts { stale: 1, ..TimelineCounts::default() });
        assert_eq!(buffer.oldest(), Some(milliseconds(0)));

        buffer.insert(milliseconds(-50_000), pose(1.0));
        assert_eq!(buffer.newest(), Some(milliseconds(2_100)));
        buffer.insert(milliseconds(-49_000), pose(3.0));
        assert_eq!(buffer.newest(), Some(milliseconds(-49_000)));
        assert_eq!(buffer.at(milliseconds(-49_500)), Ok(pose(2.0)));
        let counts = TimelineCounts { stale: 1, restarts: 1, ..TimelineCounts::default() };
        assert_eq!(buffer.counts(), counts);
    }

    #[test]
    fn late_samples_of_a_second_clock_do_not_restart_the_buffer() {
        let mut buffer = buffer();
        for step in 0..10 {
            buffer.insert(milliseconds(step * 100), pose(0.0));
            buffer.insert(milliseconds(step * 100 - 60_000), pose(0.0));
        }
        assert_eq!(buffer.counts(), TimelineCounts { stale: 10, ..TimelineCounts::default() });
    }

    #[test]
    fn a_late_sample_twice_is_no_sign_of_a_clock_set_back() {
        let buffer = filled(&[60_000, 0, 0]);
        let counts = TimelineCounts { stale: 1, duplicates: 1, ..TimelineCounts::default() };
        assert_eq!(buffer.counts(), counts);
        let apart = filled(&[60_000, 0, 11_000]);
        assert_eq!(apart.counts(), TimelineCounts { stale: 2, ..TimelineCounts::default() });
    }

    #[test]
    fn the_number_of_samples_is_bounded() {
        let mut buffer = OdometryBuffer::new(Duration::from_secs(10), 3);
        for step in 0..5 {
            buffer.insert(milliseconds(step), pose(step as f64));
        }
        assert_eq!((buffer.len(), buffer.oldest()), (3, Some(milliseconds(2))));
        assert_eq!(buffer.counts().crowded_out, 2);
    }

    proptest! {
        /// Whatever stamps arrive, what is kept is in order, bounded and accounted for.
        #[test]
        fn any_stamps_leave_order_and_a_bound(
            stamps in vec(any::<i64>(), 0..50),
            near in vec(0..20_i64, 0..50),
        ) {
            let mut buffer = OdometryBuffer::new(Duration::from_secs(10), 20);
            for stamp in stamps.into_iter().chain(near.into_iter().map(|step| step * SECOND / 4)) {
                buffer.insert(Stamp(stamp), pose(0.0));
                prop_assert!(buffer.at(Stamp(stamp.saturating_add(1))).is_err() || buffer.len() > 1);
            }
            prop_assert!(buffer.len() <= 20);
            prop_assert!(buffer.samples.iter().is_sorted_by(|a, b| a.0 < b.0));
        }

        #[test]
        fn interpolation_is_fair(fraction in 0.0..1.0_f64, from in -PI..PI, turn in -3.0..3.0_f64) {
            let earlier = Pose2::new(1.0, 2.0, from);
            let later = earlier * Pose2::new(0.0, 0.0, turn);
            let there = earlier.interpolate(&later, fraction);
            let back = later.interpolate(&earlier, 1.0 - fraction);
            prop_assert!(wrap_angle(there.theta - back.theta).abs() < 1e-12);
            prop_assert!((wrap_angle(there.theta - from) - fraction * turn).abs() < 1e-12);
            prop_assert_eq!(earlier.interpolate(&later, 0.0), earlier);
        }
    }
}
