//! What a query asks: its key and its parameters, parsed once.
//!
//! Parameters are `name=value`, with `;` between them, as in `map?format=text;cols=100`. Those
//! that begin with `_` are Zenoh's own and passed over.

use std::f64::consts::TAU;
use std::num::NonZeroUsize;

use thiserror::Error;

use super::save::{NameError, SaveName};
use super::tiles::TilesQuestion;
use crate::config::CommandName;
use crate::map::region::{Layer, Window};
use crate::map::tiles::TileIndex;
use crate::slam::known_map::Mode;
use crate::slam::pose::{Point2, Pose2, Stamp, wrap_angle};

/// Columns of a map drawn with characters, unless asked otherwise.
const USUAL_COLUMNS: NonZeroUsize = NonZeroUsize::new(80).expect("80 is not 0");

/// A terminal is not wider, and a reply not larger than it is worth.
const MOST_COLUMNS: usize = 1000;

/// Coordinates that are further away than this are typing errors, m.
const FURTHEST: f64 = 1e6;

/// Characters of a query that an error repeats.
const LONGEST_EXCERPT: usize = 60;

/// Tiles that are asked for by name at once.
const MOST_WANTED: usize = 1000;

const WANTED: &str =
    "none, or at most 1000 tiles as COLUMN:ROW with commas between, as in 0:-1,2:3";

const NANOSECOND_DIGITS: usize = 9;

/// What a robot can be asked, one key each.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Topic {
    /// The map.
    Map,
    /// The map, as the service of slam_gmapping.
    DynamicMap,
    /// Size and place of the map.
    MapMetadata,
    /// Where the robot is, or was.
    Pose,
    /// The way of the robot.
    Path,
    /// The poses of the particles.
    ParticleCloud,
    /// How undecided the particles are.
    Entropy,
    /// The map as tiles.
    Tiles,
    /// How the daemon is.
    Status,
    /// Begin anew.
    Reset,
    /// Take no scans.
    Pause,
    /// Take scans again.
    Resume,
    /// Say where the robot is.
    InitialPose,
    /// Let scans enter the map, or freeze it.
    Mode,
    /// Write the map to files.
    Save,
    /// Write the state, to go on from.
    Checkpoint,
}

impl Topic {
    /// All that can be asked.
    pub const ALL: [Self; 16] = [
        Self::Map,
        Self::DynamicMap,
        Self::MapMetadata,
        Self::Pose,
        Self::Path,
        Self::ParticleCloud,
        Self::Entropy,
        Self::Tiles,
        Self::Status,
        Self::Reset,
        Self::Pause,
        Self::Resume,
        Self::InitialPose,
        Self::Mode,
        Self::Save,
        Self::Checkpoint,
    ];

    /// The key under the robot's prefix.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Map => "map",
            Self::DynamicMap => "dynamic_map",
            Self::MapMetadata => "map_metadata",
            Self::Pose => "pose",
            Self::Path => "path",
            Self::ParticleCloud => "particlecloud",
            Self::Entropy => "entropy",
            Self::Tiles => "slam/tiles",
            Self::Status => "slam/status",
            Self::Reset => "slam/cmd/reset",
            Self::Pause => "slam/cmd/pause",
            Self::Resume => "slam/cmd/resume",
            Self::InitialPose => "slam/cmd/initial_pose",
            Self::Mode => "slam/cmd/mode",
            Self::Save => "slam/cmd/save",
            Self::Checkpoint => "slam/cmd/checkpoint",
        }
    }

    /// What asking changes, if it does; then it must not happen by a wildcard.
    #[must_use]
    pub const fn command(self) -> Option<CommandName> {
        match self {
            Self::Reset => Some(CommandName::Reset),
            Self::Pause => Some(CommandName::Pause),
            Self::Resume => Some(CommandName::Resume),
            Self::InitialPose => Some(CommandName::InitialPose),
            Self::Save => Some(CommandName::Save),
            Self::Mode => Some(CommandName::Mode),
            Self::Checkpoint => Some(CommandName::Checkpoint),
            Self::Map
            | Self::DynamicMap
            | Self::MapMetadata
            | Self::Pose
            | Self::Path
            | Self::ParticleCloud
            | Self::Entropy
            | Self::Tiles
            | Self::Status => None,
        }
    }

    /// Whether the answer may be megabytes, which take their time on the network.
    #[must_use]
    pub const fn is_large(self) -> bool {
        matches!(self, Self::Map | Self::DynamicMap | Self::Path | Self::Tiles)
    }

    /// What is asked with these parameters.
    ///
    /// # Errors
    /// When a parameter is not known here, is there twice, or has a value that is not allowed.
    pub fn question(self, parameters: &str) -> Result<Question, SelectorError> {
        let of = |allowed| Parameters::parse(parameters, allowed);
        Ok(match self {
            Self::Map => map_question(&of(&["format", "cols", "bbox", "res", "layers"])?)?,
            // Never an error: a ROS client of this service would wait for a reply for ever.
            Self::DynamicMap => Question::DynamicMap,
            Self::MapMetadata => Question::MapMetadata(of(&["format"])?.message_format()?),
            Self::Pose => {
                let parameters = of(&["format", "at"])?;
                let format = parameters.message_format()?;
                Question::Pose { at: parameters.get("at").map(stamp).transpose()?, format }
            }
            Self::Path => Question::Path(path_format(&of(&["format"])?)?),
            Self::ParticleCloud => Question::ParticleCloud(of(&["format"])?.message_format()?),
            Self::Entropy => Question::Entropy(of(&["format"])?.message_format()?),
            Self::Tiles => Question::Tiles(tiles_question(&of(&["since", "run", "want"])?)?),
            Self::Status => {
                of(&["format"])?.choice("format", &[("json", ())])?;
                Question::Status
            }
            Self::Reset => Question::Reset(of(&["x", "y", "yaw"])?.pose()?),
            Self::Pause => of(&[]).map(|_| Question::Pause)?,
            Self::Resume => of(&[]).map(|_| Question::Resume)?,
            Self::InitialPose => {
                let pose = of(&["x", "y", "yaw"])?.pose()?;
                Question::InitialPose(pose.ok_or(SelectorError::NoPose)?)
            }
            Self::Mode => {
                let modes = [("mapping", Mode::Mapping), ("localization", Mode::Localization)];
                let mode = of(&["mode"])?.choice("mode", &modes)?;
                Question::Mode(mode.ok_or(SelectorError::NoMode)?)
            }
            Self::Save => {
                let parameters = of(&["name"])?;
                let name = parameters.get("name").map(SaveName::parse).transpose()?;
                Question::Save(name.unwrap_or_default())
            }
            Self::Checkpoint => of(&[]).map(|_| Question::Checkpoint)?,
        })
    }
}

/// A query that makes sense.
#[derive(Debug, Clone, PartialEq)]
pub enum Question {
    /// The map, in this format.
    Map(MapFormat),
    /// A part of it, or the whole in coarser cells.
    Region(RegionQuestion),
    /// The map as the response of `nav_msgs/srv/GetMap`.
    DynamicMap,
    /// `nav_msgs/MapMetaData`.
    MapMetadata(MessageFormat),
    /// `geometry_msgs/PoseWithCovarianceStamped`.
    Pose {
        /// When; `None` for now.
        at: Option<Stamp>,
        /// How to write it.
        format: MessageFormat,
    },
    /// The way of the robot.
    Path(PathFormat),
    /// `geometry_msgs/PoseArray`.
    ParticleCloud(MessageFormat),
    /// `std_msgs/Float64`.
    Entropy(MessageFormat),
    /// The map as tiles.
    Tiles(TilesQuestion),
    /// How the daemon is.
    Status,
    /// Begin anew, with the base at this pose in `map` if there is one.
    Reset(Option<Pose2>),
    /// Take no scans.
    Pause,
    /// Take scans again.
    Resume,
    /// The base is at this pose in `map`.
    InitialPose(Pose2),
    /// Scans enter the map, or do not.
    Mode(Mode),
    /// Write the map to files of this name.
    Save(SaveName),
    /// Write the state, to go on from.
    Checkpoint,
}

/// Which part of the map is asked for, and what of it.
#[derive(Debug, Clone, PartialEq)]
pub struct RegionQuestion {
    /// The part; `None` for the whole.
    pub window: Option<Window>,
    /// Metres a cell at least; `None` for the map's own.
    pub resolution: Option<f64>,
    /// What to tell of each cell, and how to write it.
    pub form: RegionForm,
}

/// The ways to write a region.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RegionForm {
    /// As a map.
    Map(MapFormat),
    /// These layers, as JSON.
    Layers(Vec<Layer>),
}

/// The ways to write the map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum MapFormat {
    /// `nav_msgs/OccupancyGrid` as CDR.
    Cdr,
    /// Cells in runs of equal ones.
    Json,
    /// A picture with the path.
    Png,
    /// The image of map_server.
    Pgm,
    /// The file that goes with the image of map_server.
    Yaml,
    /// Drawn with characters.
    Text {
        /// Characters a line at most.
        columns: NonZeroUsize,
    },
}

/// The ways to write a ROS message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum MessageFormat {
    /// CDR.
    Cdr,
    /// JSON of the same fields.
    Json,
}

/// The ways to write the path.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum PathFormat {
    /// `nav_msgs/Path`.
    Message(MessageFormat),
    /// A line a pose: stamp, position, quaternion.
    Tum,
}

/// Why a query makes no sense.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum SelectorError {
    /// A parameter that is not known here.
    #[error("there is no parameter {name:?} here; {}", allowed_names(allowed))]
    Unknown {
        /// As it was given.
        name: String,
        /// What there is.
        allowed: &'static [&'static str],
    },
    /// The same parameter once more.
    #[error("the parameter {0} is given twice; give it once")]
    Twice(&'static str),
    /// A word that is not one of those allowed.
    #[error("{name}={value:?} is not known; allowed are {}", allowed.join(", "))]
    NoChoice {
        /// The parameter.
        name: &'static str,
        /// As it was given.
        value: String,
        /// The words that are.
        allowed: Vec<&'static str>,
    },
    /// A value that is not a number, or not one that is allowed.
    #[error("{name}={value:?} is not allowed; it must be {allowed}")]
    NoNumber {
        /// The parameter.
        name: &'static str,
        /// As it was given.
        value: String,
        /// What it may be.
        allowed: &'static str,
    },
    /// A width for a format that has none.
    #[error("cols is only for format=text; leave it out, or ask for format=text")]
    ColumnsWithoutText,
    /// A region without any area.
    #[error(
        "bbox={0:?} is inverted or empty; it must be x0,y0,x1,y1 with x0 below x1 and y0 below y1"
    )]
    NoArea(String),
    /// A layer that is not known.
    #[error(
        "there is no layer {0:?}; allowed are occupancy, hits, visits, last_seen, with commas \
         between, each once"
    )]
    NoLayer(String),
    /// Layers that a format cannot show.
    #[error("format goes with layers=occupancy alone; other layers are always JSON")]
    LayersAsMap,
    /// Tiles by version and by place at once.
    #[error("{0} does not go with want: tiles are asked for by version or by name")]
    WantBeside(&'static str),
    /// A pose without some of its parts.
    #[error("{0} is missing: a pose needs x and y in metres and yaw in radians")]
    PartOfPose(&'static str),
    /// No pose where one is needed.
    #[error("a pose is needed: x and y in metres and yaw in radians, as in x=1.5;y=-2;yaw=0.5")]
    NoPose,
    /// No mode where one is needed.
    #[error("a mode is needed: mode=mapping or mode=localization")]
    NoMode,
    /// No name for files.
    #[error(transparent)]
    Name(#[from] NameError),
}

fn allowed_names(allowed: &[&str]) -> String {
    if allowed.is_empty() {
        "none is allowed".to_owned()
    } else {
        format!("allowed are {}", allowed.join(", "))
    }
}

/// The beginning of what somebody sent: an error reply does not grow with the query.
pub(super) fn excerpt(text: &str) -> String {
    let mut characters = text.chars();
    let mut excerpt: String = characters.by_ref().take(LONGEST_EXCERPT).collect();
    if characters.next().is_some() {
        excerpt.push('…');
    }
    excerpt
}

/// The parameters of a query: each is known and there once.
struct Parameters<'a>(Vec<(&'static str, &'a str)>);

impl<'a> Parameters<'a> {
    fn parse(text: &'a str, allowed: &'static [&'static str]) -> Result<Self, SelectorError> {
        let mut parameters = Self(Vec::new());
        let parts = text.split(';').filter(|part| !part.is_empty() && !part.starts_with('_'));
        for part in parts {
            let (name, value) = part.split_once('=').unwrap_or((part, ""));
            let Some(&known) = allowed.iter().find(|&&known| known == name) else {
                return Err(SelectorError::Unknown { name: excerpt(name), allowed });
            };
            if parameters.get(known).is_some() {
                return Err(SelectorError::Twice(known));
            }
            parameters.0.push((known, value));
        }
        Ok(parameters)
    }

    fn get(&self, name: &str) -> Option<&'a str> {
        self.0.iter().find(|(known, _)| *known == name).map(|&(_, value)| value)
    }

    /// What a word stands for; `None` if it is not given.
    fn choice<T: Copy>(
        &self,
        name: &'static str,
        choices: &[(&'static str, T)],
    ) -> Result<Option<T>, SelectorError> {
        let Some(value) = self.get(name) else { return Ok(None) };
        let chosen = choices.iter().find(|(word, _)| *word == value);
        chosen.map(|&(_, choice)| Some(choice)).ok_or_else(|| SelectorError::NoChoice {
            name,
            value: excerpt(value),
            allowed: choices.iter().map(|&(word, _)| word).collect(),
        })
    }

    fn message_format(&self) -> Result<MessageFormat, SelectorError> {
        let choices = [("json", MessageFormat::Json), ("cdr", MessageFormat::Cdr)];
        Ok(self.choice("format", &choices)?.unwrap_or(MessageFormat::Json))
    }

    /// All parts of a pose, or none.
    fn pose(&self) -> Result<Option<Pose2>, SelectorError> {
        if self.0.is_empty() {
            return Ok(None);
        }
        let part = |name| self.get(name).ok_or(SelectorError::PartOfPose(name));
        let (x, y, yaw) = (part("x")?, part("y")?, part("yaw")?);
        let metres = |name, value| {
            number(name, value, FURTHEST, "a number of metres from -1000000 to 1000000")
        };
        let yaw = number("yaw", yaw, TAU, "a number of radians from -6.283 to 6.283")?;
        Ok(Some(Pose2::new(metres("x", x)?, metres("y", y)?, wrap_angle(yaw))))
    }
}

/// A number between `-most` and `most`; a degree taken for a radian is mostly beyond.
fn number(
    name: &'static str,
    value: &str,
    most: f64,
    allowed: &'static str,
) -> Result<f64, SelectorError> {
    let number = value.parse().ok().filter(|number: &f64| number.abs() <= most);
    number.ok_or_else(|| SelectorError::NoNumber { name, value: excerpt(value), allowed })
}

/// Seconds as decimal digits, to the nanosecond: a float would round today's date.
fn stamp(value: &str) -> Result<Stamp, SelectorError> {
    nanoseconds(value).map(Stamp).ok_or_else(|| SelectorError::NoNumber {
        name: "at",
        value: excerpt(value),
        allowed: "seconds with at most nine decimals, as in 1700000000.25",
    })
}

fn nanoseconds(value: &str) -> Option<i64> {
    let (sign, digits) = value.strip_prefix('-').map_or((1, value), |digits| (-1, digits));
    let (seconds, decimals) = digits.split_once('.').unwrap_or((digits, "0"));
    let is_number = |text: &str| !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
    if !is_number(seconds) || !is_number(decimals) || decimals.len() > NANOSECOND_DIGITS {
        return None;
    }
    let seconds: i64 = seconds.parse().ok()?;
    let decimals: i64 = format!("{decimals:0<NANOSECOND_DIGITS$}").parse().ok()?;
    seconds.checked_mul(1_000_000_000)?.checked_add(decimals)?.checked_mul(sign)
}

fn map_format(parameters: &Parameters<'_>) -> Result<MapFormat, SelectorError> {
    let columns = parameters.get("cols").map(columns).transpose()?;
    let choices = [
        ("cdr", MapFormat::Cdr),
        ("json", MapFormat::Json),
        ("png", MapFormat::Png),
        ("pgm", MapFormat::Pgm),
        ("yaml", MapFormat::Yaml),
        ("text", MapFormat::Text { columns: columns.unwrap_or(USUAL_COLUMNS) }),
    ];
    let format = parameters.choice("format", &choices)?.unwrap_or(MapFormat::Cdr);
    if columns.is_some() && !matches!(format, MapFormat::Text { .. }) {
        return Err(SelectorError::ColumnsWithoutText);
    }
    Ok(format)
}

fn columns(value: &str) -> Result<NonZeroUsize, SelectorError> {
    let columns = value.parse().ok().filter(|columns: &NonZeroUsize| columns.get() <= MOST_COLUMNS);
    columns.ok_or_else(|| SelectorError::NoNumber {
        name: "cols",
        value: excerpt(value),
        allowed: "a whole number from 1 to 1000",
    })
}

fn map_question(parameters: &Parameters<'_>) -> Result<Question, SelectorError> {
    let format = map_format(parameters)?;
    let window = parameters.get("bbox").map(window).transpose()?;
    let resolution = parameters.get("res").map(|value| {
        let number = value.parse().ok().filter(|metres: &f64| (1e-6..=1e6).contains(metres));
        let allowed = "metres a cell, as in 0.2";
        number.ok_or_else(|| SelectorError::NoNumber {
            name: "res",
            value: excerpt(value),
            allowed,
        })
    });
    let (resolution, layers) =
        (resolution.transpose()?, parameters.get("layers").map(layers).transpose()?);
    let form = match layers {
        Some(layers) if layers != [Layer::Occupancy] => {
            if parameters.get("format").is_some_and(|format| format != "json") {
                return Err(SelectorError::LayersAsMap);
            }
            RegionForm::Layers(layers)
        }
        None if window.is_none() && resolution.is_none() => return Ok(Question::Map(format)),
        _ => RegionForm::Map(format),
    };
    Ok(Question::Region(RegionQuestion { window, resolution, form }))
}

fn window(value: &str) -> Result<Window, SelectorError> {
    let corners: Option<Vec<f64>> = value.split(',').map(|number| number.parse().ok()).collect();
    let corners = corners.filter(|all| all.iter().all(|metres| metres.abs() <= FURTHEST));
    let Some([x0, y0, x1, y1]) = corners.and_then(|all| <[f64; 4]>::try_from(all).ok()) else {
        let allowed = "x0,y0,x1,y1 in metres from -1000000 to 1000000";
        return Err(SelectorError::NoNumber { name: "bbox", value: excerpt(value), allowed });
    };
    if x0 >= x1 || y0 >= y1 {
        return Err(SelectorError::NoArea(excerpt(value)));
    }
    Ok(Window { low: Point2::new(x0, y0), high: Point2::new(x1, y1) })
}

fn layers(value: &str) -> Result<Vec<Layer>, SelectorError> {
    let mut found = Vec::new();
    for name in value.split(',') {
        let known = Layer::ALL;
        let layer = known.into_iter().find(|layer| layer.name() == name);
        let layer = layer.filter(|layer| !found.contains(layer));
        found.push(layer.ok_or_else(|| SelectorError::NoLayer(excerpt(name)))?);
    }
    Ok(found)
}

/// Those after a version, or those that are named.
fn tiles_question(parameters: &Parameters<'_>) -> Result<TilesQuestion, SelectorError> {
    let number =
        |name, value, allowed| SelectorError::NoNumber { name, value: excerpt(value), allowed };
    if let Some(value) = parameters.get("want") {
        if let Some(other) = ["since", "run"].into_iter().find(|n| parameters.get(n).is_some()) {
            return Err(SelectorError::WantBeside(other));
        }
        let error = number("want", value, WANTED);
        return tile_names(value).map(TilesQuestion::Want).ok_or(error);
    }
    let since = parameters.get("since").map(|value| {
        let version = value.parse().ok();
        version.ok_or_else(|| number("since", value, "the number of a version, 0 for all"))
    });
    let run = parameters.get("run").map(|value| {
        let hexadecimal = value.len() <= 16 && value.bytes().all(|b| b.is_ascii_hexdigit());
        let run = u64::from_str_radix(value, 16).ok().filter(|_| hexadecimal);
        run.ok_or_else(|| number("run", value, "at most 16 hexadecimal digits"))
    });
    Ok(TilesQuestion::Since { version: since.transpose()?.unwrap_or(0), run: run.transpose()? })
}

fn tile_names(value: &str) -> Option<Vec<TileIndex>> {
    if value == "none" {
        return Some(Vec::new());
    }
    let named = value.split(',').map(|name| {
        let (tx, ty) = name.split_once(':')?;
        Some(TileIndex { ty: ty.parse().ok()?, tx: tx.parse().ok()? })
    });
    named.collect::<Option<Vec<_>>>().filter(|named| named.len() <= MOST_WANTED)
}

fn path_format(parameters: &Parameters<'_>) -> Result<PathFormat, SelectorError> {
    let choices = [
        ("json", PathFormat::Message(MessageFormat::Json)),
        ("cdr", PathFormat::Message(MessageFormat::Cdr)),
        ("tum", PathFormat::Tum),
    ];
    Ok(parameters.choice("format", &choices)?.unwrap_or(choices[0].1))
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use proptest::prelude::{
        Just, Strategy as _, any, prop_assert, prop_assert_eq, prop_oneof, proptest,
    };
    use proptest::sample::select;

    use super::*;

    fn error(topic: Topic, parameters: &str) -> String {
        topic.question(parameters).unwrap_err().to_string()
    }

    fn text(columns: usize) -> MapFormat {
        MapFormat::Text { columns: NonZeroUsize::new(columns).unwrap() }
    }

    #[test]
    fn without_parameters_each_topic_has_its_usual_form() {
        let json = MessageFormat::Json;
        let asked = |topic: Topic| topic.question("");
        assert_eq!(asked(Topic::Map), Ok(Question::Map(MapFormat::Cdr)));
        assert_eq!(asked(Topic::DynamicMap), Ok(Question::DynamicMap));
        assert_eq!(asked(Topic::MapMetadata), Ok(Question::MapMetadata(json)));
        assert_eq!(asked(Topic::Pose), Ok(Question::Pose { at: None, format: json }));
        assert_eq!(asked(Topic::Path), Ok(Question::Path(PathFormat::Message(json))));
        assert_eq!(asked(Topic::ParticleCloud), Ok(Question::ParticleCloud(json)));
        assert_eq!(asked(Topic::Entropy), Ok(Question::Entropy(json)));
        let all = TilesQuestion::Since { version: 0, run: None };
        assert_eq!(asked(Topic::Tiles), Ok(Question::Tiles(all)));
        assert_eq!(asked(Topic::Status), Ok(Question::Status));
        assert_eq!(asked(Topic::Reset), Ok(Question::Reset(None)));
        assert_eq!(asked(Topic::Pause), Ok(Question::Pause));
        assert_eq!(asked(Topic::Checkpoint), Ok(Question::Checkpoint));
        assert_eq!(asked(Topic::Resume), Ok(Question::Resume));
        assert_eq!(asked(Topic::InitialPose), Err(SelectorError::NoPose));
        assert_eq!(asked(Topic::Save), Ok(Question::Save(SaveName::default())));
    }

    #[test]
    fn formats_are_words() {
        let formats = [
            ("cdr", MapFormat::Cdr),
            ("json", MapFormat::Json),
            ("png", MapFormat::Png),
            ("pgm", MapFormat::Pgm),
            ("yaml", MapFormat::Yaml),
            ("text", text(80)),
            ("text;cols=100", text(100)),
        ];
        for (words, format) in formats {
            let asked = Topic::Map.question(&format!("format={words}"));
            assert_eq!(asked, Ok(Question::Map(format)), "{words}");
        }
        assert_eq!(
            Topic::Map.question("cols=12;format=text"),
            Ok(Question::Map(text(12))),
            "the order does not matter"
        );
        assert_eq!(Topic::Path.question("format=tum"), Ok(Question::Path(PathFormat::Tum)));
        assert_eq!(
            Topic::Entropy.question("format=cdr"),
            Ok(Question::Entropy(MessageFormat::Cdr))
        );
    }

    #[test]
    fn errors_name_the_part_and_list_what_is_allowed() {
        assert_eq!(
            error(Topic::Map, "fromat=png"),
            "there is no parameter \"fromat\" here; allowed are format, cols, bbox, res, layers"
        );
        assert_eq!(
            error(Topic::Map, "format=pgn"),
            "format=\"pgn\" is not known; allowed are cdr, json, png, pgm, yaml, text"
        );
        assert_eq!(
            error(Topic::Map, "format"),
            "format=\"\" is not known; allowed are cdr, json, png, pgm, yaml, text"
        );
        assert_eq!(
            error(Topic::Map, "format=text;cols=0"),
            "cols=\"0\" is not allowed; it must be a whole number from 1 to 1000"
        );
        assert_eq!(
            error(Topic::Map, "format=png;cols=9"),
            "cols is only for format=text; leave it out, or ask for format=text"
        );
        assert_eq!(
            error(Topic::Map, "format=png;format=pgm"),
            "the parameter format is given twice; give it once"
        );
        assert_eq!(
            error(Topic::Status, "format=cdr"),
            "format=\"cdr\" is not known; allowed are json"
        );
        assert_eq!(
            error(Topic::Pause, "now"),
            "there is no parameter \"now\" here; none is allowed"
        );
        assert_eq!(
            error(Topic::Reset, "x=1;yaw=0"),
            "y is missing: a pose needs x and y in metres and yaw in radians"
        );
        assert_eq!(
            error(Topic::InitialPose, "x=1;y=2;yaw=90"),
            "yaw=\"90\" is not allowed; it must be a number of radians from -6.283 to 6.283"
        );
    }

    #[test]
    fn a_region_has_corners_cells_and_layers() {
        let asked = |parameters: &str| match Topic::Map.question(parameters) {
            Ok(Question::Region(question)) => Ok(question),
            Ok(other) => panic!("{other:?}"),
            Err(error) => Err(error.to_string()),
        };
        let window = Window { low: Point2::new(-1.0, 0.5), high: Point2::new(2.0, 3e1) };
        let map = |format| RegionForm::Map(format);
        let region = |window, resolution, form| Ok(RegionQuestion { window, resolution, form });
        let box_only = region(Some(window), None, map(MapFormat::Cdr));
        assert_eq!(asked("bbox=-1,0.5,2,3e1"), box_only);
        assert_eq!(asked("bbox=-1,0.5,2,30;layers=occupancy"), box_only);
        assert_eq!(asked("res=0.2;format=png"), region(None, Some(0.2), map(MapFormat::Png)));
        let layers = RegionForm::Layers(vec![Layer::Hits, Layer::Occupancy]);
        assert_eq!(asked("layers=hits,occupancy"), region(None, None, layers.clone()));
        assert_eq!(asked("format=json;layers=hits,occupancy"), region(None, None, layers));
        for (parameters, begins) in [
            ("bbox=1,0,0,1", "bbox=\"1,0,0,1\" is inverted or empty"),
            ("bbox=0,0,0,1", "bbox=\"0,0,0,1\" is inverted or empty"),
            ("bbox=0,0,1", "bbox=\"0,0,1\" is not allowed; it must be x0,y0,x1,y1"),
            ("bbox=0,0,1,nan", "bbox=\"0,0,1,nan\" is not allowed"),
            ("bbox=0,0,1e7,1", "bbox=\"0,0,1e7,1\" is not allowed"),
            ("res=0", "res=\"0\" is not allowed; it must be metres a cell"),
            ("res=-1", "res=\"-1\" is not allowed"),
            (
                "layers=age",
                "there is no layer \"age\"; allowed are occupancy, hits, visits, last_seen",
            ),
            (
                "layers=hits,hits",
                "there is no layer \"hits\"; allowed are occupancy, hits, visits, last_seen",
            ),
            ("layers=", "there is no layer \"\""),
            ("layers=hits;format=png", "format goes with layers=occupancy alone"),
        ] {
            let error = asked(parameters).unwrap_err();
            assert!(error.starts_with(begins), "{parameters}: {error}");
        }
    }

    #[test]
    fn tiles_are_asked_for_by_version_or_by_name() {
        let asked = |parameters: &str| match Topic::Tiles.question(parameters) {
            Ok(Question::Tiles(question)) => Ok(question),
            Ok(other) => panic!("{other:?}"),
            Err(error) => Err(error.to_string()),
        };
        let since = |version, run| Ok(TilesQuestion::Since { version, run });
        assert_eq!(asked("since=12"), since(12, None));
        assert_eq!(asked("since=12;run=00ff"), since(12, Some(255)));
        assert_eq!(asked("want=none"), Ok(TilesQuestion::Want(Vec::new())));
        let named = vec![TileIndex { ty: -1, tx: 0 }, TileIndex { ty: 3, tx: 2 }];
        assert_eq!(asked("want=0:-1,2:3"), Ok(TilesQuestion::Want(named)));
        assert_eq!(
            asked("want=none;since=3").unwrap_err(),
            "since does not go with want: tiles are asked for by version or by name"
        );
        assert_eq!(
            asked("since=-1").unwrap_err(),
            "since=\"-1\" is not allowed; it must be the number of a version, 0 for all"
        );
        assert_eq!(
            asked("want=1").unwrap_err(),
            "want=\"1\" is not allowed; it must be none, or at most 1000 tiles as COLUMN:ROW \
             with commas between, as in 0:-1,2:3"
        );
        for nonsense in ["run=xyz", "run=+1", "run=", "run=00000000000000001", "want=", "want=1:2,"]
        {
            assert!(asked(nonsense).is_err(), "{nonsense}");
        }
        assert!(asked(&format!("want={}", "1:1,".repeat(1001).trim_end_matches(','))).is_err());
    }

    #[test]
    fn zenohs_own_parameters_are_passed_over() {
        let asked = Topic::Map.question("_anyke;_time=[now(-1s)..];format=png;");
        assert_eq!(asked, Ok(Question::Map(MapFormat::Png)));
    }

    #[test]
    fn the_service_of_slam_gmapping_takes_whatever_comes() {
        assert_eq!(Topic::DynamicMap.question("x=1;x=1;;=;format"), Ok(Question::DynamicMap));
    }

    #[test]
    fn stamps_are_exact() {
        let at = |value: &str| match Topic::Pose.question(&format!("at={value}")) {
            Ok(Question::Pose { at, .. }) => at.map(|stamp| stamp.0),
            _ => None,
        };
        assert_eq!(at("1700000000.123456789"), Some(1_700_000_000_123_456_789));
        assert_eq!(at("12"), Some(12_000_000_000));
        assert_eq!(at("12.5"), Some(12_500_000_000));
        assert_eq!(at("-0.000000001"), Some(-1));
        for nonsense in ["", ".", "-", "1.", ".5", "1e9", "+1", "0.1234567891", "9223372037", "١"]
        {
            assert_eq!(at(nonsense), None, "{nonsense}");
        }
        assert_eq!(
            error(Topic::Pose, "at=noon"),
            "at=\"noon\" is not allowed; \
             it must be seconds with at most nine decimals, as in 1700000000.25"
        );
    }

    #[test]
    fn poses_are_finite_and_their_headings_wrapped() {
        let asked = Topic::InitialPose.question("x=1.5;y=-2e1;yaw=3.5");
        let Ok(Question::InitialPose(pose)) = asked else { panic!("{asked:?}") };
        assert_eq!((pose.x, pose.y), (1.5, -20.0));
        assert!((pose.theta - (3.5 - TAU)).abs() < 1e-12 && pose.theta > -PI);
        for nonsense in ["nan", "inf", "1e400", "1e7", "", "one"] {
            let asked = Topic::Reset.question(&format!("x={nonsense};y=0;yaw=0"));
            let named = format!("x={nonsense:?}");
            assert!(asked.unwrap_err().to_string().starts_with(&named), "{nonsense}");
        }
    }

    #[test]
    fn an_error_does_not_grow_with_the_query() {
        let long = "é".repeat(100_000);
        assert!(error(Topic::Map, &long).len() < 300);
        assert!(error(Topic::Map, &format!("format={long}")).len() < 300);
        assert!(error(Topic::Save, &format!("name={long}")).len() < 300);
    }

    proptest! {
        /// Whatever is asked, the answer is a question or an error with the offending part.
        #[test]
        fn no_query_is_a_disaster(
            topic in select(Topic::ALL.to_vec()),
            name in prop_oneof![
                select(vec!["format", "cols", "at", "x", "y", "yaw", "name"]).prop_map(str::to_owned),
                "[^_].{0,80}",
            ],
            value in prop_oneof![any::<String>(), Just("png".to_owned()), Just("1".to_owned())],
        ) {
            use SelectorError as Error;
            let text = format!("{name}={value}");
            let told = match topic.question(&text) {
                Err(Error::Unknown { name, .. }) => name,
                Err(Error::NoChoice { value, .. } | Error::NoNumber { value, .. }) => value,
                Err(Error::Name(error)) => error.given,
                Err(Error::PartOfPose(part)) => {
                    let given = format!("{part}=");
                    prop_assert!(!text.starts_with(&given));
                    return Ok(());
                }
                Err(error) => {
                    prop_assert!(!error.to_string().is_empty());
                    return Ok(());
                }
                Ok(_) => return Ok(()),
            };
            prop_assert!(text.contains(told.trim_end_matches('…')), "{told:?} is not in {text:?}");
        }

        #[test]
        fn every_string_is_taken(topic in select(Topic::ALL.to_vec()), text in any::<String>()) {
            if let Err(error) = topic.question(&text) {
                prop_assert!(error.to_string().len() < 600);
            }
        }

        #[test]
        fn every_stamp_reads_back(stamp in any::<i64>()) {
            let sign = if stamp < 0 { "-" } else { "" };
            let nanoseconds = stamp.unsigned_abs();
            let (seconds, rest) = (nanoseconds / 1_000_000_000, nanoseconds % 1_000_000_000);
            let asked = Topic::Pose.question(&format!("at={sign}{seconds}.{rest:09}"));
            if stamp == i64::MIN {
                prop_assert!(asked.is_err());
            } else {
                let format = MessageFormat::Json;
                prop_assert_eq!(asked, Ok(Question::Pose { at: Some(Stamp(stamp)), format }));
            }
        }
    }
}
