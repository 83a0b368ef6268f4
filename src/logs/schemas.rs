//! Definitions of ROS 2 messages as recordings carry them: the message's own, then those it uses.

/// Between two definitions.
const RULE: &str =
    "================================================================================";

const TIME: &str = "int32 sec\nuint32 nanosec\n";
const HEADER: &str = "builtin_interfaces/Time stamp\nstring frame_id\n";
const POINT: &str = "float64 x\nfloat64 y\nfloat64 z\n";
const QUATERNION: &str = "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n";
const POSE: &str = "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n";

/// Types with their own fields, each after all types that use it.
const DEFINITIONS: [(&str, &str); 22] = [
    (
        "sensor_msgs/LaserScan",
        "std_msgs/Header header\nfloat32 angle_min\nfloat32 angle_max\nfloat32 angle_increment\n\
         float32 time_increment\nfloat32 scan_time\nfloat32 range_min\nfloat32 range_max\n\
         float32[] ranges\nfloat32[] intensities\n",
    ),
    (
        "nav_msgs/Odometry",
        "std_msgs/Header header\nstring child_frame_id\n\
         geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist\n",
    ),
    ("tf2_msgs/TFMessage", "geometry_msgs/TransformStamped[] transforms\n"),
    ("nav_msgs/OccupancyGrid", "std_msgs/Header header\nnav_msgs/MapMetaData info\nint8[] data\n"),
    (
        "nav_msgs/MapMetaData",
        "builtin_interfaces/Time map_load_time\nfloat32 resolution\nuint32 width\nuint32 height\n\
         geometry_msgs/Pose origin\n",
    ),
    ("nav_msgs/Path", "std_msgs/Header header\ngeometry_msgs/PoseStamped[] poses\n"),
    (
        "geometry_msgs/PoseWithCovarianceStamped",
        "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose\n",
    ),
    ("geometry_msgs/PoseArray", "std_msgs/Header header\ngeometry_msgs/Pose[] poses\n"),
    (
        "diagnostic_msgs/DiagnosticArray",
        "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status\n",
    ),
    (
        "diagnostic_msgs/DiagnosticStatus",
        "byte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\nbyte level\nstring name\n\
         string message\nstring hardware_id\ndiagnostic_msgs/KeyValue[] values\n",
    ),
    ("diagnostic_msgs/KeyValue", "string key\nstring value\n"),
    ("std_msgs/Float64", "float64 data\n"),
    (
        "geometry_msgs/TransformStamped",
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n",
    ),
    (
        "geometry_msgs/Transform",
        "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
    ),
    ("geometry_msgs/PoseStamped", "std_msgs/Header header\ngeometry_msgs/Pose pose\n"),
    ("geometry_msgs/PoseWithCovariance", "geometry_msgs/Pose pose\nfloat64[36] covariance\n"),
    ("geometry_msgs/TwistWithCovariance", "geometry_msgs/Twist twist\nfloat64[36] covariance\n"),
    ("geometry_msgs/Twist", "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n"),
    ("geometry_msgs/Pose", POSE),
    ("geometry_msgs/Point", POINT),
    ("geometry_msgs/Quaternion", QUATERNION),
    ("geometry_msgs/Vector3", POINT),
];

/// Used by others, and last.
const BASICS: [(&str, &str); 2] = [("std_msgs/Header", HEADER), ("builtin_interfaces/Time", TIME)];

/// The whole definition of a type such as `sensor_msgs/msg/LaserScan`; `None` for others than
/// those that gmapd takes and gives.
pub(super) fn ros2msg(message_type: &str) -> Option<String> {
    let name = message_type.replace("/msg/", "/");
    let mut text = own_fields(&name)?.to_owned();
    let types = DEFINITIONS.iter().chain(&BASICS);
    // Users come before what they use, so that one pass finds all.
    for (other, fields) in types.filter(|(other, _)| *other != name) {
        let used = |line: &str| {
            let kind = line.split([' ', '[']).next().unwrap_or_default();
            kind == *other
        };
        if text.lines().any(used) {
            text += &format!("{RULE}\nMSG: {other}\n{fields}");
        }
    }
    Some(text)
}

fn own_fields(name: &str) -> Option<&'static str> {
    let found = DEFINITIONS.iter().chain(&BASICS).find(|(other, _)| *other == name);
    found.map(|(_, fields)| *fields)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_definition_is_followed_by_those_it_uses_once() {
        let text = ros2msg("geometry_msgs/msg/PoseArray").unwrap();
        let parts: Vec<&str> = text.lines().filter(|line| line.starts_with("MSG: ")).collect();
        assert_eq!(
            parts,
            [
                "MSG: geometry_msgs/Pose",
                "MSG: geometry_msgs/Point",
                "MSG: geometry_msgs/Quaternion",
                "MSG: std_msgs/Header",
                "MSG: builtin_interfaces/Time"
            ]
        );
        assert_eq!(ros2msg("std_msgs/msg/Float64").as_deref(), Some("float64 data\n"));
        assert_eq!(ros2msg("sensor_msgs/msg/Image"), None);
    }

    #[test]
    fn every_type_that_is_used_is_defined() {
        for (name, _) in DEFINITIONS {
            let text = ros2msg(name).unwrap();
            let fields = text.lines().filter(|line| !line.contains('='));
            for kind in fields.filter_map(|line| line.split([' ', '[']).next()) {
                let defined = !kind.contains('/') || text.contains(&format!("MSG: {kind}\n"));
                assert!(defined, "{name}: {kind}");
            }
        }
    }
}
