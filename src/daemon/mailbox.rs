//! What the filter's thread has to do next.
//!
//! Odometry and transforms wait without loss; of the scans the oldest goes when too many wait.

use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use super::command::Request;
use super::ledger::Verdict;
use super::synchronizer::{FramedScan, Refusal};
use crate::convert::FramedPose;
use crate::slam::pose::{Pose2, Stamp};
use crate::tf::{Kind, Transform};

/// Odometry samples and transforms that may wait; more come only if the filter hangs.
const MOST_MOTIONS: usize = 65_536;

/// Refusals that are told one by one; of those beyond, only the number.
const MOST_REFUSALS: usize = 4096;

/// Commands that may wait; those beyond are told that the daemon is busy.
const MOST_COMMANDS: usize = 64;

/// Input for the filter's thread.
#[derive(Debug, Clone, PartialEq)]
pub enum Mail {
    /// From `odom`.
    Odometry(Stamp, Pose2),
    /// From `pose`.
    Pose(FramedPose),
    /// From `tf` or `tf_static`.
    Transform(Transform, Kind),
    /// From `scan`.
    Scan(FramedScan),
}

/// What the filter's thread finds.
#[derive(Debug)]
pub enum Event {
    /// Somebody asks for something.
    Command(Request),
    /// A scan does not reach the filter.
    Refusal(Refusal),
    /// Input.
    Mail(Mail),
    /// Nothing came until the time that was given.
    Expired,
    /// Nothing comes any more.
    Closed,
}

#[derive(Debug, Default)]
struct State {
    commands: VecDeque<Request>,
    refusals: VecDeque<Refusal>,
    /// Refused scans beyond those.
    untold: u64,
    mail: VecDeque<Mail>,
    scans: usize,
    lost_motions: u64,
    /// Until when what waits is still taken out.
    closed: Option<Instant>,
}

/// The box between the tasks that decode and the filter's thread.
#[derive(Debug)]
pub struct Mailbox {
    state: Mutex<State>,
    changed: Condvar,
    most_scans: usize,
}

impl Mailbox {
    /// An empty box in which so many scans may wait.
    #[must_use]
    pub fn new(most_scans: usize) -> Self {
        Self { state: Mutex::default(), changed: Condvar::new(), most_scans }
    }

    /// Puts in input; the oldest scan is refused if too many wait.
    pub fn put(&self, mail: Mail) {
        let mut state = self.lock();
        state.scans += usize::from(is_scan(&mail));
        state.mail.push_back(mail);
        if state.scans > self.most_scans {
            self.drop_oldest_scan(&mut state);
        }
        if state.mail.len() - state.scans > MOST_MOTIONS {
            state.drop_oldest_motion();
        }
        self.changed.notify_one();
    }

    /// Puts in a scan that does not reach the filter.
    pub fn refuse(&self, refusal: Refusal) {
        self.lock().refuse(refusal);
        self.changed.notify_one();
    }

    /// Puts in a command; dropped, which its sender notices, if there are too many.
    pub fn ask(&self, request: Request) {
        let mut state = self.lock();
        if state.commands.len() < MOST_COMMANDS {
            state.commands.push_back(request);
            self.changed.notify_one();
        }
    }

    /// Nothing comes any more; what waits may be taken out until `deadline`.
    pub fn close(&self, deadline: Instant) {
        self.lock().closed = Some(deadline);
        self.changed.notify_one();
    }

    /// Whether the box is closed and what waits is not taken out any more.
    pub fn is_over(&self, now: Instant) -> bool {
        self.lock().is_over(now)
    }

    /// A command or a refusal, which are not kept waiting; and that the box is closed and empty,
    /// or that it is later than what was waited for.
    pub fn urgent(&self, now: Instant) -> Option<Event> {
        self.lock().urgent(now)
    }

    /// What comes next; `None` if nothing is there.
    pub fn take(&self, now: Instant) -> Option<Event> {
        self.lock().next(now)
    }

    /// Waits for what comes next, until `deadline` if one is given.
    ///
    /// `now` tells the time, for what ends the waiting.
    pub fn wait(&self, deadline: Option<Instant>, now: fn() -> Instant) -> Event {
        let mut state = self.lock();
        loop {
            let time = now();
            if let Some(event) = state.next(time) {
                return event;
            }
            let Some(deadline) = deadline else {
                state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
                continue;
            };
            if time >= deadline {
                return Event::Expired;
            }
            let left = deadline.duration_since(time);
            let waited = self.changed.wait_timeout(state, left);
            state = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// Scans that wait.
    pub fn scans(&self) -> usize {
        self.lock().scans
    }

    /// Odometry samples and transforms that were lost because the filter hung.
    pub fn lost_motions(&self) -> u64 {
        self.lock().lost_motions
    }

    fn drop_oldest_scan(&self, state: &mut State) {
        let Some(position) = state.mail.iter().position(is_scan) else { return };
        if let Some(Mail::Scan(framed)) = state.mail.remove(position) {
            state.scans -= 1;
            let detail = format!(
                "{} newer scans came before the filter was ready; particles and beams cost time, \
                 --threads and a larger linearUpdate save it",
                self.most_scans
            );
            let stamp = Some(framed.scan.stamp);
            state.refuse(Refusal { stamp, verdict: Verdict::Overload, detail });
        }
    }

    /// A panic of another thread leaves the box as it was between two operations.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    fn refuse(&mut self, refusal: Refusal) {
        if self.refusals.len() < MOST_REFUSALS {
            self.refusals.push_back(refusal);
        } else {
            self.untold += 1;
        }
    }

    fn drop_oldest_motion(&mut self) {
        if let Some(position) = self.mail.iter().position(|mail| !is_scan(mail)) {
            self.mail.remove(position);
            self.lost_motions += 1;
        }
    }

    fn is_over(&self, now: Instant) -> bool {
        self.closed.is_some_and(|deadline| now >= deadline)
    }

    fn urgent(&mut self, now: Instant) -> Option<Event> {
        if self.is_over(now) {
            return Some(Event::Closed);
        }
        if let Some(request) = self.commands.pop_front() {
            return Some(Event::Command(request));
        }
        if let Some(refusal) = self.refusals.pop_front() {
            return Some(Event::Refusal(refusal));
        }
        if self.untold > 0 {
            self.untold -= 1;
            let (verdict, detail) = (Verdict::Overload, String::new());
            return Some(Event::Refusal(Refusal { stamp: None, verdict, detail }));
        }
        None
    }

    fn next(&mut self, now: Instant) -> Option<Event> {
        if let Some(event) = self.urgent(now) {
            return Some(event);
        }
        if let Some(mail) = self.mail.pop_front() {
            self.scans -= usize::from(is_scan(&mail));
            return Some(Event::Mail(mail));
        }
        self.closed.is_some().then_some(Event::Closed)
    }
}

const fn is_scan(mail: &Mail) -> bool {
    matches!(mail, Mail::Scan(_))
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use tokio::sync::oneshot;

    use super::*;
    use crate::clock;
    use crate::daemon::command::Command;
    use crate::slam::scan::{Scan, ScanGeometry};

    fn scan(stamp: i64) -> Mail {
        let geometry = ScanGeometry::new([0.0, 1.0], 0.5, [0.1, 9.0]).unwrap();
        let scan = Scan { stamp: Stamp(stamp), geometry, ranges: vec![1.0; 3] };
        Mail::Scan(FramedScan { scan, frame: "laser".to_owned() })
    }

    fn odometry(stamp: i64) -> Mail {
        Mail::Odometry(Stamp(stamp), Pose2::IDENTITY)
    }

    /// The stamps of what is in the box, scans negative, and of refusals in the end.
    fn contents(mailbox: &Mailbox) -> (Vec<i64>, Vec<i64>) {
        let (mut mail, mut refused) = (Vec::new(), Vec::new());
        while let Some(event) = mailbox.take(clock::now()) {
            match event {
                Event::Mail(Mail::Odometry(stamp, _)) => mail.push(stamp.0),
                Event::Mail(Mail::Scan(framed)) => mail.push(-framed.scan.stamp.0),
                Event::Refusal(refusal) => {
                    assert_eq!(refusal.verdict, Verdict::Overload);
                    refused.push(refusal.stamp.map_or(0, |stamp| stamp.0));
                }
                other => panic!("{other:?}"),
            }
        }
        (mail, refused)
    }

    #[test]
    fn the_oldest_scans_go_and_odometry_stays() {
        let mailbox = Mailbox::new(2);
        for stamp in 1..=5 {
            mailbox.put(odometry(stamp));
            mailbox.put(scan(stamp));
        }
        assert_eq!(mailbox.scans(), 2);
        assert_eq!(contents(&mailbox), (vec![1, 2, 3, 4, -4, 5, -5], vec![1, 2, 3]));
        assert_eq!((mailbox.scans(), mailbox.lost_motions()), (0, 0));
    }

    #[test]
    fn odometry_is_bounded_too() {
        let mailbox = Mailbox::new(1);
        mailbox.put(scan(1));
        for stamp in 0..MOST_MOTIONS as i64 + 3 {
            mailbox.put(odometry(stamp));
        }
        assert_eq!(mailbox.lost_motions(), 3);
        let (mail, _) = contents(&mailbox);
        assert_eq!((mail.len(), mail[0], mail[1]), (MOST_MOTIONS + 1, -1, 3));
    }

    #[test]
    fn every_refusal_is_counted_whether_it_is_told_or_not() {
        let mailbox = Mailbox::new(1);
        for stamp in 0..MOST_REFUSALS as i64 + 10 {
            let (verdict, detail) = (Verdict::Overload, String::new());
            mailbox.refuse(Refusal { stamp: Some(Stamp(stamp)), verdict, detail });
        }
        assert_eq!(contents(&mailbox).1.len(), MOST_REFUSALS + 10);
    }

    #[test]
    fn commands_come_first_and_too_many_are_dropped() {
        let mailbox = Mailbox::new(4);
        mailbox.put(odometry(1));
        let mut replies: Vec<oneshot::Receiver<_>> = Vec::new();
        for _ in 0..=MOST_COMMANDS {
            let (reply, receiver) = oneshot::channel();
            mailbox.ask(Request { command: Command::Pause, reply });
            replies.push(receiver);
        }
        let dropped = |receiver: &mut oneshot::Receiver<_>| {
            receiver.try_recv() == Err(oneshot::error::TryRecvError::Closed)
        };
        assert_eq!(replies.iter_mut().map(dropped).filter(|dropped| *dropped).count(), 1);
        assert!(matches!(mailbox.take(clock::now()), Some(Event::Command(_))));
    }

    #[test]
    fn waiting_ends_with_mail_or_at_the_deadline_or_when_the_box_is_closed() {
        let mailbox = Mailbox::new(4);
        let soon = Some(clock::now() + Duration::from_millis(1));
        assert!(matches!(mailbox.wait(soon, clock::now), Event::Expired));
        std::thread::scope(|scope| {
            let put = || mailbox.put(odometry(1));
            std::thread::Builder::new().spawn_scoped(scope, put).unwrap();
            assert!(matches!(mailbox.wait(None, clock::now), Event::Mail(_)));
        });
        mailbox.put(odometry(2));
        mailbox.close(clock::now() + Duration::from_secs(60));
        assert!(matches!(mailbox.wait(None, clock::now), Event::Mail(_)));
        assert!(matches!(mailbox.wait(None, clock::now), Event::Closed));
    }

    #[test]
    fn a_closed_box_is_not_emptied_for_ever() {
        let mailbox = Mailbox::new(4);
        mailbox.put(odometry(1));
        mailbox.close(clock::now());
        assert!(matches!(mailbox.take(clock::now()), Some(Event::Closed)));
    }
}
