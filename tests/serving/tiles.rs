//! The map as tiles, and mirrors of it: what is lost, cut off, slow or started anew.

use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use std::time::Duration;

use gmapd::client::{MapMirror, MirrorState};
use gmapd::clock::Stopwatch;
use gmapd::daemon::keys::Prefix;
use gmapd::daemon::serving::Settings;
use gmapd::daemon::tiles::publishing::DIGEST_PERIOD;
use gmapd::map::content_hash;
use gmapd::map::tiles::{LARGEST_MESSAGE, Message};
use gmapd::statistics::Spread;
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use zenoh::liveliness::LivelinessToken;
use zenoh::query::ConsolidationMode;

use super::router::{Router, links, open_impatient};
use super::*;

/// Beyond what is promised, for a machine that does other things as well.
const SLACK: Duration = Duration::from_secs(1);

/// Held by the tests that measure time: a client that does not read holds a thread that all of
/// Zenoh's sessions in this process share.
static ALONE: tokio::sync::Mutex<()> = tokio::sync::Mutex::const_new(());

async fn follow(session: &zenoh::Session) -> MapMirror {
    let robot = Prefix::parse(ROBOT).expect("it is a key");
    MapMirror::follow(session, &robot).await.expect("nothing stands against it")
}

/// Waits until a mirror is as wanted.
async fn until(mirror: &MapMirror, wanted: impl Fn(&MirrorState) -> bool) -> MirrorState {
    let mut states = mirror.states();
    let state = tokio::time::timeout(PATIENCE, states.wait_for(|state| wanted(state))).await;
    let Ok(state) = state else { panic!("this is how it is: {mirror:?}") };
    state.expect("the mirror lives").clone()
}

fn has(snapshot: &Snapshot) -> impl Fn(&MirrorState) -> bool {
    let number = version(snapshot).version;
    move |state| state.map.version() == number
}

/// Asserts that a mirror has the map that the daemon answers with, byte for byte.
async fn assert_same_map(rig: &Rig, state: &MirrorState) {
    let asked = rig.ask("map").await.expect("it is answered");
    let label = asked.attachment.expect("it has one");
    assert_eq!(label["sha256"], content_hash(&state.map.grid()).as_str());
    assert_eq!(label["version"], state.map.version());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_mirror_has_every_version_as_a_whole() {
    let drive = drive();
    let rig = Rig::start(drive[0].clone()).await;
    let mut samples = rig.subscribe("slam/tiles").await;
    let mirror = follow(&rig.client).await;
    let state = until(&mirror, has(&drive[0])).await;
    assert!(state.is_alive && state.is_newest);
    for snapshot in &drive[1..] {
        rig.show(snapshot);
        let state = until(&mirror, has(snapshot)).await;
        assert_eq!(state.map.grid(), grid(snapshot));
        assert_eq!(state.map.stamp(), version(snapshot).stamp);
        assert_same_map(&rig, &state).await;
    }
    let state = mirror.state();
    assert_eq!((state.repairs, state.rejected), (1, 0), "nothing was lost");
    while let Ok(sample) = samples.try_recv() {
        let bytes = sample.payload().to_bytes();
        assert!(bytes.len() <= LARGEST_MESSAGE && Message::decode(&bytes).is_ok());
        assert_eq!(sample.priority(), zenoh::qos::Priority::Background);
        assert_eq!(sample.congestion_control(), zenoh::qos::CongestionControl::Drop);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_reset_empties_the_mirror_and_a_new_map_fills_it() {
    let drive = drive();
    let rig = Rig::start(Snapshot::default()).await;
    let mirror = follow(&rig.client).await;
    until(&mirror, |state| state.is_newest).await;
    assert!(mirror.map().grid().cells.is_empty());
    rig.show(&drive[5]);
    let state = until(&mirror, has(&drive[5])).await;
    assert_eq!(state.map.epoch(), 1);
    rig.show(&Snapshot::default());
    let state = until(&mirror, |state| state.map.epoch() == 2).await;
    assert_eq!((state.map.tiles(), state.map.grid().cells.len()), (0, 0));

    let known = version(&drive[0]);
    let anew = MapVersion { version: known.version + 100, epoch: 2, ..known.clone() };
    let anew = Snapshot { map: Some(Arc::new(anew)), ..drive[0].clone() };
    rig.show(&anew);
    let state = until(&mirror, has(&anew)).await;
    assert_eq!(state.map.grid(), grid(&drive[0]));
    assert_same_map(&rig, &state).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn who_comes_late_makes_nobody_else_ask() {
    let drive = drive();
    let daemon = open("peer", None).await;
    let client = open("peer", Some(&locator(&daemon).await)).await;
    let long = |settings: &mut Settings| settings.map_update_interval = PATIENCE * 10;
    let rig = Rig::with(daemon, client, drive[0].clone(), long).await;
    let mirror = follow(&rig.client).await;
    until(&mirror, has(&drive[0])).await;
    let mut news = mirror.states();
    // With the digest, the first version has been published, and no other is for long.
    news.changed().await.expect("the mirror lives");
    drive[1..5].iter().for_each(|snapshot| rig.show(snapshot));
    let late = follow(&rig.client).await;
    until(&late, has(&drive[4])).await;
    for _ in 0..2 {
        news.mark_unchanged();
        news.changed().await.expect("the mirror lives");
    }
    let state = mirror.state();
    assert_eq!((state.repairs, state.newest_version), (1, Some(version(&drive[0]).version)));
    assert_eq!(late.map().version(), version(&drive[4]).version);
    assert_eq!(late.state().repairs, 1);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_question_that_is_refused_is_told() {
    let daemon = open("peer", None).await;
    let client = open("client", Some(&locator(&daemon).await)).await;
    let refuse = |query: zenoh::query::Query| {
        zenoh::Wait::wait(query.reply_err("not now")).ok();
    };
    let tiles = format!("{ROBOT}/slam/tiles");
    daemon.declare_queryable(tiles).callback(refuse).background().await.expect("it is a key");
    let alive = format!("{ROBOT}/slam/alive");
    let _alive = daemon.liveliness().declare_token(alive).await.expect("it is a key");
    let mirror = follow(&client).await;
    let state = until(&mirror, |state| state.last_error.is_some()).await;
    assert_eq!((state.last_error.as_deref(), state.is_newest), (Some("not now"), false));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_daemon_that_comes_is_seen_though_messages_are_too_many() {
    let daemon = open("peer", None).await;
    let client = open("client", Some(&locator(&daemon).await)).await;
    let mirror = follow(&client).await;
    let (sender, mut heard) = unbounded_channel();
    let tell = move |sample: Sample| drop(sender.send(sample));
    let key = format!("{ROBOT}/slam/tiles");
    client.declare_subscriber(&key).callback(tell).background().await.expect("it is a key");
    let publisher = daemon.declare_publisher(&key);
    let publisher = publisher.congestion_control(zenoh::qos::CongestionControl::Block);
    let publisher = publisher.await.expect("it is a key");
    while !publisher.matching_status().await.expect("it is declared").matching() {
        tokio::task::yield_now().await;
    }
    // The only thread that follows does something else.
    let (hold, held) = std::sync::mpsc::channel::<()>();
    let (begin, begun) = tokio::sync::oneshot::channel();
    tokio::spawn(async move {
        begin.send(()).ok();
        held.recv().ok();
    });
    begun.await.expect("it begins");
    for _ in 0..1000 {
        publisher.put("no tiles").await.expect("the session is open");
    }
    for _ in 0..1000 {
        next(&mut heard).await;
    }
    let alive = format!("{ROBOT}/slam/alive");
    let mut lives = liveliness(&client).await;
    let _alive = daemon.liveliness().declare_token(alive).await.expect("it is a key");
    assert_eq!(next(&mut lives).await.kind(), SampleKind::Put);
    drop(hold);
    let state = until(&mirror, |state| state.is_alive).await;
    assert!(state.repairs > 0);
}

/// Two sessions with a way between them that loses some of what is published.
struct LossyRelay {
    daemons_side: zenoh::Session,
    clients_side: zenoh::Session,
    _alive: LivelinessToken,
    /// Of a hundred messages.
    lost_percent: Arc<AtomicU32>,
    lost: Arc<AtomicU64>,
}

impl LossyRelay {
    async fn start(daemon: &zenoh::Session) -> Self {
        let daemons_side = open("peer", Some(&locator(daemon).await)).await;
        let clients_side = open("peer", None).await;
        let key = format!("{ROBOT}/slam/tiles");
        let (lost_percent, lost) = (Arc::new(AtomicU32::new(0)), Arc::new(AtomicU64::new(0)));
        let (there, losses) = (clients_side.clone(), lost.clone());
        let percent = lost_percent.clone();
        let rng = std::sync::Mutex::new(ChaCha8Rng::seed_from_u64(3));
        let forward = move |sample: Sample| {
            let percent = percent.load(Ordering::Relaxed);
            if rng.lock().expect("nobody panics").random_ratio(percent, 100) {
                losses.fetch_add(1, Ordering::Relaxed);
                return;
            }
            let put = there.put(sample.key_expr().clone(), sample.payload().clone());
            zenoh::Wait::wait(put).expect("the session is open");
        };
        daemons_side.declare_subscriber(&key).callback(forward).background().await.expect("a key");
        let (here, runtime) = (daemons_side.clone(), tokio::runtime::Handle::current());
        let ask = move |query: zenoh::query::Query| {
            let here = here.clone();
            runtime.spawn(async move {
                let selector = query.selector().into_owned();
                let replies = here.get(selector).consolidation(ConsolidationMode::None).await;
                let replies = replies.expect("the session is open");
                while let Ok(reply) = replies.recv_async().await {
                    let sample = reply.into_result().expect("tiles are answered for");
                    query.reply(sample.key_expr(), sample.payload().clone()).await.ok();
                }
            });
        };
        clients_side.declare_queryable(&key).callback(ask).background().await.expect("a key");
        let alive = format!("{ROBOT}/slam/alive");
        let alive = clients_side.liveliness().declare_token(alive).await.expect("a key");
        Self { daemons_side, clients_side, _alive: alive, lost_percent, lost }
    }

    /// From now on so many of a hundred messages are lost.
    fn lose(&self, percent: u32) {
        self.lost_percent.store(percent, Ordering::Relaxed);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn after_thirty_percent_were_lost_mirrors_are_right_within_a_digest_period() {
    let _alone = ALONE.lock().await;
    let drive = drive();
    let rig = Rig::start(drive[0].clone()).await;
    let relay = LossyRelay::start(&rig.daemon).await;
    let far = open("client", Some(&locator(&relay.clients_side).await)).await;
    let mirrors = [follow(&far).await, follow(&far).await, follow(&far).await];
    for mirror in &mirrors {
        until(mirror, has(&drive[0])).await;
    }
    let versions: Vec<_> =
        drive.iter().cycle().skip(1).take(60).enumerate().map(numbered).collect();
    for versions in versions.chunks(10) {
        relay.lose(30);
        for snapshot in versions {
            rig.show(snapshot);
            // The tiles of this version have been made when it is answered for.
            rig.ask("slam/tiles?want=none").await.ok();
        }
        relay.lose(0);
        let whole = Stopwatch::start();
        let newest = versions.last().expect("there are ten");
        for mirror in &mirrors {
            let state = until(mirror, has(newest)).await;
            assert!(whole.elapsed().wall < DIGEST_PERIOD + SLACK, "{:?}", whole.elapsed().wall);
            assert_same_map(&rig, &state).await;
        }
    }
    assert!(relay.lost.load(Ordering::Relaxed) > 5, "something was lost");
    relay.daemons_side.close().await.ok();
}

/// The maps of a drive again and again, as versions of their own.
fn numbered((number, snapshot): (usize, &Snapshot)) -> Snapshot {
    let map = version(snapshot);
    let map = MapVersion { version: number as u64 + 2, ..map.clone() };
    Snapshot { map: Some(Arc::new(map)), ..snapshot.clone() }
}

#[tokio::test(flavor = "multi_thread")]
async fn behind_a_router_that_was_killed_mirrors_are_right_within_a_digest_period() {
    let _alone = ALONE.lock().await;
    let drive = drive();
    let mut router = Some(Router::start("tcp/127.0.0.1:0"));
    let endpoint = router.as_ref().expect("it is there").endpoint.clone();
    let daemon = open_impatient(&endpoint).await;
    let client = open_impatient(&endpoint).await;
    let rig = Rig::between(daemon, client, drive[0].clone()).await;
    let mut links = [links(&rig.daemon).await, links(&rig.client).await];
    let mirrors = [follow(&rig.client).await, follow(&rig.client).await, follow(&rig.client).await];
    for mirror in &mirrors {
        until(mirror, has(&drive[0])).await;
    }
    for versions in drive[1..].chunks(4).take(3) {
        drop(router.take());
        for link in &mut links {
            assert_eq!(next(link).await, SampleKind::Delete);
        }
        versions.iter().for_each(|snapshot| rig.show(snapshot));
        router = Some(Router::start(&endpoint));
        for link in &mut links {
            assert_eq!(next(link).await, SampleKind::Put);
        }
        let back = Stopwatch::start();
        let newest = versions.last().expect("there are some");
        for mirror in &mirrors {
            let state = until(mirror, has(newest)).await;
            assert!(back.elapsed().wall < DIGEST_PERIOD + SLACK, "{:?}", back.elapsed().wall);
            assert_same_map(&rig, &state).await;
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn another_run_of_the_daemon_begins_from_nothing() {
    let drive = drive();
    let router = open("router", None).await;
    let endpoint = locator(&router).await;
    let client = open("client", Some(&endpoint)).await;
    let daemon = open("client", Some(&endpoint)).await;
    let rig = Rig::between(daemon, client.clone(), drive.last().unwrap().clone()).await;
    let mirror = follow(&client).await;
    let first = until(&mirror, has(drive.last().unwrap())).await;
    rig.serving.stop().await;
    until(&mirror, |state| !state.is_alive).await;
    assert_eq!(mirror.map(), first.map, "the last map stays");

    let daemon = open("client", Some(&endpoint)).await;
    let rig = Rig::between(daemon, client, drive[1].clone()).await;
    let state = until(&mirror, has(&drive[1])).await;
    assert_ne!(state.map.run(), first.map.run());
    assert_same_map(&rig, &state).await;
}

/// Shows versions, and waits until a mirror has each and a subscriber the entropy of its scan; how
/// long that takes in the median, ms.
async fn latency(
    rig: &Rig,
    versions: &[Snapshot],
    (mirror, entropy): (&MapMirror, &mut UnboundedReceiver<Sample>),
) -> f64 {
    let mut milliseconds = Vec::new();
    for snapshot in versions {
        let start = Stopwatch::start();
        rig.show(snapshot);
        until(mirror, has(snapshot)).await;
        next(entropy).await;
        milliseconds.push(start.elapsed().wall.as_secs_f64() * 1e3);
    }
    Spread::of(&milliseconds).expect("there are versions").p50
}

#[tokio::test(flavor = "multi_thread")]
async fn a_client_that_does_not_read_slows_no_other() {
    let _alone = ALONE.lock().await;
    let drive = drive();
    let rig = Rig::start(drive[0].clone()).await;
    let mirror = follow(&rig.client).await;
    until(&mirror, has(&drive[0])).await;
    let mut entropy = rig.subscribe("entropy").await;
    let versions = drive.iter().cycle().skip(1).take(160).enumerate().map(numbered);
    let versions: Vec<Snapshot> = versions.collect();
    // What was there before is not counted.
    latency(&rig, &versions[..10], (&mirror, &mut entropy)).await;
    let alone = latency(&rig, &versions[10..80], (&mirror, &mut entropy)).await;

    let dead = open("client", Some(&locator(&rig.daemon).await)).await;
    let (hold, held) = std::sync::mpsc::channel::<()>();
    let held = std::sync::Mutex::new(held);
    let (tell, mut told) = unbounded_channel();
    let stuck = move |_| {
        tell.send(()).ok();
        held.lock().unwrap().recv().ok();
    };
    dead.declare_subscriber(format!("{ROBOT}/**")).callback(stuck).background().await.unwrap();
    next(&mut told).await;
    let beside = latency(&rig, &versions[80..], (&mirror, &mut entropy)).await;
    assert!(beside < 2.0 * alone + 10.0, "{alone} ms alone, {beside} ms beside a dead client");
    drop(hold);
}

#[tokio::test(flavor = "multi_thread")]
async fn tiles_are_answered_for_by_version_and_by_name() {
    let drive = drive();
    let rig = Rig::start(drive[0].clone()).await;
    let all = Message::decode(&rig.ask("slam/tiles").await.unwrap().bytes).unwrap();
    assert_eq!(all.entries.len(), all.head.tiles as usize);
    assert_eq!(all.head.version, version(&drive[0]).version);
    rig.show(&drive[1]);
    let run = all.head.run;
    let selector = format!("slam/tiles?since=1;run={run:016x}");
    let changed = Message::decode(&rig.ask(&selector).await.unwrap().bytes).unwrap();
    assert!(changed.entries.iter().all(|entry| entry.version == 2));
    let other = Message::decode(&rig.ask("slam/tiles?since=1;run=5").await.unwrap().bytes).unwrap();
    assert_eq!(other.entries.len(), other.head.tiles as usize);
    let index = other.entries[0].index;
    let selector = format!("slam/tiles?want={}:{}", index.tx, index.ty);
    let wanted = Message::decode(&rig.ask(&selector).await.unwrap().bytes).unwrap();
    let with_cells = wanted.entries.iter().filter(|entry| !entry.data.is_empty());
    assert_eq!(with_cells.map(|entry| entry.index).collect::<Vec<_>>(), [index]);
    let error = rig.ask("slam/tiles?since=new").await.unwrap_err();
    assert!(error.starts_with("since=\"new\" is not allowed"), "{error}");
}

fn values(data: &ros::Int8Array) -> Vec<i8> {
    let values = serde_json::to_value(data).and_then(serde_json::from_value);
    values.expect("it is an array of numbers")
}

#[tokio::test(flavor = "multi_thread")]
async fn updates_make_the_last_map_the_next_one() {
    let drive = drive();
    let place = |grid: &OccupancyGrid| (grid.width, grid.height, grid.origin);
    let pair = drive.windows(2).map(|pair| [grid(&pair[0]), grid(&pair[1])]);
    let pair = pair.enumerate().find(|(_, [a, b])| place(a) == place(b) && a != b);
    let (at, [a, b]) = pair.expect("once the map changed without growing");
    let rig = Rig::start(drive[at].clone()).await;
    let mut updates = rig.subscribe("map_updates").await;
    // The two in turns, until the daemon has seen both.
    let mut number = 100;
    let sample = loop {
        number += 1;
        rig.show(&numbered((number, &drive[at + number % 2])));
        let update = tokio::time::timeout(Duration::from_millis(50), updates.recv()).await;
        if let Ok(update) = update {
            break update.expect("the subscriber lives");
        }
        assert!(number < 500, "no update comes");
    };
    let update: ros::OccupancyGridUpdate = message(&sample);
    assert_eq!(update.header.frame_id, "map");
    let becomes_b = stamp(update.header.stamp) == version(&drive[at + 1]).stamp;
    let (mut map, next) = if becomes_b { (a, b) } else { (b, a) };
    for (row, values) in values(&update.data).chunks_exact(update.width as usize).enumerate() {
        let start = (update.y as usize + row) * map.width + update.x as usize;
        map.cells[start..start + values.len()].copy_from_slice(values);
    }
    assert_eq!(map, next);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_region_is_answered_in_coarser_cells() {
    let snapshot = last();
    let whole = grid(&snapshot);
    let seconds = version(&snapshot).stamp.0 / 1_000_000_000;
    let rig = Rig::start(snapshot).await;
    let region: ros::OccupancyGrid = rig.ask_message("map?bbox=-1,-1,1.9,2;res=0.2").await;
    assert!((region.info.resolution - 0.2).abs() < 1e-6);
    assert_eq!((region.info.width, region.info.height), (15, 15));
    assert_eq!((region.info.origin.position.x, region.info.origin.position.y), (-1.0, -1.0));
    let same: ros::OccupancyGrid = rig.ask_message("map?layers=occupancy").await;
    assert_eq!(same.data, ros::Int8Array::from(whole.cells.as_slice()));
    let picture = rig.ask("map?res=0.1;format=png").await.expect("it can be drawn");
    assert!(picture.bytes.starts_with(b"\x89PNG"));
    let layers = rig.ask_json("map?bbox=0,0,1,1;layers=hits,visits,last_seen").await;
    assert_eq!((&layers["width"], &layers["height"]), (&20.into(), &20.into()));
    assert!(layers["layers"]["visits"][0][0].as_u64() > Some(0), "{layers}");
    assert_eq!(layers["layers"]["last_seen"], serde_json::json!([[seconds, 400]]));
    for (selector, begins) in [
        ("map?bbox=1,1,0,0", "bbox=\"1,1,0,0\" is inverted or empty"),
        ("map?bbox=-1e6,-1e6,1e6,1e6", "the region has 40000000 by 40000000 cells of 0.05 m"),
        ("map?res=0.01", "res=0.01 is finer than the map, which has 0.05 m a cell"),
        ("map?layers=age", "there is no layer \"age\""),
    ] {
        let error = rig.ask(selector).await.unwrap_err();
        assert!(error.starts_with(begins), "{error}");
    }
}
