//! The configuration: one YAML file, `--set key=value` on top, checked before anything runs.
//!
//! A parameter file of slam_gmapping loads as it is, flat or nested as ROS 1 and ROS 2 write it.
//! Errors name the file and line (or `--set`), the key, the value and what is allowed.

mod check;
mod raw;
mod source;

use std::fmt;
use std::path::{Path, PathBuf};

use thiserror::Error;

pub use raw::{
    EngineKind, Interop, Jump, Keys, Laser, MapOf, Matcher, OdometrySource, RawConfig, RosDistro,
    Smoothing,
};
pub use source::Origin;

use crate::slam::engine::EngineParameters;
use crate::slam::gmapping::{
    MapParameters, MatcherKind, MatcherParameters, Parameters, WeightSmoothing, Weighting,
};
use crate::slam::known_poses::{self, MapExtent};
use crate::slam::motion_gate::MotionGate;
use crate::slam::odometry::{JumpGuard, JumpPolicy, MotionNoise};
use crate::slam::outline::BeamLimits;
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
            source::add_override(&mut entries, text)?;
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
                furthest: known_poses::FURTHEST_CELL * raw.resolution,
            },
            extent: match raw.map_of {
                MapOf::AllScans => MapExtent::AllScans,
                MapOf::NewestScan => MapExtent::NewestScan,
            },
            occupied_threshold: raw.occupied_threshold,
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
            initial_pose: raw.initial_pose.map(|[x, y, yaw]| Pose2::new(x, y, yaw)),
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
                occupied_threshold: raw.occupied_threshold,
                free_on_no_return: raw.free_on_no_return,
            },
        }
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
        if raw::DEAD_KEYS.contains(&key) {
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
            Self::Foreign { key } => {
                write!(formatter, "{key} has no effect: it is not a parameter of the filter")
            }
            Self::OtherNode { name } => {
                write!(
                    formatter,
                    "{name} is passed over: it is not among slam_gmapping's parameters"
                )
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
