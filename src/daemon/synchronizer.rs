//! Puts odometry and scans in the order in which the filter takes them.
//!
//! A scan waits until odometry at or after its stamp is known. Then the filter gets all odometry up
//! to the scan, and the scan with odometry's pose at its stamp: what it gets does not depend on
//! what came first, as long as nothing is late. No clock is read here.

pub mod state;

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use self::state::{Again, KNOWN_AGAIN};
use super::frames::{Frames, MountError};
use super::ledger::Verdict;
use crate::config::OdometrySource;
use crate::slam::deskew::Velocity;
use crate::slam::pose::{Pose2, Stamp};
use crate::slam::scan::{LaserMount, Scan, ScanGeometry};
use crate::timeline::{Missing, OdometryBuffer, TimelineCounts};

/// How much odometry is kept, and at most how many samples: ten seconds at a kilohertz.
const KEEP: Duration = Duration::from_secs(10);
const MOST_SAMPLES: usize = 10_000;

/// Odometry this much older than the newest goes to the filter though no scan asks for it, ns.
///
/// Scans older than that are late.
const HORIZON: i64 = 5_000_000_000;

/// A scan this much before the last that was taken may come from a clock that was set back, ns.
const CLOCK_SET_BACK: i64 = 500_000_000;

/// A second scan after such a one belongs to it if it is not later than this, ns.
const CLOCK_RESTARTED: i64 = 10_000_000_000;

/// No laser takes longer for a sweep, s.
const LONGEST_SWEEP_S: f64 = 1.0;

/// Odometry that is missing by more than this, s, is hardly only late.
const CLOCKS_DIFFER_S: f64 = 1.0;

/// How to wait, and what to say while waiting.
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
    /// How long a scan waits, and how much later than it its odometry may be stamped.
    pub odometry_timeout: Duration,
    /// Scans that may wait.
    pub most_waiting: usize,
    /// Where odometry comes from.
    pub source: OdometrySource,
    /// What comes from there.
    pub sought: Sought,
    /// Seconds from the first beam of a sweep to the last; `None` is as the scan says, and 0 takes
    /// all at once.
    pub sweep_time_s: Option<f64>,
    /// Whether scans are of use without odometry.
    pub need: Need,
    /// The key of odometry messages.
    pub odom_key: String,
    /// Which transforms tell odometry, in words: key and frames.
    pub tf_path: String,
}

/// What says where the base is when a scan is taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sought {
    /// Odometry.
    Odometry,
    /// A given pose.
    Pose,
}

impl Sought {
    const fn name(self) -> &'static str {
        match self {
            Self::Odometry => "odometry",
            Self::Pose => "a given pose",
        }
    }

    const fn none(self) -> &'static str {
        match self {
            Self::Odometry => "no odometry",
            Self::Pose => "no given pose",
        }
    }
}

/// What becomes of a scan whose odometry does not come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Need {
    /// It is refused.
    Required,
    /// It goes without. While no odometry has come at all, only the first waits for it.
    Optional,
}

/// Odometry's messages or its transforms.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Channel {
    /// `nav_msgs/Odometry`.
    Messages,
    /// From `odom_frame` to `base_frame`.
    Transforms,
}

/// A scan and the frame of its laser.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FramedScan {
    /// The sweep.
    pub scan: Scan,
    /// The frame it was taken in.
    pub frame: String,
}

/// What is to be done next.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum Call {
    /// The filter takes odometry of a stamp.
    Odometry(Stamp, Pose2),
    /// The filter takes a scan.
    Scan(ReadyScan),
    /// A scan does not reach the filter.
    Refuse(Refusal),
    /// Odometry begins anew here: where it was before says nothing.
    BeginOdometry(Pose2),
}

/// A scan with all that is needed to use it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ReadyScan {
    /// The sweep.
    pub scan: Scan,
    /// How the laser sits.
    pub mount: LaserMount,
    /// The base at the scan's stamp; `None` if it goes without odometry.
    pub odom_from_base: Option<Pose2>,
}

/// A scan that does not reach the filter.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Refusal {
    /// The scan's; `None` if its bytes could not be read.
    pub stamp: Option<Stamp>,
    /// Why, in a word.
    pub verdict: Verdict,
    /// Why, in a sentence; may be empty.
    pub detail: String,
}

/// What became of scans that were not simply the newest.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ScanCounts {
    /// With the stamp of an earlier one.
    pub duplicates: u64,
    /// After a newer one.
    pub reordered: u64,
    /// Times the clock was set back.
    pub clock_restarts: u64,
    /// Taken as if the robot had stood still, for odometry has it move faster than a robot does
    /// during the sweep.
    pub not_deskewed: u64,
}

/// A scan that waits.
#[derive(Debug)]
struct Waiting {
    framed: FramedScan,
    since: Instant,
    /// Whether it has waited long enough to go without odometry.
    goes_without: bool,
}

impl Waiting {
    const fn stamp(&self) -> Stamp {
        self.framed.scan.stamp
    }
}

/// Where and how fast the laser was that took a scan.
#[derive(Debug)]
struct Place {
    mount: LaserMount,
    odom_from_base: Option<Pose2>,
    velocity: Velocity,
}

impl Place {
    /// Of a robot without odometry.
    fn still(mount: LaserMount) -> Self {
        Self { mount, odom_from_base: None, velocity: Velocity::default() }
    }
}

/// Why a scan is not ready.
#[derive(Debug)]
struct Lack {
    verdict: Verdict,
    detail: String,
    chance: Chance,
}

/// Whether what a scan lacks may still come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Chance {
    MayCome,
    Gone,
}

/// Scans and odometry on their way to the filter.
#[derive(Debug)]
pub struct Synchronizer {
    settings: Settings,
    odometry: OdometryBuffer,
    /// Where the odometry comes from that is kept.
    channel: Option<Channel>,
    /// The last odometry the filter got; of it, nothing older is of use.
    fed: Option<Stamp>,
    /// In the order of their stamps.
    waiting: VecDeque<Waiting>,
    /// The last scan the filter got.
    taken: Option<Stamp>,
    /// The last scan, if it came much too late: one more such, and the clock was set back.
    suspect: Option<Stamp>,
    calls: VecDeque<Call>,
    counts: ScanCounts,
    /// Whether a scan has waited for the first odometry in vain.
    waited_in_vain: bool,
    /// The last scans, whatever became of them.
    seen: VecDeque<Stamp>,
    /// What is fed again after a restart.
    again: Again,
}

impl Synchronizer {
    /// Nothing has come yet.
    #[must_use]
    pub fn new(settings: Settings) -> Self {
        Self {
            settings,
            odometry: OdometryBuffer::new(KEEP, MOST_SAMPLES),
            channel: None,
            fed: None,
            waiting: VecDeque::new(),
            taken: None,
            suspect: None,
            calls: VecDeque::new(),
            counts: ScanCounts::default(),
            waited_in_vain: false,
            seen: VecDeque::new(),
            again: Again::default(),
        }
    }

    /// Takes odometry; `false` if it comes on a channel that is not listened to.
    pub fn odometry(
        &mut self,
        channel: Channel,
        (stamp, odom_from_base): (Stamp, Pose2),
        frames: &Frames,
    ) -> bool {
        if !self.listens_to(channel) {
            return false;
        }
        let forgotten = self.odometry.is_too_late(stamp) || self.odometry.is_empty();
        if self.again.knows_odometry(stamp) && forgotten {
            self.odometry.count_duplicate();
            return true;
        }
        if let Some(pause) = self.odometry.newest().map(|newest| stamp.seconds_since(newest))
            && pause > 0.0
            && self.again.odometry_begins_anew(odom_from_base, pause)
        {
            self.begin_odometry(odom_from_base);
        }
        // What is about to be forgotten, for this sample comes long after it.
        self.feed(Stamp(stamp.0.saturating_sub(HORIZON)));
        let restarts = self.odometry.counts().restarts;
        self.odometry.insert(stamp, odom_from_base);
        if self.odometry.counts().restarts > restarts {
            self.fed = None;
            if self.again.odometry_begins_anew(odom_from_base, f64::INFINITY) {
                self.calls.push_back(Call::BeginOdometry(odom_from_base));
            }
        }
        self.release(frames);
        if let Some(newest) = self.odometry.newest() {
            self.feed(Stamp(newest.0.saturating_sub(HORIZON)));
        }
        true
    }

    /// The filter gets what is left of the odometry so far, and nothing is between that and this.
    fn begin_odometry(&mut self, odom_from_base: Pose2) {
        if let Some(newest) = self.odometry.newest() {
            self.feed(newest);
        }
        self.odometry.clear();
        self.calls.push_back(Call::BeginOdometry(odom_from_base));
    }

    /// Whether odometry of a channel is used; messages take the place of transforms until the
    /// filter has got odometry.
    fn listens_to(&mut self, channel: Channel) -> bool {
        let wanted = match self.settings.source {
            OdometrySource::Odom => channel == Channel::Messages,
            OdometrySource::Tf => channel == Channel::Transforms,
            OdometrySource::None => false,
            OdometrySource::Auto => match self.channel {
                None => true,
                Some(Channel::Transforms) if channel == Channel::Messages && self.fed.is_none() => {
                    self.odometry = OdometryBuffer::new(KEEP, MOST_SAMPLES);
                    true
                }
                Some(current) => current == channel,
            },
        };
        if wanted {
            self.channel = Some(channel);
        }
        wanted
    }

    /// Takes a scan at the time `now`.
    pub fn scan(&mut self, framed: FramedScan, now: Instant, frames: &Frames) {
        let stamp = framed.scan.stamp;
        if self.again.knows_scan(stamp, &self.seen) {
            self.counts.duplicates += 1;
            let detail = "it had its verdict before the restart".to_owned();
            self.refuse(stamp, Verdict::Duplicate, detail);
            return;
        }
        self.remember(stamp);
        if let Some((verdict, detail)) = self.out_of_order(stamp) {
            self.refuse(stamp, verdict, detail);
            return;
        }
        let position = self.waiting.partition_point(|other| other.stamp() < stamp);
        if self.waiting.get(position).is_some_and(|other| other.stamp() == stamp) {
            self.counts.duplicates += 1;
            self.refuse(stamp, Verdict::Duplicate, "a scan with this stamp waits already".into());
            return;
        }
        self.counts.reordered += u64::from(position < self.waiting.len());
        self.waiting.insert(position, Waiting { framed, since: now, goes_without: false });
        self.release(frames);
        self.make_room();
    }

    fn remember(&mut self, stamp: Stamp) {
        if self.seen.len() >= KNOWN_AGAIN {
            self.seen.pop_front();
        }
        self.seen.push_back(stamp);
    }

    /// What a scan is that does not come after the last that was taken.
    fn out_of_order(&mut self, stamp: Stamp) -> Option<(Verdict, String)> {
        let suspect = self.suspect.take();
        let taken = self.taken.filter(|taken| stamp <= *taken)?;
        if stamp == taken {
            self.counts.duplicates += 1;
            return Some((Verdict::Duplicate, "the last scan had this stamp".to_owned()));
        }
        let before = taken.0.saturating_sub(stamp.0);
        if before > CLOCK_SET_BACK {
            let follows =
                |first: Stamp| stamp > first && stamp.0.saturating_sub(first.0) <= CLOCK_RESTARTED;
            if suspect.is_some_and(follows) {
                self.counts.clock_restarts += 1;
                self.taken = None;
                self.again.forget_stamps();
                return None;
            }
            self.suspect = Some(stamp);
        }
        self.counts.reordered += 1;
        let by = before as f64 / 1e6;
        Some((Verdict::Late, format!("a scan that is {by:.1} ms newer was taken before it")))
    }

    fn make_room(&mut self) {
        while self.waiting.len() > self.settings.most_waiting {
            if let Some(oldest) = self.waiting.pop_front() {
                let detail = format!(
                    "{} newer scans came while it waited for its odometry",
                    self.settings.most_waiting
                );
                self.refuse(oldest.stamp(), Verdict::Overload, detail);
            }
        }
    }

    /// Looks again at the scans that wait, for a transform came.
    pub fn frames_changed(&mut self, frames: &Frames) {
        self.release(frames);
    }

    /// Ends the waiting of scans that have waited long enough at the time `now`.
    pub fn expire(&mut self, now: Instant, frames: &Frames) {
        let timeout = self.settings.odometry_timeout;
        self.give_up(frames, |waiting| waiting.since + timeout <= now);
    }

    /// Ends the waiting of all scans: nothing will come any more.
    pub fn finish(&mut self, frames: &Frames) {
        self.give_up(frames, |_| true);
    }

    fn give_up(&mut self, frames: &Frames, which: impl Fn(&Waiting) -> bool) {
        for mut waiting in std::mem::take(&mut self.waiting) {
            match self.place(&waiting, frames) {
                Err(lack) if which(&waiting) && self.can_go_without(&lack) => {
                    waiting.goes_without = true;
                    self.waited_in_vain = true;
                    self.waiting.push_back(waiting);
                }
                Err(lack) if which(&waiting) => {
                    self.refuse(waiting.stamp(), lack.verdict, lack.detail);
                }
                _ => self.waiting.push_back(waiting),
            }
        }
        self.release(frames);
    }

    /// When [`Self::expire`] is to be called; `None` while no scan waits.
    #[must_use]
    pub fn deadline(&self) -> Option<Instant> {
        let since = self.waiting.iter().map(|waiting| waiting.since).min()?;
        Some(since + self.settings.odometry_timeout)
    }

    /// What is to be done next.
    pub fn next_call(&mut self) -> Option<Call> {
        self.calls.pop_front()
    }

    /// The newest odometry, which the filter may not have got yet; `None` while it has to hear
    /// first that odometry begins anew.
    #[must_use]
    pub fn newest_odometry(&self) -> Option<(Stamp, Pose2)> {
        if self.calls.iter().any(|call| matches!(call, Call::BeginOdometry(_))) {
            return None;
        }
        let newest = self.odometry.newest()?;
        Some((newest, self.odometry.at(newest).ok()?))
    }

    /// How many scans wait for what they lack.
    #[must_use]
    pub fn waiting(&self) -> usize {
        self.waiting.len()
    }

    /// How many scans are ready and not called yet.
    #[must_use]
    pub fn ready(&self) -> usize {
        self.calls.iter().filter(|call| matches!(call, Call::Scan(_))).count()
    }

    /// Where odometry comes from; `None` before the first.
    #[must_use]
    pub const fn channel(&self) -> Option<Channel> {
        self.channel
    }

    /// What became of odometry that was not simply the newest.
    #[must_use]
    pub const fn odometry_counts(&self) -> TimelineCounts {
        self.odometry.counts()
    }

    /// What became of scans that were not simply the newest.
    #[must_use]
    pub const fn scan_counts(&self) -> ScanCounts {
        self.counts
    }

    /// Calls what is ready. Scans stay in the order of their stamps: one that waits holds up those
    /// after it.
    fn release(&mut self, frames: &Frames) {
        while let Some(first) = self.waiting.pop_front() {
            match self.place(&first, frames) {
                Ok(Place { mount, odom_from_base, velocity }) => {
                    let mut scan = first.framed.scan;
                    scan.geometry = self.timed(&scan).with_velocity(self.believed(velocity));
                    self.feed(scan.stamp);
                    self.taken = Some(scan.stamp);
                    self.calls.push_back(Call::Scan(ReadyScan { scan, mount, odom_from_base }));
                }
                Err(lack) if lack.chance == Chance::Gone => {
                    self.refuse(first.stamp(), lack.verdict, lack.detail);
                }
                Err(_) => {
                    self.waiting.push_front(first);
                    return;
                }
            }
        }
    }

    /// The motion during a sweep, or none where no robot moves like that: its odometry was reset
    /// meanwhile, or its pose found anew.
    fn believed(&mut self, velocity: Velocity) -> Velocity {
        if velocity.is_of_a_robot() {
            return velocity;
        }
        self.counts.not_deskewed += 1;
        Velocity::default()
    }

    /// Gives the filter the odometry up to a stamp.
    fn feed(&mut self, until: Stamp) {
        for &(stamp, odom_from_base) in self.odometry.between(self.fed, until) {
            self.fed = Some(stamp);
            self.calls.push_back(Call::Odometry(stamp, odom_from_base));
        }
    }

    fn refuse(&mut self, stamp: Stamp, verdict: Verdict, detail: String) {
        self.calls.push_back(Call::Refuse(Refusal { stamp: Some(stamp), verdict, detail }));
    }

    /// How the laser sat and where odometry had the base when a scan was taken.
    fn place(&self, waiting: &Waiting, frames: &Frames) -> Result<Place, Lack> {
        let (framed, stamp) = (&waiting.framed, waiting.stamp());
        let sweep_s = self.sweep_time(&framed.scan)?;
        let mount = frames.mount(&framed.frame, stamp).map_err(|error| {
            let (verdict, chance) = match error {
                MountError::Tilted { .. } => (Verdict::TiltedMount, Chance::Gone),
                MountError::NoFrame { .. } => (Verdict::NoMount, Chance::Gone),
                MountError::Unknown { .. } => (Verdict::NoMount, Chance::MayCome),
            };
            Lack { verdict, detail: error.to_string(), chance }
        })?;
        let none_comes = self.channel.is_none() && self.waited_in_vain;
        if self.settings.source == OdometrySource::None || none_comes {
            return Ok(Place::still(mount));
        }
        match self.odometry_during(stamp, sweep_s) {
            Ok((pose, velocity)) => Ok(Place { mount, odom_from_base: Some(pose), velocity }),
            Err(lack) if self.can_go_without(&lack) => {
                let now = waiting.goes_without || lack.chance == Chance::Gone;
                if now { Ok(Place::still(mount)) } else { Err(lack) }
            }
            Err(lack) => Err(lack),
        }
    }

    /// Where the base was at the stamp of a scan, and how fast during its sweep, for which odometry
    /// at the end of it is needed.
    fn odometry_during(&self, stamp: Stamp, sweep_s: f64) -> Result<(Pose2, Velocity), Lack> {
        let odom_from_base = self.odometry_at(stamp)?;
        if sweep_s == 0.0 {
            return Ok((odom_from_base, Velocity::default()));
        }
        let end = Stamp(stamp.0.saturating_add((sweep_s * 1e9) as i64));
        let motion = odom_from_base.between(self.odometry_at(end)?);
        Ok((odom_from_base, Velocity::of_motion(motion, sweep_s)))
    }

    /// Seconds from the first beam of a scan to the last, if a laser can take so long.
    fn sweep_time(&self, scan: &Scan) -> Result<f64, Lack> {
        let beams = scan.ranges.len().saturating_sub(1) as f64;
        let seconds = self.timed(scan).time_increment() * beams;
        if seconds.is_nan() || seconds.abs() > LONGEST_SWEEP_S {
            let detail = format!(
                "by its time_increment the sweep takes {seconds} s, which no laser needs; set \
                 sweep_time_s in the configuration"
            );
            return Err(Lack { verdict: Verdict::BadGeometry, detail, chance: Chance::Gone });
        }
        Ok(seconds)
    }

    /// When the beams of a scan are taken: as configured, or as it says.
    fn timed(&self, scan: &Scan) -> ScanGeometry {
        let intervals = scan.ranges.len().saturating_sub(1).max(1) as f64;
        match self.settings.sweep_time_s {
            Some(seconds) => scan.geometry.with_time_increment(seconds / intervals),
            None => scan.geometry,
        }
    }

    fn can_go_without(&self, lack: &Lack) -> bool {
        self.settings.need == Need::Optional && lack.verdict == Verdict::NoOdometry
    }

    fn odometry_at(&self, stamp: Stamp) -> Result<Pose2, Lack> {
        let too_late = |other: Stamp| {
            let after = other.seconds_since(stamp);
            after > self.settings.odometry_timeout.as_secs_f64()
        };
        let next = self.odometry.next(stamp);
        match (self.odometry.at(stamp), next.filter(|next| too_late(*next))) {
            (Ok(odom_from_base), None) => Ok(odom_from_base),
            (Ok(_), Some(next)) => Err(self.lack(
                next.seconds_since(stamp),
                "the next is newer than the scan",
                Chance::Gone,
            )),
            (Err(Missing::TooOld(by)), _) => {
                let gone = self.odometry.newest().is_some_and(too_late);
                let chance = if gone { Chance::Gone } else { Chance::MayCome };
                Err(self.lack(by.as_secs_f64(), "the oldest is newer than the scan", chance))
            }
            (Err(Missing::TooNew(by)), _) => Err(self.lack(
                by.as_secs_f64(),
                "the newest is older than the scan",
                Chance::MayCome,
            )),
            (Err(Missing::Empty), _) => {
                let detail = format!("{} has come {}", self.settings.sought.none(), self.origin());
                Err(Lack { verdict: Verdict::NoOdometry, detail, chance: Chance::MayCome })
            }
        }
    }

    fn lack(&self, missing_s: f64, what: &str, chance: Chance) -> Lack {
        let sought = self.settings.sought.name();
        let remedy = if missing_s > CLOCKS_DIFFER_S {
            format!("do the clocks that stamp them agree, and does {sought} still come?")
        } else {
            format!("if {sought} only comes late or seldom, raise odometry_timeout_s")
        };
        let origin = self.origin();
        let milliseconds = missing_s * 1e3;
        let detail = format!(
            "{sought} is missing by {milliseconds:.1} ms: {what} by that, of those {origin}; {remedy}"
        );
        Lack { verdict: Verdict::NoOdometry, detail, chance }
    }

    /// Where odometry comes from or is expected, in words.
    fn origin(&self) -> String {
        let Settings { source, odom_key, tf_path, .. } = &self.settings;
        match (source, self.channel) {
            (OdometrySource::Odom, _) | (_, Some(Channel::Messages)) => format!("on {odom_key}"),
            (OdometrySource::Tf, _) | (_, Some(Channel::Transforms)) => format!("in {tf_path}"),
            (OdometrySource::Auto | OdometrySource::None, None) => {
                format!("on {odom_key} or in {tf_path}")
            }
        }
    }
}

#[cfg(test)]
mod tests;
