//! Everything that leaves the daemon: publications, answers to queries, and the sign of life.

use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use thiserror::Error;
use tokio::sync::{broadcast, mpsc, watch};
use tokio::task::{JoinSet, spawn_blocking};
use zenoh::key_expr::OwnedKeyExpr;
use zenoh::liveliness::LivelinessToken;
use zenoh::{Session, Wait as _};

use super::answers::Responder;
use super::command::Request;
use super::formats::ProductCache;
use super::keys::KeyError;
use super::ledger::Entry;
use super::limits::{Limits, Refusals};
use super::outputs;
use super::queries::Queryables;
use super::ros_node::RosNode;
use super::snapshot::Snapshot;
use super::status::Status;
use super::tiles::run_number;
use crate::clock;
use crate::config::{Config, EngineKind};

/// The key under the prefix of the token that lives as long as the daemon answers.
pub const ALIVE: &str = "slam/alive";

/// How long a stop waits for what is being sent.
const LONGEST_STOP: Duration = Duration::from_millis(300);

/// How things are served.
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
    /// The frame of the map.
    pub map_frame: String,
    /// The frame of odometry.
    pub odom_frame: String,
    /// Frame of the robot.
    pub base_frame: String,
    /// Metres a cell, for the map before there is one.
    pub resolution: f64,
    /// Between two publications of the map at least.
    pub map_update_interval: Duration,
    /// Between two sendings of map to odom; zero is off.
    pub transform_publish_period: Duration,
    /// How far ahead map to odom is dated, s; may be negative.
    pub tf_delay_s: f64,
    /// Where `slam/cmd/save` writes; it is made when it is needed.
    pub save_directory: PathBuf,
    /// What is refused.
    pub limits: Limits,
}

impl Settings {
    /// What the configuration says.
    #[must_use]
    pub fn new(config: &Config, save_directory: PathBuf) -> Self {
        let raw = &config.raw;
        Self {
            map_frame: raw.map_frame.clone(),
            odom_frame: raw.odom_frame.clone(),
            base_frame: raw.base_frame.clone(),
            resolution: raw.resolution,
            map_update_interval: duration(raw.map_update_interval),
            transform_publish_period: match raw.engine {
                EngineKind::Gmapping | EngineKind::Hector => duration(raw.transform_publish_period),
                // Whoever gives the poses tells them.
                EngineKind::KnownPoses => Duration::ZERO,
            },
            tf_delay_s: raw.tf_delay.unwrap_or(raw.transform_publish_period),
            save_directory,
            limits: Limits::new(config),
        }
    }
}

/// The configuration allows longer than a duration holds.
fn duration(seconds: f64) -> Duration {
    Duration::try_from_secs_f64(seconds).unwrap_or(Duration::MAX)
}

/// Asks how the daemon is.
#[derive(Clone)]
pub struct AskStatus(Arc<dyn Fn() -> Status + Send + Sync>);

impl AskStatus {
    /// Asks this function, on any thread.
    #[must_use]
    pub fn new(status: impl Fn() -> Status + Send + Sync + 'static) -> Self {
        Self(Arc::new(status))
    }

    /// How the daemon is now.
    #[must_use]
    pub fn status(&self) -> Status {
        (self.0)()
    }
}

impl fmt::Debug for AskStatus {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("AskStatus").finish_non_exhaustive()
    }
}

/// Where everything comes from that is served.
#[derive(Debug)]
pub struct Sources {
    /// What the filter knows.
    pub snapshots: watch::Receiver<Arc<Snapshot>>,
    /// What became of each scan.
    pub verdicts: broadcast::Receiver<Entry>,
    /// Takes commands to the filter.
    pub commands: mpsc::Sender<Request>,
    /// Tells how the daemon is.
    pub status: AskStatus,
    /// Takes what is refused.
    pub refusals: Arc<Refusals>,
}

/// Why nothing can be served.
#[derive(Debug, Error)]
pub enum ServingError {
    /// A key cannot be used.
    #[error(transparent)]
    Key(#[from] KeyError),
    /// Zenoh does not take a publisher, queryable or token.
    #[error("cannot declare {key}: {source}")]
    Declare {
        /// Its key.
        key: OwnedKeyExpr,
        /// What Zenoh says.
        source: zenoh::Error,
    },
}

/// What a robot publishes and answers, until it is stopped.
#[derive(Debug)]
pub struct Serving {
    alive: LivelinessToken,
    /// What tells ROS 2 of all this.
    announced: Vec<LivelinessToken>,
    queryables: Queryables,
    outputs: JoinSet<()>,
}

impl Serving {
    /// Declares all publishers and queryables of `node`, and at last the token of life: who sees
    /// it may ask.
    ///
    /// # Errors
    /// When Zenoh refuses a key or a declaration.
    pub async fn start(
        session: &Session,
        mut node: RosNode,
        settings: Settings,
        sources: Sources,
    ) -> Result<Self, ServingError> {
        let Sources { snapshots, verdicts, commands, status, refusals } = sources;
        let run = run_number(&session.zid().to_string(), clock::unix_nanoseconds());
        let responder =
            Arc::new(Responder::new(&settings, run, snapshots.clone(), status.clone(), commands));
        let mut declare =
            outputs::Declare { session, node: &mut node, last_put: watch::Sender::default() };
        let mut tasks = JoinSet::new();
        declare.maps(&settings, &snapshots, &responder.products(), &mut tasks).await?;
        declare.tiles(&settings, &snapshots, responder.tiles(), &mut tasks).await?;
        declare.estimates(&settings, &snapshots, &mut tasks).await?;
        tasks.spawn(keep_ready(responder.products(), snapshots.clone()));
        declare.transform(settings.clone(), snapshots.clone(), &mut tasks).await?;
        declare.diagnostics(status, &mut tasks).await?;
        let products = responder.products();
        declare.map_updates(&settings, &snapshots, products, &mut tasks).await?;
        declare.verdicts(verdicts, &mut tasks).await?;
        let limits = settings.limits.clone();
        let queryables =
            Queryables::declare(session, &mut node, responder, limits, refusals).await?;
        let announced = node.announce(session).await?;
        let key = node.prefix().key(ALIVE)?;
        let alive = session.liveliness().declare_token(key.clone()).await;
        let alive = alive.map_err(|source| ServingError::Declare { key, source })?;
        Ok(Self { alive, announced, queryables, outputs: tasks })
    }

    /// Takes the token back, answers no more queries, and publishes nothing more.
    ///
    /// It takes a moment at most: replies that have not been sent by then are not sent at all.
    pub async fn stop(self) {
        let Self { alive, announced, queryables, mut outputs } = self;
        let stop = async move {
            // It blocks while the network is slow.
            let undeclare = move || {
                for token in std::iter::once(alive).chain(announced) {
                    if let Err(error) = token.undeclare().wait() {
                        tracing::debug!(%error, "a token could not be undeclared");
                    }
                }
            };
            spawn_blocking(undeclare).await.ok();
            queryables.stop().await;
            outputs.shutdown().await;
        };
        if tokio::time::timeout(LONGEST_STOP, stop).await.is_err() {
            tracing::debug!("stopped while something was being sent");
        }
    }
}

/// Encodes each new map that will be asked for, so that whoever asks first does not wait for it.
async fn keep_ready(products: Arc<ProductCache>, mut snapshots: watch::Receiver<Arc<Snapshot>>) {
    let mut version = 0;
    while snapshots.changed().await.is_ok() {
        let newest = snapshots.borrow_and_update().map.clone();
        let Some(newest) = newest.filter(|map| map.version != version) else { continue };
        version = newest.version;
        let products = products.clone();
        spawn_blocking(move || products.make_ready(&newest)).await.ok();
    }
}
