//! Strangers on the mesh: the ready configurations keep them out, and the daemon's own limits
//! hold against those who are in.
#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::io;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use gmapd::client::MapMirror;
use gmapd::config::Config;
use gmapd::daemon::keys::Prefix;
use gmapd::daemon::limits::Reason;
use gmapd::daemon::snapshot::State;
use gmapd::daemon::{Daemon, Settings};
use processes::text;
use tokio::sync::watch;
use tracing_subscriber::EnvFilter;
use zenoh::qos::CongestionControl;
use zenoh::query::Query;
use zenoh::{Session, Wait as _};

#[expect(dead_code, reason = "other tests use the rest")]
mod processes;

/// How long anything may take on a machine that does other things as well.
const PATIENCE: Duration = Duration::from_secs(60);

/// What all sessions of this process log.
#[derive(Debug, Clone)]
struct Log(Arc<watch::Sender<String>>);

impl Log {
    fn start() -> Self {
        static LOG: OnceLock<Log> = OnceLock::new();
        let log = LOG.get_or_init(|| {
            let log = Self(Arc::new(watch::Sender::default()));
            let writer = log.clone();
            // As `docs/security.md` says.
            let denials = "warn,zenoh_transport::unicast::establishment::accept=debug,\
                           zenoh::net::routing::interceptor=trace";
            tracing_subscriber::fmt()
                .with_env_filter(EnvFilter::new(denials))
                .with_ansi(false)
                .with_writer(move || writer.clone())
                .init();
            log
        });
        log.clone()
    }

    /// Waits for a line with all of these.
    async fn says(&self, words: &[&str]) {
        let mut text = self.0.subscribe();
        let said =
            |text: &String| text.lines().any(|line| words.iter().all(|word| line.contains(word)));
        let waited = tokio::time::timeout(PATIENCE, text.wait_for(said)).await.map(drop);
        assert!(waited.is_ok(), "{words:?} is not in\n{}", self.0.borrow().as_str());
    }
}

impl io::Write for Log {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.send_modify(|text| text.push_str(&String::from_utf8_lossy(bytes)));
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// A copy of the ready configurations, with certificates.
struct Mesh {
    log: Log,
    directory: tempfile::TempDir,
    /// Which of the configurations.
    kind: &'static str,
    router: Session,
    locator: String,
}

fn secure() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("config/secure")
}

fn make_certificates(directory: &Path, names: &[&str]) {
    let script = secure().join("certificates.sh");
    let output = Command::new(script).arg(directory).args(names).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

/// A router, and how it is reached.
async fn router(configuration: &str) -> (Session, String) {
    let router = zenoh::open(zenoh::Config::from_json5(configuration).unwrap()).await.unwrap();
    let locator = router.info().locators().await[0].to_string();
    let port = locator.rsplit(':').next().unwrap();
    let locator = format!("quic/localhost:{port}");
    (router, locator)
}

impl Mesh {
    /// The router of `config/secure` or a folder in it, on a port of the loopback.
    async fn start(kind: &'static str) -> Self {
        let log = Log::start();
        let directory = tempfile::tempdir().unwrap();
        let names = ["router", "robot01", "robot02", "base", "reader"];
        make_certificates(&directory.path().join("certificates"), &names);
        make_certificates(&directory.path().join("strangers"), &["robot01"]);
        let users = secure().join("password/users.txt");
        std::fs::copy(users, directory.path().join("users.txt")).unwrap();
        let text = configuration(directory.path(), kind, "router.json5");
        let text = text.replace("quic/0.0.0.0:7447", "quic/127.0.0.1:0");
        let (router, locator) = router(&text).await;
        Self { log, directory, kind, router, locator }
    }

    /// Another router, with somebody's certificate.
    async fn router_with(&self, certificate: &str) -> (Session, String) {
        let text = configuration(self.directory.path(), self.kind, "router.json5");
        let text = text.replace("quic/0.0.0.0:7447", "quic/127.0.0.1:0");
        router(&text.replace("certificates/router", certificate)).await
    }

    /// How `who` connects; a stranger is refused at once.
    fn configuration(&self, who: &str) -> String {
        configuration(self.directory.path(), self.kind, &format!("{who}.json5"))
            .replace("quic/localhost:7447", &self.locator)
            .replace("timeout_ms: -1", "timeout_ms: 0")
    }

    async fn open(&self, who: &str) -> Session {
        let config = zenoh::Config::from_json5(&self.configuration(who)).unwrap();
        zenoh::open(config).await.unwrap()
    }

    async fn refuses(&self, configuration: &str) {
        let config = zenoh::Config::from_json5(configuration).unwrap();
        let opened = tokio::time::timeout(PATIENCE, zenoh::open(config)).await.unwrap();
        assert!(opened.is_err(), "let in with {configuration}");
    }

    /// What holds for everybody who is in, with certificates or passwords.
    async fn keeps_each_to_what_is_theirs(&self) {
        let robot = self.open("robot").await;
        let daemon = Daemon::start(&robot, settings(&[])).await.unwrap();
        let [base, reader] = [self.open("base").await, self.open("reader").await];
        for selector in ["robot01/slam/status", "*/slam/status", "robot01/map?format=json"] {
            assert_eq!(ask_until_answered(&reader, selector).await.len(), 1);
        }

        assert!(ask(&reader, "robot01/slam/cmd/pause").await.is_empty());
        let wildcard = ask_until_answered(&reader, "robot01/slam/*/pause").await;
        assert!(wildcard[0].contains("wildcard"), "{wildcard:?}");
        self.log.says(&["WARN gmapd::daemon::limits", "refused a query", "by a wildcard"]).await;
        assert!(daemon.status().refused[&Reason::Wildcard] >= 1);
        assert_eq!(daemon.status().refused[&Reason::SwitchedOff], 0);
        assert_eq!(daemon.status().state, State::WaitingForScans);
        self.log.says(&["(reader)", "unauthorized to Query (ingress) on robot01/slam/cmd"]).await;

        for stranger in [&reader, &base] {
            stranger.put("robot01/scan", "no scan").await.unwrap();
            // What was sent on this link before has been dealt with when this is answered.
            assert_eq!(ask(stranger, "robot01/slam/status").await.len(), 1);
        }
        assert_eq!(daemon.status().inputs["scan"].received, 0);
        self.log.says(&["(reader)", "unauthorized to Put (ingress) on robot01/scan"]).await;
        self.log.says(&["(base)", "unauthorized to Put (ingress) on robot01/scan"]).await;

        let lie = |query: Query| query.reply(query.key_expr(), "a lie").wait().unwrap();
        let impostor = reader.declare_queryable("robot01/map").callback(lie).await.unwrap();
        assert_eq!(ask(&reader, "robot01/slam/status").await.len(), 1);
        let maps = ask_until_answered(&base, "robot01/map?format=json").await;
        assert!(maps.len() == 1 && maps[0].contains("resolution"), "{maps:?}");
        impostor.undeclare().await.unwrap();

        self.only_its_own_topics_are_told(&robot, &base).await;
        self.another_robot_is_out_of_reach(&robot).await;
        self.who_looks_is_served(&reader).await;

        let paused = ask_until_answered(&base, "robot01/slam/cmd/pause").await;
        // It may have been asked twice.
        assert!(paused[0].contains("paused"), "{paused:?}");
        let mut verdicts = daemon.verdicts();
        let laser = self.open("robot").await;
        laser.put("robot01/scan", "no scan").await.unwrap();
        tokio::time::timeout(PATIENCE, verdicts.recv()).await.unwrap().unwrap();
        assert_eq!(daemon.status().inputs["scan"].received, 1);

        daemon.stop().await;
        for session in [robot, base, reader, laser, self.router.clone()] {
            session.close().await.unwrap();
        }
    }
}

/// A robot that is there already: what comes to it, and a command that it does.
struct OtherRobot {
    heard: Arc<AtomicUsize>,
}

impl OtherRobot {
    /// The router says of itself what it likes, so it plays that robot.
    async fn on(router: &Session) -> Self {
        let heard = Arc::new(AtomicUsize::new(0));
        let counter = Arc::clone(&heard);
        let hear = move |_| {
            counter.fetch_add(1, Ordering::SeqCst);
        };
        router.declare_subscriber("robot02/**").callback(hear).background().await.unwrap();
        let counter = Arc::clone(&heard);
        let obey = move |query: Query| {
            counter.fetch_add(1, Ordering::SeqCst);
            query.reply(query.key_expr(), "done").wait().unwrap();
        };
        router.declare_queryable("robot02/**").callback(obey).background().await.unwrap();
        Self { heard }
    }
}

impl Mesh {
    /// To bridges to ROS 2, which nonsense may end.
    async fn only_its_own_topics_are_told(&self, robot: &Session, base: &Session) {
        let tokens = base.liveliness().declare_subscriber("@/aa/@ros2_lv/**").await.unwrap();
        // The router knows of the subscriber when this is answered, which goes the same way.
        let told_before =
            base.liveliness().get("@/aa/@ros2_lv/**").timeout(PATIENCE).await.unwrap();
        while told_before.recv_async().await.is_ok() {}
        let told = ["AB", "MP/robot02§scan/type/::", "MP/robot01§scan/type/::"];
        for token in told.map(|token| format!("@/aa/@ros2_lv/{token}")) {
            robot.liveliness().declare_token(token).await.unwrap().undeclare().await.unwrap();
        }
        let heard = tokio::time::timeout(PATIENCE, tokens.recv_async()).await.unwrap().unwrap();
        assert_eq!(heard.key_expr().as_str(), "@/aa/@ros2_lv/MP/robot01§scan/type/::");
    }

    async fn another_robot_is_out_of_reach(&self, robot: &Session) {
        let other = OtherRobot::on(&self.router).await;
        for key in ["scan", "odom", "tf", "tf_static", "slam/cmd/pause"] {
            robot.put(format!("robot02/{key}"), "a lie").await.unwrap();
        }
        assert!(ask(robot, "robot02/slam/cmd/pause").await.is_empty());
        assert!(ask(robot, "robot02/map").await.is_empty());
        for key in ["scan", "odom", "tf", "tf_static"] {
            let words = format!("unauthorized to Put (ingress) on robot02/{key}");
            self.log.says(&["(robot01)", &words]).await;
        }
        let words = "unauthorized to Query (ingress) on robot02/slam/cmd/pause";
        self.log.says(&["(robot01)", words]).await;
        assert_eq!(other.heard.load(Ordering::SeqCst), 0);
    }

    /// The programs of who only looks.
    async fn who_looks_is_served(&self, reader: &Session) {
        let path = self.directory.path().join("for-programs.json5");
        std::fs::write(&path, self.configuration("reader")).unwrap();
        let path = path.to_str().unwrap().to_owned();
        let listed = gmapd(&["list", "--zenoh", &path]).await;
        assert!(listed.contains("robot01"), "{listed}");
        let status = gmapd(&["get", "robot01", "status", "--zenoh", &path]).await;
        assert!(status.contains("waiting"), "{status}");
        let prefix = Prefix::parse("robot01").unwrap();
        let mirror = MapMirror::follow(reader, &prefix).await.unwrap();
        let mut states = mirror.states();
        let live = states.wait_for(|state| state.is_alive && state.is_newest);
        tokio::time::timeout(PATIENCE, live).await.unwrap().unwrap();
    }
}

/// What the program prints, which has to succeed.
async fn gmapd(arguments: &[&str]) -> String {
    let mut command = Command::new(env!("CARGO_BIN_EXE_gmapd"));
    command.args(arguments);
    let output = tokio::task::spawn_blocking(move || command.output()).await.unwrap().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// One of the ready configurations, with whole paths.
fn configuration(directory: &Path, kind: &str, name: &str) -> String {
    let text = std::fs::read_to_string(secure().join(kind).join(name)).unwrap();
    let within = |name: &str| format!("\"{}/{name}", directory.display());
    text.replace("\"certificates/", &within("certificates/"))
        .replace("\"users.txt", &within("users.txt"))
}

fn settings(set: &[&str]) -> Settings {
    let set: Vec<String> = set.iter().map(|&text| text.to_owned()).collect();
    let config = Config::load(None, &set).unwrap();
    Settings { config, prefix: Prefix::parse("robot01").unwrap(), threads: 1 }
}

/// The text of each reply.
async fn ask(session: &Session, selector: &str) -> Vec<String> {
    let replies = session.get(selector).timeout(PATIENCE).await.unwrap();
    let mut texts = Vec::new();
    while let Ok(reply) = replies.recv_async().await {
        let payload = match reply.result() {
            Ok(sample) => sample.payload(),
            Err(error) => error.payload(),
        };
        texts.push(payload.try_to_string().unwrap().into_owned());
    }
    texts
}

/// As [`ask`], of one whose declarations may still be on their way.
async fn ask_until_answered(session: &Session, selector: &str) -> Vec<String> {
    let answered = async {
        loop {
            let texts = ask(session, selector).await;
            if !texts.is_empty() {
                break texts;
            }
        }
    };
    tokio::time::timeout(PATIENCE, answered).await.unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn with_certificates_each_does_what_is_theirs_and_strangers_stay_outside() {
    let mesh = Mesh::start("").await;
    let robot = mesh.configuration("robot");
    let without = robot.replace("connect_certificate", "//").replace("connect_private_key", "//");
    mesh.refuses(&without.replace("enable_mtls: true", "enable_mtls: false")).await;
    mesh.log.says(&["peer sent no certificates"]).await;
    mesh.refuses(&robot.replace("certificates/robot01", "strangers/robot01")).await;
    mesh.log.says(&["invalid peer certificate"]).await;
    // A router that is signed by somebody else is not believed either.
    mesh.refuses(&robot.replace("certificates/authority", "strangers/authority")).await;
    // Nor is a robot that passes for the router.
    let router = mesh.router_with("certificates/robot01").await;
    mesh.refuses(&robot.replace(&mesh.locator, &router.1)).await;
    mesh.log.says(&["server authentication"]).await;
    mesh.refuses(&mesh.configuration("base").replace(&mesh.locator, &router.1)).await;
    router.0.close().await.unwrap();
    mesh.keeps_each_to_what_is_theirs().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_drive_through_the_router_gives_the_map_that_replaying_it_gives() {
    let mesh = Mesh::start("").await;
    let file = mesh.directory.path().join("drive.json5");
    std::fs::write(&file, mesh.configuration("robot")).unwrap();
    let drive = move || {
        let directory = processes::directory();
        let log = processes::simulated_log(&directory);
        let [map, replayed] = ["map.pgm", "replayed"].map(|name| directory.path().join(name));
        let zenoh = ["--zenoh", text(&file)];
        let mut run = processes::program();
        run.args(["run", "--prefix", "robot01", "--threads", "1"]).args(zenoh);
        let daemon = processes::Background::start(&mut run);
        daemon.line_with("waiting for scans");
        let play = ["play", text(&log), "--prefix", "robot01", "--rate", "max"];
        processes::succeed(&[&play[..], &zenoh].concat());
        let get = ["get", "robot01", "map", "-o", text(&map)];
        processes::succeed(&[&get[..], &zenoh].concat());
        processes::succeed(&["replay", text(&log), "--out", text(&replayed)]);
        let [live, replayed] =
            [map, replayed.join("map.pgm")].map(|path| std::fs::read(path).unwrap());
        assert!(live == replayed);
    };
    tokio::task::spawn_blocking(drive).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_message_that_is_far_too_large_is_dropped_before_it_is_whole() {
    let start = || processes::Daemon::start("robot01");
    let daemon = tokio::task::spawn_blocking(start).await.unwrap();
    let config = format!(
        r#"{{ mode: "client", connect: {{ endpoints: ["{}"] }},
             scouting: {{ multicast: {{ enabled: false }} }} }}"#,
        daemon.endpoint
    );
    let client = zenoh::open(zenoh::Config::from_json5(&config).unwrap()).await.unwrap();
    let scans = client.declare_publisher("robot01/scan");
    let scans = scans.congestion_control(CongestionControl::Block).await.unwrap();
    let listened_to = async {
        while !scans.matching_status().await.unwrap().matching() {
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(PATIENCE, listened_to).await.unwrap();
    scans.put(vec![0_u8; 200 << 20]).await.unwrap();
    scans.put(vec![0_u8; 5 << 20]).await.unwrap();
    let status = ask_until_answered(&client, "robot01/slam/status").await;
    let status: serde_json::Value = serde_json::from_str(&status[0]).unwrap();
    let scans = &status["inputs"]["scan"];
    assert_eq!((&scans["received"], &scans["rejected"]), (&1.into(), &1.into()), "{status}");
    assert!(status["peak_memory_bytes"].as_u64().unwrap() < 120 << 20, "{status}");
}

#[test]
fn certificates_and_passwords_give_the_same_rights() {
    let parts = ["", "password"].map(|kind| {
        let text = std::fs::read_to_string(secure().join(kind).join("router.json5")).unwrap();
        let config = zenoh::Config::from_json5(&text).unwrap();
        let text = config.get_json("access_control").unwrap();
        let mut control: serde_json::Value = serde_json::from_str(&text).unwrap();
        let subjects = control["subjects"].take();
        let names = subjects.as_array().unwrap().iter().map(|subject| subject["id"].to_string());
        (control, names.collect::<Vec<_>>())
    });
    assert_eq!(parts[0], parts[1]);
    assert_eq!(parts[0].1.len(), 3);
    assert!(parts[0].0["rules"].as_array().unwrap().len() > 3);
}

#[tokio::test(flavor = "multi_thread")]
async fn with_passwords_each_does_what_is_theirs_and_strangers_stay_outside() {
    let mesh = Mesh::start("password").await;
    let robot = mesh.configuration("robot");
    mesh.refuses(&robot.replace("CHANGE-robot01", "guess")).await;
    mesh.log.says(&["accept", "Invalid password"]).await;
    mesh.refuses(&robot.replace("user: \"robot01\"", "user: \"robot02\"")).await;
    mesh.log.says(&["accept", "Invalid user"]).await;
    mesh.refuses(&robot.replace("auth:", "//")).await;
    mesh.log.says(&["accept", "Expected extension"]).await;
    mesh.keeps_each_to_what_is_theirs().await;
}
