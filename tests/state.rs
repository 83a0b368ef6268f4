//! The real daemon, killed and started again: it goes on where it was, byte for byte.
#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use gmapd::checkpoint::{self, checkpoints};
use gmapd::clock;
use gmapd::convert::{self, OdometrySample};
use gmapd::daemon::checkpointing::Checkpoint;
use gmapd::ros;
use gmapd::sim::{self, Place, Scenario, Simulation};
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
}

/// The first moments of a drive through a building.
fn drive(moments: usize) -> Vec<Moment> {
    let scenario = Scenario { beams: 60, ..Scenario::new(Place::Building, 3) };
    let mut simulation = Simulation::new(&scenario).unwrap();
    simulation.lidar.mount = LaserMount::default();
    let moment = |reading: sim::Reading| {
        let odometry = OdometrySample {
            stamp: reading.stamp,
            odom_frame: "odom".to_owned(),
            base_frame: "base_link".to_owned(),
            odom_from_base: reading.odom_from_base,
        };
        Moment {
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

/// How many take what a robot sends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Daemons {
    None,
    One,
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
    async fn until(&self, expected: Daemons) {
        for publisher in [&self.odom, &self.scan] {
            let listener = publisher.matching_listener().await.unwrap();
            let there = expected == Daemons::One;
            while publisher.matching_status().await.unwrap().matching() != there {
                let changed = tokio::time::timeout(PATIENCE, listener.recv_async());
                changed.await.expect("the daemon comes and goes").unwrap();
            }
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
        command.args(["run", "--prefix", robot, "--threads", "1", "--zenoh"]);
        command.arg(&mesh.configuration).arg("--state").arg(mesh.state(robot));
        for set in ["particles=4", "linearUpdate=0.3", "scan_queue=500"] {
            command.args(["--set", set]);
        }
        command.args(arguments).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        Self(command.spawn().unwrap())
    }

    async fn start(mesh: &Mesh, robot: &Robot, arguments: &[&str]) -> Self {
        let daemon = Self::spawn(mesh, &robot.name, arguments);
        robot.until(Daemons::One).await;
        daemon
    }

    async fn kill(mut self, robot: &Robot) {
        self.0.kill().unwrap();
        self.0.wait().unwrap();
        robot.until(Daemons::None).await;
        // Verdicts of the dead are none of the next.
        while robot.verdicts.try_recv().unwrap().is_some() {}
    }

    async fn terminate(mut self, robot: &Robot) {
        let id = self.0.id().to_string();
        assert!(Command::new("kill").arg(id).status().unwrap().success());
        assert!(self.0.wait().unwrap().success());
        robot.until(Daemons::None).await;
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

/// Each takes a few hundredths of a second.
const KILLS: usize = 300;

/// Moments that are fed again though they are not lost.
const AGAIN: usize = 5;

#[tokio::test(flavor = "multi_thread")]
async fn it_survives_any_number_of_kills_at_any_moment() {
    let mesh = Mesh::new().await;
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    let rounds: Vec<usize> = (0..KILLS).map(|_| rng.random_range(0..8)).collect();
    let moments = drive(rounds.iter().sum::<usize>() + 20);
    let expected = undisturbed(&mesh, ENGINES[0], &moments).await;
    let robot = mesh.robot("robot01").await;
    // Of these, so many are known to be on the disk.
    let (mut fed, mut written, mut most_lost) = (0, 0, 0);
    for (round, more) in rounds.into_iter().enumerate() {
        if round % 10 == 9 {
            // Before it has read its state, while it does, or just after.
            let daemon = Daemon::spawn(&mesh, "robot01", &EVERY_SCAN);
            tokio::time::sleep(Duration::from_millis(rng.random_range(0..150))).await;
            daemon.kill(&robot).await;
        }
        let daemon = Daemon::start(&mesh, &robot, &EVERY_SCAN).await;
        let checkpoint = robot.status().await["checkpoint"].take();
        let kept = checkpoint["resumed_stamp"].as_i64();
        let kept = moments.iter().take_while(|moment| Some(moment.stamp) <= kept).count();
        let possible = written..=fed + 1;
        assert!(possible.contains(&kept), "{round}: {kept} of {fed}: {checkpoint}");
        most_lost = most_lost.max(fed.saturating_sub(kept));
        let again = kept - AGAIN.min(kept);
        let verdicts = robot.feed_all(&moments[again..(fed + more).max(kept)]).await;
        let (known, new) = verdicts.split_at(kept - again);
        assert!(known.iter().all(|verdict| verdict == "duplicate"), "round {round}: {known:?}");
        assert!(new.iter().all(|verdict| verdict != "duplicate"), "round {round}: {new:?}");
        fed += more;
        if round % 5 == 0 && fed > 0 {
            let last = moments[fed - 1].stamp;
            robot.until_checkpoint(|status| status["last"]["stamp"].as_i64() >= Some(last)).await;
            written = fed;
        }
        if round % 2 == 0 {
            // Nobody knows what becomes of this one.
            robot.send(&moments[fed]).await;
        }
        tokio::time::sleep(Duration::from_micros(rng.random_range(0..4000))).await;
        daemon.kill(&robot).await;
    }
    let daemon = Daemon::start(&mesh, &robot, &EVERY_SCAN).await;
    robot.feed_all(&moments).await;
    println!("at most {most_lost} scans were lost");
    assert!(robot.results().await == expected);
    daemon.terminate(&robot).await;
    let kept = checkpoints(&mesh.state("robot01")).len();
    assert!(kept <= 4, "{kept} checkpoints are kept");
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
        let again = Checkpoint::decode(&opened).unwrap().encode().unwrap();
        assert!(again == body, "decoding and encoding gives the same bytes");

        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut taken = 0;
        for _ in 0..25 {
            let mut forged = body.clone();
            forged[rng.random_range(0..body.len())] ^= 1 << rng.random_range(0..8);
            fs::write(&path, checkpoint::seal(opened.head.clone(), &forged).unwrap()).unwrap();
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
    fs::remove_file(mesh.state("robot01")).unwrap();

    // Files may have 16 KiB, as on a disk that is nearly full: the first states fit.
    let mut limited = Command::new("sh");
    let script = r#"trap "" XFSZ; ulimit -f 32; exec "$0" "$@""#;
    limited.args(["-c", script, env!("CARGO_BIN_EXE_gmapd")]);
    let daemon = Daemon::of(limited, &mesh, "robot01", &EVERY_SCAN);
    robot.until(Daemons::One).await;
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
    let refused = Command::new(env!("CARGO_BIN_EXE_gmapd"))
        .args(["run", "--zenoh"])
        .arg(&mesh.configuration)
        .arg("--state")
        .arg(empty.path())
        .args(localizing)
        .output()
        .unwrap();
    assert_eq!(refused.status.code(), Some(1));
    let error = String::from_utf8(refused.stderr).unwrap();
    assert!(error.contains("has no state of this robot to go on from"), "{error}");
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
