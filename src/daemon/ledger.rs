//! What became of every scan: a verdict each, counted.

use std::collections::BTreeMap;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::slam::pose::Stamp;
use crate::slam::update::{SkipReason, WeakDirection};

/// What became of a scan.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// It is in the map.
    Processed,
    /// The robot had not moved enough since the last processed scan.
    NotMovedEnough,
    /// Not the n-th scan that `throttle_scans` asks for.
    Throttled,
    /// No beam is a hit within `maxUrange`.
    NoUsableBeams,
    /// Its odometry is not finite, or further away than a robot gets.
    BadOdometry,
    /// Where in the map that mapping starts from it was taken cannot be told.
    NotLocalized,
    /// Odometry for its stamp did not come in time, or no pose is given to map along.
    NoOdometry,
    /// Where the laser sits on the robot is not known.
    NoMount,
    /// The laser does not scan parallel to the floor.
    TiltedMount,
    /// Its stamp or its angles and ranges make no sense.
    BadGeometry,
    /// Its bytes are no laser scan.
    NotDecodable,
    /// There was one with the same stamp.
    Duplicate,
    /// A newer one was taken before it came.
    Late,
    /// It waited while too many newer ones came.
    Overload,
    /// Mapping is paused.
    Paused,
}

impl Verdict {
    /// All verdicts, so that a count of zero is told too.
    pub const ALL: [Self; 15] = [
        Self::Processed,
        Self::NotMovedEnough,
        Self::Throttled,
        Self::NoUsableBeams,
        Self::BadOdometry,
        Self::NotLocalized,
        Self::NoOdometry,
        Self::NoMount,
        Self::TiltedMount,
        Self::BadGeometry,
        Self::NotDecodable,
        Self::Duplicate,
        Self::Late,
        Self::Overload,
        Self::Paused,
    ];
}

impl From<SkipReason> for Verdict {
    fn from(reason: SkipReason) -> Self {
        match reason {
            SkipReason::Throttled => Self::Throttled,
            SkipReason::NotMovedEnough => Self::NotMovedEnough,
            SkipReason::NoUsableBeams => Self::NoUsableBeams,
            SkipReason::BadOdometry => Self::BadOdometry,
            SkipReason::NotLocalized => Self::NotLocalized,
        }
    }
}

/// A scan's verdict with what there is to say about it: one sample on `slam/verdict`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Entry {
    /// How many scans have had their verdict, this one included.
    pub number: u64,
    /// The scan's; `None` if its bytes could not be read.
    pub stamp: Option<Stamp>,
    /// What became of it.
    pub verdict: Verdict,
    /// What is wrong and what to do, in a sentence; empty where nothing is.
    pub detail: String,
    /// What a processed scan left open: a unit vector in `map`; `None` if nothing.
    pub weak_direction: Option<WeakDirection>,
}

/// The verdicts so far; cheap to copy, for every snapshot has one.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(from = "Counted", into = "Counted")]
pub struct Ledger {
    counts: Arc<BTreeMap<Verdict, u64>>,
    total: u64,
    last: Arc<BTreeMap<Verdict, Entry>>,
}

/// A ledger as plain data.
#[derive(Serialize, Deserialize)]
struct Counted {
    counts: BTreeMap<Verdict, u64>,
    total: u64,
    last: BTreeMap<Verdict, Entry>,
}

impl From<Ledger> for Counted {
    fn from(ledger: Ledger) -> Self {
        let Ledger { counts, total, last } = ledger;
        Self { counts: Arc::unwrap_or_clone(counts), total, last: Arc::unwrap_or_clone(last) }
    }
}

impl From<Counted> for Ledger {
    fn from(Counted { counts, total, last }: Counted) -> Self {
        Self { counts: Arc::new(counts), total, last: Arc::new(last) }
    }
}

impl Ledger {
    /// Enters a verdict and returns its entry.
    pub fn enter(&mut self, stamp: Option<Stamp>, verdict: Verdict, detail: String) -> &Entry {
        self.add(Entry { number: self.total + 1, stamp, verdict, detail, weak_direction: None })
    }

    /// Enters a scan that was processed, with what it left open, and returns its entry.
    pub fn enter_processed(
        &mut self,
        stamp: Stamp,
        weak_direction: Option<WeakDirection>,
    ) -> &Entry {
        let (number, verdict, detail) = (self.total + 1, Verdict::Processed, String::new());
        self.add(Entry { number, stamp: Some(stamp), verdict, detail, weak_direction })
    }

    fn add(&mut self, entry: Entry) -> &Entry {
        let verdict = entry.verdict;
        *Arc::make_mut(&mut self.counts).entry(verdict).or_default() += 1;
        self.total += 1;
        let last = Arc::make_mut(&mut self.last);
        last.insert(verdict, entry);
        &last[&verdict]
    }

    /// How many scans had this verdict.
    #[must_use]
    pub fn count(&self, verdict: Verdict) -> u64 {
        self.counts.get(&verdict).copied().unwrap_or(0)
    }

    /// How many scans had a verdict.
    #[must_use]
    pub const fn total(&self) -> u64 {
        self.total
    }

    /// The last entry of each verdict that occurred.
    #[must_use]
    pub fn last(&self) -> &BTreeMap<Verdict, Entry> {
        &self.last
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_verdict_is_counted_and_its_last_entry_kept() {
        let mut ledger = Ledger::default();
        ledger.enter(Some(Stamp(1)), Verdict::Late, "first".to_owned());
        ledger.enter(None, Verdict::NotDecodable, String::new());
        let entry = ledger.enter(Some(Stamp(2)), Verdict::Late, "second".to_owned()).clone();
        assert_eq!(entry.number, 3);
        assert_eq!((ledger.total(), ledger.count(Verdict::Late)), (3, 2));
        assert_eq!(ledger.count(Verdict::Processed), 0);
        assert_eq!(ledger.last()[&Verdict::Late], entry);
    }
}
