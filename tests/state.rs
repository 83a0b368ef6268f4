//! The real daemon, killed and started again: it goes on where it was, byte for byte.
#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::fs::{self, File};
use std::io::{BufRead as _, BufReader, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use gmapd::checkpoint::{self, checkpoints};
use gmapd::clock;
use gmapd::convert::{self, OdometrySample};
use gmapd::daemon::checkpointing::Checkpoint;
use gmapd::ros;
use gmapd::sim::{self, Place, Scenario, Simulation};
use gmapd::slam::pose::{Pose2, Stamp};
use gmapd::slam::scan::LaserMount;
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use serde_json::Value;
use tempfile::TempDir;
use zenoh::Session;
use zenoh::handlers::FifoChannelHandler;
use zenoh::pubsub::{Publisher, Subscriber};
use zenoh::qos::CongestionControl;
use zenoh::sample::Sample;

/// Much longer than anything takes, for machines with other things to do.
const PATIENCE: Duration = Duration::from_secs(60);

/// A scan with the odometry at its stamp, as bytes.
#[derive(Debug, Clone)]
struct Moment {
    odometry: Vec<u8>,
    scan: Vec<u8>,
    stamp: i64,
    odom_from_base: Pose2,
}

/// The first moments of a drive through a building.
fn drive(moments: usize) -> Vec<Moment> {
    drive_after(moments, 0, Pose2::IDENTITY)
}

/// The same drive so many seconds later, with an odometry that has its origin elsewhere.
fn drive_after(moments: usize, seconds: i64, odom_from_before: Pose2) -> Vec<Moment> {
    let scenario = Scenario { beams: 60, ..Scenario::new(Place::Building, 3) };
    let mut simulation = Simulation::new(&scenario).unwrap();
    simulation.lidar.mount = LaserMount::default();
    let moment = |mut reading: sim::Reading| {
        let stamp = Stamp(reading.stamp.0 + seconds * 1_000_000_000);
        (reading.stamp, reading.scan.stamp) = (stamp, stamp);
        let odometry = OdometrySample {
            stamp: reading.stamp,
            odom_frame: "odom".to_owned(),
            base_frame: "base_link".to_owned(),
            odom_from_base: odom_from_before * reading.odom_from_base,
        };
        Moment {
            odom_from_base: odometry.odom_from_base,
            odometry: ros::cdr(&convert::odometry_message(&odometry)),
            scan: ros::cdr(&convert::laser_scan(&reading.scan, "base_link")),
            stamp: reading.stamp.0,
        }
    };
    simulation.readings().take(moments).map(moment).collect()
}

/// The mesh, with the robot on it that feeds daemons.
struct Mesh {
    session: Session,
    configuration: PathBuf,
    directory: TempDir,
}

impl Mesh {
    async fn new() -> Self {
        let mut config = zenoh::Config::default();
        for (key, value) in [
            ("mode", r#""peer""#),
            ("listen/endpoints", r#"["tcp/127.0.0.1:0"]"#),
            ("scouting/multicast/enabled", "false"),
            ("scouting/gossip/enabled", "false"),
        ] {
            config.insert_json5(key, value).unwrap();
        }
        let session = zenoh::open(config).await.unwrap();
        let locator = session.info().locators().await[0].to_string();
        let directory = tempfile::tempdir().unwrap();
        let configuration = directory.path().join("client.json5");
        let text = format!(
            "{{ mode: 'client', connect: {{ endpoints: ['{locator}'] }}, scouting: {{ multicast: \
             {{ enabled: false }}, gossip: {{ enabled: false }} }} }}"
        );
        fs::write(&configuration, text).unwrap();
        Self { session, configuration, directory }
    }

    /// Where a robot's state is.
    fn state(&self, robot: &str) -> PathBuf {
        self.directory.path().join(robot)
    }

    async fn robot(&self, name: &str) -> Robot {
        let publisher = async |key: &str| {
            let publisher = self.session.declare_publisher(format!("{name}/{key}"));
            publisher.congestion_control(CongestionControl::Block).await.unwrap()
        };
        let verdicts = self.session.declare_subscriber(format!("{name}/slam/verdict"));
        Robot {
            name: name.to_owned(),
            session: self.session.clone(),
            scan: publisher("scan").await,
            odom: publisher("odom").await,
            verdicts: verdicts.await.unwrap(),
        }
    }
}

/// What feeds one daemon, and asks it.
struct Robot {
    name: String,
    session: Session,
    scan: Publisher<'static>,
    odom: Publisher<'static>,
    verdicts: Subscriber<FifoChannelHandler<Sample>>,
}

impl Robot {
    /// Waits until a daemon listens.
    async fn until_heard(&self) {
        for publisher in [&self.odom, &self.scan] {
            let listener = publisher.matching_listener().await.unwrap();
            while !publisher.matching_status().await.unwrap().matching() {
                let changed = tokio::time::timeout(PATIENCE, listener.recv_async());
                changed.await.expect("the daemon comes").unwrap();
            }
        }
    }

    /// Waits until nobody is linked: what the dead declared may not have been read yet.
    async fn until_alone(&self) {
        let start = clock::now();
        while self.session.info().transports().await.next().is_some() {
            assert!(start.elapsed() < PATIENCE, "the daemon stays");
            tokio::task::yield_now().await;
        }
    }

    async fn send(&self, moment: &Moment) {
        self.odom.put(&*moment.odometry).await.unwrap();
        self.scan.put(&*moment.scan).await.unwrap();
    }

    /// Feeds a moment, and waits for what becomes of its scan.
    async fn feed(&self, moment: &Moment) -> Option<String> {
        self.send(moment).await;
        loop {
            let sample = tokio::time::timeout(PATIENCE, self.verdicts.recv_async()).await;
            let sample = sample.expect("no verdict").unwrap();
            let entry: Value = serde_json::from_slice(&sample.payload().to_bytes()).unwrap();
            if entry["stamp"] == moment.stamp {
                return Some(entry["verdict"].as_str()?.to_owned());
            }
        }
    }

    async fn feed_all(&self, moments: &[Moment]) -> Vec<String> {
        let mut verdicts = Vec::new();
        for moment in moments {
            verdicts.extend(self.feed(moment).await);
        }
        verdicts
    }

    /// The answer, or the error.
    async fn ask(&self, what: &str) -> Result<Vec<u8>, String> {
        let replies = self.session.get(format!("{}/{what}", self.name)).await.unwrap();
        let reply = replies.recv_async().await.unwrap();
        match reply.result() {
            Ok(sample) => Ok(sample.payload().to_bytes().to_vec()),
            Err(error) => Err(error.payload().try_to_string().unwrap().into_owned()),
        }
    }

    async fn status(&self) -> Value {
        serde_json::from_slice(&self.ask("slam/status").await.unwrap()).unwrap()
    }

    /// Waits until the status of the checkpoints is as `wanted`.
    async fn until_checkpoint(&self, wanted: impl Fn(&Value) -> bool) -> Value {
        let start = clock::now();
        loop {
            let status = self.status().await["checkpoint"].take();
            if wanted(&status) {
                return status;
            }
            assert!(start.elapsed() < PATIENCE, "{status}");
            tokio::task::yield_now().await;
        }
    }

    /// Where the robot is.
    async fn pose(&self) -> Pose2 {
        let pose = &self.status().await["pose_in_map"];
        let [x, y, theta] = ["x", "y", "theta"].map(|axis| pose[axis].as_f64().unwrap());
        Pose2::new(x, y, theta)
    }

    /// The map's picture and the path.
    async fn results(&self) -> [Vec<u8>; 2] {
        [self.ask("map?format=pgm").await.unwrap(), self.ask("path?format=tum").await.unwrap()]
    }
}

/// A daemon.
struct Daemon(Child);

impl Daemon {
    /// Starts one, which is not ready yet.
    fn spawn(mesh: &Mesh, robot: &str, arguments: &[&str]) -> Self {
        Self::of(Command::new(env!("CARGO_BIN_EXE_gmapd")), mesh, robot, arguments)
    }

    fn of(mut command: Command, mesh: &Mesh, robot: &str, arguments: &[&str]) -> Self {
        command.args(["run", "--prefix", robot, "--zenoh"]);
        command.arg(&mesh.configuration).arg("--state").arg(mesh.state(robot));
        if !arguments.contains(&"--threads") {
            command.args(["--threads", "1"]);
        }
        for set in ["particles=4", "linearUpdate=0.3", "scan_queue=500"] {
            command.args(["--set", set]);
        }
        command.args(arguments).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        Self(command.spawn().unwrap())
    }

    async fn start(mesh: &Mesh, robot: &Robot, arguments: &[&str]) -> Self {
        let daemon = Self::spawn(mesh, &robot.name, arguments);
        robot.until_heard().await;
        daemon
    }

    async fn kill(mut self, robot: &Robot) {
        self.0.kill().unwrap();
        self.0.wait().unwrap();
        robot.until_alone().await;
        // Verdicts of the dead are none of the next.
        while robot.verdicts.try_recv().unwrap().is_some() {}
    }

    async fn terminate(mut self, robot: &Robot) {
        let id = self.0.id().to_string();
        assert!(Command::new("kill").arg(id).status().unwrap().success());
        assert!(self.0.wait().unwrap().success());
        robot.until_alone().await;
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        self.0.kill().ok();
        self.0.wait().ok();
    }
}

const EVERY_SCAN: [&str; 2] = ["--set", "checkpoint={every_scans: 1}"];

const ENGINES: [&[&str]; 3] = [
    &["--set", "engine=gmapping"],
    &["--set", "engine=hector"],
    &["--set", "engine=known_poses", "--set", "odometry_source=odom"],
];

/// What a daemon makes of the moments that is not disturbed.
async fn undisturbed(mesh: &Mesh, engine: &[&str], moments: &[Moment]) -> [Vec<u8>; 2] {
    let robot = mesh.robot("undisturbed").await;
    let daemon = Daemon::start(mesh, &robot, engine).await;
    robot.feed_all(moments).await;
    let results = robot.results().await;
    daemon.terminate(&robot).await;
    fs::remove_dir_all(mesh.state("undisturbed")).unwrap();
    results
}

#[tokio::test(flavor = "multi_thread")]
async fn after_a_kill_the_map_is_as_if_nothing_had_happened() {
    let mesh = Mesh::new().await;
    let moments = drive(160);
    for engine in ENGINES {
        let expected = undisturbed(&mesh, engine, &moments).await;
        let robot = mesh.robot("robot01").await;
        let arguments = [engine, &EVERY_SCAN].concat();
        let daemon = Daemon::start(&mesh, &robot, &arguments).await;
        robot.feed_all(&moments[..90]).await;
        let written = robot.until_checkpoint(|status| status["last"]["scans"] == 90).await;
        assert_eq!(written["last"]["stamp"], moments[89].stamp);
        daemon.kill(&robot).await;

        let start = clock::now();
        let daemon = Daemon::start(&mesh, &robot, &arguments).await;
        println!("{engine:?}: listens again after {:?}", start.elapsed());
        let status = robot.status().await;
        assert_eq!(status["checkpoint"]["resumed_from"], written["last"]["file"]);
        assert!(status["map"]["width"].as_u64() > Some(10), "{}", status["map"]);
        // From the first on, as a client does that knows nothing of the restart.
        let verdicts = robot.feed_all(&moments).await;
        assert!(verdicts[..90].iter().all(|verdict| verdict == "duplicate"), "{verdicts:?}");
        assert!(verdicts[90..].iter().any(|verdict| verdict == "processed"), "{verdicts:?}");
        assert!(robot.results().await == expected, "{engine:?}");
        daemon.terminate(&robot).await;

        // The last one is written at the end, so that nothing has to be fed again.
        let daemon = Daemon::start(&mesh, &robot, &arguments).await;
        assert!(robot.results().await == expected, "{engine:?}");
        daemon.kill(&robot).await;
        fs::remove_dir_all(mesh.state("robot01")).unwrap();
    }
}

/// A robot whose daemon is killed again and again; each time takes a few hundredths of a second.
struct Victim {
    name: &'static str,
    engine: &'static [&'static str],
    arguments: &'static [&'static str],
    /// Scans that need not be on the disk when nothing is being written.
    interval: usize,
    kills: usize,
}

const VICTIMS: [Victim; 4] = [
    Victim {
        name: "each-scan",
        engine: ENGINES[0],
        arguments: &EVERY_SCAN,
        interval: 1,
        kills: 120,
    },
    Victim {
        name: "two-threads",
        engine: ENGINES[0],
        arguments: &["--set", "checkpoint={every_scans: 5}", "--threads", "2"],
        interval: 5,
        kills: 60,
    },
    Victim {
        name: "without-particles",
        engine: ENGINES[1],
        arguments: &["--set", "checkpoint={every_scans: 5}"],
        interval: 5,
        kills: 60,
    },
    Victim {
        name: "by-time",
        engine: ENGINES[2],
        arguments: &["--set", "checkpoint={every_scans: 100000, every_s: 0.1}"],
        interval: 1,
        kills: 60,
    },
];

/// Moments that are fed again though they are not lost.
const AGAIN: usize = 5;

/// What is known of a daemon that was killed.
#[derive(Debug, Default)]
struct Losses {
    /// Scans that were sent.
    sent: usize,
    /// Of these, so many are known to be on the disk.
    written: usize,
    /// The most that a kill lost, those without a verdict among them.
    most: usize,
    /// Kills while a checkpoint was being written.
    in_writing: usize,
}

impl Losses {
    /// What a daemon that was just started has, which is what must be on the disk at least.
    async fn look(&mut self, robot: &Robot, moments: &[Moment]) -> usize {
        let checkpoint = robot.status().await["checkpoint"].take();
        let kept = up_to(moments, &checkpoint["resumed_stamp"]);
        let possible = self.written..=self.sent;
        assert!(possible.contains(&kept), "{kept} is not in {self:?}: {checkpoint}");
        assert_eq!(checkpoint["refused"], serde_json::json!([]));
        self.written = kept;
        kept
    }

    /// Waits until nothing is to be written: then less than an interval can be lost.
    async fn rest(&mut self, robot: &Robot, victim: &Victim, moments: &[Moment]) {
        let least = self.sent.saturating_sub(victim.interval - 1);
        let rests = |status: &Value| {
            let last = [&status["last"]["stamp"], &status["resumed_stamp"]];
            last.iter().any(|stamp| up_to(moments, stamp) >= least)
        };
        robot.until_checkpoint(rests).await;
        self.written = self.written.max(least);
    }
}

/// How many moments there are until a stamp; none until `null`.
fn up_to(moments: &[Moment], stamp: &Value) -> usize {
    moments.iter().take_while(|moment| Some(moment.stamp) <= stamp.as_i64()).count()
}

/// Files that somebody began to write and did not end.
fn unfinished(directory: &Path) -> usize {
    let names = fs::read_dir(directory).into_iter().flatten().flatten();
    let names = names.map(|entry| entry.file_name().into_string().unwrap());
    names.filter(|name| name.starts_with(".checkpoint-") && name.ends_with(".tmp")).count()
}

/// One life: it goes on where the one before was, is fed, and is killed at any moment.
async fn live(
    mesh: &Mesh,
    robot: &Robot,
    (victim, moments): (&Victim, &[Moment]),
    (losses, rng): (&mut Losses, &mut ChaCha8Rng),
) {
    let daemon = Daemon::start(mesh, robot, &[victim.engine, victim.arguments].concat()).await;
    let told = losses.sent;
    let kept = losses.look(robot, moments).await;
    let again = kept - AGAIN.min(kept);
    losses.sent = losses.sent.max(kept) + rng.random_range(0..8);
    let verdicts = robot.feed_all(&moments[again..losses.sent]).await;
    let (known, new) = verdicts.split_at(kept - again);
    assert!(known.iter().all(|verdict| verdict == "duplicate"), "{losses:?}: {known:?}");
    assert!(new.iter().all(|verdict| verdict != "duplicate"), "{losses:?}: {new:?}");
    losses.most = losses.most.max(told - kept);
    if rng.random_bool(0.5) {
        losses.rest(robot, victim, moments).await;
    }
    // Nobody knows what becomes of these.
    for _ in 0..rng.random_range(0..4) {
        robot.send(&moments[losses.sent]).await;
        losses.sent += 1;
    }
    tokio::time::sleep(Duration::from_micros(rng.random_range(0..4000))).await;
    daemon.kill(robot).await;
    losses.in_writing += unfinished(&mesh.state(&robot.name));
}

/// Kills a daemon before it has read its state, while it does, or just after.
async fn nip_in_the_bud(mesh: &Mesh, robot: &Robot, victim: &Victim, rng: &mut ChaCha8Rng) {
    let arguments = [victim.engine, victim.arguments].concat();
    let daemon = Daemon::spawn(mesh, &robot.name, &arguments);
    tokio::time::sleep(Duration::from_millis(rng.random_range(0..150))).await;
    daemon.kill(robot).await;
}

/// Kills that came while a checkpoint was being written.
async fn survives(mesh: &Mesh, victim: &Victim) -> usize {
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    // In a life, seven scans with a verdict and three without at most.
    let moments = drive(victim.kills * 10 + 20);
    let robot = mesh.robot(victim.name).await;
    let mut losses = Losses::default();
    for round in 0..victim.kills {
        if round % 10 == 9 {
            nip_in_the_bud(mesh, &robot, victim, &mut rng).await;
        }
        live(mesh, &robot, (victim, &moments), (&mut losses, &mut rng)).await;
    }
    let Losses { sent, most, in_writing, .. } = losses;
    println!("{}: {in_writing} kills in writing, {most} of {sent} scans lost at most", victim.name);
    let moments = &moments[..sent + 10];
    let daemon = Daemon::start(mesh, &robot, &[victim.engine, victim.arguments].concat()).await;
    robot.feed_all(moments).await;
    let results = robot.results().await;
    daemon.terminate(&robot).await;
    let kept = checkpoints(&mesh.state(victim.name)).len();
    assert!(kept <= 4, "{kept} checkpoints are kept");
    assert!(results == undisturbed(mesh, victim.engine, moments).await, "{}", victim.name);
    in_writing
}

#[tokio::test(flavor = "multi_thread")]
async fn it_survives_any_number_of_kills_at_any_moment_and_loses_no_more_than_the_interval() {
    let mesh = Mesh::new().await;
    let mut in_writing = 0;
    for victim in &VICTIMS {
        in_writing += survives(&mesh, victim).await;
    }
    assert!(in_writing > 0, "no kill came while a checkpoint was being written");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_damaged_or_foreign_checkpoint_is_told_and_the_one_before_is_taken() {
    let mesh = Mesh::new().await;
    let moments = drive(60);
    let robot = mesh.robot("robot01").await;
    let daemon = Daemon::start(&mesh, &robot, &EVERY_SCAN).await;
    for scans in [10, 20, 30] {
        robot.feed_all(&moments[scans - 10..scans]).await;
        robot.until_checkpoint(|status| status["last"]["scans"] == scans).await;
    }
    daemon.kill(&robot).await;
    let files = checkpoints(&mesh.state("robot01"));
    let [newest, second, third] = [0, 1, 2].map(|index| files[index].1.clone());
    let bytes = fs::read(&newest).unwrap();
    fs::write(&newest, &bytes[..bytes.len() / 2]).unwrap();
    let mut flipped = fs::read(&second).unwrap();
    let middle = flipped.len() / 2;
    flipped[middle] ^= 4;
    fs::write(&second, &flipped).unwrap();

    let daemon = Daemon::start(&mesh, &robot, &EVERY_SCAN).await;
    let status = robot.status().await["checkpoint"].take();
    assert_eq!(status["resumed_from"], name(&third));
    assert_eq!(status["refused"][0]["file"], name(&newest));
    let reason = status["refused"][0]["reason"].as_str().unwrap();
    assert!(reason.starts_with(&format!("it has {} bytes, and should", bytes.len() / 2)));
    let reason = "it is damaged: its checksum does not fit its bytes";
    assert_eq!(status["refused"][1]["reason"], reason);
    robot.feed_all(&moments).await;
    daemon.terminate(&robot).await;
    // What is damaged stays for whoever wants to look at it.
    assert_eq!(fs::read(&second).unwrap(), flipped);
    let info = info(&mesh.state("robot01"), &["--json"]);
    let info: Value = serde_json::from_str(&info).unwrap();
    assert_eq!(info[0]["good"], true);
    assert!(info[0]["head"]["scans"].as_u64() > Some(60), "{info}");
    assert_eq!(info[0]["head"]["engine"], "gmapping");
    assert_eq!(info.as_array().unwrap().iter().filter(|file| file["good"] == false).count(), 2);

    // With other particles, none of them can be gone on from.
    let other = [&EVERY_SCAN[..], &["--set", "particles=5"]].concat();
    let daemon = Daemon::start(&mesh, &robot, &other).await;
    let status = robot.status().await["checkpoint"].take();
    assert_eq!(status["resumed_from"], Value::Null);
    let reason = "it is of another configuration: particles was 4, and is 5";
    assert_eq!(status["refused"][0]["reason"], reason);
    daemon.terminate(&robot).await;
}

/// Its checksum fits, but not all that is in it: nobody knows what other programs write.
#[tokio::test(flavor = "multi_thread")]
async fn a_forged_checkpoint_is_refused_or_does_no_harm() {
    let mesh = Mesh::new().await;
    let moments = drive(40);
    for engine in ENGINES {
        let robot = mesh.robot("robot01").await;
        let daemon = Daemon::start(&mesh, &robot, engine).await;
        robot.feed_all(&moments[..20]).await;
        daemon.terminate(&robot).await;
        let path = checkpoints(&mesh.state("robot01")).remove(0).1;
        let bytes = fs::read(&path).unwrap();
        let opened = checkpoint::open(&bytes).unwrap();
        let body = opened.body().unwrap();
        let mut again = Vec::new();
        Checkpoint::decode(&opened).unwrap().write(&mut again).unwrap();
        assert!(again == body, "decoding and encoding gives the same bytes");

        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut taken = 0;
        for _ in 0..25 {
            let mut forged = body.clone();
            forged[rng.random_range(0..body.len())] ^= 1 << rng.random_range(0..8);
            let sealed = checkpoint::seal(opened.head.clone(), |to| to.write_all(&forged));
            fs::write(&path, sealed.unwrap()).unwrap();
            let daemon = Daemon::start(&mesh, &robot, engine).await;
            let status = robot.status().await["checkpoint"].take();
            taken += usize::from(status["resumed_from"] != Value::Null);
            assert_eq!(
                status["refused"].as_array().unwrap().is_empty(),
                !status["resumed_from"].is_null()
            );
            let verdicts = robot.feed_all(&moments[20..23]).await;
            assert_eq!(verdicts.len(), 3);
            daemon.kill(&robot).await;
        }
        println!("{engine:?}: {taken} of 25 are gone on from");
        fs::remove_dir_all(mesh.state("robot01")).unwrap();
    }
}

fn name(path: &Path) -> &str {
    path.file_name().unwrap().to_str().unwrap()
}

fn info(path: &Path, arguments: &[&str]) -> String {
    let mut command = Command::new(env!("CARGO_BIN_EXE_gmapd"));
    let output = command.args(["state", "info"]).args(arguments).arg(path).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn what_cannot_be_written_is_told_and_mapping_goes_on() {
    let mesh = Mesh::new().await;
    let moments = drive(40);
    let robot = mesh.robot("robot01").await;
    // Nobody can make a file there, root neither.
    std::os::unix::fs::symlink("/proc/self", mesh.state("robot01")).unwrap();
    let daemon = Daemon::start(&mesh, &robot, &EVERY_SCAN).await;
    let verdicts = robot.feed_all(&moments[..20]).await;
    assert!(verdicts.iter().any(|verdict| verdict == "processed"));
    let status = robot.until_checkpoint(|status| status["error"] != Value::Null).await;
    let error = status["error"].as_str().unwrap();
    assert!(error.starts_with("the state is not written: cannot write /"), "{error}");
    let error = robot.ask("slam/cmd/checkpoint").await.unwrap_err();
    assert!(error.starts_with("the state is not written"), "{error}");
    daemon.terminate(&robot).await;
    let often = ["--set", "checkpoint={every_s: 0.2, every_scans: 1}"];
    let daemon = Daemon::start(&mesh, &robot, &often).await;
    robot.feed(&moments[20]).await;
    robot.until_checkpoint(|status| status["error"] != Value::Null).await;
    // Once it can be written, it is, though no scan comes.
    fs::remove_file(mesh.state("robot01")).unwrap();
    robot.until_checkpoint(|status| status["written"] == 1).await;
    daemon.terminate(&robot).await;
    fs::remove_dir_all(mesh.state("robot01")).unwrap();

    // Files may have 16 KiB, as on a disk that is nearly full: the first states fit.
    let mut limited = Command::new("sh");
    let script = r#"trap "" XFSZ; ulimit -f 32; exec "$0" "$@""#;
    limited.args(["-c", script, env!("CARGO_BIN_EXE_gmapd")]);
    let daemon = Daemon::of(limited, &mesh, "robot01", &EVERY_SCAN);
    robot.until_heard().await;
    robot.feed_all(&moments[..2]).await;
    let before = robot.until_checkpoint(|status| status["written"].as_u64() > Some(0)).await;
    assert_eq!(before["error"], Value::Null);
    let more = drive(400);
    let verdicts = robot.feed_all(&more[2..]).await;
    assert!(verdicts.iter().rev().take(50).any(|verdict| verdict == "processed"));
    let status = robot.until_checkpoint(|status| status["error"] != Value::Null).await;
    let error = status["error"].as_str().unwrap();
    assert!(error.contains("File too large"), "{error}");
    let last = status["last"]["file"].as_str().unwrap().to_owned();
    daemon.kill(&robot).await;

    let daemon = Daemon::start(&mesh, &robot, &EVERY_SCAN).await;
    assert_eq!(robot.status().await["checkpoint"]["resumed_from"], last);
    daemon.terminate(&robot).await;
}

/// A small disk, which only programs that were started on it see.
struct SmallDisk {
    holder: Child,
    mounted_on: PathBuf,
}

impl SmallDisk {
    /// `None` without the rights to have one.
    fn new(directory: &Path) -> Option<Self> {
        fs::create_dir_all(directory).unwrap();
        let script = r#"mount -t tmpfs -o size=2M tmpfs "$0" && echo mounted && exec sleep 1000"#;
        let mut holder = Command::new("unshare")
            .args(["--mount", "sh", "-c", script])
            .arg(directory)
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(holder.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let disk = Self { holder, mounted_on: directory.to_owned() };
        let is_root = Command::new("id").arg("-u").output().unwrap().stdout == b"0\n";
        let must = is_root && std::env::var_os("GMAPD_CI").is_some();
        assert!(line == "mounted\n" || !must, "root can mount no disk");
        (line == "mounted\n").then_some(disk)
    }

    /// Runs a command where the disk is.
    fn command(&self, words: &[&str]) -> Command {
        let mut command = Command::new("nsenter");
        command.args(["--mount", "--target", &self.holder.id().to_string()]).args(words);
        command
    }

    /// What is on it, as it is seen from outside.
    fn path(&self) -> PathBuf {
        let root = PathBuf::from(format!("/proc/{}/root", self.holder.id()));
        root.join(self.mounted_on.strip_prefix("/").unwrap())
    }

    /// The bytes of each checkpoint.
    fn files(&self) -> Vec<(u64, Vec<u8>)> {
        let files = checkpoints(&self.path()).into_iter();
        files.map(|(number, path)| (number, fs::read(path).unwrap())).collect()
    }

    /// Until nothing goes on it any more.
    fn fill(&self) {
        let mut file = File::create(self.path().join("filler")).unwrap();
        while file.write_all(&[7; 4096]).is_ok() {}
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        self.holder.kill().ok();
        self.holder.wait().ok();
    }
}

/// Feeds scans to a daemon that cannot write; what is on the disk stays as it is.
async fn goes_on_without_writing(robot: &Robot, moments: &[Moment], disk: &SmallDisk, why: &str) {
    let before = disk.files();
    let verdicts = robot.feed_all(moments).await;
    assert!(verdicts.iter().any(|verdict| verdict == "processed"), "{verdicts:?}");
    let status = robot.until_checkpoint(|status| status["error"] != Value::Null).await;
    assert!(status["error"].as_str().unwrap().contains(why), "{status}");
    assert!(!before.is_empty() && disk.files() == before, "files are others than before");
    assert_eq!(unfinished(&disk.path()), 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn on_a_full_or_read_only_disk_mapping_goes_on_and_what_is_there_stays() {
    let mesh = Mesh::new().await;
    let Some(disk) = SmallDisk::new(&mesh.state("robot01")) else {
        return eprintln!("skipped: only root can mount a small disk");
    };
    let moments = drive(120);
    let robot = mesh.robot("robot01").await;
    let gmapd = || disk.command(&[env!("CARGO_BIN_EXE_gmapd")]);
    let daemon = Daemon::of(gmapd(), &mesh, "robot01", &EVERY_SCAN);
    robot.until_heard().await;
    robot.feed_all(&moments[..20]).await;
    robot.until_checkpoint(|status| status["last"]["scans"] == 20).await;
    disk.fill();
    goes_on_without_writing(&robot, &moments[20..50], &disk, "No space left on device").await;
    fs::remove_file(disk.path().join("filler")).unwrap();
    robot.feed_all(&moments[50..60]).await;
    let status = robot.until_checkpoint(|status| status["last"]["scans"] == 60).await;
    assert_eq!(status["error"], Value::Null);
    daemon.kill(&robot).await;

    let mut remount = disk.command(&["mount", "-o", "remount,ro"]);
    assert!(remount.arg(&disk.mounted_on).status().unwrap().success());
    let daemon = Daemon::of(gmapd(), &mesh, "robot01", &EVERY_SCAN);
    robot.until_heard().await;
    let checkpoint = robot.status().await["checkpoint"].take();
    assert_eq!(checkpoint["resumed_from"], status["last"]["file"]);
    assert_eq!(checkpoint["resumed_stamp"], moments[59].stamp);
    goes_on_without_writing(&robot, &moments[60..], &disk, "Read-only file system").await;
    daemon.terminate(&robot).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_checkpoint_can_be_asked_for_and_holds_what_was_commanded() {
    let mesh = Mesh::new().await;
    let moments = drive(40);
    let robot = mesh.robot("robot01").await;
    let daemon = Daemon::start(&mesh, &robot, &[]).await;
    robot.feed_all(&moments[..20]).await;
    let done = String::from_utf8(robot.ask("slam/cmd/checkpoint").await.unwrap()).unwrap();
    assert!(done.contains("checkpoint-0000000001.state"), "{done}");
    let [path] = [checkpoints(&mesh.state("robot01")).remove(0).1];
    let text = info(&path, &[]);
    for part in ["good", "robot01", "gmapping, 4 hypotheses", "cells of 0.05 m", "format 2"] {
        assert!(text.contains(part), "{part}: {text}");
    }
    // What a command changed is written at once.
    robot.ask("slam/cmd/pause").await.unwrap();
    robot.until_checkpoint(|status| status["written"] == 2).await;
    // Nothing was changed, and so nothing is written.
    robot.ask("slam/cmd/pause").await.unwrap();
    let done = String::from_utf8(robot.ask("slam/cmd/checkpoint").await.unwrap()).unwrap();
    assert!(done.contains("checkpoint-0000000003.state"), "{done}");
    let two = Command::new(env!("CARGO_BIN_EXE_gmapd"))
        .args(["run", "--zenoh"])
        .arg(&mesh.configuration)
        .arg("--state")
        .arg(mesh.state("robot01"))
        .output()
        .unwrap();
    assert_eq!(two.status.code(), Some(1));
    let error = String::from_utf8(two.stderr).unwrap();
    assert!(error.contains("another daemon keeps its state in"), "{error}");
    daemon.kill(&robot).await;
    let daemon = Daemon::start(&mesh, &robot, &[]).await;
    assert_eq!(robot.status().await["state"], "paused");
    assert_eq!(robot.feed(&moments[20]).await.unwrap(), "paused");
    daemon.terminate(&robot).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_map_goes_on_in_the_mode_that_was_configured_or_commanded_last() {
    let mesh = Mesh::new().await;
    let moments = drive(40);
    let robot = mesh.robot("robot01").await;
    let daemon = Daemon::start(&mesh, &robot, &[]).await;
    robot.feed_all(&moments[..20]).await;
    robot.ask("slam/cmd/checkpoint").await.unwrap();
    daemon.kill(&robot).await;

    let localizing = ["--set", "mode=localization", "--set", "commands_per_second=3"];
    let empty = tempfile::tempdir().unwrap();
    let error = complaint(&mesh, empty.path(), &localizing);
    assert!(error.contains("has no state of this robot with a map to go on from"), "{error}");
    let daemon = Daemon::start(&mesh, &robot, &localizing).await;
    let status = robot.status().await;
    assert_eq!(status["mode"], "localization");
    let area = status["map"]["known_area_m2"].clone();
    assert!(area.as_f64().unwrap() > 1.0, "{status}");
    robot.feed_all(&moments[20..30]).await;
    assert_eq!(robot.status().await["map"]["known_area_m2"], area);
    robot.ask("slam/cmd/mode?mode=mapping").await.unwrap();
    robot.until_checkpoint(|status| status["written"] == 1).await;
    daemon.kill(&robot).await;

    let daemon = Daemon::start(&mesh, &robot, &localizing).await;
    assert_eq!(robot.status().await["mode"], "mapping");
    robot.ask("slam/cmd/mode?mode=localization").await.unwrap();
    robot.until_checkpoint(|status| status["written"] == 1).await;
    daemon.kill(&robot).await;

    let daemon = Daemon::start(&mesh, &robot, &localizing).await;
    assert_eq!(robot.status().await["mode"], "localization");
    daemon.terminate(&robot).await;
}

/// Metres between two poses.
fn apart(a: Pose2, b: Pose2) -> f64 {
    (a.x - b.x).hypot(a.y - b.y)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_robot_that_was_carried_is_where_it_is_said_to_be() {
    let mesh = Mesh::new().await;
    let moments = drive(80);
    for engine in &ENGINES[..2] {
        let robot = mesh.robot("robot01").await;
        let daemon = Daemon::start(&mesh, &robot, engine).await;
        robot.feed_all(&moments[..20]).await;
        let Pose2 { x, y, theta } = robot.pose().await;
        robot.feed_all(&moments[20..60]).await;
        let there = robot.pose().await;
        robot.feed_all(&moments[60..]).await;
        daemon.terminate(&robot).await;

        // As an operator points at where it was after 20 moments; odometry has another origin.
        let given = format!("{},{},{theta}", x + 0.1, y - 0.1);
        let said = [engine, &["--initial-pose", given.as_str()][..]].concat();
        let again = drive_after(60, 1000, odometry_elsewhere(&moments));
        let daemon = Daemon::start(&mesh, &robot, &said).await;
        assert_ne!(robot.status().await["checkpoint"]["resumed_from"], Value::Null);
        assert!(apart(robot.pose().await, Pose2::new(x + 0.1, y - 0.1, theta)) < 1e-6);
        robot.until_checkpoint(|status| status["written"] == 1).await;
        daemon.kill(&robot).await;

        // A pose that is said already says nothing new, in which checkpoint it may be.
        let daemon = Daemon::start(&mesh, &robot, &said).await;
        robot.feed_all(&again[20..]).await;
        let pose = robot.pose().await;
        assert!(apart(pose, there) < 0.25, "{engine:?}: {pose:?}, and not {there:?}");
        daemon.terminate(&robot).await;
        let daemon = Daemon::start(&mesh, &robot, &said).await;
        assert!(apart(robot.pose().await, pose) < 1e-6);
        daemon.kill(&robot).await;
        fs::remove_dir_all(mesh.state("robot01")).unwrap();
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn the_place_of_a_robot_that_was_carried_is_searched_for_in_its_map() {
    let mesh = Mesh::new().await;
    let moments = drive(80);
    for engine in &ENGINES[..2] {
        let robot = mesh.robot("robot01").await;
        let search = [engine, &["--initial-pose", "search"][..]].concat();
        let daemon = Daemon::start(&mesh, &robot, engine).await;
        robot.feed_all(&moments[..40]).await;
        let there = robot.pose().await;
        robot.feed_all(&moments[40..]).await;
        let area = robot.status().await["map"]["known_area_m2"].clone();
        daemon.terminate(&robot).await;

        let daemon = Daemon::start(&mesh, &robot, &search).await;
        let error = robot.ask("pose").await.unwrap_err();
        assert!(error.starts_with("the pose is not known yet"), "{error}");
        robot.until_checkpoint(|status| status["written"] == 1).await;
        daemon.kill(&robot).await;

        // Until its place is found, each restart goes on searching.
        let again = drive_after(41, 1000, odometry_elsewhere(&moments));
        let blind = Moment { scan: no_walls(&again[20]), ..again[20].clone() };
        let daemon = Daemon::start(&mesh, &robot, &search).await;
        assert!(robot.ask("pose").await.is_err());
        assert_eq!(robot.feed(&blind).await.unwrap(), "not_localized");
        let status = robot.status().await;
        assert_eq!(status["state"], "not_localized", "{status}");
        assert_eq!(status["map"]["known_area_m2"], area);
        let verdicts = robot.feed_all(&again[21..40]).await;
        assert!(verdicts.contains(&"processed".to_owned()), "{verdicts:?}");
        let pose = robot.pose().await;
        assert!(apart(pose, there) < 0.25, "{engine:?}: {pose:?}, and not {there:?}");
        daemon.kill(&robot).await;
        fs::remove_dir_all(mesh.state("robot01")).unwrap();
    }
}

/// The scan of a moment with all walls at one distance, as there are nowhere.
fn no_walls(moment: &Moment) -> Vec<u8> {
    let mut scan: ros::LaserScan = ros::decode(&moment.scan, "").unwrap();
    scan.ranges = vec![2.0; scan.ranges.len()];
    ros::cdr(&scan)
}

/// What a daemon says that does not start.
fn complaint(mesh: &Mesh, state: &Path, arguments: &[&str]) -> String {
    let mut command = Command::new(env!("CARGO_BIN_EXE_gmapd"));
    command.args(["run", "--prefix", "robot01", "--zenoh"]).arg(&mesh.configuration);
    let output = command.arg("--state").arg(state).args(arguments).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    String::from_utf8(output.stderr).unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn nobody_localizes_without_a_map() {
    let mesh = Mesh::new().await;
    let moments = drive(30);
    for engine in &ENGINES[..2] {
        let robot = mesh.robot("robot01").await;
        let localizing = [engine, &["--mode", "localization"][..]].concat();
        // Its state has no map.
        let daemon = Daemon::start(&mesh, &robot, engine).await;
        robot.ask("slam/cmd/pause").await.unwrap();
        robot.feed(&moments[0]).await;
        daemon.terminate(&robot).await;
        let set = ["--set", "particles=4", "--set", "linearUpdate=0.3"];
        let error = complaint(&mesh, &mesh.state("robot01"), &[&localizing, &set[..]].concat());
        assert!(error.contains("no state of this robot with a map to go on from"), "{error}");

        let daemon = Daemon::start(&mesh, &robot, engine).await;
        robot.ask("slam/cmd/resume").await.unwrap();
        robot.feed_all(&moments[1..10]).await;
        daemon.terminate(&robot).await;
        let daemon = Daemon::start(&mesh, &robot, &localizing).await;
        assert_eq!(robot.status().await["mode"], "localization");
        let done = String::from_utf8(robot.ask("slam/cmd/reset").await.unwrap()).unwrap();
        assert!(done.contains("begins a new map"), "{done}");
        assert_eq!(robot.status().await["mode"], "mapping");
        daemon.terminate(&robot).await;

        let daemon = Daemon::start(&mesh, &robot, &localizing).await;
        let verdicts = robot.feed_all(&moments[10..]).await;
        assert_eq!(verdicts[0], "processed");
        assert!(robot.status().await["map"]["known_area_m2"].as_f64() > Some(1.0));
        daemon.kill(&robot).await;
        fs::remove_dir_all(mesh.state("robot01")).unwrap();
    }
}

/// What takes odometry's poses to such with the origin a few metres from where the robot is.
fn odometry_elsewhere(moments: &[Moment]) -> Pose2 {
    Pose2::new(3.0, -2.0, 0.8) * moments[moments.len() - 1].odom_from_base.inverse()
}

#[tokio::test(flavor = "multi_thread")]
async fn odometry_that_begins_anew_after_a_power_cut_is_no_motion() {
    let mesh = Mesh::new().await;
    let moments = drive_after(120, 1000, Pose2::IDENTITY);
    let origin = moments[79].odom_from_base;
    assert!(moments[0].odom_from_base.between(origin).position().norm() > 1.0);
    let later = |seconds| drive_after(120, seconds, origin.inverse()).split_off(80);
    for engine in &ENGINES[..2] {
        let [_, expected] = undisturbed(&mesh, engine, &moments).await;
        // Stamped later, and by a clock that was set back.
        for seconds in [2000, 500] {
            let robot = mesh.robot("robot01").await;
            let daemon = Daemon::start(&mesh, &robot, engine).await;
            robot.feed_all(&moments[..80]).await;
            let before = robot.pose().await;
            daemon.terminate(&robot).await;
            let daemon = Daemon::start(&mesh, &robot, engine).await;
            let anew = later(seconds);
            robot.feed(&anew[0]).await;
            robot.feed(&anew[1]).await;
            robot.feed(&anew[2]).await;
            let pose = robot.pose().await;
            assert!(apart(pose, before) < 0.6, "{engine:?} {seconds}: {before:?} to {pose:?}");
            robot.feed_all(&anew[3..]).await;
            let status = robot.status().await;
            assert_eq!(status["filter"]["odometry_restarts"], 1, "{engine:?} {seconds}");
            let [_, path] = robot.results().await;
            let [end, expected] = [&path, &expected].map(|path| end_of(path));
            assert!(apart(end, expected) < 0.3, "{engine:?} {seconds}: {end:?}, not {expected:?}");
            daemon.kill(&robot).await;
            fs::remove_dir_all(mesh.state("robot01")).unwrap();
        }
    }
}

/// The last position of a path in TUM's format.
fn end_of(path: &[u8]) -> Pose2 {
    let last = std::str::from_utf8(path).unwrap().lines().last().unwrap();
    let numbers: Vec<f64> = last.split(' ').map(|word| word.parse().unwrap()).collect();
    Pose2::new(numbers[1], numbers[2], 0.0)
}

#[tokio::test(flavor = "multi_thread")]
async fn however_many_ask_a_slow_disk_for_a_checkpoint_one_is_written() {
    const ASKERS: usize = 4;
    let mesh = Mesh::new().await;
    let moments = drive(5);
    let robot = mesh.robot("robot01").await;
    let daemon = Daemon::start(&mesh, &robot, &EVERY_SCAN).await;
    // Opening a pipe to write waits for somebody who reads, as a disk that does not answer.
    let name = format!(".checkpoint-0000000001.state.{}.tmp", daemon.0.id());
    let pipe = mesh.state("robot01").join(name);
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    robot.feed_all(&moments).await;
    let mut replies = Vec::new();
    for _ in 0..ASKERS {
        replies.push(robot.session.get("robot01/slam/cmd/checkpoint").await.unwrap());
    }
    // Commands are done in the order in which they come, and this one after those.
    robot.ask("slam/cmd/pause").await.unwrap();
    let status = robot.status().await["checkpoint"].take();
    assert_eq!((&status["written"], &status["error"]), (&Value::from(0), &Value::Null));

    drop(fs::File::open(&pipe).unwrap());
    for reply in replies {
        let reply = tokio::time::timeout(PATIENCE, reply.recv_async()).await.unwrap().unwrap();
        let done = reply.result().unwrap().payload().try_to_string().unwrap().into_owned();
        assert!(done.contains("the state is in"), "{done}");
    }
    // A command that overtook another one costs one more.
    let written = robot.status().await["checkpoint"]["written"].as_u64().unwrap();
    assert!(written < ASKERS as u64, "{written}");
    daemon.kill(&robot).await;
}
