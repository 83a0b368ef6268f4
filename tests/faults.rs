//! Networks and clocks fail: the daemon goes on by itself, and its counters have the outage.
#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::Duration;

use gmapd::logs::Reading;
use gmapd::playback::Frames;
use gmapd::ros;
use gmapd::sim::{Place, Scenario, Simulation};
use gmapd::slam::pose::Stamp;
use gmapd::slam::scan::LaserMount;
use serde_json::Value;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{mpsc, watch};
use zenoh::Session;
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;

/// How long anything may take on a machine that does other things as well.
const PATIENCE: Duration = Duration::from_secs(60);

/// Who hears nothing for so long is taken for gone, ms; and is tried again soon.
const LEASE: u32 = 1000;

/// Scans that are lost in an outage.
const OUTAGE: usize = 20;

/// From the last scan before it to the first after it.
const LOST_S: f64 = 2.1;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Condition {
    Whole,
    /// Everything takes this longer.
    Slow(Duration),
    /// Nothing gets through, and nobody is told.
    Silent,
    /// Connections end, and no new one is taken.
    Cut,
}

/// A wire to a port, of which a test says how it is.
struct Wire {
    endpoint: String,
    condition: watch::Sender<Condition>,
}

impl Wire {
    async fn to(port: u16) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let endpoint = format!("tcp/{}", listener.local_addr().unwrap());
        let (condition, watched) = watch::channel(Condition::Whole);
        tokio::spawn(async move {
            while let Ok((near, _)) = listener.accept().await {
                if *watched.borrow() == Condition::Cut {
                    continue;
                }
                let Ok(far) = TcpStream::connect(("127.0.0.1", port)).await else { continue };
                let ((from_near, to_near), (from_far, to_far)) =
                    (near.into_split(), far.into_split());
                tokio::spawn(carry(from_near, to_far, watched.clone()));
                tokio::spawn(carry(from_far, to_near, watched.clone()));
            }
        });
        Self { endpoint, condition }
    }

    fn is(&self, condition: Condition) {
        self.condition.send_replace(condition);
    }
}

async fn carry(
    mut from: OwnedReadHalf,
    mut to: OwnedWriteHalf,
    mut condition: watch::Receiver<Condition>,
) {
    let mut watched = condition.clone();
    let copy = async {
        let mut bytes = vec![0; 65_536];
        while let Ok(count @ 1..) = from.read(&mut bytes).await {
            let now = *condition.wait_for(|now| *now != Condition::Silent).await.unwrap();
            if let Condition::Slow(delay) = now {
                tokio::time::sleep(delay).await;
            }
            if to.write_all(&bytes[..count]).await.is_err() {
                break;
            }
        }
    };
    tokio::select! {
        () = copy => {}
        _ = watched.wait_for(|now| *now == Condition::Cut) => {}
    }
}

fn configuration(mode: &str, lease: u32, rest: &str) -> String {
    format!(
        "{{ mode: {mode:?}, transport: {{ link: {{ tx: {{ lease: {lease}, keep_alive: 4 }} }} }},
         scouting: {{ multicast: {{ enabled: false }}, gossip: {{ enabled: false }} }}, {rest} }}"
    )
}

fn connect_to(endpoint: &str) -> String {
    format!(
        "connect: {{ endpoints: [{endpoint:?}], timeout_ms: -1,
         retry: {{ period_init_ms: 50, period_max_ms: 200 }} }}"
    )
}

async fn open(configuration: &str) -> Session {
    zenoh::open(zenoh::Config::from_json5(configuration).unwrap()).await.unwrap()
}

/// A router; port 0 is any.
async fn router(port: u16, lease: u32) -> (Session, u16) {
    let listen = format!("listen: {{ endpoints: [\"tcp/127.0.0.1:{port}\"] }}");
    let session = open(&configuration("router", lease, &listen)).await;
    let locator = session.info().locators().await[0].to_string();
    (session, locator.rsplit(':').next().unwrap().parse().unwrap())
}

/// The real program behind a wire, and a robot that feeds it past that wire.
struct Rig {
    wire: Wire,
    port: u16,
    router: Session,
    robot: Session,
    scan: Publisher<'static>,
    odom: Publisher<'static>,
    verdicts: mpsc::UnboundedReceiver<Value>,
    readings: std::vec::IntoIter<Reading>,
    program: Program,
    /// Its configuration lives as long.
    _directory: tempfile::TempDir,
}

/// Whether anybody listens to the robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Heard {
    Yes,
    No,
}

/// Between the program and the router.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Link {
    /// The wire.
    Wire,
    /// One that loses a tenth of its packets, and delays the others by 20 ms.
    Lossy,
}

struct Program(Child);

impl Drop for Program {
    fn drop(&mut self) {
        self.0.kill().ok();
        self.0.wait().ok();
    }
}

/// Runs the program after these words.
fn program(before: &[String], configuration: &PathBuf) -> Program {
    let words = [before, &[env!("CARGO_BIN_EXE_gmapd").to_owned()]].concat();
    let mut command = Command::new(&words[0]);
    command.args(&words[1..]);
    command.args(["run", "--prefix", "robot01", "--zenoh"]).arg(configuration);
    for set in ["particles=6", "linearUpdate=0.2", "laser={x: 0.0}"] {
        command.args(["--set", set]);
    }
    Program(command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap())
}

/// What the script is called with that runs programs behind a lossy link to a port.
fn lossy_link(port: u16) -> [String; 5] {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/lossy_link.py");
    let script = script.to_str().unwrap().to_owned();
    ["python3".to_owned(), script, port.to_string(), "0.1".to_owned(), "0.02".to_owned()]
}

/// Whether networks can be made here; where everything is tested, they must be.
fn has_networks() -> bool {
    let link = lossy_link(1);
    let mut command = Command::new(&link[0]);
    let status = command.args(&link[1..]).arg("true").status().unwrap();
    let can = status.success();
    let is_root = Command::new("id").arg("-u").output().unwrap().stdout == b"0\n";
    let must = is_root && std::env::var_os("GMAPD_CI").is_some();
    assert!(can || !must, "root can make no network: {status}");
    can
}

impl Rig {
    async fn start() -> Self {
        Self::start_behind(Link::Wire, LEASE).await
    }

    async fn start_behind(link: Link, lease: u32) -> Self {
        let (router, port) = router(0, lease).await;
        let wire = Wire::to(port).await;
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("zenoh.json5");
        let (before, endpoint) = match link {
            Link::Wire => (Vec::new(), wire.endpoint.as_str()),
            Link::Lossy => (lossy_link(port).to_vec(), "tcp/10.77.0.1:7447"),
        };
        std::fs::write(&path, configuration("client", lease, &connect_to(endpoint))).unwrap();
        let near = connect_to(&format!("tcp/127.0.0.1:{port}"));
        let robot = open(&configuration("client", lease, &near)).await;
        let [scan, odom] = [publisher(&robot, "scan").await, publisher(&robot, "odom").await];
        let verdicts = verdicts(&robot).await;
        let program = program(&before, &path);
        let rig = Self {
            wire,
            port,
            router,
            robot,
            scan,
            odom,
            verdicts,
            readings: drive().into_iter(),
            program,
            _directory: directory,
        };
        rig.heard(Heard::Yes).await;
        rig
    }

    /// Until the daemon is known to listen, or known not to.
    async fn heard(&self, wanted: Heard) {
        for publisher in [&self.scan, &self.odom] {
            let listener = publisher.matching_listener().await.unwrap();
            while publisher.matching_status().await.unwrap().matching() != (wanted == Heard::Yes) {
                let change = tokio::time::timeout(PATIENCE, listener.recv_async()).await;
                change.expect("nothing changes").unwrap();
            }
        }
    }

    /// Sends the next scans with their odometry, stamped `shift` seconds later.
    async fn send(&mut self, count: usize, shift: i64) {
        for mut reading in self.readings.by_ref().take(count) {
            reading.stamp = Stamp(reading.stamp.0 + shift * 1_000_000_000);
            if let Some(scan) = &mut reading.scan {
                scan.stamp = reading.stamp;
            }
            let messages = Frames::default().messages(&reading);
            self.odom.put(ros::cdr(&messages.odometry)).await.unwrap();
            self.scan.put(ros::cdr(&messages.scan.unwrap())).await.unwrap();
        }
    }

    /// Sends scans and waits for the verdict of each; how many were processed.
    async fn map(&mut self, count: usize, shift: i64) -> usize {
        self.send(count, shift).await;
        let mut processed = 0;
        for _ in 0..count {
            let verdict = tokio::time::timeout(PATIENCE, self.verdicts.recv()).await;
            let verdict = verdict.expect("a scan has no verdict").unwrap();
            processed += usize::from(verdict["verdict"] == "processed");
        }
        processed
    }

    async fn status(&self) -> Value {
        let replies = self.robot.get("robot01/slam/status").timeout(PATIENCE).await.unwrap();
        let reply = replies.recv_async().await.unwrap();
        serde_json::from_slice(&reply.result().unwrap().payload().to_bytes()).unwrap()
    }

    /// So many outages are in the counters of what comes with the scans, the longest this long.
    async fn tells_of_outages(&self, count: u64, longest_s: f64) {
        let inputs = self.status().await["inputs"].take();
        for input in ["scan", "odom"] {
            assert_eq!(inputs[input]["gaps"], count, "{inputs}");
            let longest = inputs[input]["longest_gap_s"].as_f64().unwrap();
            assert!((longest - longest_s).abs() < 0.01, "{inputs}");
        }
    }

    /// The daemon never ended, and its links ended so often.
    async fn ends(mut self, outages: u64) {
        assert!(self.map(30, 0).await > 0, "it does not map any more");
        let status = self.status().await;
        assert_eq!(status["state"], "mapping", "{status}");
        let expected = serde_json::json!({"connected": 1, "ended": outages});
        assert_eq!(status["links"], expected);
        assert!(self.program.0.try_wait().unwrap().is_none());
        self.robot.close().await.unwrap();
        self.router.close().await.unwrap();
    }
}

async fn publisher(session: &Session, name: &str) -> Publisher<'static> {
    let publisher = session.declare_publisher(format!("robot01/{name}"));
    publisher.congestion_control(CongestionControl::Block).await.unwrap()
}

async fn verdicts(session: &Session) -> mpsc::UnboundedReceiver<Value> {
    let (sender, receiver) = mpsc::unbounded_channel();
    let take = move |sample: zenoh::sample::Sample| {
        sender.send(serde_json::from_slice(&sample.payload().to_bytes()).unwrap()).ok();
    };
    session.declare_subscriber("robot01/slam/verdict").callback(take).background().await.unwrap();
    receiver
}

fn drive() -> Vec<Reading> {
    let scenario = Scenario { beams: 120, ..Scenario::new(Place::Building, 3) };
    let simulation = Simulation::new(&scenario).unwrap();
    let reading = |reading: gmapd::sim::Reading| Reading {
        line: 0,
        stamp: reading.stamp,
        odom_from_base: reading.odom_from_base,
        scan: Some(reading.scan),
        mount: LaserMount::default(),
    };
    simulation.readings().take(300).map(reading).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_slow_network_delays_and_loses_nothing() {
    let mut rig = Rig::start().await;
    rig.wire.is(Condition::Slow(Duration::from_millis(30)));
    assert!(rig.map(40, 0).await > 0);
    rig.wire.is(Condition::Whole);
    rig.ends(0).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_connection_that_is_cut_comes_back() {
    let mut rig = Rig::start().await;
    for _ in 0..3 {
        assert!(rig.map(30, 0).await > 0);
        rig.wire.is(Condition::Cut);
        rig.heard(Heard::No).await;
        rig.send(OUTAGE, 0).await;
        rig.wire.is(Condition::Whole);
        rig.heard(Heard::Yes).await;
    }
    assert!(rig.map(30, 0).await > 0);
    rig.tells_of_outages(3, LOST_S).await;
    rig.ends(3).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_network_that_is_silent_is_noticed_and_comes_back() {
    let mut rig = Rig::start().await;
    assert!(rig.map(30, 0).await > 0);
    rig.wire.is(Condition::Silent);
    rig.heard(Heard::No).await;
    rig.send(OUTAGE, 0).await;
    rig.wire.is(Condition::Whole);
    rig.heard(Heard::Yes).await;
    assert!(rig.map(30, 0).await > 0);
    rig.tells_of_outages(1, LOST_S).await;
    rig.ends(1).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_router_that_restarts_is_found_again() {
    let mut rig = Rig::start().await;
    assert!(rig.map(30, 0).await > 0);
    rig.router.close().await.unwrap();
    rig.heard(Heard::No).await;
    rig.router = router(rig.port, LEASE).await.0;
    rig.heard(Heard::Yes).await;
    rig.ends(1).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_clock_that_jumps_back_or_ahead_is_counted_and_mapping_goes_on() {
    let mut rig = Rig::start().await;
    assert!(rig.map(30, 0).await > 0);
    assert!(rig.map(40, -3600).await > 0, "after a step back");
    assert!(rig.map(40, 3600).await > 0, "after a step ahead");
    let status = rig.status().await;
    assert_eq!(status["inputs"]["scan"]["clock_restarts"], 1, "{}", status["inputs"]);
    // The last scan before the step ahead was 0.1 s before the first after it.
    rig.tells_of_outages(1, 7200.1).await;
    rig.ends(0).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn packets_that_are_lost_delay_scans_and_lose_none() {
    if !has_networks() {
        return eprintln!("skipped: only root can make a network that loses packets");
    }
    let mut rig = Rig::start_behind(Link::Lossy, 20_000).await;
    let lines = BufReader::new(rig.program.0.stdout.take().unwrap()).lines();
    let (lost, mut losses) = watch::channel(0);
    let read = move || {
        for line in lines.map_while(Result::ok) {
            lost.send_replace(line.split(' ').next().unwrap().parse::<u64>().unwrap());
        }
    };
    thread::Builder::new().name("losses".to_owned()).spawn(read).unwrap();
    let (mut sent, before) = (0, *losses.borrow_and_update());
    while *losses.borrow_and_update() < before + 30 {
        assert!(rig.map(10, 0).await > 0, "after {sent} scans");
        sent += 10;
    }
    println!("{} packets were lost while {sent} scans were sent", *losses.borrow() - before);
    let status = rig.status().await;
    let verdicts = status["scans"].as_object().unwrap().values();
    assert_eq!(verdicts.filter_map(Value::as_u64).sum::<u64>(), sent, "{status}");
    rig.tells_of_outages(0, 0.0).await;
    rig.ends(0).await;
}
