//! Recordings of ROS messages: read whole, in parts and damaged, against logs of the same drive.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use gmapd::config::Config;
use gmapd::logs::carmen::CarmenLog;
use gmapd::logs::mcap_writer::{McapRecorder, Recordable};
use gmapd::logs::recording::{self, Recording, RecordingError};
use gmapd::playback::{Frames, Messages};
use gmapd::recorded::{Event, Recorded, RecordedError, Wanted};
use gmapd::ros::{self, Message};
use gmapd::slam::pose::Stamp;
use serde_json::Value;
use tempfile::TempDir;

const SCANS: u64 = 1432;

fn directory() -> TempDir {
    tempfile::tempdir().expect("a temporary directory can be made")
}

fn gmapd(arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_gmapd"));
    command.args(arguments).output().expect("the program was built with this test")
}

fn text(path: &Path) -> &str {
    path.to_str().expect("temporary names are text")
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// The summary of a replay that has to succeed, and what it warned of.
fn replay(arguments: &[&str]) -> (Value, String) {
    let output = gmapd(&[&["replay", "--json"], arguments].concat());
    assert!(output.status.success(), "{arguments:?}: {}", stderr(&output));
    let summary = serde_json::from_slice(&output.stdout).expect("--json prints JSON");
    (summary, stderr(&output))
}

/// A drive of 143 s through a corridor.
fn simulated_log(directory: &TempDir) -> PathBuf {
    let path = directory.path().join("sim.log");
    let simulated =
        gmapd(&["simulate", "--scenario", "corridor", "--beams", "90", "--out", text(&path)]);
    assert!(simulated.status.success(), "{}", stderr(&simulated));
    path
}

/// How odometry is told.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Told {
    Messages,
    Transforms,
    NotAtAll,
}

/// Writes messages as a robot sends them.
struct Robot {
    file: McapRecorder,
    frames: Frames,
    namespace: &'static str,
}

impl Robot {
    fn create(path: &Path, namespace: &'static str) -> Self {
        let file = McapRecorder::create(path).expect("a temporary directory can be written to");
        Self { file, frames: Frames::default(), namespace }
    }

    fn send<M: Message>(&mut self, topic: &str, stamp: Stamp, message: &M) {
        self.file
            .add(&Recordable {
                topic: &format!("{}/{topic}", self.namespace),
                message_type: M::TYPE,
                log_time: stamp,
                stamp: Some(stamp),
                bytes: &ros::cdr(message),
            })
            .expect("the file takes messages");
    }

    /// The log's messages from one scan to another; odometry as it is to be told.
    fn drive(&mut self, log: &Path, scans: std::ops::Range<usize>, odometry_as: Told) {
        let log = CarmenLog::open(log).expect("it was simulated");
        let mut number = 0;
        for reading in log.readings().expect("it was opened before") {
            let reading = reading.expect("it is whole");
            number += usize::from(reading.scan.is_some());
            if !scans.contains(&(number.saturating_sub(1))) {
                continue;
            }
            let stamp = reading.stamp;
            if number == 1 {
                let mount = self.frames.mount(stamp, &reading.mount);
                self.send("tf_static", stamp, &mount);
            }
            let Messages { odometry, scan } = self.frames.messages(&reading);
            match odometry_as {
                Told::Messages => self.send("odom", stamp, &odometry),
                Told::Transforms => self.send("tf", stamp, &transform_of(odometry)),
                Told::NotAtAll => {}
            }
            if let Some(scan) = scan {
                self.send("scan", stamp, &scan);
            }
        }
    }

    fn finish(self) -> PathBuf {
        self.file.finish().expect("the file takes its end")
    }
}

fn transform_of(odometry: ros::Odometry) -> ros::TfMessage {
    let ros::Pose { position: ros::Point { x, y, z }, orientation } = odometry.pose.pose;
    let transform = ros::Transform { translation: ros::Vector3 { x, y, z }, rotation: orientation };
    let (header, child_frame_id) = (odometry.header, odometry.child_frame_id);
    ros::TfMessage { transforms: vec![ros::TransformStamped { header, child_frame_id, transform }] }
}

/// A whole recording of a log.
fn recorded(directory: &TempDir, log: &Path) -> PathBuf {
    let mut robot = Robot::create(&directory.path().join("run.mcap"), "");
    robot.drive(log, 0..usize::MAX, Told::Messages);
    robot.finish()
}

fn open(path: &Path, wanted: &Wanted) -> Result<Recorded, RecordedError> {
    let config = Config::load(None, &[]).expect("the defaults are valid");
    let format = recording::format(path)?;
    Recorded::open(Recording::new(path, format)?, path, wanted, &config)
}

/// Scans that reach the filter.
fn usable_scans(recorded: &Recorded) -> usize {
    let config = Config::load(None, &[]).expect("the defaults are valid");
    let is_scan =
        |event: &Event| matches!(event, Event::Reading(reading) if reading.scan.is_some());
    recorded.readings(&config).filter(is_scan).count()
}

#[test]
fn a_recording_gives_the_map_of_the_log_it_was_made_of() {
    let directory = directory();
    let log = simulated_log(&directory);
    let (expected, _) = replay(&[text(&log)]);
    let recording = recorded(&directory, &log);
    let (found, warnings) = replay(&[text(&recording)]);
    assert_eq!(found["sha256"], expected["sha256"]);
    assert_eq!(found["readings"], expected["readings"]);
    assert!(!warnings.contains("byte"), "{warnings}");

    let hash = expected["sha256"]["map.pgm"].as_str().expect("there is a map");
    assert!(gmapd(&["replay", text(&recording), "--expect", hash]).status.success());
    let other = "0".repeat(64);
    let differs = gmapd(&["replay", text(&recording), "--expect", &other]);
    assert_eq!(differs.status.code(), Some(1));
    let said = stderr(&differs);
    assert!(said.contains(hash) && said.contains(&other), "{said}");
}

#[test]
fn odometry_from_transforms_gives_the_same_map() {
    let directory = directory();
    let log = simulated_log(&directory);
    let (expected, _) = replay(&[text(&log)]);
    let mut robot = Robot::create(&directory.path().join("tf.mcap"), "");
    robot.frames = Frames { odom: "world", base: "foot", laser: "eye" };
    robot.drive(&log, 0..usize::MAX, Told::Transforms);
    let path = robot.finish();
    let (found, _) = replay(&[text(&path)]);
    assert_eq!(found["sha256"]["map.pgm"], expected["sha256"]["map.pgm"]);
    let recorded = open(&path, &Wanted::default()).expect("it is whole");
    let frames = recorded.frames();
    assert_eq!((frames.odom.as_str(), frames.base.as_str()), ("world", "foot"));
}

/// As in the daemon, scans go without odometry where none comes, if the engine can do without.
#[test]
fn odometry_that_ends_stops_hector_no_more_than_the_daemon() {
    let directory = directory();
    let log = simulated_log(&directory);
    let mut robot = Robot::create(&directory.path().join("ends.mcap"), "");
    robot.drive(&log, 0..60, Told::Messages);
    robot.drive(&log, 60..120, Told::NotAtAll);
    let path = robot.finish();
    let (refused, _) = replay(&[text(&path)]);
    let readings = &refused["readings"];
    assert_eq!(readings["refused"], 60, "{readings}");
    let (mapped, _) = replay(&[text(&path), "--engine", "hector"]);
    let readings = &mapped["readings"];
    assert_eq!((&readings["processed"], &readings["refused"]), (&120.into(), &0.into()));
}

#[test]
fn a_recording_without_odometry_is_for_hector_alone() {
    let directory = directory();
    let log = simulated_log(&directory);
    let mut robot = Robot::create(&directory.path().join("scans.mcap"), "");
    robot.drive(&log, 0..60, Told::NotAtAll);
    let path = robot.finish();
    let refused = gmapd(&["replay", text(&path)]);
    assert_eq!(refused.status.code(), Some(1));
    assert!(stderr(&refused).contains("it has no odometry"), "{}", stderr(&refused));
    let (mapped, _) = replay(&[text(&path), "--engine", "hector"]);
    assert_eq!(mapped["readings"]["processed"], 60, "{mapped}");
    let (alone, _) = replay(&[text(&path), "--engine", "hector", "--set", "odometry_source=none"]);
    assert_eq!(mapped["sha256"], alone["sha256"]);
}

#[test]
fn a_folder_of_files_is_one_recording() {
    let directory = directory();
    let log = simulated_log(&directory);
    let (expected, _) = replay(&[text(&log)]);
    let folder = directory.path().join("run");
    fs::create_dir(&folder).expect("a temporary directory can be written to");
    // Their names are not in the order of their content.
    for (name, scans) in [("b.mcap", 0..500), ("a.mcap", 500..usize::MAX)] {
        let mut robot = Robot::create(&folder.join(name), "");
        robot.drive(&log, scans, Told::Messages);
        robot.finish();
    }
    let metadata = "rosbag2_bagfile_information:\n  version: 9\n  storage_identifier: mcap\n  \
                    relative_file_paths:\n    - b.mcap\n    - a.mcap\n";
    fs::write(folder.join("metadata.yaml"), metadata).expect("it is writable");
    let (found, _) = replay(&[text(&folder)]);
    assert_eq!(found["sha256"], expected["sha256"]);

    let sqlite = metadata.replace("mcap\n  rel", "sqlite3\n  rel");
    fs::write(folder.join("metadata.yaml"), sqlite).expect("it is writable");
    let refused = gmapd(&["replay", text(&folder)]);
    assert_eq!(refused.status.code(), Some(1));
    assert!(stderr(&refused).contains("sqlite3"), "{}", stderr(&refused));
}

#[test]
fn whatever_is_cut_off_the_rest_is_read_and_the_place_told() {
    let directory = directory();
    let log = simulated_log(&directory);
    let bytes = fs::read(recorded(&directory, &log)).expect("it was written");
    let cut = directory.path().join("cut.mcap");
    let mut most = 0;
    for part in 1..=40 {
        let length = bytes.len() * part / 41;
        fs::write(&cut, &bytes[..length]).expect("it is writable");
        let Ok(recorded) = open(&cut, &Wanted::default()) else {
            assert_eq!(most, 0, "less is read of {length} bytes than of fewer");
            continue;
        };
        let fault = recorded.faults().first().expect("a file that is cut off has no end");
        assert!(fault.offset <= length as u64, "{fault}");
        let scans = usable_scans(&recorded);
        assert!(scans >= most, "{scans} scans of {length} bytes, {most} of fewer");
        most = scans;
    }
    assert!(most > 1000, "{most} scans of {} bytes", bytes.len() * 40 / 41);
    let (summary, warnings) = replay(&[text(&cut)]);
    assert!(summary["readings"]["processed"].as_u64() > Some(0));
    assert!(warnings.contains("at byte"), "{warnings}");
}

#[test]
fn a_damaged_chunk_costs_no_more_than_itself() {
    let directory = directory();
    let log = simulated_log(&directory);
    let path = recorded(&directory, &log);
    let mut bytes = fs::read(&path).expect("it was written");
    let middle = bytes.len() / 2;
    for byte in &mut bytes[middle..middle + 64] {
        *byte ^= 0x5a;
    }
    fs::write(&path, &bytes).expect("it is writable");
    let recorded = open(&path, &Wanted::default()).expect("most of it is whole");
    assert_eq!(recorded.faults().len(), 1, "{:?}", recorded.faults());
    let scans = recorded.statistics().scans;
    assert!(scans < SCANS && scans > SCANS * 9 / 10, "{scans}");
}

#[test]
fn no_wrong_byte_ends_the_program() {
    let directory = directory();
    let log = simulated_log(&directory);
    let mut robot = Robot::create(&directory.path().join("short.mcap"), "");
    robot.drive(&log, 0..60, Told::Messages);
    let path = robot.finish();
    let whole = fs::read(&path).expect("it was written");
    let mut readable = 0;
    for place in (8..whole.len()).step_by(whole.len() / 300) {
        let mut bytes = whole.clone();
        bytes[place] ^= 0xff;
        fs::write(&path, &bytes).expect("it is writable");
        if let Ok(recorded) = open(&path, &Wanted::default()) {
            assert!(usable_scans(&recorded) <= 60);
            readable += 1;
        }
    }
    assert!(readable > 30, "{readable}");
}

#[test]
fn topics_are_found_or_asked_for() {
    let directory = directory();
    let log = simulated_log(&directory);
    let path = directory.path().join("two.mcap");
    let mut robot = Robot::create(&path, "/robot01");
    robot.drive(&log, 0..300, Told::Messages);
    robot.namespace = "/robot02";
    robot.drive(&log, 0..200, Told::Messages);
    robot.finish();
    let several = gmapd(&["replay", text(&path)]);
    assert_eq!(several.status.code(), Some(1));
    let said = stderr(&several);
    for word in ["/robot01/scan", "/robot02/scan", "--scan"] {
        assert!(said.contains(word), "{said}");
    }
    let wanted = Wanted { scan: Some("robot02/scan".to_owned()), odometry: None };
    let recorded = open(&path, &wanted).expect("the topic is there");
    assert_eq!(recorded.topics().odometry.as_deref(), Some("/robot02/odom"));
    assert_eq!(usable_scans(&recorded), 200);
    let missing = Wanted { scan: Some("/scan".to_owned()), odometry: None };
    let error = open(&path, &missing).expect_err("it is not there").to_string();
    assert!(error.contains("no scans on /scan") && error.contains("/robot01/scan"), "{error}");
}

#[test]
fn what_is_no_recording_is_refused_with_what_is_read() {
    let directory = directory();
    let path = directory.path().join("run.mcap");
    fs::write(&path, b"SQLite format 3\0and so on").expect("it is writable");
    let error = recording::format(&path).expect_err("it is none");
    assert!(matches!(error, RecordingError::UnknownFormat { .. }), "{error}");
    for word in ["CARMEN", "MCAP", "ROS 1 bag", ".db3"] {
        assert!(error.to_string().contains(word), "{error}");
    }
    let log = simulated_log(&directory);
    let refused = gmapd(&["replay", text(&log), "--scan", "/scan"]);
    assert!(stderr(&refused).contains("no topics"), "{}", stderr(&refused));
}

#[test]
fn a_file_that_is_there_is_not_recorded_over() {
    let directory = directory();
    let path = directory.path().join("run.mcap");
    let message = ros::Float64 { data: 1.0 };
    for expected in ["run.mcap", "run-2.mcap", "run-3.mcap"] {
        let mut robot = Robot::create(&path, "");
        robot.send("entropy", Stamp(1), &message);
        assert_eq!(robot.finish().file_name().and_then(|name| name.to_str()), Some(expected));
    }
    assert_eq!(fs::read_dir(directory.path()).expect("it is there").count(), 3);
}

/// What a crash leaves: nothing finishes the file.
#[test]
fn a_recording_that_was_not_finished_can_be_replayed() {
    let directory = directory();
    let log = simulated_log(&directory);
    let mut robot = Robot::create(&directory.path().join("run.mcap"), "");
    robot.drive(&log, 0..1000, Told::Messages);
    let unfinished = robot.file.unfinished().to_owned();
    let crashed = directory.path().join("crashed");
    fs::copy(&unfinished, &crashed).expect("it is there");
    let recorded = open(&crashed, &Wanted::default()).expect("its chunks are whole");
    let scans = usable_scans(&recorded);
    assert!((900..=1000).contains(&scans), "{scans}");
}

fn tutorial_bag() -> Option<PathBuf> {
    let beside = concat!(env!("CARGO_MANIFEST_DIR"), "/../shared/data");
    let data = std::env::var_os("GMAPD_LOGS").map_or_else(|| beside.into(), PathBuf::from);
    let bag = data.join("ros-gmapping-tutorial/basic_localization_stage.bag");
    if !bag.exists() {
        eprintln!("NOT RUN: no recording {}", bag.display());
    }
    Some(bag).filter(|bag| bag.exists())
}

#[test]
fn the_bag_of_the_tutorial_makes_a_map() {
    let Some(bag) = tutorial_bag() else { return };
    let (summary, warnings) = replay(&[text(&bag)]);
    assert!(summary["sha256"]["map.pgm"].is_string(), "{warnings}");
    assert_eq!(summary["readings"]["refused"], 0, "{warnings}");
    let recorded = open(&bag, &Wanted::default()).expect("it is whole");
    assert!(recorded.faults().is_empty());
    assert_eq!(usable_scans(&recorded), 24);
}

#[test]
fn a_bag_may_be_cut_off_anywhere() {
    let Some(bag) = tutorial_bag() else { return };
    let bytes = fs::read(bag).expect("it is there");
    let directory = directory();
    let cut = directory.path().join("cut.bag");
    let mut most = 0;
    for length in (0..bytes.len()).step_by(7919) {
        fs::write(&cut, &bytes[..length]).expect("it is writable");
        let Ok(recorded) = open(&cut, &Wanted::default()) else { continue };
        let scans = usable_scans(&recorded);
        assert!(scans >= most, "{scans} scans of {length} bytes, {most} of fewer");
        most = scans;
    }
    assert!(most >= 23, "{most}");
}
