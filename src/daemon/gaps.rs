//! Outages of an input, by the stamps of what came before and after.

use crate::slam::pose::Stamp;

/// Stamps that are further apart than this, ns, have an outage between them.
const LONGEST_STEP: i64 = 1_000_000_000;

/// Stamps this much before the newest, ns, are late or of a clock that was set back.
const SET_BACK: i64 = 500_000_000;

/// The outages of one sender's messages.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Gaps {
    newest: Option<Stamp>,
    /// The last, if it came too late: one more such, and the clock was set back.
    suspect: Option<Stamp>,
    /// How many there were.
    pub count: u64,
    /// From the last stamp before the longest of them to the first after it.
    pub longest_s: f64,
}

impl Gaps {
    /// Takes the stamp of a message.
    pub fn note(&mut self, stamp: Stamp) {
        let Some(newest) = self.newest else {
            self.newest = Some(stamp);
            return;
        };
        let step = stamp.0.saturating_sub(newest.0);
        if step < -SET_BACK {
            let set_back = self.suspect.is_some_and(|first| stamp > first);
            self.suspect = if set_back { None } else { Some(stamp) };
            if set_back {
                self.newest = Some(stamp);
            }
            return;
        }
        self.suspect = None;
        self.newest = Some(stamp.max(newest));
        if step > LONGEST_STEP {
            self.count += 1;
            self.longest_s = self.longest_s.max(stamp.seconds_since(newest));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gaps(milliseconds: &[i64]) -> (u64, f64) {
        let mut gaps = Gaps::default();
        let stamps = milliseconds.iter().map(|stamp| Stamp(stamp * 1_000_000));
        stamps.for_each(|stamp| gaps.note(stamp));
        (gaps.count, gaps.longest_s)
    }

    #[test]
    fn a_step_of_more_than_a_second_is_a_gap_and_the_longest_is_told() {
        assert_eq!(gaps(&[0, 100, 1100, 1200]), (0, 0.0));
        assert_eq!(gaps(&[0, 100, 3600, 3700, 5200]), (2, 3.5));
    }

    #[test]
    fn one_that_is_late_makes_no_gap_and_a_clock_that_is_set_back_neither() {
        assert_eq!(gaps(&[5000, 5100, 1000, 5200]), (0, 0.0));
        assert_eq!(gaps(&[5000, 5100, 1000, 1100, 1200]), (0, 0.0));
        assert_eq!(gaps(&[5000, 1000, 1100, 5100]), (1, 4.0));
        assert_eq!(gaps(&[0, i64::MAX / 1_000_000, i64::MIN / 1_000_000]).0, 1);
    }
}
