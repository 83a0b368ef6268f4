//! What one open page is told.

use std::collections::BTreeMap;
use std::time::Duration;

use axum::extract::ws::{Message, WebSocket};
use bytes::Bytes;
use gmapd::client::{MapMirror, MirrorState};
use gmapd::daemon::keys::Prefix;
use gmapd::map::mirror::MirroredMap;
use gmapd::map::tiles::{self, TileIndex};
use serde_json::{Value, json};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::sleep;
use zenoh::Session;

use crate::cli::mesh;

/// Between questions to the robot that is looked at.
const PERIOD: Duration = Duration::from_millis(500);

/// Tells a page about a robot until it is closed.
///
/// A page that reads slowly is told the newest of everything when it reads again: nothing waits for
/// it anywhere.
pub(super) async fn talk(mut socket: WebSocket, session: Session, robot: Option<Prefix>) {
    let mirror = match &robot {
        Some(robot) => MapMirror::follow(&session, robot).await.ok(),
        None => None,
    };
    let (news, newest) = watch::channel(Value::Null);
    let (paths, path) = watch::channel(Value::Null);
    let mut tasks = JoinSet::new();
    tasks.spawn(ask(session, robot, Told { news, paths }));
    let states = mirror.as_ref().map(MapMirror::states);
    tell(&mut socket, Heard { newest, path, states }).await.ok();
}

/// Where what was heard waits for the page.
struct Heard {
    newest: watch::Receiver<Value>,
    path: watch::Receiver<Value>,
    states: Option<watch::Receiver<MirrorState>>,
}

async fn tell(socket: &mut WebSocket, mut heard: Heard) -> Result<(), axum::Error> {
    let mut sent = Sent::default();
    loop {
        tokio::select! {
            message = socket.recv() => match message {
                Some(Ok(_)) => {}
                Some(Err(error)) => return Err(error),
                None => return Ok(()),
            },
            Ok(()) = heard.newest.changed() => {
                let text = heard.newest.borrow_and_update().to_string();
                socket.send(Message::Text(text.into())).await?;
            }
            Ok(()) = heard.path.changed() => {
                let text = heard.path.borrow_and_update().to_string();
                socket.send(Message::Text(text.into())).await?;
            }
            Some(map) = changed(&mut heard.states) => {
                for message in sent.update(&map) {
                    socket.send(message).await?;
                }
            }
            else => return Ok(()),
        }
    }
}

async fn changed(
    states: &mut Option<watch::Receiver<MirrorState>>,
) -> Option<std::sync::Arc<MirroredMap>> {
    let Some(states) = states else { return std::future::pending().await };
    states.changed().await.ok()?;
    Some(states.borrow_and_update().map.clone())
}

/// The tiles that a page has.
#[derive(Default)]
struct Sent {
    version: (u64, u64),
    hashes: BTreeMap<TileIndex, u64>,
}

impl Sent {
    /// What the page lacks of a version; tiles that are no more make it begin anew.
    fn update(&mut self, map: &MirroredMap) -> Vec<Message> {
        let version = (map.run(), map.version());
        if std::mem::replace(&mut self.version, version) == version {
            return Vec::new();
        }
        let hashes: BTreeMap<_, _> = map.entries().map(|tile| (tile.index, tile.hash)).collect();
        let mut messages = Vec::new();
        if self.hashes.keys().any(|index| !hashes.contains_key(index)) {
            self.hashes.clear();
            messages.push(Message::Text(json!({ "clear": true }).to_string().into()));
        }
        let lacks = |tile: &tiles::Entry| self.hashes.get(&tile.index) != Some(&tile.hash);
        let packed = tiles::Message::pack(map.head(), map.entries().filter(lacks));
        messages.extend(packed.into_iter().map(|bytes: Bytes| Message::Binary(bytes)));
        self.hashes = hashes;
        messages
    }
}

struct Told {
    news: watch::Sender<Value>,
    paths: watch::Sender<Value>,
}

async fn ask(session: Session, robot: Option<Prefix>, told: Told) {
    let mut version = Value::Null;
    loop {
        let robots = mesh::alive(&session).await.unwrap_or_default();
        let robots: Vec<String> = robots.iter().map(Prefix::to_string).collect();
        let Some(robot) = &robot else {
            told.news.send_replace(json!({ "robots": robots }));
            sleep(PERIOD).await;
            continue;
        };
        let status = json_of(&session, robot, "slam/status").await;
        let particles = json_of(&session, robot, "particlecloud").await;
        if status["map"]["version"] != version {
            version = status["map"]["version"].clone();
            let path = json_of(&session, robot, "path").await;
            told.paths.send_replace(json!({ "path": flat(&path["poses"], "/pose/position") }));
        }
        let particles = flat(&particles["poses"], "/position");
        let news = json!({ "robots": robots, "status": status, "particles": particles });
        told.news.send_replace(news);
        sleep(PERIOD).await;
    }
}

/// `null` if nobody answers.
async fn json_of(session: &Session, robot: &Prefix, name: &str) -> Value {
    let Ok(key) = robot.key(name) else { return Value::Null };
    let answer = mesh::ask(session, key.as_str()).await.ok().flatten();
    answer.and_then(|answer| serde_json::from_slice(&answer.bytes).ok()).unwrap_or_default()
}

/// x, y, x, y ... of the points of poses.
fn flat(poses: &Value, position: &str) -> Vec<f64> {
    let points = poses.as_array().into_iter().flatten().filter_map(|pose| pose.pointer(position));
    points.flat_map(|point| ["x", "y"].map(|axis| point[axis].as_f64().unwrap_or(0.0))).collect()
}
