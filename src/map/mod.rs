//! The map as files: for navigation (PGM and YAML) and for people (PNG).

mod pgm;
mod picture;

pub use pgm::{pgm, yaml};
pub use picture::png;
