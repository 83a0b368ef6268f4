//! Drives the real program over real Zenoh on loopback: a daemon, and those who ask it.

use std::fs;
use std::path::{Path, PathBuf};

use serde_json::Value;
use sha2::{Digest as _, Sha256};
use tempfile::TempDir;

use self::processes::{Background, Daemon, ROUTER, directory, endpoint, file, gmapd, program};
use self::processes::{simulated_log, succeed, text};

#[expect(dead_code, reason = "other tests use the rest")]
mod processes;

/// What it complained about.
fn fail(arguments: &[&str], code: i32) -> String {
    let run = gmapd(arguments);
    assert_eq!(run.code, Some(code), "{arguments:?}: {}{}", run.text(), run.stderr);
    run.stderr
}

impl Daemon {
    /// A second daemon on the same mesh.
    fn join(&self, prefix: &str) -> Background {
        let mut command = program();
        command.args(["run", "--prefix", prefix, "-e", &self.endpoint, "--threads", "1"]);
        let background = Background::start(&mut command);
        background.line_with("waiting for scans");
        background
    }
}

fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

/// The hashes that `gmapd replay` tells of a log.
fn replayed(log: &Path) -> Value {
    replayed_with(log, &[])
}

fn replayed_with(log: &Path, arguments: &[&str]) -> Value {
    let summary = succeed(&[&["replay", text(log), "--json"], arguments].concat());
    let mut summary: Value = serde_json::from_str(&summary).expect("--json prints JSON");
    summary["sha256"].take()
}

/// The hash of an answer, by way of a file.
fn answered(daemon: &Daemon, what: &str, name: &str) -> String {
    let directory = directory();
    let path = directory.path().join(name);
    succeed(&["get", "-e", &daemon.endpoint, what, "-o", text(&path)]);
    sha256(&fs::read(&path).expect("it was written"))
}

#[test]
fn playing_a_log_gives_the_map_and_path_that_replaying_it_gives() {
    let directory = directory();
    let log = simulated_log(&directory);
    let expected = replayed(&log);
    for rate in ["max", "40"] {
        let daemon = Daemon::start("robot01");
        let told = daemon.play(&[text(&log), "--prefix", "robot01", "--rate", rate]);
        assert!(told.starts_with("played 1432 scans in"), "{told}");
        assert!(told.contains(" processed") && !told.contains("overload"), "{told}");
        assert_eq!(answered(&daemon, "map", "map.pgm"), expected["map.pgm"], "rate {rate}");
        assert_eq!(answered(&daemon, "path", "path.tum"), expected["path.tum"], "rate {rate}");
    }
}

#[test]
fn a_log_of_sweeps_is_played_and_replayed_alike() {
    let directory = directory();
    let log = simulated_log(&directory);
    let sweeps = ["--set", "sweep_time_s=0.1"];
    let expected = replayed_with(&log, &sweeps);
    assert_ne!(expected["map.pgm"], replayed(&log)["map.pgm"], "motion during sweeps matters");
    let daemon = Daemon::start_with("robot01", &sweeps);
    daemon.play(&[text(&log), "--prefix", "robot01", "--rate", "max"]);
    assert_eq!(answered(&daemon, "map", "map.pgm"), expected["map.pgm"]);
    assert_eq!(answered(&daemon, "path", "path.tum"), expected["path.tum"]);
}

/// Once by the daemon itself, and once beside it.
#[test]
fn a_recording_of_a_live_run_replays_to_its_map() {
    let directory = directory();
    let log = simulated_log(&directory);
    let [inside, beside] = ["inside.mcap", "beside.mcap"].map(|name| directory.path().join(name));
    let record = format!("record={}", text(&inside));
    let mut daemon = Daemon::start_with("robot01", &["--set", &record]);
    let mut command = program();
    command.args(["record", "robot01", "-e", &daemon.endpoint, "-o", text(&beside)]);
    let mut recorder = Background::start(&mut command);
    recorder.line_with("recording robot01");
    daemon.play(&[text(&log), "--prefix", "robot01", "--rate", "max"]);
    let live = answered(&daemon, "map", "map.pgm");
    recorder.interrupt();
    recorder.line_with("recorded ");
    assert_eq!(recorder.exit_code(), Some(0));
    daemon.background.interrupt();
    assert_eq!(daemon.background.exit_code(), Some(0));
    for recording in [inside, beside] {
        succeed(&["replay", text(&recording), "--expect", &live]);
        // And once more onto the mesh.
        let daemon = Daemon::start("robot02");
        daemon.play(&[text(&recording), "--prefix", "robot02", "--rate", "max"]);
        assert_eq!(answered(&daemon, "map", "map.pgm"), live);
    }
}

#[test]
fn recorded_logs_give_the_same_too() {
    let beside = concat!(env!("CARGO_MANIFEST_DIR"), "/../shared/data");
    let data = std::env::var_os("GMAPD_LOGS").map_or_else(|| beside.into(), PathBuf::from);
    let bag = "ros-gmapping-tutorial/basic_localization_stage.bag";
    for name in ["aces/aces.log", "tinyslam/exp1.log", bag] {
        let log = data.join(name);
        if !log.exists() {
            eprintln!("NOT RUN: no recorded log {}", log.display());
            continue;
        }
        let daemon = Daemon::start("robot01");
        daemon.play(&[text(&log), "--prefix", "robot01", "--rate", "max"]);
        let expected = replayed(&log);
        assert_eq!(answered(&daemon, "map", "map.pgm"), expected["map.pgm"], "{name}");
        assert_eq!(answered(&daemon, "path", "path.tum"), expected["path.tum"], "{name}");
    }
}

#[test]
fn a_log_whose_clock_steps_back_is_refused_unless_it_is_restamped() {
    let directory = directory();
    let whole = fs::read_to_string(simulated_log(&directory)).expect("it was written");
    // The stamp is the last but two of a line's fields; the clock is set back by two seconds.
    let set_back = |line: &str| {
        let fields: Vec<&str> = line.split(' ').collect();
        let stamp: f64 = fields[fields.len() - 3].parse().expect("it is a number");
        line.replace(fields[fields.len() - 3], &format!("{:.6}", stamp - 2.0))
    };
    let is_reading = |line: &str| line.starts_with("ODOM") || line.starts_with("ROBOTLASER1");
    let lines = whole.lines().enumerate().map(|(index, line)| {
        if index >= 500 && is_reading(line) { set_back(line) } else { line.to_owned() }
    });
    let log = file(&directory, "stepped.log", &(lines.collect::<Vec<_>>().join("\n") + "\n"));

    let error = fail(&["play", text(&log), "--prefix", "robot01"], 1);
    assert!(error.contains("stepped.log: line 501 has the stamp 10"), "{error}");
    assert!(error.contains("of line 500; --restamp gives it stamps that increase"), "{error}");

    let daemon = Daemon::start("robot01");
    daemon.play(&[text(&log), "--prefix", "robot01", "--rate", "max", "--restamp"]);
    // Other stamps, and so another path; the same map.
    assert_eq!(answered(&daemon, "map", "map.pgm"), replayed(&log)["map.pgm"]);
}

/// A robot that has been mapped, for all that can be asked.
fn mapped(directory: &TempDir) -> Daemon {
    let log = simulated_log(directory);
    let daemon = Daemon::start("robot01");
    daemon.play(&[text(&log), "--prefix", "robot01", "--rate", "max"]);
    daemon
}

#[test]
fn everything_a_robot_knows_can_be_had() {
    let directory = directory();
    let daemon = mapped(&directory);
    let get = |arguments: &[&str]| succeed(&[&["get", "-e", &daemon.endpoint], arguments].concat());

    let status = get(&[]);
    assert!(status.contains("\nscans        1432, ") && status.contains("m2 known"), "{status}");
    let status: Value = serde_json::from_str(&get(&["robot01", "--json"])).expect("it is JSON");
    assert_eq!(status["inputs"]["scan"]["received"], 1432);

    let drawing = get(&["robot01", "map"]);
    assert!(drawing.contains("arrow: robot"), "{drawing}");
    assert!(drawing.lines().all(|line| line.chars().count() <= 120), "{drawing}");
    assert!(get(&["robot01", "pose"]).contains("\npose         ("));
    assert!(get(&["robot01", "map_metadata"]).contains("cells of 0.05 m"));
    assert!(get(&["robot01", "entropy"]).ends_with(" nats\n"));
    assert!(get(&["robot01", "particlecloud"]).starts_with("# 30 particles"));
    assert!(get(&["robot01", "path"]).lines().count() > 100);

    let out = |name: &str| directory.path().join(name);
    for name in ["map.png", "map.cdr", "pose.json", "path.cdr"] {
        let what = name.split('.').next().expect("it has a name");
        get(&["robot01", what, "-o", text(&out(name))]);
    }
    let picture = fs::read(out("map.png")).expect("it was written");
    assert!(picture.starts_with(b"\x89PNG"));
    assert!(fs::read(out("map.cdr")).expect("it was written").starts_with(&[0, 1, 0, 0]));
    let pose = fs::read(out("pose.json")).expect("it was written");
    let pose: Value = serde_json::from_slice(&pose).expect("it is JSON");
    assert!(pose["pose"]["pose"]["position"]["x"].is_number(), "{pose}");
}

#[test]
fn a_saved_map_is_that_of_the_daemon_and_loads_by_its_yaml() {
    let directory = directory();
    let daemon = mapped(&directory);
    let name = directory.path().join("office");
    let told = succeed(&["save", "-e", &daemon.endpoint, "robot01", "-f", text(&name)]);
    assert!(told.contains("office.pgm\n") && told.contains("office.yaml\n"), "{told}");
    let pgm = fs::read(name.with_extension("pgm")).expect("it was written");
    assert_eq!(sha256(&pgm), answered(&daemon, "map", "map.pgm"));
    let yaml = fs::read_to_string(name.with_extension("yaml")).expect("it was written");
    assert!(yaml.starts_with("image: office.pgm\nmode: trinary\nresolution: 0.05\n"), "{yaml}");

    let nowhere = directory.path().join("missing").join("office");
    let error = fail(&["save", "-e", &daemon.endpoint, "-f", text(&nowhere)], 1);
    assert!(error.contains("missing/office.pgm"), "{error}");
}

#[test]
fn errors_name_what_is_wrong_and_who_would_answer() {
    let daemon = Daemon::start("robot01");
    let at = ["-e", &daemon.endpoint];
    let error = fail(&[&["get", "robot02", "map"], &at[..]].concat(), 1);
    assert!(error.contains("nobody answers on robot02/map; alive are: robot01"), "{error}");
    let error = fail(&[&["get", "robot01", "map"], &at[..]].concat(), 1);
    assert!(error.starts_with("error: ") && error.contains("no map"), "{error}");
    let error = fail(&[&["get", "robot01", "pose", "--format", "png"], &at[..]].concat(), 1);
    assert!(error.contains("png") && error.contains("json"), "{error}");
    let error = fail(&[&["save", "robot01", "-f", "office"], &at[..]].concat(), 1);
    assert!(error.contains("there is no map yet"), "{error}");
    let error = fail(&[&["get", "fleet/*"], &at[..]].concat(), 1);
    assert!(error.contains("wildcard"), "{error}");
    assert!(fail(&["get", "-e", "tcp/127.0.0.1:1"], 1).contains("tcp/127.0.0.1:1"));

    for wrong in [
        &["get", "robot01", "mapp"][..],
        &["get", "robot01", "map", "-o", "map.gif"],
        &["play"],
        &["play", "a.log", "--rate", "0"],
        &["play", "a.log", "--prefix", "robot*"],
        &["save", "robot01"],
        &["doctor", "--seconds", "0"],
        &["demo", "--seconds", "0"],
    ] {
        fail(wrong, 2);
    }
    for command in ["play", "get", "save", "list", "doctor", "demo"] {
        assert!(succeed(&[command, "--help"]).contains("Examples:"), "{command}");
    }
}

#[test]
fn robots_are_listed_and_one_of_several_has_to_be_named() {
    let daemon = Daemon::start("robot01");
    let list = || succeed(&["list", "-e", &daemon.endpoint]);
    let alone = list();
    assert_eq!(alone.lines().count(), 1, "{alone}");
    assert!(alone.starts_with("robot01          waiting for scans     no map yet"), "{alone}");

    let _second = daemon.join("site/robot02");
    let both = list();
    let names: Vec<_> = both.lines().filter_map(|line| line.split(' ').next()).collect();
    assert_eq!(names, ["robot01", "site/robot02"]);
    let error = fail(&["get", "-e", &daemon.endpoint, "status"], 1);
    assert!(error.contains("robot01, site/robot02; name one of them"), "{error}");
}

#[test]
fn a_mesh_without_robots_is_told() {
    let directory = directory();
    let zenoh = file(&directory, "router.json5", ROUTER);
    let zenoh = ["--zenoh", text(&zenoh)];
    for command in [&["list"][..], &["get"], &["save", "-f", "office"], &["doctor"]] {
        let error = fail(&[command, &zenoh[..]].concat(), 1);
        assert!(error.contains("start gmapd run"), "{error}");
    }
    // A robot without a daemon can be looked at, if it is named.
    let run = gmapd(&[&["doctor", "robot01", "--seconds", "1"], &zenoh[..]].concat());
    assert_eq!(run.code, Some(1), "{}", run.stderr);
    assert!(run.text().contains("WRONG   nothing arrived on robot01/scan\n"), "{}", run.text());
    assert!(run.text().contains("remedy: start the driver"), "{}", run.text());
    assert!(run.stderr.contains("error: 3 things are wrong"), "{}", run.stderr);
}

#[test]
fn an_interrupt_ends_playing_cleanly() {
    let directory = directory();
    let log = simulated_log(&directory);
    let daemon = Daemon::start("robot01");
    let mut play = Background::start(program().args([
        "play",
        text(&log),
        "--prefix",
        "robot01",
        "-e",
        &daemon.endpoint,
    ]));
    play.line_with("waiting for a daemon");
    daemon.background.line_with("mapped");
    play.interrupt();
    play.line_with("interrupted after");
    assert_eq!(play.exit_code(), Some(0));
}

/// A daemon that starts after the player still learns how the laser sits.
#[test]
fn playing_waits_for_a_daemon() {
    let directory = directory();
    let log = simulated_log(&directory);
    let meeting_point = Daemon::start("somebody");
    let at = ["-e", &meeting_point.endpoint];
    let arguments = ["play", text(&log), "--prefix", "robot01", "--rate", "max"];
    let mut play = Background::start(program().args(arguments).args(at));
    play.line_with("waiting for a daemon that takes robot01/scan");
    let _daemon = meeting_point.join("robot01");
    let told = play.line_with("played");
    assert!(told.contains("processed") && !told.contains("no mount"), "{told}");
    assert_eq!(play.exit_code(), Some(0));
}

#[test]
fn the_demo_maps_is_healthy_and_leaves_its_map() {
    let directory = directory();
    let out = directory.path().join("out");
    let mut demo = Background::start(program().args([
        "demo",
        "--seconds",
        "60",
        "--prefix",
        "r2d2",
        "--out",
        text(&out),
    ]));
    let endpoint = endpoint(&demo.line_with("meanwhile"));
    demo.line_with("m2 known");
    let report = succeed(&["doctor", "-e", &endpoint, "r2d2", "--seconds", "2"]);
    assert!(report.contains("Hz, 360 beams") && report.ends_with("healthy\n"), "{report}");
    assert!(succeed(&["list", "-e", &endpoint]).starts_with("r2d2 "));
    let told = demo.line_with("from the truth on average");
    assert!(told.contains(" scans in the map, "), "{told}");
    demo.line_with("next: open");
    assert_eq!(demo.exit_code(), Some(0));
    for name in ["map.pgm", "map.yaml", "map.png", "path.tum"] {
        assert!(fs::metadata(out.join(name)).expect("it was written").len() > 100, "{name}");
    }
}
