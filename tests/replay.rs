//! Drives the real program on small logs that the tests write themselves.

use std::fmt::Write as _;
use std::fs;
use std::io::{BufReader, Cursor, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use flate2::Compression;
use flate2::write::GzEncoder;
use serde_json::Value;
use tempfile::TempDir;

/// What the program did.
struct Run {
    code: i32,
    stdout: String,
    stderr: String,
}

fn gmapd(arguments: &[&str]) -> Run {
    let output = Command::new(env!("CARGO_BIN_EXE_gmapd"))
        .args(arguments)
        .stdin(Stdio::null())
        .output()
        .expect("the program was built with this test");
    Run {
        code: output.status.code().expect("no signal ended it"),
        stdout: String::from_utf8(output.stdout).expect("it prints text"),
        stderr: String::from_utf8(output.stderr).expect("it prints text"),
    }
}

fn text(path: &Path) -> &str {
    path.to_str().expect("temporary names are text")
}

fn file(directory: &TempDir, name: &str, bytes: &[u8]) -> PathBuf {
    let path = directory.path().join(name);
    fs::write(&path, bytes).expect("a temporary directory can be written to");
    path
}

fn directory() -> TempDir {
    tempfile::tempdir().expect("a temporary directory can be made")
}

/// A robot that drives 4 m along a room of 10 m by 6 m, from (2, 3): a scan every half metre and
/// an odometry reading between each two.
fn room_log() -> String {
    let mut log = "# a room\nPARAM robot_frontlaser_offset 0.0 nohost 0\n".to_owned();
    for step in 0..=16 {
        let x = f64::from(step) * 0.25;
        let stamp = 100.0 + f64::from(step) * 0.5;
        if step % 2 == 1 {
            writeln!(log, "ODOM {x} 0 0 0.5 0 0 {stamp:.6} host 0").expect("memory suffices");
            continue;
        }
        log.push_str("FLASER 181");
        for beam in 0..181 {
            let angle = (f64::from(beam) - 90.0).to_radians();
            write!(log, " {:.3}", range_in_room(2.0 + x, 3.0, angle)).expect("memory suffices");
        }
        writeln!(log, " {x} 0 0 {x} 0 0 {stamp:.6} host 0").expect("memory suffices");
    }
    log
}

/// The same drive with a laser 0.3 m ahead of the base and odometry that bends; the poses of the
/// laser are `corrected`.
fn bent_log(corrected: impl Fn(f64) -> [f64; 3]) -> String {
    let mut log = "PARAM robot_frontlaser_offset 0.3 nohost 0\n".to_owned();
    for step in 0..=16 {
        let x = f64::from(step) * 0.25;
        let (odom_y, odom_yaw) = (0.1 * x * x, 0.2 * x);
        let [laser_x, laser_y, laser_yaw] = corrected(x);
        log.push_str("FLASER 181");
        for beam in 0..181 {
            let angle = (f64::from(beam) - 90.0).to_radians();
            write!(log, " {:.3}", range_in_room(2.3 + x, 3.0, angle)).expect("memory suffices");
        }
        let stamp = 100.0 + f64::from(step) * 0.5;
        let poses = format!("{laser_x} {laser_y} {laser_yaw} {x} {odom_y} {odom_yaw}");
        writeln!(log, " {poses} {stamp:.6} host 0").expect("memory suffices");
    }
    log
}

fn range_in_room(x: f64, y: f64, angle: f64) -> f64 {
    let along = |position: f64, direction: f64, size: f64| {
        if direction > 0.0 { (size - position) / direction } else { position / -direction }
    };
    along(x, angle.cos(), 10.0).min(along(y, angle.sin(), 6.0))
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::default());
    encoder.write_all(bytes).expect("memory can be written to");
    encoder.finish().expect("memory can be written to")
}

/// The summary of a replay that has to succeed.
fn summary(arguments: &[&str]) -> Value {
    let run = gmapd(&[&["replay", "--json"], arguments].concat());
    assert_eq!(run.code, 0, "{}", run.stderr);
    serde_json::from_str(&run.stdout).expect("--json prints JSON")
}

fn error(arguments: &[&str], code: i32) -> String {
    let run = gmapd(arguments);
    assert_eq!(run.code, code, "{}{}", run.stdout, run.stderr);
    run.stderr
}

#[test]
fn wrong_usage_ends_with_two_and_help_with_zero() {
    assert!(error(&["replay"], 2).contains("<LOG>"));
    assert!(error(&["fly"], 2).contains("unrecognized subcommand"));
    assert!(error(&["replay", "a.log", "--threads", "0"], 2).contains("--threads"));
    for arguments in [&["--help"][..], &["replay", "--help"], &["evaluate", "--help"]] {
        let run = gmapd(arguments);
        assert_eq!(run.code, 0);
        assert!(run.stdout.contains("Examples:"), "{}", run.stdout);
    }
}

#[test]
fn a_missing_log_is_named() {
    let error = error(&["replay", "/nowhere/run.log"], 1);
    assert!(error.contains("cannot open the log /nowhere/run.log: No such file"), "{error}");
}

#[test]
fn an_empty_log_holds_nothing() {
    let directory = directory();
    let log = file(&directory, "empty.log", b"");
    let error = error(&["replay", text(&log)], 1);
    assert!(error.contains("empty.log holds no usable FLASER"), "{error}");
}

#[test]
fn each_reading_has_a_verdict() {
    let directory = directory();
    let log = file(&directory, "room.log", room_log().as_bytes());
    let summary = summary(&[text(&log)]);
    let readings = &summary["readings"];
    let sum: u64 = [
        "processed",
        "not_moved_enough",
        "throttled",
        "no_usable_beams",
        "bad_odometry",
        "bad_geometry",
        "odometry_only",
    ]
    .iter()
    .map(|verdict| readings[verdict].as_u64().expect("counts are whole"))
    .sum();
    assert_eq!((readings["total"].as_u64(), sum), (Some(17), 17));
    assert_eq!(readings["odometry_only"], 8);
    assert_eq!(summary["lines_by_keyword"]["#"], 1);
    assert_eq!(summary["timing"]["log_s"], 8.0);
}

#[test]
fn malformed_lines_are_told_with_number_and_reason_and_passed_over() {
    let directory = directory();
    let mut lines: Vec<String> = room_log().lines().map(str::to_owned).collect();
    lines.insert(3, "ODOM 0 0 nan 0 0 0 100.1 host 0".to_owned());
    lines.insert(5, "FLASER 181 1 2 3".to_owned());
    let log = file(&directory, "damaged.log", lines.join("\n").as_bytes());
    let run = gmapd(&["replay", text(&log), "--json"]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert!(
        run.stderr.contains("damaged.log:4: theta is NaN, which is not finite"),
        "{}",
        run.stderr
    );
    assert!(
        run.stderr.contains("damaged.log:6: has 5 fields where 192 are needed"),
        "{}",
        run.stderr
    );
    let summary: Value = serde_json::from_str(&run.stdout).expect("--json prints JSON");
    assert_eq!(summary["readings"]["malformed"], 2);
    assert_eq!(summary["readings"]["total"], 17);
}

/// B5 of the semantics: a jump of more than `jump_max_step_m`, there and back.
#[test]
fn jumps_of_odometry_are_rejected_and_counted() {
    let directory = directory();
    let mut lines: Vec<String> = room_log().lines().map(str::to_owned).collect();
    lines.insert(10, "ODOM 30 0 0 0 0 0 104.1 host 0".to_owned());
    let log = file(&directory, "jump.log", lines.join("\n").as_bytes());
    let rejected = summary(&[text(&log)]);
    assert_eq!(rejected["readings"]["jump_rejected"], 2);
    let believed = summary(&[text(&log), "--set", "jump_policy=continue"]);
    assert_eq!(believed["readings"]["jump_rejected"], 0);
}

#[test]
fn known_poses_are_those_that_the_log_was_corrected_to_or_those_of_a_file() {
    let directory = directory();
    let true_laser = |x| [x + 0.3, 0.0, 0.0];
    let log = file(&directory, "corrected.log", bent_log(true_laser).as_bytes());
    let out = directory.path().join("out");
    let run =
        gmapd(&["replay", text(&log), "--engine", "known_poses", "--out", text(&out), "--json"]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert!(!run.stderr.contains("--poses"), "{}", run.stderr);
    let corrected: Value = serde_json::from_str(&run.stdout).expect("--json prints JSON");
    assert_eq!(corrected["readings"]["processed"], 17);
    // The base drives straight on, from the origin to 4 m.
    let trajectory = fs::read_to_string(out.join("trajectory.tum")).expect("it was written");
    let last: Vec<f64> = trajectory
        .lines()
        .last()
        .expect("it has poses")
        .split(' ')
        .map(|field| field.parse().expect("a number"))
        .collect();
    assert!((last[1] - 4.0).abs() < 1e-6 && last[2].abs() < 1e-6, "{last:?}");

    let poses: String = (0..=16)
        .map(|step| format!("{} {} 0 0\n", 100.0 + 0.5 * f64::from(step), 0.25 * f64::from(step)))
        .collect();
    let poses = file(&directory, "poses.txt", poses.as_bytes());
    let given = summary(&[text(&log), "--engine", "known_poses", "--poses", text(&poses)]);
    assert_eq!(given["sha256"], corrected["sha256"]);
    let by_odometry = summary(&[text(&log)]);
    assert_ne!(by_odometry["sha256"]["map.pgm"], corrected["sha256"]["map.pgm"]);
}

#[test]
fn a_scan_outside_of_the_given_poses_is_refused_by_how_much() {
    let directory = directory();
    let log = file(&directory, "corrected.log", bent_log(|x| [x + 0.3, 0.0, 0.0]).as_bytes());
    let poses = file(&directory, "poses.txt", b"100 0 0 0\n107.25 3.625 0 0\n");
    let arguments = [text(&log), "--engine", "known_poses", "--poses", text(&poses)];
    let run = gmapd(&[&["replay", "--json"], &arguments[..]].concat());
    assert_eq!(run.code, 0, "{}", run.stderr);
    let told = "2 scans could not be used; of the last of them: no pose is given for it: the last is \
                750.0 ms older";
    assert!(run.stderr.contains(told), "{}", run.stderr);
    let summary: Value = serde_json::from_str(&run.stdout).expect("--json prints JSON");
    let readings = &summary["readings"];
    assert_eq!((&readings["processed"], &readings["refused"]), (&15.into(), &2.into()));
}

#[test]
fn a_log_whose_poses_were_not_corrected_is_told_for_what_it_is() {
    let directory = directory();
    let log = file(&directory, "room.log", room_log().as_bytes());
    let run = gmapd(&["replay", text(&log), "--engine", "known_poses"]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let told = "room.log no pose is corrected: the map is along odometry; --poses FILE";
    assert!(run.stderr.contains(told), "{}", run.stderr);
}

#[test]
fn a_truncated_log_is_replayed_up_to_where_it_ends() {
    let directory = directory();
    let whole = room_log();
    let log = file(&directory, "cut.log", &whole.as_bytes()[..whole.len() - 200]);
    let plain = summary(&[text(&log)]);
    assert_eq!(plain["readings"]["total"], 16);
    assert_eq!(plain["readings"]["malformed"], 1);

    let zipped = gzip(whole.as_bytes());
    let log = file(&directory, "cut.log.gz", &zipped[..zipped.len() - 20]);
    let run = gmapd(&["replay", text(&log)]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert!(run.stderr.contains("the compressed file is cut off here"), "{}", run.stderr);
}

#[test]
fn a_gzipped_log_is_recognised_by_its_content_and_equals_the_plain_one() {
    let directory = directory();
    let plain = file(&directory, "room.log", room_log().as_bytes());
    let zipped = file(&directory, "zipped.log", &gzip(room_log().as_bytes()));
    let (plain, zipped) = (summary(&[text(&plain)]), summary(&[text(&zipped)]));
    assert_eq!(plain["sha256"], zipped["sha256"]);
    assert_eq!(plain["readings"], zipped["readings"]);
}

#[test]
fn an_unknown_key_is_named_and_the_nearest_suggested() {
    let directory = directory();
    let log = file(&directory, "room.log", room_log().as_bytes());
    let message = error(&["replay", text(&log), "--set", "partikles=3"], 1);
    assert!(message.contains("unknown key partikles, did you mean particles?"), "{message}");

    let config = file(&directory, "my.yaml", b"delta: 0.1\nsrrr: 0.1\n");
    let message = error(&["replay", text(&log), "--config", text(&config)], 1);
    assert!(message.contains("my.yaml:2: unknown key srrr, did you mean srr?"), "{message}");
}

#[test]
fn the_summary_tells_the_configuration_that_held() {
    let directory = directory();
    let log = file(&directory, "room.log", room_log().as_bytes());
    let config = file(&directory, "my.yaml", b"particles: 5\ndelta: 0.1\nxmin: -5\n");
    let arguments = [text(&log), "--config", text(&config), "--set", "particles=6", "--seed", "9"];
    let summary = summary(&arguments);
    assert_eq!((&summary["particles"], &summary["seed"]), (&6.into(), &9.into()));
    assert_eq!(summary["configuration"]["particles"], 6);
    assert_eq!(summary["configuration"]["delta"], 0.1);
    let run = gmapd(&[&["replay"], &arguments[..]].concat());
    assert!(
        run.stderr.contains("xmin has no effect: the map grows without limit"),
        "{}",
        run.stderr
    );
    assert!(run.stdout.contains("particles      6"), "{}", run.stdout);
}

#[test]
fn without_out_nothing_is_written() {
    let directory = directory();
    let log = file(&directory, "room.log", room_log().as_bytes());
    summary(&[text(&log)]);
    assert_eq!(fs::read_dir(directory.path()).expect("it is there").count(), 1);
}

#[test]
fn results_are_written_and_parse() {
    let directory = directory();
    let log = file(&directory, "room.log", room_log().as_bytes());
    let out = directory.path().join("a").join("b");
    let summary = summary(&[text(&log), "--out", text(&out), "--set", "particles=3"]);

    let written = fs::read_to_string(out.join("summary.json")).expect("it was written");
    let written: Value = serde_json::from_str(&written).expect("it is JSON");
    assert_eq!(written, summary);

    let trajectory = fs::read_to_string(out.join("trajectory.tum")).expect("it was written");
    let rows: Vec<Vec<f64>> = trajectory
        .lines()
        .map(|line| line.split(' ').map(|field| field.parse().expect("a number")).collect())
        .collect();
    assert_eq!(rows.len(), 17);
    assert!(rows.iter().all(|row| row.len() == 8));
    assert!((rows[16][0] - 108.0).abs() < 1e-6);
    assert!((rows[16][1] - 4.0).abs() < 0.2 && rows[16][2].abs() < 0.2, "{:?}", rows[16]);

    assert!(summary["timing"]["phases"]["match"]["cpu_ms"]["p50"].is_number());
    check_map(&out);
}

fn check_map(out: &Path) {
    let pgm = fs::read(out.join("map.pgm")).expect("it was written");
    assert!(pgm.starts_with(b"P5\n"));
    let pixels = |value: u8| pgm.iter().filter(|&&pixel| pixel == value).count();
    assert!(pixels(254) > 1000 && pixels(0) > 100, "free {} occupied {}", pixels(254), pixels(0));

    let yaml = fs::read_to_string(out.join("map.yaml")).expect("it was written");
    assert!(yaml.contains("image: map.pgm\nmode: trinary\nresolution: 0.05\n"), "{yaml}");

    let png = fs::read(out.join("map.png")).expect("it was written");
    let mut reader =
        png::Decoder::new(BufReader::new(Cursor::new(png))).read_info().expect("a PNG");
    let mut picture = vec![0; reader.output_buffer_size().expect("it fits into memory")];
    reader.next_frame(&mut picture).expect("all of it is there");
}

#[test]
fn a_second_run_gives_the_same_bytes_on_any_number_of_threads() {
    let directory = directory();
    let log = file(&directory, "room.log", room_log().as_bytes());
    let hashes = |threads: &str| summary(&[text(&log), "--threads", threads])["sha256"].clone();
    let one = hashes("1");
    assert_eq!(hashes("1"), one);
    assert_eq!(hashes("2"), one);
}

#[test]
fn a_trajectory_is_evaluated_against_relations() {
    let directory = directory();
    let trajectory = file(&directory, "t.txt", b"1.0 0 0 0\n2.0 1.0 0 0\n");
    let relations = file(&directory, "r.txt", b"1.0 2.0 1.1 0 0 0 0 0\n1.0 9.0 0 0 0 0 0 0\n");
    let run = gmapd(&["evaluate", text(&trajectory), text(&relations), "--json"]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let report: Value = serde_json::from_str(&run.stdout).expect("--json prints JSON");
    let mean = report["translation_m"]["mean"].as_f64().expect("a number");
    assert!((mean - 0.1).abs() < 1e-9);
    assert_eq!((&report["used"], &report["skipped"][0]["line"]), (&1.into(), &2.into()));

    let run = gmapd(&["evaluate", text(&trajectory), text(&relations)]);
    assert!(run.stdout.contains("1 used, 1 skipped"), "{}", run.stdout);
    assert!(run.stdout.contains("line 2: no pose at 9.000000"), "{}", run.stdout);
}

#[test]
fn relations_that_do_not_belong_to_the_trajectory_are_a_failure() {
    let directory = directory();
    let trajectory = file(&directory, "t.txt", b"1.0 0 0 0\n");
    let relations = file(&directory, "r.txt", b"5.0 6.0 0 0 0 0 0 0\n");
    let message = error(&["evaluate", text(&trajectory), text(&relations)], 1);
    assert!(message.contains("no relation of"), "{message}");
    let message = error(&["evaluate", text(&relations), text(&trajectory)], 1);
    assert!(message.contains("t.txt:1: has 4 fields where 8"), "{message}");
}

/// `gmapd replay ... | head -0` is no failure.
#[test]
fn a_reader_that_leaves_early_is_no_failure() {
    let directory = directory();
    let log = file(&directory, "room.log", room_log().as_bytes());
    let mut child = Command::new(env!("CARGO_BIN_EXE_gmapd"))
        .args(["replay", text(&log), "--json"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the program was built with this test");
    drop(child.stdout.take());
    let output = child.wait_with_output().expect("it ends");
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{stderr}");
    assert!(!stderr.contains("panicked"), "{stderr}");
}
