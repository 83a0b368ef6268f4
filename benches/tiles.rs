//! What following a map by tiles costs beside sending it whole: bytes over a simulated hour of
//! driving, and processor and memory of many mirrors and of many robots behind a real router.
//!
//! `cargo bench --bench tiles`; the figures are printed as JSON. With `hour` or `fleet` behind `--`
//! only one of the two.

use std::io::{Read as _, Write as _};
use std::process::{Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use bytes::Bytes;
use flate2::Compression;
use flate2::write::DeflateEncoder;
use gmapd::client::MapMirror;
use gmapd::clock::{Stopwatch, peak_resident_memory};
use gmapd::config::Config;
use gmapd::convert;
use gmapd::daemon::keys::Prefix;
use gmapd::daemon::snapshot::MapVersion;
use gmapd::daemon::tiles::{TileSet, digest, run_number};
use gmapd::map::tiles::compress;
use gmapd::ros;
use gmapd::sim::lidar::Lidar;
use gmapd::sim::{Simulation, building};
use gmapd::slam::gmapping::{GMapping, ScanReading, ScanUpdate};
use gmapd::slam::grid::occupancy::OccupancyGrid;
use gmapd::slam::pose::Stamp;
use gmapd::statistics::Spread;
use serde_json::{Value, json};
use zenoh::Session;
use zenoh::liveliness::LivelinessToken;
use zenoh::qos::{CongestionControl, Priority};

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

/// A robot as the mesh sees it, without its filter.
struct Robot {
    session: Session,
    tiles: Arc<Mutex<TileSet>>,
    _alive: LivelinessToken,
}

impl Robot {
    async fn start(endpoint: &str, number: usize) -> Self {
        let session = session("client", Some(endpoint)).await;
        let run = run_number(&session.zid().to_string(), number as i64);
        let tiles = Arc::new(Mutex::new(TileSet::new(run, 0.05)));
        let (key, asked) = (format!("{}/slam/tiles", robot_name(number)), tiles.clone());
        let answer = move |query: zenoh::query::Query| {
            let since = query.parameters().get("since").and_then(|text| text.parse().ok());
            let messages = asked.lock().expect("nobody panics").since(since.unwrap_or(0));
            for message in messages {
                zenoh::Wait::wait(query.reply(query.key_expr(), message)).ok();
            }
        };
        let queryable = session.declare_queryable(key).callback(answer).background();
        queryable.await.expect("it is a key");
        let token = format!("{}/slam/alive", robot_name(number));
        let alive = session.liveliness().declare_token(token).await.expect("it is a key");
        Self { session, tiles, _alive: alive }
    }

    async fn tell(&self, number: usize, version: &Arc<MapVersion>) -> usize {
        let key = format!("{}/slam/tiles", robot_name(number));
        let messages = {
            let mut tiles = self.tiles.lock().expect("nobody panics");
            let before = tiles.head().version;
            tiles.update(Some(version));
            tiles.since(before)
        };
        for message in &messages {
            let put = self.session.put(&key, message.clone());
            let put = put.congestion_control(CongestionControl::Drop);
            put.priority(Priority::Background).await.expect("the session is open");
        }
        size(&messages)
    }
}

/// Robots behind a router, and one base station, a process of its own, that mirrors their maps: a
/// version a second.
async fn fleet(versions: Arc<Vec<Arc<MapVersion>>>, robots: usize, mirrors: usize) -> Value {
    let router = session("router", None).await;
    let endpoint = router.info().locators().await.first().expect("it listens").to_string();
    let mut fleet = Vec::new();
    for number in 0..robots {
        let robot = Robot::start(&endpoint, number).await;
        robot.tell(number, &versions[versions.len() / 2]).await;
        fleet.push(robot);
    }
    let own = std::env::current_exe().expect("this program has a path");
    let words = ["base".to_owned(), endpoint, robots.to_string(), mirrors.to_string()];
    let mut base = Command::new(own).args(words).stdout(Stdio::piped()).spawn().expect("it runs");
    let mut output = base.stdout.take().expect("it is piped");
    let mut sent = 0;
    let mut ticks = tokio::time::interval(Duration::from_secs(1));
    let reader = tokio::task::spawn_blocking(move || {
        let mut text = String::new();
        output.read_to_string(&mut text).map(|_| text)
    });
    let mut newest = versions[versions.len() / 2 + 1..].iter().cycle();
    for _ in 0..FLEET_S {
        ticks.tick().await;
        let version = newest.next().expect("it goes round");
        for (number, robot) in fleet.iter().enumerate() {
            sent += robot.tell(number, version).await;
        }
    }
    drop(fleet);
    let text = reader.await.expect("it does not panic").expect("it is text");
    base.wait().ok();
    let figures: Value = serde_json::from_str(&text).expect("the base prints figures");
    json!({"base": figures, "bytes a second of all robots": sent / FLEET_S})
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
