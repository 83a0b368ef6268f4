//! The daemon over real Zenoh on the loopback: what goes in, and the snapshot that comes out.
#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::io::{BufRead as _, BufReader};
use std::process::{Child, Command as Process, Stdio};
use std::sync::Arc;
use std::time::Duration;

use byteorder::BigEndian;
use gmapd::config::Config;
use gmapd::convert;
use gmapd::daemon::command::{Command, Done, Request};
use gmapd::daemon::keys::Prefix;
use gmapd::daemon::ledger::{Entry, Verdict};
use gmapd::daemon::snapshot::{Snapshot, State};
use gmapd::daemon::{self, Daemon, Settings};
use gmapd::logs::Reading;
use gmapd::map;
use gmapd::replay::Replay;
use gmapd::ros::{self, Message};
use gmapd::sim::{Place, Scenario, Simulation};
use gmapd::slam::deskew::Velocity;
use gmapd::slam::gmapping::{GMapping, ScanReading};
use gmapd::slam::grid::occupancy::OccupancyGrid;
use gmapd::slam::known_map::Mode;
use gmapd::slam::path::Path;
use gmapd::slam::pose::{Pose2, Stamp};
use gmapd::slam::scan::{LaserMount, Scan};
use tokio::sync::{broadcast, oneshot};
use zenoh::Session;
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;
use zenoh_ext::{AdvancedPublisherBuilderExt as _, CacheConfig, MissDetectionConfig};

/// How long anything may take on a machine that does other things as well.
const PATIENCE: Duration = Duration::from_secs(60);

const ROBOT: &str = "robot01";

/// Where the laser of the tests sits on the base.
const BASE_FROM_LASER: Pose2 = Pose2::new(0.2, -0.05, 0.1);

/// How messages are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Wire {
    LittleEndian,
    BigEndian,
    Json,
}

impl Wire {
    fn bytes<M: Message>(self, message: &M) -> Vec<u8> {
        match self {
            Self::LittleEndian => ros::cdr(message),
            Self::Json => ros::json(message),
            Self::BigEndian => {
                let mut bytes = vec![0, 0, 0, 0];
                cdr_encoding::to_writer::<M, BigEndian, _>(&mut bytes, message).unwrap();
                bytes
            }
        }
    }

    /// Bridges set no encoding.
    const fn encoding(self) -> &'static str {
        match self {
            Self::LittleEndian => "zenoh/bytes",
            Self::BigEndian => "application/cdr",
            Self::Json => "application/json",
        }
    }
}

/// A scan with the odometry at its stamp, as messages.
#[derive(Debug, Clone)]
struct Moment {
    scan: ros::LaserScan,
    odometry: ros::Odometry,
}

impl Moment {
    fn scan(&self) -> Scan {
        convert::scan(self.scan.clone()).unwrap()
    }

    fn odom_from_base(&self) -> Pose2 {
        convert::odometry(self.odometry.clone()).unwrap().odom_from_base
    }

    fn transform(&self) -> ros::TfMessage {
        let pose = &self.odometry.pose.pose;
        let ros::Point { x, y, z } = pose.position;
        let transform =
            ros::Transform { translation: ros::Vector3 { x, y, z }, rotation: pose.orientation };
        let header = self.odometry.header.clone();
        let child_frame_id = "base_link".to_owned();
        let transform = ros::TransformStamped { header, child_frame_id, transform };
        ros::TfMessage { transforms: vec![transform] }
    }
}

/// The first moments of a drive through a building.
fn drive(moments: usize) -> Vec<Moment> {
    drive_in(Place::Building, moments)
}

fn drive_in(place: Place, moments: usize) -> Vec<Moment> {
    let scenario = Scenario { beams: 120, ..Scenario::new(place, 3) };
    let mut simulation = Simulation::new(&scenario).unwrap();
    simulation.lidar.mount = mount();
    simulation
        .readings()
        .take(moments)
        .map(|reading| Moment {
            scan: scan_message(&reading.scan),
            odometry: odometry_message(reading.stamp, reading.odom_from_base),
        })
        .collect()
}

fn scan_message(scan: &Scan) -> ros::LaserScan {
    let geometry = scan.geometry;
    ros::LaserScan {
        header: convert::header(scan.stamp, "laser"),
        angle_min: geometry.angle(0) as f32,
        angle_max: geometry.angle(scan.ranges.len() - 1) as f32,
        angle_increment: geometry.angle_increment() as f32,
        range_min: 0.05,
        range_max: geometry.range_max() as f32,
        ranges: scan.ranges.clone(),
        ..ros::LaserScan::default()
    }
}

fn odometry_message(stamp: Stamp, odom_from_base: Pose2) -> ros::Odometry {
    let pose = convert::pose(odom_from_base);
    ros::Odometry {
        header: convert::header(stamp, "odom"),
        child_frame_id: "base_link".to_owned(),
        pose: ros::PoseWithCovariance { pose, ..ros::PoseWithCovariance::default() },
        ..ros::Odometry::default()
    }
}

fn mount_message(base_from_laser: Pose2) -> ros::TfMessage {
    let header = convert::header(Stamp(0), "base_link");
    ros::TfMessage {
        transforms: vec![convert::transform_stamped(header, "laser", base_from_laser)],
    }
}

fn mount() -> LaserMount {
    let transform = mount_message(BASE_FROM_LASER).transforms.remove(0);
    convert::laser_mount(&convert::transform(transform).unwrap().parent_from_child).unwrap()
}

fn settings(overrides: &[&str]) -> Settings {
    let mut set = vec!["particles=6".to_owned(), "linearUpdate=0.4".to_owned()];
    set.extend(overrides.iter().map(|&text| text.to_owned()));
    let config = Config::load(None, &set).unwrap();
    Settings { config, prefix: Prefix::parse(ROBOT).unwrap(), threads: 1 }
}

fn config(mode: &str, endpoints: &str) -> zenoh::Config {
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", format!("{mode:?}")),
        (endpoints, "[]".to_owned()),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "false".to_owned()),
    ] {
        config.insert_json5(key, &value).unwrap();
    }
    config
}

/// A session that listens on a port of the loopback, and the port.
async fn listening() -> (Session, String) {
    let mut config = config("peer", "connect/endpoints");
    config.insert_json5("listen/endpoints", r#"["tcp/127.0.0.1:0"]"#).unwrap();
    let session = zenoh::open(config).await.unwrap();
    let locator = session.info().locators().await[0].to_string();
    (session, locator)
}

async fn connected(locator: &str) -> Session {
    let mut config = config("client", "listen/endpoints");
    config.insert_json5("connect/endpoints", &format!("[{locator:?}]")).unwrap();
    zenoh::open(config).await.unwrap()
}

/// A robot that feeds a daemon.
struct Robot {
    wire: Wire,
    scan: Publisher<'static>,
    odom: Publisher<'static>,
    tf: Publisher<'static>,
    tf_static: Publisher<'static>,
}

impl Robot {
    /// Ready when the daemon listens, to odometry or poses on the key `motion`.
    async fn start(session: &Session, wire: Wire, motion: &str) -> Self {
        let publisher = async |name: &str| {
            let publisher = session.declare_publisher(format!("{ROBOT}/{name}"));
            let publisher = publisher.congestion_control(CongestionControl::Block).await.unwrap();
            matched(&publisher).await;
            publisher
        };
        Self {
            wire,
            scan: publisher("scan").await,
            odom: publisher(motion).await,
            tf: publisher("tf").await,
            tf_static: publisher("tf_static").await,
        }
    }

    async fn put<M: Message>(&self, publisher: &Publisher<'static>, message: &M) {
        let put = publisher.put(self.wire.bytes(message)).encoding(self.wire.encoding());
        put.await.unwrap();
    }

    async fn scan(&self, moment: &Moment) {
        self.put(&self.scan, &moment.scan).await;
    }

    async fn odometry(&self, moment: &Moment) {
        self.put(&self.odom, &moment.odometry).await;
    }

    async fn mount(&self, base_from_laser: Pose2) {
        self.put(&self.tf_static, &mount_message(base_from_laser)).await;
    }
}

async fn matched(publisher: &Publisher<'static>) {
    let listener = publisher.matching_listener().await.unwrap();
    while !publisher.matching_status().await.unwrap().matching() {
        tokio::time::timeout(PATIENCE, listener.recv_async())
            .await
            .expect("nobody listens")
            .unwrap();
    }
}

/// A daemon and a robot that share a link.
struct Rig {
    daemon: Daemon,
    verdicts: broadcast::Receiver<Entry>,
    robot: Robot,
    /// The link lives as long as they do.
    sessions: [Session; 2],
}

impl Rig {
    async fn start(settings: Settings, wire: Wire) -> Self {
        let (session, locator) = listening().await;
        let far = connected(&locator).await;
        let motion = if settings.config.takes_pose_messages() { "amcl_pose" } else { "odom" };
        let daemon = Daemon::start(&session, settings).await.unwrap();
        let verdicts = daemon.verdicts();
        let robot = Robot::start(&far, wire, motion).await;
        Self { daemon, verdicts, robot, sessions: [session, far] }
    }

    async fn mounted(overrides: &[&str]) -> Self {
        let rig = Self::start(settings(overrides), Wire::LittleEndian).await;
        rig.robot.mount(BASE_FROM_LASER).await;
        rig
    }

    async fn feed(&self, moment: &Moment) {
        self.robot.odometry(moment).await;
        self.robot.scan(moment).await;
    }

    async fn verdict(&mut self) -> Entry {
        tokio::time::timeout(PATIENCE, self.verdicts.recv()).await.expect("no verdict").unwrap()
    }

    async fn verdicts(&mut self, count: usize) -> Vec<Verdict> {
        let mut verdicts = Vec::new();
        for _ in 0..count {
            verdicts.push(self.verdict().await.verdict);
        }
        verdicts
    }

    async fn command(&self, command: Command) -> Done {
        let (reply, answer) = oneshot::channel();
        self.daemon.commands().send(Request { command, reply }).await.unwrap();
        tokio::time::timeout(PATIENCE, answer).await.expect("no answer").unwrap()
    }

    async fn end(self) -> Arc<Snapshot> {
        let snapshot = self.daemon.stop().await;
        for session in self.sessions {
            session.close().await.unwrap();
        }
        snapshot
    }
}

fn grid(snapshot: &Snapshot) -> Option<OccupancyGrid> {
    let map = snapshot.map.as_ref()?;
    map.occupancy.to_grid(map.occupied_threshold)
}

fn path(snapshot: &Snapshot) -> Path {
    snapshot.map.as_ref().map(|map| map.path.clone()).unwrap_or_default()
}

/// What `gmapd replay` makes of the moments: its map, and the filter's path.
fn replayed(settings: &Settings, moments: &[Moment]) -> (Option<OccupancyGrid>, Path) {
    let config = &settings.config;
    let mut replay = Replay::new(config, 1).unwrap();
    let mut filter = GMapping::new(config.parameters(), config.raw.seed, 1).unwrap();
    let mount = mount();
    for moment in moments {
        let (scan, odom_from_base) = (moment.scan(), moment.odom_from_base());
        filter.add_odometry(odom_from_base);
        let reading = ScanReading { scan: &scan, mount: &mount, odom_from_base };
        filter.add_scan(&reading, &mut |_| ());
        let stamp = scan.stamp;
        replay.add(&Reading { line: 1, stamp, odom_from_base, scan: Some(scan), mount });
    }
    (replay.finish().map, filter.path())
}

#[tokio::test(flavor = "multi_thread")]
async fn the_map_is_that_of_a_replay_however_messages_are_written() {
    let moments = drive(120);
    let (map, way) = replayed(&settings(&[]), &moments);
    assert!(way.len() > 10, "{} scans are mapped", way.len());
    for wire in [Wire::LittleEndian, Wire::BigEndian, Wire::Json] {
        let mut rig = Rig::start(settings(&[]), wire).await;
        rig.robot.mount(BASE_FROM_LASER).await;
        for moment in &moments {
            rig.feed(moment).await;
            // One at a time, so that none is dropped.
            rig.verdict().await;
        }
        let snapshot = rig.end().await;
        assert_eq!(path(&snapshot), way, "{wire:?}");
        assert_eq!(grid(&snapshot), map, "{wire:?}");
        assert_eq!(snapshot.ledger.count(Verdict::Processed), way.len() as u64);
    }
}

/// What `gmapd replay` makes of the moments along their odometry as poses in the map, with the
/// motion during each sweep that `motion` tells.
fn along(
    moments: &[Moment],
    motion: impl Fn(usize) -> Option<Pose2>,
) -> (Option<OccupancyGrid>, Path) {
    let mut replay = Replay::new(&settings(&["engine=known_poses"]).config, 1).unwrap();
    for (index, moment) in moments.iter().enumerate() {
        let (mut scan, odom_from_base) = (moment.scan(), moment.odom_from_base());
        let Some(motion) = motion(index) else { continue };
        let increment = SWEEP_S / (scan.ranges.len() - 1) as f64;
        let timed = scan.geometry.with_time_increment(increment);
        scan.geometry = timed.with_velocity(Velocity::of_motion(motion, SWEEP_S));
        let (stamp, mount) = (scan.stamp, mount());
        let scan = Some(scan);
        replay.add_received(&Reading { line: 1, stamp, odom_from_base, scan, mount });
    }
    let outcome = replay.finish();
    (outcome.map, outcome.path)
}

fn at_once(_: usize) -> Option<Pose2> {
    Some(Pose2::IDENTITY)
}

/// The time between two moments.
const SWEEP_S: f64 = 0.1;

impl Moment {
    fn pose_in(&self, frame: &str) -> ros::PoseStamped {
        let header = ros::Header { frame_id: frame.to_owned(), ..self.odometry.header.clone() };
        ros::PoseStamped { header, pose: self.odometry.pose.pose }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn given_poses_as_messages_or_transforms_give_the_same_map() {
    #[derive(Debug, Clone, Copy, PartialEq)]
    enum Form {
        Stamped,
        WithCovariance,
        Transform,
    }
    let moments = drive(40);
    let (map, way) = along(&moments, at_once);
    assert_eq!(way.len(), 40);
    for (form, wire) in [
        (Form::Stamped, Wire::LittleEndian),
        (Form::Stamped, Wire::Json),
        (Form::WithCovariance, Wire::LittleEndian),
        (Form::WithCovariance, Wire::Json),
        (Form::Transform, Wire::LittleEndian),
    ] {
        let mut rig = Rig::start(settings(&["engine=known_poses"]), wire).await;
        rig.robot.mount(BASE_FROM_LASER).await;
        for moment in &moments {
            let ros::PoseStamped { header, pose } = moment.pose_in("map");
            match form {
                Form::Stamped => rig.robot.put(&rig.robot.odom, &moment.pose_in("map")).await,
                Form::WithCovariance => {
                    let pose =
                        ros::PoseWithCovariance { pose, ..ros::PoseWithCovariance::default() };
                    let message = ros::PoseWithCovarianceStamped { header, pose };
                    rig.robot.put(&rig.robot.odom, &message).await;
                }
                Form::Transform => {
                    let mut message = moment.transform();
                    message.transforms[0].header = header;
                    rig.robot.put(&rig.robot.tf, &message).await;
                }
            }
            rig.robot.scan(moment).await;
            assert_eq!(rig.verdict().await.verdict, Verdict::Processed, "{form:?} {wire:?}");
        }
        let status = rig.daemon.status();
        let came = if form == Form::Transform { "tf" } else { "pose" };
        assert_eq!(status.inputs[came].received, 40);
        assert!(!status.inputs.contains_key("odom"));
        let snapshot = rig.end().await;
        assert_eq!(path(&snapshot), way, "{form:?} {wire:?}");
        assert_eq!(grid(&snapshot), map, "{form:?} {wire:?}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_scan_waits_for_its_pose_and_says_how_much_was_missing() {
    let moments = drive(4);
    let mut rig = Rig::mounted(&["engine=known_poses", "odometry_timeout_s=0.05"]).await;
    // In another frame it says nothing of the map.
    rig.robot.put(&rig.robot.odom, &moments[0].pose_in("odom")).await;
    rig.robot.scan(&moments[0]).await;
    let entry = rig.verdict().await;
    assert_eq!(entry.verdict, Verdict::NoOdometry);
    let expected = "no given pose has come on robot01/amcl_pose or in robot01/tf (from `map`";
    assert!(entry.detail.starts_with(expected), "{}", entry.detail);
    rig.robot.put(&rig.robot.odom, &moments[1].pose_in("map")).await;
    rig.robot.scan(&moments[3]).await;
    let entry = rig.verdict().await;
    assert!(entry.detail.starts_with("a given pose is missing by 200.0 ms"), "{}", entry.detail);
    let pose = &rig.daemon.status().inputs["pose"];
    assert_eq!((pose.received, pose.rejected), (2, 1));
    let reason = pose.last_rejection.as_deref();
    assert_eq!(reason, Some("it is a pose in `odom`, and not in `map`"));
    rig.end().await;
}

/// The share of the cells known in either that are not the same in both.
fn difference(a: &OccupancyGrid, b: &OccupancyGrid) -> f64 {
    let at = |grid: &OccupancyGrid, x: i64, y: i64| {
        let column = x - (grid.origin.x / grid.resolution).round() as i64;
        let row = y - (grid.origin.y / grid.resolution).round() as i64;
        let inside = 0..grid.width as i64;
        if inside.contains(&column) && (0..grid.height as i64).contains(&row) {
            grid.cells[row as usize * grid.width + column as usize]
        } else {
            -1
        }
    };
    let (mut known, mut other) = (0, 0);
    for y in -1000..1000 {
        for x in -1000..1000 {
            let (a, b) = (at(a, x, y), at(b, x, y));
            known += u32::from(a >= 0 || b >= 0);
            other += u32::from(a != b);
        }
    }
    f64::from(other) / f64::from(known)
}

#[tokio::test(flavor = "multi_thread")]
async fn the_beams_of_a_sweep_are_moved_to_where_its_first_was_taken() {
    let mut moments = drive(60);
    for moment in &mut moments {
        let intervals = (moment.scan.ranges.len() - 1) as f64;
        moment.scan.time_increment = (SWEEP_S / intervals) as f32;
    }
    let skewed = along(&moments, at_once).0.unwrap();
    let motion = |index: usize| {
        let (now, next) = (moments.get(index)?, moments.get(index + 1)?);
        Some(now.odom_from_base().between(next.odom_from_base()))
    };
    let expected = along(&moments, motion).0.unwrap();
    let mut rig = Rig::mounted(&["engine=known_poses", "odometry_timeout_s=5"]).await;
    rig.robot.put(&rig.robot.odom, &moments[0].pose_in("map")).await;
    for pair in moments.windows(2) {
        rig.robot.scan(&pair[0]).await;
        let mut pose = pair[1].pose_in("map");
        rig.robot.put(&rig.robot.odom, &pose).await;
        // A digit of time_increment may put the end of the sweep after that.
        pose.header.stamp.nanosec += 1000;
        rig.robot.put(&rig.robot.odom, &pose).await;
        assert_eq!(rig.verdict().await.verdict, Verdict::Processed);
    }
    let found = grid(&*rig.end().await).unwrap();
    let (right, wrong) = (difference(&found, &expected), difference(&found, &skewed));
    eprintln!("{right:.5} of the cells differ; as taken {wrong:.5}");
    assert!(right < 0.002, "{right}");
    assert!(wrong > 10.0 * right && wrong > 0.01, "{wrong}");
}

#[tokio::test(flavor = "multi_thread")]
async fn odometry_from_transforms_gives_the_same_map() {
    let moments = drive(60);
    let (map, way) = replayed(&settings(&[]), &moments);
    let mut rig = Rig::mounted(&[]).await;
    for moment in &moments {
        rig.robot.put(&rig.robot.tf, &moment.transform()).await;
        rig.robot.scan(moment).await;
        rig.verdict().await;
    }
    let status = rig.daemon.status();
    assert_eq!((status.inputs["tf"].received, status.inputs["odom"].received), (60, 0));
    let snapshot = rig.end().await;
    assert_eq!(path(&snapshot), way);
    assert_eq!(grid(&snapshot), map);
}

#[tokio::test(flavor = "multi_thread")]
async fn odometry_that_comes_after_its_scan_gives_the_same_map() {
    let moments = drive(60);
    let (map, way) = replayed(&settings(&[]), &moments);
    let mut rig = Rig::mounted(&["odometry_timeout_s=5"]).await;
    for pair in moments.chunks(2) {
        for moment in pair {
            rig.robot.scan(moment).await;
        }
        for moment in pair {
            rig.robot.odometry(moment).await;
        }
        rig.verdicts(pair.len()).await;
    }
    let snapshot = rig.end().await;
    assert_eq!(path(&snapshot), way);
    assert_eq!(grid(&snapshot), map);
}

#[tokio::test(flavor = "multi_thread")]
async fn the_map_is_there_while_the_robot_drives_and_the_pose_follows_odometry() {
    let moments = drive(40);
    let mut rig = Rig::mounted(&["map_update_interval=1000"]).await;
    let mut snapshots = rig.daemon.snapshots();
    rig.feed(&moments[0]).await;
    rig.verdict().await;
    let mapped = snapshots.wait_for(|snapshot| snapshot.map.is_some());
    tokio::time::timeout(PATIENCE, mapped).await.expect("no map").unwrap();
    // No scan for these: only odometry tells where the robot is.
    for moment in &moments[1..] {
        rig.robot.odometry(moment).await;
    }
    let newest = convert::stamp(moments[39].odometry.header.stamp).unwrap();
    let followed = snapshots.wait_for(|snapshot| snapshot.estimate.stamp == Some(newest));
    let snapshot =
        tokio::time::timeout(PATIENCE, followed).await.expect("no pose").unwrap().clone();
    let moved = moments[0].odom_from_base().between(moments[39].odom_from_base());
    let first = snapshot.map.as_ref().unwrap().path.iter().next().unwrap().1;
    let error = (first * moved).between(snapshot.estimate.pose_in_map);
    assert!(error.position().norm() < 1e-9 && moved.position().norm() > 1.0, "{error:?}");
    rig.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn without_odometry_the_verdict_says_so_and_how_much_is_missing() {
    let moments = drive(4);
    let mut rig = Rig::mounted(&["odometry_timeout_s=0.05"]).await;
    rig.robot.scan(&moments[0]).await;
    let entry = rig.verdict().await;
    assert_eq!(entry.verdict, Verdict::NoOdometry);
    assert!(entry.detail.starts_with("no odometry has come on robot01/odom"), "{}", entry.detail);
    rig.robot.odometry(&moments[1]).await;
    rig.robot.scan(&moments[3]).await;
    let entry = rig.verdict().await;
    assert!(entry.detail.starts_with("odometry is missing by 200.0 ms"), "{}", entry.detail);
    assert_eq!(entry.stamp, Some(moments[3].scan().stamp));
    let status = rig.daemon.status();
    assert_eq!(status.state, State::WaitingForOdometry, "{}", status.detail);
    assert_eq!(status.scans[&Verdict::NoOdometry], 2);
    rig.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn hector_maps_from_scans_alone_and_says_how_many_came_without_odometry() {
    let moments = drive(6);
    let mut rig = Rig::mounted(&["engine=hector", "odometry_timeout_s=0.05"]).await;
    for moment in &moments {
        rig.robot.scan(moment).await;
        assert_eq!(rig.verdict().await.verdict, Verdict::Processed);
    }
    let status = rig.daemon.status();
    assert_eq!(status.filter.scans_without_odometry, 6, "{}", status.detail);
    assert_eq!(status.filter.particles, 1);
    assert!(status.map.is_some_and(|map| map.known_area_m2 > 1.0));
    rig.end().await;
}

/// In the middle of a straight corridor nothing tells how far along it the robot is.
#[tokio::test(flavor = "multi_thread")]
async fn hector_without_odometry_tells_its_transform_and_that_a_corridor_is_weak() {
    let mut rig = Rig::mounted(&["engine=hector", "odometry_source=none"]).await;
    let (sender, mut transforms) = tokio::sync::mpsc::unbounded_channel();
    let told = move |sample: zenoh::sample::Sample| {
        let message: ros::TfMessage = ros::decode(&sample.payload().to_bytes(), "").unwrap();
        message.transforms.into_iter().for_each(|transform| drop(sender.send(transform)));
    };
    let far = &rig.sessions[1];
    far.declare_subscriber(format!("{ROBOT}/tf")).callback(told).background().await.unwrap();
    let mut last = None;
    for moment in drive_in(Place::Corridor, 300).iter().skip(200) {
        rig.robot.scan(moment).await;
        last = rig.verdict().await.weak_direction;
    }
    let replies = rig.sessions[1].get(format!("{ROBOT}/slam/status")).await.unwrap();
    let reply = tokio::time::timeout(PATIENCE, replies.recv_async()).await.unwrap().unwrap();
    let bytes = reply.result().unwrap().payload().to_bytes();
    let status: serde_json::Value = serde_json::from_slice(&bytes).unwrap();
    assert_eq!(status["state"], "degraded", "{status}");
    let detail = status["detail"].as_str().unwrap();
    assert!(detail.starts_with("the scans do not tell how far it moves along"), "{detail}");
    assert!(detail.ends_with("and without odometry the map may shrink there"), "{detail}");
    let filter = &status["filter"];
    assert!(filter["weak_directions"].as_u64() > Some(50), "{filter}");
    let weak = last.expect("the verdict tells it, too");
    assert!(weak.x.abs() > 0.9, "the corridor is along x: {weak:?}");
    assert_eq!(filter["weak_direction"], serde_json::to_value(weak).unwrap());

    let transform = tokio::time::timeout(PATIENCE, transforms.recv()).await.unwrap().unwrap();
    let frames = (transform.header.frame_id.as_str(), transform.child_frame_id.as_str());
    assert_eq!(frames, ("map", "base_link"));
    rig.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn of_too_many_scans_the_oldest_are_dropped_and_counted() {
    let moments = drive(6);
    let mut rig = Rig::mounted(&["odometry_timeout_s=5", "scan_queue=2"]).await;
    for moment in &moments {
        rig.robot.scan(moment).await;
    }
    assert_eq!(rig.verdicts(4).await, [Verdict::Overload; 4]);
    for moment in &moments {
        rig.robot.odometry(moment).await;
    }
    assert_eq!(rig.verdicts(2).await, [Verdict::Processed, Verdict::NotMovedEnough]);
    let status = rig.daemon.status();
    assert_eq!((status.state, status.scans[&Verdict::Overload]), (State::Degraded, 4));
    assert!(status.detail.contains("4 of the last 6 scans"), "{}", status.detail);
    assert_eq!(status.inputs["odom"].received, 6);
    rig.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn every_scan_of_a_flood_has_a_verdict_and_those_that_reach_the_filter_are_in_order() {
    let moments = drive(300);
    let mut rig = Rig::mounted(&["scan_queue=3"]).await;
    let mut replies = Vec::new();
    for moment in &moments {
        rig.feed(moment).await;
        while let Ok(entry) = rig.verdicts.try_recv() {
            replies.push(entry);
        }
    }
    while replies.len() < moments.len() {
        replies.push(rig.verdict().await);
    }
    let numbers: Vec<u64> = replies.iter().map(|entry| entry.number).collect();
    assert_eq!(numbers, (1..=300).collect::<Vec<u64>>());
    let reached = [Verdict::Processed, Verdict::NotMovedEnough];
    let stamps: Vec<Stamp> = replies
        .iter()
        .filter(|entry| reached.contains(&entry.verdict))
        .filter_map(|entry| entry.stamp)
        .collect();
    assert!(stamps.is_sorted() && !stamps.is_empty());
    let status = rig.daemon.status();
    let [overloaded, late] = [Verdict::Overload, Verdict::Late].map(|v| status.scans[&v]);
    assert_eq!((overloaded as usize + stamps.len(), late), (300, 0));
    assert_eq!((status.inputs["odom"].received, status.inputs["odom"].dropped), (300, 0));
    rig.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_paused_daemon_takes_no_scan_and_goes_on_where_the_robot_is() {
    let moments = drive(40);
    let mut rig = Rig::mounted(&[]).await;
    rig.feed(&moments[0]).await;
    assert_eq!(rig.verdicts(1).await, [Verdict::Processed]);
    assert!(rig.command(Command::Pause).await.changed);
    assert!(!rig.command(Command::Pause).await.changed);
    assert_eq!(rig.daemon.status().state, State::Paused);
    for moment in &moments[1..39] {
        rig.feed(moment).await;
        assert_eq!(rig.verdicts(1).await, [Verdict::Paused]);
    }
    assert!(rig.command(Command::Resume).await.changed);
    assert!(!rig.command(Command::Resume).await.changed);
    rig.feed(&moments[39]).await;
    assert_eq!(rig.verdicts(1).await, [Verdict::Processed]);
    let snapshot = rig.end().await;
    let way: Vec<Pose2> = path(&snapshot).iter().map(|(_, pose)| pose).collect();
    let driven = moments[0].odom_from_base().between(moments[39].odom_from_base());
    let error = driven.between(way[0].between(way[1]));
    assert!(way.len() == 2 && error.position().norm() < 0.3, "{way:?} {driven:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn other_engines_pause_and_go_on_too() {
    let moments = drive(20);
    for engine in ["engine=hector", "engine=known_poses"] {
        let mut rig = Rig::mounted(&[engine]).await;
        let poses = rig.daemon.status().inputs.contains_key("pose");
        for (index, moment) in moments.iter().enumerate() {
            match index {
                1 => assert!(rig.command(Command::Pause).await.changed),
                19 => assert!(rig.command(Command::Resume).await.changed),
                _ => {}
            }
            if poses {
                rig.robot.put(&rig.robot.odom, &moment.pose_in("map")).await;
            } else {
                rig.robot.odometry(moment).await;
            }
            rig.robot.scan(moment).await;
            let paused = (1..19).contains(&index);
            let expected = if paused { Verdict::Paused } else { Verdict::Processed };
            assert_eq!(rig.verdict().await.verdict, expected, "{engine}: {index}");
            let state = rig.daemon.status().state;
            assert_eq!(state == State::Paused, paused, "{engine}: {state:?}");
        }
        let way: Vec<Pose2> = path(&*rig.end().await).iter().map(|(_, pose)| pose).collect();
        let driven = moments[0].odom_from_base().between(moments[19].odom_from_base());
        let error = driven.between(way[0].between(way[1]));
        assert!(way.len() == 2 && error.position().norm() < 0.1, "{way:?} {driven:?}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_reset_begins_a_new_map_at_the_pose_that_is_given() {
    let moments = drive(3);
    let mut rig = Rig::mounted(&[]).await;
    rig.feed(&moments[0]).await;
    rig.verdict().await;
    let place = Pose2::new(5.0, -3.0, 1.0);
    let done = rig.command(Command::Reset(Some(place))).await;
    assert!(done.changed && done.done.contains("x 5.000 m, y -3.000 m"), "{}", done.done);
    let snapshot = rig.daemon.snapshots().borrow().clone();
    assert!(snapshot.map.is_none() && snapshot.estimate.particles.is_empty());
    assert_eq!(snapshot.ledger.total(), 1);
    rig.feed(&moments[1]).await;
    assert_eq!(rig.verdicts(1).await, [Verdict::Processed]);

    let moved = Pose2::new(1.0, 1.0, 0.0);
    rig.command(Command::InitialPose(moved)).await;
    let estimate = rig.daemon.snapshots().borrow().estimate.clone();
    assert!(moved.between(estimate.pose_in_map).position().norm() < 1e-9);
    let snapshot = rig.end().await;
    assert_eq!(path(&snapshot).iter().map(|(_, pose)| pose).collect::<Vec<_>>(), [place]);
    let map = snapshot.map.as_ref().unwrap();
    assert_eq!((map.version, map.epoch), (3, 2), "the reset was a version, too");
}

#[tokio::test(flavor = "multi_thread")]
async fn an_initial_pose_before_the_first_scan_is_where_the_map_begins() {
    let moments = drive(1);
    let mut rig = Rig::mounted(&[]).await;
    let place = Pose2::new(5.0, -3.0, 1.0);
    assert!(rig.command(Command::InitialPose(place)).await.done.contains("will begin"));
    rig.feed(&moments[0]).await;
    rig.verdict().await;
    let snapshot = rig.end().await;
    assert_eq!(path(&snapshot).iter().next().unwrap().1, place);
}

/// Saves a map in a folder; what makes a daemon start from it.
fn start_from(folder: &std::path::Path, grid: &OccupancyGrid) -> String {
    std::fs::write(folder.join("map.pgm"), map::pgm(grid)).unwrap();
    std::fs::write(folder.join("map.yaml"), map::yaml(grid, "map.pgm")).unwrap();
    format!("map={}", folder.join("map.yaml").display())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_map_to_start_from_is_told_frozen_and_thawed_by_command() {
    let moments = drive(120);
    let (mapped, _) = replayed(&settings(&[]), &moments[..60]);
    let folder = tempfile::tempdir().unwrap();
    let map = start_from(folder.path(), mapped.as_ref().unwrap());
    let mut rig = Rig::mounted(&[&map, "mode=localization"]).await;
    let first = rig.daemon.snapshots().borrow().clone();
    assert_eq!((grid(&first), path(&first).len()), (mapped.clone(), 0), "before any scan");
    let mut verdicts = Vec::new();
    for moment in &moments[..60] {
        rig.feed(moment).await;
        verdicts.extend(rig.verdicts(1).await);
    }
    assert_eq!(verdicts[0], Verdict::Processed, "the search found the beginning");
    let status = rig.daemon.status();
    assert_eq!((status.state, status.mode), (State::Localizing, Mode::Localization));
    assert!(!rig.command(Command::Mode(Mode::Localization)).await.changed);
    assert!(rig.command(Command::Mode(Mode::Mapping)).await.changed);
    let frozen = rig.daemon.snapshots().borrow().clone();
    assert_eq!(grid(&frozen), mapped, "a whole drive has changed nothing");
    assert!(path(&frozen).len() > 5 && frozen.map.as_ref().unwrap().epoch == 1);
    for moment in &moments[60..] {
        rig.feed(moment).await;
        rig.verdict().await;
    }
    assert_eq!(rig.daemon.status().state, State::Mapping);
    let last = rig.end().await;
    assert_ne!(grid(&last), mapped);
    let error = moments[119].odom_from_base().between(last.estimate.pose_in_map);
    assert!(error.position().norm() < 0.3, "map is odom of the first session: {error:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn who_is_not_localized_says_why_until_a_pose_is_given() {
    let moments = drive(3);
    let folder = tempfile::tempdir().unwrap();
    let (mapped, _) = replayed(&settings(&[]), &moments);
    let mut empty = mapped.unwrap();
    empty.cells.fill(0);
    let mut rig = Rig::mounted(&[&start_from(folder.path(), &empty)]).await;
    for moment in &moments[..2] {
        rig.feed(moment).await;
        let entry = rig.verdict().await;
        assert_eq!(entry.verdict, Verdict::NotLocalized);
        assert!(entry.detail.contains("fits nowhere"), "{}", entry.detail);
    }
    let status = rig.daemon.status();
    assert_eq!(status.state, State::NotLocalized);
    assert!(status.detail.contains("slam/cmd/initial_pose"), "{}", status.detail);
    rig.command(Command::InitialPose(Pose2::new(1.0, 2.0, 0.5))).await;
    rig.feed(&moments[2]).await;
    assert_eq!(rig.verdicts(1).await, [Verdict::Processed]);
    assert_eq!(rig.daemon.status().state, State::Mapping);
    let last = rig.end().await;
    assert_eq!(path(&last).len(), 1);
}

#[tokio::test(flavor = "multi_thread")]
async fn there_has_to_be_a_map_to_localize_in() {
    let rig = Rig::mounted(&[]).await;
    let done = rig.command(Command::Mode(Mode::Localization)).await;
    assert!(!done.changed && done.done.contains("no map"), "{}", done.done);
    assert_eq!(rig.daemon.status().mode, Mode::Mapping);
    rig.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_tilted_laser_is_refused_and_an_unknown_one_is_named() {
    let moments = drive(2);
    let mut rig = Rig::start(settings(&["odometry_timeout_s=0.05"]), Wire::LittleEndian).await;
    rig.feed(&moments[0]).await;
    let entry = rig.verdict().await;
    assert_eq!(entry.verdict, Verdict::NoMount);
    assert!(entry.detail.contains("`laser`") && entry.detail.contains("robot01/tf_static"));

    let mut tilted = mount_message(Pose2::IDENTITY);
    // 20 degrees about y.
    tilted.transforms[0].transform.rotation =
        ros::Quaternion { x: 0.0, y: 0.173_648, z: 0.0, w: 0.984_808 };
    rig.robot.put(&rig.robot.tf_static, &tilted).await;
    rig.feed(&moments[1]).await;
    let entry = rig.verdict().await;
    assert_eq!(entry.verdict, Verdict::TiltedMount);
    assert!(entry.detail.contains("tilted by 20.00 degrees"), "{}", entry.detail);
    assert_eq!(rig.daemon.status().state, State::Degraded);
    rig.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn bytes_that_are_no_message_are_counted_and_mapping_goes_on() {
    let moments = drive(2);
    let mut rig = Rig::mounted(&["max_message_bytes=10000"]).await;
    rig.feed(&moments[0]).await;
    assert_eq!(rig.verdicts(1).await, [Verdict::Processed]);

    let mut cut = ros::cdr(&moments[1].scan);
    cut.truncate(100);
    let mut upright = moments[1].odometry.clone();
    upright.pose.pose.orientation = ros::Quaternion::default();
    let mut flat = moments[1].scan.clone();
    flat.angle_increment = 0.0;
    let robot = &rig.robot;
    for publisher in [&robot.odom, &robot.tf, &robot.tf_static] {
        publisher.put(&b"\x00\x01\x00\x00\xff\xff\xff\xff"[..]).await.unwrap();
        publisher.put(&b""[..]).await.unwrap();
        publisher.delete().await.unwrap();
    }
    robot.put(&robot.odom, &upright).await;
    robot.scan.put(cut).await.unwrap();
    robot.scan.put("hello").encoding("application/json").await.unwrap();
    robot.scan.put(vec![0_u8; 10_001]).await.unwrap();
    robot.put(&robot.scan, &flat).await;
    rig.feed(&moments[1]).await;

    let [bad, geometry, fine] =
        [Verdict::NotDecodable, Verdict::BadGeometry, Verdict::NotMovedEnough];
    assert_eq!(rig.verdicts(5).await, [bad, bad, bad, geometry, fine]);
    let status = rig.daemon.status();
    let rejected = ["scan", "odom", "tf", "tf_static"].map(|name| status.inputs[name].rejected);
    assert_eq!(rejected, [4, 4, 3, 3]);
    let rejection = status.inputs["odom"].last_rejection.as_ref().unwrap();
    assert!(rejection.contains("is no rotation"), "{rejection}");
    rig.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_robot_without_ros_needs_five_lines_and_a_configured_laser() {
    let (session, locator) = listening().await;
    let far = connected(&locator).await;
    let set = ["laser={x: 0.1}", "keys={scan: front/scan}"];
    let daemon = Daemon::start(&session, settings(&set)).await.unwrap();
    let mut verdicts = daemon.verdicts();
    let publisher = far.declare_publisher(format!("{ROBOT}/front/scan")).await.unwrap();
    matched(&publisher).await;
    let odometry = r#"{"header": {"stamp": {"sec": 5, "nanosec": 0}},
        "pose": {"pose": {"position": {"x": 1, "y": 2}, "orientation": {"z": 0, "w": 1}}}}"#;
    let scan = r#"{"header": {"stamp": {"sec": 5, "nanosec": 0}}, "angle_min": -1, "angle_max": 1,
        "angle_increment": 0.5, "range_min": 0.1, "range_max": 10, "ranges": [2, 3, 4, null, 2]}"#;
    far.put(format!("{ROBOT}/odom"), odometry).await.unwrap();
    publisher.put(scan).await.unwrap();
    let entry = tokio::time::timeout(PATIENCE, verdicts.recv()).await.expect("no verdict").unwrap();
    assert_eq!(entry.verdict, Verdict::Processed, "{}", entry.detail);
    let snapshot = daemon.stop().await;
    assert_eq!(snapshot.estimate.pose_in_map, Pose2::new(1.0, 2.0, 0.0));
    far.close().await.unwrap();
}

/// What transient local becomes on Zenoh.
#[tokio::test(flavor = "multi_thread")]
async fn static_transforms_told_before_the_daemon_started_reach_it() {
    let (session, locator) = listening().await;
    let far = connected(&locator).await;
    let publisher = far
        .declare_publisher(format!("{ROBOT}/tf_static"))
        .cache(CacheConfig::default().max_samples(1))
        .sample_miss_detection(MissDetectionConfig::default())
        .publisher_detection()
        .await
        .unwrap();
    publisher.put(ros::cdr(&mount_message(BASE_FROM_LASER))).await.unwrap();
    let set = ["odometry_timeout_s=5"];
    let daemon = Daemon::start(&session, settings(&set)).await.unwrap();
    let mut verdicts = daemon.verdicts();
    let robot = Robot::start(&far, Wire::LittleEndian, "odom").await;
    let moments = drive(1);
    robot.odometry(&moments[0]).await;
    robot.scan(&moments[0]).await;
    let entry = tokio::time::timeout(PATIENCE, verdicts.recv()).await.expect("no verdict").unwrap();
    assert_eq!(entry.verdict, Verdict::Processed, "{}", entry.detail);
    daemon.stop().await;
    far.close().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn the_daemon_runs_until_it_is_told_to_end() {
    let (session, locator) = listening().await;
    let far = connected(&locator).await;
    let (end, ended) = oneshot::channel::<()>();
    let shutdown = async move { ended.await.unwrap_or_default() };
    let running = tokio::spawn(daemon::run(session, settings(&[]), shutdown));
    let robot = Robot::start(&far, Wire::LittleEndian, "odom").await;
    robot.mount(BASE_FROM_LASER).await;
    end.send(()).unwrap();
    let ended = tokio::time::timeout(Duration::from_secs(2), running).await;
    ended.expect("it did not end in time").unwrap().unwrap();
    far.close().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn the_last_map_is_saved_if_that_is_configured() {
    let directory = tempfile::tempdir().unwrap();
    let into = format!("save_directory={}", directory.path().join("maps").display());
    let mut rig = Rig::mounted(&[&into, "save_on_exit=last"]).await;
    rig.feed(&drive(1)[0]).await;
    rig.verdict().await;
    let snapshot = rig.end().await;
    let saved = std::fs::read(directory.path().join("maps/last.pgm")).unwrap();
    assert_eq!(saved, gmapd::map::pgm(&grid(&snapshot).unwrap()));

    let (session, _) = listening().await;
    let wrong = settings(&["save_on_exit=../last"]);
    let error = Daemon::start(&session, wrong).await.unwrap_err();
    assert!(error.to_string().starts_with("save_on_exit: "), "{error}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_key_with_a_wildcard_is_an_error() {
    let (session, _) = listening().await;
    let error = Daemon::start(&session, settings(&["keys={odom: '*'}"])).await.unwrap_err();
    assert!(error.to_string().contains("has a wildcard"), "{error}");
}

/// The standard error of a program up to a line that says so much.
fn said(lines: &mut impl Iterator<Item = std::io::Result<String>>, what: &str) -> String {
    lines.map(Result::unwrap).find(|line| line.contains(what)).expect(what)
}

/// `gmapd run`, which does not outlive its test.
struct Program(Child);

impl Program {
    fn start(endpoint: &str, log: &str) -> Self {
        let program = Process::new(env!("CARGO_BIN_EXE_gmapd"))
            .args(["run", "--prefix", ROBOT, "--set", "particles=6", "-e", endpoint])
            .env("GMAPD_LOG", log)
            .stderr(Stdio::piped())
            .spawn();
        Self(program.unwrap())
    }

    fn lines(&mut self) -> impl Iterator<Item = std::io::Result<String>> + use<> {
        BufReader::new(self.0.stderr.take().unwrap()).lines()
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        self.0.kill().ok();
        self.0.wait().ok();
    }
}

/// Ends a program as an operator does, and checks that it ends well.
async fn terminate(mut program: Program) {
    let id = program.0.id().to_string();
    assert!(Process::new("kill").args(["-TERM", &id]).status().unwrap().success());
    let ended = tokio::task::spawn_blocking(move || program.0.wait().unwrap());
    let status = tokio::time::timeout(Duration::from_secs(2), ended).await;
    assert_eq!(status.expect("it did not end in time").unwrap().code(), Some(0));
}

#[tokio::test(flavor = "multi_thread")]
async fn the_program_ends_while_nobody_answers_where_it_connects() {
    let mut program = Program::start("tcp/127.0.0.1:1", "info");
    let mut lines = program.lines();
    said(&mut lines, "connecting to tcp/127.0.0.1:1");
    terminate(program).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_program_maps_and_ends_with_exit_code_zero_within_two_seconds() {
    let (session, locator) = listening().await;
    let mut program = Program::start(&locator, "warn,gmapd=debug");
    let robot = Robot::start(&session, Wire::LittleEndian, "odom").await;
    robot.mount(BASE_FROM_LASER).await;
    for moment in drive(30) {
        robot.odometry(&moment).await;
        robot.scan(&moment).await;
    }
    // Refused after all that came before it, and logged.
    robot.odom.put("the end").await.unwrap();
    let mut lines = program.lines();
    let rejected = said(&mut lines, "rejected a message");
    assert!(rejected.contains("nav_msgs/msg/Odometry"), "{rejected}");
    terminate(program).await;
    said(&mut lines, "ending");
}
