//! What is fuzzed: each function takes bytes of any content, and neither panics nor hangs, nor
//! takes memory without bound. The fuzzers of `fuzz_targets` call them, and `tests/corpus.rs`
//! calls them with each input of `corpus`.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use gmapd::checkpoint;
use gmapd::config::Config;
use gmapd::daemon::keys::Prefix;
use gmapd::daemon::selector::Topic;
use gmapd::evaluation::{parse_relations, parse_trajectory};
use gmapd::logs::carmen::CarmenLog;
use gmapd::logs::recording::{self, Format, Recording};
use gmapd::map::mirror::Mirror;
use gmapd::slam::engine::Engine;
use gmapd::slam::state::EngineState;
use gmapd::{convert, map, ros};

/// Bears any bytes.
pub type Target = fn(&[u8]);

/// By the name of the folder of their inputs.
pub const ALL: [(&str, Target); 6] = [
    ("decoders", decoders),
    ("selectors", selectors),
    ("tiles", tiles),
    ("recordings", recordings),
    ("texts", texts),
    ("checkpoints", checkpoints),
];

/// Each message that the daemon takes, and a map that `gmapd get` reads.
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
        ros::decode::<ros::GetMapRequest>(bytes, encoding).ok();
    }
    map::parse_json(bytes).ok();
}

/// The parameters of each query, and the name of a robot.
pub fn selectors(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    for topic in Topic::ALL {
        if let Err(error) = topic.question(text) {
            assert!(error.to_string().len() < 2000, "{error}");
        }
    }
    if let Ok(prefix) = Prefix::parse(text) {
        prefix.key("map").expect("what a prefix takes, a key takes");
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
