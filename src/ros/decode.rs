//! Bytes to messages.

use byteorder::{BigEndian, ByteOrder, LittleEndian};
use cdr_encoding::CdrDeserializer;
use thiserror::Error;

use super::field_path::FieldPath;
use super::{Message, PoseStamped, PoseWithCovarianceStamped};

/// Length of the header that says how a CDR body is written; offsets count from its start.
const CDR_HEADER: usize = 4;

/// Senders may fill up a body to a multiple of four bytes.
const MOST_PADDING: usize = 3;

/// Why bytes are not a message.
#[derive(Debug, Error)]
pub enum DecodeError {
    /// Neither of the two ways to write a message.
    #[error(
        "{message}: {length} bytes that begin with {} are neither plain CDR, which begins with \
         00 00 or 00 01 and two more bytes, nor a JSON object",
        hexadecimal(start)
    )]
    Unrecognized {
        /// The ROS type that was expected.
        message: &'static str,
        /// How many bytes there are.
        length: usize,
        /// The first of them, at most four.
        start: Vec<u8>,
    },
    /// The CDR body ends early or holds a value that the type does not allow.
    #[error("{message}: {field} at byte {offset} of {length}: {reason}")]
    Cdr {
        /// The ROS type that was expected.
        message: &'static str,
        /// The field that was being read, such as `header.frame_id` or `ranges[12]`.
        field: String,
        /// Where reading stopped, from the start of the payload.
        offset: usize,
        /// Length of the payload.
        length: usize,
        /// What is wrong.
        reason: cdr_encoding::Error,
    },
    /// The payload goes on after the message: it is of another type.
    #[error("{message} would end at byte {offset} of {length}: is the payload of another type?")]
    TooLong {
        /// The ROS type that was expected.
        message: &'static str,
        /// Where the message ends.
        offset: usize,
        /// Length of the payload.
        length: usize,
    },
    /// The JSON is malformed or does not have the fields of the type.
    #[error("{message}: {field}: {reason}")]
    Json {
        /// The ROS type that was expected.
        message: &'static str,
        /// The field that was being read; `.` is the message itself.
        field: String,
        /// What is wrong, and in which line and column.
        reason: serde_json::Error,
    },
}

fn hexadecimal(bytes: &[u8]) -> String {
    let digits: Vec<String> = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
    if digits.is_empty() { "nothing".to_owned() } else { digits.join(" ") }
}

/// Reads a message from a payload that came with `encoding`, which may be empty.
///
/// JSON if the encoding says so. Whatever else it says, the bytes decide, for bridges and
/// `rmw_zenoh` set none: CDR of either byte order by its header, else JSON by its brace.
///
/// Memory grows with the bytes that are there, never with a length that is only claimed.
///
/// # Errors
/// When the bytes are not exactly one message; the error tells field and offset.
pub fn decode<M: Message>(bytes: &[u8], encoding: &str) -> Result<M, DecodeError> {
    if is_json(encoding) {
        return json(bytes);
    }
    match bytes {
        [0, 0, _, _, ..] => cdr::<M, BigEndian>(bytes),
        [0, 1, _, _, ..] => cdr::<M, LittleEndian>(bytes),
        _ if bytes.trim_ascii_start().starts_with(b"{") => json(bytes),
        _ => Err(DecodeError::Unrecognized {
            message: M::TYPE,
            length: bytes.len(),
            start: bytes.iter().copied().take(CDR_HEADER).collect(),
        }),
    }
}

/// Reads a pose, which may be a `PoseWithCovarianceStamped` or a `PoseStamped`: neither reads as
/// the other.
///
/// # Errors
/// When the bytes are neither; the error is that of the pose with a covariance.
pub fn decode_pose(bytes: &[u8], encoding: &str) -> Result<PoseStamped, DecodeError> {
    match decode::<PoseWithCovarianceStamped>(bytes, encoding) {
        Ok(PoseWithCovarianceStamped { header, pose }) => {
            Ok(PoseStamped { header, pose: pose.pose })
        }
        Err(error) => decode(bytes, encoding).or(Err(error)),
    }
}

/// A Zenoh encoding may carry a schema after a semicolon.
fn is_json(encoding: &str) -> bool {
    let kind = encoding.split(';').next().unwrap_or_default().trim();
    kind == "application/json" || kind == "text/json"
}

fn cdr<M: Message, Order: ByteOrder>(bytes: &[u8]) -> Result<M, DecodeError> {
    let mut body = CdrDeserializer::<Order>::new(&bytes[CDR_HEADER..]);
    let path = FieldPath::default();
    let decoded = M::deserialize(path.traced(&mut body));
    let offset = CDR_HEADER + body.bytes_consumed();
    let length = bytes.len();
    match decoded {
        Err(reason) => {
            let field = path.to_string();
            Err(DecodeError::Cdr { message: M::TYPE, field, offset, length, reason })
        }
        Ok(_) if length - offset > MOST_PADDING => {
            Err(DecodeError::TooLong { message: M::TYPE, offset, length })
        }
        Ok(message) => Ok(message),
    }
}

fn json<M: Message>(bytes: &[u8]) -> Result<M, DecodeError> {
    let error = |field, reason| DecodeError::Json { message: M::TYPE, field, reason };
    let mut deserializer = serde_json::Deserializer::from_slice(bytes);
    let message = serde_path_to_error::deserialize(&mut deserializer)
        .map_err(|failure| error(failure.path().to_string(), failure.into_inner()))?;
    deserializer.end().map_err(|reason| error(".".to_owned(), reason))?;
    Ok(message)
}
