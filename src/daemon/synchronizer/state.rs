//! What has come and not been used yet, as plain data; and what is fed again after a restart.

use std::collections::VecDeque;
use std::time::Instant;

use serde::{Deserialize, Serialize};

use super::{Call, Channel, FramedScan, ScanCounts, Sought, Synchronizer, Waiting};
use crate::daemon::ledger::Verdict;
use crate::slam::pose::{Pose2, Stamp};
use crate::slam::state::{StateError, ensure};
use crate::timeline::OdometryBuffer;

/// Stamps of scans that are known again when they come after a restart: minutes at any rate.
pub(super) const KNOWN_AGAIN: usize = 16_384;

/// A robot whose power was cut sends odometry again after more than this, s.
const POWER_CUT_S: f64 = 5.0;

/// Odometry that has just begun has the base within this distance of its origin, m.
const NEAR_ORIGIN_M: f64 = 0.5;

/// All that has come and may still matter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SynchronizerState {
    odometry: OdometryBuffer,
    channel: Option<Channel>,
    fed: Option<Stamp>,
    /// Scans that wait, and whether each goes without odometry.
    waiting: Vec<(FramedScan, bool)>,
    taken: Option<Stamp>,
    suspect: Option<Stamp>,
    calls: VecDeque<Call>,
    counts: ScanCounts,
    waited_in_vain: bool,
    seen: VecDeque<Stamp>,
}

/// What is known of a sender that feeds again what came before the restart.
///
/// Its stamps go back, as those of a clock that was set back do; but scans that are fed again have
/// stamps that are known, to the nanosecond.
#[derive(Debug, Default)]
pub(super) struct Again {
    /// The newest scan before the restart, until one comes that is newer.
    scans_until: Option<Stamp>,
    /// Likewise of odometry.
    odometry_until: Option<Stamp>,
    /// Where odometry had the base before the restart, until it tells more.
    odometry_before: Option<Pose2>,
    /// Whether a scan came whose stamp is known.
    recognised: bool,
}

impl Again {
    /// Whether a scan came before the restart already.
    pub(super) fn knows_scan(&mut self, stamp: Stamp, seen: &VecDeque<Stamp>) -> bool {
        let Some(until) = self.scans_until else { return false };
        if stamp > until {
            self.scans_until = None;
            return false;
        }
        self.recognised |= seen.contains(&stamp);
        self.recognised
    }

    /// The clock was set back: no stamp is known any more.
    pub(super) fn forget_stamps(&mut self) {
        *self = Self { odometry_before: self.odometry_before, ..Self::default() };
    }

    /// Whether the first odometry after the restart has another origin, as after a power cut: it
    /// is near its origin, and was not. One that came after a `pause` of so many seconds only may
    /// have, for no robot starts sooner; without stamps to compare, `pause` is infinite.
    pub(super) fn odometry_begins_anew(&mut self, odom_from_base: Pose2, pause: f64) -> bool {
        let near = |pose: Pose2| pose.position().norm() <= NEAR_ORIGIN_M;
        let before = self.odometry_before.take().filter(|_| pause > POWER_CUT_S);
        before.is_some_and(|before| near(odom_from_base) && !near(before))
    }

    /// Whether odometry is not newer than what came before the restart.
    pub(super) fn knows_odometry(&mut self, stamp: Stamp) -> bool {
        let known = self.odometry_until.is_some_and(|until| stamp <= until);
        if !known {
            self.odometry_until = None;
        }
        known
    }
}

impl Synchronizer {
    /// Given poses have no origin to begin at.
    fn odometry_before(&self, state: &SynchronizerState) -> Option<Pose2> {
        let newest = state.odometry.newest().filter(|_| self.settings.sought == Sought::Odometry);
        state.odometry.at(newest?).ok()
    }

    /// Forgets all odometry, for the robot was carried, and refuses the scans from before that.
    pub fn forget_odometry(&mut self) {
        self.odometry.clear();
        self.again.odometry_before = None;
        let mut stamps = Vec::new();
        self.calls.retain(|call| {
            if let Call::Scan(ready) = call {
                stamps.push(ready.scan.stamp);
            }
            matches!(call, Call::Refuse(_))
        });
        stamps.extend(self.waiting.drain(..).map(|waiting| waiting.stamp()));
        for stamp in stamps {
            let detail = "it is from before the robot was carried".to_owned();
            self.refuse(stamp, Verdict::Late, detail);
        }
    }

    /// All that has come and may still matter.
    #[must_use]
    pub fn state(&self) -> SynchronizerState {
        let waiting = self.waiting.iter().map(|w| (w.framed.clone(), w.goes_without));
        SynchronizerState {
            odometry: self.odometry.clone(),
            channel: self.channel,
            fed: self.fed,
            waiting: waiting.collect(),
            taken: self.taken,
            suspect: self.suspect,
            calls: self.calls.clone(),
            counts: self.counts,
            waited_in_vain: self.waited_in_vain,
            seen: self.seen.clone(),
        }
    }

    /// Goes on from a state at the time `now`, from when on its scans wait once more.
    pub fn resume(&mut self, state: SynchronizerState, now: Instant) {
        self.again = Again {
            scans_until: state.taken,
            odometry_until: state.odometry.newest(),
            odometry_before: self.odometry_before(&state),
            recognised: false,
        };
        self.odometry = state.odometry;
        self.channel = state.channel;
        self.fed = state.fed;
        let waiting = |(framed, goes_without)| Waiting { framed, since: now, goes_without };
        self.waiting = state.waiting.into_iter().map(waiting).collect();
        self.taken = state.taken;
        self.suspect = state.suspect;
        self.calls = state.calls;
        self.counts = state.counts;
        self.waited_in_vain = state.waited_in_vain;
        self.seen = state.seen;
    }
}

impl SynchronizerState {
    /// Looks whether all parts fit together.
    ///
    /// # Errors
    /// When they are not such as a synchronizer leaves.
    pub fn check(&self) -> Result<(), StateError> {
        ensure(self.odometry.is_sound(), "odometry")?;
        let called = self.calls.iter().filter_map(|call| match call {
            Call::Scan(ready) => Some(&ready.scan),
            Call::Odometry(..) | Call::Refuse(_) | Call::BeginOdometry(_) => None,
        });
        let waiting = self.waiting.iter().map(|(framed, _)| &framed.scan);
        ensure(called.chain(waiting).all(|scan| scan.geometry.is_usable()), "scans")?;
        ensure(self.waiting.is_sorted_by_key(|(framed, _)| framed.scan.stamp), "scans")
    }

    /// The last scan that was taken.
    #[must_use]
    pub const fn taken(&self) -> Option<Stamp> {
        self.taken
    }
}
