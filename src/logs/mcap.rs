//! MCAP, the container of rosbag2: <https://mcap.dev/spec>.
//!
//! A file is read from front to back and not by its index, for one that was not finished has none.

use std::collections::{BTreeMap, VecDeque};
use std::io;
use std::path::Path;
use std::sync::Arc;

use super::cursor::Cursor;
use super::recording::{RawMessage, Topic, Wire};
use super::source::{Damage, Fault, Got, Source, decompressed};
use crate::slam::pose::Stamp;

/// How every file begins.
pub(super) const MAGIC: &[u8] = b"\x89MCAP0\r\n";

/// Opcode and length.
const RECORD_HEAD: u64 = 9;

const FOOTER: u8 = 0x02;
const SCHEMA: u8 = 0x03;
const CHANNEL: u8 = 0x04;
const MESSAGE: u8 = 0x05;
const CHUNK: u8 = 0x06;
const DATA_END: u8 = 0x0f;

/// The messages of a file.
#[derive(Debug)]
pub(super) struct McapReader {
    source: Source,
    content: Content,
    ended: bool,
}

impl McapReader {
    pub(super) fn open(path: &Path) -> io::Result<Self> {
        let mut source = Source::open(path)?;
        if source.exactly(MAGIC.len() as u64, "the first bytes").ok().as_deref() != Some(MAGIC) {
            return Err(io::Error::new(io::ErrorKind::InvalidData, "it is no MCAP file"));
        }
        Ok(Self { source, content: Content::default(), ended: false })
    }

    /// The next message that can be read. What is damaged is passed over and told in `faults`.
    pub(super) fn next(&mut self, faults: &mut Vec<Fault>) -> Option<RawMessage> {
        loop {
            if let Some(message) = self.content.messages.pop_front() {
                return Some(message);
            }
            if self.ended {
                return None;
            }
            let offset = self.source.offset();
            if let Err(damage) = self.record() {
                self.ended |= !matches!(
                    damage,
                    Damage::UnknownCompression(_)
                        | Damage::Decompression { .. }
                        | Damage::Checksum { .. }
                        | Damage::Malformed(_)
                );
                faults.push(self.source.fault(offset, damage));
            }
        }
    }

    /// All topics so far, with their types.
    pub(super) fn topics(&self) -> impl Iterator<Item = (&str, &str)> {
        self.content.channels.values().map(|(topic, kind, _)| (topic.as_str(), kind.as_str()))
    }

    fn record(&mut self) -> Result<(), Damage> {
        if self.source.available() == 0 {
            return Err(Damage::NoEnd);
        }
        let head = self.source.exactly(RECORD_HEAD, "the head of a record")?;
        let mut head = Cursor::new(&head);
        let (Some(opcode), Some(length)) = (head.u8(), head.u64()) else {
            return Err(Damage::Malformed("the head of a record"));
        };
        match opcode {
            DATA_END | FOOTER => {
                self.ended = true;
                Ok(())
            }
            CHUNK => self.chunk(length),
            SCHEMA | CHANNEL | MESSAGE => {
                let body = self.source.exactly(length, "a record")?;
                self.content.record(opcode, &body)
            }
            _ => self.source.skip(length, "a record"),
        }
    }

    fn chunk(&mut self, length: u64) -> Result<(), Damage> {
        let available = self.source.available();
        let (body, cut_off) = match self.source.read(length)? {
            Got::All(body) => (body, None),
            Got::Part(body) => {
                let needed = length;
                (body, Some(Damage::CutOff { what: "a chunk", needed, available }))
            }
        };
        let chunk = Chunk::parse(&body).ok_or(Damage::Malformed("the head of a chunk"));
        let Ok(chunk) = chunk else { return Err(cut_off.unwrap_or(Damage::Malformed("a chunk"))) };
        let (content, damage) = decompressed(chunk.compression, chunk.records, chunk.length);
        if damage.is_none() {
            chunk.check(&content)?;
        }
        let read = self.content.records(&content);
        match cut_off.or(damage) {
            Some(damage) => Err(damage),
            None => read,
        }
    }
}

/// A chunk as far as it is there.
struct Chunk<'a> {
    /// Of its content.
    length: u64,
    /// Of its content; 0 if nobody computed it.
    checksum: u32,
    compression: &'a str,
    records: &'a [u8],
}

impl<'a> Chunk<'a> {
    fn parse(body: &'a [u8]) -> Option<Self> {
        let mut body = Cursor::new(body);
        body.u64()?; // The earliest and the latest time.
        body.u64()?;
        let (length, checksum) = (body.u64()?, body.u32()?);
        let compression = body.text()?;
        body.u64()?; // How many bytes follow.
        Some(Self { length, checksum, compression, records: body.rest() })
    }

    fn check(&self, content: &[u8]) -> Result<(), Damage> {
        let mut checksum = flate2::Crc::new();
        checksum.update(content);
        let (expected, found) = (self.checksum, checksum.sum());
        if expected == 0 || expected == found {
            return Ok(());
        }
        Err(Damage::Checksum { expected, found })
    }
}

/// What the records say.
#[derive(Debug, Default)]
struct Content {
    /// Names of types by number.
    schemas: BTreeMap<u16, String>,
    /// Topic, type and, if it is of use, how to read it, by number.
    channels: BTreeMap<u16, (String, String, Option<Arc<Topic>>)>,
    messages: VecDeque<RawMessage>,
}

impl Content {
    /// Reads the records of a chunk until they end; the first that makes no sense is the error.
    fn records(&mut self, bytes: &[u8]) -> Result<(), Damage> {
        let mut records = Cursor::new(bytes);
        let mut all = Ok(());
        while !records.rest().is_empty() {
            let (Some(opcode), Some(length)) = (records.u8(), records.u64()) else {
                return Err(Damage::Malformed("the last record of a chunk"));
            };
            let body = usize::try_from(length).ok().and_then(|length| records.bytes(length));
            let body = body.ok_or(Damage::Malformed("a record of a chunk"))?;
            all = all.and(self.record(opcode, body));
        }
        all
    }

    fn record(&mut self, opcode: u8, body: &[u8]) -> Result<(), Damage> {
        let body = Cursor::new(body);
        let (read, what) = match opcode {
            SCHEMA => (self.schema(body), "a schema"),
            CHANNEL => (self.channel(body), "a channel"),
            MESSAGE => (self.message(body), "a message"),
            _ => return Ok(()),
        };
        read.ok_or(Damage::Malformed(what))
    }

    fn schema(&mut self, mut body: Cursor<'_>) -> Option<()> {
        let number = body.u16()?;
        self.schemas.insert(number, body.text()?.to_owned());
        Some(())
    }

    fn channel(&mut self, mut body: Cursor<'_>) -> Option<()> {
        let (number, schema) = (body.u16()?, body.u16()?);
        let (name, encoding) = (body.text()?, body.text()?);
        let kind = self.schemas.get(&schema).map_or("", String::as_str);
        let wire = match encoding {
            "cdr" | "json" => Some(Wire::Ros2),
            "ros1" => Some(Wire::Ros1),
            _ => None,
        };
        let topic = wire.and_then(|wire| Topic::new(name, kind, wire)).map(Arc::new);
        self.channels.insert(number, (name.to_owned(), kind.to_owned(), topic));
        Some(())
    }

    fn message(&mut self, mut body: Cursor<'_>) -> Option<()> {
        let channel = body.u16()?;
        body.u32()?; // The number of the message.
        let log_time = body.u64()?;
        body.u64()?; // The time of sending.
        let (_, _, topic) = self.channels.get(&channel)?;
        if let Some(topic) = topic {
            let log_time = Stamp(i64::try_from(log_time).ok()?);
            let topic = Arc::clone(topic);
            self.messages.push_back(RawMessage { topic, log_time, bytes: body.rest().to_vec() });
        }
        Some(())
    }
}
