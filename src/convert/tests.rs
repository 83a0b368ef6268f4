use std::f64::consts::{FRAC_PI_2, PI};

use proptest::prelude::{any, prop_assert, prop_assert_eq, proptest};

use super::*;
use crate::slam::pose::Point2;
use crate::slam::scan::Beam;

fn rotation(axis: &nalgebra::Unit<Vector3<f64>>, degrees: f64) -> UnitQuaternion<f64> {
    UnitQuaternion::from_axis_angle(axis, degrees.to_radians())
}

fn mounted(rotation: UnitQuaternion<f64>) -> Isometry3<f64> {
    Isometry3::from_parts(Translation3::new(0.2, -0.1, 1.5), rotation)
}

fn laser_scan_message() -> ros::LaserScan {
    ros::LaserScan {
        header: header(Stamp(1_700_000_000_250_000_000), "laser"),
        angle_min: -0.5,
        angle_max: 0.5,
        angle_increment: 0.25,
        range_min: 0.1,
        range_max: 30.0,
        ranges: vec![1.0, 0.05, f32::INFINITY, f32::NAN, 2.5],
        ..ros::LaserScan::default()
    }
}

fn turned_odometry(orientation: ros::Quaternion) -> ros::Odometry {
    let position = ros::Point { x: 1.0, y: 2.0, z: 0.1 };
    let pose = ros::Pose { position, orientation };
    ros::Odometry {
        header: header(Stamp(5), "odom"),
        child_frame_id: "base_link".to_owned(),
        pose: ros::PoseWithCovariance { pose, ..ros::PoseWithCovariance::default() },
        twist: ros::TwistWithCovariance::default(),
    }
}

#[test]
fn a_scan_keeps_its_stamp_geometry_and_ranges() {
    let scan = scan(laser_scan_message()).unwrap();
    assert_eq!(scan.stamp, Stamp(1_700_000_000_250_000_000));
    assert_eq!([scan.geometry.angle(0), scan.geometry.angle(4)], [-0.5, 0.5]);
    assert_eq!(scan.geometry.range_max(), 30.0);
    let beams: Vec<Beam> = scan.ranges.iter().map(|&r| scan.geometry.classify(r)).collect();
    let (none, invalid) = (Beam::NoReturn, Beam::Invalid);
    assert_eq!(beams, [Beam::Hit(1.0), invalid, none, invalid, Beam::Hit(2.5)]);
}

#[test]
fn a_scan_survives_messages_but_for_the_digits_of_its_angles() {
    let first = scan(laser_scan_message()).unwrap();
    let again = scan(laser_scan(&first, "laser")).unwrap();
    assert_eq!((again.stamp, again.geometry), (first.stamp, first.geometry));
    assert_eq!(again.ranges[..3], first.ranges[..3]);
    let clockwise = ScanGeometry::new([PI, -PI], -0.001, [0.02, f64::INFINITY]).unwrap();
    let swept = Scan { geometry: clockwise, ..first };
    let again = scan(laser_scan(&swept, "laser")).unwrap().geometry;
    assert_eq!(again.range_max(), f64::INFINITY);
    assert!((again.angle(1000) - clockwise.angle(1000)).abs() < 1e-6, "{again:?}");
}

#[test]
fn an_unusable_scan_is_an_error() {
    let error = scan(ros::LaserScan { angle_increment: 0.0, ..laser_scan_message() }).unwrap_err();
    assert_eq!(error, ConvertError::Geometry(GeometryError::Increment(0.0)));
    for time_increment in [f32::NAN, f32::INFINITY] {
        let error = scan(ros::LaserScan { time_increment, ..laser_scan_message() }).unwrap_err();
        assert!(error.to_string().contains("field time_increment is"), "{error}");
    }
    let mut late = laser_scan_message();
    late.header.stamp.nanosec = 1_000_000_000;
    assert_eq!(
        scan(late).unwrap_err().to_string(),
        "the stamp has 1000000000 nanoseconds, which must be below 1000000000"
    );
}

#[test]
fn odometry_keeps_its_frames_and_pose() {
    let turned = ros::Quaternion { z: 0.6 * 3.0, w: 0.8 * 3.0, ..ros::Quaternion::default() };
    let sample = odometry(turned_odometry(turned)).unwrap();
    assert_eq!((sample.stamp, sample.odom_frame.as_str()), (Stamp(5), "odom"));
    assert_eq!(sample.base_frame, "base_link");
    let expected = Pose2::new(1.0, 2.0, 2.0 * 0.6_f64.atan2(0.8));
    assert!(expected.between(sample.odom_from_base).theta.abs() < 1e-12);
    assert_eq!(sample.odom_from_base.position(), Point2::new(1.0, 2.0));
}

#[test]
fn odometry_on_a_ramp_keeps_its_heading_and_a_tipped_base_is_refused() {
    let yaw = rotation(&Vector3::z_axis(), 40.0);
    let ramp = mounted(yaw * rotation(&Vector3::y_axis(), 15.0));
    assert!((base_pose(&ramp).unwrap().theta - 40_f64.to_radians()).abs() < 1e-12);
    let tipped = base_pose(&mounted(yaw * rotation(&Vector3::x_axis(), 30.0))).unwrap_err();
    assert_eq!(
        tipped.to_string(),
        "the base is tilted by 30.0 degrees; mapping in the plane allows 20"
    );
}

#[test]
fn what_is_no_rotation_or_no_position_is_refused() {
    let error = odometry(turned_odometry(ros::Quaternion::default())).unwrap_err();
    assert_eq!(
        error.to_string(),
        "the quaternion (x 0, y 0, z 0, w 0) is no rotation: its length is 0"
    );
    for w in [f64::NAN, f64::INFINITY, 1e300] {
        let quaternion = ros::Quaternion { w, ..ros::Quaternion::default() };
        let error = odometry(turned_odometry(quaternion)).unwrap_err();
        assert!(matches!(error, ConvertError::Quaternion { .. }), "{error}");
    }
    let mut lost = turned_odometry(quaternion(0.0));
    lost.pose.pose.position.y = f64::NAN;
    let error = odometry(lost).unwrap_err();
    assert_eq!(error.to_string(), "the position (1, NaN, 0.1) is not finite");
}

#[test]
fn a_laser_may_be_turned_and_upside_down() {
    let yawed = laser_mount(&mounted(rotation(&Vector3::z_axis(), 90.0))).unwrap();
    assert_eq!(yawed.orientation, MountOrientation::Upright);
    assert_eq!(yawed.base_from_laser.position(), Point2::new(0.2, -0.1));
    assert!((yawed.base_from_laser.theta - FRAC_PI_2).abs() < 1e-12);
    let left = yawed.point_in_base(FRAC_PI_2, 2.0);
    assert!((left.x - -1.8).abs() < 1e-12 && (left.y - -0.1).abs() < 1e-12);
}

/// The beam of the message and the beam of the mount end in the same point.
#[test]
fn an_upside_down_laser_sees_where_its_transform_says() {
    let yaw = rotation(&Vector3::z_axis(), 30.0);
    for flip in [rotation(&Vector3::x_axis(), 180.0), rotation(&Vector3::y_axis(), 180.0)] {
        let base_from_laser = mounted(yaw * flip);
        let mount = laser_mount(&base_from_laser).unwrap();
        assert_eq!(mount.orientation, MountOrientation::UpsideDown);
        let (angle, range) = (0.7_f64, 3.0);
        let end = nalgebra::Point3::new(range * angle.cos(), range * angle.sin(), 0.0);
        let expected = base_from_laser * end;
        let point = mount.point_in_base(angle, range);
        assert!((point.x - expected.x).hypot(point.y - expected.y) < 1e-12);
    }
}

#[test]
fn a_tilted_laser_is_refused_with_its_tilt() {
    let tilted = |degrees| laser_mount(&mounted(rotation(&Vector3::y_axis(), degrees)));
    assert!(tilted(2.5).is_ok() && tilted(177.5).is_ok());
    let error = tilted(2.6).unwrap_err().to_string();
    assert_eq!(error, "the laser is tilted by 2.60 degrees against the plane; mapping allows 2.56");
    assert!(tilted(177.0).unwrap_err().to_string().contains("by 3.00 degrees"));
    assert!(tilted(90.0).unwrap_err().to_string().contains("by 90.00 degrees"));
}

#[test]
fn a_covariance_takes_its_place_among_six() {
    let covariance = Matrix3::new(1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0);
    let all = pose_with_covariance(Pose2::IDENTITY, &covariance).covariance.0;
    let mut expected = [0.0; 36];
    expected[..2].copy_from_slice(&[1.0, 2.0]);
    expected[5..8].copy_from_slice(&[3.0, 4.0, 5.0]);
    expected[11] = 6.0;
    expected[30..32].copy_from_slice(&[7.0, 8.0]);
    expected[35] = 9.0;
    assert_eq!(all, expected);
}

#[test]
fn paths_and_clouds_keep_order_stamps_and_frame() {
    let poses = [(Stamp(1), Pose2::new(1.0, 0.0, 0.0)), (Stamp(2), Pose2::new(2.0, 0.0, PI))];
    let path = path(header(Stamp(9), "map"), &poses);
    assert_eq!(path.header, header(Stamp(9), "map"));
    let headers: Vec<&ros::Header> = path.poses.iter().map(|pose| &pose.header).collect();
    assert_eq!(headers, [&header(Stamp(1), "map"), &header(Stamp(2), "map")]);
    assert_eq!(path.poses[1].pose, pose(poses[1].1));
    let cloud = pose_array(header(Stamp(9), "map"), poses.map(|(_, pose)| pose));
    assert_eq!(cloud.poses, [pose(poses[0].1), pose(poses[1].1)]);
}

#[test]
fn a_map_keeps_its_cells_size_and_place() {
    let grid = OccupancyGrid {
        resolution: 0.05,
        width: 3,
        height: 2,
        origin: Point2::new(-1.5, 2.5),
        cells: vec![-1, 0, 100, 0, -1, 100],
    };
    let message = occupancy_grid(header(Stamp(7), "map"), &grid);
    assert_eq!(message.header, header(Stamp(7), "map"));
    assert_eq!(message.data.iter().collect::<Vec<i8>>(), grid.cells);
    let info = message.info;
    assert_eq!((info.resolution, info.width, info.height), (0.05, 3, 2));
    assert_eq!(info.map_load_time, time(Stamp(7)));
    assert_eq!(info.origin, pose(Pose2::new(-1.5, 2.5, 0.0)));
}

proptest! {
    #[test]
    fn stamps_survive_messages(sec in any::<i32>(), nanosec in 0..1_000_000_000_u32) {
        let message = ros::Time { sec, nanosec };
        prop_assert_eq!(time(stamp(message).unwrap()), message);
    }

    #[test]
    fn no_stamp_panics(nanoseconds in any::<i64>()) {
        let back = stamp(time(Stamp(nanoseconds))).unwrap();
        prop_assert!(back == Stamp(nanoseconds) || back.0.abs() > i64::from(i32::MAX) * NANOSECONDS);
    }

    #[test]
    fn odometry_survives_messages(x in -1e3..1e3, y in -1e3..1e3, theta in -PI..PI) {
        let sample = OdometrySample {
            stamp: Stamp(7),
            odom_frame: "odom".to_owned(),
            base_frame: "base_link".to_owned(),
            odom_from_base: Pose2::new(x, y, theta),
        };
        let back = odometry(odometry_message(&sample)).unwrap();
        let turn = wrap_angle(back.odom_from_base.theta - theta);
        prop_assert!(turn.abs() < 1e-14, "{turn}");
        prop_assert_eq!(back.odom_from_base.position(), sample.odom_from_base.position());
        let sample = OdometrySample { odom_from_base: back.odom_from_base, ..sample };
        prop_assert_eq!(back, sample);
    }

    /// Through the buffer of frames, as in the daemon, the mount is the same bit by bit.
    #[test]
    fn mounts_survive_messages(x in -1.0..1.0, y in -1.0..1.0, yaw in -PI..PI, down in any::<bool>()) {
        let orientation = if down { MountOrientation::UpsideDown } else { MountOrientation::Upright };
        let mount = LaserMount { base_from_laser: Pose2::new(x, y, yaw), orientation };
        let message = mount_transform(header(Stamp(0), "base_link"), "laser", &mount);
        let transform = transform(message).unwrap();
        let direct = laser_mount(&transform.parent_from_child).unwrap();
        prop_assert_eq!(direct.orientation, orientation);
        prop_assert_eq!(direct.base_from_laser.position(), mount.base_from_laser.position());
        prop_assert!(wrap_angle(direct.base_from_laser.theta - yaw).abs() < 1e-14);

        let mut frames = tf::TfBuffer::new(std::time::Duration::from_secs(1));
        frames.insert(&transform, tf::Kind::Static).unwrap();
        let base_from_laser = frames.target_from_source("base_link", "laser", Stamp(5)).unwrap();
        prop_assert_eq!(laser_mount(&base_from_laser).unwrap(), direct);
    }

    #[test]
    fn poses_survive_messages(x in -1e3..1e3, y in -1e3..1e3, theta in -PI..PI) {
        let there = Pose2::new(x, y, theta);
        let message = transform_stamped(header(Stamp(3), "map"), "odom", there);
        let back = transform(message).unwrap();
        prop_assert_eq!((back.parent.as_str(), back.child.as_str()), ("map", "odom"));
        prop_assert_eq!(back.stamp, Stamp(3));
        let back = base_pose(&back.parent_from_child).unwrap();
        prop_assert_eq!(back.position(), there.position());
        prop_assert!(wrap_angle(back.theta - theta).abs() < 1e-15 * 8.0);
    }
}
