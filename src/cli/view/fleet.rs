//! The robots of a mesh, each watched once for all pages that look at it.

use std::collections::BTreeMap;
use std::sync::{Arc, Weak};

use anyhow::{Context as _, anyhow};
use gmapd::daemon::keys::Prefix;
use gmapd::daemon::serving::ALIVE;
use tokio::sync::{Mutex, watch};
use zenoh::Session;
use zenoh::pubsub::Subscriber;
use zenoh::sample::{Sample, SampleKind};

use super::robot::Watched;
use crate::cli::mesh;

/// The robots that were ever alive, by name, and whether they are now.
pub(super) type Robots = BTreeMap<String, bool>;

/// Who is on the mesh.
pub(super) struct Fleet {
    session: Session,
    robots: watch::Receiver<Robots>,
    watched: Mutex<BTreeMap<String, Weak<Watched>>>,
    _life: Subscriber<()>,
}

impl Fleet {
    /// Begins to listen to who comes and goes.
    pub(super) async fn of(session: Session) -> anyhow::Result<Self> {
        let (sender, robots) = watch::channel(Robots::new());
        let on_life = move |sample: Sample| {
            if let Some(robot) = mesh::robot_of(sample.key_expr().as_str(), ALIVE) {
                let is_alive = sample.kind() == SampleKind::Put;
                sender.send_modify(|robots| {
                    robots.insert(robot.to_string(), is_alive);
                });
            }
        };
        let life = session.liveliness().declare_subscriber(format!("**/{ALIVE}")).history(true);
        let life = life.callback(on_life).await.map_err(|error| anyhow!(error));
        let life = life.context("cannot listen to who is alive")?;
        Ok(Self { session, robots, watched: Mutex::default(), _life: life })
    }

    pub(super) const fn session(&self) -> &Session {
        &self.session
    }

    pub(super) fn robots(&self) -> watch::Receiver<Robots> {
        self.robots.clone()
    }

    /// The robots that are alive.
    ///
    /// They are not asked for again: beside a subscriber to the same, Zenoh's answers to that are
    /// at times not whole.
    pub(super) fn alive(&self) -> Vec<Prefix> {
        let robots = self.robots.borrow();
        let alive = robots.iter().filter(|(_, is_alive)| **is_alive);
        alive.filter_map(|(name, _)| Prefix::parse(name).ok()).collect()
    }

    /// What is seen of a robot; it is watched as long as somebody holds this.
    pub(super) async fn watch(&self, robot: &Prefix) -> anyhow::Result<Arc<Watched>> {
        let mut watched = self.watched.lock().await;
        watched.retain(|_, watched| watched.strong_count() > 0);
        if let Some(watched) = watched.get(&robot.to_string()).and_then(Weak::upgrade) {
            return Ok(watched);
        }
        let new = Arc::new(Watched::begin(&self.session, robot).await?);
        watched.insert(robot.to_string(), Arc::downgrade(&new));
        Ok(new)
    }
}
