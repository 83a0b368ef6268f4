//! What the filter knows, for all who ask: immutable, shared, and replaced as a whole.

use std::sync::Arc;

use nalgebra::Matrix3;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::ledger::Ledger;
use crate::slam::grid::occupancy::{OccupancyMap, OccupiedThreshold};
use crate::slam::known_map::Mode;
use crate::slam::path::Path;
use crate::slam::pose::{Pose2, Stamp};
use crate::slam::update::ScanReport;
use crate::statistics::Spread;

/// What the filter knew at one moment; by default, before anything has come.
#[derive(Debug, Clone, Default)]
pub struct Snapshot {
    /// Where the robot is.
    pub estimate: Estimate,
    /// What became of the scans.
    pub ledger: Ledger,
    /// Milliseconds that the last processed scans took; `None` before the first.
    pub milliseconds_per_scan: Option<Spread>,
    /// How many times particles were drawn anew.
    pub resamples: u64,
    /// Whether scans are taken.
    pub paused: bool,
    /// Whether they enter the map.
    pub mode: Mode,
    /// The map; without a map to start from `None` before the first scan and after a reset; often older than the estimate.
    pub map: Option<Arc<MapVersion>>,
}

/// Where the robot is, and how sure that is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    /// Of the last scan or odometry that moved the pose; `None` before the first.
    pub stamp: Option<Stamp>,
    /// The base in `map`.
    pub pose_in_map: Pose2,
    /// Of the cloud of particles, or of the match: m², m rad, rad².
    pub covariance: Matrix3<f64>,
    /// What takes odometry to the map.
    pub map_from_odom: Pose2,
    /// Whether the last scan came with odometry; without, `map` to the base is told.
    pub has_odometry: bool,
    /// The base in `map`, one pose a particle, at the last processed scan.
    #[serde(serialize_with = "write_poses", deserialize_with = "read_poses")]
    pub particles: Arc<[Pose2]>,
    /// About the last processed scan; `None` before the first.
    pub report: Option<ScanReport>,
}

/// Before anything has come; odometry is expected.
impl Default for Estimate {
    fn default() -> Self {
        Self {
            stamp: None,
            pose_in_map: Pose2::IDENTITY,
            covariance: Matrix3::zeros(),
            map_from_odom: Pose2::IDENTITY,
            has_odometry: true,
            particles: Arc::new([]),
            report: None,
        }
    }
}

fn write_poses<S: Serializer>(poses: &Arc<[Pose2]>, to: S) -> Result<S::Ok, S::Error> {
    poses[..].serialize(to)
}

fn read_poses<'de, D: Deserializer<'de>>(from: D) -> Result<Arc<[Pose2]>, D::Error> {
    Vec::deserialize(from).map(Arc::from)
}

/// One version of the map. A copy costs little: tiles and poses are shared.
#[derive(Debug, Clone)]
pub struct MapVersion {
    /// From 1; grows with every change, and with every reset by one more.
    pub version: u64,
    /// Grows when scans that were in the last version lie elsewhere, or are forgotten.
    pub epoch: u64,
    /// Of the last scan in it.
    pub stamp: Stamp,
    /// Hits and visits of each cell.
    pub occupancy: OccupancyMap,
    /// When a cell is occupied.
    pub occupied_threshold: OccupiedThreshold,
    /// The pose of the base at each processed scan.
    pub path: Path,
}

/// What the daemon is doing, in one word.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// No scan has come, or none for a while.
    WaitingForScans,
    /// Scans come, and no odometry for them.
    WaitingForOdometry,
    /// Scans come, and where in the known map they were taken cannot be told.
    NotLocalized,
    /// Scans enter the map.
    Mapping,
    /// Scans tell where the robot is in a map that stays as it is.
    Localizing,
    /// Scans come, and many of them are lost or do not match.
    Degraded,
    /// By command.
    Paused,
}

impl State {
    /// All states, in the order above.
    pub const ALL: [Self; 7] = [
        Self::WaitingForScans,
        Self::WaitingForOdometry,
        Self::NotLocalized,
        Self::Mapping,
        Self::Localizing,
        Self::Degraded,
        Self::Paused,
    ];
}
