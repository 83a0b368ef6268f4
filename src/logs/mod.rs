//! Recorded input and output.

pub mod carmen_writer;
pub mod tum_writer;
