//! A directory of checkpoints.

use std::collections::VecDeque;
use std::fs::{self, File, TryLockError};
use std::path::{Path, PathBuf};

use thiserror::Error;

use super::{Head, open, read};
use crate::files::{WriteError, write_atomically};

const BEGINNING: &str = "checkpoint-";
const ENDING: &str = ".state";
const LOCK: &str = "lock";

/// A directory that one daemon writes checkpoints to. Their names have numbers that grow, so none
/// is ever overwritten; what is damaged or of another configuration is never deleted.
#[derive(Debug)]
pub struct Store {
    directory: PathBuf,
    keep: usize,
    /// Numbers of those that are known to be good, oldest first.
    good: VecDeque<u64>,
    next: u64,
    /// Nobody else writes here as long as it is open.
    _lock: Option<File>,
}

/// Why a directory cannot be used.
#[derive(Debug, Error)]
pub enum StoreError {
    /// Two daemons would delete each other's checkpoints.
    #[error("another daemon keeps its state in {}", .0.display())]
    Locked(PathBuf),
}

impl Store {
    /// Uses a directory, which is made if it is not there, and keeps so many good checkpoints.
    ///
    /// One that cannot be made or written to is no error yet: each writing will tell.
    ///
    /// # Errors
    /// When another daemon uses it.
    pub fn new(directory: &Path, keep: usize) -> Result<Self, StoreError> {
        fs::create_dir_all(directory).ok();
        let lock = File::options().create(true).append(true).open(directory.join(LOCK)).ok();
        if let Some(Err(TryLockError::WouldBlock)) = lock.as_ref().map(File::try_lock) {
            return Err(StoreError::Locked(directory.to_owned()));
        }
        let next = checkpoints(directory).first().map_or(1, |(number, _)| number + 1);
        let directory = directory.to_owned();
        let store = Self { directory, keep, good: VecDeque::new(), next, _lock: lock };
        store.remove_unfinished();
        Ok(store)
    }

    /// Where it is.
    #[must_use]
    pub fn directory(&self) -> &Path {
        &self.directory
    }

    /// A daemon that was killed while it wrote leaves a file with a temporary name.
    fn remove_unfinished(&self) {
        let Ok(entries) = fs::read_dir(&self.directory) else { return };
        for path in entries.flatten().map(|entry| entry.path()) {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            if name.starts_with(&format!(".{BEGINNING}")) && name.ends_with(".tmp") {
                fs::remove_file(&path).ok();
            }
        }
    }

    /// Looks which of the checkpoints that are there are good and of the same kind as `own`: those
    /// take part in being replaced by newer ones.
    pub fn adopt(&mut self, own: &Head) {
        let good = |path: &Path| {
            let bytes = read(path)?;
            open(&bytes)?.head.check_against(own)
        };
        let mut found: Vec<u64> = checkpoints(&self.directory)
            .into_iter()
            .filter_map(|(number, path)| good(&path).ok().map(|()| number))
            .filter(|number| *number < self.next && !self.good.contains(number))
            .collect();
        found.extend(self.good.drain(..));
        found.sort_unstable();
        self.good = found.into();
    }

    /// Writes a checkpoint, and deletes the good ones that are too many.
    ///
    /// # Errors
    /// When the directory cannot be made or written to, or the disk is full; nothing is deleted
    /// then.
    pub fn write(&mut self, bytes: &[u8]) -> Result<PathBuf, WriteError> {
        let number = self.next;
        // A file that has its name already may fail to be synced: the next is another in any case.
        self.next += 1;
        let path = self.path(number);
        if let Err(source) = fs::create_dir_all(&self.directory) {
            return Err(WriteError { path, source });
        }
        write_atomically(&path, bytes)?;
        self.good.push_back(number);
        while self.good.len() > self.keep {
            if let Some(number) = self.good.pop_front() {
                fs::remove_file(self.path(number)).ok();
            }
        }
        Ok(path)
    }

    fn path(&self, number: u64) -> PathBuf {
        self.directory.join(format!("{BEGINNING}{number:010}{ENDING}"))
    }
}

/// The checkpoints of a directory, newest first, by their numbers.
#[must_use]
pub fn checkpoints(directory: &Path) -> Vec<(u64, PathBuf)> {
    let Ok(entries) = fs::read_dir(directory) else { return Vec::new() };
    let mut found: Vec<(u64, PathBuf)> = entries
        .flatten()
        .filter_map(|entry| {
            let name = entry.file_name();
            let number = name.to_str()?.strip_prefix(BEGINNING)?.strip_suffix(ENDING)?;
            Some((number.parse().ok()?, entry.path()))
        })
        .collect();
    found.sort_unstable_by(|a, b| b.cmp(a));
    found
}

#[cfg(test)]
mod tests {
    use std::io::Write as _;

    use super::super::seal;
    use super::super::tests::head;
    use super::*;

    fn numbers(directory: &Path) -> Vec<u64> {
        checkpoints(directory).into_iter().map(|(number, _)| number).collect()
    }

    #[test]
    fn the_last_good_ones_are_kept_and_nothing_else_is_touched() {
        let directory = tempfile::tempdir().unwrap();
        let directory = directory.path().join("deep").join("state");
        let good = seal(head(), |to| to.write_all(b"state")).unwrap();
        let mut store = Store::new(&directory, 3).unwrap();
        (0..5).for_each(|_| drop(store.write(&good).unwrap()));
        assert_eq!(numbers(&directory), [5, 4, 3]);
        drop(store);
        let [damaged, foreign] =
            [6, 7].map(|n| directory.join(format!("checkpoint-{n:010}.state")));
        fs::write(&damaged, &good[..40]).unwrap();
        let other = Head { robot: "robot02".to_owned(), ..head() };
        fs::write(&foreign, seal(other, |to| to.write_all(b"state")).unwrap()).unwrap();
        fs::write(directory.join(".checkpoint-0000000008.state.77.tmp"), b"half").unwrap();
        fs::write(directory.join("notes.txt"), b"mine").unwrap();

        let mut store = Store::new(&directory, 3).unwrap();
        store.adopt(&head());
        assert_eq!(numbers(&directory), [7, 6, 5, 4, 3]);
        assert!(store.write(&good).unwrap().ends_with("checkpoint-0000000008.state"));
        assert_eq!(numbers(&directory), [8, 7, 6, 5, 4]);
        (0..3).for_each(|_| drop(store.write(&good).unwrap()));
        assert_eq!(numbers(&directory), [11, 10, 9, 7, 6]);
        let names = fs::read_dir(&directory).unwrap().count();
        assert_eq!(names, 7, "five checkpoints, the lock and the notes");
    }

    #[test]
    fn two_daemons_do_not_share_a_directory() {
        let directory = tempfile::tempdir().unwrap();
        let store = Store::new(directory.path(), 3).unwrap();
        let error = Store::new(directory.path(), 3).unwrap_err().to_string();
        assert!(error.starts_with("another daemon keeps its state in /"), "{error}");
        drop(store);
        Store::new(directory.path(), 3).unwrap();
    }

    #[test]
    fn what_cannot_be_written_is_told_and_deletes_nothing() {
        let directory = tempfile::tempdir().unwrap();
        let good = seal(head(), |to| to.write_all(b"state")).unwrap();
        let mut store = Store::new(directory.path(), 1).unwrap();
        store.write(&good).unwrap();
        // A directory that nobody empties has the name that is next.
        fs::create_dir_all(directory.path().join("checkpoint-0000000002.state/in it")).unwrap();
        let error = store.write(&good).unwrap_err();
        assert!(error.to_string().ends_with("checkpoint-0000000002.state"), "{error}");
        assert_eq!(numbers(directory.path()), [2, 1]);
        assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 3);
        assert!(store.write(&good).unwrap().ends_with("checkpoint-0000000003.state"));
        assert_eq!(numbers(directory.path()), [3, 2], "the good one before is replaced");
    }
}
