//! What the mesh may ask of the daemon at most.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::{Mutex, PoisonError};
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
}

impl Reason {
    /// All of them.
    pub const ALL: [Self; 5] = [
        Self::Wildcard,
        Self::SwitchedOff,
        Self::TooManyCommands,
        Self::TooManyQueries,
        Self::TooLarge,
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

#[cfg(test)]
mod tests {
    use super::*;

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
        assert_eq!(counts, [6, 0, 0, 0, 1]);
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
