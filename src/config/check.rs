//! From keys and values to a [`RawConfig`] whose every value is allowed.

use std::fmt;

use serde_json::{Map, Value};

use super::ConfigError;
use super::raw::{EngineKind, InitialPose, OdometrySource, RawConfig};
use super::source::{Entries, Origin};
use crate::slam::known_map::Mode;

/// A name this similar to an unknown one is suggested (Jaro-Winkler, 1 is equal).
const SIMILAR: f64 = 0.75;

/// Beyond, one message could take all memory of a small computer.
const MOST_BYTES: f64 = 1e9;

/// The configuration of all entries over the defaults.
pub(super) fn resolve(entries: &Entries) -> Result<RawConfig, ConfigError> {
    check_keys(entries)?;
    let mut object = Map::new();
    for (key, entry) in entries {
        if entry.value.is_null() {
            return Err(wrong_kind(entries, key, "leave the key out for its default"));
        }
        object.insert(key.clone(), entry.value.clone());
    }
    let raw: RawConfig = serde_path_to_error::deserialize(Value::Object(object))
        .map_err(|error| at_key(entries, &error))?;
    for (key, value, allowed) in limits(&raw) {
        if !allowed.contains(value) {
            return Err(out_of_range(entries, key, value.to_string(), allowed.to_string()));
        }
    }
    check_together(entries, &raw)?;
    Ok(raw)
}

/// Values that are allowed alone, and not together.
fn check_together(entries: &Entries, raw: &RawConfig) -> Result<(), ConfigError> {
    if raw.engine == EngineKind::Gmapping && raw.odometry_source == OdometrySource::None {
        let key = "odometry_source";
        return Err(wrong_kind(entries, key, "GMapping cannot do without odometry; Hector can"));
    }
    if raw.laser_max_dist <= raw.laser_min_dist {
        let (key, value) = ("laser_max_dist", raw.laser_max_dist.to_string());
        let allowed = format!("more than laser_min_dist, which is {}", raw.laser_min_dist);
        return Err(out_of_range(entries, key, value, allowed));
    }
    check_start(entries, raw)
}

/// What a map to start from is needed for, and who takes none.
fn check_start(entries: &Entries, raw: &RawConfig) -> Result<(), ConfigError> {
    let localizes = raw.mode == Mode::Localization;
    let searches = matches!(raw.initial_pose, Some(InitialPose::Search(_)));
    let (key, reason) = match (raw.engine, &raw.map) {
        (EngineKind::KnownPoses, Some(_)) => ("map", "known_poses starts from no map"),
        (EngineKind::KnownPoses, None) if localizes => ("mode", "to known_poses, poses are given"),
        (EngineKind::KnownPoses, None) if searches => {
            ("initial_pose", "to known_poses, poses are given")
        }
        (_, None) if localizes && raw.state_directory.is_none() => {
            ("mode", "a map to localize in is needed: --map, or map, or --state of a run before")
        }
        (_, None) if searches && raw.state_directory.is_none() => {
            let reason = "a map to search is needed: --map, or map, or --state of a run before";
            ("initial_pose", reason)
        }
        _ => return Ok(()),
    };
    Err(wrong_kind(entries, key, reason))
}

fn check_keys(entries: &Entries) -> Result<(), ConfigError> {
    let known = known_keys();
    for (key, entry) in entries {
        if !known.contains(key) {
            return Err(ConfigError::UnknownKey {
                origin: entry.origin.clone(),
                key: key.clone(),
                suggestion: nearest(key, &known),
            });
        }
    }
    Ok(())
}

/// The struct itself says which keys there are.
pub(super) fn known_keys() -> Vec<String> {
    match serde_json::to_value(RawConfig::default()) {
        Ok(Value::Object(object)) => object.into_iter().map(|(key, _)| key).collect(),
        _ => Vec::new(),
    }
}

fn nearest(key: &str, known: &[String]) -> Option<String> {
    let similarity = |other: &str| strsim::jaro_winkler(&key.to_lowercase(), &other.to_lowercase());
    known
        .iter()
        .map(|other| (similarity(other), other))
        .filter(|&(similarity, _)| similarity >= SIMILAR)
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, other)| other.clone())
}

fn at_key(entries: &Entries, error: &serde_path_to_error::Error<serde_json::Error>) -> ConfigError {
    let path = error.path().to_string();
    let key = path.split(['.', '[']).next().unwrap_or_default();
    wrong_kind(entries, key, &what_is_needed(&error.inner().to_string()))
}

/// Serde names Rust's types; a parameter file has other words for them.
fn what_is_needed(message: &str) -> String {
    let expected =
        message.strip_prefix("invalid type: ").or(message.strip_prefix("invalid value: "));
    let needed = match expected.and_then(|rest| rest.rsplit_once("expected ")) {
        Some((_, "usize" | "u32" | "u64")) => "a whole number of at least 0",
        Some((_, "f64")) => "a number",
        Some((_, "a string")) => "text",
        Some((_, "a boolean")) => "true or false",
        Some((_, other)) => other,
        None => return message.to_owned(),
    };
    format!("{needed} is needed")
}

fn wrong_kind(entries: &Entries, key: &str, reason: &str) -> ConfigError {
    ConfigError::WrongKind {
        origin: origin(entries, key),
        key: key.to_owned(),
        value: entries.get(key).map_or_else(String::new, |entry| entry.value.to_string()),
        reason: reason.to_owned(),
    }
}

fn out_of_range(entries: &Entries, key: &str, value: String, allowed: String) -> ConfigError {
    ConfigError::OutOfRange { origin: origin(entries, key), key: key.to_owned(), value, allowed }
}

/// A default is never out of range, so every key that is has an entry.
fn origin(entries: &Entries, key: &str) -> Origin {
    entries.get(key).map_or(Origin::Override, |entry| entry.origin.clone())
}

/// The values a number may have.
#[derive(Debug, Clone, Copy)]
enum Allowed {
    Finite,
    Positive,
    AtLeast(f64),
    Between(f64, f64),
}

impl Allowed {
    fn contains(self, value: f64) -> bool {
        value.is_finite()
            && match self {
                Self::Finite => true,
                Self::Positive => value > 0.0,
                Self::AtLeast(low) => value >= low,
                Self::Between(low, high) => value >= low && value <= high,
            }
    }
}

impl fmt::Display for Allowed {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Finite => formatter.write_str("a finite number"),
            Self::Positive => formatter.write_str("a finite number above 0"),
            Self::AtLeast(low) => write!(formatter, "a finite number of at least {low}"),
            Self::Between(low, high) => write!(formatter, "a number from {low} to {high}"),
        }
    }
}

/// Every number with what it may be; those left out by choice are not among them.
fn limits(raw: &RawConfig) -> Vec<(&'static str, f64, Allowed)> {
    use Allowed::{AtLeast, Between, Finite, Positive};
    let mut limits = vec![
        ("particles", raw.particles as f64, Between(1.0, 100_000.0)),
        ("throttle_scans", raw.throttle_scans as f64, AtLeast(1.0)),
        ("map_update_interval", raw.map_update_interval, AtLeast(0.0)),
        ("transform_publish_period", raw.transform_publish_period, AtLeast(0.0)),
        ("srr", raw.translation_noise_from_translation, AtLeast(0.0)),
        ("srt", raw.rotation_noise_from_translation, AtLeast(0.0)),
        ("str", raw.translation_noise_from_rotation, AtLeast(0.0)),
        ("stt", raw.rotation_noise_from_rotation, AtLeast(0.0)),
        ("linearUpdate", raw.linear_update, AtLeast(0.0)),
        ("angularUpdate", raw.angular_update, AtLeast(0.0)),
        ("temporalUpdate", raw.temporal_update, Finite),
        ("lstep", raw.linear_step, Positive),
        ("astep", raw.angular_step, Positive),
        ("minimumScore", raw.minimum_score, Finite),
        ("field_sigma_m", raw.field_sigma_m, Positive),
        ("sigma", raw.sigma, Positive),
        ("kernelSize", f64::from(raw.kernel_size), Between(0.0, 100.0)),
        ("lsigma", raw.likelihood_sigma, Positive),
        ("iterations", f64::from(raw.iterations), Between(0.0, 30.0)),
        ("ogain", raw.gain, Positive),
        ("resampleThreshold", raw.resample_threshold, Between(0.0, 1.0)),
        ("jump_max_step_m", raw.jump_max_step_m, Positive),
        ("delta", raw.resolution, Between(0.001, 10.0)),
        ("map_resolution", raw.map_resolution, Between(0.001, 10.0)),
        ("map_multi_res_levels", raw.map_multi_res_levels as f64, Between(1.0, 10.0)),
        ("update_factor_free", raw.update_factor_free, Between(0.001, 0.499)),
        ("update_factor_occupied", raw.update_factor_occupied, Between(0.501, 0.999)),
        ("map_update_distance_thresh", raw.map_update_distance_thresh, AtLeast(0.0)),
        ("map_update_angle_thresh", raw.map_update_angle_thresh, AtLeast(0.0)),
        ("laser_min_dist", raw.laser_min_dist, AtLeast(0.0)),
        ("laser_max_dist", raw.laser_max_dist, Positive),
        ("occ_thresh", raw.occupied_threshold, Between(0.0, 1.0)),
        ("odometry_timeout_s", raw.odometry_timeout_s, Between(0.01, 5.0)),
        ("scan_queue", raw.scan_queue as f64, Between(1.0, 1000.0)),
        ("commands_per_second", f64::from(raw.commands_per_second), Between(1.0, 1000.0)),
        ("queries_at_once", raw.queries_at_once as f64, Between(1.0, 1000.0)),
        ("max_message_bytes", raw.max_message_bytes as f64, Between(1024.0, MOST_BYTES)),
        ("max_reply_bytes", raw.max_reply_bytes as f64, Between(65536.0, MOST_BYTES)),
        ("max_bytes_in_flight", raw.max_bytes_in_flight as f64, Between(65536.0, MOST_BYTES)),
        ("checkpoint", raw.checkpoint.every_s, Between(0.1, 86_400.0)),
        ("checkpoint", raw.checkpoint.every_scans as f64, AtLeast(1.0)),
        ("checkpoint", raw.checkpoint.keep as f64, Between(1.0, 1000.0)),
        ("ros_domain_id", f64::from(raw.ros_domain_id), Between(0.0, 232.0)),
    ];
    let optional = [
        ("maxRange", raw.max_range, Positive),
        ("maxUrange", raw.max_usable_range, Positive),
        ("tf_delay", raw.tf_delay, Finite),
        ("occ_min_visits", raw.occupied_min_visits.map(f64::from), Between(1.0, 1000.0)),
        ("sweep_time_s", raw.sweep_time_s, Between(0.0, 1.0)),
    ];
    limits.extend(optional.into_iter().filter_map(|(key, value, of)| Some((key, value?, of))));
    let pose = raw.initial_pose.and_then(InitialPose::numbers);
    let poses = pose.into_iter().flatten().map(|value| ("initial_pose", value, Finite));
    limits.extend(poses);
    let laser = raw.laser.into_iter().flat_map(|laser| [laser.x, laser.y, laser.yaw]);
    limits.extend(laser.map(|value| ("laser", value, Finite)));
    limits
}
