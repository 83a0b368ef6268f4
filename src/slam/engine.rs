//! The mapping systems, one of which runs.

use std::sync::Arc;

use nalgebra::Matrix3;

use super::gmapping::{GMapping, Parameters, ThreadsError};
use super::grid::occupancy::{OccupancyGrid, OccupancyMap, OccupiedThreshold};
use super::grid::tile_map::TileCounts;
use super::hector::{self, Hector};
use super::known_map::{KnownMap, Mode};
use super::known_poses::{self, KnownPoses};
use super::path::Path;
use super::pose::Pose2;
use super::scan::{LaserMount, Scan};
use super::search::NotLocalized;
use super::state::{EngineState, StateError};
use super::update::{OdometryUpdate, OnPhase, ScanReading, ScanUpdate, SkipReason};

/// Which system maps, with its parameters.
#[derive(Debug, Clone, PartialEq)]
pub enum EngineParameters {
    /// A particle filter, with the seed of its random numbers.
    GMapping(Parameters, u64),
    /// One hypothesis, by matching each scan with the map.
    Hector(hector::Parameters),
    /// Mapping along given poses.
    KnownPoses(known_poses::Parameters),
}

/// A system that makes a map and a path of scans and odometry.
#[derive(Debug, Clone)]
pub enum Engine {
    /// A particle filter.
    GMapping(Box<GMapping>),
    /// One hypothesis, by matching each scan with the map.
    Hector(Box<Hector>),
    /// Mapping along given poses, which come in place of odometry: `odom` is `map`.
    KnownPoses(Box<KnownPoses>),
}

/// A scan with what there is to use it.
#[derive(Debug, Clone, Copy)]
pub struct Sweep<'a> {
    /// The sweep.
    pub scan: &'a Scan,
    /// How the laser sits on the robot.
    pub mount: &'a LaserMount,
    /// Where odometry says the base was when the sweep was taken; `None` where there is none.
    pub odom_from_base: Option<Pose2>,
}

impl Engine {
    /// An engine with no scan yet. `threads` of 1 or 0 runs everything on the caller's thread.
    ///
    /// # Errors
    /// When the threads cannot be started.
    pub fn new(parameters: EngineParameters, threads: usize) -> Result<Self, ThreadsError> {
        match parameters {
            EngineParameters::GMapping(parameters, seed) => {
                Ok(Self::GMapping(Box::new(GMapping::new(parameters, seed, threads)?)))
            }
            EngineParameters::Hector(parameters) => {
                Ok(Self::Hector(Box::new(Hector::new(parameters))))
            }
            EngineParameters::KnownPoses(parameters) => {
                Ok(Self::KnownPoses(Box::new(KnownPoses::new(parameters))))
            }
        }
    }

    /// All that it knows, to go on from later. A clone of the engine costs little; this does not.
    #[must_use]
    pub fn state(&self) -> EngineState {
        match self {
            Self::GMapping(filter) => EngineState::GMapping(Box::new(filter.state())),
            Self::Hector(hector) => EngineState::Hector(Box::new(hector.state())),
            Self::KnownPoses(mapping) => EngineState::KnownPoses(Box::new(mapping.state())),
        }
    }

    /// Goes on from a state: what comes next gives the same bytes as where the state is from.
    ///
    /// # Errors
    /// When the state is of another engine, or is not one that an engine with these parameters can
    /// have; nothing is changed.
    pub fn resume(&mut self, state: EngineState) -> Result<(), StateError> {
        match (self, state) {
            (Self::GMapping(filter), EngineState::GMapping(state)) => filter.resume(*state),
            (Self::Hector(hector), EngineState::Hector(state)) => hector.resume(*state),
            (Self::KnownPoses(mapping), EngineState::KnownPoses(state)) => mapping.resume(*state),
            (Self::GMapping(_) | Self::Hector(_) | Self::KnownPoses(_), _) => {
                Err(StateError::OtherEngine)
            }
        }
    }

    /// An engine that begins with a known map. Where no initial pose is set, that of the first scan
    /// is searched for. Mapping along given poses takes no map.
    ///
    /// # Errors
    /// When the threads cannot be started.
    pub fn from_map(
        parameters: EngineParameters,
        threads: usize,
        known: Arc<KnownMap>,
    ) -> Result<Self, ThreadsError> {
        let mut engine = Self::new(parameters, threads)?;
        match &mut engine {
            Self::GMapping(filter) => filter.begin_on(known),
            Self::Hector(hector) => hector.begin_on(known),
            Self::KnownPoses(_) => {}
        }
        Ok(engine)
    }

    /// Whether scans enter the map from now on; where poses are given, this has no effect.
    pub fn set_mode(&mut self, mode: Mode) {
        match self {
            Self::GMapping(filter) => filter.set_mode(mode),
            Self::Hector(hector) => hector.set_mode(mode),
            Self::KnownPoses(_) => {}
        }
    }

    /// Whether scans enter the map.
    #[must_use]
    pub const fn mode(&self) -> Mode {
        match self {
            Self::GMapping(filter) => filter.mode(),
            Self::Hector(hector) => hector.mode(),
            Self::KnownPoses(_) => Mode::Mapping,
        }
    }

    /// Why the last scan was [`SkipReason::NotLocalized`], until one is localized.
    #[must_use]
    pub const fn obstacle(&self) -> Option<&NotLocalized> {
        match self {
            Self::GMapping(filter) => filter.obstacle(),
            Self::Hector(hector) => hector.obstacle(),
            Self::KnownPoses(_) => None,
        }
    }

    /// Forgets map and path, as if nothing had been read: the next scan is the first, at
    /// `initial_pose` in `map`, or where odometry says.
    pub fn reset(&mut self, initial_pose: Option<Pose2>) {
        match self {
            Self::GMapping(filter) => filter.reset(initial_pose),
            Self::Hector(hector) => hector.reset(initial_pose),
            Self::KnownPoses(mapping) => mapping.reset(),
        }
    }

    /// Says where the base is in `map`: before the first scan, where the map begins; later, the
    /// robot is moved, and the map stays where it is. Where poses are given, this has no effect.
    pub fn set_pose(&mut self, pose_in_map: Pose2) {
        match self {
            Self::GMapping(filter) => filter.set_pose(pose_in_map),
            Self::Hector(hector) => hector.set_pose(pose_in_map),
            Self::KnownPoses(_) => {}
        }
    }

    /// Forgets where the base is in `map`: its place is searched for there, until a scan fits
    /// there and nowhere else. Where poses are given, this has no effect.
    pub fn search_pose(&mut self) {
        match self {
            Self::GMapping(filter) => filter.search_pose(),
            Self::Hector(hector) => hector.search_pose(),
            Self::KnownPoses(_) => {}
        }
    }

    /// Whether nobody knows where the base is in the map so far.
    #[must_use]
    pub const fn is_searching(&self) -> bool {
        match self {
            Self::GMapping(filter) => filter.is_searching(),
            Self::Hector(hector) => hector.is_searching(),
            Self::KnownPoses(_) => false,
        }
    }

    /// Forgets where odometry has the base: the next reading begins anew, and is no motion. Where
    /// poses are given, this has no effect.
    pub const fn forget_odometry(&mut self) {
        match self {
            Self::GMapping(filter) => filter.forget_odometry(),
            Self::Hector(hector) => hector.forget_odometry(),
            Self::KnownPoses(_) => {}
        }
    }

    /// Takes an odometry reading: the base in `odom`.
    pub fn add_odometry(&mut self, odom_from_base: Pose2) -> OdometryUpdate {
        match self {
            Self::GMapping(filter) => filter.add_odometry(odom_from_base),
            Self::Hector(hector) => hector.add_odometry(odom_from_base),
            Self::KnownPoses(mapping) => mapping.add_pose(odom_from_base),
        }
    }

    /// Takes a scan; `on_phase` is called as each phase of processing ends.
    pub fn add_scan(&mut self, sweep: &Sweep<'_>, on_phase: OnPhase<'_>) -> ScanUpdate {
        let &Sweep { scan, mount, odom_from_base } = sweep;
        match (self, odom_from_base) {
            (Self::GMapping(filter), Some(odom_from_base)) => {
                filter.add_scan(&ScanReading { scan, mount, odom_from_base }, on_phase)
            }
            (Self::KnownPoses(mapping), Some(odom_from_base)) => {
                mapping.add_scan(&ScanReading { scan, mount, odom_from_base }, on_phase)
            }
            (Self::GMapping(_) | Self::KnownPoses(_), None) => {
                ScanUpdate::Skipped(SkipReason::BadOdometry)
            }
            (Self::Hector(hector), _) => hector.add_scan(sweep, on_phase),
        }
    }

    /// The base in `map` at the last processed scan, with odometry since; the initial pose before
    /// the first scan.
    #[must_use]
    pub fn pose_in_map(&self) -> Pose2 {
        match self {
            Self::GMapping(filter) => filter.pose_in_map(),
            Self::Hector(hector) => hector.pose_in_map(),
            Self::KnownPoses(mapping) => mapping.pose_in_map(),
        }
    }

    /// What takes odometry poses to the map; the identity before the first scan and without
    /// odometry.
    #[must_use]
    pub fn map_from_odom(&self) -> Pose2 {
        match self {
            Self::GMapping(filter) => filter.map_from_odom(),
            Self::Hector(hector) => hector.map_from_odom(),
            Self::KnownPoses(_) => Pose2::IDENTITY,
        }
    }

    /// How sure the pose of the last processed scan is: m², m rad, rad².
    #[must_use]
    pub fn covariance(&self) -> Matrix3<f64> {
        match self {
            Self::GMapping(filter) => filter.cloud_covariance(),
            Self::Hector(hector) => hector.covariance(),
            Self::KnownPoses(_) => Matrix3::zeros(),
        }
    }

    /// The base in `map` as each hypothesis has it; none before the first scan.
    #[must_use]
    pub fn hypotheses(&self) -> Vec<Pose2> {
        match self {
            Self::GMapping(filter) => filter.particles().iter().map(|p| p.pose_in_map()).collect(),
            Self::Hector(hector) if hector.has_begun() => vec![hector.pose_in_map()],
            Self::Hector(_) => Vec::new(),
            Self::KnownPoses(mapping) if mapping.path().is_empty() => Vec::new(),
            Self::KnownPoses(mapping) => vec![mapping.pose_in_map()],
        }
    }

    /// Whether a scan has been processed.
    #[must_use]
    pub fn has_begun(&self) -> bool {
        match self {
            Self::GMapping(filter) => !filter.particles().is_empty(),
            Self::Hector(hector) => hector.has_begun(),
            Self::KnownPoses(mapping) => !mapping.path().is_empty(),
        }
    }

    /// The pose of the base at each processed scan as it is known now, oldest first.
    #[must_use]
    pub fn path(&self) -> Path {
        match self {
            Self::GMapping(filter) => filter.path(),
            Self::Hector(hector) => hector.path().clone(),
            Self::KnownPoses(mapping) => mapping.path().clone(),
        }
    }

    /// Hits and visits of each cell.
    pub fn occupancy(&mut self) -> &OccupancyMap {
        match self {
            Self::GMapping(filter) => filter.occupancy(),
            Self::Hector(hector) => hector.occupancy(),
            Self::KnownPoses(mapping) => mapping.occupancy(),
        }
    }

    /// When a cell is occupied.
    #[must_use]
    pub fn occupied_threshold(&self) -> OccupiedThreshold {
        match self {
            Self::GMapping(filter) => filter.occupied_threshold(),
            Self::Hector(_) => hector::OCCUPIED_THRESHOLD,
            Self::KnownPoses(mapping) => mapping.occupied_threshold(),
        }
    }

    /// How often the map became another one since the first scan, not only a larger one.
    #[must_use]
    pub fn map_corrections(&self) -> u64 {
        match self {
            Self::GMapping(filter) => filter.map_corrections(),
            Self::Hector(_) => 0,
            Self::KnownPoses(mapper) => mapper.map_corrections(),
        }
    }

    /// The map, cropped to what is known; `None` before the first scan.
    #[must_use]
    pub fn occupancy_grid(&mut self) -> Option<OccupancyGrid> {
        let threshold = self.occupied_threshold();
        self.occupancy().to_grid(threshold)
    }

    /// The tiles of the maps that scans are matched with.
    #[must_use]
    pub fn tiles(&self) -> TileCounts {
        match self {
            Self::GMapping(filter) => filter.particle_tiles(),
            Self::Hector(hector) => hector.tiles(),
            Self::KnownPoses(_) => TileCounts::default(),
        }
    }
}
