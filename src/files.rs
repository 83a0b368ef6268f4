//! Files that are there in full or not at all.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use thiserror::Error;

/// Why a file was not written.
#[derive(Debug, Error)]
#[error("cannot write {}", path.display())]
pub struct WriteError {
    /// The file that was to be written.
    pub path: PathBuf,
    /// What the system says.
    pub source: io::Error,
}

/// Writes a file so that a crash leaves either its old content or all of the new.
///
/// # Errors
/// When the directory is not there or not writable, or the disk is full; the error names `path`.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> Result<(), WriteError> {
    let mut file = NewFile::create(path)?;
    let written = file.write_all(bytes);
    written.map_err(|source| file.error(source))?;
    file.publish()
}

/// A file that takes its name only when it is complete and on disk.
///
/// The bytes go to a temporary name in the same directory, which is removed unless published.
#[derive(Debug)]
pub struct NewFile {
    out: BufWriter<File>,
    path: PathBuf,
    temporary: PathBuf,
}

impl NewFile {
    /// Begins a file that will be called `path`.
    ///
    /// # Errors
    /// When the directory is not there or not writable; the error names `path`.
    pub fn create(path: &Path) -> Result<Self, WriteError> {
        let temporary = temporary_name(path);
        let path = path.to_owned();
        match File::create(&temporary) {
            Ok(file) => Ok(Self { out: BufWriter::new(file), path, temporary }),
            Err(source) => Err(WriteError { path, source }),
        }
    }

    /// A failure of writing to this file, with its name.
    #[must_use]
    pub fn error(&self, source: io::Error) -> WriteError {
        WriteError { path: self.path.clone(), source }
    }

    /// Gives the file its name once its bytes are on disk.
    ///
    /// # Errors
    /// When the disk is full or the name cannot be taken; the error names the file.
    pub fn publish(mut self) -> Result<(), WriteError> {
        self.sync_and_rename().map_err(|source| self.error(source))
    }

    fn sync_and_rename(&mut self) -> io::Result<()> {
        self.out.flush()?;
        self.out.get_ref().sync_all()?;
        fs::rename(&self.temporary, &self.path)?;
        // The rename itself is on disk only when the directory is.
        let directory = match self.path.parent() {
            Some(parent) if parent != Path::new("") => parent,
            _ => Path::new("."),
        };
        File::open(directory)?.sync_all()
    }
}

impl Write for NewFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.out.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }
}

impl Drop for NewFile {
    fn drop(&mut self) {
        fs::remove_file(&self.temporary).ok();
    }
}

/// Two processes that write the same file do not share a temporary name.
fn temporary_name(path: &Path) -> PathBuf {
    let mut name = std::ffi::OsString::from(".");
    name.push(path.file_name().unwrap_or_default());
    name.push(format!(".{}.tmp", std::process::id()));
    path.with_file_name(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_replaced_and_nothing_is_left_beside_it() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("map.pgm");
        write_atomically(&path, b"old").unwrap();
        write_atomically(&path, b"new").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"new");
        assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 1);
    }

    #[test]
    fn an_error_names_the_file() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("missing").join("map.pgm");
        let error = write_atomically(&path, b"x").unwrap_err();
        assert!(error.to_string().ends_with("missing/map.pgm"), "{error}");
    }
}
