//! What following a map by tiles costs beside sending it whole: bytes over a simulated hour of
//! driving, and processor and memory of many mirrors and of many robots behind a router.
//!
//! Robots serve as the daemon does, all of them in this process; the router and the base station
//! that mirrors them are processes of their own.
//!
//! `cargo bench --bench tiles`; the figures are printed as JSON. With `hour` or `fleet` behind `--`
//! only one of the two.

use std::collections::BTreeMap;
use std::io::{BufRead as _, BufReader, Read, Write as _};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use flate2::Compression;
use flate2::write::DeflateEncoder;
use gmapd::client::MapMirror;
use gmapd::clock::{Stopwatch, peak_resident_memory};
use gmapd::config::{Config, EngineKind};
use gmapd::convert;
use gmapd::daemon::command::Request;
use gmapd::daemon::keys::Prefix;
use gmapd::daemon::ledger::Entry;
use gmapd::daemon::links::LinksStatus;
use gmapd::daemon::ros_node::{Convention, RosNode};
use gmapd::daemon::serving::{AskStatus, Serving, Settings, Sources};
use gmapd::daemon::snapshot::{Estimate, MapVersion, Snapshot, State};
use gmapd::daemon::status::{FilterStatus, Status};
use gmapd::daemon::tiles::{TileSet, digest};
use gmapd::map::tiles::compress;
use gmapd::ros;
use gmapd::sim::lidar::Lidar;
use gmapd::sim::{Simulation, building};
use gmapd::slam::gmapping::{GMapping, ScanReading, ScanUpdate};
use gmapd::slam::grid::occupancy::OccupancyGrid;
use gmapd::slam::known_map::Mode;
use gmapd::slam::pose::{Pose2, Stamp};
use gmapd::statistics::Spread;
use serde_json::{Value, json};
use tokio::sync::{broadcast, mpsc, watch};
use zenoh::Session;

const SEED: u64 = 1;
/// Side of the building, m: half of the hour goes by before the robot has been everywhere.
const BUILDING_M: f64 = 100.0;
const HOUR_S: f64 = 3600.0;
/// Versions that a mirror misses in 30 s away, at a map each 5 s.
const AWAY: usize = 6;
/// As little goes over the wire while nothing changes.
const DIGESTS_PER_VERSION: usize = 5;
const SIDES: [usize; 4] = [32, 64, 128, 256];
/// Each so many versions, tiles of several sizes are compared.
const COMPARED: u64 = 24;
const FLEET_S: usize = 40;

fn main() {
    let words: Vec<String> = std::env::args().skip(1).filter(|word| word != "--bench").collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build();
    let runtime = runtime.expect("threads are to be had");
    if let ["base", endpoint, robots, mirrors] = words[..] {
        let number = |word: &str| word.parse().expect("it is a number");
        let figures = runtime.block_on(base(endpoint, number(robots), number(mirrors)));
        return println!("{figures}");
    }
    if words == ["router"] {
        return println!("{}", runtime.block_on(router()));
    }
    let config = Config::load(None, &[format!("seed={SEED}")]).expect("it is one");
    let chosen = |part| words.is_empty() || words.contains(&part);
    let versions = drive(&config, if chosen("hour") { HOUR_S } else { HOUR_S / 6.0 });
    let hour = chosen("hour").then(|| measure_hour(&versions));
    let fleet = chosen("fleet").then(|| {
        let versions = Arc::new(versions);
        let of = |robots, mirrors| runtime.block_on(fleet(versions.clone(), robots, mirrors));
        json!({"200 mirrors of one robot": of(1, 200), "50 robots at one base": of(50, 1)})
    });
    println!("{:#}", json!({"hour": hour, "fleet": fleet}));
}

/// The versions of the map while a robot drives so long through the building.
fn drive(config: &Config, seconds: f64) -> Vec<Arc<MapVersion>> {
    let lidar = Lidar::full_circle(360).expect("more than two beams");
    let simulation = Simulation::through(&building::building(SEED, BUILDING_M), 4, lidar, SEED);
    let mut filter = GMapping::new(config.parameters(), SEED, 1).expect("it needs no thread");
    let mut versions: Vec<Arc<MapVersion>> = Vec::new();
    let mut start = None;
    for reading in simulation.readings() {
        let start: Stamp = *start.get_or_insert(reading.stamp);
        if reading.stamp.seconds_since(start) > seconds {
            break;
        }
        let (scan, mount) = (&reading.scan, &simulation.lidar.mount);
        let reading = ScanReading { scan, mount, odom_from_base: reading.odom_from_base };
        let update = filter.add_scan(&reading, &mut |_| ());
        let due = versions.last().is_none_or(|last| {
            scan.stamp.seconds_since(last.stamp) >= config.raw.map_update_interval
        });
        if due && matches!(update, ScanUpdate::Processed(_)) {
            versions.push(Arc::new(MapVersion {
                version: versions.len() as u64 + 1,
                epoch: 1 + filter.map_corrections(),
                stamp: scan.stamp,
                occupancy: filter.occupancy().clone(),
                occupied_threshold: config.parameters().map.occupied_threshold,
                path: filter.path(),
            }));
        }
    }
    versions
}

fn size(messages: &[Bytes]) -> usize {
    messages.iter().map(Bytes::len).sum()
}

/// Bytes and times of the same versions as tiles and as whole maps.
fn measure_hour(versions: &[Arc<MapVersion>]) -> Value {
    let mut set = TileSet::new(1, 0.05);
    let (mut tiles, mut whole, mut deflated) = (0, 0, 0);
    let mut by_side = SIDES.map(|_| 0);
    let (mut milliseconds, mut catch_up) = (Vec::new(), Vec::new());
    let mut before = None;
    for version in versions {
        let watch = Stopwatch::start();
        set.update(Some(version));
        let changes = set.since(version.version - 1);
        milliseconds.push(watch.elapsed().cpu.as_secs_f64() * 1e3);
        tiles += size(&changes) + DIGESTS_PER_VERSION * size(&digest(*set.head()));
        catch_up.push(size(&set.since(version.version.saturating_sub(AWAY as u64))) as f64);
        let grid = version.occupancy.to_grid(version.occupied_threshold).expect("it is known");
        let message = convert::occupancy_grid(ros::Header::default(), &grid);
        let message = ros::cdr(&message);
        whole += message.len();
        let mut encoder = DeflateEncoder::new(Vec::new(), Compression::default());
        encoder.write_all(&message).expect("memory takes it");
        deflated += encoder.finish().expect("memory takes it").len();
        if let Some(before) = before.as_ref().filter(|_| version.version.is_multiple_of(COMPARED)) {
            for (bytes, side) in by_side.iter_mut().zip(SIDES) {
                *bytes += changed(before, &grid, side);
            }
        }
        before = Some(grid);
    }
    let share = |bytes: usize| bytes as f64 / whole as f64;
    let last = before.expect("there is a version");
    json!({
        "versions": versions.len(),
        "epochs": versions.last().map(|version| version.epoch),
        "last map": [last.width, last.height],
        "bytes": {"tiles": tiles, "whole maps": whole, "whole maps, deflated": deflated},
        "share of whole maps": {"tiles": share(tiles), "whole maps, deflated": share(deflated)},
        "share of deflated maps": tiles as f64 / deflated as f64,
        "bytes by side of tiles, some versions": SIDES.iter().map(ToString::to_string).zip(by_side)
            .map(|(side, bytes)| (side, json!(bytes))).collect::<serde_json::Map<_, _>>(),
        "ms an update": Spread::of(&milliseconds),
        "bytes after 30 s away": Spread::of(&catch_up),
        "bytes of all tiles": size(&set.since(0)),
    })
}

/// Bytes of the tiles of this size that differ, each with what is told beside its cells.
fn changed(before: &OccupancyGrid, now: &OccupancyGrid, side: usize) -> usize {
    let first = |metres: f64| (metres / now.resolution).round() as i64;
    let (ix, iy) = (first(now.origin.x), first(now.origin.y));
    let cell = |grid: &OccupancyGrid, x: i64, y: i64| {
        let (x, y) = (
            x - (grid.origin.x / grid.resolution).round() as i64,
            y - (grid.origin.y / grid.resolution).round() as i64,
        );
        let inside = (0..grid.width as i64).contains(&x) && (0..grid.height as i64).contains(&y);
        if inside { grid.cells[y as usize * grid.width + x as usize] } else { -1 }
    };
    let step = side as i64;
    let tiles = |from: i64, count: usize| {
        from.div_euclid(step)..=(from + count as i64 - 1).div_euclid(step)
    };
    let mut bytes = 0;
    for (ty, tx) in
        tiles(iy, now.height).flat_map(|ty| tiles(ix, now.width).map(move |tx| (ty, tx)))
    {
        let cells = |grid: &OccupancyGrid| -> Vec<i8> {
            let places = (0..step).flat_map(|y| (0..step).map(move |x| (x, y)));
            places.map(|(x, y)| cell(grid, tx * step + x, ty * step + y)).collect()
        };
        let drawn = cells(now);
        if cells(before) != drawn {
            bytes += 26 + compress(&drawn).len();
        }
    }
    bytes
}

async fn session(mode: &str, connect: Option<&str>) -> Session {
    let listen = if mode == "client" { "" } else { "\"tcp/127.0.0.1:0\"" };
    let connect = connect.map(|endpoint| format!("{endpoint:?}")).unwrap_or_default();
    let config = format!(
        r#"{{ mode: "{mode}", listen: {{ endpoints: [{listen}] }},
             connect: {{ endpoints: [{connect}] }},
             scouting: {{ multicast: {{ enabled: false }}, gossip: {{ enabled: false }} }} }}"#
    );
    let config = zenoh::Config::from_json5(&config).expect("it is well-formed");
    zenoh::open(config).await.expect("loopback is there")
}

fn robot_name(number: usize) -> String {
    format!("fleet/robot{number:02}")
}

/// A robot as the mesh sees it: the daemon without its filter.
struct Robot {
    snapshots: watch::Sender<Arc<Snapshot>>,
    serving: Serving,
    /// What the filter's side holds.
    _filter: (broadcast::Sender<Entry>, mpsc::Receiver<Request>),
    _session: Session,
}

impl Robot {
    async fn start(endpoint: &str, number: usize, first: &Arc<MapVersion>) -> Self {
        let session = session("client", Some(endpoint)).await;
        let config = Config::load(None, &["map_update_interval=0.1".to_owned()]);
        let settings = Settings::new(&config.expect("it is one"), PathBuf::from("maps"));
        let (snapshots, watched) = watch::channel(Arc::new(snapshot(first)));
        let (verdicts, heard) = broadcast::channel(16);
        let (commander, commands) = mpsc::channel(16);
        let status = AskStatus::new(status);
        let sources = Sources {
            snapshots: watched,
            verdicts: heard,
            commands: commander,
            status,
            refusals: Arc::default(),
        };
        let prefix = Prefix::parse(&robot_name(number)).expect("it is a key");
        let node = RosNode::new(session.zid().to_string(), prefix, Convention::Bridge);
        let serving = Serving::start(&session, node, settings, sources).await;
        let serving = serving.expect("nothing stands against it");
        Self { snapshots, serving, _filter: (verdicts, commands), _session: session }
    }

    fn show(&self, version: &Arc<MapVersion>) {
        self.snapshots.send_replace(Arc::new(snapshot(version)));
    }
}

fn snapshot(version: &Arc<MapVersion>) -> Snapshot {
    Snapshot {
        estimate: Estimate { stamp: Some(version.stamp), ..Estimate::default() },
        map: Some(version.clone()),
        ..Snapshot::default()
    }
}

fn status() -> Status {
    Status {
        version: "1.0.0",
        engine: EngineKind::Gmapping,
        links: LinksStatus::default(),
        mode: Mode::Mapping,
        uptime_s: 1.0,
        state: State::Mapping,
        detail: String::new(),
        pose_in_map: Pose2::IDENTITY,
        laser: None,
        scans: BTreeMap::new(),
        last_details: BTreeMap::new(),
        inputs: BTreeMap::new(),
        milliseconds_per_scan: None,
        real_time_factor: None,
        refused: BTreeMap::new(),
        scans_waiting: 0,
        filter: FilterStatus::default(),
        map: None,
        checkpoint: None,
        peak_memory_bytes: None,
        seed: SEED,
    }
}

/// Bytes of memory that this process has now.
fn resident() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kilobytes = line.and_then(|line| line.split_whitespace().next()?.parse::<u64>().ok());
    kilobytes.unwrap_or(0) << 10
}

/// What a process took since the watch was started.
fn cost(watch: &Stopwatch) -> Value {
    let spent = watch.elapsed();
    json!({
        "share of a processor": spent.cpu.as_secs_f64() / spent.wall.as_secs_f64(),
        "megabytes": resident() >> 20,
    })
}

/// Another process of this program.
fn child(words: &[&str]) -> Child {
    let own = std::env::current_exe().expect("this program has a path");
    let mut command = Command::new(own);
    command.args(words).stdin(Stdio::piped()).stdout(Stdio::piped());
    command.spawn().expect("it runs")
}

/// The router: tells where it listens, and what it took when nobody writes to it any more.
async fn router() -> Value {
    let session = session("router", None).await;
    println!("{}", session.info().locators().await.first().expect("it listens"));
    let watch = Stopwatch::start();
    let end = || std::io::stdin().read_to_end(&mut Vec::new());
    tokio::task::spawn_blocking(end).await.expect("it does not panic").ok();
    let cost = cost(&watch);
    session.close().await.ok();
    cost
}

/// The figures that a child prints at its end.
fn figures(mut output: impl Read) -> Value {
    let mut text = String::new();
    output.read_to_string(&mut text).expect("it is text");
    serde_json::from_str(&text).expect("it prints figures")
}

/// Robots behind a router, and a base station that mirrors their maps: a version a second.
async fn fleet(versions: Arc<Vec<Arc<MapVersion>>>, robots: usize, mirrors: usize) -> Value {
    let mut router = child(&["router"]);
    let mut router_output = BufReader::new(router.stdout.take().expect("it is piped"));
    let mut endpoint = String::new();
    router_output.read_line(&mut endpoint).expect("it tells where it listens");
    let endpoint = endpoint.trim();
    let (first, newer) = versions[versions.len() / 2..].split_first().expect("there are some");
    let mut fleet = Vec::new();
    for number in 0..robots {
        fleet.push(Robot::start(endpoint, number, first).await);
    }
    let mut base = child(&["base", endpoint, &robots.to_string(), &mirrors.to_string()]);
    let base_output = base.stdout.take().expect("it is piped");
    let base_figures = tokio::task::spawn_blocking(move || figures(base_output));
    let mut set = TileSet::new(1, 0.05);
    set.update(Some(first));
    let (watch, mut sent) = (Stopwatch::start(), 0);
    let mut ticks = tokio::time::interval(Duration::from_secs(1));
    for version in newer.iter().take(FLEET_S) {
        ticks.tick().await;
        let before = set.head().version;
        set.update(Some(version));
        sent += robots * size(&set.since(before));
        fleet.iter().for_each(|robot| robot.show(version));
    }
    let robots_cost = cost(&watch);
    for robot in fleet {
        robot.serving.stop().await;
    }
    let base_figures = base_figures.await.expect("it does not panic");
    drop(router.stdin.take());
    let router_figures = figures(router_output);
    base.wait().and_then(|_| router.wait()).ok();
    json!({
        "base": base_figures,
        "router": router_figures,
        "robots, all in one process": robots_cost,
        "bytes a second of all robots' tiles": sent / FLEET_S,
    })
}

/// The base station: so many mirrors of each robot, for as long as robots are there.
async fn base(endpoint: &str, robots: usize, mirrors: usize) -> Value {
    let watch = Stopwatch::start();
    let session = session("client", Some(endpoint)).await;
    let before = peak_resident_memory().unwrap_or(0);
    let mut all = Vec::new();
    for number in 0..robots {
        let robot = Prefix::parse(&robot_name(number)).expect("it is a key");
        for _ in 0..mirrors {
            all.push(MapMirror::follow(&session, &robot).await.expect("they are keys"));
        }
    }
    for mirror in &all {
        mirror.states().wait_for(|state| state.is_newest).await.expect("the mirror lives");
    }
    let caught_up = watch.elapsed();
    let mut states = all[0].states();
    let lap = Stopwatch::start();
    states.wait_for(|state| !state.is_alive).await.expect("the mirror lives");
    let followed = lap.elapsed();
    let peak = peak_resident_memory().unwrap_or(0);
    let whole = all.iter().filter(|mirror| mirror.state().is_newest).count();
    let seconds = followed.wall.as_secs_f64();
    let states: Vec<_> = all.iter().map(MapMirror::state).collect();
    json!({
        "mirrors": all.len(),
        "of the newest version": whole,
        "s until all were whole": caught_up.wall.as_secs_f64(),
        "share of a processor": followed.cpu.as_secs_f64() / seconds,
        "s": seconds,
        "questions": states.iter().map(|state| state.repairs).sum::<u64>(),
        "rejected": states.iter().map(|state| state.rejected).sum::<u64>(),
        "versions": states.iter().map(|state| state.map.version()).max(),
        "megabytes": {"before": before >> 20, "peak": peak >> 20},
    })
}
