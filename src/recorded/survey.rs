//! What a recording holds, before anything of it is used.

use std::collections::BTreeMap;

use super::choice::Topics;
use super::tree::Tree;
use crate::convert;
use crate::logs::LogStatistics;
use crate::logs::recording::{Kind, Message, RawMessage};
use crate::ros;
use crate::slam::pose::Stamp;

/// All topics of use.
#[derive(Debug, Default)]
pub(super) struct Survey {
    /// By name.
    pub(super) topics: BTreeMap<String, TopicSurvey>,
}

/// What is known of a topic.
#[derive(Debug)]
pub(super) struct TopicSurvey {
    pub(super) kind: Kind,
    messages: u64,
    malformed: u64,
    first_malformed: Option<String>,
    /// Of the first message: a scan's laser, odometry's base.
    pub(super) frame: Option<String>,
    stamps: Option<(Stamp, Stamp)>,
    /// Of transforms.
    pub(super) tree: Tree,
}

impl TopicSurvey {
    const fn new(kind: Kind) -> Self {
        Self {
            kind,
            messages: 0,
            malformed: 0,
            first_malformed: None,
            frame: None,
            stamps: None,
            tree: Tree::new(),
        }
    }

    fn add(&mut self, content: Message) -> Result<(), String> {
        match content {
            Message::LaserScan(scan) => self.note(&scan.header, &scan.header.frame_id),
            Message::Odometry(odometry) => {
                self.note(&odometry.header, &odometry.child_frame_id)?;
                convert::odometry(*odometry).map(|_| ()).map_err(|error| error.to_string())
            }
            Message::Transforms(transforms) => {
                let transforms = transforms.transforms.into_iter().map(convert::transform);
                let (good, bad): (Vec<_>, Vec<_>) = transforms.partition(Result::is_ok);
                good.into_iter().flatten().for_each(|transform| self.tree.add(&transform));
                bad.into_iter().find_map(Result::err).map_or(Ok(()), |error| Err(error.to_string()))
            }
        }
    }

    fn note(&mut self, header: &ros::Header, frame: &str) -> Result<(), String> {
        self.frame.get_or_insert_with(|| frame.trim_start_matches('/').to_owned());
        let stamp = convert::stamp(header.stamp).map_err(|error| error.to_string())?;
        let (first, last) = self.stamps.unwrap_or((stamp, stamp));
        self.stamps = Some((first.min(stamp), last.max(stamp)));
        Ok(())
    }
}

impl Survey {
    pub(super) fn add(&mut self, message: &RawMessage) {
        let name = message.topic.name.clone();
        let kind = message.topic.kind;
        let topic = self.topics.entry(name).or_insert_with(|| TopicSurvey::new(kind));
        topic.messages += 1;
        if let Err(reason) = message.decode().and_then(|content| topic.add(content)) {
            topic.malformed += 1;
            topic.first_malformed.get_or_insert(reason);
        }
    }

    /// The names of the topics of a kind.
    pub(super) fn of_kind(&self, kind: Kind) -> Vec<&str> {
        let of_kind = self.topics.iter().filter(|(_, topic)| topic.kind == kind);
        of_kind.map(|(name, _)| name.as_str()).collect()
    }

    pub(super) fn statistics(&self, chosen: &Topics) -> LogStatistics {
        let mut statistics = LogStatistics::default();
        for (name, topic) in &self.topics {
            statistics.lines += topic.messages;
            statistics.lines_by_keyword.insert(name.clone(), topic.messages);
            if !chosen.names(name) {
                continue;
            }
            statistics.malformed += topic.malformed;
            statistics.readings += topic.messages - topic.malformed;
            if *name == chosen.scan {
                statistics.scans += topic.messages - topic.malformed;
                statistics.stamps = topic.stamps;
            }
        }
        statistics
    }

    /// Of each topic with malformed messages how many they are, and what is wrong with the first.
    pub(super) fn into_rejected(self, chosen: &Topics) -> Vec<String> {
        let mut rejected = Vec::new();
        for (name, topic) in self.topics {
            if let Some(reason) = topic.first_malformed.filter(|_| chosen.names(&name)) {
                let TopicSurvey { messages, malformed, .. } = topic;
                rejected.push(format!(
                    "{malformed} of {messages} messages on {name} cannot be used; the first: {reason}"
                ));
            }
        }
        rejected
    }
}
