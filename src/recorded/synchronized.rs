//! Readings as they leave the daemon's synchronizer, with the times of a log as its clock.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use super::Event;
use crate::clock;
use crate::config::{Config, OdometrySource};
use crate::convert;
use crate::daemon::frames::{FrameNames, Frames};
use crate::daemon::ledger::Verdict;
use crate::daemon::synchronizer::{
    self, Call, Channel, FramedScan, Need, ReadyScan, Refusal, Sought, Synchronizer,
};
use crate::logs::{LogError, Reading};
use crate::slam::pose::{Pose2, Stamp};
use crate::slam::scan::{LaserMount, Scan};
use crate::tf;

/// Frames of what has no frames.
const BASE: &str = "base_link";
const LASER: &str = "laser";

/// A synchronizer between what was recorded and the filter.
#[derive(Debug)]
pub(super) struct Synchronized {
    pub(super) frames: Frames,
    synchronizer: Synchronizer,
    /// The first time of the log, and what stands for it.
    start: Option<(Stamp, Instant)>,
    /// Of the message or line read last, from 1.
    line: u64,
    /// Odometry that the next scan may bring again.
    odometry: Option<(Stamp, Pose2)>,
    ready: VecDeque<Event>,
    ended: bool,
}

impl Synchronized {
    pub(super) fn new(frames: Frames, settings: synchronizer::Settings) -> Self {
        Self {
            frames,
            synchronizer: Synchronizer::new(settings),
            start: None,
            line: 0,
            odometry: None,
            ready: VecDeque::new(),
            ended: false,
        }
    }

    /// What comes next; `None` until more is read, and at the end.
    pub(super) fn next_event(&mut self) -> Option<Event> {
        while self.ready.is_empty() {
            let call = self.synchronizer.next_call()?;
            self.make(call);
        }
        self.ready.pop_front()
    }

    /// Nothing more is read. Whether something may come out of that.
    pub(super) fn finish(&mut self) -> bool {
        let first = !self.ended;
        if first {
            self.ended = true;
            self.synchronizer.finish(&self.frames);
        }
        first
    }

    /// Something was read at a time of the log, on a line.
    pub(super) fn advance(&mut self, line: u64, time: Stamp) {
        self.line = line;
        let now = self.now(time);
        while self.synchronizer.deadline().is_some_and(|deadline| deadline <= now) {
            let waiting = self.synchronizer.waiting();
            self.synchronizer.expire(now, &self.frames);
            if self.synchronizer.waiting() == waiting {
                break;
            }
        }
    }

    /// The time on a clock that starts with the log.
    fn now(&mut self, time: Stamp) -> Instant {
        let (first, start) = *self.start.get_or_insert_with(|| (time, clock::now()));
        let passed = time.0.saturating_sub(first.0);
        start + Duration::from_nanos(u64::try_from(passed).unwrap_or(0))
    }

    pub(super) fn scan(&mut self, scan: Scan, frame: String, time: Stamp) {
        let now = self.now(time);
        self.synchronizer.scan(FramedScan { scan, frame }, now, &self.frames);
    }

    pub(super) fn odometry(&mut self, channel: Channel, sample: (Stamp, Pose2)) {
        self.synchronizer.odometry(channel, sample, &self.frames);
    }

    pub(super) fn frames_changed(&mut self) {
        self.synchronizer.frames_changed(&self.frames);
    }

    pub(super) fn refuse(&mut self, refusal: Refusal) {
        self.ready.push_back(Event::Refused(refusal));
    }

    fn make(&mut self, call: Call) {
        match call {
            Call::Odometry(stamp, odom_from_base) => {
                self.give_odometry();
                self.odometry = Some((stamp, odom_from_base));
            }
            Call::Scan(ReadyScan { scan, mount, odom_from_base }) => {
                let (line, stamp) = (self.line, scan.stamp);
                let Some(odom_from_base) = odom_from_base else {
                    self.give_odometry();
                    return self.ready.push_back(Event::ScanAlone(scan, mount));
                };
                // The odometry of a scan comes with it, and once is enough.
                self.odometry.take_if(|odometry| *odometry == (stamp, odom_from_base));
                self.give_odometry();
                let reading = Reading { line, stamp, odom_from_base, scan: Some(scan), mount };
                self.ready.push_back(Event::Reading(reading));
            }
            Call::Refuse(refusal) => self.ready.push_back(Event::Refused(refusal)),
            // A recording has no restart.
            Call::BeginOdometry(_) => {}
        }
    }

    fn give_odometry(&mut self) {
        if let Some((stamp, odom_from_base)) = self.odometry.take() {
            let (line, mount) = (self.line, LaserMount::default());
            let reading = Reading { line, stamp, odom_from_base, scan: None, mount };
            self.ready.push_back(Event::Reading(reading));
        }
    }
}

/// How the daemon would match scans with their odometry.
pub(super) fn settings(
    config: &Config,
    source: OdometrySource,
    odom_key: String,
    tf_path: String,
) -> synchronizer::Settings {
    let raw = &config.raw;
    let need = if raw.engine.needs_odometry() { Need::Required } else { Need::Optional };
    synchronizer::Settings {
        odometry_timeout: Duration::from_secs_f64(raw.odometry_timeout_s),
        most_waiting: raw.scan_queue,
        sweep_time_s: raw.sweep_time_s,
        source,
        sought: Sought::Odometry,
        need,
        odom_key,
        tf_path,
    }
}

/// Readings of a log whose scans are sweeps: each waits for the odometry at the end of its sweep,
/// and is then as the daemon has it when the log is played.
#[derive(Debug)]
pub struct Sweeps<I> {
    readings: I,
    synchronized: Synchronized,
    /// Of the last scan.
    mount: Option<LaserMount>,
}

impl<I: Iterator<Item = Result<Reading, LogError>>> Sweeps<I> {
    /// Of readings that no message has carried yet.
    pub fn new(readings: I, config: &Config) -> Self {
        let source = match config.raw.odometry_source {
            OdometrySource::None => OdometrySource::None,
            OdometrySource::Auto | OdometrySource::Odom | OdometrySource::Tf => {
                OdometrySource::Odom
            }
        };
        let settings = settings(config, source, "the log's lines".to_owned(), String::new());
        let names = FrameNames { base: BASE.to_owned(), odom: "odom".to_owned() };
        let frames = Frames::new(names, config.laser_mount(), String::new());
        Self { readings, synchronized: Synchronized::new(frames, settings), mount: None }
    }

    fn take(&mut self, reading: &Reading) {
        let Reading { line, stamp, .. } = *reading;
        self.synchronized.advance(line, stamp);
        let odom_from_base = convert::odometry_as_received(stamp, reading.odom_from_base);
        self.synchronized.odometry(Channel::Messages, (stamp, odom_from_base));
        let Some(scan) = &reading.scan else { return };
        self.sit(&reading.mount);
        match convert::scan(convert::laser_scan(scan, LASER)) {
            Ok(scan) => self.synchronized.scan(scan, LASER.to_owned(), stamp),
            Err(error) => {
                let (verdict, detail) = (Verdict::BadGeometry, error.to_string());
                self.synchronized.refuse(Refusal { stamp: Some(stamp), verdict, detail });
            }
        }
    }

    /// How the laser sits, as a static transform tells it.
    fn sit(&mut self, mount: &LaserMount) {
        if self.mount.as_ref() == Some(mount) {
            return;
        }
        self.mount = Some(*mount);
        let header = convert::header(Stamp(0), BASE);
        let transform = convert::transform(convert::mount_transform(header, LASER, mount));
        if let Ok(transform) = transform
            && self.synchronized.frames.insert(&transform, tf::Kind::Static).is_ok()
        {
            self.synchronized.frames_changed();
        }
    }
}

impl<I: Iterator<Item = Result<Reading, LogError>>> Iterator for Sweeps<I> {
    type Item = Result<Event, LogError>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            if let Some(event) = self.synchronized.next_event() {
                return Some(Ok(event));
            }
            match self.readings.next() {
                Some(Ok(reading)) => self.take(&reading),
                Some(Err(error)) => return Some(Err(error)),
                None if self.synchronized.finish() => {}
                None => return None,
            }
        }
    }
}
