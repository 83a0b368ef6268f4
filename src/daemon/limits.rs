//! What the mesh may ask of the daemon at most.

use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

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
    fn so_many_are_let_through_in_a_second() {
        let rate = Rate::new(2);
        let began = crate::clock::now();
        let at = |milliseconds| rate.admits(began + Duration::from_millis(milliseconds));
        assert_eq!([0, 10, 20, 999].map(at), [true, true, false, false]);
        assert_eq!([1000, 1500, 1999].map(at), [true, true, false]);
        assert!(at(5000));
    }
}
