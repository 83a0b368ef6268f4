//! The map as files in one directory, and nowhere else.

use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use serde::Serialize;
use sha2::{Digest as _, Sha256};
use thiserror::Error;

use super::formats::MapProducts;
use super::selector::excerpt;
use crate::files::{WriteError, write_atomically};

/// With an ending and a temporary name around it, it fits every file system.
const LONGEST_NAME: usize = 100;

/// What the files of a map are called, without their endings: a name and never a path.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SaveName(String);

/// Why files cannot be called so.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error(
    "name={given:?} {reason}; it must be the name of a file without its ending, as in office, of \
     at most {LONGEST_NAME} bytes"
)]
pub struct NameError {
    /// As it was given, or its beginning.
    pub given: String,
    /// What is wrong with it.
    pub reason: &'static str,
}

impl SaveName {
    /// Checks a name that came from somewhere.
    ///
    /// # Errors
    /// When it is empty, too long, hidden, or would leave the directory.
    pub fn parse(name: &str) -> Result<Self, NameError> {
        let reason = if name.is_empty() {
            "is empty"
        } else if name.len() > LONGEST_NAME {
            "is too long"
        } else if name.contains(['/', '\\']) {
            "has a slash"
        } else if name.contains("..") {
            "has two dots"
        } else if name.starts_with('.') {
            "begins with a dot"
        } else if name.contains(char::is_control) {
            "has a control character"
        } else {
            return Ok(Self(name.to_owned()));
        };
        Err(NameError { given: excerpt(name), reason })
    }
}

impl Default for SaveName {
    fn default() -> Self {
        Self("map".to_owned())
    }
}

impl fmt::Display for SaveName {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.0)
    }
}

/// What was written, for the reply.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Saved {
    /// In a sentence.
    pub done: String,
    /// Of the map.
    pub version: u64,
    /// The content hash of the map, as in the attachments of its queries.
    pub map_sha256: String,
    /// Each file.
    pub files: Vec<SavedFile>,
}

/// A file that is there now.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct SavedFile {
    /// Where, from the root of the daemon's machine.
    pub path: PathBuf,
    /// SHA-256 of its bytes, in hexadecimal digits.
    pub sha256: String,
}

/// Why nothing, or not all, was saved.
#[derive(Debug, Error)]
pub enum SaveError {
    /// There is nothing to save.
    #[error("there is no map to save yet: no scan has been processed")]
    NoMap,
    /// The directory is not there and cannot be made.
    #[error("cannot make the directory {}: {source}", path.display())]
    Directory {
        /// The directory.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// A file cannot be written.
    #[error("cannot write {}: {}", .0.path.display(), .0.source)]
    Write(#[from] WriteError),
    /// The picture cannot be made.
    #[error("cannot draw the map: {0}")]
    Picture(String),
}

/// Writes maps into one directory, one at a time.
#[derive(Debug)]
pub struct Saver {
    directory: PathBuf,
    /// Two that write the same name at once would share the temporary file.
    one_at_a_time: Mutex<()>,
}

impl Saver {
    /// Files go into `directory`, which is made when it is needed.
    #[must_use]
    pub const fn new(directory: PathBuf) -> Self {
        Self { directory, one_at_a_time: Mutex::new(()) }
    }

    /// Writes NAME.pgm, NAME.png, NAME.tum and NAME.yaml; each replaces the one that was there.
    ///
    /// # Errors
    /// When there is no map yet or a file cannot be written.
    pub fn save(&self, name: &SaveName, products: &MapProducts) -> Result<Saved, SaveError> {
        if products.is_empty() {
            return Err(SaveError::NoMap);
        }
        let picture = products.png().map_err(|error| SaveError::Picture(error.to_string()))?;
        // The yaml is last: where it is, the image that it names is there too.
        let contents = [
            ("pgm", products.pgm()),
            ("png", picture),
            ("tum", products.tum()),
            ("yaml", products.yaml(&format!("{name}.pgm"))),
        ];
        let _turn = self.one_at_a_time.lock().unwrap_or_else(PoisonError::into_inner);
        let directory = self.directory()?;
        let mut files = Vec::new();
        for (ending, bytes) in contents {
            let path = directory.join(format!("{name}.{ending}"));
            write_atomically(&path, &bytes)?;
            files.push(SavedFile { path, sha256: sha256(&bytes) });
        }
        let label = products.label();
        let done = format!("saved version {} of the map as {name}.yaml", label.version);
        Ok(Saved { done, version: label.version, map_sha256: label.sha256.clone(), files })
    }

    fn directory(&self) -> Result<PathBuf, SaveError> {
        let error = |source| SaveError::Directory { path: self.directory.clone(), source };
        std::fs::create_dir_all(&self.directory).map_err(error)?;
        std::path::absolute(Path::new(&self.directory)).map_err(error)
    }
}

fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::{any, prop_assert_eq, proptest};

    use super::*;

    #[test]
    fn a_name_is_never_a_path() {
        let reason = |name: &str| SaveName::parse(name).map_err(|error| error.reason);
        for name in ["office", "Küche 2", "a.b", "-", "x".repeat(100).as_str()] {
            assert_eq!(reason(name), Ok(SaveName(name.to_owned())));
        }
        assert_eq!(reason(""), Err("is empty"));
        assert_eq!(reason(&"x".repeat(101)), Err("is too long"));
        assert_eq!(reason("a/b"), Err("has a slash"));
        assert_eq!(reason("/etc/passwd"), Err("has a slash"));
        assert_eq!(reason("a\\b"), Err("has a slash"));
        assert_eq!(reason(".."), Err("has two dots"));
        assert_eq!(reason("a..b"), Err("has two dots"));
        assert_eq!(reason(".hidden"), Err("begins with a dot"));
        assert_eq!(reason("a\nb"), Err("has a control character"));
        assert_eq!(reason("a\0"), Err("has a control character"));
    }

    #[test]
    fn the_error_repeats_the_name_and_says_what_is_allowed() {
        assert_eq!(
            SaveName::parse("../x").unwrap_err().to_string(),
            "name=\"../x\" has a slash; it must be the name of a file without its ending, as in \
             office, of at most 100 bytes"
        );
    }

    proptest! {
        /// Joined to a directory, any name that is allowed is a file directly in it.
        #[test]
        fn every_allowed_name_stays_in_the_directory(name in any::<String>()) {
            if let Ok(name) = SaveName::parse(&name) {
                let path = Path::new("maps").join(format!("{name}.pgm"));
                prop_assert_eq!(path.parent(), Some(Path::new("maps")));
                prop_assert_eq!(path.components().count(), 2);
            }
        }
    }
}
