//! What is fuzzed: each function takes bytes of any content, and neither panics nor hangs, nor
//! takes memory without bound. The fuzzers of `fuzz_targets` call them, and `tests/corpus.rs`
//! calls them with each input of `corpus`.

use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use gmapd::checkpoint::{self, Head};
use gmapd::config::Config;
use gmapd::daemon::checkpointing::Checkpoint;
use gmapd::daemon::keys::Prefix;
use gmapd::daemon::selector::{Question, RegionForm, RegionQuestion, Topic};
use gmapd::evaluation::{parse_relations, parse_trajectory};
use gmapd::logs::carmen::CarmenLog;
use gmapd::logs::recording::{self, Format, Recording};
use gmapd::map::mirror::Mirror;
use gmapd::map::region::{Known, LastSeen, Region};
use gmapd::ros::graph::rmw_zenoh::Attachment;
use gmapd::slam::engine::{Engine, Sweep};
use gmapd::slam::grid::Cell;
use gmapd::slam::grid::occupancy::{OccupancyGrid, OccupancyMap, OccupiedThreshold};
use gmapd::slam::pose::{Point2, Pose2};
use gmapd::slam::scan::LaserMount;
use gmapd::slam::state::EngineState;
use gmapd::{convert, map, ros};

/// Bears any bytes.
pub type Target = fn(&[u8]);

/// By the name of the folder of their inputs.
pub const ALL: [(&str, Target); 8] = [
    ("decoders", decoders),
    ("selectors", selectors),
    ("tiles", tiles),
    ("recordings", recordings),
    ("texts", texts),
    ("checkpoints", checkpoints),
    ("states", states),
    ("maps", maps),
];

/// Each message that the daemon takes, what comes with a request, and a map that `gmapd get` reads.
pub fn decoders(bytes: &[u8]) {
    for encoding in ["", "application/json"] {
        if let Ok(message) = ros::decode::<ros::LaserScan>(bytes, encoding) {
            convert::scan(message).ok();
        }
        if let Ok(message) = ros::decode::<ros::Odometry>(bytes, encoding) {
            convert::odometry(message).ok();
        }
        if let Ok(message) = ros::decode::<ros::TfMessage>(bytes, encoding) {
            message.transforms.into_iter().for_each(|transform| {
                convert::transform(transform).ok();
            });
        }
        if let Ok(message) = ros::decode_pose(bytes, encoding) {
            convert::stamped_pose(message).ok();
        }
        ros::decode::<ros::GetMapRequest>(bytes, encoding).ok();
    }
    if let Some(attachment) = Attachment::from_bytes(bytes) {
        assert_eq!(attachment.to_bytes(), bytes);
    }
    map::parse_json(bytes).ok();
}

/// The parameters of each query, with the part of a map that is asked for, and the name of a robot.
pub fn selectors(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    for topic in Topic::ALL {
        match topic.question(text) {
            Ok(Question::Region(asked)) => region(&asked),
            Ok(_) => {}
            Err(error) => assert!(error.to_string().len() < 2000, "{error}"),
        }
    }
    if let Ok(prefix) = Prefix::parse(text) {
        prefix.key("map").expect("what a prefix takes, a key takes");
    }
}

/// A part of a map of 3 by 2 cells; large parts are allowed, and take their time.
fn region(asked: &RegionQuestion) {
    const MOST_CELLS: f64 = 65_536.0;
    let grid = OccupancyGrid {
        resolution: 0.05,
        width: 3,
        height: 2,
        origin: Point2::new(0.0, 0.0),
        cells: vec![0, 100, -1, 100, 0, 0],
    };
    let Some(window) = asked.window else { return };
    let resolution = asked.resolution.unwrap_or(grid.resolution);
    let Ok(region) = Region::new(window, resolution, grid.resolution) else { return };
    let [width, height] = [window.high.x - window.low.x, window.high.y - window.low.y];
    if width * height / (resolution * resolution) > MOST_CELLS {
        return;
    }
    let map = OccupancyMap::of_grid(&grid, Cell::new(-1, 0), 3);
    let (threshold, last_seen) = (OccupiedThreshold::of_share(0.25), LastSeen::default());
    let known = Known { map: &map, threshold, last_seen: &last_seen };
    let part = region.occupancy(Some(&map), threshold);
    assert_eq!(part.cells.len(), part.width * part.height);
    if let RegionForm::Layers(layers) = &asked.form {
        let most = 4096;
        if let Ok(json) = region.json(layers, Some(known), most) {
            assert!((1..=most).contains(&json.len()));
        }
    }
}

/// Messages of tiles that a mirror takes, each after two bytes that say how long it is.
pub fn tiles(bytes: &[u8]) {
    let mut mirror = Mirror::new();
    let mut rest = bytes;
    while let Some((length, others)) = rest.split_first_chunk::<2>() {
        let (message, others) =
            others.split_at(others.len().min(u16::from_le_bytes(*length).into()));
        mirror.take(message).ok();
        mirror.take_reply(&[message]).ok();
        drop(mirror.question());
        rest = others;
    }
}

/// A recording of any format.
pub fn recordings(bytes: &[u8]) {
    let file = Scratch::with(bytes);
    let Ok(format) = recording::format(&file.0) else { return };
    if format == Format::Carmen {
        return carmen(&file.0);
    }
    if let Ok(recording) = Recording::new(&file.0, format) {
        recording.messages().for_each(|message| drop(message.decode()));
    }
}

fn carmen(path: &Path) {
    let Ok(log) = CarmenLog::open(path) else { return };
    log.readings().into_iter().flatten().for_each(drop);
    log.corrected_readings().into_iter().flatten().for_each(drop);
}

/// Files that people write: configurations, trajectories and relations.
pub fn texts(bytes: &[u8]) {
    let file = Scratch::with(bytes);
    Config::load(Some(&file.0), &[]).ok();
    if let Ok(text) = std::str::from_utf8(bytes) {
        Config::load(None, &[text.to_owned()]).ok();
        parse_trajectory(&file.0, text).ok();
        parse_relations(&file.0, text).ok();
    }
}

/// A checkpoint's file, and the state of an engine as it is in one.
pub fn checkpoints(bytes: &[u8]) {
    if let Ok(opened) = checkpoint::open(bytes) {
        opened.body().ok();
    }
    let Ok(state) = postcard::from_bytes::<EngineState>(bytes) else { return };
    let parameters = Config::load(None, &[]).expect("the defaults are allowed").engine_parameters();
    let mut engine = Engine::new(parameters, 1).expect("threads can be started");
    engine.resume(state).ok();
}

/// The body of a checkpoint whose checksum fits: an engine that goes on from it takes a scan.
pub fn states(bytes: &[u8]) {
    let sealed = checkpoint::seal(head(), |to| to.write_all(bytes)).expect("memory takes it");
    let opened = checkpoint::open(&sealed).expect("it was just sealed");
    let Ok(checkpoint) = Checkpoint::decode(&opened) else { return };
    let engine = match checkpoint.engine {
        EngineState::GMapping(_) => "engine=gmapping",
        EngineState::Hector(_) => "engine=hector",
        EngineState::KnownPoses(_) => "engine=known_poses",
    };
    let set = [engine, "particles=2", "maxUrange=3"].map(str::to_owned);
    let parameters = Config::load(None, &set).expect("it is allowed").engine_parameters();
    let mut engine = Engine::new(parameters, 1).expect("it needs no thread");
    if engine.resume(checkpoint.engine).is_err() {
        return;
    }
    let message = include_bytes!("corpus/decoders/scan-2");
    let message = ros::decode::<ros::LaserScan>(message, "").expect("it is one");
    let scan = convert::scan(message).expect("it can be used");
    let (mount, odom_from_base) = (LaserMount::default(), Some(Pose2::IDENTITY));
    engine.add_scan(&Sweep { scan: &scan, mount: &mount, odom_from_base }, &mut |_| ());
    assert!(engine.pose_in_map().is_finite());
}

fn head() -> Head {
    Head { robot: "robot01".to_owned(), ..Head::default() }
}

/// The two files of a map: the YAML, a line of four dashes, and the image.
pub fn maps(bytes: &[u8]) {
    const BETWEEN: &[u8] = b"----\n";
    let end = bytes.windows(BETWEEN.len()).position(|part| part == BETWEEN);
    let (yaml, image) = bytes.split_at(end.unwrap_or(bytes.len()));
    let yaml = Scratch::with(yaml);
    // The image that the inputs name is beside it.
    let beside = yaml.0.with_file_name("map.pgm");
    std::fs::write(&beside, image.strip_prefix(BETWEEN).unwrap_or(image))
        .expect("there is a place for temporary files");
    if let Ok(grid) = map::read(&yaml.0) {
        assert_eq!(grid.cells.len(), grid.width * grid.height);
    }
    std::fs::remove_file(beside).ok();
}

/// A file for what reads files only.
struct Scratch(PathBuf);

impl Scratch {
    fn with(bytes: &[u8]) -> Self {
        static NUMBER: AtomicU64 = AtomicU64::new(0);
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        let name = format!("gmapd-fuzz-{}-{number}", std::process::id());
        let path = std::env::temp_dir().join(name);
        std::fs::write(&path, bytes).expect("there is a place for temporary files");
        Self(path)
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        std::fs::remove_file(&self.0).ok();
    }
}
