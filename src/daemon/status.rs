//! What `slam/status` tells: the one answer to "why does my map not grow?".

use std::collections::BTreeMap;

use serde::Serialize;

use super::ledger::Verdict;
use super::snapshot::State;
use crate::slam::pose::Pose2;
use crate::statistics::Spread;

/// How the daemon is, at the moment of asking.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Status {
    /// Of gmapd.
    pub version: &'static str,
    /// Seconds since the daemon started.
    pub uptime_s: f64,
    /// In one word.
    pub state: State,
    /// In a sentence, with what to do where something is wrong.
    pub detail: String,
    /// The pose of the base in `map`.
    pub pose_in_map: Pose2,
    /// Scans by verdict; all verdicts are there.
    pub scans: BTreeMap<Verdict, u64>,
    /// The last detail of each verdict that had one.
    pub last_details: BTreeMap<Verdict, String>,
    /// What arrived.
    pub inputs: BTreeMap<&'static str, InputStatus>,
    /// Milliseconds that the last processed scans took; `null` before the first.
    pub milliseconds_per_scan: Option<Spread>,
    /// Seconds of driving mapped in a second of work; `null` before there is something to tell.
    pub real_time_factor: Option<f64>,
    /// Scans that wait for odometry or for the filter.
    pub scans_waiting: usize,
    /// About the hypotheses.
    pub filter: FilterStatus,
    /// The map that is handed out; `null` before the first.
    pub map: Option<MapStatus>,
    /// The most memory the process has had resident, bytes.
    pub peak_memory_bytes: Option<u64>,
    /// Seed of the random numbers.
    pub seed: u64,
}

/// About one input: `scan`, `odom`, `tf` or `tf_static`.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct InputStatus {
    /// The key it is subscribed to.
    pub key: String,
    /// Samples that came.
    pub received: u64,
    /// Samples whose bytes were not what was expected.
    pub rejected: u64,
    /// Samples dropped because they came faster than they could be decoded.
    pub dropped: u64,
    /// What was wrong with the last that was rejected.
    pub last_rejection: Option<String>,
    /// Seconds since the last came; `null` when none has.
    pub age_s: Option<f64>,
    /// Messages with the stamp of an earlier one.
    pub duplicates: u64,
    /// Messages that came after a newer one.
    pub reordered: u64,
    /// Times the sender's clock was set back.
    pub clock_restarts: u64,
}

/// About the particles.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct FilterStatus {
    /// How many there are.
    pub particles: usize,
    /// 1 / Σ wᵢ² at the last processed scan.
    pub effective_sample_size: Option<f64>,
    /// How often particles were drawn anew.
    pub resamples: u64,
    /// Odometry steps that were too long to be believed.
    pub odometry_jumps: u64,
}

/// About the map.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct MapStatus {
    /// Grows with every change.
    pub version: u64,
    /// Cells a row of the map cropped to what is known.
    pub width: usize,
    /// Its rows.
    pub height: usize,
    /// Metres a cell.
    pub resolution: f64,
    /// Free and occupied area, m².
    pub known_area_m2: f64,
    /// Processed scans in it.
    pub scans: usize,
}
