//! A daemon's serving part between made-up sources and real sessions on loopback.

use std::collections::BTreeMap;
use std::fmt::Debug;
use std::sync::Arc;
use std::time::Duration;

use gmapd::config::{Config, EngineKind};
use gmapd::daemon::command::Request;
use gmapd::daemon::keys::Prefix;
use gmapd::daemon::ledger::Entry;
use gmapd::daemon::limits::Limits;
use gmapd::daemon::links::LinksStatus;
use gmapd::daemon::ros_node::{Convention, RosNode};
use gmapd::daemon::serving::{AskStatus, Serving, Settings, Sources};
use gmapd::daemon::snapshot::{Estimate, MapVersion, Snapshot, State};
use gmapd::daemon::status::{FilterStatus, Status};
use gmapd::ros;
use gmapd::slam::gmapping::{GMapping, ScanReport, ScanUpdate};
use gmapd::slam::grid::occupancy::OccupiedThreshold;
use gmapd::slam::known_map::Mode;
use gmapd::slam::pose::{Point2, Pose2};
use tokio::sync::mpsc::UnboundedReceiver;
use tokio::sync::{broadcast, mpsc, watch};
use zenoh::Session;
use zenoh::sample::{Sample, SampleKind};
use zenoh_ext::{AdvancedSubscriber, AdvancedSubscriberBuilderExt as _, HistoryConfig};

use crate::support::{add, filter, full_circle, parameters, room, route, shots};

/// Nothing here takes that long; what does will never come.
pub(crate) const PATIENCE: Duration = Duration::from_secs(20);

pub(crate) const ROBOT: &str = "site/robot01";

/// A session on loopback that hears nobody else on the machine.
pub(crate) async fn open(mode: &str, connect: Option<&str>) -> Session {
    let endpoints = connect.map(|locator| format!("{locator:?}")).unwrap_or_default();
    let listen = if mode == "client" { "" } else { "\"tcp/127.0.0.1:0\"" };
    let config = format!(
        r#"{{ mode: "{mode}", listen: {{ endpoints: [{listen}] }},
             connect: {{ endpoints: [{endpoints}] }},
             scouting: {{ multicast: {{ enabled: false }}, gossip: {{ enabled: false }} }} }}"#
    );
    let config = zenoh::Config::from_json5(&config).expect("it is well-formed");
    zenoh::open(config).await.expect("loopback is there")
}

pub(crate) async fn locator(session: &Session) -> String {
    session.info().locators().await.first().expect("it listens").to_string()
}

/// What the filter knew after each of a few scans of a drive through a room.
pub(crate) fn drive() -> Vec<Snapshot> {
    let corner = Point2::new(-1.0, -2.0);
    let lidar = full_circle(180);
    let shots = shots(&room(corner), &lidar, &route(corner));
    let mut filter = filter(&parameters());
    let mut snapshots = Vec::new();
    for shot in &shots {
        if let ScanUpdate::Processed(report) = add(&mut filter, &lidar, shot) {
            let version = MapVersion {
                version: snapshots.len() as u64 + 1,
                epoch: 1,
                stamp: shot.scan.stamp,
                occupancy: filter.occupancy().clone(),
                occupied_threshold: OccupiedThreshold::of_share(0.25),
                path: filter.path(),
            };
            snapshots.push(snapshot(&filter, report, version));
        }
    }
    assert!(snapshots.len() > 10, "the robot moved");
    snapshots
}

fn snapshot(filter: &GMapping, report: ScanReport, version: MapVersion) -> Snapshot {
    let estimate = Estimate {
        stamp: Some(version.stamp),
        pose_in_map: filter.pose_in_map(),
        covariance: filter.cloud_covariance(),
        map_from_odom: filter.map_from_odom(),
        has_odometry: true,
        particles: vec![filter.pose_in_map(); filter.particles().len()].into(),
        report: Some(report),
    };
    Snapshot { estimate, map: Some(Arc::new(version)), ..Snapshot::default() }
}

fn status() -> Status {
    Status {
        version: "1.2.3",
        engine: EngineKind::Gmapping,
        links: LinksStatus::default(),
        mode: Mode::Mapping,
        uptime_s: 4.5,
        state: State::WaitingForOdometry,
        detail: "odometry is missing".to_owned(),
        pose_in_map: Pose2::IDENTITY,
        laser: None,
        scans: BTreeMap::new(),
        last_details: BTreeMap::new(),
        inputs: BTreeMap::new(),
        milliseconds_per_scan: None,
        real_time_factor: None,
        scans_waiting: 0,
        filter: FilterStatus::default(),
        map: None,
        checkpoint: None,
        refused: BTreeMap::new(),
        peak_memory_bytes: None,
        seed: 1,
    }
}

/// The serving part, a client that is connected to it, and what the filter's side holds.
pub(crate) struct Rig {
    pub(crate) daemon: Session,
    pub(crate) client: Session,
    pub(crate) snapshots: watch::Sender<Arc<Snapshot>>,
    pub(crate) verdicts: broadcast::Sender<Entry>,
    pub(crate) commands: mpsc::Receiver<Request>,
    pub(crate) serving: Serving,
    /// Where maps are saved: in `maps`, which is not there yet.
    pub(crate) directory: tempfile::TempDir,
}

impl Rig {
    /// Two peers.
    pub(crate) async fn start(first: Snapshot) -> Self {
        let daemon = open("peer", None).await;
        let client = open("peer", Some(&locator(&daemon).await)).await;
        Self::between(daemon, client, first).await
    }

    /// Serves on one session, and waits until the other knows.
    pub(crate) async fn between(daemon: Session, client: Session, first: Snapshot) -> Self {
        Self::with(daemon, client, first, |_| ()).await
    }

    /// With other settings.
    pub(crate) async fn with(
        daemon: Session,
        client: Session,
        first: Snapshot,
        change: impl FnOnce(&mut Settings),
    ) -> Self {
        let directory = tempfile::tempdir().expect("there is a place for temporary files");
        let (snapshots, watched) = watch::channel(Arc::new(first));
        let (verdicts, heard) = broadcast::channel(16);
        let (commander, commands) = mpsc::channel(16);
        let mut settings = Settings {
            map_frame: "map".to_owned(),
            odom_frame: "odom".to_owned(),
            base_frame: "base_link".to_owned(),
            resolution: 0.05,
            map_update_interval: Duration::ZERO,
            transform_publish_period: Duration::from_millis(20),
            tf_delay_s: 0.02,
            save_directory: directory.path().join("maps"),
            limits: Limits::new(&Config::load(None, &[]).expect("the defaults are allowed")),
        };
        change(&mut settings);
        let sources = Sources {
            snapshots: watched,
            verdicts: heard,
            commands: commander,
            status: AskStatus::new(status),
            refusals: Arc::default(),
        };
        let prefix = Prefix::parse(ROBOT).expect("it is a key");
        let node = RosNode::new(daemon.zid().to_string(), prefix, Convention::Bridge);
        let serving = Serving::start(&daemon, node, settings, sources).await;
        let serving = serving.expect("nothing stands against it");
        let mut alive = liveliness(&client).await;
        assert_eq!(next(&mut alive).await.kind(), SampleKind::Put);
        Self { daemon, client, snapshots, verdicts, commands, serving, directory }
    }

    pub(crate) fn show(&self, snapshot: &Snapshot) {
        self.snapshots.send_replace(Arc::new(snapshot.clone()));
    }

    pub(crate) async fn ask(&self, selector: &str) -> Result<Answer, String> {
        ask(&self.client, selector).await
    }

    /// What a message says that is asked for as CDR.
    pub(crate) async fn ask_message<M: ros::Message>(&self, selector: &str) -> M {
        let answer = self.ask(selector).await.expect(selector);
        assert_eq!(answer.encoding, format!("application/cdr;{}", M::TYPE));
        ros::decode(&answer.bytes, "").expect(selector)
    }

    /// What a message says that is the same as CDR, as JSON, and when no format is asked for.
    pub(crate) async fn ask_both<M: ros::Message + PartialEq + Debug>(&self, name: &str) -> M {
        let message: M = self.ask_message(&format!("{name}?format=cdr")).await;
        for selector in [name, &format!("{name}?format=json")] {
            let answer = self.ask(selector).await.expect(selector);
            assert_eq!(answer.encoding, format!("application/json;{}", M::TYPE));
            let same: M = ros::decode(&answer.bytes, &answer.encoding).expect(selector);
            assert_eq!(same, message, "{selector}");
        }
        message
    }

    pub(crate) async fn ask_json(&self, selector: &str) -> serde_json::Value {
        let answer = self.ask(selector).await.expect(selector);
        assert!(answer.encoding.starts_with("application/json"), "{}", answer.encoding);
        serde_json::from_slice(&answer.bytes).expect(selector)
    }

    pub(crate) async fn subscribe(&self, name: &str) -> UnboundedReceiver<Sample> {
        let (sender, receiver) = mpsc::unbounded_channel();
        self.client
            .declare_subscriber(format!("{ROBOT}/{name}"))
            .callback(move |sample| drop(sender.send(sample)))
            .background()
            .await
            .expect("it is a key");
        // The daemon's side hears of the subscription before it hears a later question.
        self.ask("slam/status").await.expect("it is answered");
        receiver
    }
}

/// The comings and goings of robots, those that are there included.
pub(crate) async fn liveliness(client: &Session) -> UnboundedReceiver<Sample> {
    let (sender, receiver) = mpsc::unbounded_channel();
    client
        .liveliness()
        .declare_subscriber("**/slam/alive")
        .history(true)
        .callback(move |sample| drop(sender.send(sample)))
        .background()
        .await
        .expect("it is a key");
    receiver
}

pub(crate) async fn next<T>(receiver: &mut UnboundedReceiver<T>) -> T {
    let next = tokio::time::timeout(PATIENCE, receiver.recv()).await;
    next.expect("it comes in time").expect("the sender lives")
}

pub(crate) fn message<M: ros::Message>(sample: &Sample) -> M {
    assert_eq!(sample.encoding().to_string(), format!("application/cdr;{}", M::TYPE));
    ros::decode(&sample.payload().to_bytes(), "").expect(M::TYPE)
}

/// What RViz and nav2 are behind a bridge.
pub(crate) async fn late_joiner(
    session: &Session,
    name: &str,
) -> (AdvancedSubscriber<()>, UnboundedReceiver<Sample>) {
    let (sender, receiver) = mpsc::unbounded_channel();
    let subscriber = session
        .declare_subscriber(format!("{ROBOT}/{name}"))
        .history(HistoryConfig::default().detect_late_publishers().max_samples(1))
        .callback(move |sample| drop(sender.send(sample)))
        .await;
    (subscriber.expect("it is a key"), receiver)
}

/// Ends subscriptions to the map, and waits until the daemon knows that nobody is left.
pub(crate) async fn leave(rig: &Rig, subscribers: Vec<AdvancedSubscriber<()>>) {
    let publisher = rig.daemon.declare_publisher(format!("{ROBOT}/map")).await;
    let publisher = publisher.expect("it is a key");
    let matching = publisher.matching_listener().await.expect("it is declared");
    for subscriber in subscribers {
        subscriber.undeclare().await.expect("it is declared");
    }
    while publisher.matching_status().await.expect("it is declared").matching() {
        let change = tokio::time::timeout(PATIENCE, matching.recv_async()).await;
        change.expect("it comes in time").expect("the publisher lives");
    }
}

/// A reply.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Answer {
    pub(crate) key: String,
    pub(crate) bytes: Vec<u8>,
    pub(crate) encoding: String,
    pub(crate) attachment: Option<serde_json::Value>,
}

/// Asks for something under the robot's prefix that gives exactly one reply.
pub(crate) async fn ask(client: &Session, selector: &str) -> Result<Answer, String> {
    let mut answers = ask_all(client, &format!("{ROBOT}/{selector}")).await;
    assert_eq!(answers.len(), 1, "{selector}: {answers:?}");
    answers.remove(0)
}

pub(crate) async fn ask_all(client: &Session, selector: &str) -> Vec<Result<Answer, String>> {
    let replies = client.get(selector).timeout(PATIENCE).await.expect("it is a selector");
    let mut answers = Vec::new();
    while let Ok(reply) = replies.recv_async().await {
        answers.push(match reply.into_result() {
            Ok(sample) => Ok(Answer {
                key: sample.key_expr().to_string(),
                bytes: sample.payload().to_bytes().into_owned(),
                encoding: sample.encoding().to_string(),
                attachment: sample.attachment().map(|attachment| {
                    serde_json::from_slice(&attachment.to_bytes()).expect("it is JSON")
                }),
            }),
            Err(error) => {
                assert_eq!(error.encoding().to_string(), "text/plain");
                Err(error.payload().try_to_string().expect("it is text").into_owned())
            }
        });
    }
    answers
}
