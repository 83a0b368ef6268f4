use proptest::prelude::{any, prop_assert_eq, proptest};

use super::*;
use crate::slam::scan::Beam;

fn survey(log: &str) -> (Lasers, LogStatistics) {
    let bytes: Vec<u8> = log.as_bytes().to_vec();
    let mut survey = Survey::default();
    survey.read(&mut Lines::new(Box::new(std::io::Cursor::new(bytes)))).unwrap();
    survey.finish()
}

fn reading(line: &str) -> Reading {
    match parse(line, &Lasers::default()).unwrap() {
        Message::Reading(reading) => reading,
        other => panic!("{line} is {other:?}"),
    }
}

fn flaser(beams: usize, range: &str) -> String {
    let ranges = vec![range; beams].join(" ");
    format!("FLASER {beams} {ranges} 9 9 9 1.5 -2.5 0.25 12.000001 host 0.5")
}

fn robotlaser(header: &str, poses: &str) -> String {
    format!("ROBOTLASER1 {header} 0 {poses} 0.1 0.2 0.3 0.4 0 7.5 host 7.6")
}

fn degrees(scan: &Scan, beam: usize) -> f64 {
    scan.geometry.angle(beam).to_degrees()
}

#[test]
fn a_flaser_line_carries_its_own_odometry() {
    let reading = reading(&flaser(3, "4.25"));
    assert_eq!(reading.odom_from_base, Pose2::new(1.5, -2.5, 0.25));
    assert_eq!(reading.stamp, Stamp(12_000_001_000));
    assert_eq!(reading.scan.unwrap().ranges, [4.25; 3]);
}

#[test]
fn flaser_angles_follow_the_sick() {
    for (beams, last) in [(180, 89.0), (181, 90.0), (360, 89.5), (361, 90.0)] {
        let scan = reading(&flaser(beams, "1")).scan.unwrap();
        assert!((degrees(&scan, 0) + 90.0).abs() < 1e-9);
        assert!((degrees(&scan, beams - 1) - last).abs() < 1e-9, "{beams} beams");
    }
}

#[test]
fn a_robotlaser_line_gives_the_mount_of_its_laser() {
    // The robot looks along y, the laser sits 0.2 m ahead of it and looks to its left.
    let poses = "1.0 2.2 3.141592653589793 1.0 2.0 1.5707963267948966";
    let line = robotlaser("0 -1.570796 3.141593 1.570796 80.0 0.01 0 3 1 81 0", poses);
    let reading = reading(&line);
    let mount = reading.mount.base_from_laser;
    assert!((mount.x - 0.2).abs() < 1e-12 && mount.y.abs() < 1e-12);
    assert!((mount.theta - FRAC_PI_2).abs() < 1e-12);
    assert_eq!(reading.odom_from_base, Pose2::new(1.0, 2.0, FRAC_PI_2));
    let scan = reading.scan.unwrap();
    let beams: Vec<Beam> = scan.ranges.iter().map(|&r| scan.geometry.classify(r)).collect();
    assert_eq!(beams, [Beam::Hit(1.0), Beam::NoReturn, Beam::Invalid]);
}

/// Written with few decimals, the place of a laser differs from line to line.
#[test]
fn a_laser_that_is_screwed_to_its_robot_has_one_place() {
    let line = |laser: &str| {
        let header = "0 -1.570796 3.141593 1.570796 80.0 0.01 0 3 1 81 0";
        robotlaser(header, &format!("{laser} 1.0 2.0 0.0"))
    };
    let log = [line("1.145 2 0"), line("1.147 2 0.002"), line("4.0 2 0"), line("1.146 2 -0.002")];
    let (lasers, _) = survey(&(log.join("\n") + "\n"));
    let mount = |line: &str| match parse(line, &lasers).unwrap() {
        Message::Reading(reading) => reading.mount.base_from_laser,
        other => panic!("{line} is {other:?}"),
    };
    let common = mount(&log[0]);
    assert!((common.x - 0.146).abs() < 1e-12 && common.theta.abs() < 1e-12, "{common:?}");
    assert_eq!([mount(&log[1]), mount(&log[3])], [common; 2]);
    assert_eq!(mount(&log[2]).x, 3.0);
}

#[test]
fn remissions_are_passed_over() {
    let line = "ROBOTLASER1 0 0 1 0.5 80 0.01 0 3 1 2 3 2 0.5 0.5 0 0 0 0 0 0 0 0 0 0 0 7.5 h 7.6";
    assert_eq!(reading(line).scan.unwrap().ranges, [1.0, 2.0, 3.0]);
}

#[test]
fn an_increment_rounded_to_six_decimals_gains_digits_from_the_field_of_view() {
    assert!((stated_increment(4.188_790, 0.006_151, 682) - 4.188_790 / 681.0).abs() < 1e-12);
    assert!((stated_increment(1.745_329, 0.017_453, 100) - 1.745_329 / 100.0).abs() < 1e-12);
    assert_eq!(stated_increment(3.0, 0.25, 180), 0.25);
    assert_eq!(stated_increment(3.0, 0.25, 1), 0.25);
}

#[test]
fn the_largest_range_that_repeats_means_no_return() {
    let log = format!("{}\n{}\n", flaser(2, "81.83"), flaser(2, "81.83"));
    assert_eq!(survey(&log).0.range_max, f64::from(81.83_f32));
}

#[test]
fn a_largest_range_that_occurs_once_is_a_hit() {
    let log = format!("{}\n{}\n", flaser(1, "12"), flaser(2, "3"));
    assert_eq!(survey(&log).0.range_max, 13.0);
}

#[test]
fn parameters_of_the_front_laser_are_used() {
    let log = format!(
        "PARAM robot_front_laser_max 50.0\nPARAM robot_frontlaser_offset 0.3 host 0\n{}\n",
        flaser(4, "81.83")
    );
    let (lasers, _) = survey(&log);
    assert_eq!(lasers.range_max, 50.0);
    assert_eq!(lasers.base_from_front_laser, Pose2::new(0.3, 0.0, 0.0));
}

/// A driver may be configured for 81.9 m and write 81.83 m where nothing reflected.
#[test]
fn a_configured_maximum_above_the_no_return_value_does_not_make_it_a_hit() {
    let log = format!("PARAM robot_front_laser_max 81.9\n{}\n", flaser(4, "81.83"));
    assert_eq!(survey(&log).0.range_max, f64::from(81.83_f32));
}

#[test]
fn other_lines_are_counted_by_keyword() {
    let log =
        "# comment\n# more\n\nSYNC 1 2\nODOM 0 0 0 0 0 0 5.0 h 5.0\nODOM 0 0 0 0 0 0 3.0 h 3\n";
    let (_, statistics) = survey(log);
    let counts: Vec<(&str, u64)> =
        statistics.lines_by_keyword.iter().map(|(word, &count)| (word.as_str(), count)).collect();
    assert_eq!(counts, [("#", 2), ("(empty)", 1), ("ODOM", 2), ("SYNC", 1)]);
    assert_eq!((statistics.lines, statistics.readings, statistics.malformed), (6, 2, 0));
    assert_eq!(statistics.duration(), 2.0);
}

#[test]
fn keywords_of_a_file_that_is_no_log_stay_few() {
    let log: String = (0..1000).map(|i| format!("word{i}\n")).collect();
    let (_, statistics) = survey(&log);
    assert_eq!(statistics.lines_by_keyword.len(), KEYWORDS_KEPT + 1);
    assert_eq!(statistics.lines_by_keyword["(other)"], 1000 - KEYWORDS_KEPT as u64);
}

#[test]
fn malformed_lines_are_reported_with_number_and_reason() {
    let log = "ODOM 0 0 0 0 0 0 5.0 h\n\
               ODOM 0 nan 0 0 0 0 5.0 h 5.0\n\
               ODOM 0 0 zero 0 0 0 5.0 h 5.0\n\
               FLASER 3 1 2 0 0 0 0 0 0 5.0 h 5.0\n\
               FLASER 0 0 0 0 0 0 0 5.0 h 5.0\n\
               FLASER\n\
               FLASER -1 1\n\
               FLASER 18446744073709551615 1\n\
               ROBOTLASER1 0 0 1 0.5 -1 0.01 0 1 1 0 0 0 0 0 0 0 0 0 0 0 0 7.5 h 7.6\n";
    let (_, statistics) = survey(log);
    let reasons: Vec<String> = statistics
        .first_malformed
        .iter()
        .map(|malformed| format!("{}: {}", malformed.line, malformed.reason))
        .collect();
    assert_eq!(
        reasons,
        [
            "1: has 9 fields where 10 are needed",
            "2: y is NaN, which is not finite",
            "3: theta is \"zero\", which is not a number",
            "4: has 13 fields where 14 are needed",
            "5: its sweep has no beams",
            "6: number of beams is \"\", which is not a number",
            "7: number of beams is \"-1\", which is not a number",
            "8: has 3 fields where 18446744073709551615 are needed",
            "9: range_min 0.02 m and range_max -1 m leave no range to measure",
        ]
    );
    assert_eq!((statistics.malformed, statistics.readings), (9, 0));
}

#[test]
fn ranges_that_are_no_numbers_to_a_laser_are_left_to_the_core() {
    let scan = reading("FLASER 4 nan inf 0 -1 0 0 0 0 0 0 5.0 h 5.0").scan.unwrap();
    assert_eq!(scan.geometry.classify(scan.ranges[0]), Beam::Invalid);
    assert_eq!(scan.geometry.classify(scan.ranges[1]), Beam::NoReturn);
}

proptest! {
    #[test]
    fn any_bytes_are_surveyed_without_panic(bytes in proptest::collection::vec(any::<u8>(), 0..400)) {
        let mut survey = Survey::default();
        survey.read(&mut Lines::new(Box::new(std::io::Cursor::new(bytes)))).unwrap();
        survey.finish();
    }

    #[test]
    fn any_fields_behind_a_keyword_are_parsed_without_panic(
        keyword in "FLASER|ROBOTLASER1|ODOM|PARAM",
        fields in proptest::collection::vec("[0-9]{1,3}|-?[0-9]\\.[0-9]|nan|inf|1e308|robot_front_laser_max|x", 0..40),
    ) {
        let line = format!("{keyword} {}", fields.join(" "));
        let statistics = survey(&line).1;
        prop_assert_eq!(statistics.lines, 1);
    }
}
