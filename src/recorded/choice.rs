//! Which topics are used: those that were named, or the only ones of their types.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use thiserror::Error;

use super::survey::Survey;
use crate::config::{Config, OdometrySource};
use crate::logs::Fault;
use crate::logs::recording::{Kind, Topic};

/// Topics that somebody has named; others are found by their types.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Wanted {
    /// Of the scans.
    pub scan: Option<String>,
    /// Of odometry, its messages or its transforms.
    pub odometry: Option<String>,
}

/// The topics that are used.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Topics {
    /// Of the scans.
    pub scan: String,
    /// Of odometry's messages, if there are any.
    pub odometry: Option<String>,
    /// Of transforms that move and that do not.
    pub transforms: Vec<String>,
    /// Where odometry comes from.
    pub source: OdometrySource,
}

/// Why it is not clear what to use.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum Unclear {
    /// There are none.
    #[error("it has no scans (sensor_msgs/LaserScan); it has {}", list(.0))]
    NoScans(Vec<String>),
    /// The topic that was named is not there.
    #[error("it has no {what} on {topic}; it has {}", list(.known))]
    Unknown {
        /// What should be there.
        what: &'static str,
        /// The topic.
        topic: String,
        /// The topics that are there.
        known: Vec<String>,
    },
    /// There are several.
    #[error("it has {what} on {}; choose one with {option}", list(.known))]
    Several {
        /// What there are several of.
        what: &'static str,
        /// The topics.
        known: Vec<String>,
        /// What to choose with.
        option: &'static str,
    },
    /// Neither odometry nor transforms.
    #[error(
        "it has no odometry: neither nav_msgs/Odometry nor transforms (tf2_msgs/TFMessage); it has \
         {}", list(.0)
    )]
    NoOdometry(Vec<String>),
}

/// Why a recording does not say what to use.
#[derive(Debug, Error, PartialEq, Eq)]
#[error("{}: {unclear}{damage}", path.display())]
pub struct ChoiceError {
    /// The recording.
    pub path: PathBuf,
    /// Why.
    pub unclear: Unclear,
    /// What could not be read of it, in words; may be empty.
    pub damage: String,
}

impl Unclear {
    pub(super) fn of(self, path: &Path, faults: &[Fault]) -> ChoiceError {
        let damage = faults.first().map_or_else(String::new, |fault| format!("; damaged: {fault}"));
        ChoiceError { path: path.to_owned(), unclear: self, damage }
    }
}

fn list(topics: &[String]) -> String {
    if topics.is_empty() { "nothing".to_owned() } else { topics.join(", ") }
}

impl Topics {
    pub(super) fn choose(
        survey: &Survey,
        all: &BTreeMap<String, String>,
        wanted: &Wanted,
        config: &Config,
    ) -> Result<Self, Unclear> {
        let every = || all.iter().map(|(topic, kind)| format!("{topic} ({kind})")).collect();
        let scans = survey.of_kind(Kind::LaserScan);
        let scan = match (&wanted.scan, scans.as_slice()) {
            (Some(topic), _) => find("scans", topic, &scans)?,
            (None, []) => return Err(Unclear::NoScans(every())),
            (None, [topic]) => (*topic).to_owned(),
            (None, _) => return Err(several("scans", &scans, "--scan")),
        };
        let near = |kind| near(&scan, survey.of_kind(kind));
        let messages = survey.of_kind(Kind::Odometry);
        let mut transforms: Vec<String> = near(Kind::Transforms);
        let mut source = config.raw.odometry_source;
        let mut odometry = None;
        if let Some(topic) = &wanted.odometry {
            let known = [messages, survey.of_kind(Kind::Transforms)].concat();
            let topic = find("odometry", topic, &known)?;
            if survey.topics.get(&topic).is_some_and(|topic| topic.kind == Kind::Odometry) {
                (source, odometry) = (OdometrySource::Odom, Some(topic));
            } else {
                source = OdometrySource::Tf;
                transforms.retain(|other| *other != topic);
                transforms.push(topic);
            }
        } else if !matches!(source, OdometrySource::Tf | OdometrySource::None) {
            odometry = match near(Kind::Odometry).as_slice() {
                [] => None,
                [topic] => Some(topic.clone()),
                _ => return Err(several("odometry", &messages, "--odom")),
            };
        }
        let none = match source {
            OdometrySource::None => false,
            OdometrySource::Odom => odometry.is_none(),
            OdometrySource::Tf => transforms.is_empty(),
            OdometrySource::Auto => {
                let needed = config.raw.engine.needs_odometry();
                needed && odometry.is_none() && transforms.is_empty()
            }
        };
        if none {
            return Err(Unclear::NoOdometry(every()));
        }
        transforms.extend(near(Kind::StaticTransforms));
        Ok(Self { scan, odometry, transforms, source })
    }

    /// Whether messages on a topic are used.
    #[must_use]
    pub fn uses(&self, topic: &Topic) -> bool {
        self.names(&topic.name)
    }

    /// Whether a topic is used.
    pub(super) fn names(&self, topic: &str) -> bool {
        topic == self.scan
            || self.odometry.as_deref() == Some(topic)
            || self.transforms.iter().any(|other| other == topic)
    }
}

fn find(what: &'static str, topic: &str, known: &[&str]) -> Result<String, Unclear> {
    let bare = |topic: &str| topic.trim_start_matches('/').to_owned();
    match known.iter().find(|other| bare(other) == bare(topic)) {
        Some(found) => Ok((*found).to_owned()),
        None => Err(Unclear::Unknown { what, topic: topic.to_owned(), known: owned(known) }),
    }
}

fn several(what: &'static str, known: &[&str], option: &'static str) -> Unclear {
    Unclear::Several { what, known: owned(known), option }
}

fn owned(topics: &[&str]) -> Vec<String> {
    topics.iter().map(|&topic| topic.to_owned()).collect()
}

/// Of several topics those of the scan's robot: of the same namespace, else of none.
fn near(scan: &str, topics: Vec<&str>) -> Vec<String> {
    let namespace = |topic: &str| {
        let (namespace, _) = topic.trim_start_matches('/').rsplit_once('/').unwrap_or_default();
        namespace.to_owned()
    };
    let within = |wanted: &str| -> Vec<&str> {
        topics.iter().copied().filter(|topic| namespace(topic) == wanted).collect()
    };
    let own = within(&namespace(scan));
    let common = within("");
    let found = if topics.len() < 2 {
        topics
    } else if !own.is_empty() {
        own
    } else if !common.is_empty() {
        common
    } else {
        topics
    };
    owned(&found)
}
