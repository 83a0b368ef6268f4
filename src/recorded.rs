//! Recorded messages as readings for the filter: which topics, which frames, and in which order.
//!
//! The messages pass the daemon's own synchronizer with the times at which they were recorded as
//! its clock, so that a recording of a live run gives what the live run gave.

mod choice;
mod survey;
mod synchronized;
mod tree;

use std::path::Path;

use thiserror::Error;

pub use self::choice::{ChoiceError, Topics, Unclear, Wanted};
use self::survey::Survey;
pub use self::synchronized::Sweeps;
use self::synchronized::Synchronized;
use crate::config::Config;
use crate::convert;
use crate::daemon::frames::{FrameNames, Frames};
use crate::daemon::ledger::Verdict;
use crate::daemon::synchronizer::{Channel, Refusal};
use crate::logs::recording::{Kind, Message, Messages, RawMessage, Recording, RecordingError};
use crate::logs::{Fault, LogStatistics, Reading};
use crate::ros;
use crate::slam::pose::Stamp;
use crate::slam::scan::{LaserMount, Scan};
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
        let Topics { odometry, transforms, source, .. } = &self.topics;
        let odom_key = odometry.clone().unwrap_or_else(|| "a topic of odometry".to_owned());
        let FrameNames { base, odom } = &self.frames;
        let tf_path = format!("{} (from `{odom}` to `{base}`)", transforms.join(", "));
        let settings = synchronized::settings(config, *source, odom_key, tf_path);
        let tf_static = "/tf_static".to_owned();
        let frames = Frames::new(self.frames.clone(), config.laser_mount(), tf_static);
        Readings {
            messages: self.recording.messages(),
            topics: self.topics.clone(),
            synchronized: Synchronized::new(frames, settings),
            number: 0,
        }
    }
}

/// What comes next from a recording.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// For the filter.
    Reading(Reading),
    /// A scan for the filter that goes without odometry, and how its laser sits.
    ScanAlone(Scan, LaserMount),
    /// A scan that does not reach the filter.
    Refused(Refusal),
}

/// The readings of a recording, one after the other.
#[derive(Debug)]
pub struct Readings {
    messages: Messages,
    topics: Topics,
    synchronized: Synchronized,
    /// Of the message read last, from 1.
    number: u64,
}

impl Iterator for Readings {
    type Item = Event;

    fn next(&mut self) -> Option<Event> {
        loop {
            if let Some(event) = self.synchronized.next_event() {
                return Some(event);
            }
            if let Some(message) = self.messages.next() {
                self.number += 1;
                self.take(&message);
            } else if !self.synchronized.finish() {
                return None;
            }
        }
    }
}

impl Readings {
    fn take(&mut self, message: &RawMessage) {
        if !self.topics.uses(&message.topic) {
            return;
        }
        self.synchronized.advance(self.number, message.log_time);
        // What cannot be decoded was told by the survey.
        let Ok(content) = message.decode() else { return };
        match content {
            Message::LaserScan(scan) => self.take_scan(scan, message.log_time),
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

    fn take_scan(&mut self, message: ros::LaserScan, time: Stamp) {
        let frame = message.header.frame_id.clone();
        let stamp = convert::stamp(message.header.stamp).ok();
        match convert::scan(message) {
            Ok(scan) => self.synchronized.scan(scan, frame, time),
            Err(error) => {
                let (verdict, detail) = (Verdict::BadGeometry, error.to_string());
                self.synchronized.refuse(Refusal { stamp, verdict, detail });
            }
        }
    }

    fn take_odometry(&mut self, message: ros::Odometry) {
        if let Ok(sample) = convert::odometry(message) {
            let odometry = (sample.stamp, sample.odom_from_base);
            self.synchronized.odometry(Channel::Messages, odometry);
        }
    }

    fn take_transform(&mut self, message: ros::TransformStamped, kind: tf::Kind) {
        let Ok(transform) = convert::transform(message) else { return };
        if self.synchronized.frames.insert(&transform, kind).is_err() {
            return;
        }
        for (stamp, odom_from_base) in self.synchronized.frames.new_odometry() {
            if let Ok(pose) = odom_from_base {
                self.synchronized.odometry(Channel::Transforms, (stamp, pose));
            }
        }
        self.synchronized.frames_changed();
    }
}
