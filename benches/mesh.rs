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
/// Between two bursts of queries.
const PAUSE: Duration = Duration::from_millis(250);
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
    if let [_, mode, size] = arguments.as_slice()
        && mode == "bare"
    {
        return serve_bare(size.parse().expect("a number of bytes"));
    }
    let directory = tempfile::tempdir().expect("a temporary directory");
    let log = directory.path().join("sim.log");
    let mut simulate = Command::new(GMAPD);
    simulate.args(["simulate", "--laps", "2", "--out"]).arg(&log);
    assert!(quiet(&mut simulate).status().expect("gmapd runs").success(), "no log to play");

    let alone = drive(&log, false);
    let asked = drive(&log, true);
    let growth = |name: &str| asked.scan[name].as_f64().zip(alone.scan[name].as_f64());
    let growth = growth("p50").map(|(asked, alone)| asked / alone);
    let (daemon, bare) = (asked.daemon.expect("replies"), asked.bare.expect("replies"));
    println!(
        "{:#}",
        json!({
            "clients": CLIENTS,
            "map_bytes": asked.bytes,
            "reply_ms": {"daemon": daemon, "bare": bare, "median_ratio": daemon.p50 / bare.p50},
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
    daemon: Option<Spread>,
    bare: Option<Spread>,
    bytes: usize,
}

/// Plays the log to a daemon of its own as fast as it goes; `asked` has clients ask meanwhile.
fn drive(log: &Path, asked: bool) -> Drive {
    let (_daemon, endpoint) = start(Command::new(GMAPD).args([
        "run",
        "--prefix",
        "robot01",
        "--threads",
        "1",
        "--set",
        "particles=100",
        "--listen",
        "tcp/127.0.0.1:0",
    ]));
    let mut play = Command::new(GMAPD);
    play.args(["play", "--prefix", "robot01", "--rate", "max", "--connect", &endpoint]).arg(log);
    let mut play = Process(quiet(&mut play).spawn().expect("gmapd runs"));
    let (mut daemon, mut bare, mut bytes) = (Vec::new(), Vec::new(), 0);
    if asked {
        let first = client(&endpoint);
        while bytes < 10_000 {
            bytes = ask(&first, "robot01/map").1;
        }
        let own = std::env::current_exe().expect("this program has a path");
        let (_bare, bare_endpoint) = start(Command::new(own).args(["bare", &bytes.to_string()]));
        let clients: Vec<[Session; 2]> =
            (0..CLIENTS).map(|_| [client(&endpoint), client(&bare_endpoint)]).collect();
        while play.0.try_wait().expect("it is our child").is_none() {
            daemon.extend(burst(clients.iter().map(|[daemon, _]| daemon), "robot01/map"));
            std::thread::sleep(PAUSE);
            bare.extend(burst(clients.iter().map(|[_, bare]| bare), BARE));
            std::thread::sleep(PAUSE);
        }
    }
    assert!(play.0.wait().expect("it is our child").success(), "play failed");
    let status = ask(&client(&endpoint), "robot01/slam/status").2;
    let status: Value = serde_json::from_slice(&status).expect("the status is JSON");
    Drive {
        scan: status["milliseconds_per_scan"].clone(),
        daemon: Spread::of(&daemon),
        bare: Spread::of(&bare),
        bytes,
    }
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

/// All clients ask at once.
fn burst<'a>(clients: impl Iterator<Item = &'a Session>, key: &str) -> Vec<f64> {
    std::thread::scope(|scope| {
        let threads: Vec<_> =
            clients.map(|client| scope.spawn(move || ask(client, key).0)).collect();
        threads.into_iter().map(|thread| thread.join().expect("no panic")).collect()
    })
}

/// Answers every query with as many bytes, until killed.
fn serve_bare(size: usize) {
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", "\"router\""),
        ("listen/endpoints", "[\"tcp/127.0.0.1:0\"]"),
        ("scouting/multicast/enabled", "false"),
    ] {
        config.insert_json5(key, value).expect("the setting exists");
    }
    let session = zenoh::open(config).wait().expect("a session");
    let payload = Bytes::from(vec![100_u8; size]);
    let _queryable = session
        .declare_queryable(BARE)
        .complete(true)
        .callback(move |query| {
            query.reply(BARE, payload.clone()).wait().ok();
        })
        .wait()
        .expect("a queryable");
    let locators = session.info().locators().wait();
    println!("{}", locators.iter().map(ToString::to_string).collect::<Vec<_>>().join(" "));
    std::io::stdout().flush().ok();
    std::thread::park();
}
