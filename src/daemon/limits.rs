//! What the mesh may ask of the daemon at most.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use serde::Serialize;

use crate::config::{CommandName, Config};

const SECOND: Duration = Duration::from_secs(1);

/// What is refused, by the configuration's keys of the same names.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Limits {
    /// Commands that are done.
    pub commands: Vec<CommandName>,
    /// Commands that are done in a second.
    pub commands_per_second: u32,
    /// Queries that are answered at once. A reply to a slow client holds its place until it is
    /// sent.
    pub queries_at_once: usize,
    /// Bytes of an answer.
    pub max_reply_bytes: usize,
    /// Bytes of answers that are on their way together. One alone is let through in any case.
    pub max_bytes_in_flight: usize,
}

impl Limits {
    /// What the configuration says.
    #[must_use]
    pub fn new(config: &Config) -> Self {
        let raw = &config.raw;
        Self {
            commands: raw.commands.clone(),
            commands_per_second: raw.commands_per_second,
            queries_at_once: raw.queries_at_once,
            max_reply_bytes: raw.max_reply_bytes,
            max_bytes_in_flight: raw.max_bytes_in_flight,
        }
    }
}

/// Why something that was asked for is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Reason {
    /// A command by a wildcard.
    Wildcard,
    /// A command that is switched off.
    SwitchedOff,
    /// More commands than are done in a second, or than may wait.
    TooManyCommands,
    /// More queries than are answered at once.
    TooManyQueries,
    /// An answer of more bytes than one may have.
    TooLarge,
    /// An answer with which more bytes would be on their way than may be.
    TooManyBytes,
}

impl Reason {
    /// All of them.
    pub const ALL: [Self; 6] = [
        Self::Wildcard,
        Self::SwitchedOff,
        Self::TooManyCommands,
        Self::TooManyQueries,
        Self::TooLarge,
        Self::TooManyBytes,
    ];
}

/// What was refused: counted for the status, and told in the log, of each reason once a second.
#[derive(Debug, Default)]
pub struct Refusals(Mutex<BTreeMap<Reason, Tally>>);

#[derive(Debug, Default)]
struct Tally {
    count: u64,
    /// Since the last that was told.
    untold: u64,
    told: Option<Instant>,
}

impl Refusals {
    /// How many were refused for each reason.
    #[must_use]
    pub fn counts(&self) -> BTreeMap<Reason, u64> {
        let tallies = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let count = |reason| tallies.get(&reason).map_or(0, |tally| tally.count);
        Reason::ALL.into_iter().map(|reason| (reason, count(reason))).collect()
    }

    /// Counts one more, and tells it unless another one was told in the second before.
    pub(super) fn note(&self, reason: Reason, refusal: &dyn fmt::Display, now: Instant) {
        match self.count(reason, now) {
            None => {}
            Some(0) => tracing::warn!("refused a query: {refusal}"),
            Some(more) => tracing::warn!("refused a query, and {more} such before: {refusal}"),
        }
    }

    /// Counts one more; if it is to be told, how many were not since the last.
    fn count(&self, reason: Reason, now: Instant) -> Option<u64> {
        let mut tallies = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let tally = tallies.entry(reason).or_default();
        tally.count += 1;
        if tally.told.is_some_and(|told| now.saturating_duration_since(told) < SECOND) {
            tally.untold += 1;
            return None;
        }
        tally.told = Some(now);
        Some(std::mem::take(&mut tally.untold))
    }
}

/// Counts what is let through in a second, which begins with the first.
#[derive(Debug)]
pub(super) struct Rate {
    most: u32,
    /// When the second began, and how many it has had.
    second: Mutex<Option<(Instant, u32)>>,
}

impl Rate {
    pub(super) const fn new(most: u32) -> Self {
        Self { most, second: Mutex::new(None) }
    }

    /// Whether one more is let through.
    pub(super) fn admits(&self, now: Instant) -> bool {
        let mut second = self.second.lock().unwrap_or_else(PoisonError::into_inner);
        let same = second.filter(|(began, _)| now.saturating_duration_since(*began) < SECOND);
        let (began, had) = same.unwrap_or((now, 0));
        let admitted = had < self.most;
        *second = Some((began, had + u32::from(admitted)));
        admitted
    }
}

/// Bytes of answers that are on their way: those to clients that read slowly stay in memory.
#[derive(Debug)]
pub(super) struct InFlight {
    most: usize,
    bytes: AtomicUsize,
}

/// Room for an answer on its way, until it is dropped.
#[derive(Debug)]
pub(super) struct Room {
    bytes: usize,
    of: Arc<InFlight>,
}

impl InFlight {
    pub(super) fn new(most: usize) -> Arc<Self> {
        Arc::new(Self { most, bytes: AtomicUsize::new(0) })
    }

    /// Room for an answer of so many bytes.
    ///
    /// # Errors
    /// When there is none, with the bytes that are on their way; an answer alone always has room.
    pub(super) fn room(self: &Arc<Self>, bytes: usize) -> Result<Room, usize> {
        let more = |before: usize| {
            let after = before.saturating_add(bytes);
            (before == 0 || after <= self.most).then_some(after)
        };
        self.bytes.fetch_update(Ordering::AcqRel, Ordering::Acquire, more)?;
        Ok(Room { bytes, of: Arc::clone(self) })
    }
}

impl Drop for Room {
    fn drop(&mut self) {
        self.of.bytes.fetch_sub(self.bytes, Ordering::AcqRel);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn answers_on_their_way_have_so_many_bytes_together_and_one_alone_any() {
        let in_flight = InFlight::new(100);
        let alone = in_flight.room(500).unwrap();
        assert_eq!(in_flight.room(1).unwrap_err(), 500);
        drop(alone);
        let [first, second] = [60, 40].map(|bytes| in_flight.room(bytes).unwrap());
        assert_eq!(in_flight.room(1).unwrap_err(), 100);
        drop(first);
        assert!(in_flight.room(60).is_ok());
        drop(second);
    }

    #[test]
    fn of_what_is_refused_all_is_counted_and_one_a_second_is_told() {
        let refusals = Refusals::default();
        let began = crate::clock::now();
        let told = |reason, milliseconds| {
            refusals.count(reason, began + Duration::from_millis(milliseconds))
        };
        let wildcards = [0, 10, 999, 1000, 1500, 2000].map(|at| told(Reason::Wildcard, at));
        assert_eq!(wildcards, [Some(0), None, None, Some(2), None, Some(1)]);
        assert_eq!(told(Reason::TooLarge, 20), Some(0), "each reason for itself");
        let counts: Vec<u64> = refusals.counts().into_values().collect();
        assert_eq!(counts, [6, 0, 0, 0, 1, 0]);
    }

    #[test]
    fn so_many_are_let_through_in_a_second() {
        let rate = Rate::new(2);
        let began = crate::clock::now();
        let at = |milliseconds| rate.admits(began + Duration::from_millis(milliseconds));
        assert_eq!([0, 10, 20, 999].map(at), [true, true, false, false]);
        assert_eq!([1000, 1500, 1999].map(at), [true, true, false]);
        assert!(at(5000));
    }
}
