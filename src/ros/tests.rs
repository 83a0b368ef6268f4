//! Messages against the bytes that `rosbags` writes, and decoders against all other bytes.

use byteorder::BigEndian;
use proptest::collection::vec;
use proptest::prelude::{Just, Strategy, any, prop_assert, prop_assert_eq, prop_oneof, proptest};

use super::{
    Covariance, DecodeError, DiagnosticArray, DiagnosticStatus, Float64, GetMapRequest,
    GetMapResponse, Header, Int8Array, KeyValue, LaserScan, MapMetaData, Message, OccupancyGrid,
    OccupancyGridUpdate, Odometry, Path, Point, Pose, PoseArray, PoseStamped, PoseWithCovariance,
    PoseWithCovarianceStamped, Quaternion, TfMessage, Time, Transform, TransformStamped, Twist,
    TwistWithCovariance, Vector3, cdr, decode, json,
};

/// Written by `golden/make.py`.
const GOLDEN: &str = include_str!("golden/messages.txt");

/// A LaserScan as it was captured on a mesh, sent by another implementation than `rosbags`.
const CAPTURED_SCAN: &str = "0001000000f1536580b2e60e060000006c61736572000000000000bf0000003f\
    0000803e00000000cdcccc3dcdcc4c3d0000f041050000000000803f0000c03f000000400000807f0000204000000000";

fn bytes_of(digits: &str) -> Vec<u8> {
    let pairs = digits.as_bytes().chunks_exact(2);
    pairs.map(|pair| u8::from_str_radix(str::from_utf8(pair).unwrap(), 16).unwrap()).collect()
}

fn golden(message: &str, order: &str) -> Vec<u8> {
    let start = format!("{message} {order} ");
    let digits = GOLDEN.lines().find_map(|line| line.strip_prefix(&start));
    bytes_of(digits.expect("the message has a golden line"))
}

fn header(sec: i32, nanosec: u32, frame_id: &str) -> Header {
    Header { stamp: Time { sec, nanosec }, frame_id: frame_id.to_owned() }
}

fn pose([x, y]: [f64; 2], [z, w]: [f64; 2]) -> Pose {
    Pose {
        position: Point { x, y, z: 0.25 },
        orientation: Quaternion { z, w, ..Quaternion::default() },
    }
}

fn first_pose() -> Pose {
    pose([1.0, 2.0], [0.0, 1.0])
}

fn second_pose() -> Pose {
    pose([3.0, 4.0], [0.6, 0.8])
}

fn covariance() -> Covariance {
    Covariance(std::array::from_fn(|index| index as f64))
}

fn laser_scan() -> LaserScan {
    LaserScan {
        header: header(1_700_000_000, 250_000_000, "laser"),
        angle_min: -0.5,
        angle_max: 0.5,
        angle_increment: 0.25,
        time_increment: 0.0,
        scan_time: 0.1,
        range_min: 0.05,
        range_max: 30.0,
        ranges: vec![1.0, 1.5, 2.0, f32::INFINITY, 2.5],
        intensities: vec![],
    }
}

fn odometry() -> Odometry {
    let linear = Vector3 { x: 0.1, y: 0.2, z: 0.3 };
    let angular = Vector3 { x: 0.4, y: 0.5, z: 0.6 };
    Odometry {
        header: header(10, 20, "odom"),
        child_frame_id: "base_link".to_owned(),
        pose: PoseWithCovariance { pose: pose([1.0, 2.0], [0.6, 0.8]), covariance: covariance() },
        twist: TwistWithCovariance { twist: Twist { linear, angular }, covariance: covariance() },
    }
}

fn tf_message() -> TfMessage {
    let transform = |sec, parent, child: &str| TransformStamped {
        header: header(sec, 7, parent),
        child_frame_id: child.to_owned(),
        transform: Transform {
            translation: Vector3 { x: 1.0, y: -2.0, z: 0.5 },
            rotation: Quaternion { z: 0.6, w: 0.8, ..Quaternion::default() },
        },
    };
    TfMessage { transforms: vec![transform(1, "odom", "base_link"), transform(-2, "base", "l")] }
}

fn occupancy_grid() -> OccupancyGrid {
    OccupancyGrid {
        header: header(-1, 2, "map"),
        info: MapMetaData {
            map_load_time: Time { sec: 5, nanosec: 6 },
            resolution: 0.05,
            width: 3,
            height: 2,
            origin: pose([-1.5, 2.5], [0.0, 1.0]),
        },
        data: Int8Array::from([-1, 0, 100, 0, -1, 100].as_slice()),
    }
}

fn pose_with_covariance_stamped() -> PoseWithCovarianceStamped {
    PoseWithCovarianceStamped {
        header: header(3, 4, "map"),
        pose: PoseWithCovariance { pose: first_pose(), covariance: covariance() },
    }
}

fn path() -> Path {
    let stamped = |header, pose| PoseStamped { header, pose };
    Path {
        header: header(3, 4, "map"),
        poses: vec![
            stamped(header(3, 4, "map"), first_pose()),
            stamped(header(5, 6, ""), second_pose()),
        ],
    }
}

fn diagnostics() -> DiagnosticArray {
    DiagnosticArray {
        header: header(3, 4, ""),
        status: vec![DiagnosticStatus {
            level: DiagnosticStatus::ERROR,
            name: "gmapd".to_owned(),
            message: "no scans".to_owned(),
            hardware_id: "robot01".to_owned(),
            values: vec![KeyValue { key: "age".to_owned(), value: "3.5 s".to_owned() }],
        }],
    }
}

/// Holds for each message: its bytes are those of `rosbags`, both byte orders read back, JSON
/// reads back, and no part of any of them is taken for the whole.
fn agrees<M: Message + PartialEq + std::fmt::Debug>(message: &M) {
    assert_eq!(cdr(message), golden(M::TYPE, "little"));
    for order in ["little", "big"] {
        let bytes = golden(M::TYPE, order);
        assert_eq!(&decode::<M>(&bytes, "").unwrap(), message, "{order}");
        for length in 0..bytes.len() {
            let error = decode::<M>(&bytes[..length], "").unwrap_err().to_string();
            assert!(error.starts_with(M::TYPE), "{error}");
        }
    }
    let text = json(message);
    assert_eq!(&decode::<M>(&text, "application/json").unwrap(), message);
    assert_eq!(&decode::<M>(&text, "").unwrap(), message);
    for length in 0..text.len() {
        decode::<M>(&text[..length], "application/json").unwrap_err();
    }
}

#[test]
fn every_message_has_the_bytes_of_rosbags() {
    agrees(&laser_scan());
    agrees(&odometry());
    agrees(&tf_message());
    agrees(&occupancy_grid());
    agrees(&occupancy_grid().info);
    agrees(&OccupancyGridUpdate {
        header: header(3, 4, "map"),
        x: 1,
        y: -2,
        width: 2,
        height: 3,
        data: occupancy_grid().data,
    });
    agrees(&PoseStamped { header: header(3, 4, "map"), pose: first_pose() });
    agrees(&pose_with_covariance_stamped());
    agrees(&PoseArray { header: header(3, 4, "map"), poses: vec![first_pose(), second_pose()] });
    agrees(&path());
    agrees(&Float64 { data: 1.25 });
    agrees(&diagnostics());
    agrees(&GetMapRequest::default());
    agrees(&GetMapResponse { map: occupancy_grid() });
}

#[test]
fn a_captured_scan_reads_and_writes() {
    let bytes = bytes_of(CAPTURED_SCAN);
    assert_eq!(bytes.len(), 80);
    assert_eq!(decode::<LaserScan>(&bytes, "application/cdr").unwrap(), laser_scan());
    assert_eq!(cdr(&laser_scan()), bytes);
}

/// A bridge fills the one byte of an empty request up to four.
#[test]
fn padding_at_the_end_is_no_error_and_more_is() {
    let padded = [0, 1, 0, 0, 0, 0, 0, 0];
    decode::<GetMapRequest>(&padded, "").unwrap();
    let error = decode::<Float64>(&[cdr(&Float64 { data: 1.0 }), vec![0; 4]].concat(), "");
    assert_eq!(
        error.unwrap_err().to_string(),
        "std_msgs/msg/Float64 would end at byte 12 of 16: is the payload of another type?"
    );
}

#[test]
fn errors_name_the_type_the_field_and_the_offset() {
    let scan = cdr(&laser_scan());
    let error = |bytes: &[u8]| decode::<LaserScan>(bytes, "").unwrap_err().to_string();
    assert_eq!(
        error(&scan[..66]),
        "sensor_msgs/msg/LaserScan: ranges[2] at byte 64 of 66: unexpected end of input"
    );
    assert_eq!(
        error(&scan[..6]),
        "sensor_msgs/msg/LaserScan: header.stamp.sec at byte 4 of 6: unexpected end of input"
    );
    assert_eq!(
        error(b"\x01\x02"),
        "sensor_msgs/msg/LaserScan: 2 bytes that begin with 01 02 are neither plain CDR, which \
         begins with 00 00 or 00 01 and two more bytes, nor a JSON object"
    );
    let parameter_list = [0, 3, 0, 0];
    assert!(error(&parameter_list).contains("begin with 00 03 00 00"));
    assert!(error(b"").contains("begin with nothing"));
}

#[test]
fn errors_in_json_name_the_field_and_the_place() {
    let error = |text: &str| decode::<Odometry>(text.as_bytes(), "").unwrap_err().to_string();
    assert_eq!(
        error(r#"{"header": {"stamp": {"sec": "1", "nanosec": 2}}}"#),
        "nav_msgs/msg/Odometry: header.stamp.sec: invalid type: string \"1\", expected i32 at \
         line 1 column 32"
    );
    assert!(error(r#"{"heder": {}}"#).contains("unknown field `heder`, expected one of `header`"));
    assert!(error("{").starts_with("nav_msgs/msg/Odometry: "));
    let twice = decode::<Float64>(br#"{"data": 1.0} {"data": 2.0}"#, "").unwrap_err().to_string();
    assert!(twice.contains("trailing characters"), "{twice}");
}

#[test]
fn json_may_leave_out_what_a_simple_robot_does_not_have() {
    let scan = r#"{"header": {"stamp": {"sec": 1, "nanosec": 2}},
        "angle_min": 0, "angle_max": 1, "angle_increment": 0.2, "range_min": 0.1,
        "range_max": "inf", "ranges": [1, 2.5, null, "nan", "inf", "-inf"]}"#;
    let scan = decode::<LaserScan>(scan.as_bytes(), "text/json;LaserScan").unwrap();
    assert_eq!(scan.header, header(1, 2, ""));
    assert_eq!((scan.time_increment, scan.scan_time, scan.range_max), (0.0, 0.0, f32::INFINITY));
    assert_eq!(scan.ranges[..2], [1.0, 2.5]);
    assert!(scan.ranges[2].is_nan() && scan.ranges[3].is_nan());
    assert_eq!(scan.ranges[4..], [f32::INFINITY, f32::NEG_INFINITY]);
    assert!(scan.intensities.is_empty());

    let odometry = br#"{"header": {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "odom"},
        "pose": {"pose": {"position": {"x": 1, "y": 2}, "orientation": {"z": 0.6, "w": 0.8}}}}"#;
    let odometry = decode::<Odometry>(odometry, "").unwrap();
    assert_eq!(odometry.pose.pose.position, Point { x: 1.0, y: 2.0, z: 0.0 });
    assert_eq!(odometry.pose.covariance, Covariance([0.0; 36]));
    assert_eq!(odometry.twist, TwistWithCovariance::default());
    assert_eq!(odometry.child_frame_id, "");

    let misspelt = br#"{"header": {"stamp": {"sec": 1, "nanosec": 2}},
        "angle_min": 0, "angle_max": 1, "angle_increment": 0.2, "range_min": 0.1,
        "range_max": 3, "ranges": ["infinite"]}"#;
    let error = decode::<LaserScan>(misspelt, "").unwrap_err().to_string();
    assert!(error.contains("ranges[0]") && error.contains("infinite"), "{error}");
}

#[test]
fn ranges_without_a_number_survive_json() {
    let mut scan = laser_scan();
    scan.ranges = vec![f32::NAN, f32::INFINITY, f32::NEG_INFINITY];
    scan.range_max = f32::INFINITY;
    let text = json(&scan);
    assert!(str::from_utf8(&text).unwrap().contains(r#""ranges":[null,"inf","-inf"]"#));
    let back = decode::<LaserScan>(&text, "").unwrap();
    assert_eq!(cdr(&back), cdr(&scan));
}

#[test]
fn the_encoding_decides_for_json_and_the_bytes_otherwise() {
    let (text, bytes) = (json(&Float64 { data: 2.0 }), cdr(&Float64 { data: 2.0 }));
    for encoding in ["", "zenoh/bytes", "application/cdr", "application/octet-stream"] {
        assert_eq!(decode::<Float64>(&text, encoding).unwrap().data, 2.0);
        assert_eq!(decode::<Float64>(&bytes, encoding).unwrap().data, 2.0);
    }
    for encoding in ["application/json", "text/json", "application/json;std_msgs/msg/Float64"] {
        assert_eq!(decode::<Float64>(&text, encoding).unwrap().data, 2.0);
        let error = decode::<Float64>(&bytes, encoding).unwrap_err();
        assert!(matches!(error, DecodeError::Json { .. }), "{error}");
    }
    assert_eq!(decode::<Float64>(b"  {\"data\": 2}\n", "").unwrap().data, 2.0);
}

fn frames() -> impl Strategy<Value = String> {
    prop_oneof![Just(String::new()), "[a-z_/]{1,20}", "\\PC{0,8}"]
}

fn headers() -> impl Strategy<Value = Header> {
    (any::<i32>(), any::<u32>(), frames())
        .prop_map(|(sec, nanosec, frame_id)| Header { stamp: Time { sec, nanosec }, frame_id })
}

fn poses() -> impl Strategy<Value = Pose> {
    any::<[f64; 7]>().prop_map(|[px, py, pz, x, y, z, w]| Pose {
        position: Point { x: px, y: py, z: pz },
        orientation: Quaternion { x, y, z, w },
    })
}

fn laser_scans() -> impl Strategy<Value = LaserScan> {
    let ranges = vec(any::<f32>(), 0..40);
    (headers(), any::<[f32; 7]>(), ranges.clone(), ranges).prop_map(
        |(header, [a, b, c, d, e, f, g], ranges, intensities)| LaserScan {
            header,
            angle_min: a,
            angle_max: b,
            angle_increment: c,
            time_increment: d,
            scan_time: e,
            range_min: f,
            range_max: g,
            ranges,
            intensities,
        },
    )
}

fn grids() -> impl Strategy<Value = OccupancyGrid> {
    (headers(), poses(), any::<f32>(), vec(any::<i8>(), 0..40)).prop_map(
        |(header, origin, resolution, cells)| OccupancyGrid {
            info: MapMetaData {
                map_load_time: header.stamp,
                resolution,
                width: 7,
                height: 3,
                origin,
            },
            header,
            data: Int8Array::from(cells.as_slice()),
        },
    )
}

fn tf_messages() -> impl Strategy<Value = TfMessage> {
    let transform = (headers(), frames(), poses()).prop_map(|(header, child_frame_id, pose)| {
        let Point { x, y, z } = pose.position;
        TransformStamped {
            header,
            child_frame_id,
            transform: Transform { translation: Vector3 { x, y, z }, rotation: pose.orientation },
        }
    });
    vec(transform, 0..5).prop_map(|transforms| TfMessage { transforms })
}

/// Bytes stand in for messages, whose NaN are not equal.
fn returns<M: Message>(message: &M) -> bool {
    let mut big = vec![0, 0, 0, 0];
    big.extend(cdr_encoding::to_vec::<M, BigEndian>(message).unwrap());
    [cdr(message), big].iter().all(|bytes| cdr(&decode::<M>(bytes, "").unwrap()) == cdr(message))
}

fn decode_as_everything(bytes: &[u8], encoding: &str) {
    decode::<LaserScan>(bytes, encoding).ok();
    decode::<Odometry>(bytes, encoding).ok();
    decode::<TfMessage>(bytes, encoding).ok();
    decode::<GetMapRequest>(bytes, encoding).ok();
    decode::<GetMapResponse>(bytes, encoding).ok();
    decode::<MapMetaData>(bytes, encoding).ok();
    decode::<PoseWithCovarianceStamped>(bytes, encoding).ok();
    decode::<PoseArray>(bytes, encoding).ok();
    decode::<Path>(bytes, encoding).ok();
    decode::<Float64>(bytes, encoding).ok();
    decode::<DiagnosticArray>(bytes, encoding).ok();
}

proptest! {
    #[test]
    fn what_is_encoded_decodes(
        scan in laser_scans(), grid in grids(), tf in tf_messages(), header in headers(),
        poses in vec(poses(), 1..5),
    ) {
        let stamped = poses.iter().map(|&pose| PoseStamped { header: header.clone(), pose });
        let path = Path { header: header.clone(), poses: stamped.collect() };
        let odometry = Odometry {
            header: header.clone(),
            child_frame_id: header.frame_id.clone(),
            pose: PoseWithCovariance { pose: poses[0], ..PoseWithCovariance::default() },
            twist: TwistWithCovariance::default(),
        };
        let cloud = PoseArray { header, poses };
        prop_assert!(returns(&scan));
        prop_assert!(returns(&grid));
        prop_assert!(returns(&tf));
        prop_assert!(returns(&path));
        prop_assert!(returns(&odometry));
        prop_assert!(returns(&cloud));
    }

    #[test]
    fn scans_survive_json(scan in laser_scans()) {
        let back = decode::<LaserScan>(&json(&scan), "").unwrap();
        prop_assert_eq!(cdr(&back), cdr(&scan));
    }

    #[test]
    fn no_bytes_panic(bytes in vec(any::<u8>(), 0..300), order in 0..2_u8) {
        decode_as_everything(&bytes, "");
        decode_as_everything(&bytes, "application/json");
        decode_as_everything(&[vec![0, order, 0, 0], bytes].concat(), "");
    }

    #[test]
    fn no_damage_to_a_message_panics(line in 0..26_usize, at in 0..2000_usize, octet in any::<u8>()) {
        let digits = GOLDEN.lines().nth(line).unwrap().rsplit(' ').next().unwrap();
        let mut bytes = bytes_of(digits);
        let at = at % bytes.len();
        bytes[at] = octet;
        decode_as_everything(&bytes, "");
    }
}
