//! `gmapd run`: live mapping on a Zenoh mesh.
//!
//! What comes is handed on by Zenoh's callbacks ([`input`]), decoded by a task, and put in the
//! [`mailbox`] of the filter's thread ([`mapper`]), which puts it in order ([`synchronizer`]),
//! runs the filter, and leaves a [`snapshot`] and an entry in the [`ledger`] for each scan.
//! From these [`serving`] publishes and answers.

mod answers;
pub mod checkpointing;
pub mod command;
mod diagnostics;
pub mod formats;
pub mod frames;
pub mod gaps;
pub mod input;
mod judgement;
pub mod keys;
mod last_seen;
pub mod ledger;
pub mod limits;
pub mod links;
pub mod mailbox;
mod map_updates;
pub mod mapper;
mod message_clock;
mod outputs;
mod queries;
pub mod recorder;
pub mod ros_node;
pub mod save;
pub mod selector;
pub mod serving;
pub mod snapshot;
pub mod status;
pub mod synchronizer;
pub mod tiles;

use std::future::Future;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use thiserror::Error;
use tokio::sync::{broadcast, mpsc, oneshot, watch};
use tokio::task::{JoinHandle, spawn_blocking};
use zenoh::Wait as _;
use zenoh::pubsub::Subscriber;
use zenoh::sample::Locality;
use zenoh_ext::{AdvancedSubscriber, AdvancedSubscriberBuilderExt as _, HistoryConfig};

use self::checkpointing::CheckpointsError;
use self::command::Request;
use self::formats::{EmptyMap, MapProducts};
use self::input::{Inbox, Input};
use self::keys::{InputKeys, KeyError, Prefix, plain_message};
use self::ledger::Entry;
use self::links::Links;
use self::mailbox::Mailbox;
use self::mapper::{Connections, Gauges, Mapper};
use self::recorder::{Recorder, RecorderError};
use self::ros_node::{Convention, RosNode};
use self::save::{NameError, SaveName, Saver};
use self::serving::{Serving, ServingError, Sources};
use self::snapshot::{MapVersion, Snapshot, State};
use self::status::{Shared, Status, StatusSource};
use crate::clock;
use crate::config::Config;
use crate::starting::StartError;

/// At the end, what waits in the mailbox is worked off for this long.
const DRAIN: Duration = Duration::from_millis(1200);

/// And the state is written for this long: a busy disk takes its time.
const LAST_CHECKPOINT: Duration = Duration::from_secs(10);

/// How long anything else may take at the end.
const CLOSE: Duration = Duration::from_millis(200);

/// Verdicts that a slow listener may be behind.
const VERDICTS_KEPT: usize = 1024;

/// Commands on their way to the mailbox.
const COMMANDS: usize = 16;

/// Static transforms a publisher may have told before the daemon started.
const STATIC_TRANSFORMS: usize = 100;

/// How often the state is looked at, to log what changed.
const LOOK: Duration = Duration::from_secs(2);

/// What to run.
#[derive(Debug, Clone)]
pub struct Settings {
    /// All about mapping.
    pub config: Config,
    /// What the robot's keys begin with.
    pub prefix: Prefix,
    /// Threads of the filter.
    pub threads: usize,
}

/// Why the daemon does not run, or ended by itself.
#[derive(Debug, Error)]
pub enum DaemonError {
    /// A key cannot be used.
    #[error(transparent)]
    Key(#[from] KeyError),
    /// `save_on_exit` is not a name.
    #[error("save_on_exit: {0}")]
    SaveName(#[from] NameError),
    /// Nothing can be published or answered.
    #[error(transparent)]
    Serving(#[from] ServingError),
    /// What `record` asks for cannot be done.
    #[error("record: {0}")]
    Record(#[from] RecorderError),
    /// The filter does not start.
    #[error(transparent)]
    Start(#[from] StartError),
    /// The state cannot be kept.
    #[error("state: {0}")]
    Checkpoints(#[from] CheckpointsError),
    /// The thread `mapper` does not start.
    #[error("cannot start the thread that maps")]
    Mapper(#[source] std::io::Error),
    /// Zenoh takes no subscriber.
    #[error("cannot subscribe to {key}: {reason}")]
    Subscribe {
        /// The key.
        key: String,
        /// What Zenoh says.
        reason: String,
    },
    /// Zenoh does not tell of its links.
    #[error("cannot watch the links of the session: {0}")]
    Links(String),
    /// A bug: the thread `mapper` ended though nobody asked it to.
    #[error("the thread that maps ended unexpectedly")]
    MapperEnded,
}

/// Maps until `shutdown` resolves, and closes the session then.
///
/// # Errors
/// When the daemon cannot start, or ends by itself.
pub async fn run(
    session: zenoh::Session,
    settings: Settings,
    shutdown: impl Future<Output = ()>,
) -> Result<(), DaemonError> {
    let mut recorder = record(&session, &settings).await?;
    let mut daemon = Daemon::start(&session, settings).await?;
    let ended = tokio::select! {
        () = shutdown => Ok(()),
        () = daemon.mapper_ended() => Err(DaemonError::MapperEnded),
    };
    if let Some(recorder) = &mut recorder {
        recorder.stop_inputs().await;
    }
    daemon.stop().await;
    if let Some(recorder) = recorder {
        finish(recorder).await;
    }
    // What it would still send is not worth waiting for; letting the session go could block.
    let closing = tokio::spawn(async move { session.close().await });
    tokio::time::timeout(CLOSE, closing).await.ok();
    ended
}

/// Begins to record, if the configuration asks for it.
async fn record(
    session: &zenoh::Session,
    settings: &Settings,
) -> Result<Option<Recorder>, DaemonError> {
    let raw = &settings.config.raw;
    let Some(path) = &raw.record else { return Ok(None) };
    let (id, prefix) = (session.zid().to_string(), settings.prefix.clone());
    let keys = RosNode::new(id, prefix, Convention::new(raw))
        .inputs(&raw.keys, Input::of_motion(&settings.config))?;
    let recorder = Recorder::start(session, &settings.prefix, &keys, path.as_ref()).await?;
    tracing::info!("recording to {}", recorder.unfinished().display());
    Ok(Some(recorder))
}

async fn finish(recorder: Recorder) {
    match tokio::time::timeout(DRAIN, recorder.finish()).await {
        Ok(Ok(recorder::Recorded { path, messages, lost })) => {
            tracing::info!("recorded {messages} messages to {}, {lost} lost", path.display());
        }
        Ok(Err(error)) => tracing::error!("the recording is not whole: {error}"),
        Err(_) => {
            tracing::warn!("the recording is not finished in time; it can be read all the same");
        }
    }
}

/// A daemon that runs.
#[derive(Debug)]
pub struct Daemon {
    /// `None` before it listens and once it does no more.
    subscribers: Option<Subscribers>,
    inbox: Arc<Inbox>,
    mailbox: Arc<Mailbox>,
    decoder: JoinHandle<()>,
    /// Ends with the thread `mapper`.
    mapper: oneshot::Receiver<()>,
    snapshots: watch::Receiver<Arc<Snapshot>>,
    verdicts: broadcast::Sender<Entry>,
    commands: mpsc::Sender<Request>,
    links: Arc<Links>,
    status: Arc<StatusSource>,
    /// `None` before it has started and once stopped.
    serving: Option<Serving>,
    saving: Saving,
    helpers: [JoinHandle<()>; 2],
}

/// What is saved at the end.
#[derive(Debug, Clone)]
struct Saving {
    name: Option<SaveName>,
    directory: PathBuf,
    empty: EmptyMap,
}

#[derive(Debug)]
struct Subscribers {
    changing: Vec<Subscriber<()>>,
    constant: AdvancedSubscriber<()>,
}

impl Daemon {
    /// Starts to listen and to map.
    ///
    /// # Errors
    /// When a key cannot be used, or a thread does not start.
    pub async fn start(session: &zenoh::Session, settings: Settings) -> Result<Self, DaemonError> {
        let Settings { config, prefix, threads } = settings;
        let convention = Convention::new(&config.raw);
        let mut node = RosNode::new(session.zid().to_string(), prefix.clone(), convention);
        let keys = node.inputs(&config.raw.keys, Input::of_motion(&config))?;
        let mut daemon = Self::deaf(&config, &prefix, &keys, threads)?;
        daemon
            .links
            .watch(session)
            .await
            .map_err(|error| DaemonError::Links(plain_message(&error)))?;
        let sources = Sources {
            snapshots: daemon.snapshots(),
            verdicts: daemon.verdicts(),
            commands: daemon.commands(),
            status: asked(&daemon.status),
            refusals: daemon.status.refusals(),
        };
        let served = serving::Settings::new(&config, daemon.saving.directory());
        daemon.serving = Some(Serving::start(session, node, served, sources).await?);
        daemon.subscribers = Some(subscribe(session, &keys, &daemon.inbox).await?);
        tell_keys(&keys);
        Ok(daemon)
    }

    /// All threads and tasks of a daemon that hears and tells nothing yet.
    fn deaf(
        config: &Config,
        prefix: &Prefix,
        keys: &InputKeys,
        threads: usize,
    ) -> Result<Self, DaemonError> {
        let saving = Saving::new(config)?;
        let inbox = Arc::new(Inbox::new(config.raw.max_message_bytes));
        let mailbox = Arc::new(Mailbox::new(config.raw.scan_queue));
        let gauges = Arc::new(Mutex::new(Gauges::default()));
        let links = Arc::new(Links::default());
        let (snapshot_sender, snapshots) = watch::channel(Arc::new(Snapshot::default()));
        let verdicts = broadcast::Sender::new(VERDICTS_KEPT);
        let connections = Connections {
            mailbox: Arc::clone(&mailbox),
            inbox: Arc::clone(&inbox),
            snapshots: snapshot_sender,
            verdicts: verdicts.clone(),
            gauges: Arc::clone(&gauges),
        };
        let mut mapper = Mapper::new(connections, config, keys, threads)?;
        let checkpoints = checkpointing::attach(&mut mapper, config, prefix)?;
        let mapper = spawn(mapper)?;
        let decoder = tokio::spawn(input::decode(Arc::clone(&inbox), Arc::clone(&mailbox)));
        let shared = Shared {
            inbox: Arc::clone(&inbox),
            mailbox: Arc::clone(&mailbox),
            gauges,
            snapshots: snapshots.clone(),
            links: Arc::clone(&links),
            checkpoints,
        };
        let status = Arc::new(StatusSource::new(keys.clone(), &config.raw, shared));
        let (commands, requests) = mpsc::channel(COMMANDS);
        let helpers = [
            tokio::spawn(forward(requests, Arc::clone(&mailbox))),
            tokio::spawn(log_changes(Arc::clone(&status))),
        ];
        Ok(Self {
            subscribers: None,
            inbox,
            mailbox,
            decoder,
            mapper,
            snapshots,
            verdicts,
            commands,
            links,
            status,
            serving: None,
            saving,
            helpers,
        })
    }

    /// What the filter knows.
    #[must_use]
    pub fn snapshots(&self) -> watch::Receiver<Arc<Snapshot>> {
        self.snapshots.clone()
    }

    /// What becomes of each scan from now on.
    #[must_use]
    pub fn verdicts(&self) -> broadcast::Receiver<Entry> {
        self.verdicts.subscribe()
    }

    /// Where commands go.
    #[must_use]
    pub fn commands(&self) -> mpsc::Sender<Request> {
        self.commands.clone()
    }

    /// How it is.
    #[must_use]
    pub fn status(&self) -> Status {
        self.status.status()
    }

    /// Resolves when the filter's thread has ended.
    async fn mapper_ended(&mut self) {
        // The sender is dropped with the thread, and never sends.
        (&mut self.mapper).await.ok();
    }

    /// Stops listening, works off what waits for a while, and leaves the last snapshot.
    pub async fn stop(mut self) -> Arc<Snapshot> {
        let deadline = clock::now() + DRAIN;
        if let Some(subscribers) = self.subscribers.take() {
            // It blocks while the network is slow.
            let undeclare = spawn_blocking(move || subscribers.undeclare());
            tokio::time::timeout(CLOSE, undeclare).await.ok();
        }
        self.inbox.close();
        tokio::time::timeout(CLOSE, &mut self.decoder).await.ok();
        self.mailbox.close(deadline);
        let deadline = deadline + self.status.time_to_write();
        if tokio::time::timeout_at(deadline.into(), self.mapper_ended()).await.is_err() {
            tracing::warn!("the filter did not end in time; its last scans are lost");
        }
        self.helpers.iter().for_each(JoinHandle::abort);
        let last = self.snapshots.borrow().clone();
        let (saving, map) = (self.saving.clone(), last.map.clone());
        let saved = spawn_blocking(move || saving.save(map));
        if let Some(serving) = self.serving.take() {
            tokio::time::timeout(CLOSE, serving.stop()).await.ok();
        }
        // It panics for a bug alone, which is told already.
        saved.await.ok();
        last
    }
}

impl Drop for Daemon {
    /// A daemon that is let go without having been stopped leaves no task behind.
    fn drop(&mut self) {
        self.inbox.close();
        self.mailbox.close(clock::now());
        self.helpers.iter().for_each(JoinHandle::abort);
    }
}

impl Saving {
    fn new(config: &Config) -> Result<Self, NameError> {
        let raw = &config.raw;
        Ok(Self {
            name: raw.save_on_exit.as_deref().map(SaveName::parse).transpose()?,
            directory: PathBuf::from(&raw.save_directory),
            empty: EmptyMap { frame: raw.map_frame.clone(), resolution: raw.resolution },
        })
    }

    fn directory(&self) -> PathBuf {
        self.directory.clone()
    }

    /// Saves the last map, if the configuration asks for it and there is one.
    fn save(self, map: Option<Arc<MapVersion>>) {
        let Some(name) = &self.name else { return };
        let products = MapProducts::new(map, self.empty);
        match Saver::new(self.directory).save(name, &products) {
            Ok(saved) => tracing::info!("{}", saved.done),
            Err(error) => tracing::error!("the last map is not saved: {error}"),
        }
    }
}

impl Subscribers {
    /// A session that is closed has none any more, which is as good.
    fn undeclare(self) {
        for subscriber in self.changing {
            subscriber.undeclare().wait().ok();
        }
        self.constant.undeclare().wait().ok();
    }
}

/// Starts the thread; the receiver ends with it, even if it panics.
fn spawn(mapper: Mapper) -> Result<oneshot::Receiver<()>, DaemonError> {
    let (alive, ended) = oneshot::channel();
    let work = move || {
        let _alive: oneshot::Sender<()> = alive;
        mapper.run();
    };
    let thread = std::thread::Builder::new().name("mapper".to_owned());
    thread.spawn(work).map_err(DaemonError::Mapper)?;
    Ok(ended)
}

async fn subscribe(
    session: &zenoh::Session,
    keys: &InputKeys,
    inbox: &Arc<Inbox>,
) -> Result<Subscribers, DaemonError> {
    let failed = |input| {
        let key = keys.of(input).to_string();
        move |error| DaemonError::Subscribe { key, reason: plain_message(&error) }
    };
    let mut changing = Vec::new();
    for input in [Input::Tf, keys.motion(), Input::Scan] {
        // Our own transforms leave on the key on which others come in, and our pose is none of
        // those that are given.
        let own = matches!(input, Input::Tf | Input::Pose);
        let origin = if own { Locality::Remote } else { Locality::Any };
        let inbox = Arc::clone(inbox);
        let subscriber = session
            .declare_subscriber(keys.of(input))
            .allowed_origin(origin)
            .callback(move |sample| inbox.receive(input, &sample));
        changing.push(subscriber.await.map_err(failed(input))?);
    }
    let inbox = Arc::clone(inbox);
    let history = HistoryConfig::default().detect_late_publishers().max_samples(STATIC_TRANSFORMS);
    let constant = session
        .declare_subscriber(keys.of(Input::TfStatic))
        .callback(move |sample| inbox.receive(Input::TfStatic, &sample))
        .history(history)
        .await
        .map_err(failed(Input::TfStatic))?;
    Ok(Subscribers { changing, constant })
}

/// The status as those ask for it that serve it.
fn asked(status: &Arc<StatusSource>) -> serving::AskStatus {
    let status = Arc::clone(status);
    serving::AskStatus::new(move || status.status())
}

fn tell_keys(keys: &InputKeys) {
    tracing::info!(
        "waiting for scans on {}, {} on {} or {}, static transforms on {}",
        keys.of(Input::Scan),
        if keys.motion() == Input::Pose { "poses" } else { "odometry" },
        keys.of(keys.motion()),
        keys.of(Input::Tf),
        keys.of(Input::TfStatic)
    );
}

async fn forward(mut requests: mpsc::Receiver<Request>, mailbox: Arc<Mailbox>) {
    while let Some(request) = requests.recv().await {
        mailbox.ask(request);
    }
}

/// Tells the operator when the state changes.
async fn log_changes(source: Arc<StatusSource>) {
    let mut last = None;
    loop {
        tokio::time::sleep(LOOK).await;
        let (state, detail) = source.state();
        if last.replace(state) != Some(state) {
            match state {
                State::Mapping | State::Localizing | State::Paused => {
                    tracing::info!(?state, "{detail}");
                }
                State::WaitingForScans
                | State::WaitingForOdometry
                | State::NotLocalized
                | State::Degraded => {
                    tracing::warn!(?state, "{detail}");
                }
            }
        }
    }
}
