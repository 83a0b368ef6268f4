//! Twenty clients ask for the map at once while the filter is busy: how long a reply takes beside
//! a bare queryable that returns as many bytes, and what it costs the filter.
//!
//! `cargo bench --bench mesh`; the figures are printed as JSON.

use std::io::{BufRead as _, BufReader, Write as _};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use bytes::Bytes;
use gmapd::statistics::Spread;
use serde_json::{Value, json};
use zenoh::{Session, Wait as _};

const CLIENTS: usize = 20;
/// As fast as it goes, a minute of the log takes about half a second: new maps come not much more
/// often than in real time.
const MAP_EACH: &str = "map_update_interval=60";
/// Between two bursts of queries.
const PAUSE: Duration = Duration::from_millis(250);
const IDLE_BURSTS: usize = 10;
const GMAPD: &str = env!("CARGO_BIN_EXE_gmapd");
const BARE: &str = "bare/map";

/// A process that ends with its value.
struct Process(Child);

impl Drop for Process {
    fn drop(&mut self) {
        self.0.kill().ok();
        self.0.wait().ok();
    }
}

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    if arguments.get(1).is_some_and(|mode| mode == "bare") {
        return serve_bare();
    }
    let directory = tempfile::tempdir().expect("a temporary directory");
    let log = directory.path().join("sim.log");
    let mut simulate = Command::new(GMAPD);
    simulate.args(["simulate", "--laps", "2", "--out"]).arg(&log);
    assert!(quiet(&mut simulate).status().expect("gmapd runs").success(), "no log to play");

    let alone = drive(&log, 0);
    let asked = drive(&log, CLIENTS);
    let growth = |name: &str| asked.scan[name].as_f64().zip(alone.scan[name].as_f64());
    let growth = growth("p50").map(|(asked, alone)| asked / alone);
    println!(
        "{:#}",
        json!({
            "clients": CLIENTS,
            "map_bytes": asked.bytes,
            "reply_ms": {"filter busy": asked.busy.figures(), "filter idle": asked.idle.figures()},
            "ms_per_scan": {"alone": alone.scan, "asked": asked.scan, "median_growth": growth},
        })
    );
}

fn quiet(command: &mut Command) -> &mut Command {
    command.stdout(Stdio::null()).stderr(Stdio::null())
}

/// What was measured while a log was played.
struct Drive {
    scan: Value,
    busy: Replies,
    idle: Replies,
    bytes: usize,
}

/// Milliseconds that replies took.
#[derive(Default)]
struct Replies {
    daemon: Vec<f64>,
    bare: Vec<f64>,
}

impl Replies {
    fn figures(&self) -> Option<Value> {
        let (daemon, bare) = (Spread::of(&self.daemon)?, Spread::of(&self.bare)?);
        Some(json!({"daemon": daemon, "bare": bare, "median_ratio": daemon.p50 / bare.p50}))
    }
}

/// Plays the log to a daemon of its own as fast as it goes, while so many clients ask.
fn drive(log: &Path, clients: usize) -> Drive {
    let (_daemon, endpoint) = start(Command::new(GMAPD).args([
        "run",
        "--prefix",
        "robot01",
        "--threads",
        "1",
        "--set",
        "particles=100",
        "--set",
        MAP_EACH,
        "--listen",
        "tcp/127.0.0.1:0",
    ]));
    let mut play = Command::new(GMAPD);
    play.args(["play", "--prefix", "robot01", "--rate", "max", "--connect", &endpoint]).arg(log);
    let mut play = Process(quiet(&mut play).spawn().expect("gmapd runs"));
    let (mut busy, mut idle, mut bytes) = (Replies::default(), Replies::default(), 0);
    if clients > 0 {
        let own = std::env::current_exe().expect("this program has a path");
        let (_bare, bare_endpoint) = start(Command::new(own).arg("bare"));
        let clients: Vec<[Session; 2]> =
            (0..clients).map(|_| [client(&endpoint), client(&bare_endpoint)]).collect();
        let mut ask_both = |replies: &mut Replies| {
            let daemons = clients.iter().map(|[daemon, _]| daemon);
            let (times, size) = burst(daemons, "robot01/map");
            replies.daemon.extend(times);
            bytes = size;
            std::thread::sleep(PAUSE);
            let bare = clients.iter().map(|[_, bare]| bare);
            replies.bare.extend(burst(bare, &format!("{BARE}?size={size}")).0);
            std::thread::sleep(PAUSE);
        };
        while play.0.try_wait().expect("it is our child").is_none() {
            ask_both(&mut busy);
        }
        (0..IDLE_BURSTS).for_each(|_| ask_both(&mut idle));
    }
    assert!(play.0.wait().expect("it is our child").success(), "play failed");
    let status = ask(&client(&endpoint), "robot01/slam/status").2;
    let status: Value = serde_json::from_slice(&status).expect("the status is JSON");
    Drive { scan: status["milliseconds_per_scan"].clone(), busy, idle, bytes }
}

/// Starts a server and returns where it listens, as its first lines tell.
fn start(command: &mut Command) -> (Process, String) {
    let mut child = command
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .env("GMAPD_LOG", "warn,gmapd=info")
        .spawn()
        .expect("the program runs");
    let (out, err) = (child.stdout.take().expect("piped"), child.stderr.take().expect("piped"));
    let (sender, endpoints) = std::sync::mpsc::channel();
    let readers: [Box<dyn std::io::Read + Send>; 2] = [Box::new(out), Box::new(err)];
    for (index, reader) in readers.into_iter().enumerate() {
        let sender = sender.clone();
        let read = move || {
            for line in BufReader::new(reader).lines().map_while(Result::ok) {
                let word = line.split([' ', ',']).find(|word| word.starts_with("tcp/127.0.0.1:"));
                word.map(|endpoint| sender.send(endpoint.to_owned()).ok());
            }
        };
        let thread = std::thread::Builder::new().name(format!("reader-{index}"));
        thread.spawn(read).expect("a thread");
    }
    let endpoint = endpoints.recv_timeout(Duration::from_secs(30)).expect("it tells its endpoint");
    (Process(child), endpoint)
}

fn client(endpoint: &str) -> Session {
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", "\"client\"".to_owned()),
        ("connect/endpoints", format!("[\"{endpoint}\"]")),
        ("scouting/multicast/enabled", "false".to_owned()),
    ] {
        config.insert_json5(key, &value).expect("the setting exists");
    }
    zenoh::open(config).wait().expect("the server listens")
}

/// Milliseconds until the reply was there, its length, and the reply.
#[allow(clippy::disallowed_methods, reason = "latency is what is measured")]
fn ask(client: &Session, key: &str) -> (f64, usize, Vec<u8>) {
    let start = Instant::now();
    let replies = client.get(key).wait().expect("the session is open");
    let reply = replies.recv().expect("somebody answers");
    let payload = reply.into_result().expect("it is no error").payload().to_bytes().into_owned();
    (start.elapsed().as_secs_f64() * 1e3, payload.len(), payload)
}

/// All clients ask at once: milliseconds until each had its reply, and the longest reply.
fn burst<'a>(clients: impl Iterator<Item = &'a Session>, key: &str) -> (Vec<f64>, usize) {
    std::thread::scope(|scope| {
        let threads: Vec<_> = clients.map(|client| scope.spawn(move || ask(client, key))).collect();
        let replies: Vec<_> =
            threads.into_iter().map(|thread| thread.join().expect("no panic")).collect();
        let longest = replies.iter().map(|reply| reply.1).max().unwrap_or(0);
        (replies.into_iter().map(|reply| reply.0).collect(), longest)
    })
}

/// Answers every query with as many bytes as its parameter says, until killed.
fn serve_bare() {
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", "\"router\""),
        ("listen/endpoints", "[\"tcp/127.0.0.1:0\"]"),
        ("scouting/multicast/enabled", "false"),
    ] {
        config.insert_json5(key, value).expect("the setting exists");
    }
    let session = zenoh::open(config).wait().expect("a session");
    let memory = Bytes::from(vec![100_u8; 1 << 26]);
    let _queryable = session
        .declare_queryable(BARE)
        .complete(true)
        .callback(move |query| {
            let size = query.parameters().get("size").and_then(|size| size.parse().ok());
            query.reply(BARE, memory.slice(..size.unwrap_or(0))).wait().ok();
        })
        .wait()
        .expect("a queryable");
    let locators = session.info().locators().wait();
    println!("{}", locators.iter().map(ToString::to_string).collect::<Vec<_>>().join(" "));
    std::io::stdout().flush().ok();
    std::thread::park();
}
