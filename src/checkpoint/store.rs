//! A directory of checkpoints.

use std::collections::VecDeque;
use std::fs::{self, File, TryLockError};
use std::io;
use std::os::unix::fs::MetadataExt as _;
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
    /// Nobody else writes here as long as it is open; `None` until there is one.
    lock: Option<File>,
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
        let lock = match lock(directory) {
            Err(TryLockError::WouldBlock) => return Err(StoreError::Locked(directory.to_owned())),
            lock => lock.ok(),
        };
        let directory = directory.to_owned();
        let store = Self { directory, keep, good: VecDeque::new(), next: 1, lock };
        store.remove_unfinished();
        Ok(store)
    }

    /// Sees to it that there is a directory of ours, without a file of this name.
    fn prepare(&mut self, path: &Path) -> io::Result<()> {
        fs::create_dir_all(&self.directory)?;
        self.hold_lock()?;
        if path.try_exists()? {
            return Err(io::ErrorKind::AlreadyExists.into());
        }
        Ok(())
    }

    /// The directory may have come only now, or be another than it was: a disk that is mounted late
    /// has checkpoints, and may have a daemon.
    fn hold_lock(&mut self) -> io::Result<()> {
        let is = |held: &File, found: &fs::Metadata| {
            held.metadata().is_ok_and(|held| (held.dev(), held.ino()) == (found.dev(), found.ino()))
        };
        let found = fs::metadata(self.directory.join(LOCK)).ok();
        if self.lock.as_ref().zip(found).is_some_and(|(held, found)| is(held, &found)) {
            return Ok(());
        }
        match lock(&self.directory) {
            Ok(lock) => {
                self.lock = Some(lock);
                // They are of the directory before, if there was one.
                self.good.clear();
            }
            Err(TryLockError::WouldBlock) => {
                return Err(io::Error::other(StoreError::Locked(self.directory.clone())));
            }
            // Where there are no locks, one goes on without.
            Err(TryLockError::Error(_)) => {}
        }
        Ok(())
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
            .filter(|number| !self.good.contains(number))
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
        let newest = checkpoints(&self.directory).first().map_or(0, |(number, _)| *number);
        let number = self.next.max(newest.saturating_add(1));
        // A file that has its name already may fail to be synced: the next is another in any case.
        self.next = number.saturating_add(1);
        let path = self.path(number);
        if let Err(source) = self.prepare(&path) {
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

/// The lock of a directory, held.
fn lock(directory: &Path) -> Result<File, TryLockError> {
    let lock = File::options().create(true).append(true).open(directory.join(LOCK));
    let lock = lock.map_err(TryLockError::Error)?;
    lock.try_lock()?;
    Ok(lock)
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
    use std::os::unix::fs::symlink;

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
        // No number is left.
        let last = directory.path().join(format!("checkpoint-{}.state", u64::MAX));
        fs::write(&last, "mine").unwrap();
        let error = store.write(&good).unwrap_err();
        assert!(error.to_string().ends_with(&*last.to_string_lossy()), "{error}");
        assert_eq!(numbers(directory.path()), [u64::MAX, 1]);
        assert_eq!(fs::read(&last).unwrap(), b"mine");
        assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 3);
        fs::remove_file(&last).unwrap();
        store.write(&good).unwrap();
        assert_eq!(numbers(directory.path()), [u64::MAX], "the good one before is replaced");
    }

    #[test]
    fn a_directory_that_comes_late_is_locked_and_nothing_in_it_is_overwritten() {
        let root = tempfile::tempdir().unwrap();
        let [place, disk] = ["state", "disk"].map(|name| root.path().join(name));
        let good = seal(head(), |to| to.write_all(b"state")).unwrap();
        symlink(root.path().join("not mounted/yet"), &place).unwrap();
        let mut store = Store::new(&place, 3).unwrap();
        store.write(&good).unwrap_err();

        let other = Store::new(&disk, 3).unwrap();
        fs::write(disk.join("checkpoint-0000000018.state"), &good).unwrap();
        fs::remove_file(&place).unwrap();
        symlink(&disk, &place).unwrap();
        let error = store.write(&good).unwrap_err().source.to_string();
        assert!(error.starts_with("another daemon"), "{error}");
        drop(other);
        assert!(store.write(&good).unwrap().ends_with("checkpoint-0000000020.state"));
        assert_eq!(numbers(&disk), [20, 18]);
        Store::new(&disk, 3).unwrap_err();

        // Another one, with files whose numbers were of ours on the one before.
        let another = root.path().join("another");
        fs::create_dir(&another).unwrap();
        fs::write(another.join("checkpoint-0000000020.state"), b"mine").unwrap();
        fs::remove_file(&place).unwrap();
        symlink(&another, &place).unwrap();
        (0..4).for_each(|_| drop(store.write(&good).unwrap()));
        assert_eq!(numbers(&another), [24, 23, 22, 20]);
    }
}
