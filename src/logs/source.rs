//! A file of records, read from its beginning until it ends or makes no sense.

use std::fs::File;
use std::io::{self, BufReader, Read as _};
use std::path::{Path, PathBuf};

use thiserror::Error;

/// A chunk may be this long when decompressed; recorders make them a thousand times shorter.
const LONGEST_CHUNK: u64 = 1 << 30;

/// What is wrong with a recording.
#[derive(Debug, Error)]
pub enum Damage {
    /// The file is shorter than it says.
    #[error("{what} needs {needed} bytes, and the file has {available} more")]
    CutOff {
        /// What is not whole.
        what: &'static str,
        /// How many bytes it says to have.
        needed: u64,
        /// How many there are.
        available: u64,
    },
    /// The file ends between two records, where it should go on.
    #[error("the file ends without an end: whoever recorded it did not finish")]
    NoEnd,
    /// A record is not what its kind asks for.
    #[error("{0} makes no sense")]
    Malformed(&'static str),
    /// A chunk is compressed in a way that is not known.
    #[error("the chunk is compressed with `{0}`; none, zstd, lz4 and bz2 are known")]
    UnknownCompression(String),
    /// A chunk does not decompress to its end.
    #[error("the chunk decompresses to {length} of {expected} bytes: {reason}")]
    Decompression {
        /// What it says to hold.
        expected: u64,
        /// How many bytes it gave.
        length: u64,
        /// What the decompressor says.
        reason: String,
    },
    /// The content of a chunk is not what was written.
    #[error("the chunk's checksum is {found:08x} and should be {expected:08x}")]
    Checksum {
        /// As written beside the chunk.
        expected: u32,
        /// As computed.
        found: u32,
    },
    /// The system does not give the bytes.
    #[error("it cannot be read: {0}")]
    Read(io::Error),
}

/// A place in a recording where something could not be read.
#[derive(Debug, Error)]
#[error("{}: at byte {offset}: {damage}", path.display())]
pub struct Fault {
    /// The file.
    pub path: PathBuf,
    /// Where the record begins that is concerned.
    pub offset: u64,
    /// What is wrong.
    #[source]
    pub damage: Damage,
}

impl Fault {
    pub(super) const fn unopened(path: PathBuf, error: io::Error) -> Self {
        Self { path, offset: 0, damage: Damage::Read(error) }
    }
}

/// What a read gave.
pub(super) enum Got {
    /// All that was asked for.
    All(Vec<u8>),
    /// What there was before the file ended.
    Part(Vec<u8>),
}

/// A file and how far it is read.
#[derive(Debug)]
pub(super) struct Source {
    path: PathBuf,
    file: BufReader<File>,
    offset: u64,
    length: u64,
}

impl Source {
    pub(super) fn open(path: &Path) -> io::Result<Self> {
        let file = File::open(path)?;
        let length = file.metadata()?.len();
        let file = BufReader::with_capacity(1 << 16, file);
        Ok(Self { path: path.to_owned(), file, offset: 0, length })
    }

    pub(super) const fn offset(&self) -> u64 {
        self.offset
    }

    pub(super) const fn available(&self) -> u64 {
        self.length.saturating_sub(self.offset)
    }

    pub(super) fn fault(&self, offset: u64, damage: Damage) -> Fault {
        Fault { path: self.path.clone(), offset, damage }
    }

    /// Takes so many bytes, or fewer if the file ends: a length that is only claimed costs nothing.
    pub(super) fn read(&mut self, length: u64) -> Result<Got, Damage> {
        let mut bytes = Vec::new();
        self.file.by_ref().take(length).read_to_end(&mut bytes).map_err(Damage::Read)?;
        self.offset += bytes.len() as u64;
        Ok(if bytes.len() as u64 == length { Got::All(bytes) } else { Got::Part(bytes) })
    }

    /// Takes so many bytes or none.
    pub(super) fn exactly(&mut self, length: u64, what: &'static str) -> Result<Vec<u8>, Damage> {
        let available = self.available();
        match self.read(length)? {
            Got::All(bytes) => Ok(bytes),
            Got::Part(_) => Err(Damage::CutOff { what, needed: length, available }),
        }
    }

    /// Passes over bytes that nobody asked for.
    pub(super) fn skip(&mut self, length: u64, what: &'static str) -> Result<(), Damage> {
        let available = self.available();
        let step = i64::try_from(length).ok().filter(|_| length <= available);
        let Some(step) = step else {
            return Err(Damage::CutOff { what, needed: length, available });
        };
        // Within the buffer where possible.
        self.file.seek_relative(step).map_err(Damage::Read)?;
        self.offset += length;
        Ok(())
    }
}

/// What a chunk holds, as far as it can be decompressed, and what stopped that.
pub(super) fn decompressed(
    compression: &str,
    bytes: &[u8],
    expected: u64,
) -> (Vec<u8>, Option<Damage>) {
    let mut content = Vec::new();
    let most = expected.min(LONGEST_CHUNK);
    let read = match compression {
        "" | "none" => bytes.take(most).read_to_end(&mut content),
        "zstd" => zstd::stream::read::Decoder::with_buffer(bytes)
            .and_then(|decoder| decoder.take(most).read_to_end(&mut content)),
        "lz4" => lz4::Decoder::new(bytes)
            .and_then(|decoder| decoder.take(most).read_to_end(&mut content)),
        "bz2" => bzip2::read::BzDecoder::new(bytes).take(most).read_to_end(&mut content),
        other => return (content, Some(Damage::UnknownCompression(other.to_owned()))),
    };
    let length = content.len() as u64;
    let reason = match read {
        Err(error) => error.to_string(),
        Ok(_) if length < expected => "it ends early".to_owned(),
        Ok(_) => return (content, None),
    };
    (content, Some(Damage::Decompression { expected, length, reason }))
}
