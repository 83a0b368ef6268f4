//! The map as files, for navigation (PGM and YAML) and for people (PNG), and as answers to who asks:
//! drawn with characters, as JSON, and as a hash.

mod bounds;
mod file;
mod hash;
mod json;
pub mod mirror;
mod pgm;
mod picture;
pub mod region;
mod text;
pub mod tiles;

pub use file::{MapFileError, read};
pub use hash::content_hash;
pub use json::{NotAMap, json, parse_json};
pub use pgm::{pgm, yaml};
pub use picture::png;
pub use text::text;
