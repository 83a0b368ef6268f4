//! Checkpoints as files: what is around a state, and a directory that keeps the last good ones.
//!
//! A file is, in little-endian numbers: `gmapd state\n`, the format's version (u32), the length of
//! the head (u32) and of the body (u64), the head (JSON), the body (zstd), and SHA-256 of all that.
//! Nothing is looked at before the checksum fits.

mod store;

use std::collections::BTreeMap;
use std::fmt;
use std::fs;
use std::io::{self, BufWriter, Read as _, Write};
use std::path::Path;

use serde::{Deserialize, Serialize};
use serde_json::Value;
use sha2::{Digest as _, Sha256};
use thiserror::Error;

use crate::slam::pose::Stamp;
pub use store::{Store, StoreError, checkpoints};

/// Of the state within, too: what is written by another version is not read.
pub const FORMAT: u32 = 2;

const MAGIC: &[u8; 12] = b"gmapd state\n";
const FIXED: usize = MAGIC.len() + 4 + 4 + 8;
const CHECKSUM: usize = 32;

/// Larger files are no checkpoints, and no larger body is inflated.
const LARGEST: u64 = 1 << 31;

/// So much of a body goes to the compressor at once, bytes.
const PIECE: usize = 1 << 16;

/// Fast: the state is mostly floats, of which little can be saved.
const COMPRESSION: i32 = 1;

/// What a checkpoint is of.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Head {
    /// The version of gmapd that wrote it.
    pub gmapd: String,
    /// What the robot's keys begin with.
    pub robot: String,
    /// Which engine made the state.
    pub engine: String,
    /// The configuration's keys on which results depend.
    pub settings: BTreeMap<String, Value>,
    /// Scans that had their verdict.
    pub scans: u64,
    /// Scans that were processed.
    pub processed: u64,
    /// Hypotheses.
    pub particles: u64,
    /// Of the last scan that was taken.
    pub stamp: Option<Stamp>,
    /// The map that would be handed out; `None` before the first scan.
    pub map: Option<MapSize>,
    /// Whether the robot's place in it is searched for.
    #[serde(default)]
    pub searching: bool,
    /// Of the body before it is compressed.
    pub body_bytes: u64,
}

/// How large a map is.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct MapSize {
    /// Cells a row of the map cropped to what is known.
    pub width: usize,
    /// Its rows.
    pub height: usize,
    /// Metres a cell.
    pub resolution: f64,
}

impl Head {
    /// SHA-256 of the settings, in hexadecimal digits.
    #[must_use]
    pub fn settings_sha256(&self) -> String {
        let text = Value::from_iter(self.settings.clone()).to_string();
        Sha256::digest(text).iter().map(|byte| format!("{byte:02x}")).collect()
    }

    /// Whether `own` has another initial pose: the robot was carried, and is there now.
    #[must_use]
    pub fn has_other_pose(&self, own: &Self) -> bool {
        self.settings.get(INITIAL_POSE) != own.settings.get(INITIAL_POSE)
    }

    /// Looks whether who has `own` can go on from this; in another mode and at another pose it can.
    ///
    /// # Errors
    /// When it is of another robot, another engine or another configuration.
    pub fn check_against(&self, own: &Self) -> Result<(), Refusal> {
        if self.robot != own.robot {
            let (found, own) = (self.robot.clone(), own.robot.clone());
            return Err(Refusal::OtherRobot { found, own });
        }
        if self.engine != own.engine {
            let (found, own) = (self.engine.clone(), own.engine.clone());
            return Err(Refusal::OtherEngine { found, own });
        }
        let told = |value: Option<&Value>| value.map_or("not set".to_owned(), Value::to_string);
        let keys = self.settings.keys().chain(own.settings.keys());
        match keys
            .filter(|key| ![MODE, INITIAL_POSE].contains(&key.as_str()))
            .find(|key| self.settings.get(*key) != own.settings.get(*key))
        {
            None => Ok(()),
            Some(key) => Err(Refusal::OtherSetting {
                found: told(self.settings.get(key)),
                own: told(own.settings.get(key)),
                key: key.clone(),
            }),
        }
    }
}

/// The key of the configuration that changes during a run, too.
pub const MODE: &str = "mode";

/// The key of the configuration that says where the robot is.
const INITIAL_POSE: &str = "initial_pose";

/// Why a checkpoint is not taken.
#[derive(Debug, Error)]
pub enum Refusal {
    /// The file cannot be read.
    #[error("it cannot be read: {0}")]
    Read(#[from] io::Error),
    /// It does not begin as checkpoints do.
    #[error("it is no checkpoint of gmapd")]
    Foreign,
    /// Its length is not what its beginning says.
    #[error("it has {found} bytes, and should have {expected}")]
    Length {
        /// Bytes that are there.
        found: u64,
        /// Bytes that should be.
        expected: u64,
    },
    /// Its bytes are not those that were written.
    #[error("it is damaged: its checksum does not fit its bytes")]
    Checksum,
    /// Another version of gmapd wrote it.
    #[error("it has format version {0}, and this gmapd reads {FORMAT}")]
    Format(u32),
    /// It was written with something wrong in it.
    #[error("it cannot be decoded: {0}")]
    Undecodable(String),
    /// It is of another robot.
    #[error("it is of the robot `{found}`, and this is `{own}`")]
    OtherRobot {
        /// Its robot.
        found: String,
        /// This one.
        own: String,
    },
    /// It is of another engine.
    #[error("it is of engine {found}, and {own} is configured")]
    OtherEngine {
        /// Its engine.
        found: String,
        /// This one.
        own: String,
    },
    /// Results would be others with the configuration that it is of.
    #[error("it is of another configuration: {key} was {found}, and is {own}")]
    OtherSetting {
        /// The first key that differs.
        key: String,
        /// As it was.
        found: String,
        /// As it is.
        own: String,
    },
}

/// Where a body is written to: it is compressed as it comes, and never whole in memory.
pub struct BodyWriter {
    to: BufWriter<zstd::stream::write::Encoder<'static, Vec<u8>>>,
    bytes: u64,
}

impl BodyWriter {
    fn new() -> io::Result<Self> {
        let encoder = zstd::stream::write::Encoder::new(Vec::new(), COMPRESSION)?;
        Ok(Self { to: BufWriter::with_capacity(PIECE, encoder), bytes: 0 })
    }

    /// How many bytes were written, and those compressed.
    fn finish(self) -> io::Result<(u64, Vec<u8>)> {
        Ok((self.bytes, self.to.into_inner()?.finish()?))
    }
}

impl fmt::Debug for BodyWriter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("BodyWriter").field("bytes", &self.bytes).finish_non_exhaustive()
    }
}

impl Write for BodyWriter {
    #[inline]
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.to.write(bytes)?;
        self.bytes += written as u64;
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.to.flush()
    }
}

/// A checkpoint's bytes, with the body that `write` writes; the head's `body_bytes` are filled in.
///
/// # Errors
/// When `write` fails, or the compressor does, which only a lack of memory makes it do, or nobody
/// would read what is so large.
pub fn seal(
    head: Head,
    write: impl FnOnce(&mut BodyWriter) -> io::Result<()>,
) -> io::Result<Vec<u8>> {
    let mut body = BodyWriter::new()?;
    write(&mut body)?;
    let (body_bytes, body) = body.finish()?;
    let head = serde_json::to_vec(&Head { body_bytes, ..head })?;
    let mut bytes = Vec::with_capacity(FIXED + head.len() + body.len() + CHECKSUM);
    bytes.extend(MAGIC);
    bytes.extend(FORMAT.to_le_bytes());
    bytes.extend((head.len() as u32).to_le_bytes());
    bytes.extend((body.len() as u64).to_le_bytes());
    bytes.extend(head);
    bytes.extend(body);
    let checksum = Sha256::digest(&bytes);
    bytes.extend_from_slice(&checksum);
    if body_bytes.max(bytes.len() as u64) > LARGEST {
        return Err(io::Error::other(format!("a state of {body_bytes} bytes is too large")));
    }
    Ok(bytes)
}

/// The bytes of a checkpoint's file.
///
/// # Errors
/// When there is no such file, or one that is far too large.
pub fn read(path: &Path) -> Result<Vec<u8>, Refusal> {
    let metadata = fs::metadata(path)?;
    if !metadata.is_file() {
        return Err(Refusal::Foreign);
    }
    let length = metadata.len();
    if length > LARGEST {
        return Err(Refusal::Read(io::Error::other(format!("{length} bytes are too many"))));
    }
    Ok(fs::read(path)?)
}

/// A checkpoint whose checksum fits.
#[derive(Debug, Clone, PartialEq)]
pub struct Opened<'a> {
    /// What it is of.
    pub head: Head,
    compressed: &'a [u8],
}

/// Looks into a checkpoint's bytes.
///
/// # Errors
/// When they are not those of a checkpoint of this format, or have changed.
pub fn open(bytes: &[u8]) -> Result<Opened<'_>, Refusal> {
    let known = bytes.len().min(MAGIC.len());
    if bytes.is_empty() || bytes[..known] != MAGIC[..known] {
        return Err(Refusal::Foreign);
    }
    let found = bytes.len() as u64;
    let cut = Refusal::Length { found, expected: (FIXED + CHECKSUM) as u64 };
    let Some((fixed, rest)) = bytes.split_first_chunk::<FIXED>() else { return Err(cut) };
    let [format, head] = [12, 16].map(|at| number::<4>(fixed, at) as u32);
    let body = number::<8>(fixed, 20);
    let expected = ((FIXED + CHECKSUM) as u64 + u64::from(head)).saturating_add(body);
    if expected != found {
        return Err(Refusal::Length { found, expected });
    }
    let Some((content, checksum)) = bytes.split_last_chunk::<CHECKSUM>() else { return Err(cut) };
    if Sha256::digest(content).as_slice() != checksum {
        return Err(Refusal::Checksum);
    }
    if format != FORMAT {
        return Err(Refusal::Format(format));
    }
    // The lengths add up, so both are there.
    let (head, body) = rest[..rest.len() - CHECKSUM].split_at(head as usize);
    let head = serde_json::from_slice(head).map_err(|e| Refusal::Undecodable(e.to_string()))?;
    Ok(Opened { head, compressed: body })
}

impl Opened<'_> {
    /// The body, as it was before it was compressed.
    ///
    /// # Errors
    /// When it cannot be inflated to just the length that the head says.
    pub fn body(&self) -> Result<Vec<u8>, Refusal> {
        let expected = self.head.body_bytes;
        if expected > LARGEST {
            return Err(Refusal::Undecodable(format!("a body of {expected} bytes is too large")));
        }
        let mut body = Vec::new();
        zstd::stream::read::Decoder::new(self.compressed)?
            .take(expected + 1)
            .read_to_end(&mut body)?;
        let found = body.len() as u64;
        if found == expected { Ok(body) } else { Err(Refusal::Length { found, expected }) }
    }
}

/// Little-endian, of `N` bytes at a place.
fn number<const N: usize>(bytes: &[u8; FIXED], at: usize) -> u64 {
    bytes[at..at + N].iter().rev().fold(0, |number, byte| (number << 8) | u64::from(*byte))
}

#[cfg(test)]
mod tests {
    use proptest::collection::vec;
    use proptest::prelude::{any, prop_assert_eq, proptest};

    use super::*;

    pub(super) fn head() -> Head {
        Head {
            gmapd: "0.1.0".to_owned(),
            robot: "robot01".to_owned(),
            engine: "gmapping".to_owned(),
            settings: BTreeMap::from([("particles".to_owned(), 30.into())]),
            scans: 7,
            processed: 3,
            particles: 30,
            stamp: Some(Stamp(12_000_000_001)),
            map: Some(MapSize { width: 3, height: 4, resolution: 0.05 }),
            searching: false,
            body_bytes: 0,
        }
    }

    fn sealed(body: &[u8]) -> Vec<u8> {
        seal(head(), |to| to.write_all(body)).unwrap()
    }

    proptest! {
        #[test]
        fn what_is_sealed_is_found_again(body in vec(any::<u8>(), 0..3000)) {
            let sealed = sealed(&body);
            let opened = open(&sealed).unwrap();
            prop_assert_eq!(opened.head, Head { body_bytes: body.len() as u64, ..head() });
            prop_assert_eq!(open(&sealed).unwrap().body().unwrap(), body);
        }
    }

    #[test]
    fn cut_anywhere_and_with_any_bit_flipped_it_is_refused() {
        let sealed = sealed(&[7; 300]);
        for length in 0..sealed.len() {
            let refusal = open(&sealed[..length]).unwrap_err();
            let expected = matches!(refusal, Refusal::Length { found, .. } if found == length as u64)
                || matches!(refusal, Refusal::Foreign if length == 0);
            assert!(expected, "{length}: {refusal}");
        }
        for bit in 0..sealed.len() * 8 {
            let mut flipped = sealed.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            let refusal = open(&flipped).unwrap_err();
            let expected = match bit / 8 {
                0..12 => matches!(refusal, Refusal::Foreign),
                16..28 => matches!(refusal, Refusal::Length { .. }),
                _ => matches!(refusal, Refusal::Checksum),
            };
            assert!(expected, "bit {bit}: {refusal}");
        }
        let longer = [&sealed[..], b"x"].concat();
        assert!(matches!(open(&longer), Err(Refusal::Length { .. })));
    }

    /// Its checksum fits, but somebody else wrote it.
    fn forged(change: impl Fn(&mut Vec<u8>)) -> Vec<u8> {
        let mut bytes = sealed(&[7; 300]);
        bytes.truncate(bytes.len() - CHECKSUM);
        change(&mut bytes);
        let checksum = Sha256::digest(&bytes);
        bytes.extend_from_slice(&checksum);
        bytes
    }

    #[test]
    fn another_format_and_a_body_that_is_not_as_told_are_refused() {
        let newer = forged(|bytes| bytes[12] += 1);
        let refusal = open(&newer).unwrap_err().to_string();
        assert_eq!(refusal, "it has format version 3, and this gmapd reads 2");
        let other = sealed(&[7; 300]);
        for told in [299_u64, 301, 1 << 40] {
            let mut opened = open(&other).unwrap();
            opened.head.body_bytes = told;
            assert!(opened.body().is_err(), "{told}");
        }
        let garbled = forged(|bytes| bytes[FIXED] = b'[');
        assert!(matches!(open(&garbled), Err(Refusal::Undecodable(_))));
    }

    #[test]
    fn what_is_of_another_robot_engine_or_configuration_is_told_with_the_difference() {
        let refusal = |change: fn(&mut Head)| {
            let mut found = head();
            change(&mut found);
            found.check_against(&head()).unwrap_err().to_string()
        };
        assert!(head().check_against(&head()).is_ok());
        let mut localizing = head();
        localizing.settings.insert(MODE.to_owned(), "localization".into());
        assert!(localizing.check_against(&head()).is_ok());
        assert_eq!(
            refusal(|head| head.robot = "robot02".to_owned()),
            "it is of the robot `robot02`, and this is `robot01`"
        );
        assert_eq!(
            refusal(|head| head.engine = "hector".to_owned()),
            "it is of engine hector, and gmapping is configured"
        );
        assert_eq!(
            refusal(|head| *head.settings.get_mut("particles").unwrap() = 60.into()),
            "it is of another configuration: particles was 60, and is 30"
        );
        assert_eq!(
            refusal(|head| head.settings.clear()),
            "it is of another configuration: particles was not set, and is 30"
        );
    }
}
