//! Writes ROS 2 messages to an MCAP file as rosbag2 does.

use std::collections::BTreeMap;
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

use ::mcap::records::MessageHeader;
use ::mcap::write::NoSeek;
use ::mcap::{Compression, McapError, WriteOptions, Writer};
use thiserror::Error;

use super::schemas::ros2msg;
use crate::slam::pose::Stamp;

/// Bytes of a chunk before compression, at which it is closed.
const CHUNK: u64 = 1 << 20;

/// A chunk is closed at the latest after this time, ns: that much is lost in a crash.
const CHUNK_TIME: i64 = 2_000_000_000;

/// Ending of a file that is not finished.
const UNFINISHED: &str = "part";

/// Why nothing is recorded.
#[derive(Debug, Error)]
pub enum RecordError {
    /// The file cannot be made.
    #[error("cannot record to {}", path.display())]
    Create {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// The file does not take more.
    #[error("cannot record to {}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: McapError,
    },
    /// Nobody knows how messages of the type look.
    #[error("`{0}` is no type of message that gmapd records")]
    UnknownType(String),
}

/// A file that grows message by message.
///
/// Until it is finished its name ends in `.part`; what a crash leaves there can be read.
pub struct McapRecorder {
    writer: Writer<NoSeek<File>>,
    path: PathBuf,
    unfinished: PathBuf,
    /// Number and messages so far, by topic.
    channels: BTreeMap<String, (u16, u32)>,
    /// When the chunk was begun.
    chunk_begun: Option<Stamp>,
    messages: u64,
}

impl std::fmt::Debug for McapRecorder {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.debug_struct("McapRecorder").field("path", &self.path).finish_non_exhaustive()
    }
}

/// A message on its way to a file.
#[derive(Debug, Clone, Copy)]
pub struct Recordable<'a> {
    /// Its topic, with a leading slash.
    pub topic: &'a str,
    /// Its type, such as `sensor_msgs/msg/LaserScan`.
    pub message_type: &'a str,
    /// When it came.
    pub log_time: Stamp,
    /// Its own stamp, if it has one.
    pub stamp: Option<Stamp>,
    /// CDR with its header.
    pub bytes: &'a [u8],
}

impl McapRecorder {
    /// Begins a file that will be called `path`, or `path` with a number if that is taken.
    ///
    /// # Errors
    /// When the file cannot be made.
    pub fn create(path: &Path) -> Result<Self, RecordError> {
        let create = |source| RecordError::Create { path: path.to_owned(), source };
        let (path, unfinished, file) = free_file(path).map_err(create)?;
        let write = |source| RecordError::Write { path: path.clone(), source };
        // Without seeking a chunk is written when it is whole, so that a crash leaves whole ones.
        let writer = WriteOptions::new()
            .profile("ros2")
            .library(concat!("gmapd ", env!("CARGO_PKG_VERSION")))
            .compression(Some(Compression::Zstd))
            .compression_threads(0)
            .chunk_size(Some(CHUNK))
            .disable_seeking(true)
            .create(NoSeek::new(file))
            .map_err(write)?;
        let channels = BTreeMap::new();
        Ok(Self { writer, path, unfinished, channels, chunk_begun: None, messages: 0 })
    }

    /// What the file will be called.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// What it is called until it is finished.
    #[must_use]
    pub fn unfinished(&self) -> &Path {
        &self.unfinished
    }

    /// How many messages it has.
    #[must_use]
    pub const fn messages(&self) -> u64 {
        self.messages
    }

    /// Writes a message.
    ///
    /// # Errors
    /// When its type is not known, or the file does not take it.
    pub fn add(&mut self, message: &Recordable<'_>) -> Result<(), RecordError> {
        let (channel_id, sequence) = self.channel(message)?;
        let nanoseconds = |stamp: Stamp| u64::try_from(stamp.0).unwrap_or(0);
        let header = MessageHeader {
            channel_id,
            sequence,
            log_time: nanoseconds(message.log_time),
            publish_time: nanoseconds(message.stamp.unwrap_or(message.log_time)),
        };
        let begun = *self.chunk_begun.get_or_insert(message.log_time);
        let written = self.writer.write_to_known_channel(&header, message.bytes);
        written.map_err(|source| self.failed(source))?;
        self.messages += 1;
        if message.log_time.0.saturating_sub(begun.0) >= CHUNK_TIME {
            self.chunk_begun = None;
            self.writer.flush().map_err(|source| self.failed(source))?;
        }
        Ok(())
    }

    /// Ends the file and gives it its name.
    ///
    /// # Errors
    /// When it does not take its end or its name.
    pub fn finish(mut self) -> Result<PathBuf, RecordError> {
        self.writer.finish().map_err(|source| self.failed(source))?;
        let Self { writer, path, unfinished, .. } = self;
        let named = writer.into_inner().into_inner().sync_all();
        let named = named.and_then(|()| std::fs::rename(&unfinished, &path));
        match named {
            Ok(()) => Ok(path),
            Err(source) => Err(RecordError::Create { path, source }),
        }
    }

    /// The number of a topic and of its next message.
    fn channel(&mut self, message: &Recordable<'_>) -> Result<(u16, u32), RecordError> {
        if let Some((channel, messages)) = self.channels.get_mut(message.topic) {
            *messages = messages.wrapping_add(1);
            return Ok((*channel, *messages));
        }
        let Recordable { topic, message_type, .. } = message;
        let definition = ros2msg(message_type)
            .ok_or_else(|| RecordError::UnknownType((*message_type).to_owned()))?;
        let added = self
            .writer
            .add_schema(message_type, "ros2msg", definition.as_bytes())
            .and_then(|schema| {
                let no_qos = [("offered_qos_profiles".to_owned(), String::new())];
                self.writer.add_channel(schema, topic, "cdr", &BTreeMap::from(no_qos))
            });
        let channel = added.map_err(|source| self.failed(source))?;
        self.channels.insert((*topic).to_owned(), (channel, 0));
        Ok((channel, 0))
    }

    fn failed(&self, source: McapError) -> RecordError {
        RecordError::Write { path: self.unfinished.clone(), source }
    }
}

/// A name that is not taken, with the name until it is finished and its file.
fn free_file(path: &Path) -> io::Result<(PathBuf, PathBuf, File)> {
    for number in 1_u32.. {
        let path = numbered(path, number);
        let mut unfinished = path.clone().into_os_string();
        unfinished.push(format!(".{UNFINISHED}"));
        let unfinished = PathBuf::from(unfinished);
        if path.try_exists()? {
            continue;
        }
        match File::options().write(true).create_new(true).open(&unfinished) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
            file => return file.map(|file| (path, unfinished, file)),
        }
    }
    Err(io::ErrorKind::AlreadyExists.into())
}

/// `run.mcap`, `run-2.mcap` and so on.
fn numbered(path: &Path, number: u32) -> PathBuf {
    if number == 1 {
        return path.to_owned();
    }
    let mut name = path.file_stem().unwrap_or_default().to_owned();
    name.push(format!("-{number}"));
    if let Some(extension) = path.extension() {
        name.push(".");
        name.push(extension);
    }
    path.with_file_name(name)
}
