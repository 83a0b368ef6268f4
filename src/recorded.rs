//! Recorded messages as readings for the filter: which topics, which frames, and in which order.
//!
//! The messages pass the daemon's own synchronizer with the times at which they were recorded as
//! its clock, so that a recording of a live run gives what the live run gave.

mod choice;
mod survey;
mod tree;

use std::collections::VecDeque;
use std::path::Path;
use std::time::{Duration, Instant};

use thiserror::Error;

pub use self::choice::{ChoiceError, Topics, Unclear, Wanted};
use self::survey::Survey;
use crate::clock;
use crate::config::Config;
use crate::convert;
use crate::daemon::frames::{FrameNames, Frames};
use crate::daemon::ledger::Verdict;
use crate::daemon::synchronizer::{
    self, Call, Channel, FramedScan, Need, ReadyScan, Refusal, Sought, Synchronizer,
};
use crate::logs::recording::{Kind, Message, Messages, RawMessage, Recording, RecordingError};
use crate::logs::{Fault, LogStatistics, Reading};
use crate::ros;
use crate::slam::pose::{Pose2, Stamp};
use crate::slam::scan::LaserMount;
use crate::tf;

/// Why a recording cannot be used.
#[derive(Debug, Error)]
pub enum RecordedError {
    /// It cannot be read.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// It does not say what to use.
    #[error(transparent)]
    Choice(#[from] ChoiceError),
}

/// A recording that has been surveyed.
#[derive(Debug)]
pub struct Recorded {
    recording: Recording,
    topics: Topics,
    frames: FrameNames,
    statistics: LogStatistics,
    faults: Vec<Fault>,
    rejected: Vec<String>,
}

impl Recorded {
    /// Reads a recording once from end to end.
    ///
    /// # Errors
    /// When it does not say clearly which scans and which odometry to use.
    pub fn open(
        recording: Recording,
        path: &Path,
        wanted: &Wanted,
        config: &Config,
    ) -> Result<Self, RecordedError> {
        let mut messages = recording.messages();
        let mut survey = Survey::default();
        for message in messages.by_ref() {
            survey.add(&message);
        }
        let topics = Topics::choose(&survey, messages.topics(), wanted, config)
            .map_err(|error| error.of(path, messages.faults()))?;
        let frames = tree::frame_names(&survey, &topics, config);
        let statistics = survey.statistics(&topics);
        let rejected = survey.into_rejected(&topics);
        let faults = messages.into_faults();
        Ok(Self { recording, topics, frames, statistics, faults, rejected })
    }

    /// What the survey found.
    #[must_use]
    pub const fn statistics(&self) -> &LogStatistics {
        &self.statistics
    }

    /// What is used of it.
    #[must_use]
    pub const fn topics(&self) -> &Topics {
        &self.topics
    }

    /// The names of the robot's and of odometry's frame.
    #[must_use]
    pub const fn frames(&self) -> &FrameNames {
        &self.frames
    }

    /// Where something could not be read.
    #[must_use]
    pub fn faults(&self) -> &[Fault] {
        &self.faults
    }

    /// The first message of each topic that is not what its type asks for, in words.
    #[must_use]
    pub fn rejected(&self) -> &[String] {
        &self.rejected
    }

    /// The messages that are used, as they were recorded.
    pub fn messages(&self) -> impl Iterator<Item = RawMessage> + '_ {
        self.recording.messages().filter(|message| self.topics.uses(&message.topic))
    }

    /// What the filter is to take, in its order.
    #[must_use]
    pub fn readings(&self, config: &Config) -> Readings {
        let raw = &config.raw;
        let Topics { odometry, transforms, .. } = &self.topics;
        let odom_key = odometry.clone().unwrap_or_else(|| "a topic of odometry".to_owned());
        let FrameNames { base, odom } = &self.frames;
        let synchronizer = Synchronizer::new(synchronizer::Settings {
            odometry_timeout: Duration::from_secs_f64(raw.odometry_timeout_s),
            most_waiting: raw.scan_queue,
            sweep_time_s: raw.sweep_time_s,
            source: self.topics.source,
            sought: Sought::Odometry,
            need: Need::Required,
            odom_key,
            tf_path: format!("{} (from `{odom}` to `{base}`)", transforms.join(", ")),
        });
        let tf_static = "/tf_static".to_owned();
        Readings {
            messages: self.recording.messages(),
            topics: self.topics.clone(),
            frames: Frames::new(self.frames.clone(), config.laser_mount(), tf_static),
            synchronizer,
            start: None,
            number: 0,
            ended: false,
            odometry: None,
            ready: VecDeque::new(),
        }
    }
}

/// What comes next from a recording.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// For the filter.
    Reading(Reading),
    /// A scan that does not reach the filter.
    Refused(Refusal),
}

/// The readings of a recording, one after the other.
#[derive(Debug)]
pub struct Readings {
    messages: Messages,
    topics: Topics,
    frames: Frames,
    synchronizer: Synchronizer,
    /// The time of the first message, and what stands for it.
    start: Option<(Stamp, Instant)>,
    /// Of the message read last, from 1.
    number: u64,
    ended: bool,
    /// Odometry that the next scan may bring again.
    odometry: Option<(Stamp, Pose2)>,
    ready: VecDeque<Event>,
}

impl Iterator for Readings {
    type Item = Event;

    fn next(&mut self) -> Option<Event> {
        loop {
            if let Some(event) = self.ready.pop_front() {
                return Some(event);
            }
            if let Some(call) = self.synchronizer.next_call() {
                self.make(call);
            } else if let Some(message) = self.messages.next() {
                self.number += 1;
                self.take(&message);
            } else if self.ended {
                return None;
            } else {
                self.ended = true;
                self.synchronizer.finish(&self.frames);
            }
        }
    }
}

impl Readings {
    fn make(&mut self, call: Call) {
        match call {
            Call::Odometry(stamp, odom_from_base) => {
                self.give_odometry();
                self.odometry = Some((stamp, odom_from_base));
            }
            Call::Scan(ReadyScan { scan, mount, odom_from_base }) => {
                let stamp = scan.stamp;
                // None only if the configuration wants none, and then nobody looks at it.
                let odom_from_base = odom_from_base.unwrap_or_default();
                // The odometry of a scan comes with it, and once is enough.
                self.odometry.take_if(|odometry| *odometry == (stamp, odom_from_base));
                self.give_odometry();
                let line = self.number;
                let reading = Reading { line, stamp, odom_from_base, scan: Some(scan), mount };
                self.ready.push_back(Event::Reading(reading));
            }
            Call::Refuse(refusal) => self.ready.push_back(Event::Refused(refusal)),
        }
    }

    fn give_odometry(&mut self) {
        if let Some((stamp, odom_from_base)) = self.odometry.take() {
            let (line, mount) = (self.number, LaserMount::default());
            let reading = Reading { line, stamp, odom_from_base, scan: None, mount };
            self.ready.push_back(Event::Reading(reading));
        }
    }

    fn take(&mut self, message: &RawMessage) {
        if !self.topics.uses(&message.topic) {
            return;
        }
        let now = self.now(message.log_time);
        while self.synchronizer.deadline().is_some_and(|deadline| deadline <= now) {
            let waiting = self.synchronizer.waiting();
            self.synchronizer.expire(now, &self.frames);
            if self.synchronizer.waiting() == waiting {
                break;
            }
        }
        // What cannot be decoded was told by the survey.
        let Ok(content) = message.decode() else { return };
        match content {
            Message::LaserScan(scan) => self.take_scan(scan, now),
            Message::Odometry(odometry) => self.take_odometry(*odometry),
            Message::Transforms(transforms) => {
                let fixed = message.topic.kind == Kind::StaticTransforms;
                let kind = if fixed { tf::Kind::Static } else { tf::Kind::Dynamic };
                for transform in transforms.transforms {
                    self.take_transform(transform, kind);
                }
            }
        }
    }

    /// The time of a message on a clock that starts with the first.
    fn now(&mut self, log_time: Stamp) -> Instant {
        let (first, start) = *self.start.get_or_insert_with(|| (log_time, clock::now()));
        let passed = log_time.0.saturating_sub(first.0);
        start + Duration::from_nanos(u64::try_from(passed).unwrap_or(0))
    }

    fn take_scan(&mut self, message: ros::LaserScan, now: Instant) {
        let frame = message.header.frame_id.clone();
        let stamp = convert::stamp(message.header.stamp).ok();
        match convert::scan(message) {
            Ok(scan) => self.synchronizer.scan(FramedScan { scan, frame }, now, &self.frames),
            Err(error) => {
                let (verdict, detail) = (Verdict::BadGeometry, error.to_string());
                self.ready.push_back(Event::Refused(Refusal { stamp, verdict, detail }));
            }
        }
    }

    fn take_odometry(&mut self, message: ros::Odometry) {
        if let Ok(sample) = convert::odometry(message) {
            let odometry = (sample.stamp, sample.odom_from_base);
            self.synchronizer.odometry(Channel::Messages, odometry, &self.frames);
        }
    }

    fn take_transform(&mut self, message: ros::TransformStamped, kind: tf::Kind) {
        let Ok(transform) = convert::transform(message) else { return };
        if self.frames.insert(&transform, kind).is_err() {
            return;
        }
        for (stamp, odom_from_base) in self.frames.new_odometry() {
            if let Ok(pose) = odom_from_base {
                self.synchronizer.odometry(Channel::Transforms, (stamp, pose), &self.frames);
            }
        }
        self.synchronizer.frames_changed(&self.frames);
    }
}
