//! Changed tiles to whoever follows the map.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use tokio::sync::watch;
use tokio::task::spawn_blocking;
use tokio::time::MissedTickBehavior;
use zenoh::Wait as _;
use zenoh::pubsub::Publisher;

use super::super::snapshot::Snapshot;
use super::{TileStore, digest};
use crate::map::tiles::Head;

/// How often it is told which version is the newest. Who has missed the last change finds it out
/// within this time.
pub const DIGEST_PERIOD: Duration = Duration::from_secs(1);

/// Publishes what each version of the map changes, and repeats which version that is.
///
/// Who asks may get a newer version than was published. The others are not told of it before its
/// tiles are: they would ask for it, each of them.
#[derive(Debug)]
pub(in super::super) struct TilesOutput {
    pub(in super::super) publisher: Arc<Publisher<'static>>,
    pub(in super::super) tiles: Arc<TileStore>,
    /// Between two versions at least.
    pub(in super::super) interval: Duration,
}

impl TilesOutput {
    pub(in super::super) async fn run(self, mut snapshots: watch::Receiver<Arc<Snapshot>>) {
        let (mut told, mut seen) = (self.tiles.first(), None);
        let mut digests = tokio::time::interval(DIGEST_PERIOD);
        digests.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let rest = tokio::time::sleep(Duration::ZERO);
        tokio::pin!(rest);
        snapshots.mark_changed();
        loop {
            tokio::select! {
                changed = snapshots.changed(), if rest.is_elapsed() => {
                    if changed.is_err() {
                        return;
                    }
                    let newest = snapshots.borrow_and_update().map.as_ref().map(|map| map.version);
                    if newest != seen {
                        seen = newest;
                        told = self.tell_changes(told).await;
                        rest.set(tokio::time::sleep(self.interval));
                        digests.reset();
                    }
                }
                () = &mut rest, if !rest.is_elapsed() => {}
                _ = digests.tick() => self.repeat(told).await,
            }
        }
    }

    /// Tells what has changed since a version; returns the one that is told now.
    async fn tell_changes(&self, told: Head) -> Head {
        let wanted = self.is_wanted().await;
        let (tiles, publisher) = (self.tiles.clone(), self.publisher.clone());
        let tell = move || {
            let (head, messages) = tiles.newest(|tiles| {
                let head = *tiles.head();
                let is_new = wanted && head.version != told.version;
                (head, if is_new { tiles.since(told.version) } else { Vec::new() })
            });
            put_all(&publisher, messages);
            head
        };
        spawn_blocking(tell).await.unwrap_or(told)
    }

    /// Says once more which version was told last.
    async fn repeat(&self, told: Head) {
        if self.is_wanted().await {
            let publisher = self.publisher.clone();
            spawn_blocking(move || put_all(&publisher, digest(told))).await.ok();
        }
    }

    async fn is_wanted(&self) -> bool {
        self.publisher.matching_status().await.is_ok_and(|status| status.matching())
    }
}

fn put_all(publisher: &Publisher<'_>, messages: Vec<Bytes>) {
    for message in messages {
        // What is lost here is asked for by whoever misses it.
        if let Err(error) = publisher.put(message).wait() {
            tracing::debug!(output = "slam/tiles", %error, "not published");
        }
    }
}
