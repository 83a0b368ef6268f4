//! For programs on the mesh that follow robots.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use thiserror::Error;
use tokio::sync::{mpsc, watch};
use tokio::task::JoinHandle;
use zenoh::Session;
use zenoh::pubsub::Subscriber;
use zenoh::query::ConsolidationMode;
use zenoh::sample::{Sample, SampleKind};

use crate::daemon::keys::{KeyError, Prefix, plain_message};
use crate::daemon::selector::Topic;
use crate::daemon::serving::ALIVE;
use crate::map::mirror::{Mirror, MirroredMap, Progress};

/// Messages that wait to be read; more are lost, and asked for.
const WAITING: usize = 256;

/// A whole map through a slow network takes its time.
const LONGEST_ANSWER: Duration = Duration::from_secs(60);

/// Why a robot cannot be followed.
#[derive(Debug, Error)]
pub enum MirrorError {
    /// It has no such keys.
    #[error(transparent)]
    Key(#[from] KeyError),
    /// Zenoh does not take a subscriber.
    #[error("cannot subscribe to {key}: {reason}")]
    Subscribe {
        /// The key.
        key: String,
        /// What Zenoh says.
        reason: String,
    },
}

/// What a mirror has, and what it knows that it lacks.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct MirrorState {
    /// The last version that was whole; without tiles before the first one.
    pub map: Arc<MirroredMap>,
    /// The newest version that was heard of; what lies between is missing. `None` before anything
    /// was heard.
    pub newest_version: Option<u64>,
    /// Whether `map` is of the newest version that was heard of.
    pub is_newest: bool,
    /// Whether the daemon is there.
    pub is_alive: bool,
    /// How often something had to be asked for, the first time included.
    pub repairs: u64,
    /// Messages that could not be read.
    pub rejected: u64,
    /// What the daemon said when it refused the last question; `None` since one was answered.
    pub last_error: Option<String>,
}

/// Follows the map of one robot: holds the last version that came as a whole, never a mixture of
/// two, and asks for what was lost on the way.
///
/// It ends when it is dropped. It needs a runtime of tokio with more than one thread.
pub struct MapMirror {
    states: watch::Receiver<MirrorState>,
    follower: JoinHandle<()>,
    _subscribers: [Subscriber<()>; 2],
}

/// The daemon's comings and goings, which are never lost as messages may be.
#[derive(Debug, Clone, Copy, Default)]
struct Life {
    is_alive: bool,
    /// How often it came.
    comings: u64,
}

impl MapMirror {
    /// Begins to follow the robot whose keys begin with `robot`.
    ///
    /// # Errors
    /// When that is no key, or Zenoh takes no subscriber.
    pub async fn follow(session: &Session, robot: &Prefix) -> Result<Self, MirrorError> {
        let (tiles, alive) = (robot.key(Topic::Tiles.name())?, robot.key(ALIVE)?);
        let failed = |key: &dyn fmt::Display| {
            let key = key.to_string();
            move |error| MirrorError::Subscribe { key, reason: plain_message(&error) }
        };
        let (sender, messages) = mpsc::channel(WAITING);
        let (life_sender, lives) = watch::channel(Life::default());
        // Zenoh's thread is never held up: what does not fit is lost, and asked for later.
        let on_message = move |sample: Sample| {
            let bytes = Bytes::from(sample.payload().to_bytes().into_owned());
            sender.try_send(bytes).ok();
        };
        let on_life = move |sample: Sample| {
            let is_alive = sample.kind() == SampleKind::Put;
            life_sender.send_modify(|life| {
                *life = Life { is_alive, comings: life.comings + u64::from(is_alive) };
            });
        };
        let subscriber = session.declare_subscriber(&tiles).callback(on_message).await;
        let subscriber = subscriber.map_err(failed(&tiles))?;
        let life = session.liveliness().declare_subscriber(&alive).history(true);
        let life = life.callback(on_life).await.map_err(failed(&alive))?;
        let (sender, states) = watch::channel(MirrorState::default());
        let follower = Follower {
            asker: Asker { session: session.clone(), key: tiles.to_string() },
            mirror: Mirror::new(),
            states: sender,
            messages,
            lives,
            comings: 0,
            repair: None,
        };
        let follower = tokio::spawn(follower.run());
        Ok(Self { states, follower, _subscribers: [subscriber, life] })
    }

    /// The last version that came as a whole.
    #[must_use]
    pub fn map(&self) -> Arc<MirroredMap> {
        self.states.borrow().map.clone()
    }

    /// What it has and lacks.
    #[must_use]
    pub fn state(&self) -> MirrorState {
        self.states.borrow().clone()
    }

    /// Tells of each change; who looks seldom sees the newest.
    #[must_use]
    pub fn states(&self) -> watch::Receiver<MirrorState> {
        self.states.clone()
    }
}

impl fmt::Debug for MapMirror {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("MapMirror").field("state", &self.state()).finish_non_exhaustive()
    }
}

impl Drop for MapMirror {
    fn drop(&mut self) {
        self.follower.abort();
    }
}

/// The task behind a mirror.
struct Follower {
    asker: Asker,
    mirror: Mirror,
    states: watch::Sender<MirrorState>,
    messages: mpsc::Receiver<Bytes>,
    lives: watch::Receiver<Life>,
    /// How often the daemon was greeted.
    comings: u64,
    /// The question that is being asked.
    repair: Option<JoinHandle<Reply>>,
}

/// What came of a question.
#[derive(Debug, Default)]
struct Reply {
    messages: Vec<Bytes>,
    /// Why there are none.
    error: Option<String>,
}

impl Follower {
    async fn run(mut self) {
        loop {
            tokio::select! {
                message = self.messages.recv() => match message {
                    Some(bytes) => self.take(&bytes),
                    None => return,
                },
                Ok(()) = self.lives.changed() => self.look_alive(),
                reply = answered(&mut self.repair) => {
                    self.repair = None;
                    self.take_reply(reply);
                }
            }
        }
    }

    fn take(&mut self, bytes: &[u8]) {
        let progress = self.mirror.take(bytes);
        if progress == Ok(Progress::Missing) && self.repair.is_none() {
            self.ask();
        }
        self.tell(|state| state.rejected += u64::from(progress.is_err()));
    }

    /// Who comes (back) may be another daemon, or have gone on meanwhile.
    fn look_alive(&mut self) {
        let Life { is_alive, comings } = *self.lives.borrow_and_update();
        if comings != self.comings {
            self.comings = comings;
            self.ask();
        }
        self.tell(|state| state.is_alive = is_alive);
    }

    fn take_reply(&mut self, Reply { messages, error }: Reply) {
        let taken = self.mirror.take_reply(&messages);
        // Newer tiles were lost while this came; otherwise the next digest is waited for.
        if taken == Ok(true) && !self.mirror.is_newest() {
            self.ask();
        }
        self.tell(|state| {
            state.rejected += u64::from(taken.is_err());
            state.last_error = error;
        });
    }

    /// Asks for what is missing. What was asked for before may be on a way that is no more.
    fn ask(&mut self) {
        let selector = format!("{}?{}", self.asker.key, self.mirror.question());
        let session = self.asker.session.clone();
        let asked = tokio::spawn(async move { answers(&session, &selector).await });
        if let Some(before) = self.repair.replace(asked) {
            before.abort();
        }
        self.tell(|state| state.repairs += 1);
    }

    fn tell(&self, change: impl FnOnce(&mut MirrorState)) {
        self.states.send_modify(|state| {
            change(state);
            state.map = self.mirror.map().clone();
            state.newest_version = self.mirror.newest_version();
            state.is_newest = self.mirror.is_newest();
        });
    }
}

impl Drop for Follower {
    fn drop(&mut self) {
        if let Some(repair) = &self.repair {
            repair.abort();
        }
    }
}

/// Where questions go.
struct Asker {
    session: Session,
    key: String,
}

/// Never, while nothing is asked.
async fn answered(repair: &mut Option<JoinHandle<Reply>>) -> Reply {
    match repair {
        Some(repair) => repair.await.unwrap_or_default(),
        None => std::future::pending().await,
    }
}

async fn answers(session: &Session, selector: &str) -> Reply {
    let query = session.get(selector).timeout(LONGEST_ANSWER);
    let mut reply = Reply::default();
    // All replies have the same key.
    let Ok(replies) = query.consolidation(ConsolidationMode::None).await else { return reply };
    while let Ok(answer) = replies.recv_async().await {
        match answer.into_result() {
            Ok(sample) => {
                reply.messages.push(Bytes::from(sample.payload().to_bytes().into_owned()));
            }
            Err(error) => {
                let words = String::from_utf8_lossy(&error.payload().to_bytes()).into_owned();
                tracing::debug!(selector, error = words, "no tiles");
                reply.error = Some(words);
            }
        }
    }
    reply
}
