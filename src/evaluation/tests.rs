use std::path::Path;

use proptest::prelude::{prop_assert, proptest};

use super::*;

fn pose(seconds: f64, x: f64, y: f64, theta: f64) -> StampedPose {
    StampedPose { stamp: Stamp::from_seconds(seconds), pose: Pose2::new(x, y, theta) }
}

fn relation(from: f64, to: f64, x: f64, yaw: f64) -> Relation {
    Relation {
        line: 1,
        from: Stamp::from_seconds(from),
        to: Stamp::from_seconds(to),
        pose: Pose2::new(x, 0.0, yaw),
    }
}

#[test]
fn a_relation_measures_distance_and_angle() {
    let trajectory = [pose(1.0, 0.0, 0.0, 0.0), pose(2.0, 1.3, 0.4, 0.1)];
    let report = relation_errors(&trajectory, &[relation(1.0, 2.0, 1.0, 0.0)]);
    let translation = report.translation_m.unwrap();
    assert!((translation.mean - 0.5).abs() < 1e-12 && translation.std.abs() < 1e-12);
    assert!((report.rotation_deg.unwrap().max - 0.1_f64.to_degrees()).abs() < 1e-9);
}

#[test]
fn stamps_need_not_be_sorted_and_match_within_ten_microseconds() {
    let trajectory = [pose(2.000_009, 1.0, 0.0, 0.0), pose(1.0, 0.0, 0.0, 0.0)];
    let relations = [relation(1.0, 2.0, 1.0, 0.0), relation(1.0, 2.000_020, 1.0, 0.0)];
    let report = relation_errors(&trajectory, &relations);
    assert_eq!((report.used, report.skipped.len()), (1, 1));
    assert!((report.skipped[0].stamp_s - 2.000_020).abs() < 1e-9);
    assert!((report.skipped[0].nearest_s.unwrap() - 11e-6).abs() < 1e-9);
}

#[test]
fn an_empty_trajectory_has_no_errors_to_tell() {
    let report = relation_errors(&[], &[relation(1.0, 2.0, 1.0, 0.0)]);
    assert_eq!((report.used, report.translation_m), (0, None));
    assert_eq!(report.skipped[0].nearest_s, None);
}

#[test]
fn messages_name_file_and_line() {
    let path = Path::new("truth.relations");
    let error = |text: &str| parse_relations(path, text).unwrap_err().to_string();
    assert_eq!(
        error("# t1 t2\n1 2 3 4 5 6 7\n"),
        "truth.relations:2: has 7 fields where 8 (stamp stamp x y z roll pitch yaw) are needed"
    );
    assert_eq!(error("1 2 3 4 5 6 7 x\n"), "truth.relations:1: \"x\" is not a finite number");
    assert_eq!(error("\n# nothing\n"), "truth.relations holds no data");
}

#[test]
fn four_columns_are_stamp_x_y_theta() {
    let trajectory = parse_trajectory(Path::new("t"), "976052857.337483 1 2 0.5\n").unwrap();
    assert_eq!(trajectory, [pose(976_052_857.337_483, 1.0, 2.0, 0.5)]);
}

#[test]
fn stamps_of_a_tum_file_have_six_decimals() {
    let trajectory = [pose(976_052_857.337_483, 0.0, 0.0, 0.0), pose(-0.25, 0.0, 0.0, 0.0)];
    let text = tum(&trajectory);
    let stamps: Vec<&str> = text.lines().map(|line| line.split(' ').next().unwrap()).collect();
    assert_eq!(stamps[0], "976052857.337483");
}

proptest! {
    #[test]
    fn a_tum_file_reads_back(
        seconds in 0.0..2e9,
        x in -1e3..1e3,
        y in -1e3..1e3,
        theta in -3.1..3.1,
    ) {
        let written = pose(seconds, x, y, theta);
        let read = parse_trajectory(Path::new("t"), &tum(&[written])).unwrap()[0];
        let difference = written.pose.between(read.pose);
        prop_assert!(difference.position().norm() < 2e-9 && difference.theta.abs() < 1e-8);
        prop_assert!(read.stamp.seconds_since(written.stamp).abs() < 2e-6);
    }
}

/// The figures that the authors' own trajectory has under this metric; needs the recorded data.
#[test]
fn the_published_trajectory_of_intel_has_its_published_errors() {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/intel");
    if !data.exists() {
        eprintln!("NOT RUN: {} is not there", data.display());
        return;
    }
    let trajectory = read_trajectory(&data.join("gmapping-published.txt")).unwrap();
    let relations = read_relations(&data.join("intel.relations")).unwrap();
    let report = relation_errors(&trajectory, &relations);
    let translation = report.translation_m.unwrap();
    let rotation = report.rotation_deg.unwrap();
    eprintln!("{} used: {translation:?} {rotation:?}", report.used);
    assert_eq!((report.used, report.skipped.len()), (2984, 0));
    assert!((translation.mean - 0.0416).abs() < 0.00005, "{translation:?}");
    assert!((translation.std - 0.0351).abs() < 0.00005, "{translation:?}");
    assert!((rotation.mean - 1.84).abs() < 0.005, "{rotation:?}");
    assert!((rotation.std - 1.59).abs() < 0.005, "{rotation:?}");
}
