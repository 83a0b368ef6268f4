//! How much may be on its way to a daemon that says what became of each scan.

use std::collections::VecDeque;

use serde::Deserialize;

use crate::slam::pose::Stamp;

/// Scans without a verdict; the daemon's own queue takes twice as many by default.
const MOST_SCANS: usize = 16;

/// Readings may be this much later than a scan without a verdict, s: the daemon gives up scans
/// that are five seconds older than its odometry.
const MOST_AHEAD_S: f64 = 3.0;

/// Odometry that nobody has acknowledged; the daemon's own queue takes four times as many.
const MOST_ODOMETRY: u64 = 1000;

/// What the daemon tells of a scan on `slam/verdict`.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct VerdictMessage {
    /// The scan's; `None` if its bytes could not be read.
    pub stamp: Option<Stamp>,
    /// What became of it, such as `processed`.
    pub verdict: String,
}

/// What was sent, and what of it is known to have arrived.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Backlog {
    /// Without a verdict, oldest first, each with how much odometry was sent before it.
    scans: VecDeque<(Stamp, u64)>,
    scans_sent: u64,
    odometry_sent: u64,
    odometry_arrived: u64,
}

/// Whether another reading may be sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Room {
    /// It may.
    Free,
    /// Not before scans have their verdicts.
    WaitForVerdicts,
    /// Not before odometry has arrived.
    WaitForOdometry,
}

impl Backlog {
    /// Whether a reading with this stamp may be sent.
    #[must_use]
    pub fn room(&self, stamp: Stamp) -> Room {
        let ahead = |&(oldest, _): &(Stamp, u64)| stamp.seconds_since(oldest) > MOST_AHEAD_S;
        if self.scans.len() >= MOST_SCANS || self.scans.front().is_some_and(ahead) {
            Room::WaitForVerdicts
        } else if self.odometry_sent - self.odometry_arrived >= MOST_ODOMETRY {
            Room::WaitForOdometry
        } else {
            Room::Free
        }
    }

    /// An odometry message was sent.
    pub const fn odometry_sent(&mut self) {
        self.odometry_sent += 1;
    }

    /// A scan was sent.
    pub fn scan_sent(&mut self, stamp: Stamp) {
        self.scans.push_back((stamp, self.odometry_sent));
        self.scans_sent += 1;
    }

    /// The scan with this stamp has its verdict, and so have those before it: they are mapped in
    /// the order of their stamps.
    pub fn settled(&mut self, stamp: Stamp) {
        while let Some(&(_, odometry)) = self.scans.front().filter(|scan| scan.0 <= stamp) {
            // Odometry up to a scan came before it was mapped.
            self.odometry_arrived = self.odometry_arrived.max(odometry);
            self.scans.pop_front();
        }
    }

    /// The daemon has given this many verdicts since the first scan was sent; some may not have
    /// come here.
    pub fn verdicts_given(&mut self, count: u64) {
        let open = usize::try_from(self.scans_sent.saturating_sub(count)).unwrap_or(usize::MAX);
        if let Some(last) = self.scans.len().checked_sub(open + 1) {
            self.settled(self.scans[last].0);
        }
    }

    /// The daemon has received this much odometry since the first was sent.
    pub fn odometry_received(&mut self, count: u64) {
        self.odometry_arrived = self.odometry_arrived.max(count.min(self.odometry_sent));
    }

    /// Scans without a verdict.
    #[must_use]
    pub fn open_scans(&self) -> usize {
        self.scans.len()
    }

    /// Scans that were sent.
    #[must_use]
    pub const fn scans_sent(&self) -> u64 {
        self.scans_sent
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn seconds(seconds: f64) -> Stamp {
        Stamp::from_seconds(seconds)
    }

    /// Scans every tenth of a second.
    fn sent(scans: usize) -> Backlog {
        let mut backlog = Backlog::default();
        for index in 0..scans {
            backlog.odometry_sent();
            backlog.scan_sent(seconds(index as f64 / 10.0));
        }
        backlog
    }

    #[test]
    fn verdicts_are_read_as_the_ledger_tells_them() {
        let mut ledger = crate::daemon::ledger::Ledger::default();
        let verdict = crate::daemon::ledger::Verdict::NotMovedEnough;
        let entry = ledger.enter(Some(Stamp(7)), verdict, String::new());
        let told = serde_json::to_vec(entry).unwrap();
        let read: VerdictMessage = serde_json::from_slice(&told).unwrap();
        let verdict = "not_moved_enough".to_owned();
        assert_eq!(read, VerdictMessage { stamp: Some(Stamp(7)), verdict });
    }

    #[test]
    fn only_so_many_scans_are_open() {
        let mut backlog = sent(MOST_SCANS - 1);
        assert_eq!(backlog.room(seconds(1.5)), Room::Free);
        backlog.scan_sent(seconds(1.5));
        assert_eq!(backlog.room(seconds(1.6)), Room::WaitForVerdicts);
        backlog.settled(seconds(0.0));
        assert_eq!((backlog.room(seconds(1.6)), backlog.open_scans()), (Room::Free, 15));
    }

    #[test]
    fn nothing_is_sent_long_after_an_open_scan() {
        let mut backlog = sent(1);
        assert_eq!(backlog.room(seconds(3.0)), Room::Free);
        assert_eq!(backlog.room(seconds(3.1)), Room::WaitForVerdicts);
        backlog.settled(seconds(0.0));
        assert_eq!(backlog.room(seconds(100.0)), Room::Free);
    }

    #[test]
    fn a_verdict_settles_the_scans_before_it() {
        let mut backlog = sent(10);
        backlog.settled(seconds(0.45));
        assert_eq!(backlog.open_scans(), 5);
        backlog.settled(seconds(0.2));
        assert_eq!(backlog.open_scans(), 5);
    }

    #[test]
    fn lost_verdicts_are_made_up_for_by_their_number() {
        let mut backlog = sent(10);
        backlog.verdicts_given(0);
        assert_eq!(backlog.open_scans(), 10);
        backlog.verdicts_given(7);
        assert_eq!(backlog.open_scans(), 3);
        backlog.verdicts_given(6);
        assert_eq!(backlog.open_scans(), 3);
        backlog.verdicts_given(25);
        assert_eq!((backlog.open_scans(), backlog.scans_sent()), (0, 10));
    }

    #[test]
    fn odometry_waits_until_it_is_acknowledged() {
        let mut backlog = sent(1);
        for _ in 1..MOST_ODOMETRY {
            assert_eq!(backlog.room(seconds(0.1)), Room::Free);
            backlog.odometry_sent();
        }
        assert_eq!(backlog.room(seconds(0.1)), Room::WaitForOdometry);
        backlog.settled(seconds(0.0));
        assert_eq!(backlog.room(seconds(0.1)), Room::Free);
        backlog.odometry_sent();
        assert_eq!(backlog.room(seconds(0.1)), Room::WaitForOdometry);
        backlog.odometry_received(u64::MAX);
        assert_eq!(backlog.room(seconds(0.1)), Room::Free);
    }
}
