//! Recorded ROS messages: rosbag2's MCAP files and folders, and ROS 1 bags.
//!
//! The file is told by its first bytes, never by its name alone.

use std::collections::{BTreeMap, VecDeque};
use std::fs::File;
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::Deserialize;
use thiserror::Error;

use super::bag::{self, BagReader};
use super::mcap::{self, McapReader};
use super::ros1;
use super::source::Fault;
use crate::ros;
use crate::slam::pose::Stamp;

/// Messages are put in the order of their log times among so many: those who record with several
/// threads mix up neighbours.
const WINDOW: usize = 256;

/// Faults that are kept; what follows is no news.
const FAULTS_KEPT: usize = 100;

/// What a file is, by its first bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// CARMEN's text, plain or gzipped.
    Carmen,
    /// MCAP, or a folder with such files.
    Mcap,
    /// A ROS 1 bag.
    Bag,
}

/// Why there is nothing to read.
#[derive(Debug, Error)]
pub enum RecordingError {
    /// The file or folder does not open.
    #[error("cannot open the log {}", path.display())]
    Open {
        /// The recording.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// It is nothing that is known.
    #[error(
        "{} is no log that gmapd knows; it reads CARMEN logs (text, plain or gzipped), rosbag2 \
         recordings in MCAP (a .mcap file, or the folder with metadata.yaml) and ROS 1 bags of \
         version 2.0; `ros2 bag convert` makes MCAP of rosbag2's SQLite files (.db3)",
        path.display()
    )]
    UnknownFormat {
        /// The file.
        path: PathBuf,
    },
    /// The folder's `metadata.yaml` cannot be used.
    #[error("cannot use {}: {reason}", path.display())]
    Metadata {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
}

/// Tells what a file or folder is.
///
/// # Errors
/// When it does not open or is nothing that is known.
pub fn format(path: &Path) -> Result<Format, RecordingError> {
    let open = |source| RecordingError::Open { path: path.to_owned(), source };
    if std::fs::metadata(path).map_err(open)?.is_dir() {
        return Ok(Format::Mcap);
    }
    let mut start = Vec::new();
    File::open(path).and_then(|file| file.take(1024).read_to_end(&mut start)).map_err(open)?;
    if start.starts_with(mcap::MAGIC) {
        Ok(Format::Mcap)
    } else if start.starts_with(bag::MAGIC) {
        Ok(Format::Bag)
    } else if start.starts_with(b"#ROSBAG") || start.starts_with(&mcap::MAGIC[..5]) {
        Err(RecordingError::UnknownFormat { path: path.to_owned() })
    } else if start.starts_with(&[0x1f, 0x8b]) || !start.contains(&0) {
        Ok(Format::Carmen)
    } else {
        Err(RecordingError::UnknownFormat { path: path.to_owned() })
    }
}

/// What kind of message a topic has, of those that are of use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// `sensor_msgs/LaserScan`.
    LaserScan,
    /// `nav_msgs/Odometry`.
    Odometry,
    /// `tf2_msgs/TFMessage` of frames that move.
    Transforms,
    /// `tf2_msgs/TFMessage` of frames that do not.
    StaticTransforms,
}

/// How the messages of a topic are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Wire {
    /// CDR with its four bytes of header, or JSON.
    Ros2,
    /// As ROS 1 writes them.
    Ros1,
}

/// A topic of use.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Topic {
    /// Its name, with a leading slash where the recording has one.
    pub name: String,
    /// What its messages say.
    pub kind: Kind,
    wire: Wire,
}

impl Topic {
    /// `None` for types that are of no use.
    pub(super) fn new(name: &str, kind: &str, wire: Wire) -> Option<Self> {
        let kind = match kind {
            "sensor_msgs/msg/LaserScan" | "sensor_msgs/LaserScan" => Kind::LaserScan,
            "nav_msgs/msg/Odometry" | "nav_msgs/Odometry" => Kind::Odometry,
            "tf2_msgs/msg/TFMessage" | "tf2_msgs/TFMessage" | "tf/tfMessage"
                if name.ends_with("tf_static") =>
            {
                Kind::StaticTransforms
            }
            "tf2_msgs/msg/TFMessage" | "tf2_msgs/TFMessage" | "tf/tfMessage" => Kind::Transforms,
            _ => return None,
        };
        Some(Self { name: name.to_owned(), kind, wire })
    }
}

/// A message as it was recorded.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RawMessage {
    /// Where it came.
    pub topic: Arc<Topic>,
    /// When it came.
    pub log_time: Stamp,
    /// Its bytes.
    pub bytes: Vec<u8>,
}

/// A message.
#[derive(Debug, Clone, PartialEq)]
pub enum Message {
    /// A sweep.
    LaserScan(ros::LaserScan),
    /// Odometry.
    Odometry(Box<ros::Odometry>),
    /// Transforms of either kind.
    Transforms(ros::TfMessage),
}

impl Message {
    /// Its own; of transforms that of the first. `None` if it has none that can be.
    #[must_use]
    pub fn stamp(&self) -> Option<Stamp> {
        let header = match self {
            Self::LaserScan(scan) => &scan.header,
            Self::Odometry(odometry) => &odometry.header,
            Self::Transforms(transforms) => &transforms.transforms.first()?.header,
        };
        let ros::Time { sec, nanosec } = header.stamp;
        let stamp = Stamp(i64::from(sec) * 1_000_000_000 + i64::from(nanosec));
        (nanosec < 1_000_000_000).then_some(stamp)
    }
}

impl RawMessage {
    /// What it says.
    ///
    /// # Errors
    /// In words, when the bytes are no message of the topic's type.
    pub fn decode(&self) -> Result<Message, String> {
        let bytes = &self.bytes;
        match (self.topic.wire, self.topic.kind) {
            (Wire::Ros2, Kind::LaserScan) => ros2(bytes).map(Message::LaserScan),
            (Wire::Ros2, Kind::Odometry) => ros2(bytes).map(Box::new).map(Message::Odometry),
            (Wire::Ros2, Kind::Transforms | Kind::StaticTransforms) => {
                ros2(bytes).map(Message::Transforms)
            }
            (Wire::Ros1, kind) => {
                let message = match kind {
                    Kind::LaserScan => ros1::laser_scan(bytes).map(Message::LaserScan),
                    Kind::Odometry => ros1::odometry(bytes).map(Box::new).map(Message::Odometry),
                    Kind::Transforms | Kind::StaticTransforms => {
                        ros1::transforms(bytes).map(Message::Transforms)
                    }
                };
                let length = bytes.len();
                message.ok_or_else(|| format!("its {length} bytes are no ROS 1 message"))
            }
        }
    }

    /// What it says, as ROS 2 writes it.
    ///
    /// # Errors
    /// In words, when the bytes are no message of the topic's type.
    pub fn cdr(&self) -> Result<Vec<u8>, String> {
        if self.topic.wire == Wire::Ros2 {
            return Ok(self.bytes.clone());
        }
        Ok(match self.decode()? {
            Message::LaserScan(message) => ros::cdr(&message),
            Message::Odometry(message) => ros::cdr(&*message),
            Message::Transforms(message) => ros::cdr(&message),
        })
    }
}

fn ros2<M: ros::Message>(bytes: &[u8]) -> Result<M, String> {
    ros::decode(bytes, "").map_err(|error| error.to_string())
}

/// A recording: the files it has, one after the other.
#[derive(Debug, Clone)]
pub struct Recording {
    files: Vec<PathBuf>,
    format: Format,
}

/// What is used of rosbag2's `metadata.yaml`.
#[derive(Debug, Deserialize)]
struct Metadata {
    rosbag2_bagfile_information: Information,
}

#[derive(Debug, Deserialize)]
struct Information {
    storage_identifier: String,
    relative_file_paths: Vec<PathBuf>,
    #[serde(default)]
    compression_mode: String,
}

impl Recording {
    /// The files of a recording that [`format()`] has told.
    ///
    /// # Errors
    /// When a folder has no files of a known format.
    pub fn new(path: &Path, format: Format) -> Result<Self, RecordingError> {
        let files = if path.is_dir() { files_of(path)? } else { vec![path.to_owned()] };
        Ok(Self { files, format })
    }

    /// The messages of use in the order of their log times.
    #[must_use]
    pub fn messages(&self) -> Messages {
        Messages {
            files: self.files.clone().into(),
            format: self.format,
            reader: None,
            window: BTreeMap::new(),
            read: 0,
            topics: BTreeMap::new(),
            faults: Vec::new(),
        }
    }
}

fn files_of(folder: &Path) -> Result<Vec<PathBuf>, RecordingError> {
    let path = folder.join("metadata.yaml");
    let wrong = |reason| RecordingError::Metadata { path: path.clone(), reason };
    let text = match std::fs::read_to_string(&path) {
        Ok(text) => text,
        // A recorder that was killed has written none.
        Err(error) if error.kind() == io::ErrorKind::NotFound => return mcap_files(folder),
        Err(error) => return Err(wrong(error.to_string())),
    };
    let metadata: Metadata =
        serde_saphyr::from_str(&text).map_err(|error| wrong(error.to_string()))?;
    let Information { storage_identifier, relative_file_paths, compression_mode } =
        metadata.rosbag2_bagfile_information;
    if ["file", "message"].contains(&compression_mode.to_lowercase().as_str()) {
        return Err(wrong(format!(
            "its compression mode is `{compression_mode}`, and only chunks of MCAP may be \
             compressed; `ros2 bag convert` makes one of the other"
        )));
    }
    if storage_identifier != "mcap" {
        return Err(wrong(format!(
            "the recording is stored as `{storage_identifier}`, and only mcap is read; `ros2 bag \
             convert` makes one of the other"
        )));
    }
    if relative_file_paths.is_empty() {
        return Err(wrong("it names no files".to_owned()));
    }
    Ok(relative_file_paths.iter().map(|file| folder.join(file)).collect())
}

/// The MCAP files of a folder; `run_10.mcap` comes after `run_9.mcap`.
fn mcap_files(folder: &Path) -> Result<Vec<PathBuf>, RecordingError> {
    let open = |source| RecordingError::Open { path: folder.to_owned(), source };
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(open)? {
        let path = entry.map_err(open)?.path();
        if path.extension().is_some_and(|extension| extension == "mcap") {
            files.push(path);
        }
    }
    if files.is_empty() {
        return Err(RecordingError::UnknownFormat { path: folder.to_owned() });
    }
    files.sort_by_key(|path| (path.as_os_str().len(), path.clone()));
    Ok(files)
}

#[derive(Debug)]
enum Reader {
    Mcap(McapReader),
    Bag(BagReader),
}

/// The messages of a recording, one after the other.
#[derive(Debug)]
pub struct Messages {
    /// Not read yet.
    files: VecDeque<PathBuf>,
    format: Format,
    reader: Option<Reader>,
    /// By log time, and by number where that is equal.
    window: BTreeMap<(Stamp, u64), RawMessage>,
    /// How many messages were read.
    read: u64,
    topics: BTreeMap<String, String>,
    faults: Vec<Fault>,
}

impl Iterator for Messages {
    type Item = RawMessage;

    fn next(&mut self) -> Option<RawMessage> {
        while self.window.len() < WINDOW {
            let Some(message) = self.read_next() else { break };
            self.window.insert((message.log_time, self.read), message);
            self.read += 1;
        }
        self.window.pop_first().map(|(_, message)| message)
    }
}

impl Messages {
    /// What could not be read so far.
    #[must_use]
    pub fn faults(&self) -> &[Fault] {
        &self.faults
    }

    /// What could not be read.
    #[must_use]
    pub fn into_faults(self) -> Vec<Fault> {
        self.faults
    }

    /// The topics of all files that were read to their end, used or not, with their types.
    #[must_use]
    pub const fn topics(&self) -> &BTreeMap<String, String> {
        &self.topics
    }

    fn read_next(&mut self) -> Option<RawMessage> {
        loop {
            let faults = &mut self.faults;
            let message = match self.reader.as_mut() {
                None => None,
                Some(Reader::Mcap(reader)) => reader.next(faults),
                Some(Reader::Bag(reader)) => reader.next(faults),
            };
            faults.truncate(FAULTS_KEPT);
            if message.is_some() {
                return message;
            }
            self.keep_topics();
            self.open_next()?;
        }
    }

    fn keep_topics(&mut self) {
        let owned = |(topic, kind): (&str, &str)| (topic.to_owned(), kind.to_owned());
        match self.reader.take() {
            None => {}
            Some(Reader::Mcap(reader)) => self.topics.extend(reader.topics().map(owned)),
            Some(Reader::Bag(reader)) => self.topics.extend(reader.topics().map(owned)),
        }
    }

    /// Goes on with the next file that opens; `None` when there is no more.
    fn open_next(&mut self) -> Option<()> {
        let path = self.files.pop_front()?;
        let opened = match self.format {
            Format::Bag => BagReader::open(&path).map(Reader::Bag),
            Format::Mcap | Format::Carmen => McapReader::open(&path).map(Reader::Mcap),
        };
        match opened {
            Ok(reader) => self.reader = Some(reader),
            Err(error) => self.faults.push(Fault::unopened(path, error)),
        }
        Some(())
    }
}
