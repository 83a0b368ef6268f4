//! ROS 1 bags, version 2.0: <http://wiki.ros.org/Bags/Format/2.0>.
//!
//! A file is read from front to back and not by its index, for one that was not closed has none.

use std::collections::{BTreeMap, VecDeque};
use std::io;
use std::path::Path;
use std::sync::Arc;

use super::cursor::Cursor;
use super::recording::{RawMessage, Topic, Wire};
use super::source::{Damage, Fault, Got, Source, decompressed};
use crate::slam::pose::Stamp;

/// How every file begins.
pub(super) const MAGIC: &[u8] = b"#ROSBAG V2.0\n";

const MESSAGE: u8 = 2;
const BAG_HEADER: u8 = 3;
const CHUNK: u8 = 5;
const CONNECTION: u8 = 7;

/// The messages of a file.
#[derive(Debug)]
pub(super) struct BagReader {
    source: Source,
    content: Content,
    /// Where the chunks end and the index begins; `None` in a bag that was not closed.
    index: Option<u64>,
    ended: bool,
}

impl BagReader {
    pub(super) fn open(path: &Path) -> io::Result<Self> {
        let mut source = Source::open(path)?;
        let ended = source.skip(MAGIC.len() as u64, "the first line").is_err();
        Ok(Self { source, content: Content::default(), index: None, ended })
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
                        | Damage::Malformed("a chunk" | "a record of a chunk")
                );
                faults.push(self.source.fault(offset, damage));
            }
        }
    }

    /// All topics so far, with their types.
    pub(super) fn topics(&self) -> impl Iterator<Item = (&str, &str)> {
        self.content.connections.values().map(|(topic, kind, _)| (topic.as_str(), kind.as_str()))
    }

    fn record(&mut self) -> Result<(), Damage> {
        if self.index.is_some_and(|index| self.source.offset() >= index) {
            self.ended = true;
            return Ok(());
        }
        if self.source.available() == 0 {
            return Err(Damage::NoEnd);
        }
        let header = self.counted("the header of a record")?;
        let header = Header::parse(&header).ok_or(Damage::Malformed("the header of a record"))?;
        let length = self.source.exactly(4, "the length of a record")?;
        let length = u64::from(Cursor::new(&length).u32().unwrap_or_default());
        match header.opcode {
            CHUNK => self.chunk(&header, length),
            BAG_HEADER => {
                // 0 until the bag is closed.
                self.index = header.index.filter(|index| *index > 0);
                self.source.skip(length, "the header of the bag")
            }
            CONNECTION | MESSAGE => {
                let body = self.source.exactly(length, "a record")?;
                self.content.record(&header, &body)
            }
            _ => self.source.skip(length, "a record"),
        }
    }

    fn counted(&mut self, what: &'static str) -> Result<Vec<u8>, Damage> {
        let length = self.source.exactly(4, what)?;
        self.source.exactly(Cursor::new(&length).u32().unwrap_or_default().into(), what)
    }

    fn chunk(&mut self, header: &Header<'_>, length: u64) -> Result<(), Damage> {
        let available = self.source.available();
        let (body, cut_off) = match self.source.read(length)? {
            Got::All(body) => (body, None),
            Got::Part(body) => {
                let needed = length;
                (body, Some(Damage::CutOff { what: "a chunk", needed, available }))
            }
        };
        let size = header.size.ok_or(Damage::Malformed("a chunk"))?;
        let (content, damage) = decompressed(header.compression, &body, size.into());
        let read = self.content.records(&content);
        match cut_off.or(damage) {
            Some(damage) => Err(damage),
            None => read,
        }
    }
}

/// The fields of a record's header that are of use.
#[derive(Debug, Default)]
struct Header<'a> {
    opcode: u8,
    connection: Option<u32>,
    topic: Option<&'a str>,
    kind: Option<&'a str>,
    compression: &'a str,
    /// Of a chunk's content.
    size: Option<u32>,
    index: Option<u64>,
    /// Seconds and nanoseconds.
    time: Option<(u32, u32)>,
}

impl<'a> Header<'a> {
    /// Each field is its length, its name, an equals sign and its value.
    fn parse(bytes: &'a [u8]) -> Option<Self> {
        let mut fields = Cursor::new(bytes);
        let mut header = Self::default();
        while !fields.rest().is_empty() {
            let field = fields.counted()?;
            let equals = field.iter().position(|byte| *byte == b'=')?;
            let (name, value) = (&field[..equals], &field[equals + 1..]);
            let mut number = Cursor::new(value);
            let text = || std::str::from_utf8(value).ok();
            match name {
                b"op" => header.opcode = number.u8()?,
                b"conn" => header.connection = number.u32(),
                b"topic" => header.topic = text(),
                b"type" => header.kind = text(),
                b"compression" => header.compression = text()?,
                b"size" => header.size = number.u32(),
                b"index_pos" => header.index = number.u64(),
                b"time" => header.time = number.u32().zip(number.u32()),
                _ => {}
            }
        }
        Some(header)
    }
}

/// What the records say.
#[derive(Debug, Default)]
struct Content {
    /// Topic, type and, if it is of use, how to read it, by number.
    connections: BTreeMap<u32, (String, String, Option<Arc<Topic>>)>,
    messages: VecDeque<RawMessage>,
}

impl Content {
    /// Reads the records of a chunk until they end; the first that makes no sense is the error.
    fn records(&mut self, bytes: &[u8]) -> Result<(), Damage> {
        let mut records = Cursor::new(bytes);
        let mut all = Ok(());
        while !records.rest().is_empty() {
            let record = records.counted().zip(records.counted());
            let (header, body) = record.ok_or(Damage::Malformed("a record of a chunk"))?;
            let header = Header::parse(header).ok_or(Damage::Malformed("a record of a chunk"))?;
            all = all.and(self.record(&header, body));
        }
        all
    }

    fn record(&mut self, header: &Header<'_>, body: &[u8]) -> Result<(), Damage> {
        let read = match header.opcode {
            CONNECTION => self.connection(header, body),
            MESSAGE => self.message(header, body),
            _ => return Ok(()),
        };
        read.ok_or(Damage::Malformed("a record of a chunk"))
    }

    fn connection(&mut self, header: &Header<'_>, body: &[u8]) -> Option<()> {
        let details = Header::parse(body)?;
        let (name, kind) = (header.topic?, details.kind?);
        let topic = Topic::new(name, kind, Wire::Ros1).map(Arc::new);
        self.connections.insert(header.connection?, (name.to_owned(), kind.to_owned(), topic));
        Some(())
    }

    fn message(&mut self, header: &Header<'_>, body: &[u8]) -> Option<()> {
        let (seconds, nanoseconds) = header.time?;
        let (_, _, topic) = self.connections.get(&header.connection?)?;
        if let Some(topic) = topic {
            let log_time = Stamp(i64::from(seconds) * 1_000_000_000 + i64::from(nanoseconds));
            let topic = Arc::clone(topic);
            self.messages.push_back(RawMessage { topic, log_time, bytes: body.to_vec() });
        }
        Some(())
    }
}
