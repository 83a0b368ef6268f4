//! The state on disk: when it is written, on a thread of its own, and which one is gone on from.

use std::io::{self, Write};
use std::panic::AssertUnwindSafe;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use thiserror::Error;
use tokio::sync::oneshot;

use super::command::Done;
use super::keys::Prefix;
use super::mapper::Mapper;
use super::mapper::state::MapperState;
use crate::checkpoint::{
    self, Head, MODE, MapSize, Opened, Refusal, Store, StoreError, checkpoints,
};
use crate::clock::{self, Stopwatch};
use crate::config::{self, Config, EngineKind};
use crate::files::WriteError;
use crate::slam::engine::Engine;
use crate::slam::pose::Stamp;
use crate::slam::state::EngineState;

/// While one is being written, it is looked so often whether the next can be.
const LOOK: Duration = Duration::from_millis(20);

/// The body of a checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Checkpoint {
    /// What the engine knows.
    pub engine: EngineState,
    /// What is known beside it.
    pub mapper: MapperState,
}

impl Checkpoint {
    /// Writes its bytes.
    ///
    /// # Errors
    /// When they cannot be written.
    pub fn write(&self, to: &mut impl Write) -> io::Result<()> {
        postcard::to_io(self, to).map(|_| ()).map_err(io::Error::other)
    }

    /// Of the body of a checkpoint.
    ///
    /// # Errors
    /// When the body cannot be inflated or is not the state of a daemon.
    pub fn decode(opened: &Opened<'_>) -> Result<Self, Refusal> {
        postcard::from_bytes(&opened.body()?).map_err(|e| Refusal::Undecodable(e.to_string()))
    }
}

/// How it goes with checkpoints.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct CheckpointStatus {
    /// Where they are.
    pub directory: PathBuf,
    /// The one that was gone on from; `null` if mapping began anew.
    pub resumed_from: Option<String>,
    /// Of the last scan that was taken before that one: who feeds again begins after it.
    pub resumed_stamp: Option<Stamp>,
    /// Those that were not taken, newest first.
    pub refused: Vec<RefusedCheckpoint>,
    /// How many have been written.
    pub written: u64,
    /// The last that was; `null` before the first.
    pub last: Option<WrittenCheckpoint>,
    /// Why the last could not be written; `null` if it could.
    pub error: Option<String>,
}

/// A checkpoint that is not gone on from.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct RefusedCheckpoint {
    /// Its name.
    pub file: String,
    /// Why, in a sentence.
    pub reason: String,
}

/// A checkpoint that is on the disk.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct WrittenCheckpoint {
    /// Its name.
    pub file: String,
    /// Of the last scan that was taken.
    pub stamp: Option<Stamp>,
    /// Scans that had their verdict.
    pub scans: u64,
    /// Its size.
    pub bytes: usize,
    /// What it took to make and to write it.
    pub milliseconds: f64,
}

/// The status, as the thread and those who ask share it.
pub(super) type SharedStatus = Arc<Mutex<CheckpointStatus>>;

/// Why there is nothing to write with.
#[derive(Debug, Error)]
pub enum CheckpointsError {
    /// The directory cannot be used.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// There is no state to localize in, and no map either.
    #[error(
        "mode is localization, and {} has no state of this robot with a map to go on from: map \
         first, or name a map",
        directory.display()
    )]
    NothingToLocalizeIn {
        /// Where states are kept.
        directory: PathBuf,
    },
    /// The thread does not start.
    #[error("cannot start the thread that writes checkpoints")]
    Thread(#[source] std::io::Error),
}

/// Why a checkpoint is not on the disk.
#[derive(Debug, Error)]
enum NotWritten {
    #[error("the state cannot be encoded: {0}")]
    Encode(io::Error),
    #[error("{error}: {}", error.source)]
    Write {
        #[from]
        error: WriteError,
    },
    #[error("gmapd has a fault there: {0}")]
    Panicked(String),
    #[error("the thread that writes it has ended; restart gmapd")]
    NoThread,
}

/// Decides when the state is written, and hands it to the thread `checkpoint`.
#[derive(Debug)]
pub(super) struct Keeper {
    jobs: Sender<Job>,
    status: SharedStatus,
    /// Jobs that are not done yet.
    pending: Arc<AtomicUsize>,
    /// Who waits for a state to be on the disk, and is in no job yet.
    asked: Vec<oneshot::Sender<Done>>,
    every: Duration,
    every_scans: u64,
    /// When the last was handed on, and the scans that had their verdict by then.
    last: (Instant, u64),
    /// Whether a command changed the state since.
    commanded: bool,
}

/// A state to be written. What is costly is done on the thread.
#[derive(Debug)]
struct Job {
    engine: Engine,
    mapper: MapperState,
    asked: Vec<oneshot::Sender<Done>>,
    _pending: Pending,
}

/// Counts a job until it is done, whatever becomes of it.
#[derive(Debug)]
struct Pending(Arc<AtomicUsize>);

impl Pending {
    fn new(pending: &Arc<AtomicUsize>) -> Self {
        pending.fetch_add(1, Ordering::AcqRel);
        Self(Arc::clone(pending))
    }
}

impl Drop for Pending {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::AcqRel);
    }
}

impl Keeper {
    /// Notes that a command changed what is known.
    pub(super) fn note_command(&mut self) {
        self.commanded = true;
    }

    /// Has the state written as soon as the one before is; `done` hears when it is on the disk.
    ///
    /// However many ask while the disk is slow, one state is written for all of them.
    pub(super) fn ask(&mut self, done: oneshot::Sender<Done>) {
        self.asked.retain(|done| !done.is_closed());
        self.asked.push(done);
    }

    /// Whether the state is to be written now, with so many scans that had their verdict.
    pub(super) fn is_due(&self, now: Instant, scans: u64) -> bool {
        let (since, before) = self.last;
        let late = now >= since + self.every && (scans != before || self.has_failed());
        !self.is_writing() && (late || self.is_pressing(scans))
    }

    /// Whether it is to be written as soon as the one before is.
    fn is_pressing(&self, scans: u64) -> bool {
        let many = scans.saturating_sub(self.last.1) >= self.every_scans;
        self.commanded || !self.asked.is_empty() || many
    }

    fn is_writing(&self) -> bool {
        self.pending.load(Ordering::Acquire) > 0
    }

    /// Whether the last is not on the disk.
    fn has_failed(&self) -> bool {
        locked(&self.status).error.is_some()
    }

    /// When to look again though nothing comes; `None` if all that is known is on the disk.
    pub(super) fn deadline(&self, now: Instant, scans: u64) -> Option<Instant> {
        let (since, before) = self.last;
        let soon = now + LOOK;
        if self.is_pressing(scans) {
            return Some(soon);
        }
        // What is being written may fail.
        let unsettled = scans != before || self.is_writing() || self.has_failed();
        unsettled.then(|| soon.max(since + self.every))
    }

    /// Hands a state to the thread; those who asked hear when it is on the disk.
    pub(super) fn write(&mut self, engine: Engine, mapper: MapperState) {
        self.last = (clock::now(), mapper.scans());
        self.commanded = false;
        let (asked, pending) = (std::mem::take(&mut self.asked), Pending::new(&self.pending));
        if let Err(unsent) = self.jobs.send(Job { engine, mapper, asked, _pending: pending }) {
            tell(unsent.0.asked, &note(&self.status, Err(NotWritten::NoThread)));
        }
    }
}

/// Whoever asked may be gone.
fn tell(asked: Vec<oneshot::Sender<Done>>, done: &Done) {
    for asker in asked {
        asker.send(done.clone()).ok();
    }
}

fn locked(status: &SharedStatus) -> MutexGuard<'_, CheckpointStatus> {
    status.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Goes on from the newest checkpoint that is good, if the configuration has a directory for them,
/// and has the mapper write there.
pub(super) fn attach(
    mapper: &mut Mapper,
    config: &Config,
    prefix: &Prefix,
) -> Result<Option<SharedStatus>, CheckpointsError> {
    let Some(directory) = &config.raw.state_directory else { return Ok(None) };
    let config::Checkpoint { every_s, every_scans, keep } = config.raw.checkpoint;
    let store = Store::new(directory.as_ref(), keep)?;
    let own = own_head(config, prefix);
    let (status, head) = resume(mapper, store.directory(), &own);
    if mapper.localizes_in_nothing() {
        let directory = store.directory().to_owned();
        return Err(CheckpointsError::NothingToLocalizeIn { directory });
    }
    // Where the robot was said to be is written at once: from the next restart on it is old.
    let commanded = head.is_some_and(|head| head.has_other_pose(&own));
    let status = Arc::new(Mutex::new(status));
    let (jobs, waiting) = channel();
    let pending = Arc::new(AtomicUsize::new(0));
    let writer = Writer { store, own, status: Arc::clone(&status) };
    let thread = std::thread::Builder::new().name("checkpoint".to_owned());
    thread.spawn(move || writer.run(&waiting)).map_err(CheckpointsError::Thread)?;
    mapper.keep_state(Keeper {
        jobs,
        status: Arc::clone(&status),
        pending,
        asked: Vec::new(),
        every: Duration::from_secs_f64(every_s),
        every_scans,
        last: (clock::now(), mapper.scans()),
        commanded,
    });
    Ok(Some(status))
}

/// What this daemon writes, without what changes from one checkpoint to the next.
fn own_head(config: &Config, prefix: &Prefix) -> Head {
    let engine = match config.raw.engine {
        EngineKind::Gmapping => "gmapping",
        EngineKind::Hector => "hector",
        EngineKind::KnownPoses => "known_poses",
    };
    Head {
        gmapd: env!("CARGO_PKG_VERSION").to_owned(),
        robot: prefix.to_string(),
        engine: engine.to_owned(),
        settings: config.settings_of_state(),
        ..Head::default()
    }
}

/// Goes on from the newest checkpoint that is good and of this daemon's kind, and has its head.
fn resume(mapper: &mut Mapper, directory: &Path, own: &Head) -> (CheckpointStatus, Option<Head>) {
    let mut status = CheckpointStatus {
        directory: directory.to_owned(),
        resumed_from: None,
        resumed_stamp: None,
        refused: Vec::new(),
        written: 0,
        last: None,
        error: None,
    };
    for (_, path) in checkpoints(directory) {
        match resume_from(mapper, &path, own) {
            Ok(head) => {
                let (path, scans) = (path.display(), head.processed);
                tracing::info!("going on from {path}, with {scans} scans in the map");
                status.resumed_stamp = head.stamp;
                status.resumed_from = Some(name(&path.to_string()));
                return (status, Some(head));
            }
            Err(refusal) => {
                tracing::warn!("{} is not gone on from: {refusal}", path.display());
                let file = name(&path.display().to_string());
                status.refused.push(RefusedCheckpoint { file, reason: refusal.to_string() });
            }
        }
    }
    tracing::info!("no state to go on from in {}: mapping begins anew", directory.display());
    (status, None)
}

fn resume_from(mapper: &mut Mapper, path: &Path, own: &Head) -> Result<Head, Refusal> {
    let bytes = checkpoint::read(path)?;
    let opened = checkpoint::open(&bytes)?;
    opened.head.check_against(own)?;
    let Checkpoint { engine, mapper: state } = Checkpoint::decode(&opened)?;
    mapper.go_on_from(state, engine).map_err(|e| Refusal::Undecodable(e.to_string()))?;
    // Otherwise it is as the last command left it.
    if opened.head.settings.get(MODE) != own.settings.get(MODE) {
        mapper.take_configured_mode();
    }
    if opened.head.searching {
        mapper.search_pose();
    }
    if opened.head.has_other_pose(own) {
        mapper.take_configured_pose();
    }
    Ok(opened.head)
}

/// A file's name without its directory.
fn name(path: &str) -> String {
    path.rsplit('/').next().unwrap_or_default().to_owned()
}

/// What the thread `checkpoint` works with.
struct Writer {
    store: Store,
    own: Head,
    status: SharedStatus,
}

impl Writer {
    /// Until the mapper ends.
    fn run(mut self, jobs: &Receiver<Job>) {
        self.store.adopt(&self.own);
        while let Ok(Job { engine, mapper, asked, _pending: pending }) = jobs.recv() {
            let written = caught(|| self.write(engine, mapper));
            let done = note(&self.status, written);
            drop(pending);
            tell(asked, &done);
        }
    }

    fn write(
        &mut self,
        engine: Engine,
        mapper: MapperState,
    ) -> Result<WrittenCheckpoint, NotWritten> {
        let watch = Stopwatch::start();
        let (stamp, scans) = (mapper.taken(), mapper.scans());
        let (head, state) = self.describe(engine, &mapper);
        let checkpoint = Checkpoint { engine: state, mapper };
        let sealed =
            checkpoint::seal(head, |to| checkpoint.write(to)).map_err(NotWritten::Encode)?;
        let path = self.store.write(&sealed)?;
        Ok(WrittenCheckpoint {
            file: name(&path.display().to_string()),
            stamp,
            scans,
            bytes: sealed.len(),
            milliseconds: watch.elapsed().wall.as_secs_f64() * 1e3,
        })
    }

    fn describe(&self, mut engine: Engine, mapper: &MapperState) -> (Head, EngineState) {
        let occupancy = engine.occupancy();
        let map = occupancy.bounds().map(|(low, high)| MapSize {
            width: (high.ix - low.ix + 1) as usize,
            height: (high.iy - low.iy + 1) as usize,
            resolution: occupancy.resolution(),
        });
        let head = Head {
            scans: mapper.scans(),
            processed: engine.path().len() as u64,
            particles: engine.hypotheses().len() as u64,
            stamp: mapper.taken(),
            map,
            searching: engine.is_searching(),
            ..self.own.clone()
        };
        (head, engine.state())
    }
}

/// A fault in what makes a checkpoint is an error as any other, and the next is tried.
fn caught<T>(work: impl FnOnce() -> Result<T, NotWritten>) -> Result<T, NotWritten> {
    std::panic::catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|panic| {
        let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
        let text = text.or_else(|| panic.downcast_ref::<String>().cloned());
        Err(NotWritten::Panicked(text.unwrap_or_default()))
    })
}

/// Puts it in the status, and in the log where it is new that something is wrong or right.
fn note(status: &SharedStatus, written: Result<WrittenCheckpoint, NotWritten>) -> Done {
    let mut status = locked(status);
    match written {
        Ok(written) => {
            if status.error.take().is_some() {
                tracing::info!("checkpoints are written again");
            }
            let WrittenCheckpoint { file, bytes, milliseconds, .. } = &written;
            tracing::debug!(file, bytes, milliseconds, "checkpoint");
            let done = format!("the state is in {}", status.directory.join(file).display());
            status.written += 1;
            status.last = Some(written);
            Done { done, changed: true }
        }
        Err(error) => {
            let done = format!("the state is not written: {error}");
            if status.error.as_ref() != Some(&done) {
                tracing::error!("{done}; mapping goes on");
                status.error = Some(done.clone());
            }
            Done { done, changed: false }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fault_in_what_writes_is_told_as_any_other_error() {
        let written = caught::<()>(|| panic!("a cell is missing")).unwrap_err();
        assert_eq!(written.to_string(), "gmapd has a fault there: a cell is missing");
        assert!(caught(|| Ok(())).is_ok());
    }

    #[test]
    fn a_job_counts_until_it_is_gone_whatever_became_of_it() {
        let pending = Arc::new(AtomicUsize::new(0));
        let (jobs, waiting) = channel();
        jobs.send(Pending::new(&pending)).unwrap();
        assert_eq!(pending.load(Ordering::Acquire), 1);
        drop(waiting);
        jobs.send(Pending::new(&pending)).unwrap_err();
        assert_eq!(pending.load(Ordering::Acquire), 0);
    }

    const SECOND: Duration = Duration::from_secs(1);

    /// Due after ten seconds or five scans, with three scans that are in the last.
    fn keeper() -> (Keeper, Instant) {
        let start = clock::now();
        let keeper = Keeper {
            jobs: channel().0,
            status: SharedStatus::default(),
            pending: Arc::default(),
            asked: Vec::new(),
            every: 10 * SECOND,
            every_scans: 5,
            last: (start, 3),
            commanded: false,
        };
        (keeper, start)
    }

    #[test]
    fn it_is_due_by_scans_or_by_time_with_a_scan() {
        let (keeper, start) = keeper();
        assert!(!keeper.is_due(start, 3));
        assert!(!keeper.is_due(start, 7));
        assert!(keeper.is_due(start, 8));
        assert!(!keeper.is_due(start + 9 * SECOND, 4));
        assert!(keeper.is_due(start + 10 * SECOND, 4));
        assert!(!keeper.is_due(start + 100 * SECOND, 3), "nothing has come");
    }

    #[test]
    fn a_command_makes_it_due_at_once() {
        let (mut keeper, start) = keeper();
        keeper.note_command();
        assert!(keeper.is_due(start, 3));
    }

    #[test]
    fn while_one_is_being_written_none_is_due_and_it_is_looked_again_soon() {
        let (mut keeper, start) = keeper();
        keeper.pending.store(1, Ordering::Release);
        assert!(!keeper.is_due(start + 100 * SECOND, 100));
        assert_eq!(keeper.deadline(start, 100), Some(start + LOOK));
        keeper.note_command();
        assert!(!keeper.is_due(start, 3));
        assert_eq!(keeper.deadline(start, 3), Some(start + LOOK));
        keeper.pending.store(0, Ordering::Release);
        assert!(keeper.is_due(start, 3));
    }

    #[test]
    fn though_nothing_comes_any_more_what_came_is_written_when_it_is_time() {
        let (keeper, start) = keeper();
        assert_eq!(keeper.deadline(start, 3), None);
        assert_eq!(keeper.deadline(start, 4), Some(start + 10 * SECOND));
        assert_eq!(keeper.deadline(start + 20 * SECOND, 4), Some(start + 20 * SECOND + LOOK));
    }
}
