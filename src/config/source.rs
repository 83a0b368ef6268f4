//! Where a value was given, from the text of a file or a `--set` to a list of keys.

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

use serde::de::{Deserialize, DeserializeOwned, Deserializer, MapAccess, SeqAccess, Visitor};
use serde_json::Value;
use serde_saphyr::Spanned;
use serde_saphyr::options::DuplicateKeyPolicy;

use super::raw::HECTOR_KEYS;
use super::{ConfigError, ConfigWarning};

/// The names under which ROS nests the parameters of slam_gmapping and hector_mapping.
const NODE_NAMES: [&str; 5] =
    ["slam_gmapping", "/slam_gmapping", "hector_mapping", "/hector_mapping", "/**"];

/// ROS 2 nests them once more.
const ROS_PARAMETERS: &str = "ros__parameters";

/// Keys that ROS adds to a parameter file, or that slam_gmapping dropped long ago.
const FOREIGN_KEYS: [&str; 4] =
    ["use_sim_time", "qos_overrides", "start_type_description_service", "inverted_laser"];

/// With this, hector_mapping matches nothing.
const KNOWN_POSES: &str = "map_with_known_poses";

/// Where a value was given.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Origin {
    /// In a file.
    File {
        /// The file.
        path: PathBuf,
        /// Its line, from 1.
        line: u64,
    },
    /// By `--set`.
    Override,
}

impl fmt::Display for Origin {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File { path, line } => write!(formatter, "{}:{line}", path.display()),
            Self::Override => formatter.write_str("--set"),
        }
    }
}

/// A value and where it was given.
#[derive(Debug)]
pub(super) struct Entry {
    pub(super) value: Value,
    pub(super) origin: Origin,
}

/// The keys that were given; a later one replaces an earlier one.
pub(super) type Entries = BTreeMap<String, Entry>;

/// Adds the keys of a file, whichever way they are nested.
pub(super) fn add_file(
    entries: &mut Entries,
    warnings: &mut Vec<ConfigWarning>,
    path: &Path,
    text: &str,
) -> Result<(), ConfigError> {
    let document: Option<Spanned<Node>> = parse(text).map_err(|error| {
        let line = error.location().map_or(1, |location| location.line());
        let reason = plain_message(&error);
        ConfigError::Syntax { origin: Origin::File { path: path.to_owned(), line }, reason }
    })?;
    let Some(document) = document else { return Ok(()) };
    let parameters = unnest(into_map(document, path)?, path, warnings)?;
    for (key, node) in parameters {
        let origin = Origin::File { path: path.to_owned(), line: node.referenced.line() };
        let entry = Entry { value: node.value.into_value(), origin };
        add(entries, warnings, key, entry)?;
    }
    Ok(())
}

/// Adds a key, or warns that it means nothing here.
fn add(
    entries: &mut Entries,
    warnings: &mut Vec<ConfigWarning>,
    key: String,
    entry: Entry,
) -> Result<(), ConfigError> {
    if key == KNOWN_POSES && entry.value == Value::Bool(true) {
        let reason = "mapping along known poses is another engine: leave this out, and set \
                      `engine: known_poses`";
        let (value, reason) = (entry.value.to_string(), reason.to_owned());
        return Err(ConfigError::WrongKind { origin: entry.origin, key, value, reason });
    }
    if FOREIGN_KEYS.contains(&key.as_str()) {
        warnings.push(ConfigWarning::Foreign { key });
    } else if let Some((_, instead)) = HECTOR_KEYS.iter().find(|(name, _)| *name == key) {
        warnings.push(ConfigWarning::Hectors { key, instead });
    } else {
        entries.insert(key, entry);
    }
    Ok(())
}

/// Adds the key of one `key=value`.
pub(super) fn add_override(
    entries: &mut Entries,
    warnings: &mut Vec<ConfigWarning>,
    text: &str,
) -> Result<(), ConfigError> {
    let (key, value) =
        text.split_once('=').ok_or_else(|| ConfigError::NotKeyValue { text: text.to_owned() })?;
    let node: Node = parse(value).map_err(|error| ConfigError::Syntax {
        origin: Origin::Override,
        reason: format!("{key}={value}: {}", plain_message(&error)),
    })?;
    let entry = Entry { value: node.into_value(), origin: Origin::Override };
    add(entries, warnings, key.trim().to_owned(), entry)
}

/// Repeated keys and NaN are left to [`NodeVisitor`], which says so in the file's words.
fn parse<T: DeserializeOwned>(text: &str) -> Result<T, serde_saphyr::Error> {
    let options = serde_saphyr::options! {
        duplicate_keys: DuplicateKeyPolicy::LastWins,
        reject_non_finite_typeless_float: false,
    };
    serde_saphyr::from_str_with_options(text, options)
}

type Map = Vec<(String, Spanned<Node>)>;

fn unnest(map: Map, path: &Path, warnings: &mut Vec<ConfigWarning>) -> Result<Map, ConfigError> {
    let is_node = |key: &str| NODE_NAMES.contains(&key);
    if !map.iter().any(|(key, _)| is_node(key) || key == ROS_PARAMETERS) {
        return Ok(map);
    }
    let mut parameters = Map::new();
    for (key, node) in map {
        if is_node(&key) {
            parameters.extend(unnest(into_map(node, path)?, path, warnings)?);
        } else if key == ROS_PARAMETERS {
            parameters.extend(into_map(node, path)?);
        } else {
            warnings.push(ConfigWarning::OtherNode { name: key });
        }
    }
    Ok(parameters)
}

fn into_map(node: Spanned<Node>, path: &Path) -> Result<Map, ConfigError> {
    let syntax_error = |line: u64, reason: String| {
        Err(ConfigError::Syntax { origin: Origin::File { path: path.to_owned(), line }, reason })
    };
    let map = match node.value {
        Node::Map(map) => map,
        Node::Value(Value::Null) => return Ok(Map::new()),
        Node::Value(_) => {
            let reason = "keys and values are needed here, as in \"particles: 30\"".to_owned();
            return syntax_error(node.referenced.line(), reason);
        }
    };
    for (index, (key, value)) in map.iter().enumerate() {
        if map[..index].iter().any(|(earlier, _)| earlier == key) {
            return syntax_error(value.referenced.line(), format!("{key} is given a second time"));
        }
    }
    Ok(map)
}

/// The parser's own message, without the line that our message names already.
fn plain_message(error: &serde_saphyr::Error) -> String {
    error.without_snippet().to_string()
}

/// A YAML node whose maps remember the lines of their values.
#[derive(Debug)]
enum Node {
    Map(Map),
    Value(Value),
}

impl Node {
    fn into_value(self) -> Value {
        match self {
            Self::Map(map) => Value::Object(
                map.into_iter().map(|(key, node)| (key, node.value.into_value())).collect(),
            ),
            Self::Value(value) => value,
        }
    }
}

impl<'de> Deserialize<'de> for Node {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(NodeVisitor)
    }
}

struct NodeVisitor;

impl<'de> Visitor<'de> for NodeVisitor {
    type Value = Node;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("a value, a list or keys with values")
    }

    fn visit_bool<E>(self, value: bool) -> Result<Node, E> {
        Ok(Node::Value(value.into()))
    }

    fn visit_i64<E>(self, value: i64) -> Result<Node, E> {
        Ok(Node::Value(value.into()))
    }

    fn visit_u64<E>(self, value: u64) -> Result<Node, E> {
        Ok(Node::Value(value.into()))
    }

    fn visit_f64<E: serde::de::Error>(self, value: f64) -> Result<Node, E> {
        if value.is_finite() {
            Ok(Node::Value(value.into()))
        } else {
            Err(E::custom(format!("{value} is not a finite number")))
        }
    }

    fn visit_str<E>(self, value: &str) -> Result<Node, E> {
        Ok(Node::Value(value.into()))
    }

    fn visit_unit<E>(self) -> Result<Node, E> {
        Ok(Node::Value(Value::Null))
    }

    fn visit_none<E>(self) -> Result<Node, E> {
        Ok(Node::Value(Value::Null))
    }

    fn visit_some<D: Deserializer<'de>>(self, deserializer: D) -> Result<Node, D::Error> {
        Node::deserialize(deserializer)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut sequence: A) -> Result<Node, A::Error> {
        let mut values = Vec::new();
        while let Some(node) = sequence.next_element::<Node>()? {
            values.push(node.into_value());
        }
        Ok(Node::Value(Value::Array(values)))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut access: A) -> Result<Node, A::Error> {
        let mut map = Map::new();
        while let Some(entry) = access.next_entry::<String, Spanned<Node>>()? {
            map.push(entry);
        }
        Ok(Node::Map(map))
    }
}
