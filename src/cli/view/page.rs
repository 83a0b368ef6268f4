//! What one open page is told.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use axum::body::Bytes;
use axum::extract::ws::{Message, WebSocket};
use gmapd::client::MirrorState;
use gmapd::daemon::keys::Prefix;
use gmapd::map::mirror::MirroredMap;
use gmapd::map::tiles::{self, TileIndex};
use serde_json::{Value, json};
use tokio::sync::watch;
use tokio::time::{MissedTickBehavior, interval, timeout};

use super::fleet::{Fleet, Robots};
use super::robot::Scene;

/// A page that takes nothing for so long is gone, and opens the socket anew if it is not.
const PATIENCE: Duration = Duration::from_secs(30);

/// Between pings. A phone that is out of reach says nothing, and its socket stays open.
const PING_PERIOD: Duration = Duration::from_secs(20);

/// So many pings without a sign of life, and the page is gone.
const MOST_UNANSWERED: u32 = 2;

/// Tells a page who is there, and about a robot, until it is closed.
///
/// A page that reads slowly is told the newest of everything when it reads again: nothing waits for
/// it anywhere.
pub(super) async fn talk(mut socket: WebSocket, fleet: Arc<Fleet>, robot: Option<Prefix>) {
    let watched = match &robot {
        Some(robot) => match fleet.watch(robot).await {
            Ok(watched) => Some(watched),
            Err(error) => {
                tracing::warn!("{robot} cannot be watched: {error:#}");
                return;
            }
        },
        None => None,
    };
    let heard = Heard {
        robots: fleet.robots(),
        scene: watched.as_ref().map(|watched| watched.scene.clone()),
        map: watched.as_ref().map(|watched| watched.mirror.states()),
    };
    // What is there already is news to this page.
    tell(&mut socket, heard.all_new()).await.ok();
}

/// Where what was heard waits for the page.
struct Heard {
    robots: watch::Receiver<Robots>,
    scene: Option<watch::Receiver<Scene>>,
    map: Option<watch::Receiver<MirrorState>>,
}

impl Heard {
    fn all_new(mut self) -> Self {
        self.robots.mark_changed();
        self.scene.iter_mut().for_each(watch::Receiver::mark_changed);
        self.map.iter_mut().for_each(watch::Receiver::mark_changed);
        self
    }
}

/// The page is gone, or as good as gone.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Gone;

/// Whether a page answers.
#[derive(Debug, Default)]
struct Pulse {
    unanswered: u32,
}

impl Pulse {
    fn ping(&mut self) -> Result<Message, Gone> {
        if self.unanswered == MOST_UNANSWERED {
            return Err(Gone);
        }
        self.unanswered += 1;
        Ok(Message::Ping(Bytes::new()))
    }
}

async fn tell(socket: &mut WebSocket, mut heard: Heard) -> Result<(), Gone> {
    let mut sent = Sent::default();
    let mut pulse = Pulse::default();
    let mut pings = interval(PING_PERIOD);
    pings.reset();
    pings.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        let messages = tokio::select! {
            // What the page has answered is read before it is missed.
            biased;
            message = socket.recv() => match message {
                Some(Ok(_)) => {
                    pulse = Pulse::default();
                    Vec::new()
                }
                Some(Err(_)) | None => return Err(Gone),
            },
            _ = pings.tick() => vec![pulse.ping()?],
            Ok(()) = heard.robots.changed() => {
                vec![text(&robots(&heard.robots.borrow_and_update()))]
            }
            Some(scene) = newest(&mut heard.scene) => sent.scene(scene),
            Some(state) = newest(&mut heard.map) => sent.map(&state.map),
            else => return Ok(()),
        };
        for message in messages {
            let Ok(Ok(())) = timeout(PATIENCE, socket.send(message)).await else {
                return Err(Gone);
            };
        }
    }
}

/// Never, if there is none.
async fn newest<T: Clone>(receiver: &mut Option<watch::Receiver<T>>) -> Option<T> {
    let Some(receiver) = receiver else { return std::future::pending().await };
    receiver.changed().await.ok()?;
    Some(receiver.borrow_and_update().clone())
}

fn robots(robots: &Robots) -> Value {
    let robot = |(name, is_alive)| json!({ "name": name, "is_alive": is_alive });
    json!({ "robots": robots.iter().map(robot).collect::<Vec<_>>() })
}

fn text(value: &Value) -> Message {
    Message::Text(value.to_string().into())
}

/// What a page has.
#[derive(Default)]
struct Sent {
    scene: Scene,
    /// Run and version of the map.
    version: (u64, u64),
    tiles: BTreeMap<TileIndex, u64>,
}

impl Sent {
    fn scene(&mut self, scene: Scene) -> Vec<Message> {
        let news = scene.iter().filter(|(kind, text)| self.scene.get(*kind) != Some(text));
        let messages = news.map(|(_, text)| Message::Text(text.clone())).collect();
        self.scene = scene;
        messages
    }

    /// What the page lacks of a version; tiles that are no more make it begin anew.
    fn map(&mut self, map: &MirroredMap) -> Vec<Message> {
        let version = (map.run(), map.version());
        if std::mem::replace(&mut self.version, version) == version {
            return Vec::new();
        }
        let tiles: BTreeMap<_, _> = map.entries().map(|tile| (tile.index, tile.hash)).collect();
        let mut messages = Vec::new();
        if self.tiles.keys().any(|index| !tiles.contains_key(index)) {
            self.tiles.clear();
            messages.push(text(&json!({ "clear": true })));
        }
        let lacks = |tile: &tiles::Entry| self.tiles.get(&tile.index) != Some(&tile.hash);
        let packed = tiles::Message::pack(map.head(), map.entries().filter(lacks));
        messages.extend(packed.into_iter().map(Message::Binary));
        self.tiles = tiles;
        messages
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_that_answers_no_ping_is_gone() {
        let mut pulse = Pulse::default();
        let ping = Ok(Message::Ping(Bytes::new()));
        assert_eq!([pulse.ping(), pulse.ping(), pulse.ping()], [ping.clone(), ping, Err(Gone)]);
    }
}
