//! The time of the messages, carried on between them.

use std::time::Duration;

use crate::slam::pose::Stamp;

/// Stamps this much before the newest are of a clock that was set back, ns: a log played again.
const SET_BACK: i64 = 500_000_000;

/// Tells what time it is for those who stamp the messages.
///
/// The robot's clock may differ from this machine's, and a recorded log has the time of its
/// recording; so the time is the newest stamp plus what has passed here since it came.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct MessageClock {
    /// And when it came.
    newest: Option<(Stamp, Duration)>,
    told: Option<Stamp>,
}

impl MessageClock {
    /// A message with this stamp came at `now`, by any clock that always runs forward.
    pub(super) fn hear(&mut self, stamp: Stamp, now: Duration) {
        match self.newest {
            Some((newest, _)) if newest == stamp => return,
            Some((newest, _)) if newest.0.saturating_sub(stamp.0) > SET_BACK => self.told = None,
            _ => (),
        }
        self.newest = Some((stamp, now));
    }

    /// The time at `now`, `ahead_ns` later; `None` before the first message.
    ///
    /// It always grows until the clock of the messages is set back: those who keep transforms by
    /// stamp complain about repeated ones.
    pub(super) fn tell(&mut self, now: Duration, ahead_ns: i64) -> Option<Stamp> {
        let (newest, came) = self.newest?;
        let passed = i64::try_from(now.saturating_sub(came).as_nanos()).unwrap_or(i64::MAX);
        let time = Stamp(newest.0.saturating_add(passed).saturating_add(ahead_ns));
        let told = self.told.map_or(time, |told| time.max(Stamp(told.0.saturating_add(1))));
        self.told = Some(told);
        Some(told)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MILLISECOND: i64 = 1_000_000;

    fn after(milliseconds: u64) -> Duration {
        Duration::from_millis(milliseconds)
    }

    fn stamp(milliseconds: i64) -> Stamp {
        Stamp(milliseconds * MILLISECOND)
    }

    #[test]
    fn time_goes_on_between_messages() {
        let mut clock = MessageClock::default();
        assert_eq!(clock.tell(after(10), 0), None);
        clock.hear(stamp(70_000), after(1_000));
        assert_eq!(clock.tell(after(1_030), 0), Some(stamp(70_030)));
        clock.hear(stamp(70_000), after(1_040));
        assert_eq!(clock.tell(after(1_050), 5 * MILLISECOND), Some(stamp(70_055)));
    }

    #[test]
    fn time_never_stands_still_or_goes_back() {
        let mut clock = MessageClock::default();
        clock.hear(stamp(70_000), after(0));
        assert_eq!(clock.tell(after(200), 0), Some(stamp(70_200)));
        clock.hear(stamp(70_100), after(250));
        assert_eq!(clock.tell(after(260), 0), Some(Stamp(70_200 * MILLISECOND + 1)));
        assert_eq!(clock.tell(after(400), 0), Some(stamp(70_250)));
    }

    #[test]
    fn a_log_that_is_played_again_sets_the_time_back() {
        let mut clock = MessageClock::default();
        clock.hear(stamp(70_000), after(0));
        clock.tell(after(0), 0);
        clock.hear(stamp(60_000), after(100));
        assert_eq!(clock.tell(after(120), 0), Some(stamp(60_020)));
    }
}
