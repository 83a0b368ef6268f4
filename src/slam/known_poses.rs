//! Occupancy mapping along poses that somebody else knows: no matching, every scan whole.
//!
//! Where the given poses are in `map`, the map is the occupancy grid of the textbook (Thrun,
//! Burgard, Fox, Probabilistic Robotics, chapter 9): each scan says of each cell at most once that
//! it is free or occupied, and occupied beats free. `map_with_known_poses` of Hector leaves the
//! coarse grids empty, and takes nothing of a beam that ends outside of the map; here the grid
//! grows, and beams are as long as they are.

use serde::{Deserialize, Serialize};

use super::grid::occupancy::{BeamEndKind, Count, OccupancyMap, OccupiedThreshold};
use super::grid::tile_map::saved::SavedMaps;
use super::odometry::{JumpGuard, JumpPolicy};
use super::outline::{BeamLimits, outline};
use super::path::Path;
use super::pose::Pose2;
use super::state::{StateError, ensure_poses};
use super::update::{
    OdometryUpdate, OnPhase, Phase, ScanReading, ScanReport, ScanUpdate, SkipReason,
};

/// Poses may jump, for whoever gives them may have found out better.
const ANY_STEP: JumpGuard = JumpGuard { max_step: f64::INFINITY, policy: JumpPolicy::Continue };

/// What mapping along given poses can be told.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Parameters {
    /// `delta`: metres a cell.
    pub resolution: f64,
    /// Which readings are used.
    pub limits: BeamLimits,
    /// What the map is of.
    pub extent: MapExtent,
    /// `occ_thresh` and `occ_min_visits`: when a cell is occupied.
    pub occupied_threshold: OccupiedThreshold,
}

/// What the map is of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MapExtent {
    /// All scans since the beginning.
    AllScans,
    /// The newest scan alone.
    NewestScan,
}

/// A map along given poses.
#[derive(Debug, Clone)]
pub struct KnownPoses {
    parameters: Parameters,
    map: OccupancyMap,
    path: Path,
    /// The last that was given.
    pose_in_map: Pose2,
}

/// All that mapping along given poses knows.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct KnownPosesState {
    counts: SavedMaps<Count>,
    path: Path,
    pose_in_map: Pose2,
}

impl KnownPoses {
    /// An empty map.
    #[must_use]
    pub fn new(parameters: Parameters) -> Self {
        let map = OccupancyMap::new(parameters.resolution);
        Self { parameters, map, path: Path::default(), pose_in_map: Pose2::IDENTITY }
    }

    /// Forgets map and path; where the base is, the next pose says.
    pub fn reset(&mut self) {
        *self = Self::new(self.parameters);
    }

    /// All that it knows now.
    #[must_use]
    pub fn state(&self) -> KnownPosesState {
        let Self { map, path, pose_in_map, .. } = self;
        let counts = SavedMaps::of([map.counts()]);
        KnownPosesState { counts, path: path.clone(), pose_in_map: *pose_in_map }
    }

    /// Goes on from a state of mapping with the same parameters.
    ///
    /// # Errors
    /// When the state is not one that there can be; nothing is changed.
    pub fn resume(&mut self, state: KnownPosesState) -> Result<(), StateError> {
        let KnownPosesState { counts, path, pose_in_map } = state;
        ensure_poses([pose_in_map].into_iter(), "the pose")?;
        let map = OccupancyMap::of_counts(self.parameters.resolution, counts.restore_one()?);
        *self = Self { parameters: self.parameters, map, path, pose_in_map };
        Ok(())
    }

    /// Takes a pose: the base in `map`.
    pub fn add_pose(&mut self, pose_in_map: Pose2) -> OdometryUpdate {
        if !ANY_STEP.is_usable(pose_in_map) {
            return OdometryUpdate::NotUsable;
        }
        self.pose_in_map = pose_in_map;
        OdometryUpdate::Accepted
    }

    /// Takes a scan, whose odometry is the given pose; `on_phase` is called when it is in the map.
    ///
    /// A scan without an obstacle counts too, if it says that something is free.
    pub fn add_scan(&mut self, reading: &ScanReading<'_>, on_phase: OnPhase<'_>) -> ScanUpdate {
        if self.add_pose(reading.odom_from_base) == OdometryUpdate::NotUsable {
            return ScanUpdate::Skipped(SkipReason::BadOdometry);
        }
        let scan = outline(reading.scan, reading.mount, &self.parameters.limits);
        if scan.ends.iter().all(|end| end.kind == BeamEndKind::Nothing) {
            return ScanUpdate::Skipped(SkipReason::NoUsableBeams);
        }
        if self.parameters.extent == MapExtent::NewestScan {
            self.map = OccupancyMap::new(self.parameters.resolution);
        }
        self.map.add(&scan, self.pose_in_map);
        self.path.push(reading.scan.stamp, self.pose_in_map);
        on_phase(Phase::Map);
        ScanUpdate::Processed(report(
            scan.ends.iter().filter(|end| end.kind == BeamEndKind::Hit).count(),
        ))
    }

    /// The base in `map`, as was given last; the origin before that.
    #[must_use]
    pub const fn pose_in_map(&self) -> Pose2 {
        self.pose_in_map
    }

    /// The given pose of each scan in the map, oldest first.
    #[must_use]
    pub const fn path(&self) -> &Path {
        &self.path
    }

    /// How often the map became another one since the first scan, not only a larger one.
    #[must_use]
    pub fn map_corrections(&self) -> u64 {
        match self.parameters.extent {
            MapExtent::AllScans => 0,
            MapExtent::NewestScan => self.path.len() as u64,
        }
    }

    /// Hits and visits of each cell.
    #[must_use]
    pub const fn occupancy(&self) -> &OccupancyMap {
        &self.map
    }

    /// When a cell is occupied.
    #[must_use]
    pub const fn occupied_threshold(&self) -> OccupiedThreshold {
        self.parameters.occupied_threshold
    }
}

/// There is one hypothesis, and no doubt about it.
const fn report(hits: usize) -> ScanReport {
    ScanReport {
        hits,
        matched: 1,
        best_score: hits as f64,
        effective_sample_size: 1.0,
        entropy: 0.0,
        resampled: false,
        registered: true,
        weak_direction: None,
    }
}
