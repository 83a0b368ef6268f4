//! Messages to bytes.

use byteorder::LittleEndian;

use super::Message;

/// The message as CDR: the four bytes that say "plain, little endian, no options", and the body.
#[must_use]
pub fn cdr<M: Message>(message: &M) -> Vec<u8> {
    let mut bytes = vec![0, 1, 0, 0];
    cdr_encoding::to_writer::<M, LittleEndian, _>(&mut bytes, message)
        .expect("memory takes every write, and every sequence knows its length");
    bytes
}

/// The message as JSON, with the names of its ROS fields.
#[must_use]
pub fn json<M: Message>(message: &M) -> Vec<u8> {
    serde_json::to_vec(message).expect("memory takes every write, and every key is a string")
}
