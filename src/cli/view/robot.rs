//! What is seen of one robot.

use std::collections::BTreeMap;
use std::time::Duration;

use anyhow::{Context as _, anyhow};
use axum::extract::ws::Utf8Bytes;
use gmapd::client::MapMirror;
use gmapd::convert;
use gmapd::daemon::keys::Prefix;
use gmapd::ros;
use gmapd::ros::graph::POSE_WITH_COVARIANCE_STAMPED;
use gmapd::ros::graph::rmw_zenoh::{Graph, TypeHashes};
use gmapd::slam::pose::{Point2, Pose2};
use gmapd::slam::scan::{Beam, LaserMount, Scan};
use gmapd::timeline::{Missing, Timeline};
use serde_json::{Value, json};
use tokio::sync::{mpsc, watch};
use tokio::task::JoinSet;
use tokio::time::{MissedTickBehavior, interval};
use zenoh::Session;
use zenoh::pubsub::Subscriber;
use zenoh::sample::Sample;

use crate::cli::mesh;

/// Between questions for the status.
const STATUS_PERIOD: Duration = Duration::from_millis(500);

/// Between two scans that are shown. A scan waits as long for the pose that it leads to.
const SCAN_PERIOD: Duration = Duration::from_millis(100);

/// A path is asked for after this many statuses, and one more for each so many of its poses: the
/// longer it is, the less a page sees of what is new in it.
const PATH_STATUSES: usize = 4;
const POSES_A_STATUS: usize = 500;

/// More beams than this make no clearer picture.
const MOST_POINTS: usize = 720;

/// Of the poses that scans are placed by; a log may be played much faster than it was recorded.
const KEPT_POSES: (Duration, usize) = (Duration::from_secs(60), 1024);

/// Poses and scans that wait to be read; more are lost.
const WAITING: usize = 256;

/// The newest of each kind, as the pages are told it: a message is an object with the kind's name.
pub(super) type Scene = BTreeMap<&'static str, Utf8Bytes>;

/// One robot, watched until this is dropped.
pub(super) struct Watched {
    pub(super) mirror: MapMirror,
    pub(super) scene: watch::Receiver<Scene>,
    _tasks: JoinSet<()>,
}

impl Watched {
    pub(super) async fn begin(session: &Session, robot: &Prefix) -> anyhow::Result<Self> {
        let mirror = MapMirror::follow(session, robot).await?;
        let (sender, scene) = watch::channel(Scene::new());
        let (laser, lasers) = watch::channel(None);
        let mut tasks = JoinSet::new();
        let asker = Asker {
            session: session.clone(),
            robot: robot.clone(),
            scene: sender.clone(),
            laser,
            particles: Value::Null,
            path: PathAsked::default(),
        };
        tasks.spawn(asker.run());
        let (session, robot) = (session.clone(), robot.clone());
        tasks.spawn(async move {
            if let Err(error) = place_scans(&session, &robot, (sender, lasers)).await {
                tracing::warn!("scans of {} are not shown: {error:#}", mesh::name(&robot));
            }
        });
        Ok(Self { mirror, scene, _tasks: tasks })
    }
}

fn tell(scene: &watch::Sender<Scene>, kind: &'static str, value: &Value) {
    let text = Utf8Bytes::from(json!({ kind: value }).to_string());
    scene.send_if_modified(|scene| scene.insert(kind, text.clone()).as_ref() != Some(&text));
}

/// Where scans come from, and how the laser sits.
#[derive(Debug, Clone, PartialEq)]
struct Laser {
    key: String,
    mount: LaserMount,
}

/// Asks the robot's daemon, one question after the other.
struct Asker {
    session: Session,
    robot: Prefix,
    scene: watch::Sender<Scene>,
    laser: watch::Sender<Option<Laser>>,
    /// Processed scans and pose when the particles were asked for.
    particles: Value,
    path: PathAsked,
}

/// When the path was asked for last.
#[derive(Default)]
struct PathAsked {
    /// Scans in the map and its version then.
    map: Value,
    /// Statuses since then.
    statuses: usize,
    poses: usize,
}

impl Asker {
    async fn run(mut self) {
        let mut ticks = interval(STATUS_PERIOD);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            ticks.tick().await;
            self.ask().await;
        }
    }

    async fn ask(&mut self) {
        let status = self.bytes_of("slam/status").await;
        let status: Value =
            status.and_then(|bytes| serde_json::from_slice(&bytes).ok()).unwrap_or_default();
        tell(&self.scene, "status", &status);
        if status.is_null() {
            return;
        }
        let laser = laser_of(&status);
        self.laser.send_if_modified(|old| std::mem::replace(old, laser.clone()) != laser);
        let particles = json!([status["scans"]["processed"], status["pose_in_map"]]);
        if particles != self.particles {
            self.particles = particles;
            self.ask_particles().await;
        }
        self.path.statuses += 1;
        let is_time = self.path.statuses >= PATH_STATUSES + self.path.poses / POSES_A_STATUS;
        let map = json!([status["map"]["scans"], status["map"]["version"]]);
        if map != self.path.map && (is_time || self.path.poses == 0) {
            self.ask_path().await;
            self.path = PathAsked { map, statuses: 0, ..self.path };
        }
    }

    async fn ask_particles(&self) {
        let Some(bytes) = self.bytes_of("particlecloud?format=cdr").await else { return };
        let Ok(cloud) = ros::decode::<ros::PoseArray>(&bytes, "") else { return };
        let points = cloud.poses.iter().map(|pose| (pose.position.x, pose.position.y));
        tell(&self.scene, "particles", &flat(points));
    }

    async fn ask_path(&mut self) {
        let Some(bytes) = self.bytes_of("path?format=cdr").await else { return };
        let Ok(path) = ros::decode::<ros::Path>(&bytes, "") else { return };
        self.path.poses = path.poses.len();
        let points = path.poses.iter().map(|pose| pose.pose.position);
        tell(&self.scene, "path", &flat(points.map(|point| (point.x, point.y))));
    }

    /// `None` if nobody answers.
    async fn bytes_of(&self, name: &str) -> Option<Vec<u8>> {
        let (name, parameters) = name.split_once('?').unwrap_or((name, ""));
        let key = self.robot.key(name).ok()?;
        let answer = mesh::ask(&self.session, &format!("{key}?{parameters}")).await;
        answer.ok().flatten().map(|answer| answer.bytes)
    }
}

/// `None` before the first scan, and with daemons that do not tell.
fn laser_of(status: &Value) -> Option<Laser> {
    let key = status["inputs"]["scan"]["key"].as_str()?.to_owned();
    let mount = serde_json::from_value(status["laser"].clone()).ok()?;
    Some(Laser { key, mount })
}

/// x, y, x, y ... in metres, to the centimetre.
fn flat(points: impl Iterator<Item = (f64, f64)>) -> Value {
    let centimetres = |metres: f64| (metres * 100.0).round() / 100.0;
    points.flat_map(|(x, y)| [x, y].map(centimetres)).collect()
}

/// What a robot sends without being asked.
enum Heard {
    Pose(Sample),
    Scan(Sample),
}

/// Shows pose and scan as soon as the daemon tells how the laser sits, for as long as it exists.
async fn place_scans(
    session: &Session,
    robot: &Prefix,
    (scene, mut lasers): (watch::Sender<Scene>, watch::Receiver<Option<Laser>>),
) -> anyhow::Result<()> {
    loop {
        let laser = lasers.borrow_and_update().clone();
        let Some(laser) = laser else {
            if lasers.changed().await.is_err() {
                return Ok(());
            }
            continue;
        };
        let (sender, heard) = mpsc::channel(WAITING);
        let _subscribers = subscribe(session, robot, (&laser, sender)).await?;
        let placer = Placer {
            scene: scene.clone(),
            mount: laser.mount,
            poses: Timeline::new(KEPT_POSES.0, KEPT_POSES.1),
            pose: None,
            newest: None,
            waiting: None,
        };
        tokio::select! {
            changed = lasers.changed() => if changed.is_err() { return Ok(()) },
            () = placer.run(heard) => return Ok(()),
        }
    }
}

async fn subscribe(
    session: &Session,
    robot: &Prefix,
    (laser, sender): (&Laser, mpsc::Sender<Heard>),
) -> anyhow::Result<[Subscriber<()>; 2]> {
    let poses = match Graph::name_in(&laser.key) {
        // Who reads scans by ROS 2's own convention publishes by it.
        Some((domain, _)) => {
            let graph = Graph { domain, hashes: TypeHashes::Known };
            let name = robot.key("pose")?;
            graph.subscription_key(&name, POSE_WITH_COVARIANCE_STAMPED)
        }
        None => robot.key("pose")?.to_string(),
    };
    let pose_sender = sender.clone();
    let on_pose = move |sample| {
        pose_sender.try_send(Heard::Pose(sample)).ok();
    };
    let on_scan = move |sample| {
        sender.try_send(Heard::Scan(sample)).ok();
    };
    let failed = |error| anyhow!("{error}");
    let poses = session.declare_subscriber(poses).callback(on_pose).await.map_err(failed);
    let scans = session.declare_subscriber(&laser.key).callback(on_scan).await.map_err(failed);
    Ok([poses.context("cannot subscribe to poses")?, scans.context("cannot subscribe to scans")?])
}

/// Puts scans where the robot was.
struct Placer {
    scene: watch::Sender<Scene>,
    mount: LaserMount,
    poses: Timeline<Pose2>,
    pose: Option<Pose2>,
    /// The scan that came last.
    newest: Option<Sample>,
    /// A scan whose pose is on its way.
    waiting: Option<Sample>,
}

impl Placer {
    async fn run(mut self, mut heard: mpsc::Receiver<Heard>) {
        let mut ticks = interval(SCAN_PERIOD);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                heard = heard.recv() => match heard {
                    Some(Heard::Pose(sample)) => self.add_pose(&sample),
                    Some(Heard::Scan(sample)) => self.newest = Some(sample),
                    None => return,
                },
                _ = ticks.tick() => self.show(),
            }
        }
    }

    fn add_pose(&mut self, sample: &Sample) {
        let Some(message) = decode::<ros::PoseWithCovarianceStamped>(sample) else { return };
        let stamped = ros::PoseStamped { header: message.header, pose: message.pose.pose };
        if let Ok(pose) = convert::stamped_pose(stamped) {
            self.poses.insert(pose.stamp, pose.frame_from_base);
            self.pose = Some(pose.frame_from_base);
        }
    }

    fn show(&mut self) {
        if let Some(pose) = self.pose {
            tell(&self.scene, "pose", &json!(pose));
        }
        if let Some(scan) = std::mem::replace(&mut self.waiting, self.newest.take())
            && let Some(points) = self.placed(&scan)
        {
            tell(&self.scene, "scan", &points);
        }
    }

    fn placed(&self, sample: &Sample) -> Option<Value> {
        let scan = convert::scan(decode::<ros::LaserScan>(sample)?).ok()?;
        let map_from_base = match self.poses.at(scan.stamp) {
            Ok(pose) => pose,
            // A robot that stands tells no new poses.
            Err(Missing::TooNew(_)) => self.pose?,
            Err(Missing::Empty | Missing::TooOld(_)) => return None,
        };
        let points = hits(&scan, &self.mount).map(|point| map_from_base * point);
        Some(flat(points.map(|point| (point.x, point.y))))
    }
}

fn hits<'a>(scan: &'a Scan, mount: &'a LaserMount) -> impl Iterator<Item = Point2> + 'a {
    let step = scan.ranges.len().div_ceil(MOST_POINTS).max(1);
    let beams = scan.ranges.iter().enumerate().step_by(step);
    beams.filter_map(move |(index, &range)| match scan.geometry.classify(range) {
        Beam::Hit(range) => Some(scan.point_in_base(mount, index, range)),
        Beam::NoReturn | Beam::Invalid => None,
    })
}

fn decode<M: ros::Message>(sample: &Sample) -> Option<M> {
    ros::decode(&sample.payload().to_bytes(), &sample.encoding().to_string()).ok()
}
