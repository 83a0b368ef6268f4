//! The hashes once more, from the definitions, as REP-2016 makes them.

use std::collections::{BTreeMap, BTreeSet};

use sha2::{Digest as _, Sha256};

use super::{
    DIAGNOSTIC_ARRAY, FLOAT64, GET_MAP, LASER_SCAN, MAP_META_DATA, OCCUPANCY_GRID,
    OCCUPANCY_GRID_UPDATE, ODOMETRY, PATH, POSE_ARRAY, POSE_WITH_COVARIANCE_STAMPED, TF_MESSAGE,
    WireType,
};

/// Each type with its fields, one a line, as in the `.msg` files of ROS 2.
const DEFINITIONS: [(&str, &str); 27] = [
    ("builtin_interfaces/msg/Time", "int32 sec\nuint32 nanosec"),
    ("std_msgs/msg/Header", "builtin_interfaces/Time stamp\nstring frame_id"),
    ("std_msgs/msg/Float64", "float64 data"),
    ("geometry_msgs/msg/Point", "float64 x\nfloat64 y\nfloat64 z"),
    ("geometry_msgs/msg/Vector3", "float64 x\nfloat64 y\nfloat64 z"),
    ("geometry_msgs/msg/Quaternion", "float64 x\nfloat64 y\nfloat64 z\nfloat64 w"),
    (
        "geometry_msgs/msg/Pose",
        "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    ),
    ("geometry_msgs/msg/PoseStamped", "std_msgs/Header header\ngeometry_msgs/Pose pose"),
    ("geometry_msgs/msg/PoseArray", "std_msgs/Header header\ngeometry_msgs/Pose[] poses"),
    ("geometry_msgs/msg/PoseWithCovariance", "geometry_msgs/Pose pose\nfloat64[36] covariance"),
    (
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose",
    ),
    ("geometry_msgs/msg/Twist", "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular"),
    ("geometry_msgs/msg/TwistWithCovariance", "geometry_msgs/Twist twist\nfloat64[36] covariance"),
    (
        "geometry_msgs/msg/Transform",
        "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation",
    ),
    (
        "geometry_msgs/msg/TransformStamped",
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform",
    ),
    ("tf2_msgs/msg/TFMessage", "geometry_msgs/TransformStamped[] transforms"),
    (
        "sensor_msgs/msg/LaserScan",
        "std_msgs/Header header\nfloat32 angle_min\nfloat32 angle_max\nfloat32 angle_increment\n\
         float32 time_increment\nfloat32 scan_time\nfloat32 range_min\nfloat32 range_max\n\
         float32[] ranges\nfloat32[] intensities",
    ),
    (
        "nav_msgs/msg/Odometry",
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n\
         geometry_msgs/TwistWithCovariance twist",
    ),
    (
        "nav_msgs/msg/MapMetaData",
        "builtin_interfaces/Time map_load_time\nfloat32 resolution\nuint32 width\nuint32 height\n\
         geometry_msgs/Pose origin",
    ),
    (
        "map_msgs/msg/OccupancyGridUpdate",
        "std_msgs/Header header\nint32 x\nint32 y\nuint32 width\nuint32 height\nint8[] data",
    ),
    (
        "nav_msgs/msg/OccupancyGrid",
        "std_msgs/Header header\nnav_msgs/MapMetaData info\nint8[] data",
    ),
    ("nav_msgs/msg/Path", "std_msgs/Header header\ngeometry_msgs/PoseStamped[] poses"),
    ("diagnostic_msgs/msg/KeyValue", "string key\nstring value"),
    (
        "diagnostic_msgs/msg/DiagnosticStatus",
        "byte level\nstring name\nstring message\nstring hardware_id\n\
         diagnostic_msgs/KeyValue[] values",
    ),
    (
        "diagnostic_msgs/msg/DiagnosticArray",
        "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status",
    ),
    (
        "service_msgs/msg/ServiceEventInfo",
        "uint8 event_type\nbuiltin_interfaces/Time stamp\nchar[16] client_gid\n\
         int64 sequence_number",
    ),
    // The request and the response, with dashes between them as in a `.srv` file.
    ("nav_msgs/srv/GetMap", "---\nnav_msgs/OccupancyGrid map"),
];

const NESTED: u8 = 1;

/// The number of a type of field, `None` for one that is a message.
fn primitive(name: &str) -> Option<u8> {
    let numbers = [
        ("int8", 2),
        ("uint8", 3),
        ("char", 3),
        ("int32", 6),
        ("uint32", 7),
        ("int64", 8),
        ("float32", 10),
        ("float64", 11),
        ("byte", 16),
        ("string", 17),
    ];
    numbers.into_iter().find(|(other, _)| *other == name).map(|(_, number)| number)
}

/// All structs by name, each with its fields as `(type, name)`; of a service come four.
fn structs() -> BTreeMap<String, Vec<(String, String)>> {
    let fields = |text: &str| -> Vec<(String, String)> {
        let fields = text.lines().filter_map(|line| line.split_once(' '));
        fields.map(|(kind, name)| (kind.to_owned(), name.to_owned())).collect()
    };
    let mut structs = BTreeMap::new();
    for (name, text) in DEFINITIONS {
        let Some((request, response)) = text.split_once("---\n") else {
            structs.insert(name.to_owned(), fields(text));
            continue;
        };
        for (part, text) in [("Request", request), ("Response", response)] {
            let mut fields = fields(text);
            if fields.is_empty() {
                let filler = "structure_needs_at_least_one_member";
                fields.push(("uint8".to_owned(), filler.to_owned()));
            }
            structs.insert(format!("{name}_{part}"), fields);
        }
        let event = format!(
            "service_msgs/ServiceEventInfo info\n{name}_Request[<=1] request\n\
             {name}_Response[<=1] response"
        );
        structs.insert(format!("{name}_Event"), fields(&event));
        let service = format!(
            "{name}_Request request_message\n{name}_Response response_message\n\
             {name}_Event event_message"
        );
        structs.insert(name.to_owned(), fields(&service));
    }
    structs
}

/// How a field's type is written in the hashed text, and the struct it names.
fn field_type(kind: &str) -> (String, Option<String>) {
    let (element, brackets) = kind.split_once('[').unwrap_or((kind, ""));
    let nested = primitive(element).is_none().then(|| {
        let (package, name) = element.split_once('/').expect("a message has a package");
        if name.contains('/') { element.to_owned() } else { format!("{package}/msg/{name}") }
    });
    let (offset, capacity) = match brackets.trim_end_matches(']') {
        "" if brackets.is_empty() => (0, 0),
        "" => (144, 0),
        bound => match bound.strip_prefix("<=") {
            Some(bound) => (96, bound.parse().unwrap()),
            None => (48, bound.parse().unwrap()),
        },
    };
    let number = offset + primitive(element).unwrap_or(NESTED);
    let text = format!(
        r#"{{"type_id": {number}, "capacity": {capacity}, "string_capacity": 0, "nested_type_name": "{}"}}"#,
        nested.as_deref().unwrap_or_default()
    );
    (text, nested)
}

/// A struct in the hashed text, and those it names.
fn description(name: &str, fields: &[(String, String)]) -> (String, BTreeSet<String>) {
    let mut named = BTreeSet::new();
    let mut texts = Vec::new();
    for (kind, field) in fields {
        let (text, nested) = field_type(kind);
        named.extend(nested);
        texts.push(format!(r#"{{"name": "{field}", "type": {text}}}"#));
    }
    (format!(r#"{{"type_name": "{name}", "fields": [{}]}}"#, texts.join(", ")), named)
}

fn hash(name: &str) -> String {
    let structs = structs();
    let (text, mut waiting) = description(name, &structs[name]);
    let mut referenced = BTreeMap::new();
    while let Some(next) = waiting.pop_first() {
        let (text, more) = description(&next, &structs[&next]);
        referenced.insert(next, text);
        waiting.extend(more.into_iter().filter(|name| !referenced.contains_key(name)));
    }
    let referenced: Vec<String> = referenced.into_values().collect();
    let text = format!(
        r#"{{"type_description": {text}, "referenced_type_descriptions": [{}]}}"#,
        referenced.join(", ")
    );
    let digest = Sha256::digest(text.as_bytes());
    let hexadecimal: String = digest.iter().map(|byte| format!("{byte:02x}")).collect();
    format!("RIHS01_{hexadecimal}")
}

#[test]
fn hashes_are_those_of_the_definitions() {
    let types: [WireType; 12] = [
        DIAGNOSTIC_ARRAY,
        FLOAT64,
        GET_MAP,
        LASER_SCAN,
        MAP_META_DATA,
        OCCUPANCY_GRID,
        OCCUPANCY_GRID_UPDATE,
        ODOMETRY,
        PATH,
        POSE_ARRAY,
        POSE_WITH_COVARIANCE_STAMPED,
        TF_MESSAGE,
    ];
    for wire_type in types {
        assert_eq!(hash(wire_type.name), wire_type.hash, "{}", wire_type.name);
    }
}
