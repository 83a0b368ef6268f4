//! The configuration: one YAML file, `--set key=value` on top, checked before anything runs.
//!
//! A parameter file of slam_gmapping loads as it is, flat or nested as ROS 1 and ROS 2 write it.
//! Errors name the file and line (or `--set`), the key, the value and what is allowed.

mod check;
mod raw;
mod source;

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

use serde_json::Value;
use thiserror::Error;

pub use raw::{
    Checkpoint, CommandName, EngineKind, InitialPose, Interop, Jump, Keys, Laser, MapOf, Matcher,
    OdometrySource, RawConfig, RosDistro, Search, Smoothing,
};
pub use source::Origin;

use crate::slam::engine::EngineParameters;
use crate::slam::gmapping::{
    MapParameters, MatcherKind, MatcherParameters, Parameters, WeightSmoothing, Weighting,
};
use crate::slam::grid::occupancy::OccupiedThreshold;
use crate::slam::hector;
use crate::slam::known_poses::{self, MapExtent};
use crate::slam::motion_gate::MotionGate;
use crate::slam::odometry::{JumpGuard, JumpPolicy, MotionNoise};
use crate::slam::outline::{BeamLimits, FURTHEST_CELL};
use crate::slam::pose::Pose2;
use crate::slam::scan::{LaserMount, MountOrientation};
use source::Entries;

/// A configuration that has been checked.
#[derive(Debug, Clone, PartialEq)]
pub struct Config {
    /// Every key with the value that holds.
    pub raw: RawConfig,
    /// What an operator should know about the file.
    pub warnings: Vec<ConfigWarning>,
}

impl Config {
    /// Loads a file, if one is given, and puts overrides of the form `key=value` on top.
    ///
    /// # Errors
    /// When the file cannot be read, or a key or a value is not one that is allowed.
    pub fn load(path: Option<&Path>, overrides: &[String]) -> Result<Self, ConfigError> {
        let mut entries = Entries::new();
        let mut warnings = Vec::new();
        if let Some(path) = path {
            let text = std::fs::read_to_string(path)
                .map_err(|source| ConfigError::Read { path: path.to_owned(), source })?;
            source::add_file(&mut entries, &mut warnings, path, &text)?;
        }
        for text in overrides {
            source::add_override(&mut entries, &mut warnings, text)?;
        }
        let raw = check::resolve(&entries)?;
        warnings.extend(warnings_about(&entries, &raw));
        Ok(Self { raw, warnings })
    }

    /// Which engine runs, and what it is told.
    #[must_use]
    pub fn engine_parameters(&self) -> EngineParameters {
        match self.raw.engine {
            EngineKind::Gmapping => EngineParameters::GMapping(self.parameters(), self.raw.seed),
            EngineKind::Hector => EngineParameters::Hector(self.hector_parameters()),
            EngineKind::KnownPoses => EngineParameters::KnownPoses(self.known_poses()),
        }
    }

    fn known_poses(&self) -> known_poses::Parameters {
        let raw = &self.raw;
        known_poses::Parameters {
            resolution: raw.resolution,
            limits: BeamLimits {
                max_range: raw.max_range,
                max_usable_range: raw.max_usable_range,
                free_on_no_return: raw.free_on_no_return,
                furthest: FURTHEST_CELL * raw.resolution,
            },
            extent: match raw.map_of {
                MapOf::AllScans => MapExtent::AllScans,
                MapOf::NewestScan => MapExtent::NewestScan,
            },
            occupied_threshold: occupied_threshold(raw),
        }
    }

    /// What Hector is told. Keys that it shares with GMapping mean the same to both.
    #[must_use]
    pub fn hector_parameters(&self) -> hector::Parameters {
        let raw = &self.raw;
        let Parameters { throttle_scans, initial_pose, motion_noise, jump, map, .. } =
            self.parameters();
        hector::Parameters {
            throttle_scans,
            resolution: raw.map_resolution,
            levels: raw.map_multi_res_levels,
            free_probability: raw.update_factor_free,
            occupied_probability: raw.update_factor_occupied,
            update_distance: raw.map_update_distance_thresh,
            update_angle: raw.map_update_angle_thresh,
            min_range: raw.laser_min_dist,
            max_range: raw.laser_max_dist,
            free_on_no_return: map.free_on_no_return,
            initial_pose,
            motion_noise,
            jump,
        }
    }

    /// What the particle filter is told.
    #[must_use]
    pub fn parameters(&self) -> Parameters {
        let raw = &self.raw;
        Parameters {
            particles: raw.particles,
            throttle_scans: raw.throttle_scans,
            resolution: raw.resolution,
            max_range: raw.max_range,
            max_usable_range: raw.max_usable_range,
            initial_pose: raw.initial_pose.and_then(InitialPose::pose),
            motion_noise: MotionNoise {
                translation_from_translation: raw.translation_noise_from_translation,
                translation_from_rotation: raw.translation_noise_from_rotation,
                rotation_from_translation: raw.rotation_noise_from_translation,
                rotation_from_rotation: raw.rotation_noise_from_rotation,
            },
            gate: MotionGate {
                linear_update: raw.linear_update,
                angular_update: raw.angular_update,
                temporal_update: Some(raw.temporal_update).filter(|&seconds| seconds >= 0.0),
            },
            jump: JumpGuard { max_step: raw.jump_max_step_m, policy: raw.jump_policy.into() },
            matcher: matcher_parameters(raw),
            weighting: Weighting {
                flatness: raw.gain,
                smoothing: raw.weight_smoothing.into(),
                resample_threshold: raw.resample_threshold,
            },
            map: MapParameters {
                occupied_threshold: occupied_threshold(raw),
                free_on_no_return: raw.free_on_no_return,
            },
        }
    }

    /// When a cell of the engine's map is occupied.
    #[must_use]
    pub fn occupied_threshold(&self) -> OccupiedThreshold {
        match self.raw.engine {
            EngineKind::Hector => hector::OCCUPIED_THRESHOLD,
            EngineKind::Gmapping | EngineKind::KnownPoses => occupied_threshold(&self.raw),
        }
    }

    /// The same for an engine that is given poses: what other engines have as odometry, `odom_frame`
    /// to `base_frame`, are then the transforms from `map_frame`, and poses may jump.
    ///
    /// Messages of odometry are poses in `map` only where `odometry_source: odom` says so.
    #[must_use]
    pub fn with_poses_as_odometry(&self) -> Self {
        let mut config = self.clone();
        if config.raw.engine == EngineKind::KnownPoses {
            config.raw.odom_frame.clone_from(&self.raw.map_frame);
            config.raw.jump_policy = Jump::Continue;
            if config.raw.odometry_source == OdometrySource::Auto {
                config.raw.odometry_source = OdometrySource::Tf;
            }
        }
        config
    }

    /// The keys that a state depends on, with their values: who goes on from it needs the same.
    #[must_use]
    pub fn settings_of_state(&self) -> BTreeMap<String, Value> {
        let Ok(Value::Object(keys)) = serde_json::to_value(&self.raw) else {
            return BTreeMap::new();
        };
        let without_effect = |key: &str| {
            raw::WITHOUT_EFFECT_ON_STATE.contains(&key)
                || raw::DEAD_KEYS.contains(&key)
                || raw::EXTENT_KEYS.contains(&key)
                || of_another_engine(key, self.raw.engine).is_some()
                || raw::COMPAT_KEYS.contains(&key) && self.raw.matcher == Matcher::Field
        };
        keys.into_iter().filter(|(key, _)| !without_effect(key)).collect()
    }

    /// Whether given poses come as messages on `keys: pose`, in place of odometry's.
    #[must_use]
    pub fn takes_pose_messages(&self) -> bool {
        let RawConfig { engine, odometry_source, .. } = &self.raw;
        *engine == EngineKind::KnownPoses && *odometry_source == OdometrySource::Auto
    }

    /// How the laser sits on the robot, where the configuration says so.
    #[must_use]
    pub fn laser_mount(&self) -> Option<LaserMount> {
        self.raw.laser.map(|laser| LaserMount {
            base_from_laser: Pose2::new(laser.x, laser.y, laser.yaw),
            orientation: if laser.upside_down {
                MountOrientation::UpsideDown
            } else {
                MountOrientation::Upright
            },
        })
    }
}

fn occupied_threshold(raw: &RawConfig) -> OccupiedThreshold {
    let many = raw.engine == EngineKind::KnownPoses && raw.map_of == MapOf::AllScans;
    let visits = raw.occupied_min_visits.unwrap_or(if many { 2 } else { 1 });
    OccupiedThreshold { share: raw.occupied_threshold, visits }
}

fn matcher_parameters(raw: &RawConfig) -> MatcherParameters {
    MatcherParameters {
        kind: raw.matcher.into(),
        linear_step: raw.linear_step,
        angular_step: raw.angular_step,
        iterations: raw.iterations,
        sigma: raw.sigma,
        kernel_size: raw.kernel_size,
        likelihood_sigma: raw.likelihood_sigma,
        beam_skip: raw.beam_skip,
        minimum_score: raw.minimum_score,
        field_sigma: raw.field_sigma_m,
    }
}

impl From<Matcher> for MatcherKind {
    fn from(matcher: Matcher) -> Self {
        match matcher {
            Matcher::Field => Self::Field,
            Matcher::Compat => Self::Compat,
        }
    }
}

impl From<Smoothing> for WeightSmoothing {
    fn from(smoothing: Smoothing) -> Self {
        match smoothing {
            Smoothing::Fixed => Self::Fixed,
            Smoothing::PerParticle => Self::PerParticle,
        }
    }
}

impl From<Jump> for JumpPolicy {
    fn from(jump: Jump) -> Self {
        match jump {
            Jump::Reject => Self::Reject,
            Jump::Continue => Self::Continue,
        }
    }
}

fn warnings_about(entries: &Entries, raw: &RawConfig) -> Vec<ConfigWarning> {
    let without_effect = |key: &str| {
        if let Some(warning) = of_another_engine(key, raw.engine) {
            Some(warning)
        } else if raw::DEAD_KEYS.contains(&key) {
            Some(ConfigWarning::NeverHadAnEffect { key: key.to_owned() })
        } else if raw::EXTENT_KEYS.contains(&key) {
            Some(ConfigWarning::MapGrows { key: key.to_owned() })
        } else if raw::COMPAT_KEYS.contains(&key) && raw.matcher == Matcher::Field {
            Some(ConfigWarning::CompatOnly { key: key.to_owned() })
        } else {
            None
        }
    };
    entries.keys().filter_map(|key| without_effect(key)).collect()
}

fn of_another_engine(key: &str, engine: EngineKind) -> Option<ConfigWarning> {
    let (of, instead) = match engine {
        EngineKind::Gmapping => (raw::HECTOR_ONLY.contains(&key).then_some("hector")?, None),
        EngineKind::Hector => {
            let (_, instead) = raw::GMAPPING_ONLY.iter().find(|(name, _)| *name == key)?;
            ("gmapping", Some(*instead))
        }
        EngineKind::KnownPoses => (raw::HECTOR_ONLY.contains(&key).then_some("hector")?, None),
    };
    Some(ConfigWarning::OtherEngine { key: key.to_owned(), of, instead })
}

/// What an operator should know about a configuration that is valid.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ConfigWarning {
    /// A parameter that slam_gmapping reads and never uses.
    NeverHadAnEffect {
        /// The key.
        key: String,
    },
    /// A parameter that sizes the original's first map.
    MapGrows {
        /// The key.
        key: String,
    },
    /// A parameter of the matcher that does not run.
    CompatOnly {
        /// The key.
        key: String,
    },
    /// A parameter of an engine that does not run.
    OtherEngine {
        /// The key.
        key: String,
        /// The engine that looks at it.
        of: &'static str,
        /// What the engine that runs has in its place.
        instead: Option<&'static str>,
    },
    /// A parameter of hector_mapping that means nothing here.
    Hectors {
        /// The key.
        key: String,
        /// What there is in its place.
        instead: &'static str,
    },
    /// A parameter of ROS, or of a slam_gmapping of long ago.
    Foreign {
        /// The key.
        key: String,
    },
    /// The parameters of another node, or a key beside those of a node.
    OtherNode {
        /// The key.
        name: String,
    },
}

impl fmt::Display for ConfigWarning {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NeverHadAnEffect { key } => {
                write!(formatter, "{key} never had an effect, not in slam_gmapping either")
            }
            Self::MapGrows { key } => {
                write!(formatter, "{key} has no effect: the map grows without limit")
            }
            Self::CompatOnly { key } => {
                write!(formatter, "{key} has an effect only with \"matcher: compat\"")
            }
            Self::OtherEngine { key, of, instead: None } => {
                write!(formatter, "{key} has an effect only with \"engine: {of}\"")
            }
            Self::OtherEngine { key, of, instead: Some(instead) } => {
                write!(
                    formatter,
                    "{key} has an effect only with \"engine: {of}\"; here it is {instead}"
                )
            }
            Self::Hectors { key, instead } => {
                write!(formatter, "{key} of hector_mapping has no effect: {instead}")
            }
            Self::Foreign { key } => {
                write!(formatter, "{key} has no effect: it is not a parameter of the filter")
            }
            Self::OtherNode { name } => {
                write!(formatter, "{name} is passed over: it is not among the engine's parameters")
            }
        }
    }
}

/// Why a configuration cannot be used.
#[derive(Debug, Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read the configuration {}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The text is not the YAML that is needed.
    #[error("{origin}: {reason}")]
    Syntax {
        /// Where.
        origin: Origin,
        /// What the parser says.
        reason: String,
    },
    /// A `--set` without `=`.
    #[error("--set {text}: a key and a value are needed, as in particles=100")]
    NotKeyValue {
        /// What was given.
        text: String,
    },
    /// There is no such key.
    #[error("{origin}: unknown key {key}{}", suggestion.as_ref().map_or_else(String::new, |near| format!(", did you mean {near}?")))]
    UnknownKey {
        /// Where.
        origin: Origin,
        /// The key.
        key: String,
        /// The nearest key that is known, if any is near.
        suggestion: Option<String>,
    },
    /// The value is of another kind than the key asks for.
    #[error("{origin}: {key} is {value}: {reason}")]
    WrongKind {
        /// Where.
        origin: Origin,
        /// The key.
        key: String,
        /// The value.
        value: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The value is outside what the key allows.
    #[error("{origin}: {key} is {value}; allowed is {allowed}")]
    OutOfRange {
        /// Where.
        origin: Origin,
        /// The key.
        key: String,
        /// The value.
        value: String,
        /// What is allowed.
        allowed: String,
    },
}

#[cfg(test)]
mod tests;
