use nalgebra::{UnitQuaternion, Vector3};

use super::*;
use crate::convert;
use crate::playback::Frames;
use crate::ros;
use crate::sim::lidar::Lidar;
use crate::sim::{Reading, Simulation, building};
use crate::slam::pose::{Pose2, Stamp};
use crate::slam::scan::{LaserMount, MountOrientation};

const STATUS: &str = r#"{"state":"mapping","detail":"all is well","scans":{"processed":3}}"#;

/// The first seconds of a drive through a building, turns included.
fn drive(orientation: MountOrientation) -> Vec<Reading> {
    let mut lidar = Lidar::full_circle(180).unwrap();
    lidar.mount = LaserMount { base_from_laser: Pose2::new(0.1, 0.0, 0.2), orientation };
    let simulation = Simulation::through(&building::building(4, 20.0), 1, lidar, 4);
    simulation.readings().take(400).collect()
}

fn keys() -> Keys {
    let key = |name: &str| format!("robot01/{name}");
    Keys { inputs: Input::ALL.map(|input| key(input.name())), status: key("slam/status") }
}

/// What a test changes about the messages of a healthy robot.
struct Robot {
    mount: Option<LaserMount>,
    scan: fn(&mut ros::LaserScan),
    odometry: fn(&mut ros::Odometry),
    status: Option<&'static str>,
}

fn healthy(orientation: MountOrientation) -> Robot {
    let mount = LaserMount { base_from_laser: Pose2::new(0.1, 0.0, 0.2), orientation };
    Robot { mount: Some(mount), scan: |_| (), odometry: |_| (), status: Some(STATUS) }
}

impl Robot {
    fn watched(&self, readings: &[Reading]) -> Report {
        let names = FrameNames { odom: "odom".to_owned(), base: "base_link".to_owned() };
        let mut watch = Watch::new(keys(), names);
        if let Some(mount) = &self.mount {
            let message = ros::cdr(&Frames::default().mount(Stamp(0), mount));
            watch.add(Input::TfStatic, Stamp(0), (&message, ""));
        }
        for reading in readings {
            let arrival = Stamp(reading.stamp.0 + 50_000_000);
            let sample = convert::OdometrySample {
                stamp: reading.stamp,
                odom_frame: "odom".to_owned(),
                base_frame: "base_link".to_owned(),
                odom_from_base: reading.odom_from_base,
            };
            let mut odometry = convert::odometry_message(&sample);
            (self.odometry)(&mut odometry);
            watch.add(Input::Odom, arrival, (&ros::cdr(&odometry), ""));
            let mut scan = convert::laser_scan(&reading.scan, "laser");
            (self.scan)(&mut scan);
            watch.add(Input::Scan, arrival, (&ros::cdr(&scan), ""));
        }
        if let Some(status) = self.status {
            watch.add_status(status.as_bytes());
        }
        watch.report()
    }

    fn only_finding(&self, readings: &[Reading]) -> Finding {
        let mut findings = self.watched(readings).findings;
        assert_eq!(findings.len(), 1, "{findings:#?}");
        findings.remove(0)
    }
}

#[test]
fn a_healthy_robot_gives_no_complaint() {
    for orientation in [MountOrientation::Upright, MountOrientation::UpsideDown] {
        let report = healthy(orientation).watched(&drive(orientation));
        assert_eq!(report.findings, []);
        let facts = report.facts.join("\n");
        assert!(facts.contains("scans: 10.0 Hz, 180 beams 2.00 degrees apart"), "{facts}");
        assert!(facts.contains("odometry: 10.0 Hz, messages"), "{facts}");
        assert!(facts.contains("turns: scans and odometry agree"), "{facts}");
    }
}

/// The laser hangs upside down, and its transform does not say so; and the other way round.
#[test]
fn a_mirrored_mount_is_found() {
    let (up, down) = (MountOrientation::Upright, MountOrientation::UpsideDown);
    for (true_orientation, told) in [(down, up), (up, down)] {
        let finding = healthy(told).only_finding(&drive(true_orientation));
        assert!(matches!(finding, Finding::Mirrored { .. }), "{finding}");
        assert!(finding.remedy().contains("upside_down: true"));
    }
}

#[test]
fn odometry_that_turns_too_little_is_found() {
    let halve = |message: &mut ros::Odometry| {
        let orientation = &mut message.pose.pose.orientation;
        let half = libm::atan2(orientation.z, orientation.w) / 2.0;
        (orientation.z, orientation.w) = libm::sincos(half);
    };
    let robot = Robot { odometry: halve, ..healthy(MountOrientation::Upright) };
    let finding = robot.only_finding(&drive(MountOrientation::Upright));
    assert!(matches!(finding, Finding::TurnScale { ratio, .. } if ratio > 1.5), "{finding}");
}

#[test]
fn odometry_that_stands_still_is_found() {
    let stuck = |message: &mut ros::Odometry| message.pose.pose = convert::pose(Pose2::IDENTITY);
    let robot = Robot { odometry: stuck, ..healthy(MountOrientation::Upright) };
    assert_eq!(robot.only_finding(&drive(MountOrientation::Upright)), Finding::OdometryStuck);
}

#[test]
fn a_robot_that_stands_still_gives_no_complaint() {
    let mut readings = drive(MountOrientation::Upright);
    let (pose, scan) = (readings[0].odom_from_base, readings[0].scan.clone());
    for reading in &mut readings {
        reading.odom_from_base = pose;
        reading.scan.ranges.clone_from(&scan.ranges);
    }
    assert_eq!(healthy(MountOrientation::Upright).watched(&readings).findings, []);
}

#[test]
fn scans_that_repeat_while_odometry_moves_are_found() {
    let mut readings = drive(MountOrientation::Upright);
    let ranges = readings[0].scan.ranges.clone();
    for reading in &mut readings {
        reading.scan.ranges.clone_from(&ranges);
    }
    let finding = healthy(MountOrientation::Upright).only_finding(&readings);
    assert!(matches!(finding, Finding::ScansFrozen { .. }), "{finding}");
}

#[test]
fn clocks_that_differ_are_found() {
    let ahead = |message: &mut ros::Odometry| message.header.stamp.sec += 2;
    let robot = Robot { odometry: ahead, ..healthy(MountOrientation::Upright) };
    let finding = robot.only_finding(&drive(MountOrientation::Upright)).to_string();
    assert!(finding.contains("stamped +2.000 s against the scans"), "{finding}");
}

#[test]
fn a_missing_mount_is_found_unless_the_daemon_knows_it() {
    let readings = drive(MountOrientation::Upright);
    let waiting = Some(r#"{"state":"mapping","detail":"","scans":{"processed":0}}"#);
    let robot = Robot { mount: None, status: waiting, ..healthy(MountOrientation::Upright) };
    let finding = robot.only_finding(&readings);
    assert!(finding.to_string().contains("where the laser (laser) sits"), "{finding}");
    assert!(finding.remedy().contains("tf_static"));
    let robot = Robot { status: Some(STATUS), ..robot };
    assert_eq!(robot.watched(&readings).findings, []);
}

#[test]
fn scans_without_ranges_and_wrong_angles_are_found() {
    let readings = drive(MountOrientation::Upright);
    let blind = |message: &mut ros::LaserScan| message.ranges.fill(f32::NAN);
    let robot = Robot { scan: blind, ..healthy(MountOrientation::Upright) };
    let finding = robot.only_finding(&readings).to_string();
    assert!(finding.contains("of 180 ranges 180 are NaN"), "{finding}");

    let cut = |message: &mut ros::LaserScan| message.ranges.truncate(170);
    let robot = Robot { scan: cut, ..healthy(MountOrientation::Upright) };
    assert_eq!(robot.only_finding(&readings), Finding::Angles { beams: 170, expected: 180 });

    let limit = |message: &mut ros::LaserScan| message.range_max = 1.0;
    let robot = Robot { scan: limit, ..healthy(MountOrientation::Upright) };
    let findings = robot.watched(&readings).findings;
    assert!(findings.iter().any(|f| matches!(f, Finding::RangeLimit { .. })), "{findings:?}");

    let none = |message: &mut ros::LaserScan| message.angle_increment = 0.0;
    let robot = Robot { scan: none, ..healthy(MountOrientation::Upright) };
    let finding = robot.only_finding(&readings).to_string();
    assert!(finding.contains("400 of 400 messages on robot01/scan could not be used"), "{finding}");
}

#[test]
fn silence_is_three_findings() {
    let robot = Robot { mount: None, status: None, ..healthy(MountOrientation::Upright) };
    let findings: Vec<String> =
        robot.watched(&[]).findings.iter().map(ToString::to_string).collect();
    assert_eq!(
        findings,
        [
            "nothing arrived on robot01/scan",
            "no odometry arrived: nothing on robot01/odom, and no transform from odom to base_link",
            "no gmapd answers on robot01/slam/status",
        ]
    );
}

#[test]
fn only_gmapping_needs_odometry() {
    let scans_alone = |status: &str| {
        let names = FrameNames { odom: "odom".to_owned(), base: "base_link".to_owned() };
        let mut watch = Watch::new(keys(), names);
        for reading in drive(MountOrientation::Upright) {
            let scan = convert::laser_scan(&reading.scan, "base_link");
            watch.add(Input::Scan, reading.stamp, (&ros::cdr(&scan), ""));
        }
        watch.add_status(status.as_bytes());
        watch.report()
    };
    let report = scans_alone(r#"{"state":"mapping","detail":"","engine":"hector"}"#);
    assert_eq!(report.findings, []);
    assert!(report.facts.join("\n").contains("Hector maps from scans alone"));
    let report = scans_alone(r#"{"state":"mapping","detail":"","engine":"known_poses"}"#);
    assert_eq!(report.findings, []);
    let report = scans_alone(r#"{"state":"mapping","detail":"","engine":"gmapping"}"#);
    assert!(matches!(report.findings[..], [Finding::NoOdometry { .. }]), "{:?}", report.findings);
}

/// A robot without odometry messages, whose transforms tell the same.
#[test]
fn odometry_from_transforms_is_odometry() {
    let names = FrameNames { odom: "odom".to_owned(), base: "base_link".to_owned() };
    let mut watch = Watch::new(keys(), names);
    for reading in drive(MountOrientation::Upright) {
        let header = convert::header(reading.stamp, "odom");
        let transform = convert::transform_stamped(header, "base_link", reading.odom_from_base);
        let message = ros::TfMessage { transforms: vec![transform] };
        watch.add(Input::Tf, reading.stamp, (&ros::cdr(&message), ""));
        let mut scan = convert::laser_scan(&reading.scan, "base_link");
        scan.header.stamp = convert::time(reading.stamp);
        watch.add(Input::Scan, reading.stamp, (&ros::cdr(&scan), ""));
    }
    watch.add_status(STATUS.as_bytes());
    let report = watch.report();
    assert_eq!(report.findings, []);
    let facts = report.facts.join("\n");
    assert!(facts.contains("odometry: 10.0 Hz, from tf"), "{facts}");
    assert!(facts.contains("turns: scans and odometry agree"), "{facts}");
}

#[test]
fn a_tilted_laser_is_found() {
    let names = FrameNames { odom: "odom".to_owned(), base: "base_link".to_owned() };
    let mut watch = Watch::new(keys(), names);
    let tilt = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), 0.2);
    let mut message = Frames::default().mount(Stamp(0), &LaserMount::default());
    message.transforms[0].transform.rotation =
        ros::Quaternion { x: tilt.i, y: tilt.j, z: tilt.k, w: tilt.w };
    watch.add(Input::TfStatic, Stamp(0), (&ros::cdr(&message), ""));
    for reading in drive(MountOrientation::Upright) {
        let odometry = ros::cdr(&ros::Odometry {
            header: convert::header(reading.stamp, "odom"),
            pose: ros::PoseWithCovariance {
                pose: convert::pose(reading.odom_from_base),
                ..ros::PoseWithCovariance::default()
            },
            ..ros::Odometry::default()
        });
        watch.add(Input::Odom, reading.stamp, (&odometry, ""));
        let scan = ros::cdr(&convert::laser_scan(&reading.scan, "laser"));
        watch.add(Input::Scan, reading.stamp, (&scan, ""));
    }
    let findings = watch.report().findings;
    assert!(
        matches!(&findings[0], Finding::Tilted(text) if text.contains("11.46")),
        "{findings:?}"
    );
}
